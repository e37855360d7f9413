"""SUMO in a process, forked at the current step of every window and again for every episode.

Started by `python -m rlftsim.scenario.synthetic.rerun WORLD SOCKET`; imports libsumo and the parser of JSON alone.
SUMO stores no state exactly: a copied process is the only copy of a state that goes on bit for bit. The processes:

1. The first walks through the network. It receives an index of a window with the socket of an episode.
2. One waits at the current step of each window that was passed, receives the sockets of its episodes, and forks.
3. One for each episode receives lists of the ego's poses, makes a step for each, and answers with what SUMO shows.

Each ends when its socket is closed. Nothing stays behind.
"""

import json
import math
import os
import signal
import socket
import sys
import tempfile
import zipfile
from typing import Any

import libsumo  # pyright: ignore[reportMissingImports]

from rlftsim.jobs.documents import parse_json

NETWORK, ROUTES, DOCUMENT = "network.net.xml", "demand.rou.xml", "world.json"
"""Members of the archive of a world."""
DIGITS = 4
"""Decimal places of the recording, to which all that is answered is rounded."""
STRANGER_WITHIN_M = 20.0


def start_sumo(path: str) -> list[dict[str, Any]]:
    """Start the simulation of a world; returns the windows in the order of the current steps."""
    with zipfile.ZipFile(path) as archive, tempfile.TemporaryDirectory() as folder:
        document = parse_json(archive.read(DOCUMENT), "make the data set again", source=DOCUMENT)
        files = [archive.extract(name, folder) for name in (NETWORK, ROUTES)]
        # all routes at once: forked processes would share the position in the open file
        options = [*document["options"], "--seed", str(document["seed"]), "--route-steps", "0"]
        libsumo.start(["sumo", "-n", files[0], "-r", files[1], *options])
    return document["windows"]


def serve_world(control: socket.socket, windows: list[dict[str, Any]]) -> None:
    """Walk to the windows that are asked for, and hand the sockets of episodes on until the control is closed.

    Args:
        control: Socket that receives the index of a window as text, each with the socket of an episode.
        windows: Windows of the world in the order of the current steps.
    """
    steps, forked = 0, []
    while True:
        message, descriptors, *_ = socket.recv_fds(control, 16, 1)
        if not descriptors:
            return
        while len(forked) <= int(message):
            window = windows[len(forked)]
            while steps < window["num_steps"]:
                libsumo.simulationStep()
                steps += 1
            window_control, window_end = socket.socketpair()
            if os.fork() == 0:
                for parent_socket in (control, window_control, *forked):
                    parent_socket.close()
                os.close(descriptors[0])
                serve_window(window_end, window)
                os._exit(0)
            window_end.close()
            forked.append(window_control)
        socket.send_fds(forked[int(message)], [b"."], descriptors)
        os.close(descriptors[0])


def serve_window(control: socket.socket, window: dict[str, Any]) -> None:
    """Fork an episode for each socket that comes, until the control is closed.

    Args:
        control: Socket that receives a byte with the socket of each episode.
        window: Window at whose current step SUMO stands.
    """
    while True:
        _, descriptors, *_ = socket.recv_fds(control, 1, 1)
        if not descriptors:
            return
        channel = socket.socket(fileno=descriptors[0])
        if os.fork() == 0:
            control.close()
            Episode(window).serve(channel)
            os._exit(0)
        channel.close()


class Episode:
    """Steps of SUMO from the current step of a window, with the ego put at poses.

    Args:
        window: Window at whose current step SUMO stands.
    """

    def __init__(self, window: dict[str, Any]):
        self.ego, self.lights = window["ego"], window["lights"]
        self.tracks = [track["sumo_id"] for track in window["tracks"]]
        self.is_driven = False
        self.off_lane_steps, self.strangers = 0, set()

    def serve(self, channel: socket.socket) -> None:
        """Answer lists of poses, a line of JSON each, until the channel is closed."""
        for line in channel.makefile():
            for pose in parse_json(line, "start again", source="the poses", expected=list):
                self.step(pose)
            channel.sendall(json.dumps(self.describe()).encode() + b"\n")

    def step(self, pose: list[float] | None) -> None:
        """Step of 0.1 s; the others see the ego where it was before.

        Args:
            pose: x, y of the ego's front bumper, m, and SUMO's angle, degrees, after the step; None lets SUMO drive.
        """
        if pose is not None and self.ego in libsumo.vehicle.getIDList():
            self.put_ego(pose)
        libsumo.simulationStep()
        is_present = self.ego in libsumo.vehicle.getIDList()
        self.off_lane_steps += not is_present or libsumo.vehicle.getLaneID(self.ego) == ""
        if is_present:
            x, y = libsumo.vehicle.getPosition(self.ego)
            for users in (libsumo.vehicle, libsumo.person):
                for name in set(users.getIDList()).difference(self.tracks, [self.ego], self.strangers):
                    if math.dist((x, y), users.getPosition(name)) < STRANGER_WITHIN_M:
                        self.strangers.add(name)

    def put_ego(self, pose: list[float]) -> None:
        """Ask SUMO to put the ego at a pose [x, y, angle] at the end of the step."""
        x, y, angle = pose
        vehicle = libsumo.vehicle
        if not self.is_driven:
            self.is_driven = True
            vehicle.setSpeedMode(self.ego, 0)
            vehicle.setLaneChangeMode(self.ego, 0)
        edge, position_m, lane = libsumo.simulation.convertRoad(x, y, False, vehicle.getVehicleClass(self.ego))
        # moved to the next lane first: else a shadow, which stops its followers, stays on the old lane for ever
        if edge == vehicle.getRoadID(self.ego) and edge[:1] != ":" and lane != vehicle.getLaneIndex(self.ego):
            vehicle.moveTo(self.ego, f"{edge}_{lane}", position_m)
        vehicle.moveToXY(self.ego, "", -1, x, y, angle=angle, keepRoute=2)

    def describe(self) -> dict[str, Any]:
        """What SUMO shows: poses of the tracks (None = gone), letters of the lights, and counts since the start."""
        poses = {}
        for users in (libsumo.vehicle, libsumo.person):
            for name in set(users.getIDList()).intersection(self.tracks):
                poses[name] = [round(value, DIGITS) for value in (*users.getPosition(name), users.getAngle(name))]
        states = {junction: libsumo.trafficlight.getRedYellowGreenState(junction) for junction, _, _ in self.lights}
        return {
            "poses": [poses.get(name) for name in self.tracks],
            "lights": "".join(states[junction][link] for junction, link, _ in self.lights),
            "off_lane_steps": self.off_lane_steps,
            "num_strangers": len(self.strangers),
        }


def main() -> None:
    """Serve a world until the parent closes its socket."""
    # an interrupt is the parent's to handle; children that end need nobody to wait for them
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    signal.signal(signal.SIGCHLD, signal.SIG_IGN)
    windows = start_sumo(sys.argv[1])
    serve_world(socket.socket(fileno=int(sys.argv[2])), windows)


if __name__ == "__main__":
    main()

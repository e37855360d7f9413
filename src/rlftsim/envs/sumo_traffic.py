"""SUMO as the traffic: the world of a log runs again from the current step on, with the planner's ego in it.

A state holds the ego's poses since the current step, so a state stays a value. A process for each network, see
`scenario.synthetic.rerun`, keeps the latest states; any other state is made again by repeating the poses.
"""

import importlib.util
import json
import os
import socket
import subprocess
import sys
from collections import OrderedDict
from dataclasses import dataclass, field, replace
from importlib import metadata
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Bool, Float, Int64

from rlftsim.envs.scene import GREEN, RED, YELLOW, Lights, Scene
from rlftsim.errors import ConfigError, DataError, EpisodeFailure
from rlftsim.jobs.documents import parse_json
from rlftsim.scenario.synthetic.bodies import BodyState, SumoPose, advance_body
from rlftsim.scenario.synthetic.crop import on_grid
from rlftsim.scenario.synthetic.windows import HEADING_GRID_PER_RAD, POSITION_GRID_PER_M, VELOCITY_GRID_PER_MPS
from rlftsim.scenario.synthetic.worlds import REMEDY, WindowSource, find_window
from rlftsim.scenario.types import CURRENT_STEP, STEP_S

WORKER = "rlftsim.scenario.synthetic.rerun"
MAX_WORLDS = 16
"""Networks that run at the same time in a process of this package, about 100 MB each."""
MAX_EPISODES = 64
"""Latest states that are kept of each network."""
COLORS = {"G": GREEN, "g": GREEN, "y": YELLOW, "Y": YELLOW}
"""Of SUMO's letters; all others mean red."""
Poses = tuple[SumoPose | None, ...]
"""SUMO's pose of the ego at each step after the current one; None = SUMO drives it."""


@dataclass(frozen=True, eq=False)
class SumoScene:
    """A scene whose other agents SUMO drives."""

    window: WindowSource
    rows: tuple[int, ...]
    """Agent of each track of the window."""
    lights: Int64[np.ndarray, "T"]
    """Index in SUMO's answers of each light of the scene."""
    ahead_m: float | None = 0.0
    """Distance by which SUMO's ego is ahead of the planner's; None = SUMO drives an ego of its own."""


@dataclass(frozen=True, eq=False)
class SumoState:
    """All that the next step of a scene depends on, and what SUMO has shown."""

    poses: Poses
    bodies: tuple[BodyState, ...]
    has_left: Bool[np.ndarray, "A"]
    """True = is not there any more: vehicles leave where the network ends."""
    lights: Lights
    """Lights of the scene, up to the present step as SUMO showed them."""
    off_lane_steps: int = 0
    """Steps at which the ego was on no lane, where SUMO's drivers do not see it."""
    num_strangers: int = 0
    """Road users that came within 20 m of the ego and are no agents of the scene."""


def check_sumo() -> None:
    """Check that SUMO can be the traffic here.

    Raises:
        ConfigError: The extra is not installed, or the system cannot fork processes.
    """
    if importlib.util.find_spec("libsumo") is None:
        raise ConfigError('traffic "sumo" needs libsumo: pip install "rlftsim[synthetic]".')
    if not hasattr(os, "fork"):
        raise ConfigError('traffic "sumo" needs a system that forks processes: Linux or macOS.')


def build_sumo_scene(scene: Scene, data: Path) -> SumoScene:
    """What SUMO needs to drive the other agents of a scene.

    Args:
        scene: Scene of a scenario of the data set.
        data: Folder of the data set.

    Raises:
        ConfigError: Another version of SUMO than that of the world.
        DataError: The scenario has no world, or the archive is damaged.
    """
    window = find_window(data, scene.scenario.scenario_id)
    version = metadata.version("libsumo")
    if window.sumo_version != version:
        raise ConfigError(
            f"{window.path} was made by SUMO {window.sumo_version}, this is {version}, whose traffic differs: "
            f"pip install libsumo=={window.sumo_version}, or make the data set again."
        )
    row_of_id = {object_id: row for row, object_id in enumerate(scene.object_id.tolist())}
    lane_ids = np.unique(scene.scenario.lights.lane_id).tolist()
    if not {track.object_id for track in window.tracks} <= {*row_of_id} or not {*lane_ids} <= {*window.light_lanes}:
        raise DataError(f"{window.path}: not of this scenario {scene.scenario.scenario_id}: {REMEDY}.")
    lights = np.array([window.light_lanes.index(lane_id) for lane_id in lane_ids], np.int64)
    return SumoScene(window, tuple(row_of_id[track.object_id] for track in window.tracks), lights)


def begin_sumo(sumo_scene: SumoScene, scene: Scene) -> SumoState:
    """State at the current step of the log."""
    has_left = np.zeros(len(scene.object_id), bool)
    return SumoState((), tuple(track.state for track in sumo_scene.window.tracks), has_left, scene.lights)


def advance_sumo(
    sumo_scene: SumoScene, state: SumoState, motion: Float[np.ndarray, "A 5"], scene: Scene,
    ego: Float[np.ndarray, "5"] | None,
) -> tuple[SumoState, Float[np.ndarray, "A 5"]]:  # fmt: skip
    """State and motion of the agents 0.1 s later; agents that have left keep their last pose at rest.

    Args:
        sumo_scene: Scene whose other agents SUMO drives.
        state: State before the step; not changed.
        motion: Motion of all agents before the step, map frame.
        scene: Scene of the agents.
        ego: Motion of the ego after the step, which the result leaves out; None = SUMO drives it.
    """
    pose, origin = None, scene.scenario.origin
    if ego is not None and sumo_scene.ahead_m is not None:
        ahead_m = scene.size[scene.ego, 0] / 2 + sumo_scene.ahead_m
        front = ego[:2] + ahead_m * np.array([np.cos(ego[2]), np.sin(ego[2])]) + origin
        pose = (float(front[0]), float(front[1]), 90.0 - float(np.degrees(ego[2])))
    poses = (*state.poses, pose)
    answer = _find_world(sumo_scene.window.path).step(sumo_scene.window.index, poses)
    step = CURRENT_STEP + len(poses)
    motion = np.concatenate([motion[:, :3], np.zeros((len(motion), 2))], 1)
    bodies, has_left = list(state.bodies), state.has_left.copy()
    rows = []
    for index, (track, track_pose) in enumerate(zip(sumo_scene.window.tracks, answer["poses"], strict=True)):
        row = sumo_scene.rows[index]
        if track_pose is None:
            has_left[row] = True
            continue
        bodies[index], box = advance_body(track.shape, bodies[index], tuple(track_pose))
        rows.append((row, *box))
    if rows:
        agents, boxes = np.array([row[0] for row in rows]), np.array([row[1:] for row in rows])
        # as a log stores them
        motion[agents, :2] = on_grid(boxes[:, :2], POSITION_GRID_PER_M) - origin
        motion[agents, 2] = on_grid(boxes[:, 2], HEADING_GRID_PER_RAD)
        motion[agents, 3:] = on_grid(boxes[:, 3:], VELOCITY_GRID_PER_MPS)
    colors = np.array([COLORS.get(letter, RED) for letter in answer["lights"]], np.int64)[sumo_scene.lights]
    lights = _with_colors(state.lights, step, colors)
    counts = answer["off_lane_steps"], answer["num_strangers"]
    return SumoState(poses, tuple(bodies), has_left, lights, *counts), motion


def _with_colors(lights: Lights, step: int, colors: Int64[np.ndarray, "T"]) -> Lights:
    """Lights with other states at a step of the log's time."""
    state, age_s = lights.state.copy(), lights.age_s.copy()
    state[step] = colors
    num_steps = np.where(colors == state[step - 1], np.rint(age_s[step - 1] / STEP_S) + 1, 0)
    age_s[step] = STEP_S * num_steps
    return replace(lights, state=state, age_s=age_s)


@dataclass(eq=False)
class SumoWorld:
    """A process that runs a network again, and the sockets of the episodes in it."""

    path: Path
    channels: "OrderedDict[tuple[int, Poses], socket.socket]" = field(default_factory=OrderedDict)
    """By window and poses, the latest one last."""
    process: "subprocess.Popen[bytes] | None" = None
    control: socket.socket | None = None

    def step(self, window: int, poses: Poses) -> dict[str, Any]:
        """What SUMO shows after the last of the poses.

        Args:
            window: Index of the window in the archive.
            poses: All poses of the ego since the current step, at least one.

        Raises:
            EpisodeFailure: The process has failed twice.
        """
        reason = ""
        for _ in range(2):  # a process that was killed, perhaps for memory: all its states can be made again
            try:
                return self._step(window, poses)
            except (OSError, EOFError):
                reason = self.close()
        raise EpisodeFailure(
            f"SUMO has failed twice in {self.path} ({reason}): free memory, or leave the scenario out."
        )

    def _step(self, window: int, poses: Poses) -> dict[str, Any]:
        channel, new_poses = self.channels.pop((window, poses[:-1]), None), poses[-1:]
        if channel is None:
            channel, new_poses = self._open(window), poses
        channel.sendall(json.dumps(new_poses).encode() + b"\n")
        answer = b""
        while not answer.endswith(b"\n"):
            received = channel.recv(1 << 16)
            if not received:
                raise EOFError
            answer += received
        self.channels[window, poses] = channel
        while len(self.channels) > MAX_EPISODES:
            self.channels.popitem(last=False)[1].close()
        return parse_json(answer, REMEDY, source="the answer of SUMO")

    def _open(self, window: int) -> socket.socket:
        """Socket of a new episode, in which SUMO stands at the current step of a window."""
        if self.process is None:
            self.control, control_end = socket.socketpair()
            command = [sys.executable, "-m", WORKER, str(self.path), str(control_end.fileno())]
            self.process = subprocess.Popen(
                command, pass_fds=[control_end.fileno()], stdin=subprocess.DEVNULL, stdout=subprocess.DEVNULL,
                stderr=subprocess.PIPE,
            )  # fmt: skip
            control_end.close()
        assert self.control is not None
        channel, channel_end = socket.socketpair()
        with channel_end:
            socket.send_fds(self.control, [str(window).encode()], [channel_end.fileno()])
        return channel

    def close(self) -> str:
        """End the processes, each of which ends when its socket is closed; returns the last line of their errors."""
        while self.channels:
            self.channels.popitem()[1].close()
        if self.process is None or self.control is None:
            return "not started"
        self.control.close()
        lines = self.process.communicate()[1].decode(errors="replace").strip().splitlines()
        reason = lines[-1] if lines else f"status {self.process.returncode}"
        self.process = self.control = None
        return reason


_WORLDS: "OrderedDict[tuple[int, Path], SumoWorld]" = OrderedDict()
"""By process and archive, the latest one last: a forked process must not talk to the sockets of its parent."""


def _find_world(path: Path) -> SumoWorld:
    """The running network of an archive, started if there is none."""
    key = os.getpid(), path
    _WORLDS[key] = _WORLDS.pop(key, None) or SumoWorld(path)
    while len(_WORLDS) > MAX_WORLDS:
        _WORLDS.popitem(last=False)[1].close()
    return _WORLDS[key]

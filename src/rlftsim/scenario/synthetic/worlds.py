"""Worlds that SUMO can run again: an archive for each network, beside the shards of a data set.

An archive holds network and routes as SUMO reads them, and a document with seed, version, options and windows.
"""

import json
import re
import zipfile
from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache
from pathlib import Path
from zlib import error as ZlibError

from rlftsim.errors import DataError
from rlftsim.jobs.documents import MAX_TEXT_BYTES, first_line, parse_json
from rlftsim.jobs.files import write_atomically
from rlftsim.scenario.synthetic.bodies import BodyShape, BodyState
from rlftsim.scenario.synthetic.sumo import DISCARDED_S, OPTIONS, SIMULATED_S, sumo_version
from rlftsim.scenario.synthetic.windows import Window, World
from rlftsim.scenario.types import CURRENT_STEP, STEP_S

WORLDS, SUFFIX = "worlds", ".world"
NETWORK, ROUTES, DOCUMENT = "network.net.xml", "demand.rou.xml", "world.json"
"""Members of an archive, which `rerun` reads, too."""
FORMAT = "rlftsim-world-1"
REMEDY = "make the data set again with rlftsim synthesize --keep-worlds"


@dataclass(frozen=True)
class TrackSource:
    """A track that SUMO moves; parked cars have none."""

    object_id: int
    shape: BodyShape
    state: BodyState
    """State at the current step."""


@dataclass(frozen=True)
class WindowSource:
    """A scenario as SUMO runs it again."""

    path: Path
    """Archive of the world."""
    index: int
    """Index of the window in the archive."""
    sumo_version: str
    tracks: tuple[TrackSource, ...]
    """Tracks of the current step but the ego."""
    light_lanes: tuple[int, ...]
    """Lane id of each light."""


def write_world(folder: Path, world: World, windows: Sequence[Window]) -> None:
    """Write the archive of a world; equal worlds give equal bytes.

    Args:
        folder: Folder of the worlds, created if missing.
        world: World with a source.
        windows: Windows that became scenarios.

    Raises:
        DataError: The file cannot be written.
    """
    assert world.source is not None
    links = {lane_id: (junction, link) for junction, link, lane_id, _ in world.cropper.network_map.light_lanes}
    document = {
        "format": FORMAT,
        "sumo_version": sumo_version(),
        "seed": world.source.seed,
        "options": OPTIONS,
        "windows": [_describe_window(window, links) for window in sorted(windows, key=lambda window: window.start)],
    }
    # netconvert writes the date and the paths of its files into a comment
    network = re.sub("<!--.*?-->", "", world.source.network, flags=re.DOTALL)
    routes = re.sub("<!--.*?-->", "", world.source.routes, flags=re.DOTALL)

    def write(temporary: Path) -> None:
        with zipfile.ZipFile(temporary, "w", zipfile.ZIP_DEFLATED) as archive:
            for name, text in ((DOCUMENT, json.dumps(document)), (NETWORK, network), (ROUTES, routes)):
                archive.writestr(zipfile.ZipInfo(name), text, zipfile.ZIP_DEFLATED)

    write_atomically(folder / f"{world.name.replace('/', '-')}{SUFFIX}", write)


def _describe_window(window: Window, links: dict[int, tuple[str, int]]) -> dict[str, object]:
    """What a window has in an archive."""
    scenario, current_step = window.scenario, window.start + CURRENT_STEP
    ego, is_valid = window.bodies[scenario.ego_index].dragging, scenario.tracks.valid[:, CURRENT_STEP]
    assert ego is not None, "the ego is a moving vehicle"
    tracks = [
        {
            "object_id": int(object_id), "sumo_id": body.dragging.sumo_id, "shape": body.dragging.shape,
            "state": body.dragging.states[current_step - body.first_step],
        }
        for object_id, body, is_track in zip(scenario.tracks.object_id, window.bodies, is_valid)
        if is_track and body.dragging is not None and body.dragging is not ego
    ]  # fmt: skip
    lights = [[*links[lane_id], lane_id] for lane_id in sorted(set(scenario.lights.lane_id.tolist()))]
    # the row that SUMO writes for a time is what its interface shows one step later
    num_steps = round(DISCARDED_S / STEP_S) + current_step + 1
    return {
        "scenario_id": scenario.scenario_id, "num_steps": num_steps, "ego": ego.sumo_id, "tracks": tracks,
        "lights": lights,
    }  # fmt: skip


def find_window(folder: Path, scenario_id: str) -> WindowSource:
    """Source of a scenario.

    Args:
        folder: Folder of the data set, which has the folder of the worlds.
        scenario_id: Id of a scenario of the data set.

    Raises:
        DataError: A data set without worlds, no such scenario in any world, or a damaged archive.
    """
    worlds = folder / WORLDS
    windows = _read_folder(worlds, worlds.stat().st_mtime_ns) if worlds.is_dir() else {}
    if scenario_id not in windows:
        raise DataError(f"scenario {scenario_id}: {worlds} has no world that SUMO can run again: {REMEDY}.")
    return windows[scenario_id]


@lru_cache(maxsize=8)
def _read_folder(worlds: Path, changed: int) -> dict[str, WindowSource]:
    """Windows of all archives by scenario id; `changed` is the time of the last change, which the cache goes by."""
    return {name: window for path in sorted(worlds.glob(f"*{SUFFIX}")) for name, window in _read_world(path).items()}


def _read_world(path: Path) -> dict[str, WindowSource]:
    """Windows of an archive by scenario id.

    Raises:
        DataError: A damaged archive, or one of another version of this package.
    """
    try:
        with zipfile.ZipFile(path) as archive:
            if archive.getinfo(DOCUMENT).file_size > MAX_TEXT_BYTES:
                raise ValueError(f"{DOCUMENT} is larger than {MAX_TEXT_BYTES >> 20} MiB")
            text = archive.read(DOCUMENT)
    except (OSError, KeyError, ValueError, RuntimeError, EOFError, zipfile.BadZipFile, ZlibError) as problem:
        raise DataError(f"{path}: no archive of a world ({first_line(problem)}): {REMEDY}.") from None
    document = parse_json(text, REMEDY, source=f"{path}: {DOCUMENT}")
    if document.get("format") != FORMAT or document.get("options") != list(OPTIONS):
        raise DataError(f"{path}: of another version of rlftsim: {REMEDY}.")
    try:
        steps = [int(window["num_steps"]) for window in document["windows"]]
        if steps != sorted(steps) or max(steps, default=0) > SIMULATED_S / STEP_S:
            raise ValueError("windows out of order")
        return {
            str(window["scenario_id"]): WindowSource(
                path, index, str(document["sumo_version"]), tuple(map(_parse_track, window["tracks"])),
                tuple(int(lane_id) for _, _, lane_id in window["lights"]),
            )
            for index, window in enumerate(document["windows"])
        }  # fmt: skip
    except (KeyError, TypeError, ValueError, AttributeError) as problem:
        raise DataError(f"{path}: a damaged world ({first_line(problem)}): {REMEDY}.") from None


def _parse_track(track: dict[str, object]) -> TrackSource:
    """Track of an archive.

    Raises:
        KeyError, TypeError, ValueError: A value is missing or of the wrong type.
    """
    shape, state = (map(float, track[name]) for name in ("shape", "state"))  # type: ignore[arg-type]
    return TrackSource(int(track["object_id"]), BodyShape(*shape), BodyState(*state))  # type: ignore[call-overload]

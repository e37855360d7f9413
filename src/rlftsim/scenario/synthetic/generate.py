"""Make a data set of synthetic scenarios: one street network after another, each in its own process."""

import json
import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from itertools import islice
from pathlib import Path

import numpy as np

from rlftsim.errors import ConfigError, DataError, RlftsimError
from rlftsim.files import write_text
from rlftsim.progress import progress_bar
from rlftsim.scenario.dataset import (
    INCOMPLETE,
    MANIFEST,
    SHARDS,
    Manifest,
    describe_shard,
    read_manifest,
    write_index_and_manifest,
)
from rlftsim.scenario.shards import ShardReader, ShardWriter
from rlftsim.scenario.synthetic import sumo
from rlftsim.scenario.synthetic.city_plan import draw_city_plan
from rlftsim.scenario.synthetic.crop import MapCropper
from rlftsim.scenario.synthetic.demand import write_demand
from rlftsim.scenario.synthetic.freeway_plan import draw_freeway_plan
from rlftsim.scenario.synthetic.ground import draw_ground
from rlftsim.scenario.synthetic.map_features import build_network_map
from rlftsim.scenario.synthetic.network import Network, read_network
from rlftsim.scenario.synthetic.parking import park_in_lots, park_in_strips
from rlftsim.scenario.synthetic.recording import SignalStates, read_pedestrians, read_signals, read_vehicles
from rlftsim.scenario.synthetic.windows import World, cut_scenarios
from rlftsim.scenario.types import STEP_S, Scenario
from rlftsim.workers import Advance, run_tasks

GENERATOR_VERSION = 1
LICENCE_NOTE = "CC0-1.0: synthetic scenarios, no rights reserved."
KINDS = ("city", "quiet", "city", "freeway", "city", "city", "quiet", "city")
"""Kinds of the networks in turn; a freeway gives half as many scenarios as the others."""
LOTS_PER_STREET = {"city": 0.35, "quiet": 0.22, "freeway": 0.0}
MAX_ATTEMPTS = 6
_NUM_STEPS = round((sumo.SIMULATED_S - sumo.DISCARDED_S) / STEP_S)


@dataclass(frozen=True)
class SyntheticRequest:
    """What decides, together with the versions, every scenario of a generated data set."""

    num_scenarios: int
    seed: int
    scenarios_per_network: int = 10
    splits: Mapping[str, float] | None = None
    """Share of the scenarios by split; None = 80 % training, 20 % validation."""

    def __post_init__(self) -> None:
        if self.num_scenarios < 1 or self.scenarios_per_network < 1:
            raise ConfigError(
                f"num_scenarios = {self.num_scenarios} and scenarios_per_network = {self.scenarios_per_network} "
                "must both be at least 1"
            )
        if abs(sum(self.shares.values()) - 1.0) > 1e-6:
            raise ConfigError(f"the shares of the splits must sum to 1, got {dict(self.shares)}")

    @property
    def shares(self) -> Mapping[str, float]:
        """Share of the scenarios by split."""
        return self.splits if self.splits is not None else {"training": 0.8, "validation": 0.2}


@dataclass(frozen=True)
class NetworkTask:
    """One network: where its scenarios go, how many, what it is drawn from."""

    split: str
    index: int
    kind: str
    num_scenarios: int
    seed: tuple[int, ...]

    @property
    def shard_name(self) -> str:
        """File of its scenarios."""
        return f"{self.split}_{self.index:05d}.arrow"


def plan_networks(request: SyntheticRequest) -> list[NetworkTask]:
    """Networks of all splits; no two splits share one, because the seed of a network contains its split."""
    tasks = []
    for split_number, (split, share) in enumerate(request.shares.items()):
        total = round(request.num_scenarios * share)
        count = max(1, round(total / request.scenarios_per_network))
        kinds = [KINDS[k % len(KINDS)] for k in range(count)]
        weights = np.array([0.5 if kind == "freeway" else 1.0 for kind in kinds])
        bounds = np.rint(np.append(0.0, np.cumsum(weights)) / weights.sum() * total).astype(int)
        tasks += [
            NetworkTask(split, k, kinds[k], int(bounds[k + 1] - bounds[k]), (request.seed, split_number, k))
            for k in range(count)
        ]
    return tasks


def simulate_world(kind: str, seed: tuple[int, ...], folder: Path) -> World:
    """Draw a network, let SUMO fill it with traffic, and turn what comes out into bodies, lights and a map.

    Args:
        kind: "city", "quiet" or "freeway".
        seed: decides everything, for a given version of SUMO.
        folder: existing folder for SUMO's files.

    Raises:
        ConfigError: SUMO or shapely is not installed.
        RlftsimError: a program of SUMO failed.
    """
    rng = np.random.default_rng(seed)
    plan = draw_freeway_plan(rng) if kind == "freeway" else draw_city_plan(rng, quiet=kind == "quiet")
    layout = "opposites" if rng.random() < 0.75 else "incoming"
    network_file = sumo.compile_network(plan, folder, layout)
    network = read_network(network_file, plan)
    types = write_demand(plan, rng, folder / "demand.xml")
    sumo_seed = int(rng.integers(1, 2**31 - 1))
    routes = sumo.route_demand(network_file, folder / "demand.xml", sumo_seed)
    vehicles_file, persons_file = sumo.simulate(network_file, routes, _ask_for_signals(network, folder), sumo_seed)
    network_map = build_network_map(network)
    bodies = read_vehicles(vehicles_file, network, types, rng)
    bodies += read_pedestrians(persons_file, rng)
    bodies += park_in_strips(rng, network, _NUM_STEPS)
    bodies += park_in_lots(rng, network, network_map.drivable, _NUM_STEPS, LOTS_PER_STREET[kind])
    return World(
        name="/".join(map(str, seed)),
        bodies=tuple(bodies),
        cropper=MapCropper.of(network_map, draw_ground(rng)),
        signals={junction: _read_junction(folder, junction) for junction in network.lights},
        ends=np.stack([node.position for node in plan.fringe_nodes]),
        num_steps=_NUM_STEPS,
    )


def _ask_for_signals(network: Network, folder: Path) -> Path:
    """Additional file that makes SUMO write every junction's signal states."""
    rows = [
        f'<timedEvent type="SaveTLSStates" source="{junction}" dest="{folder / f"signals_{junction}.xml"}"/>'
        for junction in network.lights
    ]
    path = folder / "additional.xml"
    path.write_text("\n".join(["<additional>", *rows, "</additional>"]))
    return path


def _read_junction(folder: Path, junction: str) -> SignalStates:
    return read_signals(folder / f"signals_{junction}.xml", junction)


def generate_scenarios(task: NetworkTask) -> Iterator[Scenario]:
    """Scenarios of a task. Where one network does not yield enough, another one is drawn from the next seed.

    Raises:
        RlftsimError: not enough after `MAX_ATTEMPTS` networks.
    """
    missing = task.num_scenarios
    for attempt in range(MAX_ATTEMPTS):
        seed = (*task.seed, attempt)
        with tempfile.TemporaryDirectory(prefix="rlftsim_synthetic_") as name:
            world = simulate_world(task.kind, seed, Path(name))
        for scenario in islice(cut_scenarios(world, np.random.default_rng((*seed, 1))), missing):
            missing -= 1
            yield scenario
        if missing == 0:
            return
    raise RlftsimError(f"{MAX_ATTEMPTS} {task.kind} networks of seed {task.seed} gave {missing} scenarios too few")


def _write_shard(task: NetworkTask, folder: Path) -> int:
    writer = ShardWriter(folder / SHARDS / task.shard_name)
    try:
        for scenario in generate_scenarios(task):
            writer.add(scenario, task.split)
    except BaseException:
        writer.discard()
        raise
    writer.close()
    return task.num_scenarios


def generate(
    destination: str | Path,
    *,
    num_scenarios: int,
    seed: int,
    jobs: int = 1,
    splits: Mapping[str, float] | None = None,
    scenarios_per_network: int = 10,
    show_progress: bool = True,
) -> Manifest:
    """Make a data set of synthetic scenarios. The same arguments and versions give the same tracks.

    An interrupted run goes on where it stopped when called again with the same arguments.

    Args:
        destination: folder of the data set; new, empty, or left unfinished by the same call.
        num_scenarios: in all splits together.
        seed: decides all networks.
        jobs: networks made at the same time; does not change the result.
        splits: share of the scenarios by split; None = 80 % training, 20 % validation. No two splits share a network.
        scenarios_per_network: how many are cut from one city; a freeway gives half as many.
        show_progress: whether to draw a progress bar.

    Returns:
        The manifest written; its `provenance` holds the arguments, the versions and the licence.

    Raises:
        ConfigError: SUMO or shapely is not installed, or an argument is out of range.
        DataError: the folder holds something else, or scenarios of other arguments.
    """
    request = SyntheticRequest(num_scenarios, seed, scenarios_per_network, splits)
    folder = Path(destination)
    if not sumo.is_available():
        raise ConfigError(sumo.INSTALL_HINT)
    provenance = _provenance(request)
    if (folder / MANIFEST).exists() and not (folder / INCOMPLETE).exists():
        manifest = read_manifest(folder)
        if dict(manifest.provenance) != provenance:
            raise DataError(f"{folder} holds scenarios made with other arguments or versions: choose another folder")
        return manifest
    _claim(folder, provenance)
    tasks = plan_networks(request)
    _make_shards(tasks, folder, jobs, show_progress)
    entries = [describe_shard(folder, path, len(ShardReader(path))) for path in _shard_paths(tasks, folder)]
    manifest = write_index_and_manifest(folder, entries, licence_note=LICENCE_NOTE, provenance=provenance)
    (folder / INCOMPLETE).unlink()
    return manifest


def _shard_paths(tasks: list[NetworkTask], folder: Path) -> list[Path]:
    return [folder / SHARDS / task.shard_name for task in tasks]


def _provenance(request: SyntheticRequest) -> dict[str, object]:
    """Plain JSON values that tell how the data was made."""
    arguments = {**asdict(request), "splits": dict(request.shares)}
    return {
        "generator": "rlftsim.scenario.synthetic.generate",
        "generator_version": GENERATOR_VERSION,
        "sumo_version": sumo.sumo_version(),
        "arguments": arguments,
        "licence": "CC0-1.0",
        "networks": [
            {"shard": task.shard_name, "kind": task.kind, "seed": list(task.seed)} for task in plan_networks(request)
        ],
    }


def _claim(folder: Path, provenance: dict[str, object]) -> None:
    """Mark the folder as being filled with this request.

    Raises:
        DataError: the folder holds something else.
    """
    marker = folder / INCOMPLETE
    if marker.exists():
        if json.loads(marker.read_text(encoding="utf-8") or "{}") != provenance:
            raise DataError(f"{folder} was begun with another seed, other arguments or versions: choose another folder")
        return
    if folder.exists() and any(folder.iterdir()):
        raise DataError(f"{folder} is not empty: choose another folder or delete it")
    (folder / SHARDS).mkdir(parents=True)
    write_text(marker, json.dumps(provenance, indent=1))


def _make_shards(tasks: list[NetworkTask], folder: Path, jobs: int, show_progress: bool) -> None:
    """Write the shards that are not there yet."""
    done = [task for task in tasks if (folder / SHARDS / task.shard_name).exists()]
    todo = [task for task in tasks if task not in done]
    total, so_far = (sum(task.num_scenarios for task in some) for some in (tasks, done))
    with progress_bar("synthetic scenarios", total, so_far, show=show_progress) as advance:
        run_tasks(partial(_make_shard, folder=folder), todo, jobs=jobs, advance=advance)


def _make_shard(task: NetworkTask, advance: Advance, is_stopped: Callable[[], bool], *, folder: Path) -> None:
    if not is_stopped():
        advance(_write_shard(task, folder))

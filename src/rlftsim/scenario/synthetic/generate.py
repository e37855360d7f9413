"""Make a data set of synthetic scenarios: a shard for each street network, several networks at a time."""

import tempfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import asdict, dataclass, field
from functools import partial
from itertools import islice
from operator import attrgetter
from pathlib import Path

import numpy as np

from rlftsim.errors import ConfigError, DataError, RlftsimError
from rlftsim.jobs.files import remove_temporaries
from rlftsim.jobs.folder import Lease, check_folder, find_differences, write_identity
from rlftsim.jobs.items import WholeFiles, run_items
from rlftsim.jobs.processes import Advance
from rlftsim.jobs.runner import Runner, check_begun, choose_runner
from rlftsim.scenario.dataset import (
    INCOMPLETE,
    INDEX,
    MANIFEST,
    SHARDS,
    Manifest,
    describe_shard,
    read_manifest,
    write_index_and_manifest,
)
from rlftsim.scenario.shards import ShardReader, ShardWriter, check_scenario
from rlftsim.scenario.synthetic import sumo
from rlftsim.scenario.synthetic.windows import cut_windows, simulate_world
from rlftsim.scenario.synthetic.worlds import WORLDS, write_world
from rlftsim.scenario.types import STEP_S, TOTAL_STEPS, Scenario

GENERATOR_VERSION = 1
LICENSE_NOTE = "CC0-1.0: synthetic scenarios, no rights reserved."
NETWORK_TYPES = ("city", "quiet", "city", "freeway", "city", "city", "quiet", "city")
"""Types of the networks in turn; a freeway gives half as many scenarios as the others."""
FREEWAY_STEPS = 200
"""Longest window of a freeway: later all of its cars have left it."""
DEFAULT_SPLITS = {"training": 0.8, "validation": 0.2}
MAX_ATTEMPTS = 6
MAX_STEPS = 1200
"""Longest scenario: two fit one after the other into the traffic that SUMO simulates."""


@dataclass(frozen=True)
class SyntheticRequest:
    """Arguments of a generated data set, which determine every scenario together with the versions."""

    num_scenarios: int
    seed: int
    scenarios_per_network: int = 10
    splits: Mapping[str, float] = field(default_factory=lambda: dict(DEFAULT_SPLITS))
    """Fraction of the scenarios by split."""
    num_steps: int = TOTAL_STEPS
    """Length of each scenario in steps of 0.1 s."""

    def __post_init__(self) -> None:
        if not TOTAL_STEPS <= self.num_steps <= MAX_STEPS:
            raise ConfigError(
                f"synthetic scenarios last {TOTAL_STEPS * STEP_S:g} to {MAX_STEPS * STEP_S:g} s, got "
                f"{self.num_steps * STEP_S:g}"
            )
        if self.num_scenarios < 1 or self.scenarios_per_network < 1:
            raise ConfigError(
                f"num_scenarios = {self.num_scenarios} and scenarios_per_network = {self.scenarios_per_network} "
                "must both be at least 1"
            )
        if abs(sum(self.splits.values()) - 1.0) > 1e-6:
            raise ConfigError(f"the fractions of the splits must sum to 1, got {dict(self.splits)}")


@dataclass(frozen=True)
class NetworkTask:
    """A network: split and number of the scenarios, and the seed."""

    split: str
    index: int
    network_type: str
    num_scenarios: int
    seed: tuple[int, ...]
    num_steps: int = TOTAL_STEPS
    """Length of each scenario."""
    worlds: Path | None = None
    """Folder of the worlds that SUMO can run again; None = they are not kept."""

    @property
    def shard_name(self) -> str:
        """File of the scenarios."""
        return f"{self.split}_{self.index:05d}.arrow"


def plan_networks(request: SyntheticRequest, worlds: Path | None = None) -> list[NetworkTask]:
    """Networks of all splits; no two splits share a network, because the seed of a network contains the split.

    Args:
        request: Arguments of the data set.
        worlds: Folder of the worlds that SUMO can run again; None = they are not kept.
    """
    tasks = []
    for split_number, (split, fraction) in enumerate(request.splits.items()):
        total = round(request.num_scenarios * fraction)
        count = max(1, round(total / request.scenarios_per_network))
        types = [NETWORK_TYPES[k % len(NETWORK_TYPES)] for k in range(count)]
        if request.num_steps > FREEWAY_STEPS:
            types = [name.replace("freeway", "city") for name in types]
        weights = np.array([0.5 if network_type == "freeway" else 1.0 for network_type in types])
        # cumulated and rounded, so that the numbers add up to the total
        counts = np.diff(np.rint(np.append(0.0, np.cumsum(weights)) / weights.sum() * total).astype(int)).tolist()
        for k, (network_type, num_scenarios) in enumerate(zip(types, counts)):
            seed = (request.seed, split_number, k)
            tasks.append(NetworkTask(split, k, network_type, num_scenarios, seed, request.num_steps, worlds))
    return tasks


def generate_scenarios(task: NetworkTask) -> Iterator[Scenario]:
    """Scenarios of a task. If a network does not yield enough, a new network is drawn from the next seed.

    Raises:
        RlftsimError: Not enough after `MAX_ATTEMPTS` networks.
    """
    missing = task.num_scenarios
    for attempt in range(MAX_ATTEMPTS):
        seed = (*task.seed, attempt)
        # SUMO's files are large: they are removed with the network
        with tempfile.TemporaryDirectory(prefix="rlftsim_synthetic_") as name:
            world = simulate_world(task.network_type, seed, Path(name), keeps_source=task.worlds is not None)
        windows = []
        for window in islice(cut_windows(world, np.random.default_rng((*seed, 1)), task.num_steps), missing):
            missing -= 1
            windows.append(window)
            yield window.scenario
        if task.worlds is not None:
            write_world(task.worlds, world, windows)
        if missing == 0:
            return
    raise RlftsimError(
        f"{MAX_ATTEMPTS} {task.network_type} networks of seed {task.seed} gave {missing} scenarios too few"
    )


def generate(
    destination: str | Path,
    *,
    num_scenarios: int,
    seed: int,
    num_steps: int = TOTAL_STEPS,
    jobs: int = 1,
    runner: Runner | None = None,
    splits: Mapping[str, float] | None = None,
    scenarios_per_network: int = 10,
    keep_worlds: bool = False,
    show_progress: bool = True,
) -> Manifest:
    """Make a data set of synthetic scenarios. The same arguments and versions give the same tracks.

    An interrupted run goes on where it stopped when called again with the same arguments.

    Args:
        destination: Folder of the data set; new, empty, or left unfinished by the same call.
        num_scenarios: Number of scenarios in all splits together.
        seed: Seed of all networks and of the traffic on them.
        num_steps: Length of each scenario in steps of 0.1 s, from 91 on; the step 10 is "now" in all of them.
        jobs: Number of networks made at the same time; does not change the result.
        runner: Runner of the work in place of such processes, see `rlftsim.jobs.runner`.
        splits: Fraction of the scenarios by split, which share no network; None = 80 % training, 20 % validation.
        scenarios_per_network: Number of scenarios cut from a city; a freeway gives half as many.
        keep_worlds: True = worlds/NETWORK.world holds what SUMO needs to run each network again; boxes are then made
            from the past alone, and the future has no label noise.
        show_progress: False prints neither progress nor the time left.

    Returns:
        The manifest written, with the arguments, the versions and the license as `provenance`.

    Raises:
        ConfigError: SUMO or shapely is not installed, or an argument is out of range.
        DataError: The folder holds other contents, or scenarios of other arguments, or another driver is at work.
        Unfinished: `runner` is a share, which is done, while others are not.
    """
    splits = dict(DEFAULT_SPLITS if splits is None else splits)
    request = SyntheticRequest(num_scenarios, seed, scenarios_per_network, splits, num_steps)
    folder = Path(destination)
    check_folder(folder, "data set")
    tasks = plan_networks(request, folder / WORLDS if keep_worlds else None)
    runner = runner or choose_runner(jobs, len(tasks))
    check_begun(runner, folder)
    if not sumo.is_available():
        raise ConfigError(sumo.INSTALL_HINT)

    # 1. Take over a finished data set of the same arguments, or claim the folder.
    provenance = {
        "generator": __name__,
        "generator_version": GENERATOR_VERSION,
        "sumo_version": sumo.sumo_version(),
        "arguments": asdict(request),
        "license": "CC0-1.0",
        "networks": [{"shard": task.shard_name, "kind": task.network_type, "seed": list(task.seed)} for task in tasks],
        **({"keep_worlds": True} if keep_worlds else {}),
    }
    if (folder / MANIFEST).exists() and not (folder / INCOMPLETE).exists():
        manifest = read_manifest(folder)
        if dict(manifest.provenance) != provenance:
            raise DataError(f"{folder} holds scenarios made with other arguments or versions: choose another folder")
        return manifest
    marker = folder / INCOMPLETE
    if marker.exists():
        if find_differences(marker, provenance, "choose another folder, or delete this one"):
            raise DataError(f"{folder} was begun with another seed, other arguments or versions: choose another folder")
    else:
        # not what other shares of the same run make in this moment
        if folder.exists() and any(p.name != INCOMPLETE and p.suffix != ".tmp" for p in folder.iterdir()):
            raise DataError(f"{folder} is not empty: choose another folder or delete it")
        write_identity(marker, provenance)

    # 2. Make the shards that are not there yet.
    shards = folder / SHARDS
    with Lease(shards / ".lock", runner, "makes scenarios in") as lease:
        paths = run_items(
            "synthetic scenarios", tasks, partial(_write_shard, shards), lease=lease,
            format=WholeFiles(shards, attrgetter("shard_name"), ShardReader, attrgetter("num_scenarios")),
            show_progress=show_progress,
        )  # fmt: skip
        # of processes that were killed
        remove_temporaries([marker, folder / INDEX, folder / MANIFEST, *paths])

        # 3. Index and manifest.
        entries = [describe_shard(folder, path, len(ShardReader(path))) for path in paths]
        manifest = write_index_and_manifest(folder, entries, license_note=LICENSE_NOTE, provenance=provenance)
        lease.remove()
        marker.unlink()  # last: without it the same call would not come here again
    return manifest


def _write_shard(folder: Path, task: NetworkTask, advance: Advance, is_stopped: Callable[[], bool]) -> None:
    """Write the scenarios of a task, unless the run is being stopped."""
    if is_stopped():
        return
    with ShardWriter(folder / task.shard_name) as writer:
        for scenario in generate_scenarios(task):
            check_scenario(scenario)
            writer.add(scenario, task.split)
    advance(task.num_scenarios)

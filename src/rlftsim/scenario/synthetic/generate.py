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
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.files import remove_temporaries_below, write_text
from rlftsim.jobs.folder import Lease, check_folder
from rlftsim.jobs.processes import Advance
from rlftsim.jobs.progress import progress_bar
from rlftsim.jobs.runner import Runner, check_begun, check_finished, choose_runner
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
from rlftsim.scenario.synthetic.windows import cut_scenarios
from rlftsim.scenario.synthetic.world import simulate_world
from rlftsim.scenario.types import Scenario

GENERATOR_VERSION = 1
LICENSE_NOTE = "CC0-1.0: synthetic scenarios, no rights reserved."
KINDS = ("city", "quiet", "city", "freeway", "city", "city", "quiet", "city")
"""Kinds of the networks in turn; a freeway gives half as many scenarios as the others."""
MAX_ATTEMPTS = 6


@dataclass(frozen=True)
class SyntheticRequest:
    """Arguments of a generated data set. Together with the versions they determine every scenario."""

    num_scenarios: int
    seed: int
    scenarios_per_network: int = 10
    splits: Mapping[str, float] | None = None
    """Fraction of the scenarios by split; None = 80 % training, 20 % validation."""

    def __post_init__(self) -> None:
        if self.num_scenarios < 1 or self.scenarios_per_network < 1:
            raise ConfigError(
                f"num_scenarios = {self.num_scenarios} and scenarios_per_network = {self.scenarios_per_network} "
                "must both be at least 1"
            )
        if abs(sum(self.fractions.values()) - 1.0) > 1e-6:
            raise ConfigError(f"the fractions of the splits must sum to 1, got {dict(self.fractions)}")

    @property
    def fractions(self) -> Mapping[str, float]:
        """Fraction of the scenarios by split."""
        return self.splits if self.splits is not None else {"training": 0.8, "validation": 0.2}


@dataclass(frozen=True)
class NetworkTask:
    """One network: split and number of its scenarios, and its seed."""

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
    for split_number, (split, fraction) in enumerate(request.fractions.items()):
        total = round(request.num_scenarios * fraction)
        count = max(1, round(total / request.scenarios_per_network))
        kinds = [KINDS[k % len(KINDS)] for k in range(count)]
        weights = np.array([0.5 if kind == "freeway" else 1.0 for kind in kinds])
        # cumulated and rounded, so that the numbers add up to the total
        bounds = np.rint(np.append(0.0, np.cumsum(weights)) / weights.sum() * total).astype(int)
        tasks += [
            NetworkTask(split, k, kinds[k], int(bounds[k + 1] - bounds[k]), (request.seed, split_number, k))
            for k in range(count)
        ]
    return tasks


def generate_scenarios(task: NetworkTask) -> Iterator[Scenario]:
    """Scenarios of a task. If one network does not yield enough, another one is drawn from the next seed.

    Raises:
        RlftsimError: not enough after `MAX_ATTEMPTS` networks.
    """
    missing = task.num_scenarios
    for attempt in range(MAX_ATTEMPTS):
        seed = (*task.seed, attempt)
        # SUMO's files are large: they are removed with the network
        with tempfile.TemporaryDirectory(prefix="rlftsim_synthetic_") as name:
            world = simulate_world(task.kind, seed, Path(name))
        for scenario in islice(cut_scenarios(world, np.random.default_rng((*seed, 1))), missing):
            missing -= 1
            yield scenario
        if missing == 0:
            return
    raise RlftsimError(f"{MAX_ATTEMPTS} {task.kind} networks of seed {task.seed} gave {missing} scenarios too few")


def generate(
    destination: str | Path,
    *,
    num_scenarios: int,
    seed: int,
    jobs: int = 1,
    runner: Runner | None = None,
    splits: Mapping[str, float] | None = None,
    scenarios_per_network: int = 10,
    show_progress: bool = True,
) -> Manifest:
    """Make a data set of synthetic scenarios. The same arguments and versions give the same tracks.

    An interrupted run goes on where it stopped when called again with the same arguments.

    Args:
        destination: folder of the data set; new, empty, or left unfinished by the same call.
        num_scenarios: in all splits together.
        seed: source of all networks.
        jobs: networks made at the same time; does not change the result.
        runner: does the work in place of such processes, see `rlftsim.jobs.runner`.
        splits: fraction of the scenarios by split, which share no network; None = 80 % training, 20 % validation.
        scenarios_per_network: scenarios cut from one city; a freeway gives half as many.
        show_progress: False draws no progress bar.

    Returns:
        The manifest written; its `provenance` holds the arguments, the versions and the license.

    Raises:
        ConfigError: SUMO or shapely is not installed, or an argument is out of range.
        DataError: the folder holds something else, or scenarios of other arguments, or another driver is at work.
        Unfinished: `runner` is a share, which is done, while others are not.
    """
    request = SyntheticRequest(num_scenarios, seed, scenarios_per_network, splits)
    folder = Path(destination)
    check_folder(folder, "data set")
    tasks = plan_networks(request)
    runner = runner or choose_runner(jobs, len(tasks))
    check_begun(runner, folder)
    if not sumo.is_available():
        raise ConfigError(sumo.INSTALL_HINT)

    # 1. Take over a finished data set of the same arguments, or claim the folder.
    provenance = {
        "generator": __name__,
        "generator_version": GENERATOR_VERSION,
        "sumo_version": sumo.sumo_version(),
        "arguments": {**asdict(request), "splits": dict(request.fractions)},
        "license": "CC0-1.0",
        "networks": [{"shard": task.shard_name, "kind": task.kind, "seed": list(task.seed)} for task in tasks],
    }
    if (folder / MANIFEST).exists() and not (folder / INCOMPLETE).exists():
        manifest = read_manifest(folder)
        if dict(manifest.provenance) != provenance:
            raise DataError(f"{folder} holds scenarios made with other arguments or versions: choose another folder")
        return manifest
    marker = folder / INCOMPLETE
    if marker.exists():
        if read_json(marker, "choose another folder, or delete this one") != provenance:
            raise DataError(f"{folder} was begun with another seed, other arguments or versions: choose another folder")
    else:
        # not what other shares of the same run make in this moment
        if folder.exists() and any(p.name != INCOMPLETE and p.suffix != ".tmp" for p in folder.iterdir()):
            raise DataError(f"{folder} is not empty: choose another folder or delete it")
        write_text(marker, json.dumps(provenance, indent=1))

    # 2. Make the shards that are not there yet.
    paths = [folder / SHARDS / task.shard_name for task in tasks]
    with Lease(folder / SHARDS / ".lock", runner, "makes scenarios in") as lease:
        own = runner.select(tasks)
        todo = [task for task in own if not (folder / SHARDS / task.shard_name).exists()]
        total, left = (sum(task.num_scenarios for task in some) for some in (own, todo))
        with progress_bar("synthetic scenarios", total, total - left, show=show_progress) as advance:
            runner.run(
                partial(_write_shard, folder=folder), todo, advance=advance, describe=lambda task: task.shard_name
            )
        lease.finish("synthetic scenarios")
        num_missing = sum(not path.exists() for path in paths)
        check_finished(runner, num_missing, len(tasks), "synthetic scenarios")
        remove_temporaries_below(folder)  # of processes that were killed

        # 3. Index and manifest.
        entries = [describe_shard(folder, path, len(ShardReader(path))) for path in paths]
        manifest = write_index_and_manifest(folder, entries, license_note=LICENSE_NOTE, provenance=provenance)
        marker.unlink()
        lease.remove()
    return manifest


def _write_shard(task: NetworkTask, advance: Advance, is_stopped: Callable[[], bool], *, folder: Path) -> None:
    """Write the scenarios of a task, unless the run is being stopped."""
    if is_stopped():
        return
    writer = ShardWriter(folder / SHARDS / task.shard_name)
    try:
        for scenario in generate_scenarios(task):
            writer.add(scenario, task.split)
    except BaseException:
        writer.discard()
        raise
    writer.close()
    advance(task.num_scenarios)

"""Planners in the world that made a log, and in other traffic: a row for each window, planner and type of traffic.

Windows come in turn from all networks, and each is driven in everything before the next one begins, so a run that is
stopped has measured the same of every planner.
"""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from functools import cached_property, partial
from itertools import islice
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

import rlftsim
from rlftsim.envs.planners.registry import hash_code
from rlftsim.envs.true_world_episode import PLANNERS, Trip, read_row
from rlftsim.envs.true_world_traffic import Surroundings, list_conflicts, load_model
from rlftsim.errors import ConfigError, whole_number
from rlftsim.evaluation.resumable import ScenarioValues, measure_scenarios
from rlftsim.evaluation.scenario_source import hash_manifest
from rlftsim.jobs.files import write_atomically
from rlftsim.jobs.folder import check_folder
from rlftsim.jobs.runner import Runner
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.scenario.dataset import ScenarioDataset, dataset_folder
from rlftsim.scenario.maneuver import VEHICLE_CONFLICTS
from rlftsim.scenario.synthetic.worlds import find_window

ROWS = "rows.parquet"
TRUTH = Surroundings("truth", "sumo")
GHOST = Surroundings("ghost", "sumo", ahead_m=None)
"""What truth does with its own ego: nobody reacts to the planner."""
RULES = (
    Surroundings("replay", "replay"), Surroundings("constant velocity", "constant_velocity"),
    Surroundings("idm", "idm"),
)  # fmt: skip


def shift_truth(ahead_m: float) -> Surroundings:
    """Truth in which the others see the ego ahead of its place, as label noise moves it: no error is smaller.

    Args:
        ahead_m: Distance along the ego's heading, m.
    """
    return Surroundings(f"truth {ahead_m:g} m ahead", "sumo", ahead_m=ahead_m)


@dataclass(frozen=True)
class TrueWorldConfig:
    """Windows, planners and types of traffic."""

    data: str
    """Data set with worlds, all splits."""
    surroundings: tuple[Surroundings, ...]
    planners: tuple[str, ...] = tuple(PLANNERS)
    """Names of `PLANNERS`, or any that `load_planner` takes."""
    seed: int = 0
    limit: int | None = None
    """Only the first so many windows."""
    conflict_windows: int = 0
    """Conflict windows to drive: the windows after the limit that have a conflict follow, until there are so many."""
    num_rollouts: int = 1
    """Rollouts of each episode in traffic with a model; all other traffic is the same in each."""

    def __post_init__(self) -> None:
        if self.limit is not None:
            whole_number("limit", self.limit, 1)
        whole_number("conflict_windows", self.conflict_windows, 0)
        whole_number("num_rollouts", self.num_rollouts, 1)
        for label, names in (("planners", self.planners), ("models", [s.name for s in self.surroundings])):
            if len({*names}) < len(names):
                raise ConfigError(f"{label}: two of {', '.join(names)} have the same name: leave one out.")

    @cached_property
    def trips(self) -> list[Trip]:
        """All episodes, window by window, a window of each network in turn; chosen conflict windows come last.

        Raises:
            DataError: A scenario without a world.
        """
        folder = dataset_folder(self.data)
        stored = {name: find_window(folder, name) for name in ScenarioDataset(folder).scenario_ids}
        by_network: dict[str, list[str]] = {}
        for name, window in sorted(stored.items(), key=lambda item: (item[1].path, item[1].index)):
            by_network.setdefault(window.path.stem, []).append(name)
        turns = sorted((turn, network) for network, names in by_network.items() for turn in range(len(names)))
        ordered = [(by_network[network][turn], network) for turn, network in turns]
        num_random = len(ordered) if self.limit is None else self.limit
        windows = ordered[:num_random]
        if self.conflict_windows:
            missing = self.conflict_windows - sum(map(self._has_conflict, windows))
            windows = [*windows, *islice(filter(self._has_conflict, ordered[num_random:]), max(0, missing))]
        return [
            Trip(self.data, name, network, surroundings, planner, self.seed, number < num_random, rollout)
            for number, (name, network) in enumerate(windows)
            for surroundings in self.surroundings for planner in self.planners
            for rollout in range(self.num_rollouts if surroundings.has_model else 1)
        ]  # fmt: skip

    def _has_conflict(self, window: tuple[str, str]) -> bool:
        return not list_conflicts(self.data, window[0]).isdisjoint(VEHICLE_CONFLICTS)


def drive_true_world(config: TrueWorldConfig, out: Path, runner: Runner) -> pa.Table:
    """Rows of all episodes, written to OUT/rows.parquet; only what earlier calls left undone is driven.

    Args:
        config: Windows, planners and types of traffic.
        out: Folder of the rows, and of a file for each episode.
        runner: Runner of the episodes; changes nothing but `seconds`.

    Raises:
        ConfigError: An unknown planner or model, or SUMO cannot run here.
        DataError: A data set without worlds.
        SetAside, Unfinished: See `run_items`.
    """
    check_folder(out, "results")
    trips = config.trips
    codes = {name: hash_code(planner_name) for name, planner_name in {(t.planner, t.planner_name) for t in trips}}
    models = {s.name: fingerprint_policy(load_model(s.model)) for s in config.surroundings if s.has_model}
    manifest = hash_manifest(dataset_folder(config.data))
    identity = {
        trip.name: {
            "manifest": manifest, "seed": trip.seed, "surroundings": asdict(trip.surroundings),
            "planner_code": codes[trip.planner], "model": models.get(trip.surroundings.name, "none"),
            "rlftsim_version": rlftsim.__version__,
        }
        for trip in trips
    }  # fmt: skip
    names = [trip.name for trip in trips]
    if len(identity) < len(names):
        doubled = next(name for name in names if names.count(name) > 1)
        raise ConfigError(f"{doubled} names two episodes: planners or models differ in signs alone, leave one out.")
    format = ScenarioValues(out / "episodes", names, identity, read_row)
    rows = measure_scenarios("episodes", partial(_drive_trip, trips), format, runner=runner)
    # a window is random or chosen by this call's settings, and the files serve others, too
    table = pa.Table.from_pylist([{**row, "is_random": trip.is_random} for row, trip in zip(rows, trips, strict=True)])
    write_atomically(out / ROWS, lambda temporary: pq.write_table(table, temporary, compression="zstd"))
    return table


def _drive_trip(trips: Sequence[Trip], position: int) -> dict[str, object]:
    return trips[position].drive()

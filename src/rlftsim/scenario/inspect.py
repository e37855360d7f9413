"""Checks of a data set, of its files and contents, and statistics of the contents."""

import os
from collections import Counter
from collections.abc import Iterator, Mapping
from dataclasses import dataclass
from enum import StrEnum
from pathlib import Path

import numpy as np

from rlftsim.errors import DataError
from rlftsim.scenario.consistency import (
    BACKING_S,
    DRIVING_MPS,
    MAX_CLIMB_M,
    MAX_JUMP_M,
    describe_contradictions,
    find_backing,
)
from rlftsim.scenario.dataset import (
    INDEX,
    Manifest,
    ScenarioDataset,
    build_index,
    dataset_folder,
    load_index,
    read_manifest,
)
from rlftsim.scenario.shards import AGENT_COLUMNS, ShardReader, hash_file
from rlftsim.scenario.types import CURRENT_STEP, LANE_TYPES, ROAD_EDGE_TYPES, Scenario

FAR_MAP_M = 200.0
"""A map whose nearest point is farther from the ego is taken to be in another frame."""


class Problem(StrEnum):
    """Types of findings."""

    MISSING_SHARD = "missing shard"
    DAMAGED_SHARD = "damaged shard"
    INDEX_MISMATCH = "index mismatch"
    CONTRADICTORY_LIGHTS = "contradictory lights"
    CONTRADICTORY_MOTION = "contradictory motion"
    TELEPORT = "teleport"
    BACKWARDS = "backward driving"
    MISSING_MAP = "missing map"
    MAP_ELSEWHERE = "map elsewhere"
    FAR_FROM_ORIGIN = "far from the origin"
    NOT_FINITE = "not finite"
    BROKEN = "broken scenario"
    NO_EVALUATED_AGENTS = "no evaluated agents"
    MISSING_EGO = "missing ego"

    @property
    def is_damage(self) -> bool:
        """True: files are not as written. False: files are sound, but the logged content is doubtful."""
        return self in (Problem.MISSING_SHARD, Problem.DAMAGED_SHARD, Problem.INDEX_MISMATCH)


@dataclass(frozen=True)
class Finding:
    """A problem of a data set."""

    problem: Problem
    location: str
    """File inside the data set, or scenario id."""
    detail: str

    def __str__(self) -> str:
        return f"{self.problem}: {self.location}: {self.detail}"


@dataclass(frozen=True)
class DatasetStats:
    """Counts and means over a data set."""

    num_scenarios: int
    by_split: Mapping[str, int]
    by_num_steps: Mapping[int, int]
    by_ego_maneuver: Mapping[str, int]
    agents_by_type: Mapping[str, int]
    """Tracks that are valid at the current step, over all scenarios."""
    mean_agents: float
    mean_evaluated: float
    mean_map_points: float
    percent_with_lights: float
    kilobytes_per_scenario: float
    """Size of all shards over the scenarios in them, in units of 1000 bytes."""
    by_source: Mapping[str, int]
    by_guessed: Mapping[str, int]
    """Scenarios in which a value is guessed, by the word for it."""


def verify_dataset(folder: str | os.PathLike[str]) -> list[Finding]:
    """Findings in every shard and every scenario of a data set.

    Damage: shards missing or not as the manifest has them, index and manifest that do not belong together, a scenario
    that is in the index twice. Doubtful content: steps that are not 0.1 s apart, ids that occur twice, impossible ids,
    types, sizes or track indices, NaN or infinite states or map points, positions too far from the origin for float32,
    a lane with two states at a step, velocities or headings that contradict the positions of most moving tracks,
    consecutive valid positions that imply more than 60 m/s, no lanes or no road edges, a map 200 m from the ego or
    more, no agent to evaluate beside the ego, an ego that is not valid at the current step.

    Args:
        folder: Folder of the data set, or "synthetic".

    Returns:
        The findings, damage first; empty for a sound data set.

    Raises:
        DataError: No finished data set in the folder.
    """
    folder = dataset_folder(folder)
    manifest = read_manifest(folder)
    damage, content, checked_ids = [], [], set()
    for entry in manifest.shards:
        path = folder / entry.file
        if not path.exists():
            damage.append(Finding(Problem.MISSING_SHARD, entry.file, "the file is gone: convert again"))
        elif hash_file(path) != entry.sha256:
            damage.append(Finding(Problem.DAMAGED_SHARD, entry.file, "its checksum does not match: convert again"))
        else:
            content.extend(_check_shard(path, entry.file, checked_ids))
    if not damage:  # the index is rebuilt from the shards, which takes whole ones
        damage.extend(_check_index(folder, manifest))
    return damage + [f for f in content if f.problem.is_damage] + [f for f in content if not f.problem.is_damage]


def dataset_stats(folder: str | os.PathLike[str], *, split: str | None = None) -> DatasetStats:
    """Summary of a data set or of a split.

    Args:
        folder: Folder of the data set, or "synthetic".
        split: Split to summarize, such as "training"; None = all splits.

    Raises:
        DataError: No data set in the folder, an unfinished or damaged data set, or no such split.
    """
    dataset = ScenarioDataset(folder, split, cache_size=0)
    index = dataset.index
    num_scenarios = max(len(dataset), 1)
    agents = {name.removeprefix("num_"): int(sum(index[name].to_pylist())) for name in AGENT_COLUMNS}
    # a shard holds scenarios of all splits, so the size is that of the whole data set
    total_bytes = sum((dataset.folder / entry.file).stat().st_size for entry in dataset.manifest.shards)
    total_rows = max(sum(entry.num_rows for entry in dataset.manifest.shards), 1)
    return DatasetStats(
        num_scenarios=len(dataset),
        **{f"by_{name}": _count(index[name].to_pylist()) for name in ("split", "num_steps", "ego_maneuver", "source")},
        agents_by_type=agents,
        mean_agents=sum(agents.values()) / num_scenarios,
        mean_evaluated=sum(index["num_evaluated"].to_pylist()) / num_scenarios,
        mean_map_points=sum(index["num_map_points"].to_pylist()) / num_scenarios,
        percent_with_lights=100.0 * sum(n > 0 for n in index["num_light_states"].to_pylist()) / num_scenarios,
        kilobytes_per_scenario=total_bytes / total_rows / 1000.0,
        by_guessed=_count([word for words in index["guessed"].to_pylist() for word in words.split()]),
    )


def find_problems(scenario: Scenario) -> Iterator[Finding]:
    """Doubtful content of a scenario, at most 1 finding of each type."""
    scenario_id, tracks, lights = scenario.scenario_id, scenario.tracks, scenario.lights
    checks = {
        Problem.BROKEN: scenario.check_consistency,
        Problem.NOT_FINITE: scenario.check_finite_arrays,
        Problem.FAR_FROM_ORIGIN: scenario.check_precision,
    }
    for problem, check in checks.items():
        try:
            check()
        except DataError as error:
            yield Finding(problem, scenario_id, str(error))
            if problem == Problem.BROKEN:  # later checks rely on a consistent scenario
                return

    # Different states of one lane at one step. Repeated equal observations are no contradiction.
    observed = np.unique(np.stack([lights.step, lights.lane_id, lights.state], axis=1), axis=0)
    lane_steps, count = np.unique(observed[:, :2], axis=0, return_counts=True)
    entries = np.flatnonzero(count > 1)
    if len(entries):
        step, lane = lane_steps[entries[0]]
        detail = f"lane {lane} has {count[entries[0]]} different states at step {step}{_format_repeats(len(entries))}"
        yield Finding(Problem.CONTRADICTORY_LIGHTS, scenario_id, detail)

    contradictions = describe_contradictions(tracks, scenario.map_features, scenario.guessed)
    if contradictions:
        yield Finding(Problem.CONTRADICTORY_MOTION, scenario_id, contradictions)

    # Jumps between two valid states that no road user makes.
    with np.errstate(invalid="ignore"):  # states that are not valid may hold infinities
        moved = np.diff(tracks.position.astype(np.float64), axis=1)  # [O, S-1, 3]
    both_valid = tracks.valid[:, 1:] & tracks.valid[:, :-1]
    shift = np.where(both_valid, np.hypot(moved[..., 0], moved[..., 1]), 0.0)  # [O, S-1]
    climb = np.where(both_valid & ("z" not in scenario.guessed), np.abs(moved[..., 2]), 0.0)
    entries = np.argwhere((shift > MAX_JUMP_M) | (climb > MAX_CLIMB_M))
    if len(entries):
        track, step = entries[0]
        is_far = shift[track, step] > MAX_JUMP_M
        motion = f"moves {shift[track, step]:.1f}" if is_far else f"climbs or falls by {climb[track, step]:.1f}"
        detail = f"track {tracks.object_id[track]} {motion} m from step {step} to "
        yield Finding(Problem.TELEPORT, scenario_id, f"{detail}{step + 1}{_format_repeats(len(entries))}")
    backing = find_backing(tracks)
    if backing:
        track, step = backing[0]
        motion = f"moves against its heading faster than {DRIVING_MPS:g} m/s for more than {BACKING_S:g} s"
        detail = f"track {tracks.object_id[track]} {motion} from step {step}{_format_repeats(len(backing))}"
        yield Finding(Problem.BACKWARDS, scenario_id, detail)

    features = scenario.map_features
    required = (("lanes", LANE_TYPES), ("road edges", ROAD_EDGE_TYPES))
    missing = [name for name, types in required if not len(features.find_indices(types))]
    if missing:
        detail = f"no {' and no '.join(missing)}" if len(features.points) else "no map features"
        yield Finding(Problem.MISSING_MAP, scenario_id, detail)
    if len(features.points) and tracks.valid[scenario.ego_index, CURRENT_STEP]:
        # NaN of either is no separate finding
        nearest = np.linalg.norm(features.points[:, :2] - scenario.origin, axis=-1).min()
        if nearest > FAR_MAP_M:
            detail = f"its nearest point is {nearest:.0f} m from the ego: give map and tracks the same origin"
            yield Finding(Problem.MAP_ELSEWHERE, scenario_id, detail)
    if not (scenario.evaluated_indices != scenario.ego_index).any():
        has_ego = len(scenario.evaluated_indices) > 0
        consequence = "only the ego is evaluated" if has_ego else "nor is the ego: nothing is evaluated"
        detail = f"no track to predict is valid at the current step, {consequence}"
        yield Finding(Problem.NO_EVALUATED_AGENTS, scenario_id, detail)
    elif not tracks.valid[scenario.ego_index, CURRENT_STEP]:
        ego = f"the ego (track {tracks.object_id[scenario.ego_index]})"
        detail = f"{ego} is not valid at the current step ({CURRENT_STEP}): no planner can drive it"
        yield Finding(Problem.MISSING_EGO, scenario_id, detail)


def _check_shard(path: Path, name: str, checked_ids: set[str]) -> Iterator[Finding]:
    """Findings in a shard. Scenarios with an id of an earlier shard are in no index and not checked again."""
    try:
        reader = ShardReader(path)
    except DataError as error:
        yield Finding(Problem.DAMAGED_SHARD, name, str(error))
        return
    for row in range(len(reader)):
        try:
            scenario = reader.read(row)
        except DataError as error:
            yield Finding(Problem.DAMAGED_SHARD, name, str(error))
        else:
            if scenario.scenario_id not in checked_ids:
                yield from find_problems(scenario)
            checked_ids.add(scenario.scenario_id)


def _check_index(folder: Path, manifest: Manifest) -> Iterator[Finding]:
    """Findings in the index, which must be the manifest's, with the rows of the shards."""
    path = folder / INDEX
    if not path.exists() or hash_file(path) != manifest.index_sha256:
        yield Finding(Problem.INDEX_MISMATCH, INDEX, "it is not the one the manifest was written for: convert again")
        return
    index = load_index(folder)
    shards: dict[str, list[str]] = {}
    for scenario_id, shard in zip(index["scenario_id"].to_pylist(), index["shard"].to_pylist()):
        shards.setdefault(scenario_id, []).append(shard)
    repeated = [scenario_id for scenario_id, shard_names in shards.items() if len(shard_names) > 1]
    if repeated:
        shard_names = " and ".join(shards[repeated[0]])
        detail = f"scenario {repeated[0]} is in it from {shard_names}{_format_repeats(len(repeated))}"
        yield Finding(Problem.INDEX_MISMATCH, INDEX, f"{detail}: convert one of the sources again, the first is kept")
        return
    expected, duplicates = build_index(folder, manifest.shards)
    if not index.equals(expected):
        yield Finding(Problem.INDEX_MISMATCH, INDEX, "its rows are not those of the shards: convert again")
    # of duplicates the number alone: versions describe them differently
    if expected.num_rows != manifest.num_scenarios or len(duplicates) != len(manifest.duplicates):
        yield Finding(Problem.INDEX_MISMATCH, INDEX, "the manifest's counts are not those of the shards: convert again")


def _format_repeats(count: int) -> str:
    return f" (and {count - 1} more)" if count > 1 else ""


def _count(values: list) -> dict:
    return dict(sorted(Counter(values).items()))

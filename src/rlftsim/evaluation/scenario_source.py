"""Logged scenarios to measure on: of a split, or by id, of a converted data set or of tfrecord files."""

import hashlib
import io
from dataclasses import dataclass, replace
from os import PathLike
from pathlib import Path

from rlftsim.errors import DataError
from rlftsim.evaluation.results import EvaluateConfig
from rlftsim.evaluation.wire_format import BYTES, iterate_fields
from rlftsim.realism.map_based import select_polylines
from rlftsim.scenario.dataset import MANIFEST, ScenarioDataset, dataset_folder
from rlftsim.scenario.shards import hash_file
from rlftsim.scenario.tfrecord import RECORD_OVERHEAD_BYTES, read_records
from rlftsim.scenario.types import ROAD_EDGE_TYPES, TOTAL_STEPS, Scenario
from rlftsim.scenario.womd import find_tfrecords, scenario_from_bytes

_SCENARIO_ID_FIELD = 5
_HEADER_BYTES = 12
_CACHED_SCENARIOS = 2  # each is read once


def has_road_edge(scenario: Scenario) -> bool:
    """True if the map has a road edge of two points or more; else the official metric is undefined."""
    return len(select_polylines(scenario.map_features, ROAD_EDGE_TYPES).count) > 0


def open_held_out(
    data: str | PathLike[str] | ScenarioDataset, config: EvaluateConfig
) -> tuple[ScenarioDataset, EvaluateConfig]:
    """The scenarios to measure on, and the settings with the split.

    Args:
        data: Data set's folder, or "synthetic", or an opened data set, whose split replaces the settings' split.
        config: Settings of the measurement, with the split.

    Raises:
        DataError: No such data set.
    """
    if not isinstance(data, ScenarioDataset):
        return ScenarioDataset(dataset_folder(data), config.split, cache_size=_CACHED_SCENARIOS), config
    config = replace(config, split=data.split)
    return ScenarioDataset(data.folder, data.split, cache_size=_CACHED_SCENARIOS, limit=data.limit), config


def choose_scenarios(dataset: ScenarioDataset, config: EvaluateConfig) -> list[str]:
    """Ids of the scenarios to evaluate: all, or the first up to the limit.

    Args:
        dataset: Scenarios of the split.
        config: Settings with the limit.

    Raises:
        DataError: No scenario, or a scenario without a future.
    """
    positions = range(min(len(dataset), config.limit or len(dataset)))
    split = f" (split {dataset.split})" if dataset.split else ""
    if not positions:
        raise DataError(f"{dataset.folder}{split} has no scenarios: nothing to evaluate.")
    steps = dataset.index["num_steps"].to_pylist()
    short = [i for i in positions if steps[i] < TOTAL_STEPS]
    if short:
        # scenarios in memory lie in a temporary folder, without a split
        title = f"{dataset.folder}{split}: " if split else ""
        raise DataError(
            f"{title}{len(short)} of {len(positions)} scenarios withhold their future, the first is "
            f"{dataset.scenario_ids[short[0]]} with {steps[short[0]]} steps: a test split can be simulated but not "
            "evaluated, use training or validation data."
        )
    return dataset.scenario_ids[: len(positions)]


def hash_manifest(folder: Path) -> str:
    """SHA-256 of a data set's manifest, which lists the checksums of all files: equal for moved data sets."""
    return hash_file(folder / MANIFEST)


@dataclass(frozen=True, eq=False)
class LoggedScenarios:
    """The scenarios of tfrecord files, parsed one by one when read."""

    spans: dict[str, tuple[Path, int, int]]
    """File, first byte and number of bytes of each record, by scenario id."""
    fingerprint: str
    sources: tuple[str, ...] = ("womd",)
    guessed: tuple[str, ...] = ()

    def __contains__(self, scenario_id: object) -> bool:
        return scenario_id in self.spans

    def __len__(self) -> int:
        return len(self.spans)

    def by_id(self, scenario_id: str) -> Scenario:
        """The scenario of an id.

        Raises:
            DataError: An unknown id, or damaged bytes.
        """
        if scenario_id not in self.spans:
            raise DataError(f"no scenario {scenario_id!r} among {len(self)} logged ones")
        path, offset, length = self.spans[scenario_id]
        with path.open("rb") as file:
            file.seek(offset)
            data = file.read(length)
        try:
            return scenario_from_bytes(data)
        except DataError as error:
            raise DataError(f"{path}: scenario {scenario_id}: {error}") from error

    def find_cluster(self, scenario_id: str) -> str | None:
        """None: records do not name the recording."""
        return None


ScenarioSource = ScenarioDataset | LoggedScenarios
"""Scenarios by id; can be handed to worker processes."""


def open_scenarios(source: str | PathLike[str]) -> ScenarioSource:
    """The scenarios of a converted data set's folder, of all splits, or of tfrecords: a file, a folder or a glob.

    Raises:
        DataError: A missing source, or a damaged record.
    """
    if (Path(source) / MANIFEST).is_file():
        return ScenarioDataset(source, cache_size=_CACHED_SCENARIOS)
    return index_tfrecords(Path(source))


def hash_source(source: ScenarioSource) -> str:
    """SHA-256 of a data set's manifest, or of the records of tfrecord files."""
    return hash_manifest(source.folder) if isinstance(source, ScenarioDataset) else source.fingerprint


def index_tfrecords(source: Path) -> LoggedScenarios:
    """Index of the scenarios of tfrecord files, with every record's checksums checked and no record parsed.

    Raises:
        DataError: No such files, or a damaged record (a conversion that skips errors makes a data set of the others).
    """
    spans: dict[str, tuple[Path, int, int]] = {}
    digest = hashlib.sha256()
    for path in find_tfrecords(source):
        # A record is length (8 bytes), checksum (4), data, checksum (4): its data begin after a header of 12 bytes.
        offset = 0
        for record, data in read_records(path):
            scenario_id = _find_scenario_id(data)
            if scenario_id is None:
                raise DataError(f"{path}: record {record}: not a WOMD Scenario message, it has no scenario_id")
            # of a scenario that occurs twice the first is taken, as by the converter
            spans.setdefault(scenario_id, (path, offset + _HEADER_BYTES, len(data)))
            offset += len(data) + RECORD_OVERHEAD_BYTES
            digest.update(data)
    return LoggedScenarios(spans, digest.hexdigest())


def _find_scenario_id(record: bytes) -> str | None:
    # Field by field: parsing the whole message would decode its map and all tracks.
    try:
        for field in iterate_fields(io.BytesIO(record), 0, len(record)):
            if (field.number, field.wire_type) == (_SCENARIO_ID_FIELD, BYTES):
                return record[field.start : field.stop].decode("utf-8", "replace")
    except DataError:
        return None
    return None

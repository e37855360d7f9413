"""Recorded scenarios by id, whether they were converted or still lie in tfrecord files."""

import hashlib
import io
from dataclasses import dataclass
from pathlib import Path
from typing import Protocol, runtime_checkable

from rlftsim.errors import DataError
from rlftsim.experiments.wire_format import BYTES, iterate_fields
from rlftsim.scenario.dataset import MANIFEST, ScenarioDataset
from rlftsim.scenario.tfrecord import RECORD_OVERHEAD_BYTES, read_records
from rlftsim.scenario.types import Scenario
from rlftsim.scenario.womd import find_tfrecords, scenario_from_bytes

_SCENARIO_ID_FIELD = 5
_HEADER_BYTES = 12
_CACHED_SCENARIOS = 2


@runtime_checkable
class ScenarioSource(Protocol):
    """Scenarios by id; can be handed to other processes."""

    @property
    def fingerprint(self) -> str:
        """Hash of what is in it."""
        ...

    def __contains__(self, scenario_id: object) -> bool: ...

    def __len__(self) -> int: ...

    def by_id(self, scenario_id: str) -> Scenario:
        """One scenario.

        Raises:
            DataError: it is not there, or its record is bad.
        """
        ...


def open_scenarios(source: Path) -> ScenarioSource:
    """Scenarios of a converted data set's folder, or of tfrecords: a file, a folder or a glob.

    Raises:
        DataError: neither is there, or a record is damaged.
    """
    if (Path(source) / MANIFEST).is_file():
        return ConvertedScenarios(Path(source))
    return index_tfrecords(source)


class ConvertedScenarios:
    """Those of a data set's folder, of all splits."""

    def __init__(self, folder: Path) -> None:
        self._dataset = ScenarioDataset(folder, cache_size=_CACHED_SCENARIOS)
        self.fingerprint = hashlib.sha256((folder / MANIFEST).read_bytes()).hexdigest()

    def __contains__(self, scenario_id: object) -> bool:
        return scenario_id in self._dataset

    def __len__(self) -> int:
        return len(self._dataset)

    def by_id(self, scenario_id: str) -> Scenario:
        """One scenario, see `ScenarioSource`."""
        return self._dataset.by_id(scenario_id)


@dataclass(frozen=True)
class RecordPlace:
    """Where a record's bytes are."""

    file: Path
    offset: int
    length: int


@dataclass(frozen=True, eq=False)
class RecordedScenarios:
    """Those of tfrecord files; a scenario is parsed when it is asked for."""

    places: dict[str, RecordPlace]
    fingerprint: str

    def __contains__(self, scenario_id: object) -> bool:
        return scenario_id in self.places

    def __len__(self) -> int:
        return len(self.places)

    def by_id(self, scenario_id: str) -> Scenario:
        """One scenario, see `ScenarioSource`."""
        if scenario_id not in self.places:
            raise DataError(f"no scenario {scenario_id!r} among {len(self)} recorded ones")
        place = self.places[scenario_id]
        with place.file.open("rb") as file:
            file.seek(place.offset)
            data = file.read(place.length)
        try:
            return scenario_from_bytes(data)
        except DataError as error:
            raise DataError(f"{place.file}: scenario {scenario_id}: {error}") from error


def index_tfrecords(source: Path) -> RecordedScenarios:
    """Find the scenarios of tfrecord files, checking every record's checksums but parsing none.

    Raises:
        DataError: no such files, or a damaged record (converting with errors skipped makes a data set of the others).
    """
    places: dict[str, RecordPlace] = {}
    digest = hashlib.sha256()
    for path in find_tfrecords(source):
        offset = 0
        for record, data in read_records(path):
            scenario_id = _scenario_id_of(data)
            if scenario_id is None:
                raise DataError(f"{path}: record {record}: not a WOMD Scenario message, it has no scenario_id")
            places.setdefault(scenario_id, RecordPlace(path, offset + _HEADER_BYTES, len(data)))
            offset += len(data) + RECORD_OVERHEAD_BYTES
            digest.update(data)
    return RecordedScenarios(places, digest.hexdigest())


def _scenario_id_of(record: bytes) -> str | None:
    try:
        for field in iterate_fields(io.BytesIO(record), 0, len(record)):
            if (field.number, field.wire_type) == (_SCENARIO_ID_FIELD, BYTES):
                return record[field.start : field.stop].decode("utf-8", "replace")
    except DataError:
        return None
    return None

"""Data sources by name: one that ships with the package, one of another package, one of a notebook."""

import json
import sys
from pathlib import Path

import numpy as np
import pytest

import third_party
from rlftsim.errors import ConfigError, DataError
from rlftsim.scenario.convert import convert
from rlftsim.scenario.dataset import ScenarioDataset, read_manifest, write_dataset
from rlftsim.scenario.source import DataSource, Unit, infer_split, read_unit, units_of_files
from rlftsim.scenario.sources import SOURCES, find_source
from rlftsim.scenario.tfrecord import SkippedRecord, write_records
from rlftsim.scenario.womd import WomdSource, scenario_from_bytes

DRIVES = '''
"""A recorder of straight drives: one text file each, a line "id x_m speed_mps" per scenario."""

from pathlib import Path

import numpy as np

from rlftsim.scenario.source import units_of_files
from rlftsim.scenario.tfrecord import SkippedRecord
from rlftsim.scenario.types import LightStates, MapFeatures, Scenario, Tracks


class Drives:
    license_note = "CC0-1.0: drives."

    def detects(self, path):
        return any(Path(path).glob("*.drive"))

    def find(self, path):
        return units_of_files(sorted(Path(path).glob("*.drive")))

    def read(self, unit):
        for line in unit.files[0].read_text().splitlines():
            try:
                name, x, speed = line.split()
                yield scenario(name, float(x), float(speed))
            except ValueError:
                yield SkippedRecord(unit.name, 0, f"{line!r} is no drive")

    def describe(self):
        return {"source": "drives", "guessed": ["size"]}


def scenario(name, x, speed):
    position = np.zeros((1, 91, 3), np.float32)
    position[0, :, 0] = x + speed * 0.1 * np.arange(91)
    velocity = np.tile(np.float32([speed, 0]), (1, 91, 1))
    size = np.tile(np.float32([4.6, 2.1, 1.6]), (1, 91, 1))
    return Scenario(
        scenario_id=name,
        timestamps_s=0.1 * np.arange(91),
        tracks=Tracks(
            np.array([7]), np.array([1], np.int8), position, np.zeros((1, 91), np.float32), velocity, size,
            np.ones((1, 91), bool),
        ),
        map_features=MapFeatures(
            np.zeros(0, np.int64), np.zeros(0, np.int8), np.zeros((0, 3), np.float32), np.zeros(1, np.int64)
        ),
        lights=LightStates(
            np.zeros(0, np.int32), np.zeros(0, np.int64), np.zeros(0, np.int8), np.zeros((0, 3), np.float32)
        ),
        ego_index=0,
        tracks_to_predict=np.zeros(0, np.int32),
        difficulty=np.zeros(0, np.int8),
        objects_of_interest=np.zeros(0, np.int64),
    )
'''


@pytest.fixture(autouse=True)
def fresh_table(monkeypatch):
    """Sources that a test adds are forgotten after it."""
    monkeypatch.setattr(SOURCES, "_registered", dict(SOURCES._registered))


@pytest.fixture
def drives(tmp_path):
    """An installed package with a data source in one file."""
    entry_points = {"rlftsim.sources": {"drives": "drives_package:Drives"}}
    with third_party.installed(tmp_path / "site", "drives_package", DRIVES, entry_points):
        yield


@pytest.fixture
def recordings(tmp_path):
    folder = tmp_path / "recordings"
    folder.mkdir()
    (folder / "a.drive").write_text("first 10 5\nnonsense\nsecond 20 6\n")
    (folder / "b_validation.drive").write_text("third 30 7\n")
    return folder


def run(source, destination, **settings):
    return convert(source, destination, **{"jobs": 1, "show_progress": False, **settings})


@pytest.mark.parametrize("reader", ["drives", "auto"])
@pytest.mark.usefixtures("drives")
def test_a_source_of_another_package_converts_by_name(tmp_path, recordings, reader):
    report = run(recordings, tmp_path / "data", reader=reader)
    assert report.counts == {"unknown": 2, "validation": 1}
    assert [str(skipped) for skipped in report.skipped] == ["a.drive: record 0: 'nonsense' is no drive"]
    data = ScenarioDataset(tmp_path / "data")
    assert data.scenario_ids == ["first", "second", "third"]
    assert data["second"].tracks.position[0, 10, 0] == np.float32(26)
    assert data.manifest.license_note == "CC0-1.0: drives."
    assert data.manifest.provenance == {"source": "drives", "guessed": ["size"]}
    again = run(recordings, tmp_path / "data", reader=reader)
    assert (again.shards_written, again.shards_reused) == (0, 2)


@pytest.mark.usefixtures("drives")
def test_other_processes_have_the_source_too(tmp_path, recordings):
    run(recordings, tmp_path / "one", reader="drives")
    run(recordings, tmp_path / "two", reader="drives", jobs=2)
    shards = [path.relative_to(tmp_path / "one") for path in (tmp_path / "one").rglob("*") if path.is_file()]
    assert len(shards) == 4
    for path in shards:
        assert (tmp_path / "one" / path).read_bytes() == (tmp_path / "two" / path).read_bytes()


@pytest.mark.usefixtures("drives")
def test_stop_ends_at_the_first_bad_record_of_any_source(tmp_path, recordings):
    with pytest.raises(DataError, match=r"a\.drive: record 0: 'nonsense' is no drive"):
        run(recordings, tmp_path / "data", reader="drives", on_error="stop")


def test_an_unsound_scenario_of_any_source_is_a_bad_record(make_message):
    good, bad = (scenario_from_bytes(make_message(name).SerializeToString()) for name in ("good", "bad"))
    bad.tracks.object_id[:] = 7
    lost = scenario_from_bytes(make_message("lost").SerializeToString())
    lost.tracks.heading[0, 3] = np.nan

    class Yields:
        license_note = "CC0-1.0"

        def find(self, path):
            return [Unit("x", ())]

        def read(self, unit):
            yield from (bad, good, lost)

        def describe(self):
            return {}

    first, read, last = read_unit(Yields(), Unit("x", ()), on_error="skip")
    assert read == (1, good)
    skipped = [item for _, item in (first, last)]
    assert [(number, item.record) for number, item in (first, last)] == [(0, 0), (2, 2)]
    assert "scenario bad: object id 7 belongs to 3 tracks" in str(skipped[0])
    assert "scenario lost: track 100 has a NaN or infinite heading at step 3" in str(skipped[1])


@pytest.mark.usefixtures("drives")
def test_a_data_set_of_two_sources_carries_both_licenses(tmp_path, recordings, make_message, make_tfrecord):
    make_tfrecord(tmp_path / "womd" / "x.tfrecord", make_message("waymo"))
    run(recordings, tmp_path / "data")
    run(tmp_path / "womd", tmp_path / "data")
    run(tmp_path / "womd", tmp_path / "data")
    manifest = read_manifest(tmp_path / "data")
    assert manifest.license_note == f"CC0-1.0: drives. {WomdSource.license_note}"
    assert manifest.provenance == {"source": "drives", "guessed": ["size"]}


def test_a_source_of_a_notebook_is_registered_under_a_name(tmp_path, make_message):
    @SOURCES.register("two_files")
    class TwoFiles:
        """A unit is a pair of files, of which the second is damaged."""

        license_note = "CC0-1.0"

        def find(self, path):
            first, second = sorted(Path(path).iterdir())
            return [Unit("pair", (first, second), "training")]

        def read(self, unit):
            yield from WomdSource().read(Unit("", unit.files[:1]))
            raise DataError("its second file is damaged")

        def describe(self):
            return {}

    (tmp_path / "pairs").mkdir()
    write_records(tmp_path / "pairs" / "a", [make_message("a").SerializeToString()])
    (tmp_path / "pairs" / "b").write_text("nothing")
    assert isinstance(TwoFiles(), DataSource)
    report = run(tmp_path / "pairs", tmp_path / "data", reader="two_files")
    assert report.skipped == (SkippedRecord("pair", 1, "its second file is damaged"),)
    assert ScenarioDataset(tmp_path / "data", "training").scenario_ids == ["a"]
    (tmp_path / "pairs" / "b").write_text("something else")
    assert run(tmp_path / "pairs", tmp_path / "data", reader="two_files").shards_written == 1
    with pytest.raises(DataError, match="its second file is damaged"):
        run(tmp_path / "pairs", tmp_path / "data", reader="two_files", on_error="stop")


def test_a_source_that_lacks_a_part_is_refused(tmp_path):
    SOURCES.register("half")(type("Half", (), {"license_note": "CC0-1.0", "find": lambda self, path: []}))
    with pytest.raises(ConfigError, match="data source 'half' has no read, describe"):
        run(tmp_path, tmp_path / "data", reader="half")


def test_units_of_one_name_and_missing_files_are_refused(tmp_path):
    class Lost(WomdSource):
        names = ("a", "a")

        def find(self, path):
            return [Unit(name, (Path(path) / name,)) for name in self.names]

    SOURCES.register("lost")(Lost)
    with pytest.raises(DataError, match=r"two units of one name for shards/unknown/a\.arrow"):
        run(tmp_path, tmp_path / "data", reader="lost")
    Lost.names = ("a", "b")
    with pytest.raises(DataError, match="/a: cannot be read: No such file or directory"):
        run(tmp_path, tmp_path / "data", reader="lost")


def test_an_unknown_source_is_refused_with_the_nearest_name(tmp_path):
    with pytest.raises(ConfigError, match="unknown data source 'wmod': did you mean 'womd'"):
        run(tmp_path, tmp_path / "data", reader="wmod")


def test_what_no_source_recognizes_is_read_as_womd(tmp_path):
    assert isinstance(find_source("auto", tmp_path), WomdSource)
    with pytest.raises(DataError, match="no tfrecord file in this folder"):
        run(tmp_path, tmp_path / "data")


@pytest.mark.usefixtures("drives")
def test_files_of_several_sources_have_to_be_named(tmp_path, recordings):
    SOURCES.register("other")(type("Other", (WomdSource,), {"detects": lambda self, path: "rec" in str(path)}))
    with pytest.raises(ConfigError, match="could be read as drives or other: name the data source"):
        run(recordings, tmp_path / "data")


def test_womd_is_found_without_loading_any_other_package(tmp_path, make_message, make_tfrecord):
    make_tfrecord(tmp_path / "x.tfrecord", make_message())
    entry_points = {"rlftsim.sources": {"broken": "broken_package:Gone"}}
    with third_party.installed(tmp_path / "site", "broken_package", "raise RuntimeError('too early')", entry_points):
        assert isinstance(find_source("auto", tmp_path), WomdSource)
        assert "broken_package" not in sys.modules


def test_units_are_named_below_the_folder_they_share(tmp_path):
    units = units_of_files([tmp_path / "training" / "a.x", tmp_path / "b" / "c.x"])
    assert [(unit.name, unit.split) for unit in units] == [("training/a.x", "training"), ("b/c.x", "unknown")]
    assert infer_split(tmp_path / "validation" / "training.x") == "training"


def test_a_given_license_replaces_that_of_the_source(tmp_path, make_message, make_tfrecord):
    make_tfrecord(tmp_path / "x.tfrecord", make_message())
    run(tmp_path / "x.tfrecord", tmp_path / "data", license_note="mine")
    assert json.loads((tmp_path / "data" / "manifest.json").read_text())["license_note"] == "mine"
    write_dataset(ScenarioDataset(tmp_path / "data"), str(tmp_path / "copy"))
    assert len(ScenarioDataset(str(tmp_path / "copy"))) == 1

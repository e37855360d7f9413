"""The report on a vocabulary: whole or not at all, and its numbers are those that were measured."""

import errno
import re

import pytest

import scenes
from rlftsim.errors import DataError
from rlftsim.scenario.types import ObjectType
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.tokens.coverage import measure_coverage
from rlftsim.viewer import vocabulary_report
from rlftsim.viewer.vocabulary_report import ROWS, write_vocabulary_report


@pytest.fixture(scope="module")
def classes():
    """Of a vocabulary without cyclists."""
    data = [scenes.build_scenario("two", tuple(m for m in scenes.TRAFFIC if m.kind != ObjectType.CYCLIST))]
    vocabulary, radii = build_vocabulary(data, TokensConfig(num_tokens=64, num_map_prototypes=4))
    return measure_coverage(data, vocabulary, radii_m=radii)


def test_page_and_picture_stand_in_a_folder(classes, tmp_path):
    folder = tmp_path / "new" / "v.report"
    write_vocabulary_report(folder, classes, vocabulary="old", data="two cars")
    (folder / "report.json").touch()  # as earlier versions wrote it
    write_vocabulary_report(folder, classes, vocabulary="v", data="two cars")
    assert {p.name for p in folder.iterdir()} == {"report.md", "picture.png"}
    assert [p.name for p in folder.parent.iterdir()] == ["v.report"]
    assert (folder / "picture.png").read_bytes().startswith(b"\x89PNG")
    page = (folder / "report.md").read_text()
    assert all(name in page for name in ROWS)
    assert f"| motions | {classes[0].single_m.count} | " in page
    assert re.search(r"\| tokens \| \d+ \| \d+ \| 1 \|", page)  # of cyclists that which stands still
    assert "| token 0 stands exactly still | yes | yes | yes |" in page


def test_a_folder_with_other_things_in_it_is_left_alone(classes, tmp_path):
    (tmp_path / "thesis.tex").write_text("x")
    with pytest.raises(DataError, match=r"not a report on a vocabulary.*--report"):
        write_vocabulary_report(tmp_path, classes, vocabulary="v", data="two cars")
    assert (tmp_path / "thesis.tex").read_text() == "x"


def test_what_goes_wrong_half_way_leaves_the_old_report(classes, tmp_path, monkeypatch):
    folder = tmp_path / "v.report"
    write_vocabulary_report(folder, classes, vocabulary="old", data="two cars")

    def full(*_, **__):
        raise OSError("no space left on device")

    (tmp_path / ".v.report.machine.12.tmp").mkdir()  # by a process that was killed
    (tmp_path / ".v.report.machine.12.tmp" / "report.md").touch()
    monkeypatch.setattr(vocabulary_report, "coverage_picture", full)
    with pytest.raises(DataError, match=r"no space left.*make room"):
        write_vocabulary_report(folder, classes, vocabulary="new", data="two cars")
    assert (folder / "report.md").read_text().startswith("# A vocabulary\n\nold")
    assert [p.name for p in tmp_path.iterdir()] == ["v.report"]


def test_a_read_only_place_for_a_report_needs_no_room(classes, tmp_path, monkeypatch):
    def refused(*_, **__):
        raise OSError(errno.EROFS, "Read-only file system")

    monkeypatch.setattr(vocabulary_report, "coverage_picture", refused)
    with pytest.raises(DataError, match=r"v\.report \(Read-only file system\): choose another place"):
        write_vocabulary_report(tmp_path / "v.report", classes, vocabulary="v", data="two cars")

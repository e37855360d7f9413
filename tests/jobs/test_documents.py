import ast
import math
from pathlib import Path

import pytest

import rlftsim
from rlftsim.errors import CheckpointError, DataError
from rlftsim.jobs.documents import MAX_DEPTH, parse_json, read_json, read_toml

PACKAGE = Path(rlftsim.__file__).parent


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        ("[" * 100_000, "nested more than 64 deep"),
        ('{"a":' * 900 + "1" + "}" * 900, "nested more than 64 deep"),
        ('{"a": 1, "b": 2, "a": 3}', "'a' is written more than once"),
        ('{"a": NaN}', "NaN is no finite number"),
        ('{"a": -1e999}', "-1e999 is no finite number"),
        ('{"a": ' + "9" * 5000 + "}", "a whole number of 5000 digits"),
        ('{"a": "\\ud800"}', "half a character, U+D800"),
        ('{"a": 1', "not JSON, line 1, column 8"),
        (b"\xff\xfe{", "not text in UTF-8"),
        ("[1]", "holds a list instead of an object"),
        ("7", "holds a number instead of an object"),
        ("", "not JSON, line 1, column 1"),
    ],
)
def test_json_that_no_reader_could_use_is_refused_in_one_line_with_the_way_out(text, cause):
    with pytest.raises(CheckpointError) as error:
        parse_json(text, "write it again", source="model/config.json", error=CheckpointError)
    message = str(error.value)
    assert message.startswith("model/config.json: ")
    assert cause in message
    assert message.endswith(": write it again.")
    assert "\n" not in message
    assert len(message) < 200


def test_json_is_read_with_a_mark_in_front_to_the_greatest_depth(tmp_path):
    path = tmp_path / "a.json"
    path.write_bytes(b"\xef\xbb\xbf" + b'{"a": ' + b"[" * (MAX_DEPTH - 1) + b"]" * (MAX_DEPTH - 1) + b', "b": 1e3}')
    assert read_json(path, "write it again")["b"] == 1000.0


def test_metrics_may_hold_nan():
    assert math.isnan(parse_json('{"loss": NaN}', "train again", source="line 1", allow_nan=True)["loss"])


def test_a_missing_file_is_the_callers_to_explain_and_a_folder_is_refused(tmp_path):
    with pytest.raises(FileNotFoundError):
        read_json(tmp_path / "no.json", "write it")
    with pytest.raises(DataError, match=r"cannot be read .*: write it\.$"):
        read_json(tmp_path, "write it")


@pytest.mark.parametrize(("read", "size"), [(read_json, 65 << 20), (read_toml, 2 << 20)])
def test_a_text_larger_than_any_is_refused_before_it_is_read(tmp_path, read, size):
    with (tmp_path / "large").open("wb") as file:
        file.truncate(size)
    with pytest.raises(DataError, match=r"larger than \d+ MiB"):
        read(tmp_path / "large", "write it again")


def test_a_device_without_end_is_read_to_the_limit_only(monkeypatch):
    monkeypatch.setattr("rlftsim.jobs.documents.MAX_TEXT_BYTES", 1000)
    with pytest.raises(DataError, match="larger than"):
        read_json("/dev/zero", "write it again")


def test_toml_is_read_with_a_mark_in_front(tmp_path):
    (tmp_path / "e.toml").write_bytes(b'\xef\xbb\xbfname = "a"\r\nborn = 2020-01-01\r\n')
    assert read_toml(tmp_path / "e.toml", "write one")["name"] == "a"


@pytest.mark.parametrize(
    ("text", "cause"),
    [
        (b"x = " + b"[" * 3000, "nested more than 64 deep"),
        (b"a." * 40_000 + b"a = 1", "nested more than 64 deep"),
        (b"[" + b"'a' . " * 400 + b"a]\nx = 1", "nested more than 64 deep"),
        (b"x = 1\nx = 2", "not TOML: "),
        (b"x = \xff", "not text in UTF-8"),
    ],
)
def test_toml_that_is_damaged_is_refused_in_one_line(tmp_path, text, cause):
    (tmp_path / "e.toml").write_bytes(text)
    with pytest.raises(DataError) as error:
        read_toml(tmp_path / "e.toml", "write one")
    assert cause in str(error.value)
    assert "\n" not in str(error.value)


def test_no_other_module_parses_json_or_toml():
    for path in PACKAGE.rglob("*.py"):
        if path == PACKAGE / "jobs" / "documents.py":
            continue
        for node in ast.walk(ast.parse(path.read_text())):
            is_parser = isinstance(node, ast.Attribute) and node.attr in ("loads", "load")
            assert not (is_parser and isinstance(node.value, ast.Name) and node.value.id in ("json", "tomllib")), path
            assert not (isinstance(node, ast.ImportFrom) and node.module in ("json", "tomllib")), path

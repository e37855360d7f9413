import ast
import os
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq
import pytest

import rlftsim
from rlftsim.errors import DataError
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.tables import check_columns, map_arrow, read_parquet, read_parquet_metadata

PACKAGE = Path(rlftsim.__file__).parent


def damaged_text():
    """A column of text whose bytes are no UTF-8."""
    return pa.Array.from_buffers(pa.string(), 1, pa.array([b"\xff\xfe"], pa.binary()).buffers())


def write_arrow(path, table, compression=None):
    with pa.ipc.new_file(path, table.schema, options=pa.ipc.IpcWriteOptions(compression=compression)) as writer:
        writer.write_table(table)
    return path


def test_text_that_is_no_utf8_is_refused_in_both_formats(tmp_path):
    table = pa.table({"a": damaged_text()})
    pq.write_table(table, tmp_path / "a.parquet")
    with pytest.raises(DataError, match="Invalid UTF8"):
        read_parquet(tmp_path / "a.parquet", "write it again")
    with pytest.raises(DataError, match=r"is damaged \(.*Invalid UTF8.*: write it again\.$"):
        map_arrow(write_arrow(tmp_path / "a.arrow", table), "write it again")


READ_DAMAGED = """
import sys
from pathlib import Path
from rlftsim.errors import DataError
from rlftsim.jobs.tables import read_parquet

whole, damaged = Path(sys.argv[1]).read_bytes(), Path(sys.argv[2])
for position in range(4, len(whole)):
    damaged.write_bytes(whole[:position] + bytes([whole[position] ^ 0x13]) + whole[position + 1 :])
    try:
        read_parquet(damaged, "write it again")
    except DataError:
        pass
"""


def test_no_damaged_byte_of_a_parquet_file_ends_the_process(tmp_path):
    pq.write_table(pa.table({"a": ["x", "y"], "b": ["z", "z"], "c": [1, 2]}), tmp_path / "a.parquet")
    command = [sys.executable, "-c", READ_DAMAGED, str(tmp_path / "a.parquet"), str(tmp_path / "damaged.parquet")]
    subprocess.run(command, check=True)


def test_a_column_twice_is_refused(tmp_path):
    table = pa.table([pa.array([1]), pa.array([2])], names=["a", "a"])
    with pytest.raises(DataError, match="two columns 'a'"):
        map_arrow(write_arrow(tmp_path / "a.arrow", table), "write it again")


@pytest.mark.parametrize("compression", ["zstd", "lz4"])
def test_a_compressed_shard_is_refused_before_it_fills_the_memory(compression, tmp_path):
    table = pa.table({"a": [bytes(1 << 20)] * 16})
    path, unused = write_arrow(tmp_path / "a.arrow", table, compression), pa.default_memory_pool().max_memory()
    assert path.stat().st_size < 1 << 17
    del table
    with pytest.raises(DataError, match=r"is damaged \(it is compressed, .*\): convert again\.$"):
        map_arrow(path, "convert again")
    assert pa.default_memory_pool().max_memory() == unused


def test_a_shard_is_mapped_and_its_batches_are_as_many_as_its_end_says(tmp_path):
    batches = pa.table({"a": pa.chunked_array([[bytes(1 << 16)], [b"x", None], []], pa.binary()), "b": [1, 2, 3]})
    before = pa.total_allocated_bytes()
    table = map_arrow(write_arrow(tmp_path / "a.arrow", batches), "convert again")
    assert table.equals(batches)
    assert pa.total_allocated_bytes() - before < 1 << 12
    data = (tmp_path / "a.arrow").read_bytes()
    for size in (8, 200, len(data) // 2, len(data) - 20):
        (tmp_path / "cut.arrow").write_bytes(data[:size])
        with pytest.raises(DataError, match="is damaged"):
            map_arrow(tmp_path / "cut.arrow", "convert again")


def repeat_text(num_rows, num_bytes):
    text = pa.array(["x" * num_bytes])
    return pa.DictionaryArray.from_arrays(pa.array(np.zeros(num_rows, np.int32)), text)


BOMBS = {
    "texts": (lambda: repeat_text(20_000, 1_000_000), {"dictionary_pagesize_limit": 1 << 30}),
    "texts-v2": (
        lambda: repeat_text(20_000, 1_000_000),
        {"dictionary_pagesize_limit": 1 << 30, "data_page_version": "2.0"},
    ),
    "texts-in-a-list": (lambda: in_a_list(repeat_text(20_000, 1_000_000)), {}),
    "a-long-list": (lambda: in_a_list(pa.array(np.zeros(150_000_000))), {}),
    "a-long-text": (lambda: ["y" * 1_500_000_000], {"use_dictionary": False, "write_statistics": False}),
    "differences": (
        lambda: [f"{'z' * 100_000}{number}" for number in range(12_000)],
        {"use_dictionary": False, "column_encoding": {"a": "DELTA_BYTE_ARRAY"}},
    ),
}


def in_a_list(values):
    return pa.ListArray.from_arrays(pa.array([0, len(values)], pa.int32()), values)


@pytest.mark.parametrize("name", BOMBS)
def test_a_small_file_that_unfolds_to_more_than_memory_holds_is_refused(name, tmp_path):
    make_column, settings = BOMBS[name]
    table = pa.table({"a": make_column()})
    pq.write_table(table, tmp_path / "a.parquet", compression="zstd", store_schema=False, **settings)
    command = [sys.executable, "-c", READ_BOMB, str(tmp_path / "a.parquet")]
    message, peak = subprocess.run(command, check=True, capture_output=True, text=True).stdout.splitlines()
    assert message.endswith("a.parquet: cannot be read (it unfolds to more than its size explains): get it again.")
    assert int(peak) < 3 << 29


READ_BOMB = """
import resource, sys
from rlftsim.errors import DataError
from rlftsim.jobs.tables import read_parquet

before = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss, resource.getrlimit(resource.RLIMIT_AS)
try:
    read_parquet(sys.argv[1], "get it again")
except DataError as error:
    print(error)
print((resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - before[0]) << 10)
assert resource.getrlimit(resource.RLIMIT_AS) == before[1]
"""


def test_a_named_pipe_is_refused_where_a_file_is_read(tmp_path):
    os.mkfifo(tmp_path / "a.parquet")
    for read in (read_parquet, map_arrow, read_json):
        with pytest.raises(DataError, match="a pipe, not a file"):
            read(tmp_path / "a.parquet", "write it again")
    assert read_parquet_metadata(tmp_path / "a.parquet") == {}


def test_texts_that_are_repeated_within_reason_are_read(tmp_path):
    names = [f"{'name' * 20}-{number % 3000}" for number in range(200_000)]
    table = pa.table({"by dictionary": names, "by differences": sorted(names), "in a list": [[name] for name in names]})
    pq.write_table(
        table, tmp_path / "a.parquet", use_dictionary=["by dictionary", "in a list.list.element"],
        column_encoding={"by differences": "DELTA_BYTE_ARRAY"},
    )  # fmt: skip
    assert read_parquet(tmp_path / "a.parquet", "get it again").equals(table)


def test_a_small_file_that_announces_more_than_memory_holds_is_refused_unread(tmp_path, monkeypatch):
    monkeypatch.setattr("rlftsim.jobs.tables.MAX_VALUES", 1000)
    monkeypatch.setattr(pq.ParquetFile, "read", lambda *_: pytest.fail("it was read"))
    pq.write_table(pa.table({"a": [0] * 1_000_000}), tmp_path / "a.parquet")
    with pytest.raises(DataError, match=r"announces 1e\+06 values in \d+ bytes"):
        read_parquet(tmp_path / "a.parquet", "write it again")


def test_damage_is_one_line_and_a_missing_file_is_the_callers_to_explain(tmp_path):
    (tmp_path / "a.parquet").write_bytes(b"PAR1 nonsense PAR1")
    with pytest.raises(DataError, match=r"a\.parquet: cannot be read \(.*\): write it again\.$") as error:
        read_parquet(tmp_path / "a.parquet", "write it again")
    assert "\n" not in str(error.value)
    assert read_parquet_metadata(tmp_path / "a.parquet") == {}
    for read in (read_parquet, map_arrow):
        with pytest.raises(FileNotFoundError):
            read(tmp_path / "none", "write it")
    with pytest.raises(DataError, match="cannot be read"):
        read_parquet(tmp_path, "write it")


@pytest.mark.parametrize(
    ("columns", "words"),
    [
        ({"a": [1]}, "no column b"),
        ({"a": [1], "b": ["x"], "c": [1]}, "unknown column 'c'"),
        ({"a": [1.0], "b": ["x"]}, "column a holds double, not int64"),
        ({"a": [1], "b": pa.array([None], pa.string())}, "column b has empty cells"),
    ],
)
def test_columns_other_than_the_schemas_are_named(columns, words):
    with pytest.raises(DataError, match=words):
        check_columns(pa.table(columns), pa.schema([("a", pa.int64()), ("b", pa.string())]))


def test_no_other_module_opens_parquet_or_arrow_files():
    openers = {"ParquetFile", "read_table", "read_schema", "memory_map", "open_file", "open_stream", "ParquetDataset"}
    for path in PACKAGE.rglob("*.py"):
        if path == PACKAGE / "jobs" / "tables.py":
            continue
        names = {node.attr for node in ast.walk(ast.parse(path.read_text())) if isinstance(node, ast.Attribute)}
        assert not names & openers, path

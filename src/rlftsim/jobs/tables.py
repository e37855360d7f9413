"""Arrow tables from files that anybody may have written, damaged or edited.

The only module that opens Parquet or Arrow files. Arrow trusts the offsets and lengths in a file until a table is
validated: a wrong offset is followed out of the file, which ends the process.
"""

import resource
import threading
from collections import Counter
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from os import PathLike, fspath, stat
from pathlib import Path

import pyarrow as pa
import pyarrow.parquet as pq

from rlftsim.errors import DataError
from rlftsim.jobs.documents import check_has_end, explained_damage, first_line

MAX_VALUES = 1 << 25
"""Values that a Parquet file may hold, however small it is: 256 MiB of numbers."""
MAX_VALUES_PER_BYTE = 100
"""Values a byte of a larger Parquet file; columns that hardly vary are packed far better than others."""
MAX_COLUMNS = 10_000
MAX_TABLE_BYTES, MAX_BYTES_PER_BYTE = 3 << 29, 16
"""Memory that reading a Parquet file may take, and the same for each byte of the file: repeated values are packed a
million times smaller."""
_memory_limit = threading.Lock()
_ARROW_BEGINNING = b"ARROW1\0\0"
_DAMAGE = (OSError, ValueError, TypeError, KeyError, MemoryError, OverflowError, pa.ArrowException)


def read_parquet(path: str | PathLike[str], remedy: str, *, missing: str = "") -> pa.Table:
    """Validated table of a Parquet file.

    Args:
        path: Parquet file; a folder is none.
        remedy: Way out at the end of every message, such as "convert again".
        missing: Whole message where there is no such file; empty leaves it to the caller.

    Raises:
        FileNotFoundError: No such file, and no message for that.
        DataError: Damaged file, text that is no UTF-8, a column twice, or more values than the file's size can explain.
    """
    with explained_damage(path, _DAMAGE, remedy, describe=_describe_cause, missing=missing):
        num_bytes = stat(path).st_size
        with _limited_memory(MAX_TABLE_BYTES + MAX_BYTES_PER_BYTE * num_bytes), pq.ParquetFile(path) as file:
            _check_size(file.metadata, num_bytes)
            # in batches: memory for as many values as a damaged column tells would be taken at once; without threads,
            # whose stacks would count as memory
            return _validate_table(pa.Table.from_batches(file.iter_batches(use_threads=False), file.schema_arrow))


def map_arrow(path: str | PathLike[str], remedy: str) -> pa.Table:
    """Validated table of an Arrow file, memory-mapped: values are read when needed.

    Batches are read from the checked messages, not from the positions that the end of the file announces.

    Args:
        path: Arrow file of a shard, which must not change while the table is in use.
        remedy: Way out at the end of every message.

    Raises:
        FileNotFoundError: No such file; the caller names the file in the message.
        DataError: Damaged or compressed file, or text that is no UTF-8.
    """
    with explained_damage(path, _DAMAGE, remedy, words=" is damaged", describe=_describe_cause):
        file = pa.memory_map(fspath(path))
        reader = pa.ipc.open_file(file)
        file.seek(len(_ARROW_BEGINNING))
        messages = [message for message in pa.ipc.MessageReader.open_stream(file) if message.type != "schema"]
        if len(messages) != reader.num_record_batches:
            raise ValueError(f"it has {len(messages)} batches, not {reader.num_record_batches}")
        if any(map(_is_compressed, messages)):
            raise ValueError("it is compressed, as this package writes no shard")
        batches = [pa.ipc.read_record_batch(message, reader.schema) for message in messages]
        return _validate_table(pa.Table.from_batches(batches, reader.schema))


def read_parquet_metadata(path: str | PathLike[str]) -> Mapping[bytes, bytes]:
    """Metadata in the schema of a Parquet file; empty where there are none, or no such file."""
    try:
        check_has_end(path)
        return pq.read_schema(path).metadata or {}
    except _DAMAGE:
        return {}


def check_columns(table: pa.Table, schema: pa.Schema) -> None:
    """Check that a table has the columns of a schema, and no empty cells.

    Args:
        table: Columns in any order.
        schema: Names and types of all columns.

    Raises:
        DataError: A column is missing, unknown, of the wrong type or has an empty cell; the message begins with the
            column.
    """
    missing = [name for name in schema.names if name not in table.schema.names]
    unexpected = [name for name in table.schema.names if name not in schema.names]
    if missing or unexpected:
        raise DataError(f"no column {missing[0]}" if missing else f"unknown column {unexpected[0][:40]!r}")
    for field in schema:
        column = table[field.name]
        if column.type != field.type:
            raise DataError(f"column {field.name} holds {str(column.type)[:40]}, not {field.type}")
        if column.null_count:
            raise DataError(f"column {field.name} has empty cells")


@contextmanager
def _limited_memory(num_bytes: int) -> Iterator[None]:
    """Let this process take a number of bytes more at the most: what is beyond ends in a MemoryError.

    The sizes in a file do not tell what pyarrow will take: a text of a megabyte that is repeated is stored once.
    """
    try:
        used = int(Path("/proc/self/statm").read_text().split()[0]) * resource.getpagesize()
    except OSError:  # no such file on this platform
        yield
        return
    with _memory_limit:
        before = resource.getrlimit(resource.RLIMIT_AS)
        limits = [limit for limit in (used + num_bytes, *before) if limit != resource.RLIM_INFINITY]
        resource.setrlimit(resource.RLIMIT_AS, (min(limits), before[1]))
        try:
            yield
        finally:
            resource.setrlimit(resource.RLIMIT_AS, before)


def _validate_table(table: pa.Table) -> pa.Table:
    names = table.schema.names  # decoded here
    table.validate(full=True)
    name, count = next(iter(Counter(names).most_common(1)), ("", 0))
    if count > 1:
        raise ValueError(f"two columns {name[:40]!r}")
    return table


def _is_compressed(message: pa.ipc.Message) -> bool:
    """True for a record batch with compressed values, which would unfold in memory to a size that the file announces.

    pyarrow does not say; `Message.header` and `RecordBatch.compression` are in Arrow's format/Message.fbs.
    """
    data = message.metadata.to_pybytes()

    def read(start: int, size: int = 4) -> int:
        return int.from_bytes(data[start : start + size], "little")

    def find(table: int, number: int) -> int:
        """Position of a table's field, 0 where left out: a FlatBuffer lists offsets before tables."""
        offsets = table - int.from_bytes(data[table : table + 4], "little", signed=True)
        entry = 4 + 2 * number
        offset = read(offsets + entry, 2) if entry < read(offsets, 2) else 0
        return table + offset if offset else 0

    header = find(read(0), 2)
    return find(header + read(header), 3) > 0


def _check_size(metadata: pq.FileMetaData, num_bytes: int) -> None:
    """Check that values can be in a file: a few bytes may announce as many as memory cannot hold."""
    # not by the metadata of columns: a damaged one ends the process as soon as pyarrow looks at it
    num_rows = sum(metadata.row_group(number).num_rows for number in range(metadata.num_row_groups))
    if metadata.num_columns > MAX_COLUMNS:
        raise ValueError(f"it has {metadata.num_columns} columns, above {MAX_COLUMNS}")
    announced = max(num_rows, metadata.num_rows) * metadata.num_columns
    if announced > max(MAX_VALUES, MAX_VALUES_PER_BYTE * num_bytes):
        raise ValueError(f"it announces {announced:.3g} values in {num_bytes} bytes")


def _describe_cause(problem: BaseException) -> str:
    if isinstance(problem, MemoryError):
        return "it unfolds to more than its size explains"
    return "a name is not text in UTF-8" if isinstance(problem, UnicodeDecodeError) else first_line(problem)

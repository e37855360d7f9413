"""Arrow tables from files that anybody may have written, damaged or edited.

The only module that opens Parquet or Arrow files. Arrow trusts the offsets and lengths in them until a table is
validated: a wrong one is followed out of the file, which ends the process.
"""

from collections.abc import Mapping
from os import PathLike, fspath, stat

import pyarrow as pa
import pyarrow.parquet as pq

from rlftsim.errors import DataError, RlftsimError
from rlftsim.jobs.documents import first_line

MAX_VALUES = 1 << 27
"""Values that a Parquet file may hold, however small it is: 1 GiB of numbers."""
MAX_VALUES_PER_BYTE = 100
"""Values a byte of a larger Parquet file; columns that hardly vary are packed far better than others."""
_DAMAGE = (OSError, ValueError, TypeError, KeyError, MemoryError, OverflowError, pa.ArrowException)


def read_parquet(path: str | PathLike[str], remedy: str, *, error: type[RlftsimError] = DataError) -> pa.Table:
    """Validated table of a Parquet file.

    Args:
        path: Parquet file; a folder is none.
        remedy: Way out at the end of every message, such as "convert again".
        error: Class of the errors raised.

    Raises:
        FileNotFoundError: No such file; the caller knows what was looked for.
        RlftsimError: Damaged file, text that is no UTF-8, a column twice, or more values than its size can explain.
    """
    try:
        with pq.ParquetFile(path) as file:
            _check_size(file.metadata, stat(path).st_size)
            return _validate_table(file.read())
    except FileNotFoundError:
        raise
    except _DAMAGE as problem:
        raise error(f"{path}: cannot be read ({_describe_cause(problem)}): {remedy}.") from None


def map_arrow(path: str | PathLike[str], remedy: str) -> pa.Table:
    """Validated table of an Arrow file, memory-mapped: its values are read when they are needed.

    Args:
        path: Arrow file of a shard, which must not change while the table is in use.
        remedy: Way out at the end of every message.

    Raises:
        FileNotFoundError: No such file; the caller knows what was looked for.
        DataError: Damaged file, or text that is no UTF-8.
    """
    try:
        return _validate_table(pa.ipc.open_file(pa.memory_map(fspath(path))).read_all())
    except FileNotFoundError:
        raise
    except _DAMAGE as problem:
        raise DataError(f"{path} is damaged ({_describe_cause(problem)}): {remedy}.") from None


def read_parquet_metadata(path: str | PathLike[str]) -> Mapping[bytes, bytes]:
    """Metadata in the schema of a Parquet file; empty where there are none, or no such file."""
    try:
        return pq.read_schema(path).metadata or {}
    except _DAMAGE:
        return {}


def check_columns(table: pa.Table, schema: pa.Schema) -> None:
    """Check that a table has the columns of a schema, and no empty cells.

    Args:
        table: Columns in any order.
        schema: Names and types of all columns.

    Raises:
        DataError: A column is missing, unknown, of another type or has an empty cell; the message begins with it.
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


def _validate_table(table: pa.Table) -> pa.Table:
    names = table.schema.names  # decoded here
    table.validate(full=True)
    repeated = [name for name in names if names.count(name) > 1]
    if repeated:
        raise ValueError(f"two columns {repeated[0][:40]!r}")
    return table


def _check_size(metadata: pq.FileMetaData, num_bytes: int) -> None:
    """Check that values can be in a file: a few bytes may announce as many as memory cannot hold."""
    groups = [metadata.row_group(number) for number in range(metadata.num_row_groups)]
    announced = sum(group.column(k).num_values for group in groups for k in range(group.num_columns))
    announced = max(announced, metadata.num_rows * metadata.num_columns)
    if announced > max(MAX_VALUES, MAX_VALUES_PER_BYTE * num_bytes):
        raise ValueError(f"it announces {announced:.3g} values in {num_bytes} bytes")


def _describe_cause(problem: BaseException) -> str:
    return "a name is not text in UTF-8" if isinstance(problem, UnicodeDecodeError) else first_line(problem)

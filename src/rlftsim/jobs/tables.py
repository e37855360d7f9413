"""Arrow tables from files that anybody may have written, damaged or edited.

The only module that opens Parquet or Arrow files. Arrow trusts the offsets and lengths in a file until a table is
validated: a wrong offset is followed out of the file, which ends the process.
"""

from collections.abc import Mapping
from mmap import ACCESS_READ, mmap
from os import PathLike, fspath, stat
from typing import Any

import pyarrow as pa
import pyarrow.compute as pc
import pyarrow.parquet as pq

from rlftsim.errors import DataError, RlftsimError
from rlftsim.jobs.documents import first_line

MAX_BYTES = 1 << 29
"""Bytes of memory that a Parquet file may unfold to, however small it is."""
MAX_BYTES_PER_BYTE = 100
"""The same for a byte of a larger Parquet file; columns that hardly vary are packed far better than others."""
_BYTES_PER_VALUE = 16
"""Memory of a number, and of the place of a text or a list."""
_TEXT, _DIFFERENCES, _DICTIONARY = 6, 7, (2, 8)
"""Numbers of Parquet: the type of texts, the encoding of texts by what they share, and those by a dictionary."""
_ARROW_BEGINNING = b"ARROW1\0\0"
_DAMAGE = (
    AttributeError,
    OSError,
    ValueError,
    TypeError,
    LookupError,
    MemoryError,
    OverflowError,
    RecursionError,
    pa.ArrowException,
)


def read_parquet(path: str | PathLike[str], remedy: str, *, error: type[RlftsimError] = DataError) -> pa.Table:
    """Validated table of a Parquet file.

    Args:
        path: Parquet file; a folder is none.
        remedy: Way out at the end of every message, such as "convert again".
        error: Class of the errors raised.

    Raises:
        FileNotFoundError: No such file; the caller names the file in the message.
        RlftsimError: Damaged file, text that is no UTF-8, a column twice, or more values than the file's size can
            explain.
    """
    try:
        _check_size(path)
        with pq.ParquetFile(path) as file:
            # in batches: memory for as many values as a damaged column tells would be taken at once
            return _validate_table(pa.Table.from_batches(file.iter_batches(), file.schema_arrow))
    except FileNotFoundError:
        raise
    except _DAMAGE as problem:
        raise error(f"{path}: cannot be read ({_describe_cause(problem)}): {remedy}.") from None


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
    try:
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


def _validate_table(table: pa.Table) -> pa.Table:
    names = table.schema.names  # decoded here
    table.validate(full=True)
    repeated = [name for name in names if names.count(name) > 1]
    if repeated:
        raise ValueError(f"two columns {repeated[0][:40]!r}")
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


def _check_size(path: str | PathLike[str]) -> None:
    """Check that a file can unfold to what its pages announce: a few bytes may stand for more than memory holds.

    By the headers of the pages, which Arrow allocates by. Those of columns may say anything, and a damaged one ends the
    process as soon as pyarrow looks at it.
    """
    num_bytes = stat(path).st_size
    if num_bytes < 12:
        raise ValueError("it is too short")
    limit = max(MAX_BYTES, MAX_BYTES_PER_BYTE * num_bytes)
    with open(path, "rb") as file, mmap(file.fileno(), 0, access=ACCESS_READ) as data:
        length = int.from_bytes(data[-8:-4], "little")
        groups = _Description(data, num_bytes - 8 - length).read_struct().get(4, [])
        sizes = [[_measure_pages(data, column[3]) for column in group[1]] for group in groups]
    unfolded, texts = (sum(size[number] for columns in sizes for size in columns) for number in (0, 1))
    if unfolded <= limit < unfolded + texts:
        largest = [max(size[2] for size in column) for column in zip(*sizes)]
        unfolded += _measure_texts(path, limit - unfolded, largest)
    if unfolded > limit:
        raise ValueError(f"it unfolds to {unfolded:.3g} bytes or more from {num_bytes}")


def _measure_pages(data: mmap, column: dict[int, Any]) -> tuple[int, int, int]:
    """Most bytes that a column of a row group unfolds to, without and for repeated texts, and of its largest page.

    The last is 0 where no text is stored by what it shares with the text before.

    Args:
        data: Whole file.
        column: Description of the column in the row group, by the numbers of the fields.
    """
    start = min(column[9], column.get(11) or column[9])
    unfolded = texts = dictionary_bytes = width = largest = 0
    has_differences = False
    position = start
    while position < start + column[7]:
        description = _Description(data, position)
        header = description.read_struct()
        page = header.get(5) or header.get(8) or {1: 0}
        encoding = page.get(2 if 5 in header else 4)
        if 7 in header:
            dictionary_bytes, width = header[2], header[2] // max(header[7][1], 1)
        unfolded += header[2] + page[1] * _BYTES_PER_VALUE
        largest, has_differences = max(largest, header[2]), has_differences or encoding == _DIFFERENCES
        if encoding == _DIFFERENCES:
            texts += page[1] * header[2]
        elif encoding in _DICTIONARY and column[1] == _TEXT:
            texts += page[1] * dictionary_bytes
        elif encoding in _DICTIONARY:
            unfolded += page[1] * width
        if min(header[2], header[3], page[1]) < 0:
            raise ValueError("a page has a negative size")
        position = description.position + header[3]
    if has_differences and len(column[3]) > 1:  # inside a list, a row may hold all of them
        return unfolded + texts, 0, largest
    return unfolded, texts, largest if has_differences else 0


def _measure_texts(path: str | PathLike[str], limit: int, largest: list[int]) -> int:
    """Bytes of all texts, each counted as often as it is repeated; counting ends above a limit.

    Args:
        path: Parquet file.
        limit: Bytes above which counting ends.
        largest: Bytes of the largest page of each column, see `_measure_pages`. Arrow keeps no dictionary of these
            columns, so few rows are read at a time.
    """
    num_rows = max(1, min(1 << 16, limit // max(*largest, 1)))
    with pq.ParquetFile(path) as file:
        paths = [file.schema.column(number).path for number, size in enumerate(largest) if not size]
    num_bytes = 0
    with pq.ParquetFile(path, read_dictionary=paths) as file:
        for batch in file.iter_batches(num_rows):
            num_bytes += sum(map(_count_text_bytes, batch.columns))
            if num_bytes > limit:
                break
    return num_bytes


def _count_text_bytes(array: pa.Array) -> int:
    """Bytes of the texts in an array, of dictionaries as if each was written out."""
    if isinstance(array, pa.DictionaryArray):
        if pa.types.is_primitive(array.type.value_type):
            return 0
        return pc.sum(pc.binary_length(array.dictionary).take(array.indices)).as_py() or 0
    if pa.types.is_nested(array.type):
        inner = array.flatten()
        return sum(map(_count_text_bytes, inner if isinstance(inner, list) else [inner]))
    return 0 if pa.types.is_primitive(array.type) else array.nbytes


class _Description:
    """Reader of Thrift's compact protocol, in which Parquet files describe themselves (parquet.thrift).

    Args:
        data: Whole file.
        position: First byte of a description; moves on with each value that is read.
    """

    def __init__(self, data: mmap, position: int) -> None:
        self._data, self.position = data, position

    def read_struct(self) -> dict[int, Any]:
        """Values by the number of the field."""
        fields: dict[int, Any] = {}
        number = 0
        while head := self._read_byte():
            number = number + (head >> 4) if head >> 4 else self._read_signed()
            fields[number] = head & 15 == 1 if head & 15 in (1, 2) else self._read_value(head & 15)
        return fields

    def _read_value(self, value_type: int) -> Any:
        if value_type <= 3:  # in lists, truth values are bytes, too
            return self._read_byte()
        if value_type <= 6:
            return self._read_signed()
        if value_type in (7, 8):  # a float, or bytes: none of either is needed
            size = 8 if value_type == 7 else self._read_unsigned()
            self.position += size
            return None
        if value_type in (9, 10):
            head = self._read_byte()
            size = head >> 4 if head >> 4 < 15 else self._read_unsigned()
            return [self._read_value(head & 15) for _ in range(size)]
        if value_type == 12:
            return self.read_struct()
        raise ValueError(f"it describes itself by values of type {value_type}")

    def _read_byte(self) -> int:
        if self.position < 0:
            raise ValueError("it is cut off")
        self.position += 1
        return self._data[self.position - 1]

    def _read_unsigned(self) -> int:
        number = shift = 0
        while shift < 64:
            byte = self._read_byte()
            number |= (byte & 127) << shift
            shift += 7
            if byte < 128:
                return number
        raise ValueError("it describes itself by a number of more than 64 bits")

    def _read_signed(self) -> int:
        number = self._read_unsigned()
        return number >> 1 ^ -(number & 1)


def _describe_cause(problem: BaseException) -> str:
    return "a name is not text in UTF-8" if isinstance(problem, UnicodeDecodeError) else first_line(problem)

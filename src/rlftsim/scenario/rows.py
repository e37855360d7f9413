"""Rows of Parquet tables of recordings: columns of checked types, and errors that name table and row."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Int64

from rlftsim.errors import DataError

Schema = tuple[Mapping[str, str], Mapping[str, str]]
"""Contents by name of the columns that are needed, and of those that may be left out. Further columns are ignored.

Contents are the words of `_read_column`. "text or nothing" and lists may have empty cells; empty numbers are NaN, an
error where it matters.
"""
MAX_OBJECT_BYTES = 1 << 24
"""Distinct texts, or lists, in a column: as Python objects they take ten times as much."""


@dataclass(frozen=True, eq=False)
class Rows:
    """Columns of some rows of a table, with the numbers of the rows."""

    table: str
    number: Int64[np.ndarray, "n"]
    columns: Mapping[str, np.ndarray]

    def __len__(self) -> int:
        return len(self.number)

    def __getitem__(self, name: str) -> np.ndarray:
        return self.columns[name]

    def __contains__(self, name: str) -> bool:
        return name in self.columns

    def take(self, rows: np.ndarray) -> "Rows":
        """Rows at some positions of these."""
        return Rows(self.table, self.number[rows], {name: column[rows] for name, column in self.columns.items()})

    def first(self, name: str, default: Any = None) -> Any:
        """Value of the first row in a column, or the default without such a column."""
        return self.columns[name][0] if name in self.columns else default

    def error(self, row: int | np.integer, cause: str) -> DataError:
        """Error that names table, row and cause."""
        return DataError(f"{self.table}: row {self.number[row]}: {cause}")

    def check(self, is_broken: Bool[np.ndarray, "n"], cause: str, *values: np.ndarray) -> None:
        """Raise a `DataError` at the first broken row; the cause is formatted with the row's values."""
        if is_broken.any():
            row = int(np.argmax(is_broken))
            raise self.error(row, cause.format(*(column[row] for column in values)))


def read_rows(name: str, table: pa.Table, schema: Schema) -> Rows:
    """Rows of an Arrow table, in the types of a schema.

    Args:
        name: Name of the table in messages, such as the name of the file.
        table: Table with any columns.
        schema: Contents of needed and of optional columns.

    Raises:
        DataError: A column is missing, of a wrong type or has empty cells.
    """
    needed, optional = schema
    for column in needed:
        if column not in table.schema.names:
            raise DataError(f"{name} has no column {column}")
    contents = {column: content for column, content in {**needed, **optional}.items() if column in table.schema.names}
    columns = {column: _read_column(name, column, table[column], content) for column, content in contents.items()}
    return Rows(name, np.arange(table.num_rows), columns)


def _read_column(table: str, name: str, column: pa.ChunkedArray, content: str) -> np.ndarray:
    """A column as an array: float64, int64, bool, or objects for text and lists."""
    types, cell_type = pa.types, column.type.value_type if pa.types.is_dictionary(column.type) else column.type
    is_list = types.is_list(cell_type) or types.is_large_list(cell_type)
    item_type = cell_type.value_type if is_list else cell_type
    is_text, has_text_items = (
        types.is_string(value_type) or types.is_large_string(value_type) or types.is_string_view(value_type)
        for value_type in (cell_type, item_type)
    )
    is_word = is_text or types.is_integer(cell_type) or types.is_null(cell_type)
    fits = {
        "text": is_word,
        "text or nothing": is_word,
        "numbers": types.is_floating(cell_type) or types.is_integer(cell_type),
        "whole numbers": types.is_integer(cell_type),
        "lists of whole numbers": (is_list and types.is_integer(item_type)) or types.is_null(item_type),
        "lists of words": (is_list and has_text_items) or types.is_null(item_type),
        "names or whole numbers": is_text or types.is_integer(cell_type),
        "True or False": types.is_boolean(cell_type),
    }[content]
    if not fits:
        raise DataError(f"{table}: column {name} is {column.type}, it must have {content}")
    if column.null_count and content not in ("text or nothing", "numbers", "lists of whole numbers", "lists of words"):
        row = np.flatnonzero(column.is_null().to_numpy())[0]
        raise DataError(f"{table}: row {row}: {name} is empty")
    try:
        if content == "numbers":
            return column.cast(pa.float64(), safe=False).to_numpy()
        if content == "whole numbers":
            return column.cast(pa.int64()).to_numpy()
        if content == "True or False":
            return column.to_numpy()
        if content.startswith("lists"):
            values = np.empty(len(column), object)
            values[:] = _to_objects(column)
            return values
        # equal texts are one object, so that a repeated text takes a pointer
        cells = column.dictionary_encode().combine_chunks()
        texts = _to_objects(cells.dictionary)
        if not content.startswith("names"):
            texts = [str(text) for text in texts]
        return np.array([*texts, None], object)[cells.indices.fill_null(len(texts))]
    except (pa.ArrowException, OverflowError) as error:
        raise DataError(f"{table}: column {name}: {error}") from None


def _to_objects(values: pa.Array | pa.ChunkedArray) -> list[Any]:
    if values.nbytes > MAX_OBJECT_BYTES:
        raise OverflowError(f"{values.nbytes / 1e6:.0f} MB of texts or lists, above {MAX_OBJECT_BYTES >> 20} MiB")
    return values.to_pylist()

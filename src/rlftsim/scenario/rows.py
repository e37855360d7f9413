"""Rows of Parquet tables of recordings: columns of checked types, and errors that name table and row."""

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
import pyarrow as pa
from jaxtyping import Bool, Int64

from rlftsim.errors import DataError

WORDS, NOTES, NUMBERS, INTEGERS = "text", "text or nothing", "numbers", "whole numbers"
NAMES_OR_NUMBERS, TRUTHS = "names or whole numbers", "True or False"
LISTS, WORD_LISTS = "lists of whole numbers", "lists of words"
"""Contents of a column. Notes and lists may have empty cells; empty numbers are NaN, an error where it matters."""


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


def read_rows(name: str, table: pa.Table, needed: Mapping[str, str], optional: Mapping[str, str]) -> Rows:
    """Rows of an Arrow table, in the types of a schema; further columns are ignored.

    Args:
        name: Name of the table in messages, such as the name of the file.
        table: Table with any columns.
        needed: Content of each needed column by name, such as `NUMBERS`.
        optional: Content of each column that may be left out.

    Raises:
        DataError: A column is missing, of a wrong type or has empty cells.
    """
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
        WORDS: is_word,
        NOTES: is_word,
        NUMBERS: types.is_floating(cell_type) or types.is_integer(cell_type),
        INTEGERS: types.is_integer(cell_type),
        LISTS: (is_list and types.is_integer(item_type)) or types.is_null(item_type),
        WORD_LISTS: (is_list and has_text_items) or types.is_null(item_type),
        NAMES_OR_NUMBERS: is_text or types.is_integer(cell_type),
        TRUTHS: types.is_boolean(cell_type),
    }[content]
    if not fits:
        raise DataError(f"{table}: column {name} is {column.type}, it must have {content}")
    if column.null_count and content not in (NOTES, NUMBERS, LISTS, WORD_LISTS):
        row = np.flatnonzero(column.is_null().to_numpy())[0]
        raise DataError(f"{table}: row {row}: {name} is empty")
    try:
        if content == NUMBERS:
            return column.cast(pa.float64(), safe=False).to_numpy()
        if content == INTEGERS:
            return column.cast(pa.int64()).to_numpy()
        if content == TRUTHS:
            return column.to_numpy()
        values = np.empty(len(column), object)
        values[:] = column.to_pylist()
        if content in (WORDS, NOTES):
            values[:] = [None if value is None else str(value) for value in values]
        return values
    except pa.ArrowException as error:
        raise DataError(f"{table}: column {name}: {error}") from None

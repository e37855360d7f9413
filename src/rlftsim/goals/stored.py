"""Goals of many scenarios in a folder of Parquet files: scenario_id, object_id, x, y. Frame: world, m.

For goals that programs write, such as the augmented goals of a whole data set. Goals written by hand are JSON
(`goals.goals_file`).
"""

import hashlib
from collections.abc import Iterable, Mapping
from functools import cached_property
from pathlib import Path

import numpy as np
import pyarrow as pa
import pyarrow.parquet as pq

from rlftsim.errors import DataError
from rlftsim.goals.types import Goals, Points, goals_at
from rlftsim.jobs.files import write_atomically
from rlftsim.jobs.tables import check_columns, read_parquet
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.shards import hash_file

MAX_COORDINATE_M = 1e7
"""Farthest coordinate of a goal, meters in the world frame; UTM coordinates stay within."""
SCHEMA = pa.schema([("scenario_id", pa.string()), ("object_id", pa.int64()), ("x", pa.float64()), ("y", pa.float64())])


def write_goal_file(path: Path, goals: Mapping[str, Points]) -> None:
    """Write a file of such a folder, atomically.

    Args:
        path: File to write; the files of a folder are read in the order of names.
        goals: Object ids and points by scenario id, world frame, m.
    """
    scenario_ids = np.repeat(list(goals), [len(ids) for ids, _ in goals.values()])
    object_ids, points = (np.concatenate(values) for values in zip(*goals.values()))
    columns = zip((scenario_ids, object_ids, *points.T), SCHEMA)
    table = pa.table([pa.array(values, column.type) for values, column in columns], schema=SCHEMA)
    write_atomically(path, lambda temporary: pq.write_table(table, temporary))


def read_goal_file(file: Path) -> pa.Table:
    """Table of a file that `write_goal_file` wrote.

    Raises:
        DataError: The file is damaged, or a row is not a goal.
    """
    way_out = f"remove {file.parent} and write its goals again by `rlftsim augment`"
    table = read_parquet(file, way_out)
    try:
        check_columns(table, SCHEMA)
        points = np.abs([table["x"].to_numpy(), table["y"].to_numpy()])
        if not (points <= MAX_COORDINATE_M).all():  # false for NaN, too
            raise DataError(f"a point is not within {MAX_COORDINATE_M:g} m of the origin")
    except DataError as error:
        raise DataError(f"{file}: holds rows that are not goals ({error}): {way_out}.") from None
    return table.replace_schema_metadata(None)


class StoredGoals:
    """The goals of a folder, by scenario id.

    Raises:
        DataError: The folder has no goals, a file is damaged, or a row is not a goal.
    """

    def __init__(self, folder: Path):
        self._files = sorted(folder.glob("*.parquet"))
        if not self._files:
            raise DataError(f"{folder}: holds no goals: write them by `rlftsim augment`.")
        tables = [read_goal_file(file) for file in self._files]
        self._table = pa.concat_tables([table.select(SCHEMA.names) for table in tables]).combine_chunks()

    @cached_property
    def _rows(self) -> dict[str, slice]:
        """Rows of each scenario."""
        ids = self._table["scenario_id"].to_numpy()
        # A scenario's rows are contiguous, so it begins wherever the id changes.
        starts = np.flatnonzero(np.append(True, ids[1:] != ids[:-1])) if len(ids) else np.zeros(0, np.int64)
        return {ids[a]: slice(a, b) for a, b in zip(starts.tolist(), [*starts[1:].tolist(), len(ids)])}

    def __contains__(self, scenario_id: str) -> bool:
        return scenario_id in self._rows

    def __len__(self) -> int:
        """Number of scenarios that have goals."""
        return len(self._rows)

    @cached_property
    def fingerprint(self) -> str:
        """Hash of the files' bytes, in the order of names."""
        return hashlib.sha256("".join(map(hash_file, self._files)).encode()).hexdigest()

    def count_among(self, scenario_ids: Iterable[str]) -> int:
        """Number of the listed scenarios that have goals here; 0 for scenarios of a different data set."""
        return sum(scenario_id in self for scenario_id in scenario_ids)

    def of_scenario(self, scenario_id: str) -> Points:
        """Object ids and goals of a scenario that has goals."""
        rows = self._rows[scenario_id]
        table = self._table.slice(rows.start, rows.stop - rows.start)
        ids, x, y = (table[name].to_numpy() for name in ("object_id", "x", "y"))
        return ids, np.stack([x, y], -1)

    def of_batch(self, batch: ScenarioBatch) -> Goals:
        """Goals of a batch, for a single rollout, in the batch's frame; scenarios outside the folder have no goals."""
        ids = [scenario.scenario_id for scenario in batch.scenarios if scenario.scenario_id in self]
        return goals_at({scenario_id: self.of_scenario(scenario_id) for scenario_id in ids}, batch)

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

from rlftsim.atomic_io import write_whole
from rlftsim.errors import DataError
from rlftsim.goals.types import Goals, Points, goals_at
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.shards import hash_file

SCHEMA = pa.schema([("scenario_id", pa.string()), ("object_id", pa.int64()), ("x", pa.float64()), ("y", pa.float64())])


def write_goal_file(path: Path, goals: Mapping[str, Points]) -> None:
    """Write a file of such a folder, atomically.

    Args:
        path: File to write; the files of a folder are read in the order of names.
        goals: Object ids and points by scenario id, world frame, m.
    """
    columns = {
        "scenario_id": np.repeat(list(goals), [len(ids) for ids, _ in goals.values()]),
        "object_id": np.concatenate([ids for ids, _ in goals.values()]),
        "x": np.concatenate([points[:, 0] for _, points in goals.values()]),
        "y": np.concatenate([points[:, 1] for _, points in goals.values()]),
    }
    table = pa.table({name: pa.array(values, SCHEMA.field(name).type) for name, values in columns.items()}, SCHEMA)
    write_whole(path, lambda temporary: pq.write_table(table, temporary))


class StoredGoals:
    """The goals of a folder, by scenario id.

    Raises:
        DataError: The folder has no goals, a file is damaged, or a row is not a goal.
    """

    def __init__(self, folder: Path):
        self._files = sorted(folder.glob("*.parquet"))
        if not self._files:
            raise DataError(f"{folder}: holds no goals: write them by `rlftsim augment`.")
        try:
            self._table = pa.concat_tables(
                [pq.read_table(file, schema=SCHEMA) for file in self._files]
            ).combine_chunks()
        except (pa.ArrowException, OSError) as error:
            raise DataError(f"{folder}: damaged goals ({error}): remove the folder and write them again.") from None
        points = np.stack([self._table[name].to_numpy().astype(float) for name in ("x", "y")])
        if any(column.null_count for column in self._table.columns) or not np.isfinite(points).all():
            raise DataError(
                f"{folder}: holds rows that are not goals (a value is missing or not finite): write them by "
                "`rlftsim augment`."
            )

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

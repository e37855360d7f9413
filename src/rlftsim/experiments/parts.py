"""An evaluation that can be interrupted: finished groups of scenarios are part files, a later run does the missing ones.

Groups are ranges of positions. A finished group is a file under `<name>.parts/`; when all are there they become
`<name>.parquet` and the folder goes.
"""

import shutil
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path

import pyarrow as pa

from rlftsim.errors import ConfigError, DataError
from rlftsim.experiments.evaluation import SCHEMA, Evaluation, Provenance, Skipped, join_evaluations
from rlftsim.processor import one_thread
from rlftsim.progress import progress_bar, say
from rlftsim.workers import Task, run_tasks

SCENARIOS_PER_GROUP = 4
"""What is lost at most, for each process, when a run is interrupted."""


@dataclass(frozen=True, eq=False)
class ResumableEvaluation:
    """Where the rows of an evaluation go, and what makes it this evaluation."""

    name: str
    provenance: Provenance
    out: Path

    def __post_init__(self) -> None:
        if not self.name or Path(self.name).name != self.name:
            raise ConfigError(f"an evaluation's name becomes a file name, {self.name!r} cannot: pass another name.")

    @property
    def result_path(self) -> Path:
        """The finished evaluation."""
        return self.out / f"{self.name}.parquet"

    @property
    def parts_folder(self) -> Path:
        """Finished groups of an unfinished evaluation."""
        return self.out / f"{self.name}.parts"

    def part_path(self, group: range) -> Path:
        """File of one finished group."""
        return self.parts_folder / f"{group.start:06d}-{group.stop:06d}.parquet"

    def run(self, task: Task, scenario_ids: Sequence[str], *, jobs: int, title: str, show_progress: bool) -> Evaluation:
        """Do what is missing, join it, write and return the result; only read it if it is there.

        Args:
            task: works on a group (a range of positions in `scenario_ids`) and calls `write_part`.
            scenario_ids: all scenarios of the evaluation.
            jobs: processes.
            title: beside the progress bar.
            show_progress: whether there is one.
        """
        positions = range(len(scenario_ids))
        groups = [positions[i : i + SCENARIOS_PER_GROUP] for i in range(0, len(positions), SCENARIOS_PER_GROUP)]
        finished = self._read_finished(scenario_ids)
        if finished is None:
            self._fill(task, groups, jobs=jobs, title=title, show_progress=show_progress)
            parts = [self._read_part(group) for group in groups]
            whole = [part for part in parts if part is not None]
            if len(whole) < len(parts):
                raise DataError(
                    f"{self.parts_folder}: parts vanished meanwhile (another process with the same name?): run again."
                )
            finished = join_evaluations(self.name, self.provenance, whole)
            finished.write(self.result_path)
        shutil.rmtree(self.parts_folder, ignore_errors=True)
        return finished

    def write_part(self, group: range, outcomes: Sequence[dict[str, object] | Skipped]) -> None:
        """Write a finished group: rows of `SCHEMA` and scenarios without scores."""
        rows = [outcome for outcome in outcomes if not isinstance(outcome, Skipped)]
        skipped = tuple(outcome for outcome in outcomes if isinstance(outcome, Skipped))
        table = pa.Table.from_pylist(rows, schema=SCHEMA)
        Evaluation(self.name, self.provenance, table, skipped).write(self.part_path(group))

    def _read_finished(self, scenario_ids: Sequence[str]) -> Evaluation | None:
        """The result of an earlier call with the same arguments, if there is one."""
        found = self._read(self.result_path, "it will be replaced")
        if found is None:
            return None
        return found if {*found.scenario_ids, *(s.scenario_id for s in found.skipped)} == set(scenario_ids) else None

    def _read_part(self, group: range) -> Evaluation | None:
        """What an earlier call left of a group; None if there is nothing usable."""
        return self._read(self.part_path(group), "discarded")

    def _read(self, path: Path, fate: str) -> Evaluation | None:
        if not path.exists():
            return None
        try:
            found = Evaluation.read(path)
        except DataError as error:
            say(f"{error} Doing so.")
            return None
        other = found.provenance.differences(self.provenance)
        if other:
            say(f"{path} is of another {', '.join(other)}: {fate}.")
        return None if other else found

    def _fill(self, task: Task, groups: list[range], *, jobs: int, title: str, show_progress: bool) -> None:
        """Work on the groups whose part is missing."""
        missing = [group for group in groups if self._read_part(group) is None]
        total = sum(len(group) for group in groups)
        done = total - sum(len(group) for group in missing)
        with progress_bar(title, total, done, show=show_progress) as advance, one_thread():
            run_tasks(task, missing, jobs=jobs, advance=advance)

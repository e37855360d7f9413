"""Row of an experiment: a model specification, evaluated for each seed, and compared with further rows."""

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
import pyarrow as pa
from jaxtyping import Float

from rlftsim.errors import DataError
from rlftsim.evaluation.compare import compare
from rlftsim.evaluation.results import SCHEMA, SCORE_COLUMNS, Evaluation
from rlftsim.statistics import mean_interval

RMM = "meta_metric"


@dataclass(frozen=True, eq=False)
class Row:
    """Evaluations of a model specification on the same scenarios, in the order of the seeds."""

    name: str
    by_seed: tuple[Evaluation, ...]

    @cached_property
    def mean(self) -> Evaluation:
        """Each scenario's mean over the seeds."""
        return mean_of_seeds(self.name, self.by_seed)

    def against(self, reference: "Row", column: str = RMM, *, alpha: float = 0.05) -> str:
        """Verdict of a paired t-test in a line, such as "tuned against base, 40 scenarios in both: difference, ...".

        Args:
            reference: Row to compare with, such as the base model; the difference is this row minus the reference.
            column: Name of the score to compare, a column of `Evaluation`.
            alpha: Level of the test: the chance of a difference where there is none.
        """
        comparison = compare(reference.mean, self.mean, alpha=alpha)
        return f"{self.name} against {reference.name}, {comparison.pairing}: {comparison[column].verdict}"

    def gains_over(self, reference: "Row", column: str = RMM) -> Float[np.ndarray, "seeds"]:
        """Difference of the means to a reference row, for each seed of this row.

        Args:
            reference: Row to compare with; the reference's seeds are averaged.
            column: Name of the score to compare, a column of `Evaluation`.
        """
        level = reference.mean.mean_and_error(column).mean
        return np.array([evaluation.mean_and_error(column).mean - level for evaluation in self.by_seed])

    def seeds_against(self, reference: "Row") -> str:
        """Gain in RMM of every seed in a line, with a 95 % interval over the seeds where there are several.

        The interval does not answer the question of a paired t-test over scenarios, but tells the gain that a
        further run would have.
        """
        gains = self.gains_over(reference)
        line = f"{self.name} minus {reference.name}, RMM by seed: {', '.join(f'{gain:+.4f}' for gain in gains)}"
        if len(gains) == 1:
            return f"{line}; a single seed says nothing about others."
        # Student's t over seeds: with two or three of them the interval is wide, as it should be.
        mean = mean_interval(gains)
        low, high = mean.interval
        return f"{line}; mean {mean.mean:+.4f}, 95% interval over seeds [{low:+.4f}, {high:+.4f}]."


def mean_of_seeds(
    name: str, evaluations: Sequence[Evaluation], *, weights: Sequence[float] | None = None
) -> Evaluation:
    """Evaluation with mean scores over evaluations of the same scenarios, scenario by scenario.

    Args:
        name: Name of the mean in tables and messages.
        evaluations: Evaluations of the same scenarios, in the order of the seeds.
        weights: Weight of each evaluation in the mean, with a sum of 1; None = equal weights.

    Raises:
        DataError: The evaluations are of different scenarios.
    """
    first = evaluations[0]
    if any(evaluation.scenario_ids != first.scenario_ids for evaluation in evaluations):
        raise DataError(f"{name}: the evaluations of its seeds are of different scenarios: remove them to start anew.")
    # Ids and numbers of agents are the same for all seeds; only scores are averaged. NaN in one seed stays NaN.
    table = first.table
    for column in SCORE_COLUMNS:
        scores = [evaluation.values(column) for evaluation in evaluations]
        mean = np.average(scores, axis=0, weights=weights)  # [scenarios]
        table = table.set_column(table.schema.get_field_index(column), SCHEMA.field(column), pa.array(mean))
    return Evaluation(name, first.provenance, table, first.skipped)

"""`rs.compare` and `rlftsim compare`: results, scenario by scenario."""

import os
from typing import overload

from rlftsim.evaluation.compare import Comparison, format_comparison
from rlftsim.evaluation.compare import compare as compare_evaluations
from rlftsim.evaluation.drive_results import (
    DriveComparison,
    DriveResult,
    compare_drives,
    format_drive_comparison,
    is_drive_result,
)
from rlftsim.evaluation.results import Evaluation
from rlftsim.jobs.progress import print_wide
from rlftsim.verbs.arguments import Result, Results
from rlftsim.verbs.inputs import read_result, with_checked_arguments


@with_checked_arguments
@overload
def compare(a: Result, b: Result, *, alpha: float = ...) -> Comparison | DriveComparison: ...
@overload
def compare(
    a: Result, b: Result, others: Results, *, alpha: float = ...
) -> Comparison | DriveComparison | list[Comparison | DriveComparison]: ...
def compare(
    a: Result, b: Result, others: Results = (), *, alpha: float = 0.05
) -> Comparison | DriveComparison | list[Comparison | DriveComparison]:
    """Compare evaluations scenario by scenario: mean differences with 95 % intervals and a verdict.

    Differences are b minus a; further evaluations are each compared with a, too.

    Args:
        a: Reference, such as the base model: a result of `evaluate`, or a parquet file that `rlftsim evaluate` or
            `rlftsim drive` wrote.
        b: Another one on the same scenarios, such as that of the fine-tuned model.
        others: Any further ones, each for a comparison with the reference.
        alpha: Significance level: probability of calling a difference that is none.

    Returns:
        The comparison; with further evaluations a list, each with the reference.

    Raises:
        ConfigError: Alpha is no probability, or something else than an evaluation.
        DataError: Another metric or number of rollouts, no scenario in common, or no such file.
    """
    results = (a, b, *others)
    # or: of several, the one that is damaged is to be named
    if any(isinstance(result, str | os.PathLike) and is_drive_result(result) for result in results):
        reference, *drives = (read_result(result, DriveResult) for result in results)
        comparisons: list[Comparison | DriveComparison] = [compare_drives(reference, d, alpha=alpha) for d in drives]
    else:
        reference, *evaluations = (read_result(result, Evaluation) for result in results)
        comparisons = [compare_evaluations(reference, other, alpha=alpha) for other in evaluations]
    return comparisons if others else comparisons[0]


def print_comparison(comparison: Comparison | DriveComparison | list[Comparison | DriveComparison]) -> None:
    """Print the means of both results, and their differences.

    Args:
        comparison: Both results with their differences, or several pairs.
    """
    comparisons = comparison if isinstance(comparison, list) else [comparison]
    print_wide(
        *(format_drive_comparison(c) if isinstance(c, DriveComparison) else format_comparison(c) for c in comparisons)
    )

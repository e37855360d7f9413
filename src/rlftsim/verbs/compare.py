"""`rs.compare` and `rlftsim compare`: two results, scenario by scenario."""

import os
from typing import Any

from rlftsim.errors import ConfigError
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
from rlftsim.verbs.arguments import Result


def compare(a: Result, b: Result, *, alpha: float = 0.05) -> Comparison | DriveComparison:
    """Compare two evaluations scenario by scenario: mean differences with 95 % intervals and a verdict.

    Differences are b minus a.

    Args:
        a: Reference, such as the base model: a result of `evaluate`, or a parquet file that `rlftsim evaluate` or
            `rlftsim drive` wrote.
        b: Another one on the same scenarios, such as that of the fine-tuned model.
        alpha: Significance level: probability of calling a difference that is none.

    Raises:
        ConfigError: Alpha is no probability, or something else than an evaluation.
        DataError: Another metric or number of rollouts, no scenario in common, or no such file.
    """
    # or: of two, the one that is damaged is to be named
    if any(isinstance(side, str | os.PathLike) and is_drive_result(side) for side in (a, b)):
        return compare_drives(_read(a, DriveResult), _read(b, DriveResult), alpha=alpha)
    return compare_evaluations(_read(a, Evaluation), _read(b, Evaluation), alpha=alpha)


def _read(result: Any, result_type: Any) -> Any:
    """A result of a type as it is, or read from its file."""
    if isinstance(result, str | os.PathLike):
        return result_type.read(result)
    if not isinstance(result, result_type):
        raise ConfigError(f"{type(result).__name__}: not an evaluation: hand over one of rs.evaluate, or its file.")
    return result


def print_comparison(comparison: Comparison | DriveComparison) -> None:
    """Print the means of both results, and their differences.

    Args:
        comparison: Both results with their differences.
    """
    is_drive = isinstance(comparison, DriveComparison)
    print_wide(format_drive_comparison(comparison) if is_drive else format_comparison(comparison))

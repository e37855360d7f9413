"""A calibration as a table: weight and gain of each feature, and the changes on the scenarios held back."""

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

from rlftsim.errors import CheckpointError
from rlftsim.jobs.documents import read_json

CHANGES = {
    "rmm": ("RMM", "+.4f"),
    "kinematic": ("kinematic", "+.4f"),
    "interactive": ("interactive", "+.4f"),
    "map_based": ("map-based", "+.4f"),
    "min_ade": ("minADE (m)", "+.3f"),
    "speed": ("speed (m/s)", "+.3f"),
    "evaluated_speed": ("of evaluated agents (m/s)", "+.3f"),
}
"""Heading and format of each change that is shown."""


def read_calibration(path: Path) -> dict[str, Any]:
    """Values of a calibration.json.

    Raises:
        FileNotFoundError: No such file.
        CheckpointError: Damaged file, or values that are no calibration.
    """
    calibration = read_json(path, "remove it", error=CheckpointError)
    try:
        calibration_table(calibration)
    except (KeyError, TypeError, ValueError, AttributeError):
        raise CheckpointError(f"{path}: no calibration of this version: remove it.") from None
    return calibration


def calibration_table(calibration: Mapping[str, Any]) -> str:
    """Markdown of a calibration.

    Args:
        calibration: Values of calibration.json, as `training.calibrate` writes these.
    """
    num_fitted, num_held_back = calibration["num_scenarios"]
    scores = ("rmm", "kinematic", "interactive", "map_based")
    features = [
        [row["feature"], f"{row['eta']:+.3f}", f"{row['t']:+.1f}", *(f"{row[name]:+.4f}" for name in scores)]
        for row in sorted(calibration["features"], key=lambda row: -row["rmm"])
    ]
    lengths = [
        [f"{row['length']:g}", f"{row['kl']:.4f}", *(_with_t(row[name], style) for name, (_, style) in CHANGES.items())]
        for row in calibration["held_back"]
    ]
    return f"""## Calibration

What a feature earns in RMM, and of that in which sub-score, is predicted to first order on {num_fitted} scenarios with
{calibration["num_rollouts"]} rollouts each; t is that of its gradient over scenarios.
Kept as they are, by prediction: {", ".join(calibration["constraints"]) or "nothing"}.

{_markdown(("feature", "eta", "t", "RMM", "kinematic", "interactive", "map-based"), features)}

Measured on {num_held_back} scenarios that were held back, with t in parentheses. The length taken is
{calibration["length"]:.2f}.

{_markdown(("length", "KL", *(heading for heading, _ in CHANGES.values())), lengths)}
"""


def _with_t(change: Mapping[str, float], style: str) -> str:
    return f"{change['change']:{style}} ({change['t']:+.1f})"


def _markdown(headings: Sequence[str], rows: Sequence[Sequence[str]]) -> str:
    rule = ["---", *["--:"] * (len(headings) - 1)]
    return "\n".join(f"| {' | '.join(cells)} |" for cells in (headings, rule, *rows))

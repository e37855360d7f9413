"""The appendix's paired t-test: every reward against every other, scenario by scenario."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Int

from rlftsim.evaluation.compare import PairedDifference, compare
from rlftsim.experiments.paper import published, reward_ablation
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.rows import RMM, Row
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import TextTable
from rlftsim.viewer.figure import draw_verdicts

ALPHA = 1e-3
SIGNS = {1: "+", -1: "−", 0: "~"}


def differences(rows: Sequence[Row]) -> list[list[PairedDifference]]:
    """Row minus column of the per-scenario RMM; the diagonal compares a row with itself."""
    return [[compare(column.mean, row.mean, alpha=ALPHA)[RMM] for column in rows] for row in rows]


def verdict_of(difference: PairedDifference) -> int:
    """1 = significantly better, -1 = worse, 0 = no difference."""
    return int(np.sign(difference.difference)) if difference.is_difference else 0


def summarize(measured: Mapping[str, Row], suite: ExperimentSuite) -> ExperimentResult:
    """The matrix of verdicts, as a table and as a figure; the best reward first.

    Args:
        measured: rows of the reward ablation, in any order.
        suite: for the notes.
    """
    rows = sorted(measured.values(), key=lambda row: -row.mean.mean_and_error(RMM).mean)
    # Best first, so that a perfect order has + above the diagonal and − below it.
    names, compared, count = [row.name for row in rows], differences(rows), len(rows[0].mean)
    verdicts: Int[np.ndarray, "n n"] = np.array([[verdict_of(d) for d in line] for line in compared])
    signs = [["" if i == j else SIGNS[int(v)] for j, v in enumerate(line)] for i, line in enumerate(verdicts)]
    cells = tuple((name, *line) for name, line in zip(names, signs))
    note = (
        f"Per-scenario RMM of {count} scenarios, two-sided paired t-test at {ALPHA:g}; + the row is better than the "
        "column, − worse, ~ no difference."
    )
    # Each pair once, the better row first.
    pairs = [(i, j) for i in range(len(names)) for j in range(i + 1, len(names))]
    return ExperimentResult(
        title="Paired t-test: every reward against every other",
        tables=(TextTable("Ours", ("", *names), cells, note), published.T_TEST),
        verdicts=tuple(f"{names[i]} against {names[j]}: {compared[i][j].verdict}" for i, j in pairs),
        notes=(
            suite.budget.note,
            "The test takes the trained models as given: it says which is better on scenarios like these, not which "
            "reward would win in another run.",
            *(("With several seeds a scenario counts with its mean over them.",) if suite.num_seeds > 1 else ()),
        ),
        numbers={
            "alpha": ALPHA,
            "names": names,
            "verdicts": verdicts.tolist(),
            "p_values": [[d.p_value for d in line] for line in compared],
            "differences": [[d.difference for d in line] for line in compared],
        },
        figure=draw_verdicts(
            names,
            verdicts,
            title="Row against column, per-scenario RMM",
            note=f"+ better, − worse, ~ no difference at {ALPHA:g} ({count} scenarios)",
        ),
    )


EXPERIMENT = Experiment(
    "Which rewards differ, when every scenario is compared with itself?", reward_ablation.run, summarize
)

"""The appendix's paired t-test: every reward against every other, scenario by scenario."""

from collections.abc import Mapping

import numpy as np
from jaxtyping import Int

from rlftsim.evaluation.compare import compare
from rlftsim.experiments.paper import reward_ablation
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import RMM, Row, TextTable, load_published

ALPHA = 1e-3
SIGNS = {1: "+", -1: "−", 0: "~"}
"""Signs of the row being significantly better than the column, worse, or not different."""


def summarize(measured: Mapping[str, Row], suite: ExperimentSuite) -> ExperimentResult:
    """The matrix of verdicts as a table, the best reward first.

    Args:
        measured: Rows of the reward ablation by name, in any order.
        suite: Suite with budget and seeds for the notes; no model is trained or evaluated here.
    """
    # Best first, so that a perfect order has + above the diagonal and − below it.
    rows = sorted(measured.values(), key=lambda row: -row.mean.mean_and_error(RMM).mean)
    names, count = [row.name for row in rows], len(rows[0].mean)
    # Row minus column; the diagonal compares a row with itself.
    gains = [[compare(column.mean, row.mean, alpha=ALPHA)[RMM] for column in rows] for row in rows]
    verdicts: Int[np.ndarray, "n n"] = np.array(
        [[int(np.sign(gain.difference)) if gain.is_difference else 0 for gain in line] for line in gains]
    )
    cells = tuple(
        (name, *("" if i == j else SIGNS[int(verdict)] for j, verdict in enumerate(verdicts[i])))
        for i, name in enumerate(names)
    )
    note = (
        f"Per-scenario RMM of {count} scenarios, two-sided paired t-test at {ALPHA:g}; + the row is better than the "
        "column, − worse, ~ no difference."
    )
    # Each pair once, the better row first.
    pairs = [(i, j) for i in range(len(names)) for j in range(i + 1, len(names))]
    return ExperimentResult(
        title="Paired t-test: every reward against every other",
        tables=(TextTable("Ours", ("", *names), cells, note), load_published("paired-ttest")),
        verdicts=tuple(f"{names[i]} against {names[j]}: {gains[i][j].verdict}" for i, j in pairs),
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
            "p_values": [[gain.p_value for gain in line] for line in gains],
            "differences": [[gain.difference for gain in line] for line in gains],
        },
    )


EXPERIMENT = Experiment(
    "Which rewards differ, when every scenario is compared with itself?", reward_ablation.run, summarize
)

"""The appendix's paired t-test: every reward against every other, scenario by scenario."""

from collections.abc import Mapping, Sequence

import numpy as np
from jaxtyping import Int

from rlftsim.experiments.catalogue import published, reward_ablation
from rlftsim.experiments.compare import PairedDifference, compare
from rlftsim.experiments.findings import Experiment, Findings, TextTable, budget_note
from rlftsim.experiments.workshop import Row, Workshop
from rlftsim.viewer.figure import draw_verdicts

ALPHA = 1e-3
SIGNS = {1: "+", -1: "−", 0: "~"}


def differences(rows: Sequence[Row]) -> list[list[PairedDifference]]:
    """Row minus column of the per-scenario RMM; the diagonal compares a row with itself."""
    return [[compare(column.mean, row.mean, alpha=ALPHA)["meta_metric"] for column in rows] for row in rows]


def verdict_of(difference: PairedDifference) -> int:
    """1 = significantly better, -1 = worse, 0 = no difference."""
    return int(np.sign(difference.difference)) if difference.is_difference else 0


def conclude(measured: Mapping[str, Row], workshop: Workshop) -> Findings:
    """The matrix and its picture."""
    rows = sorted(measured.values(), key=lambda row: -row.mean.mean_and_error("meta_metric").mean)
    names, compared = [row.name for row in rows], differences(rows)
    verdicts: Int[np.ndarray, "n n"] = np.array([[verdict_of(d) for d in line] for line in compared])
    cells = tuple(
        (name, *("" if i == j else SIGNS[int(verdicts[i, j])] for j in range(len(names))))
        for i, name in enumerate(names)
    )
    first = rows[0].mean
    note = f"Per-scenario RMM of {len(first)} scenarios, two-sided paired t-test at {ALPHA:g}; + the row is better than the column, − worse, ~ no difference."
    pairs = [(i, j) for i in range(len(names)) for j in range(i + 1, len(names))]
    return Findings(
        title="Paired t-test: every reward against every other",
        tables=(TextTable("Ours", ("", *names), cells, note), published.T_TEST),
        verdicts=tuple(f"{names[i]} against {names[j]}: {compared[i][j].verdict}" for i, j in pairs),
        notes=(
            budget_note(workshop),
            "The test takes the trained models as given: it says which is better on scenarios like these, not which reward would "
            "win in another run.",
            *(("With several seeds a scenario counts with its mean over them.",) if workshop.num_seeds > 1 else ()),
        ),
        numbers={
            "alpha": ALPHA,
            "names": names,
            "verdicts": verdicts.tolist(),
            "p_values": [[d.p_value for d in line] for line in compared],
            "differences": [[d.difference for d in line] for line in compared],
        },
        figure=draw_verdicts(names, verdicts, title="Row against column, per-scenario RMM", note=f"+ better, − worse, ~ no difference at {ALPHA:g} ({len(first)} scenarios)"),
    )  # fmt: skip


EXPERIMENT = Experiment(
    question="Which rewards differ, when every scenario is compared with itself?",
    measure=reward_ablation.measure,
    conclude=conclude,
)

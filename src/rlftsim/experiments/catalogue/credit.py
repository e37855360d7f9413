"""Whom a reward is owed to: the plain leave-one-out reward beside one that is split over agents."""

from collections.abc import Mapping

from rlftsim.experiments.catalogue.reward_ablation import REFERENCE, REWARDS
from rlftsim.experiments.columns import COLUMNS
from rlftsim.experiments.contestants import BASE, over_seeds
from rlftsim.experiments.findings import (
    Experiment,
    Findings,
    budget_note,
    draw_gains,
    result_table,
    row_numbers,
    seeds_line,
    verdict_line,
)
from rlftsim.experiments.workshop import Row, Workshop

COMPARED = ("MLOO", "MLOO, credit by agent")


def measure(workshop: Workshop) -> dict[str, Row]:
    """The base model, and MLOO with either credit."""
    tuned = {name: over_seeds(REWARDS[name], workshop.num_seeds) for name in COMPARED}
    return workshop.measure({REFERENCE: (BASE,), **tuned})


def conclude(measured: Mapping[str, Row], workshop: Workshop) -> Findings:
    """The table and whether the split helps."""
    base, plain, split = measured.values()
    return Findings(
        title="Credit: MLOO owed to rollouts, and to agents",
        tables=(result_table("Ours", list(measured.values()), COLUMNS),),
        verdicts=(
            verdict_line(plain, split),
            verdict_line(base, plain),
            verdict_line(base, split),
            seeds_line(base, plain),
            seeds_line(base, split),
        ),
        notes=(budget_note(workshop), "The paper gives every decision of a rollout the same reward; it has no number for the other."),
        numbers={"rows": row_numbers(list(measured.values()), COLUMNS)},
        figure=draw_gains(base, [plain, split]),
    )  # fmt: skip


EXPERIMENT = Experiment(
    question="Does it help to give every agent its own share of the leave-one-out reward?",
    measure=measure,
    conclude=conclude,
    default_seeds=3,
)

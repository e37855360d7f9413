"""Table 2 and the table of heuristic rewards: the same budget spent on different rewards."""

from collections.abc import Mapping

from rlftsim.experiments.catalogue import published
from rlftsim.experiments.columns import COLUMNS
from rlftsim.experiments.contestants import BASE, Contestant, FineTuned, over_seeds
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

REFERENCE, MLOO = "base", "MLOO"
REWARDS = {
    MLOO: FineTuned("mloo"),
    "MLOO, credit by agent": FineTuned("mloo", credit="agent"),
    "RLOO": FineTuned("rloo"),
    "minADE, RLOO": FineTuned("minade_rloo"),
    "collision + off-road + ADE": FineTuned("collision_offroad_ade"),
    "collision + off-road": FineTuned("collision_offroad"),
}
"""Rows, in the order of the tables."""


def rows(num_seeds: int) -> dict[str, tuple[Contestant, ...]]:
    """The base model and what each reward makes of it."""
    return {REFERENCE: (BASE,), **{name: over_seeds(one, num_seeds) for name, one in REWARDS.items()}}


def measure(workshop: Workshop) -> dict[str, Row]:
    """Everybody's evaluations."""
    return workshop.measure(rows(workshop.num_seeds))


def conclude(measured: Mapping[str, Row], workshop: Workshop) -> Findings:
    """The table, every reward against the base model, and MLOO against every other."""
    base, mloo, *others = measured.values()
    tuned = [mloo, *others]
    return Findings(
        title="Rewards: what the same budget of fine-tuning does with each",
        tables=(result_table("Ours", list(measured.values()), COLUMNS), published.REWARDS, published.HEURISTICS),
        verdicts=(
            *(verdict_line(base, row) for row in tuned),
            *(verdict_line(row, mloo) for row in others),
            *(seeds_line(base, row) for row in tuned if len(row.by_seed) > 1),
        ),
        notes=(
            budget_note(workshop),
            "A miss: an evaluated agent ends further from the log's end than WOMD tolerates.",
        ),
        numbers={"rows": row_numbers(list(measured.values()), COLUMNS)},
        figure=draw_gains(base, tuned),
    )


EXPERIMENT = Experiment(
    question="Which reward makes the simulation more realistic, and what does it do to collisions, off-road driving and displacement?",
    measure=measure,
    conclude=conclude,
)

"""Table 2 and the table of heuristic rewards: the same budget spent on different rewards."""

from collections.abc import Mapping

import numpy as np

from rlftsim.experiments.catalogue import published
from rlftsim.experiments.columns import COLUMNS
from rlftsim.experiments.contestants import BASE, Contestant, FineTuned, over_seeds
from rlftsim.experiments.findings import (
    Experiment,
    Findings,
    TextTable,
    budget_note,
    draw_gains,
    result_table,
    row_numbers,
    seeds_line,
    verdict_line,
)
from rlftsim.experiments.workshop import Row, Workshop
from rlftsim.training.run_folder import read_metrics

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
TRAVELLED = {
    "kl": "KL to the base model [nats a decision]",
    "entropy": "entropy [nats]",
    "diversity_m": "spread of rollouts [m]",
    "speed_gap_mps": "speed minus the log's [m/s]",
    "reward_std": "std of the reward",
}
"""Headings, by what a run logs."""
END_SHARE = 5


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
    travelled = _travelled(workshop)
    return Findings(
        title="Rewards: what the same budget of fine-tuning does with each",
        tables=(
            result_table("Ours", list(measured.values()), COLUMNS),
            *((travelled,) if travelled.rows else ()),
            published.REWARDS,
            published.HEURISTICS,
        ),
        verdicts=(
            *(verdict_line(base, row) for row in tuned),
            *(verdict_line(row, mloo) for row in others),
            *(seeds_line(base, row) for row in tuned if len(row.by_seed) > 1),
        ),
        notes=(
            budget_note(workshop),
            "A miss: an evaluated agent ends further from the log's end than WOMD tolerates.",
            "Equal budgets are not equal distances: rewards differ in size, so they pull with different force against the same KL penalty, and in "
            "a short run its controller does not catch up.",
        ),
        numbers={"rows": row_numbers(list(measured.values()), COLUMNS)},
        figure=draw_gains(base, tuned),
    )


def _travelled(workshop: Workshop) -> TextTable:
    """How far each reward took the model, from the end of its runs; no rows where there are none."""
    rows = []
    for name, contestant in REWARDS.items():
        runs = [workshop.model_folder(one) for one in over_seeds(contestant, workshop.num_seeds)]
        metrics = [read_metrics(run) for run in runs if (run / "metrics.jsonl").exists()]
        ends = [line for lines in metrics for line in lines[-max(len(lines) // END_SHARE, 1) :]]
        if ends:
            means = (f"{np.mean([line[what] for line in ends]):.3g}" for what in TRAVELLED)
            rows.append((name, *means))
    note = f"Means over the last {100 // END_SHARE} % of the updates; training rollouts."
    return TextTable("How far each went", ("", *TRAVELLED.values()), tuple(rows), note)


EXPERIMENT = Experiment(
    question="Which reward makes the simulation more realistic, and what does it do to collisions, off-road driving and displacement?",
    measure=measure,
    conclude=conclude,
)

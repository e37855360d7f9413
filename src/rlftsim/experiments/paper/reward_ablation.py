"""Table 2 and the table of heuristic rewards: the same budget spent on different rewards."""

from collections.abc import Mapping, Sequence

import numpy as np

from rlftsim.evaluation.columns import COLUMNS
from rlftsim.experiments.model_specs import BASE, FineTuned, over_seeds
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import Row, TextTable, build_table, draw_gains, load_published, to_numbers
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
DISTANCES = {
    "kl": "KL to the base model [nats a decision]",
    "entropy": "entropy [nats]",
    "diversity_m": "spread of rollouts [m]",
    "speed_gap_mps": "speed minus the log's [m/s]",
    "reward_std": "std of the reward",
}
"""Headings, by metric of a run."""
FINAL_PERCENT = 20
"""Percentage of a run's updates, the last ones, that metrics are averaged over."""


def run(suite: ExperimentSuite) -> dict[str, Row]:
    """Rows of the base model and of a fine-tuning with each reward."""
    tuned = {name: over_seeds(spec, suite.num_seeds) for name, spec in REWARDS.items()}
    return suite.evaluate({REFERENCE: (BASE,), **tuned})


def summarize(rows: Mapping[str, Row], suite: ExperimentSuite) -> ExperimentResult:
    """The table, every reward against the base model, and MLOO against every other."""
    base, *tuned = rows.values()  # in the order of `run`
    mloo, *alternatives = tuned
    distances = _tabulate_distances(suite)
    return ExperimentResult(
        title="Rewards: the same budget of fine-tuning with each of them",
        tables=(
            build_table("Ours", rows.values(), COLUMNS),
            *((distances,) if distances.rows else ()),
            load_published("rewards"),
            load_published("heuristics"),
        ),
        verdicts=(
            *(row.against(base) for row in tuned),
            *(mloo.against(row) for row in alternatives),
            *(row.seeds_against(base) for row in tuned if len(row.by_seed) > 1),
        ),
        notes=(
            suite.budget.note,
            "A miss: an evaluated agent ends further from its logged endpoint than WOMD tolerates.",
            "Equal budgets are not equal distances: rewards differ in size, so they pull with different force "
            "against the same KL penalty, and in a short run its controller does not catch up.",
        ),
        numbers={"rows": to_numbers(rows.values(), COLUMNS)},
        figure=draw_gains(base, tuned),
    )


def _tabulate_distances(suite: ExperimentSuite) -> TextTable:
    """Distance of each fine-tuned model from the base model at the end of its runs; no rows where there are no runs."""
    means = {name: mean_at_end(suite, over_seeds(spec, suite.num_seeds)) for name, spec in REWARDS.items()}
    rows = [(name, *(f"{mean[metric]:.3g}" for metric in DISTANCES)) for name, mean in means.items() if mean]
    note = f"Means over the last {FINAL_PERCENT} % of the updates; training rollouts."
    return TextTable("Distance from the base model", ("", *DISTANCES.values()), tuple(rows), note)


def mean_at_end(suite: ExperimentSuite, specs: Sequence[FineTuned]) -> dict[str, float]:
    """Mean of each of `DISTANCES` over the last updates of runs; empty where there are no runs.

    Args:
        suite: Suite with the folder of the runs; no model is trained here.
        specs: Specifications of a fine-tuning, a seed each; runs without metrics are left out.
    """
    runs = [suite.model_folder(spec) for spec in specs]
    metrics = [read_metrics(run) for run in runs if (run / "metrics.jsonl").exists()]
    # At least the last update of every run.
    updates = [line for lines in metrics for line in lines[-max(len(lines) * FINAL_PERCENT // 100, 1) :]]
    return {metric: float(np.mean([line[metric] for line in updates])) for metric in DISTANCES} if updates else {}


EXPERIMENT = Experiment(
    "Which reward makes the simulation more realistic, and what does it do to collisions, off-road driving and "
    "displacement?",
    run,
    summarize,
)

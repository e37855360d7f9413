"""Credit assignment: the leave-one-out reward given to whole rollouts, or split over agents."""

from collections.abc import Mapping

from rlftsim.evaluation.columns import COLUMNS
from rlftsim.experiments.paper import reward_ablation
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import Row, build_table, draw_gains, to_numbers

COMPARED = ("MLOO", "MLOO, credit by agent")


def run(suite: ExperimentSuite) -> dict[str, Row]:
    """Rows of the base model, and of MLOO with either credit assignment."""
    return reward_ablation.evaluate_rewards(suite, COMPARED)


def summarize(rows: Mapping[str, Row], suite: ExperimentSuite) -> ExperimentResult:
    """The table, and a verdict on the split."""
    base, plain, split = rows.values()  # in the order of `run`
    return ExperimentResult(
        title="Credit assignment: MLOO for whole rollouts, and for each agent",
        tables=(build_table("Ours", rows.values(), COLUMNS),),
        verdicts=(
            *(split.against(plain), plain.against(base), split.against(base)),
            *(plain.seeds_against(base), split.seeds_against(base)),
        ),
        notes=(
            suite.budget.note,
            "The paper gives every decision of a rollout the same reward; it has no number for the other.",
        ),
        numbers={"rows": to_numbers(rows.values(), COLUMNS)},
        figure=draw_gains(base, [plain, split]),
    )


EXPERIMENT = Experiment(
    "Does it help to give each agent its own leave-one-out reward?", run, summarize, default_seeds=3
)

"""Table 3: encodings of goals and goal rewards, against the goals that agents miss and the realism that this costs."""

from collections.abc import Mapping
from dataclasses import dataclass

from rlftsim.evaluation.columns import GOAL_COLUMNS
from rlftsim.experiments.model_specs import GCFT, GCSL, FineTuned, GoalRewardType, GoalTraining, Guided, over_seeds
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import RMM, Row, build_table, load_published, to_numbers
from rlftsim.viewer.figure import Interval, draw_intervals

MISS = "passing_miss_rate"
START = "goal-free"
GOAL_FREE = FineTuned("mloo")
"""The realism-aligned model that goal conditioning starts from."""
ENCODINGS = {"concatenation": "concat", "indication": "indication"}
REWARD_TYPES: tuple[GoalRewardType, ...] = ("soft", "hard")
GOAL_WEIGHT = 0.02
"""Lambda. The paper's is 0.1, for agents that learn from the reward what a goal is. These have learned it
before, and at 0.1 small models pay for passing more goals in collisions (docs/log.md)."""
RELABELLED = {
    f"{name}, relabelled": FineTuned(GCSL, base=GOAL_FREE, goals=GoalTraining(encoding))
    for name, encoding in ENCODINGS.items()
}
"""The goal-free model after imitating its own rollouts, relabelled with their endpoints as goals. Not rewarded yet."""
VARIANTS = {
    f"{name}, {reward_type}": FineTuned(
        GCFT,
        credit="agent",
        base=RELABELLED[f"{name}, relabelled"],
        goals=GoalTraining(encoding, reward_type, GOAL_WEIGHT),
    )
    for name, encoding in ENCODINGS.items()
    for reward_type in REWARD_TYPES
}
GUIDANCE_SCALE = 2.0
"""Of the goal logit bias. Small models have not learned a bias as strong as it might be (docs/log.md)."""
GUIDED = {f"{name}, guided": Guided(spec, GUIDANCE_SCALE) for name, spec in VARIANTS.items()}
"""The same models, not trained any further."""


@dataclass(frozen=True)
class GoalRows:
    """Rows of the goal-free model, and by name of the goal-conditioned models."""

    start: Row
    relabelled: Mapping[str, Row]
    """Evaluated with logged endpoints as goals, as are the variants and the guided variants."""
    variants: Mapping[str, Row]
    guided: Mapping[str, Row]
    without_goals: Mapping[str, Row]
    """The variants, evaluated without goals."""


def run(suite: ExperimentSuite) -> GoalRows:
    """Rows of all models. Of the goal-free and the relabelled models only seed 0 is trained, where the
    further trainings start."""
    variants = {name: over_seeds(spec, suite.num_seeds) for name, spec in VARIANTS.items()}
    # The guided models of all seeds, not only those of seed 0 that `GUIDED` has.
    guided = {
        f"{name}, guided": tuple(Guided(spec, GUIDANCE_SCALE) for spec in specs) for name, specs in variants.items()
    }
    return GoalRows(
        start=suite.evaluate({START: (GOAL_FREE,)})[START],
        relabelled=suite.evaluate({name: (spec,) for name, spec in RELABELLED.items()}, goals="logged"),
        variants=suite.evaluate(variants, goals="logged"),
        guided=suite.evaluate(guided, goals="logged"),
        without_goals=suite.evaluate(variants),
    )


def summarize(rows: GoalRows, suite: ExperimentSuite) -> ExperimentResult:
    """The table, the cost of following goals, and the realism that is left without goals.

    Args:
        rows: Rows that `run` returned; all are compared with the goal-free model.
        suite: Suite with the budget for the notes; no model is trained or evaluated here.
    """
    start = rows.start
    conditioned = [*rows.relabelled.values(), *rows.variants.values(), *rows.guided.values()]
    without_goals = [Row(f"{name}, without goals", row.by_seed) for name, row in rows.without_goals.items()]
    intervals = []
    for number, row in enumerate([start, *conditioned]):
        misses = row.mean.mean_and_error(MISS)
        low, high = (100 * v for v in misses.interval)
        intervals.append(Interval(row.name, 100 * misses.mean, low, high, color=0 if number else 4))
    return ExperimentResult(
        title="Goal conditioning: goals that agents miss, and the cost in realism",
        tables=(
            build_table("Ours: goals are the logged endpoints", [start, *conditioned], GOAL_COLUMNS),
            build_table("Ours: the same models without goals", [start, *without_goals], GOAL_COLUMNS),
            load_published("goal-conditioning"),
        ),
        verdicts=(
            *(_format_misses(start, row) for row in conditioned),
            *(f"passing misses: {row.against(start, MISS)}" for row in conditioned),
            *(f"RMM: {row.against(start)}" for row in (*conditioned, *without_goals)),
        ),
        notes=(
            suite.budget.note,
            "All goal-conditioned models also have a goal logit bias, which the paper's do not. Relabelled: the "
            "goal-free model after imitating its own rollouts with their endpoints as goals; without goals it "
            "decides as before. The variants start from these rows and have had the fine-tuning of the goal-free one "
            "again; what more goal-free fine-tuning does is in finetune-curve. Guided: the same models with their "
            f"goal logit bias scaled by {GUIDANCE_SCALE:g}; without goals they are the variants.",
            "A passing miss: an evaluated agent that at no simulated step is within WOMD's tolerance of its logged "
            "endpoint; percentage of agents and rollouts. In all rollouts: percentage of agents that miss in every "
            "one of them.",
        ),
        numbers={"rows": to_numbers([start, *conditioned, *without_goals], GOAL_COLUMNS)},
        figure=draw_intervals(
            intervals,
            title="Agents that never pass their goal",
            x_label="passing misses [%], mean over scenarios, 95 % interval",
            zero=False,
        ),
    )


def _format_misses(start: Row, row: Row) -> str:
    start_rate, rate = (evaluation.mean_and_error(MISS).mean for evaluation in (start.mean, row.mean))
    # Rates of 0 have no relative change.
    relative = f"{rate / start_rate - 1:+.0%} relative" if start_rate > 0 else "no misses before"
    gain = row.mean.mean_and_error(RMM).mean - start.mean.mean_and_error(RMM).mean
    return f"{row.name}: passing misses {start_rate:.2%} → {rate:.2%}, {relative}, at {gain:+.4f} RMM."


EXPERIMENT = Experiment(
    "Do goal-conditioned agents follow their goals, and what does it cost in realism?", run, summarize, needs_goals=True
)

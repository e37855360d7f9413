"""Table 3: how agents see their goals and what is rewarded, against how far they follow and what that costs in realism."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass

from rlftsim.experiments.catalogue import published
from rlftsim.experiments.columns import GOAL_COLUMNS
from rlftsim.experiments.contestants import (
    GCFT,
    GCSL,
    Contestant,
    FineTuned,
    GoalKind,
    GoalTraining,
    Guided,
    over_seeds,
)
from rlftsim.experiments.findings import Experiment, Findings, budget_note, result_table, row_numbers, verdict_line
from rlftsim.experiments.workshop import Row, Workshop
from rlftsim.policies.smart.config import GoalSight
from rlftsim.viewer.figure import Interval, draw_intervals

MISS = "passing_miss_rate"
GOAL_FREE = FineTuned("mloo")
"""The realism-aligned model that learning to follow goals starts from."""
SIGHTS: Mapping[str, GoalSight] = {"concatenation": "concat", "indication": "indication"}
KINDS: tuple[GoalKind, ...] = ("soft", "hard")
GOAL_WEIGHT = 0.02
"""Lambda. The paper's is 0.1, for agents that learn from the reward what a goal is. These know, and at 0.1 small models pay for passing more
goals in collisions (docs/log.md)."""
TOLD = {f"{name}, told": FineTuned(GCSL, base=GOAL_FREE, goals=GoalTraining(sight)) for name, sight in SIGHTS.items()}
"""Models that know what goals are: the goal-free one, told where its own rollouts led. Nothing was rewarded yet."""
VARIANTS = {
    f"{name}, {kind}": FineTuned(
        GCFT, credit="agent", base=TOLD[f"{name}, told"], goals=GoalTraining(sight, kind, GOAL_WEIGHT)
    )
    for name, sight in SIGHTS.items()
    for kind in KINDS
}
GUIDANCE = 2.0
"""How many times an aim counts. Small models have not learned to aim as firmly as they might (docs/log.md)."""
GUIDED = {f"{name}, guided": Guided(one, GUIDANCE) for name, one in VARIANTS.items()}
"""The same models, not trained any further."""
START = "goal-free"


@dataclass(frozen=True)
class Measured:
    """Evaluations of the model without goals, and of those that were told, of the variants and of these guided, asked to go where the record
    ended; of the variants asked nothing, too."""

    start: Row
    told: Mapping[str, Row]
    asked: Mapping[str, Row]
    guided: Mapping[str, Row]
    unasked: Mapping[str, Row]


def rows(num_seeds: int) -> dict[str, tuple[Contestant, ...]]:
    """The four variants."""
    return {name: over_seeds(one, num_seeds) for name, one in VARIANTS.items()}


def guided_rows(num_seeds: int) -> dict[str, tuple[Contestant, ...]]:
    """The four variants, guided."""
    return {
        name: tuple(Guided(one, guided.times) for one in over_seeds(guided.of, num_seeds))
        for name, guided in GUIDED.items()
    }


def measure(workshop: Workshop) -> Measured:
    """Everybody's evaluations."""
    start = workshop.measure({START: (GOAL_FREE,)})[START]
    variants = rows(workshop.num_seeds)
    told = workshop.measure({name: (one,) for name, one in TOLD.items()}, goals="recorded")
    asked = workshop.measure(variants, goals="recorded")
    guided = workshop.measure(guided_rows(workshop.num_seeds), goals="recorded")
    return Measured(start, told, asked, guided, workshop.measure(variants))


def conclude(measured: Measured, workshop: Workshop) -> Findings:
    """The table, what following costs, and what is left of the goal-free model."""
    start, asked = (
        measured.start,
        [
            *measured.told.values(),
            *measured.asked.values(),
            *measured.guided.values(),
        ],
    )
    unasked = [Row(f"{name}, asked nothing", row.by_seed) for name, row in measured.unasked.items()]
    return Findings(
        title="Goal conditioning: following goals, and what it costs in realism",
        tables=(
            result_table("Ours: evaluated agents asked to go where the record ends", [start, *asked], GOAL_COLUMNS),
            result_table("Ours: the same models, asked nothing", [start, *unasked], GOAL_COLUMNS),
            published.GOALS,
        ),
        verdicts=(
            *(_misses_line(start, row) for row in asked),
            *(f"passing misses: {verdict_line(start, row, MISS)}" for row in asked),
            *(f"RMM: {verdict_line(start, row)}" for row in (*asked, *unasked)),
        ),
        notes=(
            budget_note(workshop),
            "All models that see goals also weigh tokens by where they lead, which the paper's do not. Told: the goal-free row, told where its own "
            "rollouts led; where nobody is asked anything it decides as that. The variants start from these rows and have had the fine-tuning of the "
            "goal-free one again; what more goal-free fine-tuning does is in finetune-curve. "
            f"Guided: the same models, their aim counting {GUIDANCE:g} times; asked nothing they are the variants.",
            "A passing miss: an evaluated agent that at no simulated step is within WOMD's tolerance of where its record ends; share of agents and "
            "rollouts. In all rollouts: share of agents that miss in every one of them.",
        ),
        numbers={"rows": row_numbers([start, *asked, *unasked], GOAL_COLUMNS)},
        figure=_figure([start, *asked]),
    )  # fmt: skip


def _misses_line(start: Row, row: Row) -> str:
    before, after = (one.mean.mean_and_error(MISS).mean for one in (start, row))
    relative = f"{after / before - 1:+.0%} relative" if before > 0 else "nobody missed before"
    gain = row.mean.mean_and_error("meta_metric").mean - start.mean.mean_and_error("meta_metric").mean
    return f"{row.name}: passing misses {before:.2%} → {after:.2%}, {relative}, at {gain:+.4f} RMM."


def _figure(shown: Sequence[Row]):
    intervals = []
    for number, row in enumerate(shown):
        estimate = row.mean.mean_and_error(MISS)
        low, high = (100 * v for v in estimate.interval)
        intervals.append(Interval(row.name, 100 * estimate.mean, low, high, colour=0 if number else 4))
    label = "passing misses [%], mean over scenarios, 95 % interval"
    return draw_intervals(intervals, title="Agents that never come near their goal", x_label=label, zero=False)


EXPERIMENT = Experiment(
    question="Do agents that see goals follow them, and what does it cost in realism?",
    measure=measure,
    conclude=conclude,
)

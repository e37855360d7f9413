"""Table 2 at equal distance: what each reward gains for the KL to the base model that it spends."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from rlftsim.evaluation.columns import DRIFT_COLUMNS, SCORES
from rlftsim.evaluation.compare import compare
from rlftsim.experiments import tables
from rlftsim.experiments.model_specs import BASE, FineTuned, over_seeds
from rlftsim.experiments.paper import paired_ttest, published, reward_ablation
from rlftsim.experiments.paper.reward_ablation import MLOO, REFERENCE
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.rows import RMM, Row, mean_of_seeds
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.viewer.figure import Band, draw_bands

PARTS = (0.25, 0.5, 1.0)
"""Where a run is evaluated on its way, as fractions of the recipe's fine-tuning epochs."""
HEURISTICS = ("minADE, RLOO", "collision + off-road + ADE", "collision + off-road")
REWARDS = {name: reward_ablation.REWARDS[name] for name in (MLOO, "RLOO", *HEURISTICS)}
ORDER = ((MLOO, "RLOO"), *(("RLOO", heuristic) for heuristic in HEURISTICS))
"""The paper's order: the first of each pair scores higher."""
COLUMNS = (*SCORES, DRIFT_COLUMNS[0])


def point(reward: str, part: float) -> str:
    """Row of a point on the way of a reward's runs.

    Args:
        reward: its name in `REWARDS`.
        part: of the runs, one of `PARTS`.
    """
    return f"{reward}, {part:.0%} of the run"


def specs(num_seeds: int) -> dict[str, tuple[FineTuned, ...]]:
    """Specifications of the points of all rewards.

    Args:
        num_seeds: of every point.
    """
    # Shorter runs first: longer ones continue them, so a reward's points are one run a seed.
    return {
        point(name, part): over_seeds(replace(spec, epochs_fraction=part), num_seeds)
        for name, spec in REWARDS.items()
        for part in PARTS
    }


def run(suite: ExperimentSuite) -> dict[str, Row]:
    """Rows of the base model and of all points."""
    return suite.evaluate({REFERENCE: (BASE,), **specs(suite.num_seeds)})


def summarize(rows: Mapping[str, Row], suite: ExperimentSuite) -> ExperimentResult:
    """The points, the rewards at the largest KL that all have reached, and a verdict on the paper's order.

    Args:
        rows: of `run`.
        suite: where the runs are, whose KL is read.
    """
    base, runs, frontiers = rows[REFERENCE], specs(suite.num_seeds), {}
    for name in REWARDS:
        names = [point(name, part) for part in PARTS]
        points = [(reward_ablation.mean_at_end(suite, runs[one])["kl"], rows[one]) for one in names]
        frontiers[name] = [(0.0, base), *sorted(points, key=lambda one: one[0])]
    # 1. All rewards at one distance: the largest that none of them has to be extrapolated to.
    kl = min(frontier[-1][0] for frontier in frontiers.values())
    equal = {name: at_kl(name, frontier, kl) for name, frontier in frontiers.items()}
    matrix = paired_ttest.summarize(equal, suite)
    # 2. Curves of the gain, whose bands leave out that some scenarios are harder for all models.
    bands = []
    for number, (name, frontier) in enumerate(frontiers.items()):
        gains = [compare(base.mean, row.mean)[RMM] for _, row in frontier[1:]]
        middle = np.array([0.0, *(gain.difference for gain in gains)])  # [points]
        limits = np.array([(0.0, 0.0), *(gain.interval for gain in gains)])  # [points, 2]
        bands.append(Band(name, np.array([k for k, _ in frontier]), middle, limits[:, 0], limits[:, 1], color=number))
    measured = [Row(f"{name}, KL {k:.4f}", row.by_seed) for name, line in frontiers.items() for k, row in line[1:]]
    return ExperimentResult(
        title="Rewards at equal KL to the base model",
        tables=(
            tables.build_table(f"At a KL of {kl:.4f} nats a decision", (base, *equal.values()), COLUMNS),
            replace(matrix.tables[0], title="Row against column, at that KL"),
            tables.build_table("Measured", (base, *measured), COLUMNS),
            published.REWARDS,
        ),
        verdicts=(_verdict_on_the_order(equal, kl), *(row.against(base) for row in equal.values()), *matrix.verdicts),
        notes=(
            f"{suite.budget.note} The points of a run are its evaluations at "
            f"{', '.join(f'{part:.0%}' for part in PARTS)} of the updates.",
            "KL: to the base model, nats a decision, training rollouts of the last fifth of the updates until there. "
            "Between two points, and between the base model and the first, each scenario's scores are interpolated.",
        ),
        numbers={
            "kl": kl,
            "at_equal_kl": tables.to_numbers((base, *equal.values()), COLUMNS),
            "measured": tables.to_numbers((base, *measured), COLUMNS),
            "t_test": matrix.numbers,
        },
        figure=draw_bands(
            bands,
            title="Realism gained against distance from the base model",
            x_label="KL to the base model [nats a decision]",
            y_label="gain in RMM, 95 % interval",
        ),
    )


def at_kl(name: str, frontier: Sequence[tuple[float, Row]], kl: float) -> Row:
    """A row whose scores are interpolated, scenario by scenario and seed by seed.

    Args:
        name: of the row.
        frontier: rows with their KL, nearest first; the first may have a single seed.
        kl: between the first and the last.
    """
    above = next(number for number, (at, _) in enumerate(frontier) if number and at >= kl)
    (near, below), (far, beyond) = frontier[above - 1], frontier[above]
    share = (kl - near) / (far - near)
    if share == 1.0:  # a point itself; scores that are missing below it would be lost
        return Row(name, beyond.by_seed)
    seeds = [(below.by_seed[min(seed, len(below.by_seed) - 1)], one) for seed, one in enumerate(beyond.by_seed)]
    return Row(name, tuple(mean_of_seeds(name, pair, weights=(1 - share, share)) for pair in seeds))


def _verdict_on_the_order(rows: Mapping[str, Row], kl: float) -> str:
    """The paper's order confirmed, refuted or undecided, in a sentence."""
    found = {pair: compare(rows[pair[1]].mean, rows[pair[0]].mean)[RMM] for pair in ORDER}
    opposite = [pair for pair, one in found.items() if one.is_difference and one.difference < 0]
    undecided = [pair for pair, one in found.items() if not one.is_difference]
    if opposite:
        gains = (f"{worse} above {better} by {-found[better, worse].difference:.4f}" for better, worse in opposite)
        verdict = f"refuted: {', '.join(gains)}"
    elif undecided:
        verdict = f"not decided: no difference between {', '.join(' and '.join(pair) for pair in undecided)}"
    else:
        verdict = "confirmed"
    return f"The paper's order, MLOO above RLOO above heuristics, at a KL of {kl:.4f} nats and the 5% level: {verdict}."


EXPERIMENT = Experiment(
    "Which reward gains most realism at the same KL to the base model?", run, summarize, default_seeds=3
)

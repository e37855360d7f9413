"""Table 2 at equal distance: gain of each reward for the KL to the base model that the training spends."""

from collections.abc import Mapping, Sequence
from dataclasses import replace

from rlftsim.evaluation.columns import DRIFT_COLUMNS, SCORES
from rlftsim.evaluation.compare import compare
from rlftsim.experiments.model_specs import BASE, FineTuned, over_seeds
from rlftsim.experiments.paper import paired_ttest, reward_ablation
from rlftsim.experiments.paper.reward_ablation import MLOO, REFERENCE
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import RMM, Row, build_gain_band, build_table, load_published, mean_of_seeds, to_numbers
from rlftsim.viewer.figure import draw_bands

FRACTIONS = (0.25, 0.5, 1.0)
"""Lengths at which a run is evaluated on its way, as fractions of the recipe's fine-tuning epochs."""
HEURISTICS = ("minADE, RLOO", "collision + off-road + ADE", "collision + off-road")
REWARDS = {name: reward_ablation.REWARDS[name] for name in (MLOO, "RLOO", *HEURISTICS)}
ORDER = ((MLOO, "RLOO"), *(("RLOO", heuristic) for heuristic in HEURISTICS))
"""The paper's order: the first of each pair scores higher."""
COLUMNS = (*SCORES, DRIFT_COLUMNS[0])


def point(reward: str, fraction: float) -> str:
    """Name of a point's row.

    Args:
        reward: Name of the reward, a key of `REWARDS`.
        fraction: Fraction of the reward's runs at the point, from `FRACTIONS`.
    """
    return f"{reward}, {fraction:.0%} of the run"


def specs(num_seeds: int) -> dict[str, tuple[FineTuned, ...]]:
    """Specifications of the points of all rewards.

    Args:
        num_seeds: Number of runs of every reward, with the seeds 0, 1, ....
    """
    # Shorter runs first: longer ones continue them, so a reward's points are one run a seed.
    return {
        point(name, fraction): over_seeds(replace(spec, epochs_fraction=fraction), num_seeds)
        for name, spec in REWARDS.items()
        for fraction in FRACTIONS
    }


def run(suite: ExperimentSuite) -> dict[str, Row]:
    """Rows of the base model and of all points."""
    return suite.evaluate({REFERENCE: (BASE,), **specs(suite.num_seeds)})


def summarize(rows: Mapping[str, Row], suite: ExperimentSuite) -> ExperimentResult:
    """The points, the rewards at the largest KL that all have reached, and a verdict on the paper's order.

    Args:
        rows: Rows that `run` returned, by the names that `point` gives.
        suite: Suite with the folder of the runs, whose metrics have the KL.
    """
    base, runs, frontiers = rows[REFERENCE], specs(suite.num_seeds), {}
    for name in REWARDS:
        names = [point(name, fraction) for fraction in FRACTIONS]
        points = [(reward_ablation.mean_at_end(suite, runs[row])["kl"], rows[row]) for row in names]
        frontiers[name] = [(0.0, base), *sorted(points, key=lambda kl_and_row: kl_and_row[0])]
    # 1. All rewards at one distance: the largest that none of them has to be extrapolated to.
    kl = min(frontier[-1][0] for frontier in frontiers.values())
    equal = {name: interpolate_row(name, frontier, kl) for name, frontier in frontiers.items()}
    matrix = paired_ttest.summarize(equal, suite)
    # 2. Curves of the gain, whose bands leave out that some scenarios are harder for all models.
    bands = [
        build_gain_band(name, base, frontier[1:], color=number)
        for number, (name, frontier) in enumerate(frontiers.items())
    ]
    measured = [Row(f"{name}, KL {k:.4f}", row.by_seed) for name, line in frontiers.items() for k, row in line[1:]]
    return ExperimentResult(
        title="Rewards at equal KL to the base model",
        tables=(
            build_table(f"At a KL of {kl:.4f} nats a decision", (base, *equal.values()), COLUMNS),
            replace(matrix.tables[0], title="Row against column, at that KL"),
            build_table("Measured", (base, *measured), COLUMNS),
            load_published("rewards"),
        ),
        verdicts=(_format_order(equal, kl), *(row.against(base) for row in equal.values()), *matrix.verdicts),
        notes=(
            f"{suite.budget.note} The points of a run are its evaluations at "
            f"{', '.join(f'{fraction:.0%}' for fraction in FRACTIONS)} of the updates.",
            "KL: to the base model, nats a decision, training rollouts of the last fifth of the updates until there. "
            "Between two points, and between the base model and the first, each scenario's scores are interpolated.",
        ),
        numbers={
            "kl": kl,
            "at_equal_kl": to_numbers((base, *equal.values()), COLUMNS),
            "measured": to_numbers((base, *measured), COLUMNS),
            "t_test": matrix.numbers,
        },
        figure=draw_bands(
            bands,
            title="Realism gained against distance from the base model",
            x_label="KL to the base model [nats a decision]",
            y_label="gain in RMM, 95 % interval",
        ),
    )


def interpolate_row(name: str, frontier: Sequence[tuple[float, Row]], kl: float) -> Row:
    """Row with interpolated scores, scenario by scenario and seed by seed.

    Args:
        name: Name of the row in tables.
        frontier: Rows with the KL to the base model, smallest first; the first may have a single seed.
        kl: KL to interpolate at, nats a decision, between those of the first and the last row.
    """
    upper = next(number for number, (point_kl, _) in enumerate(frontier) if number and point_kl >= kl)
    (lower_kl, lower_row), (upper_kl, upper_row) = frontier[upper - 1], frontier[upper]
    share = (kl - lower_kl) / (upper_kl - lower_kl)
    if share == 1.0:  # a point itself; scores that are missing in the lower row would be lost
        return Row(name, upper_row.by_seed)
    lower_seeds = [lower_row.by_seed[min(seed, len(lower_row.by_seed) - 1)] for seed in range(len(upper_row.by_seed))]
    seeds = zip(lower_seeds, upper_row.by_seed)
    return Row(name, tuple(mean_of_seeds(name, pair, weights=(1 - share, share)) for pair in seeds))


def _format_order(rows: Mapping[str, Row], kl: float) -> str:
    """The paper's order confirmed, refuted or undecided, in a sentence."""
    gains = {pair: compare(rows[pair[1]].mean, rows[pair[0]].mean)[RMM] for pair in ORDER}
    opposite = {pair: -gain.difference for pair, gain in gains.items() if gain.is_difference and gain.difference < 0}
    undecided = [pair for pair, gain in gains.items() if not gain.is_difference]
    if opposite:
        reversals = (f"{second} above {first} by {size:.4f}" for (first, second), size in opposite.items())
        verdict = f"refuted: {', '.join(reversals)}"
    elif undecided:
        verdict = f"not decided: no difference between {', '.join(' and '.join(pair) for pair in undecided)}"
    else:
        verdict = "confirmed"
    return f"The paper's order, MLOO above RLOO above heuristics, at a KL of {kl:.4f} nats and the 5% level: {verdict}."


EXPERIMENT = Experiment(
    "Which reward gains most realism at the same KL to the base model?", run, summarize, default_seeds=3
)

"""Table 1, extended: base model, CAT-K, RoaD and RLFTSim, between constant velocity and the log (the oracle)."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rlftsim.evaluation.columns import SCORES
from rlftsim.evaluation.compare import paired_values
from rlftsim.evaluation.results import Evaluation
from rlftsim.experiments.model_specs import BASE, CATK, CONSTANT_VELOCITY, ORACLE, ROAD, FineTuned, over_seeds
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import RMM, Row, build_table, draw_gains, load_published, to_numbers

REFERENCE, TUNED, CEILING, FLOOR = "base", "RLFTSim (MLOO)", "oracle", "constant velocity"
IMITATIONS = {"CAT-K": CATK, "RoaD": ROAD}
"""Methods of closed-loop imitation by the name of their row."""
NUM_RESAMPLES = 10_000
RESAMPLES_AT_ONCE = 100


def run(suite: ExperimentSuite) -> dict[str, Row]:
    """Rows of the table; closed-loop imitation is left out for a policy without tokens."""
    rows = {
        REFERENCE: (BASE,),
        **{name: over_seeds(FineTuned(method), suite.num_seeds) for name, method in IMITATIONS.items()},
        TUNED: over_seeds(FineTuned("mloo"), suite.num_seeds),
        CEILING: (ORACLE,),
        FLOOR: (CONSTANT_VELOCITY,),
    }
    return suite.evaluate(suite.select_feasible(rows))


def summarize(rows: Mapping[str, Row], suite: ExperimentSuite) -> ExperimentResult:
    """The table, the differences, and the part of the gap to the oracle that fine-tuning closes."""
    base, tuned = rows[REFERENCE], rows[TUNED]
    imitations = [rows[name] for name in IMITATIONS if name in rows]
    closed = {row.name: compute_gap_closed(base.mean, row.mean, rows[CEILING].mean) for row in (*imitations, tuned)}
    return ExperimentResult(
        title="Benchmark: realism of the base model, closed-loop imitation and RLFTSim",
        tables=(build_table("Ours", rows.values(), SCORES), load_published("benchmark")),
        verdicts=(
            *(tuned.against(base), tuned.seeds_against(base)),
            *(v for row in imitations for v in (row.against(base), row.seeds_against(base), tuned.against(row))),
            *(f"{name}: {gap}" for name, gap in closed.items()),
        ),
        notes=(
            suite.budget.note,
            *(
                f"{row.name} needs one rollout of a scenario where the rewards need several: it has as many updates "
                "of as many scenarios, and fewer rollouts."
                for row in imitations
            ),
            "Intervals over scenarios take the trained models as given; the interval over seeds says what other runs "
            "would give.",
        ),
        numbers={
            "rows": to_numbers(rows.values(), SCORES),
            "gain_by_seed": {row.name: row.gains_over(base).tolist() for row in (*imitations, tuned)},
            "gap_closed": {name: {"fraction": g.fraction, "interval": g.interval} for name, g in closed.items()},
        },
        figure=draw_gains(base, [tuned, *imitations, rows[CEILING], rows[FLOOR]]),
    )


@dataclass(frozen=True)
class GapClosed:
    """Fraction of the gap in realism between base model and oracle that a model closes."""

    fraction: float
    """1 = as realistic as the oracle; NaN where there is no gap."""
    interval: tuple[float, float]
    """95 %, bootstrap over scenarios."""

    def __str__(self) -> str:
        low, high = self.interval
        interval = f"95% interval over scenarios [{low:.1%}, {high:.1%}]"
        return f"{self.fraction:.1%} of the gap from base to oracle closed, {interval}."


def compute_gap_closed(base: Evaluation, tuned: Evaluation, ceiling: Evaluation) -> GapClosed:
    """Mean gain over mean gap of the meta-metric, scenarios paired.

    Args:
        base: Evaluation of the base model, the start of the gap.
        tuned: Evaluation of the fine-tuned model, for the gain.
        ceiling: Evaluation of the oracle, the end of the gap.

    Raises:
        DataError: No scenario in common.
    """
    ids, base_scores, tuned_scores = paired_values(base, tuned, RMM)
    by_id = dict(zip(ceiling.scenario_ids, ceiling.values(RMM)))
    gain, gap = tuned_scores - base_scores, np.array([by_id.get(i, np.nan) for i in ids]) - base_scores
    # A scenario counts where all three have a score.
    is_scored = np.isfinite(gain) & np.isfinite(gap)
    gain, gap = gain[is_scored], gap[is_scored]  # [scenarios]
    if not len(gain):
        return GapClosed(np.nan, (np.nan, np.nan))
    # Bootstrap: scenarios are drawn again and again with replacement, a few resamples at a time for memory.
    rng, means = np.random.default_rng(0), []
    for _ in range(NUM_RESAMPLES // RESAMPLES_AT_ONCE):
        resamples = rng.integers(len(gain), size=(RESAMPLES_AT_ONCE, len(gain)))  # [resamples, scenarios]
        means.append((gain[resamples].mean(1), gap[resamples].mean(1)))
    mean_gain, mean_gap = np.concatenate(means, axis=1)  # [NUM_RESAMPLES] each
    # Ratio of means, not mean of ratios: scenarios in which the base model is as good as the oracle have no ratio.
    with np.errstate(divide="ignore", invalid="ignore"):
        low, high = np.quantile(mean_gain / mean_gap, (0.025, 0.975))
        return GapClosed(float(np.divide(gain.mean(), gap.mean())), (float(low), float(high)))


EXPERIMENT = Experiment(
    "Does closed-loop fine-tuning make the simulation more realistic, and more so than CAT-K and RoaD with the same "
    "budget?",
    run,
    summarize,
    default_seeds=3,
)

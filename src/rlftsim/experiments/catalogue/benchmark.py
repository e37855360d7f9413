"""Table 1, extended: base model, CAT-K, RLFTSim, between the record itself and constant velocity."""

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from rlftsim.experiments.catalogue import published
from rlftsim.experiments.columns import SCORES
from rlftsim.experiments.compare import paired_values
from rlftsim.experiments.contestants import BASE, CATK, CONSTANT_VELOCITY, ORACLE, Contestant, FineTuned, over_seeds
from rlftsim.experiments.evaluation import Evaluation
from rlftsim.experiments.findings import (
    Experiment,
    Findings,
    budget_note,
    draw_gains,
    result_table,
    row_numbers,
    seed_gains,
    seeds_line,
    verdict_line,
)
from rlftsim.experiments.workshop import Row, Workshop

REFERENCE, IMITATION, TUNED, CEILING, FLOOR = "base", "CAT-K", "RLFTSim (MLOO)", "oracle", "constant velocity"
NUM_RESAMPLES = 10_000


def rows(num_seeds: int) -> dict[str, tuple[Contestant, ...]]:
    """Who is compared."""
    return {
        REFERENCE: (BASE,),
        IMITATION: over_seeds(FineTuned(CATK), num_seeds),
        TUNED: over_seeds(FineTuned("mloo"), num_seeds),
        CEILING: (ORACLE,),
        FLOOR: (CONSTANT_VELOCITY,),
    }


def measure(workshop: Workshop) -> dict[str, Row]:
    """Everybody's evaluations."""
    return workshop.measure(rows(workshop.num_seeds))


def conclude(measured: Mapping[str, Row], workshop: Workshop) -> Findings:
    """The table, who differs from whom, and how much of the gap to the oracle is closed."""
    base, imitation, tuned = (measured[name] for name in (REFERENCE, IMITATION, TUNED))
    ceiling = measured[CEILING].mean
    closed = {row.name: gap_closed(base.mean, row.mean, ceiling) for row in (imitation, tuned)}
    return Findings(
        title="Benchmark: realism of the base model, CAT-K and RLFTSim",
        tables=(result_table("Ours", list(measured.values()), SCORES), published.BENCHMARK),
        verdicts=(
            verdict_line(base, tuned),
            seeds_line(base, tuned),
            verdict_line(base, imitation),
            seeds_line(base, imitation),
            verdict_line(imitation, tuned),
            *(f"{name}: {gap}" for name, gap in closed.items()),
        ),
        notes=(
            budget_note(workshop),
            "CAT-K needs one rollout of a scenario where the rewards need several: it has as many updates of as many "
            "scenarios, and fewer rollouts.",
            "Intervals over scenarios take the trained models as given; the interval over seeds says what other runs would give.",
        ),
        numbers={
            "rows": row_numbers(list(measured.values()), SCORES),
            "gain_by_seed": {row.name: seed_gains(base, row).tolist() for row in (imitation, tuned)},
            "gap_closed": {name: {"share": gap.share, "interval": gap.interval} for name, gap in closed.items()},
        },
        figure=draw_gains(base, [tuned, imitation, measured[CEILING], measured[FLOOR]]),
    )


@dataclass(frozen=True)
class GapClosed:
    """How far a model has come from the base to the ceiling."""

    share: float
    """1 = as good as the ceiling; NaN where there is no gap."""
    interval: tuple[float, float]
    """95 %, from drawing the scenarios again and again (bootstrap)."""

    def __str__(self) -> str:
        low, high = self.interval
        return f"{self.share:.1%} of the gap from base to oracle closed, 95% interval over scenarios [{low:.1%}, {high:.1%}]."


def gap_closed(base: Evaluation, tuned: Evaluation, ceiling: Evaluation) -> GapClosed:
    """Mean gain over mean gap of the meta-metric, scenarios paired.

    Raises:
        DataError: no scenario in common.
    """
    ids, before, after = paired_values(base, tuned, "meta_metric")
    above = dict(zip(ceiling.scenario_ids, ceiling.values("meta_metric")))
    best = np.array([above.get(i, np.nan) for i in ids])
    known = np.isfinite(before) & np.isfinite(after) & np.isfinite(best)
    gain, gap = (after - before)[known], (best - before)[known]
    drawn = np.random.default_rng(0).integers(len(gain), size=(NUM_RESAMPLES, len(gain))) if len(gain) else None
    with np.errstate(divide="ignore", invalid="ignore"):
        shares = gain[drawn].mean(1) / gap[drawn].mean(1) if drawn is not None else np.array([np.nan])
        low, high = np.quantile(shares, (0.025, 0.975))
        return GapClosed(float(np.divide(gain.mean(), gap.mean())) if len(gain) else np.nan, (float(low), float(high)))


EXPERIMENT = Experiment(
    question="Does closed-loop fine-tuning make the simulation more realistic, and more so than CAT-K with the same budget?",
    measure=measure,
    conclude=conclude,
    default_seeds=3,
)

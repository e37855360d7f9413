"""What experiments that give the ego one goal at a time have in common: who takes part, shares by scenario, and how they are told."""

from collections.abc import Iterable, Mapping, Sequence

import numpy as np

from rlftsim.experiments.attainment import Attained
from rlftsim.experiments.catalogue.goal_conditioning import GOAL_FREE, GUIDED, START
from rlftsim.experiments.contestants import BASE, Contestant
from rlftsim.intervals import MeanInterval, mean_interval
from rlftsim.viewer.figure import Band

WAYS = {"passed": "passed [%]", "reached": "reached [%]"}
"""Shares of the rollouts, by names of `Attained`."""
SEED_NOTE = "Of every fine-tuned row one model is measured, that of seed 0, whatever `--seeds` says."


def contestants() -> dict[str, Contestant]:
    """The models that see no goals, and the four variants, guided."""
    return {"base": BASE, START: GOAL_FREE, **GUIDED}


def shares_by_scenario(attained: Iterable[Attained], way: str) -> dict[str, float]:
    """The mean share over each scenario's goals."""
    collected: dict[str, list[float]] = {}
    for one in attained:
        collected.setdefault(one.entry.scenario_id, []).append(getattr(one, way))
    return {scenario_id: float(np.mean(own)) for scenario_id, own in collected.items()}


def estimate(values: Iterable[float]) -> MeanInterval:
    """The mean of some shares; NaN without a single one."""
    return mean_interval(np.array(list(values), float))


def cell(share: MeanInterval) -> str:
    """A mean share in percent with its standard error, where there is one; a dash without a single share."""
    if not share.count:
        return "–"
    error = f" ± {100 * share.standard_error:.1f}" if share.count > 1 else ""
    return f"{100 * share.mean:.1f}{error}"


def paired_gain(before: Mapping[str, float], after: Mapping[str, float]) -> MeanInterval:
    """What shares gain, scenario by scenario."""
    return estimate(after[scenario_id] - before[scenario_id] for scenario_id in after)


def gain_words(gain: MeanInterval) -> str:
    """A paired difference of shares as a verdict, in percentage points."""
    low, high = (100 * v for v in gain.interval)
    if gain.count < 2:
        return "no verdict: fewer than two scenarios."
    verdict = "no difference" if low <= 0 <= high else f"difference, for the {'better' if gain.mean > 0 else 'worse'}"
    return (
        f"{verdict}: {100 * gain.mean:+.1f} points, 95% interval over {gain.count} scenarios [{low:+.1f}, {high:+.1f}]."
    )


def bands_of(curves: Mapping[str, Sequence[MeanInterval]]) -> tuple[Band, ...]:
    """Curves of shares in percent; those of models without goals dashed with open dots, intervals beside each other and cut at 0 and 100."""
    bands = []
    for number, (name, curve) in enumerate(curves.items()):
        place = np.arange(len(curve)) + 0.07 * (number - (len(curves) - 1) / 2)
        mean, low, high = (100 * np.array(v) for v in ([m.mean for m in curve], *zip(*(m.interval for m in curve))))
        sees = name in GUIDED
        colour = list(GUIDED).index(name) if sees else 4 + (name == START)
        bands.append(
            Band(
                name,
                place,
                mean,
                low.clip(0, 100),
                high.clip(0, 100),
                style="measured" if sees else "theory",
                colour=colour,
            )
        )
    return tuple(bands)

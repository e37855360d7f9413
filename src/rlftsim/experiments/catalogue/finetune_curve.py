"""RMM against epochs of fine-tuning: RLFTSim beside CAT-K, from a strong and from a weak base model."""

from collections.abc import Mapping
from dataclasses import replace

import numpy as np
from matplotlib.figure import Figure

from rlftsim.experiments.catalogue import published
from rlftsim.experiments.columns import SCORES
from rlftsim.experiments.compare import compare
from rlftsim.experiments.contestants import BASE, CATK, WEAK_EPOCHS, Base, Contestant, FineTuned, over_seeds
from rlftsim.experiments.findings import (
    Experiment,
    Findings,
    result_table,
    row_numbers,
    verdict_line,
)
from rlftsim.experiments.workshop import Row, Workshop
from rlftsim.viewer.figure import Band, draw_bands

SHARES = (0.25, 0.5, 1.0, 1.5)
"""Of the recipe's fine-tuning epochs."""
WEAK = Base(WEAK_EPOCHS)
CURVES = {
    "RLFTSim": FineTuned("mloo"),
    "CAT-K": FineTuned(CATK),
    "RLFTSim, weak base": FineTuned("mloo", base=WEAK),
    "CAT-K, weak base": FineTuned(CATK, base=WEAK),
}
PAIRS = (("CAT-K", "RLFTSim"), ("CAT-K, weak base", "RLFTSim, weak base"))
"""Compared at equal length."""


def start_of(curve: FineTuned) -> str:
    """Row of the model that a curve starts from."""
    return "base" if curve.base == BASE else f"weak base ({WEAK_EPOCHS:g} epoch)"


def point(name: str, share: float, epochs: float) -> str:
    """Row of a point of a curve, of which a share of 1 is so many epochs."""
    return f"{name}, {share * epochs:g} epochs"


def rows(num_seeds: int, epochs: float) -> dict[str, tuple[Contestant, ...]]:
    """Start and points of all curves; shorter runs come first, longer ones go on from them where they can."""
    starts = {start_of(curve): (curve.base,) for curve in CURVES.values()}
    points = {
        point(name, share, epochs): over_seeds(replace(curve, share=share), num_seeds)
        for name, curve in CURVES.items()
        for share in SHARES
    }
    return {**starts, **points}


def measure(workshop: Workshop) -> dict[str, Row]:
    """Everybody's evaluations."""
    return workshop.measure(rows(workshop.num_seeds, workshop.recipe.finetune.epochs))


def conclude(measured: Mapping[str, Row], workshop: Workshop) -> Findings:
    """The table, the curves, and what differs at equal length."""
    epochs = workshop.recipe.finetune.epochs
    verdicts = []
    for name, curve in CURVES.items():
        points = [measured[point(name, share, epochs)] for share in SHARES]
        best = max(points, key=lambda row: row.mean.mean_and_error("meta_metric").mean)
        verdicts.append(f"best of its curve: {verdict_line(measured[start_of(curve)], best)}")
    for first, second in PAIRS:
        for share in SHARES:
            verdicts.append(verdict_line(measured[point(first, share, epochs)], measured[point(second, share, epochs)]))
    return Findings(
        title="Realism against epochs of fine-tuning",
        tables=(result_table("Ours", list(measured.values()), SCORES[:4]), published.CURVE),
        verdicts=tuple(verdicts),
        notes=(
            "At equal epochs all curves had the same number of updates of as many scenarios; RLFTSim simulates "
            f"{workshop.budget.rollouts_a_scenario} rollouts of each, CAT-K one.",
            "The points of RLFTSim are one run, looked at on its way (nothing in it depends on its end); those of CAT-K are runs of their own, "
            "because its learning rate falls towards the end.",
            "The best point of a curve is chosen with the scenarios it is measured on, which flatters it a little.",
        ),
        numbers={"rows": row_numbers(list(measured.values()), SCORES[:4]), "epochs": [share * epochs for share in SHARES]},
        figure=_figure(measured, epochs),
    )  # fmt: skip


def _figure(measured: Mapping[str, Row], epochs: float) -> Figure:
    """Means of RMM. The bands are the intervals of the paired gains: all scenarios being harder or easier is not in them."""
    bands, across = [], epochs * np.array([0.0, *SHARES])
    for number, (name, curve) in enumerate(CURVES.items()):
        start = measured[start_of(curve)].mean
        low = start.mean_and_error("meta_metric").mean
        points = [measured[point(name, share, epochs)].mean for share in SHARES]
        gains = [compare(start, one)["meta_metric"] for one in points]
        middle = low + np.array([0.0, *(gain.difference for gain in gains)])
        limits = low + np.array([(0.0, 0.0), *(gain.interval for gain in gains)])
        bands.append(Band(name, across, middle, limits[:, 0], limits[:, 1], colour=number))
    return draw_bands(
        bands, title="Realism against fine-tuning", x_label="epochs of fine-tuning", y_label="RMM, 95 % interval of the gain"
    )  # fmt: skip


EXPERIMENT = Experiment(
    question="How fast does fine-tuning gain realism, beside CAT-K, and how much does a weak base model gain?",
    measure=measure,
    conclude=conclude,
)

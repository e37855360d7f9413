"""RMM against epochs of fine-tuning: RLFTSim beside CAT-K, from a strong and from a weak base model."""

from collections.abc import Mapping
from dataclasses import replace

from rlftsim.evaluation.columns import SCORES
from rlftsim.experiments.model_specs import BASE, CATK, WEAK_EPOCHS, Base, FineTuned, ModelSpec, over_seeds
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import RMM, Row, build_gain_band, build_table, load_published, to_numbers
from rlftsim.viewer.figure import draw_bands

EPOCHS_FRACTIONS = (0.25, 0.5, 1.0, 1.5)
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


def name_start(curve: FineTuned) -> str:
    """Row of the model that a curve starts from."""
    return "base" if curve.base == BASE else f"weak base ({WEAK_EPOCHS:g} epoch)"


def point(curve: str, epochs: float) -> str:
    """Name of a point's row.

    Args:
        curve: Name of the curve, a key of `CURVES`.
        epochs: Epochs of fine-tuning at the point.
    """
    return f"{curve}, {epochs:g} epochs"


def specs(num_seeds: int, epochs: float) -> dict[str, tuple[ModelSpec, ...]]:
    """Specifications of the starts and points of all curves.

    Args:
        num_seeds: Number of fine-tunings behind every point, with the seeds 0, 1, ....
        epochs: Epochs of the recipe's fine-tuning; points lie at the fractions `EPOCHS_FRACTIONS` of these.
    """
    starts = {name_start(curve): (curve.base,) for curve in CURVES.values()}
    # Shorter runs first: longer ones with a reward continue them.
    points = {
        point(name, fraction * epochs): over_seeds(replace(curve, epochs_fraction=fraction), num_seeds)
        for name, curve in CURVES.items()
        for fraction in EPOCHS_FRACTIONS
    }
    return {**starts, **points}


def run(suite: ExperimentSuite) -> dict[str, Row]:
    """Rows of all points; CAT-K is left out for a policy without tokens."""
    return suite.evaluate(suite.select_feasible(specs(suite.num_seeds, suite.recipe.finetune.epochs)))


def summarize(rows: Mapping[str, Row], suite: ExperimentSuite) -> ExperimentResult:
    """The table, the curves, and the differences at equal length.

    Args:
        rows: Rows that `run` returned, by the names that `name_start` and `point` give.
        suite: Suite with the recipe's epochs; no model is trained or evaluated here.
    """
    epochs = [fraction * suite.recipe.finetune.epochs for fraction in EPOCHS_FRACTIONS]
    verdicts, bands = [], []
    # A curve of a method that cannot train the policy has no rows.
    measured_curves = [name for name in CURVES if point(name, epochs[0]) in rows]
    for number, (name, curve) in enumerate(CURVES.items()):
        if name not in measured_curves:
            continue
        start, points = rows[name_start(curve)], [rows[point(name, length)] for length in epochs]
        best = max(points, key=lambda row: row.mean.mean_and_error(RMM).mean)
        verdicts.append(f"best of its curve: {best.against(start)}")
        level = start.mean.mean_and_error(RMM).mean
        bands.append(build_gain_band(name, start, list(zip(epochs, points)), level=level, color=number))
    for first, second in (pair for pair in PAIRS if set(pair) <= set(measured_curves)):
        verdicts += [rows[point(second, length)].against(rows[point(first, length)]) for length in epochs]
    return ExperimentResult(
        title="Realism against epochs of fine-tuning",
        tables=(build_table("Ours", rows.values(), SCORES[:4]), load_published("finetune-curve")),
        verdicts=tuple(verdicts),
        notes=(
            "At equal epochs all curves had the same number of updates of as many scenarios; RLFTSim simulates "
            f"{suite.budget.rollouts_a_scenario} rollouts of each, CAT-K one.",
            "The points of RLFTSim are one run, evaluated on its way (nothing in it depends on its end); those of "
            "CAT-K are runs of their own, because its learning rate falls towards the end.",
            "The best point of a curve is chosen with the scenarios it is evaluated on, which flatters it a little.",
        ),
        numbers={"rows": to_numbers(rows.values(), SCORES[:4]), "epochs": epochs},
        figure=draw_bands(
            bands,
            title="Realism against fine-tuning",
            x_label="epochs of fine-tuning",
            y_label="RMM, 95 % interval of the gain",
        ),
    )


EXPERIMENT = Experiment(
    "How fast does fine-tuning gain realism, beside CAT-K, and how much does a weak base model gain?", run, summarize
)

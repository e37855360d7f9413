"""A second architecture: base model and RLFTSim for SMART and for TrafficBots, in a single table."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from rlftsim.errors import ConfigError
from rlftsim.evaluation.columns import SCORES
from rlftsim.evaluation.evaluate import evaluate
from rlftsim.experiments.model_specs import BASE, CONSTANT_VELOCITY, FineTuned, ModelSpec, over_seeds
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.experiments.tables import Row, build_table, draw_gains, load_published, to_numbers
from rlftsim.policies.registry import load_policy
from rlftsim.recipes.registry import recipe_by_name

FLOOR = "constant velocity"
UNTUNED, TUNED, MEAN_ACTIONS = "base", "RLFTSim (MLOO)", ", mean actions"
ALPHA = 1e-3
"""Level of the tests of a gain."""


def run(suite: ExperimentSuite) -> dict[str, Row]:
    """Rows of both architectures; twice for models without tokens: with exploration noise, and without."""
    pair = suites(suite)  # first, which refuses models of the wrong architecture
    rows = suite.evaluate({FLOOR: (CONSTANT_VELOCITY,)})
    for architecture in pair:
        recipe = architecture.recipe
        tuned = over_seeds(FineTuned("mloo", credit=recipe.finetune.credit), suite.num_seeds)
        specs = {f"{recipe.model_name}, {UNTUNED}": (BASE,), f"{recipe.model_name}, {TUNED}": tuned}
        rows |= architecture.evaluate(specs)
        # A model of tokens at temperature 0 always drives the same, which no metric of distributions is made for.
        if recipe.tokens is None:
            rows |= {
                f"{name}{MEAN_ACTIONS}": _evaluate_mean_actions(architecture, f"{name}{MEAN_ACTIONS}", row)
                for name, row in specs.items()
            }
    return rows


def suites(suite: ExperimentSuite) -> tuple[ExperimentSuite, ExperimentSuite]:
    """The suite, and a suite for the recipe's counterpart in an inner folder.

    Raises:
        ConfigError: The recipe names no counterpart, or a base model is not of the recipe's architecture.
    """
    name = suite.recipe.counterpart
    if name is None:
        raise ConfigError(f"{type(suite.recipe).__name__} names no recipe of another architecture to compare with.")
    out, base = Path(suite.out) / name, suite.counterpart_model
    recipe = recipe_by_name(name)
    # Rows are named after recipes, so a model of the other architecture would stand under a wrong name.
    for model_recipe, model in ((suite.recipe, suite.base_model), (recipe, base)):
        if model is not None:
            model_recipe.like(load_policy(model))
    return suite, replace(suite, recipe=recipe, out=out, base_model=base, counterpart_model=None)


def _evaluate_mean_actions(suite: ExperimentSuite, name: str, specs: Sequence[ModelSpec]) -> Row:
    """Row of the same models at temperature 0: rollouts differ by the draws at the start."""
    config, folder = replace(suite.evaluation, temperature=0.0), suite.out / "evaluations"
    evaluations = []
    for spec, model in suite.models(specs).items():
        title = f"{suite.evaluation_name(spec)}-mean-actions"
        evaluations.append(evaluate(load_policy(model, suite.device), suite.data, folder, config, name=title))
    return Row(name, tuple(evaluations))


def summarize(rows: Mapping[str, Row], suite: ExperimentSuite) -> ExperimentResult:
    """The table, and the gain of each model."""
    pairs = [(rows[name.replace(TUNED, UNTUNED)], row) for name, row in rows.items() if TUNED in name]
    bases = [row for name, row in rows.items() if UNTUNED in name]
    return ExperimentResult(
        title="Model agnosticism: RLFTSim on two architectures",
        tables=(build_table("Ours", rows.values(), SCORES), load_published("model-agnosticism")),
        verdicts=(
            *(base.against(rows[FLOOR]) for base in bases),
            *(
                verdict
                for base, tuned in pairs
                for verdict in (
                    tuned.against(base, alpha=ALPHA),
                    tuned.against(base, "kinematic", alpha=ALPHA),
                    tuned.seeds_against(base),
                )
            ),
        ),
        notes=(
            # The settings that each recipe chooses for itself.
            *(
                f"{s.recipe.model_name}: {s.budget}; credit by {s.recipe.finetune.credit}, "
                f"speed {'held' if s.recipe.finetune.constraints else 'not held'}."
                for s in suites(suite)
            ),
            f"Gains are tested at level {ALPHA:g}, scenarios paired.",
            "Mean actions: rollouts at temperature 0, without exploration noise.",
        ),
        numbers={
            "rows": to_numbers(rows.values(), SCORES),
            "gain_by_seed": {tuned.name: tuned.gains_over(base).tolist() for base, tuned in pairs},
        },
        figure=draw_gains(rows[FLOOR], [row for name, row in rows.items() if name != FLOOR]),
    )


EXPERIMENT = Experiment(
    "Does RLFTSim improve a model with continuous actions as it does SMART?", run, summarize, default_seeds=3
)

"""Another architecture: base model and RLFTSim for SMART and for TrafficBots, in one table."""

from collections.abc import Mapping, Sequence
from dataclasses import replace
from pathlib import Path

from rlftsim.errors import ConfigError
from rlftsim.evaluation.columns import SCORES
from rlftsim.evaluation.evaluate import evaluate
from rlftsim.experiments import tables
from rlftsim.experiments.model_specs import BASE, CONSTANT_VELOCITY, FineTuned, ModelSpec, over_seeds
from rlftsim.experiments.paper import published
from rlftsim.experiments.results import Experiment, ExperimentResult
from rlftsim.experiments.rows import Row
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.policies.registry import load_policy
from rlftsim.recipes.registry import recipe_by_name
from rlftsim.training.finetune_config import FinetuneConfig

FLOOR = "constant velocity"
BEFORE, AFTER, MEAN_ACTIONS = "base", "RLFTSim (MLOO)", ", mean actions"
ALPHA = 1e-3
"""Level of the tests of a gain."""


def run(suite: ExperimentSuite) -> dict[str, Row]:
    """Rows of both architectures; twice for models without tokens: with their exploration noise, and without."""
    both = suites(suite)  # first, which refuses models of the wrong kind
    rows = suite.evaluate({FLOOR: (CONSTANT_VELOCITY,)})
    for one in both:
        specs: dict[str, Sequence[ModelSpec]] = {
            BEFORE: (BASE,),
            AFTER: over_seeds(FineTuned("mloo", credit=one.recipe.finetune.credit), suite.num_seeds),
        }
        model = one.recipe.model_name
        rows |= one.evaluate({f"{model}, {name}": row for name, row in specs.items()})
        # A model of tokens at temperature 0 always drives the same, which no metric of distributions is made for.
        if one.recipe.tokens is None:
            rows |= {f"{model}, {name}{MEAN_ACTIONS}": _without_noise(one, name, row) for name, row in specs.items()}
    return rows


def suites(suite: ExperimentSuite) -> tuple[ExperimentSuite, ExperimentSuite]:
    """The suite, and one for its recipe's counterpart in a folder inside of it.

    Raises:
        ConfigError: the recipe names no counterpart, or a base model is not of its recipe's architecture.
    """
    name = suite.recipe.counterpart
    if name is None:
        raise ConfigError(f"{type(suite.recipe).__name__} names no recipe of another architecture to compare with.")
    out, base = Path(suite.out) / name, suite.counterpart_model
    recipe = recipe_by_name(name)
    # Rows are named after recipes, so a model of the other kind would stand under a wrong name.
    for own, model in ((suite.recipe, suite.base_model), (recipe, base)):
        if model is not None:
            own.like(load_policy(model))
    return suite, replace(suite, recipe=recipe, out=out, base_model=base, counterpart_model=None)


def _without_noise(suite: ExperimentSuite, name: str, specs: Sequence[ModelSpec]) -> Row:
    """The same models at temperature 0: rollouts differ by what is drawn once."""
    config, folder = replace(suite.evaluation, temperature=0.0), suite.out / "evaluations"
    found = []
    for spec, model in suite.models(specs).items():
        title = f"{suite.evaluation_name(spec)}-mean-actions"
        found.append(evaluate(load_policy(model, suite.device), suite.data, folder, config, name=title))
    return Row(f"{suite.recipe.model_name}, {name}{MEAN_ACTIONS}", tuple(found))


def summarize(rows: Mapping[str, Row], suite: ExperimentSuite) -> ExperimentResult:
    """The table, and the gain of each model."""
    pairs = [(rows[name.replace(AFTER, BEFORE)], row) for name, row in rows.items() if AFTER in name]
    bases = [row for name, row in rows.items() if BEFORE in name]
    return ExperimentResult(
        title="Model agnosticism: RLFTSim on two architectures",
        tables=(tables.build_table("Ours", rows.values(), SCORES), published.AGNOSTICISM),
        verdicts=(
            *(base.against(rows[FLOOR]) for base in bases),
            *(verdict for before, after in pairs for verdict in _gain(before, after)),
        ),
        notes=(
            *(f"{one.recipe.model_name}: {one.budget}; {_objective(one.recipe.finetune)}." for one in suites(suite)),
            f"Gains are tested at level {ALPHA:g}, scenarios paired.",
            "Mean actions: rollouts at temperature 0, without exploration noise.",
        ),
        numbers={
            "rows": tables.to_numbers(rows.values(), SCORES),
            "gain_by_seed": {after.name: after.gains_over(before).tolist() for before, after in pairs},
        },
        figure=tables.draw_gains(rows[FLOOR], [row for name, row in rows.items() if name != FLOOR]),
    )


def _objective(config: FinetuneConfig) -> str:
    """The settings in words that each recipe chooses for itself."""
    return f"credit by {config.credit}, speed {'held' if config.hold_speed else 'not held'}"


def _gain(before: Row, after: Row) -> tuple[str, ...]:
    return (
        after.against(before, alpha=ALPHA),
        after.against(before, "kinematic", alpha=ALPHA),
        after.seeds_against(before),
    )


EXPERIMENT = Experiment(
    "Does RLFTSim improve a model with continuous actions as it does SMART?", run, summarize, default_seeds=3
)

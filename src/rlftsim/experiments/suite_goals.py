"""Goal attainment of the models of a suite, on its scenarios and in its folder."""

from collections.abc import Mapping, Sequence

from rlftsim.evaluation.goal_attainment import Attained, attain_goals
from rlftsim.evaluation.scenario_source import choose_scenarios
from rlftsim.experiments.model_specs import ModelSpec
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.policies.registry import load_policy
from rlftsim.scenario.dataset import ScenarioDataset

FOLDER = "attainment"


def held_out(suite: ExperimentSuite) -> tuple[ScenarioDataset, tuple[str, ...]]:
    """The scenarios that a suite measures on, and their ids."""
    dataset = ScenarioDataset(suite.data, suite.evaluation.split)
    return dataset, tuple(dataset.scenario_ids[i] for i in choose_scenarios(dataset, suite.evaluation))


def measure_attainment(
    suite: ExperimentSuite, rows: Mapping[str, ModelSpec], goals: Sequence[GoalEntry], *, name: str
) -> dict[str, tuple[Attained, ...]]:
    """Attainment of every goal by each spec, in the order of the goals; specs that are not trained yet are trained.

    Args:
        suite: scenarios, settings, models.
        rows: specs by the names of their rows.
        goals: each is given alone, whatever other goals its scenario has.
        name: of the folder of results.
    """
    models = suite.models(list(rows.values()))
    found = {}
    for row, spec in rows.items():
        out = suite.out / FOLDER / name / suite.evaluation_name(spec)
        policy = load_policy(models[spec], suite.device)
        found[row] = attain_goals(policy, suite.data, out, suite.evaluation, goals, title=f"goals, {row}")
    return found

"""Pages that explain scores, and films, of scenarios that several models were evaluated on."""

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import Any

from rlftsim import __version__
from rlftsim.evaluation.explain import explain
from rlftsim.evaluation.explain_page import explanation_html, write_files
from rlftsim.evaluation.exporters import animate_states
from rlftsim.evaluation.results import Evaluation
from rlftsim.evaluation.rollout_states import simulate_states
from rlftsim.evaluation.scenario_source import hash_manifest
from rlftsim.jobs.files import write_text
from rlftsim.jobs.runner import check_jobs, choose_runner
from rlftsim.realism import metric_by_name
from rlftsim.rollout.policy import Policy, get_device
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.viewer.film import to_film
from rlftsim.viewer.page import Animation

FOLDER = "scenarios"
ROLLOUTS_SHOWN = 4


@dataclass(frozen=True, eq=False)
class EvaluatedModels:
    """Evaluations with what can simulate their scenarios again."""

    evaluations: Sequence[Evaluation]
    policies: Mapping[int, Policy]
    """Models at hand, by the position of the evaluation."""
    dataset: ScenarioDataset | None
    """Evaluated scenarios; None = not at hand."""

    @property
    def can_simulate(self) -> bool:
        """True if scenarios and at least one model are at hand, and agents go on from the log, as pages show them."""
        makes_scenes = any(evaluation.config.challenge.makes_scenes for evaluation in self.evaluations)
        return bool(self.policies) and self.dataset is not None and not makes_scenes

    def animate(self, scenario_id: str, caption: str = "") -> Animation:
        """The log beside the first rollouts of each model at hand.

        Args:
            scenario_id: Scenario of the data set.
            caption: Text below the title.
        """
        assert self.dataset is not None
        scenario = self.dataset.by_id(scenario_id)
        states = {}
        for position, policy in self.policies.items():
            evaluation = self.evaluations[position]
            config = replace(evaluation.config, num_rollouts=ROLLOUTS_SHOWN)
            name = evaluation.name if evaluation.name not in states else f"{evaluation.name} ({position + 1})"
            states[name] = simulate_states(policy, collate([scenario]), config)
        return animate_states(scenario, states, max_rollouts=ROLLOUTS_SHOWN, caption=caption)


def write_scenario_files(
    models: EvaluatedModels, scenario_ids: Sequence[str], out: Path, *, jobs: int = 1
) -> dict[str, dict[str, Any]]:
    """Write a page for each model at hand, and a film of all, of each scenario. A call that was interrupted goes on.

    Args:
        models: Models and scenarios at hand.
        scenario_ids: Scenarios to look at.
        out: Folder of the report; the files are in `FOLDER` inside.
        jobs: Processes that share the work, with models on CPUs.

    Returns:
        Addresses of `pages`, one of each evaluation (empty = none), and of the `film`, by scenario.

    Raises:
        DataError: A scenario that the data set does not have.
    """
    assert models.dataset is not None
    for policy in models.policies.values():
        check_jobs(jobs, get_device(policy), "jobs")
    files, items = {}, {}
    for number, scenario_id in enumerate(scenario_ids, 1):
        name = f"{number:02}-{scenario_id.replace('/', '_')}"
        pages = [""] * len(models.evaluations)
        for position in models.policies:
            pages[position] = f"{name}-{position + 1}.html"
            items[pages[position]] = (scenario_id, position)
        items[f"{name}.mp4"] = (scenario_id, None)
        addresses = [f"{FOLDER}/{page}" if page else "" for page in pages]
        files[scenario_id] = {"pages": addresses, "film": f"{FOLDER}/{name}.mp4"}
    identity = repr((
        [(e.name, e.provenance.what_counts()) for e in models.evaluations], sorted(models.policies),
        hash_manifest(models.dataset.folder), list(items), __version__,
    ))  # fmt: skip
    write = partial(_write_scenario_file, models)
    write_files("pages and films", items, write, out / FOLDER, identity, choose_runner(jobs, len(items)))
    return files


def _write_scenario_file(models: EvaluatedModels, path: Path, item: tuple[str, int | None]) -> None:
    """Write the page of a model, or the film of all."""
    scenario_id, position = item
    if position is None:
        to_film(path, models.animate(scenario_id), steps_per_frame=2)
        return
    assert models.dataset is not None
    evaluation, scenario = models.evaluations[position], models.dataset.by_id(scenario_id)
    states = simulate_states(models.policies[position], collate([scenario]), evaluation.config)
    explanation = explain(scenario, states, metric_by_name(evaluation.config.metric))
    write_text(path, explanation_html(explanation, evaluation.name))

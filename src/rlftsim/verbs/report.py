"""`rs.report` and `rlftsim report`: a page that compares evaluated models and shows what they do."""

import os
from pathlib import Path

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.report import build_report, write_report
from rlftsim.evaluation.results import Evaluation
from rlftsim.evaluation.scenario_pages import EvaluatedModels
from rlftsim.evaluation.scenario_source import hash_manifest
from rlftsim.jobs.folder import check_folder, recognize_folder
from rlftsim.jobs.progress import log, print_line
from rlftsim.policies import SHIPPED_POLICIES
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy, frozen_copy
from rlftsim.scenario.dataset import MANIFEST, ScenarioDataset, dataset_folder
from rlftsim.verbs.arguments import Data, Device, File, Models, Reported, Runs
from rlftsim.verbs.inputs import read_result, to_policy, validate_name, with_checked_arguments


@with_checked_arguments
def report(
    results: Reported,
    *,
    out: File,
    models: Models = (),
    data: Data | None = None,
    runs: Runs = (),
    num_listed: int = 10,
    jobs: int = 1,
    device: Device = "auto",
) -> Path:
    """Write a page that compares evaluated models: results, differences, and the scenarios to look at.

    Example: `rlftsim report base.parquet tuned.parquet --models runs/base runs/tuned --out runs/report`

    The second evaluation is judged against the first: the worst scenarios are those in which it loses most, the most
    changed ones those in which both differ most. Where scenarios and models are at hand, each of these has a film, and
    a page for each model that says where the score was lost. An interrupted report goes on when it is called again.

    Args:
        results: Evaluations on the same scenarios, or their Parquet files: the reference first, then the judged one,
            then any others, such as that of the oracle, whose score is what can be lost. In Python also a single one.
        out: Folder of report.html, and of pages and films of scenarios.
        models: Runs, model folders or registered names of the evaluated models, in any order. Models that ship need
            not be named.
        data: Evaluated data set, where it is not in the folder that the evaluation read.
        runs: Training runs whose learning curves and settings are shown; their models are at hand, too.
        num_listed: Number of the worst scenarios, and of the most changed ones, with pages and films; 0 = none.
        jobs: Processes that write pages and films, with models on CPUs.
        device: Device of the models.

    Returns:
        Path of the page.

    Raises:
        ConfigError: A model or data that no evaluation is of, or no evaluation.
        DataError: Evaluations that cannot be compared, no such file, or no such run.
    """
    out = Path(out)
    results = [results] if isinstance(results, Evaluation | str | os.PathLike) else results
    evaluations = [read_result(result, Evaluation) for result in results]
    if not evaluations:
        raise ConfigError("a report needs an evaluation at least: name a Parquet file of `rlftsim evaluate`.")
    check_folder(out, "results")
    folders = [Path(run) for run in runs]
    for folder in folders:
        if recognize_folder(folder) != "run":
            raise DataError(f"{folder} is no training run: name the --out of a training.")
    trained = [folder for folder in folders if (folder / "model").is_dir()]
    policies = _find_policies(evaluations, models, trained, device)
    dataset = _find_dataset(evaluations[0], data)
    evaluated = EvaluatedModels(evaluations, policies, dataset)
    contents = build_report(evaluated, out, runs=folders, num_listed=num_listed, jobs=jobs)
    write_report(out / "report.html", contents)
    return out / "report.html"


def _find_policies(
    evaluations: list[Evaluation], models: Models, runs: list[Path], device: Device
) -> dict[int, Policy]:
    """Models of evaluations, by the position of the evaluation.

    Raises:
        ConfigError: A named model that no evaluation is of.
    """
    fingerprints = [evaluation.provenance.policy_fingerprint for evaluation in evaluations]
    shipped = [evaluation.name for evaluation in evaluations if evaluation.name in SHIPPED_POLICIES]
    policies: dict[int, Policy] = {}
    for model in (*models, *runs, *shipped):
        policy = to_policy(model, device)
        fingerprint = fingerprint_policy(policy)
        if fingerprint not in fingerprints and model in models:
            raise ConfigError(f"{model}: none of the evaluations is of this model: evaluate it, or leave it out.")
        frozen = frozen_copy(policy)
        policies |= {position: frozen for position, other in enumerate(fingerprints) if other == fingerprint}
    for position, evaluation in enumerate(evaluations):
        if position not in policies and evaluation.provenance.policy != "oracle":
            log.info(f"{evaluation.name}: no pages, its model is not at hand: name it with --models.")
    return dict(sorted(policies.items()))


def _find_dataset(evaluation: Evaluation, data: Data | None) -> ScenarioDataset | None:
    """The evaluated data set, if it is at hand.

    Raises:
        ConfigError: Another data set than the evaluated one.
    """
    provenance = evaluation.provenance
    if isinstance(data, ScenarioDataset):
        data = data.folder
    folder = dataset_folder(provenance.dataset if data is None else validate_name(data, "data set", "synthetic"))
    is_present = (folder / MANIFEST).is_file()
    if data is not None or is_present:
        dataset = ScenarioDataset(folder, None)
        if hash_manifest(dataset.folder) == provenance.manifest_sha256:
            return dataset
        if data is not None:
            raise ConfigError(f"{data}: {evaluation.name} was evaluated on other scenarios: name those with --data.")
    log.info(f"no pages and films: {folder} has not the evaluated scenarios: name their data set with --data.")
    return None


def print_report(path: Path) -> None:
    """Print where the report is.

    Args:
        path: Page of the report.
    """
    print_line(f"report: {path}")

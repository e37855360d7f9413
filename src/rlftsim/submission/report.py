"""Report of a built archive, for the authors: contents, origin, checks and the realism to expect.

The report names the method and not the account, so that authors may share the file.
"""

import json
from dataclasses import asdict, dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
import pyarrow as pa
import torch
from rich.table import Table

from rlftsim.errors import DataError
from rlftsim.evaluation.results import SCHEMA, EvaluateConfig, Evaluation, Provenance, Skipped, row_of_result
from rlftsim.evaluation.scenario_source import choose_scenarios, has_road_edge, hash_manifest
from rlftsim.evaluation.score_files import format_scores
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.files import remove_temporaries, write_text
from rlftsim.policies.checkpoint import read_card
from rlftsim.realism import (
    METRIC_2025,
    METRIC_2025_SCENARIO_GEN,
    SIM_AGENTS,
    MetricConfig,
    SimulatedStates,
    metric_by_name,
    score,
)
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import Scenario
from rlftsim.submission.check import CHECKS, ArchiveCheck
from rlftsim.submission.messages import NUM_SCENES, DecodedRollouts

BOARD = {"SMART-tiny": 0.7824, "UniMM": 0.7839, "SMART-tiny CAT-K": 0.7856, "TrajTok": 0.7861, "RLFTSim": 0.7867}
"""RMM on the test split with the weights of 2025, no traffic light term; from the table of RLFTSim (CVPR 2026)."""
BOARD_METRICS = {metric.challenge.name: metric for metric in (METRIC_2025, METRIC_2025_SCENARIO_GEN)}
"""Metric of each challenge's leaderboard, by the challenge's name."""
SERVER_ERRORS = """If the server answers with an error and no reason, or not for days, nothing in the file has to be
wrong: entries wait up to several days, and others have met unexplained errors. Open an issue at
waymo-research/waymo-open-dataset with the submission key that the page shows, the size and the SHA-256 above, and this
report."""


@dataclass(frozen=True)
class Estimate:
    """Realism to be expected of an entry: the same model and settings on the validation split."""

    evaluation: str
    """File of the evaluation."""
    scenarios: int
    rmm: float
    interval: tuple[float, float]
    """95 %."""
    rmm_light_one: float
    """With the traffic light term set to 1, as in tables of models without one."""
    metric: str


def estimate_realism(path: str | PathLike[str], policy_fingerprint: str, config: EvaluateConfig) -> Estimate | str:
    """Realism of an earlier evaluation, or the reason why the evaluation says nothing about an entry.

    Args:
        path: File that `rlftsim evaluate` wrote.
        policy_fingerprint: Hash of the entry's policy; an evaluation of another policy is no estimate.
        config: Settings of the entry's simulation; the evaluation may differ in the split.
    """
    try:
        evaluation = Evaluation.read(path)
    except DataError as error:
        return str(error)
    provenance = evaluation.provenance
    if provenance.policy_fingerprint != policy_fingerprint:
        return f"{path} is of another model."
    settings, evaluated = config.what_counts(), replace(provenance.config, split=config.split).what_counts()
    differing = [name for name in settings if settings[name] != evaluated.get(name)]
    if differing:
        return f"{path} was evaluated with another {', '.join(differing)}."
    rmm = evaluation.mean_and_error("meta_metric")
    rmm_without_light = evaluation.mean_and_error("meta_metric_light_one").mean
    return Estimate(str(path), rmm.count, rmm.mean, rmm.interval, rmm_without_light, config.metric)


@dataclass(frozen=True)
class Report:
    """Contents, checks, origin and expected realism of an archive."""

    check: ArchiveCheck
    method: str
    num_parameters: str
    closed_loop: str
    """Statement that the entry makes."""
    card: str
    """Card of the model, see `model_card`."""
    work: dict[str, Any]
    """Model, data and settings that the archive depends on."""
    seconds: float
    estimate: Estimate | str

    def write(self, archive: Path) -> Path:
        """Write `submission.report.md` and `.json` beside the archive; returns the path of the text."""
        json_path, text_path = (report_path(archive, ending) for ending in ("json", "md"))
        remove_temporaries([json_path, text_path])
        values = summarize(self.check) | vars(self)
        del values["check"]
        write_text(text_path, self.as_text())
        write_text(json_path, json.dumps(values, indent=1, default=asdict) + "\n")
        return text_path

    def as_text(self) -> str:
        """The report in Markdown."""
        check, counts = self.check, self.check.findings.counts
        checks = [
            f"| {number} | {title} | {f'**{counts[number]} findings**' if counts[number] else 'passed'} |"
            for number, title in CHECKS.items()
        ]
        contents = [
            f"* {check.size} bytes ({check.size / 1e9:.3g} GB), SHA-256 `{check.sha256}`",
            f"* {check.num_scenarios} scenarios in {len(check.shards)} shards, {check.num_trajectories} trajectories, "
            f"{check.raw_bytes / 1e9:.3g} GB of messages",
            f"* {self.num_parameters} parameters; built and checked in {self.seconds:.0f} s",
            *(f"* {name}: {value}" for name, value in self.work.items()),
        ]
        findings = [f"* {finding.severity}, check {finding.check}: {finding}" for finding in check.findings.stored]
        sections = {
            f"# Submission {check.archive}: {self.method}": contents,
            "## Checks": ["| | check | result |", "|---|---|---|", *checks, "", *findings],
            "## Realism to expect": _estimate_lines(self.estimate),
            "## Closed loop": [self.closed_loop],
            "## Model": [self.card],
            "## After the upload": [SERVER_ERRORS],
        }
        return "\n".join(line for title, lines in sections.items() for line in (title, "", *lines, ""))


def summarize(check: ArchiveCheck) -> dict[str, Any]:
    """Contents and findings of an archive by name, as JSON files have them."""
    return {
        "archive": check.archive,
        "bytes": check.size,
        "sha256": check.sha256,
        "shards": len(check.shards),
        "scenarios": check.num_scenarios,
        "checked": check.num_checked,
        "trajectories": check.num_trajectories,
        "message_bytes": check.raw_bytes,
        "counts": dict(sorted(check.findings.counts.items())),
        "findings": [asdict(finding) for finding in check.findings.stored],
    }


def model_card(name: str) -> str:
    """Card of a model, with headings two levels down; a sentence for a model without a card."""
    return read_card(name) or f"{name} is no model folder, so it has no card."


def report_path(archive: Path, ending: str) -> Path:
    """Path of an archive's report.

    Args:
        archive: Path of the .tar.gz; the report lies in the same folder.
        ending: "md" or "json".
    """
    return archive.with_name(f"{archive.name.removesuffix('.tar.gz')}.report.{ending}")


def reported_sha256(archive: Path) -> str | None:
    """Checksum in the report beside an archive; None without a report."""
    try:
        return str(read_json(report_path(archive, "json"), "build again")["sha256"])
    except (DataError, FileNotFoundError, KeyError):
        return None


def write_findings(check: ArchiveCheck, path: Path) -> None:
    """Write the findings of a check as JSON.

    Args:
        check: Check of an archive of any writer.
        path: File that is written or replaced.
    """
    write_text(path, json.dumps(summarize(check), indent=1) + "\n")


def _estimate_lines(estimate: Estimate | str) -> list[str]:
    if isinstance(estimate, str):
        return [
            f"Not known: {estimate} `rlftsim evaluate` of the same model, seed and sampling on the validation split "
            "gives an estimate."
        ]
    low, high = estimate.interval
    half = (high - low) / 2
    lines = [
        f"RMM {estimate.rmm:.4f}, 95 % interval {low:.4f} to {high:.4f} (sampling of scenarios), over "
        f"{estimate.scenarios} scenarios of `{estimate.evaluation}`; with the traffic light term set to 1 "
        f"{estimate.rmm_light_one:.4f}. Validation and test split differ."
    ]
    if metric_by_name(estimate.metric).challenge != SIM_AGENTS:
        return lines
    lines += ["", "| published, test split | RMM | this entry, light = 1, minus it |", "|---|---|---|"]
    for name, value in BOARD.items():
        difference = estimate.rmm_light_one - value
        note = " (within noise)" if abs(difference) <= half else ""
        lines.append(f"| {name} | {value:.4f} | {difference:+.4f}{note} |")
    return lines


class ArchiveScores:
    """Realism of the rollouts in an archive, scored scenario by scenario: the number that the file will get.

    An instance is the `callback` of `check_archive`.

    Args:
        data: Scenarios of the archive's split.
        metric: Metric of the challenge that the archive is for.

    Raises:
        DataError: Scenarios without a logged future.
    """

    def __init__(self, data: ScenarioDataset, metric: MetricConfig = METRIC_2025) -> None:
        try:
            choose_scenarios(data, EvaluateConfig(split=data.split))
        except DataError as error:
            raise DataError(f"--score is for the validation split: {error}") from None
        self._data, self._metric = data, metric
        self._rows: list[dict[str, object]] = []
        self._skipped: list[Skipped] = []

    def __call__(self, scenario: Scenario, decoded: DecodedRollouts) -> None:
        """Score a scenario.

        Args:
            scenario: Scenario with the logged future that the metric compares with.
            decoded: Rollouts without an error.
        """
        if not has_road_edge(scenario):
            self._skipped.append(Skipped(scenario.scenario_id, "has no road edge"))
            return
        assert decoded.values is not None
        x, y, z, heading, *sizes = torch.from_numpy(decoded.values).unbind(2)
        size = torch.stack([sizes[1], sizes[0], sizes[2]], -1) if sizes else None  # length before width
        states = SimulatedStates(np.array(decoded.object_ids[0], np.int64), x, y, z, heading, size=size)
        result = score(scenario, states, self._metric)
        self._rows.append(row_of_result(result, scenario, states))

    def table(self, check: ArchiveCheck, sample: float) -> Table:
        """Every mean score, for `print_wide`.

        Args:
            check: Finished check of the archive.
            sample: Fraction of the scenarios that was looked at.

        Raises:
            DataError: No scenario could be scored.
        """
        data = self._data
        if not self._rows:
            reason = self._skipped[0].reason if self._skipped else "none that was read is without an error"
            raise DataError(
                f"--score: none of {len(data)} scenarios of split {data.split} of {data.folder} could be scored "
                f"({reason}): see the findings above{', or give a larger --sample' if sample < 1 else ''}."
            )
        provenance = Provenance(
            config=EvaluateConfig(num_rollouts=NUM_SCENES, metric=self._metric.name, split=data.split),
            policy="rollouts of a submission",
            policy_fingerprint=check.sha256,
            dataset=str(data.folder.absolute()),
            manifest_sha256=hash_manifest(data.folder),
            sources=data.sources,
            guessed=data.guessed,
        )
        table = pa.Table.from_pylist(self._rows, schema=SCHEMA)
        return format_scores(Evaluation(check.archive, provenance, table, tuple(self._skipped)))

"""Report of a built archive, for the authors: contents, origin, checks and the realism to expect.

The report names the method and not the account, so that authors may share the file.
"""

import json
from dataclasses import asdict, dataclass, replace
from os import PathLike
from pathlib import Path
from typing import Any

from rlftsim.errors import DataError
from rlftsim.evaluation.results import EvaluateConfig, Evaluation
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.files import remove_temporaries, write_text
from rlftsim.policies.checkpoint import read_card
from rlftsim.submission.check import ArchiveCheck
from rlftsim.submission.findings import CHECKS, Finding

BOARD = {"SMART-tiny": 0.7824, "UniMM": 0.7839, "SMART-tiny CAT-K": 0.7856, "TrajTok": 0.7861, "RLFTSim": 0.7867}
"""RMM on the test split with the weights of 2025, no traffic light term; from the table of RLFTSim (CVPR 2026)."""
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
    return Estimate(str(path), rmm.count, rmm.mean, rmm.interval, rmm_without_light)


@dataclass(frozen=True)
class Report:
    """Contents, checks, origin and expected realism of an archive."""

    archive: str
    bytes: int
    sha256: str
    method: str
    num_parameters: str
    shards: int
    scenarios: int
    trajectories: int
    message_bytes: int
    findings: tuple[Finding, ...]
    counts: dict[int, int]
    """Findings by check."""
    closed_loop: str
    """Statement that the entry makes."""
    card: str
    """Card of the model, see `model_card`."""
    work: dict[str, Any]
    """Model, data and settings that the archive depends on."""
    seconds: float
    estimate: Estimate | str

    def write(self, archive: Path) -> list[Path]:
        """Write `submission.report.md` and `.json` beside the archive; returns both paths."""
        json_path, text_path = (report_path(archive, ending) for ending in ("json", "md"))
        for path in (json_path, text_path):
            remove_temporaries([path])
        write_text(text_path, self.as_text())
        write_text(json_path, json.dumps(asdict(self), indent=1) + "\n")
        return [text_path, json_path]

    def as_text(self) -> str:
        """The report in Markdown."""
        checks = [
            f"| {number} | {title} | {f'**{self.counts[number]} findings**' if self.counts.get(number) else 'passed'} |"
            for number, title in CHECKS.items()
        ]
        findings = [f"* {finding.severity}, check {finding.check}: {finding}" for finding in self.findings]
        work = [f"* {name}: {value}" for name, value in self.work.items()]
        contents = [
            f"* {self.bytes} bytes ({self.bytes / 1e9:.3g} GB), SHA-256 `{self.sha256}`",
            f"* {self.scenarios} scenarios in {self.shards} shards, {self.trajectories} trajectories, "
            f"{self.message_bytes / 1e9:.3g} GB of messages",
            f"* {self.num_parameters} parameters; built and checked in {self.seconds:.0f} s",
            *work,
        ]
        sections = {
            f"# Submission {self.archive}: {self.method}": contents,
            "## Checks": ["| | check | result |", "|---|---|---|", *checks, "", *findings],
            "## Realism to expect": _estimate_lines(self.estimate),
            "## Closed loop": [self.closed_loop],
            "## Model": [self.card],
            "## After the upload": [SERVER_ERRORS],
        }
        return "\n".join(line for title, lines in sections.items() for line in (title, "", *lines, ""))


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


def select_findings(check: ArchiveCheck) -> tuple[tuple[Finding, ...], dict[int, int]]:
    """The findings of a check in the form of a report, and the number of findings of each check."""
    return tuple(check.findings.stored), dict(sorted(check.findings.counts.items()))


def write_findings(check: ArchiveCheck, path: Path) -> None:
    """Write the findings of a check as JSON.

    Args:
        check: Check of an archive of any writer.
        path: File that is written or replaced.
    """
    findings, counts = select_findings(check)
    values = {
        "archive": check.archive,
        "bytes": check.size,
        "sha256": check.sha256,
        "shards": len(check.shards),
        "scenarios": check.num_scenarios,
        "checked": check.num_checked,
        "counts": counts,
        "findings": [asdict(finding) for finding in findings],
    }
    write_text(path, json.dumps(values, indent=1) + "\n")


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
        f"{estimate.rmm_light_one:.4f}. Validation and test split differ.",
        "",
        "| published, test split | RMM | this entry, light = 1, minus it |",
        "|---|---|---|",
    ]
    for name, value in BOARD.items():
        difference = estimate.rmm_light_one - value
        note = " (within noise)" if abs(difference) <= half else ""
        lines.append(f"| {name} | {value:.4f} | {difference:+.4f}{note} |")
    return lines

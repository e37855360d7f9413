"""The verb for entries of the Sim Agents challenge: submit build, check, info."""

import time
from dataclasses import dataclass, field
from pathlib import Path
from typing import Annotated

import tyro
from tyro.conf import Positional

from rlftsim.errors import ConfigError, DataError, shorten
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluation_name, frozen_copy
from rlftsim.evaluation.scenario_source import choose_scenarios
from rlftsim.evaluation.score_files import format_scores
from rlftsim.jobs.folder import check_file
from rlftsim.jobs.progress import print_wide
from rlftsim.jobs.runner import Work
from rlftsim.policies.registry import Device, load_policy
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.simulate import check_sampling
from rlftsim.scenario.open import open_dataset
from rlftsim.submission.build import Job, build_archive, delete_parts
from rlftsim.submission.check import ArchiveCheck, check_archive
from rlftsim.submission.closed_loop import check_closed_loop, statement
from rlftsim.submission.entry import count_parameters, describe_entry, read_entry
from rlftsim.submission.plan import check_complete, check_sources, make_plan
from rlftsim.submission.report import (
    Report,
    estimate_realism,
    model_card,
    reported_sha256,
    select_findings,
    write_findings,
)
from rlftsim.submission.scores import ArchiveScores
from rlftsim.submission.transfer import split_file

CACHED_SCENARIOS = 2
"""Each is read once."""
EVALUATIONS = Path("runs/evaluations")


@dataclass(frozen=True)
class Build:
    """Simulate a split and pack it as a .tar.gz for the upload page, checked. Nothing is uploaded.

    An interrupted build continues when the same command is repeated. The archive's bytes depend on model, data and
    settings alone.
    """

    model: Annotated[Positional[str], tyro.conf.arg(metavar="MODEL")]
    """A run, a model folder, or a registered name."""
    data: str
    """Folder of a data set, or "synthetic" for the scenarios that ship with the package."""
    out: Path
    """Folder of the archive."""
    config: Path
    """TOML file with account, method, authors, affiliation, description and link (docs/submission.md)."""
    split: str = "testing"
    """Split of the data set."""
    account: str | None = None
    """E-mail address of the account that uploads, in place of the file's."""
    method: str | None = None
    """Name on the leaderboard, in place of the file's."""
    i_comply: bool = False
    """Declare that the entry complies with the closed-loop requirement. Without it, the statement is printed."""
    num_shards: int = 150
    """Files in the archive; one is repeated by an interruption of each process."""
    seed: int = 0
    """Seed of the rollouts."""
    temperature: float = 1.0
    """Sampling temperature."""
    top_k: int | None = None
    """Sample among the TOP_K most likely motions only."""
    rollouts_per_pass: int = 8
    """Rollouts simulated together. Changes no result."""
    jobs: int = 1
    """Processes, each with one thread. Changes no byte."""
    device: Device = "auto"
    """Device of the model; several processes (--jobs) need cpu."""
    round: float | None = None
    """Round positions to a power of two of at most so many meters. 0.001 makes the archive about a seventh smaller and
    changed the meta-metric of 13 real scenarios by at most 0.00005."""
    delete_parts: bool = False
    """Delete each compressed shard once it is in the archive: half the disk space, and damage found later means
    simulating again."""
    partial: bool = False
    """Build although files of the split are missing, to try things out. The server refuses such an archive."""
    evaluation: Path | None = None
    """Evaluation of the same model on the validation split, for the estimate in the report. Left out:
    runs/evaluations/MODEL.parquet."""
    work: Annotated[Work, tyro.conf.arg(name="")] = field(default_factory=Work)

    def run(self) -> int:
        """Refuse what can be refused, build, check, report; exit status 1 if the server would refuse the archive."""
        start = time.monotonic()
        # 1. everything that can be refused is refused before anything is simulated
        entry = read_entry(self.config, account=self.account, method=self.method)
        policy = frozen_copy(load_policy(self.model, self.device))
        data = open_dataset(self.data, self.split, cache_size=CACHED_SCENARIOS)
        config = EvaluateConfig(
            seed=self.seed, temperature=self.temperature, top_k=self.top_k,
            split=self.split, rollouts_per_pass=self.rollouts_per_pass, jobs=self.jobs,
        )  # fmt: skip
        check_sources(data)
        if not self.partial:
            check_complete(data)
        check_closed_loop(policy, data[0])
        check_sampling(policy, data, config.sampling)
        closed_loop = statement(policy, config.sampling)
        print(closed_loop)
        if not self.i_comply:
            raise ConfigError("an entry has to declare this: add --i-comply if it is true of yours.")
        # 2. build
        parameters = count_parameters(policy)
        metadata = describe_entry(entry, parameters)
        fingerprint = fingerprint_policy(policy)
        plan = make_plan(data, fingerprint, metadata, config, num_shards=self.num_shards, round_m=self.round)
        job = Job(policy, data, plan, metadata, config, self.round, self.out)
        archive = build_archive(
            job,
            runner=self.work.runner(self.jobs, self.work.on_error),
            delete_parts=self.delete_parts,
        )
        # 3. check the file that will be uploaded, and report
        check = check_archive(archive, data)
        evaluation = self.evaluation or EVALUATIONS / f"{evaluation_name(self.model)}.parquet"
        findings, counts = select_findings(check)
        work = {"model": self.model, "data set": str(data.folder), **plan.identity}
        report = Report(
            archive.name, check.size, check.sha256, entry.method, parameters, len(check.shards), check.num_scenarios,
            check.num_trajectories, check.raw_bytes, findings, counts, closed_loop, model_card(self.model),
            work, time.monotonic() - start,
            estimate_realism(evaluation, fingerprint, config),
        )  # fmt: skip
        text, _ = report.write(archive)
        _print_findings(check)
        if check.findings.has_errors:
            print(f"{archive} cannot be uploaded: remove it and repeat the command, which builds it anew.")
        else:
            delete_parts(job)
        print(f"{archive}: {check.size} bytes, SHA-256 {check.sha256}\n{text}")
        return int(check.findings.has_errors)


@dataclass(frozen=True)
class Check:
    """Check an archive of any writer against the data set: everything that is known to make the server refuse one."""

    archive: Positional[Path]
    """The .tar.gz."""
    data: str
    """Folder of a data set, or "synthetic"."""
    split: str = "testing"
    """Split that the archive is for."""
    sample: float = 1.0
    """Fraction of the scenarios whose trajectories are looked at, for a quick look."""
    json: Path | None = None
    """File for the findings as JSON."""
    score: bool = False
    """Score the rollouts, too; for an archive of the validation split."""

    def run(self) -> int:
        """Print the findings; exit status 1 if there is an error.

        Raises:
            DataError: `score`, and the scenarios have no logged future, or the archive no scenario that can be scored.
        """
        if self.json is not None:
            check_file(self.json)
        data = open_dataset(self.data, self.split, cache_size=CACHED_SCENARIOS)
        if self.score:
            try:
                choose_scenarios(data, EvaluateConfig(split=self.split))
            except DataError as error:
                raise DataError(f"--score is for the validation split: {error}") from None
        scores = ArchiveScores() if self.score else None
        check = check_archive(
            self.archive, data, sample=self.sample, expected_sha256=reported_sha256(self.archive), see=scores
        )
        _print_findings(check)
        if self.json is not None:
            write_findings(check, self.json)
        if scores is not None:
            evaluation = scores.evaluation(check.archive, data, check.sha256)
            if not len(evaluation):
                reason = (
                    evaluation.skipped[0].reason if evaluation.skipped else "none that was read is without an error"
                )
                raise DataError(
                    f"--score: none of {len(data)} scenarios of split {self.split} of {self.data} could be scored "
                    f"({reason}): see the findings above{', or give a larger --sample' if self.sample < 1 else ''}."
                )
            print_wide(format_scores(evaluation))
        return int(check.findings.has_errors)


@dataclass(frozen=True)
class Info:
    """Print what is in an archive, without a data set."""

    archive: Positional[Path]
    """The .tar.gz."""
    split_gb: float | None = None
    """Also cut the archive into parts of so many GB, for moving it about. The upload page takes the joined file."""

    def run(self) -> int:
        """Print names, sizes and fields."""
        check = check_archive(self.archive, None)
        _print_findings(check)
        if check.metadata is not None:
            for field, value in check.metadata.ListFields():
                text = ", ".join(map(str, value)) if field.is_repeated else str(value)
                print(f"  {field.name}: {shorten(text)}")
        if self.split_gb is not None:
            parts = split_file(self.archive, self.split_gb)
            print(f"{len(parts)} parts; join them with: cat {self.archive.name}.??? > {self.archive.name}")
        return int(check.findings.has_errors)


def _print_findings(check: ArchiveCheck) -> None:
    for line in check.findings.lines():
        print(line)
    looked = "" if check.num_checked == check.num_scenarios else f", trajectories of {check.num_checked} looked at"
    print(
        f"{check.archive}: {len(check.shards)} shards, {check.num_scenarios} scenarios{looked}, "
        f"{check.raw_bytes / 1e9:.3g} GB of messages, {check.size} bytes, SHA-256 {check.sha256}: "
        f"{sum(check.findings.counts.values()) or 'no'} findings."
    )


@dataclass(frozen=True)
class Submit:
    """Build, check or describe an archive for the Sim Agents challenge (docs/submission.md)."""

    action: (
        Annotated[Build, tyro.conf.subcommand("build")]
        | Annotated[Check, tyro.conf.subcommand("check")]
        | Annotated[Info, tyro.conf.subcommand("info")]
    )

    def run(self) -> int:
        """Run the action."""
        return self.action.run()

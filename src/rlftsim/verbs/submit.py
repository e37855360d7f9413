"""`rlftsim submit`: build, check or describe an archive for the Sim Agents or Scenario Generation challenge."""

import time
from pathlib import Path
from typing import Literal

from rlftsim.errors import ConfigError, shorten
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluation_name
from rlftsim.jobs.folder import check_file
from rlftsim.jobs.progress import print_line, print_lines, print_wide
from rlftsim.jobs.runner import Work
from rlftsim.policies.registry import load_policy
from rlftsim.scenario.open import open_dataset
from rlftsim.submission.archive import split_file
from rlftsim.submission.build import build_archive, delete_shards
from rlftsim.submission.check import ArchiveCheck, check_archive
from rlftsim.submission.entry import count_parameters, read_entry, statement
from rlftsim.submission.plan import prepare_job
from rlftsim.submission.report import (
    BOARD_METRICS,
    ArchiveScores,
    Report,
    estimate_realism,
    model_card,
    reported_sha256,
    write_findings,
)
from rlftsim.verbs.arguments import Device

ChallengeName = Literal["sim-agents", "scenario-gen"]
CACHED_SCENARIOS = 2
"""Each is read once."""
EVALUATIONS = Path("runs/evaluations")


def build(
    model: str,
    data: str,
    out: Path,
    config: Path,
    *,
    challenge: ChallengeName = "sim-agents",
    split: str = "testing",
    account: str | None = None,
    method: str | None = None,
    i_comply: bool = False,
    num_shards: int = 150,
    seed: int = 0,
    temperature: float = 1.0,
    top_k: int | None = None,
    rollouts_per_pass: int = 8,
    jobs: int = 1,
    device: Device = "auto",
    round: float | None = None,
    delete_parts: bool = False,
    partial: bool = False,
    evaluation: Path | None = None,
    work: Work = Work(),  # noqa: B008
) -> int:
    """Simulate a split and pack it as a .tar.gz for the upload page, checked. Nothing is uploaded.

    An interrupted build continues when the same command is repeated. The archive's bytes depend on model, data and
    settings alone. The exit status is 1 if the server would refuse the archive.

    Args:
        model: Run, model folder, or registered name.
        data: Folder of a data set, or "synthetic" for the scenarios that ship with the package.
        out: Folder of the archive.
        config: TOML file with account, method, authors, affiliation, description and link (docs/submission.md).
        challenge: Challenge of the entry. Scenario generation makes whole scenes: agents but the ego begin at states
            drawn from the lanes.
        split: Split of the data set.
        account: E-mail address of the account that uploads, in place of the file's.
        method: Name on the leaderboard, in place of the file's.
        i_comply: Declare that the entry complies with the closed-loop requirement. Without it, the statement is
            printed.
        num_shards: Number of files in the archive; one is repeated by an interruption of each process.
        seed: Seed of the rollouts.
        temperature: Sampling temperature; 0 always takes the most likely motion.
        top_k: Number of candidates: sample among the TOP_K most likely motions only.
        rollouts_per_pass: Rollouts simulated together. Changes no result.
        jobs: Processes, each with one thread. Changes no byte.
        device: Device of the model; several processes (--jobs) need cpu.
        round: Grid of positions: rounded to a power of two of at most so many meters. 0.001 makes the archive about a
            seventh smaller and changed the meta-metric of 13 real scenarios by at most 0.00005.
        delete_parts: Delete each compressed shard once it is in the archive: half the disk space, and damage
            found later means simulating again.
        partial: Build although files of the split are missing, to try things out. The server refuses such an
            archive.
        evaluation: Evaluation of the same model on the validation split, for the estimate in the report. Left
            out: runs/evaluations/MODEL.parquet.
        work: Machines that share the work.
    """
    start = time.monotonic()
    entry = read_entry(config, account=account, method=method)
    policy = load_policy(model, device)
    dataset = open_dataset(data, split, cache_size=CACHED_SCENARIOS)
    settings = EvaluateConfig(
        metric=BOARD_METRICS[challenge].name, seed=seed, temperature=temperature, top_k=top_k, split=split,
        rollouts_per_pass=rollouts_per_pass, jobs=jobs,
    )  # fmt: skip
    job = prepare_job(entry, policy, dataset, settings, out, num_shards=num_shards, round_m=round, is_partial=partial)
    closed_loop = statement(policy, settings.sampling, settings.challenge)
    print_lines(closed_loop)
    if not i_comply:
        raise ConfigError("an entry has to declare this: add --i-comply if it is true of yours.")
    archive = build_archive(job, runner=work.runner(jobs, work.on_error), is_deleting=delete_parts)
    # the file that will be uploaded is checked, not what was meant to be in it
    result = check_archive(archive, dataset, challenge=settings.challenge)
    evaluation = evaluation or EVALUATIONS / f"{evaluation_name(model)}.parquet"
    report = Report(
        result, entry.method, count_parameters(policy), closed_loop, model_card(model),
        {"model": model, "data set": str(dataset.folder), **job.plan.identity}, time.monotonic() - start,
        estimate_realism(evaluation, str(job.plan.identity["policy"]), settings),
    )  # fmt: skip
    text_path = report.write(archive)
    _print_findings(result)
    if result.findings.has_errors:
        print_line(f"{archive} cannot be uploaded: remove it and repeat the command, which builds it anew.")
    else:
        delete_shards(job)
    print_lines(f"{archive}: {result.size} bytes, SHA-256 {result.sha256}\n{text_path}")
    return int(result.findings.has_errors)


def check(
    archive: Path,
    data: str,
    *,
    challenge: ChallengeName = "sim-agents",
    split: str = "testing",
    sample: float = 1.0,
    json: Path | None = None,
    score: bool = False,
) -> int:
    """Check an archive of any writer against the data set: everything that is known to make the server refuse one.

    The exit status is 1 if there is an error.

    Args:
        archive: Archive (.tar.gz) to check, of this or another writer.
        data: Folder of a data set, or "synthetic".
        challenge: Challenge that the archive is for.
        split: Split that the archive is for.
        sample: Fraction of the scenarios whose trajectories are looked at, for a quick look.
        json: File for the findings as JSON.
        score: Score the rollouts, too; for an archive of the validation split.

    Raises:
        DataError: `score`, and the scenarios have no logged future, or the archive no scenario that can be scored.
    """
    if json is not None:
        check_file(json)
    dataset = open_dataset(data, split, cache_size=CACHED_SCENARIOS)
    metric = BOARD_METRICS[challenge]
    scores = ArchiveScores(dataset, metric) if score else None
    checksum = reported_sha256(archive)
    result = check_archive(
        archive, dataset, sample=sample, expected_sha256=checksum, challenge=metric.challenge, callback=scores
    )
    _print_findings(result)
    if json is not None:
        write_findings(result, json)
    if scores is not None:
        print_wide(scores.table(result, sample))
    return int(result.findings.has_errors)


def info(archive: Path, *, split_gb: float | None = None) -> int:
    """Print what is in an archive, without a data set.

    Args:
        archive: Archive (.tar.gz) to describe, of this or another writer.
        split_gb: Size in GB of parts that the archive is also cut into, for moving it about. The upload page takes the
            joined file.
    """
    result = check_archive(archive, None)
    _print_findings(result)
    if result.metadata is not None:
        for entry, value in result.metadata.ListFields():
            text = ", ".join(map(str, value)) if entry.is_repeated else str(value)
            print_line(f"  {entry.name}: {shorten(text)}")
    if split_gb is not None:
        files = split_file(archive, split_gb)
        print_line(f"{len(files)} parts; join them with: cat {archive.name}.??? > {archive.name}")
    return int(result.findings.has_errors)


def _print_findings(check: ArchiveCheck) -> None:
    """Print each finding, and what was checked."""
    for line in check.findings.lines():
        print_line(line)
    note = "" if check.num_checked == check.num_scenarios else f", trajectories of {check.num_checked} looked at"
    print_line(
        f"{check.archive}: {len(check.shards)} shards, {check.num_scenarios} scenarios{note}, "
        f"{check.raw_bytes / 1e9:.3g} GB of messages, {check.size} bytes, SHA-256 {check.sha256}: "
        f"{sum(check.findings.counts.values()) or 'no'} findings."
    )

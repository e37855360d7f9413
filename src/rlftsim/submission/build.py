"""Archives for the Sim Agents challenge: simulate a split shard by shard, pack, check.

    OUT/plan.json                what the shards depend on; another plan is refused
    OUT/shards/00003.part        a finished shard, compressed (`submission.archive`)
    OUT/shards/00003.json        its receipt, written after it
    OUT/submission.tar.gz        appears when it is whole

A build that was interrupted in any way goes on with the shards that have no receipt. The bytes of the archive depend on
the plan alone, not on processes or interruptions.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from rlftsim.errors import ConfigError, DataError, require_types
from rlftsim.evaluation.evaluate import check_jobs, simulate_states
from rlftsim.evaluation.results import EvaluateConfig
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.files import (
    errors_name,
    remove_folder,
    remove_temporaries,
    remove_temporaries_below,
    temporary_beside,
    write_text,
)
from rlftsim.jobs.folder import check_folder
from rlftsim.jobs.lease import Lease, remove_locks
from rlftsim.jobs.progress import log, progress_bar
from rlftsim.jobs.runner import Runner, on_this_machine, require_finished
from rlftsim.jobs.threads import one_thread
from rlftsim.rollout.policy import Policy, get_device
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import Scenario
from rlftsim.submission.archive import Piece, count_joined, join_pieces, write_piece
from rlftsim.submission.messages import decode_rollouts, encode_rollouts, encode_varint, round_states
from rlftsim.submission.plan import GZIP_RATIO, PLAN, Plan
from rlftsim.submission.scenario_checks import check_rollouts

ARCHIVE = "submission.tar.gz"
_SHARDS, _LOCK = "shards", ".lock"


@dataclass(frozen=True)
class Job:
    """Input of the work on a shard; is handed to other processes."""

    policy: Policy
    data: ScenarioDataset
    plan: Plan
    metadata: bytes
    """Fields that each shard repeats, see `submission.entry`."""
    config: EvaluateConfig
    round_m: float | None
    folder: Path

    def piece_path(self, number: int) -> Path:
        """File of a finished shard."""
        return self.folder / _SHARDS / f"{number:05d}.part"

    def receipt_path(self, number: int) -> Path:
        """Receipt of a finished shard."""
        return self.folder / _SHARDS / f"{number:05d}.json"

    def receipt(self, number: int) -> Piece | None:
        """A finished shard; None if there is none. Its file may be in the archive already."""
        try:
            piece = Piece(**read_json(self.receipt_path(number), "build again"))
            require_types(piece)
        except (DataError, ConfigError, FileNotFoundError, TypeError):
            return None
        return piece if piece.file == self.piece_path(number).name else None


def build_archive(
    job: Job, *, runner: Runner | None = None, delete_parts: bool = False, show_progress: bool = True
) -> Path:
    """Simulate what is missing and write the archive; returns its path. Interrupted in any way, the same call goes on.

    Args:
        job: policy, data, plan and settings.
        runner: does the work in place of the settings' processes, see `rlftsim.jobs.runner`.
        delete_parts: remove each compressed shard as soon as it is in the archive. Halves the disk space.
        show_progress: False = no progress bar.

    Raises:
        ConfigError: several processes for a policy on a GPU, or a folder with work on another plan.
        DataError: rollouts that the server would refuse, a disk that is full, or another driver at work here.
        SetAside: shards that killed their process again and again; all others are done.
        Unfinished: `runner` is a share, which is done, while others are not.
    """
    check_folder(job.folder, "submission")
    check_jobs(job.config, get_device(job.policy))
    archive = job.folder / ARCHIVE
    numbers = range(len(job.plan.shards))
    runner = runner or on_this_machine(job.config.jobs, len(numbers))
    if archive.exists():
        if not (job.folder / PLAN).exists():
            raise DataError(f"{archive} is there without its {PLAN}: name another --out, or remove it.")
        job.plan.claim(job.folder)
        remove_locks(job.folder / _LOCK)  # of a process that was killed between the archive and its end
        return archive
    with Lease(job.folder / _LOCK, runner, "builds in") as lease:
        job.plan.claim(job.folder)
        shards = job.folder / _SHARDS
        shards.mkdir(exist_ok=True)
        if lease.is_alone:
            remove_temporaries_below(shards)
        receipts = [job.receipt(n) for n in numbers]
        num_joined = count_joined(archive, shards, receipts)
        own = runner.own(numbers)
        missing = [n for n in own if n >= num_joined and (receipts[n] is None or not job.piece_path(n).exists())]
        total, left = (sum(len(job.plan.shards[n]) for n in some) for some in (own, missing))
        _forecast(job, len(missing))
        with progress_bar("submit", total, total - left, show=show_progress) as advance, one_thread():
            runner.run(partial(_build_shard, job), missing, advance=advance, name_of=job.plan.shard_name)
        lease.finish("submit")
        remove_temporaries_below(shards)
        remove_temporaries(job.folder / PLAN)
        pieces = [piece for piece in map(job.receipt, numbers) if piece is not None]
        require_finished(runner, len(numbers) - len(pieces), len(numbers), "submit")
        join_pieces(archive, shards, pieces, delete=delete_parts)
        lease.remove()
    return archive


def delete_parts(job: Job) -> None:
    """Remove the compressed shards of a finished archive and their receipts."""
    paths = [path for n in range(len(job.plan.shards)) for path in (job.piece_path(n), job.receipt_path(n))]
    remove_folder(job.folder / _SHARDS, [path.name for path in paths])


def _forecast(job: Job, num_missing: int) -> None:
    """Say how large the archive will be, and if the disk has too little room."""
    low, high = (ratio * job.plan.message_bytes / 1e9 for ratio in GZIP_RATIO)
    free = shutil.disk_usage(job.folder).free / 1e9
    log.info(
        f"{sum(len(s) for s in job.plan.shards)} scenarios, {sum(job.plan.num_agents)} agents, {len(job.plan.shards)} "
        f"shards, {num_missing} to simulate: {job.plan.message_bytes / 1e9:.3g} GB of messages, an archive of about "
        f"{low:.3g} to {high:.3g} GB; {free:.3g} GB free in {job.folder}."
    )
    needed = 2 * high * num_missing / len(job.plan.shards)
    if needed > free:
        log.warning(f"  parts and archive need up to {needed:.3g} GB: make room, or halve that with --delete-parts.")


def _build_shard(job: Job, number: int, advance: Callable[[int], None], is_stopped: Callable[[], bool]) -> None:
    """Simulate the scenarios of a shard, write it, compress it, sign for it."""
    name = job.plan.shard_name(number)
    raw = temporary_beside(job.folder / _SHARDS / name)
    try:
        with errors_name(raw), raw.open("wb") as file:
            file.write(job.metadata)
            for position in job.plan.shards[number]:
                if is_stopped():
                    return
                message = _simulate_message(job, job.data[position], name)
                file.write(b"\x0a" + encode_varint(len(message)) + message)
                advance(1)
        piece = write_piece(raw, name, job.piece_path(number))
    finally:
        raw.unlink(missing_ok=True)
    is_first = not any(job.receipt_path(n).exists() for n in range(len(job.plan.shards)))
    write_text(job.receipt_path(number), json.dumps(asdict(piece)) + "\n")
    if is_first:
        size = forecast_size(job.plan, number, piece)
        log.info(
            f"  first shard: compressed to {piece.size / piece.raw_size:.3f}, so the archive will have "
            f"about {size / 1e9:.3g} GB."
        )


def _simulate_message(job: Job, scenario: Scenario, shard: str) -> bytes:
    """Rollouts of a scenario as they are written, checked."""
    states = simulate_states(job.policy, scenario, job.config, get_device(job.policy))
    message = encode_rollouts(scenario.scenario_id, round_states(states, job.round_m))
    for finding in check_rollouts(decode_rollouts(message), scenario, shard).findings:
        if finding.severity == "error":
            raise DataError(f"check {finding.check}: {finding}. Nothing of this shard is kept.")
    return message


def forecast_size(plan: Plan, number: int, piece: Piece) -> float:
    """Bytes that the archive will have, from one finished shard.

    Args:
        plan: of the archive.
        number: of the shard.
        piece: the shard.
    """
    return piece.size / plan.num_agents[number] * sum(plan.num_agents)

"""Archives for the challenges of the Waymo Open Dataset: simulate a split shard by shard, pack, check.

    OUT/plan.json                all that the shards depend on; any other plan is refused
    OUT/shards/00003.part        a finished shard, compressed (`submission.archive`)
    OUT/shards/00003.json        receipt of the shard, written afterwards
    OUT/submission.tar.gz        appears when complete

A build that was interrupted in any way goes on with the shards that have no receipt. The bytes of the archive depend on
the plan alone, not on processes or interruptions.
"""

import json
import shutil
from collections.abc import Callable
from dataclasses import asdict, dataclass
from functools import partial
from pathlib import Path

from rlftsim.errors import DataError
from rlftsim.evaluation.rollout_states import simulate_states
from rlftsim.jobs.files import errors_name, remove_folder, remove_temporaries, temporary_path, write_text
from rlftsim.jobs.folder import Lease, check_folder, remove_locks
from rlftsim.jobs.items import ResultFormat, run_items
from rlftsim.jobs.progress import log
from rlftsim.jobs.runner import Advance, Runner, check_jobs, choose_runner, select_items
from rlftsim.rollout.policy import get_device
from rlftsim.scenario.batch import collate
from rlftsim.submission.archive import PackedShard, count_joined, join_shards, pack_shard
from rlftsim.submission.check import check_rollouts
from rlftsim.submission.messages import decode_rollouts, encode_rollouts, encode_varint, round_states
from rlftsim.submission.plan import GZIP_RATIO, PLAN, SHARDS, Job, Plan

ARCHIVE = "submission.tar.gz"
_LOCK = ".lock"


@dataclass(frozen=True)
class _Receipts(ResultFormat[int, PackedShard]):
    """Finished shards by number, from the receipts; the first shards may be in the unfinished archive alone."""

    job: Job
    num_joined: int

    def read(self, item: int) -> PackedShard | None:
        """The receipt of a shard, see `ResultFormat`."""
        return self.job.receipt(item)

    def is_finished(self, item: int) -> bool:
        """True for a shard with receipt and file, or in the archive, see `ResultFormat`."""
        return item < self.num_joined or (self.read(item) is not None and self.job.shard_path(item).exists())

    def count_units(self, item: int) -> int:
        """Number of scenarios, see `ResultFormat`."""
        return len(self.job.plan.shards[item])

    def describe(self, item: int) -> str:
        """Name of the shard in the archive, see `ResultFormat`."""
        return self.job.plan.shard_name(item)


def build_archive(
    job: Job, *, runner: Runner | None = None, is_deleting: bool = False, show_progress: bool = True
) -> Path:
    """Simulate the missing shards, write the archive and return the path. After an interruption the same call goes on.

    Args:
        job: Policy, data, plan and settings of the submission.
        runner: Runner of the work in place of the settings' processes, see `rlftsim.jobs.runner`.
        is_deleting: True removes each compressed shard as soon as the archive holds the bytes: half the disk space.
        show_progress: False prints neither progress nor the time left.

    Raises:
        ConfigError: Several processes for a policy on a GPU, or a folder with work on another plan.
        DataError: Rollouts that the server would refuse, a disk that is full, or another driver at work here.
        SetAside: Shards that killed a process again and again; all remaining shards are done.
        Unfinished: `runner` is a share, which is done, while the remaining shares are not.
    """
    check_folder(job.folder, "submission")
    check_jobs(job.config.jobs, get_device(job.policy))
    archive = job.folder / ARCHIVE
    numbers = range(len(job.plan.shards))
    runner = runner or choose_runner(job.config.jobs, len(numbers))
    if archive.exists():
        if not (job.folder / PLAN).exists():
            raise DataError(f"{archive} is there without its {PLAN}: name another --out, or remove it.")
        job.plan.claim(job.folder)
        remove_locks(job.folder / _LOCK)  # of a process that was killed between the archive and its end
        return archive
    with Lease(job.folder / _LOCK, runner, "builds in") as lease:
        job.plan.claim(job.folder)
        shards = job.folder / SHARDS
        shards.mkdir(exist_ok=True)
        outputs = [
            path for n in numbers for path in (shards / job.plan.shard_name(n), job.shard_path(n), job.receipt_path(n))
        ]
        if lease.is_alone:
            remove_temporaries(outputs)
        receipts = _Receipts(job, count_joined(archive, shards, [job.receipt(n) for n in numbers]))
        _forecast(job, sum(not receipts.is_finished(n) for n in select_items(runner, numbers)))
        task = partial(_build_shard, job)
        packed_shards = run_items("submit", numbers, task, format=receipts, lease=lease, show_progress=show_progress)
        remove_temporaries([*outputs, job.folder / PLAN])
        join_shards(archive, shards, packed_shards, delete=is_deleting)
        lease.remove()
    return archive


def delete_shards(job: Job) -> None:
    """Remove the compressed shards of a finished archive, and the receipts."""
    paths = [path for n in range(len(job.plan.shards)) for path in (job.shard_path(n), job.receipt_path(n))]
    remove_folder(job.folder / SHARDS, [path.name for path in paths])


def _forecast(job: Job, num_missing: int) -> None:
    """Log the size of the archive to come, and warn of a disk with too little room."""
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


def _build_shard(job: Job, number: int, advance: Advance, is_stopped: Callable[[], bool]) -> None:
    """Simulate the scenarios of a shard; write, compress and sign for the shard."""
    name = job.plan.shard_name(number)
    raw = temporary_path(job.folder / SHARDS / name)
    try:
        with errors_name(raw), raw.open("wb") as file:
            file.write(job.metadata)
            for position in job.plan.shards[number]:
                if is_stopped():
                    return
                message = _simulate_message(job, position, name)
                file.write(b"\x0a" + encode_varint(len(message)) + message)
                advance(1)
        shard = pack_shard(raw, name, job.shard_path(number))
    finally:
        raw.unlink(missing_ok=True)
    is_first = not any(job.receipt_path(n).exists() for n in range(len(job.plan.shards)))
    write_text(job.receipt_path(number), json.dumps(asdict(shard)) + "\n")
    if is_first:
        size_gb = forecast_size(job.plan, number, shard) / 1e9
        ratio = shard.size / shard.raw_size
        log.info(f"  first shard: compressed to {ratio:.3f}, so the archive will have about {size_gb:.3g} GB.")


def _simulate_message(job: Job, position: int, shard: str) -> bytes:
    """Serialized rollouts of a scenario for the archive, checked."""
    scenario = job.data[position]
    states = round_states(simulate_states(job.policy, collate([scenario]), job.config), job.round_m)
    message = encode_rollouts(scenario.scenario_id, states, scenario.tracks.object_type[scenario.simulated_indices])
    for finding in check_rollouts(decode_rollouts(message), scenario, shard, job.config.challenge).findings:
        if finding.severity == "error":
            raise DataError(f"check {finding.check}: {finding}. Nothing of this shard is kept.")
    return message


def forecast_size(plan: Plan, number: int, shard: PackedShard) -> float:
    """Bytes that the archive will have, extrapolated from a finished shard.

    Args:
        plan: Plan of the archive, with the number of agents in each shard.
        number: Number of the finished shard in the plan.
        shard: The finished shard, whose size per agent stands for all shards.
    """
    return shard.size / plan.num_agents[number] * sum(plan.num_agents)

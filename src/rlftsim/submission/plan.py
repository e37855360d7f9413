"""Plan of a submission: the scenarios of each shard, the settings that bytes depend on, and the input of a build."""

import hashlib
import re
from collections.abc import Mapping
from dataclasses import dataclass
from itertools import pairwise
from pathlib import Path

import numpy as np

from rlftsim.errors import ConfigError, DataError, check_types
from rlftsim.evaluation.results import NUMBERS_VERSION, EvaluateConfig
from rlftsim.jobs.documents import read_json
from rlftsim.jobs.folder import describe_differences, find_differences, write_identity
from rlftsim.realism import SIM_AGENTS, Challenge
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy, frozen_copy
from rlftsim.rollout.simulate import check_sampling
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.tfrecord import count_lost
from rlftsim.submission.archive import PackedShard
from rlftsim.submission.entry import Entry, check_closed_loop, count_parameters, describe_entry
from rlftsim.submission.messages import NUM_SCENES, count_bytes

FORMAT = "rlftsim-submission-1"
PLAN, SHARDS = "plan.json", "shards"
GZIP_RATIO = (0.56, 0.64)
"""Compressed size of sampled rollouts, lowest and highest of five models."""
_NUMBERED = re.compile(r"(.*)-(\d{5})-of-(\d{5})")


@dataclass(frozen=True)
class Plan:
    """Shards as ranges of positions in the split, and the identity of the work."""

    shards: tuple[range, ...]
    num_agents: tuple[int, ...]
    """Simulated agents of each shard."""
    identity: Mapping[str, object]
    """Plain values that a folder's earlier work must agree with to be continued."""
    challenge: Challenge = SIM_AGENTS

    def shard_name(self, number: int) -> str:
        """Name of a shard in the archive, in the challenge's form."""
        return f"submission.binproto-{number:05d}-of-{len(self.shards):05d}"

    @property
    def message_bytes(self) -> int:
        """Forecast of the uncompressed size."""
        return sum(self.num_agents) * NUM_SCENES * count_bytes(self.challenge)

    def claim(self, folder: Path) -> None:
        """Write the plan into a folder, or compare the plan with the stored plan.

        Raises:
            ConfigError: The folder holds work on another plan.
        """
        path = folder / PLAN
        values = {**self.identity, "shards": [[shard.start, shard.stop] for shard in self.shards]}
        if differences := find_differences(path, values, "name another --out, or remove the folder"):
            raise ConfigError(
                f"{folder} holds a submission of another {describe_differences(differences, values)}: name another "
                "--out, or remove it."
            )
        if not path.exists():
            write_identity(path, values)


def make_plan(
    data: ScenarioDataset,
    policy_fingerprint: str,
    metadata: bytes,
    config: EvaluateConfig,
    *,
    num_shards: int,
    round_m: float | None,
) -> Plan:
    """Shards of about equal numbers of agents, in the order of the split.

    Args:
        data: Scenarios of the split that is simulated.
        policy_fingerprint: Hash of the policy's weights and code; another policy makes another plan.
        metadata: Serialized fields that each shard repeats.
        config: Settings of the simulation; all that change a number are in the plan.
        num_shards: Files of the archive; fewer for a split with fewer scenarios.
        round_m: Step that positions are rounded to, in meters; None = not rounded.

    Raises:
        ConfigError: No shards, a step of nothing or above 1 m, or a number of rollouts that the challenge refuses.
    """
    agents = data.num_agents
    if num_shards < 1:
        raise ConfigError(f"num_shards must be at least 1, got {num_shards}.")
    if config.num_rollouts != NUM_SCENES:
        raise ConfigError(f"an entry has {NUM_SCENES} rollouts of each scenario, not {config.num_rollouts}.")
    if round_m is not None and not 0 < round_m < 1:
        raise ConfigError(f"round={round_m:g} must be above 0 and below 1 m, such as 0.001.")
    num_shards = min(num_shards, len(agents))
    # Borders where the running number of agents passes multiples of its share; each shard keeps at least one scenario.
    total = np.concatenate([[0], np.cumsum(agents)])
    borders = [int(np.searchsorted(total, total[-1] * n / num_shards)) for n in range(num_shards + 1)]
    for n in range(1, num_shards):
        borders[n] = min(max(borders[n], borders[n - 1] + 1), len(agents) - (num_shards - n))
    borders[-1] = len(agents)
    shards = tuple(range(first, stop) for first, stop in pairwise(borders))
    identity = {
        "format": FORMAT,
        "challenge": config.challenge.name,
        "policy": policy_fingerprint,
        "data": data.fingerprint,
        "split": data.split,
        # hashed: the plan does not show the account
        "entry": hashlib.sha256(metadata).hexdigest(),
        "seed": config.seed,
        "temperature": config.temperature,
        "top_k": config.top_k,
        "round": round_m,
        "numbers": NUMBERS_VERSION,
    }
    num_agents = tuple(int(agents[shard.start : shard.stop].sum()) for shard in shards)
    return Plan(shards, num_agents, identity, config.challenge)


def check_sources(data: ScenarioDataset) -> None:
    """Check that recordings are Waymo's, which alone are on the leaderboard; synthetic scenarios are practice.

    Raises:
        DataError: A data set with scenarios of another source.
    """
    sources = sorted(set(data.sources) - {"womd", "synthetic", "unknown"})
    if sources:
        raise DataError(
            f"{data.folder}: scenarios of the source {' and '.join(sources)}: the Sim Agents server scores WOMD alone; "
            "convert a split of it, or score these rollouts with `rlftsim evaluate`."
        )


def check_complete(data: ScenarioDataset) -> None:
    """Check that no file of a split is missing before the simulation: the server wants every scenario.

    Raises:
        DataError: A shard of the data set is missing, a source file was not converted, or records were lost.
    """
    missing = [name for name in sorted(set(data.index["shard"].to_pylist())) if not (data.folder / name).is_file()]
    if missing and data.url is None:
        raise DataError(f"{data.folder / missing[0]} is missing, and {len(missing) - 1} more: convert again.")
    entries = [entry for entry in data.manifest.shards if entry.split == data.split]
    lost = [record for entry in entries for record in entry.skipped]
    if lost:
        raise DataError(
            f"{data.folder}: {count_lost(lost)} records of split {data.split} were lost in the conversion, the first "
            f"in {lost[0].file}: get the file again and convert it; a submission without them is refused."
        )
    numbers: dict[tuple[str, int], set[int]] = {}
    for match in (_NUMBERED.fullmatch(entry.source or "") for entry in entries):
        if match:
            numbers.setdefault((match[1], int(match[3])), set()).add(int(match[2]))
    for (name, count), converted in numbers.items():
        absent = sorted(set(range(count)) - converted)
        if absent:
            raise DataError(
                f"{data.folder}: split {data.split} was converted from {len(converted)} of {count} files, "
                f"{name}-{absent[0]:05d}-of-{count:05d} is missing: convert it, too, or try things out with --partial; "
                "the server refuses a submission without it."
            )


@dataclass(frozen=True)
class Job:
    """Input of the work on a shard; is handed to worker processes."""

    policy: Policy
    data: ScenarioDataset
    plan: Plan
    metadata: bytes
    """Fields that each shard repeats, see `submission.entry`."""
    config: EvaluateConfig
    round_m: float | None
    folder: Path

    def shard_path(self, number: int) -> Path:
        """File of a finished shard."""
        return self.folder / SHARDS / f"{number:05d}.part"

    def receipt_path(self, number: int) -> Path:
        """Receipt of a finished shard."""
        return self.folder / SHARDS / f"{number:05d}.json"

    def receipt(self, number: int) -> PackedShard | None:
        """A finished shard, whose file may be in the archive already; None before that."""
        try:
            shard = PackedShard(**read_json(self.receipt_path(number), "build again"))
            check_types(shard)
        except (DataError, ConfigError, FileNotFoundError, TypeError):
            return None
        sizes, sums = (shard.size, shard.raw_size), (shard.piece_crc, shard.raw_crc)
        fits = min(*sizes, *sums) >= 0 and max(sizes) < 1 << 36 and max(sums) < 1 << 32
        return shard if fits and shard.file == self.shard_path(number).name else None


def prepare_job(
    entry: Entry,
    policy: Policy,
    data: ScenarioDataset,
    config: EvaluateConfig,
    folder: Path,
    *,
    num_shards: int,
    round_m: float | None,
    is_partial: bool,
) -> Job:
    """Input of a build; everything that can be refused is refused before anything is simulated.

    Args:
        entry: Account, method and authors.
        policy: Policy whose rollouts are submitted; left unchanged, as a frozen copy is used.
        data: Scenarios of the split that is simulated.
        config: Settings of the simulation.
        folder: Folder of the archive.
        num_shards: Files of the archive; fewer for a split with fewer scenarios.
        round_m: Step that positions are rounded to, in meters; None = not rounded.
        is_partial: True lets files of the split be missing, to try things out.

    Raises:
        ConfigError: A policy that breaks the challenge's rules or cannot sample so, or see `make_plan`.
        DataError: Scenarios of another source, or a split that is not complete.
    """
    policy = frozen_copy(policy)
    check_sources(data)
    if not is_partial:
        check_complete(data)
    check_closed_loop(policy, data[0])
    check_sampling(policy, data, config.sampling)
    metadata = describe_entry(entry, count_parameters(policy))
    fingerprint = fingerprint_policy(policy)
    plan = make_plan(data, fingerprint, metadata, config, num_shards=num_shards, round_m=round_m)
    return Job(policy, data, plan, metadata, config, round_m, folder)

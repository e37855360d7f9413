"""Checks of a finished archive, in a single pass from the first to the last byte.

Numbers 1, 3, 4, 8, 10 to 14, 19 and 20 of `CHECKS` compare a scenario's rollouts with its log: `submit build` makes
these before a scenario is appended.
"""

import hashlib
import io
import re
import tarfile
from collections import Counter
from collections.abc import Callable, Iterator
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import BinaryIO, Literal

import numpy as np
from google.protobuf.message import DecodeError

from rlftsim.errors import ConfigError, DataError, shorten
from rlftsim.evaluation.rollout_checks import MAX_FIRST_STEP_ERROR_M, PoseChecks
from rlftsim.evaluation.rollout_files import AXES
from rlftsim.evaluation.submission_pb2 import SimAgentsChallengeSubmission
from rlftsim.evaluation.wire_format import BYTES, iterate_fields
from rlftsim.jobs.progress import progress_bar
from rlftsim.realism import SIM_AGENTS, Challenge
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import HISTORY_STEPS, Scenario
from rlftsim.submission.archive import GzipReader
from rlftsim.submission.entry import find_problems
from rlftsim.submission.messages import NUM_SCENES, DecodedRollouts, decode_rollouts

Severity = Literal["error", "warning"]

CHECKS = {
    1: "agents of every scene are those valid at step 10",
    2: "scenarios are those of the split",
    3: "32 scenes per scenario",
    4: "80 steps per agent, or 91 of a generated one",
    5: "required fields, the same in every shard",
    6: "names and numbers of the shards",
    7: "a whole .tar.gz that Python's tarfile reads",
    8: "no scenario twice, no agent twice",
    9: "no scenario of another split",
    10: "finite positions, possible distances",
    11: "headings in one convention",
    12: "heights of the log",
    13: "the first step continues the log",
    14: "scenes that differ",
    15: "object ids of this version of the data",
    16: "sizes of shards and archive",
    17: "the file that was built, unbroken",
    19: "sizes at 91 steps, and a type, of every generated agent",
    20: "no generated agent repeats the log's history",
}
"""Title of each check. The 18th of docs/submission.md, a server error without a reason, cannot be checked."""
SAME_M = 1e-3
"""A generated agent this near to its log at every logged step of the history repeats it."""
_CHECK_OF_SUBJECT = {
    "not finite": 10,
    "distance": 10,
    "heading": 11,
    "turn": 11,
    "height": 12,
    "offset": 13,
    "equal": 14,
}
"""The place of the first step, 13, is judged over all scenarios."""
MAX_STORED = 10
"""Findings of a check that are stored; further findings are counted."""


@dataclass(frozen=True)
class Finding:
    """A problem and the location in the archive."""

    check: int
    """Key of `CHECKS`."""
    severity: Severity
    text: str
    file: str | None = None
    """Shard, or the archive."""
    scenario_id: str | None = None
    object_id: int | None = None

    def __str__(self) -> str:
        location = (
            self.file,
            self.scenario_id and f"scenario {self.scenario_id}",
            None if self.object_id is None else f"object {self.object_id}",
        )
        line = f"{', '.join(text for text in location if text)}: {self.text}"
        # names in an archive may hold anything, such as control characters and bytes that are no text
        return shorten("".join(c if c.isprintable() else ascii(c)[1:-1] for c in line))


@dataclass
class Findings:
    """The first findings of each check, and the number of all."""

    stored: list[Finding] = field(default_factory=list)
    counts: Counter[int] = field(default_factory=Counter)

    def add(self, finding: Finding) -> None:
        """Count a finding; the first findings of each check are stored."""
        self.counts[finding.check] += 1
        if self.counts[finding.check] <= MAX_STORED:
            self.stored.append(finding)

    def drop(self, check: int) -> list[Finding]:
        """Forget the findings of a check; returns the stored findings."""
        dropped = [finding for finding in self.stored if finding.check == check]
        self.stored = [finding for finding in self.stored if finding.check != check]
        self.counts.pop(check, None)
        return dropped

    @property
    def has_errors(self) -> bool:
        """True if the server would refuse the archive."""
        return any(finding.severity == "error" for finding in self.stored)

    def lines(self) -> list[str]:
        """A line for each stored finding, and a line that counts the remaining findings of each check."""
        lines = []
        for check in sorted(self.counts):
            findings = [finding for finding in self.stored if finding.check == check]
            lines += [f"{finding.severity}, check {check}: {finding}" for finding in findings]
            if self.counts[check] > len(findings):
                lines.append(f"check {check}: {self.counts[check] - len(findings)} more of this kind")
        return lines


@dataclass(frozen=True)
class ScenarioCheck:
    """Findings of a scenario, and numbers that are judged over all scenarios."""

    findings: tuple[Finding, ...]
    num_agents: int = 0
    """Trajectories, agents times scenes."""
    num_jumps: int = 0
    """Trajectories with a first step away from constant velocity."""


def check_rollouts(
    decoded: DecodedRollouts, scenario: Scenario, file: str, challenge: Challenge = SIM_AGENTS
) -> ScenarioCheck:
    """Findings of the comparison of a scenario's rollouts with the log.

    Args:
        decoded: Rollouts as read from the message.
        scenario: Scenario with the log up to the current step; a future is not read.
        file: Name of the shard, for the findings.
        challenge: Challenge that the archive is for.
    """
    findings = list(_structure(decoded, scenario, file, challenge))
    if findings or decoded.values is None:
        return ScenarioCheck(tuple(findings))
    poses = decoded.values[:, :, : len(AXES)]
    checks = PoseChecks(decoded.object_ids[0], poses, scenario)
    for doubt in checks.doubts():
        text = doubt.text if doubt.rollout is None else f"{doubt.text} in scene {doubt.rollout}"
        severity = "error" if doubt.is_impossible else "warning"
        check = _CHECK_OF_SUBJECT[doubt.subject]
        findings.append(Finding(check, severity, text, file, decoded.scenario_id, doubt.object_id))
        if doubt.subject == "not finite":
            return ScenarioCheck(tuple(findings))
    if challenge.makes_scenes:
        sizes = decoded.values[:, :, len(AXES) :]  # [scenes, agents, 3, steps]
        for scene, row in np.argwhere(~(np.isfinite(sizes) & (sizes > 0)).all((2, 3)))[:1]:
            text = f"width, length or height is no number above 0 in scene {scene}"
            findings.append(Finding(19, "error", text, file, decoded.scenario_id, decoded.object_ids[scene][row]))
        findings += _find_history(checks, scenario, file)
        return ScenarioCheck(tuple(findings), poses.shape[0] * poses.shape[1])
    error = checks.first_step_errors()
    return ScenarioCheck(tuple(findings), error.size, int((error > MAX_FIRST_STEP_ERROR_M).sum()))


def _find_history(checks: PoseChecks, scenario: Scenario, file: str) -> Iterator[Finding]:
    """Agents that repeat the history of their log, which the challenge does not let a model read: 20."""
    tracks, rows = scenario.tracks, checks.rows
    valid = tracks.valid[rows, :HISTORY_STEPS]  # [A, S]
    logged = np.moveaxis(tracks.position[rows, :HISTORY_STEPS, :2], -1, 1)  # [A, 2, S]
    gap = np.linalg.norm(checks.poses[:, :, :2, :HISTORY_STEPS] - logged, axis=2)  # [N, A, S]
    repeats = ((gap <= SAME_M) | ~valid).all(-1).any(0) & (np.array(rows) != scenario.ego_index)  # [A]
    if repeats.any():
        text = f"{repeats.sum()} of {len(rows) - 1} agents repeat their logged history, which must not be read"
        yield Finding(20, "warning", text, file, scenario.scenario_id, checks.object_ids[int(repeats.argmax())])


def _structure(decoded: DecodedRollouts, scenario: Scenario, file: str, challenge: Challenge) -> Iterator[Finding]:
    """Scenes, agents, steps, sizes and types: 1, 3, 4, 8 and 19."""
    name = decoded.scenario_id
    if decoded.challenge != challenge:
        steps = f"{challenge.num_steps} steps" + (" with sizes and a type" if challenge.makes_scenes else "")
        text = f"agents are laid out as for {decoded.challenge.title}, {challenge.title} wants {steps}"
        yield Finding(4, "error", f"{text}: name it with --challenge {decoded.challenge.name}", file, name)
        return
    if len(decoded.object_ids) != NUM_SCENES:
        yield Finding(3, "error", f"{len(decoded.object_ids)} scenes instead of {NUM_SCENES}", file, name)
    for agent in decoded.wrong_lengths[:1]:
        sizes = agent.lengths[len(AXES) :]
        text = f"x, y, z and heading have {list(agent.lengths[: len(AXES)])} steps in scene {agent.scene}"
        if set(agent.lengths[: len(AXES)]) != {challenge.num_steps}:
            yield Finding(4, "error", text, file, name, agent.object_id)
        if set(sizes) - {challenge.num_steps}:
            text = f"width, length and height have {list(sizes)} steps in scene {agent.scene}"
            yield Finding(19, "error", text, file, name, agent.object_id)
    if not decoded.has_types:
        yield Finding(19, "error", "an agent has no object_type", file, name)
    expected = frozenset(scenario.tracks.object_id[scenario.simulated_indices].tolist())
    for scene, ids in enumerate(decoded.object_ids):
        if scene and ids == decoded.object_ids[scene - 1]:
            continue
        repeated = [object_id for object_id, count in Counter(ids).items() if count > 1]
        if repeated:
            yield Finding(8, "error", f"listed twice in scene {scene}", file, name, repeated[0])
            return
        missing, extra = expected - set(ids), set(ids) - expected
        if missing or extra:
            groups = [("missing", missing), ("not simulated in this scenario", extra)]
            text = "; ".join(f"{word}: {', '.join(map(str, sorted(ids)[:10]))}" for word, ids in groups if ids)
            yield Finding(1, "error", f"scene {scene}: {text}", file, name, min(missing or extra))
            return


SHARD_NAME = re.compile(r".*\.binproto(-(\d{5})-of-(\d{5}))?")
SPLIT_NAME = re.compile(r".*\.tar\.gz\.\d{3}")
"""Name of a part of an archive that was cut for moving it about, see `archive.split_file`."""
MAX_SHARD_BYTES = 2 * 10**9
MAX_METADATA_BYTES = 1 << 24
DOUBTFUL_ARCHIVE_BYTES = 50 * 10**9
MAX_JUMPS = 1e-3
"""Fraction of trajectories whose first step may be away from constant velocity."""
MAX_OTHER_AGENTS = 0.01
"""Fraction of scenarios with other agents beyond which the data are of another version; at least `MIN_OTHER_AGENTS`."""
MIN_OTHER_AGENTS = 10
_TAR_BUFFER = 1 << 20

RolloutsCallback = Callable[[Scenario, DecodedRollouts], None]


@dataclass
class ArchiveCheck:
    """Contents and findings of an archive."""

    archive: str
    size: int
    sha256: str = ""
    num_scenarios: int = 0
    num_checked: int = 0
    """Scenarios whose trajectories were looked at."""
    num_trajectories: int = 0
    num_jumps: int = 0
    raw_bytes: int = 0
    """Uncompressed bytes of the shards."""
    shards: list[str] = field(default_factory=list)
    """Names, in the order of the archive."""
    metadata: SimAgentsChallengeSubmission | None = None
    """Fields of the first shard but its rollouts."""
    findings: Findings = field(default_factory=Findings)


def check_archive(
    archive: str | PathLike[str],
    data: ScenarioDataset | None,
    *,
    sample: float = 1.0,
    expected_sha256: str | None = None,
    challenge: Challenge = SIM_AGENTS,
    callback: RolloutsCallback | None = None,
    show_progress: bool = True,
) -> ArchiveCheck:
    """Contents and findings of an archive that is read front to back with every check of `findings.CHECKS`.

    Memory holds a single scenario at a time.

    Args:
        archive: A .tar.gz, from any writer.
        data: Scenarios of the split that the archive is for; None makes only the checks that need no data set.
        sample: Fraction of scenarios with a look at the trajectories; names, fields and sets are always checked.
        expected_sha256: Checksum of the file that was built; None = not compared.
        challenge: Challenge that the archive is for.
        callback: Function of a scenario and the rollouts, called for trajectories without an error.
        show_progress: False shows no progress bar.

    Raises:
        ConfigError: A sample of nothing.
        DataError: A missing file, a folder, or a damaged data set.
    """
    if not 0 < sample <= 1:
        raise ConfigError(f"sample={sample:g} must be above 0 and at most 1.")
    archive = Path(archive)
    if archive.is_dir():
        raise DataError(f"{archive} is a folder: name the .tar.gz in it.")
    if not archive.is_file():
        raise DataError(f"{archive}: there is no such archive.")
    check = ArchiveCheck(archive.name, archive.stat().st_size)
    archive_pass = _Pass(check, data, sample, callback, challenge)
    if SPLIT_NAME.fullmatch(archive.name):
        joined = archive.name.rpartition(".")[0]
        archive_pass.add(17, f"a part of an archive: join the parts first, cat {joined}.??? > {joined}")
        return check
    with archive.open("rb") as file, progress_bar("check", check.size, unit="bytes", show=show_progress) as advance:
        reader = GzipReader(file)
        is_complete = archive_pass.read(reader, file, advance)
        reader.read_to_end()  # what follows damage still counts for the checksum
    check.sha256 = reader.sha256
    archive_pass.judge(is_complete)
    if expected_sha256 not in (None, check.sha256):
        archive_pass.add(17, "not the file that its report describes (SHA-256 differs): copied in part, or replaced")
    return check


@dataclass(eq=False)
class _Pass:
    """State of a pass over an archive."""

    check: ArchiveCheck
    data: ScenarioDataset | None
    sample: float
    callback: RolloutsCallback | None
    challenge: Challenge
    scenario_ids: set[str] = field(default_factory=set)
    numbers: list[tuple[int, int]] = field(default_factory=list)
    """Number and count in the names of shards."""
    all_splits: ScenarioDataset | None = None
    """The data set without a split; opened where a scenario is not of the split."""
    data_error: DataError | None = None
    """Damage of the data set, which says nothing about the archive."""

    def read(self, reader: GzipReader, file: BinaryIO, advance: Callable[[int], None]) -> bool:
        """Read all shards; False if the archive is damaged."""
        num_read = 0
        try:
            magic = file.read(2)
            file.seek(0)
            if magic != b"\x1f\x8b":
                raise DataError("not compressed with gzip: pack it as .tar.gz")
            with tarfile.open(fileobj=reader, mode="r|", bufsize=_TAR_BUFFER) as tar:  # pyright: ignore
                for member in tar:
                    contents = tar.extractfile(member)
                    self._read_shard(member, contents if isinstance(contents, io.BufferedReader) else None)
                    advance(reader.packed_size - num_read)
                    num_read = reader.packed_size
            reader.finish()
            advance(reader.packed_size - num_read)
        except (DataError, tarfile.TarError) as error:
            if error is self.data_error:
                raise
            self.add(7, str(error))
            return False
        return True

    def _read_shard(self, member: tarfile.TarInfo, contents: io.BufferedReader | None) -> None:
        """Check name, fields and scenarios of a file."""
        match = SHARD_NAME.fullmatch(member.name)
        if contents is None or match is None or "/" in member.name:
            text = "no shard's name; wanted are flat names such as submission.binproto-00000-of-00150"
            self.add(6, text, member.name)
            if contents is None:
                return
        elif match[1]:
            self.numbers.append((int(match[2]), int(match[3])))
        if member.size >= MAX_SHARD_BYTES:
            self.add(16, f"{member.size / 1e9:.2f} GB; protobuf reads less than 2 GB: use more shards", member.name)
        self.check.shards.append(member.name)
        self.check.raw_bytes += member.size
        metadata = bytearray()
        for wire_field in iterate_fields(contents, 0, member.size, is_stream=True):
            if (wire_field.number, wire_field.wire_type) == (1, BYTES):
                self._read_scenario(wire_field.payload, member.name)
            else:
                metadata += wire_field.head + wire_field.payload
                if len(metadata) > MAX_METADATA_BYTES:
                    raise DataError(f"{member.name}: more than {MAX_METADATA_BYTES} bytes beside rollouts")
        self._read_metadata(bytes(metadata), member.name)

    def _read_metadata(self, data: bytes, file: str) -> None:
        try:
            metadata = SimAgentsChallengeSubmission.FromString(data)
        except DecodeError as error:
            raise DataError(f"{file}: no submission message ({error})") from None
        problems, first = find_problems(metadata), self.check.metadata
        if not problems and first is not None and metadata != first:
            names = [f.name for f in metadata.DESCRIPTOR.fields if getattr(metadata, f.name) != getattr(first, f.name)]
            problems = [f"{', '.join(names)} differ from those of {self.check.shards[0]}"]
        if problems:
            self.add(5, "; ".join(problems), file)
        if first is None:
            self.check.metadata = metadata

    def _read_scenario(self, data: bytes, file: str) -> None:
        decoded = decode_rollouts(data)
        name = decoded.scenario_id
        self.check.num_scenarios += 1
        if name in self.scenario_ids:
            self.add(8, "the scenario is in the archive twice", file, name)
            return
        if self.data is not None and name not in self.data:
            self._add_foreign(self.data, name, file)
            return
        self.scenario_ids.add(name)
        # a number in [0, 1) for each scenario, the same in every check
        fraction = int.from_bytes(hashlib.blake2b(name.encode(), digest_size=8).digest(), "little") / 2**64
        if self.data is None or (self.sample < 1 and fraction >= self.sample):
            return
        try:
            scenario = self.data.by_id(name)
        except DataError as error:
            self.data_error = error
            raise
        scenario_check = check_rollouts(decoded, scenario, file, self.challenge)
        self.check.num_checked += 1
        self.check.num_trajectories += scenario_check.num_agents
        self.check.num_jumps += scenario_check.num_jumps
        for finding in scenario_check.findings:
            self.check.findings.add(finding)
        if self.callback is not None and not any(f.severity == "error" for f in scenario_check.findings):
            self.callback(scenario, decoded)

    def _add_foreign(self, data: ScenarioDataset, name: str, file: str) -> None:
        """Add the finding of a scenario that is not of the split: of another split, or unknown."""
        if self.all_splits is None:
            self.all_splits = ScenarioDataset(data.folder)
        if name in self.all_splits:
            split = self.all_splits.index["split"][self.all_splits.scenario_ids.index(name)].as_py()
            self.add(9, f"of split {split}, not {data.split}", file, name)
        else:
            self.add(2, f"unknown to {data.folder}, split {data.split}", file, name)

    def judge(self, is_complete: bool) -> None:
        """Add the findings about the archive in total; `is_complete` is False where damage ended the reading."""
        check = self.check
        if check.size >= DOUBTFUL_ARCHIVE_BYTES:
            text = f"{check.size / 1e9:.0f} GB: the server has taken archives below 50 GB; try --round 0.001"
            self.add(16, text, severity="warning")
        if not is_complete:
            return  # whatever is missing lies behind the damage
        if not check.shards:
            self.add(6, "there is no shard in it: pack files named as submission.binproto-00000-of-00150")
        if self.numbers:
            total = self.numbers[0][1]
            if Counter(self.numbers) != Counter((number, total) for number in range(total)):
                self.add(6, f"{len(self.numbers)} shards whose names do not count from 0 to {total - 1} of {total}")
        if self.data is None:
            return
        missing = [name for name in self.data.scenario_ids if name not in self.scenario_ids]
        if missing:
            names = ", ".join(missing[:MAX_STORED])
            self.add(2, f"{len(missing)} of {len(self.data)} scenarios of split {self.data.split} missing: {names}")
        if check.num_trajectories and check.num_jumps > MAX_JUMPS * check.num_trajectories:
            percent = 100 * check.num_jumps / check.num_trajectories
            text = f"{percent:.3g} % of agents jump away from the log at the first step: another frame, or off by one"
            self.add(13, text, severity="warning")
        num_differing = check.findings.counts[1]
        if num_differing >= max(MIN_OTHER_AGENTS, MAX_OTHER_AGENTS * check.num_checked):
            first = check.findings.drop(1)[0]
            text = (
                f"{num_differing} of {check.num_checked} scenarios have other agents than {self.data.folder} "
                f"({self.data.fingerprint[:8]}): simulated from another version of the data. First: {first}"
            )
            self.add(15, text)

    def add(
        self, number: int, text: str, file: str = "", scenario_id: str | None = None, severity: Severity = "error"
    ) -> None:
        """Add a finding about a scenario or shard, or about the archive if `file` is left out."""
        self.check.findings.add(Finding(number, severity, text, file or self.check.archive, scenario_id))

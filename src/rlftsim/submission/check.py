"""Checks of a finished archive, in one pass from its first to its last byte."""

import hashlib
import io
import re
import tarfile
from collections import Counter
from collections.abc import Callable
from dataclasses import dataclass, field
from os import PathLike
from pathlib import Path
from typing import BinaryIO

from google.protobuf.message import DecodeError

from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.submission_pb2 import SimAgentsChallengeSubmission
from rlftsim.evaluation.wire_format import BYTES, read_fields
from rlftsim.jobs.progress import progress_bar
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import Scenario
from rlftsim.submission.archive import GzipReader
from rlftsim.submission.entry import find_problems
from rlftsim.submission.findings import MAX_KEPT, Finding, Findings
from rlftsim.submission.messages import DecodedRollouts, decode_rollouts
from rlftsim.submission.scenario_checks import check_rollouts

SHARD_NAME = re.compile(r".*\.binproto(-(\d{5})-of-(\d{5}))?")
SPLIT_NAME = re.compile(r".*\.tar\.gz\.\d{3}")
"""Name of a part of an archive that was cut for moving it about, see `submission.split_file`."""
MAX_SHARD_BYTES = 2 * 10**9
MAX_METADATA_BYTES = 1 << 24
DOUBTFUL_ARCHIVE_BYTES = 50 * 10**9
MAX_JUMPS = 1e-3
"""Fraction of trajectories whose first step may be away from constant velocity."""
MAX_OTHER_AGENTS = 0.01
"""Fraction of scenarios with other agents beyond which the data are of another version; at least `MIN_OTHER_AGENTS`."""
MIN_OTHER_AGENTS = 10
_TAR_BUFFER = 1 << 20

SeeRollouts = Callable[[Scenario, DecodedRollouts], None]


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
    """Of the shards."""
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
    see: SeeRollouts | None = None,
    show_progress: bool = True,
) -> ArchiveCheck:
    """Read an archive front to back and make every check of `findings.CHECKS`; memory of one scenario.

    Args:
        archive: a .tar.gz, from any writer.
        data: scenarios of the split that the archive is for; None makes only the checks that need none.
        sample: fraction of the scenarios whose trajectories are looked at; names, fields and sets are checked for all.
        expected_sha256: of the file that was built; None = not known.
        see: called with each scenario whose trajectories have no error, and its rollouts.
        show_progress: False = no progress bar.

    Raises:
        ConfigError: a sample of nothing.
        DataError: no such file, a folder, or a damaged data set.
    """
    if not 0 < sample <= 1:
        raise ConfigError(f"sample={sample:g} must be above 0 and at most 1.")
    archive = Path(archive)
    if archive.is_dir():
        raise DataError(f"{archive} is a folder: name the .tar.gz in it.")
    if not archive.is_file():
        raise DataError(f"{archive}: there is no such archive.")
    found = ArchiveCheck(archive.name, archive.stat().st_size)
    if SPLIT_NAME.fullmatch(archive.name):
        whole = archive.name.rpartition(".")[0]
        text = f"a part of an archive: join the parts first, cat {whole}.??? > {whole}"
        found.findings.add(Finding(17, "error", text, archive.name))
        return found
    pass_over = _Pass(found, data, sample, see)
    with archive.open("rb") as file, progress_bar("check", found.size, unit="bytes", show=show_progress) as advance:
        reader = GzipReader(file)
        is_whole = pass_over.read(reader, file, advance)
        reader.read_to_end()  # what follows damage still counts for the checksum
    found.sha256 = reader.sha256
    pass_over.judge(is_whole)
    if expected_sha256 is not None and found.sha256 != expected_sha256:
        text = "not the file that its report describes (SHA-256 differs): copied in part, or replaced"
        found.findings.add(Finding(17, "error", text, archive.name))
    return found


@dataclass(eq=False)
class _Pass:
    """State of one pass over an archive."""

    found: ArchiveCheck
    data: ScenarioDataset | None
    sample: float
    see: SeeRollouts | None
    seen: set[str] = field(default_factory=set)
    numbers: list[tuple[int, int]] = field(default_factory=list)
    """Number and count in the names of shards."""
    whole_data: ScenarioDataset | None = None
    """All splits; opened where a scenario is not of the split."""
    of_data: DataError | None = None
    """Damage of the data set, which says nothing about the archive."""

    def read(self, reader: GzipReader, file: BinaryIO, advance: Callable[[int], None]) -> bool:
        """Read all shards; False if the archive is damaged."""
        done = 0
        try:
            magic = file.read(2)
            file.seek(0)
            if magic != b"\x1f\x8b":
                raise DataError("not compressed with gzip: pack it as .tar.gz")
            with tarfile.open(fileobj=reader, mode="r|", bufsize=_TAR_BUFFER) as tar:  # pyright: ignore
                for member in tar:
                    contents = tar.extractfile(member)
                    self._read_shard(member, contents if isinstance(contents, io.BufferedReader) else None)
                    advance(reader.packed_size - done)
                    done = reader.packed_size
            reader.finish()
            advance(reader.packed_size - done)
        except (DataError, tarfile.TarError) as error:
            if error is self.of_data:
                raise
            self._add(7, str(error), self.found.archive)
            return False
        return True

    def _read_shard(self, member: tarfile.TarInfo, contents: io.BufferedReader | None) -> None:
        """Check the name of a file, its fields and its scenarios."""
        match = SHARD_NAME.fullmatch(member.name)
        if contents is None or match is None or "/" in member.name:
            wanted = "wanted are flat names such as submission.binproto-00000-of-00150"
            self._add(6, f"no shard's name; {wanted}", member.name)
            if contents is None:
                return
        elif match[1]:
            self.numbers.append((int(match[2]), int(match[3])))
        if member.size >= MAX_SHARD_BYTES:
            self._add(16, f"{member.size / 1e9:.2f} GB; protobuf reads less than 2 GB: use more shards", member.name)
        self.found.shards.append(member.name)
        self.found.raw_bytes += member.size
        rest = bytearray()
        for whole in read_fields(contents, member.size):
            if (whole.number, whole.wire_type) == (1, BYTES):
                self._read_scenario(whole.payload, member.name)
            else:
                rest += whole.head + whole.payload
                if len(rest) > MAX_METADATA_BYTES:
                    raise DataError(f"{member.name}: more than {MAX_METADATA_BYTES} bytes beside rollouts")
        self._read_metadata(bytes(rest), member.name)

    def _read_metadata(self, data: bytes, file: str) -> None:
        try:
            metadata = SimAgentsChallengeSubmission.FromString(data)
        except DecodeError as error:
            raise DataError(f"{file}: no submission message ({error})") from None
        problems = find_problems(metadata)
        if not problems and self.found.metadata is not None and metadata != self.found.metadata:
            names = [
                one.name
                for one in metadata.DESCRIPTOR.fields
                if getattr(metadata, one.name) != getattr(self.found.metadata, one.name)
            ]
            problems = [f"{', '.join(names)} differ from those of {self.found.shards[0]}"]
        if problems:
            self._add(5, "; ".join(problems), file)
        if self.found.metadata is None:
            self.found.metadata = metadata

    def _read_scenario(self, data: bytes, file: str) -> None:
        decoded = decode_rollouts(data)
        name = decoded.scenario_id
        self.found.num_scenarios += 1
        if name in self.seen:
            self._add(8, "the scenario is in the archive twice", file, name)
            return
        if self.data is not None and name not in self.data:
            self._add_foreign(self.data, name, file)
            return
        self.seen.add(name)
        if self.data is None or (self.sample < 1 and _place(name) >= self.sample):
            return
        try:
            scenario = self.data.by_id(name)
        except DataError as error:
            self.of_data = error
            raise
        checked = check_rollouts(decoded, scenario, file)
        self.found.num_checked += 1
        self.found.num_trajectories += checked.num_agents
        self.found.num_jumps += checked.num_jumps
        for finding in checked.findings:
            self.found.findings.add(finding)
        if self.see is not None and not any(finding.severity == "error" for finding in checked.findings):
            self.see(scenario, decoded)

    def _add_foreign(self, data: ScenarioDataset, name: str, file: str) -> None:
        """A scenario that is not of the split: of another one, or unknown."""
        if self.whole_data is None:
            self.whole_data = ScenarioDataset(data.folder)
        if name in self.whole_data:
            split = self.whole_data.index["split"][self.whole_data.scenario_ids.index(name)].as_py()
            self._add(9, f"of split {split}, not {data.split}", file, name)
        else:
            self._add(2, f"unknown to {data.folder}, split {data.split}", file, name)

    def judge(self, is_whole: bool) -> None:
        """Findings about the archive as a whole."""
        found = self.found
        if found.size >= DOUBTFUL_ARCHIVE_BYTES:
            text = f"{found.size / 1e9:.0f} GB: the server has taken archives below 50 GB; try --round 0.001"
            found.findings.add(Finding(16, "warning", text, found.archive))
        if not is_whole:
            return  # whatever is missing lies behind the damage
        if not found.shards:
            self._add(
                6, "there is no shard in it: pack files named as submission.binproto-00000-of-00150", found.archive
            )
        if self.numbers:
            total = self.numbers[0][1]
            if Counter(number for number, _ in self.numbers) != Counter(range(total)) or any(
                count != total for _, count in self.numbers
            ):
                text = f"{len(self.numbers)} shards whose names do not count from 0 to {total - 1} of {total}"
                self._add(6, text, found.archive)
        if self.data is None:
            return
        missing = [name for name in self.data.scenario_ids if name not in self.seen]
        if missing:
            some = ", ".join(missing[:MAX_KEPT])
            text = f"{len(missing)} of {len(self.data)} scenarios of split {self.data.split} missing: {some}"
            self._add(2, text, found.archive)
        if found.num_trajectories and found.num_jumps > MAX_JUMPS * found.num_trajectories:
            percent = 100 * found.num_jumps / found.num_trajectories
            text = f"{percent:.3g} % of agents jump away from the log at the first step: another frame, or off by one"
            found.findings.add(Finding(13, "warning", text, found.archive))
        others = found.findings.counts[1]
        if others >= max(MIN_OTHER_AGENTS, MAX_OTHER_AGENTS * found.num_checked):
            first = found.findings.drop(1)[0]
            text = (
                f"{others} of {found.num_checked} scenarios have other agents than {self.data.folder} "
                f"({self.data.fingerprint[:8]}): simulated from another version of the data. First: {first}"
            )
            self._add(15, text, found.archive)

    def _add(self, check: int, text: str, file: str, scenario_id: str | None = None) -> None:
        self.found.findings.add(Finding(check, "error", text, file, scenario_id))


def _place(scenario_id: str) -> float:
    """A number in [0, 1) for each scenario, always the same."""
    return int.from_bytes(hashlib.blake2b(scenario_id.encode(), digest_size=8).digest(), "little") / 2**64

"""Problems that are found in an archive, by the number of the check."""

from collections import Counter
from dataclasses import dataclass, field
from typing import Literal

from rlftsim.errors import shorten

Severity = Literal["error", "warning"]

CHECKS = {
    1: "agents of every scene are those valid at step 10",
    2: "scenarios are those of the split",
    3: "32 scenes per scenario",
    4: "80 steps per agent",
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
}
"""Title of each check. The 18th of docs/submission.md, a server error without a reason, cannot be checked."""
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

"""Problems that are found in an archive, by the number of the check, and the checks of a scenario against the log.

`submit build` checks a scenario before it is appended, `submit check` on the finished archive: numbers 1, 3, 4, 8 and
10 to 14, 19 and 20 of `CHECKS`.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, field
from typing import Literal

import numpy as np

from rlftsim.errors import shorten
from rlftsim.evaluation.rollout_checks import MAX_FIRST_STEP_ERROR_M, PoseChecks
from rlftsim.evaluation.rollout_files import AXES
from rlftsim.realism import SIM_AGENTS, Challenge
from rlftsim.scenario.types import HISTORY_STEPS, Scenario
from rlftsim.submission.messages import NUM_SCENES, DecodedRollouts

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

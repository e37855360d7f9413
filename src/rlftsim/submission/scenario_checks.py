"""Checks of a scenario's rollouts against the log: numbers 1, 3, 4, 8 and 10 to 14 of `findings.CHECKS`.

`submit build` makes these checks before a scenario is appended, `submit check` on the finished archive.
"""

from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass

from rlftsim.evaluation.rollout_checks import MAX_FIRST_STEP_ERROR_M, PoseChecks
from rlftsim.scenario.types import Scenario
from rlftsim.submission.findings import Finding
from rlftsim.submission.messages import NUM_SCENES, DecodedRollouts

_CHECK_OF_SUBJECT = {"not finite": 10, "distance": 10, "heading": 11, "turn": 11, "height": 12, "equal": 14}
"""The first step, 13, is judged over all scenarios."""


@dataclass(frozen=True)
class ScenarioCheck:
    """Findings of a scenario, and numbers that are judged over all scenarios."""

    findings: tuple[Finding, ...]
    num_agents: int = 0
    """Trajectories, agents times scenes."""
    num_jumps: int = 0
    """Trajectories with a first step away from constant velocity."""


def check_rollouts(decoded: DecodedRollouts, scenario: Scenario, file: str) -> ScenarioCheck:
    """Findings of the comparison of a scenario's rollouts with the log.

    Args:
        decoded: Rollouts as read from the message.
        scenario: Scenario with the log up to the current step; a future is not read.
        file: Name of the shard, for the findings.
    """
    findings = list(_structure(decoded, scenario, file))
    if findings or decoded.values is None:
        return ScenarioCheck(tuple(findings))
    checks = PoseChecks(decoded.object_ids[0], decoded.values, scenario)
    for doubt in checks.doubts():
        text = doubt.text if doubt.rollout is None else f"{doubt.text} in scene {doubt.rollout}"
        severity = "error" if doubt.is_impossible else "warning"
        check = _CHECK_OF_SUBJECT[doubt.subject]
        findings.append(Finding(check, severity, text, file, decoded.scenario_id, doubt.object_id))
        if doubt.subject == "not finite":
            return ScenarioCheck(tuple(findings))
    error = checks.first_step_errors()
    return ScenarioCheck(tuple(findings), error.size, int((error > MAX_FIRST_STEP_ERROR_M).sum()))


def _structure(decoded: DecodedRollouts, scenario: Scenario, file: str) -> Iterator[Finding]:
    """Scenes, agents and steps: 1, 3, 4 and 8."""
    name = decoded.scenario_id
    if len(decoded.object_ids) != NUM_SCENES:
        yield Finding(3, "error", f"{len(decoded.object_ids)} scenes instead of {NUM_SCENES}", file, name)
    for agent in decoded.wrong_lengths[:1]:
        text = f"x, y, z and heading have {list(agent.lengths)} steps in scene {agent.scene}"
        yield Finding(4, "error", text, file, name, agent.object_id)
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

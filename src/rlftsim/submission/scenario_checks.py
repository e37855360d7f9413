"""Checks of one scenario's rollouts against its log: numbers 1, 3, 4, 8 and 10 to 14 of `findings.CHECKS`.

`submit build` makes them before it appends a scenario, `submit check` on the finished archive.
"""

import math
from collections import Counter
from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np
from jaxtyping import Float32

from rlftsim.scenario.types import CURRENT_STEP, STEP_S, Scenario
from rlftsim.submission.findings import Finding
from rlftsim.submission.messages import NUM_SCENES, DecodedRollouts

MAX_DISTANCE_M = 480.0
"""From the current position, 60 m/s for 8 seconds."""
MAX_STEP_M, DOUBTFUL_STEP_M = 8.0, 5.0
"""In 0.1 s."""
MAX_HEADING_RAD = 100.0
MAX_HEIGHT_CHANGE_M = 20.0
MAX_FIRST_STEP_ERROR_M = 3.0
"""Between the first simulated position and that of constant velocity."""
MOVING_MPS = 0.5


@dataclass(frozen=True)
class ScenarioCheck:
    """Findings of one scenario, and numbers that are judged over all scenarios."""

    findings: tuple[Finding, ...]
    num_agents: int = 0
    """Trajectories, agents times scenes."""
    num_jumps: int = 0
    """Of these, with a first step away from constant velocity."""


def check_rollouts(decoded: DecodedRollouts, scenario: Scenario, file: str) -> ScenarioCheck:
    """Compare a scenario's rollouts with its log.

    Args:
        decoded: the rollouts.
        scenario: the log up to the current step.
        file: name of the shard, for the findings.
    """
    findings = list(_structure(decoded, scenario, file))
    if findings or decoded.values is None:
        return ScenarioCheck(tuple(findings))
    # Agents in the order of the message.
    tracks, ids = scenario.tracks, decoded.object_ids[0]
    row_of = {int(tracks.object_id[row]): row for row in scenario.simulated_indices}
    rows = [row_of[object_id] for object_id in ids]
    start = tracks.position[rows, CURRENT_STEP]  # [A, 3]
    heading = tracks.heading[rows, CURRENT_STEP]  # [A]
    velocity = tracks.velocity[rows, CURRENT_STEP]  # [A, 2]
    values = decoded.values  # [N, A, 4, T]

    def finding(check: int, agent: int | None, text: str, severity: str = "warning") -> Finding:
        object_id = None if agent is None else ids[agent]
        return Finding(check, "error" if severity == "error" else "warning", text, file, decoded.scenario_id, object_id)

    # 10. finite; nothing else can be said of numbers that are not
    if not np.isfinite(values).all():
        scene, agent, axis, step = np.argwhere(~np.isfinite(values))[0].tolist()
        name = ("x", "y", "z", "heading")[axis]
        text = f"{name} is {values[scene, agent, axis, step]} in scene {scene} at step {step}"
        return ScenarioCheck((finding(10, agent, text, "error"),))
    x, y, z, turned = (values[:, :, axis] for axis in range(4))  # each [N, A, T]
    far = _largest_distance(x - start[:, 0, None], y - start[:, 1, None])
    if far.value > MAX_DISTANCE_M:
        text = f"{far.value:.0f} m from its current position in scene {far.scene}, beyond {MAX_DISTANCE_M:.0f} m"
        findings.append(finding(10, far.agent, text, "error"))
    step = _largest_distance(x[..., 1:] - x[..., :-1], y[..., 1:] - y[..., :-1])
    if step.value > DOUBTFUL_STEP_M:
        text = f"a step of {step.value:.1f} m in 0.1 s in scene {step.scene}"
        findings.append(finding(10, step.agent, text, "error" if step.value > MAX_STEP_M else "warning"))
    # 11. headings. Either all within a turn, where a step through pi jumps by a turn, or turned continuously
    is_wrapped = (np.abs(turned) <= math.pi + 1e-4).all(-1, keepdims=True)  # [N, A, 1]
    change = np.abs(np.diff(turned, prepend=np.broadcast_to(heading[:, None], (*turned.shape[:2], 1))))
    doubtful = _largest(np.where(is_wrapped, np.float32(0), change))
    if doubtful.value > math.pi:
        text = f"heading changes by {doubtful.value:.2f} rad in 0.1 s in scene {doubtful.scene}, over half a turn"
        findings.append(finding(11, doubtful.agent, text))
    elif (largest := _largest(np.abs(turned))).value > MAX_HEADING_RAD:
        text = f"heading of {largest.value:.0f} rad in scene {largest.scene}: degrees?"
        findings.append(finding(11, largest.agent, text))
    # 12. heights
    climb = _largest(np.abs(z - start[:, 2, None]))
    if climb.value > MAX_HEIGHT_CHANGE_M:
        text = f"z is {climb.value:.0f} m from that of the current step in scene {climb.scene}"
        findings.append(finding(12, climb.agent, text))
    elif not z.any() and start[:, 2].any():
        findings.append(finding(12, None, "z is 0 everywhere, in the log it is not: speed and road edges are 3-D"))
    # 13. the first step, judged over all scenarios
    expected = start[:, :2] + STEP_S * velocity  # [A, 2]
    error = np.hypot(x[..., 0] - expected[:, 0], y[..., 0] - expected[:, 1])  # [N, A]
    # 14. scenes
    moving = np.hypot(velocity[:, 0], velocity[:, 1]) > MOVING_MPS
    if moving.any() and (values[:, moving, :2] == values[:1, moving, :2]).all():
        text = f"all {len(values)} scenes are equal: the metric compares distributions"
        findings.append(finding(14, None, text))
    return ScenarioCheck(tuple(findings), error.size, int((error > MAX_FIRST_STEP_ERROR_M).sum()))


def _structure(decoded: DecodedRollouts, scenario: Scenario, file: str) -> Iterator[Finding]:
    """Scenes, agents and steps: 1, 3, 4 and 8."""
    name = decoded.scenario_id
    if len(decoded.object_ids) != NUM_SCENES:
        yield Finding(3, "error", f"{len(decoded.object_ids)} scenes instead of {NUM_SCENES}", file, name)
    for wrong in decoded.wrong_lengths[:1]:
        text = f"x, y, z and heading have {list(wrong.lengths)} steps in scene {wrong.scene}"
        yield Finding(4, "error", text, file, name, wrong.object_id)
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
            parts = [("missing", missing), ("not simulated in this scenario", extra)]
            said = "; ".join(f"{word}: {', '.join(map(str, sorted(some)[:10]))}" for word, some in parts if some)
            yield Finding(1, "error", f"scene {scene}: {said}", file, name, min(missing or extra))
            return


@dataclass(frozen=True)
class _Largest:
    value: float
    scene: int
    agent: int


def _largest_distance(dx: Float32[np.ndarray, "N A t"], dy: Float32[np.ndarray, "N A t"]) -> _Largest:
    """The largest length of vectors; the root of one number, as `hypot` of all takes longer than all other checks."""
    found = _largest(dx * dx + dy * dy)
    return replace(found, value=math.sqrt(found.value))


def _largest(values: Float32[np.ndarray, "N A t"]) -> _Largest:
    """The largest value and its place; 0 where there are no agents."""
    if not values.size:
        return _Largest(0.0, 0, 0)
    scene, agent, step = np.unravel_index(int(values.argmax()), values.shape)
    return _Largest(float(values[scene, agent, step]), int(scene), int(agent))

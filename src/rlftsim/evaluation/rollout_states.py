"""Rollouts of a scenario in the form of the metric: agents that go on from the log, the log itself, or whole scenes."""

from collections.abc import Sequence
from dataclasses import replace
from typing import Any, Literal

import torch

from rlftsim.evaluation.results import EvaluateConfig
from rlftsim.goals.types import Goals, logged_goals
from rlftsim.jobs.items import group_positions
from rlftsim.realism import SimulatedStates
from rlftsim.realism.from_rollouts import logged_states, prepend_history, states_of_rollouts
from rlftsim.rollout.policy import Policy, get_device
from rlftsim.rollout.scene_draw import draw_scene
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import ScenarioBatch, collate

Oracle = Literal["oracle"]


def simulate_states(
    policy: Policy | Oracle,
    batch: ScenarioBatch,
    config: EvaluateConfig,
    *,
    context: Any = None,
    goals: Goals | None = None,
) -> SimulatedStates:
    """Rollouts of a scenario as an evaluation scores them, simulated a few at a time.

    A deterministic policy is simulated once. Where the challenge is to make whole scenes, each rollout goes on from a
    history of its own, drawn by `draw_scene`, and of the scenario only map, lights and the ego's past are read.

    Args:
        policy: Policy of all agents, or "oracle" for the log.
        batch: The scenario alone, simulated from the current step on; for the log, with a future.
        config: Metric, number of rollouts, rollouts at a time, seed, sampling, goals.
        context: Result of an earlier `policy.encode(batch)`, from which rollouts go on in every challenge; None =
            encode here.
        goals: Goals of a single rollout, the same in all; None = the goals that `config` says.

    Raises:
        ConfigError: The policy cannot sample as `config` says, e.g. top-k without categories.
        DataError: A pose of the policy is not finite.
    """
    scenario, device, count = batch.scenarios[0], get_device(policy), config.num_rollouts
    if isinstance(policy, str):
        return logged_states(scenario, num_rollouts=count, device=device, challenge=config.challenge)
    batch, makes_scenes = batch.to(device), context is None and config.challenge.makes_scenes
    is_random = makes_scenes or policy.initial_noise_size or (policy.noise_size and config.temperature > 0)
    if not makes_scenes and context is None:
        with torch.no_grad():
            context = policy.encode(batch)
    if not makes_scenes and goals is None and config.goals == "logged":
        goals = logged_goals(batch, batch.evaluated_mask)
    passes = []
    for ids in group_positions(count if is_random else 1, config.rollouts_per_pass):
        histories = [draw_scene(scenario, rollout, seed=config.seed) for rollout in ids] if makes_scenes else []
        batch = collate(histories).to(device) if makes_scenes else batch
        # Noise belongs to rollout ids, so the passes together draw what a single pass would.
        rollouts = simulate(
            policy, batch, num_rollouts=1 if makes_scenes else ids, seed=config.seed, context=context,
            sampling=config.sampling, goals=goals,
        )  # fmt: skip
        states = states_of_rollouts(batch, rollouts)
        passes += map(prepend_history, histories, states) if makes_scenes else states
    joined = _join_passes(passes)
    # The metric would count NaN in a last bin, as no collision and no way off the road: a better score for nothing.
    joined.check_finite(scenario.scenario_id)
    # Equal rollouts of a deterministic policy are counted by the metric as often as rollouts were wanted.
    return joined if is_random else replace(joined, repeat=count)


def _join_passes(passes: Sequence[SimulatedStates]) -> SimulatedStates:
    """All rollouts of several passes, each [N, A, T]."""
    x, y, z, heading = (torch.cat([getattr(p, axis) for p in passes]) for axis in ("x", "y", "z", "heading"))
    sizes = [p.size for p in passes if p.size is not None]
    return SimulatedStates(passes[0].object_id, x, y, z, heading, size=torch.cat(sizes) if sizes else None)

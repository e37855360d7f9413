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
from rlftsim.scenario.types import Scenario

Oracle = Literal["oracle"]


def simulate_states(
    policy: Policy, batch: ScenarioBatch, config: EvaluateConfig, *, context: Any = None, goals: Goals | None = None
) -> SimulatedStates:
    """All rollouts of a scenario, simulated a few at a time; a deterministic policy is simulated once.

    Args:
        policy: Policy of all agents.
        batch: The scenario alone, on the policy's device; simulated from the current step on.
        config: Number of rollouts, rollouts at a time, seed, sampling.
        context: Result of an earlier `policy.encode(batch)`; None = encode here.
        goals: Goals of a single rollout, the same in all; None = goal-free.

    Raises:
        ConfigError: The policy cannot sample as `config` says, e.g. top-k without categories.
        DataError: A pose of the policy is not finite.
    """
    if context is None:
        with torch.no_grad():
            context = policy.encode(batch)
    is_random = policy.initial_noise_size or (policy.noise_size and config.temperature > 0)
    passes = []
    for ids in group_positions(config.num_rollouts if is_random else 1, config.rollouts_per_pass):
        # Noise belongs to rollout ids, so the passes together draw what a single pass would.
        rollouts = simulate(
            policy, batch, num_rollouts=ids, seed=config.seed, context=context, sampling=config.sampling, goals=goals,
        )  # fmt: skip
        passes.append(states_of_rollouts(batch, rollouts)[0])
    joined = _join_passes(passes)
    # The metric would count NaN in a last bin, as no collision and no way off the road: a better score for nothing.
    joined.check_finite(batch.scenarios[0].scenario_id)
    # Equal rollouts of a deterministic policy are counted by the metric as often as rollouts were wanted.
    return joined if is_random else replace(joined, repeat=config.num_rollouts)


def _join_passes(passes: Sequence[SimulatedStates]) -> SimulatedStates:
    """All rollouts of several passes, each [N, A, T]."""
    x, y, z, heading = (torch.cat([getattr(p, axis) for p in passes]) for axis in ("x", "y", "z", "heading"))
    sizes = [p.size for p in passes if p.size is not None]
    return SimulatedStates(passes[0].object_id, x, y, z, heading, size=torch.cat(sizes) if sizes else None)


def generate_states(policy: Policy, scenario: Scenario, config: EvaluateConfig) -> SimulatedStates:
    """Generated scenes: each rollout goes on from a history of its own, drawn by `draw_scene`.

    Args:
        policy: Policy of all agents.
        scenario: Scenario with the map, the lights and the ego's past; no other logged state is read.
        config: Number of rollouts, seed, sampling.

    Raises:
        DataError: A pose of the policy that is not finite.
    """
    scenes = []
    for numbers in group_positions(config.num_rollouts, config.rollouts_per_pass):
        histories = [draw_scene(scenario, rollout, seed=config.seed) for rollout in numbers]
        batch = collate(histories).to(get_device(policy))
        rollouts = simulate(policy, batch, num_rollouts=1, seed=config.seed, sampling=config.sampling)
        scenes += map(prepend_history, histories, states_of_rollouts(batch, rollouts))
    joined = _join_passes(scenes)
    joined.check_finite(scenario.scenario_id)
    return joined


def simulate_evaluated(policy: Policy | Oracle, batch: ScenarioBatch, config: EvaluateConfig) -> SimulatedStates:
    """Rollouts of a scenario as an evaluation scores them.

    Args:
        policy: Policy of all agents, or "oracle" for the log.
        batch: The scenario alone; for the log, with a future.
        config: Metric, number of rollouts, seed, sampling, goals.

    Raises:
        ConfigError, DataError: See `simulate_states`.
    """
    device = get_device(policy)
    if isinstance(policy, str):
        scenario, count = batch.scenarios[0], config.num_rollouts
        return logged_states(scenario, num_rollouts=count, device=device, challenge=config.challenge)
    if config.challenge.makes_scenes:
        return generate_states(policy, batch.scenarios[0], config)
    batch = batch.to(device)
    goals = logged_goals(batch, batch.evaluated_mask) if config.goals == "logged" else None
    return simulate_states(policy, batch, config, goals=goals)

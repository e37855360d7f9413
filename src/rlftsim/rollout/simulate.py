"""The closed loop: a policy decides, all agents move, and so on for eight seconds or any other time."""

import itertools
from collections.abc import Callable, Iterator
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.errors import ConfigError
from rlftsim.goals.types import Goals
from rlftsim.rollout.decisions import check_log_prob, check_numbers, encode_lights, inference, read_poses
from rlftsim.rollout.entries import EntryModel
from rlftsim.rollout.noise import draw_noise, name_decisions
from rlftsim.rollout.open_world import OpenRollouts
from rlftsim.rollout.policy import DecisionDistribution, Policy, Sampling, get_device
from rlftsim.rollout.types import AgentStates, Rollouts
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.types import FUTURE_STEPS, HISTORY_STEPS, STEP_S, Scenarios

Choose = Callable[[DecisionDistribution, Any, Sampling, Tensor], Tensor]
Force = Callable[[Any, int], AgentStates | None]
Observe = Callable[[Float[Tensor, "B N A t 3"]], None]


@inference()
def simulate(
    policy: Policy,
    batch: ScenarioBatch,
    *,
    num_rollouts: int | range,
    seed: int,
    num_steps: int = FUTURE_STEPS,
    context: Any = None,
    goals: Goals | None = None,
    sampling: Sampling = Sampling(),  # noqa: B008
    choose: Choose | None = None,
    force: Force | None = None,
    entries: EntryModel | None = None,
    observe: Observe | None = None,
    may_be_nan: bool = False,
) -> Rollouts:
    """Simulate N futures of every scenario, all in one batch; on a CPU with one thread.

    Args:
        policy: Policy that decides for every agent, the ego included.
        batch: Scenarios to continue; only history, map and lights are read.
        num_rollouts: Number N of futures, or a range of rollout ids: ids 8..15 of a seed are the same rollouts whether
            drawn alone or among 32.
        seed: Seed of the noise, the only random input of the rollouts.
        num_steps: Number of simulated steps T of 0.1 s; 80 are those of the metric. A longer rollout begins with the
            same states as a shorter one.
        context: Result of an earlier `policy.encode(batch)`; None = encode here.
        goals: Goals of agents in each of the N rollouts, or in a single rollout to be repeated; None = goal-free.
        sampling: Temperature and truncation of every draw.
        choose: Function that picks decisions from a distribution, such as CAT-K's closest among the top K; None = draw.
        force: Function called before every advance with the state and the step that the decision starts at; may impose
            states on agents.
        entries: Model of who enters, for a single scenario with visitors (`open_world.add_visitors`); agents leave,
            too. `force` has the last word, and may then move only who never leaves, the ego. None = nobody enters or
            leaves.
        observe: Function called after every decision with the poses so far (x, y, heading, map frame); an error ends
            the simulation.
        may_be_nan: True = log-probabilities that are NaN are handed on, to training, which skips such an update.

    Returns:
        Poses, decisions and log-probabilities, under the distribution that was sampled from.

    Raises:
        ConfigError: There are no rollouts, the length of a decision does not divide the steps, or goals, which are due
            after 8 s, in rollouts of another length; or entries that do not fit policy or batch, see `OpenRollouts`.
        DataError: The policy returns distributions or poses of a wrong shape, or NaN, as with weights that are NaN, or
            poses farther away than any road; the scenario is named.
    """
    rollout_ids = range(num_rollouts) if isinstance(num_rollouts, int) else num_rollouts
    stride = policy.steps_per_decision
    if len(rollout_ids) < 1 or FUTURE_STEPS % stride:
        raise ConfigError(
            f"cannot simulate {len(rollout_ids)} rollouts with {stride} steps per decision: "
            "need >= 1 and a divisor of 80."
        )
    check_length(policy, num_steps)
    if goals is not None and num_steps != FUTURE_STEPS:
        raise ConfigError(
            f"goals are due after {FUTURE_STEPS} steps, not after {num_steps}: simulate 8 seconds, or leave goals out."
        )
    world = None if entries is None else OpenRollouts(batch, rollout_ids, seed, stride, entries)
    goals = goals and goals.repeat(len(rollout_ids))

    # 1. noise depends on seed, scenario and rollout id alone
    initial = draw_noise(batch, rollout_ids, seed=seed, purpose="begin", per_agent=policy.initial_noise_size)
    noise = _draw_decision_noise(policy, batch, rollout_ids, seed)

    # 2. the loop
    context = policy.encode(batch) if context is None else context
    state = policy.begin(context, len(rollout_ids), goals, initial)
    draws, shape = state.draws, (batch.num_scenarios, len(rollout_ids), batch.agent_mask.shape[1])
    poses, decisions, log_probs, forced_states, masks = [], [], [], [], []
    for step, decision_noise in zip(range(0, num_steps, stride), noise):
        context = encode_lights(policy, batch, context, step)
        distribution = policy.decide(context, state)
        arguments = (sampling, decision_noise)
        decision = choose(distribution, state, *arguments) if choose else distribution.sample(*arguments)
        forced = force(state, step) if force else None
        forced = forced if world is None else world.force(state, step).overlay(forced)
        state = policy.advance(context, state, decision, forced)
        poses.append(read_poses(policy, state, shape))
        decisions.append(decision)
        log_probs.append(distribution.log_prob(decision, sampling))
        check_log_prob(policy, log_probs[-1], shape)
        masks.append(getattr(distribution, "mask", None))
        forced_states.append(forced)
        if observe is not None:
            observe(torch.cat(poses, dim=3))

    # 3. one value
    valid = None if world is None else world.valid.to(batch.device)
    rollouts = _join_decisions(batch, poses, decisions, log_probs, forced_states, masks)
    rollouts = replace(rollouts, draws=draws, goals=goals, valid=valid)
    if not may_be_nan:
        check_numbers(policy, batch, rollouts.log_prob, rollouts.position, rollouts.heading)
    return rollouts


def _join_decisions(
    batch: ScenarioBatch,
    poses: list[Tensor],
    decisions: list[Tensor],
    log_probs: list[Tensor],
    forced: list[AgentStates | None],
    masks: list[Tensor | None],
) -> Rollouts:
    """Rollouts of the decisions of all steps, a list each.

    A decision counts unless the agent is padding, decides nothing any more or was forced through all of its steps.
    """
    path = torch.cat(poses, dim=3)  # [B, N, A, T, 3]
    all_forced = _join_states(forced, path)
    present = batch.agent_mask[:, None].expand(path.shape[:3])  # [B, N, A]
    mask = torch.stack([present if decides is None else present & decides for decides in masks], 3)  # [B, N, A, L]
    if all_forced is not None:
        mask = mask & ~all_forced.valid.unflatten(-1, (len(masks), -1)).all(-1)
    log_prob = torch.where(mask, torch.stack(log_probs, dim=3), 0.0)
    return Rollouts(path[..., :2], path[..., 2], torch.stack(decisions, dim=3), mask, log_prob, forced=all_forced)


def _draw_decision_noise(
    policy: Policy, batch: ScenarioBatch, rollout_ids: range, seed: int
) -> Iterator[Float[Tensor, "B N A noise"]]:
    """Noise of one decision after the other, drawn for 8 s at once, so that it depends on no rollout's length."""
    per_block = FUTURE_STEPS // policy.steps_per_decision
    for block in itertools.count():
        purpose, per_agent = name_decisions(block), per_block * policy.noise_size
        noise = draw_noise(batch, rollout_ids, seed=seed, purpose=purpose, per_agent=per_agent)
        yield from noise.unflatten(-1, (per_block, -1)).unbind(-2)


def lead_ego(batch: ScenarioBatch, stride: int) -> Force:
    """A `force` of `simulate` that leads the ego along the log, as agents are logged around the logged ego; where the
    log lacks it, the policy drives.

    Args:
        batch: A single scenario.
        stride: Steps of a decision.
    """
    scenario = batch.scenarios[0]
    is_ego = batch.object_id == int(scenario.tracks.object_id[scenario.ego_index])  # [1, A]

    def force(_: object, step: int) -> AgentStates:
        steps = slice(HISTORY_STEPS + step, HISTORY_STEPS + step + stride)
        valid = batch.valid[..., steps] & is_ego[..., None]
        return AgentStates(batch.position[:, None, :, steps], batch.heading[:, None, :, steps], valid[:, None])

    return force


def check_length(policy: Policy, num_steps: int) -> None:
    """Check that decisions of a policy fill a number of steps.

    Args:
        policy: Policy that decides for some steps at once.
        num_steps: Number of simulated steps.

    Raises:
        ConfigError: The length of a decision does not divide the steps.
    """
    stride = policy.steps_per_decision
    if num_steps < 1 or num_steps % stride:
        raise ConfigError(
            f"this model decides for {stride * STEP_S:g} s at a time: seconds must be a multiple, got "
            f"{num_steps * STEP_S:g}."
        )


def check_sampling(policy: Policy, scenarios: Scenarios, sampling: Sampling) -> None:
    """Check before long work that the policy's decisions can be truncated as `sampling` says.

    Args:
        policy: Policy in evaluation mode.
        scenarios: Scenarios of the work; the first is simulated once if there is a truncation.
        sampling: Temperature and truncation of the work.

    Raises:
        ConfigError: `sampling.top_k` is set, and decisions are not categories.
    """
    if sampling.top_k is not None:  # only a draw shows whether there are categories to choose from
        simulate(policy, collate([scenarios[0]]).to(get_device(policy)), num_rollouts=1, seed=0, sampling=sampling)


def _join_states(states: list[AgentStates | None], path: Float[Tensor, "B N A T 3"]) -> AgentStates | None:
    """Imposed states of all steps; None where no states were imposed."""
    if all(forced is None for forced in states):
        return None
    joined = AgentStates(path[..., :2].clone(), path[..., 2].clone(), torch.zeros_like(path[..., 0], dtype=torch.bool))
    stride = path.shape[3] // len(states)
    for index, forced in enumerate(states):
        if forced is not None:
            steps = slice(index * stride, (index + 1) * stride)
            joined.position[..., steps, :], joined.heading[..., steps] = forced.position, forced.heading
            joined.valid[..., steps] = forced.valid
    return joined

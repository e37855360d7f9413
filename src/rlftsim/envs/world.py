"""The world: B scenes that step together at 10 Hz, with traffic that decides every half second.

A `World` holds the constants of an episode, a `WorldState` is a value: stepping returns a new state and leaves the old
state unchanged, so a fork is the same state used twice. With a policy that decides for k steps, a block of k steps runs
so:

1. Before its first step the policy decides for all agents and `advance` gives their k poses. The noise depends on seed,
   scenario, rollout and decision alone, as in `rollout.simulate`: whatever a planner does, the dice are the same.
2. Each step moves the planner's agents by one step and reveals one pose of the other agents.
3. After the last step `advance` is called again from the same state, with the poses of all agents that the policy did
   not drive imposed. So the policy sees the planner's true motion, 0.1 to 0.5 s later.

Shapes: B scenes, A agents (padded), M agents that a planner drives, over all scenes. Frame: map of each scene, meters,
seconds. Motion: x, y, heading, vx, vy.
"""

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any, Literal, get_args

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.envs.drivers import Driver, Rules, assign_drivers
from rlftsim.envs.idm import IdmConfig, IdmLines, advance_idm, begin_idm, build_idm_lines
from rlftsim.envs.scene import Lights, Scene, build_env_scene, compute_directions
from rlftsim.envs.sumo_traffic import SumoScene, SumoState, advance_sumo, begin_sumo, build_sumo_scene
from rlftsim.errors import ConfigError, in_short
from rlftsim.goals.types import Goals, PointById
from rlftsim.rollout.decisions import check_log_prob, check_numbers, encode_lights, inference, read_poses
from rlftsim.rollout.entries import EntryModel
from rlftsim.rollout.noise import draw_noise, name_decisions
from rlftsim.rollout.open_world import OpenWorld, Presence, add_visitors, make_rng
from rlftsim.rollout.policy import Policy, Sampling, get_device
from rlftsim.rollout.types import AgentStates
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, HISTORY_STEPS, STEP_S, TOTAL_STEPS, Scenario

IDM = IdmConfig()
Noise = Literal["same", "new"]


@dataclass(frozen=True)
class Dice:
    """Randomness of a scene: the same numbers give the same traffic, as `simulate(seed=..., num_rollouts=...)`."""

    seed: int
    rollout: int = 0


@dataclass(frozen=True, eq=False)
class World:
    """B scenes that step together, S steps of the log's time, and the driver of each agent."""

    scenes: tuple[Scene, ...]
    batch: ScenarioBatch
    mask: Bool[np.ndarray, "B A"]
    """False = padding."""
    drivers: Int64[np.ndarray, "B A"]
    """Numbers of `Driver`; -1 for padding."""
    actors: Int64[np.ndarray, "M 2"]
    """Scene and agent of each planner-driven agent."""
    size: Float[np.ndarray, "B A 2"]
    """Length and width."""
    height: Float[np.ndarray, "B A"]
    object_type: Int64[np.ndarray, "B A"]
    logged_steps: Float[np.ndarray, "S B A 5"]
    """Logged motion, the numbers of a step side by side."""
    logged_z: Float[np.ndarray, "B A S"]
    valid: Bool[np.ndarray, "B A S"]
    policy: Policy | None
    """None where no agent follows a policy."""
    context: Any
    """Scenarios as the policy encodes them, with the lights of the current step."""
    goals: Goals | None
    sampling: Sampling
    lines: tuple[IdmLines, ...]
    """Of the IDM-driven agents of each scene."""
    sumo_scenes: tuple[SumoScene, ...]
    """Of each scene where SUMO drives the others; else empty."""
    is_present: Bool[np.ndarray, "S B A"]
    """True = the agent is there at a step of the log's time (10 is the current one); replayed ones until it ends. Those
    that have left since are in `WorldState.has_left`."""
    is_observed: Bool[np.ndarray, "S B A"]
    """True = it is there, and not held in a gap of its log: contacts and scores count these states alone."""
    has_levels: Bool[np.ndarray, "B"]
    """True = heights count in the scene, see `levels`."""
    open_worlds: tuple[OpenWorld, ...] = ()
    """Of each scene where agents leave and enter; else empty."""

    @cached_property
    def agents(self) -> dict[Driver, tuple[np.ndarray, np.ndarray]]:
        """Scenes and agents that each driver moves, as two arrays."""
        scene, agent = np.nonzero(self.mask)
        drivers = self.drivers[scene, agent]
        return {driver: (scene[drivers == driver], agent[drivers == driver]) for driver in Driver}

    @property
    def logged(self) -> Float[np.ndarray, "B A S 5"]:
        """Logged motion of each agent; a view."""
        return np.moveaxis(self.logged_steps, 0, 2)


@dataclass(frozen=True, eq=False)
class Block:
    """Decisions of the policy that are being carried out."""

    policy_state: Any
    """State of the policy before them."""
    context: Any
    """Context that they are made in: lights change every 2 s from second 8 on, see `encode_lights`."""
    decision: Tensor | None
    """None before the first block."""
    poses: Float[np.ndarray, "B A k 3"] | None
    """The poses they lead to."""
    presences: tuple[Presence, ...] = ()
    """Who is there in each scene where agents leave and enter."""

    @property
    def is_imposed(self) -> Bool[np.ndarray, "B A"]:
        """True = the policy does not move the agent, since it is absent, parked or enters."""
        return np.concatenate([presence.is_imposed for presence in self.presences])

    @property
    def is_absent(self) -> Bool[np.ndarray, "B A"]:
        """True = the agent is not there, in scenes where agents leave and enter."""
        return ~np.concatenate([presence.is_present for presence in self.presences])


@dataclass(frozen=True, eq=False)
class WorldState:
    """B scenes at a step."""

    track: tuple[Float[np.ndarray, "B A 5"], ...]
    """Motion at every step of the log's time from 0 to the present one."""
    directions: tuple[Float[np.ndarray, "B A 2"], ...]
    """Unit vectors along the headings at the same steps."""
    z: tuple[Float[np.ndarray, "B A"], ...]
    """Heights of the centers at the same steps; always those of the current step in scenes without levels."""
    block: Block | None
    """None where no agent follows a policy."""
    noise: Float[Tensor, "B 1 A L n"] | None
    """Of all decisions of the present 8 s."""
    dice: tuple[tuple[Dice, ...], ...]
    """Dice of each scene, at each decision taken so far and for all that follow (the last entry)."""
    idm_states: tuple[Float[np.ndarray, "_ 2"], ...]
    """Distance along the line, and speed, of the IDM-driven agents of each scene."""
    sumo_states: tuple[SumoState, ...] = ()
    """Of each scene where SUMO drives the others."""
    has_left: tuple[Bool[np.ndarray, "B A"], ...] = ()
    """True = the agent is not there any more, at the same steps as `track`; empty where nobody leaves."""

    @property
    def step(self) -> int:
        """Steps taken."""
        return len(self.track) - 1 - CURRENT_STEP

    @property
    def motion(self) -> Float[np.ndarray, "B A 5"]:
        """Present motion."""
        return self.track[-1]

    @cached_property
    def since_start(self) -> tuple[Float[np.ndarray, "T1 B A 5"], Float[np.ndarray, "T1 B A"]]:
        """Motion and heights from the current step of the log to the present one."""
        return np.stack(self.track[CURRENT_STEP:]), np.stack(self.z[CURRENT_STEP:])


def build_world(
    scenarios: Sequence[Scenario],
    policy: Policy | None,
    *,
    rules: Rules,
    goals: Mapping[str, PointById] | None = None,
    sampling: Sampling = Sampling(),  # noqa: B008
    context: Any = None,
    data: Path | None = None,
    max_steps: int = FUTURE_STEPS,
    entries: EntryModel | None = None,
) -> World:
    """The world of some scenarios, which step together.

    Args:
        scenarios: Scenarios that step together, at least one.
        policy: Traffic model; left out where the rules give no agent to the policy.
        rules: Agents to driver, the first match wins, see `assign_drivers`.
        goals: Scenario id to object id to (x, y) of agents that follow the policy, world frame, m.
        sampling: Temperature and truncation of the policy's decisions.
        context: Result of `policy.encode` for these scenarios; None = computed here.
        data: Folder of the data set, which has the worlds that SUMO runs again.
        max_steps: Largest number of steps; replayed agents are gone after their log's end, and lights hold.
        entries: Model of who enters; all agents but the planner's then follow the policy. None = nobody enters or
            leaves.

    Raises:
        ConfigError: a rule that does not fit, or agents that follow the policy where `policy` is left out.
        DataError: SUMO is to drive in a scenario without a world.
    """
    num_steps = max(TOTAL_STEPS, HISTORY_STEPS + max_steps)
    if entries is not None:
        scenarios = [add_visitors(scenario) for scenario in scenarios]
    scenes = tuple(build_env_scene(scenario, num_steps) for scenario in scenarios)
    batch = collate(scenarios)
    shape = tuple(batch.agent_mask.shape)
    drivers = padded([assign_drivers(scene, rules) for scene in scenes], shape, -1)
    followers = bool((drivers == Driver.POLICY).any())
    if followers and policy is None:
        raise ConfigError("some agents follow the policy, but there is no model: name one, or give them other drivers.")
    batch = batch.to(get_device(policy)) if followers else batch
    if followers and context is None:
        assert policy is not None
        with inference():
            context = policy.encode(batch)
    by_sumo = scenes if (drivers == Driver.SUMO).any() else ()
    if by_sumo and data is None:
        raise ConfigError("SUMO drives in scenarios of a data set alone: name its folder as `data`.")
    mask = batch.agent_mask.cpu().numpy()
    valid = padded([scene.valid for scene in scenes], (*shape, num_steps), False)
    # from the current step on all agents exist, but replayed ones are gone after the last state of their log
    goes_on = np.maximum.accumulate(valid[..., ::-1], axis=-1)[..., ::-1]
    simulated = (drivers != Driver.REPLAY)[..., None]
    is_present = mask[..., None] & (simulated | goes_on)
    is_present[..., : CURRENT_STEP + 1] = valid[..., : CURRENT_STEP + 1]
    is_driven = drivers == Driver.PLANNER
    is_driven[np.arange(len(scenes)), [scene.ego for scene in scenes]] = True
    idm_rows = [np.flatnonzero(row[: len(scene.object_id)] == Driver.IDM) for row, scene in zip(drivers, scenes)]
    return World(
        scenes=scenes,
        batch=batch,
        mask=mask,
        drivers=drivers,
        actors=np.argwhere(drivers == Driver.PLANNER),
        size=padded([scene.size[:, :2] for scene in scenes], (*shape, 2)),
        height=padded([scene.size[:, 2] for scene in scenes], shape),
        object_type=padded([scene.object_type for scene in scenes], shape, 0),
        logged_steps=np.ascontiguousarray(
            np.moveaxis(padded([scene.logged for scene in scenes], (*shape, num_steps, 5)), 2, 0)
        ),
        logged_z=padded([scene.logged_z for scene in scenes], (*shape, num_steps)),
        valid=valid,
        is_present=np.moveaxis(is_present, 2, 0).copy(),
        is_observed=np.moveaxis(is_present & (simulated | valid), 2, 0).copy(),
        has_levels=np.array([scene.levels is not None for scene in scenes]),
        policy=policy if followers else None,
        context=context if followers else None,
        goals=Goals.from_points(batch, goals) if goals and followers else None,
        sampling=sampling,
        lines=tuple(build_idm_lines(scene, rows, IDM) for scene, rows in zip(scenes, idm_rows)),
        sumo_scenes=tuple(build_sumo_scene(scene, data) for scene in by_sumo if data is not None),
        open_worlds=tuple(
            OpenWorld(scene.scenario, shape[1], entries, np.flatnonzero(row))
            for scene, row in zip(scenes, is_driven) if entries is not None
        ),
    )  # fmt: skip


def padded(arrays: list[np.ndarray], shape: tuple[int, ...], fill: float | int | bool = 0.0) -> np.ndarray:
    """Arrays that differ in the length of the first axis, in a single array.

    Args:
        arrays: Arrays of the same type, at least one.
        shape: Shape of the result; the first axis has an entry for each array.
        fill: Value beyond the end of each array.
    """
    out = np.full((len(arrays), *shape[1:]), fill, arrays[0].dtype)
    for row, array in zip(out, arrays):
        row[: len(array)] = array
    return out


def begin(world: World, dice: Sequence[Dice]) -> WorldState:
    """The world at the current step of the logs.

    Args:
        world: Scenes that step together, with the drivers of all agents.
        dice: Randomness of the traffic, per scene.
    """
    block = noise = None
    if world.policy is not None:
        initial = _noise(world, dice, "begin", world.policy.initial_noise_size)
        with inference():
            policy_state = world.policy.begin(world.context, 1, world.goals, initial)
        presences = tuple(open_world.begin(1) for open_world in world.open_worlds)
        block = Block(policy_state, world.context, None, None, presences)
        noise = _decision_noise(world, dice, 0)
    idm_states = tuple(begin_idm(lines, scene) for scene, lines in zip(world.scenes, world.lines))
    track = tuple(world.logged_steps[: CURRENT_STEP + 1].copy())
    z = (world.logged_z[:, :, CURRENT_STEP],) * len(track)
    sumo_states = tuple(begin_sumo(sumo_scene, scene) for sumo_scene, scene in zip(world.sumo_scenes, world.scenes))
    leaves = bool(world.sumo_scenes) or any(np.isfinite(lines.exit_m).any() for lines in world.lines)
    has_left = (np.zeros(world.mask.shape, bool),) * (len(track) if leaves else 0)
    if block is not None and block.presences:
        has_left = (block.is_absent,) * len(track)
    directions = tuple(compute_directions(motion) for motion in track)
    return WorldState(track, directions, z, block, noise, (tuple(dice),), idm_states, sumo_states, has_left)


def step_world(world: World, state: WorldState, moved: Float[np.ndarray, "M 5"]) -> WorldState:
    """The state 0.1 s later.

    Args:
        world: Scenes that step together, with the drivers of all agents.
        state: State before the step; not changed.
        moved: Motion of the planner-driven agents after the step, in the order of `world.actors`.
    """
    block, dice = state.block, state.dice
    following = len(state.track)  # step of the log's time that is being computed
    motion = world.logged_steps[following].copy()  # replayed agents
    previous = state.motion
    # 1. agents of the policy, and those that keep their velocity
    if block is not None:
        assert world.policy is not None
        if state.step and state.step % FUTURE_STEPS == 0:
            state = with_dice(world, state, dice[-1])  # noise of the next 8 s
        if state.step % world.policy.steps_per_decision == 0:
            block = _decide(world, state)
            dice = (*dice, dice[-1])
        assert block.poses is not None
        block_step = state.step % world.policy.steps_per_decision
        poses, before = block.poses[:, :, block_step], previous[..., :2]
        if block.presences and block_step == 0:  # who enters was elsewhere
            ahead = block.poses[:, :, 1, :2] - poses[..., :2]
            before = np.where(block.is_imposed[..., None], poses[..., :2] - ahead, before)
        velocity = (poses[..., :2] - before) / STEP_S
        follows = world.agents[Driver.POLICY]
        motion[follows] = np.concatenate([poses, velocity], -1)[follows]
    coasts = world.agents[Driver.CONSTANT_VELOCITY]
    motion[coasts] = previous[coasts]
    motion[(*coasts, slice(2))] += STEP_S * previous[coasts][:, 3:]
    # 2. IDM-driven vehicles
    idm_states, driven = state.idm_states, world.agents[Driver.IDM]
    if len(driven[0]):
        motion[driven] = previous[driven]
        motion[(*driven, slice(3, 5))] = 0.0  # parked ones stay; those with a line move below
        present = find_presence(world, state, 1)[0][0]
        moved_states = []
        for b, (scene, lines) in enumerate(zip(world.scenes, world.lines)):
            agents = b, slice(len(scene.object_id))
            idm_state, motion[b, lines.agents] = advance_idm(
                lines, idm_states[b], previous[agents], state.z[-1][agents], present[agents], scene, following - 1, IDM
            )
            moved_states.append(idm_state)
        idm_states = tuple(moved_states)
    # 3. agents of SUMO, which sees the ego's new place one step later
    sumo_states = []
    for b, (sumo_scene, scene) in enumerate(zip(world.sumo_scenes, world.scenes)):
        agents = b, slice(len(scene.object_id))
        sumo_state, motion[agents] = advance_sumo(sumo_scene, state.sumo_states[b], previous[agents], scene, moved[b])
        sumo_states.append(sumo_state)
    # 4. the planner's agents; padding stays at zero
    motion[world.actors[:, 0], world.actors[:, 1]] = moved
    z = state.z[-1]
    if world.has_levels.any():
        if block is not None and block.presences:
            z = _find_entry_heights(world, z, motion, state.has_left[-1] & ~block.is_absent)
        z = _follow_levels(world, z, motion, following)
    # 5. those that have left
    has_left = state.has_left
    if block is not None and block.presences:
        has_left = (*has_left, block.is_absent)
    elif has_left:
        left = has_left[-1].copy()
        for b, (lines, idm_state) in enumerate(zip(world.lines, idm_states)):
            left[b, lines.agents] |= idm_state[:, 0] >= lines.exit_m
        for b, sumo_state in enumerate(sumo_states):
            left[b, : len(sumo_state.has_left)] |= sumo_state.has_left
        has_left = (*has_left, left)
    directions = (*state.directions, compute_directions(motion))
    return WorldState(
        (*state.track, motion), directions, (*state.z, z), block, state.noise, dice, idm_states, tuple(sumo_states),
        has_left,
    )  # fmt: skip


def find_presence(
    world: World, state: WorldState, num_steps: int | None = None
) -> tuple[Bool[np.ndarray, "T B A"], Bool[np.ndarray, "T B A"]]:
    """`is_present` and `is_observed` at the last T steps of the log's time up to the present one.

    Args:
        world: Scenes that step together.
        state: Present state of the world.
        num_steps: Number T of steps; None = all since the first of the log.
    """
    end = len(state.track)
    steps = slice(0 if num_steps is None else end - num_steps, end)
    present, observed = world.is_present[steps], world.is_observed[steps]
    if not state.has_left:
        return present, observed
    has_left = np.stack(state.has_left[steps])
    return present & ~has_left, observed & ~has_left


def find_lights(world: World, state: WorldState) -> list[Lights]:
    """Lights of each scene: those of the log, or as SUMO has shown them up to the present step."""
    return [sumo_state.lights for sumo_state in state.sumo_states] or [scene.lights for scene in world.scenes]


def _follow_levels(
    world: World, z: Float[np.ndarray, "B A"], motion: Float[np.ndarray, "B A 5"], step: int
) -> Float[np.ndarray, "B A"]:
    """Heights of the centers after a step: replayed agents have logged heights, others stay on the ground of the level.

    Args:
        world: Scenes that step together.
        z: Heights of the centers before the step, m.
        motion: Motion of all agents after the step.
        step: Step of the log's time after the step, 11 or later.
    """
    z = z.copy()
    for b, scene in enumerate(world.scenes):
        if scene.levels is not None:
            half = scene.size[:, 2] / 2
            count = len(half)
            z[b, :count] = scene.levels.follow(motion[b, :count, :2], z[b, :count] - half) + half
    is_replayed = world.has_levels[:, None] & (world.drivers == Driver.REPLAY)
    return np.where(is_replayed, world.logged_z[:, :, step], z)


def _find_entry_heights(
    world: World, z: Float[np.ndarray, "B A"], motion: Float[np.ndarray, "B A 5"], enters: Bool[np.ndarray, "B A"]
) -> Float[np.ndarray, "B A"]:
    """Heights of the centers, those of agents that enter on the nearest lane."""
    z = z.copy()
    for b, agent in np.argwhere(enters):
        lanes = world.scenes[b].lanes
        nearest = np.square(lanes.points - motion[b, agent, :2]).sum(-1).argmin()
        z[b, agent] = lanes.z.flat[nearest] + world.height[b, agent] / 2
    return z


def fork(world: World, state: WorldState, number: int, noise: Noise = "same") -> tuple[WorldState, ...]:
    """States that go on from the same state: only the noise of the decisions to come is copied.

    Args:
        world: Scenes that step together, with the drivers of all agents.
        state: State where the branches begin; not changed.
        number: Number of branches to return.
        noise: Dice of the branches: "same" = all meet the dice of `state`; "new" = branch i meets the dice of
            `rollout + 1 + i`, from the next decision on.

    Raises:
        ConfigError: Neither "same" nor "new".
    """
    if noise not in get_args(Noise):
        raise ConfigError(f"noise must be one of {', '.join(get_args(Noise))}, got {in_short(noise)}.")
    if noise == "same" or state.noise is None:
        return (state,) * number
    return tuple(
        with_dice(world, state, [Dice(d.seed, d.rollout + 1 + branch) for d in state.dice[-1]])
        for branch in range(number)
    )


def with_dice(world: World, state: WorldState, dice: Sequence[Dice]) -> WorldState:
    """The same state with other dice from the next decision on.

    Args:
        world: Scenes that step together, with the drivers of all agents.
        state: State of these scenes; not changed.
        dice: Randomness of the traffic, per scene.
    """
    noise = None if state.noise is None else _decision_noise(world, dice, state.step // FUTURE_STEPS)
    return replace(state, noise=noise, dice=(*state.dice[:-1], tuple(dice)))


def _decide(world: World, state: WorldState) -> Block:
    """Decisions of the next block: the last block is finished with the true motion, then the policy decides."""
    policy, block = world.policy, state.block
    assert policy is not None
    assert block is not None
    assert state.noise is not None
    with inference():
        policy_state = block.policy_state
        if block.decision is not None:
            policy_state = policy.advance(block.context, policy_state, block.decision, _forced(world, state))
        context = encode_lights(policy, world.batch, block.context, state.step)
        distribution = policy.decide(context, policy_state)
        index = state.step % FUTURE_STEPS // policy.steps_per_decision
        decision = distribution.sample(world.sampling, state.noise[..., index, :])
        presences, imposed = tuple(_find_presences(world, state)), None
        if presences:
            states = [presence.impose(world.batch.device) for presence in presences]
            imposed = AgentStates(*(torch.cat(values) for values in zip(*(vars(state).values() for state in states))))
        shape, log_prob = (len(world.mask), 1, world.mask.shape[1]), distribution.log_prob(decision, world.sampling)
        check_log_prob(policy, log_prob, shape)
        poses = read_poses(policy, policy.advance(context, policy_state, decision, imposed), shape)
        follows = torch.from_numpy(world.mask & (world.drivers == Driver.POLICY)).to(log_prob.device)[:, None]
        log_prob = torch.where(follows, log_prob, 0.0)
        check_numbers(policy, world.batch, log_prob, poses[..., :2], poses[..., 2], state.step)
    return Block(policy_state, context, decision, poses[:, 0].cpu().numpy().astype(np.float64), presences)


def _find_presences(world: World, state: WorldState) -> Iterator[Presence]:
    """Who is there in each scene during the next block, where agents leave and enter."""
    assert state.block is not None
    for b, (open_world, presence) in enumerate(zip(world.open_worlds, state.block.presences)):
        motion, dice = state.motion[b : b + 1], state.dice[-1][b]
        rng = make_rng(dice.seed, open_world.scenario_id, dice.rollout, state.step)
        # positions as the policy has them
        pose = motion[..., :3].astype(np.float32).astype(np.float64)
        yield open_world.step(presence, pose, motion[..., 3:], [rng])


def _forced(world: World, state: WorldState) -> AgentStates | None:
    """Last block's motion of the agents that the policy does not drive; None where the policy drives all."""
    assert world.policy is not None
    imposed = world.mask & (world.drivers != Driver.POLICY)
    if state.block is not None and state.block.presences:
        imposed |= state.block.is_imposed
    if not imposed.any():
        return None
    steps = world.policy.steps_per_decision
    done = torch.from_numpy(np.stack(state.track[-steps:], 2)).float().to(world.batch.device)[:, None]  # [B 1 A k 5]
    valid = torch.from_numpy(imposed).to(done.device)[:, None, :, None].expand(done.shape[:-1])
    return AgentStates(done[..., :2], done[..., 2], valid)


def _decision_noise(world: World, dice: Sequence[Dice], block: int) -> Tensor:
    """Noise of the decisions in 8 s, as `simulate` draws it.

    Args:
        world: Scenes that step together.
        dice: Randomness of the traffic, per scene.
        block: Number of the 8 s, from 0.
    """
    assert world.policy is not None
    num_decisions = FUTURE_STEPS // world.policy.steps_per_decision
    noise = _noise(world, dice, name_decisions(block), num_decisions * world.policy.noise_size)
    return noise.unflatten(-1, (num_decisions, -1))


def _noise(world: World, dice: Sequence[Dice], purpose: str, per_agent: int) -> Float[Tensor, "B 1 A k"]:
    """Noise of scenes with dice per scene, as `simulate` draws for each scene."""
    noise = []
    for scenario_batch, drawn in zip(world.batch.split(1), dice):
        ids = range(drawn.rollout, drawn.rollout + 1)
        noise.append(draw_noise(scenario_batch, ids, seed=drawn.seed, purpose=purpose, per_agent=per_agent))
    return torch.cat(noise)

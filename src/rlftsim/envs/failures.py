"""How often a planner fails in a scenario among simulated traffic, and the failures themselves.

Every failure is a sample of the traffic model: nothing is adversarial. An episode is a chain of blocks of half a
second; within a block planner and traffic do not see each other's moves, so a branch takes new dice at the end of a
block (`envs.splitting`). Branches of a level run side by side. What a branch shares with its parent is run again with
the same dice and the planner's stored motion, which gives equal bits; the planner itself goes on as a copy.
"""

import copy
import hashlib
import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, replace
from functools import lru_cache, partial
from os import PathLike
from pathlib import Path
from typing import Any

import numpy as np
from jaxtyping import Float, Int64

from rlftsim.envs.config import EnvConfig
from rlftsim.envs.contact import Collision, CollisionType
from rlftsim.envs.dangers import Event, StepView, find_event, measure_danger
from rlftsim.envs.episode import Episode, EpisodeState, advance, look, start
from rlftsim.envs.planners.batch import act_together, acts_together
from rlftsim.envs.planners.registry import Planner, PlannerFailure, guard_planner, read_action_settings, to_planner
from rlftsim.envs.resets import describe_start
from rlftsim.envs.result import Result, build_result
from rlftsim.envs.source import Source
from rlftsim.envs.splitting import estimate_interval, split
from rlftsim.envs.world import Dice, with_dice
from rlftsim.errors import ConfigError, DataError, check_types, in_short, whole_number
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.types import CURRENT_STEP, Scenario

BLOCK_STEPS = 5
BATCH = 32
"""Episodes that run side by side at most."""


@dataclass(frozen=True)
class Failure:
    """An episode in which the event happens, and all that is needed to run it again."""

    scenario_id: str
    probability: float
    """Share of the episode in the estimate of its repeat."""
    dice: tuple[int, ...]
    """Number of the traffic's dice in each block of half a second."""
    step: int
    """Step of 0.1 s at which the event happens."""
    digest: str
    """SHA-256 of the motion of the planner's agent."""
    contact: str = ""
    """Type of the contact, see `contact.CollisionType`; empty where the event is none."""
    at_fault: bool = False
    closing_mps: float = 0.0
    """Length of the difference of both velocities at the contact."""
    agent: int = -1
    """Object id of the agent that is touched."""

    def __post_init__(self) -> None:
        check_types(self)
        if self.step < 0 or not all(isinstance(number, int) and number >= 0 for number in self.dice):
            raise ConfigError(f"a failure has whole numbers of step and dice, got {in_short([self.step, self.dice])}.")
        if self.contact not in ("", *CollisionType):
            raise ConfigError(f"a contact is {', '.join(CollisionType)} or empty, got {in_short(self.contact)}.")


@dataclass(frozen=True)
class Repeat:
    """An independent estimate of the probability of an event, by one run of splitting."""

    probability: float
    num_levels: int
    num_steps: int
    """Steps of the world, those included that branches share with their parents."""
    failures: tuple[Failure, ...]

    def __post_init__(self) -> None:
        check_types(self)
        if not (0 <= self.probability <= 1 and self.num_steps > 0):
            raise ConfigError(f"no estimate has probability {self.probability} after {self.num_steps} steps.")


@dataclass(frozen=True, eq=False)
class DrivenPath:
    """An episode that has been driven: S steps in T blocks."""

    dice: Int64[np.ndarray, "T"]
    motion: Float[np.ndarray, "S 5"]
    """Motion of the planner's agent after each step."""
    danger: Float[np.ndarray, "S1"]
    planners: tuple[Planner, ...]
    """Copies of the planner at the beginning of each block."""
    collisions: tuple[Collision, ...]

    @property
    def driven_m(self) -> float:
        """Distance that the planner drives after the first step."""
        return float(np.hypot(*np.diff(self.motion[:, :2], axis=0).T).sum())

    @property
    def digest(self) -> str:
        """SHA-256 of the motion."""
        return hashlib.sha256(self.motion.tobytes()).hexdigest()


class FailureChain:
    """Episodes of a planner in a scenario as a `splitting.Chain`.

    Args:
        source: Settings, traffic model and the scenario; no event may end an episode.
        planner: Planner that drives; copied, and itself left as it is.
        scenario_id: Scenario of the source.
        event: Event whose danger is measured.
        seed: Seed of the traffic.
        first_number: Number of the first dice; those of other chains of the same seed should be far away.

    Raises:
        ConfigError: A planner that cannot be copied, or an episode shorter than a block.
    """

    def __init__(
        self, source: Source, planner: Planner, scenario_id: str, event: Event, *, seed: int, first_number: int = 0
    ):
        self.source, self.scenario_id, self.event = source, scenario_id, event
        self.seed, self.first_number, self.planner = seed, first_number, copy_planner(planner)
        per_decision = source.policy.steps_per_decision if source.policy is not None else 1
        self.block_steps = math.lcm(BLOCK_STEPS, per_decision, source.controls.steps)
        self.num_blocks = source.config.max_steps // self.block_steps
        if not self.num_blocks:
            raise ConfigError(f"max_steps is {source.config.max_steps}: give at least {self.block_steps}, a block.")

    def start(self, numbers: Int64[np.ndarray, "n"]) -> tuple[np.ndarray, np.ndarray]:
        """Undisturbed episodes, see `Chain`."""
        dice = np.repeat(numbers[:, None] + self.first_number, self.num_blocks, 1)
        return self._run_all(dice, np.zeros(len(dice), np.int64), np.full(len(dice), None, object))

    def branch(
        self, parents: np.ndarray, blocks: Int64[np.ndarray, "m"], numbers: Int64[np.ndarray, "m"]
    ) -> tuple[np.ndarray, np.ndarray]:
        """Episodes that leave others at the end of a block, see `Chain`."""
        is_new = np.arange(self.num_blocks) >= blocks[:, None]
        new_dice = numbers[:, None] + self.first_number
        return self._run_all(np.where(is_new, new_dice, [path.dice for path in parents]), blocks, parents)

    def _run_all(
        self, dice: Int64[np.ndarray, "m T"], blocks: Int64[np.ndarray, "m"], parents: np.ndarray
    ) -> tuple[np.ndarray, np.ndarray]:
        """Paths, and their danger at the start and in each block."""
        paths = np.empty(len(dice), object)
        order = np.argsort(blocks, kind="stable")
        for first in range(0, len(order), BATCH):
            rows = order[first : first + BATCH]
            paths[rows] = self.run(dice[rows], blocks[rows], parents[rows])[0]
        danger = np.stack([path.danger for path in paths])
        in_blocks = danger[:, 1:].reshape(len(paths), self.num_blocks, -1)
        # a branch begins at the end of a block: what threatened before and has passed does not count
        in_blocks = np.where((in_blocks >= 0).any(2), in_blocks.max(2), in_blocks[..., -1])
        # the start is the same for all: its danger would tie them
        return paths, np.concatenate([np.full((len(paths), 1), -np.inf), in_blocks], 1)

    def run(
        self,
        dice: Int64[np.ndarray, "m T"],
        blocks: Int64[np.ndarray, "m"] | None = None,
        parents: Sequence[DrivenPath | None] | np.ndarray | None = None,
        observe: Callable[[Episode, EpisodeState], None] | None = None,
    ) -> tuple[list[DrivenPath], Episode, EpisodeState]:
        """Episodes side by side, to the end; without parents the planner acts from the beginning.

        Args:
            dice: Numbers of the dice of each block.
            blocks: Blocks that each episode shares with its parent.
            parents: Paths whose motion and planner are taken over.
            observe: Function that is called after each action.

        Raises:
            DataError: The planner calls exit().
        """
        count = len(dice)
        size = 1 << (count - 1).bit_length()
        rows = np.resize(np.arange(count), size)  # those beyond `count` are run and not kept
        shared = np.zeros(size, np.int64) if blocks is None else blocks[rows]
        parent_paths = [None] * size if parents is None else [parents[int(row)] for row in rows]
        episode, dice = self._episode(size), dice[rows]
        state = start(episode, self._dice(dice[:, 0]))
        danger = np.full((size, 1 + self.num_blocks * self.block_steps), np.nan)
        planners = [self.planner] * size
        copies: list[list[Planner]] = [[] for _ in rows]
        for row, (path, k) in enumerate(zip(parent_paths, shared)):
            if path is None:
                danger[row, 0] = measure_danger(self.event, StepView(episode, state, row), is_branching_point=False)
            else:
                copies[row] = list(path.planners[: k + 1])
                danger[row, : 1 + k * self.block_steps] = path.danger[: 1 + k * self.block_steps]
        for block in range(self.num_blocks):
            begin = block * self.block_steps
            steps = slice(begin, begin + self.block_steps)
            acts = np.flatnonzero(shared[:count] <= block)
            # 1. dice, and planners that take over or have new dice
            if block and (dice[:, block] != dice[:, block - 1]).any():
                state = replace(state, world=with_dice(episode.world, state.world, self._dice(dice[:, block])))
            for row in acts:
                if block == 0:
                    planners[row] = copy_planner(self.planner)
                    about = describe_start(episode, state, int(row), self.source)
                    with guard_planner(self.planner, self.scenario_id, lambda: 0):
                        planners[row].reset(about)
                elif block == shared[row]:
                    planners[row] = copy_planner(copies[row].pop())
                if block == 0 or dice[row, block] != dice[row, block - 1]:
                    with guard_planner(self.planner, self.scenario_id, lambda now=begin: now):
                        getattr(planners[row], "seed", lambda number: None)(int(dice[row, block]))
                copies[row].append(copy_planner(planners[row]))
            imposed = np.full((size, self.block_steps, 5), np.nan)
            for row in np.flatnonzero(shared > block):
                imposed[row] = parent_paths[row].motion[steps]  # type: ignore[union-attr]
            # 2. the steps
            action = np.zeros((size, *self.source.controls.limits.shape))
            for step in range(0, self.block_steps, episode.controls.steps):
                acting: list[Any] = [planners[row] for row in acts]
                is_joint = bool(acting) and acts_together(acting[0])
                seen = None if is_joint or not acting else look(episode, state)
                with guard_planner(self.planner, self.scenario_id, lambda now=begin + step: now):
                    if seen is not None:
                        for row, planner in zip(acts, acting):
                            action[row] = planner.act(seen.of_agent(int(row)))
                    elif is_joint:
                        action[acts] = act_together(acting, partial(_observe, episode, state, acts))
                forced = imposed[:, step : step + episode.controls.steps]
                state, _ = advance(episode, state, action, forced)
                if observe is not None:
                    observe(episode, state)
                end = step + episode.controls.steps
                for row in acts:
                    danger[row, begin + step + 1 : begin + end + 1] = measure_danger(
                        self.event, StepView(episode, state, int(row)), is_branching_point=end == self.block_steps
                    )
        motion = np.stack([track[tuple(episode.world.actors.T)] for track in state.world.track[CURRENT_STEP + 1 :]], 1)
        paths = [
            DrivenPath(dice[row], motion[row], danger[row], tuple(copies[row]), state.collisions[row])
            for row in range(count)
        ]
        return paths, episode, state

    def estimate(self, particles: int, repeats: int, *, is_branching: bool = True) -> tuple[Repeat, ...]:
        """Independent estimates by splitting, side by side, and the episodes in which the event happens.

        Args:
            particles: Number of undisturbed episodes at the beginning of each repeat.
            repeats: Number of estimates.
            is_branching: False = plain Monte Carlo with the undisturbed episodes alone.
        """
        seed = (self.seed, self.first_number)
        splits = split(self, particles=particles, repeats=repeats, seed=seed, is_branching=is_branching)
        estimates = []
        for row, probability in enumerate(splits.probability.tolist()):
            failing, weight = splits.paths[row][splits.danger[row] >= 0], float(splits.weight[row])
            num_steps = int(splits.num_runs[row]) * self.num_blocks * self.block_steps
            failures = tuple(self._describe(path, weight) for path in failing)
            estimates.append(Repeat(probability, int(splits.num_levels[row]), num_steps, failures))
        return tuple(estimates)

    def check_start(self) -> None:
        """Check that the event does not hold at the start.

        Raises:
            PlannerFailure: The event has happened before the planner acts.
        """
        episode = self._episode(1)
        state = start(episode, self._dice(np.zeros(1, np.int64)))
        if self.event.danger(StepView(episode, state, 0)) >= 0:
            raise PlannerFailure(
                f"scenario {self.scenario_id}: the event has happened at the start, whatever the planner does: choose "
                "another scenario or event."
            )

    def run_again(self, failure: Failure, observe: Callable[[Episode, EpisodeState], None] | None = None) -> Result:
        """The episode of a failure, bit for bit.

        Args:
            failure: Failure of this planner, scenario and traffic.
            observe: Function that is called after each action.

        Raises:
            DataError: The planner drives otherwise than before, or the dice are of other blocks.
        """
        if len(failure.dice) != self.num_blocks or failure.step > self.num_blocks * self.block_steps:
            raise DataError(
                f"a failure at step {in_short(failure.step)} with dice of {len(failure.dice)} blocks, in an episode of "
                f"{self.num_blocks} blocks: estimate again."
            )
        [path], episode, state = self.run(np.array([failure.dice]), observe=observe)
        if path.digest != failure.digest:
            raise DataError(
                f"scenario {self.scenario_id}: the planner drives otherwise than when it failed: its code, weights or "
                "the traffic have changed, or it draws numbers without a method seed(number)."
            )
        return build_result(episode, state)

    def _describe(self, path: DrivenPath, probability: float) -> Failure:
        """Failure of a path in which the event happens."""
        step = int((path.danger >= 0).argmax())
        failure = Failure(self.scenario_id, probability, tuple(map(int, path.dice)), step, path.digest)
        last = step + self.source.controls.steps - 1
        contacts = sorted((c for c in path.collisions if step <= c.step <= last), key=lambda c: not c.at_fault)
        if not contacts:
            return failure
        contact, scene = contacts[0], self._episode(1).world.scenes[0]
        return replace(
            failure, step=contact.step, contact=str(contact.collision_type), at_fault=contact.at_fault,
            closing_mps=contact.speed_change_mps, agent=int(scene.object_id[contact.agent]),
        )  # fmt: skip

    def _dice(self, numbers: Int64[np.ndarray, "n"]) -> tuple[Dice, ...]:
        return tuple(Dice(self.seed, int(number)) for number in numbers)

    def _episode(self, size: int) -> Episode:
        return _build_episode(self.source, self.scenario_id, size)


@lru_cache(maxsize=6)
def _build_episode(source: Source, scenario_id: str, size: int) -> Episode:
    """Scenes of a scenario side by side."""
    return source.episode([source.scenario(scenario_id)] * size)


def _observe(episode: Episode, state: EpisodeState, rows: Int64[np.ndarray, "m"]) -> dict[str, np.ndarray]:
    """Observations of the agents in some rows, by name."""
    return {name: values[rows] for name, values in look(episode, state).by_name().items()}


def copy_planner(planner: Planner) -> Planner:
    """A planner with the same memory that goes on by itself: `planner.copy()` where there is one, else a deep copy.

    Raises:
        ConfigError: A planner that cannot be copied.
    """
    try:
        copied = planner.copy() if hasattr(planner, "copy") else copy.deepcopy(planner)  # type: ignore[attr-defined]
    except Exception as error:  # any code of others
        name = type(planner).__name__
        raise ConfigError(
            f"planner {name} cannot be copied ({type(error).__name__}: {in_short(str(error))}), so no branch can go on "
            "with its memory: give it a method copy()."
        ) from error
    return copied


@dataclass(frozen=True, eq=False)
class RepeatedEstimate:
    """Probability of an event in a scenario, by independent repeats."""

    repeats: tuple[Repeat, ...]
    particles: int
    """Undisturbed episodes that each repeat began with."""

    @property
    def estimates(self) -> Float[np.ndarray, "R"]:
        """Independent unbiased estimates."""
        return np.array([repeat.probability for repeat in self.repeats])

    @property
    def probability(self) -> float:
        """Mean of the estimates."""
        return float(self.estimates.mean())

    @property
    def variance(self) -> float:
        """Of the mean; NaN for a single repeat with an event."""
        if not self.probability:
            return 0.0
        return float(self.estimates.var(ddof=1)) / len(self.repeats) if len(self.repeats) > 1 else math.nan

    @property
    def interval(self) -> tuple[float, float]:
        """95 % interval, see `splitting.estimate_interval`; NaN for a single repeat with an event."""
        return estimate_interval(self.estimates, self.particles * len(self.repeats))

    @property
    def num_monte_carlo(self) -> float:
        """Undisturbed episodes that would give the same standard error; NaN where there is none."""
        return self.probability * (1 - self.probability) / self.variance if self.variance else math.nan


@dataclass(frozen=True, eq=False)
class FailureEstimate(RepeatedEstimate):
    """Probability that an event happens to a planner in a scenario within 8 seconds."""

    scenario_id: str
    chain: FailureChain

    @property
    def failures(self) -> tuple[Failure, ...]:
        """Episodes in which the event happens; those that stand for most come first."""
        failures = (failure for repeat in self.repeats for failure in repeat.failures)
        return tuple(sorted(failures, key=lambda failure: -failure.probability))

    def run_again(self, failure: Failure) -> Result:
        """The episode of a failure, bit for bit, see `FailureChain.run_again`."""
        return self.chain.run_again(failure)

    def films(self, path: str | PathLike[str], *, limit: int = 1) -> list[Path]:
        """Write films of failures, the most probable first, that begin differently if there are; returns their paths.

        Args:
            path: File of the first film, .mp4 or .webp; "crash.mp4" is followed by "crash-2.mp4".
            limit: Largest number of films.

        Raises:
            DataError: There is no failure to show.
        """
        path = Path(path)
        if not self.failures:
            raise DataError(f"{path}: scenario {self.scenario_id} has no failure to show: take more particles.")
        paths = []
        for number, failure in enumerate(choose_failures(self.failures, limit), 1):
            paths.append(path if number == 1 else path.with_stem(f"{path.stem}-{number}"))
            self.run_again(failure).film(paths[-1])
        return paths

    def __repr__(self) -> str:
        count = self.particles * len(self.repeats)
        if not self.estimates.any():
            return f"none in {count} undisturbed episodes and their branches: P < {self.interval[1]:.2g} (95 %)"
        if len(self.repeats) == 1:
            return f"P = {self.probability:.2g}, without an interval: one repeat gives none, take more repeats"
        low, high = self.interval
        return (
            f"P = {self.probability:.2g} [{low:.2g}, {high:.2g}] within 8 s, {len(self.failures)} failing episodes; as "
            f"good as {self.num_monte_carlo:.0f} episodes of Monte Carlo"
        )


def choose_failures(failures: Sequence[Failure], limit: int) -> list[Failure]:
    """Failures to show: one of each beginning first, as branches of one episode look alike.

    Args:
        failures: Failures, those that count most first.
        limit: Largest number of failures.
    """
    seen: dict[tuple[str, int], int] = {}
    rank = [seen.setdefault((f.scenario_id, f.dice[0]), len(seen)) for f in failures]
    turn = [rank[:i].count(rank[i]) for i in range(len(rank))]
    return [failures[i] for i in sorted(range(len(rank)), key=lambda i: turn[i])[:limit]]


def make_source(planner: Planner, scenarios: Any, policy: Policy | None = None, **settings: Any) -> Source:
    """Source of episodes that no event ends, with the planner's type of action.

    Args:
        planner: Planner that is to drive.
        scenarios: Scenarios in any form, None = those that the settings name.
        policy: Traffic model; None = the one that the settings name.
        settings: Fields of `EnvConfig`.
    """
    config = EnvConfig(**read_action_settings(planner), stop_on=(), reward="none", **settings)
    return Source(config, scenarios, policy)


def estimate_failures(
    planner: Planner | Callable[..., Any] | str,
    scenario: Scenario,
    *,
    event: Event | str = "at_fault_collision",
    particles: int = 64,
    repeats: int = 10,
    seed: int = 0,
    policy: Policy | None = None,
    **settings: Any,
) -> FailureEstimate:
    """Probability that an event happens to a planner in a scenario, with interval and the failures themselves.

    A planner with memory is copied at branches (`copy()`, else `copy.deepcopy`; a plain function has none). One that
    draws random numbers has a method `seed(number)`, which is called with a number of its own at each branch.

    Args:
        planner: Planner object, function from observation to action, or a name that `load_planner` takes.
        scenario: Scenario to drive.
        event: Name in `dangers.EVENTS`, or an object with `danger(view)`.
        particles: Undisturbed episodes at the beginning of each repeat.
        repeats: Number of independent estimates; the interval needs two.
        seed: Seed of the traffic; equal seeds, equal estimates.
        policy: Traffic model in place of the setting `model`, in evaluation mode.
        settings: Fields of `EnvConfig`, such as model="demo-tuned" or traffic="idm".

    Raises:
        ConfigError: A planner that cannot be copied, an unknown event, or a setting that does not fit.
        DataError: The event holds at the start.
    """
    for name, number, least in (("particles", particles, 2), ("repeats", repeats, 1), ("seed", seed, 0)):
        whole_number(name, number, least)
    driver = to_planner(planner)
    measured_event = find_event(event)
    source = make_source(driver, scenario, policy, **settings)
    chain = FailureChain(source, driver, scenario.scenario_id, measured_event, seed=seed)
    chain.check_start()
    return FailureEstimate(chain.estimate(particles, repeats), particles, scenario.scenario_id, chain)

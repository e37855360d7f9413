"""Episodes that a planner drives from the current step to the end, alone or side by side."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from rlftsim.envs.ego_env import EgoEnv
from rlftsim.envs.episode import advance, look, start
from rlftsim.envs.planners.batch import BatchPlanner
from rlftsim.envs.planners.registry import Planner, guard_planner
from rlftsim.envs.record import build_record
from rlftsim.envs.resets import describe_start
from rlftsim.envs.result import Result
from rlftsim.envs.source import Source
from rlftsim.envs.world import Dice
from rlftsim.errors import ConfigError
from rlftsim.scenario.types import Scenario


def run_planner(env: EgoEnv, planner: Planner, scenario: Scenario, *, seed: int, rollout: int = 0) -> Result:
    """Drive a scenario from the current step to the end.

    Args:
        env: Environment with the planner's type of action.
        planner: Planner that drives, made by `load_planner`.
        scenario: Scenario of the environment to drive to the end.
        seed: Seed of the traffic; equal seeds, equal traffic for every planner.
        rollout: Number of the rollout, 0 or more; each with dice of its own.

    Raises:
        EpisodeFailure: SUMO fails, or the planner raises an error, calls exit(), or wants what its type of action does
            not allow.
    """
    observation, info = env.reset(seed=seed, options={"scenario": scenario.scenario_id, "rollout": rollout})
    with guard_planner(planner, scenario.scenario_id, lambda: env.state.world.step):
        planner.reset(info)
    while not env.state.ended[0]:
        with guard_planner(planner, scenario.scenario_id, lambda: env.state.world.step):
            action = planner.act(observation)
        # of a step of the world only the action is the planner's
        with guard_planner(planner, scenario.scenario_id, lambda: env.state.world.step, errors=(ConfigError,)):
            observation, *_ = env.step(action)
    return env.result()


def run_batch(
    source: Source, planner: BatchPlanner, scenarios: Sequence[Scenario], *, seed: int, rollouts: Iterable[int]
) -> Iterator[list[Result]]:
    """Drive scenarios side by side from the current step to the end; yields a result for each of them.

    Args:
        source: Source of the scenarios, with the planner's type of action.
        planner: Planner that drives all egos.
        scenarios: Scenarios to drive to the end.
        seed: Seed of the traffic; equal seeds, equal traffic for every planner.
        rollouts: Numbers of the rollouts, each with dice of its own.

    Raises:
        EpisodeFailure: SUMO fails, or the planner fails in any scenario.
    """
    # scores see at the end who has left the road: no event is asked for
    episode = replace(source.episode(list(scenarios)), edges=None)
    names = ", ".join(scenario.scenario_id for scenario in scenarios)
    for rollout in rollouts:
        state = start(episode, (Dice(seed, rollout),) * len(scenarios))
        rows, steps = range(len(scenarios)), np.zeros(len(scenarios), int)
        with guard_planner(planner, names, lambda: 0):
            for row in rows:
                planner.reset(describe_start(episode, state, row, source))
        while not state.ended.all():
            step = state.world.step
            with guard_planner(planner, names, lambda now=step: now):
                action = planner.act_batch(lambda now=state: look(episode, now).by_name())
            with guard_planner(planner, names, lambda now=step: now, errors=(ConfigError,)):
                following, _ = advance(episode, state, action)
            steps[~state.ended] = following.world.step
            state = following
        # who has left the map stands there until the others have ended, which is not part of the episode
        yield [Result(build_record(episode, state, row).first(int(steps[row]))) for row in rows]

"""Episodes that a planner drives from the current step to the end, alone or side by side."""

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import replace

import numpy as np

from rlftsim.envs.episode import EpisodeState, advance, look, start
from rlftsim.envs.planners.batch import acts_in_batches
from rlftsim.envs.planners.registry import Planner, guard_planner
from rlftsim.envs.record import build_record
from rlftsim.envs.resets import describe_start
from rlftsim.envs.result import Result
from rlftsim.envs.source import Source
from rlftsim.envs.world import Dice
from rlftsim.errors import ConfigError
from rlftsim.scenario.types import Scenario


def run_planner(
    source: Source, planner: Planner, scenarios: Sequence[Scenario], *, seed: int, rollouts: Iterable[int]
) -> Iterator[tuple[list[Result], EpisodeState]]:
    """Drive scenarios side by side from the current step to the end; yields a result for each, and the last state.

    Args:
        source: Source of the scenarios, with the planner's type of action.
        planner: Planner that drives all egos, made by `load_planner`; a single ego, unless the planner acts in batches.
        scenarios: Scenarios to drive to the end.
        seed: Seed of the traffic; equal seeds, equal traffic for every planner.
        rollouts: Numbers of the rollouts, 0 or more, each with dice of its own.

    Raises:
        EpisodeFailure: SUMO fails, an ego is not valid at the current step, or in any scenario the planner raises an
            error, calls exit(), or wants what its type of action does not allow.
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
            observation = {} if acts_in_batches(planner) else look(episode, state).of_agent(0)
            with guard_planner(planner, names, lambda step=step: step):
                if acts_in_batches(planner):
                    action = planner.act_batch(lambda state=state: look(episode, state).by_name())
                else:
                    action = [planner.act(observation)]
            # of a step of the world only the action is the planner's
            with guard_planner(planner, names, lambda step=step: step, errors=(ConfigError,)):
                following, _ = advance(episode, state, action)
            steps[~state.ended] = following.world.step
            state = following
        # who has left the map stands there until the others have ended, which is not part of the episode
        yield [Result(build_record(episode, state, row).first(int(steps[row]))) for row in rows], state

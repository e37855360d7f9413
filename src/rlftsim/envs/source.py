"""Scenarios and the traffic model of an environment, loaded once and shared by all episodes."""

import math
from collections import OrderedDict
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

from rlftsim.envs.actions import Controls, build_controls
from rlftsim.envs.config import EnvConfig
from rlftsim.envs.drivers import load_open_traffic
from rlftsim.envs.episode import Episode, ScenarioGoals, build_episode
from rlftsim.envs.sumo_traffic import check_sumo
from rlftsim.envs.world import build_world
from rlftsim.errors import ConfigError, in_short, whole_number
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy, is_goal_conditioned, is_training
from rlftsim.scenario.dataset import dataset_folder
from rlftsim.scenario.open import AnyScenarios, to_scenarios
from rlftsim.scenario.types import Scenario, Scenarios, list_scenario_ids

KEPT_CONTEXTS = 16
"""Encoded scenarios that are kept: encoding is most of the cost of a reset."""


def check_choice(scenarios: Sequence[str] | None, limit: int | None) -> None:
    """Check the settings that choose scenarios of a source.

    Args:
        scenarios: Ids; None = all scenarios.
        limit: Number of scenarios, the first ones; None = all of them.

    Raises:
        ConfigError: An id that is named twice, or a limit below 1.
    """
    if limit is not None:
        whole_number("limit", limit, 1)
    if len(set(scenarios or ())) < len(scenarios or ()):
        raise ConfigError(f"scenarios names one twice: {', '.join(scenarios or ())}.")


class Source:
    """Scenarios, traffic model and settings of an environment.

    Args:
        config: Settings of the environment; `data` and `model` name the data set and the model to load.
        scenarios: Scenarios in place of the data set in `config`; a data set by name is read in the split of `config`.
        policy: Traffic model in place of the model that `config` names, in evaluation mode.
        controlled: Rules of the planner-driven agents, which come before the drivers of `config`; None = the ego.

    Raises:
        ConfigError: settings that contradict each other.
        DataError: no such data set or split.
    """

    def __init__(
        self,
        config: EnvConfig,
        scenarios: AnyScenarios | None = None,
        policy: Policy | None = None,
        controlled: Mapping[str | int, str] | None = None,
    ):
        if policy is not None and not isinstance(policy, Policy):
            raise ConfigError(f"policy is {in_short(policy)}, not a policy: name a stored one as `model`.")
        if is_training(policy):
            raise ConfigError(
                "policy is in training mode, in which dropout makes traffic of one seed differ: call policy.eval()."
            )
        self.config = config if policy is None else replace(config, model=type(policy).__name__)
        self.scenarios: Scenarios = to_scenarios(scenarios if scenarios is not None else config.data, config.split)
        self.scenario_ids = list(list_scenario_ids(self.scenarios))
        self.rules = {**(controlled or {"ego": "planner"}), **config.drivers}
        self.rules.setdefault("*", config.traffic)
        if "sumo" in self.rules.values():
            check_sumo()
        # IDM leaves pedestrians and cyclists to the policy
        needs_policy = "policy" in self.rules.values() or "idm" in self.rules.values() or config.action == "token"
        if policy is None and needs_policy:
            policy = load_policy(config.model, config.device)
        self.policy = policy
        self.entries = load_open_traffic(config.entries, self.rules, self.policy)
        self.fingerprint = fingerprint_policy(self.policy) if self.policy is not None else "none"
        self.controls: Controls = build_controls(
            config.action, self.policy, horizon=config.horizon, tracker=config.tracker, reverse=config.reverse,
            hard_braking=config.hard_braking,
        )  # fmt: skip
        self._contexts: OrderedDict[str | None, Any] = OrderedDict()

    def scenario(self, scenario_id: str) -> Scenario:
        """A scenario by id.

        Raises:
            ConfigError: no such scenario.
        """
        try:
            return self.scenarios[self.scenario_ids.index(scenario_id)]
        except ValueError:
            examples = ", ".join(self.scenario_ids[:3])
            raise ConfigError(
                f"no scenario {scenario_id!r}: this environment has {len(self.scenario_ids)}, such as {examples}."
            ) from None

    def episode(self, scenarios: list[Scenario], goals: ScenarioGoals | None = None) -> Episode:
        """An episode in some scenarios, which step together.

        Args:
            scenarios: Scenarios of the episode, at least one, which step together.
            goals: Scenario id to object id to (x, y) of agents that follow the policy, world frame, m.

        Raises:
            ConfigError: drivers that do not fit, or goals for a policy that does not follow goals.
            DataError: a goal of an agent that is not simulated.
        """
        if goals and (self.policy is None or not is_goal_conditioned(self.policy)):
            raise ConfigError("goals have no effect: the traffic model is not goal-conditioned.")
        # a single scenario is encoded once for its next episodes, too
        key = scenarios[0].scenario_id if len(scenarios) == 1 else None
        num_actions = math.ceil(self.config.max_steps / self.controls.steps)
        world = build_world(
            scenarios, self.policy, rules=self.rules, goals=goals, sampling=self.config.sampling,
            context=self._contexts.get(key), data=dataset_folder(self.config.data),
            max_steps=num_actions * self.controls.steps, entries=self.entries,
        )  # fmt: skip
        if key is not None and world.context is not None:
            self._contexts[key] = world.context
            self._contexts.move_to_end(key)
            if len(self._contexts) > KEPT_CONTEXTS:
                self._contexts.popitem(last=False)
        if not len(world.actors):
            raise ConfigError(
                f"scenario {scenarios[0].scenario_id}: the planner drives no agent: its ego or ids are not simulated."
            )
        return build_episode(world, self.controls, self.config, goals)

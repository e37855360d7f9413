"""Animation of a scenario that two policies simulate, in the rollout in which collisions and road departures differ
most."""

from collections.abc import Mapping
from dataclasses import dataclass

import torch

from rlftsim.evaluation.rollout_states import simulate_states
from rlftsim.experiments.suite import ExperimentSuite
from rlftsim.policies.registry import find_device
from rlftsim.realism import compute_features, scenario_log
from rlftsim.rollout.policy import Policy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import Scenario
from rlftsim.viewer.page import Animation, Panel
from rlftsim.viewer.scene import build_scene, rollout_trajectories


@dataclass(frozen=True, eq=False)
class PairedAnimation:
    """A rollout of a scenario by two policies with the same noise."""

    scenario_id: str
    rollout: int
    rates: tuple[float, float]
    """Events an evaluated agent, over all rollouts, with either policy."""
    events: tuple[int, int]
    """Events of the rollout that is shown."""
    animation: Animation


def animate_pair(
    rank: str, scenario: Scenario, policies: Mapping[str, Policy], suite: ExperimentSuite, *, prefers_increase: bool
) -> PairedAnimation:
    """Animation of the first rollout in which the number of events changes most from the first to the second policy.

    Args:
        rank: Rank of the scenario in words, such as "1. of 40", for the caption.
        scenario: Scenario with a logged future; simulated as in an evaluation, with the suite's seed and sampling.
        policies: Two policies by name, the base model first.
        suite: Suite with the settings and the device of evaluations.
        prefers_increase: True takes the rollout of the largest increase, False that of the largest decrease.
    """
    device = find_device(suite.device)
    log, batch = scenario_log(scenario, device), collate([scenario]).to(device)
    with torch.no_grad():  # from the logged history, whatever the metric: a context makes no scenes
        features = {
            name: compute_features(log, simulate_states(policy, batch, suite.evaluation, context=policy.encode(batch)))
            for name, policy in policies.items()
        }
    # Events: evaluated agents that collide at some step, plus those that leave the road at some step.
    base, tuned = (
        torch.stack([f.collision.any(-1), f.offroad.any(-1)]).sum(dim=(0, 2))  # [2, N, E] -> [N]
        for f in features.values()
    )
    rollout = int(((tuned - base) * (1 if prefers_increase else -1)).argmax())
    # Noise depends on the number of the rollout alone, so that simulating this one alone repeats it.
    rollout_ids = range(rollout, rollout + 1)
    seed, sampling = suite.evaluation.seed, suite.evaluation.sampling
    panels = []
    for name, policy in policies.items():
        rollouts = simulate(policy, batch, num_rollouts=rollout_ids, seed=seed, sampling=sampling)
        # Marks of the rollout that is shown: [1, E, T].
        flags = {mark: getattr(features[name], mark)[rollout : rollout + 1].cpu() for mark in ("collision", "offroad")}
        motion = rollout_trajectories(scenario, rollouts, row=0).with_evaluated_flags(scenario, **flags)
        panels.append(Panel(name, motion))
    num_evaluated = len(scenario.evaluated_indices)
    rates = (float(base.double().mean()) / num_evaluated, float(tuned.double().mean()) / num_evaluated)
    events = (int(base[rollout]), int(tuned[rollout]))
    caption = (
        f"{rank}, rollout {rollout}: {events[0]} collisions and departures from the road before, {events[1]} after; "
        f"over all rollouts {rates[0]:.2f} and {rates[1]:.2f} events an agent."
    )
    animation = Animation(f"Scenario {scenario.scenario_id}", build_scene(scenario), panels, caption=caption)
    return PairedAnimation(scenario.scenario_id, rollout, rates, events, animation)

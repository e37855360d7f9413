"""Scenarios, agents and steps of an update: a function of seed and update alone, which resuming relies on."""

import copy
from collections.abc import Collection, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
import torch
from jaxtyping import Bool
from torch import Tensor, nn

from rlftsim.errors import DataError
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.warm_start import start_from_rollouts
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.mirror import mirror_scenario
from rlftsim.scenario.types import CURRENT_STEP, TOTAL_STEPS, Scenario, Scenarios, cached_on_scenario

MIN_FUTURE_STEPS = 5
"""Logged steps after the current one that an agent needs to be learned from."""


def batch_with_futures(
    scenarios: Scenarios, indices: Sequence[int], *, context_radius_m: float | None = None, mirror: Collection[int] = ()
) -> ScenarioBatch:
    """Batch of some scenarios; of a log longer than 9.1 s the first 9.1 s.

    Args:
        scenarios: Training scenarios, which the indices count.
        indices: Indices of the scenarios of the batch, in order.
        context_radius_m: leave out steps farther from the ego, see `within_reach`; None = keep all steps.
        mirror: indices of the scenarios that are seen mirrored.

    Raises:
        DataError: a scenario withholds the future, so the model cannot learn from the scenario.
    """
    selected = [mirror_scenario(scenarios[i]) if i in mirror else scenarios[i] for i in indices]
    selected = [_first_window(scenario) or scenario for scenario in selected]
    for scenario in selected:
        if not scenario.has_future:
            raise DataError(
                f"scenario {scenario.scenario_id} has {scenario.num_steps} logged steps, its future is withheld: "
                "train on the training split."
            )
    if context_radius_m is not None:
        selected = [within_reach(scenario, context_radius_m) for scenario in selected]
    return collate(selected)


@cached_on_scenario
def _first_window(scenario: Scenario) -> Scenario | None:
    """First 9.1 s of a longer log; None where the log is no longer, as in `_without_far_steps`."""
    return scenario.window(0) if scenario.num_steps > TOTAL_STEPS else None


def find_starts(policy: Any, scenarios: Scenarios, settings: Any) -> Scenarios:
    """Scenarios that begin at the `start_seconds` of the settings, in traffic of the policy; else the same scenarios.

    Args:
        policy: Policy before the first update.
        scenarios: Training scenarios, with long logs where settings have such starts.
        settings: Settings of a training method.

    Raises:
        ConfigError: A start that is no multiple of 2 s.
        DataError: A log that does not go on for 8 s after the last start, or lacks the ego at a start.
    """
    seconds = getattr(settings, "start_seconds", ())
    if not seconds or not isinstance(policy, nn.Module):  # which the method refuses
        return scenarios
    driver: Any = copy.deepcopy(policy).eval()  # without dropout, or a resumed run would have other starts
    return start_from_rollouts(driver, scenarios, seconds, seed=settings.seed)


def within_reach(scenario: Scenario, radius_m: float) -> Scenario:
    """A scenario in which a step of an agent is valid only within a radius of the ego at that step.

    An agent that is out of reach at the current step is not simulated. At steps where the ego is not valid all agents
    stay.

    Args:
        scenario: Scenario with any number of logged steps.
        radius_m: 3-D distance.

    Returns:
        The same object as `scenario` where all steps are within reach.
    """
    return _without_far_steps(scenario, radius_m) or scenario


@cached_on_scenario
def _without_far_steps(scenario: Scenario, radius_m: float) -> Scenario | None:
    """None where all is within reach: a cache on the scenario must not hold the scenario, or neither is freed."""
    tracks, ego = scenario.tracks, scenario.ego_index
    distance_m = np.linalg.norm(tracks.position - tracks.position[ego], axis=-1)  # [agents, steps]
    is_out_of_reach = (distance_m >= radius_m) & tracks.valid & tracks.valid[ego]
    if not is_out_of_reach.any():
        return None
    return replace(scenario, tracks=replace(tracks, valid=tracks.valid & ~is_out_of_reach))


def trained_agents(
    batch: ScenarioBatch, update: int, *, radius_m: float, limit: int | None, seed: int
) -> Bool[Tensor, "B A"]:
    """Agents whose predictions count: evaluated and interesting agents, then other agents near the ego, up to a limit.

    The other agents need a logged future. The draw depends on the seed, the update and the scenario, not on the rest of
    the batch.

    Args:
        batch: Scenarios with logged futures.
        update: counted from 0.
        radius_m: distance from the ego at the current step up to which other agents are taken.
        limit: Largest number of trained agents in a scenario; None = no limit.
        seed: Seed of the run; equal seeds, equal choices.
    """
    interest = torch.zeros_like(batch.agent_mask)  # [B, A]
    for row, scenario, ids in zip(interest, batch.scenarios, batch.object_id):
        row |= torch.isin(ids, torch.tensor(scenario.objects_of_interest, device=ids.device))
    first = (batch.evaluated_mask | interest) & batch.agent_mask
    # [B, A] each from here on.
    has_future = batch.valid[:, :, CURRENT_STEP + 1 :].sum(-1) >= MIN_FUTURE_STEPS
    # Distance from the ego at the current step, 3-D; meaningless for padding, which the mask drops.
    ego_id = torch.tensor([s.tracks.object_id[s.ego_index] for s in batch.scenarios], device=batch.device)
    is_ego = (batch.object_id == ego_id[:, None]) & batch.agent_mask
    position = torch.cat([batch.position[:, :, CURRENT_STEP], batch.z[:, :, CURRENT_STEP, None]], -1)  # [B, A, 3]
    ego = (position * is_ego[..., None]).sum(1, keepdim=True)  # [B, 1, 3]
    is_within_radius = (position - ego).norm(dim=-1) < radius_m
    candidates = is_within_radius & has_future & batch.agent_mask & ~first
    if limit is None:
        return first | candidates
    u = torch.zeros(candidates.shape)
    for row, scenario in zip(u, batch.scenarios):
        # One generator per scenario: padding and neighbors in the batch change nothing.
        generator = torch.Generator().manual_seed(derive_seed(seed, "agents", update, scenario.scenario_id) % 2**63)
        count = len(scenario.simulated_indices)
        row[:count] = torch.rand(count, generator=generator)
    rank = torch.where(candidates, u.to(batch.device), 2.0).argsort(-1).argsort(-1)  # 2 is behind every uniform number
    return first | (candidates & (rank < limit - first.sum(-1, keepdim=True)))


def mirrored_of_update(update: int, indices: Sequence[int], probability: float, seed: int) -> set[int]:
    """The scenarios of an update that are seen mirrored; each scenario draws alone, so processes need not agree.

    Args:
        update: counted from 0.
        indices: Indices of the scenarios of the update.
        probability: Chance in [0, 1] that a scenario is mirrored.
        seed: Seed of the run; equal seeds, equal choices.
    """
    return {i for i in indices if np.random.default_rng(derive_seed(seed, "mirror", update, i)).random() < probability}


def scenarios_of_update(update: int, batch_size: int, num_scenarios: int, seed: int) -> list[int]:
    """Indices of the scenarios of an update: the whole data set in a new random order every epoch.

    Args:
        update: counted from 0.
        batch_size: scenarios per update over all processes.
        num_scenarios: Number of scenarios in the data set.
        seed: Seed of the run; equal seeds, equal choices.
    """
    # Positions in the endless sequence of epochs after epochs.
    positions = range(update * batch_size, (update + 1) * batch_size)
    # A batch may reach over the end of an epoch, so it may need more than one order.
    orders = {
        epoch: np.random.default_rng(derive_seed(seed, "order", epoch)).permutation(num_scenarios)
        for epoch in {p // num_scenarios for p in positions}
    }
    return [int(orders[p // num_scenarios][p % num_scenarios]) for p in positions]


def share_cache(scenarios: Scenarios, num_processes: int) -> Scenarios:
    """Scenarios of which each process keeps a share in memory, where the process cannot keep all.

    Args:
        scenarios: Training scenarios; a list, which is in memory already, stays unchanged.
        num_processes: Processes that share a memory.
    """
    if not isinstance(scenarios, ScenarioDataset) or num_processes == 1:
        return scenarios
    if len(scenarios) * num_processes <= scenarios.cache_size:
        return scenarios
    cache_size = max(scenarios.cache_size // num_processes, 1)
    return ScenarioDataset(scenarios.folder, scenarios.split, cache_size=cache_size, limit=scenarios.limit)

"""Which scenarios, agents and steps an update sees: a function of the seed and the update alone, so that resuming needs nothing else."""

from collections.abc import Sequence
from dataclasses import replace

import numpy as np
import torch
from jaxtyping import Bool, Float
from torch import Tensor

from rlftsim.errors import DataError
from rlftsim.rollout.noise import derive_seed
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.derived import derived
from rlftsim.scenario.types import CURRENT_STEP, Scenario, Scenarios

MIN_FUTURE_STEPS = 5
"""Recorded steps after the current one that an agent needs to be learned from."""


def batch_with_futures(
    scenarios: Scenarios, indices: Sequence[int], *, context_radius_m: float | None = None
) -> ScenarioBatch:
    """Batch of some scenarios.

    Args:
        scenarios: to choose from.
        indices: of the chosen ones.
        context_radius_m: leave out what is farther from the ego, see `within_reach`; None = leave out nothing.

    Raises:
        DataError: one of them withholds its future, so nothing can be learned from it.
    """
    chosen = [scenarios[i] for i in indices]
    for scenario in chosen:
        if not scenario.has_future:
            raise DataError(
                f"scenario {scenario.scenario_id} records {scenario.num_steps} steps, its future is withheld: "
                "train on the training split."
            )
    if context_radius_m is not None:
        chosen = [within_reach(scenario, context_radius_m) for scenario in chosen]
    return collate(chosen)


def within_reach(scenario: Scenario, radius_m: float) -> Scenario:
    """A scenario in which a step of an agent is valid only if it is nearer to the ego than a radius at that step (3-D distance).

    An agent that is out of reach at the current step is not simulated. Where the ego was not recorded nothing is left out. The same
    object as `scenario` where everything is within reach.
    """
    return _without_far_steps(scenario, radius_m) or scenario


@derived
def _without_far_steps(scenario: Scenario, radius_m: float) -> Scenario | None:
    """None = there are none. (What is remembered with a scenario must not be the scenario itself, or neither is ever forgotten.)"""
    tracks, ego = scenario.tracks, scenario.ego_index
    distance_m = np.linalg.norm(tracks.position - tracks.position[ego], axis=-1)
    far = (distance_m >= radius_m) & tracks.valid & tracks.valid[ego]
    return replace(scenario, tracks=replace(tracks, valid=tracks.valid & ~far)) if far.any() else None


def trained_agents(
    batch: ScenarioBatch, update: int, *, radius_m: float, limit: int | None, seed: int
) -> Bool[Tensor, "B A"]:
    """Agents whose predictions count: the evaluated and interesting ones, then those near the ego with a future, up to a limit.

    Who is drawn depends on the seed, the update and the scenario, not on how a batch is put together.

    Args:
        batch: with its future.
        update: counted from 0.
        radius_m: how far from the ego the others may be at the current step.
        limit: of a scenario; None = all.
        seed: of the run.
    """
    interest = torch.zeros_like(batch.agent_mask)
    for row, scenario, ids in zip(interest, batch.scenarios, batch.object_id):
        row |= torch.isin(ids, torch.from_numpy(scenario.objects_of_interest).to(ids.device))
    first = (batch.evaluated_mask | interest) & batch.agent_mask
    has_future = batch.valid[:, :, CURRENT_STEP + 1 :].sum(-1) >= MIN_FUTURE_STEPS
    others = (_distance_from_ego(batch) < radius_m) & has_future & batch.agent_mask & ~first
    if limit is None:
        return first | others
    luck = torch.zeros(others.shape)
    for row, scenario in zip(luck, batch.scenarios):
        generator = torch.Generator().manual_seed(derive_seed(seed, "agents", update, scenario.scenario_id) % 2**63)
        count = len(scenario.simulated_indices)
        row[:count] = torch.rand(count, generator=generator)
    order = torch.where(others, luck.to(batch.device), 2.0).argsort(-1).argsort(-1)
    return first | (others & (order < limit - first.sum(-1, keepdim=True)))


def _distance_from_ego(batch: ScenarioBatch) -> Float[Tensor, "B A"]:
    """At the current step, metres; nonsense for padding."""
    ids = torch.tensor([s.tracks.object_id[s.ego_index] for s in batch.scenarios], device=batch.device)
    is_ego = (batch.object_id == ids[:, None]) & batch.agent_mask
    position = torch.cat([batch.position[:, :, CURRENT_STEP], batch.z[:, :, CURRENT_STEP, None]], -1)
    ego = (position * is_ego[..., None]).sum(1, keepdim=True)
    return (position - ego).norm(dim=-1)


def scenarios_of_update(update: int, batch_size: int, num_scenarios: int, seed: int) -> list[int]:
    """Indices of the scenarios of an update: the data set is passed over in a new random order every epoch, nothing is left out.

    Args:
        update: counted from 0.
        batch_size: scenarios per update over all processes.
        num_scenarios: in the data set.
        seed: of the run.
    """
    places = range(update * batch_size, (update + 1) * batch_size)
    orders = {epoch: _order(epoch, num_scenarios, seed) for epoch in {p // num_scenarios for p in places}}
    return [int(orders[p // num_scenarios][p % num_scenarios]) for p in places]


def _order(epoch: int, num_scenarios: int, seed: int) -> np.ndarray:
    return np.random.default_rng(derive_seed(seed, "order", epoch)).permutation(num_scenarios)

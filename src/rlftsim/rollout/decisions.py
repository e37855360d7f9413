"""Around a decision: the lights that a policy sees, and checks of what it returns.

A wrong shape or a NaN is told where it arises, by the policy's name.

B scenarios, N rollouts, A agents, t steps of 0.1 s per decision.
"""

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import Any

import torch
from jaxtyping import Float
from torch import Tensor

from rlftsim.errors import DataError
from rlftsim.jobs.threads import one_thread
from rlftsim.rollout.policy import Policy, relight
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS

MAX_COORDINATE_M = 1e6
"""Beyond, float32 positions are coarser than 6 cm: such coordinates are of another frame, or damaged."""

RELIT_STEPS = 20
"""After the metric's 8 s agents see the lights of the log, anew every 2 s; within these they see those of "now"."""


@contextmanager
def inference() -> Iterator[None]:
    """Without gradient and on one thread, on which the same work gives the same bits on any machine."""
    with one_thread(), torch.no_grad():
        yield


def encode_lights(policy: Policy, batch: ScenarioBatch, context: Any, step: int) -> Any:
    """Context with the lights of the log, every 2 s from second 8 on: a signal plan is no future of the agents.

    Args:
        policy: Policy that encodes.
        batch: Scenarios of the rollouts.
        context: Context up to now, which comes back at other steps and where no log has lights any more.
        step: Simulated step, from 0.
    """
    log_step = CURRENT_STEP + step
    has_lights = any(len(s.lights.step) and log_step < s.num_steps + RELIT_STEPS for s in batch.scenarios)
    is_due = step >= FUTURE_STEPS and step % RELIT_STEPS == 0
    return relight(policy, context, replace(batch, light_step=log_step)) if is_due and has_lights else context


def read_poses(policy: Policy, state: Any, shape: tuple[int, int, int]) -> Float[Tensor, "B N A t 3"]:
    """The poses of a state after a decision.

    Args:
        policy: Policy that the state is of.
        state: Result of `policy.advance`.
        shape: Numbers of scenarios, rollouts and agents.

    Raises:
        DataError: No poses, or of another shape or type.
    """
    poses, expected = getattr(state, "poses", None), (*shape, policy.steps_per_decision, 3)
    if not isinstance(poses, Tensor):
        given = f"a {type(state).__name__} without" if poses is None else f"a {type(poses).__name__} as"
    elif poses.shape != expected or poses.dtype != torch.float32:
        given = f"{str(poses.dtype).removeprefix('torch.')} {list(poses.shape)} as"
    else:
        return poses
    raise DataError(
        f"{type(policy).__name__}.advance gives {given} poses: return a state with `poses`, x, y and heading of the "
        f"{expected[3]} steps of a decision (steps_per_decision), float32 [B, N, A, t, 3] = {list(expected)}."
    )


def check_log_prob(policy: Policy, log_prob: Any, shape: tuple[int, int, int]) -> None:
    """Check the shape of the log-probabilities of drawn decisions.

    Args:
        policy: Policy that decided.
        log_prob: Result of `log_prob` of the distribution that `policy.decide` returned.
        shape: Numbers of scenarios, rollouts and agents.

    Raises:
        DataError: Another shape.
    """
    if not isinstance(log_prob, Tensor) or log_prob.shape != shape:
        given = list(log_prob.shape) if isinstance(log_prob, Tensor) else f"a {type(log_prob).__name__}"
        raise DataError(
            f"{type(policy).__name__}.decide gives a distribution whose log_prob is {given}: a number for each agent "
            f"is needed, [B, N, A] = {list(shape)}, padding included."
        )


def check_numbers(
    policy: Policy,
    batch: ScenarioBatch,
    log_prob: Float[Tensor, "B N A *L"],
    position: Float[Tensor, "B N A t 2"],
    heading: Float[Tensor, "B N A t"],
    first_step: int = 0,
) -> None:
    """Check that decisions have probabilities and lead somewhere: NaN would score like an agent that is not there.

    Args:
        policy: Policy that decided.
        batch: Scenarios of the decisions.
        log_prob: Log-probabilities of the decisions.
        position: Positions that the decisions led to, map frame, meters.
        heading: Headings at these positions, rad.
        first_step: Step of the first of these positions, for the message.

    Raises:
        DataError: A NaN, or a position more than `MAX_COORDINATE_M` from the origin; scenario and agent are named.
    """
    name, is_present = type(policy).__name__, batch.agent_mask[:, None]  # [B, 1, A]; padding may hold anything
    is_nan = log_prob.isnan() if log_prob.dim() == 3 else log_prob.isnan().any(-1)  # [B, N, A]
    is_nan = (is_nan & is_present).flatten(1).any(1)  # [B]
    if is_nan.any():
        first = batch.scenarios[int(is_nan.nonzero()[0])].scenario_id
        raise DataError(
            f"{name} decides with probabilities that are NaN in scenario {first}: load its weights again if they "
            "diverged, or leave out a scenario with extreme values."
        )
    is_lost = ~((position.abs() <= MAX_COORDINATE_M).all(-1) & heading.isfinite()) & is_present[..., None]
    if is_lost.any():
        row, rollout, agent, step = is_lost.nonzero()[0].tolist()
        x, y = position[row, rollout, agent, step].tolist()
        raise DataError(
            f"{name} moves agent {int(batch.object_id[row, agent])} of scenario {batch.scenarios[row].scenario_id} in "
            f"rollout {rollout} at step {first_step + step} to x {x:.4g} m, y {y:.4g} m, heading "
            f"{float(heading[row, rollout, agent, step]):.4g} rad: positions must be within {MAX_COORDINATE_M:g} m of "
            "the map's origin, and all values numbers."
        )

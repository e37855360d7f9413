"""Agents at token steps: along logged tracks, and after a decision.

B scenarios, N rollouts, A agents, K token steps of a block. Map frame, meters and radians.
"""

from collections.abc import Iterator
from dataclasses import dataclass
from typing import Any

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.geometry import box_corners, pose_of_corners, rotate, wrap_angle
from rlftsim.rollout.policy import TokenPolicy
from rlftsim.rollout.types import FARTHEST_STEP_M, AgentStates, Rollouts
from rlftsim.tokens import catk_compat as catk_ops
from rlftsim.tokens.agent_tokens import AgentTokens, class_boxes, nearest_tokens
from rlftsim.tokens.vocabulary import Vocabulary, class_of_type


@dataclass(frozen=True, eq=False)
class TokenSteps:
    """States of agents at a block of token steps, map frame, and the tokens that led to these states."""

    position: Float[Tensor, "B N A K 2"]
    heading: Float[Tensor, "B N A K"]
    motion: Float[Tensor, "B N A K 2"]
    """Position minus the position one token before."""
    token_id: Int64[Tensor, "B N A K"]
    valid: Bool[Tensor, "B N A K"]

    def append(self, steps: "TokenSteps") -> "TokenSteps":
        """The block with further steps behind it."""
        return TokenSteps(*(torch.cat(pair, 3) for pair in zip(vars(self).values(), vars(steps).values())))

    @property
    def last(self) -> "TokenSteps":
        """The last step of the block."""
        return TokenSteps(*(values[:, :, :, -1:] for values in vars(self).values()))

    def repeat(self, num_rollouts: int) -> "TokenSteps":
        """The steps of a single rollout, shared by N rollouts; no copies."""
        return TokenSteps(*(v.expand(-1, num_rollouts, *v.shape[2:]) for v in vars(self).values()))


def build_logged_steps(tokens: AgentTokens, steps: slice, *, catk_compat: bool) -> TokenSteps:
    """A block of logged token steps, as a single rollout.

    Args:
        tokens: Tokens [B, A, K] of the logged tracks.
        steps: Slice of the token steps K that the block takes.
        catk_compat: Motion vectors as in the public code, where the first motion of an agent is the position.
    """
    position = tokens.position
    motion = torch.diff(position, dim=2, prepend=torch.zeros_like(position[:, :, :1]))  # [B, A, K, 2]
    if catk_compat:
        # there the position before the first valid step is zero, and only the very first step has no motion
        motion[:, :, 0] = 0.0
    else:
        was_valid = torch.cat([torch.zeros_like(tokens.valid[..., :1]), tokens.valid[..., :-1]], -1)
        motion = torch.where(was_valid[..., None], motion, 0.0)
    fields = (position, tokens.heading, motion, tokens.token_id, tokens.valid)
    return TokenSteps(*(v[:, None, :, steps] for v in fields))


def begin_elsewhere(
    pose: tuple[Float[Tensor, "B N A 2"], Float[Tensor, "B N A"]], forced: AgentStates
) -> tuple[tuple[Float[Tensor, "B N A 2"], Float[Tensor, "B N A"]], Bool[Tensor, "B N A"]]:
    """Poses that a decision starts from, and True for agents that are put farther away than anybody drives.

    Such an agent is somebody else: the pose is that of 0.1 s before the first imposed state.

    Args:
        pose: Positions and headings before the decision.
        forced: States [B, N, A, 5] imposed from outside.
    """
    first, second = forced.position[..., 0, :], forced.position[..., 1, :]
    is_elsewhere = forced.valid.all(-1) & ((first - pose[0]).norm(dim=-1) > FARTHEST_STEP_M)
    start = torch.where(is_elsewhere[..., None], 2 * first - second, pose[0])
    return (start, torch.where(is_elsewhere, forced.heading[..., 0], pose[1])), is_elsewhere


def apply_decisions(
    decision: Int64[Tensor, "B N A"],
    position: Float[Tensor, "B N A 2"],
    heading: Float[Tensor, "B N A"],
    object_type: Int64[Tensor, "B A"],
    vocabulary: Vocabulary,
    forced: AgentStates | None,
    *,
    catk_compat: bool,
) -> tuple[Float[Tensor, "B N A 5 3"], Int64[Tensor, "B N A"]]:
    """The five poses (x, y, heading) of a decision, and the decisions. Padding stands still.

    Poses are those of the chosen tokens, placed at the current states. Imposed agents get the imposed poses, and the
    nearest token as the decision, as if that token had been chosen.

    Args:
        decision: Id of the token that each agent takes, within the agent's class.
        position: Positions before the decision, meters.
        heading: Headings before the decision, radians.
        object_type: Object type of each agent, which decides the box and the token class.
        vocabulary: Vocabulary that the token ids refer to.
        forced: States [B, N, A, 5] imposed from outside; only agents with five valid states are imposed.
        catk_compat: Order of operations of the public code, which places boxes and takes poses from the corners.
    """
    class_id = class_of_type(object_type)[:, None].expand(decision.shape)
    if catk_compat:
        corners = vocabulary.corners[class_id, decision, 1:]  # [B, N, A, 5, 4, 2]
        new_position, new_heading = pose_of_corners(catk_ops.place_boxes(corners, position, heading))
    else:
        local = vocabulary.poses[class_id, decision]  # [B, N, A, 5, 3], agent's frame
        new_position = position[..., None, :] + rotate(local[..., :2], heading[..., None])
        # without a turn the heading keeps its bits: agents at the same pose share a list of neighbors
        turn, start = local[..., 2], heading[..., None]
        new_heading = torch.where(turn == 0, start, wrap_angle(start + turn))
    poses = torch.cat([new_position, new_heading[..., None]], -1)
    if forced is None:
        return poses, decision
    is_imposed = forced.valid.all(-1)
    forced_poses = torch.cat([forced.position, forced.heading[..., None]], -1)
    poses = torch.where(is_imposed[..., None, None], forced_poses, poses)
    length, width = class_boxes(object_type)
    end_position, end_heading = poses[..., -1, :2], poses[..., -1, 2]
    corners = box_corners(end_position, end_heading, length[:, None], width[:, None])  # [B, N, A, 4, 2]
    local = rotate(corners - position[..., None, :], -heading[..., None])
    return poses, torch.where(is_imposed, nearest_tokens(local, class_id, is_imposed, vocabulary), decision)


def replay_decisions(policy: TokenPolicy, context: Any, rollouts: Rollouts) -> Iterator[Any]:
    """Yield the state of a policy before each decision of rollouts.

    Args:
        policy: Policy that starts without noise, and decides nothing here.
        context: Context of the scenarios, made by the same policy.
        rollouts: Rollouts of the same scenarios, whose decisions are taken, and states imposed as they were.
    """
    stride, noise = policy.steps_per_decision, rollouts.log_prob[..., :0]
    state = policy.begin(context, rollouts.num_rollouts, rollouts.goals, noise)
    yield state
    # the last decision leads nowhere that is scored
    for index in range(rollouts.decision.shape[3] - 1):
        forced = rollouts.forced and rollouts.forced.steps(index * stride, (index + 1) * stride)
        state = policy.advance(context, state, rollouts.decision[..., index], forced)
        yield state

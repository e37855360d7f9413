"""Agents at token steps: along logged tracks, and after a decision.

B scenarios, N rollouts, A agents, K token steps of a block. Map frame, meters and radians.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.geometry import box_corners, pose_of_corners, rotate, wrap_angle
from rlftsim.tokens import catk_compat as catk_ops
from rlftsim.tokens.agent_tokens import AgentTokens, class_boxes, nearest_tokens
from rlftsim.tokens.vocabulary import Vocabulary, class_of_type


@dataclass(frozen=True, eq=False)
class TokenSteps:
    """States of agents at a block of token steps and the tokens that led there. Map frame."""

    position: Float[Tensor, "B N A K 2"]
    heading: Float[Tensor, "B N A K"]
    motion: Float[Tensor, "B N A K 2"]
    """Position minus the position one token before."""
    token_id: Int64[Tensor, "B N A K"]
    valid: Bool[Tensor, "B N A K"]

    def then(self, other: "TokenSteps") -> "TokenSteps":
        """This block followed by another one."""
        pairs = ((getattr(self, name), getattr(other, name)) for name in self.__dataclass_fields__)
        return TokenSteps(*(torch.cat(pair, 3) for pair in pairs))

    @property
    def last(self) -> "TokenSteps":
        """The last step of the block."""
        return TokenSteps(*(getattr(self, name)[:, :, :, -1:] for name in self.__dataclass_fields__))

    def repeat(self, num_rollouts: int) -> "TokenSteps":
        """The steps of a single rollout, shared by N of them; no copies."""
        fields = (getattr(self, name) for name in self.__dataclass_fields__)
        return TokenSteps(*(v.expand(-1, num_rollouts, *v.shape[2:]) for v in fields))


def logged_steps(tokens: AgentTokens, steps: slice, *, catk_compat: bool) -> TokenSteps:
    """A block of logged token steps, as a single rollout.

    Args:
        tokens: of the logged tracks [B, A, K].
        steps: the block.
        catk_compat: motion vectors as in the public code, where an agent's first one is its position.
    """
    position = tokens.position
    before = torch.cat([torch.zeros_like(position[:, :, :1]), position[:, :, :-1]], 2)
    motion = position - before  # [B, A, K, 2]
    if catk_compat:
        # there the position before the first valid step is zero, and only the very first step has no motion
        motion[:, :, 0] = 0.0
    else:
        was_valid = torch.cat([torch.zeros_like(tokens.valid[..., :1]), tokens.valid[..., :-1]], -1)
        motion = torch.where(was_valid[..., None], motion, 0.0)
    fields = (position, tokens.heading, motion, tokens.token_id, tokens.valid)
    return TokenSteps(*(v[:, None, :, steps] for v in fields))


def place_tokens(
    decision: Int64[Tensor, "B N A"],
    position: Float[Tensor, "B N A 2"],
    heading: Float[Tensor, "B N A"],
    object_type: Int64[Tensor, "B A"],
    vocabulary: Vocabulary,
    *,
    catk_compat: bool,
) -> Float[Tensor, "B N A 5 3"]:
    """The five poses (x, y, heading) of the chosen tokens, placed at the current states. Padding stands still.

    Args:
        decision: token ids.
        position: before the decision.
        heading: before the decision.
        object_type: of the agents.
        vocabulary: of the tokens.
        catk_compat: the public code's order of operations, which places boxes and takes poses from their corners.
    """
    class_id = class_of_type(object_type)[:, None].expand(decision.shape)
    if catk_compat:
        corners = vocabulary.corners[class_id, decision, 1:]  # [B, N, A, 5, 4, 2]
        new_position, new_heading = pose_of_corners(catk_ops.place_boxes(corners, position, heading))
    else:
        local = vocabulary.poses[class_id, decision]  # [B, N, A, 5, 3], agent's frame
        new_position = position[..., None, :] + rotate(local[..., :2], heading[..., None])
        # without a turn the heading keeps its bits: agents at the same pose share a list of neighbors
        turn, before = local[..., 2], heading[..., None]
        new_heading = torch.where(turn == 0, before, wrap_angle(before + turn))
    return torch.cat([new_position, new_heading[..., None]], -1)


def match_imposed(
    decision: Int64[Tensor, "B N A"],
    imposed: Bool[Tensor, "B N A"],
    end: Float[Tensor, "B N A 3"],
    position: Float[Tensor, "B N A 2"],
    heading: Float[Tensor, "B N A"],
    object_type: Int64[Tensor, "B A"],
    vocabulary: Vocabulary,
) -> Int64[Tensor, "B N A"]:
    """Decisions, replaced for imposed agents by the nearest token: the decoder sees them as if they had chosen it.

    Args:
        decision: token ids.
        imposed: True = the agent's poses came from outside.
        end: last pose (x, y, heading) of the step.
        position: before the step.
        heading: before the step.
        object_type: of the agents.
        vocabulary: of the tokens.
    """
    length, width = class_boxes(object_type)
    corners = box_corners(end[..., :2], end[..., 2], length[:, None], width[:, None])  # [B, N, A, 4, 2]
    local = rotate(corners - position[..., None, :], -heading[..., None])
    class_id = class_of_type(object_type)[:, None].expand(imposed.shape)
    return torch.where(imposed, nearest_tokens(local, class_id, imposed, vocabulary), decision)

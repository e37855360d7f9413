"""How agents see their goals, in one of two ways. Both begin as nothing: with fresh weights a model decides as it did without.

* `concat`: distance and bearing of the goal join the continuous state of the agent's token, at every step.
* `indication`: the relation to the goal's polyline, the map token whose point is nearest to the goal, carries a learned mark, however
  far away it is.

Source: RLFTSim, section 4.2 and its appendix on goal conditioning; what it leaves open is in docs/decisions.md.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from rlftsim.goals.types import Goals
from rlftsim.policies.layers import FourierEmbedding, normalize
from rlftsim.policies.smart.neighbors import Poses, relative_pose, within

GOAL_POLYLINE_REACH_M = 200.0
"""A goal that is farther than this from all of the map has no polyline."""


@dataclass(frozen=True, eq=False)
class SeenGoals:
    """Goals, and where the map has them."""

    position: Float[Tensor, "B N A 2"]
    goal_mask: Bool[Tensor, "B N A"]
    polyline: Int64[Tensor, "B N A"]
    """The map token nearest to the goal, map tokens of all scenarios counted one after the other; -1 = none."""


def see_goals(goals: Goals, map_position: Float[Tensor, "B M 2"]) -> SeenGoals:
    """Find the polyline of each goal; a goal that is no finite point is none.

    Args:
        goals: what is asked.
        map_position: points of the map tokens, infinite for padding.
    """
    goals = goals.only(goals.position.isfinite().all(-1))
    place = goals.goal_mask.nonzero(as_tuple=True)
    near = within(
        goals.position[place], place[0], map_position, None, radius_m=GOAL_POLYLINE_REACH_M, limit=1
    )  # fmt: skip
    polyline = torch.full(goals.goal_mask.shape, -1, device=goals.position.device)
    polyline[place] = torch.where(near.mask, near.index, -1)[:, 0]
    return SeenGoals(goals.position, goals.goal_mask, polyline)


class GoalState(FourierEmbedding):
    """`concat`: embedding of distance and bearing that joins an agent's continuous state."""

    def __init__(self, dim: int, num_frequencies: int):
        super().__init__(2, dim, num_frequencies)

    def start_blind(self) -> None:
        """Zero the last map: the embedding of any goal is zero."""
        last = self.out[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)

    @torch.no_grad()
    def know(self, relation: FourierEmbedding) -> None:
        """Take over what another embedding knows of its first two inputs, if these are distance and bearing."""
        self.frequencies.weight.copy_(relation.frequencies.weight[:2])
        for own, known in zip(self.inputs, relation.inputs):
            own.load_state_dict(known.state_dict())

    def look(
        self, goals: SeenGoals, poses: Poses, rows: tuple[Tensor, ...], *, seam_rad: float
    ) -> tuple[Int64[Tensor, "g"], Float[Tensor, "g D"]]:
        """The rows whose agents have goals, and what they see.

        Args:
            goals: of all agents.
            poses: of the rows.
            rows: scenario, rollout, agent and step of each.
            seam_rad: see `relative_pose`.
        """
        place = rows[:3]
        carriers = goals.goal_mask[place].nonzero()[:, 0]
        goal = goals.position[place][carriers, None]
        values = relative_pose(poses[carriers], Poses(goal, torch.zeros_like(goal[..., 0])), seam_rad=seam_rad)
        return carriers, self(values[:, 0, :2])


class GoalMark(nn.Embedding):
    """`indication`: the mark on the relation to an agent's goal polyline."""

    def __init__(self, dim: int):
        super().__init__(1, dim)

    def start_blind(self) -> None:
        """A mark of zero is none."""
        nn.init.zeros_(self.weight)

    def mark(
        self, embedding: FourierEmbedding, values: Float[Tensor, "g n"]
    ) -> tuple[Float[Tensor, "g D"], Float[Tensor, "g D"]]:
        """Normalised embeddings of relations, as they are and with the mark."""
        mark = self.weight.expand(len(values), -1)
        nothing = torch.zeros_like(mark)  # so that both round alike in half precision
        return normalize(embedding(values, nothing)), normalize(embedding(values, mark))

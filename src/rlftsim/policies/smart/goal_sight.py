"""How agents see their goals, in one of two ways, and how they aim at them. All begin as nothing: with fresh weights a model decides as
it did without.

* `concat`: distance and bearing of the goal join the continuous state of the agent's token, at every step.
* `indication`: the relation to the goal's polyline, the map token whose point is nearest to the goal, carries a learned mark, however
  far away it is.

With either, tokens may also be weighed by where they lead (`GoalAim`), which is not in the paper.

Source: RLFTSim, section 4.2 and its appendix on goal conditioning; what it leaves open is in docs/decisions.md.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from rlftsim.goals.types import Goals
from rlftsim.policies.layers import FourierEmbedding, normalize
from rlftsim.policies.smart.neighbors import Poses, relative_pose, within
from rlftsim.scenario.types import FUTURE_STEPS, STEP_S
from rlftsim.tokens.vocabulary import CLASS_NAMES, STEPS_PER_TOKEN

GOAL_POLYLINE_REACH_M = 200.0
"""A goal that is farther than this from all of the map has no polyline."""
NUM_DECISIONS = FUTURE_STEPS // STEPS_PER_TOKEN
TOKEN_S = STEPS_PER_TOKEN * STEP_S
ROUNDING_MPS = 0.5
"""Misfits smaller than this differ little."""
AIM_GAIN = 8.0
"""Weights of an aim count so many times, so that the learning rate of other weights suits them: they are few and have far to go."""
ROWS_PER_PIECE = {"cpu": 128}
"""Rows whose tokens are looked at together: on a processor they fit its cache."""
ROWS_PER_PIECE_ELSEWHERE = 1 << 12


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


class GoalAim(nn.Module):
    """Tokens weighed by where they lead: three features of each, times weights that depend on the class and on how many decisions are left.

    With T the time that is left once a token has led there:

    * how much nearer the token leads, in metres,
    * by how much going on at its speed for T would miss the rest of the way, divided by 1 s + T,
    * how far from the goal going on straight at its speed for T would end, divided by 1 s + T; both in metres a second and rounded
      at zero (`ROUNDING_MPS`).

    The logit of a token is raised by the first and lowered by the others, each times its weight: a product of what the model thinks likely
    and of how well it suits, as for a walk that is to end in a place (Doob's h-transform; here with a learned, log-linear h). To be there
    when the simulation ends is what is aimed at.
    """

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(len(CLASS_NAMES), NUM_DECISIONS, 3))

    def start_blind(self) -> None:
        """Weights of zero weigh nothing."""
        nn.init.zeros_(self.weight)

    def forward(
        self,
        goal: Float[Tensor, "g 2"],
        num_left: Int64[Tensor, "g"],
        class_id: Int64[Tensor, "g"],
        moves: Float[Tensor, "C V 2"],
    ) -> Float[Tensor, "g V"]:
        """What is added to the logits of all tokens. Differentiable in the weights.

        Args:
            goal: metres, in the frame of each agent.
            num_left: decisions to be taken, this one included.
            class_id: whose tokens they are.
            moves: where tokens lead, metres.
        """
        weights = AIM_GAIN * self.weight[class_id, num_left - 1]
        with torch.autocast(goal.device.type, enabled=False):  # logits are float32
            return (weights[:, None] @ suitability(goal, num_left, class_id, moves))[:, 0]


@torch.no_grad()
def suitability(
    goal: Float[Tensor, "g 2"],
    num_left: Int64[Tensor, "g"],
    class_id: Int64[Tensor, "g"],
    moves: Float[Tensor, "C V 2"],
) -> Float[Tensor, "g 3 V"]:
    """The features of `GoalAim`: each is the larger the better a token suits."""
    features = goal.new_empty(len(goal), 3, moves.shape[1])
    left_s = (num_left[:, None] - 1).to(goal.dtype) * TOKEN_S
    size = ROWS_PER_PIECE.get(goal.device.type, ROWS_PER_PIECE_ELSEWHERE)
    for own in range(len(moves)):
        x, y = moves[own].unbind(-1)
        speed = moves[own].norm(dim=-1) / TOKEN_S
        for rows in (class_id == own).nonzero()[:, 0].split(size):
            (goal_x, goal_y), time_s = goal[rows].split(1, dim=-1), left_s[rows]
            rest = _length(goal_x - x, goal_y - y)
            reach = 1 + time_s / TOKEN_S
            astray = _length(torch.addcmul(goal_x, reach, x, value=-1), torch.addcmul(goal_y, reach, y, value=-1))
            nearer = _length(goal_x.clone(), goal_y.clone()) - rest
            pace = torch.addcmul(rest, time_s, speed, value=-1)
            found = nearer, _rounded(pace.div_(1 + time_s)), _rounded(astray.div_(1 + time_s))
            features[rows] = torch.stack(found, dim=1)
    return features


def _length(x: Tensor, y: Tensor) -> Tensor:
    """Of vectors, whose storage it uses up."""
    return x.square_().addcmul_(y, y).sqrt_()


def _rounded(misfit: Float[Tensor, "g V"]) -> Float[Tensor, "g V"]:
    """Its negative size, without a corner at zero, in its own storage."""
    return misfit.square_().add_(ROUNDING_MPS**2).sqrt_().neg_()

"""Goal conditioning of SMART: two encodings of an agent's goal, and a bias of the token logits.

* `concat`: distance and bearing of the goal join the continuous state of the agent's token, at every step.
* `indication`: the relation to the goal's polyline (the map token with the point nearest to the goal) has a learned
  embedding added, at any distance.

With either, a bias may be added to the token logits (`GoalLogitBias`), which is not in the paper. All weights start
such that a fresh goal-conditioned model decides exactly as the goal-free model.

Source: RLFTSim, section 4.2 and the appendix on goal conditioning; docs/decisions.md has what these leave open.

B scenarios, N rollouts, A agents, M map tokens, g goal-conditioned rows, C classes, V tokens, D width.
"""

from collections.abc import Iterator
from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from rlftsim.geometry import rotate
from rlftsim.goals.types import Goals
from rlftsim.policies.distributions import CategoricalDistribution, TokenDistribution
from rlftsim.policies.smart.config import GoalEncoding
from rlftsim.policies.smart.embeddings import FourierEmbedding, normalize
from rlftsim.policies.smart.neighbors import Poses, find_neighbors, relative_pose
from rlftsim.rollout.rows import find_rows
from rlftsim.scenario.types import FUTURE_STEPS, STEP_S
from rlftsim.tokens.vocabulary import CLASS_NAMES, STEPS_PER_TOKEN, Vocabulary

GOAL_POLYLINE_REACH_M = 200.0
"""A goal that is farther than this from all of the map has no polyline."""
NUM_DECISIONS = FUTURE_STEPS // STEPS_PER_TOKEN
TOKEN_S = STEPS_PER_TOKEN * STEP_S
ROUNDING_MPS = 0.5
"""Smaller misfits differ little: |x| is replaced by sqrt(x^2 + 0.5^2)."""
BIAS_GAIN = 8.0
"""Factor on the weights of the logit bias, which are few and have far to go, so that the learning rate of the other
weights suits."""
ROWS_PER_BLOCK = 128
"""Rows whose tokens are processed together: on a processor they fit its cache."""
ROWS_PER_BLOCK_ELSEWHERE = 1 << 12


@dataclass(frozen=True, eq=False)
class EncodedGoals:
    """Goals, each with the nearest map token."""

    position: Float[Tensor, "B N A 2"]
    goal_mask: Bool[Tensor, "B N A"]
    polyline: Int64[Tensor, "B N A"]
    """The map token nearest to the goal, map tokens of all scenarios counted one after the other; -1 = none."""


def encode_goals(goals: Goals, map_position: Float[Tensor, "B M 2"]) -> EncodedGoals:
    """Find the polyline of each goal. A goal that is no finite point is left out.

    Args:
        goals: Goals [B, N, A] of all agents, map frame, meters.
        map_position: Points of the map tokens, map frame, meters; infinite for padding.
    """
    goals = goals.only(goals.position.isfinite().all(-1))
    rows = goals.goal_mask.nonzero(as_tuple=True)
    nearest = find_neighbors(goals.position[rows], rows[0], map_position, None, radius_m=GOAL_POLYLINE_REACH_M, limit=1)
    polyline = torch.full(goals.goal_mask.shape, -1, device=goals.position.device)
    polyline[rows] = torch.where(nearest.mask, nearest.index, -1)[:, 0]
    return EncodedGoals(goals.position, goals.goal_mask, polyline)


def select_rows(mask: Bool[Tensor, "R"]) -> Int64[Tensor, "g"]:
    """Rows where a mask is True. Off the CPU all rows: to leave some out, the host would wait for the number."""
    return mask.nonzero()[:, 0] if mask.device.type == "cpu" else torch.arange(len(mask), device=mask.device)


class GoalEmbedding(FourierEmbedding):
    """`concat`: embedding of distance and bearing that joins an agent's continuous state."""

    def zero_init(self) -> None:
        """Zero the last map: the embedding of any goal is zero."""
        for weight in self.out[-1].parameters():
            nn.init.zeros_(weight)

    @torch.no_grad()
    def init_from(self, relation: FourierEmbedding) -> None:
        """Copy the networks of a relation embedding's first two inputs, which must be distance and bearing."""
        self.frequencies.weight.copy_(relation.frequencies.weight[:2])
        for layers, trained_layers in zip(self.inputs, relation.inputs):
            layers.load_state_dict(trained_layers.state_dict())

    def embed(
        self, goals: EncodedGoals, poses: Poses, rows: tuple[Tensor, ...], *, seam_rad: float
    ) -> tuple[Int64[Tensor, "g"], Float[Tensor, "g D"]]:
        """Embeddings of the goals of rows.

        Args:
            goals: Goals [B, N, A] of all agents, in the frame of the poses.
            poses: Poses [R] of the rows, meters and radians.
            rows: Scenario, rollout, agent and step of each row, four indices [R].
            seam_rad: Width of the seam of angles at -pi, see `relative_pose`.

        Returns:
            The rows of agents with goals (or all rows), and an embedding of each, zero where there is no goal.
        """
        agent = rows[:3]
        has_goal = goals.goal_mask[agent]
        conditioned = select_rows(has_goal)  # [g]
        goal = goals.position[agent][conditioned, None]  # [g, 1, 2]
        # a goal has no heading; the difference of headings is computed and dropped
        values = relative_pose(poses[conditioned], Poses(goal, torch.zeros_like(goal[..., 0])), seam_rad=seam_rad)
        return conditioned, torch.where(has_goal[conditioned, None], self(values[:, 0, :2]), 0.0)


class GoalEdgeEmbedding(nn.Embedding):
    """`indication`: the embedding that is added to the relation to an agent's goal polyline."""

    def zero_init(self) -> None:
        """Zero the embedding: the relation to the goal polyline is as to any other map token."""
        nn.init.zeros_(self.weight)

    def embed(
        self, embedding: FourierEmbedding, values: Float[Tensor, "g n"]
    ) -> tuple[Float[Tensor, "g D"], Float[Tensor, "g D"]]:
        """Normalized embeddings of relations without and with the goal embedding.

        Args:
            embedding: Embedding of the relations to map tokens.
            values: Distance, bearing and difference of heading of each relation, meters and radians.
        """
        goal = self.weight.expand(len(values), -1)  # [g, D]
        zeros = torch.zeros_like(goal)  # added, so that both round alike in half precision
        return normalize(embedding(values, zeros)), normalize(embedding(values, goal))


GoalEncoder = GoalEmbedding | GoalEdgeEmbedding


def build_goal_encoder(encoding: GoalEncoding | None, dim: int, num_frequencies: int) -> GoalEncoder | None:
    """Module of a goal encoding, with random weights; None for a goal-free model.

    Args:
        encoding: Encoding of goals, "concat" or "indication"; None = goal-free.
        dim: Width D of all features of the model.
        num_frequencies: Number of learned frequencies per input; only `concat` has these.
    """
    if encoding is None:
        return None
    return GoalEmbedding(2, dim, num_frequencies) if encoding == "concat" else GoalEdgeEmbedding(1, dim)


class GoalLogitBias(nn.Module):
    """Goal-progress bias of token logits: three features per token, weighted by class and number of decisions left.

    With T the time left after a token:

    * progress: by how much the token brings the agent nearer to the goal, meters,
    * pace: the remaining distance minus the token's speed times T, divided by 1 s + T,
    * direction: distance from the goal after going straight on at the token's speed for T, divided by 1 s + T.

    Pace and direction are misfits in m/s, rounded at zero (`ROUNDING_MPS`). The logit is raised by weighted progress
    and lowered by the weighted misfits. So the policy becomes a product of the token's probability and of the token's
    suitability for the goal, as for a random walk that is conditioned on the end (Doob's h-transform; here with a
    learned, log-linear h). The goal is to be reached when the simulation ends.
    """

    def __init__(self):
        super().__init__()
        self.weight = nn.Parameter(torch.zeros(len(CLASS_NAMES), NUM_DECISIONS, 3))

    def forward(
        self, features: Float[Tensor, "g 3 V"], num_left: Int64[Tensor, "g"], class_id: Int64[Tensor, "g"]
    ) -> Float[Tensor, "g V"]:
        """Bias of the logits of all tokens, differentiable in the weights.

        Args:
            features: Features of each token, from `suitability`.
            num_left: Number of decisions left, the next included, from 1 to 16.
            class_id: Agent class that each row's token ids refer to.
        """
        weights = BIAS_GAIN * self.weight[class_id, num_left - 1]  # [g, 3]
        with torch.autocast(features.device.type, enabled=False):  # logits are float32
            return (weights[:, None] @ features)[:, 0]

    def apply_to(
        self,
        dist: CategoricalDistribution,
        goals: EncodedGoals,
        poses: Poses,
        num_left: Int64[Tensor, "*batch"],
        class_id: Int64[Tensor, "B A"],
        vocabulary: Vocabulary,
    ) -> TokenDistribution:
        """Distribution with the bias added for agents that have goals.

        Args:
            dist: Distributions without the bias, with a mask [B, N, A] or [B, N, A, L].
            goals: Goals [B, N, A] of all agents, map frame.
            poses: Poses of the agents before each decision, map frame, in the shape of the mask.
            num_left: Number of decisions left at each element, the next included, from 1 to 16.
            class_id: Agent class that each agent's token ids refer to.
            vocabulary: Vocabulary of the tokens; the boxes give the displacements.
        """
        elements = find_rows(dist.mask, len(dist.logits) == dist.mask.numel())
        has_goal = goals.goal_mask[elements[:3]]
        conditioned = select_rows(has_goal)  # [g] of the R rows of dist
        rows = tuple(index[conditioned] for index in elements)
        pose = poses[rows]
        goal = rotate(goals.position[rows[:3]] - pose.position, -pose.heading)  # [g, 2], agent's frame
        row_class = class_id[rows[0], rows[2]]
        # a token's displacement is the mean of the four corners of its last box
        features = suitability(goal, num_left[rows], row_class, vocabulary.end_corners().mean(-2))
        bias = self(features, num_left[rows], row_class)  # [g, V]
        # tokens of other classes stay impossible
        is_biased = vocabulary.token_mask[row_class] & has_goal[conditioned, None]
        logits = dist.logits.index_add(0, conditioned, bias.masked_fill(~is_biased, 0.0))
        return TokenDistribution(logits, dist.mask, dist.sampling)


@torch.no_grad()
def suitability(
    goal: Float[Tensor, "g 2"], num_left: Int64[Tensor, "g"], class_id: Int64[Tensor, "g"], ends: Float[Tensor, "C V 2"]
) -> Float[Tensor, "g 3 V"]:
    """Features of `GoalLogitBias`: progress, minus pace, minus direction; larger for a token that suits better.

    Args:
        goal: Goal of each row, meters, in the agent's frame.
        num_left: Number of decisions left, the next included, from 1 to 16.
        class_id: Agent class that each row's token ids refer to.
        ends: Displacement by each token, meters, in the agent's frame.
    """
    features = goal.new_empty(len(goal), 3, ends.shape[1])
    left_s = (num_left[:, None] - 1).to(goal.dtype) * TOKEN_S  # [g, 1]
    # in blocks, and in place where possible: at 2048 tokens these [r, V] tensors dominate a rollout's time
    for rows, move in _row_blocks(class_id, ends):
        x, y = move.unbind(-1)  # [V] or [r, V]
        speed = move.norm(dim=-1) / TOKEN_S
        (goal_x, goal_y), time_s = goal[rows].split(1, dim=-1), left_s[rows]  # [r, 1]
        remaining = _write_length(goal_x - x, goal_y - y)  # [r, V] distance to the goal after the token
        reach = 1 + time_s / TOKEN_S
        miss = _write_length(torch.addcmul(goal_x, reach, x, value=-1), torch.addcmul(goal_y, reach, y, value=-1))
        progress = _write_length(goal_x.clone(), goal_y.clone()) - remaining
        pace = torch.addcmul(remaining, time_s, speed, value=-1)
        # minus the absolute value of each misfit, without the corner at zero
        misfits = [v.div_(1 + time_s).square_().add_(ROUNDING_MPS**2).sqrt_().neg_() for v in (pace, miss)]
        features[rows] = torch.stack([progress, *misfits], dim=1)
    return features


def _row_blocks(
    class_id: Int64[Tensor, "g"], moves: Float[Tensor, "C V 2"]
) -> Iterator[tuple[Int64[Tensor, "r"] | slice, Float[Tensor, "*r V 2"]]]:
    """Blocks of rows, each with the moves of a class: on the CPU class by class, elsewhere in the order of rows."""
    if class_id.device.type == "cpu":
        for index, move in enumerate(moves):
            for rows in (class_id == index).nonzero()[:, 0].split(ROWS_PER_BLOCK):
                yield rows, move
        return
    for start in range(0, len(class_id), ROWS_PER_BLOCK_ELSEWHERE):
        rows = slice(start, start + ROWS_PER_BLOCK_ELSEWHERE)
        yield rows, moves[class_id[rows]]


def _write_length(x: Tensor, y: Tensor) -> Tensor:
    """Length of vectors, in the storage of x."""
    return x.square_().addcmul_(y, y).sqrt_()

"""Order of operations of the public SMART code (CAT-K), for models that were trained with it.

The same rules as in `agent_tokens`, in the order in which the public code computes them: gaps are filled in world
coordinates and rounded to float32, and boxes are placed in the batch's frame before they are compared or read. In the
map frame positions move by 0.1 mm. In the world frame, where float32 has steps of 0.5 mm, one token in twenty
differs.
"""

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import STEP_S
from rlftsim.tokens.vocabulary import STEPS_PER_TOKEN, Vocabulary

_ROWS_PER_CHUNK = 32
_FRONT_BACK = (1.0, 1.0, -1.0, -1.0)
_LEFT_RIGHT = (1.0, -1.0, -1.0, 1.0)


def fill_gaps_in_world(
    batch: ScenarioBatch,
) -> tuple[Float[Tensor, "B A S 2"], Float[Tensor, "B A S 2"], Bool[Tensor, "B A S"]]:
    """Positions (in the batch's frame), velocities and validity with gaps filled, as in `agent_tokens.clean_tracks`."""
    # 1. Neighbors of each step [B, A, S]. Unlike in `agent_tokens`, a valid step is interpolated from the valid step
    #    before it, too, with weight 1, because the public code rounds so.
    steps = torch.arange(batch.valid.shape[-1], device=batch.device).expand_as(batch.valid)
    seen = torch.where(batch.valid, steps, -1).cummax(-1).values
    earlier = torch.nn.functional.pad(seen[..., :-1], (1, 0), value=-1)
    after = torch.where(batch.valid, steps, steps.shape[-1]).flip(-1).cummin(-1).values.flip(-1)
    inside = (seen >= 0) & (after < steps.shape[-1])
    before = torch.where(earlier >= 0, earlier, after)  # no earlier step for the first valid one
    before, after = torch.where(inside, before, 0), torch.where(inside, after, 0)
    weight = ((steps - before).double() / (after - before).clamp(min=1))[..., None]

    # 2. Interpolated in float64, rounded to float32 in world coordinates.
    def blend(values: Float[Tensor, "B A S c"]) -> Float[Tensor, "B A S c"]:
        first, last = (values.gather(-2, at[..., None].expand_as(values)) for at in (before, after))
        return ((last - first).double() * weight + first.double()).float()

    origin = batch.origin[:, None, None]
    position = (blend((batch.position + origin).float()) - origin).float()
    masked = inside[..., None]
    return torch.where(masked, position, 0.0), torch.where(masked, blend(batch.velocity), 0.0), inside


def step_back(
    position: Float[Tensor, "*batch 2"], velocity: Float[Tensor, "*batch 2"], lead: Int64[Tensor, "*batch S"]
) -> Float[Tensor, "*batch S 2"]:
    """Positions 0 to 5 steps before a position, by repeated subtraction.

    Args:
        position: at step 0, m.
        velocity: constant, m/s.
        lead: number of steps before; clamped to 0..5.
    """
    path = [position]
    for _ in range(STEPS_PER_TOKEN):
        path.append(path[-1] - velocity * STEP_S)
    places = lead.clamp(0, STEPS_PER_TOKEN)[..., None].expand(*lead.shape, 2)
    return torch.stack(path, -2).gather(-2, places)


def place_boxes(
    corners: Float[Tensor, "*batch n 4 2"], position: Float[Tensor, "*batch 2"], heading: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch n 4 2"]:
    """Boxes moved from the frame of a pose into the frame in which the pose is given.

    Args:
        corners: in the frame of the pose.
        position: of the pose, m.
        heading: of the pose, rad.
    """
    # A matrix product, as in the public code, because it rounds differently from a sum of products.
    cos, sin = heading.cos(), heading.sin()
    rotation = torch.stack([cos, sin, -sin, cos], -1).unflatten(-1, (2, 2))
    flat = corners.flatten(-3, -2).flatten(0, -3)
    placed = torch.bmm(flat, rotation.flatten(0, -3)) + position.flatten(0, -2)[:, None]
    return placed.view(corners.shape)


def boxes_around(
    position: Float[Tensor, "*batch 2"],
    heading: Float[Tensor, "*batch"],
    length: Float[Tensor, "*batch"],
    width: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch 4 2"]:
    """Corners in the order of `geometry.box_corners`; length and width are added to the position one after the other.

    Args:
        position: center, m.
        heading: rad.
        length: m.
        width: m.
    """
    along = length[..., None] * position.new_tensor(_FRONT_BACK)
    across = width[..., None] * position.new_tensor(_LEFT_RIGHT)
    cos, sin = 0.5 * heading.cos()[..., None], 0.5 * heading.sin()[..., None]
    x = position[..., :1] + along * cos - across * sin
    y = position[..., 1:] + along * sin + across * cos
    return torch.stack([x, y], -1)


def nearest_placed_tokens(
    target: Float[Tensor, "*batch 4 2"],
    position: Float[Tensor, "*batch 2"],
    heading: Float[Tensor, "*batch"],
    class_id: Int64[Tensor, "*batch"],
    valid: Bool[Tensor, "*batch"],
    vocabulary: Vocabulary,
) -> Int64[Tensor, "*batch"]:
    """Token whose end box, placed at a pose, has the smallest sum of corner distances to a box.

    Args:
        target: corners of the box to match, m.
        position: start of the token.
        heading: at the start, rad.
        class_id: index into `CLASS_NAMES`.
        valid: the result is 0 elsewhere.
        vocabulary: the tokens.
    """
    out = torch.zeros_like(class_id)
    for index, (table, exists) in enumerate(zip(vocabulary.end_corners(), vocabulary.token_mask)):
        rows = ((class_id == index) & valid).nonzero(as_tuple=True)
        parts = zip(*(v[rows].split(_ROWS_PER_CHUNK) for v in (target, position, heading)))
        found = []
        for box, start, turn in parts:
            tokens = table[exists].expand(len(box), -1, -1, -1)  # [n, V, 4, 2]
            distance = (place_boxes(tokens, start, turn) - box[:, None]).norm(dim=-1).sum(-1)  # [n, V]
            found.append(distance.argmin(-1))
        out[rows] = exists.nonzero()[:, 0][torch.cat(found)]
    return out

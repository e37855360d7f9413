"""Order of operations of the public SMART code (CAT-K), for models trained by that code.

The same rules as in `agent_tokens`, in the order of the public code: gaps are filled in world coordinates and rounded
to float32, and boxes are placed in the batch's frame before any comparison. In the map frame positions move by 0.1 mm.
In the world frame, where float32 has steps of 0.5 mm, every twentieth token differs.
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
    last_valid = torch.where(batch.valid, steps, -1).cummax(-1).values
    previous = torch.nn.functional.pad(last_valid[..., :-1], (1, 0), value=-1)
    following = torch.where(batch.valid, steps, steps.shape[-1]).flip(-1).cummin(-1).values.flip(-1)
    is_inside = (last_valid >= 0) & (following < steps.shape[-1])
    previous = torch.where(previous >= 0, previous, following)  # no previous step for the first valid one
    previous, following = torch.where(is_inside, previous, 0), torch.where(is_inside, following, 0)
    weight = ((steps - previous).double() / (following - previous).clamp(min=1))[..., None]

    # 2. Interpolated in float64, rounded to float32 in world coordinates.
    def blend(values: Float[Tensor, "B A S c"]) -> Float[Tensor, "B A S c"]:
        first, last = (values.gather(-2, index[..., None].expand_as(values)) for index in (previous, following))
        return ((last - first).double() * weight + first.double()).float()

    origin = batch.origin[:, None, None]
    position = (blend((batch.position + origin).float()) - origin).float()
    mask = is_inside[..., None]
    return torch.where(mask, position, 0.0), torch.where(mask, blend(batch.velocity), 0.0), is_inside


def step_back(
    position: Float[Tensor, "*batch 2"], velocity: Float[Tensor, "*batch 2"], lead: Int64[Tensor, "*batch S"]
) -> Float[Tensor, "*batch S 2"]:
    """Positions 0 to 5 steps before a position, by repeated subtraction.

    Args:
        position: Position at step 0, m.
        velocity: Constant velocity, m/s.
        lead: Number of steps back to each result; clamped to 0..5.
    """
    path = [position]
    for _ in range(STEPS_PER_TOKEN):
        path.append(path[-1] - velocity * STEP_S)
    index = lead.clamp(0, STEPS_PER_TOKEN)[..., None].expand(*lead.shape, 2)
    return torch.stack(path, -2).gather(-2, index)


def place_boxes(
    corners: Float[Tensor, "*batch n 4 2"], position: Float[Tensor, "*batch 2"], heading: Float[Tensor, "*batch"]
) -> Float[Tensor, "*batch n 4 2"]:
    """Boxes moved from the frame of a pose into the frame in which the pose is given.

    Args:
        corners: Corners of n boxes in the frame of the pose, m.
        position: Position of the pose, m.
        heading: Heading of the pose, rad.
    """
    # A matrix product, as in the public code, because it rounds differently from a sum of products.
    cos, sin = heading.cos(), heading.sin()
    rotation = torch.stack([cos, sin, -sin, cos], -1).unflatten(-1, (2, 2))
    flat = corners.flatten(-3, -2).flatten(0, -3)
    boxes = torch.bmm(flat, rotation.flatten(0, -3)) + position.flatten(0, -2)[:, None]
    return boxes.view(corners.shape)


def build_boxes(
    position: Float[Tensor, "*batch 2"],
    heading: Float[Tensor, "*batch"],
    length: Float[Tensor, "*batch"],
    width: Float[Tensor, "*batch"],
) -> Float[Tensor, "*batch 4 2"]:
    """Corners in the order of `geometry.box_corners`; first the length is added to the position, then the width.

    Args:
        position: Center of the box, m.
        heading: Heading of the box, rad.
        length: Length of the box, m.
        width: Width of the box, m.
    """
    box_x = length[..., None] * position.new_tensor(_FRONT_BACK)
    box_y = width[..., None] * position.new_tensor(_LEFT_RIGHT)
    cos, sin = 0.5 * heading.cos()[..., None], 0.5 * heading.sin()[..., None]
    x = position[..., :1] + box_x * cos - box_y * sin
    y = position[..., 1:] + box_x * sin + box_y * cos
    return torch.stack([x, y], -1)


def nearest_placed_tokens(
    target: Float[Tensor, "*batch 4 2"],
    position: Float[Tensor, "*batch 2"],
    heading: Float[Tensor, "*batch"],
    class_id: Int64[Tensor, "*batch"],
    valid: Bool[Tensor, "*batch"],
    vocabulary: Vocabulary,
) -> Int64[Tensor, "*batch"]:
    """Token with the smallest sum of corner distances between a box and the end box, placed at a pose.

    Args:
        target: Corners of the box to match, m.
        position: Position at the start of the token, m.
        heading: Heading at the start of the token, rad.
        class_id: Class of each row, as an index into `CLASS_NAMES`.
        valid: True = the row is matched; the result is 0 elsewhere.
        vocabulary: Motion tokens of each class.
    """
    token_id = torch.zeros_like(class_id)
    for index, (table, exists) in enumerate(zip(vocabulary.end_corners(), vocabulary.token_mask)):
        rows = ((class_id == index) & valid).nonzero(as_tuple=True)
        nearest = []
        for box, start, turn in zip(*(values[rows].split(_ROWS_PER_CHUNK) for values in (target, position, heading))):
            tokens = table[exists].expand(len(box), -1, -1, -1)  # [n, V, 4, 2]
            distance = (place_boxes(tokens, start, turn) - box[:, None]).norm(dim=-1).sum(-1)  # [n, V]
            nearest.append(distance.argmin(-1))
        token_id[rows] = exists.nonzero()[:, 0][torch.cat(nearest)]
    return token_id

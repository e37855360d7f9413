"""Tracks → motion tokens.

A agents, K token steps: token step k is the motion from 10 Hz step 5k to 5k + 5, its state is the one at 5k + 5.
K is 18 for a whole scenario, 2 where only the history is recorded. The rules are those of the public SMART code.
"""

from dataclasses import dataclass

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.geometry import box_corners, pose_of_corners, rotate, wrap_angle
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.derived import derived
from rlftsim.scenario.types import CURRENT_STEP, STEP_S, Scenario
from rlftsim.tokens.vocabulary import CLASS_BOXES_M, STEPS_PER_TOKEN, Vocabulary, class_of_type

HISTORY_TOKENS = 2
MAX_HEADING_STEP_RAD = 1.5
_ROWS_PER_CHUNK = 512


@dataclass(frozen=True, eq=False)
class CleanTracks:
    """Recorded tracks with gaps filled, headings cleaned and begun early enough for the first token. Map frame."""

    position: Float[Tensor, "*batch A S 2"]
    heading: Float[Tensor, "*batch A S"]
    velocity: Float[Tensor, "*batch A S 2"]
    valid: Bool[Tensor, "*batch A S"]


@dataclass(frozen=True, eq=False)
class AgentTokens:
    """The rolling tokenisation of recorded tracks. Map frame; zeros where `valid` is False."""

    token_id: Int64[Tensor, "B A K"]
    position: Float[Tensor, "B A K 2"]
    """Where the chosen tokens lead, not where the record was: each token corrects the error of the last."""
    heading: Float[Tensor, "B A K"]
    valid: Bool[Tensor, "B A K"]
    logged_position: Float[Tensor, "B A K 2"]
    logged_heading: Float[Tensor, "B A K"]
    logged_valid: Bool[Tensor, "B A K"]


def clean_tracks(batch: ScenarioBatch) -> CleanTracks:
    """Tracks as SMART sees them: gaps interpolated, jumps of heading removed, up to five made-up steps before the first."""
    position, heading, velocity, valid = _fill_gaps(batch.position, batch.heading, batch.velocity, batch.valid)
    heading = _hold_jumping_headings(heading, valid)
    return _begin_earlier(CleanTracks(position, heading, velocity, valid))


def _fill_gaps(
    position: Float[Tensor, "B A S 2"],
    heading: Float[Tensor, "B A S"],
    velocity: Float[Tensor, "B A S 2"],
    valid: Bool[Tensor, "B A S"],
) -> tuple[Tensor, Tensor, Tensor, Tensor]:
    """Linear interpolation between the first and the last valid step, which all become valid."""
    steps = torch.arange(valid.shape[-1], device=valid.device).expand_as(valid)
    before = torch.where(valid, steps, -1).cummax(-1).values
    after = torch.where(valid, steps, valid.shape[-1]).flip(-1).cummin(-1).values.flip(-1)
    inside = (before >= 0) & (after < valid.shape[-1])
    before, after = torch.where(inside, before, 0), torch.where(inside, after, 0)
    share = (steps - before) / (after - before).clamp(min=1)

    def blend(values: Tensor) -> Tensor:
        first, last = _take_steps(values, before), _take_steps(values, after)
        return torch.where(inside[..., None], first + share[..., None] * (last - first), 0.0)

    turn = wrap_angle(heading.gather(-1, after) - heading.gather(-1, before))
    filled = torch.where(valid, heading, wrap_angle(heading.gather(-1, before) + share * turn))
    filled = torch.where(inside, filled, 0.0)
    return (
        torch.where(valid[..., None], position, blend(position)),
        filled,
        torch.where(valid[..., None], velocity, blend(velocity)),
        inside,
    )


def _take_steps(values: Float[Tensor, "B A S c"], steps: Int64[Tensor, "B A S"]) -> Float[Tensor, "B A S c"]:
    return values.gather(-2, steps[..., None].expand(*steps.shape, values.shape[-1]))


def _hold_jumping_headings(heading: Float[Tensor, "B A S"], valid: Bool[Tensor, "B A S"]) -> Float[Tensor, "B A S"]:
    """A heading that jumps by more than 1.5 rad from a valid step to the next takes the value before."""
    columns = list(heading.unbind(-1))
    for step in range(1, len(columns)):
        jumps = wrap_angle(columns[step] - columns[step - 1]).abs() > MAX_HEADING_STEP_RAD
        hold = jumps & valid[..., step] & valid[..., step - 1]
        columns[step] = torch.where(hold, columns[step - 1], columns[step])
    return torch.stack(columns, -1)


def _begin_earlier(tracks: CleanTracks) -> CleanTracks:
    """Extend each track backwards, at constant velocity, to the last multiple of five steps (and to step 5 at the least)."""
    num_steps = tracks.valid.shape[-1]
    steps = torch.arange(num_steps, device=tracks.valid.device)
    first = torch.where(tracks.valid, steps, num_steps).amin(-1)  # [B, A]
    extra = torch.where(first == CURRENT_STEP, STEPS_PER_TOKEN, first % STEPS_PER_TOKEN)
    lead = first[..., None] - steps  # steps before the first one
    made_up = (lead > 0) & (lead <= extra[..., None]) & (first < num_steps)[..., None]
    at = first.clamp(max=num_steps - 1)[..., None].expand_as(made_up)
    velocity = _take_steps(tracks.velocity, at)
    back = _take_steps(tracks.position, at) - lead[..., None] * STEP_S * velocity
    return CleanTracks(
        position=torch.where(made_up[..., None], back, tracks.position),
        heading=torch.where(made_up, tracks.heading.gather(-1, at), tracks.heading),
        velocity=torch.where(made_up[..., None], velocity, tracks.velocity),
        valid=tracks.valid | made_up,
    )


def class_boxes(object_type: Int64[Tensor, "..."]) -> tuple[Float[Tensor, "..."], Float[Tensor, "..."]]:
    """Length and width of the box that an agent's class is matched with."""
    table = torch.tensor(CLASS_BOXES_M, device=object_type.device)[class_of_type(object_type)]
    return table[..., 0], table[..., 1]


def tokenize_tracks(tracks: CleanTracks, object_type: Int64[Tensor, "B A"], vocabulary: Vocabulary) -> AgentTokens:
    """Rolling matching: at each token step the token that leads nearest to the record from where the last one led."""
    length, width = class_boxes(object_type)
    class_id = class_of_type(object_type)
    position, heading = tracks.position[..., 0, :], tracks.heading[..., 0]
    columns: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    ends = range(STEPS_PER_TOKEN, tracks.valid.shape[-1], STEPS_PER_TOKEN)
    for end in ends:
        valid = tracks.valid[..., end - STEPS_PER_TOKEN] & tracks.valid[..., end]
        logged_position, logged_heading = tracks.position[..., end, :], tracks.heading[..., end]
        target = box_corners(logged_position, logged_heading, length, width)
        local = rotate(target - position[..., None, :], -heading[..., None])
        token_id = nearest_tokens(local, class_id, valid, vocabulary)
        led_position, led_heading = place_pose(vocabulary, class_id, token_id, position, heading)
        position = torch.where(valid[..., None], led_position, logged_position)
        heading = torch.where(valid, led_heading, logged_heading)
        columns.append((token_id, position * valid[..., None], heading * valid, valid))
    token_id, led_positions, led_headings, valid = (torch.stack([c[i] for c in columns], 2) for i in range(4))
    logged = slice(STEPS_PER_TOKEN, None, STEPS_PER_TOKEN)
    return AgentTokens(
        token_id, led_positions, led_headings, valid,
        tracks.position[..., logged, :], tracks.heading[..., logged], tracks.valid[..., logged],
    )  # fmt: skip


def nearest_tokens(
    local_corners: Float[Tensor, "*batch 4 2"],
    class_id: Int64[Tensor, "*batch"],
    valid: Bool[Tensor, "*batch"],
    vocabulary: Vocabulary,
) -> Int64[Tensor, "*batch"]:
    """Token whose end box has the smallest sum of corner distances to a box; lowest index on ties, 0 where not `valid`."""
    out = torch.zeros_like(class_id)
    for index, (table, exists) in enumerate(zip(vocabulary.end_corners(), vocabulary.token_mask)):
        rows = ((class_id == index) & valid).nonzero(as_tuple=True)
        corners = local_corners[rows]  # [n, 4, 2]
        found = [_nearest_rows(part, table[exists]) for part in corners.split(_ROWS_PER_CHUNK)]
        if found:
            out[rows] = exists.nonzero()[:, 0][torch.cat(found)]
    return out


def _nearest_rows(corners: Float[Tensor, "n 4 2"], table: Float[Tensor, "V 4 2"]) -> Int64[Tensor, "n"]:
    total = sum((corners[:, None, c] - table[:, c]).square().sum(-1).sqrt() for c in range(4))
    return torch.as_tensor(total).argmin(-1)


def place_pose(
    vocabulary: Vocabulary,
    class_id: Int64[Tensor, "*batch"],
    token_id: Int64[Tensor, "*batch"],
    position: Float[Tensor, "*batch 2"],
    heading: Float[Tensor, "*batch"],
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
    """Pose at the end of a token that starts at a pose."""
    corners = vocabulary.end_corners()[class_id, token_id]
    local_position, local_heading = pose_of_corners(corners)
    return position + rotate(local_position, heading), wrap_angle(heading + local_heading)


def tokenize_agents(batch: ScenarioBatch, vocabulary: Vocabulary) -> AgentTokens:
    """Tokens of a batch's recorded tracks; each scenario's are computed once and remembered while it is in memory."""
    rows = [_tokenize_scenario(scenario, vocabulary) for scenario in batch.scenarios]
    num_agents = batch.agent_mask.shape[1]
    num_tokens = max(row.valid.shape[-1] for row in rows)

    def padded(name: str) -> Tensor:
        parts = [getattr(row, name)[0] for row in rows]
        out = torch.zeros((len(parts), num_agents, num_tokens, *parts[0].shape[2:]), dtype=parts[0].dtype)
        for target, part in zip(out, parts):
            target[: part.shape[0], : part.shape[1]] = part
        return out.to(batch.device)

    return AgentTokens(**{name: padded(name) for name in AgentTokens.__dataclass_fields__})


@derived
def _tokenize_scenario(scenario: Scenario, vocabulary: Vocabulary) -> AgentTokens:
    """Tokens of one scenario on the CPU; remembered with the scenario."""
    batch = collate([scenario])
    return tokenize_tracks(clean_tracks(batch), batch.object_type, vocabulary.to("cpu"))

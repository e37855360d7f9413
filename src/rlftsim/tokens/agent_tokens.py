"""Tokenization of agents: tracks to motion tokens, by the rules of the public SMART code.

A agents, S steps at 10 Hz, K token steps. Token step k is the motion from step 5k to 5k + 5, with the state at 5k + 5.
K is 18 for a whole scenario, 2 where only the history is logged.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor

from rlftsim.geometry import box_corners, pose_of_corners, rotate, square_norm, wrap_angle
from rlftsim.scenario.batch import Frame, ScenarioBatch, collate
from rlftsim.scenario.types import CURRENT_STEP, STEP_S, Scenario, cached_on_scenario
from rlftsim.tokens import catk_compat as catk_ops
from rlftsim.tokens.vocabulary import STEPS_PER_TOKEN, Vocabulary, box_of_class, class_of_type

HISTORY_TOKENS = 2
"""Token steps up to the current step."""
MAX_HEADING_STEP_RAD = 1.5
MAX_START_ERROR_M = 0.3
"""Mean distance of the corners from the log up to which a simulation begins where the history tokens end. Of 11 595
agents of WOMD 99 % are below 0.17 m in the public vocabulary; all synthetic ones are below 0.18 m in the demo's."""
_ROWS_PER_CHUNK = 512
_ROWS_PER_CHUNK_ELSEWHERE = 1 << 12
_CANDIDATES = 64
"""Tokens whose corners are compared first; all tokens are, where these may not contain the nearest token."""


@dataclass(frozen=True, eq=False)
class CleanTracks:
    """Tracks with gaps filled, headings cleaned, and extended back to the first token's start. Frame: the batch's."""

    position: Float[Tensor, "*batch A S 2"]
    heading: Float[Tensor, "*batch A S"]
    velocity: Float[Tensor, "*batch A S 2"]
    valid: Bool[Tensor, "*batch A S"]


@dataclass(frozen=True, eq=False)
class AgentTokens:
    """Rolling tokenization of logged tracks. Frame: the batch's. Zeros where `valid` is False."""

    token_id: Int64[Tensor, "B A K"]
    position: Float[Tensor, "B A K 2"]
    """End points of the matched tokens, not of the log: each token corrects the error of the token before."""
    heading: Float[Tensor, "B A K"]
    valid: Bool[Tensor, "B A K"]
    logged_position: Float[Tensor, "B A K 2"]
    logged_heading: Float[Tensor, "B A K"]
    logged_valid: Bool[Tensor, "B A K"]
    next_token_id: Int64[Tensor, "B A K"]
    """Target of next-token prediction: `token_id` of the next step. Undefined in the last column and where the next
    step is not `valid`."""


def clean_tracks(batch: ScenarioBatch, *, catk_compat: bool = False) -> CleanTracks:
    """Tracks in SMART's form: gaps interpolated, jumps of heading removed, up to five steps added before the first.

    Args:
        batch: Scenarios with the logged tracks of all agents.
        catk_compat: True = round where the public code rounds, by the rules of `tokens.catk_compat`.
    """
    tracks = _fill_gaps(batch)
    if catk_compat:
        position, velocity, valid = catk_ops.fill_gaps_in_world(batch)
        tracks = CleanTracks(position, tracks.heading, velocity, valid)
    heading = _hold_jumping_headings(tracks.heading, tracks.valid)
    return _extend_backwards(replace(tracks, heading=heading), stepwise=catk_compat)


def _fill_gaps(batch: ScenarioBatch) -> CleanTracks:
    """Linear interpolation between the first and the last valid step, which makes all steps between valid."""
    # 1. Last valid step at or before each step, and first one at or after it [B, A, S].
    heading, valid = batch.heading, batch.valid
    steps = torch.arange(valid.shape[-1], device=valid.device).expand_as(valid)
    previous = torch.where(valid, steps, -1).cummax(-1).values
    following = torch.where(valid, steps, valid.shape[-1]).flip(-1).cummin(-1).values.flip(-1)
    is_inside = (previous >= 0) & (following < valid.shape[-1])
    previous, following = torch.where(is_inside, previous, 0), torch.where(is_inside, following, 0)
    # 2. Interpolation; `weight` is 0 at valid steps, where both neighbors are the step itself.
    weight = (steps - previous) / (following - previous).clamp(min=1)

    def blend(values: Tensor) -> Tensor:
        first, last = _take_steps(values, previous), _take_steps(values, following)
        blended = torch.where(is_inside[..., None], first + weight[..., None] * (last - first), 0.0)
        return torch.where(valid[..., None], values, blended)

    # 3. Headings turn the short way round.
    turn = wrap_angle(heading.gather(-1, following) - heading.gather(-1, previous))
    heading = torch.where(valid, heading, wrap_angle(heading.gather(-1, previous) + weight * turn))
    heading = torch.where(is_inside, heading, 0.0)
    return CleanTracks(blend(batch.position), heading, blend(batch.velocity), is_inside)


def _take_steps(values: Float[Tensor, "B A S c"], steps: Int64[Tensor, "B A S"]) -> Float[Tensor, "B A S c"]:
    return values.gather(-2, steps[..., None].expand(*steps.shape, values.shape[-1]))


def _hold_jumping_headings(heading: Float[Tensor, "B A S"], valid: Bool[Tensor, "B A S"]) -> Float[Tensor, "B A S"]:
    """Headings with jumps removed: after a jump of more than 1.5 rad between valid steps the earlier value stays."""
    # Sequential, because a value that was kept is compared with the next one.
    columns = list(heading.unbind(-1))
    for step in range(1, len(columns)):
        jumps = wrap_angle(columns[step] - columns[step - 1]).abs() > MAX_HEADING_STEP_RAD
        is_jump = jumps & valid[..., step] & valid[..., step - 1]
        columns[step] = torch.where(is_jump, columns[step - 1], columns[step])
    return torch.stack(columns, -1)


def _extend_backwards(tracks: CleanTracks, *, stepwise: bool) -> CleanTracks:
    """Each track extended backwards, at constant velocity, to a multiple of five steps, and at least to step 5.

    So every agent has the token that ends at the current step. `stepwise` subtracts steps in turn instead of a product,
    which rounds differently.
    """
    num_steps = tracks.valid.shape[-1]
    steps = torch.arange(num_steps, device=tracks.valid.device)
    first = torch.where(tracks.valid, steps, num_steps).amin(-1)  # [B, A]
    num_added = torch.where(first == CURRENT_STEP, STEPS_PER_TOKEN, first % STEPS_PER_TOKEN)
    lead = first[..., None] - steps  # [B, A, S], number of steps before the first one
    is_added = (lead > 0) & (lead <= num_added[..., None]) & (first < num_steps)[..., None]
    source = first.clamp(max=num_steps - 1)[..., None].expand_as(is_added)
    velocity = _take_steps(tracks.velocity, source)
    start = _take_steps(tracks.position, source)
    position = start - lead[..., None] * STEP_S * velocity
    if stepwise:
        position = catk_ops.step_back(start[..., 0, :], velocity[..., 0, :], lead)
    return CleanTracks(
        position=torch.where(is_added[..., None], position, tracks.position),
        heading=torch.where(is_added, tracks.heading.gather(-1, source), tracks.heading),
        velocity=torch.where(is_added[..., None], velocity, tracks.velocity),
        valid=tracks.valid | is_added,
    )


def class_boxes(object_type: Int64[Tensor, "..."]) -> tuple[Float[Tensor, "..."], Float[Tensor, "..."]]:
    """Length and width of the box of an agent's class, which tokens are matched with, m."""
    return box_of_class(class_of_type(object_type))


def tokenize_tracks(
    tracks: CleanTracks, object_type: Int64[Tensor, "B A"], vocabulary: Vocabulary, *, catk_compat: bool = False
) -> AgentTokens:
    """Rolling matching: at each step the token that ends nearest to the log, from the end of the token before.

    Args:
        tracks: Tracks without gaps, from `clean_tracks`.
        object_type: WOMD's object type of each agent, which decides on the class.
        vocabulary: Motion tokens of each class.
        catk_compat: True = round where the public code rounds, by the rules of `tokens.catk_compat`.
    """
    # 1. The pose rolls along with the matched tokens; where there is no token it restarts from the log.
    match = _match_placed if catk_compat else _match_in_local_frame
    class_id = class_of_type(object_type)
    position, heading = tracks.position[..., 0, :], tracks.heading[..., 0]
    columns: list[tuple[Tensor, Tensor, Tensor, Tensor]] = []
    for end in range(STEPS_PER_TOKEN, tracks.valid.shape[-1], STEPS_PER_TOKEN):
        valid = tracks.valid[..., end - STEPS_PER_TOKEN] & tracks.valid[..., end]
        logged_pose = tracks.position[..., end, :], tracks.heading[..., end]
        token_id, end_position, end_heading = match(logged_pose, (position, heading), class_id, valid, vocabulary)
        position = torch.where(valid[..., None], end_position, logged_pose[0])
        heading = torch.where(valid, end_heading, logged_pose[1])
        columns.append((token_id, position * valid[..., None], heading * valid, valid))
    # 2. Columns to tensors [B, A, K].
    token_id, position, heading, valid = (torch.stack(column, 2) for column in zip(*columns))
    token_ends = slice(STEPS_PER_TOKEN, None, STEPS_PER_TOKEN)
    logged_position, logged_heading = tracks.position[..., token_ends, :], tracks.heading[..., token_ends]
    # 3. Targets. The public code matches them separately, from the end of each token to the next logged pose.
    next_token_id = token_id.roll(-1, -1)
    if catk_compat:
        next_pose = logged_position.roll(-1, -2), logged_heading.roll(-1, -1)
        token_class = class_id[..., None].expand_as(valid)
        next_token_id = tokens_towards(next_pose, (position, heading), token_class, valid, vocabulary)
    logged_valid = tracks.valid[..., token_ends]
    return AgentTokens(token_id, position, heading, valid, logged_position, logged_heading, logged_valid, next_token_id)


def restart_at_log(tokens: AgentTokens, batch: ScenarioBatch, vocabulary: Vocabulary) -> AgentTokens:
    """History tokens of a simulation: agents whose last one ends off the log, by `MAX_START_ERROR_M`, start at the log.

    No token leads where these went: they back up, or are faster than every token. They get the logged poses and the
    token nearest to each motion between them, as agents with imposed states do. The others keep their bits.

    Args:
        tokens: Tokens of the batch's logged tracks, by the rules of the public code.
        batch: Scenarios whose logged headings count, jumps included, and not those that tokens follow.
        vocabulary: Motion tokens of each class.
    """
    history = AgentTokens(**{name: values[:, :, :HISTORY_TOKENS] for name, values in vars(tokens).items()})
    token_ends = slice(STEPS_PER_TOKEN, CURRENT_STEP + 1, STEPS_PER_TOKEN)
    position = history.logged_position
    heading = torch.where(batch.valid[..., token_ends], batch.heading[..., token_ends], history.logged_heading)
    size = class_boxes(batch.object_type)
    token_box = box_corners(history.position[..., -1, :], history.heading[..., -1], *size)
    error = (token_box - box_corners(position[..., -1, :], heading[..., -1], *size)).norm(dim=-1).mean(-1)
    restarts = history.valid & (error > MAX_START_ERROR_M)[..., None]  # [B, A, K]
    # the first token starts at the log anyway
    goal, start = (position[..., 1:, :], heading[..., 1:]), (position[..., :-1, :], heading[..., :-1])
    class_id = class_of_type(batch.object_type)[..., None].expand_as(goal[1])
    next_id = tokens_towards(goal, start, class_id, restarts[..., 1:], vocabulary)
    token_id = torch.cat([history.token_id[..., :1], next_id], -1)
    return replace(
        history,
        token_id=torch.where(restarts, token_id, history.token_id),
        position=torch.where(restarts[..., None], position, history.position),
        heading=torch.where(restarts, heading, history.heading),
    )


Pose = tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]


def tokens_towards(
    goal: Pose, pose: Pose, class_id: Int64[Tensor, "*batch"], valid: Bool[Tensor, "*batch"], vocabulary: Vocabulary
) -> Int64[Tensor, "*batch"]:
    """Token that ends nearest to a target pose: smallest sum of corner distances in the frame of the start pose.

    Args:
        goal: Target position (m) and heading (rad).
        pose: Position and heading at the start of the token, same frame.
        class_id: Class of each row, as an index into `CLASS_NAMES`.
        valid: True = the row is matched; the result is 0 elsewhere.
        vocabulary: Motion tokens of each class.
    """
    return nearest_tokens(local_boxes(goal, pose, class_id), class_id, valid, vocabulary)


def local_boxes(goal: Pose, pose: Pose, class_id: Int64[Tensor, "*batch"]) -> Float[Tensor, "*batch 4 2"]:
    """Corners of a class's box at a target pose, in the frame of the start pose.

    Args:
        goal: Position (m) and heading (rad) of the box.
        pose: Origin and direction of the frame of the result.
        class_id: Class of each row, as an index into `CLASS_NAMES`.
    """
    length, width = box_of_class(class_id)
    position = rotate(goal[0] - pose[0], -pose[1])
    return box_corners(position, wrap_angle(goal[1] - pose[1]), length, width)


def _match_in_local_frame(
    logged: Pose, pose: Pose, class_id: Int64[Tensor, "B A"], valid: Bool[Tensor, "B A"], vocabulary: Vocabulary
) -> tuple[Int64[Tensor, "B A"], Float[Tensor, "B A 2"], Float[Tensor, "B A"]]:
    """Token that ends nearest to the logged pose, and the pose at the token's end."""
    length, width = box_of_class(class_id)
    target = box_corners(*logged, length, width)
    local = rotate(target - pose[0][..., None, :], -pose[1][..., None])
    token_id = nearest_tokens(local, class_id, valid, vocabulary)
    return token_id, *place_pose(vocabulary, class_id, token_id, *pose)


def _match_placed(
    logged: Pose, pose: Pose, class_id: Int64[Tensor, "B A"], valid: Bool[Tensor, "B A"], vocabulary: Vocabulary
) -> tuple[Int64[Tensor, "B A"], Float[Tensor, "B A 2"], Float[Tensor, "B A"]]:
    """As `_match_in_local_frame`, in the public code's order of operations."""
    length, width = box_of_class(class_id)
    target = catk_ops.build_boxes(*logged, length, width)
    token_id = catk_ops.nearest_placed_tokens(target, *pose, class_id, valid, vocabulary)
    corners = vocabulary.end_corners()[class_id, token_id]
    return token_id, *pose_of_corners(catk_ops.place_boxes(corners[..., None, :, :], *pose)[..., 0, :, :])


def nearest_tokens(
    local_corners: Float[Tensor, "*batch 4 2"],
    class_id: Int64[Tensor, "*batch"],
    valid: Bool[Tensor, "*batch"],
    vocabulary: Vocabulary,
) -> Int64[Tensor, "*batch"]:
    """Token with the smallest sum of corner distances between end box and a box; lowest index on ties.

    Args:
        local_corners: Corners of the boxes to match, in the frame of the token's start, m.
        class_id: Class of each row, as an index into `CLASS_NAMES`.
        valid: True = the row is matched; the result is 0 elsewhere.
        vocabulary: Motion tokens of each class.
    """
    if class_id.device.type != "cpu":
        # All tokens of each row's class are compared: to select rows, the host would wait for their number.
        boxes = local_corners.reshape(-1, 4, 2).split(_ROWS_PER_CHUNK_ELSEWHERE)
        classes = class_id.flatten().split(_ROWS_PER_CHUNK_ELSEWHERE)
        tokens = [_find_nearest_tokens(*chunk, vocabulary=vocabulary) for chunk in zip(boxes, classes)]
        return torch.cat(tokens).view_as(class_id) * valid
    token_id = torch.zeros_like(class_id)
    # Classes may have different numbers of tokens: rows are found among those that exist, then mapped to token ids.
    for index, (table, exists) in enumerate(zip(vocabulary.end_corners(), vocabulary.token_mask)):
        rows = ((class_id == index) & valid).nonzero(as_tuple=True)
        token_id[rows] = exists.nonzero()[:, 0][nearest_rows(local_corners[rows], table[exists])]
    return token_id


def _find_nearest_tokens(
    boxes: Float[Tensor, "n 4 2"], class_id: Int64[Tensor, "n"], vocabulary: Vocabulary
) -> Int64[Tensor, "n"]:
    """As `nearest_tokens`, with a row of the tables of all tokens for each box."""
    distance = corner_distances(boxes, vocabulary.end_corners()[class_id])
    return distance.masked_fill(~vocabulary.token_mask[class_id], torch.inf).argmin(-1)


def nearest_rows(boxes: Float[Tensor, "n 4 2"], table: Float[Tensor, "V 4 2"]) -> Int64[Tensor, "n"]:
    """Row of a table with the smallest sum of corner distances to each box; the lowest on ties.

    Args:
        boxes: Corners of the boxes to match, m.
        table: Corners of the candidate boxes, in the same frame, m.
    """
    # In chunks, so that the [n, V] tables of distances stay small.
    return torch.cat([_find_nearest_rows(chunk, table) for chunk in boxes.split(_ROWS_PER_CHUNK)])


def _find_nearest_rows(boxes: Float[Tensor, "n 4 2"], table: Float[Tensor, "V 4 2"]) -> Int64[Tensor, "n"]:
    """Nearest rows, found by way of the nearest centers; exact.

    The distances of the four corners sum to at least four times that of the centers, so only rows with a near center
    win.
    """
    if len(table) <= 2 * _CANDIDATES:
        return corner_distances(boxes, table).argmin(-1)
    center_distance = torch.cdist(boxes.mean(1), table.mean(1), compute_mode="donot_use_mm_for_euclid_dist")
    nearest_centers = center_distance.topk(_CANDIDATES, dim=-1, largest=False, sorted=False)
    candidates = nearest_centers.indices.sort(-1).values
    best_rows = corner_distances(boxes, table[candidates]).min(-1)
    nearest = candidates.gather(-1, best_rows.indices[:, None])[:, 0]
    # Rows beyond the candidates could still win, or tie within rounding: compare all.
    is_unsure = 4 * nearest_centers.values.amax(-1) <= best_rows.values * 1.0001 + 1e-4
    nearest[is_unsure] = corner_distances(boxes[is_unsure], table).argmin(-1)
    return nearest


def corner_distances(boxes: Float[Tensor, "n 4 2"], table: Float[Tensor, "*n V 4 2"]) -> Float[Tensor, "n V"]:
    """Sum of the distances of the four corners, for each pair of boxes, m.

    Args:
        boxes: Corners of n boxes, m.
        table: Corners of V boxes in the same frame, m: the same V boxes for all of the n, or V for each.
    """
    # One corner at a time: [n, V] instead of [n, V, 4, 2] in memory.
    total = sum(square_norm(boxes[:, None, c] - table[..., c, :]).sqrt() for c in range(4))
    return torch.as_tensor(total)


def place_pose(
    vocabulary: Vocabulary,
    class_id: Int64[Tensor, "*batch"],
    token_id: Int64[Tensor, "*batch"],
    position: Float[Tensor, "*batch 2"],
    heading: Float[Tensor, "*batch"],
) -> tuple[Float[Tensor, "*batch 2"], Float[Tensor, "*batch"]]:
    """Pose at the end of a token.

    Args:
        vocabulary: Motion tokens of each class.
        class_id: Class of each row, as an index into `CLASS_NAMES`.
        token_id: Index of the token in the class.
        position: Position at the start of the token, m.
        heading: Heading at the start of the token, rad.
    """
    local_position, local_heading = pose_of_corners(vocabulary.end_corners()[class_id, token_id])
    return position + rotate(local_position, heading), wrap_angle(heading + local_heading)


def tokenize_agents(batch: ScenarioBatch, vocabulary: Vocabulary, *, catk_compat: bool = False) -> AgentTokens:
    """Tokens of a batch's logged tracks, computed once per scenario and cached while the scenario is in memory.

    Args:
        batch: Batch of which only the scenarios and the frame are read.
        vocabulary: Motion tokens of each class.
        catk_compat: True = round where the public code rounds, by the rules of `tokens.catk_compat`.
    """
    rows = [_tokenize_scenario(scenario, vocabulary, batch.frame, catk_compat) for scenario in batch.scenarios]
    num_agents = batch.agent_mask.shape[1]
    num_tokens = max(row.valid.shape[-1] for row in rows)

    def pad(name: str) -> Tensor:
        """A field of all scenarios, padded to the batch's agents and to the longest scenario's tokens."""
        columns = [getattr(row, name)[0] for row in rows]
        padded = columns[0].new_zeros(len(columns), num_agents, num_tokens, *columns[0].shape[2:])
        for target, column in zip(padded, columns):
            target[: column.shape[0], : column.shape[1]] = column
        return padded.to(batch.device)

    return AgentTokens(**{name: pad(name) for name in AgentTokens.__dataclass_fields__})


@cached_on_scenario
def _tokenize_scenario(scenario: Scenario, vocabulary: Vocabulary, frame: Frame, catk_compat: bool) -> AgentTokens:
    """Tokens of a scenario on the CPU, cached with the scenario."""
    batch = collate([scenario], frame=frame)
    tracks = clean_tracks(batch, catk_compat=catk_compat)
    return tokenize_tracks(tracks, batch.object_type, vocabulary.to("cpu"), catk_compat=catk_compat)

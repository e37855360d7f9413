"""The network of a compact policy: the last tokens of an agent, the nearest map tokens and agents, and a small head.

There is no attention and no memory. Neighbors go through two layers and a maximum, as in PointNet; of the past an agent
knows the last two tokens. Map tokens are the nearest to points ahead, which lie farther off at higher speed, and the
nearest with a light. Rows with the pose and tokens of the first rollout, such as parked cars, share the map's features.

B scenarios, M simulations (rollouts, or rollouts times decisions), A agents, P map tokens, R rows (agents of a
simulation), K neighbors, C classes, V motion tokens, D width of a neighbor, H width of a row, E of a neighborhood.
"""

from dataclasses import dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from rlftsim.geometry import heading_vector, rotate, square_norm
from rlftsim.policies.distributions import NEVER
from rlftsim.policies.smart.config import CompactConfig
from rlftsim.policies.smart.embeddings import ContinuationScores, initialize
from rlftsim.policies.smart.neighbors import Poses
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import STEP_S
from rlftsim.tokens.map_tokens import NUM_FAMILIES, NUM_LIGHTS, NUM_TYPES, MapTokens, tokenize_lights, tokenize_map
from rlftsim.tokens.vocabulary import CLASS_NAMES, PADDING_CLASS, STEPS_PER_TOKEN, Vocabulary, class_of_type

MAP_POINTS = ((0.0, 0.0), (1.5, 3.0), (3.5, 8.0))
"""Points along the heading whose nearest map tokens are seen: seconds at the present speed, and meters."""
LIGHT_POINT = 1
"""Index of the map point whose nearest tokens with a light are seen."""
ANTICIPATION_S = 1.0
"""Agents are the nearest to the place that is reached after so long."""
FAR_M, NEAR_M, CLOSE_M, SMALL_RAD, FAST_MPS = 20.0, 4.0, 1.0, 0.2, 10.0
"""Units of distances, angles and speeds. Numbers in a finer unit end at 1: there the coarser unit says enough."""
CELL_M, NUM_CANDIDATES = 6.0, 48
"""Side of a cell of the map, and the tokens nearest to the middle among which those nearest to a point are."""
MAX_CELLS, CELLS_PER_BLOCK = 1024, 1024
"""Most cells along an axis, which maps of 6 km have, and cells whose distances are computed together."""
NUM_RELATIONS = 15
"""Numbers of a relation to a neighbor, without velocity."""


@dataclass(frozen=True, eq=False)
class Steps:
    """Agents before a decision, map frame."""

    position: Float[Tensor, "B M A 2"]
    heading: Float[Tensor, "B M A"]
    last: Int64[Tensor, "B M A"]
    """Last token."""
    previous: Int64[Tensor, "B M A"]
    """Token before the last; V = none."""


@dataclass(frozen=True, eq=False)
class TokenGrid:
    """Map tokens near each cell of a grid, among which the nearest to a point are looked for."""

    position: Float[Tensor, "BP 2"]
    candidates: Int64[Tensor, "cells c"]
    """Rows of `position`, the nearest to the middle of each cell of each scenario."""
    corner: Float[Tensor, "B 2"]
    """Least coordinates of the grid."""
    size: tuple[int, int]
    """Cells along x and y."""
    radius_m: float

    @classmethod
    def build(cls, position: Float[Tensor, "B P 2"], mask: Bool[Tensor, "B P"], radius_m: float) -> "TokenGrid":
        """Grid of the tokens of a mask.

        Args:
            position: Positions of all map tokens, meters.
            mask: True = the token can be found.
            radius_m: Distance within which tokens are found, meters.
        """
        inside = position.masked_fill(~mask[..., None], torch.inf)
        corner = inside.amin(1).nan_to_num(posinf=0.0) - radius_m  # [B, 2]
        extent = position.masked_fill(~mask[..., None], -torch.inf).amax(1).nan_to_num(neginf=0.0) - corner + radius_m
        size = [min(int(side) + 1, MAX_CELLS) for side in (extent.amax(0) / CELL_M).tolist()]
        middle = torch.cartesian_prod(*(torch.arange(float(count), device=position.device) for count in size))
        middle = (middle + 0.5) * CELL_M
        nearest = []
        for offset, tokens, start in zip(corner, inside, range(0, mask.numel(), mask.shape[1])):
            cells = (middle + offset).split(CELLS_PER_BLOCK)
            squared = ((tokens[:, 0] - c[:, :1]).square_().add_((tokens[:, 1] - c[:, 1:]).square_()) for c in cells)
            count = min(NUM_CANDIDATES, mask.shape[1])
            nearest += [block.topk(count, largest=False, sorted=False).indices + start for block in squared]
        return cls(inside.flatten(0, 1), torch.cat(nearest), corner, (size[0], size[1]), radius_m)

    def find_nearest(
        self, points: Float[Tensor, "R n 2"], scenario: Int64[Tensor, "R"], limit: int
    ) -> tuple[Int64[Tensor, "K R"], Bool[Tensor, "K R"]]:
        """The tokens nearest to each of n points, a list behind the other, and True for those within the radius.

        Args:
            points: Points of each row, map frame, meters.
            scenario: Scenario of each row.
            limit: Number of tokens of a list, less where there are not so many candidates in a cell.
        """
        size = torch.tensor(self.size, device=points.device)
        cell = ((points - self.corner[scenario][:, None]) / CELL_M).long()
        cell = torch.minimum(cell.clamp(min=0), size - 1)  # outside of the grid nothing is within the radius
        cell = (scenario[:, None] * size[0] + cell[..., 0]) * size[1] + cell[..., 1]
        candidates = self.candidates.index_select(0, cell.flatten())  # [R n, c]
        squared = square_norm(functional.embedding(candidates, self.position) - points.flatten(0, 1)[:, None])
        squared, column = squared.topk(min(limit, candidates.shape[1]), largest=False, sorted=False)
        index, mask = candidates.gather(1, column), squared < self.radius_m**2
        return index.view(len(points), -1).mT.contiguous(), mask.view(len(points), -1).mT.contiguous()


@dataclass(frozen=True, eq=False)
class Scene:
    """Features of map tokens and agents, and tables of motion tokens: all that no motion of an agent changes."""

    tokens: MapTokens
    class_id: Int64[Tensor, "B A"]
    """Class of each agent, `PADDING_CLASS` = no agent."""
    grid: TokenGrid
    """Of all map tokens."""
    lights: TokenGrid | None
    """Of the map tokens with a traffic light; None = there are none."""
    map_sources: Float[Tensor, "BP D"]
    agent_sources: Float[Tensor, "BA D"]
    agents: Float[Tensor, "B A H"]
    """Features of class and size."""
    last: Float[Tensor, "C V H"]
    previous: Float[Tensor, "C V1 H"]
    """Features of the last two tokens; the last row is that of no token."""
    speed: Float[Tensor, "C V"]
    """Mean speed along the heading, m/s."""
    turns: Float[Tensor, "C V F 2"]
    """Cosine and sine of the phase that a query is turned by, see `ContinuationScores`."""
    head: Float[Tensor, "C V _"]
    """Weights of the head and keys of the tokens."""
    offset: Float[Tensor, "C V"]
    """Bias of the head; `NEVER` for tokens that do not exist."""


class Pool(nn.Module):
    """Features of a neighborhood: the maximum over neighbors, zeros without any."""

    def __init__(self, num_inputs: int, dim: int, hidden: int):
        super().__init__()
        self.relation = nn.Linear(num_inputs, dim)
        self.row = nn.Linear(hidden, dim, bias=False)
        self.out = nn.Linear(dim, dim + dim // 2)

    def forward(
        self, relation: Float[Tensor, "K R _"], source: Float[Tensor, "K R D"], row: Float[Tensor, "R H"], mask: Tensor
    ) -> Float[Tensor, "R E"]:
        """Features of the neighborhood of each row.

        Args:
            relation: Numbers of the relation to each neighbor, see `relate`, about 1 in size.
            source: Features of each neighbor, which do not depend on the row that looks at the neighbor.
            row: Features of the row, such as the last motion, which decide what matters around.
            mask: True = the entry, of [K, R], is a neighbor, False = padding.
        """
        x = torch.relu(self.relation(relation) + source + self.row(row))
        # the first axis, whose maximum takes a seventh of the time of the second one's
        return (torch.relu(self.out(x)) * mask[..., None]).amax(0)


class CompactNetwork(nn.Module):
    """Logits of the next token of every agent."""

    def __init__(self, config: CompactConfig, num_tokens: int):
        super().__init__()
        self.config = config
        dim, hidden = config.dim, config.hidden
        self.scores = ContinuationScores(hidden)
        num_inputs, width = 3 + 2 * len(self.scores.frequency), hidden + 2 * (dim + dim // 2)
        self.last_token = nn.Linear(num_inputs, hidden)
        self.previous_token = nn.Linear(num_inputs, hidden, bias=False)
        self.agent = nn.Linear(3 + len(CLASS_NAMES), hidden, bias=False)
        self.agent_source = nn.Linear(3 + len(CLASS_NAMES), dim, bias=False)
        self.map_source = nn.Linear(2 + NUM_TYPES + NUM_FAMILIES + NUM_LIGHTS, dim, bias=False)
        self.map_pool = Pool(NUM_RELATIONS, dim, hidden)
        self.agent_pool = Pool(NUM_RELATIONS + 3, dim, hidden)
        self.trunk = nn.Sequential(
            nn.Linear(width, width // 2 + 16), nn.LayerNorm(width // 2 + 16), nn.ReLU(),
            nn.Linear(width // 2 + 16, hidden), nn.ReLU(),
        )  # fmt: skip
        self.bottleneck = nn.Linear(hidden, hidden // 2)
        self.head = nn.Linear(hidden // 2, num_tokens)
        initialize(self, "normal")

    # ---- once per scenario ------------------------------------------------------------------------------------------

    def build_scene(self, scenarios: ScenarioBatch, vocabulary: Vocabulary, like: Scene | None = None) -> Scene:
        """Features of map tokens and agents, and tables of the motion tokens.

        Args:
            scenarios: Scenarios with maps and agents, map frame.
            vocabulary: Motion tokens of the agents, and prototypes of map tokens.
            like: Scene of the same scenarios by other weights, whose map tokens and grids are taken over; None = new.
        """
        tokens = tokenize_map(scenarios, vocabulary.map_prototypes) if like is None else like.tokens
        class_id = class_of_type(scenarios.object_type)
        one_hot = functional.one_hot(class_id, len(CLASS_NAMES)).to(scenarios.size.dtype)
        agents = torch.cat([scenarios.size / NEAR_M, one_hot], -1)
        ends = vocabulary.poses[:, :, -1]
        keys = self.scores.keys(ends)
        by_class = keys.keys.unflatten(1, (len(CLASS_NAMES), -1)).transpose(0, 1)  # [C, V, 2 F]
        motion = torch.cat([ends / NEAR_M, by_class], -1)
        return Scene(
            tokens=tokens,
            class_id=torch.where(scenarios.agent_mask, class_id, PADDING_CLASS),
            grid=TokenGrid.build(tokens.position, tokens.token_mask, self.config.map_radius_m)
            if like is None
            else like.grid,
            lights=self._find_lights(tokens) if like is None else like.lights,
            map_sources=self._embed_map(tokens, vocabulary),
            agent_sources=self.agent_source(agents).flatten(0, 1),
            agents=self.agent(agents),
            last=self.last_token(motion),
            previous=functional.pad(self.previous_token(motion), (0, 0, 0, 1)),
            speed=ends[..., 0] / (STEPS_PER_TOKEN * STEP_S),
            turns=torch.stack([keys.last_phase.cos(), keys.last_phase.sin()], -1),
            head=torch.cat([self.head.weight.expand(len(CLASS_NAMES), -1, -1), by_class], -1),
            offset=self.head.bias.masked_fill(~vocabulary.token_mask, NEVER),
        )

    def relight(self, scene: Scene, scenarios: ScenarioBatch, vocabulary: Vocabulary) -> Scene:
        """The scene with other traffic lights.

        Args:
            scene: Scene of the same maps.
            scenarios: Scenarios of the scene, with the step of the lights.
            vocabulary: Prototypes of map tokens.
        """
        light = tokenize_lights(scenarios, vocabulary.map_prototypes.shape[1])
        if torch.equal(light, scene.tokens.light):
            return scene
        tokens = replace(scene.tokens, light=light)
        sources = self._embed_map(tokens, vocabulary)
        return replace(scene, tokens=tokens, lights=self._find_lights(tokens), map_sources=sources)

    def _find_lights(self, tokens: MapTokens) -> TokenGrid | None:
        has_light = tokens.light > 0
        return TokenGrid.build(tokens.position, has_light, self.config.map_radius_m) if has_light.any() else None

    def _embed_map(self, tokens: MapTokens, vocabulary: Vocabulary) -> Float[Tensor, "BP D"]:
        ends = vocabulary.map_prototypes[:, -1][tokens.token_id] / NEAR_M  # [B, P, 2]
        labels = ((tokens.type, NUM_TYPES), (tokens.family, NUM_FAMILIES), (tokens.light, NUM_LIGHTS))
        one_hot = [functional.one_hot(values, count).to(ends.dtype) for values, count in labels]
        return self.map_source(torch.cat([ends, *one_hot], -1)).flatten(0, 1)

    # ---- at every decision ------------------------------------------------------------------------------------------

    def forward(self, scene: Scene, steps: Steps) -> Float[Tensor, "R V"]:
        """Logits of the agents that are no padding, agent after agent, simulation after simulation.

        Args:
            scene: Result of `build_scene` for the scenarios of the agents, in the same frame.
            steps: Agents before the decision, in any number of simulations of each scenario.
        """
        mask = (scene.class_id != PADDING_CLASS)[:, None].expand(steps.heading.shape)
        rows = scenario, _, agent = mask.nonzero(as_tuple=True)
        class_id, last = scene.class_id[scenario, agent], steps.last[rows]
        x = scene.last[class_id, last] + scene.previous[class_id, steps.previous[rows]] + scene.agents[scenario, agent]
        x, speed, poses = torch.relu(x), scene.speed[class_id, last], Poses(steps.position, steps.heading)[rows]
        # 1. the map, of the rows that differ from those of the first simulation
        values = (steps.position.movedim(-1, 0), steps.heading[None], steps.last[None], steps.previous[None])
        is_shared = torch.stack([(value == value[:, :, :1]).all(0) for value in values]).all(0)  # [B, M, A]
        is_read = ~is_shared
        is_read[:, 0] = True
        is_read &= mask
        source = is_read.flatten().cumsum(0).view(mask.shape) - 1
        source = torch.where(is_shared, source[:, :1], source)[rows]
        read = is_read[rows].nonzero()[:, 0]
        map_features = self._read_map(scene, scenario[read], poses[read], speed[read], x[read]).index_select(0, source)
        # 2. the other agents, and the head
        agent_features = self._read_agents(scene, steps, rows, poses, speed, x)
        return self._score_tokens(scene, self.trunk(torch.cat([x, map_features, agent_features], -1)), class_id, last)

    def _read_map(
        self, scene: Scene, scenario: Int64[Tensor, "R"], poses: Poses, speed: Float[Tensor, "R"], x: Tensor
    ) -> Float[Tensor, "R E"]:
        """Features of the nearest map tokens of rows with features x [R, H]."""
        direction = heading_vector(poses.heading)
        points = [poses.position + direction * (speed * seconds + meters)[:, None] for seconds, meters in MAP_POINTS]
        lists = [scene.grid.find_nearest(torch.stack(points, 1), scenario, self.config.max_map_neighbors)]
        if scene.lights is not None:
            lists.append(scene.lights.find_nearest(points[LIGHT_POINT][:, None], scenario, self.config.max_lights))
        index, mask = (torch.cat(parts) for parts in zip(*lists))
        neighbors = Poses(scene.tokens.position.flatten(0, 1), scene.tokens.heading.flatten())[index]
        return self.map_pool(relate(poses, neighbors)[0], functional.embedding(index, scene.map_sources), x, mask)

    def _read_agents(
        self, scene: Scene, steps: Steps, rows: tuple[Tensor, ...], poses: Poses, speed: Float[Tensor, "R"], x: Tensor
    ) -> Float[Tensor, "R E"]:
        """Features of the nearest agents of rows with features x [R, H]."""
        num_simulations, num_agents = steps.heading.shape[1:]
        is_padding = scene.class_id == PADDING_CLASS
        # 1. the nearest agents to the place that each row is about to reach
        class_id = scene.class_id.clamp(max=PADDING_CLASS - 1)
        speeds = scene.speed[class_id[:, None], steps.last]  # [B, M, A]
        centers = steps.position + heading_vector(steps.heading) * (speeds * ANTICIPATION_S)[..., None]
        squared = square_norm(steps.position[:, :, None] - centers[:, :, :, None])  # [B, M, A, A]
        is_self = torch.eye(num_agents, dtype=torch.bool, device=speed.device)
        squared = squared.masked_fill(is_padding[:, None, None] | is_self, torch.inf)[rows]
        limit = min(self.config.max_agent_neighbors, num_agents)
        squared, neighbor = (values.mT for values in squared.topk(limit, largest=False, sorted=False))  # [K, R]
        # 2. relations, with both velocities
        scenario, simulation, _ = rows
        index = neighbor + (scenario * num_simulations + simulation) * num_agents
        relation, direction = relate(poses, Poses(steps.position.flatten(0, 2), steps.heading.flatten())[index])
        velocity = direction * speeds.flatten()[index][..., None] / FAST_MPS
        row_speed = (speed / FAST_MPS)[:, None].expand(len(index), -1, 1)
        source = functional.embedding(neighbor + scenario * num_agents, scene.agent_sources)
        mask = squared < self.config.agent_radius_m**2
        return self.agent_pool(torch.cat([relation, velocity, row_speed], -1), source, x, mask)

    def _score_tokens(
        self, scene: Scene, hidden: Float[Tensor, "R H"], class_id: Int64[Tensor, "R"], last: Int64[Tensor, "R"]
    ) -> Float[Tensor, "R V"]:
        """Logits, with scores of the tokens by how these continue the last one."""
        a, b = self.scores.query(hidden).chunk(2, -1)  # [R, F]
        cos, sin = scene.turns[class_id, last].unbind(-1)
        hidden = torch.cat([self.bottleneck(hidden), a * cos - b * sin, a * sin + b * cos], -1)
        logits = hidden.new_empty(len(hidden), scene.offset.shape[1])
        for index, (weight, offset) in enumerate(zip(scene.head, scene.offset)):
            rows = (class_id == index).nonzero()[:, 0]
            if len(rows) == len(logits):
                return torch.addmm(offset, hidden, weight.mT)
            logits = logits.index_copy_(0, rows, torch.addmm(offset, hidden.index_select(0, rows), weight.mT))
        return logits


def relate(row: Poses, neighbor: Poses) -> tuple[Float[Tensor, "K R n"], Float[Tensor, "K R 2"]]:
    """Numbers of a relation, about 1 in size, and the neighbor's direction in the row's frame.

    Args:
        row: Poses [R] of the rows, meters and radians, map frame.
        neighbor: Poses [K, R] of the neighbors, in the same frame.
    """
    offset = rotate(neighbor.position - row.position, -row.heading)
    direction = heading_vector(neighbor.heading - row.heading)
    (x, y), (cos, sin) = offset.unbind(-1), direction.unbind(-1)
    # where the neighbor is for the row, and where the row is for the neighbor
    numbers = torch.stack([x, y, -x * cos - y * sin, x * sin - y * cos], -1)
    scaled = [numbers / FAR_M, *((numbers / unit).clamp(-1, 1) for unit in (NEAR_M, CLOSE_M))]
    return torch.cat([*scaled, direction, (sin / SMALL_RAD).clamp(-1, 1)[..., None]], -1), direction

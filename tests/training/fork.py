"""A toy: one agent, a road that forks, two logged futures of the same history, one for each branch."""

from dataclasses import replace
from functools import cache

import numpy as np
import torch
from torch.nn.functional import cross_entropy

import scenes
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import CURRENT_STEP, STEP_S, TOTAL_STEPS, MapFeatureType
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary

SPEED_MPS = 6.0
STRAIGHT_M, BEND_M, ANGLE_RAD = 8.0, 24.0, 0.6
"""The branches begin so far ahead, turn over so many metres by this angle to the left or right, and go straight on."""
MODEL = SmartConfig(
    dim=24, num_heads=2, head_dim=12, num_map_layers=1, num_decoder_layers=1, num_frequencies=6, history_tokens=3,
    max_map_neighbors=4, max_agent_map_neighbors=8, dropout=0.0, history_drop=0.0,
)  # fmt: skip


def path(side, way_m):
    """Position relative to the ego at the current step, and heading, after so many metres."""
    dense = np.arange(-20.0, 80.0, 0.05)
    heading = side * ANGLE_RAD * ((dense - STRAIGHT_M) / BEND_M).clip(0, 1)
    steps = np.stack([np.cos(heading), np.sin(heading)], -1) * 0.05
    points = steps.cumsum(0) - steps.cumsum(0)[dense.searchsorted(0.0)]
    return np.stack([np.interp(way_m, dense, column) for column in points.T], -1), np.interp(way_m, dense, heading)


def scenario(side):
    """The agent takes the left (1) or the right (-1) branch."""
    kind, ways = MapFeatureType, np.arange(-15.0, 75.0)
    lanes = [(kind.LANE_SURFACE_STREET, path(s, ways)[0].tolist()) for s in (1, -1)]
    normals = [np.stack([-np.sin(h), np.cos(h)], -1) for h in (path(s, ways)[1] for s in (1, -1))]
    edges = [(kind.EDGE_BOUNDARY, (path(s, ways)[0] + s * 3.0 * n).tolist()) for s, n in zip((1, -1), normals)]
    lone = scenes.build_scenario("left" if side > 0 else "right", scenes.TRAFFIC[:1], scenes.polylines(lanes + edges))
    position, heading = path(side, SPEED_MPS * (np.arange(TOTAL_STEPS) - CURRENT_STEP) * STEP_S)
    tracks = lone.tracks
    moved = tracks.position.copy()
    moved[0, :, :2] = position + scenes.EGO_POSITION_M
    velocity = SPEED_MPS * np.stack([np.cos(heading), np.sin(heading)], -1)
    fields = {"position": moved, "heading": heading[None], "velocity": velocity[None]}
    return replace(lone, tracks=replace(tracks, **{k: v.astype(np.float32) for k, v in fields.items()}))


@cache
def fork():
    """Both scenarios, and a policy that takes either branch."""
    both = [scenario(1), scenario(-1)]
    vocabulary = build_vocabulary(both, TokensConfig(num_tokens=32, num_map_prototypes=16))[0]
    torch.manual_seed(0)
    policy, batch = SmartPolicy(MODEL, vocabulary), collate(both)
    optimizer = torch.optim.AdamW(policy.parameters(), lr=3e-3)
    for _ in range(120):
        dist = policy.teacher_forced(batch, batch.agent_mask)
        loss = cross_entropy(dist.logits[dist.target_mask], dist.target[dist.target_mask])
        optimizer.zero_grad()
        loss.backward()
        optimizer.step()
    return both, policy.eval()

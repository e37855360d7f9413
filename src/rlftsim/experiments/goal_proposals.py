"""Goals proposed from the map and the log. On a map with road edges none is off the road."""

from functools import partial

import numpy as np
import torch
from jaxtyping import Float

from rlftsim.goals.goals_file import GoalEntry
from rlftsim.goals.proposals import Proposal, RoadTest, logged_maneuver, propose_from_lanes
from rlftsim.realism.agents import Trajectories
from rlftsim.realism.map_based import RoadEdges, build_road_edges, compute_distance_to_road_edge
from rlftsim.scenario.maneuver import BENCHMARK_MANEUVERS
from rlftsim.scenario.types import Scenario, cached_on_scenario

MAX_PAIRS = 1 << 17
LOGGED = " (logged)"
"""Ending of the label of the logged maneuver."""


@cached_on_scenario
def _road_edges(scenario: Scenario) -> RoadEdges | None:
    return build_road_edges(scenario.map_features, torch.device("cpu"))


def road_test(scenario: Scenario) -> RoadTest | None:
    """The metric's own distance to the road edge as a test of goals; None for a map without road edges."""
    edges = _road_edges(scenario)
    return None if edges is None else partial(_outside_m, edges)


def _outside_m(
    edges: RoadEdges, path: Float[np.ndarray, "S 3"], heading: Float[np.ndarray, "S"], size: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "S"]:
    x, y, z = torch.from_numpy(path).float().T  # each [S]
    # the metric takes the center of the box, lanes lie on the ground
    z = z + float(size[2]) / 2
    angle = torch.from_numpy(heading).float()
    states = Trajectories(*(v[None, None] for v in (x, y, z, angle)))  # one rollout, one agent: [1, 1, S]
    box = torch.from_numpy(size).float()[None]
    return compute_distance_to_road_edge(states, box[:, None], edges, max_pairs=MAX_PAIRS)[0, 0].numpy()


def propose(scenario: Scenario, track: int) -> tuple[Proposal, ...]:
    """Proposals for an agent in the order of the maneuvers: the logged maneuver, and alternatives along lanes.

    Args:
        scenario: Scenario of the agent; without a logged future there is no logged maneuver.
        track: Row of the agent in `scenario.tracks`.
    """
    logged = logged_maneuver(scenario, track)
    from_lanes = propose_from_lanes(scenario, track, road_test(scenario))
    if logged is None:
        return from_lanes
    proposals = {proposal.maneuver: proposal for proposal in from_lanes} | {logged.maneuver: logged}
    return tuple(sorted(proposals.values(), key=lambda proposal: BENCHMARK_MANEUVERS.index(proposal.maneuver)))


def to_goal_entry(scenario: Scenario, proposal: Proposal) -> GoalEntry:
    """Entry of a goals file for a proposal, labeled with the maneuver.

    Args:
        scenario: Scenario of the agent, whose id the entry has.
        proposal: Proposal for an agent of the scenario; the end of the path becomes the goal.
    """
    x, y = proposal.position
    return GoalEntry(scenario.scenario_id, proposal.object_id, float(x), float(y), format_label(proposal))


def format_label(proposal: Proposal) -> str:
    """Label of a proposal: its maneuver, with an ending for the logged one."""
    return f"{proposal.maneuver.value}{LOGGED if proposal.is_logged else ''}"


def split_label(label: str) -> tuple[str, bool]:
    """Maneuver that a label names, and True for the logged maneuver."""
    return label.removesuffix(LOGGED), label.endswith(LOGGED)

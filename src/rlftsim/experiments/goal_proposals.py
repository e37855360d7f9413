"""Goals that a map and the record propose; those of a map that has road edges are never off the road."""

from functools import partial

import numpy as np
import torch
from jaxtyping import Float

from rlftsim.goals.goals_file import GoalEntry
from rlftsim.goals.manoeuvre import Manoeuvre
from rlftsim.goals.proposals import Proposal, RoadTest, propose_from_lanes
from rlftsim.goals.recorded_manoeuvre import recorded_manoeuvre
from rlftsim.realism.agents import Trajectories
from rlftsim.realism.map_based import RoadEdges, build_road_edges, compute_distance_to_road_edge
from rlftsim.scenario.derived import derived
from rlftsim.scenario.types import Scenario

MAX_PAIRS = 1 << 17
RECORDED = " (recorded)"
"""Said behind the label of what the record shows."""


@derived
def _road_edges(scenario: Scenario) -> RoadEdges | None:
    return build_road_edges(scenario.map_features, torch.device("cpu"))


def road_test(scenario: Scenario) -> RoadTest | None:
    """The metric's own test of being on the road; None for a map without road edges."""
    edges = _road_edges(scenario)
    return None if edges is None else partial(_outside_m, edges)


def _outside_m(
    edges: RoadEdges, way: Float[np.ndarray, "S 3"], heading: Float[np.ndarray, "S"], size: Float[np.ndarray, "3"]
) -> Float[np.ndarray, "S"]:
    x, y, z = torch.from_numpy(way).float().T
    z = z + float(size[2]) / 2
    angle = torch.from_numpy(heading).float()
    states = Trajectories(*(v[None, None] for v in (x, y, z, angle)))
    box = torch.from_numpy(size).float()[None]
    return compute_distance_to_road_edge(states, box, edges, max_pairs=MAX_PAIRS)[0, 0].numpy()


def propose(scenario: Scenario, track: int) -> tuple[Proposal, ...]:
    """What an agent may do, in the order of the manoeuvres: the recorded one with its recorded end, the others read off the lanes."""
    recorded = recorded_manoeuvre(scenario, track)
    others = propose_from_lanes(scenario, track, road_test(scenario))
    if recorded is None:
        return others
    order = tuple(Manoeuvre)
    kept = [proposal for proposal in others if proposal.manoeuvre != recorded.manoeuvre]
    return tuple(sorted([*kept, recorded], key=lambda proposal: order.index(proposal.manoeuvre)))


def entry_of(scenario: Scenario, proposal: Proposal) -> GoalEntry:
    """A proposal as a line of a goals file."""
    x, y = proposal.position
    return GoalEntry(scenario.scenario_id, proposal.object_id, float(x), float(y), label_of(proposal))


def label_of(proposal: Proposal) -> str:
    """Its manoeuvre, and whether it is the recorded one."""
    return f"{proposal.manoeuvre.value}{RECORDED if proposal.is_recorded else ''}"

"""Rollouts of files in panels of their own, beside those that the studio simulates."""

from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rlftsim.evaluation.rollout_files import RolloutEntry, find_rollouts, read_states
from rlftsim.realism import SimulatedStates
from rlftsim.scenario.types import CURRENT_STEP, Scenario
from rlftsim.studio.encoding import encode_poses
from rlftsim.studio.refusal import Refusal
from rlftsim.studio.scoring import score_states


@dataclass(frozen=True, eq=False)
class Imported:
    """Rollouts of a file or folder under the name that the page shows."""

    name: str
    entries: dict[str, RolloutEntry]
    """By scenario id."""

    def states_of(self, scenario: Scenario) -> SimulatedStates:
        """A scenario's rollouts, all simulated agents in the order of the log.

        Raises:
            Refusal: there are none (404).
            DataError: a damaged file, or agents that the scenario has are missing.
        """
        if scenario.scenario_id not in self.entries:
            raise Refusal(f"{self.name} has no rollouts of scenario {scenario.scenario_id}.", status=404)
        states = read_states(self.entries[scenario.scenario_id])
        places = {int(one): place for place, one in enumerate(states.object_id)}
        ids = scenario.tracks.object_id[scenario.simulated_indices].tolist()
        missing = [one for one in ids if one not in places]
        if missing:
            raise Refusal(f"{self.entries[scenario.scenario_id]}: no rollouts of agent {missing[0]}.")
        order = torch.tensor([places[one] for one in ids])
        axes = (getattr(states, axis)[:, order] for axis in ("x", "y", "z", "heading"))
        return SimulatedStates(np.array(ids), *axes)


def import_rollouts(sources: tuple[str, ...]) -> dict[str, Imported]:
    """Rollouts of files and folders by name; files are only listed, not read.

    Raises:
        DataError: nothing there, or no rollouts.
    """
    found: dict[str, Imported] = {}
    for source in sources:
        stem = Path(source).resolve().name
        name = next(n for k in range(1, len(sources) + 1) if (n := stem if k == 1 else f"{stem}-{k}") not in found)
        found[name] = Imported(name, {entry.scenario_id: entry for entry in find_rollouts(source)})
    return found


def encode_imported(imported: Imported, scenario: Scenario) -> bytes:
    """Bytes of a scenario's rollouts, as those of a simulated chunk.

    Args:
        imported: has the rollouts.
        scenario: its origin becomes that of the poses.

    Raises:
        Refusal: as `Imported.states_of`.
        DataError: as `Imported.states_of`.
    """
    states, chosen = imported.states_of(scenario), scenario.simulated_indices
    x, y = states.x.numpy() - scenario.origin[0], states.y.numpy() - scenario.origin[1]  # [N, A, 80]
    poses = np.stack([x, y, states.heading.numpy()], axis=-1)
    position = scenario.tracks.position[chosen, CURRENT_STEP, :2] - scenario.origin[:2]
    current = np.concatenate([position, scenario.tracks.heading[chosen, CURRENT_STEP, None]], axis=-1)  # [A, 3]
    return encode_poses(poses, current)


def score_imported(imported: Imported, scenario: Scenario, metric: str) -> dict[str, Any]:
    """Score and explanation of a scenario's rollouts, as the page takes them.

    Args:
        imported: has the rollouts.
        scenario: that they are of.
        metric: year.

    Raises:
        Refusal: as `Imported.states_of`.
        DataError: as `Imported.states_of`.
    """
    scored = score_states(scenario, imported.states_of(scenario), (), metric)
    return {**scored.to_payload(), "explained": scored.explained()}

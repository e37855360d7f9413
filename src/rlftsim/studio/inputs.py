"""Models and rollouts of files that a studio is started with; the rollouts get separate panels."""

from collections.abc import Container
from dataclasses import dataclass
from itertools import chain, count
from pathlib import Path
from typing import Any

import numpy as np
import torch

from rlftsim.errors import ConfigError
from rlftsim.evaluation.rollout_files import RolloutEntry, find_rollouts, read_states
from rlftsim.policies.registry import Device, load_policy, with_guidance
from rlftsim.realism import SimulatedStates
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy, is_goal_conditioned
from rlftsim.scenario.types import CURRENT_STEP, Scenario
from rlftsim.studio import Refusal
from rlftsim.studio.encoding import encode_poses
from rlftsim.studio.scoring import score_states


@dataclass(frozen=True, eq=False)
class Model:
    """A policy under the name that the page shows."""

    name: str
    source: str
    """As given on the command line."""
    policy: Policy
    fingerprint: str
    takes_goals: bool
    note: str
    """Reason for controls that are switched off; empty where all work."""
    can_guide: bool


@dataclass(frozen=True, eq=False)
class Imported:
    """Rollouts of a file or folder under the name that the page shows."""

    name: str
    entries: dict[str, RolloutEntry]
    """By scenario id."""

    def read_states(self, scenario: Scenario) -> SimulatedStates:
        """Rollouts of a scenario, all simulated agents in the order of the log.

        Raises:
            Refusal: No rollouts of the scenario (404), or of an agent (422).
            DataError: A damaged file.
        """
        if scenario.scenario_id not in self.entries:
            raise Refusal(f"{self.name} has no rollouts of scenario {scenario.scenario_id}.", status=404)
        states = read_states(self.entries[scenario.scenario_id])
        rows = {int(object_id): row for row, object_id in enumerate(states.object_id)}
        ids = scenario.tracks.object_id[scenario.simulated_indices].tolist()
        missing = [object_id for object_id in ids if object_id not in rows]
        if missing:
            raise Refusal(f"{self.entries[scenario.scenario_id]}: no rollouts of agent {missing[0]}.")
        order = torch.tensor([rows[object_id] for object_id in ids])
        axes = (getattr(states, axis)[:, order] for axis in ("x", "y", "z", "heading"))
        return SimulatedStates(np.array(ids), *axes)


def load_models(names: tuple[str, ...], device: Device) -> list[Model]:
    """Models by the names that `load_policy` takes, in the same order.

    Args:
        names: Runs, model folders or registered names; of equal names the second is shown as "name-2".
        device: Device that the models simulate on.

    Raises:
        RlftsimError: No such model, or a damaged one.
    """
    models: dict[str, Model] = {}
    for source in names:
        policy = load_policy(source, device)
        path = Path(source)
        # A run's model lies in run/model: the run's name says more.
        stem = path.resolve().parent.name if path.name == "model" else path.name or path.resolve().name
        name = _number_name(stem, models)
        takes_goals = is_goal_conditioned(policy)
        note = "" if takes_goals else f"{name} is not goal-conditioned: it was not trained to follow goals."
        models[name] = Model(name, source, policy, fingerprint_policy(policy), takes_goals, note, _can_guide(policy))
    return list(models.values())


def _can_guide(policy: Policy) -> bool:
    try:
        with_guidance(policy, 2.0)
    except ConfigError:
        return False
    return True


def import_rollouts(sources: tuple[str, ...]) -> dict[str, Imported]:
    """Rollouts of files and folders by name; files are only listed, not read.

    Raises:
        DataError: No file or folder of this name, or no rollouts inside.
    """
    imported: dict[str, Imported] = {}
    for source in sources:
        name = _number_name(Path(source).resolve().name, imported)
        imported[name] = Imported(name, {entry.scenario_id: entry for entry in find_rollouts(source)})
    return imported


def _number_name(stem: str, taken_names: Container[str]) -> str:
    """The name itself, or else the first of "name-2", "name-3", ... that is not taken."""
    numbered = (f"{stem}-{number}" for number in count(2))
    return next(name for name in chain([stem], numbered) if name not in taken_names)


def encode_imported(imported: Imported, scenario: Scenario) -> bytes:
    """Bytes of a scenario's rollouts in the map frame, as those of a simulated chunk.

    Args:
        imported: Rollouts of a file or folder, in the world frame.
        scenario: Scenario of the rollouts, whose origin becomes that of the poses.

    Raises:
        Refusal: As `Imported.read_states`.
        DataError: As `Imported.read_states`.
    """
    states, indices = imported.read_states(scenario), scenario.simulated_indices
    x, y = states.x.numpy() - scenario.origin[0], states.y.numpy() - scenario.origin[1]  # [N, A, 80]
    poses = np.stack([x, y, states.heading.numpy()], axis=-1)
    position = scenario.tracks.position[indices, CURRENT_STEP, :2] - scenario.origin[:2]
    current = np.concatenate([position, scenario.tracks.heading[indices, CURRENT_STEP, None]], axis=-1)  # [A, 3]
    return encode_poses(poses, current)


def score_imported(imported: Imported, scenario: Scenario, metric: str) -> dict[str, Any]:
    """Score and explanation of a scenario's rollouts, in the layout of the page.

    Args:
        imported: Rollouts of a file or folder, in the world frame.
        scenario: Scenario of the rollouts, with the logged future to compare with.
        metric: Year of the meta-metric, "2025" or "2024".

    Raises:
        Refusal: As `Imported.read_states`.
        DataError: As `Imported.read_states`.
    """
    scored = score_states(scenario, imported.read_states(scenario), (), metric)
    return {**scored.to_payload(), "explained": scored.explained()}

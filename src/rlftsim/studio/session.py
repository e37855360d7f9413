"""Data and models of a start of the studio, and all facts about a scenario that need no rollout."""

import json
import re
from collections.abc import Callable
from functools import lru_cache
from operator import eq, ge, gt, le, lt, ne
from pathlib import Path
from typing import Any

import numpy as np

import rlftsim
from rlftsim.errors import DataError
from rlftsim.experiments.goal_proposals import format_label, propose, to_goal_entry
from rlftsim.goals.goals_file import GoalEntry
from rlftsim.goals.placement import goal_warnings
from rlftsim.goals.proposals import no_proposal_reason
from rlftsim.goals.types import simulated_track
from rlftsim.jobs.folder import check_folder
from rlftsim.policies.registry import Device
from rlftsim.scenario.open import list_splits, open_dataset
from rlftsim.scenario.types import CURRENT_STEP, Scenario
from rlftsim.studio import Refusal
from rlftsim.studio.inputs import Imported, Model, import_rollouts, load_models
from rlftsim.viewer.scene import build_scene, logged_trajectories

ROWS_PER_PAGE = 200
KEPT_SCENES = 48
FIELDS = {
    "id": "scenario_id",
    "ego_turn": "ego_maneuver",
    "n_agents": "num_agents",
    "n_veh": "num_vehicles",
    "n_ped": "num_pedestrians",
    "n_cyc": "num_cyclists",
    "n_eval": "num_evaluated",
    "lights": "num_light_states",
    "points": "num_map_points",
    "source": "source",
}
"""Words of a query -> columns of the index; `num_agents` is a sum of three of them."""
MODEL_FIELDS = ("name", "source", "fingerprint", "takes_goals", "can_guide", "note")
"""Fields of `Model` that the page gets."""
_TERM = re.compile(r"^(\w+)(<=|>=|!=|=|<|>)(.+)$")
_COMPARE = {"=": eq, "!=": ne, "<": lt, ">": gt, "<=": le, ">=": ge}


class Session:
    """Data set, models and imported rollouts of the studio.

    Args:
        data: Folder of a data set, or "synthetic" for the embedded data set.
        models: Names for `load_policy`; folders are read only here, no request can name a further folder.
        split: Split that the page shows first; None = "validation", if the data set has that split.
        out: Folder of all files that the page saves.
        device: Device that the models simulate on.
        rollouts: Files and folders of rollouts; each gets a separate panel.

    Raises:
        RlftsimError: No such data set, split or model, or no rollouts.
    """

    def __init__(
        self,
        data: str,
        models: tuple[str, ...],
        split: str | None,
        out: Path,
        device: Device = "cpu",
        rollouts: tuple[str, ...] = (),
    ) -> None:
        self.data = data
        self.splits = list_splits(data)
        self.split = split or ("validation" if "validation" in self.splits else self.splits[0])
        self._datasets = {name: open_dataset(data, name) for name in dict.fromkeys((self.split, *self.splits))}
        check_folder(out, "results")
        self.out = out
        self._imported = import_rollouts(rollouts)
        self.models = {model.name: model for model in load_models(models, device)}
        self._rows: dict[str, list[dict[str, Any]]] = {}
        self._encoded_scene = lru_cache(KEPT_SCENES)(lambda *names: _encode_scene(self.scenario(*names)))
        self._described_proposals = lru_cache(KEPT_SCENES * 8)(
            lambda *names, agent: _describe_proposals(self.scenario(*names), agent)
        )

    def describe(self) -> dict[str, Any]:
        """Versions, models and data: facts for the page before a scenario is shown."""
        counts = {name: len(dataset) for name, dataset in self._datasets.items()}
        return {
            "version": rlftsim.__version__,
            "data": self.data,
            "split": self.split,
            "splits": [{"name": name, "scenarios": counts[name]} for name in self.splits],
            "license": next(iter(self._datasets.values())).manifest.license_note,
            "out": str(self.out),
            "fields": list(FIELDS),
            "models": [{name: getattr(model, name) for name in MODEL_FIELDS} for model in self.models.values()],
            "imported": [{"name": name, "scenarios": len(i.entries)} for name, i in self._imported.items()],
        }

    def scenario(self, split: str, scenario_id: str) -> Scenario:
        """Scenario of a split by id.

        Args:
            split: Name of a split of the data set, such as "validation".
            scenario_id: Id of a scenario in the split.

        Raises:
            Refusal: No such scenario (404).
        """
        if split not in self._datasets or scenario_id not in self._datasets[split]:
            sentence = f"no scenario {scenario_id} in split {split!r} of {self.data}."
            raise Refusal(sentence, status=404, hint="Choose one of the list.")
        return self._datasets[split].by_id(scenario_id)

    def model(self, name: str) -> Model:
        """Model by name.

        Raises:
            Refusal: The studio was started without this model (404).
        """
        if name not in self.models:
            raise Refusal(f"no model {name!r}: this studio was started with {', '.join(self.models)}.", status=404)
        return self.models[name]

    def imported(self, name: str) -> Imported:
        """Rollouts of files by name.

        Raises:
            Refusal: The studio was started without these rollouts (404).
        """
        if name not in self._imported:
            raise Refusal(f"no rollouts {name!r}: this studio was started without them.", status=404)
        return self._imported[name]

    def rows(self, split: str, query: str, offset: int) -> dict[str, Any]:
        """A page of the index.

        Args:
            split: Split of the data set, such as "validation".
            query: Words with spaces between, all of which must hold: "ego_turn=left n_ped>3", or a piece of an id.
            offset: First row of the page, counted among the rows that match the query.

        Raises:
            Refusal: No such split, or a word that names no column.
        """
        if split not in self._datasets:
            raise Refusal(f"no split {split!r} in {self.data}, only {', '.join(self.splits)}.", status=404)
        if split not in self._rows:
            columns = [column for column in FIELDS.values() if column != "num_agents"]
            dataset = self._datasets[split]
            index = dataset.index.select(columns).append_column("num_agents", [dataset.num_agents])
            rows = index.to_pylist()
            self._rows[split] = rows  # complete: another request may read them at once
        tests = [_parse_term(term) for term in query.split()]
        matches = [row for row in self._rows[split] if all(test(row) for test in tests)]
        return {"total": len(matches), "offset": offset, "rows": matches[offset : offset + ROWS_PER_PAGE]}

    def scene(self, split: str, scenario_id: str) -> bytes:
        """JSON of the still scene and the logged motion of a scenario.

        Args:
            split: Name of a split of the data set, such as "validation".
            scenario_id: Id of a scenario in the split.

        Raises:
            Refusal: No such scenario (404).
        """
        return self._encoded_scene(split, scenario_id)

    def proposals(self, split: str, scenario_id: str, agent: int) -> dict[str, Any]:
        """Maneuvers that an agent can do, with paths and goals.

        Args:
            split: Name of a split of the data set, such as "validation".
            scenario_id: Id of a scenario in the split.
            agent: Object id of a simulated agent.

        Raises:
            Refusal: No such scenario (404).
            DataError: No such agent.
        """
        return self._described_proposals(split, scenario_id, agent=agent)

    def doubts(self, scenario: Scenario, goals: tuple[GoalEntry, ...]) -> list[dict[str, Any]]:
        """Refusal or doubts of each goal, in the words of `rlftsim goals check`.

        Args:
            scenario: Scenario that the goals are placed in.
            goals: Goals to check, in the order of the answer.
        """
        answers = []
        for entry in goals:
            refusal, doubts = "", []
            try:
                doubts = list(goal_warnings(entry, scenario))
            except DataError as error:
                refusal = str(error)
            answers.append({"agent": entry.agent_id, "refused": refusal, "doubts": doubts})
        return answers


def _parse_term(term: str) -> Callable[[dict[str, Any]], bool]:
    """Test of a row for one word of a query."""
    match = _TERM.match(term)
    if match is None:
        return lambda row: term in row["scenario_id"] or term == row["ego_maneuver"]
    word, sign, text = match.groups()
    if word not in FIELDS:
        raise Refusal(f"{term}: no column {word!r}.", hint=f"Columns are {', '.join(FIELDS)}.")
    column, compare = FIELDS[word], _COMPARE[sign]
    if column in ("scenario_id", "ego_maneuver", "source"):
        return lambda row: compare(row[column], text)
    try:
        number = float(text)
    except ValueError:
        raise Refusal(f"{term}: {word} is compared with a number.") from None
    return lambda row: compare(row[column], number)


def _encode_scene(scenario: Scenario) -> bytes:
    scene, log = build_scene(scenario), logged_trajectories(scenario)
    speed = np.linalg.norm(scenario.tracks.velocity[scenario.simulated_indices, CURRENT_STEP], axis=-1)
    payload = {
        "scene": scene.to_payload(),
        "log": log.with_overlaps(scene.agents).to_payload(),
        "origin": scenario.origin.tolist(),
        "speeds": [round(float(v), 2) for v in speed],
        "has_future": scenario.has_future,
        "note": scene.note,
    }
    return json.dumps(payload, separators=(",", ":"), allow_nan=False).encode()


def _describe_proposals(scenario: Scenario, agent: int) -> dict[str, Any]:
    track = simulated_track(scenario, agent, "proposals")
    proposals = propose(scenario, track)
    reason = "" if proposals else no_proposal_reason(scenario, track) or "no maneuver can be completed in time"
    descriptions = []
    for proposal in proposals:
        entry = to_goal_entry(scenario, proposal)
        descriptions.append(
            {
                "maneuver": proposal.maneuver.value,
                "label": format_label(proposal),
                "logged": proposal.is_logged,
                # As a goals file stores it, so that saved and simulated goals are the same.
                "x": round(entry.x, 3),
                "y": round(entry.y, 3),
                "way": np.round(proposal.path[:, :2] - scenario.origin, 2).tolist(),
                "doubts": list(goal_warnings(entry, scenario)),
            }
        )
    return {"agent": agent, "reason": reason, "proposals": descriptions}

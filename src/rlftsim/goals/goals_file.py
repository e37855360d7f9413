"""Goals as a JSON file, for reading and editing by hand. Frame: world, m, as in the scenario's log.

    {
     "format": "rlftsim-goals-1",
     "goals": [{"scenario": "9d639de83d6f5239", "agent": 10, "x": 1034.5, "y": -188.0, "label": "left"}],
     "alternatives": []
    }

`label` is free text and optional. `alternatives` is optional, too: entries that are stored but not used. An agent has
at most one goal; to use an alternative instead, swap the two entries.
"""

import difflib
import json
import math
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rlftsim.errors import DataError, in_short
from rlftsim.jobs.documents import describe_type, parse_json, read_json
from rlftsim.jobs.files import write_text

FORMAT = "rlftsim-goals-1"
FIELDS = ("scenario", "agent", "x", "y", "label")
SECTIONS = ("goals", "alternatives")
_WAY_OUT = "goals are a list of entries, see docs/goals.md"
UNSHOWABLE = {"Cc": "a control character", "Cs": "half a character"}
"""Unicode categories that no terminal or picture can show: control characters and lone surrogates."""


@dataclass(frozen=True)
class GoalEntry:
    """The goal of an agent in a scenario."""

    scenario_id: str
    agent_id: int
    x: float
    y: float
    label: str = ""
    location: str = field(default="", compare=False)
    """File and position of the entry, for messages."""

    def __str__(self) -> str:
        return self.location or f"goal of agent {self.agent_id} in scenario {self.scenario_id}"


@dataclass(frozen=True)
class GoalsFile:
    """Content of a goals file."""

    goals: tuple[GoalEntry, ...]
    alternatives: tuple[GoalEntry, ...] = ()
    """Stored, not used."""

    @property
    def scenario_ids(self) -> tuple[str, ...]:
        """Scenarios that have goals, in the order of first mention."""
        return tuple(dict.fromkeys(entry.scenario_id for entry in self.goals))

    def of_scenario(self, scenario_id: str) -> tuple[GoalEntry, ...]:
        """The goals of a scenario."""
        return tuple(entry for entry in self.goals if entry.scenario_id == scenario_id)


def read_goals(path: Path) -> GoalsFile:
    """Read and check a goals file. `goals.placement` checks it against the scenarios.

    Raises:
        DataError: The file is missing or not JSON, or an entry is wrong; the message names file, entry and field.
    """
    missing = f"{path}: no such goals file: make one with `rlftsim goals propose`."
    return _parse_goals(read_json(path, _WAY_OUT, expected=object, allow_nan=True, missing=missing), str(path))


def parse_goals(text: str, path: str) -> GoalsFile:
    """Goals of the text of a goals file.

    Args:
        text: Content of the file, a JSON object.
        path: Name of the file, for messages.

    Raises:
        DataError: Not JSON, or an entry is wrong; the message names file, entry and field.
    """
    # numbers that are not finite pass, to be refused with their location
    return _parse_goals(parse_json(text, _WAY_OUT, source=path, expected=object, allow_nan=True), path)


def _parse_goals(content: object, path: str) -> GoalsFile:
    if not isinstance(content, dict) or content.get("format") != FORMAT:
        raise DataError(f'{path}: not a goals file of this version: it must be an object with "format": "{FORMAT}".')
    _check_fields(content, ("format", *SECTIONS), path)
    sections: list[tuple[GoalEntry, ...]] = []
    for section in SECTIONS:
        entries, location = content.get(section, []), f"{path}: {section}"
        if not isinstance(entries, list):
            raise DataError(f"{location}: must be a list of goals, is {describe_type(entries)}.")
        sections.append(tuple(_parse_entry(entry, f"{location}[{number}]") for number, entry in enumerate(entries)))
    check_single_goals(sections[0])
    return GoalsFile(*sections)


def write_goals(path: Path, file: GoalsFile) -> None:
    """Write a goals file, an entry per line, atomically.

    Args:
        path: File to write; an existing file is replaced.
        file: Goals and alternatives; coordinates are rounded to 1 mm.

    Raises:
        DataError: The file cannot be written.
    """
    lines = [f' "format": "{FORMAT}"']
    for name, entries in zip(SECTIONS, (file.goals, file.alternatives)):
        rows = (
            {"scenario": entry.scenario_id, "agent": entry.agent_id, "x": round(entry.x, 3), "y": round(entry.y, 3)}
            | ({"label": entry.label} if entry.label else {})
            for entry in entries
        )
        body = ",\n".join(f"  {json.dumps(row)}" for row in rows)
        lines.append(f' "{name}": [{f"{chr(10)}{body}{chr(10)} " if body else ""}]')
    write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")


def parse_goal(text: str, scenario_id: str) -> GoalEntry:
    """Goal of a command line, written AGENT=X,Y.

    Args:
        text: Object id, then x and y in m, world frame, such as "12=1034.5,-188.0".
        scenario_id: Scenario that the goal belongs to.

    Raises:
        DataError: The text is written otherwise, or a number is not finite.
    """
    location = f"--goal {text}"
    agent, equals, point = text.partition("=")
    x, comma, y = point.partition(",")
    try:
        numbers = {"agent": int(agent), "x": float(x), "y": float(y)}
    except ValueError:
        numbers = {}
    if not (equals and comma and numbers):
        raise DataError(f"{location}: not AGENT=X,Y: write for example --goal 12=1034.5,-188.0.")
    return _parse_entry({"scenario": scenario_id, **numbers}, location)


def check_single_goals(entries: Sequence[GoalEntry]) -> None:
    """Check that no agent has two goals.

    Raises:
        DataError: An agent has two; the message names both entries.
    """
    first_entries: dict[tuple[str, int], GoalEntry] = {}
    for entry in entries:
        first_entry = first_entries.setdefault((entry.scenario_id, entry.agent_id), entry)
        if first_entry is not entry:
            raise DataError(
                f"{entry}: agent {entry.agent_id} of scenario {entry.scenario_id} has a goal already ({first_entry}): "
                'keep one of them; in a file the other may go to "alternatives".'
            )


def _parse_entry(entry: object, location: str) -> GoalEntry:
    if not isinstance(entry, dict):
        raise DataError(f'{location}: must be an object such as {{"scenario": ..., "agent": ..., "x": ..., "y": ...}}.')
    _check_fields(entry, FIELDS, location)
    missing_fields = [name for name in FIELDS[:-1] if name not in entry]
    if missing_fields:
        raise DataError(f"{location}: {', '.join(missing_fields)} missing: a goal needs scenario, agent, x and y.")
    for name in ("scenario", "label"):
        if not isinstance(entry.get(name, ""), str):
            raise DataError(f"{location}: {name} must be text in quotes, is {describe_type(entry[name])}.")
        for character in entry.get(name, ""):
            category = UNSHOWABLE.get(unicodedata.category(character))
            if category:
                code = f"U+{ord(character):04X}"
                raise DataError(f"{location}: {name} has {category}, {code}, that cannot be shown: write it without.")
    # bool is a subclass of int: `true` is refused first.
    agent = entry["agent"]
    if isinstance(agent, bool) or not isinstance(agent, int):
        value = agent if isinstance(agent, float) else describe_type(agent)
        raise DataError(f"{location}: agent must be a whole number, an object id of the log, is {value}.")
    if not -(2**63) <= agent < 2**63:
        raise DataError(f"{location}: agent {agent} is no object id, which have 64 bits.")
    x, y = (_parse_coordinate(entry[name], f"{location}: {name}") for name in ("x", "y"))
    return GoalEntry(entry["scenario"], agent, x, y, entry.get("label", ""), location)


def _parse_coordinate(value: object, location: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DataError(f"{location} must be a number of meters, is {describe_type(value)}.")
    if not math.isfinite(value):
        raise DataError(f"{location} is {value}: a goal needs a finite point, meters in the world frame of the log.")
    return float(value)


def _check_fields(json_object: Mapping[str, Any], fields: Sequence[str], location: str) -> None:
    for name in json_object:
        if name not in fields:
            matches = difflib.get_close_matches(name, fields, 1)
            hint = f"did you mean {matches[0]!r}?" if matches else f"known are {', '.join(fields)}."
            raise DataError(f"{location}: no field {in_short(name)} here: {hint}")

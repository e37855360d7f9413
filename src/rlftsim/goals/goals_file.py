"""Goals as a JSON file, to be read and edited by hand. Frame: world, m, as in the scenario's log.

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

from rlftsim.atomic_io import write_text
from rlftsim.errors import DataError, in_short
from rlftsim.jobs.files import describe_kind, parse_json, read_json

FORMAT = "rlftsim-goals-1"
FIELDS = ("scenario", "agent", "x", "y", "label")
SECTIONS = ("goals", "alternatives")
_WAY_OUT = "goals are a list of entries, see docs/goals.md"
UNSHOWABLE = {"Cc": "a control character", "Cs": "half a character"}
"""Unicode categories that no terminal or picture can show: control characters and lone surrogates."""


@dataclass(frozen=True)
class GoalEntry:
    """The goal of one agent of one scenario."""

    scenario_id: str
    agent_id: int
    x: float
    y: float
    label: str = ""
    place: str = field(default="", compare=False)
    """File and position it was read from, for messages."""

    def __str__(self) -> str:
        return self.place or f"goal of agent {self.agent_id} in scenario {self.scenario_id}"


@dataclass(frozen=True)
class GoalsFile:
    """Content of a goals file."""

    goals: tuple[GoalEntry, ...]
    alternatives: tuple[GoalEntry, ...] = ()
    """Stored, not used."""

    @property
    def scenario_ids(self) -> tuple[str, ...]:
        """Scenarios that have goals, in the order of their first ones."""
        return tuple(dict.fromkeys(entry.scenario_id for entry in self.goals))

    def of_scenario(self, scenario_id: str) -> tuple[GoalEntry, ...]:
        """The goals of a scenario."""
        return tuple(entry for entry in self.goals if entry.scenario_id == scenario_id)


def read_goals(path: Path) -> GoalsFile:
    """Read and check a goals file. `goals.placement` checks it against the scenarios.

    Raises:
        DataError: the file is missing or not JSON, or an entry is wrong: names file, entry and field.
    """
    try:
        return _check_goals(read_json(path, _WAY_OUT, expected=object, allow_nan=True), str(path))
    except FileNotFoundError:
        raise DataError(f"{path}: no such goals file: make one with `rlftsim goals propose`.") from None


def parse_goals(text: str, path: str) -> GoalsFile:
    """Goals of the text of a goals file.

    Args:
        text: its content.
        path: name of the file, for messages.

    Raises:
        DataError: not JSON, or an entry is wrong: names file, entry and field.
    """
    # numbers that are not finite pass, to be refused with their place
    return _check_goals(parse_json(text, _WAY_OUT, source=path, expected=object, allow_nan=True), path)


def _check_goals(about: object, path: str) -> GoalsFile:
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise DataError(f'{path}: not a goals file of this version: it must be an object with "format": "{FORMAT}".')
    _refuse_unknown(about, ("format", *SECTIONS), f"{path}")
    sections: list[tuple[GoalEntry, ...]] = []
    for section in SECTIONS:
        found, place = about.get(section, []), f"{path}: {section}"
        if not isinstance(found, list):
            raise DataError(f"{place}: must be a list of goals, is {describe_kind(found)}.")
        sections.append(tuple(_entry(one, f"{place}[{number}]") for number, one in enumerate(found)))
    refuse_twice(sections[0])
    return GoalsFile(*sections)


def write_goals(path: Path, file: GoalsFile) -> None:
    """Write a goals file, one entry a line, atomically.

    Args:
        path: the file; replaced if it exists.
        file: goals and alternatives; coordinates are rounded to 1 mm.

    Raises:
        DataError: it cannot be written.
    """
    sections = {"goals": file.goals, "alternatives": file.alternatives}
    lines = [f' "format": "{FORMAT}"']
    for name, entries in sections.items():
        plain = (
            {"scenario": entry.scenario_id, "agent": entry.agent_id, "x": round(entry.x, 3), "y": round(entry.y, 3)}
            | ({"label": entry.label} if entry.label else {})
            for entry in entries
        )
        body = ",\n".join(f"  {json.dumps(entry)}" for entry in plain)
        lines.append(f' "{name}": [{f"{chr(10)}{body}{chr(10)} " if body else ""}]')
    write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")


def parse_goal(text: str, scenario_id: str) -> GoalEntry:
    """Goal of a command line, written AGENT=X,Y.

    Args:
        text: such as "12=1034.5,-188.0": object id, then x and y in m, world frame.
        scenario_id: the scenario that it is meant for.

    Raises:
        DataError: it is written otherwise, or a number is not finite.
    """
    place = f"--goal {text}"
    agent, equals, point = text.partition("=")
    x, comma, y = point.partition(",")
    try:
        numbers = {"agent": int(agent), "x": float(x), "y": float(y)}
    except ValueError:
        numbers = {}
    if not (equals and comma and numbers):
        raise DataError(f"{place}: not AGENT=X,Y: write for example --goal 12=1034.5,-188.0.")
    return _entry({"scenario": scenario_id, **numbers}, place)


def refuse_twice(entries: Sequence[GoalEntry]) -> None:
    """Check that no agent has two goals.

    Raises:
        DataError: one has: names both entries.
    """
    first: dict[tuple[str, int], GoalEntry] = {}
    for entry in entries:
        other = first.setdefault((entry.scenario_id, entry.agent_id), entry)
        if other is not entry:
            raise DataError(
                f"{entry}: agent {entry.agent_id} of scenario {entry.scenario_id} has a goal already ({other}): keep "
                'one of them; in a file the other may go to "alternatives".'
            )


def _entry(found: object, place: str) -> GoalEntry:
    if not isinstance(found, dict):
        raise DataError(f'{place}: must be an object such as {{"scenario": ..., "agent": ..., "x": ..., "y": ...}}.')
    _refuse_unknown(found, FIELDS, place)
    missing = [name for name in FIELDS[:-1] if name not in found]
    if missing:
        raise DataError(f"{place}: {', '.join(missing)} missing: a goal needs scenario, agent, x and y.")
    for name in ("scenario", "label"):
        if not isinstance(found.get(name, ""), str):
            raise DataError(f"{place}: {name} must be text in quotes, is {describe_kind(found[name])}.")
        for character in found.get(name, ""):
            unshowable = UNSHOWABLE.get(unicodedata.category(character))
            if unshowable:
                raise DataError(
                    f"{place}: {name} has {unshowable}, U+{ord(character):04X}, that cannot be shown: write it without."
                )
    # bool is a subclass of int: `true` is refused first.
    if isinstance(found["agent"], bool) or not isinstance(found["agent"], int):
        shown = found["agent"] if isinstance(found["agent"], float) else describe_kind(found["agent"])
        raise DataError(f"{place}: agent must be a whole number, an object id of the log, is {shown}.")
    if not -(2**63) <= found["agent"] < 2**63:
        raise DataError(f"{place}: agent {found['agent']} is no object id, which have 64 bits.")
    x, y = (_coordinate(found[name], f"{place}: {name}") for name in ("x", "y"))
    return GoalEntry(found["scenario"], found["agent"], x, y, found.get("label", ""), place)


def _coordinate(value: object, place: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DataError(f"{place} must be a number of meters, is {describe_kind(value)}.")
    if not math.isfinite(value):
        raise DataError(f"{place} is {value}: a goal needs a finite point, meters in the world frame of the log.")
    return float(value)


def _refuse_unknown(found: Mapping[str, Any], known: Sequence[str], place: str) -> None:
    for name in found:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}."
            raise DataError(f"{place}: no field {in_short(name)} here: {hint}")

"""Goals as a JSON file that a person can write and mend. Frame: world, metres, as in the scenario's record.

    {
     "format": "rlftsim-goals-1",
     "goals": [{"scenario": "9d639de83d6f5239", "agent": 10, "x": 1034.5, "y": -188.0, "label": "left"}],
     "alternatives": []
    }

`label` is free text and may be missing, `alternatives` too: entries that are kept at hand and not asked for. An agent has at most one
goal; to ask for an alternative, swap the two entries.
"""

import difflib
import json
import math
import unicodedata
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from rlftsim.errors import DataError
from rlftsim.files import write_text

FORMAT = "rlftsim-goals-1"
FIELDS = ("scenario", "agent", "x", "y", "label")
SECTIONS = ("goals", "alternatives")
LONGEST_WHOLE = 20
"""Digits of a whole number that may be an object id; longer ones are coordinates, written oddly."""
UNSHOWABLE = {"Cc": "a control character", "Cs": "half a character"}
"""By Unicode category."""


@dataclass(frozen=True)
class GoalEntry:
    """A point that an agent of a scenario is asked to go to."""

    scenario_id: str
    agent_id: int
    x: float
    y: float
    label: str = ""
    place: str = field(default="", compare=False)
    """Where it was written, for messages."""

    def __str__(self) -> str:
        return self.place or f"goal of agent {self.agent_id} in scenario {self.scenario_id}"


@dataclass(frozen=True)
class GoalsFile:
    """What a goals file says."""

    goals: tuple[GoalEntry, ...]
    alternatives: tuple[GoalEntry, ...] = ()
    """Not asked for."""

    @property
    def scenario_ids(self) -> tuple[str, ...]:
        """Scenarios that have goals, in the order of their first ones."""
        return tuple(dict.fromkeys(entry.scenario_id for entry in self.goals))

    def of_scenario(self, scenario_id: str) -> tuple[GoalEntry, ...]:
        """The goals of a scenario."""
        return tuple(entry for entry in self.goals if entry.scenario_id == scenario_id)


def read_goals(path: Path) -> GoalsFile:
    """Read and check a goals file; whether scenarios have these agents is for `goals.placing` to say.

    Raises:
        DataError: it is not there, no JSON, or an entry is wrong: names file, entry and field.
    """
    try:
        text = path.read_text(encoding="utf-8-sig")
        about = json.loads(text, object_pairs_hook=_Object, parse_int=_whole)
    except FileNotFoundError:
        raise DataError(f"{path}: no such goals file: make one with `rlftsim goals propose`.") from None
    except UnicodeDecodeError:
        raise DataError(f"{path}: not a text file: goals are JSON, see docs/goals.md.") from None
    except json.JSONDecodeError as error:
        raise DataError(f"{path}: not JSON, line {error.lineno}, column {error.colno}: {error.msg}.") from None
    except RecursionError:
        raise DataError(
            f"{path}: brackets nested too deeply: goals are a list of entries, see docs/goals.md."
        ) from None
    if not isinstance(about, dict) or about.get("format") != FORMAT:
        raise DataError(f'{path}: not a goals file of this version: it must be an object with "format": "{FORMAT}".')
    _refuse_unknown(about, ("format", *SECTIONS), f"{path}")
    goals, alternatives = (_entries(about.get(section, []), f"{path}: {section}") for section in SECTIONS)
    refuse_twice(goals)
    return GoalsFile(goals, alternatives)


def write_goals(path: Path, file: GoalsFile) -> None:
    """Write a goals file, one entry a line, whole or not at all.

    Raises:
        DataError: it cannot be written.
    """
    sections = {"goals": file.goals, "alternatives": file.alternatives}
    lines = [f' "format": "{FORMAT}"']
    for name, entries in sections.items():
        body = ",\n".join(f"  {json.dumps(_to_plain(entry))}" for entry in entries)
        lines.append(f' "{name}": [{f"{chr(10)}{body}{chr(10)} " if body else ""}]')
    write_text(path, "{\n" + ",\n".join(lines) + "\n}\n")


def parse_goal(text: str, scenario_id: str) -> GoalEntry:
    """A goal as written on a command line: AGENT=X,Y.

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
    """Refuse two goals of one agent.

    Raises:
        DataError: there are: names both entries.
    """
    first: dict[tuple[str, int], GoalEntry] = {}
    for entry in entries:
        other = first.setdefault((entry.scenario_id, entry.agent_id), entry)
        if other is not entry:
            raise DataError(
                f"{entry}: agent {entry.agent_id} of scenario {entry.scenario_id} has a goal already ({other}): keep one "
                'of them; in a file the other may go to "alternatives".'
            )


class _Object(dict[str, Any]):
    """A JSON object that remembers the keys it was written with more than once."""

    def __init__(self, pairs: Sequence[tuple[str, Any]]):
        super().__init__(pairs)
        names = [name for name, _ in pairs]
        self.repeated = [name for name in self if names.count(name) > 1]


def _whole(digits: str) -> int | float:
    return int(digits) if len(digits) <= LONGEST_WHOLE else float(digits)


def _entries(found: object, place: str) -> tuple[GoalEntry, ...]:
    if not isinstance(found, list):
        raise DataError(f"{place}: must be a list of goals, is {_kind(found)}.")
    return tuple(_entry(one, f"{place}[{number}]") for number, one in enumerate(found))


def _entry(found: object, place: str) -> GoalEntry:
    if not isinstance(found, dict):
        raise DataError(f'{place}: must be an object such as {{"scenario": ..., "agent": ..., "x": ..., "y": ...}}.')
    _refuse_unknown(found, FIELDS, place)
    missing = [name for name in FIELDS[:-1] if name not in found]
    if missing:
        raise DataError(f"{place}: {', '.join(missing)} missing: a goal needs scenario, agent, x and y.")
    for name in ("scenario", "label"):
        if not isinstance(found.get(name, ""), str):
            raise DataError(f'{place}: {name} must be text in quotes, is {_kind(found[name])}.')  # fmt: skip
        _refuse_unshowable(found.get(name, ""), f"{place}: {name}")
    if isinstance(found["agent"], bool) or not isinstance(found["agent"], int):
        shown = found["agent"] if isinstance(found["agent"], float) else _kind(found["agent"])
        raise DataError(f"{place}: agent must be a whole number, an object id of the record, is {shown}.")
    x, y = (_coordinate(found[name], f"{place}: {name}") for name in ("x", "y"))
    return GoalEntry(found["scenario"], found["agent"], x, y, found.get("label", ""), place)


def _coordinate(value: object, place: str) -> float:
    if isinstance(value, bool) or not isinstance(value, int | float):
        raise DataError(f"{place} must be a number of metres, is {_kind(value)}.")
    if not math.isfinite(value):
        raise DataError(f"{place} is {value}: a goal needs a finite point, metres in the world frame of the record.")
    return float(value)


def _refuse_unknown(found: Mapping[str, Any], known: Sequence[str], place: str) -> None:
    for name in found:
        if name not in known:
            near = difflib.get_close_matches(name, known, 1)
            hint = f"did you mean {near[0]!r}?" if near else f"known are {', '.join(known)}."
            raise DataError(f"{place}: no field {name!r} here: {hint}")
    if isinstance(found, _Object) and found.repeated:
        raise DataError(f"{place}: {', '.join(found.repeated)} is written more than once: keep one of them.")


def _refuse_unshowable(text: str, place: str) -> None:
    for character in text:
        kind = UNSHOWABLE.get(unicodedata.category(character))
        if kind:
            raise DataError(f"{place} has {kind}, U+{ord(character):04X}, that cannot be shown: write it without.")


def _kind(value: object) -> str:
    """A JSON value in words."""
    names = {str: "text", list: "a list", _Object: "an object", bool: "true or false", type(None): "null"}
    return names.get(type(value), "a number")


def _to_plain(entry: GoalEntry) -> dict[str, object]:
    point = {"x": round(entry.x, 3), "y": round(entry.y, 3)}
    label = {"label": entry.label} if entry.label else {}
    return {"scenario": entry.scenario_id, "agent": entry.agent_id, **point, **label}

"""Rewards of planner-driven agents: a weighted sum of terms, written as text."""

import re
from dataclasses import dataclass

from rlftsim.errors import ConfigError, in_short

TERMS = {
    "progress": "distance gained along the route (without one: ahead), in tens of meters",
    "collision": "contacts with tracks not touched before",
    "at_fault": "those of them that are the agent's fault, by nuPlan's rules",
    "offroad": "1 at the first step with a corner 0.3 m or more off the road",
    "goal": "1 at the first step within 2 m of the route's end",
}
"""Name of each term and what it is at one step."""
_TERM = re.compile(r"([+-])(?:(\d+(?:\.\d*)?|\.\d+)\*)?([a-z_]+)")


@dataclass(frozen=True)
class WeightedTerm:
    """A term of the sum."""

    weight: float
    name: str


def parse_terms(text: str) -> tuple[WeightedTerm, ...]:
    """Terms of a sum such as "progress - 5*at_fault"; none for "none".

    Raises:
        ConfigError: not such a sum, or an unknown term.
    """
    if text == "none":
        return ()
    squeezed = text.replace(" ", "")
    signed = squeezed if squeezed[:1] in ("+", "-") else f"+{squeezed}"
    terms = _TERM.findall(signed)
    if not terms or "".join(f"{sign}{factor}{'*' if factor else ''}{name}" for sign, factor, name in terms) != signed:
        raise ConfigError(
            f"reward {in_short(text)} cannot be read: write a sum of terms, such as 'progress - 5*at_fault'."
        )
    for _, _, name in terms:
        if name not in TERMS:
            raise ConfigError(
                f"reward {in_short(text)}: no term {in_short(name)}: known are {', '.join(TERMS)}, or 'none' alone."
            )
    return tuple(WeightedTerm(float(f"{sign}{factor or 1}"), name) for sign, factor, name in terms)

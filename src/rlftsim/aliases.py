"""Names of earlier versions, and the names of today. Stored runs, evaluations, data sets and model folders keep
working through this table.

A stored name that is not listed here is today's name. Fingerprints need no table: a class whose fields were renamed
declares the first names itself (`rollout.fingerprint`).
"""

from collections.abc import Mapping, Sequence
from typing import Any

RENAMED = {
    # models
    "goal_aim": "goal_logit_bias",
    "public_code_quirks": "catk_compat",
    # training settings
    "final_learning_rate_share": "final_lr_ratio",
    "shared_credit": "credit_mixing",
    "reference_asked": "condition_reference",
    "reference_every": "reference_sync_every",
    "reference_share": "reference_ema",
    "goals.share": "goals.probability",
    "augmented_share": "augmented_probability",
    "goal_share": "goal_probability",
    "device.devices": "device.processes",
    # data sets
    "licence": "license",
    "licence_note": "license_note",
    "ego_manoeuvre": "ego_maneuver",
}
"""Old name -> name of today. A name with a dot is renamed only inside the group before the dot."""

RENAMED_VALUES = {("goals", "recorded"): "logged"}
"""(Name of today, old value) -> value of today."""

RENAMED_WORDS = {
    ("--goal-aim", "yes"): ("--goal-logit-bias",),
    ("--goal-aim", "no"): ("--no-goal-logit-bias",),
    ("--goals", "recorded"): ("--goals", "logged"),
    ("--choose", "recorded"): ("--choose", "logged"),
    ("--goal-guidance",): ("--guidance-scale",),
}
"""Old words of the command line -> words of today."""


def current_name(name: str) -> str:
    """Name of today of a setting or column; dotted names keep their groups ("finetune.goals.share")."""
    group, _, last = name.rpartition(".")
    inner = f"{group.rpartition('.')[2]}.{last}"
    new = RENAMED.get(last) or RENAMED.get(inner, "").rpartition(".")[2] or last
    return f"{group}.{new}" if group else new


def current_names(values: Mapping[str, Any], group: str = "") -> dict[str, Any]:
    """A mapping as read from JSON, with names and values of today at every depth.

    Args:
        values: nested mappings of settings.
        group: name that the mapping has in the one around it.
    """
    renamed: dict[str, Any] = {}
    for name, value in values.items():
        new = current_name(f"{group}.{name}").removeprefix(f"{group}.") if group else current_name(name)
        if isinstance(value, Mapping):
            renamed[new] = current_names(value, name)
        else:
            renamed[new] = RENAMED_VALUES.get((new, value), value) if isinstance(value, str) else value
    return renamed


def current_words(words: Sequence[str]) -> list[str]:
    """A command line with flags and values of today."""
    split = [part for word in words for part in _parted(word)]
    renamed: list[str] = []
    while split:
        # A flag with one of its values is looked for first, then the flag alone.
        length = next((n for n in (2, 1) if tuple(split[:n]) in RENAMED_WORDS), 0)
        renamed += RENAMED_WORDS[tuple(split[:length])] if length else split[:1]
        split = split[max(length, 1) :]
    return renamed


def _parted(word: str) -> list[str]:
    """`--flag=value` of a renamed flag as two words; any other word as it is."""
    flag, equals, value = word.partition("=")
    return [flag, value] if equals and any(old[0] == flag for old in RENAMED_WORDS) else [word]

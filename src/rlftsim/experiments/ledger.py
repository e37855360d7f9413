"""Ledger of looks at exams: a line of JSON for each look, in a file that only grows."""

import json
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.documents import parse_json
from rlftsim.jobs.files import append_text


@dataclass(frozen=True)
class Ledger:
    """Looks at exams, in a file that may be missing."""

    path: Path

    @cached_property
    def entries(self) -> list[Mapping[str, Any]]:
        """Entries of the file, a mapping for each line.

        Raises:
            DataError: The file cannot be read, or has a line that is no entry of a ledger.
        """
        try:
            lines = self.path.read_text(encoding="utf-8").splitlines()
        except FileNotFoundError:
            return []
        except (OSError, ValueError) as error:
            raise DataError(f"{self.path} cannot be read ({error}): name another --ledger.") from None
        entries = []
        for number, line in enumerate(lines, 1):
            try:
                entry = parse_json(line, "mend it", source=str(self.path))
                _ = entry["exam"], entry["looks"], entry["recipe"], entry["date"], set(entry["fingerprints"])
            except (DataError, TypeError, KeyError):
                raise DataError(
                    f"{self.path}: line {number} is none of a ledger: mend or remove it, or name another --ledger."
                ) from None
            entries.append(entry)
        return entries

    def count_looks(self, exam: str, recipe: str, fingerprints: Sequence[str], *, is_repeat: bool) -> int:
        """Number of earlier looks at an exam by a recipe of this name or any of these models.

        Args:
            exam: Name of the exam.
            recipe: Name of the recipe.
            fingerprints: Fingerprints of the recipe's models, which may have sat under a former name.
            is_repeat: True allows a further look, which is counted; False refuses one.

        Raises:
            ConfigError: There was a look, and `is_repeat` is not set.
        """
        earlier = [
            entry
            for entry in self.entries
            if entry["looks"]  # not the base
            and entry["exam"] == exam
            and (entry["recipe"] == recipe or set(entry["fingerprints"]) & {*fingerprints})
        ]
        if earlier and not is_repeat:
            raise ConfigError(
                f"{recipe} sat the exam {exam} on {earlier[-1]['date']} ({self.path}): whoever looks twice chooses on "
                "the exam. Choose on the split tune, or add --again, which is counted."
            )
        return len(earlier)

    def append(self, entries: Sequence[Mapping[str, Any]]) -> None:
        """Add lines for a look."""
        self.path.parent.mkdir(parents=True, exist_ok=True)
        append_text(self.path, "".join(json.dumps(entry, allow_nan=False) + "\n" for entry in entries))

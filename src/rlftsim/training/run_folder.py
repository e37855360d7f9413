"""The folder of a run: resolved configuration, environment, metrics, checkpoints.

config.json        the settings, every default filled in
environment.json   versions, machine, command, commit
metrics.jsonl      a line per update; also as TensorBoard events in tensorboard/, or in other trackers
trackers.json      ids of the run in trackers
checkpoints/       all that the run resumes from, see `write_checkpoint`
best/              weights behind the best validations, where the best is kept
model/             the trained policy, once the run is done (`save_pretrained`)
"""

import dataclasses
import hashlib
import json
import math
import os
import platform
import subprocess
import sys
import time
from collections.abc import Collection, Mapping
from contextlib import suppress
from importlib.metadata import version
from pathlib import Path
from typing import Any

from torch import nn

from rlftsim import __version__
from rlftsim.errors import CheckpointError, DataError
from rlftsim.jobs.arrays import read_tensors
from rlftsim.jobs.documents import parse_json, read_json
from rlftsim.jobs.files import append_text, save_tensors, write_text
from rlftsim.jobs.folder import check_folder
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import Scenarios, list_scenario_ids
from rlftsim.training.checkpoint import check_weights, list_checkpoints, newest_checkpoint, parse_update
from rlftsim.training.trackers import RunTrackers, Status

PACKAGES = ("torch", "numpy", "pyarrow", "lightning-fabric", "safetensors")
"""Packages whose versions are stored with a run."""

MAY_CHANGE = (
    *("checkpoint_every", "device.accelerator", "device.processes", "device.num_nodes", "device.threads"),
    *("micro_batch_size", "micro_batch_cost", "rollouts_per_pass", "validation", "goals.augmented"),
)
"""Settings, or whole groups of them, that may have other values when a run is resumed: they change no estimate.
(The folder of augmented goals may change; the goals themselves are among a run's inputs.)"""


DECIDES_BEST = ("every", "keep_best", "metric", "num_rollouts", "num_scenarios", "seed", "top_k")
"""Settings of a validation on which the choice of the best model depends."""


def may_change(name: str) -> bool:
    """True for a setting, named with dots, that may have a different value when a run is resumed."""
    return any(name == free or name.startswith(f"{free}.") for free in MAY_CHANGE)


SCENARIO_FILES = "scenario_files"
"""Input that only data sets have, not lists of scenarios, and not runs of before: compared where both have it."""
HELD_OUT = "held_out"
"""Input that only runs with validations have."""
RUN_INPUTS = ("initial_policy", "scenarios", SCENARIO_FILES, HELD_OUT, "augmented_goals")
"""Entries of a run's config.json that describe what the run started from. They are hashes, not settings."""


def describe_inputs(policy: object, scenarios: Scenarios, held_out: Scenarios | None = None) -> dict[str, str]:
    """Hashes of the inputs that a run starts from.

    Args:
        policy: Policy with the weights, settings and vocabulary to hash.
        scenarios: Scenarios with the ids and order to hash, or a data set with files to hash, too.
        held_out: Scenarios to validate on, of which the ids are hashed; None = no validation.
    """
    inputs = {"initial_policy": fingerprint_policy(policy), "scenarios": _hash_ids(scenarios)}
    if isinstance(scenarios, ScenarioDataset):
        inputs[SCENARIO_FILES] = scenarios.fingerprint
    return inputs if held_out is None else inputs | {HELD_OUT: _hash_ids(held_out)}


def _hash_ids(scenarios: Scenarios) -> str:
    """Hash of the scenarios' ids; not of the scenarios themselves, which would take minutes to read."""
    ids = hashlib.blake2b(digest_size=16)
    for scenario_id in list_scenario_ids(scenarios):
        ids.update(f"{scenario_id}\n".encode())
    return ids.hexdigest()


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by dotted name.

    Args:
        values: Mappings at any depth.
        prefix: Text before every name.
    """
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat


def stored_settings(path: Path) -> dict[str, Any]:
    """Settings and inputs of the run in a folder, empty where no run has begun.

    Raises:
        CheckpointError: The file of settings is damaged.
    """
    file = path / "config.json"
    try:
        return read_json(file, f"remove the folder {path} to start anew", allow_nan=True, error=CheckpointError)
    except FileNotFoundError:
        return {}


def to_plain(config: Any) -> Any:
    """A configuration dataclass as values that JSON can hold."""
    if dataclasses.is_dataclass(config) and not isinstance(config, type):
        return {f.name: to_plain(getattr(config, f.name)) for f in dataclasses.fields(config)}
    if isinstance(config, Mapping):
        return {str(k): to_plain(v) for k, v in config.items()}
    if isinstance(config, list | tuple):
        return [to_plain(v) for v in config]
    return config if isinstance(config, str | int | float | bool | None) else str(config)


def describe_environment() -> dict[str, Any]:
    """Versions, machine, command line, and the commit if the package runs from a checkout."""
    git = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        commit = subprocess.run(git, capture_output=True, text=True, timeout=5, check=True).stdout.strip() or None
    except (OSError, subprocess.SubprocessError):
        commit = None
    return {
        "command": " ".join([Path(sys.argv[0]).name, *sys.argv[1:]]),
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "packages": {"rlftsim": __version__, **{name: version(name) for name in PACKAGES}},
        "commit": commit,
    }


class RunFolder:
    """Opens a run's folder for the first time or to resume. Only the process of rank 0 writes.

    Args:
        path: Folder of the run, created if missing.
        config: Dataclass of the run's settings.
        inputs: Hashes of the run's inputs, see `describe_inputs`.
        writes: False in all processes but rank 0.
        may_grow: Settings of the top level that may be raised when the folder is opened again, such as epochs where
            no update depends on the run's end.

    Raises:
        CheckpointError: The folder belongs to a run with other settings or inputs.
    """

    def __init__(
        self,
        path: Path,
        config: Any,
        inputs: Mapping[str, str] | None = None,
        *,
        writes: bool = True,
        may_grow: Collection[str] = (),
    ):
        check_folder(path, "run")
        self.path = path
        self.checkpoints = path / "checkpoints"
        self.model = path / "model"
        self._writes = writes
        self._metrics = path / "metrics.jsonl"
        self._trackers: RunTrackers | None = None
        # Settings and inputs stand in one file: both make a run what it is.
        self._settings = {**to_plain(config), **(inputs or {})}
        stored = self._checked_stored_settings(self._settings, may_grow)
        # kept where the same scenarios come as a list this time, or without a validation
        for name in (SCENARIO_FILES, HELD_OUT):
            if name in stored:
                self._settings.setdefault(name, stored[name])
        changed = {name: stored[name] for name in may_grow if name in stored and stored[name] != self._settings[name]}
        self.grows_from = changed if self.has_model else {}
        """Settings of the shorter run whose model is here, by name; empty unless it is made longer."""
        if writes and not self.grows_from:
            self._write_settings()

    @property
    def has_model(self) -> bool:
        """True once a run has ended here."""
        return (self.model / "config.json").exists()

    def write_best(self, update: int, model: nn.Module) -> None:
        """Keep the weights of the best validation so far.

        Args:
            update: Number of updates before the validation.
            model: Module with the weights.
        """
        save_tensors(self._best(update), model.state_dict())

    def load_best(self, update: int, model: nn.Module) -> None:
        """Load kept weights in place.

        Args:
            update: Number of updates before the validation.
            model: Module that gets the weights.

        Raises:
            CheckpointError: Missing or damaged file, or weights of a different module.
        """
        path = self._best(update)
        way_out = f"remove {self.path} and train again"
        try:
            missing = f"{path} is missing, the weights of the best validation: {way_out}."
            weights, _ = read_tensors(path, way_out, error=CheckpointError, missing=missing)
            check_weights(path.stem, weights, model)
        except ValueError as error:
            raise CheckpointError(f"{path}: {error}: {way_out}.") from None
        model.load_state_dict(weights)

    def remove_superseded_best(self) -> None:
        """Remove the weights of validations that were the best once, but are so for no checkpoint of the folder."""
        paths = sorted((self.path / "best").glob("update-*.safetensors"))
        checkpoints = [self._best(parse_update(path)) for path in list_checkpoints(self.checkpoints)]
        needed = {max((path for path in paths if path <= checkpoint), default=None) for checkpoint in checkpoints}
        for path in paths:
            if path not in needed and path < max(checkpoints, default=path):
                path.unlink(missing_ok=True)

    def _best(self, update: int) -> Path:
        return self.path / "best" / f"update-{update:08d}.safetensors"

    def finish(self) -> None:
        """Store the settings of a run that was made longer; until then the stored settings belong to the earlier model.

        The earlier model is removed, so that a kill before the new model is complete leaves no model of other settings.
        """
        if self._writes and self.grows_from:
            (self.model / "config.json").unlink(missing_ok=True)
            self._write_settings()

    def _write_settings(self) -> None:
        write_text(self.path / "config.json", json.dumps(self._settings, indent=1) + "\n")
        write_text(self.path / "environment.json", json.dumps(describe_environment(), indent=1) + "\n")

    def _checked_stored_settings(self, config: Any, may_grow: Collection[str]) -> dict[str, Any]:
        """The stored settings of the run that was begun here, once equal to the given settings."""
        old, new = flatten(stored_settings(self.path)), flatten(config)
        if not old:
            return old
        # Two versions of one kind of run share most names, two kinds do not: a list of them all would explain nothing.
        if len(old.keys() ^ new.keys()) > len(old.keys() & new.keys()):
            raise CheckpointError(
                f"{self.path} belongs to a run of another kind: name another --out, or remove the folder to start anew."
            )
        one_sided = {SCENARIO_FILES, HELD_OUT} - (old.keys() & new.keys())
        grown = {name for name in may_grow if isinstance(old.get(name), int | float) and new[name] > old[name]}
        decisive = {f"validation.{name}" for name in DECIDES_BEST} | {HELD_OUT}
        if not (old.get("validation.every") and old.get("validation.keep_best")):
            one_sided, decisive = one_sided | {HELD_OUT}, set()
        names = {name for name in old.keys() | new.keys() if not may_change(name)} - grown - one_sided | decisive
        differing = sorted(name for name in names if old.get(name) != new.get(name))
        if differing:
            max_names = 8  # settings named in one line
            remainder = f" and {len(differing) - max_names} more" if len(differing) > max_names else ""
            names_text = f"{', '.join(differing[:max_names])}{remainder}"
            raise CheckpointError(
                f"{self.path} belongs to a run with other settings or inputs ({names_text}): name another --out, or "
                "remove the folder to start anew."
            )
        return old

    def diverged(self, cause: str, remedy: str) -> CheckpointError:
        """The error of a run that makes no sense any more; names the last good checkpoint.

        Args:
            cause: Clause that follows the folder's name.
            remedy: Clause with the settings to change.
        """
        newest = newest_checkpoint(self.checkpoints)
        return CheckpointError(f"{self.path}: {cause}. The last good checkpoint is {newest or 'none'}: {remedy}.")

    def continue_from(self, update: int, trackers: Collection[str] = ()) -> None:
        """Drop the metrics of updates that will be done again, and let trackers begin.

        Args:
            update: Number of updates done; metrics of later ones are dropped.
            trackers: Names in `TRACKERS`, or "package.module:Class", of trackers to begin.
        """
        if not self._writes:
            return
        if self._metrics.exists():
            # a line cut short by a kill goes, too
            lines = [line for line, values in _read_lines(self._metrics) if values["update"] <= update]
            write_text(self._metrics, "".join(f"{line}\n" for line in lines))
        self._trackers = RunTrackers(trackers, self.path, flatten(self._settings))

    def log(self, update: int, values: Mapping[str, float]) -> None:
        """Add a line of metrics.

        Args:
            update: Number of updates done.
            values: Metrics by name, numbers.
        """
        if not self._writes:
            return
        line = json.dumps({"update": update, "time": round(time.time(), 3), **values})
        append_text(self._metrics, f"{line}\n")
        if self._trackers is not None:
            self._trackers.log(values, update)

    def finish_trackers(self, status: Status) -> None:
        """End the run in all trackers; a finished one hands over the model."""
        if self._trackers is not None:
            self._trackers.finish(status, self.model if status == "finished" else None)


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The metrics of a run's folder, a dictionary per update; empty where there are none."""
    metrics = path / "metrics.jsonl"
    return [values for _, values in _read_lines(metrics)] if metrics.exists() else []


def _read_lines(metrics: Path) -> list[tuple[str, dict[str, Any]]]:
    """Text and values of each line of metrics; without lines that are no JSON, such as a line that a kill cut short."""
    lines = []
    for line in metrics.read_text(encoding="utf-8", errors="replace").splitlines():
        with suppress(DataError):
            values = parse_json(line, "train again", source=str(metrics), allow_nan=True)
            is_sound = all(type(value) in (int, float) for value in values.values())
            if is_sound and math.isfinite(values.get("update", math.inf)):
                lines.append((line, values))
    return lines

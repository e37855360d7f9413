"""The folder of a run: resolved configuration, environment, metrics, checkpoints.

config.json        what was asked for, every default filled in
environment.json   versions, machine, command, commit
metrics.jsonl      a line an update; also as TensorBoard events in tensorboard/
checkpoints/       see `training.checkpoint`
model/             the result, once the run is done (`save_pretrained`)
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
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

from torch.utils.tensorboard import SummaryWriter

from rlftsim import __version__
from rlftsim.errors import CheckpointError
from rlftsim.files import write_text
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.scenario.types import Scenarios, scenario_ids_of
from rlftsim.training.checkpoint import newest_checkpoint

PACKAGES = ("torch", "numpy", "pyarrow", "lightning-fabric", "safetensors")


MAY_CHANGE = (
    *("checkpoint_every", "device.accelerator", "device.devices", "device.num_nodes", "device.threads"),
    *("micro_batch_size", "micro_batch_cost", "rollouts_per_pass", "validation", "goals.augmented"),
)
"""Settings, or whole groups of them, that a run may be continued with other values of: they change no estimate. (Where augmented goals lie
may change; what they are is among a run's inputs.)"""


def may_change(name: str) -> bool:
    """Whether a run may be continued with another value of a setting, named with dots."""
    return any(name == free or name.startswith(f"{free}.") for free in MAY_CHANGE)


BOARD_GROUPS = {
    "reward": ("reward_",),
    "kl": ("kl", "beta"),
    "realism": ("rmm", "kinematic", "interactive", "map_based"),
    "alarm": ("alarm_",),
    "goal": ("goal_", "hindsight_"),
    "validation": ("validation_",),
    "time": ("seconds",),
}
"""How TensorBoard shows metrics together: by how their names begin."""


def board_tag(name: str) -> str:
    """A metric's name in TensorBoard: that of metrics.jsonl, behind its group if it has one."""
    groups = [group for group, beginnings in BOARD_GROUPS.items() if name.startswith(beginnings)]
    return "/".join([*groups, name])


def describe_inputs(policy: object, scenarios: Scenarios) -> dict[str, str]:
    """What a run starts from, as hashes: weights, settings and vocabulary of the policy, and which scenarios in which order."""
    ids = hashlib.blake2b(digest_size=16)
    for scenario_id in scenario_ids_of(scenarios):
        ids.update(f"{scenario_id}\n".encode())
    return {"initial_policy": fingerprint_policy(policy), "scenarios": ids.hexdigest()}


def flatten(values: Mapping[str, Any], prefix: str = "") -> dict[str, Any]:
    """Nested settings by their dotted names."""
    flat: dict[str, Any] = {}
    for name, value in values.items():
        flat |= flatten(value, f"{prefix}{name}.") if isinstance(value, Mapping) else {f"{prefix}{name}": value}
    return flat


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
    """Versions, machine, command line and the commit of a checkout."""
    return {
        "command": " ".join(sys.argv),
        "python": platform.python_version(),
        "machine": f"{platform.system()} {platform.machine()}, {os.cpu_count()} cores",
        "packages": {"rlftsim": __version__, **{name: version(name) for name in PACKAGES}},
        "commit": _commit(),
    }


def _commit() -> str | None:
    """Commit of the checkout this package runs from; None where it is installed."""
    command = ["git", "-C", str(Path(__file__).parent), "describe", "--always", "--dirty", "--abbrev=12"]
    try:
        return subprocess.run(command, capture_output=True, text=True, timeout=5, check=True).stdout.strip() or None
    except (OSError, subprocess.SubprocessError):
        return None


def _some_of(names: Sequence[str], most: int = 8) -> str:
    """Names in a line, not too many of them."""
    rest = f" and {len(names) - most} more" if len(names) > most else ""
    return f"{', '.join(names[:most])}{rest}"


class RunFolder:
    """Opens a run's folder for the first time or to go on. Only the process of rank 0 writes.

    Raises:
        CheckpointError: the folder belongs to a run with another configuration.
    """

    def __init__(self, path: Path, config: Any, inputs: Mapping[str, str] | None = None, *, writes: bool = True):
        self.path = path
        self.checkpoints = path / "checkpoints"
        self.model = path / "model"
        self._writes = writes
        self._metrics = path / "metrics.jsonl"
        self._board: SummaryWriter | None = None
        plain = {**to_plain(config), **(inputs or {})}
        self._refuse_other(plain)
        if writes:
            write_text(path / "config.json", json.dumps(plain, indent=1) + "\n")
            write_text(path / "environment.json", json.dumps(describe_environment(), indent=1) + "\n")

    def _refuse_other(self, config: Any) -> None:
        path = self.path / "config.json"
        if not path.exists():
            return
        try:
            old, new = flatten(json.loads(path.read_text())), flatten(config)
        except (ValueError, AttributeError) as error:
            raise CheckpointError(f"{path}: damaged ({error}): remove the folder {self.path} to start anew.") from None
        differing = sorted(k for k in old.keys() | new.keys() if not may_change(k) and old.get(k) != new.get(k))
        if differing:
            raise CheckpointError(
                f"{self.path} belongs to a run with other settings or inputs ({_some_of(differing)}): "
                "name another --out, or remove the folder to start anew."
            )

    def diverged(self, cause: str, remedy: str) -> CheckpointError:
        """The error of a run that makes no sense any more; names its last good checkpoint."""
        newest = newest_checkpoint(self.checkpoints)
        return CheckpointError(f"{self.path}: {cause}. The last good checkpoint is {newest or 'none'}: {remedy}.")

    def continue_from(self, update: int) -> None:
        """Drop the metrics of updates that will be done again."""
        if not self._writes:
            return
        if self._metrics.exists():
            lines = self._metrics.read_text().splitlines()
            kept = [line for line in lines if _update_of(line) <= update]
            write_text(self._metrics, "".join(f"{line}\n" for line in kept))
        self._board = SummaryWriter(str(self.path / "tensorboard"), purge_step=update + 1)

    def log(self, update: int, values: Mapping[str, float]) -> None:
        """Add a line of metrics."""
        if not self._writes:
            return
        with self._metrics.open("a") as file:
            file.write(json.dumps({"update": update, "time": round(time.time(), 3), **values}) + "\n")
        if self._board is not None:
            for name, value in values.items():
                self._board.add_scalar(board_tag(name), value, update)

    def close(self) -> None:
        """Flush what is pending."""
        if self._board is not None:
            self._board.close()


def read_metrics(path: Path) -> list[dict[str, Any]]:
    """The metrics of a run's folder, a dictionary an update; empty where there are none."""
    metrics = path / "metrics.jsonl"
    lines = metrics.read_text().splitlines() if metrics.exists() else []
    return [json.loads(line) for line in lines if math.isfinite(_update_of(line))]


def _update_of(line: str) -> float:
    """Update of a line of metrics; infinite for a line that a kill cut short, or that is none."""
    try:
        return float(json.loads(line)["update"])
    except (ValueError, KeyError, TypeError):
        return float("inf")

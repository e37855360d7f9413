"""Flags of the verbs whose work can be spread over processes and machines (docs/machines.md)."""

from dataclasses import dataclass
from pathlib import Path

from rlftsim.errors import ConfigError
from rlftsim.jobs.runner import Inline, OnDeath, Processes, Runner, Share


@dataclass(frozen=True)
class Machines:
    """The machines that do the work, beside the processes of this machine (--jobs)."""

    share: str | None = None
    """Do every N-th piece of the work only, from the K-th on: "3/64" on one of 64 machines. The last one puts the
    result together."""
    ray: str | None = None
    """Work on a Ray cluster: its address, or "auto" (pip install "rlftsim[ray]")."""
    item_log: Path | None = None
    """Add a line of JSON to this file for each piece of the work that is finished: its name, seconds and machine."""

    def runner(self, jobs: int, on_death: OnDeath) -> Runner | None:
        """Runner of the flags; None = the verb's own choice of processes.

        Args:
            jobs: processes of this machine.
            on_death: of an item whose process dies.

        Raises:
            ConfigError: a share that is none, both flags, or Ray is not installed.
        """
        if self.share is not None and self.ray is not None:
            raise ConfigError("--share and --ray are two ways to use several machines: choose one.")
        if self.ray is not None:
            from rlftsim.jobs.ray import RayRunner

            return RayRunner(self.ray, on_death, self.item_log)
        here = Processes(jobs, on_death, self.item_log) if jobs > 1 else Inline(self.item_log)
        if self.share is None:
            return here if self.item_log else None
        return Share.parse(self.share, here)


@dataclass(frozen=True)
class Work(Machines):
    """The same for a verb that reads no damaged files of its own."""

    on_error: OnDeath = "skip"
    """When a process dies three times at the same piece (out of memory, a crash): set that piece aside, do the others
    and end with status 1, or stop at the first death."""

    def runner(self, jobs: int, on_death: OnDeath) -> Runner | None:
        """Runner of the flags, see `Machines`."""
        stops = on_death == "stop" and jobs > 1 and self.share is None and self.ray is None
        return Processes(jobs, on_death, self.item_log) if stops else super().runner(jobs, on_death)

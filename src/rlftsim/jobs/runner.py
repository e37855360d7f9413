"""Independent items of work, done by this process, by several processes, or by many machines.

    Inline()                this process
    Processes(4)            four processes of this machine (`rlftsim.jobs.processes`)
    Share(3, 64, runner)    every 64th item, from the third on; other machines do the rest (`--share 3/64`)
    RayRunner("auto")       a Ray cluster (`rlftsim.jobs.ray`, the extra "ray")

`Machines` and `Work` are the flags of commands that choose between runners (docs/machines.md).
"""

import math
import os
import socket
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

from rlftsim.errors import ConfigError, NotYetError, RlftsimError, whole_number
from rlftsim.jobs.processes import Advance, OnDeath, Processes, Task, check_log, log_item

CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")
"""Microseconds of processor time that a container has in a period, and the period; "max" = no limit."""


class Unfinished(RlftsimError):
    """This share is done, and other shares are not."""

    exit_status = 0


@runtime_checkable
class Runner(Protocol):
    """Does independent items of work somewhere."""

    def run(
        self, task: Task, items: Sequence[Any], *, advance: Advance, describe: Callable[[Any], str] = str
    ) -> list[Any]:
        """Call a task for every item; results in the items' order.

        The first error, and Ctrl-C, stop all other items. A task that has to give up may return or raise.

        Args:
            task: Function of an item; must be picklable where other processes call it. Called again for an item if the
                process died.
            items: Arguments of the calls, each independent of all other calls.
            advance: Callback for the progress that tasks report, in units of the work; negative where a dead process
                had reported some.
            describe: Name of an item in messages and in the log of finished items.

        Raises:
            ConfigError: The task cannot be handed to another process, or a script has no main guard around this call.
            SetAside: Some items ended a process again and again; raised when all other items are done.
        """
        ...


def usable_cores() -> int:
    """Cores this process may run on, within the quota of the container."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = (int(number) for number in CPU_QUOTA.read_text().split())
    except (OSError, ValueError):
        return cores
    return min(cores, max(math.ceil(quota / period), 1))


def check_jobs(jobs: int, device: Any, setting: str = "evaluate.jobs") -> None:
    """Check a number of processes; a policy on a GPU is used by a single one.

    Args:
        jobs: Number of processes, at least 1.
        device: Device of the policy; several processes need "cpu".
        setting: Name of the setting, for messages.

    Raises:
        ConfigError: No process, or several processes and a GPU.
    """
    whole_number(setting, jobs, 1)
    if jobs > 1 and device.type != "cpu":
        raise ConfigError(
            f"{setting}={jobs} works on CPUs only, the policy is on {device}: use --jobs 1 or --device cpu."
        )


@dataclass(frozen=True)
class Inline:
    """This process, item by item."""

    item_log: Path | None = None
    """See `log_item`."""

    def run(
        self, task: Task, items: Sequence[Any], *, advance: Advance, describe: Callable[[Any], str] = str
    ) -> list[Any]:
        """Results of all items, see `Runner`."""
        results = []
        for item in items:
            start = time.monotonic()
            results.append(task(item, advance, lambda: False))
            log_item(self.item_log, describe(item), time.monotonic() - start, socket.gethostname())
        return results


@dataclass(frozen=True)
class Share:
    """Every `count`-th item from number `number` on, counted from 1."""

    number: int
    count: int
    runner: Runner

    @classmethod
    def parse(cls, text: str, runner: Runner) -> "Share | Joining":
        """The share that a command line names, "3/64", or "join" for none.

        Args:
            text: Number of the share and number of all shares with a slash between, or "join".
            runner: Runner of the items in the share, on this machine.

        Raises:
            ConfigError: The text is neither, or the number is not within the count.
        """
        if text == "join":
            return Joining()
        number, slash, count = text.partition("/")
        if not (slash and number.isdecimal() and count.isdecimal() and int(count) > 0):
            raise ConfigError(f"--share {text} is no share: write the number and how many there are, such as 3/64.")
        if not 1 <= int(number) <= int(count):
            raise ConfigError(f"--share {text}: shares are counted from 1 to {count}.")
        return cls(int(number), int(count), runner)

    def __str__(self) -> str:
        return f"share {self.number}/{self.count}"

    def run(
        self, task: Task, items: Sequence[Any], *, advance: Advance, describe: Callable[[Any], str] = str
    ) -> list[Any]:
        """Results of some items, see `Runner`."""
        return self.runner.run(task, items, advance=advance, describe=describe)


@dataclass(frozen=True)
class Joining(Inline):
    """No item: only puts together the results of shares (`rlftsim join`)."""


def select_items(runner: Runner, items: Sequence[Any]) -> Sequence[Any]:
    """The items that a runner does, of all items of the work; other machines do the rest."""
    if isinstance(runner, Share):
        return items[runner.number - 1 :: runner.count]
    return items[:0] if isinstance(runner, Joining) else items


def choose_runner(jobs: int, num_items: int, on_death: OnDeath = "skip") -> Runner:
    """Runner for a number of processes of this machine: this process where that is enough.

    Args:
        jobs: Number of processes; at most `num_items` are started.
        num_items: Number of items in the whole work, finished items included.
        on_death: "skip" sets an item aside that ended `ATTEMPTS` processes, "stop" raises at the first death.
    """
    jobs = min(jobs, num_items)
    return Processes(jobs, on_death) if jobs > 1 else Inline()


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
            jobs: Number of processes of this machine, for all items or for the items of the share.
            on_death: "skip" sets an item aside that ended `ATTEMPTS` processes, "stop" raises at the first death.

        Raises:
            ConfigError: A text that is no share, both flags, a log that is a file of other content, or Ray is not
                installed.
        """
        if self.share is not None and self.ray is not None:
            raise ConfigError("--share and --ray are two ways to use several machines: choose one.")
        if self.item_log is not None:
            check_log(self.item_log)
        if self.ray is not None:
            from rlftsim.jobs.ray import RayRunner

            return RayRunner(self.ray, on_death, self.item_log)
        runner = Processes(jobs, on_death, self.item_log) if jobs > 1 else Inline(self.item_log)
        if self.share is None:
            return runner if self.item_log else None
        return Share.parse(self.share, runner)


@dataclass(frozen=True)
class Work(Machines):
    """The same flags for a verb that reads no damaged files."""

    on_error: OnDeath = "skip"
    """When a process dies three times at the same piece (out of memory, a crash): set that piece aside, do the others
    and end with status 1, or stop at the first death."""

    def runner(self, jobs: int, on_death: OnDeath) -> Runner | None:
        """Runner of the flags, see `Machines`."""
        runner = super().runner(jobs, on_death)
        return Processes(jobs, on_death) if runner is None and on_death == "stop" and jobs > 1 else runner


def check_begun(runner: Runner, folder: Path) -> None:
    """Check that there are results to put together, before a folder is made.

    Args:
        runner: Runner of the work; only `Joining` needs results of other processes.
        folder: Folder in which the shares store their results.

    Raises:
        NotYetError: Finished items are wanted alone, and the folder is not there.
    """
    if isinstance(runner, Joining) and not folder.exists():
        raise NotYetError(f"{folder} is not there, so no share has begun: check the path, or run the shares.")


def check_finished(runner: Runner, num_missing: int, num_items: int, title: str) -> None:
    """Check that every item is done, before the result is put together.

    Args:
        runner: Runner that has done the selected items.
        num_missing: Number of items without a result in the folder.
        num_items: Number of items over all shares.
        title: Name of the work at the beginning of messages, such as "evaluate base".

    Raises:
        Unfinished: This share is done, other shares are not.
        NotYetError: Results are missing that should be there.
    """
    if not num_missing:
        return
    if isinstance(runner, Share):
        raise Unfinished(
            f"{title}: {runner} is done; {num_missing} of {num_items} pieces are left to other shares. The last share "
            "puts the result together; if it was stopped, `rlftsim join` and the same command do."
        )
    if isinstance(runner, Joining):
        raise NotYetError(
            f"{title}: {num_missing} of {num_items} pieces are missing: run the shares again that have not ended with "
            "status 0, or the command without `join` to do the rest here."
        )
    raise NotYetError(f"{title}: finished pieces vanished meanwhile (another process in the same folder?): run again.")

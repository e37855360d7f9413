"""Independent pieces of work, done by whatever is there: this process, several, or one of many machines.

    Inline()                this process
    Processes(4)            four processes of this machine
    Share(3, 64, runner)    every 64th item, from the third on; other machines do the others (`--share 3/64`)
    RayRunner("auto")       a Ray cluster (`rlftsim.jobs.ray`, the extra "ray")

Each piece writes a file of its own, and the same one whenever it is done again. So it does not matter where it is
done, nor how often: a run that was stopped in any way is resumed by doing the pieces that have no file.
"""

import ast
import inspect
import json
import math
import multiprocessing
import os
import pickle
import signal
import socket
import sys
import threading
import time
import traceback
from collections import Counter, deque
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from datetime import UTC, datetime
from multiprocessing import resource_tracker
from multiprocessing.connection import Connection, wait
from multiprocessing.process import BaseProcess
from pathlib import Path
from typing import Any, Literal, Protocol, runtime_checkable

from rlftsim.errors import ConfigError, DataError, NotYetError, RlftsimError
from rlftsim.jobs.files import append_text
from rlftsim.jobs.interruption import ctrl_c_blocked
from rlftsim.jobs.progress import log
from rlftsim.jobs.threads import keep_freed_memory

Advance = Callable[[int], None]
Task = Callable[[Any, Advance, Callable[[], bool]], Any]
"""Called with an item, a function that reports progress, and one that returns True when the task should give up."""
OnDeath = Literal["skip", "stop"]
"""An item whose worker process dies: try it again and set it aside after `ATTEMPTS`, or stop at the first death."""
ATTEMPTS = 3
OUT_OF_MEMORY = 137
"""Exit status of a worker without memory: that of a process that the system has killed for it."""
CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")
"""Microseconds of processor time that a container has in a period, and the period; "max" = no limit."""


class SetAside(RlftsimError):
    """Items that killed their worker processes again and again; all others are done."""

    exit_status = 1

    def __init__(self, reasons: dict[str, str]) -> None:
        listed = "; ".join(f"{name} ({reason})" for name, reason in reasons.items())
        super().__init__(
            f"{len(reasons)} pieces of the work ended their process {ATTEMPTS} times and are set aside: {listed}. All "
            "others are done: run the same command again to try these, with fewer --jobs if memory is short."
        )


class Unfinished(RlftsimError):
    """This share is done, and others are not."""

    exit_status = 0


@runtime_checkable
class Runner(Protocol):
    """Does independent items of work somewhere."""

    def own(self, items: Sequence[Any]) -> Sequence[Any]:
        """Those of all items that this runner does; the others are another machine's."""
        ...

    def run(
        self, task: Task, items: Sequence[Any], *, advance: Advance, name_of: Callable[[Any], str] = str
    ) -> list[Any]:
        """Call `task` for every item; results in the items' order.

        The first error, and Ctrl-C, stop all the others. A task that has to give up may return or raise as it likes.

        Args:
            task: can be pickled, if other processes call it. Called again for an item whose process died.
            items: one for each call.
            advance: called with the progress that tasks report.
            name_of: an item as messages show it.

        Raises:
            ConfigError: the task cannot be handed to another process, or a script calls this without the main guard.
            SetAside: some items ended their process again and again; raised when all others are done.
        """
        ...


def usable_cores() -> int:
    """Cores this process may run on, within the quota of its container."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = (int(number) for number in CPU_QUOTA.read_text().split())
    except (OSError, ValueError):
        return cores
    return min(cores, max(math.ceil(quota / period), 1))


def log_item(path: Path | None, name: str, seconds: float, machine: str) -> None:
    """Add a line of JSON about a finished item to a file.

    Args:
        path: of the file; None = there is none.
        name: of the item.
        seconds: that it took.
        machine: that did it.

    Raises:
        DataError: the file cannot be written.
    """
    if path is not None:
        done = datetime.now(UTC).isoformat(timespec="seconds")
        values = {"item": name, "seconds": round(seconds, 2), "machine": machine, "done": done}
        append_text(path, json.dumps(values) + "\n")


@dataclass(frozen=True)
class Inline:
    """This process, one item after another."""

    item_log: Path | None = None
    """See `log_item`."""

    def own(self, items: Sequence[Any]) -> Sequence[Any]:
        """All items, see `Runner`."""
        return items

    def run(
        self, task: Task, items: Sequence[Any], *, advance: Advance, name_of: Callable[[Any], str] = str
    ) -> list[Any]:
        """Results of all items, see `Runner`."""
        results = []
        for item in items:
            start = time.monotonic()
            results.append(task(item, advance, lambda: False))
            log_item(self.item_log, name_of(item), time.monotonic() - start, socket.gethostname())
        return results


@dataclass(frozen=True)
class Share:
    """Every `of`-th item from number `number` on, counted from 1."""

    number: int
    of: int
    runner: Runner

    @classmethod
    def parse(cls, text: str, runner: Runner) -> "Share | Joining":
        """The share that a command line names, "3/64", or "join" for none.

        Args:
            text: number and count, or "join".
            runner: does the items of the share.

        Raises:
            ConfigError: something else.
        """
        if text == "join":
            return Joining()
        number, slash, of = text.partition("/")
        if not (slash and number.isdecimal() and of.isdecimal() and int(of) > 0):
            raise ConfigError(f"--share {text} is no share: write the number and how many there are, such as 3/64.")
        if not 1 <= int(number) <= int(of):
            raise ConfigError(f"--share {text}: shares are counted from 1 to {of}.")
        return cls(int(number), int(of), runner)

    def __str__(self) -> str:
        return f"share {self.number}/{self.of}"

    def own(self, items: Sequence[Any]) -> Sequence[Any]:
        """The items of this share, see `Runner`."""
        return items[self.number - 1 :: self.of]

    def run(
        self, task: Task, items: Sequence[Any], *, advance: Advance, name_of: Callable[[Any], str] = str
    ) -> list[Any]:
        """Results of some items, see `Runner`."""
        return self.runner.run(task, items, advance=advance, name_of=name_of)


@dataclass(frozen=True)
class Joining(Inline):
    """No item: only puts together what shares have made (`rlftsim join`)."""

    def own(self, items: Sequence[Any]) -> Sequence[Any]:
        """No items, see `Runner`."""
        return items[:0]


def on_this_machine(jobs: int, num_items: int, on_death: OnDeath = "skip") -> Runner:
    """Runner for a number of processes: this one where one is enough.

    Args:
        jobs: processes.
        num_items: pieces of the whole work, those that are done already included.
        on_death: see `OnDeath`.
    """
    jobs = min(jobs, num_items)
    return Processes(jobs, on_death) if jobs > 1 else Inline()


def require_begun(runner: Runner, folder: Path) -> None:
    """Stop before a folder is made where there is nothing to put together.

    Args:
        runner: that is to do items.
        folder: of the pieces.

    Raises:
        NotYetError: only finished pieces are wanted, and the folder is not there.
    """
    if isinstance(runner, Joining) and not folder.exists():
        raise NotYetError(f"{folder} is not there, so no share has begun: check the path, or run the shares.")


def require_finished(runner: Runner, num_left: int, num_items: int, title: str) -> None:
    """Stop before the result is put together where pieces of it are missing.

    Args:
        runner: that did its items.
        num_left: pieces that are not there.
        num_items: all pieces.
        title: of the work.

    Raises:
        Unfinished: this share is done, others are not.
        NotYetError: pieces are missing that should be there.
    """
    if not num_left:
        return
    if isinstance(runner, Share):
        raise Unfinished(
            f"{title}: {runner} is done; {num_left} of {num_items} pieces are left to other shares. The last share "
            "puts the result together; if it was stopped, `rlftsim join` and the same command do."
        )
    if isinstance(runner, Joining):
        raise NotYetError(
            f"{title}: {num_left} of {num_items} pieces are missing: run the shares again that have not ended with "
            "status 0, or the command without `join` to do the rest here."
        )
    raise NotYetError(f"{title}: finished pieces vanished meanwhile (another process in the same folder?): run again.")


class Attempts:
    """Items that wait for a process, and those set aside after ending theirs again and again.

    Args:
        items: of the work.
        name_of: name of an item in messages.
    """

    def __init__(self, items: Sequence[Any], name_of: Callable[[Any], str]) -> None:
        self._items, self._name_of = items, name_of
        self._deaths = Counter[int]()
        self.waiting = deque(range(len(items)))
        self.set_aside: dict[str, str] = {}
        """Name of the item -> reason."""

    def again(self, number: int, reason: str, *, counts: bool = True) -> None:
        """Try an item first of all again, or set it aside.

        Args:
            number: of the item.
            reason: of the end of its process.
            counts: False = the item had no part in it.
        """
        name = self._name_of(self._items[number])
        self._deaths[number] += counts
        if self._deaths[number] < ATTEMPTS:
            log.warning(f"the process of {name} died ({reason}): trying again.")
            self.waiting.appendleft(number)
        else:
            self.set_aside[name] = reason


@dataclass(frozen=True)
class Processes:
    """Several processes of this machine, each with one thread. They end with the process that started them.

    A process may be killed at any moment: it shares no lock with the others, and its item is done again by a new one.
    """

    jobs: int
    on_death: OnDeath = "skip"
    item_log: Path | None = None
    """See `log_item`."""

    def own(self, items: Sequence[Any]) -> Sequence[Any]:
        """All items, see `Runner`."""
        return items

    def run(
        self, task: Task, items: Sequence[Any], *, advance: Advance, name_of: Callable[[Any], str] = str
    ) -> list[Any]:
        """Results of all items, see `Runner`."""
        if not items:
            return []
        _refuse_unguarded_main()
        pickled = pickle_task(task)
        results: dict[int, Any] = {}
        attempts = Attempts(items, name_of)
        waiting = attempts.waiting
        crew: dict[Any, _Worker] = {}
        failed_starts = 0
        with ctrl_c_blocked():
            resource_tracker.ensure_running()  # apart from the others: starting it unblocks Ctrl-C
        try:
            while (num_left := len(items) - len(results) - len(attempts.set_aside)) > 0:
                with ctrl_c_blocked():
                    while len(crew) < min(self.jobs, num_left):
                        worker = _Worker()
                        crew[worker.line] = worker
                for worker in crew.values():
                    if worker.is_idle and waiting:
                        worker.give(pickle.dumps(items[waiting[0]]), waiting.popleft())
                for line in wait(list(crew)):
                    worker = crew[line]
                    kind, value = worker.read()
                    if kind == "error":
                        raise value
                    if kind == "progress":
                        worker.progress += value
                        advance(value)
                    elif kind == "result" and worker.item is not None:
                        results[worker.item] = value
                        seconds = time.monotonic() - worker.since
                        log_item(self.item_log, name_of(items[worker.item]), seconds, socket.gethostname())
                        worker.item, worker.progress = None, 0
                    elif kind == "idle" and not worker.has_task:
                        worker.give(pickled, None)
                    elif kind == "idle":
                        worker.is_idle, failed_starts = True, 0
                    elif kind == "death":
                        del crew[line]
                        advance(-worker.progress)
                        failed_starts += not worker.was_ready
                        if failed_starts == ATTEMPTS or (self.on_death == "stop" and worker.item is not None):
                            raise DataError(_DIED.format(value))
                        if worker.item is not None:
                            attempts.again(worker.item, value)
        finally:
            # A closed line is the sign to stop.
            for worker in crew.values():
                worker.line.close()
                if worker.is_starting:
                    worker.process.kill()  # it would import everything first, and has written nothing
            for worker in crew.values():
                worker.process.join()
        if attempts.set_aside:
            raise SetAside(attempts.set_aside)
        return [results[number] for number in range(len(items))]


_DIED = (
    'a worker process died ({}; out of memory, or the script lacks `if __name__ == "__main__":`?): '
    "run the same command again, it resumes."
)


def pickle_task(task: Task, dumps: Callable[[Task], bytes] = pickle.dumps) -> bytes:
    """A task by value, for other processes.

    Args:
        task: of all items.
        dumps: makes bytes that `pickle` reads.

    Raises:
        ConfigError: it holds something that cannot be handed over.
    """
    try:
        # By value: torch's own way between processes shares memory through file descriptors, which run out.
        return dumps(task)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ConfigError(f"this work cannot be handed to other processes ({error}): set jobs=1.") from error


class _Worker:
    """A process and the line to it, at this end."""

    def __init__(self) -> None:
        # Spawned, not forked: a forked process inherits locks of torch's threads and may wait for them forever.
        context = multiprocessing.get_context("spawn")
        self.line, far_end = context.Pipe()
        self.process: BaseProcess = context.Process(target=_work, args=(far_end,))
        self.process.start()
        far_end.close()  # so that the line ends with the process
        self.has_task = self.is_idle = self.was_ready = False
        self.item: int | None = None
        self.progress = 0
        """Reported since the item was begun."""
        self.since = 0.0
        """Moment at which the item was begun, `time.monotonic`."""

    @property
    def is_starting(self) -> bool:
        """True until the process has read the task."""
        return not (self.is_idle or self.was_ready)

    def give(self, message: bytes, item: int | None) -> None:
        """Send the task, or an item of a number."""
        self.was_ready, self.has_task, self.is_idle, self.item = self.has_task, True, False, item
        self.since = time.monotonic()
        with suppress(OSError):  # the process is gone: reading says so
            self.line.send_bytes(message)

    def read(self) -> tuple[str, Any]:
        """The next message: its kind and value; "death" and its reason where the process is gone."""
        try:
            return pickle.loads(self.line.recv_bytes())
        except (EOFError, OSError):
            self.process.join()
            return "death", _reason(self.process.exitcode)


def portable_error(error: Exception) -> Exception:
    """The error that is being handled as another process can read it; a bug's has its traceback as a note."""
    if not isinstance(error, RlftsimError):
        error.add_note(traceback.format_exc())
    try:
        pickle.loads(pickle.dumps(error))  # some errors can be pickled and not be read back
    except Exception:
        return RuntimeError(traceback.format_exc())
    return error


def _reason(status: int | None) -> str:
    """Cause of a process's end in words."""
    if status == OUT_OF_MEMORY:
        return "out of memory"
    if status is not None and status < 0:
        killer = " by the system, which may be out of memory" if status == -signal.SIGKILL else ""
        return f"killed with {signal.Signals(-status).name}{killer}"
    return f"exit status {status}"


def _refuse_unguarded_main() -> None:
    """Refuse a script that starts processes at its top level: each of them would run the whole script again.

    A spawned process imports the main module of the one that started it. Without the guard it comes to the same
    call, and Python stops it there with a long traceback about its "bootstrapping phase".
    """
    main = sys.modules["__main__"]
    file = getattr(main, "__file__", None)
    frame = inspect.currentframe()
    while frame is not None and not (frame.f_globals is vars(main) and frame.f_code.co_name == "<module>"):
        frame = frame.f_back
    # Not imported again: a notebook, `python -c`, and the `__main__` of a package (`python -m rlftsim`).
    name = main.__spec__.name if main.__spec__ else ""
    if file is None or frame is None or name.endswith(".__main__"):
        return
    try:
        statements = ast.parse(Path(file).read_text(encoding="utf-8")).body
    except (OSError, SyntaxError, ValueError):
        return
    # The statement of the script that is being executed: guarded if it is an `if` about __name__.
    line = frame.f_lineno
    for statement in statements:
        if statement.lineno <= line <= (statement.end_lineno or statement.lineno):
            is_guarded = isinstance(statement, ast.If) and "__name__" in ast.unparse(statement.test)
            if not is_guarded:
                raise ConfigError(
                    f'{file}, line {line}, starts other processes: put it under `if __name__ == "__main__":`, '
                    "as each of them imports the script again, or set jobs=1."
                )


def _work(line: Connection) -> None:
    """Main function of a worker process: the task first, then an item after each other until the line is closed."""
    threading.Thread(target=exit_with_parent, daemon=True).start()
    keep_freed_memory()
    os.environ["OMP_NUM_THREADS"] = "1"  # read when torch is imported, which unpickling the task may do

    def say(kind: str, value: Any = None) -> None:
        line.send_bytes(pickle.dumps((kind, value)))

    with suppress(EOFError, OSError):
        say("idle")
        task = None
        while True:
            message = line.recv_bytes()
            try:
                if task is None:
                    task = pickle.loads(message)
                else:
                    # Nothing is sent to a worker that works, so anything at the line is its end.
                    say("result", task(pickle.loads(message), lambda count: say("progress", count), line.poll))
            except MemoryError:
                os._exit(OUT_OF_MEMORY)  # a new process may have enough
            except Exception as error:
                say("error", portable_error(error))
            say("idle")


def exit_with_parent() -> None:
    """End this process when its parent is killed, so that no orphan writes beside the run that follows."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)

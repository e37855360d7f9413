"""Items of work in several processes of this machine, each with a single thread.

A process may be killed at any moment: no lock is shared, and a new process does the item again. An item that ends a
process again and again is set aside.
"""

import ast
import inspect
import json
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
from typing import Any, Literal

from rlftsim.errors import ConfigError, DataError, RlftsimError, find_package_error
from rlftsim.jobs.files import append_text, errors_name
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


class SetAside(RlftsimError):
    """Items that killed worker processes again and again; all other items are done."""

    exit_status = 1

    def __init__(self, reasons: dict[str, str]) -> None:
        listed = "; ".join(f"{name} ({reason})" for name, reason in reasons.items())
        super().__init__(
            f"{len(reasons)} pieces of the work ended their process {ATTEMPTS} times and are set aside: {listed}. All "
            "others are done: run the same command again to try these, with fewer --jobs if memory is short."
        )


_LOG_BEGINNING = b'{"item": '


def log_item(path: Path | None, name: str, seconds: float, machine: str) -> None:
    """Add a line of JSON about a finished item to a file.

    Args:
        path: Log file, created if missing; None = no log.
        name: Name of the item, as in messages about a process that died.
        seconds: Duration of the last attempt, from handing the item over to having the result.
        machine: Host name, or the address in a Ray cluster, of the machine that did the item.

    Raises:
        DataError: The file cannot be written.
    """
    if path is not None:
        done = datetime.now(UTC).isoformat(timespec="seconds")
        values = {"item": name, "seconds": round(seconds, 2), "machine": machine, "done": done}
        append_text(path, json.dumps(values) + "\n")


def check_log(path: Path) -> None:
    """Check that a file to which lines about items will be added holds such lines, or is missing or empty.

    Args:
        path: File of `log_item`; a device or pipe passes.

    Raises:
        ConfigError: A file of other content, which the lines would damage.
    """
    if path.is_file():
        with errors_name(path), open(path, "rb") as file:
            if file.read(len(_LOG_BEGINNING)) not in (b"", _LOG_BEGINNING):
                raise ConfigError(f"{path} is no log of items: name another file by --item-log.")


class Attempts:
    """Items that wait for a process, and those set aside after ending `ATTEMPTS` processes.

    Args:
        items: Items of the work, all of which wait at first, in this order.
        describe: Name of an item, for warnings and for the list of those set aside.
    """

    def __init__(self, items: Sequence[Any], describe: Callable[[Any], str]) -> None:
        self._items, self._describe = items, describe
        self._deaths = Counter[int]()
        self.waiting = deque(range(len(items)))
        self.set_aside: dict[str, str] = {}
        """Name of the item -> reason."""

    def retry(self, number: int, reason: str, *, is_to_blame: bool = True) -> None:
        """Let an item wait again, before all other items, or set the item aside.

        Args:
            number: Index of the item in the list of all items.
            reason: Cause of the end of the process, in words.
            is_to_blame: False where the item had no part in the end, such as a machine that left the cluster; the
                attempt is not counted.
        """
        name = self._describe(self._items[number])
        self._deaths[number] += is_to_blame
        if self._deaths[number] < ATTEMPTS:
            log.warning(f"the process of {name} died ({reason}): trying again.")
            self.waiting.appendleft(number)
        else:
            self.set_aside[name] = reason


@dataclass(frozen=True)
class Processes:
    """Several processes of this machine, which end with the process that started them all."""

    jobs: int
    on_death: OnDeath = "skip"
    item_log: Path | None = None
    """See `log_item`."""

    def run(
        self, task: Task, items: Sequence[Any], *, advance: Advance, describe: Callable[[Any], str] = str
    ) -> list[Any]:
        """Results of all items, see `Runner`."""
        if not items:
            return []
        _check_main_guard()
        pickled = pickle_task(task)
        results: dict[int, Any] = {}
        attempts = Attempts(items, describe)
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
                        worker.send(pickle.dumps(items[waiting[0]]), waiting.popleft())
                for line in wait(list(crew)):
                    worker = crew[line]
                    event, value = worker.read()
                    if event == "error":
                        raise value
                    if event == "progress":
                        worker.progress += value
                        advance(value)
                    elif event == "result" and worker.item is not None:
                        results[worker.item] = value
                        seconds = time.monotonic() - worker.since
                        log_item(self.item_log, describe(items[worker.item]), seconds, socket.gethostname())
                        worker.item, worker.progress = None, 0
                    elif event == "idle" and not worker.has_task:
                        worker.send(pickled, None)
                    elif event == "idle":
                        worker.is_idle, failed_starts = True, 0
                    elif event == "death":
                        del crew[line]
                        advance(-worker.progress)
                        failed_starts += not worker.was_ready
                        if failed_starts == ATTEMPTS or (self.on_death == "stop" and worker.item is not None):
                            raise DataError(_DIED.format(value))
                        if worker.item is not None:
                            attempts.retry(worker.item, value)
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
        task: Function of an item, with all data that the work on any item needs: model, data set, settings.
        dumps: Maker of bytes that `pickle.loads` reads, such as cloudpickle's for functions of the main module.

    Raises:
        ConfigError: The task holds an object that cannot be handed over.
    """
    try:
        # By value: torch's own way between processes shares memory through file descriptors, which run out.
        return dumps(task)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ConfigError(f"this work cannot be handed to other processes ({error}): set jobs=1.") from error


class _Worker:
    """A process and this end of the line to that process."""

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

    def send(self, message: bytes, item: int | None) -> None:
        """Send the task, or an item of a number."""
        self.was_ready, self.has_task, self.is_idle, self.item = self.has_task, True, False, item
        self.since = time.monotonic()
        with suppress(OSError):  # the process is gone: reading says so
            self.line.send_bytes(message)

    def read(self) -> tuple[str, Any]:
        """The next event and its value; "death" and the reason where the process is gone."""
        try:
            return pickle.loads(self.line.recv_bytes())
        except (EOFError, OSError):
            self.process.join()
            return "death", _describe_end(self.process.exitcode)


def portable_error(error: Exception) -> Exception:
    """The error that is being handled, in a form that other processes can read; a bug has the traceback as a note."""
    if not isinstance(error, RlftsimError):
        error = find_package_error(error) or error
        error.add_note(traceback.format_exc())
    try:
        pickle.loads(pickle.dumps(error))  # some errors can be pickled and not be read back
    except Exception:
        return RuntimeError(traceback.format_exc())
    return error


def _describe_end(status: int | None) -> str:
    """Cause of a process's end in words."""
    if status == OUT_OF_MEMORY:
        return "out of memory"
    if status is not None and status < 0:
        killer = " by the system, which may be out of memory" if status == -signal.SIGKILL else ""
        return f"killed with {signal.Signals(-status).name}{killer}"
    return f"exit status {status}"


def _check_main_guard() -> None:
    """Check that no script starts processes at the top level: each process would run the whole script again.

    A spawned process imports the main module of the process that started it. Without the guard the child comes to the
    same call, and Python stops there with a long traceback about the "bootstrapping phase".

    Raises:
        ConfigError: The statement that is being executed is not guarded; names file and line.
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
    running = [s for s in statements if s.lineno <= line <= (s.end_lineno or s.lineno)]
    if not all(isinstance(statement, ast.If) and "__name__" in ast.unparse(statement.test) for statement in running):
        raise ConfigError(
            f'{file}, line {line}, starts other processes: put it under `if __name__ == "__main__":`, as each of them '
            "imports the script again, or set jobs=1."
        )


def _work(line: Connection) -> None:
    """Main function of a worker process: the task first, then an item after each other until the line is closed."""
    threading.Thread(target=exit_with_parent, daemon=True).start()
    keep_freed_memory()
    os.environ["OMP_NUM_THREADS"] = "1"  # read when torch is imported, which unpickling the task may do

    def say(event: str, value: Any = None) -> None:
        line.send_bytes(pickle.dumps((event, value)))

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
    """End this process when the parent process is killed, so that no orphan writes beside the run that follows."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)

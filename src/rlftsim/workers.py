"""Work spread over processes that can be stopped at any time and never outlive the one that started them."""

import ast
import inspect
import math
import multiprocessing
import os
import pickle
import signal
import sys
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Event
from pathlib import Path
from typing import Any

from rlftsim.errors import ConfigError, DataError
from rlftsim.threads import keep_freed_memory

Advance = Callable[[int], None]
Task = Callable[[Any, Advance, Callable[[], bool]], Any]
"""Called with an item, a function that reports progress, and one that returns True when the task should give up."""


CPU_QUOTA = Path("/sys/fs/cgroup/cpu.max")
"""Microseconds of processor time that a container has in a period, and the period; "max" = no limit."""


def usable_cores() -> int:
    """Cores this process may run on, within the quota of its container."""
    cores = len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1
    try:
        quota, period = (int(number) for number in CPU_QUOTA.read_text().split())
    except (OSError, ValueError):
        return cores
    return min(cores, max(math.ceil(quota / period), 1))


def run_tasks(task: Task, items: Sequence[Any], *, jobs: int, advance: Advance) -> list[Any]:
    """Call `task` for every item, in this process or in several with one thread each; results in the items' order.

    The first error, and Ctrl-C, stop all the others. A task that has to give up may return or raise as it likes.

    Args:
        task: can be pickled, if there is more than one job.
        items: one for each call.
        jobs: processes; 1 = this one.
        advance: called with the progress that tasks report.

    Raises:
        ConfigError: the task cannot be handed to another process, or a script calls this without the main guard.
        DataError: a process died.
    """
    jobs = min(jobs, len(items))
    if jobs <= 1:
        return [task(item, advance, lambda: False) for item in items]
    _refuse_unguarded_main()
    try:
        # By value: torch's own way between processes shares memory through file descriptors, which run out.
        pickled = pickle.dumps(task)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ConfigError(f"this work cannot be handed to other processes ({error}): set jobs=1.") from error
    # Spawned, not forked: a forked process inherits locks of torch's threads and may wait for them forever.
    context = multiprocessing.get_context("spawn")
    line = _Line(context.Event(), context.SimpleQueue())
    with ProcessPoolExecutor(jobs, context, _start_worker, (pickled, line)) as pool:
        futures = [pool.submit(_work, item) for item in items]
        try:
            _wait(futures, line, advance)
            return [future.result() for future in futures]
        except BrokenProcessPool as error:
            raise DataError(
                "a worker process died (out of memory?): run the same command again, it resumes."
            ) from error
        finally:
            line.stop.set()
            pool.shutdown(wait=True, cancel_futures=True)


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


@dataclass(frozen=True)
class _Line:
    """Connection of a worker process to the one that started it."""

    stop: Event
    progress: "SimpleQueue[int]"


_task: Task  # of this process, if it is a worker
_line: _Line


def _start_worker(task: bytes, line: _Line) -> None:
    global _task, _line
    # Ctrl-C reaches the whole process group; only the parent reacts, and stops the workers by the event.
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    threading.Thread(target=exit_with_parent, daemon=True).start()
    keep_freed_memory()
    os.environ["OMP_NUM_THREADS"] = "1"  # read when torch is imported, which unpickling the task may do
    _task, _line = pickle.loads(task), line


def exit_with_parent() -> None:
    """End this process when its parent is killed, so that no orphan writes beside the run that follows."""
    parent = multiprocessing.parent_process()
    if parent is not None:
        parent.join()
        os._exit(1)


def _work(item: Any) -> Any:
    return _task(item, _line.progress.put, _line.stop.is_set)


def _wait(futures: Sequence[Future[Any]], line: _Line, advance: Advance) -> None:
    """Show progress until all are done or one failed, whose error is raised."""
    pending = set(futures)
    # A short timeout, so that progress is shown while all tasks are still at work.
    while pending:
        done, pending = wait(pending, timeout=0.2, return_when=FIRST_COMPLETED)
        while not line.progress.empty():
            advance(line.progress.get())
        for future in done:
            future.result()

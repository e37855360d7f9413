"""Work spread over processes that can be stopped at any time and never outlive the one that started them."""

import multiprocessing
import os
import pickle
import signal
import threading
from collections.abc import Callable, Sequence
from concurrent.futures import FIRST_COMPLETED, Future, ProcessPoolExecutor, wait
from concurrent.futures.process import BrokenProcessPool
from dataclasses import dataclass
from multiprocessing.queues import SimpleQueue
from multiprocessing.synchronize import Event
from typing import Any

from rlftsim.errors import ConfigError, DataError
from rlftsim.processor import keep_freed_memory

Advance = Callable[[int], None]
Task = Callable[[Any, Advance, Callable[[], bool]], Any]
"""Called with an item, a function that reports progress, and one that says whether to give up."""


def usable_cores() -> int:
    """Cores this process may run on."""
    return len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else os.cpu_count() or 1


def run_tasks(task: Task, items: Sequence[Any], *, jobs: int, advance: Advance) -> list[Any]:
    """Call `task` for every item, in this process or in several with one thread each; results in the order of the items.

    The first error, and Ctrl-C, stop all the others. A task that is told to give up may return or raise as it likes.

    Args:
        task: can be pickled, if there is more than one job.
        items: what to work on.
        jobs: processes; 1 = this one.
        advance: told the progress that tasks report.

    Raises:
        ConfigError: the task cannot be handed to another process.
        DataError: a process died.
    """
    jobs = min(jobs, len(items))
    if jobs <= 1:
        return [task(item, advance, lambda: False) for item in items]
    context = multiprocessing.get_context("spawn")
    line = _Line(context.Event(), context.SimpleQueue())
    with ProcessPoolExecutor(jobs, context, _start_worker, (_pickled(task), line)) as pool:
        futures = [pool.submit(_work, item) for item in items]
        try:
            _wait(futures, line, advance)
            return [future.result() for future in futures]
        except BrokenProcessPool as error:
            raise DataError(
                "a worker process died (out of memory?): run the same command again, it goes on."
            ) from error
        finally:
            line.stop.set()
            pool.shutdown(wait=True, cancel_futures=True)


@dataclass(frozen=True)
class _Line:
    """What connects a worker process to the one that started it."""

    stop: Event
    progress: "SimpleQueue[int]"


_task: Task  # of this process, if it is a worker
_line: _Line


def _pickled(task: Task) -> bytes:
    # by value: torch's own way between processes shares memory through file descriptors, which run out
    try:
        return pickle.dumps(task)
    except (pickle.PicklingError, AttributeError, TypeError) as error:
        raise ConfigError(f"this work cannot be handed to other processes ({error}): set jobs=1.") from error


def _start_worker(task: bytes, line: _Line) -> None:
    global _task, _line
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C reaches the whole group: the parent tells what to do
    threading.Thread(target=_exit_with_parent, daemon=True).start()
    keep_freed_memory()
    os.environ["OMP_NUM_THREADS"] = "1"  # read when torch is imported, which unpickling the task may do
    _task, _line = pickle.loads(task), line


def _exit_with_parent() -> None:
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
    while pending:
        done, pending = wait(pending, timeout=0.2, return_when=FIRST_COMPLETED)
        while not line.progress.empty():
            advance(line.progress.get())
        for future in done:
            future.result()

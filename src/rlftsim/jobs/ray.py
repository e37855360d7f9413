"""Work on a Ray cluster (the extra "ray"). No other module imports Ray.

Ray starts processes on the machines of the cluster and notices which processes die. All else is as with `Processes`:
each item writes a file in a folder that all machines see, and an item is done again if the process died.
"""

import hashlib
import logging
import os
import pickle
import socket
import time
from collections import Counter
from collections.abc import Callable, Sequence
from contextlib import suppress
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import rlftsim
from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.documents import first_line
from rlftsim.jobs.processes import (
    OUT_OF_MEMORY,
    Advance,
    Attempts,
    OnDeath,
    SetAside,
    Task,
    log_item,
    pickle_task,
    portable_error,
)
from rlftsim.jobs.progress import log

try:
    import ray
    from ray import cloudpickle
    from ray.exceptions import NodeDiedError, RayError
except ImportError as error:
    raise ConfigError('Ray is not installed: pip install "rlftsim[ray]", or use --jobs or --share.') from error

BYTES_OF_A_PROCESS = 6e8
"""Python, torch and a large scenario with a small model."""
BYTES_PER_BYTE_OF_A_TASK = 20.0
"""More memory for a larger model, whose weights are most of a task: 1.2 GB for those of SMART-tiny, 28 MB."""
ITEMS_PER_CORE = 4
"""Items handed to Ray for each core of the cluster; more would make its scheduler and this process grow."""
SECONDS_BETWEEN_REPORTS = 5.0
SECONDS_TO_STOP = 5.0

_tasks: dict[str, Task] = {}
"""The task of this worker process by its hash: model and data set stay open between items."""


@dataclass(frozen=True)
class RayRunner:
    """Processes of a Ray cluster, a process per core.

    Args:
        address: Address of the cluster, such as "10.0.0.1:6379"; "auto" = the cluster that runs on this machine.
        on_death: "skip" sets an item aside that ended `ATTEMPTS` processes, "stop" raises at the first death.
        item_log: File that gets a line of JSON for each finished item; None = no such file.
    """

    address: str = "auto"
    on_death: OnDeath = "skip"
    item_log: Path | None = None

    def run(
        self, task: Task, items: Sequence[Any], *, advance: Advance, describe: Callable[[Any], str] = str
    ) -> list[Any]:
        """Results of all items, see `Runner`.

        Raises:
            ConfigError: No such cluster, or a cluster with a different version of this package; see also `Runner`.
        """
        # Ray's pickle: processes of a cluster do not import the main module, in which a policy may be defined.
        pickled = pickle_task(task, cloudpickle.dumps)
        is_own_session = not ray.is_initialized()
        if is_own_session:
            try:
                # Ray itself ends this process where there is nothing at an address.
                host, colon, port = self.address.rpartition(":")
                if colon and port.isdecimal() and "/" not in host:
                    socket.create_connection((host, int(port)), timeout=10).close()
                ray.init(self.address, log_to_driver=False, logging_level=logging.ERROR)
            except (OSError, RuntimeError, ValueError) as error:
                raise ConfigError(
                    f"--ray {self.address}: no Ray cluster there ({first_line(error)}): `ray start` makes one."
                ) from None
        try:
            return self._run(pickled, items, advance, describe)
        finally:
            if is_own_session:
                ray.shutdown()

    def _run(self, pickled: bytes, items: Sequence[Any], advance: Advance, describe: Callable[[Any], str]) -> list[Any]:
        results: dict[int, Any] = {}
        attempts = Attempts(items, describe)
        waiting = attempts.waiting
        at_work: dict[Any, int] = {}
        is_waiting = False
        counted = Counter[int]()  # progress by item; a new process counts from zero

        # In the object store once; each worker process reads it once.
        task = ray.put(pickled)
        key, driver = hashlib.sha256(pickled).hexdigest(), (rlftsim.__version__, os.getcwd())
        board = ray.remote(_Board).options(num_cpus=0).remote()
        # No retries by Ray: it would try an item that eats all memory forever, and not tell.
        memory = _expected_memory(len(pickled))
        work = ray.remote(_work).options(num_cpus=1, memory=memory, max_retries=0, scheduling_strategy="SPREAD")

        def count(number: int, total: int) -> None:
            """Report the progress of an item since the last count."""
            advance(total - counted[number])
            counted[number] = total

        try:
            while len(results) + len(attempts.set_aside) < len(items):
                num_cores = int(ray.cluster_resources().get("CPU", 0))
                while waiting and len(at_work) < ITEMS_PER_CORE * max(num_cores, 1):
                    number = waiting.popleft()
                    at_work[work.remote([task], key, driver, pickle.dumps(items[number]), number, board)] = number
                done, _ = ray.wait(list(at_work), timeout=SECONDS_BETWEEN_REPORTS)
                if not num_cores and not is_waiting:
                    log.warning("the cluster has no cores now: waiting for machines.")
                is_waiting = not num_cores
                if not done:
                    # Not by `get` alone: the board's machine may be gone, and progress is worth no error.
                    with suppress(RayError):
                        totals: Any = ray.get(board.take.remote(), timeout=1.0)
                        for number, total in totals.items():
                            if number in at_work.values():
                                count(number, total)
                for ref in done:
                    number = at_work.pop(ref)
                    try:
                        event, value, total, seconds, machine = pickle.loads(ray.get(ref))
                    except RayError as error:
                        reason = f"{type(error).__name__}: {first_line(error)}"
                        if self.on_death == "stop":
                            name = describe(items[number])
                            raise DataError(
                                f"the process of {name} died ({reason}): run the same command again, it resumes."
                            ) from None
                        attempts.retry(number, reason, is_to_blame=not isinstance(error, NodeDiedError))
                        continue
                    if event == "error":
                        raise value
                    results[number] = value
                    count(number, total)
                    log_item(self.item_log, describe(items[number]), seconds, machine)
        finally:
            _cancel(list(at_work))
        if attempts.set_aside:
            raise SetAside(attempts.set_aside)
        return [results[number] for number in range(len(items))]


def _expected_memory(task_bytes: int) -> int:
    """Bytes of memory that a process of the cluster is expected to need: no machine gets more processes than fit."""
    needed = BYTES_OF_A_PROCESS + BYTES_PER_BYTE_OF_A_TASK * task_bytes
    # Where even the largest machine has less, the work is tried all the same; Ray would wait for a larger one.
    has = [node["Resources"].get("memory", 0.0) for node in ray.nodes() if node["Resources"].get("CPU")]
    return int(min(needed, max(has, default=needed)))


class _Board:
    """An actor that remembers the reports of tasks at work."""

    def __init__(self) -> None:
        self._totals: dict[int, int] = {}

    def put(self, number: int, total: int) -> None:
        """Remember the progress of an item.

        Args:
            number: Index of the item in the list of all items.
            total: Progress since the item was begun, in units of the work.
        """
        self._totals[number] = total

    def take(self) -> dict[int, int]:
        """Progress by item, as reported since the last call."""
        totals, self._totals = self._totals, {}
        return totals


def _work(task: list[Any], key: str, driver: tuple[str, str], item: bytes, number: int, board: Any) -> bytes:
    """Do an item in a process of the cluster; pickled "result" or "error", value, progress, seconds and machine."""
    total, last = 0, time.monotonic()
    start, machine = last, ray.util.get_node_ip_address()
    version, folder = driver

    def advance(count: int) -> None:
        """Add to the item's progress, and send the sum now and then."""
        nonlocal total, last
        total += count
        if time.monotonic() - last > SECONDS_BETWEEN_REPORTS:
            last = time.monotonic()
            board.put.remote(number, total)

    try:
        if version != rlftsim.__version__:
            raise ConfigError(
                f"the cluster has rlftsim {rlftsim.__version__}, this machine {version}: install the same on all."
            )
        if key not in _tasks:
            try:
                os.chdir(folder)  # so that relative paths are those of the command
            except OSError as error:
                raise ConfigError(
                    f"{folder} ({error.strerror}): give the command in a folder that all machines of the cluster see."
                ) from None
            _tasks.clear()
            _tasks[key] = pickle.loads(ray.get(task[0]))
        value = _tasks[key](pickle.loads(item), advance, lambda: False)
        return pickle.dumps(("result", value, total, time.monotonic() - start, machine))
    except MemoryError:
        os._exit(OUT_OF_MEMORY)  # a new process may have enough
    except Exception as error:
        error = portable_error(error)
        error.add_note(f"on {machine}")
        return pickle.dumps(("error", error, total, time.monotonic() - start, machine))


def _cancel(refs: list[Any]) -> None:
    """Stop tasks: at first tasks may clean up, then the processes are killed."""
    with suppress(RayError):
        for ref in refs:
            ray.cancel(ref)
        _, left = ray.wait(refs, num_returns=len(refs), timeout=SECONDS_TO_STOP) if refs else ([], [])
        for ref in left:
            ray.cancel(ref, force=True)

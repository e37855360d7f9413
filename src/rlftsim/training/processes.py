"""Several processes on a CPU: forked from the training process, and connected with that process by pipes.

Forked processes share the memory of this process, and start in milliseconds. So a script needs no main guard, a
notebook may train with the rewards and policies that cells define, and scenarios that have been read are shared.
"""

import multiprocessing
import os
import sys
import threading
import warnings
from collections.abc import Callable, Iterator, Sequence
from contextlib import AbstractContextManager, contextmanager, suppress
from dataclasses import dataclass
from multiprocessing.connection import Connection, Pipe
from multiprocessing.process import BaseProcess
from typing import Any

import torch
from torch import Tensor

from rlftsim.errors import ConfigError, DataError, RlftsimError
from rlftsim.jobs.interruption import ctrl_c_blocked
from rlftsim.jobs.processes import exit_with_parent, portable_error
from rlftsim.training.config import DeviceConfig
from rlftsim.training.parallel import Fabric, can_fork, forks_processes, start_fabric


@contextmanager
def linked_processes(work: Callable[[Fabric], object], config: DeviceConfig) -> Iterator[Fabric]:
    """Start the processes of a run, and yield the fabric of this process, which has rank 0, for a share of the work.

    On a CPU the other processes are forked here, and call the function. The forked processes print no text, write no
    files, and end with the `with`, also with an error, Ctrl-C, or a kill of this process. Errors of forked processes
    are raised here.

    Args:
        work: Function that the other processes call, each with the fabric of the calling process.
        config: Device settings with a number of processes, not "auto".

    Raises:
        ConfigError: Several processes, but this process cannot be forked, or several threads per process.
        DataError: A process died.
    """
    fabric, processes = start_fabric(config), config.processes
    if processes in ("auto", 1) or not forks_processes(config):
        yield fabric
        return
    if not can_fork():
        raise ConfigError(
            f"device.processes={processes}: a CPU is shared among processes on Linux only, without a GPU, and outside "
            "of other workers: set device.processes=1, or start the command by torchrun."
        )
    if config.threads != 1:
        raise ConfigError(
            f"device.threads={config.threads} and device.processes={processes} cannot be combined: set one of them "
            "to 1."
        )
    context = multiprocessing.get_context("fork")
    parts = (fabric.device, fabric.autocast, fabric.backward)
    links: list[Connection] = []
    workers: list[BaseProcess] = []
    try:
        with ctrl_c_blocked():
            for rank in range(1, processes):
                link, remote_link = Pipe()
                links.append(link)
                process = LinkedProcess(*parts, rank, processes, [remote_link])
                workers.append(context.Process(target=_help, args=(work, process, links), daemon=True))
                with warnings.catch_warnings():
                    # Of forking beside threads, from Python 3.12 on. A helper uses none of the parent's.
                    warnings.simplefilter("ignore", DeprecationWarning)
                    workers[-1].start()
                # Only the helper holds it from here on: its end is the end of the pipe.
                remote_link.close()
        yield LinkedProcess(*parts, 0, processes, links)
    finally:
        for worker in workers:
            worker.kill()  # they write no files, so none is left half-written
            worker.join()


def _help(work: Callable[[Fabric], object], process: "LinkedProcess", inherited: Sequence[Connection]) -> None:
    """Life of a forked process."""
    threading.Thread(target=exit_with_parent, daemon=True).start()
    # The parent's OpenMP threads do not exist here, and more than one thread would wait for them forever.
    torch.set_num_threads(1)
    sys.stdout = sys.stderr = open(os.devnull, "w")  # noqa: SIM115
    for link in inherited:
        link.close()
    try:
        work(process)
    except LostProcessError:
        pass  # rank 0 has ended and knows why
    except Exception as error:
        sent = portable_error(error)
        if not isinstance(error, RlftsimError):
            sent.add_note(f"in process {process.global_rank} of the run")
        with suppress(OSError):
            process.links[0].send(sent)


class LostProcessError(DataError):
    """A process of the run died."""


@dataclass(frozen=True, eq=False)
class LinkedProcess:
    """A process of several on a CPU, as a `Fabric`."""

    device: torch.device
    autocast: Callable[[], AbstractContextManager[Any]]
    backward: Callable[..., None]
    """These three are those of a process alone."""
    global_rank: int
    world_size: int
    links: Sequence[Connection]
    """Pipes to all other processes in rank 0, to rank 0 in the others."""

    def all_reduce(self, data: Tensor, *, reduce_op: str) -> Tensor:
        """Sum of a tensor over all processes, the same bits in each process and in each run.

        Args:
            data: Summand of this process.
            reduce_op: "sum".

        Raises:
            LostProcessError: a process died.
        """
        assert reduce_op == "sum"
        if self.global_rank:
            _send(self.links[0], data)
            return _receive(self.links[0])
        total = data.clone()
        # In the order of ranks, not of arrival, which rounding would show.
        for link in self.links:
            total += _receive(link)
        for link in self.links:
            _send(link, total)
        return total


def _send(link: Connection, data: Tensor) -> None:
    try:
        link.send(data.numpy())
    except ConnectionError:
        _receive(link)  # a process that failed has sent its error before it ended
        raise


def _receive(link: Connection) -> Tensor:
    try:
        message = link.recv()
    except (EOFError, ConnectionError):
        raise LostProcessError(
            "a training process died (out of memory?): run the same command again, it resumes. If that happens again, "
            "lower micro_batch_size or device.processes."
        ) from None
    if isinstance(message, Exception):
        raise message
    return torch.from_numpy(message)

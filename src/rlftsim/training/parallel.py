"""Devices and processes.

Every process works on a part of the global batch and adds up *sums*; the sums are added over the processes and divided
by global counts. So the estimator equals that of a single process with the same global batch, no matter how scenarios
and agents are spread.

On GPUs and under torchrun, lightning-fabric connects the processes; on a CPU see `training.processes`.
"""

import io
import multiprocessing
import os
import sys
from collections.abc import Iterable, Mapping, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Literal, Protocol, cast, runtime_checkable

import torch
from torch import Tensor, nn

from rlftsim.errors import ConfigError, check_not_negative, check_positive, check_types
from rlftsim.jobs.runner import usable_cores
from rlftsim.training.batches import balance_by_cost

MIN_SCENARIOS = 32
"""Data sets of fewer scenarios are trained on by one process, unless another number is given. (A limit of the data
set, not of the run's length: a run that is continued for more epochs keeps its processes.)"""


@runtime_checkable
class Fabric(Protocol):
    """The part of `lightning_fabric.Fabric` that training uses.

    Importing that class costs more than a second, which configurations and `--help` should not have to pay.
    """

    @property
    def device(self) -> torch.device:
        """Device of this process."""
        ...

    @property
    def world_size(self) -> int:
        """Number of processes."""
        ...

    @property
    def global_rank(self) -> int:
        """Position of this process among all, from 0."""
        ...

    @property
    def is_global_zero(self) -> bool:
        """True for the process of rank 0, which writes the files."""
        ...

    def autocast(self) -> AbstractContextManager[Any]:
        """Context in which operations run in the chosen precision."""
        ...

    def backward(self, tensor: Tensor) -> None:
        """Add the gradient of a scalar to the parameters."""
        ...

    def all_reduce(self, data: Tensor, *, reduce_op: str) -> Any:
        """Combine a tensor over all processes."""
        ...


@dataclass(frozen=True)
class DeviceConfig:
    """Device, processes, precision and threads of a run."""

    accelerator: Literal["auto", "cpu", "cuda"] = "auto"
    """Kind of device; auto = CUDA if there is one."""
    processes: int | Literal["auto"] = "auto"
    """Processes on this machine, that is GPUs, or cores of a CPU. auto = one on a GPU, on a CPU one for each usable
    core, but not more than scenarios in a batch or in memory at once, and one for a few scenarios. In fine-tuning more
    than scenarios divide the rollouts of each. A run stores the number in its config.json and is resumed with it:
    another one rounds otherwise. Under torchrun this and `num_nodes` have no effect: torchrun decides."""
    num_nodes: int = 1
    """Machines."""
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    """float32, or bfloat16 where torch's autocast holds it safe."""
    threads: int = 1
    """CPU threads of each process; 0 = torch's own choice. More than one needs OMP_WAIT_POLICY=PASSIVE on shared cores.
    Rollouts always use one."""

    def __post_init__(self) -> None:
        check_types(self)
        check_positive(self, ("num_nodes", *(() if self.processes == "auto" else ("processes",))))
        check_not_negative(self, ("threads",))

    @property
    def uses_cuda(self) -> bool:
        """True if a run with these settings is on GPUs."""
        return self.accelerator == "cuda" or (self.accelerator == "auto" and torch.cuda.is_available())

    @property
    def forks(self) -> bool:
        """True if `linked_processes` starts the processes of a run; else lightning-fabric or torchrun does."""
        return not self.uses_cuda and self.num_nodes == 1 and not is_torchrun()

    def num_processes(
        self, num_scenarios: int, batch_size: int, micro_batch_size: int, begun_with: int | None = None
    ) -> int:
        """Processes of a run on this machine; the number that "auto" stands for.

        Args:
            num_scenarios: Number of scenarios in the data set; few are trained on by a single process.
            batch_size: scenarios of an update; each process needs a scenario.
            micro_batch_size: scenarios in memory at once, which the processes on a CPU share.
            begun_with: number of a run that is resumed.
        """
        if is_torchrun():
            return int(os.environ["LOCAL_WORLD_SIZE"])
        if self.processes != "auto":
            return self.processes
        if not (self.forks and can_fork() and self.threads == 1):
            return 1
        if begun_with is not None:
            return begun_with
        return min(usable_cores(), batch_size, micro_batch_size) if num_scenarios >= MIN_SCENARIOS else 1


def can_fork() -> bool:
    """True where training may start processes by forking this process.

    Elsewhere system libraries, or torch's threads for the backward pass on a GPU, do not survive a fork.
    """
    return sys.platform == "linux" and not torch.cuda.is_available() and not multiprocessing.current_process().daemon


def start_fabric(config: DeviceConfig) -> Fabric:
    """Device and precision of a run, and processes on GPUs or under torchrun; for a CPU's see `linked_processes`.

    Raises:
        ConfigError: CUDA is requested, but there is none.
    """
    from lightning_fabric import Fabric as LightningFabric  # 1.3 s: not at the top, see `Fabric`

    if config.accelerator == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            "device.accelerator=cuda, but torch sees no CUDA device: use cpu, or install a CUDA build of torch."
        )
    if config.threads:
        torch.set_num_threads(config.threads)
    devices, num_nodes = 1 if config.processes == "auto" or config.forks else config.processes, config.num_nodes
    if is_torchrun():
        # torchrun has started the processes already and says how many there are.
        devices = int(os.environ["LOCAL_WORLD_SIZE"])
        num_nodes = int(os.environ["WORLD_SIZE"]) // devices
    # "ddp" for its process group only: models are not wrapped, gradients are summed by `all_reduce_gradients`.
    fabric = LightningFabric(
        accelerator="cuda" if config.uses_cuda else "cpu",
        devices=devices,
        num_nodes=num_nodes,
        strategy="ddp" if devices * num_nodes > 1 else "auto",
        precision=config.precision,
    )
    fabric.launch()
    return fabric


def is_torchrun() -> bool:
    """True where torchrun has started this process."""
    return "TORCHELASTIC_RUN_ID" in os.environ


def is_first_process() -> bool:
    """True for the process of rank 0, or the only process: the process that writes."""
    several = torch.distributed.is_available() and torch.distributed.is_initialized()
    return not several or torch.distributed.get_rank() == 0


def local_indices(
    items: list[int], fabric: Fabric, costs: Sequence[float] | None = None, *, num_rollouts: int = 1
) -> list[int]:
    """This process's part of a global batch. With fewer scenarios than processes, several share a scenario.

    Args:
        items: Indices of the scenarios of the global batch.
        fabric: Processes of the run, over which sums are added.
        costs: Cost of each item, so that shares cost about the same; None = shares are equally large.
        num_rollouts: Rollouts of each item, which processes in excess divide, see `local_rollouts`.

    Raises:
        ConfigError: the processes cannot divide the scenarios, nor the rollouts, evenly.
    """
    sharing = _num_sharing_scenario(len(items), num_rollouts, fabric)
    groups = balance_by_cost([1.0] * len(items) if costs is None else costs, fabric.world_size // sharing)
    # The first part has the most expensive scenario, and rank 0 has more to do than others: it adds, logs and writes.
    return [items[index] for index in groups[-1 - fabric.global_rank // sharing]]


def local_rollouts(num_items: int, num_rollouts: int, fabric: Fabric) -> range:
    """Rollouts of each scenario that this process simulates and scores: all, or a part where processes share them.

    Args:
        num_items: Number of scenarios in the global batch.
        num_rollouts: Rollouts of each scenario.
        fabric: Processes of the run, over which sums are added.

    Raises:
        ConfigError: as `local_indices`.
    """
    sharing = _num_sharing_scenario(num_items, num_rollouts, fabric)
    size = num_rollouts // sharing
    return range(num_rollouts)[fabric.global_rank % sharing * size :][:size]


def _num_sharing_scenario(num_items: int, num_rollouts: int, fabric: Fabric) -> int:
    """Processes that have the same scenario and divide the rollouts: 1 if there are enough scenarios for all."""
    if fabric.world_size <= num_items:
        return 1
    possible = [num_items * count for count in range(2, num_rollouts + 1) if num_rollouts % count == 0]
    if fabric.world_size not in possible:
        hint = f", or to {' or '.join(map(str, possible))}, which divide the rollouts of a scenario" if possible else ""
        raise ConfigError(
            f"a batch of {num_items} scenarios cannot be spread over {fabric.world_size} processes: raise batch_size, "
            f"or set device.processes to {num_items} at most{hint}."
        )
    return fabric.world_size // num_items


def num_sharing_memory(fabric: Fabric) -> int:
    """Number of processes that share a memory: all on a machine's CPU; a single process on a GPU."""
    if fabric.device.type != "cpu":
        return 1
    return int(os.environ["LOCAL_WORLD_SIZE"]) if is_torchrun() else fabric.world_size


def all_reduce_sum(values: Tensor, fabric: Fabric) -> Tensor:
    """Sum of a tensor over all processes.

    Args:
        values: this process's summand; all processes have the same shape.
        fabric: Processes of the run, over which sums are added.
    """
    if fabric.world_size == 1:
        return values
    return cast(Tensor, fabric.all_reduce(values, reduce_op="sum"))


def all_gather(tensors: Mapping[str, Tensor], fabric: Fabric) -> list[dict[str, Tensor]]:
    """The tensors of all processes, in the order of ranks, bit for bit and on this process's device.

    Args:
        tensors: Tensors of this process by name; other processes may have other shapes.
        fabric: Processes of the run, over which sums are added.
    """
    file = io.BytesIO()
    torch.save({name: tensor.contiguous() for name, tensor in tensors.items()}, file)
    message = torch.frombuffer(file.getbuffer(), dtype=torch.uint8).to(fabric.device)
    sizes = torch.zeros(fabric.world_size, dtype=torch.int64, device=fabric.device)
    sizes[fabric.global_rank] = len(message)
    sizes = all_reduce_sum(sizes, fabric)
    # A sum is all that every kind of `Fabric` has: each process has a row of its own, and the others add zeros to it.
    rows = torch.zeros(fabric.world_size, int(sizes.max()), dtype=torch.uint8, device=fabric.device)
    rows[fabric.global_rank, : len(message)] = message
    rows = all_reduce_sum(rows, fabric).cpu().numpy()
    files = (io.BytesIO(row[:size].tobytes()) for row, size in zip(rows, sizes.tolist()))
    return [torch.load(file, map_location=fabric.device, weights_only=True) for file in files]


def all_reduce_gradients(parameters: Iterable[nn.Parameter], fabric: Fabric) -> None:
    """Sum every gradient over all processes, in place, as a single message.

    Args:
        parameters: Parameters in the same order in every process; without a gradient here a parameter adds zero.
        fabric: Processes of the run, over which sums are added.
    """
    parameters = list(parameters)
    if fabric.world_size == 1:
        return
    # A parameter without a gradient anywhere stays without one: the optimizer then leaves its moments alone.
    has_gradient = torch.tensor([p.grad is not None for p in parameters], dtype=torch.float32, device=fabric.device)
    used = [p for p, count in zip(parameters, all_reduce_sum(has_gradient, fabric).tolist()) if count]
    for parameter in used:
        parameter.grad = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
    # One message: for small models the latency of many would dominate.
    gradients = [p.grad for p in used if p.grad is not None]
    if not gradients:
        return
    total = all_reduce_sum(torch.cat([g.flatten() for g in gradients]), fabric)
    for gradient, flat in zip(gradients, total.split([g.numel() for g in gradients])):
        gradient.copy_(flat.view_as(gradient))

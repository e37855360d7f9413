"""Devices and processes, by way of lightning-fabric.

Every process works on its part of the global batch and adds up *sums*; the sums are added over the processes and
divided by global counts. So the estimator is that of one process with the same global batch, no matter how
scenarios and agents are spread.
"""

import os
from collections.abc import Iterable, Sequence
from contextlib import AbstractContextManager
from dataclasses import dataclass
from typing import Any, Literal, Protocol, cast, runtime_checkable

import torch
from torch import Tensor, nn

from rlftsim.errors import ConfigError, require_not_negative, require_positive, require_types
from rlftsim.training.batches import balance_by_cost


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
    devices: int = 1
    """Processes on this machine. Under torchrun this and `num_nodes` have no effect: torchrun decides."""
    num_nodes: int = 1
    """Machines."""
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    """float32, or bfloat16 where torch's autocast holds it safe."""
    threads: int = 1
    """CPU threads of each process; 0 = torch's own choice. More than one needs OMP_WAIT_POLICY=PASSIVE on shared cores.
    Rollouts always use one."""

    def __post_init__(self) -> None:
        require_types(self)
        require_positive(self, ("devices", "num_nodes"))
        require_not_negative(self, ("threads",))


def start_fabric(config: DeviceConfig) -> Fabric:
    """Join the processes of a run.

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
    devices, num_nodes = config.devices, config.num_nodes
    if "TORCHELASTIC_RUN_ID" in os.environ:
        # torchrun has started the processes already and says how many there are.
        devices = int(os.environ["LOCAL_WORLD_SIZE"])
        num_nodes = int(os.environ["WORLD_SIZE"]) // devices
    # "ddp" for its process group only: models are not wrapped, gradients are summed by `all_reduce_gradients`.
    fabric = LightningFabric(
        accelerator=config.accelerator,
        devices=devices,
        num_nodes=num_nodes,
        strategy="ddp" if devices * num_nodes > 1 else "auto",
        precision=config.precision,
    )
    fabric.launch()
    return fabric


def is_first_process() -> bool:
    """True for the process of rank 0, or the only one: the one that writes."""
    several = torch.distributed.is_available() and torch.distributed.is_initialized()
    return not several or torch.distributed.get_rank() == 0


def local_indices(items: list[int], fabric: Fabric, costs: Sequence[float] | None = None) -> list[int]:
    """This process's part of a global batch.

    Args:
        items: scenario indices of the global batch.
        fabric: the processes.
        costs: of each item; the parts then cost about the same, else they are equally large.

    Raises:
        ConfigError: there are fewer items than processes.
    """
    if len(items) < fabric.world_size:
        raise ConfigError(
            f"a batch of {len(items)} scenarios cannot be spread over {fabric.world_size} processes: raise batch_size."
        )
    parts = balance_by_cost([1.0] * len(items) if costs is None else costs, fabric.world_size)
    return [items[place] for place in parts[fabric.global_rank]]


def all_reduce_sum(values: Tensor, fabric: Fabric) -> Tensor:
    """Sum of a tensor over all processes.

    Args:
        values: this process's summand; all processes have the same shape.
        fabric: the processes.
    """
    if fabric.world_size == 1:
        return values
    return cast(Tensor, fabric.all_reduce(values, reduce_op="sum"))


def all_reduce_gradients(parameters: Iterable[nn.Parameter], fabric: Fabric) -> None:
    """Sum every gradient over all processes, in place, as one message.

    Args:
        parameters: in the same order in every process; one that has no gradient here adds zero.
        fabric: the processes.
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
    for gradient, part in zip(gradients, total.split([g.numel() for g in gradients])):
        gradient.copy_(part.view_as(gradient))

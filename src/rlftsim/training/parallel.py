"""Devices and processes, by way of lightning-fabric.

Every process works on its share of the global batch and adds up *sums*; the sums are added over the processes and divided by global
counts. So the estimator is that of one process with the same global batch, however scenarios and agents are spread.
"""

import os
from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Literal, cast

import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from rlftsim.errors import ConfigError, require_not_negative, require_positive
from rlftsim.training.batches import share_out


@dataclass(frozen=True)
class DeviceConfig:
    """Where a run computes."""

    accelerator: Literal["auto", "cpu", "cuda"] = "auto"
    devices: int = 1
    """Processes on this machine. Under torchrun it and `num_nodes` do not count: the processes are those that it starts."""
    num_nodes: int = 1
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    threads: int = 1
    """CPU threads of each process; 0 = torch's own choice. More than one needs OMP_WAIT_POLICY=PASSIVE on shared cores. Rollouts always use
    one."""

    def __post_init__(self) -> None:
        require_positive(self, ("devices", "num_nodes"))
        require_not_negative(self, ("threads",))


def start_fabric(config: DeviceConfig) -> Fabric:
    """Join the processes of a run.

    Raises:
        ConfigError: CUDA is asked for and not there.
    """
    if config.accelerator == "cuda" and not torch.cuda.is_available():
        raise ConfigError(
            "device.accelerator=cuda, but torch sees no CUDA device: use cpu, or install a CUDA build of torch."
        )
    if config.threads:
        torch.set_num_threads(config.threads)
    devices, num_nodes = _processes_of_torchrun() or (config.devices, config.num_nodes)
    fabric = Fabric(
        accelerator=config.accelerator,
        devices=devices,
        num_nodes=num_nodes,
        strategy="ddp" if devices * num_nodes > 1 else "auto",
        precision=config.precision,
    )
    fabric.launch()
    return fabric


def _processes_of_torchrun() -> tuple[int, int] | None:
    """Processes on each machine, and machines; None where torchrun started nothing."""
    if "TORCHELASTIC_RUN_ID" not in os.environ:
        return None
    on_each = int(os.environ["LOCAL_WORLD_SIZE"])
    return on_each, int(os.environ["WORLD_SIZE"]) // on_each


def is_first_process() -> bool:
    """Whether this is the process of rank 0, or the only one: the one that writes."""
    several = torch.distributed.is_available() and torch.distributed.is_initialized()
    return not several or torch.distributed.get_rank() == 0


def own_share(items: list[int], fabric: Fabric, costs: Sequence[float] | None = None) -> list[int]:
    """This process's part of a global batch.

    Args:
        items: of the global batch.
        fabric: the processes.
        costs: of each item; the parts then cost about the same, else they are equally many.

    Raises:
        ConfigError: the batch cannot be shared out.
    """
    if len(items) < fabric.world_size:
        raise ConfigError(
            f"a batch of {len(items)} scenarios cannot be shared by {fabric.world_size} processes: raise batch_size."
        )
    shares = share_out([1.0] * len(items) if costs is None else costs, fabric.world_size)
    return [items[place] for place in shares[fabric.global_rank]]


def add_up(values: Tensor, fabric: Fabric) -> Tensor:
    """Sum over processes."""
    if fabric.world_size == 1:
        return values
    return cast(Tensor, fabric.all_reduce(values, reduce_op="sum"))


def add_up_gradients(parameters: Iterable[nn.Parameter], fabric: Fabric) -> None:
    """Sum every gradient over processes, in place, as one message. A process that has none for a parameter adds zero."""
    parameters = list(parameters)
    if fabric.world_size == 1:
        return
    own = torch.tensor([p.grad is not None for p in parameters], dtype=torch.float32, device=fabric.device)
    used = [p for p, count in zip(parameters, add_up(own, fabric).tolist()) if count]
    for parameter in used:
        parameter.grad = torch.zeros_like(parameter) if parameter.grad is None else parameter.grad
    gradients = [p.grad for p in used if p.grad is not None]
    if not gradients:
        return
    total = add_up(torch.cat([g.flatten() for g in gradients]), fabric)
    for gradient, part in zip(gradients, total.split([g.numel() for g in gradients])):
        gradient.copy_(part.view_as(gradient))

"""Devices and processes, by way of lightning-fabric.

Every process works on its share of the global batch and adds up *sums*; the sums are added over the processes and divided by global
counts. So the estimator is that of one process with the same global batch, however scenarios and agents are spread.
"""

from collections.abc import Iterable
from dataclasses import dataclass
from typing import Literal, cast

import torch
from lightning_fabric import Fabric
from torch import Tensor, nn

from rlftsim.errors import ConfigError


@dataclass(frozen=True)
class DeviceConfig:
    """Where a run computes."""

    accelerator: Literal["auto", "cpu", "cuda"] = "auto"
    devices: int = 1
    """Processes on this machine; under torchrun, the number it starts."""
    num_nodes: int = 1
    precision: Literal["32-true", "bf16-mixed"] = "32-true"
    threads: int = 0
    """CPU threads of each process; 0 = torch's own choice. More than one needs OMP_WAIT_POLICY=PASSIVE on shared cores."""


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
    strategy = "ddp" if config.devices * config.num_nodes > 1 else "auto"
    fabric = Fabric(
        accelerator=config.accelerator,
        devices=config.devices,
        num_nodes=config.num_nodes,
        strategy=strategy,
        precision=config.precision,
    )
    fabric.launch()
    return fabric


def own_share(items: list[int], fabric: Fabric) -> list[int]:
    """This process's part of a global batch.

    Raises:
        ConfigError: the batch cannot be shared out.
    """
    if len(items) < fabric.world_size:
        raise ConfigError(
            f"a batch of {len(items)} scenarios cannot be shared by {fabric.world_size} processes: raise batch_size."
        )
    return items[fabric.global_rank :: fabric.world_size]


def add_up(values: Tensor, fabric: Fabric) -> Tensor:
    """Sum over processes."""
    if fabric.world_size == 1:
        return values
    return cast(Tensor, fabric.all_reduce(values, reduce_op="sum"))


def add_up_gradients(parameters: Iterable[nn.Parameter], fabric: Fabric) -> None:
    """Sum every gradient over processes, in place, as one message."""
    gradients = [p.grad for p in parameters if p.grad is not None]
    if fabric.world_size == 1 or not gradients:
        return
    total = add_up(torch.cat([g.flatten() for g in gradients]), fabric)
    for gradient, part in zip(gradients, total.split([g.numel() for g in gradients])):
        gradient.copy_(part.view_as(gradient))

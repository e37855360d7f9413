"""Devices and processes, and the scenarios of an update spread over them and cut into pieces that fit into memory.

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
from typing import Any, Protocol, cast, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn

from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.runner import usable_cores
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.shards import AGENT_COLUMNS, compute_index_row
from rlftsim.scenario.types import TOTAL_STEPS, Scenarios
from rlftsim.training.config import DeviceConfig

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
        """Position of this process among all, from 0, which writes the files."""
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


def uses_cuda(config: DeviceConfig) -> bool:
    """True if a run with these settings is on GPUs."""
    return config.accelerator == "cuda" or (config.accelerator == "auto" and torch.cuda.is_available())


def forks_processes(config: DeviceConfig) -> bool:
    """True if `linked_processes` starts the processes of a run; else lightning-fabric or torchrun does."""
    return not uses_cuda(config) and config.num_nodes == 1 and not is_torchrun()


def count_processes(
    config: DeviceConfig, num_scenarios: int, batch_size: int, micro_batch_size: int, begun_with: int | None = None
) -> int:
    """Processes of a run on this machine; the number that "auto" stands for.

    Args:
        config: Device settings of the run.
        num_scenarios: Number of scenarios in the data set; few are trained on by a single process.
        batch_size: Scenarios of an update; each process needs a scenario.
        micro_batch_size: Scenarios in memory at once, which the processes on a CPU share.
        begun_with: Number of processes of a run that is resumed.
    """
    if is_torchrun():
        return int(os.environ["LOCAL_WORLD_SIZE"])
    if config.processes != "auto":
        return config.processes
    if not (forks_processes(config) and can_fork() and config.threads == 1):
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
    devices = 1 if config.processes == "auto" or forks_processes(config) else config.processes
    num_nodes = config.num_nodes
    if is_torchrun():
        # torchrun has started the processes already and says how many there are.
        devices = int(os.environ["LOCAL_WORLD_SIZE"])
        num_nodes = int(os.environ["WORLD_SIZE"]) // devices
    # "ddp" for its process group only: models are not wrapped, gradients are summed by `all_reduce_gradients`.
    fabric = LightningFabric(
        accelerator="cuda" if uses_cuda(config) else "cpu",
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


# ---- scenarios by cost: sums are divided by global counts, so that this changes time and memory, never a gradient ----

MAP_POINTS_PER_AGENT = 200
"""Map points that need about as much memory as an agent; measured 170 (SMART-nano) and 410 (the demo's model) on real
scenarios."""


def scenario_costs(scenarios: Scenarios) -> Float[np.ndarray, "n"]:
    """Thousands of map points of each scenario, an agent counted as 200: about proportional to memory and time.

    The index of a data set has the counts without a scenario being read; the scenarios of a list are counted here.
    """
    counts = count_columns(scenarios, (*AGENT_COLUMNS, "num_map_points"))
    # Thousands, so that budgets are numbers a person can write.
    return (counts[-1] + MAP_POINTS_PER_AGENT * counts[:-1].sum(0)) / 1000.0


def count_columns(scenarios: Scenarios, columns: Sequence[str]) -> Int64[np.ndarray, "columns n"]:
    """Counts of each scenario by columns of the index, from the index of a data set without a scenario being read.

    Args:
        scenarios: a data set, or scenarios of other types, which are counted here.
        columns: Names in `INDEX_FIELDS` of columns with numbers.
    """
    if isinstance(scenarios, ScenarioDataset):
        return np.array([scenarios.index[name].to_pylist() for name in columns], dtype=np.int64)
    rows = [compute_index_row(scenarios[i], "") for i in range(len(scenarios))]
    return np.array([[row[name] for row in rows] for name in columns], dtype=np.int64)


def check_scored(scenarios: Scenarios) -> None:
    """Check before a run begins that the metric, and so a reward, is defined for each scenario.

    Args:
        scenarios: Training scenarios that a method scores rollouts of.

    Raises:
        DataError: some have no logged future or no evaluated agent; the first is named.
    """
    num_steps, num_evaluated = count_columns(scenarios, ("num_steps", "num_evaluated"))
    unscored = np.flatnonzero((num_steps < TOTAL_STEPS) | (num_evaluated == 0))
    if len(unscored):
        first = scenarios[int(unscored[0])]
        cause = "no evaluated agent" if first.has_future else f"{first.num_steps} logged steps, its future is withheld"
        raise DataError(
            f"scenario {first.scenario_id} has {cause}: no reward is defined for it and {len(unscored) - 1} others of "
            f"{len(scenarios)}: leave them out, or train on the training split."
        )


def balance_by_cost(costs: Sequence[float] | Float[np.ndarray, "n"], num_groups: int) -> list[list[int]]:
    """Greedy load balancing: places of a list, in parts of about equal cost, so that no process waits long.

    The most expensive place goes first, each to the part that is cheapest so far; equal costs are dealt out in turn.

    Args:
        costs: Cost of each item, in any unit.
        num_groups: Number of groups; some stay empty where items are fewer.
    """
    groups: list[list[int]] = [[] for _ in range(num_groups)]
    spent = np.zeros(num_groups)
    # Stable, so that all processes deal alike.
    for index in np.argsort(-np.asarray(costs, float), kind="stable"):
        cheapest = int(spent.argmin())
        groups[cheapest].append(int(index))
        spent[cheapest] += costs[index]
    return [sorted(group) for group in groups]


def micro_batches(
    items: Sequence[int], costs: Float[np.ndarray, "n"], *, max_count: int, max_cost: float | None
) -> list[list[int]]:
    """Scenarios cut into pieces of similar size, the most expensive first, so that running out of memory shows at once.

    Args:
        items: Indices of the scenarios in the data set.
        costs: Costs [n] of all scenarios of the data set, thousands of map points.
        max_count: Scenarios of a batch at most.
        max_cost: Summed cost of a batch at most; a scenario that costs more is a batch alone. None = no limit.
    """
    budget = np.inf if max_cost is None else max_cost
    batches: list[list[int]] = []
    # Sorted by cost, neighbors in this order are alike, and little memory goes to padding.
    for item in sorted(items, key=lambda i: -costs[i]):
        if batches and len(batches[-1]) < max_count and costs[[*batches[-1], item]].sum() <= budget:
            batches[-1].append(item)
        else:
            batches.append([item])
    return batches

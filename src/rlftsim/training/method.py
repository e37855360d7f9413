"""A training method is `start` and `update`; all else of a run is the same for every method (`training.run`).

Methods are registered by name, also by other packages. In the pyproject.toml of such a package:

    [project.entry-points."rlftsim.methods"]
    nudge = "my_package:Nudge"

The method's section in a recipe and its flags bear this name: `rlftsim finetune --method nudge --nudge.step 1`.
"""

import copy
from collections.abc import Collection, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Any, Protocol, TypeVar, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import nn
from torch.optim import Optimizer

from rlftsim.errors import ConfigError
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.training.config import DeviceConfig
from rlftsim.training.data import batch_with_futures, mirrored_of_update, scenarios_of_update
from rlftsim.training.parallel import (
    Fabric,
    check_scored,
    local_indices,
    micro_batches,
    num_sharing_memory,
    scenario_costs,
)


@runtime_checkable
class TrainingSettings(Protocol):
    """Settings that every training method has: a frozen dataclass is stored with a run, and becomes flags."""

    @property
    def batch_size(self) -> int:
        """Scenarios per update, over all processes."""
        ...

    @property
    def micro_batch_size(self) -> int:
        """Scenarios in memory at once."""
        ...

    @property
    def warmup_updates(self) -> int:
        """Updates over which the learning rate rises."""
        ...

    @property
    def checkpoint_every(self) -> int:
        """Updates between two checkpoints."""
        ...

    @property
    def max_skipped_in_a_row(self) -> int:
        """Skipped updates in a row that end the run."""
        ...

    @property
    def seed(self) -> int:
        """Seed of the run."""
        ...

    @property
    def device(self) -> DeviceConfig:
        """Device and processes."""
        ...

    def num_updates(self, num_scenarios: int) -> int:
        """Optimizer steps of the run."""
        ...


Settings = TypeVar("Settings", bound=TrainingSettings)


@dataclass(eq=False, kw_only=True)
class Learner:
    """The state of a run that changes from update to update, which checkpoints hold."""

    policy: Any
    optimizer: Optimizer
    config: Any
    """Settings of the run."""
    update: int = 0
    """Updates done, skipped ones included."""
    skipped_in_a_row: int = 0
    inputs: Mapping[str, str] = field(default_factory=dict)
    """Hashes of what the run starts from beside the policy and the scenarios, by the names of config.json."""
    may_grow: Collection[str] = ()
    """Settings that a larger number continues, such as epochs where no update depends on the run's end."""
    skip_rule: str = "their gradients are not finite"
    """Condition under which updates are skipped, for the message of a run that diverged."""
    remedy: str = "lower learning_rate"
    """Settings to change after a divergence, for the same message."""
    average: nn.Module | None = None
    """Moving average of the weights, as a policy of its own; where the settings have an `ema_decay`."""

    def __post_init__(self) -> None:
        if self.average is None and getattr(self.config, "ema_decay", None) is not None:
            self.average = copy.deepcopy(self.policy).requires_grad_(False)

    @property
    def parameters(self) -> list[nn.Parameter]:
        """The weights that are trained."""
        return [p for p in self.policy.parameters() if p.requires_grad]

    @property
    def modules(self) -> dict[str, nn.Module]:
        """Modules that a checkpoint holds, by file name: the policy, and the average where there is one."""
        return {"policy": self.policy} | ({} if self.average is None else {"average": self.average})

    @property
    def result(self) -> Any:
        """The policy that the run validates, and saves in the end: the average where there is one."""
        return self.policy if self.average is None else self.average

    def to_numbers(self) -> dict[str, float]:
        """Numbers that a checkpoint holds beside the weights."""
        return {}

    def load_numbers(self, numbers: Mapping[str, float]) -> None:
        """Take back the numbers of a checkpoint."""

    def finish(self) -> None:
        """Make the result from the learned state, where the updates alone do not."""

    def finish_update(self, *, is_good: bool) -> None:
        """Take or skip the optimizer's step, and count the update either way.

        Args:
            is_good: False = the gradient cannot be used; weights, moments and average stay.
        """
        self.update += 1
        if not is_good:
            self.skipped_in_a_row += 1
            return
        self.optimizer.step()
        self.skipped_in_a_row = 0
        if self.average is not None:
            self._move_average(self.average)

    @torch.no_grad()
    def _move_average(self, average: nn.Module) -> None:
        """Move the average a little towards the weights."""
        # Early weights are far off: as long as few updates are made, the average is over about a tenth of them.
        decay = min(self.config.ema_decay, (1 + self.update) / (10 + self.update))
        for mean, weight in zip(average.state_dict().values(), self.policy.state_dict().values()):
            if mean.is_floating_point():
                mean.lerp_(weight, 1 - decay)
            else:
                mean.copy_(weight)


@dataclass(frozen=True, eq=False)
class UpdateReport:
    """The outcome of an update."""

    values: dict[str, float]
    """Metrics by the names of metrics.jsonl."""
    note: str
    """Text beside the progress bar."""
    skipped_because: str = ""
    """Reason why the optimizer's step was skipped."""
    warnings: Sequence[str] = ()
    """Messages for the user, such as alarms."""
    stop_because: str = ""
    """Reason why the run ends with this update."""


@dataclass(frozen=True, eq=False)
class UpdateScenarios:
    """Scenarios of a learner's next update that this process works on; read when a batch is requested."""

    scenarios: Scenarios
    """All training scenarios."""
    settings: TrainingSettings
    fabric: Fabric
    learner: Learner

    @cached_property
    def costs(self) -> Float[np.ndarray, "n"]:
        """About proportional to the time and memory that each of all scenarios needs, see `scenario_costs`."""
        return scenario_costs(self.scenarios)

    def indices(self, num_rollouts: int = 1) -> list[int]:
        """Indices of the scenarios of this process: a share of about equal cost.

        Args:
            num_rollouts: Rollouts of each scenario, which processes that outnumber the scenarios divide.
        """
        selected = scenarios_of_update(
            self.learner.update, self.settings.batch_size, len(self.scenarios), self.settings.seed
        )
        # Costs of a list of scenarios are counted from the scenarios: not where nothing is divided.
        costs = self.costs[selected].tolist() if self.fabric.world_size > 1 else None
        return local_indices(selected, self.fabric, costs, num_rollouts=num_rollouts)

    def batch(self, num_rollouts: int = 1) -> ScenarioBatch:
        """All scenarios of this process as a batch on the process's device, with futures.

        Args:
            num_rollouts: Rollouts of each scenario, as in `indices`.
        """
        return batch_with_futures(self.scenarios, self.indices(num_rollouts)).to(self.fabric.device)

    def micro_batches(
        self,
        max_count: int,
        max_cost: float | None = None,
        *,
        context_radius_m: float | None = None,
        mirror_probability: float = 0.0,
    ) -> Iterator[ScenarioBatch]:
        """Yield the scenarios of this process in batches that fit into memory, each read when due.

        Args:
            max_count: Scenarios of a batch at most, divided among processes that share a memory.
            max_cost: Thousands of map points of a batch at most, divided in the same way; None = no limit.
            context_radius_m: Distance from the ego in meters beyond which a step counts as not logged; None = no limit.
            mirror_probability: Chance in [0, 1] that a scenario is mirrored, left and right exchanged.
        """
        indices, sharing = self.indices(), num_sharing_memory(self.fabric)
        max_count = max(max_count // sharing, 1)
        max_cost = None if max_cost is None else max_cost / sharing
        mirror = mirrored_of_update(self.learner.update, indices, mirror_probability, self.settings.seed)
        for selected in micro_batches(indices, self.costs, max_count=max_count, max_cost=max_cost):
            batch = batch_with_futures(self.scenarios, selected, context_radius_m=context_radius_m, mirror=mirror)
            yield batch.to(self.fabric.device)


@runtime_checkable
class Method(Protocol[Settings]):
    """A way to train a policy. A subclass inherits all that has a value here."""

    settings: type[Settings]
    """Dataclass of the method's settings, all with defaults. The type of the settings says which method trains."""
    title: str
    """Label of the progress bar and name of the method in messages."""
    validates: bool = False
    """True = the settings have a section `validation`, and held-out scenarios may be validated on."""
    needs_all_updates: bool = False
    """True = there is a model after the last update alone, so that no run may end earlier."""

    def describe(self, settings: Settings) -> str:
        """The method in a few words, for the README of trained models."""
        return self.title

    def start(self, policy: Any, scenarios: Scenarios, settings: Settings, fabric: Fabric) -> Learner:
        """Check the policy, freeze the weights that are not trained, and make optimizer and reference.

        Called in each process, before the folder of the run is touched; `check_trainable` has the usual checks.

        Args:
            policy: Policy to train in place; the weights may be on a different device than `fabric`.
            scenarios: All training scenarios, at least the index; reading each scenario would take minutes.
            settings: Settings of the run.
            fabric: Device, precision and processes.

        Raises:
            ConfigError: The method cannot train this policy.
            DataError: A scenario lacks what the method needs.
        """
        ...

    def update(self, learner: Learner, scenarios: UpdateScenarios, fabric: Fabric) -> UpdateReport:
        """Make an update, which ends with `learner.finish_update`.

        Args:
            learner: Result of `start`, changed in place; `learner.update` counts from 0.
            scenarios: Scenarios of this update that this process works on.
            fabric: Device, precision and processes; sums have to be added over the processes (`training.parallel`).
        """
        ...


def check_trainable(
    policy: object,
    scenarios: Scenarios,
    method: str,
    *,
    needs: Sequence[str] = (),
    is_imitated: bool = False,
    is_rewarded: bool = False,
) -> None:
    """Check that a method can train a policy on these scenarios.

    Args:
        policy: Policy, which has to be an nn.Module with a method `save_pretrained(folder, *, card)`.
        scenarios: Training scenarios, at least one.
        method: Name of the training method in messages, such as "CAT-K".
        needs: Further attributes that the method uses, such as "vocabulary".
        is_imitated: True = the method uses the pre-training loss; either way to define the loss is enough.
        is_rewarded: True = the method scores rollouts of every scenario.

    Raises:
        ConfigError: The policy has no weights or lacks an attribute, or there is no scenario.
        DataError: With `is_rewarded`, a scenario has no logged future or no evaluated agent.
    """
    name = type(policy).__name__
    if not isinstance(policy, nn.Module):
        raise ConfigError(f"{name} has no weights: there is nothing for {method} to train.")
    losses = ("teacher_forced", "imitation_loss") if is_imitated else ()
    if not any(hasattr(policy, loss) for loss in losses):
        needs = (*needs, *losses)  # a refusal names both
    missing = [attribute for attribute in (*needs, "save_pretrained") if not hasattr(policy, attribute)]
    if missing:
        is_rlft_left = "vocabulary" in missing and "save_pretrained" not in missing
        way_out = "; fine-tune it by rlft, which needs no tokens." if is_rlft_left else "."
        raise ConfigError(f"{name} cannot be trained with {method}: it has no {' and no '.join(missing)}{way_out}")
    if not len(scenarios):
        raise ConfigError("no scenario to train on: is the data set empty, or the split misspelled?")
    if is_rewarded:
        check_scored(scenarios)

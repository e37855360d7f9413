"""The loop of a training run, once for all methods: resuming, skips, divergence, checkpoints, logs and progress.

A method brings its `Learner` (the weights and counters that change) and a function that makes one update. `TrainingRun`
does the rest, and leaves files through `training.run_folder` and `training.checkpoint`.
"""

import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping, Sequence
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any, Protocol, runtime_checkable

import numpy as np
import torch
from jaxtyping import Float
from torch import nn
from torch.optim import Optimizer

from rlftsim.errors import CheckpointError, ConfigError, DataError, NotYetError
from rlftsim.jobs.folder import Lease, check_folder
from rlftsim.jobs.interruption import ctrl_c_waits
from rlftsim.jobs.progress import log, progress_bar
from rlftsim.jobs.runner import Inline
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.types import Scenario, Scenarios
from rlftsim.training.batches import refuse_unscored, scenario_costs
from rlftsim.training.checkpoint import Progress, newest_checkpoint, read_checkpoint, update_of, write_checkpoint
from rlftsim.training.data import batch_with_futures, scenarios_of_update
from rlftsim.training.parallel import DeviceConfig, Fabric, all_reduce_sum, local_indices, num_sharing_memory
from rlftsim.training.processes import in_processes
from rlftsim.training.run_folder import RunFolder, describe_inputs, flatten, stored_settings

TrainingScenarios = Scenarios | Scenario
"""Scenarios that a training function takes: a data set, a list, or a single scenario."""


def as_scenarios(scenarios: TrainingScenarios) -> Scenarios:
    """A sequence of scenarios, also where a single one is given."""
    return [scenarios] if isinstance(scenarios, Scenario) else scenarios


def require_trainable(
    policy: object,
    scenarios: Scenarios,
    method: str,
    *,
    needs: Sequence[str] = (),
    imitated: bool = False,
    rewarded: bool = False,
) -> Any:
    """Return the policy if a method can train it on these scenarios.

    Args:
        policy: has to be an nn.Module with a method `save_pretrained(folder, *, card)`.
        scenarios: at least one.
        method: name of the training method in messages, such as "CAT-K".
        needs: further attributes that the method uses, such as "vocabulary".
        imitated: the method uses the pre-training loss; one of the two ways to it is enough.
        rewarded: the method scores rollouts of every scenario.

    Raises:
        ConfigError: the policy has no weights or lacks an attribute, or there is no scenario.
        DataError: rewarded, and a scenario has no logged future or no evaluated agent.
    """
    name = type(policy).__name__
    if not isinstance(policy, nn.Module):
        raise ConfigError(f"{name} has no weights: there is nothing for {method} to train.")
    losses = ("teacher_forced", "imitation_loss") if imitated else ()
    if not any(hasattr(policy, loss) for loss in losses):
        needs = (*needs, *losses)  # a refusal names both
    missing = [attribute for attribute in (*needs, "save_pretrained") if not hasattr(policy, attribute)]
    if missing:
        raise ConfigError(f"{name} cannot be trained with {method}: it has no {' and no '.join(missing)}.")
    if not len(scenarios):
        raise ConfigError("no scenario to train on: is the data set empty, or the split misspelled?")
    if rewarded:
        refuse_unscored(scenarios)
    return policy


@dataclass(eq=False, kw_only=True)
class Learner:
    """The parts of a run that change from update to update, which its checkpoints hold."""

    policy: Any
    optimizer: Optimizer
    update: int = 0
    """Updates done, skipped ones included."""
    skipped_in_a_row: int = 0

    @property
    def parameters(self) -> list[nn.Parameter]:
        """The weights that are trained."""
        return [p for p in self.policy.parameters() if p.requires_grad]

    @property
    def modules(self) -> dict[str, nn.Module]:
        """Modules that a checkpoint holds, by their file name."""
        return {"policy": self.policy}

    @property
    def result(self) -> Any:
        """The policy that the run saves in the end."""
        return self.policy

    def to_numbers(self) -> dict[str, float]:
        """Numbers that a checkpoint holds beside the weights."""
        return {}

    def load_numbers(self, numbers: Mapping[str, float]) -> None:
        """Take back the numbers of a checkpoint."""

    def finish(self) -> None:
        """Make the result of what was learned, where the updates alone do not."""

    def finish_update(self, *, is_good: bool) -> None:
        """Take the optimizer's step, or skip it, and count the update either way.

        Args:
            is_good: False = the gradient cannot be used; weights and moments stay.
        """
        self.update += 1
        if is_good:
            self.optimizer.step()
            self.skipped_in_a_row = 0
        else:
            self.skipped_in_a_row += 1


def _number_of_weights(learner: Learner) -> str:
    """Number of weights that are trained, and of all if they are more, for a message: 49 of 462,696 weights."""
    trained = sum(p.numel() for p in learner.parameters)
    total = sum(p.numel() for p in learner.policy.parameters())
    return f"{trained:,} weights" if trained == total else f"{trained:,} of {total:,} weights"


@dataclass(frozen=True, eq=False)
class UpdateReport:
    """The outcome of one update."""

    values: dict[str, float]
    """Metrics by the names of metrics.jsonl."""
    note: str
    """Text beside the progress bar."""
    skipped_because: str = ""
    """Reason why the optimizer's step was skipped."""
    warnings: Sequence[str] = ()
    """Messages for the user, such as alarms."""


@runtime_checkable
class RunConfig(Protocol):
    """Settings that every training method has."""

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


def train_in_processes(
    train: Callable[[Any, Fabric], Path], config: Any, num_scenarios: int, out: str | os.PathLike[str]
) -> Path:
    """Call a function in each process of a run; returns its result.

    Args:
        train: called with the settings and the processes.
        config: a `RunConfig`. A run keeps the number of processes that it was begun with, which rounding depends on.
        num_scenarios: in the data set.
        out: the run's folder.

    Raises:
        CheckpointError: the folder holds a damaged run.
        ConfigError: several processes cannot be started here.
        NotYetError: another run is at work in the folder.
        DataError: a process died, or the folder cannot be written to.
    """
    check_folder(Path(out), "run")
    device: DeviceConfig = config.device
    begun_with = flatten(stored_settings(Path(out))).get("device.processes")
    processes = device.num_processes(num_scenarios, config.batch_size, config.micro_batch_size, begun_with)
    device = replace(device, processes=processes)
    return in_processes(partial(_train_alone, train, replace(config, device=device), Path(out)), device)


def _train_alone(train: Callable[[Any, Fabric], Path], config: Any, out: Path, fabric: Fabric) -> Path:
    """Result of `train` in one of the processes of a run, of which no other run is at work in the folder."""
    with _sole_run_in(out, fabric):
        return train(config, fabric)


@contextmanager
def _sole_run_in(out: Path, fabric: Fabric) -> Iterator[None]:
    """Hold the folder of a run, by the process that writes.

    Raises:
        NotYetError: another run is at work there.
        DataError: the folder cannot be written to.
    """
    refusal = None
    with ExitStack() as held:
        if fabric.is_global_zero:
            try:
                lease = held.enter_context(Lease(out / ".lock", Inline(), "works in"))
                held.callback(lease.remove)
            except DataError as error:
                refusal = error
        # Refused in every process, or the others would wait for this one.
        if all_reduce_sum(torch.tensor(float(refusal is not None), device=fabric.device), fabric):
            raise refusal or NotYetError(f"{out}: the first process of this run cannot work there, and says why.")
        yield


def _with_shared_cache(scenarios: Scenarios, sharing: int) -> Scenarios:
    """Scenarios of which each process keeps its part in memory, where it cannot keep all."""
    if sharing == 1 or not isinstance(scenarios, ScenarioDataset) or len(scenarios) * sharing <= scenarios.cache_size:
        return scenarios
    return ScenarioDataset(scenarios.folder, scenarios.split, cache_size=max(scenarios.cache_size // sharing, 1))


class TrainingRun:
    """A run in a folder, new or resumed.

    Args:
        policy: the initial policy; its fingerprint becomes part of the run's identity.
        scenarios: training scenarios.
        out: the run's folder.
        config: settings of the method; stored in the folder.
        fabric: processes and device.
        inputs: further hashes of what the run starts from.
        num_rollouts: of each scenario of an update; processes that are more than scenarios divide them.
        skip_rule: condition under which updates are skipped, for the message of a run that diverged.
        remedy: settings to change after a divergence, for the same message.
        may_grow: settings that a larger number continues, see `RunFolder`.

    Raises:
        CheckpointError: the folder belongs to a run with other settings or inputs.
    """

    def __init__(
        self,
        policy: object,
        scenarios: Scenarios,
        out: str | os.PathLike[str],
        config: RunConfig,
        fabric: Fabric,
        *,
        inputs: Mapping[str, str] | None = None,
        num_rollouts: int = 1,
        skip_rule: str = "their gradients are not finite",
        remedy: str = "lower learning_rate",
        may_grow: Collection[str] = (),
    ):
        self.scenarios = _with_shared_cache(scenarios, num_sharing_memory(fabric))
        self.total = config.num_updates(len(scenarios))
        # The identity of the run: another policy, data set or order of scenarios is refused.
        described = {**describe_inputs(policy, scenarios), **(inputs or {})}
        self.folder = RunFolder(Path(out), config, described, writes=fabric.is_global_zero, may_grow=may_grow)
        self._config = config
        self._fabric = fabric
        self._num_rollouts = num_rollouts
        self._skip_rule = skip_rule
        self._remedy = remedy
        # Such a run ends with nearly its initial weights, which looks like a method that does not work.
        if self.total < config.warmup_updates and fabric.is_global_zero:
            log.warning(
                f"the run ends after {self.total} of {config.warmup_updates} warm-up updates, so its weights hardly "
                "move: raise epochs, or lower warmup_updates."
            )

    def local_batch(self, update: int) -> ScenarioBatch:
        """The scenarios that this process sees in an update (counted from 0), as one batch."""
        return batch_with_futures(self.scenarios, self.local_indices(update))

    @cached_property
    def costs(self) -> Float[np.ndarray, "n"]:
        """About proportional to the time and memory that each scenario needs, see `scenario_costs`."""
        return scenario_costs(self.scenarios)

    def local_indices(self, update: int) -> list[int]:
        """Indices of the scenarios that this process sees in an update (counted from 0): a part of about equal cost."""
        chosen = scenarios_of_update(update, self._config.batch_size, len(self.scenarios), self._config.seed)
        # Costs of a list of scenarios are counted from the scenarios: not where nothing is divided.
        costs = self.costs[chosen].tolist() if self._fabric.world_size > 1 else None
        return local_indices(chosen, self._fabric, costs, num_rollouts=self._num_rollouts)

    def train(self, learner: Learner, make_update: Callable[[], UpdateReport], *, title: str, card: str = "") -> Path:
        """Make all updates that are left, and save the trained policy.

        Args:
            learner: fresh; brought to the state of the newest checkpoint if there is one.
            make_update: makes the update `learner.update` and ends it with `Learner.finish_update`.
            title: label of the progress bar.
            card: README of the resulting model folder.

        Returns:
            The model folder, `out/model`.

        Raises:
            CheckpointError: the run diverged (its last good checkpoint is named), a checkpoint is damaged, or a longer
                run was begun in the folder.
            KeyboardInterrupt: Ctrl-C, or a signal like it; says from where the run goes on.
        """
        newest = newest_checkpoint(self.folder.checkpoints)
        if newest and update_of(newest) > self.total:
            kept = f" The model of the shorter one is {self.folder.model}." if self.folder.has_model else ""
            raise CheckpointError(
                f"{self.folder.path}: a longer run was stopped here behind update {update_of(newest)}, this one has "
                f"{self.total} updates: raise epochs again to go on with it, or name another --out.{kept}"
            )
        if newest:
            progress = read_checkpoint(newest, learner.modules, learner.optimizer)
            learner.update = progress.update
            learner.load_numbers(progress.numbers)
        # Metrics of updates behind the checkpoint would appear twice.
        self.folder.continue_from(learner.update)
        if self._fabric.is_global_zero and learner.update < self.total:
            for name, value in self.folder.grows_from.items():
                log.info(f"{self.folder.model} stays the model of {value:g} {name} until the run ends.")
            begun = f"goes on behind update {learner.update}" if learner.update else "begins"
            log.info(f"{title} {begun}: {self.total} updates of {_number_of_weights(learner)}.")
        try:
            self._make_updates(learner, make_update, title)
        except KeyboardInterrupt as stop:
            newest = newest_checkpoint(self.folder.checkpoints)
            # The command line says what the same command does next.
            what_next = f"continues behind update {update_of(newest)}" if newest else "starts anew"
            stop.args = (what_next,)
            raise
        learner.finish()
        self.folder.close()
        self.folder.finish()
        if learner.result is not learner.policy:  # trained in place: the policy is what the folder holds
            learner.policy.load_state_dict(learner.result.state_dict())
        if self._fabric.is_global_zero:
            learner.policy.eval().save_pretrained(self.folder.model, card=card)
        return self.folder.model

    def _make_updates(self, learner: Learner, make_update: Callable[[], UpdateReport], title: str) -> None:
        """Make all updates that are left, with their lines of metrics and checkpoints.

        Ctrl-C waits for the end of an update, which becomes a checkpoint. Not where lightning-fabric or torchrun
        started several processes: it reaches each at another update, and one that goes on would wait for one that
        stopped.
        """
        waits = self._fabric.world_size == 1 or self._config.device.forks
        with (
            progress_bar(title, self.total, learner.update, show=self._fabric.is_global_zero) as advance,
            ctrl_c_waits(enabled=waits) as is_stopped,
        ):
            while learner.update < self.total:
                report = make_update()
                # The line is written first, so that a run that ends here shows why.
                self.folder.log(learner.update, report.values)
                self._report(learner, report)
                # A checkpoint is always the state after a good update, so that a run resumes from sound weights.
                is_last = learner.update == self.total or is_stopped()
                is_due = learner.update % self._config.checkpoint_every == 0 or is_last
                is_due = is_due and not learner.skipped_in_a_row
                self._refuse_divergence(learner, report, check_weights=is_due)
                if is_due and self._fabric.is_global_zero:
                    progress = Progress(learner.update, learner.to_numbers())
                    write_checkpoint(self.folder.checkpoints, progress, learner.modules, learner.optimizer)
                advance(note=report.note)
                if is_last:
                    break

    @property
    def _max_skipped(self) -> int:
        """Skipped updates in a row that end the run: never more than it has."""
        return min(self._config.max_skipped_in_a_row, self.total)

    def _report(self, learner: Learner, report: UpdateReport) -> None:
        if not self._fabric.is_global_zero:
            return
        if learner.skipped_in_a_row:
            limit = f"{learner.skipped_in_a_row} in a row, the run stops at {self._config.max_skipped_in_a_row}"
            log.warning(f"update {learner.update} skipped: {report.skipped_because} ({limit})")
        for warning in report.warnings:
            log.warning(f"update {learner.update}, {warning}")

    def _refuse_divergence(self, learner: Learner, report: UpdateReport, *, check_weights: bool) -> None:
        """Raise where more updates make no sense; on every process, or the others would wait forever."""
        if learner.skipped_in_a_row >= self._max_skipped:
            cause = f"{learner.skipped_in_a_row} updates in a row were skipped, {self._skip_rule}"
            raise self.folder.diverged(cause, self._remedy)
        # Not after every update: reading all weights makes a GPU wait.
        loss = report.values.get("loss", 0.0)
        if check_weights and not (math.isfinite(loss) and all(p.isfinite().all() for p in learner.parameters)):
            raise self.folder.diverged("the loss or a weight is not finite any more", self._remedy)

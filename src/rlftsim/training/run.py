"""The loop of a training run, for every method: resuming, skips, divergence, validation, checkpoints, logs, progress.

A method brings its `Learner` (the weights and counters that change) and makes the updates (`training.method`). A run
leaves files through `training.run_folder`.
"""

import math
import os
from collections.abc import Callable, Collection, Iterator, Mapping
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch

from rlftsim.errors import CheckpointError, ConfigError, DataError, NotYetError, whole_number
from rlftsim.jobs.folder import Lease, check_folder
from rlftsim.jobs.interruption import ctrl_c_waits
from rlftsim.jobs.progress import log, progress_bar
from rlftsim.jobs.runner import Inline
from rlftsim.scenario.types import Scenario, Scenarios
from rlftsim.training.checkpoint import (
    Progress,
    newest_checkpoint,
    parse_update,
    read_checkpoint,
    remove_old_checkpoints,
    write_checkpoint,
)
from rlftsim.training.data import find_starts, share_cache
from rlftsim.training.method import Learner, Method, UpdateReport, UpdateScenarios
from rlftsim.training.monitoring import Validator, check_validation
from rlftsim.training.parallel import Fabric, all_reduce_sum, count_processes, forks_processes, num_sharing_memory
from rlftsim.training.processes import linked_processes
from rlftsim.training.registry import find_method
from rlftsim.training.run_folder import RunFolder, describe_inputs, flatten, read_metrics, stored_settings

STOPPED = "stopped"
"""Number of a checkpoint that says that the run ended there by itself."""
OnUpdate = Callable[[int, dict[str, float]], object]
"""Called with the number of updates done and the metrics of the update; what is returned has no effect."""
TrainingScenarios = Scenarios | Scenario
"""Scenarios that a run takes: a data set, a list, or a single scenario."""


def train_policy(
    policy: Any,
    scenarios: TrainingScenarios,
    out: str | os.PathLike[str],
    settings: Any,
    *,
    held_out: TrainingScenarios | None = None,
    card: str = "",
    max_updates: int | None = None,
    on_update: OnUpdate | None = None,
    trackers: Collection[str] = ("tensorboard",),
) -> Path:
    """Train a policy in place; resumes where a run in `out` was stopped, or ended below a setting that `may_grow`.

    Args:
        policy: An nn.Module with the attributes that the method needs, and `save_pretrained`.
        scenarios: Data set, list or single scenario, with futures.
        out: Folder of the run: settings, metrics, checkpoints, and the model at the end.
        settings: Settings of the run; the type decides the method: `FinetuneConfig` trains by rewards, `PretrainConfig`
            along the log, and so on. A resumed run keeps the number of processes, which rounding depends on.
        held_out: Scenarios to validate on in closed loop, see `validation` of the settings; None = no validation.
        card: README of the resulting model folder.
        max_updates: Updates after which the run ends early, with a model; no update depends on the number, so that a
            larger number continues to the same weights. None = all that the settings ask for.
        on_update: Function that the first process calls behind each update with the number of updates done and the
            metrics by name. An error in the function ends the run, which goes on from the last checkpoint.
        trackers: Names of trackers, which receive the metrics of each update.

    Returns:
        The model folder, `out/model`.

    Raises:
        ConfigError: The method cannot train this policy, does not validate or cannot end early, there is no scenario,
            or several processes cannot be started here.
        DataError: A scenario lacks data that the method needs, the folder cannot be written to, or a process died.
        CheckpointError: `out` holds a different or a damaged run, or the run diverged (the last good checkpoint is
            named).
        NotYetError: A second run is at work in `out`.
        KeyboardInterrupt: Ctrl-C or a similar signal; says from where the run goes on.
    """
    method = _find_method(settings, held_out, max_updates)
    scenarios = [scenarios] if isinstance(scenarios, Scenario) else scenarios
    held_out = [held_out] if isinstance(held_out, Scenario) else held_out
    out = Path(out)
    check_folder(out, "run")
    logs, scenarios = scenarios, find_starts(policy, scenarios, settings)
    begun_with = flatten(stored_settings(out))
    processes = count_processes(
        settings.device, len(scenarios), settings.batch_size, settings.micro_batch_size,
        begun_with.get("device.processes"),
    )  # fmt: skip
    settings = replace(settings, device=replace(settings.device, processes=processes))
    if method.validates and settings.validation.every == "auto":
        num_updates = settings.num_updates(len(scenarios)) if held_out is not None else 0
        num_updates = min(num_updates, max_updates or num_updates)
        settings = replace(settings, validation=_fit_validation(settings, num_updates, begun_with))
    run = TrainingRun(method, policy, scenarios, logs, out, settings, held_out, card, max_updates, on_update, trackers)
    with linked_processes(run.work, settings.device) as fabric:
        return run.work(fabric)


def _fit_validation(settings: Any, num_updates: int, begun_with: Mapping[str, Any]) -> Any:
    """Settings of the validation with numbers in place of "auto": those of the run in the folder if it validates."""
    if begun_with.get("validation.every"):
        stored = {name: begun_with[f"validation.{name}"] for name in ("every", "num_scenarios", "keep_best")}
        return replace(settings.validation, **stored)
    fitted = settings.validation.fit(num_updates, settings.batch_size * getattr(settings, "num_rollouts", 1))
    if num_updates and not fitted.every:
        log.info("no validation: it would take more than 5 % of so short a run. Set validation.every to have one.")
    return fitted


def _find_method(settings: Any, held_out: TrainingScenarios | None, max_updates: int | None) -> Method[Any]:
    """The method of settings, which has to do all that is asked of the run.

    Raises:
        ConfigError: Settings of no method, or a method that does not validate or cannot end early.
    """
    method = find_method(settings)
    if method is None:
        raise ConfigError(f"{type(settings).__name__} are settings of no training method: `rlftsim recipe` lists some.")
    if held_out is not None and not method.validates:
        raise ConfigError(
            f"held_out has no effect: {method.title} does not validate, but of the methods of fine-tuning rlft, "
            "CAT-K and RoaD do."
        )
    if max_updates is not None and whole_number("max_updates", max_updates, 1) and method.needs_all_updates:
        raise ConfigError(
            f"max_updates={max_updates} would leave no model: {method.title} has one after all updates alone. Set a "
            "limit to the scenarios."
        )
    return method


@contextmanager
def _hold_folder(out: Path, fabric: Fabric) -> Iterator[None]:
    """Hold the folder of a run, by the process that writes.

    Raises:
        NotYetError: A second run is at work there.
        DataError: The folder cannot be written to.
    """
    refusal = None
    with ExitStack() as stack:
        if fabric.global_rank == 0:
            try:
                lease = stack.enter_context(Lease(out / ".lock", Inline(), "works in"))
                stack.callback(lease.remove)
            except DataError as error:
                refusal = error
        # Refused in every process, or the others would wait for this one.
        if all_reduce_sum(torch.tensor(float(refusal is not None), device=fabric.device), fabric):
            raise refusal or NotYetError(f"{out}: the first process of this run cannot work there, and says why.")
        yield


@dataclass(eq=False)
class TrainingRun:
    """A run in a folder, new or resumed."""

    method: Method[Any]
    policy: object
    scenarios: Scenarios
    """Training scenarios."""
    logs: Scenarios
    """Where these begin; a different data set or order of scenarios is refused."""
    out: Path
    """Folder of the run."""
    settings: Any
    """Settings of the method, stored in the folder."""
    held_out: Scenarios | None
    """Scenarios to validate on."""
    card: str
    """README of the model folder."""
    max_updates: int | None
    """Updates after which the run ends early."""
    on_update: OnUpdate | None
    trackers: Collection[str]
    """Names of trackers."""

    def work(self, fabric: Fabric) -> Path:
        """The model of the run: all updates that are left, in this process.

        Ctrl-C waits for the end of an update, which becomes a checkpoint.

        Args:
            fabric: Device and processes; only rank 0 writes files.

        Raises:
            CheckpointError: The folder belongs to a run with other settings or inputs.
        """
        self.fabric, self.is_first = fabric, fabric.global_rank == 0
        self.scenarios = share_cache(self.scenarios, num_sharing_memory(fabric))
        if self.held_out is not None and self.settings.validation.every:
            check_validation(self.policy, self.held_out, self.settings.validation)
        else:
            self.held_out = None
        self.learner = learner = self.method.start(self.policy, self.scenarios, self.settings, fabric)
        update_scenarios = UpdateScenarios(self.scenarios, self.settings, fabric, learner)
        with _hold_folder(self.out, fabric):
            self._open()
            validator = None
            if self.held_out is not None:
                # before the weights of a checkpoint are loaded: gains refer to the policy that the run began with
                config = self.settings.validation
                start = learner.result if config.paired or config.keep_best else None
                validator = Validator(self.held_out, config, fabric, start)
            self.resume()
            with self.progress() as is_stopped:
                note = ""
                while learner.update < self.num_updates:
                    report = self.method.update(learner, update_scenarios, fabric)
                    ends = learner.update == self.num_updates or bool(report.stop_because)
                    if validator and (ends or validator.config.is_due(learner.update, self.num_updates)):
                        report.values.update(validator.validate(learner.result))
                        gain = f" ({gain:+.3f})" if (gain := report.values.get("validation_gain")) is not None else ""
                        note = f", RMM {report.values['validation_rmm']:.3f}{gain}"
                        self.keep_best(report.values)
                    is_last = ends or is_stopped()
                    self.finish_update(replace(report, note=report.note + note), is_last=is_last)
                    if self.on_update is not None and self.is_first:
                        self.on_update(learner.update, dict(report.values))
                    if is_last:
                        break
            return self.finish()

    def _open(self) -> None:
        """Open the folder, and warn of a run that ends in the warm-up."""
        learner, total = self.learner, self.settings.num_updates(len(self.scenarios))
        self.num_updates = min(total, self.max_updates or total)
        inputs = {**describe_inputs(learner.policy, self.logs, self.held_out), **learner.inputs}
        self.folder = RunFolder(self.out, self.settings, inputs, writes=self.is_first, may_grow=learner.may_grow)
        self._advance: Callable[..., object] = print
        self._best: tuple[float, int] | None = None
        """Lower bound of the gain in the best validation so far, and its update."""
        # Such a run ends with nearly its initial weights, which looks like a method that does not work.
        if self.num_updates < self.settings.warmup_updates and self.is_first:
            log.warning(
                f"the run ends after {self.num_updates} of {self.settings.warmup_updates} warm-up updates, so its "
                "weights hardly move: raise epochs or max_updates, or lower warmup_updates where that can be set."
            )

    def resume(self) -> None:
        """Bring the learner to the state of the newest checkpoint, if any.

        Raises:
            CheckpointError: The checkpoint is damaged, or a longer run was begun in the folder.
        """
        learner, newest = self.learner, newest_checkpoint(self.folder.checkpoints)
        if newest and parse_update(newest) > self.num_updates:
            shorter = f" The model of the shorter one is {self.folder.model}." if self.folder.has_model else ""
            raise CheckpointError(
                f"{self.folder.path}: a longer run was stopped here behind update {parse_update(newest)}, this one has "
                f"{self.num_updates} updates: raise epochs or max_updates to go on, or name another --out.{shorter}"
            )
        if newest:
            progress = read_checkpoint(newest, learner.modules, learner.optimizer, learner.to_numbers())
            learner.update = progress.update
            learner.load_numbers(progress.numbers)
            if progress.numbers.get(STOPPED) and not self.folder.grows_from:
                self.num_updates = learner.update
        # Metrics of updates behind the checkpoint would appear twice.
        self.folder.continue_from(learner.update, self.trackers if learner.update < self.num_updates else ())
        for values in read_metrics(self.folder.path):
            if values["update"] <= learner.update:  # the process of rank 0 may not have dropped the others yet
                self._choose_best(values)
        if self.is_first and learner.update < self.num_updates:
            if self.folder.has_model:
                log.info(f"{self.folder.model} stays the model of the shorter run until this one ends.")
            begun = f"goes on behind update {learner.update}" if learner.update else "begins"
            log.info(f"{self.method.title} {begun}: {self.num_updates} updates of {_count_weights(learner)}.")

    @contextmanager
    def progress(self) -> Iterator[Callable[[], bool]]:
        """Show the progress of the updates made inside; yields a function that is True once Ctrl-C was pressed.

        Ctrl-C does not wait where lightning-fabric or torchrun started several processes: Ctrl-C reaches each process
        at a different update, and a running process would wait for a stopped process.

        Raises:
            KeyboardInterrupt: Ctrl-C or a similar signal, when the update is done.
        """
        title, waits = self.method.title, self.fabric.world_size == 1 or forks_processes(self.settings.device)
        try:
            with (
                progress_bar(title, self.num_updates, self.learner.update, show=self.is_first) as self._advance,
                ctrl_c_waits(enabled=waits) as is_stopped,
            ):
                yield is_stopped
        except KeyboardInterrupt as stop:
            newest = newest_checkpoint(self.folder.checkpoints)
            # The command line says what the same command does next.
            stop.args = (f"continues behind update {parse_update(newest)}" if newest else "starts anew",)
            self.folder.finish_trackers("stopped")
            raise
        except Exception:
            self.folder.finish_trackers("failed")
            raise

    def keep_best(self, values: Mapping[str, Any]) -> None:
        """Keep the weights if this is the best validation so far.

        Args:
            values: Metrics of the update, those of its validation included.
        """
        if self._choose_best({**values, "update": self.learner.update}) and self.is_first:
            self.folder.write_best(self.learner.update, self.learner.result)

    def _choose_best(self, values: Mapping[str, Any]) -> bool:
        """Compare a validation with the best so far; True if it is better and the best is kept."""
        if not getattr(getattr(self.settings, "validation", None), "keep_best", False):
            return False
        bound = values.get("validation_gain_low", math.nan)
        if math.isfinite(bound) and (self._best is None or bound > self._best[0]):
            self._best = bound, int(values["update"])
            return True
        return False

    def finish_update(self, report: UpdateReport, *, is_last: bool) -> None:
        """Log an update, and write a checkpoint if due.

        Args:
            report: Outcome of the update.
            is_last: True = the run ends or stops here, which makes a checkpoint due.

        Raises:
            CheckpointError: The run diverged.
        """
        learner = self.learner
        # The line is written first, so that a run that ends here shows why.
        self.folder.log(learner.update, report.values)
        if self.is_first:
            if learner.skipped_in_a_row:
                limit = f"{learner.skipped_in_a_row} in a row, the run stops at {self.settings.max_skipped_in_a_row}"
                log.warning(f"update {learner.update} skipped: {report.skipped_because} ({limit})")
            for warning in report.warnings:
                log.warning(f"update {learner.update}, {warning}")
            if report.stop_because:
                log.warning(f"the run ends at update {learner.update} of {self.num_updates}: {report.stop_because}")
        # A checkpoint is always the state after a good update, so that a run resumes from sound weights.
        is_due = (is_last or learner.update % self.settings.checkpoint_every == 0) and not learner.skipped_in_a_row
        self._check_divergence(report, has_checked_weights=is_due)
        if is_due and self.is_first:
            numbers = learner.to_numbers() | ({STOPPED: 1.0} if report.stop_because else {})
            progress = Progress(learner.update, numbers)
            write_checkpoint(self.folder.checkpoints, progress, learner.modules, learner.optimizer)
            self.folder.remove_superseded_best()
        self._advance(note=report.note)

    def _check_divergence(self, report: UpdateReport, *, has_checked_weights: bool) -> None:
        """Raise where more updates make no sense; on every process, or other processes would wait forever."""
        learner = self.learner
        # Never more skipped updates than the run has.
        if learner.skipped_in_a_row >= min(self.settings.max_skipped_in_a_row, self.num_updates):
            cause = f"{learner.skipped_in_a_row} updates in a row were skipped, {learner.skip_rule}"
            raise self.folder.diverged(cause, learner.remedy)
        # Not after every update: reading all weights makes a GPU wait.
        loss = report.values.get("loss", 0.0)
        if has_checked_weights and not (math.isfinite(loss) and all(p.isfinite().all() for p in learner.parameters)):
            raise self.folder.diverged("the loss or a weight is not finite any more", learner.remedy)

    def finish(self) -> Path:
        """Save the trained policy, and return the model folder."""
        learner = self.learner
        learner.finish()
        self._take_best()
        self.folder.finish()
        if learner.result is not learner.policy:  # trained in place: the policy is what the folder holds
            learner.policy.load_state_dict(learner.result.state_dict())
        if self.is_first:
            learner.policy.eval().save_pretrained(self.folder.model, card=self.card)
            # of a run that was killed behind its last checkpoint
            remove_old_checkpoints(self.folder.checkpoints)
            self.folder.remove_superseded_best()
        self.folder.finish_trackers("finished")
        return self.folder.model

    def _take_best(self) -> None:
        """Load the weights of the best validation, where one was kept and later updates were made."""
        if self._best is None:
            return
        bound, update = self._best
        if update != self.learner.update:
            self.folder.load_best(update, self.learner.result)
        if not self.is_first:
            return
        log.info(
            f"{self.folder.model} is the model of update {update}: the lower bound of its gain in RMM over the start, "
            f"{bound:+.4f}, is the highest of all validations."
        )
        if bound <= 0:
            log.warning("no validation is clearly better than the start: evaluate both before you take this model.")


def _count_weights(learner: Learner) -> str:
    """Number of weights that are trained, and of all weights if more, for a message: 49 of 462,696 weights."""
    trained = sum(p.numel() for p in learner.parameters)
    total = sum(p.numel() for p in learner.policy.parameters())
    return f"{trained:,} weights" if trained == total else f"{trained:,} of {total:,} weights"

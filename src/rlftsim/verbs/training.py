"""Parts that the verbs `pretrain` and `finetune` share."""

import copy
import os
import tempfile
from contextlib import suppress
from dataclasses import replace
from pathlib import Path
from typing import Any, Literal

from torch import nn

from rlftsim.errors import ConfigError, RlftsimError, whole_number
from rlftsim.evaluation.learning_curve import film_model, write_calibration_picture, write_learning_curve
from rlftsim.jobs.progress import log
from rlftsim.policies.hub import pin_model
from rlftsim.policies.registry import find_device
from rlftsim.recipes.card import append_cards, model_card
from rlftsim.rollout.policy import Policy, get_device
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.open import list_splits, open_dataset
from rlftsim.scenario.types import Scenarios, list_scenario_ids
from rlftsim.training.parallel import is_first_process
from rlftsim.training.run import train_policy
from rlftsim.training.trackers import find_tracker
from rlftsim.verbs.inputs import remember_name, to_policy

VALIDATION = "validation"
TUNE = "tune"
"""Split that is validated on where none is named: the part of "validation" that is not of the exam."""


def load_start(policy: Any) -> tuple[Policy, Any]:
    """A policy that may be trained in place, its weights on the CPU where it was given by its name; and the device for
    the result.

    Args:
        policy: Policy, which is copied, or a name for `load_policy`.

    Raises:
        ConfigError: Neither a policy nor the name of one.
    """
    if isinstance(policy, str | os.PathLike):
        return to_policy(policy, "cpu"), find_device("auto")
    # without weights there is nothing to copy; training refuses such a policy with a message
    given = to_policy(policy)
    return copy.deepcopy(given) if isinstance(given, nn.Module) else given, get_device(given)


def train(
    policy: Any,
    scenarios: Scenarios,
    out: str | os.PathLike[str] | None,
    settings: Any,
    *,
    device: Any,
    tracker: str,
    **options: Any,
) -> Any:
    """The policy, trained in place and ready to simulate; the pictures of its run are drawn.

    Args:
        policy: Policy to train, or a student with a teacher (`training.distill.Lesson`).
        scenarios: Training scenarios, with their futures.
        out: Folder of the run; None = a temporary one.
        settings: Settings of the method.
        device: Device of the result.
        tracker: Names of trackers, with commas between.
        options: Further arguments of `train_policy`, such as the scenarios for validation.

    Raises:
        ConfigError: An unknown tracker, or see `train_policy`.
    """
    trackers = [name for name in tracker.split(",") if name]
    for name in trackers:  # a mistyped one is refused before any work
        find_tracker(name)
    # Weights of a loaded policy are frozen; each method freezes again what it does not train.
    if isinstance(policy, nn.Module):
        policy.requires_grad_(True)
    if out is None:
        with tempfile.TemporaryDirectory(prefix="rlftsim-") as folder:
            train_policy(policy, scenarios, folder, settings, trackers=trackers, **options)
    else:
        try:
            model = train_policy(policy, scenarios, out, settings, trackers=trackers, **options)
        except BaseException:
            # The reason why the run ended matters more than a picture that could not be drawn.
            with suppress(RlftsimError, OSError):
                _draw_learning_curve(out)
            raise
        _draw_learning_curve(out)
        if is_first_process():
            write_calibration_picture(model)
    assert isinstance(policy, nn.Module)
    policy.eval().requires_grad_(False).to(device)
    if out is not None and "tensorboard" in trackers and is_first_process() and isinstance(policy, Policy):
        with suppress(RlftsimError, OSError):  # a picture is no reason to lose a model
            film_model(Path(out), policy, (options["held_out"] or scenarios)[0])
    if out is not None and isinstance(policy, Policy):
        remember_name(policy, out)
    return policy


def write_card(description: str, scenarios: Scenarios, start: Any = None) -> str:
    """README of the model folder; terms are known of data sets and of starts that have a name.

    Args:
        description: Words for the kind of training, such as "pre-trained".
        scenarios: Training scenarios.
        start: Policy that training started from, or its name; None = fresh weights.
    """
    name = pin_model(start) if isinstance(start, str | os.PathLike) else None
    if start is not None:
        description = f"{description} from {name or type(start).__name__}"
    if isinstance(scenarios, ScenarioDataset):
        return model_card(description, scenarios.folder, len(scenarios), name)
    card = f"# Traffic model, {description}\n\n* trained on {len(scenarios)} scenarios handed over in Python\n"
    return append_cards(card, [] if name is None else [name])


def with_changes(settings: Any, processes: Any, seed: int | None) -> Any:
    """Settings of a run on so many processes and with this seed; None changes nothing.

    Args:
        settings: Settings of the method.
        processes: Number of processes, "auto", or None.
        seed: Seed of the run, or None.
    """
    if processes is not None:
        settings = replace(settings, device=replace(settings.device, processes=processes))
    return settings if seed is None else replace(settings, seed=whole_number("seed", seed, 0))


def find_held_out(
    data: Any, training: Scenarios, split: str | None, every: int | Literal["auto"]
) -> ScenarioDataset | None:
    """Scenarios to validate on; None = no validation was requested, or the data set has no such split and none
    was named.

    Args:
        data: Training scenarios as they were handed over; only a data set has a split to validate on.
        training: Training scenarios; "auto" validates on none of them, a number only warns about it.
        split: Split to validate on; None = "tune", where the data set has a split "validation".
        every: Updates between two validations, or "auto"; 0 = none.

    Raises:
        ConfigError: A split is named, but there is no validation.
        DataError: No such split.
    """
    if split is not None and not every:
        raise ConfigError(f"--validation-split {split} has no effect: set validation.every to a number of updates.")
    if not every:
        return None
    if isinstance(data, ScenarioDataset):
        data = data.folder
    if not isinstance(data, str | os.PathLike):
        if split is not None:
            raise ConfigError(f"validation_split={split!r} has no effect: the scenarios are not those of a data set.")
        return None
    if split is None and VALIDATION not in list_splits(data):
        log.info(f"no validation: {data} has no split {VALIDATION!r}, name another with --validation-split.")
        return None
    held_out = open_dataset(data, split or TUNE)
    if split is None and not set(held_out.scenario_ids).isdisjoint(list_scenario_ids(training)):
        if every == "auto":
            log.info(f"no validation: the training scenarios are of the split {VALIDATION!r}, too.")
            return None
        log.warning("the validation has training scenarios, too: name others with --validation-split.")
    return held_out


def _draw_learning_curve(out: str | os.PathLike[str]) -> None:
    if is_first_process():
        write_learning_curve(Path(out))

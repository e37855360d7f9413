"""Experiment suite: a folder in which models are trained and evaluated once, for all experiments.

config.json, environment.json   settings of the suite; a folder of other settings is refused
vocabulary.safetensors          motion and map tokens
runs/base/                      a training run each, see `training.run_folder`
runs/mloo-seed0/3-epochs/
evaluations/*.parquet           an evaluation each
variances/                      see `evaluation.reward_variance`
attainment/                     goals reached and passed, see `evaluation.goal_attainment`
NAME.md, NAME.json, NAME.png    results of an experiment

Stages are shared: a model that an experiment has trained is found by the next.
"""

import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

from rlftsim.errors import ConfigError
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate
from rlftsim.evaluation.results import Evaluation, GoalChoice
from rlftsim.experiments.model_specs import BASE, CATK, GCSL, ROAD, Base, Baseline, Budget, FineTuned, Guided, ModelSpec
from rlftsim.experiments.tables import Row
from rlftsim.jobs.progress import log
from rlftsim.policies.registry import Device, load_policy, load_policy_or_oracle, with_guidance
from rlftsim.recipes.base import Recipe
from rlftsim.recipes.train import (
    GoalConditioning,
    find_vocabulary,
    finetune_model,
    open_training,
    pretrain_policy,
    start_from_shorter_run,
)
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import ConditionablePolicy, Policy, TokenPolicy
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.training.parallel import uses_cuda
from rlftsim.training.run_folder import RunFolder, flatten, may_change, to_plain


@dataclass(frozen=True)
class Stage:
    """Work that an experiment needs, such as a training or an evaluation."""

    title: str
    """The first word names the activity ("fine-tune", "evaluate"); stages of an activity should last equally long."""
    is_finished: bool
    """True = finished by an earlier call: running the stage takes no time."""
    run: Callable[[], object]


def run_stages(stages: Sequence[Stage]) -> None:
    """Run stages and log a line for each: number, title, and about how long the remaining stages take.

    Args:
        stages: Stages in order. A title that comes again is neither counted nor logged again.
    """
    remaining = {stage.title: stage.is_finished for stage in stages}
    total, seconds = len(remaining), {}  # of each activity's stages, without those that were finished before
    for stage in stages:
        if stage.title not in remaining:
            stage.run()
            continue
        number = total - len(remaining) + 1
        status = "  (finished before)" if stage.is_finished else _format_time_left(remaining, seconds)
        log.info(f"{number}/{total}  {stage.title}{status}")
        start = time.monotonic()
        stage.run()
        del remaining[stage.title]
        if not stage.is_finished:
            seconds.setdefault(stage.title.partition(" ")[0], []).append(time.monotonic() - start)


def _format_time_left(remaining: dict[str, bool], seconds: dict[str, list[float]]) -> str:
    """Time left in words; empty as long as an activity has not been timed."""
    activities = [title.partition(" ")[0] for title, is_finished in remaining.items() if not is_finished]
    if not all(activity in seconds for activity in activities):
        return ""
    # Every stage lasts as long as the mean of its activity.
    minutes = sum(sum(seconds[activity]) / len(seconds[activity]) for activity in activities) / 60
    return f"  (about {minutes:.0f} min to go)" if minutes >= 1 else "  (less than a minute to go)"


@dataclass(frozen=True)
class ExperimentSuite:
    """A folder of stages and the shared settings.

    Raises:
        CheckpointError: The folder belongs to other settings, data or base model.
        DataError: No such data set.
        ConfigError: No seed, or training on several GPUs.
    """

    recipe: Recipe
    data: Path
    """A data set with the splits training and validation."""
    out: Path
    evaluation: EvaluateConfig = field(default_factory=EvaluateConfig)
    num_seeds: int = 1
    """Of fine-tuning. More may be added later."""
    base_model: str | None = None
    """Model to fine-tune, of any policy: a folder or a registered name; None = one is pre-trained by the recipe."""
    counterpart_model: str | None = None
    """The same for the recipe's counterpart, in experiments that compare two architectures."""
    device: Device = "cpu"
    """Of evaluations; training has its own in the recipe."""

    def __post_init__(self) -> None:
        if self.num_seeds < 1:
            raise ConfigError(f"an experiment needs at least one seed, got {self.num_seeds}.")
        recipe = self.recipe
        sections = (recipe.pretrain, recipe.finetune, recipe.catk, recipe.road, recipe.gcsl)
        devices = [section.device for section in sections if section is not None]
        if any(uses_cuda(device) and device.processes not in ("auto", 1) for device in devices):
            raise ConfigError(
                "experiments train on one GPU: leave device.processes at auto, or train by `rlftsim finetune` and "
                "compare by `rlftsim evaluate`."
            )
        # A data set that is not there must not claim the folder, and one without the split to evaluate on must not be
        # trained on: both are opened before anything is written.
        _ = self.training
        ScenarioDataset(self.data, self.evaluation.split)
        # A folder of other settings is refused; writing waits for the first stage, as the suite may be refused before.
        RunFolder(self.out, self._identity(), writes=False)

    @cached_property
    def training(self) -> ScenarioDataset:
        """Training scenarios of the data set."""
        return open_training(self.data)

    @property
    def budget(self) -> Budget:
        """Budget of fine-tuning, from the recipe."""
        config = self.recipe.finetune
        return Budget(config.num_updates(len(self.training)), config.batch_size, config.num_rollouts)

    def evaluate(self, rows: Mapping[str, Sequence[ModelSpec]], *, goals: GoalChoice = "none") -> dict[str, Row]:
        """Rows of a table by name; missing models are trained and evaluated.

        Args:
            rows: Specifications by row: a single model, or the same model with several seeds.
            goals: Goals of the evaluated agents: "none", or "logged" for the logged endpoints.
        """
        RunFolder(self.out, self._identity(), writes=True)
        config, folder = replace(self.evaluation, goals=goals), self.out / "evaluations"
        evaluations: dict[ModelSpec, Evaluation] = {}

        def evaluate_spec(spec: ModelSpec) -> None:
            policy = load_policy_or_oracle(self._find_model(spec), self.device)
            # An evaluation that is finished is read from its file.
            evaluations[spec] = evaluate(policy, self.data, folder, config, name=self.evaluation_name(spec, goals))

        # A model that is in several rows is trained and evaluated once.
        stages = []
        for spec in dict.fromkeys(spec for row in rows.values() for spec in row):
            title = f"evaluate {self.title(spec)}{'' if goals == 'none' else f', {goals} goals'}"
            is_finished = (folder / f"{self.evaluation_name(spec, goals)}.parquet").exists()
            stages += [*self._training_stages(spec), Stage(title, is_finished, partial(evaluate_spec, spec))]
        run_stages(stages)
        return {name: Row(name, tuple(evaluations[spec] for spec in row)) for name, row in rows.items()}

    def check_goals(self) -> None:
        """Check that the recipe and the base model can be given goals, before any model is trained.

        Raises:
            ConfigError: A recipe without goal relabeling, or a base model that cannot be given goals.
        """
        if self.recipe.gcsl is None:
            raise ConfigError(
                "this experiment is about goals, and the recipe has no section gcsl to teach them: name another "
                "recipe, such as smart-demo."
            )
        base = None if self.base_model is None else load_policy(self.base_model)
        # Goals are taught by relabelling, which learns tokens.
        if base is not None and not (isinstance(base, ConditionablePolicy) and isinstance(base, TokenPolicy)):
            raise ConfigError(
                f"this experiment is about goals, and {self.base_model} cannot be given any: take a model that can, "
                "such as demo-base."
            )

    def select_feasible(self, rows: Mapping[str, Sequence[ModelSpec]]) -> dict[str, Sequence[ModelSpec]]:
        """Rows of methods that can train the suite's policies; a warning names the rows that are left out.

        Args:
            rows: Specifications by row, as for `evaluate`.
        """
        # CAT-K and goal relabeling learn tokens; a recipe may leave either out.
        if self.base_model is None:
            has_tokens = self.recipe.tokens is not None
        else:
            has_tokens = isinstance(load_policy(self.base_model), TokenPolicy)
        sections = {CATK: self.recipe.catk, ROAD: self.recipe.road, GCSL: self.recipe.gcsl}
        unusable = {method for method, section in sections.items() if section is None or not has_tokens}
        omitted_rows = [
            name
            for name, specs in rows.items()
            if any(isinstance(s, FineTuned) and s.method in unusable for spec in specs for s in self._lineage(spec))
        ]
        if omitted_rows:
            methods = " and ".join(sorted(unusable))
            log.warning(f"left out: {', '.join(omitted_rows)} (the policy cannot be trained with {methods})")
        return {name: specs for name, specs in rows.items() if name not in omitted_rows}

    def base(self) -> str:
        """Name or folder of the base model; pre-trained where there is none."""
        return self.models([BASE])[BASE]

    def models(self, specs: Sequence[ModelSpec]) -> dict[ModelSpec, str]:
        """Names or folders of policies, for `load_policy_or_oracle`; models that are missing are trained."""
        RunFolder(self.out, self._identity(), writes=True)
        run_stages([stage for spec in specs for stage in self._training_stages(spec)])
        return {spec: self._find_model(spec) for spec in specs}

    def policy(self, spec: ModelSpec) -> Policy:
        """Policy of a specification on the device of evaluations; trained where there is none."""
        return load_policy(self.models([spec])[spec], self.device)

    def title(self, spec: ModelSpec) -> str:
        """A specification in words."""
        if isinstance(spec, Guided):
            return f"{self.title(spec.of)}, guidance scale {spec.scale:g}"
        if not isinstance(spec, FineTuned):
            return spec.name.replace("_", " ")
        epochs = self._epochs(spec)
        return f"{spec.name} ({epochs:g} epoch{'s' if epochs != 1 else ''})"

    def model_folder(self, spec: Base | FineTuned) -> Path:
        """Folder of the run that trains a model."""
        folder = self.out / "runs" / spec.name
        return folder if isinstance(spec, Base) else folder / f"{self._epochs(spec):g}-epochs"

    def evaluation_name(self, spec: ModelSpec, goals: GoalChoice = "none") -> str:
        """Name of the files with a model's results.

        Args:
            spec: Specification of the model.
            goals: Goals of the evaluated agents: "none" or "logged", which stands in the name.
        """
        if isinstance(spec, Guided):
            return f"{self.evaluation_name(spec.of, goals)}-guided-{spec.scale:g}"
        epochs = f"-{self._epochs(spec):g}-epochs" if isinstance(spec, FineTuned) else ""
        return f"{spec.name}{epochs}{'' if goals == 'none' else f'-{goals}-goals'}"

    # ---- stages ---------------------------------------------------------------------------------------------------

    def _training_stages(self, spec: ModelSpec) -> list[Stage]:
        """Trainings that a specification needs, those of base models first."""
        stages = []
        for model in self._lineage(spec):
            verb, train = ("pre-train", self._pretrain) if isinstance(model, Base) else ("fine-tune", self._finetune)
            # A run that is finished returns at once.
            is_finished = (self.model_folder(model) / "model").exists()
            stages.append(Stage(f"{verb} {self.title(model)}", is_finished, partial(train, model)))
        return stages

    def _lineage(self, spec: ModelSpec) -> list[Base | FineTuned]:
        """Models to train for a specification, the base model first."""
        if isinstance(spec, Guided):
            return self._lineage(spec.of)
        # The suite's own base model is not trained, but a weaker one beside it is.
        if isinstance(spec, Baseline) or (spec == BASE and self.base_model):
            return []
        return [*(self._lineage(spec.base) if isinstance(spec, FineTuned) else ()), spec]

    def _find_model(self, spec: ModelSpec) -> str:
        """Name or folder of a policy after all trainings."""
        if isinstance(spec, Baseline):
            return spec.name
        if spec == BASE and self.base_model:
            return self.base_model
        if not isinstance(spec, Guided):
            return str(self.model_folder(spec) / "model")
        # Guidance scales a weight: the folder is written anew each time, nothing is trained.
        folder = self.model_folder(spec.of) / f"guided-{spec.scale:g}"
        policy = with_guidance(load_policy(self._find_model(spec.of)), spec.scale)
        policy.save_pretrained(folder, card=f"# {self.title(spec)}\n")
        return str(folder)

    def _pretrain(self, base: Base) -> None:
        recipe, vocabulary, folder = self.recipe, None, self.model_folder(base)
        if self.base_model:
            # A base model for comparison, such as a weaker one: architecture and tokens are those of the suite's.
            base_policy = load_policy(self.base_model)
            try:
                recipe = recipe.like(base_policy)
            except ConfigError as error:
                message = f"the recipe pre-trains no model like {self.base_model}: leave the base model out"
                raise ConfigError(f"{message} ({str(error).removesuffix('.')}).") from None
            vocabulary = getattr(base_policy, "vocabulary", None)
        elif recipe.tokens is not None:
            origin = f"experiments on {self.data.name}, {recipe.tokens}"
            path = self.out / "vocabulary.safetensors"
            vocabulary = find_vocabulary(self.training, recipe.tokens, path, origin=origin)
        config = recipe.pretrain if base.epochs is None else replace(recipe.pretrain, epochs=base.epochs)
        pretrain_policy(recipe.new_policy(vocabulary), self.training, config, folder)

    def _finetune(self, spec: FineTuned) -> None:
        out = self.model_folder(spec)
        conditioning = None if spec.goals is None else GoalConditioning(spec.goals.encoding)
        if spec.method not in (CATK, ROAD, GCSL):
            # Only runs with a reward continue shorter ones. The learning rate of the other methods decays over the
            # whole run, so that a shorter run is no part of a longer one.
            start_from_shorter_run(out, self._epochs(spec))
        config = spec.training_config(self.recipe)
        finetune_model(self._find_model(spec.base), self.training, config, out, conditioning=conditioning)

    def _epochs(self, spec: FineTuned) -> float:
        section = (self.recipe.gcsl if spec.method == GCSL else None) or self.recipe.finetune
        return section.epochs * spec.epochs_fraction

    def _identity(self) -> dict[str, Any]:
        """Settings that all stages of the folder share, without those that change no result."""
        recipe = flatten(to_plain(self.recipe))
        return {
            # `may_change` knows names inside of a section: "finetune.device.threads" -> "device.threads".
            "recipe": {name: value for name, value in recipe.items() if not may_change(name.partition(".")[2])},
            "evaluation": {**self.evaluation.what_counts(), "limit": self.evaluation.limit},
            "data": self.training.fingerprint,
            "held_out": ScenarioDataset(self.data, self.evaluation.split).fingerprint,
            "base_model": fingerprint_policy(load_policy(self.base_model)) if self.base_model else None,
        }

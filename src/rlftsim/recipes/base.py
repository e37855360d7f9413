"""The contract of a recipe.

A recipe holds every number of a model's way from fresh weights to the fine-tuned policy, a section for each
stage. The command line shows each field of each section in `--help`, with the docstring, and takes values
by flag: `--finetune.learning-rate 1e-5`.

A recipe for a new policy is a frozen dataclass that extends `Recipe`, and a function that returns an instance. In the
pyproject.toml of the package:

    [project.entry-points."rlftsim.recipes"]
    cruise-small = "my_package.recipes:cruise_small"
"""

from collections.abc import Collection
from dataclasses import dataclass, field, fields, is_dataclass, make_dataclass, replace
from typing import Any, ClassVar, Literal

from torch import nn

from rlftsim.errors import ConfigError
from rlftsim.rollout.policy import Policy
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.training.config import (
    CalibrateConfig,
    CatkConfig,
    DeviceConfig,
    FinetuneConfig,
    GcslConfig,
    PretrainConfig,
    RoadConfig,
    with_goals,
)

SECTIONS = ("tokens", "model", "pretrain", "finetune", "catk", "road", "gcsl", "calibrate")
"""Sections that the verbs of the command line know, in the order of their use; see `list_sections`."""


@dataclass(frozen=True, kw_only=True)
class Recipe:
    """Sections that every policy has. A subclass adds `model`, the sizes of the policies, and any further field:
    each field that is a dataclass is a section."""

    model_name: ClassVar[str] = "model"
    """Name of the recipe's models in tables."""
    policy_type: ClassVar[type | None] = None
    """Class of the recipe's policies, whose `config` is a section `model`; None = the recipe makes none like others."""
    method: str = "rlft"
    """Method of fine-tuning where none is named."""
    tokens: TokensConfig | None = None
    """Vocabulary; None for policies without one."""
    pretrain: PretrainConfig = field(default_factory=PretrainConfig)
    finetune: FinetuneConfig = field(default_factory=FinetuneConfig)
    catk: CatkConfig | None = field(default_factory=CatkConfig)
    """None for policies without tokens, which CAT-K cannot train."""
    road: RoadConfig | None = None
    """None where there is no RoaD."""
    gcsl: GcslConfig | None = field(default_factory=GcslConfig)
    """None likewise."""
    calibrate: CalibrateConfig | None = None
    """None for policies that decide neither by tokens nor by actions, which features could tilt."""

    @property
    def counterpart(self) -> str | None:
        """Name of the recipe of a different architecture of about the same size, to compare with; None = none such."""
        return None

    def new_policy(self, vocabulary: Vocabulary | None) -> nn.Module:
        """A policy with fresh weights, drawn with the seed of pre-training (`torch.manual_seed(self.pretrain.seed)`).

        Args:
            vocabulary: Tokens built with the settings `tokens`; None where these are None.
        """
        raise ConfigError(
            f"{type(self).__name__} describes no new policy: take a recipe that does, or fine-tune an existing model."
        )

    def new_policy_for(self, training: Any, vocabulary: Vocabulary | None = None) -> nn.Module:
        """A policy with fresh weights, with tokens of the training scenarios where a vocabulary is needed and missing.

        Args:
            training: Training scenarios; the motions are clustered.
            vocabulary: Vocabulary of the policy; None = built, where the recipe has settings of tokens.
        """
        if vocabulary is None and self.tokens is not None:
            vocabulary = build_vocabulary(training, self.tokens)[0]
        return self.new_policy(vocabulary)

    def like(self, policy: Any) -> "Recipe":
        """The same recipe for policies of the architecture and sizes of an existing policy.

        Raises:
            ConfigError: A recipe that makes no such policies.
        """
        name = type(policy).__name__
        if self.policy_type is None:
            raise ConfigError(f"{type(self).__name__} describes no policy like a {name}.")
        if not isinstance(policy, self.policy_type):
            raise ConfigError(
                f"this recipe makes {self.model_name} policies, none like a {name}: name a recipe that does, `rlftsim "
                "recipe` lists them."
            )
        return replace(self, model=policy.config)

    @property
    def free_fields(self) -> tuple[str, ...]:
        """Settings of the section `model` that weights do not depend on."""
        return getattr(getattr(self, "model", None), "free_fields", ())

    def train_further(self, policy: Policy, vocabulary: Vocabulary | None = None, keep: Collection[str] = ()) -> Policy:
        """The policy that `rlftsim pretrain --init-from` trains: an existing policy, with this recipe's `free_fields`.

        Args:
            policy: Existing policy; training starts from the weights.
            vocabulary: Tokens in place of the policy's; None = no change.
            keep: Classes that stay with the policy's tokens, see `align_vocabulary`.

        Raises:
            ConfigError: A vocabulary for a policy without tokens.
        """
        if vocabulary is not None:
            raise ConfigError(f"a {type(policy).__name__} takes no other vocabulary: leave --vocabulary out.")
        return policy

    def with_goals(self) -> "Recipe":
        """The same recipe for goal-conditioned fine-tuning by rlft: every agent's goal is the logged endpoint, the
        reward is `gcft`.

        CAT-K and RoaD, if in the recipe, then train the goal-conditioned weights alone.
        """
        # Goals that the recipe has chosen already stay: `with_goals` fills in what is off.
        finetune = replace(self.finetune, goals=with_goals(self.finetune.goals), reward="gcft", constraints=())
        catk, road = (
            method and replace(method, goal_probability=1.0, trained="goals") for method in (self.catk, self.road)
        )
        return replace(self, method="rlft", finetune=finetune, catk=catk, road=road)

    def with_section(self, name: str, section: Any) -> Any:
        """The same recipe with a further section, such as the settings of an installed package's training method.

        Args:
            name: Name of the section, which no field of the recipe has.
            section: Dataclass of settings, with the values of the recipe.
        """
        extended = make_dataclass(
            type(self).__name__, [(name, type(section))], bases=(type(self),), frozen=True, kw_only=True
        )
        return extended(**{entry.name: getattr(self, entry.name) for entry in fields(self)}, **{name: section})

    def with_processes(self, processes: int | Literal["auto"]) -> "Recipe":
        """The same recipe, trained by so many processes on this machine, see `DeviceConfig.processes`."""
        changed = {
            name: replace(section, device=replace(section.device, processes=processes))
            for name, section in list_sections(self).items()
            if isinstance(getattr(section, "device", None), DeviceConfig)
        }
        return replace(self, **changed)

    def with_seed(self, seed: int) -> "Recipe":
        """The same recipe, every stage of which (tokens, pre-training, fine-tuning) draws with this seed.

        Args:
            seed: Seed of all sections that have one, at least 0.
        """
        drawn = {name: section for name, section in list_sections(self).items() if hasattr(section, "seed")}
        return replace(self, **{name: replace(section, seed=seed) for name, section in drawn.items()})


def list_sections(recipe: Recipe) -> dict[str, Any]:
    """Sections that a recipe has, by name: `SECTIONS` in the order of use, then the further sections."""
    present = [entry.name for entry in fields(recipe) if is_dataclass(getattr(recipe, entry.name))]
    present.sort(key=lambda name: SECTIONS.index(name) if name in SECTIONS else len(SECTIONS))
    return {name: getattr(recipe, name) for name in present}

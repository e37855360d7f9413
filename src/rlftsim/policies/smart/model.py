"""SMART's weights and vocabulary, the files, and variants with goals.

A agents, B scenarios, N rollouts, D width, R selected elements, V tokens.
"""

import copy
import math
import os
from collections.abc import Callable, Collection, Mapping
from dataclasses import asdict
from functools import partial
from typing import Any, TypeVar

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.policies.checkpoint import (
    StoredModel,
    are_frozen_alike,
    load_network,
    load_strictly,
    read_model,
    save_model,
)
from rlftsim.policies.distributions import (
    NEVER,
    CategoricalDistribution,
    LazyTokenDistribution,
    TokenDistribution,
    TokenRows,
    at_least_float32,
)
from rlftsim.policies.smart.config import GoalEncoding, SmartConfig
from rlftsim.policies.smart.embeddings import ClassHeads
from rlftsim.policies.smart.goal_conditioning import GoalEmbedding
from rlftsim.policies.smart.network import Scene, SmartNetwork
from rlftsim.policies.smart.token_steps import TokenSteps, build_logged_steps
from rlftsim.rollout.policy import Sampling
from rlftsim.rollout.rows import find_rows
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.tokens.agent_tokens import AgentTokens, tokenize_agents
from rlftsim.tokens.alignment import align_vocabulary
from rlftsim.tokens.vocabulary import Vocabulary

VOCABULARY = "vocabulary.safetensors"

Model = TypeVar("Model", bound="SmartModel")
Made = TypeVar("Made")


def save_token_model(folder: str | os.PathLike, policy: Any, config: Mapping[str, Any], card: str) -> None:
    """Write config.json, model.safetensors, vocabulary.safetensors and README.md.

    Args:
        folder: Folder of the model, created where it is missing.
        policy: Policy with a `network` and a vocabulary.
        config: Settings that the policy is built with when loaded.
        card: Text of README.md, in Markdown; empty = a line that names no origin.
    """
    extra = {VOCABULARY: policy.vocabulary.to("cpu").save}
    save_model(folder, policy, config, card=card, weights=policy.network.state_dict(), extra=extra)


def load_token_model(model: StoredModel, config_type: type[Any], make: Callable[..., Made]) -> Made:
    """Policy of a folder as written by `save_token_model`, in training mode.

    Args:
        model: Stored settings and weights.
        config_type: Dataclass of the settings.
        make: Function of settings and vocabulary that builds the policy.

    Raises:
        ConfigError: The settings contradict each other.
        CheckpointError: A missing or damaged file, or keys and shapes that do not fit.
    """
    config, weights, path = model.build(config_type), model.read_weights(), model.folder / VOCABULARY
    if not path.exists():
        raise CheckpointError(f"{model.folder}: not a SMART model folder, {VOCABULARY} is missing.")
    vocabulary = Vocabulary.load(path)
    return load_network(lambda: make(config, vocabulary), weights, source=model.folder)


class TokenModule(nn.Module):
    """Network with a vocabulary: a value, not a weight, saved beside the weights and never trained."""

    vocabulary: Vocabulary

    def _apply(self, fn, recurse: bool = True):
        """Moves to a device take the vocabulary along."""
        super()._apply(fn, recurse)
        self.vocabulary = self.vocabulary.to(next(self.parameters()).device)
        return self


class SmartModel(TokenModule):
    """SMART's network and vocabulary; `SmartPolicy` adds the decisions."""

    architecture = "smart"

    sampling: Sampling = Sampling()
    """Truncation of all draws by the model, kept in config.json; see `rollout.policy.Sampling`."""

    def __init__(self, config: SmartConfig, vocabulary: Vocabulary, sampling: Sampling = Sampling()):  # noqa: B008
        super().__init__()
        if sampling.temperature == 0:
            raise ConfigError("a model's sampling has a temperature above 0: ask for the mode where it simulates.")
        if not sampling.is_full:  # else the fingerprint is that of a model without
            self.sampling = sampling
        self.config = config
        self.vocabulary = vocabulary
        # numbers of tokens that exist, by class
        class_sizes = tuple(vocabulary.token_mask.sum(1).tolist()) if config.head_per_class else ()
        num_map_points = vocabulary.map_prototypes.shape[1]
        self.network = SmartNetwork(config, vocabulary.num_tokens, class_sizes, num_map_points)

    # ---- training -------------------------------------------------------------------------------------------------

    def fine_tuned_modules(self) -> tuple[nn.Module, ...]:
        """The decoder's attention and head, as in the public CAT-K code, and the goal modules."""
        return self.network.decoder.reader_modules()

    def head_modules(self) -> tuple[nn.Module, ...]:
        """The layers that turn an agent's features into logits of tokens, and the goal modules."""
        return *self.network.decoder.head_modules(), *self.goal_modules()

    def goal_modules(self) -> tuple[nn.Module, ...]:
        """Goal encoder and goal logit bias; empty in a goal-free model."""
        return self.network.decoder.goal_modules()

    def sees_as(self, model: nn.Module) -> bool:
        """True if scenes, and relations of rows to scenes, are the same for a second model, without gradient in both.

        The weights that compute these are frozen in both models, and equal. The layers of the decoder, the head and the
        goal modules may differ.
        """
        if not isinstance(model, SmartModel) or self.training or model.training:
            return False
        if (self.config, self.vocabulary) != (model.config, model.vocabulary):
            return False
        return are_frozen_alike(self.network.scene_weights(), model.network.scene_weights())

    def with_settings(self: Model, config: SmartConfig, vocabulary: Vocabulary | None, keep: Collection[str]) -> Model:
        """Model with other settings and the weights of this one, to be trained further.

        Args:
            config: Settings of the new model, with the same sizes.
            vocabulary: Tokens in place of the model's, see `align_vocabulary`; None = no change.
            keep: Classes that stay with the model's tokens.

        Raises:
            CheckpointError: The weights are of other sizes.
            ConfigError: More tokens than the model can hold, or a separate head for each class.
        """
        if vocabulary is not None and self.config.head_per_class:
            raise ConfigError(
                "each class of this model has a head of its own, whose places other tokens cannot take: leave "
                "--vocabulary out."
            )
        tokens = self.vocabulary if vocabulary is None else align_vocabulary(vocabulary, self.vocabulary, keep=keep)
        model = type(self)(config, tokens, self.sampling)
        load_strictly(model, self.state_dict(), source="the model to train further")
        return model

    # ---- goals ----------------------------------------------------------------------------------------------------

    @property
    def is_goal_conditioned(self) -> bool:
        """True if goals have an effect."""
        return self.config.goal is not None

    def with_goal_conditioning(self: Model, encoding: GoalEncoding, *, logit_bias: bool | None = None) -> Model:
        """Copy with goal-conditioning weights that have no effect yet; the model unchanged if conditioned in this way.

        Args:
            encoding: Encoding of goals, "concat" or "indication".
            logit_bias: Whether a goal-progress bias is added to the token logits; False is the paper's model. None =
                yes for a goal-free model, else as the model does.

        Raises:
            ConfigError: The model is conditioned in a different way.
        """
        config = self.config.with_goal_conditioning(encoding, logit_bias)
        if config == self.config:
            return self
        policy = type(self)(config, self.vocabulary, self.sampling).to(next(self.parameters()).device)
        # distance and bearing of a goal start from the trained embedding of those of map tokens
        decoder = policy.network.decoder
        if isinstance(decoder.goal, GoalEmbedding):
            decoder.goal.init_from(self.network.decoder.map_relation)
        weights = policy.network.state_dict()
        fresh = {name: weights[name] for name in weights if name.startswith(("decoder.goal.", "decoder.aim."))}
        load_strictly(policy.network, {**self.network.state_dict(), **fresh}, source="the model to start from")
        return policy.train(self.training)

    def with_guidance(self: Model, scale: float) -> Model:
        """Copy with a scaled goal logit bias: above 1 goals are followed more closely than was learned; at 1 the model.

        Raises:
            ConfigError: The model has no goal logit bias, or `scale` is no number of 0 or more.
        """
        if scale == 1.0:
            return self
        if not (math.isfinite(scale) and scale >= 0):
            raise ConfigError(f"guidance_scale is a number of 0 or more, got {scale}.")
        if self.network.decoder.aim is None:
            raise ConfigError(
                f"guidance_scale={scale:g} has no effect: this model has no goal logit bias, leave it out."
            )
        policy = copy.deepcopy(self)
        with torch.no_grad():
            policy.network.decoder.aim.weight.mul_(scale)  # type: ignore[union-attr]
        return policy

    # ---- files ----------------------------------------------------------------------------------------------------

    def save_pretrained(self, folder: str | os.PathLike, *, card: str = "") -> None:
        """Write config.json, model.safetensors, vocabulary.safetensors and README.md.

        Args:
            folder: Folder of the model, created where it is missing.
            card: Text of README.md, in Markdown; empty = a line that names no origin.
        """
        config = asdict(self.config) | ({} if self.sampling.is_full else {"sampling": asdict(self.sampling)})
        save_token_model(folder, self, config, card)

    @classmethod
    def from_pretrained(cls: type[Model], folder: str | os.PathLike) -> Model:
        """Model of a model folder as written by `save_pretrained`, or of a run's folder, in training mode.

        Raises:
            ConfigError: There is no such folder, or the settings contradict each other.
            CheckpointError: A missing or damaged file, a different architecture, or keys and shapes that do not fit;
                the first are named.
        """
        model = read_model(folder, architecture=cls.architecture)
        sampling = model.pop("sampling", Sampling)
        return load_token_model(model, SmartConfig, partial(cls, sampling=sampling))

    # ---- parts of a forward pass ----------------------------------------------------------------------------------

    def _build_scene(self, scenarios: ScenarioBatch) -> Scene:
        return self.network.build_scene(scenarios, self.vocabulary)

    def _tokenize(self, scenarios: ScenarioBatch) -> AgentTokens:
        return tokenize_agents(scenarios, self.vocabulary, catk_compat=self.config.catk_compat)

    def _logged_steps(self, tokens: AgentTokens, steps: slice) -> TokenSteps:
        return build_logged_steps(tokens, steps, catk_compat=self.config.catk_compat)

    def _predict(
        self, scene: Scene, x: Float[Tensor, "R E"], token_class: Int64[Tensor, "B A"], mask: Bool[Tensor, "B N A *L"]
    ) -> CategoricalDistribution:
        """Distributions of the elements of a mask; tokens that a class lacks get the logit `NEVER`."""
        scenario, _, agent, *_ = find_rows(mask, is_dense=len(x) == mask.numel())
        class_id = token_class[scenario, agent]  # [R]
        head, scores, exists = self.network.decoder.head, self.network.decoder.scores, self.vocabulary.class_tokens
        if isinstance(head, ClassHeads):
            return TokenDistribution(head(x, class_id).masked_fill(~exists[class_id], NEVER), mask, self.sampling)
        *first, last = head
        assert isinstance(last, nn.Linear)
        hidden, weight = nn.Sequential(*first)(x[:, : self.config.dim]), last.weight
        if scores is not None:
            assert scene.token_keys is not None
            # both terms of the logits in one product
            last_phase = x[:, self.config.dim :]
            hidden = torch.cat([hidden, scores.queries(hidden, last_phase, class_id)], -1)
            weight = torch.cat([weight, scene.token_keys.keys], -1)
        hidden = at_least_float32(hidden)  # logits may be computed after autocast has ended
        return LazyTokenDistribution(TokenRows(hidden, weight, last.bias, class_id, exists), mask, self.sampling)

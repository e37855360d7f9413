"""SMART's weights and vocabulary, their files, and variants with goals.

A agents, B scenarios, N rollouts, D width, R selected elements, V tokens.
"""

import copy
import math
import os
from dataclasses import asdict
from pathlib import Path
from typing import TypeVar

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.jobs.folder import check_folder
from rlftsim.policies.checkpoint import check_fit, load_strictly, read_model, save_model
from rlftsim.policies.distributions import CategoricalDistribution, LazyTokenDistribution, TokenDistribution
from rlftsim.policies.sharing import are_frozen_alike
from rlftsim.policies.smart.config import GoalEncoding, SmartConfig
from rlftsim.policies.smart.embeddings import normalize
from rlftsim.policies.smart.goal_conditioning import GoalEmbedding
from rlftsim.policies.smart.heads import ClassHeads
from rlftsim.policies.smart.neighbors import most_within
from rlftsim.policies.smart.network import Scene, SmartNetwork, nowhere_unless
from rlftsim.policies.smart.token_steps import TokenSteps, logged_steps
from rlftsim.policies.token_rows import NEVER, TokenRows
from rlftsim.rollout.rows import find_rows
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.tokens.agent_tokens import AgentTokens, tokenize_agents
from rlftsim.tokens.map_tokens import MapTokens, tokenize_map
from rlftsim.tokens.vocabulary import Vocabulary, class_of_type

VOCABULARY = "vocabulary.safetensors"


Model = TypeVar("Model", bound="SmartModel")


class SmartModel(nn.Module):
    """SMART's network and vocabulary; `SmartPolicy` adds the decisions.

    The vocabulary is a value, not a weight: it is saved beside the weights and never trained.
    """

    architecture = "smart"

    def __init__(self, config: SmartConfig, vocabulary: Vocabulary):
        super().__init__()
        self.config = config
        self.vocabulary = vocabulary
        # numbers of tokens that exist, by class
        class_sizes = tuple(vocabulary.token_mask.sum(1).tolist()) if config.head_per_class else ()
        self.network = SmartNetwork(config, vocabulary.num_tokens, class_sizes)

    def _apply(self, fn, recurse: bool = True):
        """Moves to a device take the vocabulary along."""
        super()._apply(fn, recurse)
        self.vocabulary = self.vocabulary.to(next(self.parameters()).device)
        return self

    # ---- training -------------------------------------------------------------------------------------------------

    def fine_tuned_modules(self) -> tuple[nn.Module, ...]:
        """The decoder's attention and head, as in the public CAT-K code, and everything for goals."""
        return self.network.decoder.reading_parts()

    def head_modules(self) -> tuple[nn.Module, ...]:
        """The layers that turn an agent's features into logits of tokens, and everything for goals."""
        return *self.network.decoder.head_modules(), *self.goal_modules()

    def goal_modules(self) -> tuple[nn.Module, ...]:
        """Goal encoder and goal logit bias; empty in a goal-free model."""
        return self.network.decoder.goal_modules()

    def sees_as(self, other: nn.Module) -> bool:
        """True if scenes, and the relations of rows to them, are the same for another model, without gradient in both.

        So weights that they are made of are frozen in both models, and equal. The layers of the decoder, its head and
        the goal parts may differ.
        """
        if not isinstance(other, SmartModel) or self.training or other.training:
            return False
        if (self.config, self.vocabulary) != (other.config, other.vocabulary):
            return False
        return are_frozen_alike(self.network.seeing_weights(), other.network.seeing_weights())

    # ---- goals ----------------------------------------------------------------------------------------------------

    @property
    def is_goal_conditioned(self) -> bool:
        """True if goals have an effect."""
        return self.config.goal is not None

    def with_goal_conditioning(self: Model, encoding: GoalEncoding, *, logit_bias: bool | None = None) -> Model:
        """Copy with goal-conditioning weights that have no effect yet; itself if it is conditioned in this way.

        Args:
            encoding: of goals.
            logit_bias: add a goal-progress bias to the token logits; False is the paper's model. None = yes for a
                goal-free model, else as the model has it.

        Raises:
            ConfigError: it is conditioned in another way.
        """
        config = self.config.with_goal_conditioning(encoding, logit_bias)
        if config == self.config:
            return self
        policy = type(self)(config, self.vocabulary).to(next(self.parameters()).device)
        # distance and bearing of a goal start from the trained embedding of those of map tokens
        decoder = policy.network.decoder
        if isinstance(decoder.goal, GoalEmbedding):
            decoder.goal.init_from(self.network.decoder.map_relation)
        fresh = {
            k: v for k, v in policy.network.state_dict().items() if k.startswith(("decoder.goal.", "decoder.aim."))
        }
        load_strictly(policy.network, {**self.network.state_dict(), **fresh}, source="the model to start from")
        return policy.train(self.training)

    def with_guidance(self: Model, scale: float) -> Model:
        """Copy whose goal logit bias is multiplied: above 1 goals are followed more closely than was learned.

        Itself at 1.

        Raises:
            ConfigError: it has no goal logit bias, or `scale` is no number of 0 or more.
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
        assert policy.network.decoder.aim is not None
        with torch.no_grad():
            policy.network.decoder.aim.weight.mul_(scale)
        return policy

    # ---- files ----------------------------------------------------------------------------------------------------

    def save_pretrained(self, folder: str | os.PathLike, *, card: str = "") -> None:
        """Write config.json, model.safetensors, vocabulary.safetensors and README.md.

        Args:
            folder: created where it is missing.
            card: text of README.md.
        """
        check_folder(Path(folder), "model")
        Path(folder).mkdir(parents=True, exist_ok=True)
        self.vocabulary.to("cpu").save(Path(folder) / VOCABULARY)
        card = card or "A SMART traffic model. Origin unknown.\n"
        save_model(folder, self, asdict(self.config), card=card, weights=self.network.state_dict())

    @classmethod
    def from_pretrained(cls: type[Model], folder: str | os.PathLike) -> Model:
        """Model of a model folder as `save_pretrained` writes it, or of a run's folder, in training mode.

        Raises:
            ConfigError: there is no such folder, or its settings contradict each other.
            CheckpointError: a missing or damaged file, another architecture, or keys and shapes that do not fit:
                names the first.
        """
        model = read_model(folder, architecture=cls.architecture)
        config, weights = model.build(SmartConfig), model.read_weights()
        path = model.folder / VOCABULARY
        if not path.exists():
            raise CheckpointError(f"{model.folder}: not a SMART model folder, {VOCABULARY} is missing.")
        vocabulary = Vocabulary.load(path)
        check_fit(lambda: cls(config, vocabulary).network, weights, source=str(model.folder))
        policy = cls(config, vocabulary)
        load_strictly(policy.network, weights, source=str(model.folder))
        return policy

    # ---- parts of a forward pass ----------------------------------------------------------------------------------

    def _scene(self, scenarios: ScenarioBatch) -> Scene:
        tokens = tokenize_map(scenarios, self.vocabulary.map_prototypes)
        class_id = class_of_type(scenarios.object_type)
        decoder = self.network.decoder
        return Scene(
            map_position=tokens.position,
            map_heading=tokens.heading,
            map_mask=tokens.token_mask,
            map_features=normalize(self.network.map_encoder(tokens, self.vocabulary.map_prototypes)),
            class_id=class_id,
            agent_features=decoder.embed_agents(class_id, scenarios.size),
            token_features=decoder.embed_tokens(self.vocabulary.end_corners()),
            token_keys=None if decoder.scores is None else decoder.scores.keys(self.vocabulary.poses[:, :, -1]),
            relations=decoder.relations(),
            most_map_tokens=self._most_map_tokens(tokens),
        )

    def _most_map_tokens(self, tokens: MapTokens) -> int | None:
        """See `Scene.most_map_tokens`. Off the CPU the host waits for it once, and not at every decision."""
        if self.config.max_agent_map_neighbors is not None or tokens.position.device.type == "cpu":
            return None
        return most_within(nowhere_unless(tokens.token_mask, tokens.position), self.config.agent_map_radius_m)

    def _tokenize(self, scenarios: ScenarioBatch) -> AgentTokens:
        return tokenize_agents(scenarios, self.vocabulary, catk_compat=self.config.catk_compat)

    def _logged_steps(self, tokens: AgentTokens, steps: slice) -> TokenSteps:
        return logged_steps(tokens, steps, catk_compat=self.config.catk_compat)

    def _predict(
        self,
        scene: Scene,
        features: Float[Tensor, "R E"],
        token_class: Int64[Tensor, "B A"],
        mask: Bool[Tensor, "B N A *L"],
    ) -> CategoricalDistribution:
        """Distributions of the elements of a mask; tokens that a class lacks get the logit `NEVER`."""
        place = find_rows(mask, is_dense=len(features) == mask.numel())
        class_id = token_class[place[0], place[2]]  # [R]
        head, scores, exists = self.network.decoder.head, self.network.decoder.scores, self.vocabulary.class_tokens
        if isinstance(head, ClassHeads):
            return TokenDistribution(head(features, class_id).masked_fill(~exists[class_id], NEVER), mask)
        *first, last = head
        assert isinstance(last, nn.Linear)
        hidden, weight = nn.Sequential(*first)(features[:, : self.config.dim]), last.weight
        if scores is not None:
            assert scene.token_keys is not None
            # both terms of the logits in one product
            phase_before = features[:, self.config.dim :]
            hidden = torch.cat([hidden, scores.queries(hidden, phase_before, class_id)], -1)
            weight = torch.cat([weight, scene.token_keys.keys], -1)
        return LazyTokenDistribution(TokenRows(hidden, weight, last.bias, class_id, exists), mask)

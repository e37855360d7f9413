"""A compact policy: every agent chooses a motion token of half a second, by a network without memory.

B scenarios, N rollouts, A agents, L decisions.
"""

import os
from dataclasses import asdict, dataclass, replace

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from rlftsim.goals.types import Goals
from rlftsim.policies.checkpoint import read_model
from rlftsim.policies.distributions import TokenDistribution
from rlftsim.policies.smart.compact_network import CompactNetwork, Scene, Steps
from rlftsim.policies.smart.config import CompactConfig
from rlftsim.policies.smart.model import TokenModule, load_token_model, save_token_model
from rlftsim.policies.smart.token_steps import apply_decisions, begin_elsewhere, build_logged_steps, replay_decisions
from rlftsim.rollout.types import AgentStates, Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.tokens.agent_tokens import HISTORY_TOKENS, restart_at_log, tokenize_agents
from rlftsim.tokens.subset import choose_tokens
from rlftsim.tokens.vocabulary import STEPS_PER_TOKEN, Vocabulary

STUDENTS = {"small": (CompactConfig(), 512)}
"""Size of a student of distillation -> settings, and number of tokens of each class."""


@dataclass(frozen=True, eq=False)
class Context:
    """Features of the scenes, and the agents at the current step."""

    scene: Scene
    current: Steps
    """Of a single rollout."""
    object_type: Int64[Tensor, "B A"]
    agent_mask: Bool[Tensor, "B A"]


@dataclass(frozen=True, eq=False)
class State:
    """Running simulations."""

    steps: Steps
    poses: Float[Tensor, "B N A 5 3"] | None = None
    draws: Tensor | None = None

    @property
    def position(self) -> Float[Tensor, "B N A 2"]:
        """Positions before the decision, map frame."""
        return self.steps.position

    @property
    def heading(self) -> Float[Tensor, "B N A"]:
        """Headings before the decision, rad."""
        return self.steps.heading


class CompactPolicy(TokenModule):
    """Next-token traffic model of all agents of a scenario, with few weights, that follows no goals.

    Args:
        config: Sizes of the network.
        vocabulary: Motion tokens of the agents, and prototypes of map tokens; a value, saved beside the weights.
    """

    architecture = "compact"
    steps_per_decision = STEPS_PER_TOKEN
    noise_size = 1
    initial_noise_size = 0

    def __init__(self, config: CompactConfig, vocabulary: Vocabulary):
        super().__init__()
        self.config = config
        self.vocabulary = vocabulary
        self.network = CompactNetwork(config, vocabulary.num_tokens)

    def __repr__(self) -> str:
        return f"CompactPolicy({sum(weight.numel() for weight in self.parameters()):,} weights)"

    def head_modules(self) -> tuple[nn.Module, ...]:
        """The layers that turn an agent's features into logits of tokens."""
        return self.network.bottleneck, self.network.head, self.network.scores

    def encode(self, scenarios: ScenarioBatch) -> Context:
        """Features of map and agents, and the tokens that led to the current step."""
        past = scenarios.history()
        tokens = restart_at_log(tokenize_agents(past, self.vocabulary), past, self.vocabulary)
        logged = build_logged_steps(tokens, slice(HISTORY_TOKENS), catk_compat=False)
        previous = torch.where(logged.valid[..., -2], logged.token_id[..., -2], self.vocabulary.num_tokens)
        current = Steps(logged.position[..., -1, :], logged.heading[..., -1], logged.token_id[..., -1], previous)
        scene = self.network.build_scene(scenarios, self.vocabulary)
        return Context(scene, current, scenarios.object_type, scenarios.agent_mask)

    def encode_again(self, scenarios: ScenarioBatch, context: Context) -> Context:
        """`encode(scenarios)`, with map tokens and history of a context that the policy made before its last update.

        Args:
            scenarios: Scenarios that `context` was encoded from, in the same order.
            context: Context of this policy, by earlier weights.
        """
        if not isinstance(context, Context):
            return self.encode(scenarios)
        return replace(context, scene=self.network.build_scene(scenarios, self.vocabulary, context.scene))

    def relight(self, context: Context, scenarios: ScenarioBatch) -> Context:
        """The context with other traffic lights.

        Args:
            context: Result of `encode` for the same scenarios.
            scenarios: Scenarios, with the step of the lights.
        """
        return replace(context, scene=self.network.relight(context.scene, scenarios, self.vocabulary))

    def begin(self, context: Context, num_rollouts: int, goals: Goals | None, noise: Tensor) -> State:
        """The current step, N times.

        Args:
            context: Result of `encode` for the scenarios.
            num_rollouts: Number N of futures that each scenario gets.
            goals: Goals of agents, which have no effect.
            noise: Empty tensor, since the start of a simulation is not random.
        """
        repeated = (v.expand(-1, num_rollouts, *v.shape[2:]) for v in vars(context.current).values())
        return State(Steps(*repeated))

    def decide(self, context: Context, state: State) -> TokenDistribution:
        """Distributions [B, N, A] of the next token of every agent.

        Args:
            context: Result of `encode` for the scenarios.
            state: State before the decision.
        """
        mask = context.agent_mask[:, None].expand(state.steps.heading.shape)
        return TokenDistribution(self.network(context.scene, state.steps), mask)

    def advance(
        self, context: Context, state: State, decision: Int64[Tensor, "B N A"], forced: AgentStates | None = None
    ) -> State:
        """State after the chosen token's five poses.

        Args:
            context: Result of `encode` for the scenarios.
            state: State before the decision, which stays as it is.
            decision: Id of the token that each agent takes, within the agent's class.
            forced: States [B, N, A, 5] imposed on agents where all five are valid.
        """
        previous, start = state.steps.last, (state.steps.position, state.steps.heading)
        if forced is not None:
            start, is_elsewhere = begin_elsewhere(start, forced)
            previous = torch.where(is_elsewhere, self.vocabulary.num_tokens, previous)
        poses, decision = apply_decisions(
            decision, *start, context.object_type, self.vocabulary, forced, catk_compat=False
        )
        return State(Steps(poses[..., -1, :2], poses[..., -1, 2], decision, previous), poses)

    def score(self, context: Context, rollouts: Rollouts) -> TokenDistribution:
        """Distributions [B, N, A, L] along rollouts, in a single pass.

        Args:
            context: Result of `encode` for the scenarios.
            rollouts: Rollouts of the same scenarios, by a policy with the same tokens.
        """
        # all decisions at once, like so many rollouts [B, N L, A]
        fields = zip(*(vars(state.steps).values() for state in replay_decisions(self, context, rollouts)))
        logits = self.network(context.scene, Steps(*(torch.stack(values, 2).flatten(1, 2) for values in fields)))
        shape = rollouts.decision.shape
        mask = context.agent_mask[:, None, :, None].expand(shape)
        row = torch.empty(shape, dtype=torch.int64, device=logits.device).transpose(2, 3)
        row[mask.transpose(2, 3)] = torch.arange(len(logits), device=logits.device)
        return TokenDistribution(logits.index_select(0, row.transpose(2, 3)[mask]), mask)

    @classmethod
    def new_student(cls, size: str, vocabulary: Vocabulary, scenarios: Scenarios, seed: int) -> "CompactPolicy":
        """A student with fresh weights, and the tokens of a teacher that the scenarios need most.

        Args:
            size: Size of the student, a name of `STUDENTS`.
            vocabulary: Vocabulary of the teacher, whose map prototypes are taken over.
            scenarios: Training scenarios, at least one, whose logged motions are counted.
            seed: Seed of the weights, at least 0, for the random numbers of torch.
        """
        config, num_tokens = STUDENTS[size]
        tokens = choose_tokens(vocabulary, scenarios, num_tokens)
        torch.manual_seed(seed)
        return cls(config, tokens)

    # ---- files ----------------------------------------------------------------------------------------------------

    def save_pretrained(self, folder: str | os.PathLike, *, card: str = "") -> None:
        """Write config.json, model.safetensors, vocabulary.safetensors and README.md.

        Args:
            folder: Folder of the model, created where it is missing.
            card: Text of README.md, in Markdown; empty = a line that names no origin.
        """
        save_token_model(folder, self, asdict(self.config), card)

    @classmethod
    def from_pretrained(cls, folder: str | os.PathLike) -> "CompactPolicy":
        """Policy of a model folder as written by `save_pretrained`, or of a run's folder, in training mode.

        Raises:
            ConfigError: There is no such folder, or the settings contradict each other.
            CheckpointError: A missing or damaged file, or a different architecture.
        """
        return load_token_model(read_model(folder, architecture=cls.architecture), CompactConfig, cls)

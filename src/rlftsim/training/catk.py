"""CAT-K ("closest among top-K"): rollouts that keep near the record, and learning along them.

In a CAT-K rollout each agent takes, among its K most likely tokens, the one that leads nearest to where it was recorded next;
where nothing was recorded, its most likely token. The loss is the cross-entropy of the token that leads nearest of all, seen from
where the rollout has led.
"""

from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any, Literal

import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor, nn

from rlftsim.errors import ConfigError, given, require_positive
from rlftsim.goals.types import Goals
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import DecisionDistribution, Policy, Sampling
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import Scenarios
from rlftsim.tokens import public_order
from rlftsim.tokens.agent_tokens import (
    HISTORY_TOKENS,
    AgentTokens,
    Pose,
    local_boxes,
    tokenize_agents,
    tokens_towards,
)
from rlftsim.tokens.vocabulary import CLASS_BOXES_M, Vocabulary, class_of_type
from rlftsim.training.closed_loop import TargetedRollouts, TokenLogits, TokenPolicy, predict_along
from rlftsim.training.freezing import TrainedParts, freeze_untrained
from rlftsim.training.goals import GoalConfig, choose_goals, refuse_goals
from rlftsim.training.imitation import ImitationConfig, Prediction, imitate, summed_loss

DEFAULT_NUM_CANDIDATES = 32

Choice = Literal["closest", "top_k", "trajeglish"]
"""closest: of the K most likely tokens the one that leads nearest to the record. top_k: drawn from the K most likely ones. trajeglish:
drawn, by the model's probabilities, from the K that lead nearest. Where nothing was recorded: the most likely token, and draws from
the K most likely ones."""


@dataclass(frozen=True)
class CatkConfig(ImitationConfig):
    """How a model is fine-tuned with CAT-K. The defaults are the published ones for SMART-tiny on WOMD, but for the epochs: its file
    says 32, RLFTSim finds the optimum between a quarter and one."""

    epochs: float = 1.0
    learning_rate: float = 5e-5
    final_learning_rate_share: float = 0.05
    label_smoothing: float = 0.0
    num_candidates: int = DEFAULT_NUM_CANDIDATES
    """K."""
    choice: Choice = "closest"
    """How the rollouts decide: closest among the K most likely, top_k drawn from them, trajeglish drawn from the K nearest."""
    max_distance_lengths: float | None = None
    """A decision from farther off the record than so many lengths of its class's box does not count. None = all count."""
    trained: TrainedParts = "decoder"
    """The parts a policy names for fine-tuning, the weights that see goals, or everything."""
    goal_share: float = 0.0
    """Chance of an agent to be asked to go where its record ends; for a policy that sees goals."""

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, ("num_candidates", *given(self, ("max_distance_lengths",))))
        if not 0 <= self.goal_share <= 1:
            raise ConfigError(f"goal_share is a share in [0, 1], got {self.goal_share}.")


def catk_finetune(
    policy: Policy,
    scenarios: Scenarios,
    out: Path,
    config: CatkConfig,
    *,
    held_out: Scenarios | None = None,
    card: str = "",
) -> Path:
    """Fine-tune a policy in place with CAT-K; go on where a run in `out` was stopped.

    A batch is encoded once, with gradient. Its rollout (dropout active, no gradient) and the pass that scores what it should have
    decided share that context; the scoring pass draws a dropout of its own.

    Args:
        policy: an nn.Module that implements `TokenPolicy`.
        scenarios: with their futures; scenarios without are refused.
        out: the run's folder.
        config: see its fields.
        held_out: scenarios to validate on, see `config.validation`; None = no validation.
        card: README of the resulting model folder.

    Returns:
        The model folder, `out/model`.

    Raises:
        ConfigError: the policy has no weights or no tokens, or there is no scenario.
        CheckpointError: `out` holds another run, or the run diverged.
    """
    if not isinstance(policy, nn.Module):
        raise ConfigError(f"{type(policy).__name__} has no weights: there is nothing to fine-tune.")
    if not isinstance(policy, TokenPolicy) or not hasattr(policy, "save_pretrained"):
        raise ConfigError(
            f"{type(policy).__name__} cannot be fine-tuned with CAT-K: it needs a vocabulary of tokens and save_pretrained."
        )
    refuse_goals(policy, config.goal_share)
    freeze_untrained(policy, config.trained)
    asked = GoalConfig(share=config.goal_share)

    def along_rollouts(batch: ScenarioBatch, trained: Bool[Tensor, "B A"], update: int) -> Prediction:
        context = policy.encode(batch)
        goals = choose_goals(batch, asked, None, seed=derive_seed(config.seed, "goals", update))
        pursuing = roll_out_closest(
            policy, batch, num_candidates=config.num_candidates, choice=config.choice, context=context,
            max_distance_lengths=config.max_distance_lengths, seed=derive_seed(config.seed, "rollouts", update), goals=goals,
        )  # fmt: skip
        torch.clear_autocast_cache()  # or weights cast during the rollout, without gradient, would be used again
        return predict_along(policy, context, pursuing, trained)

    return imitate(policy, scenarios, out, config, along_rollouts, title="CAT-K", held_out=held_out, card=card)


# ---- rollouts -----------------------------------------------------------------------------------------------------------


def roll_out_closest(
    policy: TokenPolicy,
    batch: ScenarioBatch,
    *,
    num_candidates: int = DEFAULT_NUM_CANDIDATES,
    choice: Choice = "closest",
    max_distance_lengths: float | None = None,
    num_rollouts: int = 1,
    seed: int = 0,
    context: Any = None,
    goals: Goals | None = None,
    public_order_of_operations: bool = False,
) -> TargetedRollouts:
    """Simulate with CAT-K.

    Without dropout nothing in "closest" is random: more than one rollout makes sense for a policy in training mode only.

    Args:
        policy: decides for every agent.
        batch: scenarios with their future.
        num_candidates: K.
        choice: see `Choice`.
        max_distance_lengths: see `CatkConfig`.
        num_rollouts: N.
        seed: of what else is random in the policy, and of draws.
        context: `policy.encode(batch)`, where it is at hand.
        goals: what agents are asked, see `simulate`.
        public_order_of_operations: round where the public code rounds, see `tokens.public_order`.

    Returns:
        The rollouts. Target: the token that leads nearest to the record, where the next state was recorded and the present one is not too
        far off the record.

    Raises:
        ConfigError: no candidates.
    """
    if num_candidates < 1:
        raise ConfigError(f"num_candidates must be at least 1, got {num_candidates}.")
    tokens = tokenize_agents(batch, policy.vocabulary, public_order_of_operations=public_order_of_operations)
    targets: list[tuple[Tensor, Tensor]] = []
    aims = _aims(batch, tokens, policy.vocabulary, public_order_of_operations)
    pursue = _CHOICES[choice]

    def choose(
        distribution: DecisionDistribution, state: Any, sampling: Sampling, noise: Tensor
    ) -> Int64[Tensor, "B N A"]:
        aim = next(aims)((state.position, state.heading))
        targets.append((aim.best_token(), aim.recorded & aim.is_near(max_distance_lengths)))
        return pursue(distribution, aim, num_candidates, noise)  # type: ignore[arg-type]

    rollouts = simulate(
        policy, batch, num_rollouts=num_rollouts, seed=seed, context=context, goals=goals, choose=choose
    )
    target, mask = (torch.stack(part, -1) for part in zip(*targets))
    return TargetedRollouts(rollouts, target, mask, class_of_type(batch.object_type))


@dataclass(frozen=True, eq=False)
class _Aim:
    """Where agents are, where they were recorded now, and where they were recorded next."""

    pose: Pose
    logged: Pose
    logged_valid: Bool[Tensor, "B N A"]
    goal: Pose
    recorded: Bool[Tensor, "B N A"]
    """Of the goal."""
    class_id: Int64[Tensor, "B N A"]
    vocabulary: Vocabulary
    distances_where_placed: bool
    """Place the candidates before distances are taken, as the public code does."""

    def best_token(self) -> Int64[Tensor, "B N A"]:
        """Token of all that leads nearest to the goal."""
        return tokens_towards(self.goal, self.pose, self.class_id, self.recorded, self.vocabulary)

    def is_near(self, max_lengths: float | None) -> Bool[Tensor, "B N A"]:
        """Whether an agent is within so many lengths of its class from where it was recorded now; True where it was not."""
        if max_lengths is None:
            return torch.ones_like(self.recorded)
        length = torch.tensor(CLASS_BOXES_M, device=self.class_id.device)[self.class_id][..., 0]
        return ((self.pose[0] - self.logged[0]).norm(dim=-1) <= max_lengths * length) | ~self.logged_valid

    def distances(self, ids: Int64[Tensor, "R K"], mask: Bool[Tensor, "B N A"]) -> Float[Tensor, "R K"]:
        """Mean corner distances from where tokens would lead the agents of a mask to their goals."""
        class_id = self.class_id[mask]
        ends = self.vocabulary.end_corners()[class_id[:, None], ids]
        goal, pose = ((position[mask], heading[mask]) for position, heading in (self.goal, self.pose))
        if not self.distances_where_placed:
            return (ends - local_boxes(goal, pose, class_id)[:, None]).norm(dim=-1).mean(-1)
        length, width = torch.tensor(CLASS_BOXES_M, device=class_id.device)[class_id].unbind(-1)
        aim = public_order.boxes_around(*goal, length, width)
        return (public_order.place_boxes(ends, *pose) - aim[:, None]).norm(dim=-1).mean(-1)


def _aims(
    batch: ScenarioBatch, tokens: AgentTokens, vocabulary: Vocabulary, distances_where_placed: bool
) -> Iterator[Callable[[Pose], _Aim]]:
    """Decision by decision, from the poses of a simulation to what its agents aim at."""
    for step in range(HISTORY_TOKENS, tokens.logged_valid.shape[-1]):

        def aim(pose: Pose, step: int = step) -> _Aim:
            def at(values: Tensor, step: int) -> Tensor:
                values = values[:, None, :, step]
                return values.expand(-1, pose[1].shape[1], *values.shape[2:])

            now, then = ((at(tokens.logged_position, k), at(tokens.logged_heading, k)) for k in (step - 1, step))
            class_id = class_of_type(batch.object_type)[:, None].expand(pose[1].shape)
            return _Aim(
                pose, now, at(tokens.logged_valid, step - 1), then, at(tokens.logged_valid, step), class_id, vocabulary,
                distances_where_placed,
            )  # fmt: skip

        yield aim


def _take_closest(distribution: TokenLogits, aim: _Aim, count: int, noise: Tensor) -> Int64[Tensor, "B N A"]:
    logits, mask = distribution.logits, distribution.mask
    best = logits.topk(min(count, logits.shape[-1]), dim=-1).indices
    nearest = aim.distances(best, mask).argmin(-1, keepdim=True)
    chosen = torch.where(aim.recorded[mask], best.gather(-1, nearest)[:, 0], best[:, 0])
    return torch.zeros_like(aim.class_id).masked_scatter(mask, chosen)


def _draw_likely(distribution: Any, aim: _Aim, count: int, noise: Tensor) -> Int64[Tensor, "B N A"]:
    return distribution.sample(Sampling(top_k=count), noise)


def _draw_near(distribution: Any, aim: _Aim, count: int, noise: Tensor) -> Int64[Tensor, "B N A"]:
    logits, mask = distribution.logits, distribution.mask
    ids = torch.arange(logits.shape[-1], device=logits.device).expand_as(logits)
    distances = aim.distances(ids, mask).masked_fill(~aim.vocabulary.token_mask[aim.class_id[mask]], torch.inf)
    near = distances.topk(min(count, logits.shape[-1]), dim=-1, largest=False).indices
    kept = torch.zeros_like(logits, dtype=torch.bool).scatter(-1, near, True)
    among_near = replace(distribution, logits=logits.masked_fill(~kept, -torch.inf)).sample(Sampling(), noise)
    return torch.where(aim.recorded, among_near, _draw_likely(distribution, aim, count, noise))


_CHOICES = {"closest": _take_closest, "top_k": _draw_likely, "trajeglish": _draw_near}


# ---- the loss -----------------------------------------------------------------------------------------------------------


def catk_loss(
    policy: TokenPolicy, batch: ScenarioBatch, pursuing: TargetedRollouts, trained: Bool[Tensor, "B A"]
) -> Float[Tensor, ""]:
    """Mean cross-entropy of the targets along CAT-K rollouts, nats; 0 where nothing counts. Differentiable.

    Args:
        policy: the policy that rolled out.
        batch: the same scenarios.
        pursuing: the rollouts.
        trained: True = the agent's decisions count.
    """
    loss, counts = summed_loss(predict_along(policy, policy.encode(batch), pursuing, trained), 0.0)
    return loss / counts[-1].clamp(min=1)

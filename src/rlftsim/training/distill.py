"""Distillation: a small student learns a large teacher's distributions, along the rollouts of both.

A student's tokens are some of the teacher's, so that both agree on every state to the last bit. The probability that
the teacher gives a token counts for the nearest token of the student; the loss is KL(teacher || student). The first
rollouts are the teacher's, which stay on the road; the rest are the student's, so that the student learns the teacher's
decisions in the states that a student gets into.

Source: Ross et al., "A Reduction of Imitation Learning and Structured Prediction to No-Regret Online Learning", 2011
(DAgger), with distributions in place of actions.
"""

from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Bool, Int64
from torch import Tensor, nn
from torch.nn import functional

from rlftsim.errors import ConfigError
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import ImitationLoss, Sampling, TokenPolicy, frozen_copy
from rlftsim.rollout.rows import find_rows, pick_rows, place_rows
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import AgentStates, Rollouts
from rlftsim.tokens.subset import SharedTokens
from rlftsim.tokens.vocabulary import STEPS_PER_TOKEN, class_of_type
from rlftsim.training.config import DistillConfig
from rlftsim.training.imitation import ImitationMethod, Imitator
from rlftsim.training.method import check_trainable


class Lesson(nn.Module):
    """A student and a teacher, which `DistillMethod` takes in place of a policy; the student is trained and saved.

    Args:
        student: Policy that learns, with a vocabulary and weights.
        teacher: Policy with a vocabulary that includes the student's, and weights.

    Raises:
        ConfigError: The teacher has no vocabulary or no weights, or lacks a token.
    """

    def __init__(self, student: Any, teacher: Any):
        check_teacher(teacher)
        super().__init__()
        self.student, self.teacher = student, frozen_copy(teacher)
        self.tokens = SharedTokens.find(student.vocabulary, teacher.vocabulary)

    def save_pretrained(self, folder: Any, *, card: str = "") -> None:
        """Write the model folder of the student.

        Args:
            folder: Folder of the model, created where it is missing.
            card: Text of README.md, in Markdown.
        """
        self.student.save_pretrained(folder, card=card)


@dataclass(eq=False, kw_only=True)
class Student(Imitator):
    """A student in training."""

    teacher: Any
    tokens: SharedTokens


class DistillMethod(ImitationMethod[DistillConfig]):
    """Distillation of a teacher of any architecture that chooses tokens."""

    settings = DistillConfig
    title = "distill"
    validates = False

    def start(self, policy: Any, scenarios: Any, settings: DistillConfig, fabric: Any) -> Student:
        """Learner of all weights of the student of a `Lesson`.

        Raises:
            ConfigError: A policy by itself.
        """
        check_trainable(policy, scenarios, "distillation")
        if not isinstance(policy, Lesson):
            raise ConfigError(f"a {type(policy).__name__} needs a teacher to be distilled: rlftsim distill TEACHER.")
        teacher = policy.teacher.requires_grad_(False).to(fabric.device)
        started = super().start(policy.student.requires_grad_(True), scenarios, settings, fabric)
        return Student(
            policy=started.policy, optimizer=started.optimizer, config=settings, num_scenarios=len(scenarios),
            inputs={"teacher": fingerprint_policy(teacher)}, teacher=teacher, tokens=policy.tokens,
        )  # fmt: skip

    def predict(self, learner: Imitator, batch: Any, trained: Bool[Tensor, "B A"]) -> ImitationLoss:
        """KL(teacher || student), summed over the decisions of rollouts."""
        assert isinstance(learner, Student)
        model, config, tokens, update = learner.policy.eval(), learner.config, learner.tokens, learner.update
        is_taught = update < config.teacher_share * config.num_updates(learner.num_scenarios)
        with torch.no_grad():
            simulated = roll_out(model, learner.teacher if is_taught else None, batch, tokens, config, update)
            class_id = class_of_type(batch.object_type)[:, None, :, None].expand(simulated.decision.shape)
            scored = replace(simulated, decision=tokens.in_large[class_id, simulated.decision])
            scores = learner.teacher.score(learner.teacher.encode(batch), scored)
            rows = find_rows(scores.mask, is_dense=len(scores.logits) == scores.mask.numel())
            target = tokens.project(scores.log_probs.exp(), class_id[rows])
        log_probs = model.score(model.encode(batch), simulated).log_probs
        weight = (simulated.decision_mask & trained[:, None, :, None])[rows].to(target.dtype)  # [R]
        divergence = functional.kl_div(log_probs, target, reduction="none").sum(-1)
        is_right = (log_probs.argmax(-1) == target.argmax(-1)).to(target.dtype)
        entropy = -torch.special.xlogy(target, target).sum(-1)
        sums = {"accuracy": (weight * is_right).sum(), "teacher_entropy": (weight * entropy).sum()}
        return ImitationLoss((weight * divergence).sum(), weight.sum(), sums)


def check_teacher(teacher: Any) -> None:
    """Check that a policy can teach.

    Raises:
        ConfigError: The policy has no vocabulary or no weights.
    """
    if not isinstance(teacher, TokenPolicy) or not isinstance(teacher, nn.Module):
        raise ConfigError(f"a {type(teacher).__name__} has no vocabulary, so there are no tokens to distill.")


def roll_out(
    student: Any, teacher: Any, batch: Any, tokens: SharedTokens, config: DistillConfig, update: int
) -> Rollouts:
    """Rollouts with the student's tokens as decisions, and states that student and teacher agree on.

    Args:
        student: Policy that learns, with a vocabulary of some of the teacher's tokens.
        teacher: Policy that rolls out, among the student's tokens; None = the student does.
        batch: Scenarios to continue from their current step.
        tokens: Tokens of the student among those of the teacher, as found by `SharedTokens.find`.
        config: Settings with the number of rollouts and the seed.
        update: Number of the update, on which the noise depends.
    """

    def choose(distribution: Any, state: Any, sampling: Sampling, noise: Tensor) -> Int64[Tensor, "B N A"]:
        class_id = class_of_type(batch.object_type)[:, None].expand(distribution.mask.shape)
        rows = find_rows(distribution.mask, is_dense=len(distribution.logits) == distribution.mask.numel())
        cumulative = tokens.project(distribution.log_probs.exp(), class_id[rows]).cumsum(-1)
        level = pick_rows(noise, distribution.mask, len(cumulative) == distribution.mask.numel()) * cumulative[:, -1:]
        drawn = torch.searchsorted(cumulative, level, right=True).clamp(max=cumulative.shape[1] - 1)[:, 0]
        return tokens.in_large[class_id, place_rows(drawn, distribution.mask)]

    simulated = simulate(
        student if teacher is None else teacher, batch, num_rollouts=config.num_rollouts, may_be_nan=True,
        seed=derive_seed(config.seed, "rollouts", update), choose=None if teacher is None else choose,
    )  # fmt: skip
    decision = simulated.decision
    if teacher is not None:
        class_id = class_of_type(batch.object_type)[:, None, :, None].expand(decision.shape)
        decision = tokens.in_small[class_id, decision]
    # Each has a pose of its own at the current step, the end of the nearest token. The end of the first decision is
    # imposed on both, and from there on all poses follow from tokens.
    is_first = torch.arange(simulated.heading.shape[-1], device=decision.device) < STEPS_PER_TOKEN
    valid = (is_first & batch.agent_mask[:, None, :, None]).expand(simulated.heading.shape)
    return replace(simulated, decision=decision, forced=AgentStates(simulated.position, simulated.heading, valid))

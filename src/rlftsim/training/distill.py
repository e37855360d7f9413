"""Distillation: a small student learns a large teacher's distributions, along the rollouts of both.

A student's tokens are some of the teacher's, so that both agree on every state to the last bit. The probability that
the teacher gives a token counts for the nearest token of the student; the loss is KL(teacher || student). The first
rollouts are the teacher's, which stay on the road; the rest are the student's, so that the student learns the teacher's
decisions in the states that a student gets into.

Source: Ross et al., "A Reduction of Imitation Learning and Structured Prediction to No-Regret Online Learning", 2011
(DAgger), with distributions in place of actions.
"""

import math
import time
from dataclasses import dataclass, replace
from typing import Any

import torch
from jaxtyping import Float, Int64
from torch import Tensor, nn
from torch.nn import functional

from rlftsim.errors import ConfigError
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.noise import derive_seed
from rlftsim.rollout.policy import Sampling, TokenPolicy, frozen_copy
from rlftsim.rollout.rows import find_rows, pick_rows, place_rows
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import AgentStates, Rollouts
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.tokens.subset import SharedTokens
from rlftsim.training.config import DistillConfig
from rlftsim.training.freezing import set_learning_rate
from rlftsim.training.imitation import learning_rate
from rlftsim.training.method import Learner, Method, UpdateReport, UpdateScenarios, check_trainable
from rlftsim.training.parallel import Fabric, all_reduce_gradients, all_reduce_sum


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
class Student(Learner):
    """A student in training."""

    num_scenarios: int
    """Training scenarios, all of them."""
    lesson: Lesson


class DistillMethod(Method[DistillConfig]):
    """Distillation of a teacher of any architecture that chooses tokens."""

    settings = DistillConfig
    title = "distill"

    def start(self, policy: Any, scenarios: Any, settings: DistillConfig, fabric: Fabric) -> Student:
        """Learner of all weights of the student of a `Lesson`.

        Raises:
            ConfigError: A policy by itself.
        """
        check_trainable(policy, scenarios, "distillation")
        if not isinstance(policy, Lesson):
            raise ConfigError(f"a {type(policy).__name__} needs a teacher to be distilled: rlftsim distill TEACHER.")
        policy.to(fabric.device).eval()
        policy.teacher.requires_grad_(False)
        optimizer = torch.optim.AdamW(
            policy.student.requires_grad_(True).parameters(),
            lr=settings.learning_rate, betas=settings.betas, weight_decay=settings.weight_decay,
        )  # fmt: skip
        inputs = {"teacher": fingerprint_policy(policy.teacher)}
        return Student(
            policy=policy.student, optimizer=optimizer, config=settings, inputs=inputs, num_scenarios=len(scenarios),
            lesson=policy,
        )  # fmt: skip

    def update(self, learner: Learner, scenarios: UpdateScenarios, fabric: Fabric) -> UpdateReport:
        """Some optimizer steps along rollouts that the teacher has judged: KL(teacher || student) in nats."""
        assert isinstance(learner, Student)
        start, config, model = time.perf_counter(), learner.config, learner.policy
        total = config.num_updates(learner.num_scenarios)
        set_learning_rate(learner.optimizer, learning_rate(learner.update, total, config))
        batch = scenarios.batch()
        is_taught = learner.update < config.teacher_share * total
        with torch.no_grad():
            context = model.encode(batch)
            simulated = roll_out(learner.lesson, batch, context, config, learner.update, is_taught=is_taught)
            target, rollout_of_row = judge(learner.lesson, batch, simulated)
        encode_again = getattr(model, "encode_again", None)
        size, parameters = math.ceil(config.num_rollouts / config.steps_per_update), list(model.parameters())
        totals, norm, num_left = torch.zeros(4, device=fabric.device), 0.0, config.num_rollouts
        for first in range(0, config.num_rollouts, size):
            # 1. gradient of the mean over the decisions of some rollouts, and of all processes
            learner.optimizer.zero_grad(set_to_none=True)
            current = encode_again(batch, context) if encode_again else model.encode(batch)
            wanted = target[(rollout_of_row >= first) & (rollout_of_row < first + size)]
            log_probs = model.score(current, simulated.select(slice(first, first + size))).log_probs
            loss = functional.kl_div(log_probs, wanted, reduction="sum")
            fabric.backward(loss)
            is_right = (log_probs.argmax(-1) == wanted.argmax(-1)).sum()
            entropy = -torch.special.xlogy(wanted, wanted).sum()
            sums = torch.stack([loss.detach(), is_right, entropy, torch.tensor(len(wanted), device=loss.device)])
            sums = all_reduce_sum(sums, fabric)
            all_reduce_gradients(parameters, fabric)
            for parameter in parameters:
                if parameter.grad is not None:
                    parameter.grad.div_(sums[-1].clamp(min=1.0))
            norm, totals = float(torch.nn.utils.clip_grad_norm_(parameters, config.gradient_clip)), totals + sums
            # 2. the step, the last of which counts the update
            num_left -= size
            if num_left <= 0 or not math.isfinite(norm):
                break
            learner.optimizer.step()
        learner.finish_update(is_good=math.isfinite(norm))
        loss, accuracy, entropy = (totals[:-1] / totals[-1].clamp(min=1.0)).tolist()
        values = {
            "loss": loss, "accuracy": accuracy, "teacher_entropy": entropy, "gradient_norm": norm,
            "learning_rate": learner.optimizer.param_groups[0]["lr"], "seconds": time.perf_counter() - start,
        }  # fmt: skip
        return UpdateReport(values, f"KL {loss:.3f}", "its gradient is not finite")


def check_teacher(teacher: Any) -> None:
    """Check that a policy can teach.

    Raises:
        ConfigError: The policy has no vocabulary or no weights.
    """
    if not isinstance(teacher, TokenPolicy) or not isinstance(teacher, nn.Module):
        raise ConfigError(
            f"a {type(teacher).__name__} has no vocabulary, so there are no tokens to distill: name a teacher that "
            "chooses tokens, such as demo-tuned."
        )


def roll_out(
    lesson: Lesson, batch: ScenarioBatch, context: Any, config: DistillConfig, update: int, *, is_taught: bool
) -> Rollouts:
    """Rollouts with the student's tokens as decisions, and states that student and teacher agree on.

    Args:
        lesson: Student and teacher, on the device of the batch and in evaluation mode.
        batch: Scenarios to continue from their current step.
        context: The student's encoding of the same scenarios.
        config: Settings with the number of rollouts and the seed.
        update: Number of the update from 0, on which the noise depends, so that a resumed run draws the same.
        is_taught: True = the teacher rolls out, with the student's tokens alone.
    """
    tokens = lesson.tokens

    def choose(distribution: Any, state: Any, sampling: Sampling, noise: Tensor) -> Int64[Tensor, "B N A"]:
        probability, _ = project(lesson, distribution, batch)
        cumulative = probability.cumsum(-1)
        level = pick_rows(noise, distribution.mask, len(cumulative) == distribution.mask.numel()) * cumulative[:, -1:]
        drawn = torch.searchsorted(cumulative, level, right=True).clamp(max=cumulative.shape[1] - 1)[:, 0]
        return tokens.to_large(place_rows(drawn, distribution.mask), batch.object_type)

    common: Any = {"seed": derive_seed(config.seed, "rollouts", update), "may_be_nan": True}
    if is_taught:
        simulated = simulate(lesson.teacher, batch, num_rollouts=config.num_rollouts, choose=choose, **common)
        simulated = replace(simulated, decision=tokens.to_small(simulated.decision, batch.object_type))
    else:
        simulated = simulate(lesson.student, batch, num_rollouts=config.num_rollouts, context=context, **common)
    # Each has a pose of its own at the current step, the end of the nearest token. The end of the first decision is
    # imposed on both, and from there on all poses follow from tokens.
    is_first = torch.arange(simulated.heading.shape[-1], device=batch.device) < lesson.student.steps_per_decision
    valid = (is_first & batch.agent_mask[:, None, :, None]).expand(simulated.heading.shape)
    return replace(simulated, forced=AgentStates(simulated.position, simulated.heading, valid))


def judge(lesson: Lesson, batch: ScenarioBatch, simulated: Rollouts) -> tuple[Float[Tensor, "R V"], Int64[Tensor, "R"]]:
    """The teacher's probabilities of the student's tokens at each decision, and the rollout of each decision.

    Args:
        lesson: Student and teacher, on the device of the batch and in evaluation mode.
        batch: Scenarios of the rollouts.
        simulated: Result of `roll_out` for the same scenarios, with R decisions of agents that are no padding.
    """
    in_large = replace(simulated, decision=lesson.tokens.to_large(simulated.decision, batch.object_type))
    scores = lesson.teacher.score(lesson.teacher.encode(batch), in_large)
    return project(lesson, scores, batch)


def project(lesson: Lesson, distribution: Any, batch: ScenarioBatch) -> tuple[Float[Tensor, "R V"], Int64[Tensor, "R"]]:
    """Probabilities of the student's tokens by a distribution of the teacher, and the rollout of each of its rows.

    Args:
        lesson: Student and teacher, with tokens on the device of the batch.
        distribution: Distributions [B, N, A] or [B, N, A, L] of the teacher, R rows.
        batch: Scenarios of the distributions.
    """
    mask = distribution.mask
    scenario, rollout, agent, *_ = find_rows(mask, is_dense=len(distribution.logits) == mask.numel())
    return lesson.tokens.project(distribution.log_probs.exp(), batch.object_type[scenario, agent]), rollout

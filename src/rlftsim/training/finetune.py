"""Closed-loop fine-tuning with rewards: sample, reward, score, update, sync the reference (RLFTSim, section 4).

`finetune` is the main path of this package; `update_policy` is one update of it, in seven steps.
"""

import copy
import math
import os
from pathlib import Path

import torch
from torch import nn

from rlftsim.rewards import parse_reward
from rlftsim.rollout.policy import Policy
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.training.experience import (
    Experience,
    UpdateClock,
    compute_reward,
    count_decisions,
    describe,
    hold_speed,
    missing_rate_of,
    sample_rollouts,
)
from rlftsim.training.finetune_config import FinetuneConfig
from rlftsim.training.freezing import (
    freeze_untrained,
    parameter_groups,
    refuse_constant_entropy,
    set_learning_rate,
    trained_parts,
)
from rlftsim.training.goals import StoredGoals, refuse_goals
from rlftsim.training.hindsight import accumulate_hindsight
from rlftsim.training.parallel import Fabric, all_reduce_gradients, local_rollouts, num_sharing_memory
from rlftsim.training.policy_gradient import LossTerms, accumulate_gradients
from rlftsim.training.reference import RewardLearner, adapt_beta, sync_reference
from rlftsim.training.run import (
    TrainingRun,
    TrainingScenarios,
    UpdateReport,
    as_scenarios,
    require_trainable,
    train_in_processes,
)


def finetune(
    policy: Policy, scenarios: TrainingScenarios, out: str | os.PathLike[str], config: FinetuneConfig, *, card: str = ""
) -> Path:
    """Fine-tune a policy in place with rewards; resumes where a run in `out` was stopped, or ended with fewer epochs.

    Args:
        policy: an nn.Module that implements `rollout.policy.Policy` and has `save_pretrained`.
        scenarios: a data set, a list or one scenario, with their futures.
        out: the run's folder.
        config: see its fields.
        card: README of the resulting model folder.

    Returns:
        The model folder, `out/model`.

    Raises:
        ConfigError: the policy has no weights or is not goal-conditioned as the settings want, or there is no scenario.
        DataError: a scenario has no logged future or no evaluated agent.
        CheckpointError: `out` holds another run, or the run diverged (its last good checkpoint is named).
        NotYetError: another run is at work in `out`.
    """
    scenarios = as_scenarios(scenarios)
    model = require_trainable(policy, scenarios, "rewards", imitated=config.imitation_weight > 0, rewarded=True)
    trained_parts(model, config.trained)  # refuses what the policy does not have, before the folder is claimed
    refuse_goals(policy, config.goals.probability)
    augmented = config.goals.open_augmented(scenarios)
    if config.entropy_bonus:
        refuse_constant_entropy(model, scenarios[0], config.trained)

    def train(config: FinetuneConfig, fabric: Fabric) -> Path:
        run = TrainingRun(
            policy, scenarios, out, config, fabric,
            inputs={"augmented_goals": augmented.fingerprint} if augmented else {}, num_rollouts=config.num_rollouts,
            skip_rule=f"KL above max_kl={config.max_kl} or not finite",
            remedy="lower learning_rate or raise kl.initial_beta",
            may_grow=("epochs",),  # the learning rate is constant: a longer run passes through the same weights
        )  # fmt: skip
        learner = prepare(model, config, fabric.device, augmented)
        unwarned = list(parse_reward(config.reward))

        def make_update() -> UpdateReport:
            batch = run.local_batch(learner.update).to(fabric.device)
            values = update_policy(learner, batch, config, fabric)
            levels, alarms = learner.alarms.watch(values, config.alarms)
            if learner.update == 1 and (values["reward_zero_rate"] == 1 or values["gradient_norm"] == 0):
                alarms.append(f"no reward reached a trained weight (RMM {values['rmm']:.3f})")
            for term in [term for term in unwarned if values[missing_rate_of(term)]]:
                unwarned.remove(term)
                count = round(values[missing_rate_of(term)] * config.batch_size)
                alarms.append(f"reward {term}: not finite in {count} of {config.batch_size} scenarios, counted as 0")
            cause = f"KL {values['kl']:.3g} nats per decision is above max_kl={config.max_kl:g}"
            if not math.isfinite(values["gradient_norm"]):
                cause = "its gradient is not finite"
            note = f"RMM {values['rmm']:.3f}, KL {values['kl']:.4f}, beta {learner.beta:.3f}"
            return UpdateReport({**values, **levels}, note, cause, alarms)

        return run.train(learner, make_update, title="fine-tune", card=card)

    return train_in_processes(train, config, len(scenarios), out)


def prepare(
    policy: nn.Module, config: FinetuneConfig, device: torch.device, augmented: StoredGoals | None = None
) -> RewardLearner:
    """Freeze the weights that are not trained, copy the reference, make the optimizer. Dropout is off from here on.

    Args:
        policy: changed in place.
        config: see its fields.
        device: to train on.
        augmented: goals beside the logged endpoints.
    """
    # With dropout the scored distribution would not be the one that was sampled from.
    policy.to(device).eval()
    freeze_untrained(policy, config.trained)
    optimizer = torch.optim.AdamW(
        parameter_groups(policy, config.goals.learning_rate_scale),
        lr=config.learning_rate,
        betas=config.betas,
        weight_decay=config.weight_decay,
    )
    reference = copy.deepcopy(policy).requires_grad_(False)
    beta = config.kl.initial_beta
    return RewardLearner(policy=policy, reference=reference, optimizer=optimizer, beta=beta, augmented_goals=augmented)


def update_policy(
    learner: RewardLearner, batch: ScenarioBatch, config: FinetuneConfig, fabric: Fabric
) -> dict[str, float]:
    """Make one update of the policy, as in RLFTSim, section 4.1.

    Args:
        learner: changed in place.
        batch: this process's scenarios of the update, with their futures.
        config: see its fields.
        fabric: processes and precision.

    Returns:
        Metrics by the names of metrics.jsonl.
    """
    clock = UpdateClock(fabric.device)
    experiences: list[Experience] = []
    own = local_rollouts(config.batch_size, config.num_rollouts, fabric)
    for part in batch.split(max(config.micro_batch_size // num_sharing_memory(fabric), 1)):
        # 1. Sample N rollouts of each scenario under this update's goals, without gradient.
        context, rollouts = sample_rollouts(
            learner.policy, part, config.goals, learner.augmented_goals,
            num_rollouts=config.num_rollouts, own=own, seed=config.seed, update=learner.update, fabric=fabric,
        )  # fmt: skip
        clock.lap("rollout")
        # 2. Measure their realism and the reward that each rollout, or each agent in it, earns.
        realism, rewards = compute_reward(part, rollouts, config)
        experiences.append(Experience(part, rollouts, realism, rewards, context, own))
        clock.lap("reward")
    speed = {}
    if config.hold_speed:  # over the whole batch, so not by part
        experiences, speed["speed_slope"] = hold_speed(experiences, fabric)
    # 3. Score them under policy and reference: gradient of the policy-gradient loss with its KL penalty, and of the
    # pre-training loss where it has a weight.
    terms = LossTerms(*count_decisions(experiences, fabric), learner.beta, learner.update, config)
    learner.optimizer.zero_grad(set_to_none=True)
    sums = accumulate_gradients(
        learner.policy, learner.reference, experiences, terms, fabric, rollouts_per_pass=config.rollouts_per_pass
    )
    # 4. Score them again under goals that one of them has met: gradient of the goal reward in hindsight.
    hindsight = accumulate_hindsight(
        learner.policy, experiences, parse_reward(config.reward), sums, terms, fabric,
        weight=config.goals.hindsight, rollouts_per_pass=config.rollouts_per_pass,
    )  # fmt: skip
    all_reduce_gradients(learner.parameters, fabric)
    clock.lap("backward")
    # 5. Take the optimizer's step, or skip it where the gradient is not finite or the KL exploded.
    norm = float(torch.nn.utils.clip_grad_norm_(learner.parameters, config.gradient_clip))
    warmup = min((learner.update + 1) / max(config.warmup_updates, 1), 1.0)
    set_learning_rate(learner.optimizer, config.learning_rate * warmup)
    learner.finish_update(is_good=math.isfinite(norm) and sums.kl <= config.max_kl)
    values = {
        **describe(experiences, fabric), **speed, "kl": sums.kl, "entropy": sums.entropy, **hindsight,
        **sums.imitation, "score_gap": sums.score_gap, "beta": learner.beta, "gradient_norm": norm,
        "skipped": float(learner.skipped_in_a_row),
    }  # fmt: skip
    # 6. Adapt the strength of the KL penalty to the KL of this update.
    if not learner.skipped_in_a_row:
        learner.beta = adapt_beta(learner.beta, sums.kl, config.kl)
    # 7. Move the reference a little towards the policy, now and then.
    if config.kl.reference_sync_every and learner.update % config.kl.reference_sync_every == 0:
        sync_reference(learner.reference, learner.policy, config.kl.reference_ema)
    clock.lap("step")
    return {**values, "learning_rate": learner.optimizer.param_groups[0]["lr"], **clock.seconds}

"""Pre-training of TrafficBots: closed-loop imitation of the log, in two passes.

Agents follow their mean actions for 80 steps, some are put back onto the log at every step. The network's inputs
carry no gradient, so the loss reaches an action u_t through the dynamics alone, and its gradient equals that of

    sum_t u_t(weights) * dL/du_t,

with dL/du_t a constant. So: (1) roll out without gradient; (2) differentiate the dynamics; (3) compute all mean actions
again, in parallel over time and with gradient.

Source: Zhang et al., "TrafficBots", 2023 (section 4), and "TrafficBots V1.5", 2024.

Shapes: B scenarios, A agents, T = 80 decisions, L lights, M map tokens, D width.
"""

from dataclasses import dataclass

import numpy as np
import torch
from jaxtyping import Bool, Float, Int64
from torch import Tensor
from torch.nn.functional import pad, smooth_l1_loss

from rlftsim.policies.trafficbots.config import LATENT_SIZE, TrafficBotsConfig
from rlftsim.policies.trafficbots.destinations import NO_DESTINATION, destination_labels
from rlftsim.policies.trafficbots.dynamics import max_action, move
from rlftsim.policies.trafficbots.network import (
    POSTERIOR_STRIDE,
    AgentConditioning,
    AgentContext,
    TrafficBotsNetwork,
    Windows,
    history_windows,
)
from rlftsim.policies.trafficbots.scene import Scene, build_scene
from rlftsim.policies.trafficbots.scoring import features_over_time
from rlftsim.policies.trafficbots.state import Imposed, traffic_at_start, whole_history
from rlftsim.rollout.policy import ImitationLoss
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, HISTORY_STEPS, TOTAL_STEPS

POSITION_WEIGHT, HEADING_WEIGHT, SPEED_WEIGHT, PERSONALITY_WEIGHT = 0.1, 10.0, 0.1, 0.2


@dataclass(frozen=True, eq=False)
class TrainingDraws:
    """Everything random in an update."""

    noise: Float[Tensor, "B A 16"]
    """Standard normal, of the personalities."""
    from_prior: bool
    """True = personalities are the noise itself, not drawn from the posterior."""
    forced: Bool[Tensor, "B A"]
    """True = the agent is put back onto the log at every step."""
    node_mask: Bool[Tensor, "B M 20"]
    """True = the map node is looked at."""
    history_mask: Bool[Tensor, "B A 11"]
    """True = the destination predictor looks at this step."""


def imitation_loss(
    network: TrafficBotsNetwork,
    config: TrafficBotsConfig,
    batch: ScenarioBatch,
    trained: Bool[Tensor, "B A"],
    update: int,
) -> ImitationLoss:
    """Loss of an update, a sum of means over each scenario.

    Args:
        network: in training mode inputs are hidden and agents forced by schedule; in evaluation mode nothing is hidden,
            and the last of `forced_fractions` holds.
        config: schedule of forcing, and probabilities.
        batch: with futures.
        trained: True = the agent counts; the others are context.
        update: of pre-training, counted from 0.
    """
    scene = build_scene(batch, TOTAL_STEPS, config.max_map_tokens)
    labels = np.full(trained.shape, NO_DESTINATION)
    for row, scenario in zip(labels, batch.scenarios):
        own = destination_labels(scenario, config.max_map_tokens)
        row[: len(own)] = own
    # Beside rewards, in evaluation mode, the schedule of pre-training is at its end.
    stages = len(config.forced_fractions) - 1
    stage = min(update // config.forcing_updates, stages) if network.training else stages
    draws = draw_training(scene, config, config.forced_fractions[stage], hide=network.training)
    destination = torch.from_numpy(labels).to(trained.device)
    return loss_of_scene(network, config, scene, destination, trained & scene.agent_mask, draws)


def draw_training(scene: Scene, config: TrafficBotsConfig, fraction: float, *, hide: bool) -> TrainingDraws:
    """Draw everything random of an update with torch's generator.

    Args:
        scene: supplies sizes and device.
        config: probabilities.
        fraction: of agents that follow the log.
        hide: hide some of the inputs.
    """
    agents = scene.agent_mask.shape

    def uniform(*shape: int) -> Tensor:
        # Always from the generator of the CPU, so that devices draw the same.
        return torch.rand(*shape).to(scene.pose.device)

    noise = torch.randn(*agents, LATENT_SIZE).to(scene.pose.device)
    from_prior = bool(torch.rand(()) < config.prior_probability)
    forced = uniform(*agents) < fraction
    node_mask, history_mask = scene.node_mask, scene.valid[..., :HISTORY_STEPS]
    if hide and config.input_drop:
        # The first node has the token's pose, the last step is the agent's.
        kept_nodes = uniform(*node_mask.shape) >= config.input_drop
        kept_nodes[..., 0] = True
        kept_steps = uniform(*history_mask.shape) >= config.input_drop
        kept_steps[..., -1] = True
        node_mask, history_mask = node_mask & kept_nodes, history_mask & kept_steps
    return TrainingDraws(noise, from_prior, forced, node_mask, history_mask)


def loss_of_scene(
    network: TrafficBotsNetwork,
    config: TrafficBotsConfig,
    scene: Scene,
    destination: Int64[Tensor, "B A"],
    trained: Bool[Tensor, "B A"],
    draws: TrainingDraws,
) -> ImitationLoss:
    """Loss of a scene under given draws.

    Args:
        network: the weights.
        config: KL that costs nothing, and size of a pass.
        scene: with all 91 steps.
        destination: label of each agent, negative = none.
        trained: True = the agent counts.
        draws: of `draw_training`.
    """
    # 1. Map, lights along the log, personality, destination: all with gradient.
    map_features = network.map(scene, draws.node_mask)
    light_features, light_loss = _lights_along_log(network, scene, map_features)
    mean = network.posterior(*_posterior_inputs(scene), scene, map_features)
    log_std = network.posterior.log_std
    personality = draws.noise if draws.from_prior else mean + log_std.exp() * draws.noise
    given = network.conditioning(scene, map_features, personality[:, None], destination[:, None])
    around = network.agents.context(map_features, light_features[:, CURRENT_STEP:])

    # 2. Roll out without gradient, differentiate the dynamics, score with gradient.
    rolled = _roll_out(network, scene, around, given, destination[:, None], draws.forced)
    value, grad = _loss_of_actions(scene, rolled, trained)
    features = features_over_time(
        network, rolled.history, rolled.active, scene, around, given, steps_per_pass=config.steps_per_pass
    )  # [B, T, 1, A, D]
    actions = network.mean_actions(features, scene).movedim(1, 3)  # [B, 1, A, T, 2]
    gradient_of_actions = (actions * grad).sum()
    # The value of the imitation loss with the gradient of the sum.
    imitation = value + (gradient_of_actions - gradient_of_actions.detach())

    # 3. Terms of what is drawn once, for agents that are simulated at all.
    taking_part = trained & rolled.alive.any(-1)[:, 0]
    kl = personality_kl(mean, log_std, config.free_nats)
    personality_loss = _mean_by_scenario(kl, taking_part)
    log_prob = network.destination_predictor(
        history_windows(scene), scene, map_features, draws.history_mask
    )  # [B, A, M]
    chosen = -log_prob.gather(-1, destination.clamp(min=0)[..., None])[..., 0]
    destination_loss = _mean_by_scenario(chosen, taking_part & (destination >= 0) & chosen.isfinite())
    losses = {
        "imitation_loss": imitation,
        "personality_loss": personality_loss,
        "destination_loss": destination_loss,
        "light_loss": light_loss,
    }
    sums = {name: value.detach() for name, value in losses.items()}
    loss = torch.stack(list(losses.values())).sum()
    return ImitationLoss(loss, torch.tensor(len(trained), device=trained.device), sums)


def personality_kl(
    mean: Float[Tensor, "*g 16"], log_std: Float[Tensor, "*#g 16"], free_nats: float
) -> Float[Tensor, "*g"]:
    """KL balancing of the posterior and the prior N(0, I), each at least `free_nats`.

    The prior has no weights, so that its part is a constant, kept because the public loss has it.

    Args:
        mean: of the posterior.
        log_std: of the posterior.
        free_nats: KL that costs no more.
    """
    kl = (0.5 * ((2 * log_std).exp() + mean.square() - 1) - log_std).sum(-1)
    return kl.detach().clamp(min=free_nats) + PERSONALITY_WEIGHT * kl.clamp(min=free_nats)


def imitation_terms(
    pose: Float[Tensor, "*g 3"], speed: Float[Tensor, "*g"], logged_pose: Float[Tensor, "*g 3"], logged_speed: Tensor
) -> tuple[Float[Tensor, "*g"], Float[Tensor, "*g"], Float[Tensor, "*g"]]:
    """Weighted losses of position, heading and speed.

    Args:
        pose: simulated.
        speed: simulated, m/s.
        logged_pose: of the same step.
        logged_speed: of the same step, m/s.
    """
    position = smooth_l1_loss(pose[..., :2], logged_pose[..., :2], reduction="none").sum(-1)
    heading = 0.5 * (1 - (pose[..., 2] - logged_pose[..., 2]).cos())
    speed_error = smooth_l1_loss(speed, logged_speed, reduction="none")
    return POSITION_WEIGHT * position, HEADING_WEIGHT * heading, SPEED_WEIGHT * speed_error


@dataclass(frozen=True, eq=False)
class _RolledOut:
    """A closed-loop rollout along mean actions, N = 1."""

    history: Windows
    """[B, 1, A, 10 + T]."""
    active: Bool[Tensor, "B 1 A T"]
    alive: Bool[Tensor, "B 1 A T"]
    action: Float[Tensor, "B 1 A T 2"]
    forced: Bool[Tensor, "B 1 A T"]
    """True = put onto the log after the decision."""


@torch.no_grad()
def _roll_out(
    network: TrafficBotsNetwork,
    scene: Scene,
    around: AgentContext,
    given: AgentConditioning,
    destination: Int64[Tensor, "B 1 A"],
    forced: Bool[Tensor, "B A"],
) -> _RolledOut:
    traffic = traffic_at_start(scene, destination)
    before, actions, put = [], [], []
    for index in range(FUTURE_STEPS):
        before.append(traffic)
        windows, around_now = traffic.windows.as_one_decision(), around.steps(index, index + 1)
        features = network.features(windows, scene, around_now, given, traffic.active[:, None])  # [B, 1, 1, A, D]
        action = network.mean_actions(features, scene)[:, 0]
        step = CURRENT_STEP + index + 1
        logged = scene.valid[:, None, :, step]
        imposed = Imposed(logged & forced[:, None], scene.pose[:, None, :, step], scene.motion[:, None, :, step])
        traffic = traffic.after(action, scene, imposed, staying=logged)
        actions.append(action)
        put.append(imposed.mask)
    return _RolledOut(
        whole_history(before),
        torch.stack([one.active for one in before], 3),
        torch.stack([one.alive for one in before], 3),
        torch.stack(actions, 3),
        torch.stack(put, 3),
    )


@torch.enable_grad()
def _loss_of_actions(
    scene: Scene, rolled: _RolledOut, trained: Bool[Tensor, "B A"]
) -> tuple[Float[Tensor, ""], Float[Tensor, "B 1 A T 2"]]:
    """Imitation loss (a sum over scenarios of means), and its gradient with respect to the actions."""
    action = rolled.action.detach().clone().requires_grad_(True)
    limit = max_action(scene.agent_class)[:, None]
    logged_pose, logged_motion = scene.pose[:, None], scene.motion[:, None]  # [B, 1, A, S, 3]
    pose, speed = rolled.history.pose[..., CURRENT_STEP, :], rolled.history.motion[..., CURRENT_STEP, 0]
    losses, counted = [], []
    for index in range(FUTURE_STEPS):
        step = CURRENT_STEP + index + 1
        alive, forced = rolled.alive[..., index], rolled.forced[..., index]
        pose, motion = move(pose, speed, torch.where(alive[..., None], action[..., index, :], 0.0), limit)
        speed = motion[..., 0]
        terms = imitation_terms(pose, speed, logged_pose[..., step, :], logged_motion[..., step, 0])
        losses.append(sum(terms))
        counted.append(alive & scene.valid[:, None, :, step] & trained[:, None])
        # The gradient does not pass a reset.
        pose = torch.where(forced[..., None], logged_pose[..., step, :], pose)
        speed = torch.where(forced, logged_motion[..., step, 0], speed)
    mask = torch.stack(counted, -1)  # [B, 1, A, T]
    loss = _mean_by_scenario(torch.stack(losses, -1), mask)
    (grad,) = torch.autograd.grad(loss, action)
    return loss.detach(), grad


def _lights_along_log(
    network: TrafficBotsNetwork, scene: Scene, map_features: Float[Tensor, "B M D"]
) -> tuple[Float[Tensor, "B 90 L D"], Float[Tensor, ""]]:
    """Features of the logged lights at steps 0 to 89, and the cross-entropy of each next state."""
    encoder = network.lights
    padded = pad(scene.light_state, (encoder.window - 1, 0))  # the log begins at step 0
    windows = padded.unfold(2, encoder.window, 1)[:, :, :-1].transpose(1, 2)  # [B, 90, L, W]
    steps = torch.arange(windows.shape[1], device=padded.device)[:, None]
    step_mask = steps + torch.arange(1 - encoder.window, 1, device=padded.device) >= 0  # [90, W]
    features = encoder(windows, encoder.neighborhoods(scene, map_features), step_mask)
    log_prob = torch.log_softmax(network.next_light_logits(features), -1)
    target = scene.light_state[:, :, 1:].transpose(1, 2)[..., None]  # [B, 90, L, 1]
    loss = -log_prob.gather(-1, target)[..., 0]
    return features, _mean_by_scenario(loss, scene.light_mask[:, None].expand_as(loss))


def _posterior_inputs(scene: Scene) -> tuple[Windows, Int64[Tensor, "B 1 L 19"]]:
    """Every fifth step of the log: agents [B, 1, 1, A, 19] and lights."""
    every = slice(0, TOTAL_STEPS, POSTERIOR_STRIDE)
    windows = Windows(*(v[:, None, None, :, every] for v in (scene.valid, scene.pose, scene.motion)))
    return windows, scene.light_state[:, None, :, every]


def _mean_by_scenario(values: Float[Tensor, "B *g"], mask: Bool[Tensor, "B *g"]) -> Float[Tensor, ""]:
    """Sum over scenarios of the means of what counts in each; 0 where nothing does."""
    total = torch.where(mask, values, 0.0).flatten(1).sum(1)
    return (total / mask.flatten(1).sum(1).clamp(min=1)).sum()

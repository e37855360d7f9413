"""Pre-training of TrafficBots: closed-loop imitation of the log, in two passes.

Agents follow mean actions for 80 steps, some are put back onto the log at every step. The network's inputs
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
from rlftsim.policies.trafficbots.network import (
    POSTERIOR_STRIDE,
    AgentConditioning,
    AgentContext,
    TrafficBotsNetwork,
    Windows,
    history_windows,
)
from rlftsim.policies.trafficbots.scene import NO_DESTINATION, Scene, build_scene, destination_labels
from rlftsim.policies.trafficbots.state import ImposedStates, join_history, max_action, move, start_traffic
from rlftsim.rollout.policy import ImitationLoss
from rlftsim.scenario.batch import ScenarioBatch
from rlftsim.scenario.types import CURRENT_STEP, FUTURE_STEPS, HISTORY_STEPS, TOTAL_STEPS

POSITION_WEIGHT, HEADING_WEIGHT, SPEED_WEIGHT, PERSONALITY_WEIGHT = 0.1, 10.0, 0.1, 0.2


@dataclass(frozen=True, eq=False)
class Draws:
    """All random values of an update."""

    noise: Float[Tensor, "B A 16"]
    """Standard normal noise of the personalities."""
    from_prior: bool
    """True = personalities are the noise, not drawn from the posterior."""
    forced: Bool[Tensor, "B A"]
    """True = the agent is put back onto the log at every step."""
    node_mask: Bool[Tensor, "B M 20"]
    """True = the map node is looked at."""
    history_mask: Bool[Tensor, "B A 11"]
    """True = the destination predictor looks at this step."""


def imitation_loss(
    network: TrafficBotsNetwork, batch: ScenarioBatch, trained: Bool[Tensor, "B A"], update: int
) -> ImitationLoss:
    """Loss of an update, a sum of means over each scenario.

    Args:
        network: Network with weights and settings. In training mode inputs are hidden and agents forced by schedule;
            in evaluation mode no inputs are hidden, and the last of `forced_fractions` holds.
        batch: Scenarios with logged futures, the targets of imitation.
        trained: True = the agent counts; other agents are context.
        update: Number of the update of pre-training from 0.
    """
    config, scene = network.config, build_scene(batch, TOTAL_STEPS, network.config.max_map_tokens)
    labels = np.full(trained.shape, NO_DESTINATION)
    for row, scenario in zip(labels, batch.scenarios):
        destinations = destination_labels(scenario, config.max_map_tokens)
        row[: len(destinations)] = destinations
    # Beside rewards, in evaluation mode, the schedule of pre-training has ended.
    stages = len(config.forced_fractions) - 1
    stage = min(update // config.forcing_updates, stages) if network.training else stages
    draws = draw_training(scene, config, config.forced_fractions[stage], hide=network.training)
    destination = torch.from_numpy(labels).to(trained.device)
    return compute_scene_loss(network, scene, destination, trained & scene.agent_mask, draws)


def draw_training(scene: Scene, config: TrafficBotsConfig, fraction: float, *, hide: bool) -> Draws:
    """Draw all random values of an update with torch's generator.

    Args:
        scene: Scene with the sizes and the device of the draws.
        config: Settings with the probabilities.
        fraction: Fraction in [0, 1] of agents that follow the log.
        hide: True hides some map nodes and history steps.
    """
    shape, device = scene.agent_mask.shape, scene.pose.device
    # Always from the generator of the CPU, so that devices draw the same.
    noise = torch.randn(*shape, LATENT_SIZE).to(device)
    from_prior = bool(torch.rand(()) < config.prior_probability)
    forced = torch.rand(shape).to(device) < fraction
    node_mask, history_mask = scene.node_mask, scene.valid[..., :HISTORY_STEPS]
    if hide and config.input_drop:
        # The first node has the token's pose, the last step is the agent's.
        nodes, steps = (torch.rand(mask.shape).to(device) >= config.input_drop for mask in (node_mask, history_mask))
        nodes[..., 0], steps[..., -1] = True, True
        node_mask, history_mask = node_mask & nodes, history_mask & steps
    return Draws(noise, from_prior, forced, node_mask, history_mask)


def compute_scene_loss(
    network: TrafficBotsNetwork, scene: Scene, labels: Int64[Tensor, "B A"], trained: Bool[Tensor, "B A"], draws: Draws
) -> ImitationLoss:
    """Loss of a scene with random values that have been drawn.

    Args:
        network: Network with the weights to be trained.
        scene: Scene with all 91 steps of the log.
        labels: Map token of each agent's destination; negative = none.
        trained: True = the agent counts; other agents are context.
        draws: Random values, from `draw_training`.
    """
    # 1. Map, lights along the log, personality, destination: all with gradient.
    map_features = network.map(scene, draws.node_mask)
    light_features, light_loss = _lights_along_log(network, scene, map_features)
    steps = slice(0, TOTAL_STEPS, POSTERIOR_STRIDE)
    windows = Windows(scene.valid, scene.pose, scene.motion).apply(lambda v: v[:, None, None, :, steps])
    mean = network.posterior(windows, scene.light_state[:, None, :, steps], scene, map_features)
    log_std = network.posterior.log_std
    personality = draws.noise if draws.from_prior else mean + log_std.exp() * draws.noise
    conditioning = network.conditioning(scene, map_features, personality[:, None], labels[:, None])
    context = network.agents.context(scene, map_features, light_features[:, CURRENT_STEP:])

    # 2. Roll out without gradient, differentiate the dynamics, score with gradient.
    rollout = _roll_out(network, context, conditioning, labels[:, None], draws.forced)
    value, grad = _differentiate_actions(scene, rollout, trained)
    features = network.features_over_time(rollout.history, rollout.active, context, conditioning)  # [B, T, 1, A, D]
    actions = network.mean_actions(features, scene).movedim(1, 3)  # [B, 1, A, T, 2]
    surrogate = (actions * grad).sum()

    # 3. Terms of values that are drawn once, for agents that are simulated at all.
    counts = trained & rollout.alive.any(-1)[:, 0]
    log_prob = network.destination_predictor(history_windows(scene), scene, map_features, draws.history_mask)
    nll = -log_prob.gather(-1, labels.clamp(min=0)[..., None])[..., 0]  # [B, A]
    losses = {
        "imitation_loss": value + (surrogate - surrogate.detach()),  # value of the loss, gradient of the sum
        "personality_loss": _average_by_scenario(personality_kl(mean, log_std, network.config.free_nats), counts),
        "destination_loss": _average_by_scenario(nll, counts & (labels >= 0) & nll.isfinite()),
        "light_loss": light_loss,
    }
    sums = {name: value.detach() for name, value in losses.items()}
    loss = torch.stack(list(losses.values())).sum()
    return ImitationLoss(loss, torch.tensor(len(trained), device=trained.device), sums)


def personality_kl(
    mean: Float[Tensor, "*g 16"], log_std: Float[Tensor, "*#g 16"], free_nats: float
) -> Float[Tensor, "*g"]:
    """KL balancing of the posterior and the prior N(0, I), each at least `free_nats`.

    The prior has no weights, so that the first term is a constant, as in the public loss.

    Args:
        mean: Means of the posterior.
        log_std: Logarithms of the posterior's standard deviations.
        free_nats: KL in nats below which the loss stays constant.
    """
    kl = (0.5 * ((2 * log_std).exp() + mean.square() - 1) - log_std).sum(-1)
    return kl.detach().clamp(min=free_nats) + PERSONALITY_WEIGHT * kl.clamp(min=free_nats)


def imitation_terms(
    pose: Float[Tensor, "*g 3"], speed: Float[Tensor, "*g"], logged_pose: Float[Tensor, "*g 3"], logged_speed: Tensor
) -> tuple[Float[Tensor, "*g"], Float[Tensor, "*g"], Float[Tensor, "*g"]]:
    """Weighted losses of position, heading and speed.

    Args:
        pose: Simulated poses, ego frame.
        speed: Simulated speeds, m/s.
        logged_pose: Logged poses of the same steps, ego frame.
        logged_speed: Logged speeds of the same steps, m/s.
    """
    position = smooth_l1_loss(pose[..., :2], logged_pose[..., :2], reduction="none").sum(-1)
    heading = 0.5 * (1 - (pose[..., 2] - logged_pose[..., 2]).cos())
    speed_error = smooth_l1_loss(speed, logged_speed, reduction="none")
    return POSITION_WEIGHT * position, HEADING_WEIGHT * heading, SPEED_WEIGHT * speed_error


@dataclass(frozen=True, eq=False)
class _Rollout:
    """A closed-loop rollout along mean actions, N = 1."""

    history: Windows
    """[B, 1, A, 10 + T]."""
    active: Bool[Tensor, "B 1 A T"]
    alive: Bool[Tensor, "B 1 A T"]
    action: Float[Tensor, "B 1 A T 2"]
    forced: Bool[Tensor, "B 1 A T"]
    """True = the agent is put onto the log after the decision."""


@torch.no_grad()
def _roll_out(
    network: TrafficBotsNetwork,
    context: AgentContext,
    conditioning: AgentConditioning,
    destination: Int64[Tensor, "B 1 A"],
    forced: Bool[Tensor, "B A"],
) -> _Rollout:
    scene, traffic = context.scene, start_traffic(context.scene, destination)
    states, actions, imposed_masks = [], [], []
    for index in range(FUTURE_STEPS):
        states.append(traffic)
        windows, lights = traffic.windows.add_decision_axis(), context.select_steps(slice(index, index + 1))
        features = network.features(windows, lights, conditioning, traffic.active[:, None])  # [B, 1, 1, A, D]
        action = network.mean_actions(features, scene)[:, 0]
        step = CURRENT_STEP + index + 1
        logged = scene.valid[:, None, :, step]
        imposed = ImposedStates(logged & forced[:, None], scene.pose[:, None, :, step], scene.motion[:, None, :, step])
        traffic = traffic.advance(action, scene, imposed, staying=logged)
        actions.append(action)
        imposed_masks.append(imposed.mask)
    values = ([state.active for state in states], [state.alive for state in states], actions, imposed_masks)
    return _Rollout(join_history(states), *(torch.stack(tensors, 3) for tensors in values))


@torch.enable_grad()
def _differentiate_actions(
    scene: Scene, rollout: _Rollout, trained: Bool[Tensor, "B A"]
) -> tuple[Float[Tensor, ""], Float[Tensor, "B 1 A T 2"]]:
    """Imitation loss (a sum over scenarios of means), and the gradient with respect to the actions."""
    action = rollout.action.detach().clone().requires_grad_(True)
    limit = max_action(scene.agent_class)[:, None]
    logged_pose, logged_motion = scene.pose[:, None], scene.motion[:, None]  # [B, 1, A, S, 3]
    pose, speed = rollout.history.pose[..., CURRENT_STEP, :], rollout.history.motion[..., CURRENT_STEP, 0]
    losses, masks = [], []
    for index in range(FUTURE_STEPS):
        step = CURRENT_STEP + index + 1
        alive, forced = rollout.alive[..., index], rollout.forced[..., index]
        pose, motion = move(pose, speed, torch.where(alive[..., None], action[..., index, :], 0.0), limit)
        speed = motion[..., 0]
        losses.append(sum(imitation_terms(pose, speed, logged_pose[..., step, :], logged_motion[..., step, 0])))
        masks.append(alive & scene.valid[:, None, :, step] & trained[:, None])
        # The gradient does not pass a reset.
        pose = torch.where(forced[..., None], logged_pose[..., step, :], pose)
        speed = torch.where(forced, logged_motion[..., step, 0], speed)
    loss = _average_by_scenario(torch.stack(losses, -1), torch.stack(masks, -1))  # of [B, 1, A, T]
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
    return features, _average_by_scenario(loss, scene.light_mask[:, None].expand_as(loss))


def _average_by_scenario(values: Float[Tensor, "B *g"], mask: Bool[Tensor, "B *g"]) -> Float[Tensor, ""]:
    """Sum over scenarios of the means of masked values; 0 for a scenario without such values."""
    total = torch.where(mask, values, 0.0).flatten(1).sum(1)
    return (total / mask.flatten(1).sum(1).clamp(min=1)).sum()

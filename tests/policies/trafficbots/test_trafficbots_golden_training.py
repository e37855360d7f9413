"""The imitation loss and its gradients against the public code with the same weights and draws."""

import numpy as np
import pytest
import torch
from public_names import UNUSED, our_names

from rlftsim.policies.trafficbots.imitation import Draws, compute_scene_loss, imitation_terms, personality_kl
from rlftsim.policies.trafficbots.state import max_action, move

pytestmark = [pytest.mark.official, pytest.mark.usefixtures("without_gradients")]
TERMS = ("imitation", "personality", "destination", "light")


@pytest.mark.parametrize(("name", "case"), [("A", "default"), ("A", "free"), ("B", "default")])
def test_loss_and_every_gradient(golden, small, scene, name, case):
    theirs, numbers = golden.arrays(f"scenario_{name}/train_{case}"), golden.scalars("train")[f"{name}_{case}"]
    scene, network = scene(name, "gt"), small.network
    labels = torch.from_numpy(golden.arrays(f"scenario_{name}/inputs")["dest_label"]).long()[None]
    draws = Draws(
        noise=torch.from_numpy(theirs["eps"])[None],
        from_prior=False,
        forced=torch.from_numpy(theirs["forced"][:, 11:].any(1))[None],
        node_mask=scene.node_mask,
        history_mask=scene.valid[..., :11],
    )
    small.zero_grad()
    with torch.enable_grad():
        found = compute_scene_loss(network, scene, labels, scene.agent_mask, draws)
        found.loss.backward()
    # 1. The loss, all of it and its terms.
    assert float(found.loss.detach()) == pytest.approx(numbers["loss"], rel=1e-6)
    for term in TERMS:
        # Without forcing, 80 steps of feedback make rounding grow.
        assert float(found.sums[f"{term}_loss"]) == pytest.approx(numbers[f"loss_{term}"], rel=1e-5)
    # 2. The norms of the gradients.
    ours = {n: p.grad for n, p in network.named_parameters() if p.grad is not None}
    total = torch.stack([grad.square().sum() for grad in ours.values()]).sum().sqrt()
    assert float(total) == pytest.approx(numbers["grad_norm_all"], rel=1e-4)
    for public, norm in numbers["grad_norm"].items():
        if UNUSED.search(public):
            continue
        grad = torch.cat([ours[own].flatten() for own in our_names(public)])
        assert float(grad.norm()) == pytest.approx(norm, rel=1e-3, abs=1e-6), public
    small.zero_grad()


def test_terms_of_a_step_and_of_the_personality(golden):
    theirs = golden.unit("imitation")
    found = imitation_terms(theirs["pose"], theirs["speed"], theirs["gt_pose"], theirs["gt_speed"])
    for ours, name in zip(found, ("pos", "rot", "speed")):
        np.testing.assert_allclose(ours, theirs[f"loss_{name}"], atol=2e-6)
    theirs = golden.unit("kl")
    np.testing.assert_allclose(personality_kl(theirs["mean"], theirs["log_std"], 1.0), theirs["loss"], rtol=1e-5)


def test_a_tracker_follows_logged_vehicles_through_the_dynamics(golden, scene):
    """The best that any policy can do: each step the action that leads nearest to the next logged state."""
    logged = scene("B", "gt")
    moving = logged.valid.all(-1)[0] & ((logged.pose[0, :, -1, :2] - logged.pose[0, :, 10, :2]).norm(dim=-1) > 5)
    pose, speed = logged.pose[0, moving, 10], logged.motion[0, moving, 10, 0]
    limit, errors = max_action(logged.agent_class[0, moving]), []
    for step in range(11, 91):
        target = logged.pose[0, moving, step]
        # Speed that leads to the target's position along the heading, heading of the target.
        towards = torch.stack([pose[:, 2].cos(), pose[:, 2].sin()], -1)
        way = ((target[:, :2] - pose[:, :2]) * towards).sum(-1)
        wanted = torch.stack([(way / 0.1 - speed) / 0.05 / 2, (target[:, 2] - pose[:, 2]) / 0.1], -1)
        pose, motion = move(pose, speed, torch.atanh((wanted / limit).clamp(-0.999, 0.999)), limit)
        speed = motion[:, 0]
        errors.append((pose[:, :2] - target[:, :2]).norm(dim=-1))
    assert len(errors[0]) >= 4
    # The specification measured 0.22 m.
    assert float(torch.stack(errors).mean()) < 0.242

"""Losses, gradients and optimizer steps on scenario A against the public code.

Dropout and history drop are off, as there.

Ties. A few ReLUs have inputs of 1e-8 to 1e-6 here (typical size 0.7), so rounding decides on which side of zero
they are, and each CPU rounds in its own way. Losses hardly notice, but a ReLU on the other side takes part in the
gradient or leaves it: a single one of 600 rows x 256 units changes the gradient norm of some parameters by up to
0.5 %. `break_tie` names these ReLUs, asserts that they are ties, and puts them on the side that they have in the
golden numbers (found by trying both sides: with the right one all of the golden gradient norms agree to 1e-5 and
better).
"""

import copy

import numpy as np
import pytest
import torch
from torch.nn import functional

from catk_loss import catk_loss
from rlftsim.policies.smart.catk_checkpoint import PREFIX, catk_name
from rlftsim.scenario.batch import collate
from rlftsim.training.catk_rollouts import roll_out_closest
from rlftsim.training.data import within_reach

pytestmark = pytest.mark.official
LOSS_TOLERANCE = 1e-5
GRADIENT_TOLERANCE = 1e-3
"""Relative."""
CURVE_TOLERANCE = 1e-3
NUM_COMPARED_NORMS = 3
"""Steps whose gradient norm is compared to `CURVE_TOLERANCE`, of six. What separates two
implementations grows about tenfold with each step of AdamW. From the fourth step on it exceeds the distance of
many ReLU inputs from zero, and those ties cannot be named, as they depend on the CPU. Tried on AVX2 and AVX-512, with
each tie of step 0 on either side: the first three norms stay within 2.1e-4, later ones within 6.1e-3, and all six
losses, which are continuous, within 6.4e-4."""
LATER_NORMS_TOLERANCE = 2e-2
TIE = 3e-6
"""Inputs of ReLUs that rounding may put on the other side."""
LEARNING_RATE, WEIGHT_DECAY, GRADIENT_CLIP = 5e-4, 0.01, 0.5
frames = pytest.mark.parametrize("frame", ["centred", "absolute"])


@pytest.fixture
def policy(nano):
    return copy.deepcopy(nano)


def bc_loss(policy, batch, arrays, label_smoothing):
    """Mean loss and number of terms."""
    trained = torch.from_numpy(arrays["train_mask"])[None]
    prediction = policy.teacher_forced(batch, trained)
    logits, target = prediction.logits[prediction.target_mask], prediction.target[prediction.target_mask]
    return functional.cross_entropy(logits, target, label_smoothing=label_smoothing), len(target)


def gradient_norms(policy):
    """By the public code's names, without its prefix."""
    named = policy.network.named_parameters()
    return {catk_name(name).removeprefix(PREFIX): float(p.grad.norm()) for name, p in named if p.grad is not None}


def check_gradients(policy, total, by_parameter):
    ours = gradient_norms(policy)
    theirs = {own_name(name.removeprefix(PREFIX)): norm for name, norm in by_parameter.items()}
    assert ours.keys() == theirs.keys()
    off = {name: abs(ours[name] / norm - 1) for name, norm in theirs.items()}
    wrong = {name: value for name, value in off.items() if value > GRADIENT_TOLERANCE}
    assert wrong == {}
    assert sum(n * n for n in ours.values()) ** 0.5 == pytest.approx(total, rel=GRADIENT_TOLERANCE)


def own_name(name):
    """The name that this package keeps of a norm with two names."""
    return name if ".pt2a_" in name else name.replace("attn_prenorm_x_src", "attn_prenorm_x_dst")


@frames
def test_targets_are_those_of_the_public_code(frame, policy, batch_a, golden):
    arrays = golden.arrays(f"nano/{frame}_train")
    tokens = policy._tokenize(batch_a(frame))
    np.testing.assert_array_equal(tokens.valid[0], arrays["valid_mask"])
    np.testing.assert_array_equal(tokens.logged_valid[0], arrays["gt_valid_raw"])
    counts = arrays["bc_target_valid"]
    np.testing.assert_array_equal(tokens.valid[0, :, 2:] & tokens.valid[0, :, 1:-1], counts)
    np.testing.assert_array_equal(tokens.next_token_id[0, :, 1:-1][counts], arrays["bc_target_idx"][counts])
    rolling = (tokens.token_id[0, :, 2:].numpy() != arrays["bc_target_idx"])[counts].sum()
    assert rolling == golden.scalars(f"nano_{frame}")["train"]["bc_target_vs_gtidx_mismatch"]


def test_steps_far_from_the_ego_are_left_out(scenario_a, policy, golden):
    train = golden.arrays("nano/centred_train")
    logged = golden.arrays("scenario_A/preprocessed")
    tokens = policy._tokenize(collate([within_reach(scenario_a, 150.0)]))
    np.testing.assert_array_equal(tokens.valid[0], train["valid_mask"])
    # at 60 m the mask bites: the public code's positions, its rule by hand, for agents that it leaves one stretch of
    position, valid = logged["position"], logged["valid_mask"]
    ego = logged["role"][:, 0].argmax()
    near = valid & (np.linalg.norm(position - position[ego], axis=-1) < 60.0)
    kept = near[:, 10]
    some = policy._tokenize(collate([within_reach(scenario_a, 60.0)]))
    stretch = (np.diff(near[kept].astype(int), axis=1) == 1).sum(1) + near[kept][:, 0] == 1
    late = near[kept].argmax(1) >= 6  # else begun earlier at constant velocity
    ours = some.logged_valid[0].numpy()
    assert ours.shape == (kept.sum(), 18)
    plain = stretch & ~late
    np.testing.assert_array_equal(ours[plain][:, 2:], near[kept][plain][:, 15::5])
    assert 0 < near[kept][plain].sum() < valid[kept][plain].sum()


@pytest.mark.parametrize(("frame", "label_smoothing"), [("centred", 0.1), ("absolute", 0.1), ("centred", 0.0)])
def test_pre_training_loss_and_gradients(frame, label_smoothing, policy, batch_a, golden):
    expected = golden.scalars(f"nano_{frame}")["train"]
    loss, count = bc_loss(policy, batch_a(frame), golden.arrays(f"nano/{frame}_train"), label_smoothing)
    assert count == expected["bc_n_loss_terms"]
    assert loss.item() == pytest.approx(expected[f"bc_loss_ls{label_smoothing}"], abs=LOSS_TOLERANCE)
    loss.backward()
    total = expected[f"bc_gradnorm_ls{label_smoothing}"]
    assert torch.nn.utils.get_total_norm([p.grad for p in policy.parameters()]).item() == pytest.approx(
        total, rel=GRADIENT_TOLERANCE
    )
    if label_smoothing:
        check_gradients(policy, total, expected["bc_grad"])


def optimizer_curve(policy, batch, arrays, num_steps):
    """Losses and gradient norms of some steps on one batch."""
    optimizer = torch.optim.AdamW(policy.parameters(), lr=LEARNING_RATE, weight_decay=WEIGHT_DECAY)
    losses, norms = [], []
    for _ in range(num_steps):
        optimizer.zero_grad()
        loss, _ = bc_loss(policy, batch, arrays, 0.1)
        loss.backward()
        norms.append(torch.nn.utils.clip_grad_norm_(policy.parameters(), GRADIENT_CLIP).item())
        optimizer.step()
        losses.append(loss.item())
    return losses, norms


def check_six_steps(policy, frame, batch_a, golden):
    expected, arrays = golden.scalars(f"nano_{frame}")["train"], golden.arrays(f"nano/{frame}_train")
    losses, norms = optimizer_curve(policy, batch_a(frame), arrays, len(expected["bc_curve"]))
    np.testing.assert_allclose(losses, expected["bc_curve"], atol=CURVE_TOLERANCE, rtol=0)
    first, later = slice(NUM_COMPARED_NORMS), slice(NUM_COMPARED_NORMS, None)
    golden_norms = expected["bc_curve_gradnorm"]
    np.testing.assert_allclose(norms[first], golden_norms[first], rtol=CURVE_TOLERANCE)
    np.testing.assert_allclose(norms[later], golden_norms[later], rtol=LATER_NORMS_TOLERANCE)


@torch.no_grad()
def break_tie(policy, layer, row, unit, side, predict):
    """Put a ReLU of a layer's feed-forward part on a side of zero, by moving the bias of its unit.

    Args:
        policy: receives the bias.
        layer: name of an attention layer of the decoder.
        row: of the ReLU's input.
        unit: of the ReLU's input.
        side: +1 or -1.
        predict: runs the forward pass in which it is a tie; the last call of the layer counts.
    """
    feed_forward = policy.network.decoder.get_submodule(layer).feed_forward
    inputs = []
    hook = feed_forward[2].register_forward_pre_hook(lambda module, arguments: inputs.append(arguments[0]))
    predict()
    hook.remove()
    value = inputs[-1][row, unit].item()
    assert abs(value) < TIE  # anything larger is no matter of rounding
    feed_forward[1].bias[unit] += side * 1e-6 - value


def test_six_optimizer_steps_in_absolute_coordinates(policy, batch_a, golden):
    def predict():
        bc_loss(policy, batch_a("absolute"), golden.arrays("nano/absolute_train"), 0.1)

    break_tie(policy, "time_layers.1", 481, 73, +1, predict)
    break_tie(policy, "time_layers.2", 251, 23, -1, predict)
    break_tie(policy, "time_layers.3", 16, 48, -1, predict)
    check_six_steps(policy, "absolute", batch_a, golden)


@pytest.mark.slow
def test_six_optimizer_steps(policy, batch_a, golden):
    def predict():
        bc_loss(policy, batch_a("centred"), golden.arrays("nano/centred_train"), 0.1)

    break_tie(policy, "time_layers.2", 316, 166, -1, predict)
    check_six_steps(policy, "centred", batch_a, golden)


def test_closest_among_top_k_in_our_own_order_of_operations(policy, batch_a, golden):
    expected = golden.arrays("nano/centred_train")
    targeted = roll_out_closest(policy, batch_a("centred"))
    np.testing.assert_array_equal(targeted.rollouts.decision[0, 0], expected["catk_idx"][:, 2:])


@frames
def test_closest_among_top_k(frame, policy, batch_a, golden):
    arrays, batch = golden.arrays(f"nano/{frame}_train"), batch_a(frame)
    targeted = roll_out_closest(policy, batch, catk_compat=True)
    np.testing.assert_array_equal(targeted.rollouts.decision[0, 0], arrays["catk_idx"][:, 2:])
    ends = slice(4, None, 5)
    assert np.abs(targeted.rollouts.position[0, 0, :, ends].numpy() - arrays["catk_pos"][:, 2:]).max() < 1e-3
    counts = arrays["catk_target_valid"]
    np.testing.assert_array_equal(targeted.target_mask[0, 0], counts)
    np.testing.assert_array_equal(targeted.target[0, 0][counts], arrays["catk_target_idx"][counts])

    expected = golden.scalars(f"nano_{frame}")["train"]

    def predict():
        return catk_loss(policy, batch, targeted, torch.from_numpy(arrays["train_mask"])[None])

    if frame == "centred":
        break_tie(policy, "agent_layers.0", 691, 143, +1, predict)
    loss = predict()
    assert loss.item() == pytest.approx(expected["catk_loss"], abs=LOSS_TOLERANCE)
    loss.backward()
    check_gradients(policy, expected["catk_gradnorm"], expected["catk_grad"])

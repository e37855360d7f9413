"""A calibrated TrafficBots policy: features shift the mean of what the base decides."""

import copy
import json
from dataclasses import replace

import numpy as np
import pytest
import torch
from tiny_trafficbots import TINY

import scenes
import tiny
from rlftsim.errors import ConfigError
from rlftsim.geometry import rotate
from rlftsim.policies.averaging import average_policies
from rlftsim.policies.calibrated.actions import ShiftedDistribution
from rlftsim.policies.calibrated.features import FEATURES
from rlftsim.policies.calibrated.policy import CalibratedActionPolicy, CalibratedTokenPolicy, add_features
from rlftsim.policies.registry import load_policy
from rlftsim.policies.trafficbots.policy import TrafficBotsPolicy
from rlftsim.rollout.check import check_policy
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import TokenPolicy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.training.config import CalibrateConfig
from rlftsim.training.run import train_policy

SCENES = (scenes.bend("one", 3), scenes.junction_with_light("two"))
NAMES = tuple(FEATURES.names())
ETA = [0.1 * (-1) ** index for index in range(len(NAMES))]


@pytest.fixture(scope="module")
def base():
    torch.manual_seed(0)
    return TrafficBotsPolicy(TINY).eval().requires_grad_(False)


@pytest.fixture
def calibrated(base):
    return CalibratedActionPolicy(base, NAMES, ETA)


def first_decision(policy, batch):
    """Distribution at the current step."""
    context = policy.encode(batch)
    return policy.decide(
        context, policy.begin(context, 2, None, torch.full((2, 2, batch.agent_mask.shape[1], 17), 0.5))
    )


@pytest.mark.slow
def test_the_contract_is_kept(calibrated):
    report = check_policy(calibrated, SCENES)
    assert report.is_passed, str(report)


def test_with_eta_zero_it_decides_as_its_base_bit_for_bit(base):
    batch = collate(list(SCENES))
    plain, off = (simulate(policy, batch, num_rollouts=2, seed=1) for policy in (base, add_features(base, NAMES)))
    assert torch.equal(plain.position, off.position)
    assert torch.equal(plain.log_prob, off.log_prob)


def test_the_score_function_is_the_gradient_of_the_log_probability_by_eta(calibrated):
    dist, gradient = tiny.check_score_function(calibrated, collate(list(SCENES)))  # [B, N, A, T, K]
    assert isinstance(dist, ShiftedDistribution)
    assert gradient.abs().amax((0, 1, 2, 3)).count_nonzero() >= 8  # most features have something to say here


def test_a_feature_of_speed_makes_its_vehicles_faster_and_nobody_else(base):
    batch = collate(list(SCENES))
    before, after = (first_decision(CalibratedActionPolicy(base, ["speed_middle"], [eta]), batch) for eta in (0.0, 1.0))
    speed = batch.velocity[:, :, 10].norm(dim=-1)
    in_band = ((speed >= 4) & (speed < 9) & (batch.object_type == 1) & batch.agent_mask)[:, None].expand(-1, 2, -1)
    shift = (after.mean - before.mean) / before.std
    assert in_band.any()
    assert (shift[in_band][:, 0] > 0.01).all()
    assert not shift[~in_band].any()
    assert torch.equal(after.std, before.std)


def test_a_temperature_scales_what_the_policy_aims_at_and_not_the_noise_that_goes_on(base):
    batch = collate(list(SCENES))
    names = [f"temperature_{band}" for band in ("slow", "middle", "fast")]
    rollouts = simulate(base, batch, num_rollouts=2, seed=0)
    before, after = (
        policy.score(policy.encode(batch), rollouts)
        for policy in (base, CalibratedActionPolicy(base, names, [0.2] * 3))
    )
    first = torch.cat([batch.position[:, None, :, 10:11].expand(-1, 2, -1, -1, -1), rollouts.position], 3)
    speed = first.diff(dim=3).norm(dim=-1)[..., :-1] / 0.1  # before each later decision
    moves = (speed > 0.6) & (batch.object_type == 1)[:, None, :, None] & before.mask[..., 1:]
    aim = before.aim[..., 1:, :]
    within_bounds = moves[..., None] & ((aim / before.std[..., 1:, :]).abs() < 4)
    shift = (after.mean - before.mean)[..., 1:, :]
    assert within_bounds.any()
    torch.testing.assert_close(shift[within_bounds], 0.2 * aim[within_bounds], atol=1e-5, rtol=1e-3)


def test_a_turn_to_the_lane_is_one_to_its_side(base):
    # vehicle 0 drives half a meter to the right of its lane's center, vehicle 2 to the left of its own
    scene = scenes.straight_road()
    tracks = replace(scene.tracks, position=scene.tracks.position - np.float32([0.0, 0.5, 0.0]))
    dist = first_decision(CalibratedActionPolicy(base, ["turn_to_lane_center"], [1.0]), collate([scene, scene]))
    moved = first_decision(
        CalibratedActionPolicy(base, ["turn_to_lane_center"], [1.0]), collate([replace(scene, tracks=tracks), scene])
    )
    shift = (moved.mean - moved.slopes.base.mean)[0, 0]
    assert shift[0, 1] > 1e-4
    assert shift[2, 1] < -1e-4
    assert not shift[:, 0].any()
    assert shift[0, 1] > 2 * (dist.mean - dist.slopes.base.mean)[0, 0, 0, 1].abs()


def test_an_action_leads_where_a_step_gets_the_agent(base):
    batch = collate(list(SCENES))
    context = base.encode(batch)
    state = base.begin(context, 2, None, torch.full((2, 2, batch.agent_mask.shape[1], 17), 0.5))
    decision = torch.randn(2, 2, batch.agent_mask.shape[1], 2, generator=torch.Generator().manual_seed(0))
    windows = state.traffic.windows
    class_id = context.scene.agent_class[:, None]
    end = base.predict_pose(class_id, windows.motion[..., -1, 0], decision, 0.1)
    before, after = windows.pose[..., -1, :], base.advance(context, state, decision).traffic.windows.pose[..., -1, :]
    moved = rotate(after[..., :2] - before[..., :2], -before[..., 2])
    is_alive = state.traffic.alive
    torch.testing.assert_close(end[is_alive][:, :2], moved[is_alive], atol=1e-4, rtol=0)
    torch.testing.assert_close(end[is_alive][:, 2], (after - before)[is_alive][:, 2], atol=1e-5, rtol=0)


@pytest.mark.parametrize(
    ("end", "reason"),
    [
        (lambda action: action, r"predict_pose gives \[\d+, 4, 2\] for actions"),
        (lambda action: None, "predict_pose gives NoneType"),
        (lambda action: torch.full((*action.shape[:-1], 3), torch.nan), "finite numbers"),
    ],
)
def test_a_pose_of_another_shape_is_refused(base, monkeypatch, end, reason):
    policy = CalibratedActionPolicy(base, ["speed_fast"], [1.0])
    monkeypatch.setattr(type(policy), "predict_pose", lambda policy, class_id, speed, action, seconds: end(action))
    with pytest.raises(ConfigError, match=reason):
        simulate(policy, collate([SCENES[0]]), num_rollouts=1, seed=0, num_steps=5)


def test_other_features_go_on_top(base, calibrated):
    above = add_features(calibrated, ["speed_fast"])
    assert isinstance(above, CalibratedActionPolicy)
    batch = collate([SCENES[0]])
    plain, off = (simulate(policy, batch, num_rollouts=2, seed=1) for policy in (calibrated, above))
    assert torch.equal(plain.position, off.position)


def test_a_policy_without_tokens_and_poses_is_refused():
    with pytest.raises(ConfigError, match="Linear has neither a vocabulary nor predict_pose"):
        add_features(torch.nn.Linear(1, 1), ["speed_fast"])


def test_it_is_saved_loaded_and_averaged(base, calibrated, tmp_path):
    calibrated.save_pretrained(tmp_path)
    loaded = load_policy(tmp_path)
    assert isinstance(loaded, CalibratedActionPolicy)
    assert not isinstance(loaded, TokenPolicy)
    assert fingerprint_policy(loaded) == fingerprint_policy(calibrated)
    batch = collate([SCENES[0]])
    assert torch.equal(*(simulate(one, batch, num_rollouts=2, seed=0).position for one in (loaded, calibrated)))
    mean = average_policies([loaded, calibrated], base=base, scale=2.0)
    torch.testing.assert_close(mean.eta, 2 * calibrated.eta)


def test_it_is_fitted_as_policies_of_tokens_are(base, tmp_path):
    config = CalibrateConfig(num_rollouts=3, batch_size=2, micro_batch_size=1, lengths=(1.0,), device=tiny.CPU)
    drawn = [*SCENES, scenes.straight_road(), scenes.with_gaps()]
    model = train_policy(add_features(copy.deepcopy(base), config.features), drawn, tmp_path, config)
    stored = json.loads((model / "calibration.json").read_text())
    assert any(row["eta"] for row in stored["features"]) == (stored["length"] > 0)
    assert config.kl / 10 < stored["held_back"][0]["kl"] < config.kl * 10  # in the time of five decisions
    assert fingerprint_policy(load_policy(model / "base")) == fingerprint_policy(base)


def test_another_wrapper_is_refused_with_the_reason(base):
    with pytest.raises(
        ConfigError, match="TrafficBotsPolicy is no TokenPolicy, which a CalibratedTokenPolicy is made of"
    ):
        CalibratedTokenPolicy(base, NAMES)

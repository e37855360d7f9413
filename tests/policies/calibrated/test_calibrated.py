"""A calibrated policy is a policy like any other, and with eta 0 it is its base."""

import copy
import inspect
import pickle
from dataclasses import replace

import pytest
import torch

import scenes
import tiny
from rlftsim.errors import CheckpointError, ConfigError
from rlftsim.policies.averaging import average_policies
from rlftsim.policies.calibrated.features import FEATURES, TiltedDistribution, features_by_name, register_feature
from rlftsim.policies.calibrated.policy import CHANGES, CalibratedTokenPolicy
from rlftsim.policies.registry import load_policy
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.check import check_policy
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy, TokenPolicy
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary

SCENES = (scenes.bend(), scenes.bend("pair", 2), scenes.junction_with_light())
NAMES = tuple(FEATURES.names())
ETA = [0.3 * (-1) ** index for index in range(len(NAMES))]


@pytest.fixture(scope="module")
def base():
    config = TokensConfig(num_tokens=48, num_map_prototypes=16)
    vocabulary = build_vocabulary([*SCENES, scenes.crowd(num_agents=40)], config)[0]
    return tiny.tiny_policy(vocabulary, tiny.WITHOUT_CHANCE).eval().requires_grad_(False)


@pytest.fixture
def calibrated(base):
    return CalibratedTokenPolicy(base, NAMES, ETA)


def distribution_of(policy, scenario, num_rollouts=2):
    """Of the first decision that follows another one."""
    batch = collate([scenario])
    context = policy.encode(batch)
    state = policy.begin(context, num_rollouts, None, torch.zeros(1, num_rollouts, batch.agent_mask.shape[1], 0))
    first = policy.decide(context, state).logits.argmax(-1).view(1, num_rollouts, -1)
    return policy.decide(context, policy.advance(context, state, first))


def test_a_calibrated_policy_keeps_the_contract(base):
    config = {"max_map_neighbors": None, "map_radius_m": 12.0}
    with_all_neighbors = tiny.tiny_policy(base.vocabulary, tiny.replace(tiny.WITHOUT_CHANCE, **config)).train()
    report = check_policy(CalibratedTokenPolicy(with_all_neighbors, NAMES, ETA), SCENES[:2])
    assert report.is_passed, str(report)


def test_every_python_sees_the_members_of_a_policy(calibrated):
    # as isinstance does from Python 3.12 on: without __getattr__, by which torch finds parameters and we the base's
    for name in (*TokenPolicy.__annotations__, *Policy.__annotations__):
        assert inspect.getattr_static(calibrated, name, None) is not None, name


def test_with_eta_zero_it_decides_as_its_base_bit_for_bit(base):
    batch = collate(list(SCENES))
    plain, off = (simulate(one, batch, num_rollouts=3, seed=1) for one in (base, CalibratedTokenPolicy(base, NAMES)))
    assert torch.equal(plain.position, off.position)
    assert torch.equal(plain.log_prob, off.log_prob)
    scored = [
        one.score(one.encode(batch), plain).log_prob(plain.decision)
        for one in (base, CalibratedTokenPolicy(base, NAMES))
    ]
    assert torch.equal(*scored)


def test_the_score_function_is_the_gradient_of_the_log_probability_by_eta(calibrated):
    dist, gradient = tiny.check_score_function(calibrated, collate(list(SCENES)))  # [B, N, A, L, K]
    assert isinstance(dist, TiltedDistribution)
    assert gradient.abs().amax((0, 1, 2, 3)).count_nonzero() >= 6  # most features have something to say here


def test_values_of_features_stay_within_their_bounds(base):
    dist = distribution_of(CalibratedTokenPolicy(base, NAMES), scenes.crowd(num_agents=40))
    for feature in features_by_name(NAMES):
        values = feature(dist._candidates)
        assert feature.low <= values.min()
        assert values.max() <= feature.high


def test_where_nobody_has_a_choice_nothing_is_tilted(base):
    dist = distribution_of(CalibratedTokenPolicy(base, NAMES, ETA), SCENES[0])
    certain = replace(dist.base, logits=20 * torch.nn.functional.one_hot(dist.logits.argmax(-1), 48).float())
    tilted = replace(dist, base=certain)
    assert torch.equal(tilted.logits, certain.logits)
    assert tilted.values.shape == (0, len(NAMES))


def test_a_scene_without_any_map_has_no_edge_and_no_lane(base):
    candidates = distribution_of(CalibratedTokenPolicy(base, NAMES), scenes.without_map())._candidates
    assert len(candidates.row)
    for values in (candidates.road_edge(0.5), candidates.lane_turn, candidates.lane_offset):
        assert not values.any()


def test_other_processes_have_the_same_policy(calibrated):
    sent = pickle.loads(pickle.dumps(calibrated))
    batch = collate([SCENES[0]])
    here, there = (simulate(policy, batch, num_rollouts=2, seed=0) for policy in (calibrated, sent))
    assert torch.equal(here.position, there.position)


def test_what_all_candidates_share_changes_nothing(base):
    # a vehicle that leaves the road with every token it may take: the tokens it would never take are no way out
    register_feature("off_the_road", low=0.0, high=3.0)(lambda candidates: torch.full_like(candidates.log_ratio, 3.0))
    try:
        dist = distribution_of(CalibratedTokenPolicy(base, ["off_the_road"], [-2.6]), SCENES[0])
        assert torch.equal(dist.logits, dist.base.logits)
        assert not dist.values.any()
    finally:
        FEATURES.remove("off_the_road")


def test_a_road_edge_is_that_of_the_way_ahead_and_braking_is_no_way_from_it(base):
    candidates = distribution_of(CalibratedTokenPolicy(base, NAMES), SCENES[0])._candidates
    straight = candidates.end[:, 1].abs() < 0.02
    for seconds in (0.5, 1.0):
        nearness = candidates.road_edge(seconds)
        for agent in candidates.row.unique():
            rows = straight & (candidates.row == agent)
            # tokens that differ in length alone come equally near
            torch.testing.assert_close(nearness[rows], nearness[rows][:1].expand(int(rows.sum())), atol=0.1, rtol=0)


def test_a_feature_shifts_logits_by_eta_times_its_value_and_only_those_of_candidates(base):
    name = "speed_fast"
    dist = distribution_of(CalibratedTokenPolicy(base, [name], [0.5]), SCENES[0])
    shift = dist.logits - dist.base.logits
    candidates = torch.zeros_like(shift, dtype=torch.bool)
    candidates[dist._pairs[:2]] = True
    assert not shift[~candidates].any()
    torch.testing.assert_close(shift[dist._pairs[:2]], 0.5 * dist.values[:, 0], atol=1e-5, rtol=0)


def test_it_is_saved_and_loaded_with_its_base(calibrated, tmp_path):
    fitted = {
        "num_scenarios": [2, 1],
        "num_rollouts": 4,
        "constraints": [],
        "length": 1.0,
        "features": [],
        "held_back": [],
    }
    calibrated.set_calibration(calibrated.eta.detach(), fitted)
    calibrated.save_pretrained(tmp_path, card="made by hand")
    loaded = load_policy(tmp_path)
    assert isinstance(loaded, CalibratedTokenPolicy)
    assert loaded.calibration == fitted
    assert fingerprint_policy(loaded) == fingerprint_policy(calibrated)
    batch = collate([SCENES[0]])
    assert torch.equal(*(simulate(one, batch, num_rollouts=2, seed=0).position for one in (loaded, calibrated)))
    assert fingerprint_policy(load_policy(tmp_path / "base")) == fingerprint_policy(calibrated.base)


def test_a_folder_without_finite_weights_is_refused(calibrated, tmp_path):
    with torch.no_grad():
        calibrated.eta[0] = torch.nan
    calibrated.save_pretrained(tmp_path)
    with pytest.raises(CheckpointError, match="no finite eta"):
        load_policy(tmp_path)


def test_settings_of_the_base_count_in_the_fingerprint(base):
    other = copy.deepcopy(base)
    other.config = tiny.replace(base.config, agent_radius_m=base.config.agent_radius_m + 1)
    assert fingerprint_policy(CalibratedTokenPolicy(base, NAMES)) != fingerprint_policy(
        CalibratedTokenPolicy(other, NAMES)
    )


def test_the_mean_of_two_calibrations_has_the_mean_eta(base):
    low, high = (CalibratedTokenPolicy(base, NAMES[:2], eta) for eta in ([0.0, 1.0], [1.0, 3.0]))
    assert average_policies([low, high]).eta.tolist() == [0.5, 2.0]


def test_averages_are_of_policies_with_the_same_features(base):
    with pytest.raises(ConfigError, match="differs from the first"):
        average_policies([CalibratedTokenPolicy(base, NAMES[:2]), CalibratedTokenPolicy(base, NAMES[1:3])])


def test_half_precision_coarsens_the_base_and_not_the_tilt(calibrated):
    with torch.autocast("cpu", torch.bfloat16):
        tilted = distribution_of(calibrated, SCENES[1])
        logits, base_logits = tilted.logits, tilted.base.logits
    row, token, _ = tilted._pairs
    tilt = (logits - base_logits)[row, token]
    torch.testing.assert_close(tilt, tilted.values @ tilted.eta, rtol=0, atol=1e-5)
    assert tilt.abs().max() > 0.1


def test_further_training_moves_the_base_below_a_fixed_eta(calibrated):
    learner = copy.deepcopy(calibrated).requires_grad_(True)
    batch = collate([SCENES[0]])
    rollouts = simulate(calibrated, batch, num_rollouts=2, seed=0)
    learner.score(learner.encode(batch), rollouts).log_prob(rollouts.decision).sum().backward()
    assert learner.eta.grad is None
    assert not learner.eta.requires_grad
    assert all(p.grad is not None for p in learner.base.network.decoder.head.parameters())


@pytest.mark.parametrize(
    ("make", "reason"),
    [
        (lambda base: CalibratedTokenPolicy(ConstantVelocity(), NAMES), "ConstantVelocity has no weights"),
        (lambda base: CalibratedTokenPolicy(base, ["speed_slw"]), "did you mean 'speed_slow'"),
        (lambda base: CalibratedTokenPolicy(base, ["speed_slow"] * 2), "different names"),
        (lambda base: CalibratedTokenPolicy(base, NAMES, [1.0]), "one for each"),
        (lambda base: register_feature("wide", low=1.0, high=-1.0), "low < high"),
    ],
)
def test_what_cannot_be_calibrated_is_refused_with_the_reason(base, make, reason):
    with pytest.raises(ConfigError, match=reason):
        make(base)


def test_a_feature_of_ones_own_works_by_its_name_and_its_shape_is_checked(base):
    register_feature("half_speed", low=-1.0, high=1.0)(lambda c: 0.5 * c.speed_change)
    register_feature("by_agent", low=-1.0, high=1.0)(lambda c: c.speed)
    try:
        half, whole = (
            distribution_of(CalibratedTokenPolicy(base, [name]), SCENES[0]) for name in ("half_speed", "speed_fast")
        )
        is_fast = whole.values[:, 0] != 0
        torch.testing.assert_close(half.values[is_fast, 0], 0.5 * whole.values[is_fast, 0])
        with pytest.raises(ConfigError, match="a number for each"):
            distribution_of(CalibratedTokenPolicy(base, ["by_agent"], [1.0]), SCENES[0])
    finally:
        FEATURES.remove("half_speed")
        FEATURES.remove("by_agent")


@pytest.fixture
def plugged_in(request):
    register_feature("plugged_in", low=-1.0, high=1.0)(request.param)
    yield ["plugged_in"]
    FEATURES.remove("plugged_in")


@pytest.mark.parametrize(
    "plugged_in",
    [lambda c: c.speed_change.double(), lambda c: c.speed_change > 0],
    ids=["float64", "bool"],
    indirect=True,
)
def test_a_feature_may_give_numbers_of_any_type(base, plugged_in):
    logits = distribution_of(CalibratedTokenPolicy(base, plugged_in, [1.0]), SCENES[0]).logits
    assert logits.dtype == torch.float32
    assert not torch.equal(logits, distribution_of(base, SCENES[0]).logits)


@pytest.mark.parametrize("plugged_in", [lambda c: c.log_ratio / 0.0], indirect=True)  # -inf is clipped, 0 / 0 is not
def test_a_feature_that_gives_nan_is_refused_by_its_name(base, plugged_in):
    with pytest.raises(ConfigError, match="feature 'plugged_in' gives NaN for"):
        distribution_of(CalibratedTokenPolicy(base, plugged_in, [1.0]), SCENES[0])


@pytest.mark.parametrize("plugged_in", [lambda c: c.speed_change], indirect=True)
def test_a_model_whose_feature_is_of_a_missing_package_says_so(base, plugged_in, tmp_path):
    CalibratedTokenPolicy(base, plugged_in).save_pretrained(tmp_path)
    FEATURES.remove("plugged_in")
    reason = r"do not fit CalibratedTokenPolicy \(unknown feature 'plugged_in': .* once that is installed or imported"
    with pytest.raises(CheckpointError, match=reason):
        load_policy(tmp_path)


def calibrated_runs(base, *settings):
    runs = []
    for eta, gain, changes in zip((0.2, 0.4), (0.01, 0.03), settings):
        row = {"feature": "speed_fast", "eta": eta, "t": 2.0} | dict.fromkeys(
            ("rmm", "kinematic", "interactive", "map_based"), gain
        )
        held_back = {"length": 0.7, "kl": 0.003} | {name: {"change": 0.01, "t": 1.0} for name in CHANGES}
        account = {
            "num_scenarios": [8, 2], "num_rollouts": 8, "constraints": ["speed"], "length": 0.7, "features": [row],
            "held_back": [held_back],
        }  # fmt: skip
        runs.append(CalibratedTokenPolicy(base, ["speed_fast"], [eta], account | changes))
    return runs


def test_the_mean_of_calibrations_says_only_what_is_true_of_all(base, tmp_path):
    settings = {"reward": "mloo", "constraints": ["min_ade", "speed"], "num_rollouts": 4, "num_scenarios": [3, 1]}
    average_policies(calibrated_runs(base, {"reward": "rloo"}, settings)).save_pretrained(tmp_path)
    card = (tmp_path / "README.md").read_text().replace("\n", " ")
    assert "different numbers of scenarios with different numbers of rollouts each" in card
    assert "by prediction: speed. " in card
    assert load_policy(tmp_path).calibration["reward"] is None


def test_the_mean_with_a_calibration_that_has_no_t_has_none(base):
    first, second = calibrated_runs(base, {}, {})
    first.calibration["features"][0]["t"] = None
    assert average_policies([first, second]).calibration["features"][0]["t"] is None


def test_the_mean_of_calibrations_goes_further_from_their_plain_base_and_says_what_it_earns(base, tmp_path):
    runs = calibrated_runs(base, {}, {})
    average_policies(runs, base=base, scale=3.0).save_pretrained(tmp_path)
    average = load_policy(tmp_path)
    assert average.eta.tolist() == pytest.approx([0.9])
    row = average.calibration["features"][0]
    assert (row["eta"], row["rmm"], row["t"]) == pytest.approx((0.9, 0.06, 2.0))
    card = (tmp_path / "README.md").read_text()
    assert "| speed_fast | +0.900 | +2.0 | +0.0600 |" in card
    assert "Measured on" not in card

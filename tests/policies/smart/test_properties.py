"""What must not matter to SMART, and what the public code's quirks change."""

import math
from dataclasses import replace

import numpy as np
import pytest
import torch

import scenes
from catk_loss import catk_loss
from rlftsim.geometry import rotate, wrap_angle
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.embeddings import normalize
from rlftsim.policies.smart.network import Scene
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.policies.smart.token_steps import TokenSteps
from rlftsim.rollout.edge_scenes import edge_scenes
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import CURRENT_STEP, ObjectType
from rlftsim.tokens.agent_tokens import clean_tracks
from rlftsim.tokens.clustering import TokensConfig, build_vocabulary
from rlftsim.tokens.map_tokens import MapTokens, tokenize_map
from rlftsim.tokens.vocabulary import class_of_type
from rlftsim.training.catk_rollouts import roll_out_closest

SCENES = (scenes.bend(), scenes.bend("pair", 2))
ROUNDING = 2e-5
"""Float32, between orders of summation."""


@pytest.fixture(scope="module")
def vocabulary():
    config = TokensConfig(num_tokens=48, num_map_prototypes=16)
    return build_vocabulary([*SCENES, scenes.crowd(num_agents=40)], config)[0]


def smart(vocabulary, **changes):
    torch.manual_seed(3)
    sizes = {"dim": 16, "num_heads": 2, "head_dim": 8, "num_map_layers": 2, "num_decoder_layers": 2}
    # pieces of 5 m on a straight line are exactly 10 m from the next but one, the usual radius
    config = SmartConfig(**{**sizes, "num_frequencies": 8, "map_radius_m": 12.0, "max_map_neighbors": None, **changes})
    policy = SmartPolicy(config, vocabulary).eval()
    with torch.no_grad():
        for name, weight in policy.named_parameters():
            weight.mul_(3.0 if name.startswith("network.decoder.head") and weight.dim() == 2 else 1.0)
    return policy


@torch.no_grad()
def predictions(policy, scenario_list):
    """Logits [B, A, L, V] along the recorded tracks, zeros where invalid."""
    batch = collate(scenario_list)
    logits = policy.teacher_forced(batch, batch.agent_mask).logits
    valid = policy._tokenize(batch).valid[..., 1:-1]
    return logits.new_zeros(*valid.shape, logits.shape[-1]).masked_scatter(valid[..., None], logits)


@torch.no_grad()
@pytest.mark.parametrize("most", [None, 6])
def test_lights_that_change_give_the_features_of_an_encoding_from_the_start(vocabulary, most):
    policy = smart(vocabulary, max_map_neighbors=most)
    batch = collate([scenes.straight_road(), scenes.junction_with_light()])  # red until step 50
    green = replace(batch, light_step=80)
    context = policy.encode(batch)
    relit = policy.relight(context, green)
    torch.testing.assert_close(
        relit.scene.map_features, policy.encode(green).scene.map_features, atol=ROUNDING, rtol=0.0
    )
    is_changed = (relit.scene.map_features != context.scene.map_features).any(-1).view(2, -1)
    assert not is_changed[0].any()
    assert 0 < is_changed[1].sum() < context.scene.tokens.token_mask[1].sum()
    assert policy.relight(relit, replace(batch, light_step=90)) is relit


# ---- invariances ---------------------------------------------------------------------------------


@torch.no_grad()
def features(policy, batch, turn_rad, shift_m, order=None):
    """Decoder features in float64, the tokenized scene turned and shifted, its map tokens in another order."""

    def moved(position):
        angle = torch.full(position.shape[:-1], turn_rad, dtype=torch.float64)
        return rotate(position.double(), angle) + torch.tensor(shift_m, dtype=torch.float64)

    tokens, network = tokenize_map(batch, policy.vocabulary.map_prototypes), policy.network
    order = torch.arange(tokens.heading.shape[1]) if order is None else order
    tokens = MapTokens(**{name: getattr(tokens, name)[:, order] for name in MapTokens.__dataclass_fields__})
    tokens = replace(tokens, position=moved(tokens.position), heading=wrap_angle(tokens.heading.double() + turn_rad))
    steps = policy._logged_steps(policy._tokenize(batch), slice(0, -1))
    steps = TokenSteps(
        moved(steps.position), wrap_angle(steps.heading.double() + turn_rad),
        moved(steps.motion) - moved(torch.zeros(2)), steps.token_id, steps.valid,
    )  # fmt: skip
    class_id = class_of_type(batch.object_type)
    scene = Scene(
        tokens, normalize(network.map_encoder(tokens, policy.vocabulary.map_prototypes.double())), class_id,
        network.decoder.embed_agents(class_id, batch.size.double()),
        network.decoder.embed_tokens(policy.vocabulary.end_corners().double()),
        **network.decoder.relations(),
    )  # fmt: skip
    return network.decoder.head(network.decoder(scene, steps, None)[0])


@pytest.mark.parametrize("turn_rad", [0.0, 0.7, math.pi / 2, -2.9])
def test_logits_are_invariant_to_turning_and_shifting(turn_rad, vocabulary):
    policy = smart(vocabulary).double()
    batch = collate(SCENES)
    still, moved = (features(policy, batch, *motion) for motion in ((0.0, (0.0, 0.0)), (turn_rad, (31.7, -12.9))))
    assert still.std() > 0.1
    assert (still - moved).abs().max() < 1e-9


def test_logits_do_not_depend_on_the_order_of_map_tokens(vocabulary):
    policy = smart(vocabulary).double()
    batch = collate(SCENES[:1])
    count = tokenize_map(batch, vocabulary.map_prototypes).heading.shape[1]
    order = torch.randperm(count, generator=torch.Generator().manual_seed(0))
    there = (0.0, (0.0, 0.0))
    assert (features(policy, batch, *there) - features(policy, batch, *there, order)).abs().max() < 1e-9


def test_logits_do_not_depend_on_the_order_of_agents(vocabulary):
    policy, scenario = smart(vocabulary), SCENES[0]
    order = np.random.default_rng(0).permutation(len(scenario.tracks.valid))
    tracks = replace(scenario.tracks, **{k: v[order] for k, v in vars(scenario.tracks).items()})
    place = np.argsort(order)
    other = replace(
        scenario,
        tracks=tracks,
        ego_index=int(place[scenario.ego_index]),
        tracks_to_predict=place[scenario.tracks_to_predict].astype(np.int32),
    )
    simulated = [list(s.tracks.object_id[s.simulated_indices]) for s in (scenario, other)]
    columns = [simulated[1].index(i) for i in simulated[0]]
    assert columns != sorted(columns)
    before, after = (predictions(policy, [s]) for s in (scenario, other))
    assert (before - after[:, columns]).abs().max() < ROUNDING


def test_logits_do_not_depend_on_the_order_of_scenarios(vocabulary):
    policy = smart(vocabulary)
    before, after = predictions(policy, SCENES), predictions(policy, SCENES[::-1])
    assert (before - after.flip(0)).abs().max() < ROUNDING


# ---- quirks of the public code, decided on purpose -----------------------------------------------


@pytest.mark.parametrize("name", ["agents first seen at step 7", "agents first seen at the current step"])
def test_the_first_motion_is_zero_here_and_the_position_in_the_public_code(name, vocabulary):
    batch = collate([edge_scenes(SCENES[0])[name]])
    policy = smart(vocabulary)
    tokens = policy._tokenize(batch)
    late = tokens.valid[0, :, 1] & ~tokens.valid[0, :, 0]
    assert late.sum() == batch.agent_mask.sum() - 1  # all but the ego
    here = policy._logged_steps(tokens, slice(1, 2)).motion[0, 0, :, 0]
    assert (here[late] == 0).all()
    public = smart(vocabulary, catk_compat=True)
    tokens = public._tokenize(batch)
    there = public._logged_steps(tokens, slice(1, 2)).motion[0, 0, :, 0]
    assert torch.equal(there[late], tokens.position[0, late, 1])
    assert torch.allclose(there[~late], here[~late], atol=1e-3)
    with torch.no_grad():
        assert public.teacher_forced(batch, batch.agent_mask).logits.isfinite().all()


def test_a_pedestrian_that_turns_at_once_keeps_the_heading_before():
    scenario = scenes.bend()
    kinds = scenario.tracks.object_type == ObjectType.PEDESTRIAN
    heading = scenario.tracks.heading.copy()
    heading[kinds, 40:] += 2.0
    batch = collate([replace(scenario, tracks=replace(scenario.tracks, heading=heading))])
    row = (batch.object_type[0] == ObjectType.PEDESTRIAN).nonzero()[0, 0]
    cleaned = clean_tracks(batch).heading[0, row]
    recorded = batch.heading[0, row]
    assert torch.equal(cleaned[:40], recorded[:40])
    assert cleaned[40] == cleaned[39]  # and so on, for as long as the record stays away by more than 1.5 rad
    assert (wrap_angle(cleaned[40:] - recorded[40:]).abs() > 1.5).all()


def test_the_public_order_of_operations_moves_poses_by_rounding_only(vocabulary):
    ours, public = smart(vocabulary), smart(vocabulary, catk_compat=True)
    batch = collate(SCENES)
    a, b = ours._tokenize(batch), public._tokenize(batch)
    assert torch.equal(a.token_id[a.valid], b.token_id[a.valid])
    assert (a.position - b.position).abs().max() < 1e-3
    world = collate(SCENES, frame="world")
    assert world.frame == "world"
    assert torch.equal(world.origin, torch.zeros_like(world.origin))
    back = (world.position.double() - batch.origin[:, None, None]) * world.valid[..., None]
    assert torch.equal(back.float(), batch.position)


def test_next_tokens_are_the_rolling_ones(vocabulary):
    for policy in (smart(vocabulary), smart(vocabulary, catk_compat=True)):
        tokens = policy._tokenize(collate(SCENES))
        follows = tokens.valid[..., 1:] & tokens.valid[..., :-1]
        assert torch.equal(tokens.next_token_id[..., :-1][follows], tokens.token_id[..., 1:][follows])


# ---- closest among top-K -------------------------------------------------------------------------


def test_with_all_tokens_as_candidates_rollouts_follow_the_record(vocabulary):
    policy, batch = smart(vocabulary), collate(SCENES)
    targeted = roll_out_closest(policy, batch, num_candidates=vocabulary.num_tokens)
    assert torch.equal(targeted.rollouts.decision[targeted.target_mask], targeted.target[targeted.target_mask])
    off = targeted.rollouts.position[:, 0] - batch.position[:, :, CURRENT_STEP + 1 :]
    seen = batch.valid[:, :, CURRENT_STEP + 1 :] & batch.valid.all(-1, keepdim=True)
    assert off.norm(dim=-1)[seen].mean() < 0.3


def test_with_one_candidate_the_most_likely_token_is_taken(vocabulary):
    policy, batch = smart(vocabulary), collate(SCENES)
    rollouts = roll_out_closest(policy, batch, num_candidates=1).rollouts
    with torch.no_grad():
        scored = policy.score(policy.encode(batch), rollouts)
    best = torch.zeros_like(rollouts.decision).masked_scatter(scored.mask, scored.logits.argmax(-1))
    assert torch.equal(best, rollouts.decision)


def test_the_loss_is_zero_where_nothing_is_trained(vocabulary):
    policy, batch = smart(vocabulary), collate(SCENES)
    targeted = roll_out_closest(policy, batch, num_candidates=4)
    none = catk_loss(policy, batch, targeted, torch.zeros_like(batch.agent_mask))
    all_agents = catk_loss(policy, batch, targeted, batch.agent_mask)
    assert none == 0
    assert all_agents > 0
    all_agents.backward()
    assert all(p.grad is None or p.grad.isfinite().all() for p in policy.parameters())

"""Archives of the scenario generation challenge: bytes, what a model may know of a log, and what is refused."""

import re
from dataclasses import replace

import entries
import numpy as np
import pytest

from rlftsim.errors import ConfigError
from rlftsim.evaluation.evaluate import evaluate
from rlftsim.evaluation.results import EvaluateConfig
from rlftsim.evaluation.rollout_states import simulate_states
from rlftsim.evaluation.submission_pb2 import ScenarioRollouts
from rlftsim.geometry import boxes_overlap
from rlftsim.policies.registry import load_policy
from rlftsim.realism import SCENARIO_GEN, SIM_AGENTS
from rlftsim.realism.from_rollouts import logged_states
from rlftsim.rollout.scene_draw import draw_scene
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.submission.build import build_archive
from rlftsim.submission.check import check_archive
from rlftsim.submission.messages import SIZES, count_bytes, decode_rollouts, encode_rollouts

METRIC = "2025-scenario-gen"
AXES = ("center_x", "center_y", "center_z", "heading")


@pytest.fixture(scope="module")
def data(tmp_path_factory):
    return entries.write_data(tmp_path_factory.mktemp("data"), num_scenarios=3)


@pytest.fixture(scope="module")
def archive(data, tmp_path_factory):
    job = entries.make_job(data, tmp_path_factory.mktemp("out"), num_shards=1, metric=METRIC)
    return build_archive(job, show_progress=False)


@pytest.fixture
def shards(data):
    """An archive's messages, to be damaged."""
    shards = {}
    for drawn in data[:2]:
        states = simulate_states(entries.Wanderer(), collate([drawn]), EvaluateConfig(metric=METRIC))
        shards[drawn.scenario_id] = ScenarioRollouts.FromString(
            encode_rollouts(drawn.scenario_id, states, drawn.tracks.object_type[drawn.simulated_indices])
        )
    return shards


def check(data, folder, scenes, challenge=SCENARIO_GEN):
    message = entries.SimAgentsChallengeSubmission.FromString(entries.METADATA)
    for scene in scenes.values():
        message.scenario_rollouts.append(scene)
    path = entries.pack(folder / "a.tar.gz", {"submission.binproto-00000-of-00001": message})
    found = check_archive(path, data, challenge=challenge, show_progress=False).findings
    return [line for line in found.lines() if "check 2:" not in line]


def agents(scenes):
    return [
        agent for scene in scenes.values() for joint in scene.joint_scenes for agent in joint.simulated_trajectories
    ]


def test_bytes_are_those_of_protobuf_and_come_back(data, shards):
    drawn = data[0]
    message = shards[drawn.scenario_id]
    states = simulate_states(entries.Wanderer(), collate([drawn]), EvaluateConfig(metric=METRIC))
    types = drawn.tracks.object_type[drawn.simulated_indices]
    written = encode_rollouts(drawn.scenario_id, states, types)
    assert message.SerializeToString() == written
    agent = message.joint_scenes[3].simulated_trajectories[1]
    np.testing.assert_array_equal(agent.center_x, states.x[3, 1].numpy())
    np.testing.assert_array_equal(agent.length, states.size[3, 1, :, 0].numpy())
    np.testing.assert_array_equal(agent.width, states.size[3, 1, :, 1].numpy())
    assert agent.object_type == types[1]
    assert len(agents({"a": message})) * count_bytes(SCENARIO_GEN) == pytest.approx(len(written), rel=2e-3)
    message.joint_scenes[2].simulated_trajectories.reverse()  # decoded by protobuf's parser
    for stored in (written, message.SerializeToString()):
        decoded = decode_rollouts(stored)
        assert decoded.challenge == SCENARIO_GEN
        np.testing.assert_array_equal(decoded.values[:, :, 2], states.z.numpy())
        for axis, column in zip(SIZES, (1, 0, 2)):
            np.testing.assert_array_equal(decoded.values[:, :, 4 + SIZES.index(axis)], states.size[..., column].numpy())


def test_a_built_archive_has_every_scenario_and_no_finding(data, archive):
    result = check_archive(archive, data, challenge=SCENARIO_GEN, show_progress=False)
    assert result.findings.lines() == []
    assert result.num_scenarios == result.num_checked == len(data)
    (finding, *_) = check_archive(archive, data, challenge=SIM_AGENTS, show_progress=False).findings.lines()
    assert "laid out as for Scenario Generation" in finding
    assert "--challenge scenario-gen" in finding


def cut_to_80_steps(scenes):
    for agent in agents(scenes):
        for name in (*AXES, *SIZES):
            del getattr(agent, name)[80:]


def forget_sizes(scenes):
    for agent in agents(scenes):
        for name in SIZES:
            agent.ClearField(name)


def lose_a_width(scenes):
    agents(scenes)[3].width[7] = float("nan")


def forget_a_type(scenes):
    agents(scenes)[5].ClearField("object_type")


def leave_a_scene_out(scenes):
    del next(iter(scenes.values())).joint_scenes[31]


@pytest.mark.parametrize(
    ("damage", "text"),
    [
        (cut_to_80_steps, r"check 4: .* have \[80, 80, 80, 80\] steps"),
        (forget_sizes, r"check 19: .*width, length and height have \[0, 0, 0\] steps"),
        (lose_a_width, r"check 19: .*width, length or height is no number above 0 in scene 0"),
        (forget_a_type, r"check 19: .*an agent has no object_type"),
        (leave_a_scene_out, r"check 3: .*31 scenes instead of 32"),
    ],
)
def test_a_damage_is_refused_as_what_it_is(damage, text, data, shards, tmp_path):
    assert check(data, tmp_path, shards) == []
    damage(shards)
    lines = check(data, tmp_path, shards)
    assert lines
    assert all(line.startswith("error") for line in lines[:1])
    assert any(re.search(text, line) for line in lines)


def test_an_archive_of_sim_agents_is_none_of_scenes(data, tmp_path):
    drawn = data[0]
    message = ScenarioRollouts.FromString(encode_rollouts(drawn.scenario_id, entries.draw_states(drawn)))
    (line, *_) = check(data, tmp_path, {"a": message})
    assert re.search(
        r"error, check 4: .*laid out as for Sim Agents, Scenario Generation wants 91 steps with sizes", line
    )


def test_logged_history_in_an_entry_is_warned_about(data, shards, tmp_path):
    drawn = data[0]
    states = logged_states(drawn, num_rollouts=32, challenge=SCENARIO_GEN)
    types = drawn.tracks.object_type[drawn.simulated_indices]
    copied = ScenarioRollouts.FromString(encode_rollouts(drawn.scenario_id, states, types))
    lines = check(data, tmp_path, shards | {drawn.scenario_id: copied})
    count = len(types) - 1
    assert any("warning, check 20" in line and f"{count} of {count} agents repeat" in line for line in lines)


def test_a_draw_reads_nothing_of_the_other_agents_but_their_number_and_types(data):
    scenario = ScenarioDataset("synthetic", "validation")[0]
    tracks = scenario.tracks
    others = np.arange(len(tracks.object_id)) != scenario.ego_index
    shift = np.where(others, 500.0, 0.0).astype(np.float32)
    foreign = replace(
        scenario,
        tracks=replace(
            tracks,
            position=tracks.position + shift[:, None, None],
            velocity=tracks.velocity + shift[:, None, None],
            heading=tracks.heading + shift[:, None],
            size=tracks.size + shift[:, None, None],
        ),
    )
    first, second = (draw_scene(s, 4, seed=1).tracks for s in (scenario, foreign))
    for name in ("position", "heading", "velocity", "size"):
        np.testing.assert_array_equal(getattr(first, name), getattr(second, name))
    assert first.object_type.tolist() == tracks.object_type[scenario.simulated_indices].tolist()
    # the ego has its own past, the others stand on the ground, and few boxes overlap
    ego = int(np.searchsorted(scenario.simulated_indices, scenario.ego_index))
    np.testing.assert_allclose(first.position[ego], tracks.position[scenario.ego_index, :11], atol=1e-4)
    now, angle, size = first.position[:, 10, :2], first.heading[:, 10], first.size[:, 10]
    hits = [boxes_overlap(now - now[a], angle[a : a + 1], angle, size[a], size).sum() - 1 for a in range(len(now))]
    assert sum(hits) <= 0.1 * len(now)
    assert len({draw_scene(scenario, n, seed=1).tracks.position[:, 10].tobytes() for n in range(3)}) == 3


def test_an_evaluation_scores_scenes_and_takes_no_goals(tmp_path):
    config = EvaluateConfig(num_rollouts=2, limit=2, metric=METRIC)
    drawn, log = (evaluate(p, "synthetic", None, config, show_progress=False) for p in (entries.Wanderer(), "oracle"))
    assert drawn.table["num_evaluated"].equals(drawn.table["num_agents"])
    assert (drawn["average_displacement_error"] == 0).all()
    assert np.isnan(drawn["miss_rate"]).all()
    assert (log["meta_metric"] > drawn["meta_metric"]).all()
    with pytest.raises(ConfigError, match="drawn agents, which have no logged goals"):
        evaluate(load_policy("demo-goals"), "synthetic", None, replace(config, goals="logged"), show_progress=False)

"""Every route of the studio, and the refusals of each."""

import json
import re
import shlex
from pathlib import Path

import httpx
import jaxtyping
import numpy as np
import pytest

import rlftsim as rs
from rlftsim.cli.main import main
from rlftsim.errors import ConfigError
from rlftsim.evaluation.rollout_files import find_rollouts, read_states
from rlftsim.goals.goals_file import GoalEntry, read_goals
from rlftsim.goals.placement import goal_warnings
from rlftsim.rollout.types import write_rollouts
from rlftsim.scenario.batch import collate
from rlftsim.studio.encoding import MAGIC, encode_poses
from rlftsim.studio.runs import Worker, split_rollouts
from rlftsim.studio.server import create_app
from rlftsim.studio.session import Session

SCENARIO = "9d639de83d6f5239"
EGO = 179
RUN = {"split": "validation", "scenario": SCENARIO, "models": ["goals"], "num_rollouts": 5, "seed": 3}
GOAL = {"agent": EGO, "x": -36.715, "y": -2.361, "label": "left"}


@pytest.fixture(scope="module")
def scenario():
    return rs.load_dataset("synthetic", "validation")[SCENARIO]


def decoded(content, current):
    """Poses of a chunk: both sums, in meters and radians."""
    magic, n, a, t, size = np.frombuffer(content, "<u4", 5)
    assert magic == MAGIC
    second = np.frombuffer(content, f"<i{size}", offset=20).reshape(n, a, 3, t).astype(np.int64)
    return (second.cumsum(-1).cumsum(-1) + np.rint(100 * current)[None, :, :, None]).swapaxes(2, 3) / 100


def test_the_session_names_models_and_what_they_can_do(client):
    found = client.get("/api/session").json()
    assert [(m["name"], m["takes_goals"], m["can_guide"]) for m in found["models"]] == [
        ("demo-base", False, False), ("goals", True, True)
    ]  # fmt: skip
    assert "not goal-conditioned" in found["models"][0]["note"]
    counts = {"testing": 40, "training": 160, "validation": 40}
    assert {one["name"]: one["scenarios"] for one in found["splits"]} == counts


def test_a_query_filters_the_index_and_names_a_wrong_column(client):
    index = rs.load_dataset("synthetic", "validation").index.to_pylist()
    expected = [r["scenario_id"] for r in index if r["ego_maneuver"] == "left" and r["num_pedestrians"] > 2]
    rows = client.get("/api/scenarios", params={"split": "validation", "query": "ego_turn=left n_ped>2"}).json()
    assert [row["scenario_id"] for row in rows["rows"]] == expected
    assert rows["total"] == len(expected) > 0
    wrong = client.get("/api/scenarios", params={"split": "validation", "query": "peds>2"})
    assert wrong.status_code == 422
    assert "n_ped" in wrong.json()["hint"]


def test_a_page_of_the_index_has_at_most_200_rows_and_starts_where_it_is_told(client):
    rows = client.get("/api/scenarios", params={"split": "training", "offset": 150}).json()
    assert (rows["total"], len(rows["rows"])) == (160, 10)


def test_a_scene_has_the_agents_of_the_scenario(client, scenario):
    found = client.get(f"/api/scenario/validation/{SCENARIO}").json()
    assert [agent[0] for agent in found["scene"]["agents"]] == scenario.tracks.object_id[
        scenario.simulated_indices
    ].tolist()
    assert found["has_future"]
    assert client.get("/api/scenario/validation/none").status_code == 404


def test_proposals_are_those_of_the_command_line(client, scenario, capsys):
    found = client.get(f"/api/proposals/validation/{SCENARIO}/{EGO}").json()
    assert main(["goals", "propose", "synthetic", "--scenario", SCENARIO, "--agent", str(EGO)]) == 0
    printed = capsys.readouterr().out
    assert found["proposals"]
    for proposal in found["proposals"]:
        assert proposal["label"] in printed
    points = [float(number) for pair in re.findall(r"(-?[\d.]+),(-?[\d.]+)", printed) for number in pair]
    assert points == pytest.approx([p[axis] for p in found["proposals"] for axis in "xy"], abs=0.0051)
    assert client.get(f"/api/proposals/validation/{SCENARIO}/99999").status_code == 422


def test_goals_are_doubted_and_refused_in_the_words_of_the_command_line(client, scenario):
    goals = [{"agent": EGO, "x": 200.0, "y": 0.0}, {"agent": 1, "x": 0, "y": 0}, {"agent": 2, "x": 9000, "y": 0}]
    ids = scenario.tracks.object_id[scenario.simulated_indices]
    goals[1]["agent"], goals[2]["agent"] = int(ids[0]), int(ids[1])
    found = client.post("/api/goals/check", {"split": "validation", "scenario": SCENARIO, "goals": goals}).json()[
        "goals"
    ]
    assert found[0]["doubts"] == list(goal_warnings(GoalEntry(SCENARIO, EGO, 200.0, 0.0), scenario)) != []
    assert "out of reach" in found[2]["refused"]


def test_chunks_are_four_four_eight_sixteen_then_thirty_two():
    assert [len(ids) for ids in split_rollouts(128)] == [4, 4, 8, 16, 32, 32, 32]
    assert [len(ids) for ids in split_rollouts(10)] == [4, 4, 2]


def test_poses_survive_the_encoding_to_half_a_centimeter():
    rng = np.random.default_rng(0)
    current = rng.uniform(-900, 900, (3, 3))
    poses = current[None, :, None] + rng.normal(0, 0.5, (2, 3, 80, 3)).cumsum(2)
    assert np.abs(decoded(encode_poses(poses, current), current)[..., :2] - poses[..., :2]).max() <= 0.0051
    far = poses.copy()
    far[0, 0, 40:] += 4000  # more than two bytes hold
    assert np.abs(decoded(encode_poses(far, current), current)[..., :2] - far[..., :2]).max() <= 0.0051


@pytest.fixture(scope="module")
def simulated(session, tmp_path_factory, goal_model):
    """What the command line writes for the same settings."""
    out = tmp_path_factory.mktemp("cli")
    words = f"simulate {shlex.quote(str(goal_model))} --data synthetic --split validation --scenario {SCENARIO}"
    words += (
        f" --num-rollouts 5 --seed 3 --goal {EGO}={GOAL['x']},{GOAL['y']} --device cpu --out {shlex.quote(str(out))}"
    )
    assert main(shlex.split(words)) == 0
    return out


def test_a_run_gives_the_rollouts_outcomes_and_score_of_command_line_and_python(
    client, session, simulated, goal_model, scenario
):
    state = client.finished(**RUN, goals=[GOAL])
    assert state["variants"] == [
        {"model": "goals", "goals": 1, "guidance": 1.0},
        {"model": "goals", "goals": 0, "guidance": 1.0},
    ]
    assert [event["event"] for event in state["events"]][-1] == "done"
    assert [event["id"] for event in state["events"]] == list(range(len(state["events"])))
    # rollouts: npz of the export and of the command line are the same numbers
    body = {"kind": "rollouts", "name": "mine", "run": state["run"]}
    path = client.post("/api/export", body).json()["path"]
    with np.load(path) as ours, np.load(simulated / f"{SCENARIO}.npz") as theirs:
        assert all(np.array_equal(ours[name], theirs[name]) for name in theirs.files)
    # score: that of the public functions
    rollouts = rs.simulate(
        rs.load_policy(goal_model), scenario, num_rollouts=5, seed=3, goals={EGO: (GOAL["x"], GOAL["y"])}
    )
    (official,) = rs.score(scenario, rollouts).to_official_fields()
    scores = client.get(f"/api/runs/{state['run']}/score").json()["variants"]
    assert scores[0]["score"]["official"]["metametric"] == official["metametric"]
    assert scores[0]["outcomes"][0]["agent"] == EGO
    assert scores[0]["change"]["mean"] == pytest.approx(
        scores[0]["score"]["official"]["metametric"] - scores[1]["score"]["official"]["metametric"], abs=1e-6
    )
    # the chunk that the page draws
    chunk = client.get(f"/api/runs/{state['run']}/chunk/0").content
    log = np.concatenate(
        [np.zeros((len(scenario.simulated_indices), 2)), np.zeros((len(scenario.simulated_indices), 1))], 1
    )
    chosen = scenario.simulated_indices
    log[:, :2] = scenario.tracks.position[chosen, 10, :2] - scenario.origin
    log[:, 2] = scenario.tracks.heading[chosen, 10]
    assert np.abs(decoded(chunk, log)[..., :2] - rollouts.position[0, :4].numpy()).max() < 0.0051
    # losses by feature, agent and step add up to what is lost
    explained = client.get(f"/api/runs/{state['run']}/explain").json()
    assert np.sum(explained["cost"]) == pytest.approx(scores[0]["score"]["lost"], abs=2e-3)


def test_the_same_run_again_costs_nothing_and_a_larger_one_keeps_its_chunks(client, worker):
    first = client.finished(**RUN | {"models": ["demo-base"], "num_rollouts": 4})
    assert client.post("/api/runs", RUN | {"models": ["demo-base"], "num_rollouts": 4}).json()["run"] == first["run"]
    larger = client.finished(**RUN | {"models": ["demo-base"]})
    kept = [event["data"]["k"] for event in larger["events"] if event["event"] == "progress"]
    assert set(kept) == {1}  # chunk 0 was there already


def test_a_longer_run_begins_with_the_usual_one_and_has_no_score(client, scenario):
    tracks, rows = scenario.tracks, scenario.simulated_indices
    current = np.concatenate(
        [tracks.position[rows, 10, :2] - scenario.origin, tracks.heading[rows, 10, None]], -1
    )  # fmt: skip
    poses = []
    for seconds in (8, 12):
        state = client.finished(**RUN | {"models": ["demo-base"], "num_rollouts": 2, "seconds": seconds})
        assert {e["data"]["steps"] for e in state["events"] if e["event"] == "chunk"} == {10 * seconds}
        poses.append(decoded(client.get(f"/api/runs/{state['run']}/chunk/0").content, current))
    assert poses[1].shape[2] == 120
    np.testing.assert_array_equal(poses[1][:, :, :80], poses[0])
    (variant,) = client.get(f"/api/runs/{state['run']}/score").json()["variants"]
    assert (variant["score"], variant["events"], variant["outcomes"]) == (None, [], [])
    assert "the metric compares 80 steps, these rollouts have 120" in variant["reason"]
    written = client.post("/api/export", {"kind": "rollouts", "name": "minute", "run": state["run"]})
    assert np.load(written.json()["path"])["x"].shape[2] == 120
    refused = client.post("/api/export", {"kind": "submission", "name": "minute", "run": state["run"]})
    assert "a submission has 8 seconds" in refused.json()["error"]


def test_events_stream_with_ids_and_resume_behind_the_last_one(client):
    state = client.finished(**RUN | {"models": ["demo-base"], "num_rollouts": 4})
    whole = client.get(f"/api/runs/{state['run']}/events").text
    assert whole.startswith("id: 0\nevent: progress\ndata: ")
    assert whole.count("event: done") == 1
    last = len(state["events"]) - 1
    rest = client.get(f"/api/runs/{state['run']}/events", {"last-event-id": str(last - 1)}).text
    assert rest == f"id: {last}\nevent: done\ndata: {{}}\n\n"
    assert client.get(f"/api/runs/{state['run']}/events", {"last-event-id": "9" * 5000}).text == whole


def test_a_cancelled_run_says_so_and_a_newer_run_takes_its_place(client, worker):
    long = client.post("/api/runs", RUN | {"num_rollouts": 128, "seed": 8}).json()["run"]
    assert client.post(f"/api/runs/{long}/cancel").status_code == 200
    state = client.finished(**RUN | {"models": ["demo-base"], "num_rollouts": 4})
    assert state["events"][-1]["event"] == "done"
    events = client.get(f"/api/runs/{long}").json()["events"]
    assert (events[-1]["event"], events[-1]["data"]["message"]) == ("failed", "cancelled.")
    assert client.request("DELETE", f"/api/runs/{long}").status_code == 200
    assert client.get(f"/api/runs/{long}").status_code == 404


def test_a_run_that_another_page_replaces_says_so(client, worker):
    running, waiting = (
        client.post("/api/runs", RUN | {"num_rollouts": 128, "seed": seed}).json()["run"] for seed in (21, 22)
    )
    client.finished(**RUN | {"models": ["demo-base"], "num_rollouts": 2})
    for name in (running, waiting):
        last = client.get(f"/api/runs/{name}").json()["events"][-1]
        assert (last["event"], last["data"]["message"]) == ("failed", "replaced by a newer run.")


def test_an_observer_that_raises_ends_a_simulation(scenario):
    from rlftsim.rollout.simulate import simulate
    from rlftsim.scenario.batch import collate

    seen = []

    class EnoughError(Exception):
        pass

    def observe(poses):
        seen.append(tuple(poses.shape[1:4:2]))
        if len(seen) == 3:
            raise EnoughError

    with pytest.raises(EnoughError):
        simulate(rs.load_policy("demo-base"), collate([scenario]), num_rollouts=2, seed=0, observe=observe)
    assert seen == [(2, 5), (2, 10), (2, 15)]


@pytest.mark.parametrize(
    ("change", "status", "words"),
    [
        ({"models": ["demo-base"], "goals": [GOAL]}, 422, "not goal-conditioned"),
        ({"models": ["/etc/passwd"]}, 404, "no model '/etc/passwd'"),
        ({"models": []}, 422, "models"),
        ({"scenario": "none"}, 404, "no scenario none"),
        ({"num_rollouts": 129}, 422, "num_rollouts"),
        ({"goals": [GOAL, GOAL]}, 422, "two goals"),
        ({"goals": [GOAL | {"agent": 99999}]}, 422, "no agent 99999"),
        ({"goals": [GOAL | {"x": 9000}]}, 422, "out of reach"),
        ({"goals": [GOAL] * 129}, 422, "goals"),
        ({"guidance": 7}, 422, "guidance"),
        ({"goals": [GOAL], "seconds": 12}, 422, "goals are due after 8 seconds, not after 12"),
        ({"seconds": 61}, 422, "seconds"),
        ({"metric": "2031"}, 422, "metric"),
        ({"path": "x"}, 422, "path"),
    ],
)
def test_runs_that_make_no_sense_are_refused_with_a_sentence(client, change, status, words):
    answer = client.post("/api/runs", RUN | change)
    assert answer.status_code == status
    assert set(answer.json()) == {"error", "hint"}
    assert words in answer.json()["error"]


def test_a_goal_that_is_no_number_is_refused(client):
    text = json.dumps(RUN | {"goals": [GOAL | {"x": float("nan")}]})
    assert client.request("POST", "/api/runs", content=text).status_code == 422


def test_goals_are_saved_as_the_command_line_checks_them_with_scenarios_that_are_not_there(client, session, capsys):
    others = [{"scenario": f"other{i}", "agent": i, "x": 1.0, "y": 2.0} for i in range(99)]
    text = json.dumps({"format": "rlftsim-goals-1", "goals": [{"scenario": SCENARIO, **GOAL}, *others]})
    opened = client.post("/api/goals/open", {"text": text, "name": "many.json"}).json()
    assert len(opened["goals"]) == 100
    saved = client.post(
        "/api/goals/save", {"name": "many", "text": json.dumps({"format": "rlftsim-goals-1", **opened})}
    )
    assert len(read_goals(session.out / "many.json").scenario_ids) == 100, saved.text
    own = json.dumps({"format": "rlftsim-goals-1", "goals": [{"scenario": SCENARIO, **GOAL}]})
    assert client.post("/api/goals/save", {"name": "own", "text": own}).status_code == 200
    assert main(["goals", "check", str(session.out / "own.json"), "--data", "synthetic"]) == 0
    assert client.post("/api/goals/save", {"name": "own", "text": own}).status_code == 409
    assert client.post("/api/goals/save", {"name": "own", "text": own, "replace": True}).status_code == 200
    wrong = client.post("/api/goals/save", {"name": "wrong", "text": own.replace('"x"', '"z"')})
    assert (wrong.status_code, (session.out / "wrong.json").exists()) == (422, False)
    assert "no field 'z'" in wrong.json()["error"]


def test_exports_can_be_read_by_what_reads_them(client, session):
    state = client.finished(**RUN | {"models": ["demo-base"], "num_rollouts": 4})
    paths = {}
    for kind in ("submission", "scores", "page"):
        answer = client.post("/api/export", {"kind": kind, "name": "all", "run": state["run"]})
        assert answer.status_code == 200, answer.text
        paths[kind] = answer.json()["path"]
    (entry,) = find_rollouts(paths["submission"])
    assert (entry.scenario_id, read_states(entry).num_rollouts) == (SCENARIO, 4)
    with open(paths["scores"]) as file:
        assert json.load(file)["score"]["official"]["scenario_id"] == SCENARIO
    with open(paths["page"]) as file:
        assert "<canvas" in file.read()
    pending = client.post("/api/export", {"kind": "scores", "name": "none", "run": "none"})
    assert pending.status_code == 404


GOALS_TEXT = '{"format": "rlftsim-goals-1", "goals": []}'


def test_exports_that_cannot_be_written_are_refused_with_a_sentence(client, session, worker, tmp_path, monkeypatch):
    state = client.finished(**RUN | {"models": ["demo-base"], "num_rollouts": 2})
    (tmp_path / "file").touch()

    def refusal(path, **body):
        answer = client.post(path, body)
        return answer.status_code, answer.json()["error"]

    monkeypatch.setattr(session, "out", tmp_path / "file" / "below")
    status, sentence = refusal("/api/goals/save", name="own", text=GOALS_TEXT)
    assert (status, f"{tmp_path / 'file'} is a file" in sentence) == (422, True)
    monkeypatch.setattr(session, "out", tmp_path)
    # a folder of rollouts in place of a file, and a rollout that the run does not have
    status, sentence = refusal("/api/export", kind="rollouts", name="file", run=state["run"], replace=True)
    assert (status, f"{tmp_path / 'file'} is a file" in sentence) == (422, True)
    for kind in ("film-mp4", "page"):
        status, sentence = refusal("/api/export", kind=kind, name="far", run=state["run"], rollout=2)
        assert (status, sentence) == (422, "no rollout 3: this run has 2.")
    assert [path.name for path in tmp_path.iterdir()] == ["file"]


def test_rollouts_that_are_complete_but_not_scored_have_no_scores_to_export(client, worker):
    scored = client.finished(**RUN | {"models": ["demo-base"], "num_rollouts": 2})
    # another metric finds the rollouts there; until the worker comes to it, there is no score
    worker.stop()
    run = client.post("/api/runs", RUN | {"models": ["demo-base"], "num_rollouts": 2, "metric": "2024"}).json()["run"]
    assert run != scored["run"]
    answer = client.post("/api/export", {"kind": "scores", "name": "early", "run": run})
    assert (answer.status_code, "not scored yet" in answer.json()["error"]) == (409, True)
    assert client.get(f"/api/runs/{run}/explain").status_code == 409


def test_an_error_of_the_program_has_the_shape_of_all_errors(client, worker, monkeypatch):
    monkeypatch.setattr(worker, "submit", lambda body: 1 / 0)
    answer = client.post("/api/runs", RUN)
    expected = {"error": "ZeroDivisionError: division by zero; the terminal shows more.", "hint": ""}
    assert (answer.status_code, answer.json()) == (500, expected)


def test_rollouts_of_files_are_shown_and_scored_like_simulated_ones(tmp_path, access, client, scenario):
    rollouts = rs.simulate("constant_velocity", scenario, num_rollouts=3)
    write_rollouts(tmp_path / "still", collate([scenario]), rollouts)
    session = Session("synthetic", ("demo-base",), None, tmp_path / "out", rollouts=(str(tmp_path / "still"),))
    working = Worker(session)
    files = type(client)(create_app(session, working, access), access)
    working.close()
    assert files.get("/api/session").json()["imported"] == [{"name": "still", "scenarios": 1}]
    place = f"/api/imported/still/validation/{SCENARIO}"
    (entry,) = find_rollouts(tmp_path / "still")
    states = read_states(entry)
    tracks, chosen = scenario.tracks, scenario.simulated_indices
    assert states.object_id.tolist() == tracks.object_id[chosen].tolist()
    current = np.concatenate([tracks.position[chosen, 10, :2] - scenario.origin, tracks.heading[chosen, 10, None]], -1)
    shown = decoded(files.get(place).content, current)  # [N, A, 80, 3]
    assert np.abs(shown[..., 0] - (states.x.numpy() - scenario.origin[0])).max() < 0.011
    score = files.get(f"{place}/score").json()
    expected = rs.score(scenario, rollouts)
    assert score["score"]["official"]["metametric"] == pytest.approx(float(expected.meta_metric), abs=1e-6)
    assert np.shape(score["explained"]["cost"])[1] == len(score["explained"]["agents"])
    other = files.get("/api/imported/still/validation/1870d99f95300e18")
    assert (other.status_code, other.json()["error"]) == (404, "still has no rollouts of scenario 1870d99f95300e18.")
    assert client.get(place).status_code == 404  # this studio was started without them


@pytest.mark.parametrize("models", ["constant_velocity", Path("constant_velocity"), ["constant_velocity"]])
def test_one_model_need_not_be_a_list(models, tmp_path):
    cell = rs.open_studio(models=models, out=tmp_path)
    headers = {"Authorization": f"Bearer {cell.studio.access.token}"}
    about = httpx.get(f"http://127.0.0.1:{cell.studio.port}/api/session", headers=headers).json()
    cell.stop()
    assert [model["name"] for model in about["models"]] == ["constant_velocity"]


@pytest.mark.parametrize("models", [rs.ConstantVelocity(), [rs.ConstantVelocity()], None])
def test_a_policy_in_place_of_its_name_is_refused_in_one_line(models):
    jaxtyping.config.update("jaxtyping_disable", True)  # as users call it, without the type checks of the test run
    try:
        with pytest.raises(ConfigError, match=r"^models must be names or folders, got .*\.$"):
            rs.open_studio(models=models)
    finally:
        jaxtyping.config.update("jaxtyping_disable", False)


def test_a_split_without_its_future_says_why_there_is_no_score(tmp_path, scenario):
    from dataclasses import replace

    from rlftsim.studio.scoring import score_variant

    tracks = replace(
        scenario.tracks,
        **{
            name: getattr(scenario.tracks, name)[:, :11]
            for name in ("position", "heading", "velocity", "size", "valid")
        },
    )
    short = replace(scenario, tracks=tracks, timestamps_s=scenario.timestamps_s[:11])
    rollouts = rs.simulate("constant_velocity", short, num_rollouts=2)
    payload = score_variant(short, rollouts, (GoalEntry(SCENARIO, EGO, 0.0, 0.0),), "2025").to_payload()
    assert payload["score"] is None
    assert "withholds the logged future" in payload["reason"]
    assert payload["outcomes"][0]["median_m"] > 0

"""Goals written by hand: read, edited, refused with the file, the entry and the field."""

import json
import re
from dataclasses import replace

import pytest
import torch

import scenes
from rlftsim.errors import DataError
from rlftsim.goals.goals_file import FORMAT, GoalEntry, GoalsFile, parse_goal, read_goals, write_goals
from rlftsim.goals.placement import goal_warnings, goals_of_batch
from rlftsim.scenario.batch import collate

GOOD = {"scenario": "straight", "agent": 100, "x": 1040.0, "y": -200.0, "label": "straight"}
"""Agent 100 is the ego of `scenes`, at (1000, -200); 103 is a pedestrian, 105 a parked car."""


def written(tmp_path, *entries, **about):
    path = tmp_path / "goals.json"
    path.write_text(json.dumps({"format": FORMAT, "goals": list(entries), **about}))
    return path


def test_what_is_written_is_read(tmp_path):
    file = GoalsFile(
        (GoalEntry("a", 7, 1034.125, -188.0, "left"), GoalEntry("b", 9, 0.0, 1e3)),
        (GoalEntry("a", 7, 3.0, 4.0, "right"),),
    )
    write_goals(tmp_path / "goals.json", file)
    assert read_goals(tmp_path / "goals.json") == file
    assert len((tmp_path / "goals.json").read_text().splitlines()) == 10  # an entry a line: easy to move and to edit
    assert file.scenario_ids == ("a", "b")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        ({"x": float("nan")}, r"goals\[1\]: x is nan: a goal needs a finite point"),
        ({"y": float("inf")}, r"goals\[1\]: y is inf"),
        ({"x": "12"}, r"goals\[1\]: x must be a number of meters, is text"),
        ({"y": True}, r"goals\[1\]: y must be a number of meters, is true or false"),
        ({"agent": "100"}, r"goals\[1\]: agent must be a whole number"),
        ({"agent": 1.5}, r"goals\[1\]: agent must be a whole number"),
        ({"agent": True}, r"goals\[1\]: agent must be a whole number"),
        ({"agent": None}, r"goals\[1\]: agent must be a whole number, an object id of the log, is null"),
        ({"scenario": 5}, r"goals\[1\]: scenario must be text in quotes, is a number"),
        ({"label": 5}, r"goals\[1\]: label must be text"),
        ({"lable": "x"}, r"goals\[1\]: no field 'lable' here: did you mean 'label'"),
        ({"label": "\ud800"}, r"half a character, U\+D800, in a text: goals are a list"),
        ({"label": "a\x1b[31m"}, r"goals\[1\]: label has a control character, U\+001B"),
        ({"x": 10**400}, "a whole number of 401 digits"),
        ({"agent": 2**63}, r"goals\[1\]: agent 9223372036854775808 is no object id, which have 64 bits"),
        ({"agent": 100}, r"goals\[1\]: agent 100 of scenario straight has a goal already \(.*goals\[0\]\)"),
    ],
)
def test_a_wrong_entry_is_named(change, message, tmp_path):
    path = written(tmp_path, GOOD, {**GOOD, "agent": 101, **change})
    with pytest.raises(DataError, match=message) as caught:
        read_goals(path)
    assert str(path) in str(caught.value)


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("{", "not JSON, line 1, column 2"),
        ("[]", "not a goals file of this version"),
        ('{"format": "other"}', "not a goals file of this version"),
        (f'{{"format": "{FORMAT}", "goals": {{}}}}', "goals: must be a list of goals, is an object"),
        (f'{{"format": "{FORMAT}", "goals": [5]}}', r"goals\[0\]: must be an object such as"),
        (f'{{"format": "{FORMAT}", "goals": [{{"x": 1}}]}}', r"goals\[0\]: scenario, agent, y missing"),
        (
            f'{{"format": "{FORMAT}", "goals": [{{"scenario": "s", "agent": 1, "x": {"1" * 5000}, "y": 1}}]}}',
            "a whole number of 5000 digits",
        ),
        (
            f'{{"format": "{FORMAT}", "goals": [{{"scenario": "s", "agent": 1, "x": 1, "x": 2, "y": 1}}]}}',
            "'x' is written more than once",
        ),
        (
            f'{{"format": "{FORMAT}", "goals": [], "goals": []}}',
            "json: 'goals' is written more than once: goals are a list",
        ),
        (f'{{"format": "{FORMAT}", "goals": {"[" * 200_000}', "brackets nested more than 64 deep"),
        (f'{{"format": "{FORMAT}", "goal": []}}', "no field 'goal' here: did you mean 'goals'"),
    ],
)  # fmt: skip
def test_a_wrong_file_is_refused(text, message, tmp_path):
    (tmp_path / "goals.json").write_text(text)
    with pytest.raises(DataError, match=message):
        read_goals(tmp_path / "goals.json")


def test_a_byte_order_mark_is_no_mistake(tmp_path):
    path = written(tmp_path, GOOD)
    path.write_text(path.read_text(), encoding="utf-8-sig")
    assert len(read_goals(path).goals) == 1


def test_a_file_that_is_not_there_says_how_to_make_one(tmp_path):
    with pytest.raises(DataError, match="no such goals file: make one with `rlftsim goals propose`"):
        read_goals(tmp_path / "goals.json")
    (tmp_path / "goals.json").write_bytes(b"\xff\xfe\x00")
    with pytest.raises(DataError, match="not text in UTF-8"):
        read_goals(tmp_path / "goals.json")


def test_a_goal_of_the_command_line():
    assert parse_goal("12=1034.5,-188", "s") == GoalEntry("s", 12, 1034.5, -188.0)
    for wrong in ("12", "12=5", "a=1,2", "12=1;2", "=1,2", ""):
        with pytest.raises(DataError, match=r"not AGENT=X,Y: write for example"):
            parse_goal(wrong, "s")
    with pytest.raises(DataError, match="x is nan"):
        parse_goal("12=nan,2", "s")


# ---- in a scenario -------------------------------------------------------------------------------


def test_goals_are_placed_in_the_frame_of_the_batch():
    batch = collate([scenes.straight_road(), scenes.straight_road("other")])
    goals = goals_of_batch([GoalEntry("other", 101, 1017.0, -190.0), GoalEntry("elsewhere", 1, 0.0, 0.0)], batch)
    assert goals.goal_mask.nonzero().tolist() == [[1, 0, 1]]
    torch.testing.assert_close(
        goals.position[1, 0, 1], torch.tensor([17.0, 10.0])
    )  # the map frame is centered on the ego


def entry(agent=100, x=1040.0, y=-200.0):
    return GoalEntry("straight", agent, x, y, location="goals.json: goals[3]")


def test_impossible_goals_are_refused():
    scenario = scenes.straight_road()
    with pytest.raises(
        DataError, match=r"goals\[3\]: scenario straight has no agent 7: it simulates 6 agents: 100, 101"
    ):
        goal_warnings(entry(7), scenario)
    with pytest.raises(
        DataError,
        match=r"goals\[3\]: \(6000.0, -200.0\) is 5000 m from agent 100 at \(1000.0, -200.0\), out of reach in 8 s",
    ):
        goal_warnings(entry(x=6000.0), scenario)
    with pytest.raises(DataError, match="agent 105 is not there at the current step"):
        goal_warnings(entry(105), scenes.with_gaps())


@pytest.mark.parametrize(
    ("agent", "x", "message"),
    [
        (103, 1060.0, r"pedestrian, 1.3 m/s\) would need 6.\d m/s on average"),
        (105, 1020.0, r"stands still, perhaps parked, and its goal is 30 m away"),
        (100, 1001.0, "is within 2 m of its goal already"),
        (100, 1250.0, "will most likely stop short of it"),
    ],
)
def test_doubtful_goals_get_a_warning(agent, x, message):
    (line,) = goal_warnings(entry(agent, x), scenes.straight_road())
    assert line.startswith("goals.json: goals[3]: ")
    assert re.search(message, line)


def test_a_goal_within_reach_gets_no_warning():
    assert goal_warnings(entry(), scenes.straight_road()) == ()
    parked = replace(entry(105), x=1300.0)
    assert len(goal_warnings(parked, scenes.straight_road())) == 2  # stands still, and would have to race

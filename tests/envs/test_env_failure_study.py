"""Failures over many scenarios: the budget's shares, resuming to the same bytes, the page, and the command line."""

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from rlftsim.cli.main import main
from rlftsim.envs import failure_page
from rlftsim.envs.failure_page import brake, build_exhibit
from rlftsim.envs.failure_study import (
    NUMBERS_PER_ROUND,
    Pilot,
    ScenarioEstimate,
    Study,
    StudyConfig,
    parse_budget,
    read_failure,
    share_budget,
)
from rlftsim.envs.failures import Repeat
from rlftsim.errors import ConfigError, DataError

UNLUCKY = """
class Unlucky:
    def reset(self, info):
        self.is_first = info["scenario"] == "{scenario_id}"

    def seed(self, number):
        self.number = number

    def act(self, observation):
        if self.is_first and self.number >= {first_number}:
            raise IndexError("no lane")
        return [0.0, 0.0]
"""
# a planner that does not look, in traffic that stops: it fails soon, and often
LINE = ["failures", "constant_velocity", "--data", "synthetic", "--limit", "2", "--particles", "2", "--budget", "8000"]


def pilot(danger, name="a"):
    return Pilot(name, tuple(danger), 80.0, 80 * len(danger))


def estimate(*probabilities, name="a"):
    repeats = tuple(Repeat(probability, 1, 1000, ()) for probability in probabilities)
    return ScenarioEstimate(repeats, 16, pilot([-1.0] * 4, name))


def test_a_budget_is_a_duration_of_a_core_or_a_number_of_steps():
    assert [parse_budget(text) for text in ("10m", "90s", "1.5h", "5000")] == [360000, 54000, 3240000, 5000]
    for text in ("0m", "ten", "-5m", "10 min"):
        with pytest.raises(ConfigError, match="write a duration"):
            parse_budget(text)


def test_the_budget_goes_where_failures_are_likely_and_every_scenario_has_a_round():
    pilots = [pilot([-9.0, -8.0, -5.0, -4.0]), pilot([-3.0, -1.0, -0.5, 0.0]), pilot([-np.inf] * 4)]
    plan = share_budget(pilots, 16, 200_000)
    counts = [count for count, _ in plan]
    assert min(counts) >= 1
    assert counts[1] == max(counts) > 5 * counts[0]
    assert [branches for _, branches in plan] == [True, True, False]
    assert [branches for _, branches in share_budget(pilots, 16, 30_000)] == [False, True, False]
    with pytest.raises(ConfigError, match=r"too small for 4 repeats in each of 3 scenarios: give --budget .*m or more"):
        share_budget(pilots, 16, 5000)


@pytest.mark.parametrize(
    ("settings", "message"),
    [
        ({"limit": 0}, "limit must be"),
        ({"scenarios": ("a", "b", "a")}, "names one twice"),
        ({"event": "rain"}, "known are at_fault_collision"),
    ],
)
def test_settings_that_make_no_study_are_refused(settings, message):
    with pytest.raises(ConfigError, match=message):
        StudyConfig("idm", **settings)


def test_the_total_is_a_stratified_mean():
    scenarios = (estimate(0.1, 0.2, 0.3), estimate(0.0, 0.0), estimate(0.01, 0.03))
    mean, low, high = Study(StudyConfig("idm"), scenarios, {}).mean_interval()
    assert mean == pytest.approx((0.2 + 0.0 + 0.02) / 3)
    assert 0 < low < mean < high <= 1
    # a third of the scenarios had no event in 32 undisturbed episodes: 9 % of theirs may have one
    eventful = Study(StudyConfig("idm"), scenarios[::2], {}).mean_interval()
    assert low == pytest.approx(eventful[1] * 2 / 3)
    assert high == pytest.approx(eventful[2] * 2 / 3 + (1 - 0.05 ** (1 / 32)) / 3)
    assert Study(StudyConfig("idm"), (estimate(0.0, 0.0), estimate(0.0)), {}).mean_interval()[2] == pytest.approx(
        1 - 0.05 ** (1 / 32)
    )
    assert math.isnan(Study(StudyConfig("idm"), (estimate(0.1), estimate(0.2, 0.3)), {}).mean_interval()[1])


def test_the_total_of_a_planner_that_stands_still_has_no_rate_by_distance():
    standing = replace(estimate(0.0, 0.0), pilot=replace(pilot([-1.0] * 4), driven_m=0.0))
    text = Study(StudyConfig("idm"), (standing,), {}).describe_total()
    assert text.endswith(" of idm: no rate per 1 000 km, as the planner stands still, fewer than 40.2 per hour")


def test_a_planner_that_fails_after_the_pilot_loses_the_scenario_and_no_other(tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    first, second = StudyConfig("idm", limit=2).scenario_ids()
    Path("unlucky.py").write_text(UNLUCKY.format(scenario_id=first, first_number=NUMBERS_PER_ROUND))
    assert main(["failures", "unlucky:Unlucky", *LINE[2:], "--out", "failures", "--films", "0"]) == 0
    printed = capsys.readouterr().out
    assert f"left out: planner Unlucky fails at step 0 of scenario {first}: IndexError: no lane" in printed
    assert second in printed
    assert "per 1 000 km" in printed


def test_a_smaller_study_never_replaces_a_larger_result(tmp_path, capsys):
    words = ["failures", "constant_velocity", "--data", "synthetic", "--traffic", "replay", "--particles", "2"]
    words += ["--films", "0", "--out", str(tmp_path)]
    assert main([*words, "--limit", "2", "--budget", "8000"]) == 0
    path, capture = tmp_path / "failures.parquet", capsys.readouterr
    before = path.read_bytes()
    capture()
    assert main([*words, "--limit", "2", "--budget", "6000"]) == 2
    assert f"6000 steps is too small for {path}, the result of 8000, which it would replace" in capture().err
    assert main([*words, "--limit", "1", "--budget", "8000"]) == 2
    assert f"{path} holds 2 scenarios, and limit=1 would replace them without 1 of these" in capture().err
    assert path.read_bytes() == before
    assert main([*words, "--limit", "2", "--budget", "9000"]) == 0


@pytest.mark.slow
def test_however_the_work_is_done_and_interrupted_the_bytes_are_the_same(tmp_path, capsys, monkeypatch):
    whole, shared = tmp_path / "whole", tmp_path / "shared"
    assert main([*LINE, "--out", str(whole), "--films", "1"]) == 0
    printed = capsys.readouterr().out
    assert "per 1 000 km" in printed
    assert "Monte Carlo needs" in printed
    expected = {name: (whole / name).read_bytes() for name in ("failures.parquet", "index.html")}
    # 1. a file is lost, another one is cut short
    lost, cut, *_ = sorted((whole / "repeats").glob("*.json"))
    lost.unlink()
    cut.write_bytes(cut.read_bytes()[:40])
    assert main([*LINE, "--out", str(whole), "--films", "1", "--jobs", "2"]) == 0
    assert {name: (whole / name).read_bytes() for name in expected} == expected
    # 2. two shares: their pilots, then the repeats of the second and of the first
    for share in ("1/2", "2/2", "1/2"):
        assert main([*LINE, "--out", str(shared), "--films", "1", "--share", share]) == 0
    assert {name: (shared / name).read_bytes() for name in expected} == expected
    # 3. another study, and a smaller budget than one repeat needs
    capsys.readouterr()
    assert main([*LINE, "--out", str(whole), "--seed", "1"]) == 2
    assert "holds failures of another seed (0, not 1)" in capsys.readouterr().err
    assert main([*LINE[:-1], "3000", "--out", str(whole)]) == 2
    assert "too small" in capsys.readouterr().err
    # 4. a failure again, in words and as a page
    exhibits = []
    monkeypatch.setattr(failure_page, "build_exhibit", lambda *row: exhibits.append(build_exhibit(*row)) or exhibits[0])
    assert main(["failures", "show", str(whole), "0", "--film", str(tmp_path / "film.webp")]) == 0
    printed = capsys.readouterr().out
    assert "avoided by: " in printed
    assert (tmp_path / "film.webp").exists()
    page = expected["index.html"].decode()
    assert "ordinary traffic?" in page
    assert "data-first=" in page
    ((exhibit,), (_, failure)) = exhibits, read_failure(whole, 0)
    assert exhibit.record.collisions[0].step <= failure.step
    with pytest.raises(DataError, match="there is no number 9999"):
        read_failure(whole, 9999)
    # 5. full braking follows the same path and stops
    motion, before = brake(exhibit.record, failure.step), exhibit.record.agent_motion[1:]
    begin = max(failure.step - 20, 0)
    assert np.array_equal(motion[: begin - 1], before[: begin - 1])
    speed = np.hypot(motion[begin:, 3], motion[begin:, 4])
    assert (np.diff(speed) <= 1e-9).all()
    assert speed[-1] == pytest.approx(0.0, abs=1e-9)

"""Alarms: their statistics, their thresholds, and a run that goes on with them."""

import re
from dataclasses import replace

import pytest
import torch

import scenes
import tiny
from rlftsim.errors import ConfigError
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.training.config import AlarmConfig
from rlftsim.training.experience import compute_diversity, compute_speed_gap
from rlftsim.training.monitoring import DRIFT_MONITORS, Alarms
from rlftsim.training.run import train_policy
from rlftsim.training.run_folder import read_metrics

CONFIG = AlarmConfig(first_updates=4, window=5)
CALM = {"min_ade_m": 2.0, "diversity_m": 3.0, "traffic_light_violation_rate": 0.01, "speed_gap_mps": 0.5}


def watch_all(lines, config=CONFIG):
    """Levels and messages of every update."""
    alarms, levels, messages = Alarms(), [], []
    for line in lines:
        level, words = alarms.watch(line, config)
        levels.append(level)
        messages.append(words)
    return levels, messages


def test_as_long_as_nothing_moves_every_level_is_zero():
    levels, messages = watch_all([CALM] * 12)
    assert all(value == 0 for level in levels for value in level.values())
    assert not any(messages)
    assert set(levels[0]) == {"alarm_min_ade", "alarm_diversity", "alarm_red_light", "alarm_speed"}


@pytest.mark.parametrize(
    ("statistic", "limit", "alarm", "words"),
    [
        ("min_ade_m", 3.0, "alarm_min_ade", r"best rollouts lie 3.00 m from the log, 2.00 m at the start"),
        ("diversity_m", 1.5, "alarm_diversity", r"their endpoints scatter by 1.50 m, 3.00 m at the start"),
        (
            "traffic_light_violation_rate",
            0.06,
            "alarm_red_light",
            "6.0% of the evaluated agents run a red light, 1.0%",
        ),
        ("speed_gap_mps", 1.5, "alarm_speed", r"\+1.50 m/s from the log's, \+0.50 m/s"),
        ("speed_gap_mps", -0.5, "alarm_speed", r"-0.50 m/s from the log's, \+0.50 m/s"),
    ],
)
def test_an_alarm_is_raised_at_its_threshold_with_one_message(statistic, limit, alarm, words):
    start = CALM[statistic]
    beyond = limit + 1e-9 * (limit - start) / abs(limit - start)
    short = start + 0.9 * (limit - start)
    config = replace(CONFIG, window=1)  # the running mean is the latest value
    levels, messages = watch_all([CALM] * 4 + [CALM | {statistic: v} for v in (short, beyond, beyond)], config)
    assert levels[4][alarm] == pytest.approx(0.9)
    assert levels[5][alarm] == pytest.approx(1.0)
    assert messages[4] == []
    assert len(messages[5]) == 1
    assert messages[5][0].startswith(f"{alarm}: ")
    assert re.search(words, messages[5][0])
    assert messages[6] == []
    assert all(value == 0 for level in levels for name, value in level.items() if name != alarm)


def test_an_alarm_that_has_ended_may_be_raised_again():
    config = replace(CONFIG, window=1)
    far = CALM | {"min_ade_m": 9.0}
    _, messages = watch_all([*[CALM] * 4, far, CALM, far], config)
    assert [len(words) for words in messages] == [0, 0, 0, 0, 1, 0, 1]


def test_a_single_wild_update_raises_nothing_and_a_lasting_one_does():
    wild = CALM | {"min_ade_m": 6.0}  # three times the start; a fifth of it, + 0.8 m, enters the mean
    levels, _ = watch_all([*[CALM] * 4, wild, *[CALM] * 3])
    assert max(level["alarm_min_ade"] for level in levels) == pytest.approx(0.8 / 1.0)
    levels, _ = watch_all([*[CALM] * 4, *[wild] * 3])
    # 4 (1 - 0.8^n) metres above the start
    assert [level["alarm_min_ade"] for level in levels[4:]] == pytest.approx([0.8, 1.44, 1.952])


def test_nothing_is_raised_in_the_first_updates_whose_mean_is_the_reference():
    first = [CALM | {"min_ade_m": value} for value in (1.0, 9.0, 1.0, 1.0)]  # mean 3
    levels, messages = watch_all([*first, CALM | {"min_ade_m": 4.5}], replace(CONFIG, window=1))
    assert [level["alarm_min_ade"] for level in levels] == pytest.approx([0, 0, 0, 0, 1.0])
    assert not any(messages[:4])


def test_what_is_no_number_is_passed_over():
    levels, messages = watch_all([*[CALM] * 4, CALM | {"min_ade_m": float("nan")}, CALM])
    assert levels[4]["alarm_min_ade"] == levels[5]["alarm_min_ade"] == 0
    assert not any(messages)


def test_alarms_go_on_from_a_checkpoint():
    lines = [CALM | {"min_ade_m": 2.0 + 0.3 * n} for n in range(9)]
    whole, parts = Alarms(), Alarms()
    expected = [whole.watch(line, CONFIG) for line in lines]
    found = [parts.watch(line, CONFIG) for line in lines[:5]]
    again = Alarms()
    again.load_numbers(parts.to_numbers())
    assert found + [again.watch(line, CONFIG) for line in lines[5:]] == expected


@pytest.mark.parametrize("name", ["first_updates", "window", "min_ade_rise", "red_light_rise", "speed_drift_mps"])
def test_thresholds_are_positive(name):
    with pytest.raises(ConfigError, match=f"{name} must be positive, got 0"):
        AlarmConfig(**{name: type(getattr(CONFIG, name))(0)})


def test_a_run_logs_an_alarm_once_and_goes_on(vocabulary, drawn_scenarios, tmp_path, capsys):
    touchy = AlarmConfig(first_updates=1, window=1, speed_drift_mps=1e-9)
    config = replace(tiny.FINETUNE, epochs=1.0, alarms=touchy)  # four updates on four scenarios: speeds differ
    train_policy(tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, config)
    lines = read_metrics(tmp_path)
    assert len(lines) == 4
    assert lines[0]["alarm_speed"] == 0
    assert min(line["alarm_speed"] for line in lines[1:]) >= 1
    assert all({monitor.alarm for monitor in DRIFT_MONITORS} <= line.keys() for line in lines)
    warnings = [line for line in capsys.readouterr().err.splitlines() if "alarm_speed" in line]
    assert len(warnings) == 1
    assert warnings[0].startswith("update 2, alarm_speed: mean speed differs ")
    assert (tmp_path / "model").exists()


def test_the_speed_gap_is_that_of_the_same_agents_and_steps():
    batch = collate([scenes.straight_road(), scenes.with_gaps()])
    rollouts = simulate(ConstantVelocity(), batch, num_rollouts=3, seed=0)
    now = batch.position[:, None, :, 10, None]
    # twice as far from the start at every step is twice the speed
    fast = replace(rollouts, position=now + 2 * (rollouts.position - now))
    gaps = [compute_speed_gap(batch, r) for r in (rollouts, fast)]
    for b in range(2):
        steps = [
            (a, t) for a in range(batch.agent_mask.shape[1]) for t in range(80)
            if batch.agent_mask[b, a] and batch.valid[b, a, 10 + t] and batch.valid[b, a, 11 + t]
        ]  # fmt: skip
        path = torch.cat([now.expand(-1, 3, -1, -1, -1), rollouts.position], 3)[b, 0]
        simulated = sum(float((path[a, t + 1] - path[a, t]).norm()) / 0.1 for a, t in steps) / len(steps)
        logged = sum(
            float((batch.position[b, a, 11 + t] - batch.position[b, a, 10 + t]).norm()) / 0.1 for a, t in steps
        ) / len(steps)
        assert float(gaps[0][b]) == pytest.approx(simulated - logged, abs=1e-4)
        assert float(gaps[1][b]) == pytest.approx(2 * simulated - logged, abs=1e-3)


def test_diversity_is_the_mean_distance_of_ends_from_their_middle():
    batch = collate([scenes.straight_road(), scenes.with_gaps()])
    rollouts = simulate(ConstantVelocity(), batch, num_rollouts=2, seed=0)
    apart = rollouts.position.clone()
    apart[0, 1, :, -1, 0] += 6.0  # every agent of the first scenario ends 6 m elsewhere: 3 m from the middle
    assert compute_diversity(replace(rollouts, position=apart)).tolist() == pytest.approx([3.0, 0.0], abs=1e-4)

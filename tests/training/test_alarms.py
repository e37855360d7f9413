"""Alarms: what they compare, when they ring, and that a run tells of them and goes on."""

import re
from dataclasses import replace

import pytest
import tiny
import torch

import scenes
from rlftsim.errors import ConfigError
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.training.alarms import GAUGES, AlarmConfig, Alarms
from rlftsim.training.experience import compute_diversity, compute_speed_gap
from rlftsim.training.finetune import finetune
from rlftsim.training.run_folder import read_metrics

CONFIG = AlarmConfig(first_updates=4, window=5)
CALM = {"min_ade_m": 2.0, "diversity_m": 3.0, "traffic_light_violation_rate": 0.01, "speed_gap_mps": 0.5}


def watch_all(lines, config=CONFIG):
    """Levels of every update, and all that was told."""
    alarms, levels, told = Alarms(), [], []
    for line in lines:
        level, words = alarms.watch(line, config)
        levels.append(level)
        told.append(words)
    return levels, told


def test_as_long_as_nothing_moves_every_level_is_zero():
    levels, told = watch_all([CALM] * 12)
    assert all(value == 0 for level in levels for value in level.values())
    assert not any(told)
    assert set(levels[0]) == {"alarm_min_ade", "alarm_diversity", "alarm_red_light", "alarm_speed"}


@pytest.mark.parametrize(
    ("statistic", "limit", "alarm", "words"),
    [
        ("min_ade_m", 3.0, "alarm_min_ade", r"best rollouts lie 3.00 m from the record, 2.00 m at the start"),
        ("diversity_m", 1.5, "alarm_diversity", r"their ends scatter by 1.50 m, 3.00 m at the start"),
        (
            "traffic_light_violation_rate",
            0.06,
            "alarm_red_light",
            "6.0% of the evaluated agents pass a red light, 1.0%",
        ),
        ("speed_gap_mps", 1.5, "alarm_speed", r"\+1.50 m/s from the record's, \+0.50 m/s"),
        ("speed_gap_mps", -0.5, "alarm_speed", r"-0.50 m/s from the record's, \+0.50 m/s"),
    ],
)
def test_an_alarm_rings_at_its_threshold_and_is_told_once(statistic, limit, alarm, words):
    start = CALM[statistic]
    beyond = limit + 1e-9 * (limit - start) / abs(limit - start)
    short = start + 0.9 * (limit - start)
    config = replace(CONFIG, window=1)  # the running mean is the latest value
    levels, told = watch_all([CALM] * 4 + [CALM | {statistic: v} for v in (short, beyond, beyond)], config)
    assert levels[4][alarm] == pytest.approx(0.9)
    assert levels[5][alarm] == pytest.approx(1.0)
    assert told[4] == []
    assert len(told[5]) == 1
    assert told[5][0].startswith(f"{alarm}: ")
    assert re.search(words, told[5][0])
    assert told[6] == []
    assert all(value == 0 for level in levels for name, value in level.items() if name != alarm)


def test_an_alarm_that_has_fallen_silent_rings_again():
    config = replace(CONFIG, window=1)
    far = CALM | {"min_ade_m": 9.0}
    _, told = watch_all([*[CALM] * 4, far, CALM, far], config)
    assert [len(words) for words in told] == [0, 0, 0, 0, 1, 0, 1]


def test_a_single_wild_update_rings_nothing_and_a_lasting_one_does():
    wild = CALM | {"min_ade_m": 6.0}  # three times the start; a fifth of it, + 0.8 m, enters the mean
    levels, _ = watch_all([*[CALM] * 4, wild, *[CALM] * 3])
    assert max(level["alarm_min_ade"] for level in levels) == pytest.approx(0.8 / 1.0)
    levels, _ = watch_all([*[CALM] * 4, *[wild] * 3])
    # 4 (1 - 0.8^n) metres above the start
    assert [level["alarm_min_ade"] for level in levels[4:]] == pytest.approx([0.8, 1.44, 1.952])


def test_nothing_rings_while_the_start_is_measured_whose_mean_is_the_measure():
    first = [CALM | {"min_ade_m": value} for value in (1.0, 9.0, 1.0, 1.0)]  # mean 3
    levels, told = watch_all([*first, CALM | {"min_ade_m": 4.5}], replace(CONFIG, window=1))
    assert [level["alarm_min_ade"] for level in levels] == pytest.approx([0, 0, 0, 0, 1.0])
    assert not any(told[:4])


def test_what_is_no_number_is_passed_over():
    levels, told = watch_all([*[CALM] * 4, CALM | {"min_ade_m": float("nan")}, CALM])
    assert levels[4]["alarm_min_ade"] == levels[5]["alarm_min_ade"] == 0
    assert not any(told)


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


def test_a_run_tells_of_its_alarms_once_and_goes_on(vocabulary, drawn_scenarios, tmp_path, capsys):
    touchy = AlarmConfig(first_updates=1, window=1, speed_drift_mps=1e-9)
    config = replace(tiny.FINETUNE, epochs=1.0, alarms=touchy)  # four updates on four scenarios: speeds differ
    finetune(tiny.tiny_policy(vocabulary), drawn_scenarios, tmp_path, config)
    lines = read_metrics(tmp_path)
    assert len(lines) == 4
    assert lines[0]["alarm_speed"] == 0
    assert min(line["alarm_speed"] for line in lines[1:]) >= 1
    assert all({gauge.alarm for gauge in GAUGES} <= line.keys() for line in lines)
    said = [line for line in capsys.readouterr().err.splitlines() if "alarm_speed" in line]
    assert len(said) == 1
    assert said[0].startswith("update 2, alarm_speed: mean speed lies ")
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
        recorded = sum(
            float((batch.position[b, a, 11 + t] - batch.position[b, a, 10 + t]).norm()) / 0.1 for a, t in steps
        ) / len(steps)
        assert float(gaps[0][b]) == pytest.approx(simulated - recorded, abs=1e-4)
        assert float(gaps[1][b]) == pytest.approx(2 * simulated - recorded, abs=1e-3)


def test_diversity_is_the_mean_distance_of_ends_from_their_middle():
    batch = collate([scenes.straight_road(), scenes.with_gaps()])
    rollouts = simulate(ConstantVelocity(), batch, num_rollouts=2, seed=0)
    apart = rollouts.position.clone()
    apart[0, 1, :, -1, 0] += 6.0  # every agent of the first scenario ends 6 m elsewhere: 3 m from the middle
    assert compute_diversity(replace(rollouts, position=apart)).tolist() == pytest.approx([3.0, 0.0], abs=1e-4)

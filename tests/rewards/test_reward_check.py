"""`rs.check_reward`: rewards that break the contract are told which rule, those that ship and the page's break none."""

import re
import shutil

import jaxtyping
import pytest
import torch

import rlftsim as rs
import third_party
from rlftsim.cli.main import main
from rlftsim.errors import ConfigError
from rlftsim.rewards import REWARDS, register_agent_rewards, register_reward


def mean_speed(rollouts):
    return rollouts.position.diff(dim=-2).norm(dim=-1).mean(-1)  # [B, N, A], meters per step


def plain_mean(scores, rollouts, batch):
    """Padded agents stand still at 0, and slow their scenario down."""
    return rs.leave_one_out(mean_speed(rollouts).mean(-1))


def with_mask(scores, rollouts, batch):
    return rs.leave_one_out(rs.masked_mean(mean_speed(rollouts), batch.agent_mask))


def of_batch(scores, rollouts, batch):
    return scores.rollout_offroad_rate[:1]


def infinite(scores, rollouts, batch):
    return rs.leave_one_out(1 / torch.zeros_like(scores.rollout_offroad_rate))


def random(scores, rollouts, batch):
    return torch.rand_like(scores.rollout_offroad_rate)


def in_place(scores, rollouts, batch):
    rollouts.position.mul_(0.5)
    return rs.leave_one_out(scores.rollout_offroad_rate)


def raising(scores, rollouts, batch):
    return scores.rollout_offroad


BROKEN = {
    plain_mean: ("padding changes no number", "padded agents count; take rlftsim.rewards.masked_mean"),
    of_batch: ("each rollout gets a number", r"of_batch gives shape \[1, 3\], expected \[2, 3\]"),
    infinite: ("numbers are finite", "infinite or NaN"),
    random: ("the same rollouts get the same numbers", "largest gap"),
    in_place: ("nothing is changed", "changed in place"),
    raising: ("each rollout gets a number", r"raised AttributeError: .*rollout_offroad.*test_reward_check.py:\d+ in"),
}


@pytest.mark.parametrize("reward", BROKEN, ids=lambda reward: reward.__name__)
def test_a_reward_that_breaks_a_rule_is_told_which(reward):
    report = rs.check_reward(reward)
    rule, detail = BROKEN[reward]
    assert not report.is_passed
    assert re.search(detail, {failure.rule: failure.detail for failure in report.failures}[rule])
    if reward in (plain_mean, of_batch, raising):
        assert len(report.failures) == 1  # the rules that need numbers do not repeat the cause


def test_the_masked_mean_does_not_depend_on_padding():
    assert rs.check_reward(with_mask).is_passed
    values = torch.tensor([[[1.0, 3.0, 99.0], [2.0, float("nan"), 8.0]], [[5.0, 5.0, 5.0], [5.0, 5.0, 5.0]]])
    mask = torch.tensor([[True, True, False], [False, False, False]])
    means = rs.masked_mean(values.nan_to_num(4.0), mask)
    torch.testing.assert_close(means, torch.tensor([[2.0, 3.0], [0.0, 0.0]]))


@pytest.mark.parametrize("name", ["mloo + 0.1*collision_offroad_ade(ade_weight=2)", "rloo", "minade_rloo", "gcft"])
def test_rewards_that_ship_keep_the_contract(name):
    report = rs.check_reward(name)
    assert report.is_passed, str(report)
    assert {result.outcome for result in report.results} == {"passed"}


@pytest.fixture
def forgetful(monkeypatch):
    monkeypatch.setattr(REWARDS, "_registered", dict(REWARDS._registered))


def test_shares_have_to_add_up_to_the_reward(forgetful):
    @register_reward("halved")
    def halved(scores, rollouts, batch):
        return rs.leave_one_out(scores.rollout_displacement_error)

    assert rs.check_reward("halved").is_passed  # no split
    register_agent_rewards("halved")(lambda scores, rollouts, batch: 0.5 * rs.leave_one_out(scores.displacement_error))
    assert [failure.rule for failure in rs.check_reward("halved").failures] == ["shares of agents add up"]


def test_what_is_no_reward_is_refused():
    with pytest.raises(ConfigError, match="unknown reward 'mlo': did you mean 'mloo'"):
        rs.check_reward("mlo")
    # the latter under run-time type checks
    with pytest.raises((ConfigError, jaxtyping.TypeCheckError), match=r"3 is no reward: hand over|Actual value: 3"):
        rs.check_reward(3)


PACKAGE = """
from rlftsim.rewards import leave_one_out
def slow(scores, rollouts, batch):
    return leave_one_out(-rollouts.position.diff(dim=-2).norm(dim=-1).mean((-1, -2)))
def raising(scores, rollouts, batch):
    return 1 / 0
def fine(scores, rollouts, batch):
    return leave_one_out(-scores.rollout_offroad_rate)
"""


def test_rewards_of_packages_are_tried_and_their_errors_name_the_package(forgetful, tmp_path, capsys):
    entries = {"rlftsim.rewards": {name: f"rough_rewards:{name}" for name in ("slow", "raising", "fine")}}
    words = "finetune smart-demo --model demo-base --data synthetic --limit 2 --max-updates 1 --finetune.reward raising"
    words += " --finetune.device.accelerator cpu --finetune.batch-size 2 --finetune.num-rollouts 2"
    with third_party.installed(tmp_path / "site", "rough_rewards", PACKAGE, entries):
        assert main(["plugins"]) == 1
        printed = capsys.readouterr().out
        rows = [[cell.strip() for cell in line.split("│")[1:-1]] for line in printed.splitlines()]
        states = {row[1]: row[5] for row in rows if len(row) == 6 and row[0] == "rlftsim.rewards"}
        assert states == {"slow": "fails", "raising": "fails", "fine": "works"}
        assert (
            "reward 'slow' of rough_rewards:slow breaks the contract, see rs.check_reward: padding changes" in printed
        )
        assert "each rollout gets a number: raised ZeroDivisionError: division by zero (__init__.py:6 in " in printed
        for processes in ("1", "2"):
            command = [*words.split(), "--out", str(tmp_path / processes), "--processes", processes]
            assert main(command) == 1
            error = capsys.readouterr().err.splitlines()[-1]
            assert error == (
                "rlftsim: package rough_rewards 0.1.0 fails (ZeroDivisionError: division by zero, __init__.py:6 in "
                "raising): repair it; --debug shows more."
            )
        with pytest.raises(ZeroDivisionError):
            main([*command, "--debug"])
    shutil.rmtree(tmp_path / "1")


def test_a_mistake_has_a_traceback_where_one_is_asked_for(capsys):
    assert main(["evaluate", "nothing", "--data", "synthetic", "--out", "o"]) == 2
    with pytest.raises(ConfigError):
        main(["evaluate", "nothing", "--data", "synthetic", "--out", "o", "--debug"])
    assert main(["--debug"]) == 2
    assert "--debug" in capsys.readouterr().out

"""Averages of policies."""

import copy
from dataclasses import replace

import pytest
import torch

import tiny
from rlftsim.cli.main import main
from rlftsim.errors import ConfigError
from rlftsim.policies.averaging import average_policies
from rlftsim.policies.registry import load_policy
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.baselines import ConstantVelocity


@pytest.fixture
def base():
    return tiny.tiny_policy(tiny.small_vocabulary(tiny.pack_scenarios(2)))


def moved(policy, by):
    found = copy.deepcopy(policy)
    with torch.no_grad():
        for weight in found.parameters():
            weight += by
    return found


def difference(one, other):
    """Of all weights, which has to be one number."""
    found = torch.cat([(a - b).detach().flatten() for a, b in zip(one.parameters(), other.parameters(), strict=True)])
    torch.testing.assert_close(found, found[0].expand_as(found), atol=1e-6, rtol=0)
    return pytest.approx(float(found[0]), abs=1e-6)


def test_the_average_is_the_mean_of_all_weights(base):
    left, right = moved(base, 0.1), moved(base, 0.3)
    assert difference(average_policies([left, right]), base) == 0.2
    assert difference(left, base) == 0.1
    assert difference(average_policies([base]), base) == 0.0


def test_a_scale_goes_further_from_the_base(base):
    policies = [moved(base, 0.1), moved(base, 0.3)]
    assert difference(average_policies(policies, base=base, scale=1.5), base) == 0.3
    assert difference(average_policies(policies, base=base, scale=0.0), base) == 0.0
    with pytest.raises(ConfigError, match="scale=2 needs the base"):
        average_policies(policies, scale=2.0)
    for scale, message in ((float("nan"), "finite number, got nan"), (1e41, "is not finite in the average")):
        with pytest.raises(ConfigError, match=message):
            average_policies(policies, base=base, scale=scale)


def test_policies_that_differ_in_more_than_their_weights_are_refused(base):
    other = SmartPolicy(replace(base.config, agent_radius_m=17.0), base.vocabulary)
    with pytest.raises(ConfigError, match="policy 2 of 2, a SmartPolicy, differs from the first in more than"):
        average_policies([base, other])
    others = SmartPolicy(base.config, tiny.small_vocabulary(tiny.pack_scenarios(3)))
    others.load_state_dict(base.state_dict())
    with pytest.raises(ConfigError, match="policy 2 of 2, a SmartPolicy, differs"):
        average_policies([base, others])
    with pytest.raises(ConfigError, match="the base, a SmartPolicy, differs"):
        average_policies([base], base=base.with_goal_conditioning("indication"))
    with pytest.raises(ConfigError, match="policy 1 of 1 is a ConstantVelocity and has no weights"):
        average_policies([ConstantVelocity()])
    with pytest.raises(ConfigError, match="at least one"):
        average_policies([])


def test_the_command_writes_a_model_folder_with_its_origin(base, tmp_path, capsys):
    for name, policy in {"base": base, "a": moved(base, 0.1), "b": moved(base, 0.3)}.items():
        policy.save_pretrained(tmp_path / name, card=f"# Model\n\n* terms of the data: those of {name}\n")
    words = ["model", "average", str(tmp_path / "a"), str(tmp_path / "b"), "--out", str(tmp_path / "mean")]
    killed = tmp_path / ".mean.machine.12.tmp"
    killed.mkdir()
    (killed / "model.safetensors").write_bytes(b"half")
    assert main([*words, "--base", str(tmp_path / "base"), "--scale", "1.5"]) == 0
    assert difference(load_policy(tmp_path / "mean"), base) == 0.3
    assert not killed.exists()
    card = (tmp_path / "mean" / "README.md").read_text()
    assert "/a, " in card
    assert f"scale 1.5 from {tmp_path / 'base'}" in card
    assert "terms of the data: those of a\n" in card
    assert "terms of the data: those of b\n" in card
    assert "terms of the data: those of base\n" in card
    capsys.readouterr()
    assert main(words) == 2
    assert "is not empty" in capsys.readouterr().err
    assert main([*words, "--base", str(tmp_path / "base")]) == 2
    assert "--base" in capsys.readouterr().err

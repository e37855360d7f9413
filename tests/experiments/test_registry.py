"""Experiments and policies of other packages run from the command line by their names."""

import json

from rlftsim.cli.main import main
from rlftsim.policies.registry import POLICIES
from third_party import installed

EXPERIMENT = """
from rlftsim.evaluation.columns import SCORES
from rlftsim.experiments.tables import build_table, draw_gains, to_numbers
from rlftsim.experiments.model_specs import CONSTANT_VELOCITY, ORACLE
from rlftsim.experiments.results import Experiment, ExperimentResult


def run(suite):
    return suite.evaluate({"log": (ORACLE,), "straight on": (CONSTANT_VELOCITY,)})


def summarize(rows, suite):
    return ExperimentResult(
        title="Going straight on",
        tables=(build_table("Ours", rows.values(), SCORES),),
        verdicts=(rows["straight on"].against(rows["log"]),),
        numbers={"rows": to_numbers(rows.values(), SCORES)},
        figure=draw_gains(rows["log"], [rows["straight on"]]),
    )


EXPERIMENT = Experiment("How unrealistic is a model that goes straight on?", run, summarize)
"""
POLICY = '''
"""Straight on, faster or slower."""

from dataclasses import dataclass, replace

import torch
from torch import Tensor, nn

from rlftsim.geometry import heading_vector
from rlftsim.policies.checkpoint import read_model, save_model
from rlftsim.policies.distributions import TokenDistribution

ACCELERATIONS = torch.tensor([-2.0, 0.0, 2.0])


@dataclass(frozen=True)
class Now:
    position: Tensor
    heading: Tensor
    speed: Tensor
    agent_mask: Tensor
    poses: Tensor | None = None
    draws: Tensor | None = None


class Paced(nn.Module):
    architecture = "paced"
    steps_per_decision, noise_size, initial_noise_size = 5, 1, 0

    def __init__(self):
        super().__init__()
        self.logits = nn.Parameter(torch.tensor([0.0, 1.0, 0.0]))

    def encode(self, scenarios):
        now = scenarios.position[:, :, 10], scenarios.heading[:, :, 10], scenarios.velocity[:, :, 10].norm(dim=-1)
        return Now(*now, scenarios.agent_mask)

    def begin(self, context, num_rollouts, goals, noise):
        tensors = (context.position, context.heading, context.speed, context.agent_mask)
        return Now(*(v[:, None].expand(-1, num_rollouts, *v.shape[1:]) for v in tensors))

    def decide(self, context, state):
        return self._distribution(state.agent_mask)

    def advance(self, context, state, decision, forced=None):
        speed = state.speed[..., None] + ACCELERATIONS[decision][..., None] * 0.1 * torch.arange(1, 6)
        way = (speed.clamp(min=0) * 0.1).cumsum(-1)
        position = state.position[..., None, :] + way[..., None] * heading_vector(state.heading)[..., None, :]
        poses = torch.cat([position, state.heading[..., None, None].expand(*way.shape, 1)], -1)
        return replace(state, position=poses[..., -1, :2], speed=speed[..., -1].clamp(min=0), poses=poses)

    def score(self, context, rollouts):
        return self._distribution(context.agent_mask[:, None, :, None].expand(rollouts.decision.shape))

    def _distribution(self, mask):
        return TokenDistribution(self.logits.expand(int(mask.sum()), 3), mask)

    def save_pretrained(self, folder, *, card=""):
        save_model(folder, self, {}, card=card)

    @classmethod
    def from_pretrained(cls, folder):
        return read_model(folder).load(cls)
'''


def test_an_experiment_of_another_package_runs_by_its_name(tmp_path, capsys):
    entry_points = {"rlftsim.experiments": {"straight-on": "straight_on_package:EXPERIMENT"}}
    out = tmp_path / "out"
    with installed(tmp_path / "site", "straight_on_package", EXPERIMENT, entry_points):
        words = ["experiment", "straight-on", "--out", str(out), "--limit", "2", "--num-rollouts", "4"]
        assert main(words) == 0
    assert "straight on against log, 2 scenarios of 1 cluster in both" in capsys.readouterr().out
    names = {f"straight-on.{ending}" for ending in ("md", "json", "png", "svg")}
    assert {path.name for path in out.glob("straight-on.*")} == names
    numbers = json.loads((out / "straight-on.json").read_text())
    assert numbers["question"] == "How unrealistic is a model that goes straight on?"
    assert numbers["rows"]["log"]["meta_metric"]["mean"] > numbers["rows"]["straight on"]["meta_metric"]["mean"]


def test_a_policy_of_another_package_is_fine_tuned_and_compared(tmp_path, capsys):
    out = tmp_path / "out"
    with installed(tmp_path / "site", "paced_package", POLICY, {"rlftsim.policies": {"paced": "paced_package:Paced"}}):
        POLICIES.get("paced")().save_pretrained(tmp_path / "paced")
        settings = ["--finetune.epochs", "0.01", "--finetune.batch-size", "1", "--finetune.num-rollouts", "2"]
        settings += ["--finetune.device.accelerator", "cpu", "--finetune.goals.learning-rate-scale", "1"]
        words = ["experiment", "reward-ablation", "--base-model", str(tmp_path / "paced"), "--out", str(out)]
        words += ["--device", "cpu", "--seeds", "1", "--limit", "2", "--num-rollouts", "4", "--jobs", "1"]
        assert main([*words, *settings]) == 0
    assert "MLOO against base, 2 scenarios of 1 cluster in both" in capsys.readouterr().out
    tuned = json.loads((out / "runs" / "mloo-seed0" / "0.01-epochs" / "model" / "config.json").read_text())
    assert tuned["architecture"] == "paced"

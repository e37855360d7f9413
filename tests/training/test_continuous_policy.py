"""A policy without tokens, pre-trained with a loss of its own: continuous actions every 0.1 s."""

import math
from dataclasses import replace

import pytest
import torch

import tiny
from rlftsim.evaluation.learning_curve import write_learning_curve
from rlftsim.policies.checkpoint import read_model, save_model
from rlftsim.rollout.policy import ImitatedPolicy, ImitationLoss
from rlftsim.scenario.types import CURRENT_STEP
from rlftsim.training.run import train_policy
from rlftsim.training.run_folder import read_metrics


class Glide(torch.nn.Module):
    """Gaussian over the displacement of the next 0.1 s, given the last one."""

    architecture = "glide"

    def __init__(self, width=1):
        super().__init__()
        self.width = width
        self.mean = torch.nn.Linear(2, 2)
        self.log_std = torch.nn.Parameter(torch.zeros(2))

    def imitation_loss(self, scenarios, trained, update):
        moved = scenarios.position.diff(dim=2)  # [B, A, S-1, 2]
        both = scenarios.valid[..., 1:] & scenarios.valid[..., :-1]
        counts = both[..., CURRENT_STEP:] & both[..., CURRENT_STEP - 1 : -1] & trained[..., None]
        last, target = moved[..., CURRENT_STEP - 1 : -1, :][counts], moved[..., CURRENT_STEP:, :][counts]
        mean = self.mean(last)
        nll = -torch.distributions.Normal(mean, self.log_std.exp()).log_prob(target).sum()
        sums = {"error_m": (mean - target).norm(dim=-1).sum()}
        return ImitationLoss(nll, counts.sum(), sums)

    def save_pretrained(self, folder, *, card=""):
        save_model(folder, self, {"width": self.width}, card=card)

    @classmethod
    def from_pretrained(cls, folder):
        return read_model(folder).load(cls)


CONFIG = replace(tiny.PRETRAIN, epochs=20.0, batch_size=2, micro_batch_size=1, learning_rate=3e-2)


@pytest.fixture(scope="module")
def glided(drawn_scenarios, tmp_path_factory):
    out = tmp_path_factory.mktemp("glide")
    torch.manual_seed(0)
    policy = Glide()
    train_policy(policy, drawn_scenarios, out, CONFIG)
    return policy, out


def test_its_loss_falls_and_its_metrics_are_means(glided):
    assert isinstance(glided[0], ImitatedPolicy)
    lines = read_metrics(glided[1])
    assert lines[-1]["loss"] < lines[0]["loss"] - 1
    assert lines[-1]["error_m"] < lines[0]["error_m"]
    assert {"loss", "error_m", "predictions"} <= set(lines[0])
    assert "accuracy" not in lines[0]
    assert math.isfinite(lines[-1]["gradient_norm"])


def test_it_is_saved_and_loaded(glided):
    policy, out = glided
    again = Glide.from_pretrained(out / "model")
    assert all(torch.equal(value, again.state_dict()[name]) for name, value in policy.state_dict().items())


def test_its_learning_curve_is_drawn(glided):
    assert write_learning_curve(glided[1])


def test_the_loss_does_not_depend_on_how_many_scenarios_are_in_memory(drawn_scenarios, tmp_path):
    losses = []
    for size in (1, 2):
        torch.manual_seed(0)
        config = replace(CONFIG, epochs=1.0, micro_batch_size=size)
        train_policy(Glide(), drawn_scenarios, tmp_path / str(size), config)
        losses.append([line["loss"] for line in read_metrics(tmp_path / str(size))])
    assert losses[0] == pytest.approx(losses[1], rel=1e-4)


def test_a_count_that_adds_up_to_less_than_one_divides_all_the_same(drawn_scenarios, tmp_path):
    """Counts may be weights, as those of tokens that stand still; a mean does not depend on their scale."""

    class Light(Glide):
        def imitation_loss(self, scenarios, trained, update):
            loss = super().imitation_loss(scenarios, trained, update)
            sums = {name: 1e-6 * value for name, value in loss.sums.items()}
            return ImitationLoss(1e-6 * loss.loss, 1e-6 * loss.count, sums)

    found = []
    for kind in (Glide, Light):
        torch.manual_seed(0)
        train_policy(kind(), drawn_scenarios, tmp_path / kind.__name__, replace(CONFIG, epochs=1.0, gradient_clip=1e9))
        lines = read_metrics(tmp_path / kind.__name__)
        found.append([line[name] for line in lines for name in ("loss", "error_m", "gradient_norm")])
    assert found[0] == pytest.approx(found[1], rel=1e-3)

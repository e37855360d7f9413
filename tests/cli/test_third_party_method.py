"""A training method of another package, made of the code in docs/extending.md, trains by its name."""

import json
import re
from pathlib import Path

import pytest
import torch

import rlftsim as rs
from rlftsim.cli.main import main
from rlftsim.errors import ConfigError
from rlftsim.policies.registry import load_policy
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.synthetic import pack_path
from rlftsim.training.catk import CatkMethod
from rlftsim.training.config import CatkConfig, FinetuneConfig
from rlftsim.training.registry import METHODS, find_method, method_by_name
from rlftsim.training.reward import RewardMethod
from rlftsim.training.run_folder import read_metrics
from third_party import installed

PAGE = (Path(__file__).parents[2] / "docs" / "extending.md").read_text()
PACKAGE = "nudging_package"
COMMAND = [
    "finetune",
    "smart-demo",
    "--model",
    "demo-base",
    "--data",
    "synthetic",
    "--split",
    "validation",
    "--limit",
    "2",
    "--method",
    "nudge",
]


@pytest.fixture
def package(tmp_path, monkeypatch):
    """The block of the page that defines a method is an installed package, which is forgotten after the test."""
    monkeypatch.setattr(METHODS, "_registered", dict(METHODS._registered))
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    source = next(block for block in blocks if "class Nudge(" in block).partition("\n\n\nMETHODS.add")[0]
    with installed(tmp_path / "site", PACKAGE, source, {"rlftsim.methods": {"nudge": f"{PACKAGE}:Nudge"}}):
        yield tmp_path


def test_a_method_of_another_package_trains_by_its_name_and_its_flags(package, capsys):
    words = [*COMMAND, "--nudge.batch-size", "16", "--nudge.step", "0.5", "--out"]
    assert main([*words, str(package / "tuned")]) == 0
    stored = json.loads((package / "tuned" / "config.json").read_text())
    assert (stored["step"], stored["batch_size"]) == (0.5, 16)
    assert "nudge begins: 1 updates of" in capsys.readouterr().err
    tuned, base = load_policy(str(package / "tuned")).state_dict(), load_policy("demo-base").state_dict()
    assert [name for name in base if not torch.equal(tuned[name], base[name])]
    assert "fine-tuned (nudge)" in (package / "tuned" / "model" / "README.md").read_text()
    # A run repeated from its own settings, and a finished run that is not repeated.
    again = [*COMMAND, "--config", str(package / "tuned" / "config.json"), "--out", str(package / "again")]
    assert main(again) == 0 == main(again)
    assert len(read_metrics(package / "again")) == 1
    repeated = load_policy(str(package / "again")).state_dict()
    assert all(torch.equal(repeated[name], tuned[name]) for name in tuned)


def test_settings_of_a_method_of_another_package_choose_it_in_python(package, tmp_path):
    settings = METHODS.get("nudge").settings(batch_size=2)
    scenarios = ScenarioDataset(pack_path(), "validation")
    rs.finetune("demo-base", [scenarios[0], scenarios[1]], tmp_path / "run", settings)
    assert [line["update"] for line in read_metrics(tmp_path / "run")] == [1]


def test_an_unknown_method_and_settings_of_others_are_refused(package, capsys):
    out = ["--out", str(package / "run")]
    assert main([word.replace("nudge", "nudg") for word in COMMAND] + out) == 2
    assert "unknown method 'nudg': did you mean 'nudge'?" in capsys.readouterr().err
    assert main([*COMMAND, "--catk.epochs", "1", *out]) == 2
    assert "--catk.epochs has no effect with --method nudge: its settings are --nudge.*" in capsys.readouterr().err
    assert main([word.replace("nudge", "pretrain") for word in COMMAND] + out) == 2
    assert "rlftsim pretrain --init-from MODEL" in capsys.readouterr().err
    assert not (package / "run").exists()


def test_a_class_that_is_no_method_is_refused_with_what_it_lacks(monkeypatch):
    monkeypatch.setattr(METHODS, "_registered", {"half": type("Half", (), {"settings": None, "title": "half"})})
    with pytest.raises(ConfigError, match="method 'half' has no start and no update: make it extend"):
        method_by_name("half")


def test_settings_of_a_derived_class_choose_the_method_of_the_nearest_base(package):
    class Gentle(FinetuneConfig):
        """Settings of a user's own."""

    class Gradual(CatkConfig):
        """Others."""

    assert [type(find_method(settings)) for settings in (Gentle(), Gradual())] == [RewardMethod, CatkMethod]
    assert find_method(None) is None

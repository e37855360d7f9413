"""A package of one file, made of the code in docs/extending.md, is used by name from the command line."""

import json
import os
import re
import subprocess
import sys
from pathlib import Path
from weakref import WeakSet

import pytest

from rlftsim.cli.main import main
from rlftsim.evaluation.results import Evaluation
from rlftsim.policies.registry import POLICIES, load_policy
from rlftsim.recipes.registry import RECIPES
from rlftsim.rewards import base as rewards
from rlftsim.scenario.dataset import ScenarioDataset
from rlftsim.scenario.sources import SOURCES
from third_party import install, installed

PAGE = (Path(__file__).parents[2] / "docs" / "extending.md").read_text()
PARTS = (
    '@register_reward("on_the_road")',
    "class Cruise(nn.Module)",
    '@SOURCES.register("drives")',
    "class CruiseRecipe",
)
"""A line of each block of the page that belongs into the package."""
PACKAGE = "stranger_package"
ENTRY_POINTS = {
    "rlftsim.policies": {"cruise": f"{PACKAGE}:Cruise"},
    "rlftsim.rewards": {"on_the_road": PACKAGE},
    "rlftsim.sources": {"drives": f"{PACKAGE}:Drives"},
    "rlftsim.recipes": {"cruise-fast": f"{PACKAGE}:cruise_fast"},
}


def source() -> str:
    """The package, as a reader of the page would write it: blocks of the page, registered by entry points."""
    blocks = re.findall(r"^```python\n(.*?)^```", PAGE, re.DOTALL | re.MULTILINE)
    found = [next(block for block in blocks if part in block) for part in PARTS]
    text = '"""Made of a page."""\nfrom pathlib import Path\n\n' + "\n\n".join(found)
    # The entry point registers a policy, a source and a recipe; the decorators on the page are for notebooks.
    text = re.sub(r"^@(SOURCES|RECIPES)\.register.*\n", "", text, flags=re.MULTILINE)
    return (
        re.sub(r"^assert .*\n", "", text, flags=re.MULTILINE) + "\nfrom rlftsim.training.reward import FinetuneConfig\n"
    )


@pytest.fixture
def package(tmp_path, monkeypatch):
    """The package is installed in a test, and its names are forgotten after it."""
    for point in (POLICIES, RECIPES, SOURCES, rewards.REWARDS):
        monkeypatch.setattr(point, "_registered", dict(point._registered))
    # Tables that stand beside the extension point of rewards.
    monkeypatch.setattr(rewards, "_SPLITS", dict(rewards._SPLITS))
    monkeypatch.setattr(rewards, "_SUMS", WeakSet(rewards._SUMS))
    with installed(tmp_path / "site", PACKAGE, source(), ENTRY_POINTS):
        yield tmp_path


@pytest.mark.slow
def test_a_policy_of_another_package_is_fine_tuned_evaluated_and_compared_by_name(package, capsys):
    tuned, out = package / "tuned", package / "evaluations"
    data = ["--data", "synthetic"]
    few = ["--finetune.epochs", "0.05", "--finetune.batch-size", "1", "--finetune.num-rollouts", "2"]
    learn = ["--finetune.reward", "mloo + 0.1*on_the_road", "--finetune.learning-rate", "0.1"]
    words = ["finetune", "smart-tiny", "--model", "cruise", *data, "--split", "validation", "--out", str(tuned)]
    assert main([*words, *few, *learn]) == 0
    settings = json.loads((tuned / "config.json").read_text())
    assert settings["reward"] == "mloo + 0.1*on_the_road(scale=1.0)"
    model = json.loads((tuned / "model" / "config.json").read_text())
    assert model["architecture"] == "cruise"
    assert not load_policy("cruise").logits.equal(load_policy(str(tuned)).logits)  # type: ignore[attr-defined]
    brief = [*data, "--out", str(out), "--num-rollouts", "2", "--limit", "2"]
    assert main(["evaluate", "cruise", *brief]) == 0
    assert main(["evaluate", str(tuned), *brief]) == 0
    assert len(Evaluation.read(out / "tuned.parquet")) == 2
    capsys.readouterr()
    assert main(["compare", str(out / "cruise.parquet"), str(out / "tuned.parquet")]) == 0
    printed = capsys.readouterr().out
    assert "cruise" in printed
    assert "tuned" in printed


def test_a_recipe_of_another_package_is_printed_and_used(package, capsys):
    assert main(["recipe", "cruise-fast", "--json"]) == 0
    sections = json.loads(capsys.readouterr().out)
    assert list(sections) == ["pretrain", "finetune", "catk", "gcsl"]
    assert sections["finetune"]["learning_rate"] == 0.1
    assert main(["recipe"]) == 0
    assert "cruise-fast Large steps." in " ".join(capsys.readouterr().out.split())


def test_a_data_source_of_another_package_is_converted_by_name(package, capsys):
    raw, converted = package / "raw", package / "drives"
    raw.mkdir()
    (raw / "monday.drive").write_text("first 0 10\nsecond 5 12\n")
    words = ["convert", str(raw), str(converted), "--from", "drives", "--split", "training", "--jobs", "1"]
    assert main(words) == 0
    assert "2 scenarios converted, 0 lost" in capsys.readouterr().out
    assert sorted(ScenarioDataset(converted, "training").scenario_ids) == ["first", "second"]


def test_names_of_other_packages_are_offered_when_one_is_mistyped(package, capsys):
    for words, near in [
        (["evaluate", "cruis", "--data", "synthetic", "--out", str(package)], "did you mean 'cruise'"),
        (["convert", "a", "b", "--from", "drive"], "did you mean 'drives'"),
        (["recipe", "cruise-fst"], "did you mean 'cruise-fast'"),
    ]:
        assert main(words) == 2
        assert near in capsys.readouterr().err


COMPUTES_AT_IMPORT = """
import torch
from rlftsim.recipes.smart import smart_demo_rlftsim
RATE = float(torch.logspace(-4, -4, 1)[0].double().round(decimals=6))
def slow_start():
    return replace(smart_demo_rlftsim(), finetune=FinetuneConfig(learning_rate=RATE))
"""
COMPUTES_IN_RECIPE = """
import torch
from rlftsim.recipes.smart import smart_demo_rlftsim
def slow_start():
    rate = float(torch.logspace(-4, -4, 1)[0].double().round(decimals=6))
    return replace(smart_demo_rlftsim(), finetune=FinetuneConfig(learning_rate=rate))
"""


@pytest.mark.parametrize("code", [COMPUTES_AT_IMPORT, COMPUTES_IN_RECIPE], ids=["when imported", "in its recipe"])
def test_a_recipe_that_computes_with_torch_has_a_help_text(code, tmp_path):
    """In a process of its own, where help starts without torch."""
    imports = "from dataclasses import replace\nfrom rlftsim.training.reward import FinetuneConfig\n"
    entry_points = {"rlftsim.recipes": {"slow-start": "computing_package:slow_start"}}
    site = install(tmp_path / "site", "computing_package", imports + code, entry_points)
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(site), *sys.path])}
    command = [sys.executable, "-m", "rlftsim", "finetune", "slow-start", "--help"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr
    assert done.stderr == ""
    assert re.search(r"--finetune\.learning-rate FLOAT.*default: 0\.0001\b", done.stdout, re.DOTALL)

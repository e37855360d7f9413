"""Models in the box are found without a document."""

import tiny
from rlftsim.cli.main import main
from rlftsim.policies.calibrated.policy import CalibratedTokenPolicy
from rlftsim.policies.registry import load_policy
from rlftsim.training.config import FEATURES


def test_each_listed_model_can_be_used_by_its_name(capsys):
    assert main(["models"]) == 0
    lines = capsys.readouterr().out.splitlines()
    names = [line.split()[0] for line in lines]
    assert {"constant_velocity", "demo-base", "demo-tuned", "demo-goals", "trafficbots-base"} <= set(names)
    assert all(len(line.split()) > 4 for line in lines)
    for name in names:
        load_policy(name)


def test_the_refusal_to_export_a_calibrated_model_names_the_smart_model_below_it_if_that_can_be(tmp_path, capsys):
    run, out = tmp_path / "run", str(tmp_path / "x.safetensors")
    base = tiny.tiny_policy(tiny.small_vocabulary(tiny.pack_scenarios(2)))
    CalibratedTokenPolicy(base, FEATURES).save_pretrained(run / "model")
    assert main(["model", "export", str(run), out]) == 2
    assert f"export {run / 'model' / 'base'}, which" in capsys.readouterr().err
    assert main(["model", "export", str(run / "model" / "base"), out]) == 0
    assert main(["model", "export", "demo-tuned", out]) == 2
    assert "a model with continuation_scores has no form in the public CAT-K code" in capsys.readouterr().err

"""Models in the box are found without a document."""

from rlftsim.cli.main import main
from rlftsim.policies.registry import load_policy


def test_each_listed_model_can_be_used_by_its_name(capsys):
    assert main(["models"]) == 0
    lines = capsys.readouterr().out.splitlines()
    names = [line.split()[0] for line in lines]
    assert {"constant_velocity", "demo-base", "demo-tuned", "demo-goals", "trafficbots-base"} <= set(names)
    assert all(len(line.split()) > 4 for line in lines)
    for name in names:
        load_policy(name)

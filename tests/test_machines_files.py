"""The image and the workflow: what they name exists, and the image does not run as root."""

import re
import tomllib
from pathlib import Path

from run_dockerfile import steps

ROOT = Path(__file__).parents[1]


def test_the_image_copies_what_is_there_and_runs_as_a_user():
    instructions = steps()
    copied = [name for kind, rest in instructions if kind == "COPY" for name in rest.split()[:-1]]
    assert all((ROOT / name).exists() for name in copied)
    kept = {line.removeprefix("!") for line in (ROOT / ".dockerignore").read_text().splitlines() if line[0] == "!"}
    assert kept == set(copied)
    users = [rest for kind, rest in instructions if kind == "USER"]
    assert users == ["rlftsim"]
    assert [kind for kind, _ in instructions].index("USER") < [kind for kind, _ in instructions].index("ENTRYPOINT")


def test_the_workflow_runs_what_the_project_has_on_every_python_that_it_names():
    workflow = (ROOT / ".github" / "workflows" / "tests.yml").read_text()
    assert (ROOT / ".ci" / "run").exists()
    assert "run: .ci/run" in workflow
    pythons = re.search(r"python: \[(.*)\]", workflow)[1].replace('"', "").split(", ")
    project = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
    assert project["requires-python"] == f">={pythons[0]}"
    named = [line.rpartition(" ")[2] for line in project["classifiers"] if "Python :: 3." in line]
    assert set(named) <= set(pythons)

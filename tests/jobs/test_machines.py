"""Many processes for one piece of work: the array of the documents, and kills at random moments."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import rlftsim
from rlftsim.evaluation.results import Evaluation

ROOT = Path(__file__).parents[2]
ENVIRONMENT = {**os.environ, "PYTHONPATH": str(Path(rlftsim.__file__).parents[1])}

pytestmark = pytest.mark.slow


def test_the_array_of_the_documents_runs_as_shell_processes(tmp_path):
    page = (ROOT / "docs" / "machines.md").read_text()
    array = next(block for block in page.split("```") if "#SBATCH" in block).partition("\n")[2]
    join = next(line for line in page.splitlines() if line.startswith("rlftsim join "))
    small = {"runs/rlft": "constant_velocity", "data/womd": "synthetic", "--jobs 16": "--limit 5 --num-rollouts 2"}
    for old, new in {**small, "/64": "/2"}.items():
        assert old in array
        array = array.replace(old, new)
    for old, new in small.items():
        join = join.replace(old, new)

    def run(script, number):
        script = script.replace("rlftsim ", f"{sys.executable} -m rlftsim ", 1)
        environment = {**ENVIRONMENT, "SLURM_ARRAY_TASK_ID": str(number)}
        return subprocess.Popen(["bash", "-c", script], env=environment, cwd=tmp_path, stderr=subprocess.PIPE)

    folder = tmp_path / "runs" / "evaluations"
    early = run(join + " --limit 5 --num-rollouts 2", 0)
    assert b"is not there, so no share has begun: check the path" in early.communicate(timeout=240)[1]
    assert early.returncode == 1
    assert not folder.exists()
    shares = [run(array, number) for number in (1, 2)]
    assert [(share.communicate(timeout=240), share.returncode)[1] for share in shares] == [0, 0]
    assert [path.name for path in folder.iterdir()] == ["constant_velocity.parquet"]
    assert len(Evaluation.read(folder / "constant_velocity.parquet")) == 5


def test_work_that_is_killed_at_random_moments_ends_with_the_same_bytes(tmp_path):
    command = [sys.executable, ROOT / "benchmarks" / "kills.py", tmp_path, "--kills", "10", "--scenarios", "6"]
    done = subprocess.run(command, env=ENVIRONMENT, capture_output=True, text=True, timeout=900)
    assert done.returncode == 0, done.stdout + done.stderr
    lines = [line for line in done.stdout.splitlines() if line.startswith("| ")]
    rows = [line.split("|")[1:-1] for line in lines[1:]]
    assert [(row[0].strip(), row[1].strip()) for row in rows] == [
        (backend, name)
        for backend in ("inline", "processes", "shares")
        for name in ("convert", "evaluate", "simulate", "augment", "score --explain", "submit build")
    ]
    for row in rows:
        *kills, num_rounds, different = (int(cell) for cell in row[2:])
        assert sum(kills) >= 2
        assert num_rounds >= 1
        assert different == 0

"""The speed table prints what it measures, says what it cannot, and tries the rows of a GPU on the CPU."""

import subprocess
import sys
from pathlib import Path

import pytest
import torch

BENCHMARK = Path(__file__).parents[1] / "benchmarks" / "speed.py"


@pytest.fixture(scope="module")
def work(tmp_path_factory):
    """Folder of the inputs, which are made once."""
    return tmp_path_factory.mktemp("speed")


@pytest.mark.official
def test_the_speed_table_has_a_line_for_each_row_and_continues_where_it_was_stopped(shared, work, tmp_path):
    words = ["--shared", shared, "--rows", "metric", "gpu", "--repeats", "1", "--out", tmp_path / "table.md"]
    command = [str(word) for word in (sys.executable, BENCHMARK, work, *words)]

    first = subprocess.run(command, check=True, capture_output=True, text=True).stdout
    again = subprocess.run(command, check=True, capture_output=True, text=True).stdout

    rows = [line for line in first.splitlines() if line.startswith("| metric, 32 rollouts")]
    assert len(rows) == 1
    assert 0 < float(rows[0].split("|")[5]) < 60  # CPU seconds of this version
    assert torch.cuda.is_available() or "| rollouts, tiny, A, 32-true | no GPU |" in first
    assert rows[0] in again  # to the last digit: kept, not measured again
    assert rows[0] in (tmp_path / "table.md").read_text()


@pytest.mark.slow
@pytest.mark.official
def test_a_dry_run_does_every_work_of_the_gpu_in_half_precision_on_the_cpu(shared, work):
    words = ["--shared", shared, "--rows", "gpu", "--repeats", "1", "--dry-run"]
    command = [str(word) for word in (sys.executable, BENCHMARK, work, *words)]

    printed = subprocess.run(command, check=True, capture_output=True, text=True).stdout

    rows = [line for line in printed.splitlines() if "wall s on the GPU" in line]
    assert [line.split(",")[0] for line in rows] == [
        "| metric", "| rollouts", "| pre-training update", "| CAT-K update", "| fine-tuning update",
    ]  # fmt: skip
    assert all("bf16-mixed" in line for line in rows[1:])

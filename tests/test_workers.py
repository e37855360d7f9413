"""Work in several processes, and plain scripts that start it."""

import os
import subprocess
import sys
from pathlib import Path

import pytest

import rlftsim
from rlftsim.errors import ConfigError, DataError
from rlftsim.workers import run_tasks

SCRIPT = """
import rlftsim.workers

def double(item, advance, is_stopped):
    advance(1)
    return 2 * item

def main():
    print(rlftsim.workers.run_tasks(double, [1, 2, 3], jobs={jobs}, advance=lambda count: None))

{call}
"""


def run_script(tmp_path, text, *options):
    script = tmp_path / "script.py"
    script.write_text(text)
    environment = {**os.environ, "PYTHONPATH": str(Path(rlftsim.__file__).parents[1])}
    command = [sys.executable, *options, str(script)]
    return subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120, cwd=tmp_path)


def double(item, advance, is_stopped):
    advance(1)
    return 2 * item


def fail(item, advance, is_stopped):
    raise DataError(f"item {item} is broken")


def exit_at_once(item, advance, is_stopped):
    os._exit(1)


@pytest.mark.parametrize(("quota", "cores"), [("max 100000", 6), ("250000 100000", 3), ("10000 100000", 1), ("", 6)])
def test_a_container_may_have_fewer_cores_than_the_machine(quota, cores, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(6)), raising=False)
    (tmp_path / "cpu.max").write_text(quota)
    monkeypatch.setattr(rlftsim.workers, "CPU_QUOTA", tmp_path / "cpu.max")
    assert rlftsim.workers.usable_cores() == cores


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_the_order_of_the_items(jobs):
    done = []
    assert run_tasks(double, [3, 1, 2], jobs=jobs, advance=done.append) == [6, 2, 4]
    assert sum(done) <= 3


@pytest.mark.parametrize("jobs", [1, 2])
def test_the_error_of_a_task_is_raised(jobs):
    with pytest.raises(DataError, match="is broken"):
        run_tasks(fail, [1, 2], jobs=jobs, advance=lambda count: None)


def test_a_process_that_died_is_reported():
    with pytest.raises(DataError, match="a worker process died"):
        run_tasks(exit_at_once, [1, 2], jobs=2, advance=lambda count: None)


def test_a_task_that_cannot_be_pickled_is_refused():
    with pytest.raises(ConfigError, match=r"cannot be handed to other processes .* set jobs=1"):
        run_tasks(lambda item, advance, is_stopped: item, [1, 2], jobs=2, advance=lambda count: None)


def test_a_script_with_the_main_guard_may_start_processes(tmp_path):
    done = run_script(tmp_path, SCRIPT.format(jobs=2, call='if __name__ == "__main__":\n    main()'))
    assert (done.stdout, done.returncode) == ("[2, 4, 6]\n", 0), done.stderr


def test_a_script_without_the_main_guard_gets_a_hint_and_starts_nothing(tmp_path):
    done = run_script(tmp_path, SCRIPT.format(jobs=2, call="print('once')\nmain()"))
    assert done.returncode == 1
    assert done.stdout == "once\n"  # no other process ran the script again
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("rlftsim.errors.ConfigError: ")
    assert 'script.py, line 12, starts other processes: put it under `if __name__ == "__main__":`' in last
    assert "bootstrapping" not in done.stderr


def test_a_script_without_the_main_guard_may_work_in_one_process(tmp_path):
    done = run_script(tmp_path, SCRIPT.format(jobs=1, call="main()"))
    assert (done.stdout, done.returncode) == ("[2, 4, 6]\n", 0), done.stderr


def test_a_package_that_is_run_as_a_module_needs_no_guard(tmp_path):
    """As `python -m rlftsim` does: processes do not import its __main__ again."""
    package = tmp_path / "doubling"
    package.mkdir()
    (package / "__init__.py").write_text("")
    (package / "work.py").write_text(SCRIPT.format(jobs=2, call=""))
    (package / "__main__.py").write_text("from doubling.work import main\nmain()\n")
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(rlftsim.__file__).parents[1]), str(tmp_path)])}
    command = [sys.executable, "-m", "doubling"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True, timeout=120)
    assert (done.stdout, done.returncode) == ("[2, 4, 6]\n", 0), done.stderr

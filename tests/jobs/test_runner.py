"""Work in several processes, and plain scripts that start it."""

import json
import os
import signal
import socket
import subprocess
import sys
from functools import partial
from pathlib import Path

import numpy as np
import pytest

import rlftsim
from rlftsim.errors import ConfigError, DataError
from rlftsim.jobs.processes import Processes, SetAside, log_item
from rlftsim.jobs.runner import Inline, Machines, Share, Unfinished, Work, check_finished, choose_runner, select_items

SCRIPT = """
import rlftsim.jobs.runner

def double(item, advance, is_stopped):
    advance(1)
    return 2 * item

def main():
    runner = rlftsim.jobs.runner.choose_runner({jobs}, 3)
    print(runner.run(double, [1, 2, 3], advance=lambda count: None))

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


class Unreadable(Exception):
    def __init__(self, one, other):
        super().__init__(f"{one} {other}")


def fail_unreadably(item, advance, is_stopped):
    raise Unreadable("broken", "beyond reading")


def write_or_die(item, advance, is_stopped):
    advance(1)
    if item == "exit":
        os._exit(7)
    if item == "swallow":
        np.ones(1 << 56)  # more than any machine has
    return item


def die_once(path, advance, is_stopped):
    if not path.exists():
        path.touch()
        os.kill(os.getpid(), signal.SIGKILL)
    return path.name


def test_each_finished_item_leaves_a_line_of_json(tmp_path):
    log = tmp_path / "items.jsonl"
    for runner in (Inline(log), Processes(2, item_log=log)):
        runner.run(double, [3, 1, 2], advance=lambda count: None, describe=lambda item: f"item {item}")
    lines = [json.loads(line) for line in log.read_text().splitlines()]
    assert [line["item"] for line in lines[:3]] == ["item 3", "item 1", "item 2"]
    assert sorted(line["item"] for line in lines[3:]) == ["item 1", "item 2", "item 3"]
    assert {line["machine"] for line in lines} == {socket.gethostname()}
    assert all(0 <= line["seconds"] < 60 for line in lines)


@pytest.mark.parametrize(("quota", "cores"), [("max 100000", 6), ("250000 100000", 3), ("10000 100000", 1), ("", 6)])
def test_a_container_may_have_fewer_cores_than_the_machine(quota, cores, tmp_path, monkeypatch):
    monkeypatch.setattr(os, "sched_getaffinity", lambda pid: set(range(6)), raising=False)
    (tmp_path / "cpu.max").write_text(quota)
    monkeypatch.setattr(rlftsim.jobs.runner, "CPU_QUOTA", tmp_path / "cpu.max")
    assert rlftsim.jobs.runner.usable_cores() == cores


@pytest.mark.parametrize("jobs", [1, 2])
def test_results_come_in_the_order_of_the_items(jobs):
    done = []
    assert choose_runner(jobs, 3).run(double, [3, 1, 2], advance=done.append) == [6, 2, 4]
    assert sum(done) == 3


def test_an_error_that_cannot_be_read_back_is_shown_with_its_traceback():
    with pytest.raises(RuntimeError, match="Unreadable: broken beyond reading"):
        choose_runner(2, 2).run(fail_unreadably, [1, 2], advance=lambda count: None)


@pytest.mark.parametrize("jobs", [1, 2])
def test_the_error_of_a_task_is_raised(jobs):
    with pytest.raises(DataError, match="is broken"):
        choose_runner(jobs, 2).run(fail, [1, 2], advance=lambda count: None)


def test_an_item_that_kills_its_process_is_tried_again_then_set_aside_and_all_others_are_done(tmp_path, caplog):
    done = []
    with pytest.raises(
        SetAside, match=r"^2 pieces .* 3 times and are set aside: (exit|swallow) .* All others are"
    ) as caught:
        Processes(2).run(write_or_die, items := ["exit", "a", "swallow", "b", "c"], advance=done.append, describe=str)
    assert "exit (exit status 7)" in str(caught.value)
    assert "swallow (out of memory)" in str(caught.value)
    assert "\n" not in str(caught.value)
    assert caught.value.exit_status == 1
    assert sum(done) == len(items) - 2  # what a dead process had reported does not count


def test_an_item_whose_process_died_once_gets_its_result(tmp_path):
    paths = [tmp_path / name for name in "abc"]
    assert Processes(2).run(die_once, paths, advance=lambda count: None) == ["a", "b", "c"]


def test_a_run_may_stop_at_the_first_dead_process():
    with pytest.raises(DataError, match=r"a worker process died \(exit status 7; .*__name__ == .*run the same command"):
        Processes(2, on_death="stop").run(write_or_die, ["a", "exit"], advance=lambda count: None)


def test_a_task_that_cannot_be_pickled_is_refused():
    with pytest.raises(ConfigError, match=r"cannot be handed to other processes .* set jobs=1"):
        Processes(2).run(lambda item, advance, is_stopped: item, [1, 2], advance=lambda count: None)


@pytest.mark.parametrize("of", [1, 3, 4, 20])
def test_shares_have_every_item_once(of):
    items = list(range(14))
    shares = [Share.parse(f"{k}/{of}", Inline()) for k in range(1, of + 1)]
    selected = [select_items(share, items) for share in shares]
    assert sorted(item for share in selected for item in share) == items
    assert max(map(len, selected)) - min(map(len, selected)) <= 1
    assert select_items(Share.parse("join", Inline()), items) == []
    assert select_items(Processes(2), items) == items


@pytest.mark.parametrize("text", ["3", "0/4", "5/4", "a/4", "1/0", "-1/4", "1.5/4", "/", ""])
def test_a_share_that_is_none_is_refused(text):
    with pytest.raises(ConfigError, match="counted from 1 to 4" if text in ("0/4", "5/4") else "--share"):
        Share.parse(text, Inline())


def test_a_share_ends_well_while_others_are_at_work_and_joining_does_not():
    with pytest.raises(
        Unfinished, match=r"convert: share 2/4 is done; 5 of 9 pieces are left .* `rlftsim join`"
    ) as caught:
        check_finished(Share(2, 4, Inline()), 5, 9, "convert")
    assert caught.value.exit_status == 0
    with pytest.raises(DataError, match="5 of 9 pieces are missing: run the shares again"):
        check_finished(Share.parse("join", Inline()), 5, 9, "convert")
    check_finished(Share(2, 4, Inline()), 0, 9, "convert")


def test_a_script_with_the_main_guard_may_start_processes(tmp_path):
    done = run_script(tmp_path, SCRIPT.format(jobs=2, call='if __name__ == "__main__":\n    main()'))
    assert (done.stdout, done.returncode) == ("[2, 4, 6]\n", 0), done.stderr


INTERRUPTED = """
import os, signal, time
from multiprocessing import active_children
import rlftsim.jobs.processes

if __name__ == "__main__":
    start = rlftsim.jobs.processes._Worker.__init__

    def start_then_interrupt(worker):
        start(worker)
        if len(active_children()) == 2:
            time.sleep({seconds})
            os.killpg(0, signal.SIGINT)  # as a terminal does, to the processes that are starting, too

    rlftsim.jobs.processes._Worker.__init__ = start_then_interrupt
    try:
        rlftsim.jobs.processes.Processes(2).run(print, ["an item", "another"], advance=lambda count: None)
    except KeyboardInterrupt:
        print("stopped", active_children())
"""


@pytest.mark.parametrize("seconds", [0.0, 0.05, 0.3])
def test_ctrl_c_while_processes_start_ends_them_silently(tmp_path, seconds):
    (tmp_path / "script.py").write_text(INTERRUPTED.format(seconds=seconds))
    done = subprocess.run(
        [sys.executable, "script.py"],
        env={**os.environ, "PYTHONPATH": str(Path(rlftsim.__file__).parents[1])},
        capture_output=True, text=True, timeout=120, cwd=tmp_path, start_new_session=True,
        # a shell's background job ignores Ctrl-C, and so would everything it starts
        preexec_fn=partial(signal.signal, signal.SIGINT, signal.default_int_handler),
    )  # fmt: skip
    assert (done.stdout, done.stderr) == ("stopped []\n", "")


def test_a_script_without_the_main_guard_gets_a_hint_and_starts_nothing(tmp_path):
    done = run_script(tmp_path, SCRIPT.format(jobs=2, call="print('once')\nmain()"))
    assert done.returncode == 1
    assert done.stdout == "once\n"  # no other process ran the script again
    last = done.stderr.strip().splitlines()[-1]
    assert last.startswith("rlftsim.errors.ConfigError: ")
    assert 'script.py, line 13, starts other processes: put it under `if __name__ == "__main__":`' in last
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


def test_lines_about_items_are_added_to_no_file_of_other_content(tmp_path):
    log, manifest = tmp_path / "items.jsonl", tmp_path / "manifest.json"
    log_item(log, "a", 1.0, "host")
    manifest.write_text('{"format": "rlftsim scenarios"}')
    assert Machines(item_log=log).runner(1, "skip") is not None
    for settings in (Machines(item_log=manifest), Work(item_log=manifest, on_error="stop")):
        with pytest.raises(ConfigError, match="no log of items: name another file by --item-log"):
            settings.runner(2, "stop")

"""The same work by one driver and by shares of it: the same bytes, once each."""

import errno
import fcntl
import json
import os
import shutil
import threading
import time

import pytest

from full_disk import limit_files_to
from rlftsim.cli.main import main
from rlftsim.cli.signatures import read_arguments
from rlftsim.errors import ConfigError, DataError, NotYetError
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate
from rlftsim.jobs import folder as folders
from rlftsim.jobs.folder import Lease
from rlftsim.jobs.runner import Inline, Machines, Share, Unfinished, Work
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.scenario.convert import convert
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.verbs.commands import COMMANDS

CONFIG = EvaluateConfig(num_rollouts=2, limit=9)


@pytest.fixture
def impatient(monkeypatch):
    """A share waits for others no longer than this."""
    monkeypatch.setattr(folders, "SECONDS_TO_WAIT", 0.3)


@pytest.fixture
def source(tmp_path, make_message, make_tfrecord):
    """Seven files of three scenarios; two scenarios have the same id."""
    for number in range(7):
        messages = [make_message(f"{number}-{k}" if number < 6 or k else "0-0") for k in range(3)]
        make_tfrecord(tmp_path / "womd" / f"training.tfrecord-{number:05d}-of-00007", *messages)
    return tmp_path / "womd"


def contents(folder):
    return {path.relative_to(folder).as_posix(): path.read_bytes() for path in folder.rglob("*") if path.is_file()}


def by_shares(numbers, of, work):
    """Run shares one after the other; all but the last say that others are left."""
    for number in numbers[:-1]:
        with pytest.raises(Unfinished, match=f"share {number}/{of} is done"):
            work(Share(number, of, Inline()))
    return work(Share(numbers[-1], of, Inline()))


@pytest.mark.parametrize("order", [(1, 2, 3, 4), (4, 2, 1, 3)])
def test_shares_convert_to_the_same_bytes_in_any_order(source, tmp_path, order):
    whole = convert(source, tmp_path / "whole", jobs=1, show_progress=False)
    shared = by_shares(order, 4, lambda share: convert(source, tmp_path / "shared", runner=share, show_progress=False))
    assert contents(tmp_path / "shared") == contents(tmp_path / "whole")
    assert (shared.converted, shared.duplicates) == (whole.converted, whole.duplicates)


def test_shares_evaluate_to_the_same_bytes(tmp_path):
    def work(share):
        return evaluate(
            ConstantVelocity(), "synthetic", tmp_path / "shared", CONFIG, name="a", runner=share, show_progress=False
        )

    evaluate(ConstantVelocity(), "synthetic", tmp_path / "whole", CONFIG, name="a", show_progress=False)
    by_shares((2, 1, 3), 3, work)
    assert contents(tmp_path / "shared") == contents(tmp_path / "whole")
    with pytest.raises(ConfigError, match="shares meet in a folder"):
        evaluate(ConstantVelocity(), "synthetic", None, CONFIG, runner=Share(1, 2, Inline()))


SIMULATE = ["simulate", "constant_velocity", "--data", "synthetic", "--limit", "5", "--num-rollouts", "2"]
AUGMENT = ["augment", "constant_velocity", "--num-rollouts", "2", "--top-k", "None", "--scenarios-per-part", "2"]


@pytest.fixture
def augment(tmp_path):
    """Words of an augmentation of five scenarios."""
    scenarios = ScenarioDataset("synthetic", "validation")
    write_dataset([scenarios[position] for position in range(5)], tmp_path / "set", split="training")
    return [*AUGMENT, "--data", str(tmp_path / "set")]


@pytest.mark.parametrize("verb", ["simulate", "augment"])
def test_simulations_and_augmented_goals_are_the_same_by_processes_and_by_shares(verb, augment, tmp_path, capsys):
    words = {"simulate": SIMULATE, "augment": augment}[verb]

    def run(out, *flags):
        return main([*words, "--out", str(tmp_path / out), *flags])

    def files(out):
        found = contents(tmp_path / out)
        return {name: found[name] for name in found if name != "environment.json"}  # words of the command

    assert run("whole") == 0
    assert run("processes", "--jobs", "2", "--item-log", str(tmp_path / "items.jsonl")) == 0
    assert files("processes") == files("whole")
    assert len((tmp_path / "items.jsonl").read_text().splitlines()) == {"simulate": 5, "augment": 3}[verb]
    assert run("shares", "--share", "2/2") == 0
    assert f"{verb}: share 2/2 is done" in capsys.readouterr().err
    assert main(["join", *words, "--out", str(tmp_path / "shares")]) == 1
    assert "pieces are missing: run the shares again" in capsys.readouterr().err
    assert run("shares", "--share", "1/2") == 0
    assert files("shares") == files("whole")
    before = {path: path.stat().st_mtime_ns for path in (tmp_path / "shares").glob("*[0-9a-f].*")}
    assert run("shares") == 0  # nothing is done twice
    assert all(path.stat().st_mtime_ns == stamp for path, stamp in before.items())


@pytest.mark.parametrize("verb", ["simulate", "augment"])
def test_a_file_that_was_cut_off_is_made_again_and_not_joined(verb, augment, tmp_path, capsys):
    words = [*{"simulate": SIMULATE, "augment": augment}[verb], "--out", str(tmp_path / "out")]
    assert main(words) == 0
    before = contents(tmp_path / "out")
    cut = sorted(path for path in (tmp_path / "out").iterdir() if path.suffix in (".npz", ".parquet"))[1]
    cut.write_bytes(cut.read_bytes()[:-1000])
    capsys.readouterr()
    assert main(["join", *words]) == 1
    err = capsys.readouterr().err
    assert err.count(f"{cut} has to be made again: cannot be read") == 1
    assert f"{verb}: 1 of" in err
    assert main(words) == 0
    assert contents(tmp_path / "out") == before


@pytest.mark.parametrize("verb", ["simulate", "augment"])
def test_a_second_simulation_or_augmentation_in_the_same_folder_is_refused(verb, augment, tmp_path, capsys):
    words = [*{"simulate": SIMULATE, "augment": augment}[verb], "--out", str(tmp_path / "out")]
    with Lease(tmp_path / "out" / ".lock", Inline(), "works in"):
        assert main(words) == 1
    assert "another process works in" in capsys.readouterr().err
    assert [path.name for path in (tmp_path / "out").iterdir()] == [".lock"]
    assert main([*words, "--jobs", "0"]) == 2


def test_a_share_does_its_own_files_only_and_repeats_none(source, tmp_path):
    for _ in range(2):
        with pytest.raises(Unfinished, match="5 of 7 pieces are left"):
            convert(source, tmp_path / "data", runner=Share(1, 4, Inline()), show_progress=False)
    shards = tmp_path / "data" / "shards" / "training"
    assert sorted(int(path.name[18:23]) for path in shards.glob("*.arrow")) == [0, 4]


def test_a_share_that_others_finish_behind_is_put_together_by_join(source, tmp_path, capsys):
    words = ["convert", str(source), str(tmp_path / "data"), "--jobs", "1"]
    assert main([*words, "--share", "1/2"]) == 0
    assert "share 1/2 is done; 3 of 7 pieces are left to other shares" in capsys.readouterr().err
    assert main(["join", *words]) == 1  # so that what depends on it does not start
    assert "3 of 7 pieces are missing: run the shares again" in capsys.readouterr().err
    # the last share ends while another one, started twice by mistake, is still at work
    with Lease(tmp_path / "data" / "INCOMPLETE", Share(1, 2, Inline()), "is converting to"):
        assert main([*words, "--share", "2/2"]) == 0
        assert "other shares are at work" in capsys.readouterr().err
        assert main(["join", *words]) == 1
        assert "another process is converting to" in capsys.readouterr().err
    assert main(["join", *words]) == 0
    convert(source, tmp_path / "whole", jobs=1, show_progress=False)
    assert contents(tmp_path / "data") == contents(tmp_path / "whole")


def test_a_source_that_changed_after_its_share_is_not_joined(source, tmp_path, make_message, make_tfrecord):
    with pytest.raises(Unfinished):
        convert(source, tmp_path / "data", runner=Share(1, 2, Inline()), show_progress=False)
    make_tfrecord(source / "training.tfrecord-00002-of-00007", make_message("new"))
    with pytest.raises(Unfinished, match="1 of 7 pieces are left"):
        convert(source, tmp_path / "data", runner=Share(2, 2, Inline()), show_progress=False)


@pytest.mark.parametrize("where", [[], ["--share", "1/2"]])
def test_a_line_for_each_piece_is_a_flag(where, tmp_path):
    words = ["evaluate", "constant_velocity", "--data", "synthetic", "--limit", "5", "--num-rollouts", "2"]
    places = ["--out", str(tmp_path / "out"), "--item-log", str(tmp_path / "items.jsonl")]
    assert main([*words, *places, *where]) == 0
    lines = [json.loads(line) for line in (tmp_path / "items.jsonl").read_text().splitlines()]
    assert [line["item"] for line in lines] == ["scenarios 0 to 3", "scenarios 4 to 4"][: 1 if where else 2]


def test_a_join_of_a_mistyped_folder_leaves_nothing_and_says_so(source, tmp_path, capsys):
    settings = ["--data", "synthetic", "--limit", "5", "--num-rollouts", "2"]
    assert main(["join", "evaluate", "constant_velocity", *settings, "--out", str(tmp_path / "ouT")]) == 1
    assert "constant_velocity.parts is not there, so no share has begun: check the path" in capsys.readouterr().err
    assert main(["join", "convert", str(source), str(tmp_path / "datA")]) == 1
    assert "datA is not there, so no share has begun: check the path" in capsys.readouterr().err
    assert main(["join", "synthesize", str(tmp_path / "madE"), "--num-scenarios", "2"]) == 1
    assert "madE is not there, so no share has begun: check the path" in capsys.readouterr().err
    assert [path.name for path in tmp_path.iterdir()] == ["womd"]


@pytest.mark.parametrize(
    ("first", "second"), [(Inline(), Inline()), (Inline(), Share(1, 2, Inline())), (Share(1, 2, Inline()), Inline())]
)
def test_a_second_driver_is_refused_with_the_owner_and_age_of_the_first(tmp_path, first, second, impatient):
    with Lease(tmp_path / "lock", first, "works in"):
        owner = rf"another process works in .* \(.* process {os.getpid()}, for 0:00:0\d\): wait for it"
        with pytest.raises(NotYetError, match=owner):
            Lease(tmp_path / "lock", second, "works in")
        with pytest.raises(NotYetError, match=owner):  # also the same share twice
            Lease(tmp_path / "lock", first, "works in")


def test_shares_work_side_by_side_and_the_last_to_end_is_alone(tmp_path):
    one, two = (Lease(tmp_path / "lock", Share(k, 2, Inline()), "works in") for k in (1, 2))
    with one:
        with two:
            assert not two.is_alone
            with pytest.raises(Unfinished, match="share 2/2 is done, other shares are at work"):
                two.finish("work")
        one.finish("work")
        assert one.is_alone
        one.remove()
    assert list(tmp_path.iterdir()) == []


def wait_behind(holder, end):
    """Begin a share while another driver holds the folder; that one ends a moment later, in its own way."""
    ending = threading.Timer(0.3, end)
    with holder:
        ending.start()
        try:
            return Lease(holder._path, Share(1, 2, Inline()), "works in")
        finally:
            ending.join()


def test_a_share_waits_for_the_driver_that_puts_the_result_together_and_finds_nothing_left(tmp_path):
    path = tmp_path / "a.parts" / ".lock"
    finishing = Lease(path, Inline(), "works in")

    def end():
        finishing.remove()
        finishing.__exit__(None, None, None)

    with pytest.raises(Unfinished, match="another process has just finished this work: nothing is left to do"):
        wait_behind(finishing, end)
    assert not [p for p in tmp_path.rglob("*") if p.is_file()]


def test_a_share_takes_over_from_a_driver_that_was_stopped(tmp_path):
    path = tmp_path / "a.parts" / ".lock"
    killed = Lease(path, Inline(), "works in")
    start = time.monotonic()
    with wait_behind(killed, lambda: killed.__exit__(None, None, None)) as mine:
        assert not mine.is_alone
    assert 0.2 < time.monotonic() - start < folders.SECONDS_TO_WAIT


def test_the_commands_that_join_takes_are_those_with_shares():
    annotations = {
        name: [argument.annotation for argument in read_arguments(command.function).values()]
        for name, command in COMMANDS.items()
    }
    with_shares = {name for name, kinds in annotations.items() if any(kind in (Machines, Work) for kind in kinds)}
    assert with_shares == {name for name, command in COMMANDS.items() if command.has_shares}


@pytest.mark.parametrize(
    ("text", "whom"),
    [
        (b"\nahead process 1 since 2999-01-01T00:00:00+00:00\n", r" \(ahead process 1, for 0:00:00\)"),
        (b"\nhost process 1 since 2026-01-01T00:00:00\n", ""),  # no zone
        (b"\xff\xfe since\n", ""),
        (b"", ""),
    ],
)
def test_a_lock_that_a_clock_or_disk_has_spoiled_is_refused_in_one_line(tmp_path, text, whom):
    with Lease(tmp_path / "lock", Inline(), "works in"):
        (tmp_path / "lock").write_bytes(text)
        with pytest.raises(NotYetError, match=rf"works in {tmp_path}{whom}: wait for it"):
            Lease(tmp_path / "lock", Inline(), "works in")


def test_the_lock_of_the_share_that_finishes_is_text_without_gaps(tmp_path):
    with Lease(tmp_path / ".lock", Share(1, 2, Inline()), "works in", note="In work.") as lease:
        lease.finish("work")
        text = (tmp_path / ".lock").read_text()
    assert text.startswith("In work.\n")
    assert "\0" not in text


@pytest.mark.parametrize("runner", [Inline(), Share(1, 2, Inline())])
@pytest.mark.parametrize("text", [b"of the user\n", b"\xff\xfe", b"\nlocal notes since 2020-01-01T00:00:00\n"])
def test_a_file_of_the_user_with_the_name_of_the_lock_stays(text, runner, tmp_path):
    lock = tmp_path / ".lock"
    lock.write_bytes(text)
    with pytest.raises(DataError, match=r"\.lock is no lock of `rlftsim`: rename it, or choose another folder\.$"):
        Lease(lock, runner, "works in")
    folders.remove_locks(lock)
    assert lock.read_bytes() == text


@pytest.mark.parametrize("text", ["", "\n", "\nold process 12 since 2026-01-01T00:00:00+00:00\n0\n"])
def test_a_lock_that_a_stopped_process_left_is_taken(text, tmp_path):
    (tmp_path / ".lock").write_text(text)
    with Lease(tmp_path / ".lock", Inline(), "works in") as lease:
        assert f"process {os.getpid()}" in (tmp_path / ".lock").read_text()
        lease.remove()
    assert not (tmp_path / ".lock").exists()


def test_a_share_that_ends_when_all_is_put_together_brings_nothing_back(tmp_path):
    folder = tmp_path / "a.parts"
    with Lease(folder / ".lock", Share(1, 2, Inline()), "works in") as late:
        shutil.rmtree(folder)  # by the share that took the lock as this one let it go
        with pytest.raises(Unfinished, match="nothing is left to do"):
            late.finish("work")
    assert list(tmp_path.iterdir()) == []


def test_a_disk_that_is_full_at_the_lock_is_named(tmp_path):
    with limit_files_to(10), pytest.raises(DataError, match=r"cannot write .*lock \(File too large\): make room"):
        Lease(tmp_path / "lock", Inline(), "works in")


def test_a_file_system_without_locks_notices_no_second_driver(tmp_path, monkeypatch):
    def refuse(*_):
        raise OSError(errno.ENOSYS, "Function not implemented")

    monkeypatch.setattr(fcntl, "flock", refuse)
    with Lease(tmp_path / "lock", Inline(), "works in"), Lease(tmp_path / "lock", Inline(), "works in"):
        pass

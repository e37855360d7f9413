"""Files are there whole or not at all."""

import errno
import os
import resource
import socket
import stat
import subprocess
import sys
import threading
from contextlib import nullcontext
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

from rlftsim.errors import DataError
from rlftsim.jobs.files import (
    append_text,
    errors_name,
    list_folder,
    remove_folder,
    remove_temporaries,
    save_tensors,
    write_atomically,
    write_text,
)


def names(folder):
    return sorted(path.name for path in folder.iterdir())


def test_a_failed_write_leaves_the_old_file_and_no_other(tmp_path, monkeypatch):
    write_text(tmp_path / "page.html", "old")

    def fail(*_):
        raise OSError(28, "No space left on device")

    monkeypatch.setattr(os, "fsync", fail)
    with pytest.raises(DataError, match=r"cannot write .*page\.html \(No space left on device\): make room"):
        write_text(tmp_path / "page.html", "new")
    assert names(tmp_path) == ["page.html"]
    assert (tmp_path / "page.html").read_text() == "old"


def test_what_killed_writers_left_of_a_file_is_removed_and_nothing_else(tmp_path):
    for name in (".a[1].json.host.12.tmp", ".a[1].json.other-host.7.tmp", ".b.json.host.12.tmp", "a[1].json"):
        (tmp_path / name).touch()
    remove_temporaries([tmp_path / "a[1].json"])
    assert names(tmp_path) == [".b.json.host.12.tmp", "a[1].json"]


def test_what_a_living_process_or_another_program_writes_stays(tmp_path):
    ended = subprocess.Popen(["true"])
    ended.wait()
    (tmp_path / "inner").mkdir()
    host, parent = socket.gethostname(), os.getppid()
    left, *others = (
        f".a.json.{host}.{ended.pid}.tmp", f".a.json.{host}.{parent}.tmp", f".b.json.{host}.{ended.pid}.tmp",
        f"inner/.a.json.{host}.{ended.pid}.tmp", ".x.123.tmp", ".a.json.123.tmp",
    )  # fmt: skip
    for name in (left, *others):
        (tmp_path / name).touch()
    remove_temporaries([tmp_path / "a.json"])
    assert not (tmp_path / left).exists()
    assert all((tmp_path / name).exists() for name in others)


def test_a_write_removes_what_killed_ones_of_the_same_file_left(tmp_path):
    ended = subprocess.Popen(["true"])
    ended.wait()
    host, parent = socket.gethostname(), os.getppid()
    left, *others = (
        f".a.json.{host}.{ended.pid}.tmp", f".a.json.{host}.{parent}.tmp", f".b.json.{host}.{ended.pid}.tmp",
        ".a.json.other-host.7.tmp", ".a.json.123.tmp",
    )  # fmt: skip
    for name in (left, *others):
        (tmp_path / name).touch()
    write_text(tmp_path / "a.json", "whole")
    assert names(tmp_path) == sorted([*others, "a.json"])


def test_a_folder_that_a_killed_writer_left_is_removed_whole(tmp_path):
    (tmp_path / ".set.host.12.tmp" / "shards").mkdir(parents=True)
    (tmp_path / ".set.host.12.tmp" / "shards" / "a").touch()
    remove_temporaries([tmp_path / "set"])
    assert names(tmp_path) == []


@pytest.mark.skipif(sys.platform != "linux", reason="asks /proc")
def test_a_temporary_of_a_process_whose_exit_status_nobody_collects_goes(tmp_path):
    with subprocess.Popen([sys.executable, "-c", ""], stdout=subprocess.PIPE) as process:
        temporary = tmp_path / f".a.json.{socket.gethostname()}.{process.pid}.tmp"
        temporary.touch()
        os.waitid(os.P_PID, process.pid, os.WEXITED | os.WNOWAIT)  # it has ended, and stays in the list
        os.kill(process.pid, 0)
        remove_temporaries([tmp_path / "a.json"])
        assert not temporary.exists()


def test_an_interrupted_write_leaves_nothing(tmp_path):
    def stopped(path):
        path.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_atomically(tmp_path / "page.html", stopped)
    assert names(tmp_path) == []


def test_a_folder_that_is_a_file_is_named(tmp_path):
    (tmp_path / "runs").write_text("")
    cause = r"cannot write .*runs/config\.json \((Not a directory|File exists)\)"
    with pytest.raises(DataError, match=rf"{cause}: \S+/runs is a file, not a folder: choose another place\.$"):
        write_text(tmp_path / "runs" / "config.json", "{}")


def test_only_a_full_disk_needs_room(tmp_path):
    (tmp_path / "folder").mkdir()
    with pytest.raises(DataError, match=r"cannot write .*/folder \(Is a directory\): it is a folder: name a file\.$"):
        write_text(tmp_path / "folder", "text")
    with pytest.raises(DataError, match=r"\(Permission denied\): choose another place"), errors_name(tmp_path):
        raise PermissionError(errno.EACCES, "Permission denied")


@pytest.mark.parametrize("cause", [errno.EACCES, errno.EROFS])
def test_a_place_where_tensors_may_not_be_written_needs_no_room(cause, tmp_path, monkeypatch):
    def refused(*_, **__):
        raise OSError(cause, os.strerror(cause))

    monkeypatch.setattr(Path, "write_bytes", refused)
    with pytest.raises(DataError, match=rf"safetensors \({os.strerror(cause)}\): choose another place, then run"):
        save_tensors(tmp_path / "a.safetensors", {"x": torch.zeros(3)})


def test_tensors_come_back_and_all_users_may_read_them(tmp_path):
    save_tensors(tmp_path / "new" / "a.safetensors", {"x": torch.arange(6.0).view(2, 3).T})
    assert torch.equal(load_file(tmp_path / "new" / "a.safetensors")["x"], torch.arange(6.0).view(2, 3).T)
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE((tmp_path / "new" / "a.safetensors").stat().st_mode) == 0o666 & ~mask


@pytest.fixture
def full_disk():
    """No file may grow beyond a kilobyte, as if the disk were full behind it."""
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (1024, before[1]))
    yield
    resource.setrlimit(resource.RLIMIT_FSIZE, before)


@pytest.mark.parametrize(
    "write",
    [
        lambda path: write_text(path, "x" * 5000),
        lambda path: append_text(path, "x" * 5000),
        lambda path: save_tensors(path, {"x": torch.zeros(5000)}),
        lambda path: write_atomically(path, lambda temporary: temporary.write_bytes(b"x" * 5000)),
    ],
    ids=["write_text", "append_text", "save_tensors", "write_atomically"],
)
def test_a_write_that_does_not_fit_names_its_path_in_one_line(write, tmp_path, full_disk):
    (tmp_path / "run").mkdir()
    with pytest.raises(DataError, match=r"cannot write .*run/file \(.+\): make room or choose another place") as caught:
        write(tmp_path / "run" / "file")
    assert "\n" not in str(caught.value)
    assert [name for name in names(tmp_path / "run") if name.startswith(".")] == []  # no temporary file


@pytest.mark.skipif(not Path("/dev/full").exists(), reason="a device that is always full")
def test_a_full_disk_is_named_where_lines_are_added():
    with pytest.raises(DataError, match=r"cannot write /dev/full \(No space left on device\): make room"):
        append_text(Path("/dev/full"), "a line\n")


def test_lines_are_added_to_what_is_there(tmp_path):
    append_text(tmp_path / "lines", "one\n")
    append_text(tmp_path / "lines", "two\n")
    assert (tmp_path / "lines").read_text() == "one\ntwo\n"


def test_errors_that_are_not_of_the_system_pass_as_they_are(tmp_path):
    with pytest.raises(KeyError), errors_name(tmp_path):
        raise KeyError("x")


def test_a_symbolic_link_stays_and_its_target_is_replaced_whole(tmp_path):
    (tmp_path / "elsewhere").mkdir()
    target, link = tmp_path / "elsewhere" / "goals.json", tmp_path / "goals.json"
    target.write_text("old")
    link.symlink_to(target)
    write_text(link, "new")
    assert (link.is_symlink(), target.read_text()) == (True, "new")
    assert names(tmp_path / "elsewhere") == ["goals.json"]
    (tmp_path / "to_nothing").symlink_to("elsewhere/later.json")
    write_text(tmp_path / "to_nothing", "new")
    assert (tmp_path / "elsewhere" / "later.json").read_text() == "new"


def test_a_pipe_is_written_through_and_stays(tmp_path):
    pipe, received = tmp_path / "pipe", []
    os.mkfifo(pipe)
    reader = threading.Thread(target=lambda: received.append(pipe.read_text()))
    reader.start()
    write_text(pipe, "bytes")
    reader.join(timeout=10)
    assert received == ["bytes"]
    assert stat.S_ISFIFO(pipe.stat().st_mode)
    assert names(tmp_path) == ["pipe"]


def test_a_device_is_written_through_and_stays(tmp_path):
    device = tmp_path / "null"
    try:
        os.mknod(device, 0o666 | stat.S_IFCHR, os.makedev(1, 3))
    except PermissionError:
        pytest.skip("needs root")
    write_text(device, "nothing")
    assert stat.S_ISCHR(device.stat().st_mode)


def test_a_folder_is_removed_only_with_what_its_writer_names(tmp_path):
    folder = tmp_path / "update-00000001"
    folder.mkdir()
    for name in ("policy.safetensors", ".policy.safetensors.host.7.tmp", "notes.txt"):
        (folder / name).touch()
    remove_folder(folder, ["policy.safetensors", "missing.json"])
    assert names(folder) == ["notes.txt"]
    (folder / "notes.txt").unlink()
    remove_folder(folder, [])
    remove_folder(folder, [])
    assert names(tmp_path) == []


def test_tensors_have_the_same_bytes_in_each_process(tmp_path):
    code = """
import sys
from pathlib import Path
import torch
from rlftsim.jobs.files import save_tensors
tensors = {f"t{i}": torch.arange(i, dtype=torch.float32 if i % 2 else torch.int64) for i in range(6)}
save_tensors(Path(sys.argv[1]), tensors, {f"näme {i}": '"\\n' * i for i in range(12)})
"""
    paths = [tmp_path / f"{n}.safetensors" for n in range(3)]
    for path in paths:
        subprocess.run([sys.executable, "-c", code, str(path)], check=True)
    assert len({path.read_bytes() for path in paths}) == 1
    assert load_file(paths[0])["t4"].tolist() == [0, 1, 2, 3]


@pytest.mark.parametrize(("closed", "is_named"), [("lost+found", False), (".Trash-0", False), ("train", True)])
def test_closed_folders_of_the_system_are_passed_over_and_no_other(closed, is_named, tmp_path, monkeypatch):
    def scan(path, scandir=os.scandir):
        if Path(path).name == closed:
            raise PermissionError(errno.EACCES, "Permission denied", str(path))
        return scandir(path)

    (tmp_path / "a").mkdir()
    (tmp_path / "a" / "x").touch()
    (tmp_path / closed).mkdir()
    monkeypatch.setattr(os, "scandir", scan)
    with pytest.raises(PermissionError) if is_named else nullcontext():
        assert sorted(path.name for path in list_folder(tmp_path)) == sorted([closed, "a", "x"])
    with pytest.raises(PermissionError):
        list(list_folder(tmp_path / closed))

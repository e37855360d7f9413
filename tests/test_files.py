"""Files are there whole or not at all."""

import os
import stat

import pytest
import torch
from safetensors.torch import load_file

from rlftsim.errors import DataError
from rlftsim.files import save_tensors, write_text, write_whole


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


def test_an_interrupted_write_leaves_nothing(tmp_path):
    def stopped(path):
        path.write_text("half")
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        write_whole(tmp_path / "page.html", stopped)
    assert names(tmp_path) == []


def test_a_folder_that_is_a_file_is_named(tmp_path):
    (tmp_path / "runs").write_text("")
    with pytest.raises(DataError, match=r"cannot write .*runs/config\.json \((Not a directory|File exists)\)"):
        write_text(tmp_path / "runs" / "config.json", "{}")


def test_tensors_come_back_and_everybody_may_read_them(tmp_path):
    save_tensors(tmp_path / "new" / "a.safetensors", {"x": torch.arange(6.0).view(2, 3).T})
    assert torch.equal(load_file(tmp_path / "new" / "a.safetensors")["x"], torch.arange(6.0).view(2, 3).T)
    mask = os.umask(0)
    os.umask(mask)
    assert stat.S_IMODE((tmp_path / "new" / "a.safetensors").stat().st_mode) == 0o666 & ~mask

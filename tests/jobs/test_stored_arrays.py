import ast
import io
import zipfile
from pathlib import Path

import numpy as np
import pytest
import torch
from safetensors.torch import save_file

import rlftsim
from rlftsim.errors import CheckpointError, DataError
from rlftsim.jobs.arrays import read_npz, read_tensors

PACKAGE = Path(rlftsim.__file__).parent


def write_members(path, members):
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, content in members.items():
            archive.writestr(name, content)
    return path


def array_bytes(array):
    part = io.BytesIO()
    np.lib.format.write_array(part, array, allow_pickle=True)
    return part.getvalue()


def header(text):
    """An array's header of any text."""
    return b"\x93NUMPY\x01\x00" + len(text).to_bytes(2, "little") + text.encode()


def test_arrays_come_back_and_names_that_are_not_there_are_missing(tmp_path):
    np.savez_compressed(tmp_path / "a.npz", x=np.arange(6.0).reshape(2, 3), y=np.array("id"))
    arrays = read_npz(tmp_path / "a.npz", ("x", "y", "z"), "write it again")
    assert arrays["x"].tolist() == [[0, 1, 2], [3, 4, 5]]
    assert arrays["y"].item() == "id"
    assert "z" not in arrays


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (array_bytes(np.array([{}], object)), "x.npy holds Python objects"),
        (array_bytes(np.zeros(9))[:-8], "x.npy announces an array of another size"),
        (
            header("{'descr': '<f8', 'fortran_order': False, 'shape': (10000000000,)}\n"),
            "announces an array of another",
        ),
        (header("{'descr': '<f8', 'fortran_order': False, 'shape': (-1,)}\n"), "announces an array of another"),
        (header("[" * 3000), "cannot be read"),
        (header("nonsense"), "cannot be read"),
        (b"", "cannot be read"),
    ],
)
def test_an_array_that_is_not_what_it_announces_is_refused_in_one_line(tmp_path, content, words):
    path = write_members(tmp_path / "a.npz", {"x.npy": content})
    with pytest.raises(DataError) as error:
        read_npz(path, ("x",), "write it again")
    assert words in str(error.value)
    assert "\n" not in str(error.value)
    assert str(error.value).endswith(": write it again.")


def test_damaged_tensors_are_refused_and_a_missing_file_is_the_callers_to_explain(tmp_path):
    save_file({"a": torch.ones(2)}, tmp_path / "a.safetensors", {"format": "x"})
    tensors, metadata = read_tensors(tmp_path / "a.safetensors", "write it again")
    assert tensors["a"].tolist() == [1.0, 1.0]
    assert metadata == {"format": "x"}
    (tmp_path / "b.safetensors").write_bytes((tmp_path / "a.safetensors").read_bytes()[:-1])
    with pytest.raises(CheckpointError, match=r"damaged safetensors file \(.*\): write it again\.$"):
        read_tensors(tmp_path / "b.safetensors", "write it again", error=CheckpointError)
    for read in (read_tensors, lambda path, remedy: read_npz(path, ("x",), remedy)):
        with pytest.raises(FileNotFoundError):
            read(tmp_path / "none", "write it")


def test_no_other_module_opens_safetensors_or_npz_files():
    for path in PACKAGE.rglob("*.py"):
        if path == PACKAGE / "jobs" / "arrays.py":
            continue
        tree = ast.parse(path.read_text())
        names = {alias.name for node in ast.walk(tree) if isinstance(node, ast.ImportFrom) for alias in node.names}
        assert not names & {"safe_open", "load_file"}, path
        calls = {ast.unparse(node.func) for node in ast.walk(tree) if isinstance(node, ast.Call)}
        assert not calls & {"np.load", "np.memmap", "np.fromfile"}, path

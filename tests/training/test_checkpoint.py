import copy
import json
import resource
import shutil

import pytest
import torch
from safetensors.torch import load_file, save_file
from torch import nn

from rlftsim.errors import CheckpointError, DataError
from rlftsim.training.checkpoint import (
    Progress,
    newest_checkpoint,
    read_checkpoint,
    remove_old_checkpoints,
    write_checkpoint,
)


def small_run(seed=0, steps=3):
    """A module and an optimizer that has moments."""
    torch.manual_seed(seed)
    module = nn.Sequential(nn.Linear(3, 4), nn.LayerNorm(4), nn.Linear(4, 2))
    optimizer = torch.optim.AdamW(module.parameters(), lr=1e-2)
    for _ in range(steps):
        step(module, optimizer)
    return module, optimizer


def step(module, optimizer):
    optimizer.zero_grad()
    module(torch.arange(6.0).view(2, 3)).square().sum().backward()
    optimizer.step()


def test_a_checkpoint_gives_back_weights_and_moments_bit_for_bit(tmp_path):
    module, optimizer = small_run()
    path = write_checkpoint(tmp_path, Progress(7, {"beta": 0.1 + 0.2}), {"policy": module}, optimizer)
    other, other_optimizer = small_run(seed=1, steps=0)
    assert read_checkpoint(path, {"policy": other}, other_optimizer) == Progress(7, {"beta": 0.1 + 0.2})
    for name, value in module.state_dict().items():
        assert torch.equal(other.state_dict()[name], value)
    old, new = optimizer.state_dict()["state"], other_optimizer.state_dict()["state"]
    assert old.keys() == new.keys()
    assert all(torch.equal(old[i][name], new[i][name]) for i in old for name in old[i])
    step(module, optimizer)
    step(other, other_optimizer)
    assert all(torch.equal(a, b) for a, b in zip(module.parameters(), other.parameters()))


def test_the_learning_rate_in_force_is_the_optimizers_own(tmp_path):
    module, optimizer = small_run()
    path = write_checkpoint(tmp_path, Progress(1), {"policy": module}, optimizer)
    other, other_optimizer = small_run(seed=1)
    other_optimizer.param_groups[0]["lr"] = 0.5
    read_checkpoint(path, {"policy": other}, other_optimizer)
    assert other_optimizer.param_groups[0]["lr"] == 0.5


def test_only_the_newest_two_are_kept(tmp_path):
    module, optimizer = small_run()
    for update in (2, 4, 6, 10):
        write_checkpoint(tmp_path, Progress(update), {"policy": module}, optimizer)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["update-00000006", "update-00000010"]
    newest = newest_checkpoint(tmp_path)
    assert newest is not None
    assert newest.name == "update-00000010"


def test_a_half_written_checkpoint_is_not_taken_for_whole(tmp_path):
    module, optimizer = small_run()
    good = write_checkpoint(tmp_path, Progress(2), {"policy": module}, optimizer)
    shutil.copytree(good, tmp_path / ".partial-update-00000004")
    assert newest_checkpoint(tmp_path) == good
    assert newest_checkpoint(tmp_path / "nothing") is None


def test_writing_goes_on_over_what_a_killed_run_left(tmp_path):
    module, optimizer = small_run()
    leftover = tmp_path / ".partial-update-00000004"
    leftover.mkdir(parents=True)
    (leftover / "policy.safetensors").write_bytes(b"half")
    path = write_checkpoint(tmp_path, Progress(4), {"policy": module}, optimizer)
    assert not leftover.exists()
    assert read_checkpoint(path, {"policy": copy.deepcopy(module)}, optimizer).update == 4


def test_old_and_half_checkpoints_of_a_killed_run_go(tmp_path):
    module, optimizer = small_run()
    for update in (2, 4):
        write_checkpoint(tmp_path, Progress(update), {"policy": module}, optimizer)
    shutil.copytree(tmp_path / "update-00000002", tmp_path / "update-00000001")
    shutil.copytree(tmp_path / "update-00000002", tmp_path / ".partial-update-00000003")
    (tmp_path / ".partial-update-00000003" / ".policy.safetensors.machine.12.tmp").touch()
    (tmp_path / "update-00000001" / "notes.txt").touch()
    remove_old_checkpoints(tmp_path)
    assert sorted(p.name for p in tmp_path.iterdir()) == ["update-00000001", "update-00000002", "update-00000004"]
    assert [p.name for p in (tmp_path / "update-00000001").iterdir()] == ["notes.txt"]


def test_a_checkpoint_that_does_not_fit_on_the_disk_is_named_and_the_older_one_stays(tmp_path):
    module, optimizer = small_run()
    good = write_checkpoint(tmp_path, Progress(2), {"policy": module}, optimizer)
    before = resource.getrlimit(resource.RLIMIT_FSIZE)
    resource.setrlimit(resource.RLIMIT_FSIZE, (64, before[1]))  # no file may grow larger, as on a full disk
    try:
        with pytest.raises(DataError, match=r"cannot write .*update-00000004/policy\.safetensors .*make room"):
            write_checkpoint(tmp_path, Progress(4), {"policy": module}, optimizer)
    finally:
        resource.setrlimit(resource.RLIMIT_FSIZE, before)
    assert newest_checkpoint(tmp_path) == good
    assert read_checkpoint(good, {"policy": module}, optimizer).update == 2


@pytest.mark.parametrize("name", ["policy.safetensors", "optimizer.safetensors", "progress.json"])
@pytest.mark.parametrize("damage", ["cut", "gone", "garbage"])
def test_a_damaged_checkpoint_is_refused_in_words(tmp_path, name, damage):
    module, optimizer = small_run()
    path = write_checkpoint(tmp_path, Progress(2), {"policy": module}, optimizer)
    content = (path / name).read_bytes()
    if damage == "gone":
        (path / name).unlink()
    else:
        (path / name).write_bytes(content[: len(content) // 2] if damage == "cut" else b"\xff" * 40)
    with pytest.raises(CheckpointError, match=r"update-00000002.*: cannot go on from it, delete this folder"):
        read_checkpoint(path, {"policy": module}, optimizer)


def changed(tensors, change):
    """Tensors of a file whose first one is changed."""
    name = min(tensors)
    return tensors | {name: change(tensors[name].clone())}


SPOILED = {
    "a weight that is no number": (
        "policy",
        lambda t: changed(t, lambda v: v.fill_(torch.nan)),
        "policy is not finite",
    ),
    "weights of another precision": ("policy", lambda t: changed(t, torch.Tensor.half), "is torch.float16"),
    "a moment that is no number": ("optimizer", lambda t: changed(t, lambda v: v.fill_(torch.inf)), "is not finite"),
    "a moment of another shape": ("optimizer", lambda t: changed(t, lambda v: v[:1].clone()), "has shape"),
    "a moment of no weight": ("optimizer", lambda t: t | {"x.exp_avg": torch.zeros(1)}, "'x.exp_avg' is no moment"),
    "a moment too few": ("optimizer", lambda t: {n: v for n, v in t.items() if n != min(t)}, "lack moments"),
}


@pytest.mark.parametrize("name", SPOILED)
def test_weights_and_moments_that_cannot_be_are_refused_and_nothing_is_loaded(tmp_path, name):
    file, change, words = SPOILED[name]
    module, optimizer = small_run()
    path = write_checkpoint(tmp_path, Progress(2), {"policy": module}, optimizer)
    save_file(change(load_file(path / f"{file}.safetensors")), path / f"{file}.safetensors")
    other, other_optimizer = small_run(seed=1)
    before = copy.deepcopy(other.state_dict())
    with pytest.raises(CheckpointError, match=f"{words}.*: cannot go on from it, delete this folder"):
        read_checkpoint(path, {"policy": other}, other_optimizer)
    assert all(torch.equal(value, before[key]) for key, value in other.state_dict().items())


@pytest.mark.parametrize("update", ["7", None, -5, 2.5, True, 3])
def test_a_position_that_is_not_the_folders_is_refused(tmp_path, update):
    module, optimizer = small_run()
    path = write_checkpoint(tmp_path, Progress(2), {"policy": module}, optimizer)
    (path / "progress.json").write_text(json.dumps({"update": update, "numbers": {}}))
    with pytest.raises(CheckpointError, match=r"its update is .*, not 2: cannot go on from it, delete this folder"):
        read_checkpoint(path, {"policy": module}, optimizer)


def test_a_checkpoint_without_a_number_of_its_method_is_refused(tmp_path):
    module, optimizer = small_run()
    path = write_checkpoint(tmp_path, Progress(2, {"drift.now": 1.0}), {"policy": module}, optimizer)
    with pytest.raises(CheckpointError, match=r"lacks the number beta: cannot go on from it, delete this folder"):
        read_checkpoint(path, {"policy": module}, optimizer, ["beta", "drift.now"])


def test_a_checkpoint_of_another_model_is_refused(tmp_path):
    module, optimizer = small_run()
    path = write_checkpoint(tmp_path, Progress(2), {"policy": module}, optimizer)
    with pytest.raises(CheckpointError, match="cannot go on from it"):
        read_checkpoint(path, {"policy": nn.Linear(3, 4)}, optimizer)


def test_only_files_of_checkpoints_are_removed(tmp_path):
    module, optimizer = small_run()
    for mine in ("update-notes", "update-00000001"):
        (tmp_path / mine).mkdir()
        (tmp_path / mine / "notes.txt").write_text("of a user")
    for update in (2, 3, 4):
        write_checkpoint(tmp_path, Progress(update), {"policy": module}, optimizer)
    assert {path.name for path in tmp_path.iterdir()} == {
        "update-00000001", "update-00000003", "update-00000004", "update-notes"
    }  # fmt: skip
    assert newest_checkpoint(tmp_path) == tmp_path / "update-00000004"
    assert all((tmp_path / mine / "notes.txt").exists() for mine in ("update-notes", "update-00000001"))

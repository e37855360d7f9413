import contextlib
import gzip
import io
import pickle
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from hypothesis import HealthCheck, given, settings
from hypothesis import strategies as st
from rollout_drawing import AXES, draw_arrays, to_scenario_rollouts, write_npz, write_submission

import scenes
from rlftsim.errors import DataError
from rlftsim.evaluation.rollout_files import find_rollouts, read_states
from rlftsim.evaluation.wire_format import iterate_fields
from rlftsim.jobs.arrays import read_npz
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.simulate import simulate
from rlftsim.rollout.types import write_rollouts
from rlftsim.scenario.batch import collate

FUZZ = settings(deadline=None, max_examples=60, suppress_health_check=[HealthCheck.function_scoped_fixture])


@pytest.fixture(scope="module")
def arrays():
    return draw_arrays(scenes.straight_road(), num_rollouts=2)


def read_all(path):
    return [read_states(entry) for entry in find_rollouts(path)]


def test_an_npz_is_read_as_it_was_written(arrays, tmp_path):
    (entry,) = find_rollouts(write_npz(tmp_path / "any.npz", arrays))
    states = read_states(entry)
    assert entry.scenario_id == "straight"
    assert states.object_id.tolist() == arrays["object_ids"].tolist()
    for axis in AXES:
        assert np.array_equal(getattr(states, axis).numpy(), arrays[axis])


def test_a_submission_holds_what_the_npz_does(arrays, tmp_path):
    other = draw_arrays(scenes.lone_agent(), num_rollouts=2)
    path = write_submission(tmp_path / "submission.binproto-00000-of-00150", arrays, other)
    entries = find_rollouts(tmp_path)
    assert [entry.scenario_id for entry in entries] == ["straight", "lone"]
    assert {entry.file for entry in entries} == {path}
    states = read_states(entries[0])
    order = [states.object_id.tolist().index(object_id) for object_id in arrays["object_ids"]]
    for axis in AXES:
        assert np.array_equal(getattr(states, axis).numpy()[:, order], arrays[axis])


def test_rollouts_of_one_scenario_may_come_without_the_submission_around_them(arrays, tmp_path):
    path = tmp_path / "rollouts.pb"
    path.write_bytes(to_scenario_rollouts(arrays).SerializeToString())
    (entry,) = find_rollouts(path)
    assert entry.scenario_id == "straight"
    assert read_states(entry).num_rollouts == 2


def test_a_folder_is_searched_in_order(arrays, tmp_path):
    (tmp_path / "b").mkdir()
    for name in ("b/1.npz", "a.npz"):
        write_npz(tmp_path / name, arrays)
    (tmp_path / "notes.txt").write_text("not rollouts")
    assert [entry.file.name for entry in find_rollouts(tmp_path)] == ["a.npz", "1.npz"]


def test_doubles_become_float32(arrays, tmp_path):
    wide = {**arrays, "x": arrays["x"].astype(np.float64), "object_ids": arrays["object_ids"].astype(np.uint16)}
    (states,) = read_all(write_npz(tmp_path / "a.npz", wide))
    assert states.x.dtype == torch.float32


class Bomb:
    def __reduce__(self):
        return (pytest.fail, ("a pickle was loaded",))


@pytest.mark.parametrize("name", ["rollouts.pkl", "rollouts.pickle", "model.pt", "rollouts", "rollouts.binproto"])
def test_pickles_are_refused_unopened(tmp_path, name):
    (tmp_path / name).write_bytes(pickle.dumps(Bomb()))
    with pytest.raises(DataError, match=r"is a pickle.*docs/rollout_formats\.md"):
        find_rollouts(tmp_path / name)
    (tmp_path / name).rename(tmp_path / "only.pkl")
    with pytest.raises(DataError, match="is a pickle"):
        find_rollouts(tmp_path)


def test_objects_inside_an_npz_are_refused_unopened(arrays, tmp_path):
    write_npz(tmp_path / "a.npz", {**arrays, "x": np.array([Bomb()], object)})
    with pytest.raises(DataError, match=r"x\.npy holds Python objects.*no rollouts file.*rollout_formats"):
        read_all(tmp_path)


@pytest.mark.parametrize("garbage", [b"", b"hello", b"PK\x03\x04 cut off", bytes(range(256))])
def test_an_npz_of_garbage_is_refused_in_our_words(tmp_path, garbage):
    (tmp_path / "garbage.npz").write_bytes(garbage)
    with pytest.raises(
        DataError, match=r"garbage.npz: cannot be read \(it is not an npz archive, or cut off\): no rollouts file"
    ) as error:
        find_rollouts(tmp_path)
    assert "docs/rollout_formats.md" in str(error.value)
    assert "pickle" not in str(error.value)


def test_a_damaged_array_is_refused_in_our_words(arrays, tmp_path):
    with zipfile.ZipFile(tmp_path / "a.npz", "w") as archive:
        for key, value in arrays.items():
            part = io.BytesIO()
            np.save(part, value)
            archive.writestr(f"{key}.npy", part.getvalue()[: 200 if key == "x" else None])
    with pytest.raises(DataError, match=r"x\.npy announces an array of another size.*no rollouts file"):
        read_all(tmp_path)


def test_arrays_that_unfold_to_more_than_memory_holds_are_refused_by_their_headers(arrays, tmp_path, monkeypatch):
    monkeypatch.setattr("rlftsim.jobs.arrays.MAX_ARRAY_BYTES", arrays["x"].nbytes * 3)
    monkeypatch.setattr(np.lib.format, "read_array", lambda *_, **__: pytest.fail("an array was read"))
    np.savez_compressed(tmp_path / "a.npz", **{name: np.zeros_like(arrays["x"]) for name in AXES})
    with pytest.raises(DataError, match=r"its arrays unfold to .* GB"):
        read_npz(tmp_path / "a.npz", AXES, "write it again")


@pytest.mark.parametrize("text", ["", "a\nb", "\x1b[31m", "x" * 500])
def test_an_id_that_no_file_or_terminal_could_hold_is_refused(arrays, tmp_path, text):
    write_npz(tmp_path / "a.npz", {**arrays, "scenario_id": np.array(text)})
    with pytest.raises(DataError, match="no text of 1 to 200 printable characters"):
        find_rollouts(tmp_path)


CHANGES = {
    "a key is missing": ({"z": None}, "no z in it"),
    "a step is missing": ({"x": np.zeros((2, 6, 79), np.float32)}, r"x must be floats \[N, A, 80\] with A = 6.*79"),
    "an agent is missing": ({"y": np.zeros((2, 5, 80), np.float32)}, r"y must be floats"),
    "an axis is missing": ({"heading": np.zeros((6, 80), np.float32)}, r"heading must be floats"),
    "another number of rollouts": ({"z": np.zeros((3, 6, 80), np.float32)}, r"equally many"),
    "no rollouts": ({axis: np.zeros((0, 6, 80), np.float32) for axis in AXES}, "x must be floats"),
    "whole numbers": ({"x": np.zeros((2, 6, 80), np.int64)}, "got int64"),
    "ids in two dimensions": ({"object_ids": np.zeros((6, 1), np.int32)}, "object_ids must be whole numbers"),
    "ids that are text": ({"object_ids": np.array(list("abcdef"))}, "object_ids must be whole numbers"),
    "several scenarios": ({"scenario_id": np.array(["a", "b"])}, "scenario_id must be one text"),
    "a scenario id that is a number": ({"scenario_id": np.array(3)}, "scenario_id must be one text"),
    "not a number": ({"x": np.full((2, 6, 80), np.nan, np.float32)}, "100 in rollout 0 at future step 0 is not finite"),
    "beyond float32": ({"x": np.full((2, 6, 80), 1e300)}, "not finite"),
    "far away": (
        {"y": np.full((2, 6, 80), -2.5e6, np.float32)},
        r"straight\): y of object id 100 in rollout 0 at .* -2.5e\+06 m",
    ),
}  # fmt: skip


@pytest.mark.parametrize("case", CHANGES)
def test_wrong_arrays_are_refused_by_file_and_reason(arrays, tmp_path, case):
    change, message = CHANGES[case]
    changed = {key: value for key, value in {**arrays, **change}.items() if value is not None}
    write_npz(tmp_path / "wrong.npz", changed)
    with pytest.raises(DataError, match=message) as error:
        read_all(tmp_path)
    assert "wrong.npz" in str(error.value)


def change_submission(arrays, change):
    message = to_scenario_rollouts(arrays)
    change(message)
    return message.SerializeToString()


def add_copy(message):
    message.joint_scenes[1].simulated_trajectories.add().CopyFrom(message.joint_scenes[1].simulated_trajectories[0])


MESSAGE_CHANGES = {
    "an agent is listed twice": (add_copy, "listed twice"),
    "an agent is missing": (lambda m: m.joint_scenes[1].simulated_trajectories.pop(), "rollout 1 has other agents"),
    "a step is missing": (lambda m: m.joint_scenes[0].simulated_trajectories[0].center_y.pop(), r"\[80, 79, 80, 80\]"),
    "an id is missing": (lambda m: m.joint_scenes[0].simulated_trajectories[0].ClearField("object_id"), "without an"),
    "invalid steps": (lambda m: m.joint_scenes[0].simulated_trajectories[0].valid.append(False), "invalid steps"),
    "no scenario": (lambda m: m.ClearField("scenario_id"), "name no scenario"),
}  # fmt: skip


@pytest.mark.parametrize("case", MESSAGE_CHANGES)
def test_wrong_submissions_are_refused_by_file_and_reason(arrays, tmp_path, case):
    change, reason = MESSAGE_CHANGES[case]
    (tmp_path / "wrong.binproto").write_bytes(change_submission(arrays, change))
    with pytest.raises(DataError, match=reason) as error:
        read_all(tmp_path)
    assert "wrong.binproto" in str(error.value)


def test_archives_and_empty_places_say_what_to_do(tmp_path):
    with pytest.raises(DataError, match="no such file or folder"):
        find_rollouts(tmp_path / "nothing")
    with pytest.raises(DataError, match="no rollouts in this folder"):
        find_rollouts(tmp_path)
    (tmp_path / "s.tar.gz").write_bytes(gzip.compress(b"x"))
    with pytest.raises(DataError, match="unpack it first"):
        find_rollouts(tmp_path / "s.tar.gz")
    (tmp_path / "empty.binproto").write_bytes(b"")
    with pytest.raises(DataError, match="holds no rollouts"):
        find_rollouts(tmp_path / "empty.binproto")


def damage(data: bytes, edits: list[tuple[int, int]], cut: int) -> bytes:
    damaged = bytearray(data)
    for place, value in edits:
        damaged[place % len(damaged)] = value
    return bytes(damaged[: len(damaged) - cut % len(damaged)])


EDITS = st.lists(st.tuples(st.integers(0, 1 << 30), st.integers(0, 255)), max_size=8)


@FUZZ
@given(EDITS, st.integers(0, 4000))
def test_a_damaged_npz_is_read_or_refused(tmp_path, edits, cut):
    buffer = io.BytesIO()
    np.savez(buffer, **draw_arrays(scenes.lone_agent(), num_rollouts=2))
    path = tmp_path / "fuzz.npz"
    path.write_bytes(damage(buffer.getvalue(), edits, cut))
    with contextlib.suppress(DataError):
        read_all(path)


@FUZZ
@given(EDITS, st.integers(0, 4000))
def test_a_damaged_submission_is_read_or_refused(tmp_path, edits, cut):
    write_submission(tmp_path / "whole", draw_arrays(scenes.lone_agent(), num_rollouts=2))
    path = tmp_path / "fuzz.binproto"
    path.write_bytes(damage((tmp_path / "whole").read_bytes(), edits, cut))
    with contextlib.suppress(DataError):
        read_all(path)


@FUZZ
@given(st.binary(max_size=300))
def test_any_bytes_are_read_or_refused(tmp_path, data):
    for name in ("fuzz.binproto", "fuzz.npz", "fuzz"):
        (tmp_path / name).write_bytes(data)
        with contextlib.suppress(DataError):
            read_all(tmp_path / name)


@FUZZ
@given(st.binary(max_size=100))
def test_fields_of_any_bytes_lie_inside_and_in_order(data):
    end = 0
    try:
        for field in iterate_fields(io.BytesIO(data), 0, len(data)):
            assert end <= field.start <= field.stop <= len(data)
            end = field.stop
    except DataError:
        pass


def test_a_file_is_named_once_and_ids_that_occur_twice_are_named(arrays, tmp_path):
    path = tmp_path / "a.npz"
    np.savez(path, **{**arrays, "x": arrays["x"].astype(object)})
    with pytest.raises(DataError, match="holds Python objects") as caught:
        read_all(path)
    assert str(caught.value).count("a.npz") == 1
    ids = arrays["object_ids"].copy()
    ids[1] = ids[0]
    with pytest.raises(DataError, match=rf"object_ids must differ: {ids[0]} listed twice"):
        read_all(write_npz(path, {**arrays, "object_ids": ids}))


def test_object_ids_of_more_than_32_bits_come_back(tmp_path):
    scenario = scenes.lone_agent()
    ids = scenario.tracks.object_id + 2**40
    scenario = replace(scenario, tracks=replace(scenario.tracks, object_id=ids))
    batch = collate([scenario])
    write_rollouts(tmp_path, batch, simulate(ConstantVelocity(), batch, num_rollouts=2, seed=0))
    (entry,) = find_rollouts(tmp_path)
    assert read_states(entry).object_id.tolist() == ids[scenario.simulated_indices].tolist()

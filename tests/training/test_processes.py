"""Training in several processes on a CPU: one estimator, one set of bits, one line where something goes wrong."""

import json
import multiprocessing
import os
import signal
import subprocess
import sys
import time
from dataclasses import replace
from pathlib import Path

import pytest
import torch
from safetensors.torch import load_file

import rlftsim
import tiny
from rlftsim.cli.main import main
from rlftsim.errors import ConfigError, DataError
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.scenario.synthetic import pack_path
from rlftsim.training import imitation as imitation_module
from rlftsim.training import parallel
from rlftsim.training import reward as finetune_module
from rlftsim.training.config import DeviceConfig, GoalConfig
from rlftsim.training.data import share_cache
from rlftsim.training.parallel import all_reduce_sum, count_processes, num_sharing_memory
from rlftsim.training.processes import linked_processes
from rlftsim.training.run_folder import read_metrics

TWO = replace(tiny.CPU, processes=2)
EXACT = {"gradient_clip": 1e9, "batch_size": 3, "epochs": 1.0}
"""A run whose last gradient is left in the parameters as it was computed."""


def in_processes(work, device):
    with linked_processes(work, device) as fabric:
        return work(fabric)


def train(stage, vocabulary, scenarios, out, device=TWO, config=tiny.MODEL, **changes):
    policy = tiny.tiny_policy(vocabulary, config)
    tiny.train(stage, policy, scenarios, out, device=device, **changes)
    return policy


def weights(out):
    return load_file(out / "model" / "model.safetensors")


def same_weights(first, second):
    a, b = weights(first), weights(second)
    return a.keys() == b.keys() and all(torch.equal(a[name], b[name]) for name in a)


def timeless(out):
    """Metrics of a run without its clock."""
    return [
        {k: v for k, v in line.items() if k != "time" and not k.startswith("seconds")} for line in read_metrics(out)
    ]


# ---- sums ------------------------------------------------------------------------------------------------------------


def test_all_processes_get_the_sum_of_all_in_the_order_of_ranks(tmp_path):
    # In this order the first two cancel; in any other the small one is lost to rounding.
    summands = [torch.tensor([1e8, 2.0]), torch.tensor([-1e8, 3.0]), torch.tensor([1e-3, 4.0])]

    def work(fabric):
        total = all_reduce_sum(summands[fabric.global_rank], fabric)
        count = all_reduce_sum(torch.tensor(1.0, dtype=torch.float64), fabric)  # numbers without dimensions, too
        (tmp_path / str(fabric.global_rank)).write_text(repr((total.tolist(), float(count), fabric.world_size)))
        all_reduce_sum(total, fabric)  # all have written
        return fabric.global_rank

    assert in_processes(work, replace(tiny.CPU, processes=3)) == 0
    expected = repr((torch.tensor([1e-3, 9.0]).tolist(), 3.0, 3))
    assert [(tmp_path / str(rank)).read_text() for rank in range(3)] == [expected] * 3


@pytest.mark.parametrize("stage", ["pretrain", "catk", "everything", "finetune"])
def test_two_processes_find_the_gradient_of_one_for_every_method(stage, vocabulary, drawn_scenarios, tmp_path):
    gradients = []
    changes = EXACT | ({"constraints": ("speed", "min_ade"), "credit_clip": 1.0} if stage == "finetune" else {})
    for device in (tiny.CPU, TWO):
        out = tmp_path / str(device.processes)
        policy = train(stage, vocabulary, drawn_scenarios[:3], out, device, tiny.WITHOUT_CHANCE, **changes)
        gradients.append(tiny.gradients_of(policy))
    one, two = gradients
    assert one.keys() == two.keys()
    assert max(float(g.abs().max()) for g in one.values()) > 1e-3
    for name, gradient in one.items():
        torch.testing.assert_close(two[name], gradient, atol=1e-6, rtol=1e-5, msg=lambda m, name=name: f"{name}: {m}")
    for a, b in zip(timeless(tmp_path / "auto"), timeless(tmp_path / "2"), strict=True):
        assert a.keys() == b.keys()
        for name in a.keys() - {"score_gap"}:  # of a process
            assert b[name] == pytest.approx(a[name], rel=1e-5, abs=1e-6), name


def test_tensors_of_all_processes_are_gathered_bit_for_bit():
    def own(rank):
        return {
            "floats": torch.tensor([-0.0, torch.nan, 1 / 3])[rank:],
            "numbers": torch.arange(2 * rank).view(2, rank).T * 2**40,
            "flags": torch.tensor([rank == 1]),
        }

    def work(fabric):
        everything = parallel.all_gather(own(fabric.global_rank), fabric)
        for rank, found in enumerate(everything):
            for name, expected in own(rank).items():
                assert found[name].dtype == expected.dtype
                assert found[name].numpy().tobytes() == expected.contiguous().numpy().tobytes()
        return len(everything)

    assert in_processes(work, replace(tiny.CPU, processes=3)) == 3


def test_processes_that_are_more_than_scenarios_divide_their_rollouts(vocabulary, drawn_scenarios, tmp_path):
    """Two updates with every term of the loss, each with a baseline over all rollouts of a scenario."""
    model = replace(tiny.WITHOUT_CHANCE, goal="concat")
    changes = {
        "batch_size": 1, "epochs": 1.0, "num_rollouts": 4, "rollouts_per_pass": 3, "imitation_weight": 0.1,
        "reward": "mloo + 0.5*rloo + 0.1*goal", "goals": GoalConfig(probability=1.0, hindsight=0.5),
        "gradient_clip": 1e9, "learning_rate": 1e-4, "warmup_updates": 0,
    }  # fmt: skip
    policies = {}
    for name, device in (("one", tiny.CPU), ("two", TWO)):
        policies[name] = train("everything", vocabulary, drawn_scenarios[:2], tmp_path / name, device, model, **changes)
    one, two = timeless(tmp_path / "one"), timeless(tmp_path / "two")
    assert len(one) == len(two) == 2
    assert {"hindsight_ratio", "imitation_loss", "goal_reached_rate"} <= one[0].keys()
    assert one[0]["reward_std"] > 1e-4
    for a, b in zip(one, two):
        for name in a.keys() - {"score_gap"}:  # of a process
            assert b[name] == pytest.approx(a[name], rel=1e-4, abs=1e-6), name
    for name, gradient in tiny.gradients_of(policies["one"]).items():
        torch.testing.assert_close(tiny.gradients_of(policies["two"])[name], gradient, atol=1e-5, rtol=1e-4, msg=name)
    first, second = weights(tmp_path / "one"), weights(tmp_path / "two")
    for name, weight in first.items():
        torch.testing.assert_close(second[name], weight, atol=1e-5, rtol=1e-5, msg=name)


# ---- the same bits ---------------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("stage", "update", "batch_size"), [("pretrain", 3, 2), ("everything", 3, 2), ("everything", 3, 1)]
)
def test_a_run_of_two_processes_is_resumed_bit_for_bit(
    stage, update, batch_size, vocabulary, drawn_scenarios, tmp_path, monkeypatch
):
    changes = {"epochs": float(batch_size), "batch_size": batch_size}  # four updates, checkpoints after 2 and 4
    train(stage, vocabulary, drawn_scenarios, tmp_path / "whole", **changes)
    module, name = {
        "pretrain": (imitation_module, "update_imitator"),
        "everything": (finetune_module, "update_policy"),
    }[stage]
    original, calls = getattr(module, name), []

    def interrupted(*args, **options):
        calls.append(1)
        result = original(*args, **options)
        # In rank 0 alone, as Ctrl-C: the other is in the next update or waits.
        if len(calls) == update and not torch.multiprocessing.parent_process():
            raise KeyboardInterrupt
        return result

    with monkeypatch.context() as patch:
        patch.setattr(module, name, interrupted)
        with pytest.raises(KeyboardInterrupt):
            train(stage, vocabulary, drawn_scenarios, tmp_path / "stopped", **changes)
    assert not (tmp_path / "stopped" / "model").exists()
    # "auto" now: the number of the run is kept.
    train(stage, vocabulary, drawn_scenarios, tmp_path / "stopped", device=tiny.CPU, **changes)
    assert same_weights(tmp_path / "whole", tmp_path / "stopped")
    assert timeless(tmp_path / "whole") == timeless(tmp_path / "stopped")


def test_a_run_repeated_from_its_own_settings_gives_the_same_bits_on_any_number_of_cores(tmp_path, monkeypatch):
    common = f"--data {tiny_data(tmp_path)} --vocabulary {tmp_path / 'vocabulary.safetensors'}"
    settings = (
        "--model.dim 16 --model.num-heads 2 --model.head-dim 8 --model.num-decoder-layers 1 --model.num-map-layers 1 "
        "--model.num-frequencies 4"
    )
    monkeypatch.setattr(parallel, "MIN_SCENARIOS", 4)
    monkeypatch.setattr(parallel, "usable_cores", lambda: 2)
    words = f"smart-demo {common} {settings} --pretrain.epochs 1 --pretrain.batch-size 2"
    assert main(["pretrain", *words.split(), "--out", str(tmp_path / "first")]) == 0
    stored = json.loads((tmp_path / "first" / "config.json").read_text())
    assert stored["device"]["processes"] == 2
    monkeypatch.setattr(parallel, "usable_cores", lambda: 1)
    again = f"smart-demo {common} {settings} --config {tmp_path / 'first' / 'config.json'}"
    assert main(["pretrain", *again.split(), "--out", str(tmp_path / "again")]) == 0
    assert same_weights(tmp_path / "first", tmp_path / "again")
    # Another number is another order of sums, and said by the flag.
    assert main(["pretrain", *words.split(), "--out", str(tmp_path / "one"), "--processes", "1"]) == 0
    assert json.loads((tmp_path / "one" / "config.json").read_text())["device"]["processes"] == 1
    for a, b in zip(weights(tmp_path / "first").values(), weights(tmp_path / "one").values()):
        torch.testing.assert_close(a, b, atol=1e-3, rtol=1e-3)


def tiny_data(folder):
    scenarios = tiny.pack_scenarios(4)
    write_dataset(scenarios, folder / "data", split="training")
    tiny.small_vocabulary(scenarios).save(folder / "vocabulary.safetensors")
    return folder / "data"


# ---- how many --------------------------------------------------------------------------------------------------------


def test_auto_is_a_process_for_each_core_with_limits(monkeypatch):
    monkeypatch.setattr(parallel, "usable_cores", lambda: 6)

    def processes(device=tiny.CPU, scenarios=100, batch_size=8, micro_batch_size=8, **more):
        return count_processes(device, scenarios, batch_size, micro_batch_size, **more)

    assert processes() == 6
    assert processes(batch_size=2) == 2  # each needs a scenario of its own
    assert processes(micro_batch_size=4) == 4  # memory is shared
    assert processes(scenarios=5) == 1  # too few to pay
    assert processes(DeviceConfig(accelerator="cpu", threads=4)) == 1
    assert processes(DeviceConfig(accelerator="cuda")) == 1
    assert processes(begun_with=3) == 3
    assert processes(DeviceConfig(accelerator="cpu", processes=4), begun_with=3) == 4  # as it was said
    monkeypatch.setattr(parallel, "can_fork", lambda: False)
    assert processes(begun_with=3) == 1


def test_processes_share_the_scenarios_in_memory(vocabulary, drawn_scenarios, tmp_path, monkeypatch):
    sizes = []
    original = finetune_module.sample_rollouts

    def seen(policy, batch, *args, **options):
        sizes.append(batch.num_scenarios)
        return original(policy, batch, *args, **options)

    monkeypatch.setattr(finetune_module, "sample_rollouts", seen)
    changes = {"batch_size": 4, "epochs": 1.0, "micro_batch_size": 2}
    train("finetune", vocabulary, drawn_scenarios, tmp_path / "one", tiny.CPU, **changes)
    train("finetune", vocabulary, drawn_scenarios, tmp_path / "two", TWO, **changes)
    assert sizes == [2, 2, 1, 1]  # of the two processes this one is seen


def test_processes_share_out_the_cache_of_scenarios():
    def caches(size):
        data = ScenarioDataset(pack_path(), "training", cache_size=size)
        share = in_processes(lambda fabric: share_cache(data, num_sharing_memory(fabric)), TWO)
        return share.cache_size, share is data

    assert caches(100) == (50, False)  # of 160
    assert caches(400) == (400, True)  # each may keep all, and those at hand stay


SCRIPT = """
import sys
sys.path += {path!r}
import tiny
from dataclasses import replace
from pathlib import Path
from rlftsim.rewards import register_reward

@register_reward("of_this_script")
def of_this_script(realism, rollouts, batch):
    return realism.single_meta_metric

scenarios = tiny.pack_scenarios(2)
policy = tiny.tiny_policy(tiny.small_vocabulary(scenarios))
tiny.train("finetune", policy, scenarios, Path({out!r}), reward="of_this_script", batch_size=2, epochs=1.0,
           device=replace(tiny.CPU, processes=2))
print("trained once")
"""


@pytest.mark.slow
def test_a_plain_script_trains_in_processes_with_what_it_defines(tmp_path):
    # No main guard, no file even: as a notebook or `python -c`.
    script = SCRIPT.format(path=[str(Path(rlftsim.__file__).parents[1]), *sys.path], out=str(tmp_path))
    done = subprocess.run([sys.executable, "-c", script], capture_output=True, text=True, timeout=300)
    assert done.returncode == 0, done.stderr[-2000:]
    assert done.stdout == "trained once\n"
    assert json.loads((tmp_path / "config.json").read_text())["device"]["processes"] == 2


# ---- ends ------------------------------------------------------------------------------------------------------------


def failing(error):
    """Work that fails in the last of its processes while the others wait for it."""

    def work(fabric):
        if fabric.global_rank == fabric.world_size - 1:
            raise error
        return all_reduce_sum(torch.zeros(1_000_000), fabric)

    return work


class Unsendable(Exception):
    def __init__(self, one, two):
        super().__init__(f"{one} {two}")


def test_an_error_of_any_process_is_raised_in_the_first(capfd):
    three = replace(tiny.CPU, processes=3)
    with pytest.raises(DataError, match=r"^scenario 7 has no future$"):
        in_processes(failing(DataError("scenario 7 has no future")), three)
    with pytest.raises(ZeroDivisionError) as caught:  # a bug: where it happened is part of the report
        in_processes(failing(ZeroDivisionError("a bug")), three)
    assert "in process 2 of the run" in caught.value.__notes__
    assert "in work" in caught.value.__notes__[0]
    with pytest.raises(RuntimeError, match="Unsendable: a b"):
        in_processes(failing(Unsendable("a", "b")), three)
    assert capfd.readouterr() == ("", "")


def test_the_death_of_a_process_ends_the_run_with_a_line_and_no_process_is_left():
    def work(fabric):
        if fabric.global_rank == 1:
            os.kill(os.getpid(), signal.SIGKILL)
        for _ in range(2):  # the first sum may be sent before it is noticed
            all_reduce_sum(torch.zeros(1_000_000), fabric)

    with pytest.raises(DataError, match=r"a training process died \(out of memory\?\): run the same command again"):
        in_processes(work, TWO)
    assert not multiprocessing.active_children()


def test_several_processes_are_refused_where_they_cannot_be_forked(monkeypatch):
    with pytest.raises(ConfigError, match=r"threads=2 and device\.processes=2 cannot be combined"):
        in_processes(lambda fabric: None, replace(TWO, threads=2))
    monkeypatch.setattr("rlftsim.training.processes.can_fork", lambda: False)
    with pytest.raises(ConfigError, match=r"processes=2: a CPU is shared among processes on Linux only"):
        in_processes(lambda fabric: None, TWO)
    with pytest.raises(ConfigError, match=r"processes must be positive, got 0"):
        DeviceConfig(processes=0)
    monkeypatch.undo()
    with pytest.raises(ConfigError, match=r"a batch of 1 scenarios cannot be spread over 2 processes"):
        in_processes(lambda fabric: parallel.local_indices([4], fabric), TWO)
    three = replace(tiny.CPU, processes=3)
    with pytest.raises(
        ConfigError, match=r"of 2 scenarios .* over 3 .* to 2 at most, or to 4 or 8, which divide the rol"
    ):
        in_processes(lambda fabric: parallel.local_indices([4, 5], fabric, num_rollouts=4), three)


UPDATES = 16


def start(out):
    """A run of two processes as a command with a process group of its own."""
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join([str(Path(rlftsim.__file__).parents[1]), *sys.path])}
    words = ["pretrain", str(out), "--processes", "2", "--batch-size", "2", "--updates", str(UPDATES)]
    return subprocess.Popen(
        [sys.executable, tiny.__file__, *words],
        env=environment, stderr=subprocess.PIPE, text=True, start_new_session=True,
        preexec_fn=lambda: signal.signal(signal.SIGINT, signal.default_int_handler),  # jobs in the background ignore it
    )  # fmt: skip


def wait_for(condition, what, seconds=240.0):
    deadline = time.monotonic() + seconds
    while not condition():
        assert time.monotonic() < deadline, what
        time.sleep(0.02)


def processes_of_group(group):
    """Living processes of a process group."""
    found = []
    for path in Path("/proc").glob("[0-9]*/stat"):
        try:
            state, _, its_group = path.read_text().rpartition(")")[2].split()[:3]
        except (OSError, ValueError):
            continue
        if int(its_group) == group and state != "Z":
            found.append(int(path.parent.name))
    return found


def go_on(out):
    tiny.run("pretrain", out, updates=UPDATES, processes=2, batch_size=2)
    return out


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """Folder of a run that nothing stops."""
    return go_on(tmp_path_factory.mktemp("whole"))


@pytest.mark.slow
@pytest.mark.parametrize("kind", [signal.SIGINT, signal.SIGKILL])
def test_a_stopped_run_leaves_no_process_behind_and_is_resumed_bit_for_bit(kind, whole, tmp_path):
    out = tmp_path / "stopped"
    process = start(out)
    wait_for(lambda: len(read_metrics(out)) > 2 or process.poll() is not None, "no updates were made")
    assert len(processes_of_group(process.pid)) == 2
    # Ctrl-C goes to the whole group, a kill to the process that the user sees.
    os.killpg(process.pid, kind) if kind == signal.SIGINT else process.kill()
    error = process.communicate(timeout=60)[1]
    assert process.returncode == -kind
    wait_for(lambda: not processes_of_group(process.pid), "an orphan")
    if kind == signal.SIGINT:
        # The traceback of a script that does not catch Ctrl-C, once: the other process prints nothing.
        assert error.count("Traceback") == 1
        kept = len(read_metrics(out))
        assert error.rstrip().endswith(f"KeyboardInterrupt: continues behind update {kept}")
    assert 2 < len(read_metrics(out)) < UPDATES
    assert same_weights(go_on(out), whole)
    assert timeless(out) == timeless(whole)

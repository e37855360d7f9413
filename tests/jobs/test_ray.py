"""Work on a Ray cluster of two raylets on this machine: the same bytes as inline, whatever is killed."""

import ast
import json
import os
import pickle
import shlex
import signal
import subprocess
import sys
from functools import partial
from pathlib import Path

import pytest

import ray_tasks
import rlftsim
from rlftsim.cli.main import main
from rlftsim.errors import ConfigError, DataError
from rlftsim.evaluation.evaluate import EvaluateConfig, evaluate
from rlftsim.jobs.processes import SetAside
from rlftsim.rollout.baselines import ConstantVelocity

pytestmark = pytest.mark.slow
PACKAGE = Path(rlftsim.__file__).parent


def ignore(count):
    pass


def runner():
    from rlftsim.jobs.ray import RayRunner

    return RayRunner()


@pytest.fixture(scope="module")
def cluster():
    """A head without cores and two nodes of one core each; this process is connected to it."""
    ray = pytest.importorskip("ray", reason='Ray is not installed: pip install "rlftsim[ray]"')
    from ray.cluster_utils import Cluster

    folders = [str(PACKAGE.parent), str(Path(__file__).parents[1])]
    before = os.environ.get("PYTHONPATH")
    handler = signal.getsignal(signal.SIGTERM)
    os.environ["PYTHONPATH"] = os.pathsep.join(folders)  # for the processes of the cluster
    os.environ["RAY_USAGE_STATS_ENABLED"] = "0"
    small = {"object_store_memory": 80_000_000, "include_dashboard": False}
    try:
        cluster = Cluster(initialize_head=True, head_node_args={"num_cpus": 0, **small})
        for _ in range(2):
            cluster.add_node(num_cpus=1, object_store_memory=80_000_000)
    except Exception as error:
        signal.signal(signal.SIGTERM, handler)
        if "timed out" not in str(error).lower():
            raise
        pytest.skip("this machine is too busy: Ray gives a raylet 30 seconds to start")
    ray.init(cluster.address, log_to_driver=False)
    yield cluster
    ray.shutdown()
    cluster.shutdown()
    signal.signal(signal.SIGTERM, handler)  # Ray leaves its own, which ends the process of the tests that follow
    os.environ.pop("PYTHONPATH")
    if before is not None:
        os.environ["PYTHONPATH"] = before


def test_an_address_without_a_cluster_is_refused_in_one_line():
    pytest.importorskip("ray", reason='Ray is not installed: pip install "rlftsim[ray]"')
    from rlftsim.jobs.ray import RayRunner

    with pytest.raises(
        ConfigError, match=r"^--ray 127\.0\.0\.1:1: no Ray cluster there \(.*\): `ray start` makes one\.$"
    ):
        RayRunner("127.0.0.1:1").run(ray_tasks.double_or_die, [1], advance=ignore)


def test_results_come_in_order_and_poison_is_set_aside(cluster):
    done = []
    assert runner().run(ray_tasks.double_or_die, [3, 1, 2], advance=done.append) == [6, 2, 4]
    assert sum(done) == 3
    with pytest.raises(SetAside, match=r"1 pieces .* set aside: exit \(WorkerCrashedError"):
        runner().run(ray_tasks.double_or_die, [1, "exit", 2], advance=ignore)


def test_a_process_reserves_memory_by_the_size_of_the_model_and_leaves_a_line_of_json(cluster, tmp_path):
    from rlftsim.jobs.ray import BYTES_OF_A_PROCESS, RayRunner

    runner = RayRunner(item_log=tmp_path / "items.jsonl")
    (small,) = runner.run(ray_tasks.reserved_memory, [0], advance=ignore)
    (large,) = runner.run(partial(ray_tasks.reserved_memory, weights=bytes(5_000_000)), [0], advance=ignore)
    assert BYTES_OF_A_PROCESS <= small < BYTES_OF_A_PROCESS + 1e6
    assert large == pytest.approx(small + 1e8, rel=1e-3)
    lines = [json.loads(line) for line in (tmp_path / "items.jsonl").read_text().splitlines()]
    assert [line["item"] for line in lines] == ["0", "0"]


def test_the_error_of_a_task_is_that_of_the_run(cluster):
    with pytest.raises(DataError, match=r"^item 1 is broken\n"):
        runner().run(ray_tasks.refuse, [1], advance=ignore)


def test_an_evaluation_has_the_same_bytes_as_inline(cluster, tmp_path):
    config = EvaluateConfig(num_rollouts=2, limit=9)
    for name, where in (("inline", None), ("ray", runner())):
        evaluate(ConstantVelocity(), "synthetic", tmp_path / name, config, name="a", runner=where, show_progress=False)
    inline, on_ray = (list((tmp_path / name).iterdir()) for name in ("inline", "ray"))
    assert [path.name for path in inline] == [path.name for path in on_ray] == ["a.parquet"]
    assert inline[0].read_bytes() == on_ray[0].read_bytes()


def test_the_command_of_the_documents_works_on_the_cluster(cluster, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)
    page = (Path(__file__).parents[2] / "docs" / "machines.md").read_text().replace(" \\\n", " ")
    line = next(line for line in page.splitlines() if line.startswith("rlftsim evaluate") and " --ray " in line)
    for old, new in {
        "runs/rlft": "constant_velocity", "s3://bucket/womd": "synthetic", "/shared/": "", "10.0.0.1:6379": "auto",
    }.items():  # fmt: skip
        assert old in line
        line = line.replace(old, new)
    assert main([*shlex.split(line)[1:], "--limit", "5", "--num-rollouts", "2"]) == 0
    assert (tmp_path / "evaluations" / "constant_velocity.parquet").exists()
    assert main([*shlex.split(line)[1:], "--share", "1/2"]) == 2
    assert "--share and --ray are two ways to use several machines: choose one." in capsys.readouterr().err


def test_a_machine_with_another_version_or_without_the_folder_is_refused(cluster):
    from rlftsim.jobs.ray import _work

    for driver, message in (
        (("0.0", "."), r"the cluster has rlftsim .*, this machine 0\.0: install the same on all"),
        ((rlftsim.__version__, "/nowhere"), r"/nowhere \(.*\): give the command in a folder that all machines of the"),
    ):
        kind, error, *_ = pickle.loads(_work([None], "key", driver, b"", 0, None))
        assert kind == "error"
        with pytest.raises(ConfigError, match=message):
            raise error


def test_a_task_of_the_main_module_is_handed_over_by_value(cluster, monkeypatch):
    """As of a notebook: processes of the cluster cannot import it."""
    script = {"__name__": "__main__"}
    exec("def triple(item, advance, is_stopped):\n    return 3 * item", script)
    assert runner().run(script["triple"], [1, 2], advance=ignore) == [3, 6]


def test_the_last_node_may_be_killed_if_another_one_comes(cluster, tmp_path):
    paths = [tmp_path / f"{number}" for number in range(6)]
    killed = []

    def kill_when_three_are_done(count):
        if len(list(tmp_path.iterdir())) >= 3 and not killed:
            for node in list(cluster.worker_nodes):
                cluster.remove_node(node, allow_graceful=False)
            killed.append(cluster.add_node(num_cpus=1, object_store_memory=80_000_000))

    found = runner().run(ray_tasks.slow_file, paths, advance=kill_when_three_are_done)
    assert found == [path.name for path in paths]
    assert killed
    assert sorted(path.read_text() for path in tmp_path.iterdir()) == sorted(found)


def test_one_module_imports_ray_and_no_command_does_without_being_asked():
    importing = {
        path.relative_to(PACKAGE).as_posix()
        for path in PACKAGE.rglob("*.py")
        for node in ast.walk(ast.parse(path.read_text(encoding="utf-8")))
        if (isinstance(node, ast.Import) and any(name.name.split(".")[0] == "ray" for name in node.names))
        or (isinstance(node, ast.ImportFrom) and (node.module or "").split(".")[0] == "ray")
    }
    assert importing == {"jobs/ray.py"}
    script = "import sys, rlftsim.verbs.evaluate, rlftsim.verbs.data, rlftsim.verbs.submit; print('ray' in sys.modules)"
    environment = {**os.environ, "PYTHONPATH": str(PACKAGE.parent)}
    done = subprocess.run([sys.executable, "-c", script], env=environment, capture_output=True, text=True, timeout=120)
    assert done.stdout == "False\n", done.stderr


def test_without_ray_the_flag_says_how_to_get_it(monkeypatch):
    from rlftsim.jobs.runner import Machines

    monkeypatch.setitem(sys.modules, "ray", None)
    monkeypatch.delitem(sys.modules, "rlftsim.jobs.ray", raising=False)
    with pytest.raises(ConfigError, match=r'Ray is not installed: pip install "rlftsim\[ray\]", or use --jobs or'):
        Machines(ray="auto").runner(1, "skip")

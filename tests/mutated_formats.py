"""Every format that the package reads: how a small good sample is made, and the call that reads it as a user would."""

import contextlib
import json
import re
import shutil
import tempfile
import zipfile
from collections.abc import Callable, Iterator, Mapping
from dataclasses import dataclass, replace
from functools import lru_cache
from pathlib import Path
from unittest import mock

import entries
import numpy as np
import torch
from rollout_drawing import draw_arrays, to_scenario_rollouts, write_npz, write_submission

import made_up
import rlftsim as rs
import scenes
import tiny
from alpasim_files import write_alpasim
from av2_files import write_av2
from gpudrive_files import write_file
from rlftsim.cli.main import main, parse
from rlftsim.envs import EgoEnv
from rlftsim.envs.observations import SHAPES
from rlftsim.envs.planners.registry import load_planner
from rlftsim.errors import RlftsimError
from rlftsim.evaluation.drive_results import DriveResult
from rlftsim.evaluation.evaluate import EvaluateConfig
from rlftsim.evaluation.goal_attainment import attain_goals
from rlftsim.evaluation.learning_curve import write_calibration_picture
from rlftsim.evaluation.reward_variance import measure_variances
from rlftsim.experiments.exam import Ledger
from rlftsim.goals.goals_file import GoalEntry, GoalsFile, write_goals
from rlftsim.goals.types import StoredGoals, write_goal_file
from rlftsim.policies.calibrated.policy import CHANGES, CalibratedTokenPolicy
from rlftsim.policies.checkpoint import read_card
from rlftsim.policies.smart.catk_checkpoint import export_catk, write_catk, write_catk_vocabulary
from rlftsim.policies.smart.config import smart_nano
from rlftsim.recipes.registry import recipe_by_name
from rlftsim.recipes.settings import recipe_as_json
from rlftsim.rollout.entries import Entrants, FittedEntries, load_entries, write_entries
from rlftsim.rollout.gates import GateFinder
from rlftsim.scenario.synthetic import generate, worlds
from rlftsim.scenario.tfrecord import write_records
from rlftsim.scenario.transfer import pull_dataset
from rlftsim.studio.server import load_token
from rlftsim.submission.entry import describe_entry, read_entry
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.training.run_folder import read_metrics
from small_things import TINY_BOTS
from table_files import MAP, write_tables
from womd_messages import build_message

ENTRY = "constant_velocity"
"""Policy without weights, which costs nothing."""
CATK_SIZES = {
    "hidden_dim": 64, "num_freq_bands": 64, "num_heads": 4, "head_dim": 16, "num_map_layers": 2, "num_agent_layers": 2,
    "pl2pl_radius": 10, "pl2a_radius": 30, "a2a_radius": 60, "time_span": 30, "dropout": 0.1, "hist_drop_prob": 0.1,
}  # fmt: skip


@dataclass(frozen=True)
class Format:
    """A format, or several files that are read together."""

    files: Mapping[str, str]
    """Kind of the mutants, of `mutants.KINDS`, by pattern of the file inside the sample."""
    make: Callable[[Path], object]
    """Writes a good sample into an empty folder."""
    read: Callable[[Path], object]
    """Reads a sample; raises `RlftsimError` where a user sees one line."""
    readers: tuple[str, ...]
    """Modules of the package that open these files or parse their bytes."""


class NotRead(RlftsimError):
    """A command that ended with a line for its user."""


def run(*words: object) -> None:
    """Run a command line in this process.

    Raises:
        RlftsimError: It ends with one line.
    """
    call = parse([str(word) for word in words])
    try:
        call.show(call.command.function(**call.arguments))
    except OSError as error:  # the command names what the machine says, in one line
        failing = mock.PropertyMock(side_effect=error)
        with contextlib.redirect_stderr(None), mock.patch.object(type(call), "arguments", failing):
            status = main([str(word) for word in words])
        raise NotRead(f"{error.strerror}: {error.filename} (status {status})") from None


@lru_cache
def _scenarios() -> list[rs.Scenario]:
    return [scenes.straight_road("s1"), scenes.junction_with_light("s2")]


@lru_cache
def _vocabulary() -> Vocabulary:
    return tiny.small_vocabulary(_scenarios())


def write_set(folder: Path) -> None:
    """Write a data set of two scenarios into `set`."""
    rs.write_dataset(_scenarios(), folder / "set", split="validation")


# ---- scenarios ------------------------------------------------------------------------------------


def make_womd(folder: Path) -> None:
    (folder / "womd").mkdir()
    for number in range(2):
        messages = [build_message(f"{number}{k}", num_tracks=3).SerializeToString() for k in range(2)]
        write_records(folder / "womd" / f"training.tfrecord-{number:05d}-of-00002", messages)


def convert(*words: object) -> Callable[[Path], None]:
    """A conversion from `source` to a new data set, all scenarios of which are read, too."""

    def read(folder: Path) -> None:
        source, *options = (folder / word if isinstance(word, Path) else word for word in words)
        run("convert", source, folder / "new", "--jobs", 1, *options)
        run("data", "verify", folder / "new")
        rs.simulate(ENTRY, list(rs.load_dataset(folder / "new")), num_rollouts=1)

    return read


def make_av2(folder: Path) -> None:
    write_av2(folder / "val", scenes.straight_road("0a1b"))
    sizes = {"vehicle": [4.6, 2.0, 1.6], "pedestrian": [0.5, 0.5, 1.7]}
    (folder / "sizes.json").write_text(json.dumps(sizes))


def make_tables(folder: Path) -> None:
    shared = [{"map_id": "m", **{k: v for k, v in row.items() if k != "scenario_id"}} for row in MAP]
    lanes = [{"map_id": "m", "lane_id": 1, "entry": [9], "exit": [4], "left": [4], "speed_limit_mph": 25.0}]
    lights = [{"scenario_id": "one", "step": s, "lane_id": 1, "state": "stop" if s < 5 else "go"} for s in range(91)]
    row = [{"scenario_id": "one", "ego_id": 7, "map_id": "m", "step_s": 0.1, "license": "mine"}]
    write_tables(folder / "tables", None, row, shared, lanes=lanes, lights=lights)


def gpudrive_format(form: str) -> Format:
    """A form of GPUDrive and Nocturne."""
    make = lambda folder: write_file(folder / "scenes", build_message("one", num_tracks=3), form)  # noqa: E731
    return Format({"scenes/*": "json"}, make, convert(Path("scenes"), "--from", "gpudrive"), ("scenario.gpudrive",))


def read_set(folder: Path) -> None:
    data = rs.load_dataset(folder / "set", "validation")
    rs.simulate(ENTRY, list(data), num_rollouts=1)
    run("data", "verify", folder / "set")
    run("data", "stats", folder / "set")


def read_shard(folder: Path) -> None:
    with contextlib.suppress(RlftsimError):
        run("data", "verify", folder / "set")
    rs.simulate(ENTRY, list(rs.load_dataset(folder / "set", "validation")), num_rollouts=1)


def make_begun_conversion(folder: Path) -> None:
    make_womd(folder)
    with contextlib.suppress(RlftsimError):
        run("convert", folder / "womd", folder / "new", "--jobs", 1, "--share", "1/2")


def _drawn(task: object) -> Iterator[rs.Scenario]:
    shard = re.sub(r"\W", "", task.shard_name)  # type: ignore[attr-defined]
    yield from (scenes.straight_road(f"{shard}{n}") for n in range(task.num_scenarios))  # type: ignore[attr-defined]


@contextlib.contextmanager
def without_sumo() -> Iterator[None]:
    """Inside, synthetic scenarios are drawn by hand."""
    with (
        mock.patch.object(generate.sumo, "is_available", return_value=True),
        mock.patch.object(generate.sumo, "sumo_version", return_value="1.0"),
        mock.patch.object(generate, "generate_scenarios", _drawn),
    ):
        yield


def read_begun_synthesis(folder: Path) -> None:
    with without_sumo():
        run("synthesize", folder / "new", "--num-scenarios", 4)


def make_begun_synthesis(folder: Path) -> None:
    with without_sumo(), contextlib.suppress(RlftsimError):
        run("synthesize", folder / "new", "--num-scenarios", 4, "--share", "1/2")


def make_world_document(folder: Path) -> None:
    track = {"object_id": 7, "sumo_id": "v7", "shape": (3.6, 2.3, 0.1, 1.0), "state": (9.0, 1.0, 5.4, 1.0, 6.7, 1.0)}
    window = {"scenario_id": "a", "num_steps": 631, "ego": "v1", "tracks": [track], "lights": [["J1", 0, 12]]}
    document = {"format": worlds.FORMAT, "sumo_version": "1.28.0", "seed": 5, "options": worlds.OPTIONS}
    (folder / worlds.DOCUMENT).write_text(json.dumps({**document, "windows": [window]}))


def pack_world(folder: Path) -> None:
    (folder / worlds.WORLDS).mkdir()
    with zipfile.ZipFile(folder / worlds.WORLDS / f"a{worlds.SUFFIX}", "w") as archive:
        archive.write(folder / worlds.DOCUMENT, worlds.DOCUMENT)


def make_world(folder: Path) -> None:
    make_world_document(folder)
    pack_world(folder)


def read_world_document(folder: Path) -> None:
    pack_world(folder)
    worlds.find_window(folder, "a")


def make_begun_copy(folder: Path) -> None:
    write_set(folder.parent)  # the copy's address must not change with the folder
    (folder / "new").mkdir()
    url = f"file://{folder.parent / 'set'}"
    note = f"A copy of {url} runs here or was interrupted: run the same command again, it goes on."
    (folder / "new" / "INCOMPLETE").write_text(note + "\nhost process 1 since 2026-01-01T00:00:00+00:00\n")


# ---- models ---------------------------------------------------------------------------------------


def make_smart(folder: Path) -> None:
    policy = tiny.tiny_policy(_vocabulary())
    policy.with_goal_conditioning("indication", logit_bias=True).save_pretrained(folder / "model")


def make_trafficbots(folder: Path) -> None:
    torch.manual_seed(0)
    recipe = replace(recipe_by_name("trafficbots-demo"), model=TINY_BOTS)
    recipe.new_policy(None).save_pretrained(folder / "model")


def make_calibrated(folder: Path) -> None:
    policy = CalibratedTokenPolicy(tiny.tiny_policy(_vocabulary()), ("speed_slow", "speed_fast"), [0.1, -0.2])
    scores = {name: 0.01 for name in ("rmm", "kinematic", "interactive", "map_based")}
    changes = {name: {"change": 0.01, "t": 2.0} for name in CHANGES}
    calibration = {
        "num_scenarios": [3, 1], "num_rollouts": 8, "constraints": ["speed"], "length": 0.7,
        "features": [{"feature": name, "eta": 0.1, "t": 2.0, **scores} for name in policy.features],
        "held_back": [{"length": 0.7, "kl": 0.01, **changes}],
    }  # fmt: skip
    policy.set_calibration(policy.eta, calibration)
    policy.save_pretrained(folder / "model")


def read_calibrated(folder: Path) -> None:
    read_policy(folder)
    write_calibration_picture(folder / "model")


def make_ledger(folder: Path) -> None:
    look = {"exam": "e", "looks": 1, "recipe": "r", "date": "2026-01-01", "fingerprints": ["f" * 32]}
    Ledger(folder / "exam.jsonl").append([look])


def read_policy(folder: Path) -> None:
    read_card(folder / "model")
    rs.simulate(rs.load_policy(folder / "model"), _scenarios()[0], num_rollouts=1)


def make_catk(folder: Path) -> None:
    torch.manual_seed(1)
    policy = rs.SmartPolicy(replace(smart_nano(), catk_compat=True), _vocabulary())
    content = {"state_dict": export_catk(policy), "hyper_parameters": {"model_config": {"decoder": _sizes(policy)}}}
    torch.save(content, folder / "epoch.ckpt")
    write_catk(policy, folder / "weights.safetensors")
    write_catk_vocabulary(policy.vocabulary, folder / "tables.npz")


def make_entries(folder: Path) -> None:
    left, turn, speed, closing = (np.array(pair) for pair in ((0.0, 2.0), (0.0, 3.0), (9.0, 0.1), (8.0, 2.0)))
    moving, standing = np.array([-4.0, 0.5, 0.2]), np.array([-5.0, 1.0, 0.3])
    write_entries(
        folder / "entries.npz",
        FittedEntries(moving, standing, Entrants(np.array([1, 2]), left, turn, speed), closing),
    )


def read_entries(folder: Path) -> None:
    model = load_entries(str(folder / "entries.npz"))
    gates = GateFinder(scenes.straight_road()).find(np.zeros(2), np.ones(2), 50.0)
    assert np.isfinite(model.expect(gates)).all()
    model.draw(gates, np.random.default_rng(0))


def make_learned_planner(folder: Path) -> None:
    from stable_baselines3 import PPO

    from rlftsim.envs.sb3 import SB3VecEnv

    env = SB3VecEnv(1, scenarios=[scenes.straight_road()], traffic="replay", observation="flat")
    PPO("MlpPolicy", env, n_steps=8, batch_size=8, policy_kwargs={"net_arch": [2]}).save(folder / "ppo.zip")


def read_learned_planner(folder: Path) -> None:
    planner = load_planner(f"sb3:{folder / 'ppo.zip'}")
    planner.act({name: np.zeros(shape) for name, shape in SHAPES.items()})


def _sizes(policy: rs.SmartPolicy) -> dict[str, object]:
    config = policy.config
    return {
        **CATK_SIZES, "hidden_dim": config.dim, "num_freq_bands": config.num_frequencies,
        "num_heads": config.num_heads, "head_dim": config.head_dim, "num_map_layers": config.num_map_layers,
        "num_agent_layers": config.num_decoder_layers,
    }  # fmt: skip


def import_catk(checkpoint: str) -> Callable[[Path], None]:
    """An import of a checkpoint with its tables."""
    return lambda folder: run(
        "model", "import", folder / checkpoint, "--vocabulary", folder / "tables.npz", "--out", folder / "model"
    )


# ---- runs -----------------------------------------------------------------------------------------


def train(folder: Path) -> None:
    policy = tiny.tiny_policy(_vocabulary(), tiny.WITHOUT_CHANCE)
    tiny.train("finetune", policy, _scenarios(), folder / "run", epochs=2.0, checkpoint_every=2)


def make_run(folder: Path) -> None:
    train(folder)
    shutil.rmtree(folder / "run" / "model")  # as if it had been killed just before its end
    (folder / "run" / "trackers.json").write_text('{"tensorboard": "abc"}')


def read_run(folder: Path) -> None:
    train(folder)
    read_metrics(folder / "run")
    rs.load_policy(folder / "run")


def read_config(folder: Path) -> None:
    for name in ("recipe", "run"):
        words = ("finetune", "smart-demo", "--config", folder / f"{name}.json", "--model", "demo-base")
        parse([*map(str, words), "--data", "synthetic", "--out", "out"])


def make_config(folder: Path) -> None:
    recipe = json.loads(recipe_as_json(recipe_by_name("smart-demo")))
    (folder / "recipe.json").write_text(json.dumps(recipe))
    (folder / "run.json").write_text(json.dumps({**recipe["finetune"], "initial_policy": "0", "scenarios": "1"}))


# ---- goals ----------------------------------------------------------------------------------------


def _entries() -> tuple[GoalEntry, ...]:
    return tuple(
        GoalEntry(
            one.scenario_id, int(one.tracks.object_id[track]), *map(float, one.tracks.position[track, -1, :2]), ""
        )
        for one in _scenarios()
        for track in one.evaluated_indices[:1]
    )


def make_goals(folder: Path) -> None:
    write_set(folder)
    write_goals(folder / "goals.json", GoalsFile(_entries(), _entries()))


def make_stored_goals(folder: Path) -> None:
    (folder / "goals").mkdir()
    for number, one in enumerate(_scenarios()):
        tracks = one.evaluated_indices
        points = one.tracks.position[tracks, -1, :2].astype(float)
        write_goal_file(
            folder / "goals" / f"{number}.parquet", {one.scenario_id: (one.tracks.object_id[tracks], points)}
        )


def read_stored_goals(folder: Path) -> None:
    goals = StoredGoals(folder / "goals")
    for one in _scenarios():
        if one.scenario_id in goals:
            rs.simulate(_goal_conditioned(), one, num_rollouts=1, goals=goals.of_batch(_batch(one)))


@lru_cache
def _goal_conditioned() -> rs.SmartPolicy:
    return tiny.tiny_policy(_vocabulary()).with_goal_conditioning("indication").eval()


def _batch(scenario: rs.Scenario) -> object:
    from rlftsim.scenario.batch import collate

    return collate([scenario])


# ---- results --------------------------------------------------------------------------------------

EVALUATE = EvaluateConfig(num_rollouts=4, rollouts_per_pass=4)


def make_evaluations(folder: Path) -> None:
    for name, values in {"a": (0.7, 0.6, 0.75), "b": (0.72, 0.61, 0.7)}.items():
        made_up.evaluation(name, values).write(folder / f"{name}.parquet")


def read_evaluations(folder: Path) -> None:
    repr(rs.compare(folder / "a.parquet", folder / "b.parquet"))
    run("compare", folder / "a.parquet", folder / "b.parquet")


def evaluate(folder: Path) -> None:
    run("evaluate", ENTRY, "--data", folder / "set", "--out", folder / "out", "--num-rollouts", 2, "--device", "cpu")


def make_finished_evaluation(folder: Path) -> None:
    write_set(folder)
    evaluate(folder)


def make_begun_evaluation(folder: Path) -> None:
    make_finished_evaluation(folder)
    finished = folder / "out" / f"{ENTRY}.parquet"
    (folder / "out" / f"{ENTRY}.parts").mkdir(exist_ok=True)
    finished.rename(folder / "out" / f"{ENTRY}.parts" / "000000-000002.parquet")


def drive(folder: Path) -> None:
    run("drive", "replay", "--data", folder / "set", "--traffic", "replay", "--out", folder / "out")


def make_drives(folder: Path) -> None:
    write_set(folder)
    drive(folder)
    for name in ("a", "b"):
        shutil.copy(folder / "out" / "replay-replay.parquet", folder / f"{name}.parquet")


def read_drives(folder: Path) -> None:
    DriveResult.read(folder / "b.parquet")
    run("compare", folder / "a.parquet", folder / "b.parquet")
    drive(folder)


def make_begun_drive(folder: Path) -> None:
    write_set(folder)
    # a result that cannot be put together leaves what is finished
    with mock.patch.object(DriveResult, "of", side_effect=NotRead), contextlib.suppress(NotRead):
        drive(folder)


def fail(folder: Path) -> None:
    words = ("--traffic", "replay", "--particles", "2", "--budget", "4000", "--event", "collision", "--films", "0")
    run("failures", "constant_velocity", "--data", folder / "set", *words, "--out", folder / "out")


def make_failures(folder: Path) -> None:
    write_set(folder)
    fail(folder)


def measure(folder: Path) -> None:
    data = folder / "set"
    measure_variances(entries.Wanderer(), data, folder / "variances", EVALUATE)
    attain_goals(rs.ConstantVelocity(), data, folder / "goals", EVALUATE, _entries())


def make_measured(folder: Path) -> None:
    write_set(folder)
    measure(folder)


# ---- rollouts and submissions ---------------------------------------------------------------------


def make_rollouts(folder: Path) -> None:
    write_set(folder)
    (folder / "rollouts").mkdir()
    for number, one in enumerate(_scenarios()):
        write_npz(folder / "rollouts" / f"{one.scenario_id}.npz", draw_arrays(one, 2, number))


def score(name: str, scenarios: str = "set") -> Callable[[Path], None]:
    """A score of rollouts."""
    return lambda folder: run("score", folder / name, "--data", folder / scenarios, "--jobs", 1)


def make_messages(folder: Path) -> None:
    write_set(folder)
    arrays = [draw_arrays(one, 2, number) for number, one in enumerate(_scenarios())]
    write_submission(folder / "all.binproto", *arrays)
    (folder / "one").mkdir()
    (folder / "one" / "s1.binproto").write_bytes(to_scenario_rollouts(arrays[0]).SerializeToString())


def make_scored_records(folder: Path) -> None:
    make_womd(folder)
    (folder / "new").mkdir()
    with tempfile.TemporaryDirectory() as place:
        run("convert", folder / "womd", f"{place}/set", "--jobs", 1)
        for one in list(rs.load_dataset(f"{place}/set"))[:1]:
            write_npz(folder / "new" / f"{one.scenario_id}.npz", draw_arrays(one, 2))


def simulate(folder: Path) -> None:
    words = ("simulate", ENTRY, "--data", folder / "set", "--out", folder / "out", "--num-rollouts", 2)
    run(*words, "--device", "cpu", "--export", "page")


def make_simulated(folder: Path) -> None:
    write_set(folder)
    simulate(folder)


def _env() -> EgoEnv:
    return EgoEnv(scenarios=[scenes.bend()], traffic="replay")


def make_snapshot(folder: Path) -> None:
    env = _env()
    env.reset(seed=0)
    for _ in range(3):
        env.step(np.zeros(2, np.float32))
    (folder / "snapshot").write_bytes(env.snapshot())


def read_snapshot(folder: Path) -> None:
    env = _env()
    env.restore((folder / "snapshot").read_bytes())
    env.step(np.zeros(2, np.float32))


def make_archive(folder: Path) -> None:
    data = entries.write_data(folder / "set", num_scenarios=2)
    entries.pack(folder / "submission.tar.gz", entries.draw_shards(data, num_shards=2))
    (folder / "submission.report.json").write_text(json.dumps({"sha256": "0" * 64, "bytes": 1}))


def check_archive(folder: Path) -> None:
    run("submit", "check", folder / "submission.tar.gz", "--data", folder / "set")
    run("submit", "info", folder / "submission.tar.gz")


def build(*words: str) -> Callable[[Path], None]:
    """A build of a submission."""
    return lambda folder: run(
        "submit", "build", ENTRY, "--data", folder / "set", "--config", folder / "entry.toml", "--out", folder / "out",
        "--num-shards", 2, "--device", "cpu", "--i-comply", *words,
    )  # fmt: skip


def make_begun_build(folder: Path) -> None:
    entries.write_data(folder / "set", num_scenarios=2)
    (folder / "entry.toml").write_text(entries.TOML)
    with contextlib.suppress(RlftsimError):
        build("--share", "1/2")(folder)


FORMATS: Mapping[str, Format] = {
    "WOMD": Format({"womd/*": "tfrecord"}, make_womd, convert(Path("womd")), ("scenario.tfrecord", "scenario.womd")),
    "Argoverse 2": Format(
        {"val/*/*.parquet": "parquet", "val/*/*.json": "json"},
        make_av2,
        convert(Path("val"), "--from", "av2"),
        ("scenario.av2", "scenario.av2_map"),
    ),
    "sizes of Argoverse 2": Format(
        {"sizes.json": "json"}, make_av2, convert(Path("val"), "--sizes", Path("sizes.json")), ("scenario.av2",)
    ),
    "tables": Format(
        {"tables/*": "parquet"}, make_tables, convert(Path("tables"), "--from", "tables"), ("scenario.tables",)
    ),
    "GPUDrive": gpudrive_format("present"),
    "early GPUDrive": gpudrive_format("early"),
    "Nocturne": gpudrive_format("Nocturne"),
    "data set": Format(
        {"set/manifest.json": "json", "set/index.parquet": "parquet"}, *(write_set, read_set), ("scenario.dataset",)
    ),
    "shard": Format({"set/shards/*.arrow": "shard"}, write_set, read_shard, ("scenario.shards",)),
    "begun conversion": Format(
        {"new/shards/**/*.json": "json"}, make_begun_conversion, convert(Path("womd")), ("scenario.convert",)
    ),
    "begun synthesis": Format(
        {"new/INCOMPLETE": "json"}, make_begun_synthesis, read_begun_synthesis, ("scenario.synthetic.generate",)
    ),
    "world": Format(
        {"worlds/*": "archive"},
        make_world,
        lambda folder: worlds.find_window(folder, "a"),
        ("scenario.synthetic.worlds",),
    ),
    "document of a world": Format(
        {"world.json": "json"}, make_world_document, read_world_document, ("scenario.synthetic.worlds",)
    ),
    "begun copy": Format(
        {"new/INCOMPLETE": "text"},
        make_begun_copy,
        lambda folder: pull_dataset(f"file://{folder.parent / 'set'}", folder / "new"),
        ("scenario.transfer",),
    ),
    "vocabulary": Format(
        {"v.safetensors": "safetensors"},
        lambda folder: _vocabulary().save(folder / "v.safetensors"),
        lambda folder: rs.simulate(
            tiny.tiny_policy(Vocabulary.load(folder / "v.safetensors")), _scenarios()[0], num_rollouts=1
        ),
        ("tokens.vocabulary",),
    ),
    "SMART": Format(
        {"model/config.json": "json", "model/*.safetensors": "safetensors", "model/README.md": "text"},
        make_smart,
        read_policy,
        ("policies.checkpoint", "tokens.vocabulary"),
    ),
    "calibrated model": Format(
        {"model/*.json": "json", "model/model.safetensors": "safetensors"},
        make_calibrated,
        read_calibrated,
        ("policies.checkpoint", "policies.calibrated.policy"),
    ),
    "TrafficBots": Format(
        {"model/config.json": "json", "model/*.safetensors": "safetensors"},
        make_trafficbots,
        read_policy,
        ("policies.checkpoint",),
    ),
    "learned planner": Format(
        {"ppo.zip": "npz"}, make_learned_planner, read_learned_planner, ("envs.learned_planner",)
    ),
    "CAT-K checkpoint": Format(
        {"epoch.ckpt": "checkpoint"},
        make_catk,
        import_catk("epoch.ckpt"),
        ("policies.smart.catk_checkpoint",),
    ),
    "CAT-K weights": Format(
        {"weights.safetensors": "safetensors", "tables.npz": "npz"},
        make_catk,
        import_catk("weights.safetensors"),
        ("policies.smart.catk_checkpoint",),
    ),
    "AlpaSim's CAT-K": Format(
        {"catk_v120/config.yaml": "text", "catk_v120/latest.ckpt": "checkpoint", "tokens/*.pkl": "text"},
        write_alpasim,
        lambda folder: run("model", "import", folder / "catk_v120", "--from", "alpasim", "--out", folder / "model"),
        ("policies.smart.alpasim_checkpoint",),
    ),
    "run": Format(
        {"run/config.json": "json", "run/metrics.jsonl": "jsonl", "run/trackers.json": "json"},
        make_run,
        read_run,
        ("training.run_folder", "training.trackers", "verbs.runs"),
    ),
    "checkpoint of a run": Format(
        {"run/checkpoints/*4/*.safetensors": "safetensors", "run/checkpoints/*4/*.json": "json"},
        make_run,
        read_run,
        ("training.checkpoint",),
    ),
    "settings": Format({"*.json": "json"}, make_config, read_config, ("recipes.settings",)),
    "ledger": Format(
        {"exam.jsonl": "json"},
        make_ledger,
        lambda folder: Ledger(folder / "exam.jsonl").count_looks("e", "r", ["f" * 32], is_repeat=True),
        ("experiments.exam",),
    ),
    "goals": Format(
        {"goals.json": "json"},
        make_goals,
        lambda folder: run("goals", "check", folder / "goals.json", "--data", folder / "set"),
        ("goals.goals_file",),
    ),
    "augmented goals": Format({"goals/*": "parquet"}, make_stored_goals, read_stored_goals, ("goals.types",)),
    "evaluation": Format({"b.parquet": "parquet"}, make_evaluations, read_evaluations, ("evaluation.results",)),
    "finished evaluation": Format(
        {"out/*.parquet": "parquet"}, make_finished_evaluation, evaluate, ("evaluation.results",)
    ),
    "begun evaluation": Format({"out/*.parts/*": "parquet"}, make_begun_evaluation, evaluate, ("evaluation.results",)),
    "drive": Format(
        {"b.parquet": "parquet", "out/*.parquet": "parquet"}, make_drives, read_drives, ("evaluation.drive_results",)
    ),
    "begun drive": Format({"out/*.parts/*.json": "json"}, make_begun_drive, drive, ("evaluation.resumable",)),
    "failures": Format(
        {"out/failures.parquet": "parquet"},
        make_failures,
        lambda folder: run("failures", "show", folder / "out", "0"),
        ("envs.failure_study",),
    ),
    "begun failures": Format(
        {"out/failures.json": "json", "out/pilot/*": "json", "out/repeats/*": "json"},
        make_failures,
        fail,
        ("envs.failure_run",),
    ),
    "measurements": Format({"*/s?.json": "json"}, make_measured, measure, ("evaluation.resumable",)),
    "entries": Format({"entries.npz": "npz"}, make_entries, read_entries, ("rollout.entries",)),
    "rollouts": Format({"rollouts/*": "npz"}, make_rollouts, score("rollouts"), ("evaluation.rollout_files",)),
    "messages of rollouts": Format(
        {"all.binproto": "submission"}, make_messages, score("all.binproto"), ("evaluation.rollout_files",)
    ),
    "message of rollouts": Format({"one/*": "rollouts"}, make_messages, score("one"), ("evaluation.rollout_files",)),
    "scored records": Format(
        {"womd/*": "tfrecord"}, make_scored_records, score("new", "womd"), ("evaluation.scenario_source",)
    ),
    "simulated folder": Format(
        {"out/rollouts.json": "json", "out/*.npz": "npz"}, make_simulated, simulate, ("evaluation.rollout_folder",)
    ),
    "snapshot": Format({"snapshot": "snapshot"}, make_snapshot, read_snapshot, ("envs.snapshot",)),
    "entry": Format(
        {"entry.toml": "toml"},
        lambda folder: (folder / "entry.toml").write_text(entries.TOML),
        lambda folder: describe_entry(read_entry(folder / "entry.toml"), "7M"),
        ("submission.entry",),
    ),
    "archive": Format(
        {"submission.tar.gz": "archive"},
        make_archive,
        check_archive,
        ("submission.archive", "submission.check", "submission.messages"),
    ),
    "report of an archive": Format(
        {"submission.report.json": "json"}, make_archive, check_archive, ("submission.report",)
    ),
    "begun build": Format(
        {"out/plan.json": "json", "out/**/*.json": "json"},
        make_begun_build,
        build(),
        ("submission.plan",),
    ),
    "token": Format(
        {"token": "text"},
        lambda folder: load_token(folder / "token"),
        lambda folder: load_token(folder / "token"),
        ("studio.server",),
    ),
}
"""All formats by name."""

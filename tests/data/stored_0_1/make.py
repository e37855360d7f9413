"""Makes stored.tar.xz and expected.json beside this file.

Run it with the code of release 0.1 (commit 7597aaf), never with later code:

    PYTHONPATH=<checkout of 7597aaf>/src OMP_NUM_THREADS=1 OMP_WAIT_POLICY=PASSIVE python make.py

Everything is made in the folder `stored` with paths relative to it, on one CPU thread, in under a minute.
"""

import contextlib
import hashlib
import io
import json
import os
import platform
import shutil
import tarfile
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import torch
from rlftsim.experiments.attainment import measure_attainment
from rlftsim.experiments.catalogue import variance_scaling
from rlftsim.experiments.catalogue.maneuver_controllability import goals_path, propose_goals
from rlftsim.experiments.compare import compare
from rlftsim.experiments.contestants import BASE, FineTuned, GoalTraining, Guided
from rlftsim.experiments.evaluate import EvaluateConfig, evaluate
from rlftsim.experiments.evaluation import Evaluation
from rlftsim.experiments.workshop import Workshop
from rlftsim.goals.recorded import recorded_goals
from rlftsim.recipes.models import load_policy
from rlftsim.training.gcsl import GcslConfig
from safetensors.torch import load_file

import rlftsim
from rlftsim.cli.main import main
from rlftsim.experiments import evaluate as evaluating
from rlftsim.experiments.stages import (
    NewSight,
    find_vocabulary,
    finetune_with_catk,
    finetune_with_reward,
    open_training,
    pretrain_smart,
    teach_goals,
)  # fmt: skip
from rlftsim.goals.goals_file import read_goals, write_goals
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.recipes.smart import SmartRecipe
from rlftsim.rollout.baselines import ConstantVelocity
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import sees_goals
from rlftsim.rollout.simulate import simulate
from rlftsim.scenario.batch import collate
from rlftsim.scenario.dataset import ScenarioDataset, write_dataset
from rlftsim.scenario.synthetic import pack_path
from rlftsim.tokens.clustering import TokensConfig
from rlftsim.training import finetune as finetuning
from rlftsim.training import imitation
from rlftsim.training.alarms import AlarmConfig
from rlftsim.training.catk import CatkConfig
from rlftsim.training.finetune import FinetuneConfig
from rlftsim.training.goals import GoalConfig
from rlftsim.training.parallel import DeviceConfig
from rlftsim.training.pretrain import PretrainConfig
from rlftsim.training.reference import KlConfig
from rlftsim.training.run_folder import read_metrics
from rlftsim.training.validation import ValidationConfig

HERE = Path(__file__).resolve().parent
TRAINING, VALIDATION = (89, 16, 12, 14), (19, 14, 18, 23, 12)
"""Positions in the splits of the synthetic pack; small maps."""
WRITTEN_AT = 1_700_000_000
"""Modification time of the rollouts: what `rlftsim score` keeps belongs to files of this time."""

# ---- settings ------------------------------------------------------------------------------------------------------

CPU = DeviceConfig(accelerator="cpu", threads=1)
TOKENS = TokensConfig(num_tokens=16, num_map_prototypes=8)
MODEL = SmartConfig(
    dim=4, num_heads=2, head_dim=2, num_map_layers=1, num_decoder_layers=1, num_frequencies=1, history_tokens=2,
    max_map_neighbors=3, max_agent_map_neighbors=3, max_agent_neighbors=3,
)  # fmt: skip
PRETRAIN = PretrainConfig(
    epochs=2.5, batch_size=2, micro_batch_size=1, learning_rate=1e-2, warmup_updates=1, checkpoint_every=2, seed=3,
    validation=ValidationConfig(every=3, num_scenarios=2, num_rollouts=2), device=CPU,
)  # fmt: skip
TUNE = FinetuneConfig(
    epochs=2.5, batch_size=2, micro_batch_size=1, num_rollouts=2, rollouts_per_pass=1, learning_rate=1e-2,
    warmup_updates=2, reward="mloo + 0.1*collision_offroad", checkpoint_every=2,
    kl=KlConfig(reference_every=2, reference_share=0.25), alarms=AlarmConfig(first_updates=2, window=2), device=CPU,
)  # fmt: skip
GOALS = replace(
    TUNE, num_rollouts=3, rollouts_per_pass=2, reward="gcft(goal_weight=0.3, kind='hard', partial=True)",
    credit="agent", goals=GoalConfig(share=0.8, augmented="augmented", augmented_share=0.5, hindsight=0.5,
    learning_rate_scale=2.0), kl=replace(TUNE.kl, reference_asked=False),
)  # fmt: skip
GCSL = GcslConfig(epochs=1.25, batch_size=1, num_rollouts=2, checkpoint_every=2, device=CPU)
CATK = CatkConfig(
    epochs=1.25, batch_size=1, learning_rate=1e-2, num_candidates=4, max_distance_lengths=2.0, goal_share=0.5,
    goal_learning_rate_scale=2.0, checkpoint_every=2, device=CPU,
)  # fmt: skip
RECIPE = SmartRecipe(TOKENS, MODEL, PRETRAIN, replace(TUNE, epochs=1.0), CATK, GCSL)
QUICK = EvaluateConfig(num_rollouts=4, limit=4)

# ---- what is made --------------------------------------------------------------------------------------------------


def train(name: str, out: Path) -> None:
    """The call that makes a run, and that goes on with it."""
    training, held_out = open_training(Path("data")), ScenarioDataset("data", "validation")
    vocabulary = find_vocabulary(training, TOKENS, Path("vocabulary.safetensors"), origin="stored by 0.1")
    match name:
        case "base":
            pretrain_smart(vocabulary, training, MODEL, PRETRAIN, out, held_out=held_out)
        case "tuned":
            finetune_with_reward("models/base", training, TUNE, out)
        case "goals":
            finetune_with_reward("models/base", training, GOALS, out, sight=NewSight("concat", True))
        case "gcsl":
            teach_goals("models/tuned", training, GCSL, out, sight=NewSight("concat"))
        case "catk":
            finetune_with_catk("models/goals", training, CATK, out)


def store_run(name: str) -> list[dict[str, float]]:
    """The model of a run that nothing stopped, and the folder of the same run stopped inside its fourth update of five.

    Returns the metrics.
    """
    whole = Path("whole") / name
    train(name, whole)
    shutil.copytree(whole / "model", f"models/{name}")
    loop = (finetuning, "update_policy") if name in ("tuned", "goals") else (imitation, "_update")
    with killed_in(*loop, call=4):
        train(name, Path("stopped") / name)
    return [{k: v for k, v in m.items() if k != "time" and not k.startswith("seconds")} for m in read_metrics(whole)]


@contextmanager
def killed_in(module, name, *, call):
    """The n-th call of a function does its work and is interrupted."""
    original, calls = getattr(module, name), []

    def interrupted(*args, **options):
        result = original(*args, **options)
        calls.append(1)
        if len(calls) == call:
            raise KeyboardInterrupt
        return result

    setattr(module, name, interrupted)
    with contextlib.suppress(KeyboardInterrupt):
        yield
    setattr(module, name, original)


def store_other_models() -> None:
    """Untrained models: one with the other goal encoding and no logit bias, one with the public code's quirks."""
    torch.manual_seed(5)
    other = load_policy("models/base").with_goal_sight("indication", aim=False)
    with torch.no_grad():
        for part in other.goal_parts():
            for weight in part.parameters():
                weight.add_(0.3 * torch.randn(weight.shape))
    other.save_pretrained(Path("models/indication"))
    quirky = SmartPolicy(replace(MODEL, public_code_quirks=True), other.vocabulary)
    quirky.save_pretrained(Path("models/quirks"))


def ends(model: str) -> list:
    """Where the agents of a scenario end in two rollouts, asked to go where the record ends if the model sees goals."""
    batch = collate([ScenarioDataset("data", "validation")[0]])
    policy = load_policy(model)
    goals = recorded_goals(batch) if sees_goals(policy) else None
    return simulate(policy, batch, num_rollouts=2, seed=7, goals=goals).position[0, :, :, -1].tolist()


def store_evaluations() -> dict[str, list]:
    """Finished ones, and one that was stopped after its first part. Returns their rows."""
    config, data, out = replace(QUICK, goals="recorded"), Path("data"), Path("evaluations")
    evaluate(load_policy("models/base"), data, out, QUICK, name="base")
    evaluate(load_policy("models/tuned"), data, out, QUICK, name="tuned")
    evaluate(load_policy("models/goals"), data, out, config, name="goals")
    evaluate(load_policy("models/goals", goal_guidance=2.0), data, out, config, name="guided")
    evaluate(ConstantVelocity(), pack_path(), out, QUICK, name="synthetic")
    stopped = replace(config, limit=None)
    whole = evaluate(load_policy("models/goals"), data, Path("whole"), stopped, name="stopped")
    with killed_in(evaluating, "_evaluate_scenario", call=5):
        evaluate(load_policy("models/goals"), data, out, stopped, name="stopped")
    return rows_of(out) | {"stopped": whole.table.to_pylist()}


def store_goals_files() -> None:
    """One that `rlftsim goals propose` wrote for two scenarios, and one by hand."""
    one, two, *_ = ScenarioDataset("data", "validation").scenario_ids
    run("goals", "propose", "data", "--scenario", one, two, "--out", "goals/proposed.json")
    agents = [entry.agent_id for entry in read_goals(Path("goals/proposed.json")).goals]
    Path("goals/by_hand.json").write_text(
        f'{{"goals": [{{"agent": {agents[0]}, "y": -3, "x": 1.5e1, "scenario": "{one}"}}], '
        '"format": "rlftsim-goals-1"}',
        encoding="utf-8-sig",
    )


def store_rollouts() -> dict:
    """Of two scenarios, with goals, and their scores. Returns these as JSON."""
    run("simulate", "models/goals", "--data", "data", "--goals", "goals/proposed.json", "--out", "rollouts",
        "--num-rollouts", "2", "--seed", "1", "--device", "cpu")  # fmt: skip
    for path in Path("rollouts").glob("*.npz"):
        os.utime(path, (WRITTEN_AT, WRITTEN_AT))
    return json.loads(run("score", "rollouts", "--scenarios", "data", "--out", "scores", "--json", "--jobs", "1"))


def store_experiments() -> dict:
    """A workshop with fine-tuned, told, asked and guided models. Returns what was measured."""
    workshop = Workshop(RECIPE, Path("data"), Path("experiments"), replace(QUICK, limit=2), base_model="models/base")
    told = FineTuned("gcsl", goals=GoalTraining("concat"))
    asked = FineTuned("gcft", "agent", base=told, goals=GoalTraining("concat", "soft", weight=0.2))
    contestants = {"base": BASE, "MLOO": FineTuned("mloo"), "told": told, "asked": asked, "guided": Guided(asked, 2.0)}
    free = workshop.measure({name: (one,) for name, one in contestants.items()})
    who = {name: (contestants[name],) for name in ("told", "asked", "guided")}
    with_goals = workshop.measure(who, goals="recorded")
    held_out, path = ScenarioDataset("data", "validation"), goals_path(workshop)
    if not path.exists():
        write_goals(path, propose_goals(held_out, held_out.scenario_ids[:2]))
    file = read_goals(path)
    entries = [*file.goals, *file.alternatives]
    rows = {name: contestants[name] for name in ("base", "asked", "guided")}
    attained = measure_attainment(workshop, rows, entries, name="maneuver-controllability")
    variances = variance_scaling.measure(workshop)
    return {
        "evaluations": rows_of(Path("experiments/evaluations")),
        "measured": {name: row.mean.values("meta_metric").tolist() for name, row in free.items()},
        "measured_with_goals": {name: row.mean.values("meta_metric").tolist() for name, row in with_goals.items()},
        "attained": {name: [[one.reached, one.passed] for one in found] for name, found in attained.items()},
        "variances": {name: values.tolist() for name, values in variances.by_reward.items()},
    }


# ---- helpers -------------------------------------------------------------------------------------------------------


def run(*words: str) -> str:
    """A command line; what it prints."""
    with contextlib.redirect_stdout(io.StringIO()) as out:
        assert main(words) == 0, words
    return out.getvalue()


def rows_of(folder: Path) -> dict[str, list]:
    """Of all evaluations in a folder, by name."""
    return {path.stem: Evaluation.read(path).table.to_pylist() for path in sorted(folder.glob("*.parquet"))}


def hash_weights(model: Path) -> str:
    """Of the values alone: whatever the weights are called, and in whatever order they stand."""
    tensors = load_file(model / "model.safetensors").values()
    parts = sorted(hashlib.sha256(f"{tuple(t.shape)}".encode() + t.numpy().tobytes()).hexdigest() for t in tensors)
    return hashlib.sha256("".join(parts).encode()).hexdigest()


def entries_of(path: str) -> dict[str, list]:
    """What a goals file says, in plain values."""
    file = read_goals(Path(path))
    return {
        name: [[e.scenario_id, e.agent_id, e.x, e.y, e.label] for e in entries]
        for name, entries in (("goals", file.goals), ("alternatives", file.alternatives))
    }


def pack() -> None:
    """Everything but what is of this machine alone, in one file."""
    for unwanted in [*Path().rglob("tensorboard"), *Path().rglob("environment.json"), Path("whole")]:
        shutil.rmtree(unwanted) if unwanted.is_dir() else unwanted.unlink()

    def anonymous(info: tarfile.TarInfo) -> tarfile.TarInfo:
        info.uid, info.gid, info.uname, info.gname, info.mtime = 0, 0, "", "", WRITTEN_AT
        return info

    with tarfile.open(HERE / "stored.tar.xz", "w:xz") as tar:
        for path in sorted(p for p in Path().rglob("*") if p.is_file()):
            tar.add(path, filter=anonymous)


def make() -> None:
    """Everything, in its order."""
    assert rlftsim.__version__ == "0.1.0", rlftsim.__file__
    shutil.rmtree(HERE / "stored", ignore_errors=True)
    (HERE / "stored" / "models").mkdir(parents=True)
    (HERE / "stored" / "goals").mkdir()
    os.chdir(HERE / "stored")
    torch.set_num_threads(1)
    splits = {"training": TRAINING, "validation": VALIDATION}
    chosen = [(ScenarioDataset(pack_path(), s)[i], s) for s, places in splits.items() for i in places]
    split_of = {scenario.scenario_id: split for scenario, split in chosen}
    write_dataset(
        [scenario for scenario, _ in chosen], "data", split=lambda s: split_of[s.scenario_id], licence_note="CC0-1.0"
    )
    metrics = {"base": store_run("base")}
    run("augment", "models/base", "--data", "data", "--out", "augmented",
        "--device", "cpu", "--set", "num-rollouts=4", "top-k=4")  # fmt: skip
    metrics |= {name: store_run(name) for name in ("tuned", "goals", "gcsl", "catk")}
    store_other_models()
    evaluations = store_evaluations()
    store_goals_files()
    scores = store_rollouts()
    models = sorted(path.name for path in Path("models").iterdir())
    first, second = (Evaluation.read(Path(f"evaluations/{name}.parquet")) for name in ("base", "tuned"))
    expected = {
        "made_with": {
            "rlftsim": rlftsim.__version__, "commit": "7597aaf", "torch": torch.__version__,
            "python": platform.python_version(), "cpu_capability": torch.backends.cpu.get_cpu_capability(),
        },
        "weights": {name: hash_weights(Path("models") / name) for name in models},
        "fingerprints": {name: fingerprint_policy(load_policy(f"models/{name}")) for name in models}
        | {
            "goals, guided 2": fingerprint_policy(load_policy("models/goals", goal_guidance=2.0)),
            "constant_velocity": fingerprint_policy(ConstantVelocity()),
        },
        "ends": {name: ends(f"models/{name}") for name in models},
        "metrics": metrics,
        "evaluations": evaluations,
        "comparison": {
            d.column: [d.mean_a, d.mean_b, d.difference, d.p_value] for d in compare(first, second).differences
        },
        "goals_files": {name: entries_of(f"goals/{name}.json") for name in ("proposed", "by_hand")},
        "score": scores,
        "index": ScenarioDataset("data").index.to_pylist(),
        "experiments": store_experiments(),
    }  # fmt: skip
    lines = ",\n".join(f'"{name}": {json.dumps(value)}' for name, value in expected.items())
    (HERE / "expected.json").write_text(f"{{\n{lines}\n}}\n")
    pack()


if __name__ == "__main__":
    make()

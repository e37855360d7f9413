"""The measured work of `speed.py`, one job a process: a line on stdin is one repetition, a line of JSON its numbers.

    PYTHONPATH=CHECKOUT/src python benchmarks/speed_jobs.py '{"task": "rollouts", "inputs": "INPUTS", "scenarios": ["A"]}'

The same file runs on the package of any version from 0.1 on, so it imports what all of them have.
"""

import json
import os
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import dataclass, fields, replace
from pathlib import Path
from typing import Any

import numpy as np

STILL_M = 0.05
"""An agent that moved less in the half second of a decision stood."""
CONTEXT_RADIUS_M = 150.0
"""In updates a step of an agent farther from the ego than this is taken as not logged, by both sides."""
SCENARIOS = {"637f20cafde22ff8": "A", "ee519cf571686d19": "B"}
WEIGHTS_SEED = 1003
NUM_EVALUATED = 8
CURRENT_STEP, STEPS_PER_DECISION = 10, 5

Numbers = dict[str, float]
Repeat = Callable[[], Numbers | None]


@dataclass(frozen=True)
class Job:
    """One thing that is measured; handed to its process as JSON."""

    task: str
    inputs: str = ""
    """Folder that `speed.py` prepared."""
    scenarios: tuple[str, ...] = ()
    """Names of files in INPUTS/records."""
    data: str = ""
    """Data set: "synthetic", or "real" for INPUTS/real."""
    held: bool = False
    """Agents stand where they stand in the log."""
    num_rollouts: int = 32
    timed_rollouts: int = 3
    """Of the public code, which makes them one after the other; the time of all is extrapolated."""
    top_k: int | None = 48
    """None = all tokens."""
    device: str = "cpu"
    precision: str = "32-true"
    """As in `DeviceConfig`; "bf16-mixed" computes under autocast what it holds safe."""
    batch_size: int = 4
    """Scenarios of a fine-tuning update."""
    model: str = "demo"
    """That a fine-tuning update starts from: "demo", or "tiny"."""
    warms_up: bool = True
    """Runs once before it is timed."""
    shared: str = ""
    """Folder of the official material; of `prepare_evaluated`: the folder with its records."""
    checkout: str = ""
    """Of the public code, in its process."""

    @classmethod
    def read(cls, text: str) -> "Job":
        values = json.loads(text)
        return cls(**{**values, "scenarios": tuple(values.get("scenarios", ()))})

    def write(self) -> str:
        return json.dumps({f.name: v for f in fields(self) if (v := getattr(self, f.name)) != f.default})


# ---- the protocol, also of the public code's process --------------------------------------------------------------


def serve(device: str, start: Callable[[], Repeat]) -> None:
    """Set up, then repeat on command: seconds, page faults, peak memory and what the job returns of its own.

    Seconds are CPU time on a CPU, wall time between synchronizations on a GPU. Whatever else is printed goes to stderr.
    """
    answers = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)
    repeat = start()
    print("{}", file=answers, flush=True)
    for _ in sys.stdin:
        faults, began = resource.getrusage(resource.RUSAGE_SELF).ru_minflt, now(device)
        numbers = repeat() or {}
        seconds, usage = now(device) - began, resource.getrusage(resource.RUSAGE_SELF)
        own = {"seconds": seconds, "faults": usage.ru_minflt - faults, "peak_mib": _peak_mib(device, usage)}
        print(json.dumps(own | numbers), file=answers, flush=True)


def now(device: str) -> float:
    """Seconds: CPU time on a CPU, wall time on a GPU that has nothing left to do."""
    if device == "cpu":
        return time.process_time()
    import torch

    torch.cuda.synchronize()
    return time.perf_counter()


def _peak_mib(device: str, usage: resource.struct_rusage) -> float:
    if device == "cpu":
        return usage.ru_maxrss / 1024
    import torch

    return torch.cuda.max_memory_allocated() / 2**20


def stands(position: np.ndarray, valid: np.ndarray) -> np.ndarray:
    """Which agents stand in the log, in the half second of each decision; what is not logged goes on as before.

    Args:
        position: [A, 91, 2 or more].
        valid: [A, 91].

    Returns:
        [A, 16].
    """
    ends = slice(CURRENT_STEP - STEPS_PER_DECISION, None, STEPS_PER_DECISION)
    moved = np.linalg.norm(np.diff(position[:, ends, :2], axis=1), axis=-1)  # [A, 17], one up to the current step
    logged = valid[:, ends][:, 1:] & valid[:, ends][:, :-1]
    still = [np.zeros(len(position), bool)]
    for column, known in zip((moved < STILL_M).T, logged.T):
        still.append(np.where(known, column, still[-1]))
    return np.stack(still[2:], 1)


# ---- our side ------------------------------------------------------------------------------------------------------------


def start(job: Job) -> Repeat:
    """Load everything a job needs, and run it once where it warms up: what happens only once is not timed."""
    import torch

    from rlftsim.cli.main import keep_freed_memory

    keep_freed_memory()  # as the command line does
    torch.set_num_threads(1)
    work = MEASURED[job.task](job)

    def repeat() -> Numbers | None:
        # an update of fine-tuning has an autocast of its own inside
        is_coarse = job.precision == "bf16-mixed" and job.task != "finetune"
        with torch.autocast(job.device, torch.bfloat16, enabled=is_coarse):
            return work()

    if job.warms_up:
        repeat()
    return repeat


def fresh(scenarios: list[Any], device: str) -> Any:
    """A batch of scenarios as they come from a file: without what is cached on a scenario, such as its tokens."""
    from rlftsim.scenario.batch import collate

    return collate([replace(scenario) for scenario in scenarios]).to(device)


def records(job: Job) -> list[Any]:
    """Scenarios of raw records; one that is named twice is read once."""
    from rlftsim.scenario.womd import scenario_from_bytes

    folder = Path(job.inputs) / "records"
    read = {
        name: scenario_from_bytes((folder / f"{name}.record").read_bytes()) for name in dict.fromkeys(job.scenarios)
    }
    return [read[name] for name in job.scenarios]


def tiny(job: Job) -> Any:
    """SMART-tiny with the weights of the public code's golden numbers."""
    from rlftsim.policies.smart.policy import SmartPolicy

    return SmartPolicy.from_pretrained(Path(job.inputs) / "tiny").to(job.device).eval()


def finetune(job: Job) -> Repeat:
    """An update of a few scenarios and 8 rollouts by the paper's objective: simulate, reward, score, step."""
    from rlftsim.policies.smart.policy import SmartPolicy
    from rlftsim.recipes.smart import smart_demo_rlftsim
    from rlftsim.scenario.dataset import ScenarioDataset
    from rlftsim.scenario.synthetic import pack_path
    from rlftsim.training.config import DeviceConfig
    from rlftsim.training.parallel import start_fabric
    from rlftsim.training.reward import prepare, update_policy

    config = smart_demo_rlftsim().finetune
    # the recipe's own objective is not that of all versions
    objective = {"credit": "rollout", "imitation_weight": 0.0, "kl": replace(config.kl, target=0.05)}
    known = {name: value for name, value in objective.items() if hasattr(config, name)}
    device = DeviceConfig(job.device, threads=1, precision=job.precision)
    num_rollouts = min(config.num_rollouts, job.num_rollouts)
    config = replace(config, batch_size=job.batch_size, num_rollouts=num_rollouts, device=device, **known)
    folder = Path(job.inputs) / ("tiny" if job.model == "tiny" else "base/model")
    policy = SmartPolicy.from_pretrained(folder)
    dataset = ScenarioDataset(pack_path() if job.data == "synthetic" else Path(job.inputs) / "real", "training")
    fabric = start_fabric(config.device)
    scenarios = [dataset[i] for i in range(config.batch_size)]
    learner = prepare(policy, config, fabric.device)

    def update() -> Numbers:
        return {"score_gap": update_policy(learner, fresh(scenarios, job.device), config, fabric)["score_gap"]}

    return update


def pretrain(job: Job) -> Repeat:
    """A pre-training update: tokens, forward, loss, backward, clipping, AdamW."""
    import torch
    from torch.nn.functional import cross_entropy

    from rlftsim.training.config import PretrainConfig

    policy, scenarios, config = tiny(job).requires_grad_(True).train(), near_scenarios(job), PretrainConfig()
    optimizer = torch.optim.AdamW(policy.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)

    def update() -> None:
        optimizer.zero_grad(set_to_none=True)
        batch = fresh(scenarios, job.device)
        predicted = policy.teacher_forced(batch, trained(batch))
        logits, target = predicted.logits[predicted.target_mask], predicted.target[predicted.target_mask]
        cross_entropy(logits, target, label_smoothing=config.label_smoothing).backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), config.gradient_clip)
        optimizer.step()

    return update


def catk(job: Job) -> Repeat:
    """A CAT-K update: closed-loop rollout, loss, backward, clipping, AdamW; attention and head are trained."""
    import torch
    from torch.nn.functional import cross_entropy

    from rlftsim.training.catk_rollouts import roll_out_closest  # where older versions have it, too
    from rlftsim.training.config import CatkConfig
    from rlftsim.training.freezing import freeze_untrained
    from rlftsim.training.imitation import predict_targets

    policy, scenarios, config = tiny(job).requires_grad_(True).train(), near_scenarios(job), CatkConfig()
    freeze_untrained(policy, "decoder")
    weights = [p for p in policy.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(weights, lr=config.learning_rate, weight_decay=config.weight_decay)

    def update() -> None:
        optimizer.zero_grad(set_to_none=True)
        batch = fresh(scenarios, job.device)
        context = policy.encode(batch)
        targeted = roll_out_closest(policy, batch, num_candidates=config.num_candidates, context=context)
        predicted = predict_targets(policy, context, targeted, trained(batch))
        logits, target = predicted.logits[predicted.target_mask], predicted.target[predicted.target_mask]
        cross_entropy(logits, target, label_smoothing=config.label_smoothing).backward()
        torch.nn.utils.clip_grad_norm_(weights, config.gradient_clip)
        optimizer.step()

    return update


def near_scenarios(job: Job) -> list[Any]:
    """Scenarios without what is far from the ego, as updates see them."""
    from rlftsim.training.data import within_reach

    return [within_reach(scenario, CONTEXT_RADIUS_M) for scenario in records(job)]


def trained(batch: Any) -> Any:
    """Agents that count in an update."""
    from rlftsim.training.config import PretrainConfig
    from rlftsim.training.data import trained_agents

    config = PretrainConfig()
    return trained_agents(batch, 0, radius_m=config.trained_radius_m, limit=config.max_trained_agents, seed=config.seed)


def rollouts(job: Job) -> Repeat:
    """Rollouts as `rlftsim evaluate` makes them: the scenario encoded once, then a few rollouts at a time."""
    policy, scenarios = tiny(job).requires_grad_(False), records(job)

    def roll_out() -> None:
        simulated(policy, fresh(scenarios, job.device), job)

    return roll_out


def simulated(policy: Any, batch: Any, job: Job) -> tuple[Any, list[Any]]:
    """The context of a batch and its rollouts, pass by pass."""
    import torch

    from rlftsim.evaluation.results import EvaluateConfig
    from rlftsim.rollout.policy import Sampling
    from rlftsim.rollout.simulate import simulate

    # All at once on a GPU, where small passes only cost launches.
    size = EvaluateConfig().rollouts_per_pass if job.device == "cpu" else job.num_rollouts
    sampling, force = Sampling(top_k=job.top_k), hold(batch) if job.held else None
    with torch.no_grad():
        context, ids = policy.encode(batch), range(job.num_rollouts)
        passes = [ids[i : i + size] for i in range(0, job.num_rollouts, size)]
        return context, [
            simulate(policy, batch, num_rollouts=p, seed=0, context=context, sampling=sampling, force=force)
            for p in passes
        ]


def hold(batch: Any) -> Callable[[Any, int], Any]:
    """Keeps agents where they are, while they stand in the log."""
    import torch

    from rlftsim.rollout.types import AgentStates

    logged = zip(batch.position.cpu().numpy(), batch.valid.cpu().numpy())
    held = torch.from_numpy(np.stack([stands(*arrays) for arrays in logged])).to(batch.position.device)  # [B, A, 16]

    def force(state: Any, step: int) -> Any:
        at = held[:, None, :, step // STEPS_PER_DECISION, None]
        steps = (*state.heading.shape, STEPS_PER_DECISION)
        position = state.position[..., None, :].expand(*steps, 2)
        return AgentStates(position, state.heading[..., None].expand(steps), at.expand(steps))

    return force


def gap(job: Job) -> Repeat:
    """Largest difference between the log-probability of a decision when it is sampled and when it is scored."""
    import torch

    from rlftsim.rollout.policy import Sampling

    policy, scenarios = tiny(job).requires_grad_(False), records(job)

    def differ() -> Numbers:
        context, passes = simulated(policy, fresh(scenarios, job.device), job)
        gaps = []
        for made in passes:
            with torch.no_grad():
                scored = policy.score(context, made).log_prob(made.decision, Sampling(top_k=job.top_k))
            gaps.append(float((scored - made.log_prob)[made.decision_mask].abs().max()))
        return {"score_gap": max(gaps)}

    return differ


def metric(job: Job) -> Repeat:
    """The metric of stored rollouts, the scenario's own part included."""
    import torch

    from rlftsim.realism import SimulatedStates, score_batch
    from rlftsim.scenario.womd import read_scenarios

    shared, cases = Path(job.shared), []
    every = list(read_scenarios(shared / "data" / "womd"))
    for prefix in job.scenarios:
        archive = np.load(shared / "golden" / "rmm" / "rollouts" / f"{prefix}_messy.npz")
        states = (torch.from_numpy(archive[name]).to(job.device) for name in ("x", "y", "z", "heading"))
        scenario = next(s for s in every if s.scenario_id.startswith(prefix))
        cases.append((scenario, SimulatedStates(archive["object_ids"], *states)))

    def measure() -> Numbers:
        # Copies of the scenarios: what is cached on a scenario is computed anew.
        result = score_batch([replace(scenario) for scenario, _ in cases], [states for _, states in cases])
        return {"meta_metric": float(result.meta_metric.mean())}

    return measure


# ---- inputs --------------------------------------------------------------------------------------------------------------


def prepare_tiny(job: Job) -> None:
    """Two scenarios, and SMART-tiny with the weights of the golden numbers, for this package and for the public code."""
    import runpy

    from safetensors.numpy import save_file

    from rlftsim.policies.smart.catk_checkpoint import import_catk

    inputs, shared = Path(job.inputs), Path(job.shared)
    golden, weights_file = shared / "golden" / "smart", inputs / "tiny.safetensors"
    recipe = runpy.run_path(str(golden / "make_weights.py"))
    weights = recipe["make_weights"](json.loads((golden / "state_dict_shapes.json").read_text())["tiny"], WEIGHTS_SEED)
    save_file({f"encoder.{key}": value for key, value in weights.items()}, weights_file)
    write_records(shared / "data" / "womd", inputs / "records", SCENARIOS)
    tables = [shared / "data" / "tokens" / f"{name}.npz" for name in ("agent_vocab_555_s2", "map_traj_token5")]
    import_catk(weights_file, tables).policy.save_pretrained(inputs / "tiny")


def prepare_base(job: Job) -> None:
    """The demo's vocabulary and base model, as `rlftsim demo` makes them."""
    import torch

    from rlftsim.policies.smart.policy import SmartPolicy
    from rlftsim.recipes.smart import smart_demo_rlftsim
    from rlftsim.recipes.train import find_vocabulary, open_training
    from rlftsim.scenario.synthetic import pack_path
    from rlftsim.training.run import train_policy

    recipe, training, out = smart_demo_rlftsim(), open_training(pack_path()), Path(job.inputs) / "base"
    vocabulary = find_vocabulary(training, recipe.tokens, out / "vocabulary.safetensors", origin="benchmarks/speed.py")
    torch.manual_seed(recipe.pretrain.seed)
    train_policy(SmartPolicy(recipe.model, vocabulary), training, out, recipe.pretrain)


def prepare_evaluated(job: Job) -> None:
    """Raw records of the first held-out scenarios of the real data set, for the code that reads nothing else."""
    from rlftsim.scenario.dataset import ScenarioDataset

    inputs = Path(job.inputs)
    ids = ScenarioDataset(inputs / "real", "validation").scenario_ids[:NUM_EVALUATED]
    write_records(Path(job.shared), inputs / "evaluated", {scenario_id: scenario_id for scenario_id in ids})


def write_records(source: Path, folder: Path, names: dict[str, str]) -> None:
    """Raw records of some scenarios, each a file of the name that is given for its id."""
    from rlftsim.scenario.tfrecord import read_records
    from rlftsim.scenario.womd import find_tfrecords
    from rlftsim.scenario.womd_pb2 import Scenario

    folder.mkdir(parents=True, exist_ok=True)
    for path in find_tfrecords(source):
        for _, data in read_records(path):
            name = names.get(Scenario.FromString(data).scenario_id)
            if name:
                (folder / f"{name}.record").write_bytes(data)


MEASURED = {f.__name__: f for f in (finetune, pretrain, catk, rollouts, gap, metric)}
PREPARED = {f.__name__: f for f in (prepare_tiny, prepare_base, prepare_evaluated)}


if __name__ == "__main__":
    given = Job.read(sys.argv[1])
    if given.task in PREPARED:
        PREPARED[given.task](given)
    else:
        serve(given.device, lambda: start(given))

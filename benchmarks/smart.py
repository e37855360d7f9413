"""How long and how much memory do SMART's rollouts and updates take, beside the public CAT-K code with the same weights?

    python benchmarks/smart.py ../shared
    python benchmarks/smart.py ../shared --catk CHECKOUT --catk-python VENV/bin/python --keep public.json

Prints Markdown. Every measurement is a process of its own with one thread, one after the other: the peak of resident memory never goes
down. Times are CPU time. The public code runs from a checkout in an environment of the user's (`smart_public.py` says what it needs)
and is first compared with its own golden numbers. `--keep` stores what it took and reads it the next time, if the recipe is the same.
On a GPU (`--device cuda`) times are wall time between synchronisations and memory is what torch allocated.
"""

import json
import multiprocessing
import os
import platform
import runpy
import subprocess
import sys
import tempfile
import time
from collections.abc import Callable
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Annotated, Any

import tyro
from tyro.conf import Positional

SCENARIOS = {"A": "637f20cafde22ff8", "B": "ee519cf571686d19"}
WEIGHTS_SEED = 1003
NUM_ROLLOUTS = 32
TOP_K = 48
NUM_CANDIDATES = 32
CONTEXT_RADIUS_M = 150.0
"""In updates a step of an agent farther from the ego than this is taken as not logged, by both sides."""
LARGEST_BATCH_TRIED = 1024


@dataclass(frozen=True)
class Case:
    """One measurement."""

    task: str
    """rollouts, bc (pre-training update), catk (fine-tuning update) or batch (the largest that fits)."""
    size: str
    records: str
    """Scenarios, a letter each."""

    @property
    def name(self) -> str:
        shown = self.records if len(self.records) <= 2 else f"{len(self.records)} scenarios"
        return f"{self.task} {self.size} {shown}"


CPU_CASES = (
    Case("rollouts", "tiny", "A"),
    Case("rollouts", "tiny", "B"),
    Case("bc", "tiny", "A"),
    Case("bc", "tiny", "AB"),
    Case("bc", "nano", "A"),
    Case("catk", "tiny", "A"),
    Case("catk", "nano", "A"),
)
GPU_CASES = (
    Case("rollouts", "tiny", "A"),
    Case("rollouts", "tiny", "AB" * 8),
    Case("bc", "tiny", "AB" * 5),
    Case("batch", "tiny", "AB"),
)


@dataclass(frozen=True)
class Recipe:
    """What both sides measure; numbers of another recipe are not reused."""

    device: str = "cpu"
    repeats: int = 3
    """Updates after a warm-up; the median counts."""
    public_rollouts: int = 3
    """Rollouts that the public code is timed for; it runs them one after the other, so 32 are extrapolated. `--full`: all."""
    num_rollouts: int = NUM_ROLLOUTS
    top_k: int = TOP_K
    num_candidates: int = NUM_CANDIDATES
    weights_seed: int = WEIGHTS_SEED


@dataclass(frozen=True)
class Options:
    """SMART's speed and memory beside the public CAT-K code."""

    shared: Positional[Path]
    """Folder with data/womd, data/tokens and golden/smart."""
    catk: Path | None = None
    """Checkout of the public code."""
    catk_python: Path | None = None
    """Python of the environment it runs in."""
    keep: Path | None = None
    """JSON file with the public code's part: written once, then read."""
    device: str = "cpu"
    repeats: int = 3
    full: bool = False
    """Let the public code run all 32 rollouts."""
    rollouts_per_pass: int | None = None
    """Of ours, simulated side by side. None = all on a GPU, as `rlftsim evaluate` does on a CPU."""
    only: Annotated[tuple[str, ...], tyro.conf.UseAppendAction] = ()
    """Tasks to measure: rollouts, bc, catk, batch, gap, threads. Empty = all."""

    @property
    def recipe(self) -> Recipe:
        timed = NUM_ROLLOUTS if self.full else Recipe.public_rollouts
        return Recipe(device=self.device, repeats=self.repeats, public_rollouts=timed)


# ---- inputs --------------------------------------------------------------------------------------------------------------


def write_inputs(shared: Path, folder: Path) -> None:
    """Raw records and golden weights as files that both sides read."""
    from safetensors.numpy import save_file

    from rlftsim.scenario.tfrecord import read_records
    from rlftsim.scenario.womd import find_tfrecords
    from rlftsim.scenario.womd_pb2 import Scenario

    letters = {scenario_id: letter for letter, scenario_id in SCENARIOS.items()}
    for path in find_tfrecords(shared / "data" / "womd"):
        for _, data in read_records(path):
            letter = letters.get(Scenario.FromString(data).scenario_id)
            if letter:
                (folder / f"{letter}.record").write_bytes(data)
    golden = shared / "golden" / "smart"
    recipe = runpy.run_path(str(golden / "make_weights.py"))
    shapes = json.loads((golden / "state_dict_shapes.json").read_text())
    for size in ("nano", "tiny"):
        weights = recipe["make_weights"](shapes[size], WEIGHTS_SEED)
        save_file({f"encoder.{key}": value for key, value in weights.items()}, folder / f"{size}.safetensors")


@dataclass(frozen=True)
class Inputs:
    """Where the files of `write_inputs` are."""

    shared: Path
    folder: Path
    recipe: Recipe
    rollouts_per_pass: int

    def batch(self, records: str, context_radius_m: float | None = None) -> Any:
        from rlftsim.scenario.batch import collate
        from rlftsim.scenario.womd import scenario_from_bytes
        from rlftsim.training.data import within_reach

        distinct = {r: scenario_from_bytes((self.folder / f"{r}.record").read_bytes()) for r in dict.fromkeys(records)}
        if context_radius_m:
            distinct = {r: within_reach(scenario, context_radius_m) for r, scenario in distinct.items()}
        return collate([distinct[r] for r in records]).to(self.recipe.device)

    def policy(self, size: str) -> Any:
        from rlftsim.policies.smart.catk_checkpoint import import_catk

        tables = [self.shared / "data" / "tokens" / f"{n}.npz" for n in ("agent_vocab_555_s2", "map_traj_token5")]
        return import_catk(self.folder / f"{size}.safetensors", tables).policy.to(self.recipe.device)


# ---- our side ------------------------------------------------------------------------------------------------------------


def alone(function: Callable[..., Any], *arguments: Any) -> Any:
    """The value of a call in a fresh process."""
    with multiprocessing.get_context("spawn").Pool(1) as pool:
        return pool.apply(function, arguments)


def started_clock(recipe: Recipe, threads: int = 1) -> Any:
    """A clock whose memory baseline has all libraries loaded."""
    import torch
    from clock import Clock  # beside this file

    import rlftsim.policies.smart.catk_checkpoint
    import rlftsim.rollout.simulate
    import rlftsim.training.catk
    import rlftsim.training.pretrain  # noqa: F401
    from rlftsim.threads import keep_freed_memory

    keep_freed_memory()  # as the command line does
    torch.set_num_threads(threads)
    torch.set_float32_matmul_precision("high")
    torch.ones(1, device=recipe.device) + 1
    return Clock(recipe.device)


def roll_out(policy: Any, batch: Any, inputs: Inputs, num_rollouts: int = NUM_ROLLOUTS) -> list[Any]:
    """Rollouts in passes, the scenarios looked at once."""
    import torch

    from rlftsim.rollout.policy import Sampling
    from rlftsim.rollout.simulate import simulate

    with torch.no_grad():
        context, size = policy.encode(batch), inputs.rollouts_per_pass
        passes = [range(i, min(i + size, num_rollouts)) for i in range(0, num_rollouts, size)]
        sampling = Sampling(top_k=inputs.recipe.top_k)
        return [simulate(policy, batch, num_rollouts=p, seed=0, context=context, sampling=sampling) for p in passes]


def measure(inputs: Inputs, case: Case) -> dict[str, Any]:
    """One case in this process."""
    clock = started_clock(inputs.recipe)
    policy = inputs.policy(case.size)
    if case.task == "batch":
        return {"batch": largest_batch(inputs, policy, case)}
    batch = inputs.batch(case.records, None if case.task == "rollouts" else CONTEXT_RADIUS_M)
    if case.task == "rollouts":
        policy.requires_grad_(False)
        found = {"total_s": clock.time(lambda: roll_out(policy, batch, inputs))}
        return found | {"added_mib": clock.added_mib()}
    step = pretraining_step(policy) if case.task == "bc" else fine_tuning_step(policy, inputs.recipe.num_candidates)
    times = [clock.time(lambda: step(batch)) for _ in range(inputs.recipe.repeats + 1)]
    return {"first_s": times[0], "step_s": times[1:], "added_mib": clock.added_mib()}


def pretraining_step(policy: Any) -> Callable[[Any], None]:
    """One update: tokens, forward, loss, backward, clipping, AdamW."""
    import torch
    from torch.nn.functional import cross_entropy

    from rlftsim.training.pretrain import PretrainConfig

    config = PretrainConfig()
    optimizer = torch.optim.AdamW(policy.parameters(), lr=config.learning_rate, weight_decay=config.weight_decay)
    policy.train()

    def step(batch: Any) -> None:
        optimizer.zero_grad(set_to_none=True)
        prediction = policy.teacher_forced(batch, trained(batch))
        logits, target = prediction.logits[prediction.target_mask], prediction.target[prediction.target_mask]
        cross_entropy(logits, target, label_smoothing=config.label_smoothing).backward()
        torch.nn.utils.clip_grad_norm_(policy.parameters(), config.gradient_clip)
        optimizer.step()

    return step


def fine_tuning_step(policy: Any, num_candidates: int) -> Callable[[Any], None]:
    """One update: a CAT-K rollout, its loss, backward, clipping, AdamW; only attention and head are trained."""
    import torch

    from rlftsim.training.catk import CatkConfig, roll_out_closest
    from rlftsim.training.closed_loop import predict_along
    from rlftsim.training.freezing import freeze_untrained
    from rlftsim.training.imitation import summed_loss

    config = CatkConfig()
    freeze_untrained(policy, "decoder")
    policy.train()
    weights = [p for p in policy.parameters() if p.requires_grad]
    optimizer = torch.optim.AdamW(weights, lr=config.learning_rate, weight_decay=config.weight_decay)

    def step(batch: Any) -> None:
        optimizer.zero_grad(set_to_none=True)
        context = policy.encode(batch)
        targeted = roll_out_closest(policy, batch, num_candidates=num_candidates, context=context)
        loss, counts = summed_loss(predict_along(policy, context, targeted, trained(batch)), config.label_smoothing)
        (loss / counts[2]).backward()
        torch.nn.utils.clip_grad_norm_(weights, config.gradient_clip)
        optimizer.step()

    return step


def trained(batch: Any) -> Any:
    """Agents that count in an update."""
    from rlftsim.training.data import trained_agents
    from rlftsim.training.pretrain import PretrainConfig

    config = PretrainConfig()
    return trained_agents(batch, 0, radius_m=config.trained_radius_m, limit=config.max_trained_agents, seed=config.seed)


def largest_batch(inputs: Inputs, policy: Any, case: Case) -> int:
    """Scenarios in the largest pre-training update that fits, by doubling."""
    import torch

    step, fits = pretraining_step(policy), 0
    while fits < LARGEST_BATCH_TRIED:
        count = max(2 * fits, 1)
        try:
            step(inputs.batch((case.records * count)[:count], CONTEXT_RADIUS_M))
        except torch.OutOfMemoryError:
            break
        fits = count
    return fits


def measure_gap(inputs: Inputs, record: str) -> float:
    """Largest difference between the log-probability of a decision in a rollout and in the scoring pass."""
    import torch

    from rlftsim.rollout.policy import Sampling

    started_clock(inputs.recipe)
    policy, batch = inputs.policy("tiny").requires_grad_(False), inputs.batch(record)
    gaps = []
    with torch.no_grad():
        for rollouts in roll_out(policy, batch, inputs):
            scored = policy.score(policy.encode(batch), rollouts)
            again = scored.log_prob(rollouts.decision, Sampling(top_k=inputs.recipe.top_k))
            gaps.append(float((again - rollouts.log_prob)[rollouts.decision_mask].abs().max()))
    return max(gaps)


def measure_threads(inputs: Inputs, threads: int) -> dict[str, float]:
    """Wall and CPU seconds of eight rollouts of A with some threads, best of three."""
    clock = started_clock(inputs.recipe, threads)
    policy, batch = inputs.policy("tiny").requires_grad_(False), inputs.batch("A")
    found = []
    for _ in range(3):
        start = time.perf_counter()
        cpu_s = clock.time(lambda: roll_out(policy, batch, inputs, num_rollouts=8))
        found.append((time.perf_counter() - start, cpu_s))
    return dict(zip(("wall_s", "cpu_s"), min(found)))


# ---- the public side -----------------------------------------------------------------------------------------------------


def run_public(options: Options, inputs: Inputs, case: Case) -> dict[str, Any]:
    """What `smart_public.py` found in a process of its own."""
    recipe = inputs.recipe
    request = asdict(recipe) | {
        "checkout": str(options.catk),
        "task": case.task,
        "size": case.size,
        "records": [str(inputs.folder / f"{letter}.record") for letter in case.records],
        "weights": str(inputs.folder / f"{case.size}.safetensors"),
        "repeats": recipe.public_rollouts if case.task == "rollouts" else recipe.repeats,
        "golden": str(options.shared / "golden" / "smart"),
        "max_batch": LARGEST_BATCH_TRIED,
    }
    request_path, answer_path = inputs.folder / "request.json", inputs.folder / "answer.json"
    request_path.write_text(json.dumps(request))
    here = Path(__file__).resolve().parent
    environment = os.environ | {"PYTHONPATH": str(here.parent / "src")}
    script = here / "smart_public.py"
    subprocess.run([options.catk_python, script, request_path, answer_path], check=True, env=environment)
    return json.loads(answer_path.read_text())


class PublicResults:
    """The public code's numbers: of the kept file, or measured and kept."""

    def __init__(self, options: Options, inputs: Inputs):
        self.options, self.inputs = options, inputs
        self.kept: dict[str, Any] = {"recipe": asdict(inputs.recipe), "machine": describe_machine(), "results": {}}
        if options.keep and options.keep.exists():
            found = json.loads(options.keep.read_text())
            if found["recipe"] != self.kept["recipe"]:
                sys.exit(f"{options.keep}: recipe {found['recipe']} is not the requested one, {self.kept['recipe']}.")
            self.kept = found

    def of(self, case: Case) -> dict[str, Any] | None:
        """None where nothing was kept and there is no public code to run."""
        known = self.kept["results"]
        if case.name not in known:
            if not (self.options.catk and self.options.catk_python):
                return None
            known[case.name] = run_public(self.options, self.inputs, case)
            if self.options.keep:
                self.options.keep.write_text(json.dumps(self.kept, indent=1) + "\n")
        return known[case.name]


# ---- the report ----------------------------------------------------------------------------------------------------------


def describe_machine() -> str:
    """Processor, memory, system."""
    names = [line for line in Path("/proc/cpuinfo").read_text().splitlines() if line.startswith("model name")]
    model = names[0].partition(":")[2].strip() if names else platform.processor()
    memory = os.sysconf("SC_PAGE_SIZE") * os.sysconf("SC_PHYS_PAGES") / 2**30
    return f"{os.cpu_count()} cores of {model}, {memory:.0f} GiB, {platform.system()}"


def seconds_of(case: Case, found: dict[str, Any]) -> float:
    """Seconds of 32 rollouts, or of the median update."""
    if "total_s" in found:
        return found["total_s"]
    if case.task == "rollouts":
        timed = found["rollout_s"]
        return found["tokenize_s"] + sum(timed) / len(timed) * NUM_ROLLOUTS
    return sorted(found["step_s"])[len(found["step_s"]) // 2]


def print_check(public: PublicResults) -> None:
    for size in ("nano", "tiny"):
        found = public.of(Case("check", size, "A"))
        if found:
            print(
                f"- The public code ({found['commit']}, torch {found['torch']}, neighbor search: {found['searches']}) as it is timed, "
                f"against its golden numbers, {size}, A: preprocessing {'equal' if found['inputs_equal'] else 'DIFFERENT'}, "
                f"logits within {found['logits']:.1e}, greedy tokens {'equal' if found['greedy_tokens_equal'] else 'DIFFERENT'}, "
                f"positions within {found['greedy_m']:.1e} m."
            )


def print_cases(options: Options, inputs: Inputs, public: PublicResults) -> None:
    print(
        "\n| measurement | public s | ours s | ratio | public added MiB | ours added MiB | ratio | in neighbor search |"
    )
    print("|---|--:|--:|--:|--:|--:|--:|--:|", flush=True)
    for case in CPU_CASES if options.device == "cpu" else GPU_CASES:
        if options.only and case.task not in options.only:
            continue
        theirs, ours = public.of(case), alone(measure, inputs, case)
        if case.task == "batch":
            print(f"| largest batch, tiny | {theirs['batch'] if theirs else ''} | {ours['batch']} | | | | | |")
            continue
        our_s, columns = seconds_of(case, ours), [""] * 5
        if theirs:
            their_s = seconds_of(case, theirs)
            search = theirs["search_s"] / sum(theirs.get("rollout_s") or [theirs["first_s"], *theirs["step_s"]])
            memory = f"{theirs['added_mib'] / ours['added_mib']:.1f}×"
            columns = [
                f"{their_s:.1f}",
                f"**{their_s / our_s:.1f}×**",
                f"{theirs['added_mib']:.0f}",
                memory,
                f"{search:.1%}",
            ]
        their_column, ratio, their_mib, memory, search = columns
        print(
            f"| {case.name} | {their_column} | {our_s:.2f} | {ratio} | {their_mib} | {ours['added_mib']:.0f} | {memory} | {search} |",
            flush=True,
        )


def print_gap(inputs: Inputs) -> None:
    print(f"\n## Log-probability of a decision, rollout against scoring pass ({NUM_ROLLOUTS} rollouts, top-{TOP_K})\n")
    for letter in SCENARIOS:
        print(f"- {letter}: largest difference {alone(measure_gap, inputs, letter):.1e}", flush=True)


def print_threads(inputs: Inputs) -> None:
    print(
        "\n## Threads, ours: eight rollouts of A, OMP_WAIT_POLICY=PASSIVE\n\n| threads | wall s | CPU s |\n|--:|--:|--:|"
    )
    for threads in (1, 2):
        os.environ["OMP_NUM_THREADS"] = str(threads)
        found = alone(measure_threads, inputs, threads)
        print(f"| {threads} | {found['wall_s']:.1f} | {found['cpu_s']:.1f} |", flush=True)
    os.environ["OMP_NUM_THREADS"] = "1"


def default_rollouts_per_pass() -> int:
    from rlftsim.evaluation.results import EvaluateConfig

    return EvaluateConfig().rollouts_per_pass


def main(options: Options) -> None:
    """Measure and print."""
    os.environ |= {"OMP_NUM_THREADS": "1", "OMP_WAIT_POLICY": "PASSIVE"}
    commit = subprocess.run(["git", "rev-parse", "--short", "HEAD"], capture_output=True, text=True).stdout.strip()
    size = options.rollouts_per_pass or (NUM_ROLLOUTS if options.device != "cpu" else alone(default_rollouts_per_pass))
    wanted = options.only
    with tempfile.TemporaryDirectory() as folder:
        inputs = Inputs(options.shared, Path(folder), options.recipe, size)
        alone(write_inputs, options.shared, inputs.folder)
        public = PublicResults(options, inputs)
        print(f"Machine: {describe_machine()}. Device: {options.device}. Our commit: {commit}.")
        print(f"Public side measured on: {public.kept['machine']}.")
        print(f"Ours: {size} rollouts a pass. Recipe: {options.recipe}.\n")
        if options.device == "cpu":
            print_check(public)
        print_cases(options, inputs, public)
        if not wanted or "gap" in wanted:
            print_gap(inputs)
        if options.device == "cpu" and (not wanted or "threads" in wanted):
            print_threads(inputs)


if __name__ == "__main__":
    main(tyro.cli(Options))

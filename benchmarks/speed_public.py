"""The public CAT-K code's part of `speed.py`: runs in that code's environment, by the protocol of `speed_jobs.py`.

    PYTHONPATH=src VENV/bin/python benchmarks/speed_public.py '{"task": "rollouts", "checkout": "CHECKOUT", ...}'

Nothing of the public code is here: its modules are imported from the checkout that the job names. The environment needs
torch, torch-geometric, torchmetrics, omegaconf, pandas, scipy, safetensors and protobuf. TensorFlow, Waymo's package,
Lightning and Hydra are not needed, because metrics, videos and the training loop are left out. Where torch-cluster is
not installed, exact brute-force searches stand in for its two functions, and their share of the time is reported.
"""

import pickle
import sys
import time
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from speed_jobs import Job, Numbers, Repeat, now, serve, stands  # beside this file
from torch import Tensor

PREFIX = "encoder."
GRADIENT_CLIP = 0.5
NUM_CANDIDATES = 32
search_s = 0.0
"""CPU seconds spent in the stand-ins of torch-cluster."""


class Data(dict):
    """What the public code reads of a batch of graphs: nested dicts and the number of scenarios."""

    def __init__(self, values: dict[Any, Any], num_graphs: int):
        super().__init__(values)
        self.num_graphs = num_graphs


# ---- stand-ins -----------------------------------------------------------------------------------------------------------


def radius(
    x: Tensor, y: Tensor, r: float, batch_x: Tensor | None = None, batch_y: Tensor | None = None, **_: Any
) -> Tensor:
    """Pairs (row of y, row of x) of the same group that are nearer than r, exactly. Groups are sorted. No cap on neighbors:
    those of the public code bind in no scenario that is measured."""
    global search_s
    start = time.process_time()
    batch_x = torch.zeros(len(x), dtype=torch.long, device=x.device) if batch_x is None else batch_x
    batch_y = torch.zeros(len(y), dtype=torch.long, device=y.device) if batch_y is None else batch_y
    count = int(max(batch_x.max(), batch_y.max())) + 1
    sizes = [torch.bincount(b, minlength=count).tolist() for b in (batch_x, batch_y)]
    pairs, first_x, first_y = [], 0, 0
    for own_x, own_y in zip(x.split(sizes[0]), y.split(sizes[1])):
        dx = own_y[:, :1] - own_x[:, 0]
        dy = own_y[:, 1:] - own_x[:, 1]
        found = (dx * dx + dy * dy < r * r).nonzero().T
        pairs.append(found + found.new_tensor([[first_y], [first_x]]))
        first_x, first_y = first_x + len(own_x), first_y + len(own_y)
    search_s += time.process_time() - start
    return torch.cat(pairs, 1)


def radius_graph(x: Tensor, r: float, batch: Tensor | None = None, **_: Any) -> Tensor:
    """Edges (neighbor, center) without self-loops."""
    center, neighbor = radius(x, x, r, batch, batch)
    other = center != neighbor
    return torch.stack([neighbor[other], center[other]])


def stand_in(name: str, **content: Any) -> ModuleType:
    """A module under a name, with its parents."""
    module = ModuleType(name)
    vars(module).update(content)
    sys.modules[name] = module
    parent, _, last = name.rpartition(".")
    if parent:
        setattr(sys.modules.get(parent) or stand_in(parent), last, module)
    return module


def prepare_imports(checkout: Path) -> None:
    """Make the public code importable."""
    import torch_geometric  # noqa: F401  # pyright: ignore[reportMissingImports]  # looks for others before they are stood in for

    from rlftsim.scenario import womd_pb2

    sys.path.insert(0, str(checkout))
    stand_in("tensorflow")
    stand_in("waymo_open_dataset.protos", scenario_pb2=womd_pb2)
    stand_in("tqdm", tqdm=iter)
    # these packages import TensorFlow and Lightning; one file of each is needed
    for package in ("metrics", "datamodules"):
        stand_in(f"src.smart.{package}", __path__=[str(checkout / "src" / "smart" / package)])
    del sys.modules["src"], sys.modules["src.smart"]
    try:
        import torch_cluster  # noqa: F401  # pyright: ignore[reportMissingImports]
    except ImportError:
        stand_in("torch_cluster", radius=radius, radius_graph=radius_graph)
    import src.data_preprocess  # pyright: ignore[reportMissingImports]
    import src.smart.modules.smart_decoder  # noqa: F401  # pyright: ignore[reportMissingImports]


# ---- the public model and its data --------------------------------------------------------------------------------------


def build_model(job: Job) -> tuple[Any, Any]:
    """The public token processor and network of SMART-tiny, with the golden weights."""
    from omegaconf import OmegaConf
    from safetensors.torch import load_file
    from src.smart.modules.smart_decoder import SMARTDecoder  # pyright: ignore[reportMissingImports]
    from src.smart.tokens.token_processor import TokenProcessor  # pyright: ignore[reportMissingImports]

    config: Any = OmegaConf.load(Path(job.checkout) / "configs" / "model" / "smart.yaml").model_config
    processor = TokenProcessor(**config.token_processor)
    network = SMARTDecoder(**config.decoder, n_token_agent=processor.n_token_agent)
    stored = load_file(Path(job.inputs) / "tiny.safetensors")
    network.load_state_dict({key.removeprefix(PREFIX): value for key, value in stored.items()}, strict=True)
    return processor.to(job.device).eval(), network.to(job.device).eval()


def preprocess(record: Path) -> dict[str, Any]:
    """One scenario as the public preprocessing writes it."""
    from src import data_preprocess as public  # pyright: ignore[reportMissingImports]

    from rlftsim.scenario.womd_pb2 import Scenario

    message = Scenario.FromString(record.read_bytes())
    lights = public.process_dynamic_map(public.decode_dynamic_map_states_from_proto(message.dynamic_map_states))
    now = lights.loc[lights["time_step"] == message.current_time_index]
    data = public.preprocess_map(
        public.get_map_features(public.decode_map_features_from_proto(message.map_features), now)
    )
    tracks = public.decode_tracks_from_proto(message)
    data["agent"] = public.get_agent_features(tracks, "validation", message.current_time_index + 1, 91)
    return data


def mark_trained(data: dict[str, Any]) -> dict[str, Any]:
    """The public training transform: what is valid and who is trained."""
    from src.smart.datamodules.target_builder import WaymoTargetBuilderTrain  # pyright: ignore[reportMissingImports]

    data = {key: dict(value) for key, value in data.items()}
    WaymoTargetBuilderTrain.__call__(SimpleNamespace(step_current=10, max_num=32), data)
    return data


def batch_of(scenarios: list[dict[str, Any]], device: str) -> Data:
    """Scenarios one after the other, numbered."""
    joined: dict[str, Any] = {}
    for part, example in scenarios[0].items():
        tensors = [name for name, value in example.items() if isinstance(value, Tensor)]
        joined[part] = {name: torch.cat([s[part][name] for s in scenarios]).to(device) for name in tensors}
    for part, first in (("agent", "valid_mask"), ("pt_token", "type")):
        counts = torch.tensor([len(s[part][first]) for s in scenarios])
        joined[part]["batch"] = torch.arange(len(scenarios)).repeat_interleave(counts).to(device)
    return Data(joined, len(scenarios))


def copy_of(data: Data) -> Data:
    """Tokenising changes its input in place."""
    return Data({part: {k: v.clone() for k, v in values.items()} for part, values in data.items()}, data.num_graphs)


def records(job: Job) -> list[dict[str, Any]]:
    """Preprocessed scenarios; one that is named twice is read once."""
    folder = Path(job.inputs) / "records"
    read = {name: preprocess(folder / f"{name}.record") for name in dict.fromkeys(job.scenarios)}
    return [read[name] for name in job.scenarios]


# ---- measurements --------------------------------------------------------------------------------------------------------


def sampling(criterium: str, num_k: int, temp: float) -> SimpleNamespace:
    """A sampling scheme as the public code reads it."""
    return SimpleNamespace(criterium=criterium, num_k=num_k, temp=temp)


def rollouts(job: Job) -> Repeat:
    """Tokens once, then rollouts one after the other, as the public validation does. A few are timed, for all of them."""
    processor, network = build_model(job)
    scenarios, scheme = records(job), sampling("topk_prob", job.top_k, 1.0)
    if job.held:
        hold(scenarios)

    @torch.no_grad()
    def roll_out() -> Numbers:
        began = now(job.device)
        tokens = processor(batch_of(scenarios, job.device))
        tokenized = now(job.device)
        for _ in range(job.timed_rollouts):
            network.inference(*tokens, sampling_scheme=scheme)
        one_s = (now(job.device) - tokenized) / job.timed_rollouts
        return {"seconds": tokenized - began + one_s * job.num_rollouts}

    return roll_out


def hold(scenarios: list[dict[str, Any]]) -> None:
    """Keeps agents where they are while they stand in the log, by way of the motion that is handed to the public loop."""
    from src.smart.modules import agent_decoder  # pyright: ignore[reportMissingImports]

    agents = [scenario["agent"] for scenario in scenarios]
    held = torch.cat(
        [torch.from_numpy(stands(a["position"].numpy(), a["valid_mask"].numpy())) for a in agents]
    )  # [A, 16]
    sample, calls = agent_decoder.sample_next_token_traj, 0

    def sample_or_stand(**inputs: Any) -> tuple[Tensor, Tensor]:
        nonlocal calls
        token, motion = sample(**inputs)  # [A], [A, 6, 4, 2]
        at = held[:, calls % held.shape[1]].to(token.device)
        calls += 1
        start = inputs["token_traj_all"][:, :1, :1].squeeze(1).expand_as(motion)
        return torch.where(at, 0, token), torch.where(at[:, None, None, None], start, motion)

    agent_decoder.sample_next_token_traj = sample_or_stand


def update(job: Job) -> Repeat:
    """An update: tokens, forward or CAT-K rollout, loss, backward, clipping, AdamW."""
    from src.smart.metrics.cross_entropy import CrossEntropy  # pyright: ignore[reportMissingImports]

    closed_loop = job.task == "catk"
    processor, network = build_model(job)
    loss_of = CrossEntropy(
        use_gt_raw=True, gt_thresh_scale_length=-1.0, label_smoothing=0.0 if closed_loop else 0.1, rollout_as_gt=False
    ).to(job.device)
    for module in (processor, network, loss_of):
        module.train()
    agents = network.agent_encoder
    if closed_loop:
        network.requires_grad_(False)
        trained = (agents.t_attn_layers, agents.pt2a_attn_layers, agents.a2a_attn_layers, agents.token_predict_head)
        for part in trained:
            part.requires_grad_(True)
    optimizer = torch.optim.AdamW(network.parameters(), lr=5e-5 if closed_loop else 5e-4)
    scheme = sampling("topk_prob_sampled_with_dist", NUM_CANDIDATES, 1e-5)
    torch.manual_seed(0)
    data = batch_of([mark_trained(scenario) for scenario in records(job)], job.device)

    def step() -> None:
        copy = copy_of(data)
        optimizer.zero_grad(set_to_none=True)
        of_map, of_agents = processor(copy)
        outputs = (
            network.inference(of_map, of_agents, sampling_scheme=scheme) if closed_loop else network(of_map, of_agents)
        )
        loss = loss_of(
            **outputs,
            token_agent_shape=of_agents["token_agent_shape"],
            token_traj=of_agents["token_traj"],
            train_mask=copy["agent"]["train_mask"],
        )
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), GRADIENT_CLIP)
        optimizer.step()

    return step


def check(job: Job) -> Repeat:
    """Differences from golden numbers of the public code in absolute coordinates: is it the public function that is measured?"""
    folder = Path(job.shared) / "golden" / "smart"
    processor, network = build_model(job)
    data = batch_of(records(job), job.device)
    preprocessed = np.load(folder / "scenario_A" / "preprocessed.npz")
    forward = np.load(folder / "tiny" / "absolute_forward.npz")
    greedy = np.load(folder / "tiny" / "absolute_rollouts.npz")
    same_input = all(
        np.array_equal(data[part][key].numpy(), preprocessed[name])
        for part, key, name in (
            ("map_save", "traj_pos", "map_traj_pos"),
            ("map_save", "traj_theta", "map_traj_theta"),
            ("pt_token", "type", "map_type"),
            ("pt_token", "light_type", "map_light_type"),
            ("agent", "valid_mask", "valid_mask"),
            ("agent", "position", "position"),
            ("agent", "heading", "heading"),
            ("agent", "shape", "shape"),
        )
    )

    @torch.no_grad()
    def compare() -> Numbers:
        of_map, of_agents = processor(copy_of(data))
        logits = network(of_map, of_agents)["next_token_logits"].numpy()
        rolled = network.inference(of_map, of_agents, sampling_scheme=sampling("topk_prob", 1, 1.0))
        chosen = forward["agents"]
        return {
            "inputs_equal": float(same_input),
            "logits": float(np.abs(logits[chosen] - forward["logits"])[forward["valid"][chosen]].max()),
            "greedy_tokens_equal": float(np.array_equal(rolled["pred_idx"].numpy(), greedy["greedy/idx"])),
        }

    return compare


# ---- a whole evaluation --------------------------------------------------------------------------------------------------


def prepare_evaluated(job: Job) -> None:
    """Preprocessed scenarios as files, once, as the public code keeps them."""
    for path in sorted((Path(job.inputs) / "evaluated").glob("*.record")):
        path.with_suffix(".pkl").write_bytes(pickle.dumps(preprocess(path)))


def evaluate(job: Job) -> None:
    """All rollouts of each preprocessed scenario, written for the official evaluator's script."""
    processor, network = build_model(job)
    scheme = sampling("topk_prob", job.top_k, 1.0)
    torch.manual_seed(0)
    for path in sorted((Path(job.inputs) / "evaluated").glob("*.pkl")):
        data = batch_of([pickle.loads(path.read_bytes())], job.device)
        with torch.no_grad():
            tokens = processor(data)
            made = [network.inference(*tokens, sampling_scheme=scheme) for _ in range(job.num_rollouts)]
        position, z, heading = (
            torch.stack([rollout[f"pred_{name}_10hz"] for rollout in made]).cpu().numpy()  # [N, A, 80, ...]
            for name in ("traj", "z", "head")
        )
        np.savez(
            path.with_suffix(".npz"),
            scenario_id=path.stem,
            object_ids=data["agent"]["id"].numpy().astype(np.int32),
            x=position[..., 0],
            y=position[..., 1],
            z=z,
            heading=heading,
        )


MEASURED = {"rollouts": rollouts, "pretrain": update, "catk": update, "check": check}
COMMANDS = {"prepare_evaluated": prepare_evaluated, "evaluate": evaluate}


def with_search_share(repeat: Repeat) -> Repeat:
    """Repetitions that also say how much of their time went into the stand-ins of torch-cluster."""

    def measured() -> Numbers:
        global search_s
        search_s, began = 0.0, time.process_time()
        numbers = repeat() or {}
        return {**numbers, "search_share": search_s / (time.process_time() - began)}

    return measured


def start(job: Job) -> Repeat:
    """The public code, imported, and a repetition of the job that has run once."""
    torch.set_num_threads(1)
    torch.set_float32_matmul_precision("high")
    prepare_imports(Path(job.checkout))
    repeat = with_search_share(MEASURED[job.task](job))
    repeat()
    return repeat


if __name__ == "__main__":
    given = Job.read(sys.argv[1])
    if given.task in COMMANDS:
        prepare_imports(Path(given.checkout))
        torch.set_num_threads(1)
        COMMANDS[given.task](given)
    else:
        serve(given.device, lambda: start(given))

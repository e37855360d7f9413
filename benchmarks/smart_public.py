"""The public CAT-K code's part of `smart.py`: runs in that code's environment, one measurement a process.

    PYTHONPATH=src VENV/bin/python benchmarks/smart_public.py request.json

Nothing of the public code is here: its modules are imported from the checkout that the request names. The environment needs torch,
torch-geometric, torchmetrics, omegaconf, pandas, scipy, safetensors and protobuf; TensorFlow, Waymo's package, Lightning and Hydra are not
needed, because metrics, videos and the training loop are left out. Where torch-cluster is not installed, exact brute-force searches stand in
for its two functions, and the time inside them is reported.
"""

import json
import subprocess
import sys
import time
from collections.abc import Callable
from pathlib import Path
from types import ModuleType, SimpleNamespace
from typing import Any

import numpy as np
import torch
from clock import Clock  # beside this file
from torch import Tensor

PREFIX = "encoder."
GRADIENT_CLIP = 0.5
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


def prepare_imports(checkout: Path) -> str:
    """Make the public code importable; how its neighbor searches are done."""
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
        return "exact brute force in torch"
    return "torch-cluster"


# ---- the public model and its data --------------------------------------------------------------------------------------


def build_model(request: dict[str, Any]) -> tuple[Any, Any]:
    """The public token processor and network, with the request's weights."""
    from omegaconf import OmegaConf
    from safetensors.torch import load_file
    from src.smart.modules.smart_decoder import SMARTDecoder  # pyright: ignore[reportMissingImports]
    from src.smart.tokens.token_processor import TokenProcessor  # pyright: ignore[reportMissingImports]

    configs = Path(request["checkout"]) / "configs" / "model"
    name = {"nano": "smart_nano_1M", "mini": "smart_mini_3M", "tiny": "smart"}[request["size"]]
    config: Any = OmegaConf.merge(*(OmegaConf.load(configs / f"{n}.yaml") for n in ("smart", name))).model_config
    processor = TokenProcessor(**config.token_processor)
    network = SMARTDecoder(**config.decoder, n_token_agent=processor.n_token_agent)
    weights = {key.removeprefix(PREFIX): value for key, value in load_file(request["weights"]).items()}
    network.load_state_dict(weights, strict=True)
    return processor.to(request["device"]).eval(), network.to(request["device"]).eval()


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


# ---- measurements --------------------------------------------------------------------------------------------------------


def sampling(criterium: str, num_k: int, temp: float) -> SimpleNamespace:
    """A sampling scheme as the public code reads it."""
    return SimpleNamespace(criterium=criterium, num_k=num_k, temp=temp)


def measure_rollouts(request: dict[str, Any], scenarios: list[dict[str, Any]], clock: Clock) -> dict[str, Any]:
    """Tokens once, then rollouts one after the other, as the public validation does."""
    processor, network = build_model(request)
    data = batch_of(scenarios, request["device"])
    scheme = sampling("topk_prob", request["top_k"], 1.0)
    torch.manual_seed(0)
    with torch.no_grad():
        tokens: list[Any] = []
        tokenize_s = clock.time(lambda: tokens.append(processor(data)))
        rollout_s = [
            clock.time(lambda: network.inference(*tokens[0], sampling_scheme=scheme)) for _ in range(request["repeats"])
        ]
    return {"tokenize_s": tokenize_s, "rollout_s": rollout_s}


def training_step(request: dict[str, Any]) -> Callable[[Data], Any]:
    """One update: tokens, forward, loss, backward, clipping, AdamW. `task` is bc or catk."""
    from src.smart.metrics.cross_entropy import CrossEntropy  # pyright: ignore[reportMissingImports]

    closed_loop = request["task"] == "catk"
    processor, network = build_model(request)
    loss_of = CrossEntropy(
        use_gt_raw=True, gt_thresh_scale_length=-1.0, label_smoothing=0.0 if closed_loop else 0.1, rollout_as_gt=False
    ).to(request["device"])
    for module in (processor, network, loss_of):
        module.train()
    agents = network.agent_encoder
    if closed_loop:
        network.requires_grad_(False)
        for part in (
            agents.t_attn_layers,
            agents.pt2a_attn_layers,
            agents.a2a_attn_layers,
            agents.token_predict_head,
        ):
            part.requires_grad_(True)
    optimizer = torch.optim.AdamW(network.parameters(), lr=5e-5 if closed_loop else 5e-4)
    scheme = sampling("topk_prob_sampled_with_dist", request["num_candidates"], 1e-5)

    def step(data: Data) -> None:
        optimizer.zero_grad(set_to_none=True)
        of_map, of_agents = processor(data)
        outputs = (
            network.inference(of_map, of_agents, sampling_scheme=scheme) if closed_loop else network(of_map, of_agents)
        )
        loss = loss_of(
            **outputs,
            token_agent_shape=of_agents["token_agent_shape"],
            token_traj=of_agents["token_traj"],
            train_mask=data["agent"]["train_mask"],
        )
        loss.backward()
        torch.nn.utils.clip_grad_norm_(network.parameters(), GRADIENT_CLIP)
        optimizer.step()

    return step


def measure_step(request: dict[str, Any], scenarios: list[dict[str, Any]], clock: Clock) -> dict[str, Any]:
    """A warm-up, then repeated updates on one batch."""
    torch.manual_seed(0)
    data, step = batch_of([mark_trained(s) for s in scenarios], request["device"]), training_step(request)
    copies = [copy_of(data) for _ in range(request["repeats"] + 1)]
    times = [clock.time(lambda: step(copies.pop())) for _ in range(request["repeats"] + 1)]
    return {"first_s": times[0], "step_s": times[1:], "trained": int(data["agent"]["train_mask"].sum())}


def largest_batch(request: dict[str, Any], scenarios: list[dict[str, Any]], clock: Clock) -> dict[str, Any]:
    """Scenarios in the largest pre-training update that fits, by doubling."""
    torch.manual_seed(0)
    step, fits, marked = training_step({**request, "task": "bc"}), 0, [mark_trained(s) for s in scenarios]
    while fits < request["max_batch"]:
        count = max(2 * fits, 1)
        try:
            step(batch_of([marked[i % len(marked)] for i in range(count)], request["device"]))
        except torch.OutOfMemoryError:
            break
        fits = count
    return {"batch": fits}


def check(request: dict[str, Any], scenarios: list[dict[str, Any]], clock: Clock) -> dict[str, Any]:
    """Differences from golden numbers of the public code in absolute coordinates: is it the public function that is measured?"""
    folder = Path(request["golden"])
    processor, network = build_model(request)
    data = batch_of(scenarios[:1], request["device"])
    preprocessed = np.load(folder / "scenario_A" / "preprocessed.npz")
    forward = np.load(folder / request["size"] / "absolute_forward.npz")
    greedy = np.load(folder / request["size"] / "absolute_rollouts.npz")
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
    with torch.no_grad():
        of_map, of_agents = processor(data)
        logits = network(of_map, of_agents)["next_token_logits"].numpy()
        rolled = network.inference(of_map, of_agents, sampling_scheme=sampling("topk_prob", 1, 1.0))
    valid = forward["valid"]
    total = np.logaddexp.reduce(logits.astype(np.float64), axis=-1)
    chosen = forward["agents"]
    return {
        "inputs_equal": bool(same_input),
        "logits": float(np.abs(logits[chosen] - forward["logits"])[valid[chosen]].max()),
        "logsumexp": float(np.abs(total - forward["logsumexp"])[valid].max()),
        "greedy_tokens_equal": bool(np.array_equal(rolled["pred_idx"].numpy(), greedy["greedy/idx"])),
        "greedy_m": float(np.abs(rolled["pred_traj_10hz"].numpy() - greedy["greedy/traj_10hz"]).max()),
    }


TASKS = {"rollouts": measure_rollouts, "bc": measure_step, "catk": measure_step, "check": check, "batch": largest_batch}


def main() -> None:
    request = json.loads(Path(sys.argv[1]).read_text())
    torch.set_num_threads(1)
    torch.set_float32_matmul_precision("high")
    searches = prepare_imports(Path(request["checkout"]))
    import src.data_preprocess  # pyright: ignore[reportMissingImports]
    import src.smart.modules.smart_decoder  # noqa: F401  # pyright: ignore[reportMissingImports]

    clock = Clock(request["device"])
    distinct = {path: preprocess(Path(path)) for path in dict.fromkeys(request["records"])}
    found = TASKS[request["task"]](request, [distinct[path] for path in request["records"]], clock)
    checkout = ["git", "-C", request["checkout"], "rev-parse", "--short", "HEAD"]
    commit = subprocess.run(checkout, capture_output=True, text=True).stdout.strip() or "unknown (no git checkout)"
    found |= {"added_mib": clock.added_mib(), "search_s": search_s, "searches": searches, "commit": commit}
    found |= {"torch": torch.__version__, "baseline_mib": clock.baseline_mib}
    Path(sys.argv[2]).write_text(json.dumps(found))


if __name__ == "__main__":
    main()

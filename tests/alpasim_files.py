"""A model in the layout of AlpaSim's public CAT-K weights, with random weights of a network of this package."""

import pickle
from pathlib import Path

import torch
import yaml

from rlftsim.policies.smart.catk_checkpoint import catk_name, find_aliases
from rlftsim.policies.smart.config import SmartConfig
from rlftsim.policies.smart.network import SmartNetwork
from rlftsim.tokens.map_tokens import TRIPLE

NUM_TOKENS, NUM_PIECES, DIM = 12, 7, 16
DECODER = {
    "hidden_dim": DIM, "num_historical_steps": 16, "num_future_steps": 80, "num_freq_bands": 4, "num_heads": 2,
    "head_dim": 4, "num_map_layers": 1, "num_agent_layers": 1, "pl2pl_radius": 10, "pl2a_radius": 25, "a2a_radius": 35,
    "time_span": 15, "dropout": 0.1, "hist_drop_prob": 0.1, "num_agent_types": 4, "num_polyline_types": 12,
    "num_polygon_types": 11, "num_light_types": 5, "num_polyline_points": TRIPLE,
}  # fmt: skip
AGENTS, PIECES = "agents_c12.pkl", "map_c7.pkl"


def write_alpasim(folder: Path) -> Path:
    """Write `catk_v120` and `tokens` into a folder; returns the folder of the model."""
    generator = torch.Generator().manual_seed(4)
    draw = lambda *shape: torch.randn(*shape, generator=generator)  # noqa: E731
    config = SmartConfig(
        dim=DIM, num_frequencies=4, num_heads=2, head_dim=4, num_map_layers=1, num_decoder_layers=1, history_tokens=3
    )
    torch.manual_seed(5)
    network = SmartNetwork(config, NUM_TOKENS, num_map_points=TRIPLE)
    weights = {catk_name(key): value for key, value in network.state_dict().items()}
    weights |= {second: weights[first] for second, first in find_aliases(weights).items()}
    tables = {"type_pt_emb": 12, "polygon_type_emb": 11, "light_pl_emb": 5}
    weights |= {f"encoder.map_encoder.{name}.weight": draw(rows, DIM) for name, rows in tables.items()}
    weights["encoder.agent_encoder.type_a_emb.weight"] = draw(4, DIM)
    # motions: a box that goes straight on at speeds from zero; pieces: two chords of 4 m that turn
    box = torch.tensor([[2.4, 1.0], [2.4, -1.0], [-2.4, -1.0], [-2.4, 1.0]])
    distance = torch.arange(NUM_TOKENS)[:, None] * torch.arange(6) * 0.1  # [V, 6]
    motions = box + torch.stack([distance, 0 * distance], -1)[:, :, None]
    turn = torch.linspace(-0.5, 0.5, NUM_PIECES)
    bend = torch.stack([4 + 4 * turn.cos(), 4 * turn.sin()], -1)
    pieces = torch.stack([torch.zeros(NUM_PIECES, 2), torch.tensor([4.0, 0.0]).expand(NUM_PIECES, 2), bend], 1)
    model, tokens = folder / "catk_v120", folder / "tokens"
    for path in (model, tokens):
        path.mkdir(parents=True)
    token_all = {name: motions.numpy() for name in ("veh", "ped", "cyc")}
    (tokens / AGENTS).write_bytes(pickle.dumps({"token_all": token_all}))
    (tokens / PIECES).write_bytes(pickle.dumps({"traj_src": pieces.numpy()}))
    token_processor = {"agent_token_file": AGENTS, "map_token_file": f"../../{PIECES}", "time_step": 0.1}
    sampling = {"criterium": "topk_prob", "num_k": 3, "temp": 0.8}
    groups = {"decoder": DECODER, "token_processor": token_processor, "validation_rollout_sampling": sampling}
    (model / "config.yaml").write_text(yaml.safe_dump({"model_config": groups}))
    torch.save({"state_dict": weights}, model / "latest.ckpt")
    return model

"""Weights of the public code's state dict under our names, and its scenes as ours."""

import re

import numpy as np
import torch

from rlftsim.policies.trafficbots.config import TrafficBotsConfig
from rlftsim.policies.trafficbots.scene import Scene

SMALL = TrafficBotsConfig(
    dim=64, num_map_layers=2, num_light_layers=1, num_agent_layers=2, map_neighbors=16, light_neighbors=12,
    agent_map_neighbors=32, agent_light_neighbors=12, agent_neighbors=12, radius_m=30.0, light_radius_m=15.0,
)  # fmt: skip

NAMES = (
    (r"mp_encoder\.input_encoder\.mlp\.fc_layers", "map.nodes"),
    (r"mp_encoder\.pl_encoder\.mlp_layers\.(\d)\.fc_layers\.0", r"map.polyline.layers.\1"),
    (r"mp_encoder\.tf_mp2mp", "map"),
    (r"latent_encoder\.tl_encoder_post", "posterior.tl_encoder"),
    (r"latent_encoder\.ag_encoder_post", "posterior.ag_encoder"),
    (r"latent_encoder\.latent_dist_post\.mlp_mean\.fc_layers", "posterior.mean"),
    (r"latent_encoder\.latent_dist_post\.log_std", "posterior.log_std"),
    (r"tl_state_predictor\.mlp\.fc_layers", "light_state"),
    (r"tl_encoder\.input_encoder\.mlp\.fc_layers", "lights.states"),
    (r"tl_encoder\.temp_encoder\.mlp_layers\.(\d)\.fc_layers\.0", r"lights.polyline.layers.\1"),
    (r"tl_encoder\.tf_tl2tlmp", "lights"),
    (r"ag_encoder\.tf_ag2agmptl", "agents"),
    (r"navi_encoder\.mlp_mp\.fc_layers\.0", "destination_map"),
    (r"navi_encoder\.mlp_pe\.fc_layers\.0", "destination_pose"),
    (r"navi_predictor\.mlp\.fc_layers", "destination_predictor.pairs"),
    (r"ag_encoder\.(input|temp)", r"agents.windows.\1"),
    (r"navi_predictor\.(input|temp)", r"destination_predictor.windows.\1"),
    (r"input_encoder\.mlp\.fc_layers", "steps"),
    (r"temp_encoder\.mlp_layers\.(\d)\.fc_layers\.0", r"polyline.layers.\1"),
    (r"action_head\.mlp_mean\.(\d)\.fc_layers", r"actions.features.\1"),
    (r"norm_src", "own_norm"),
    (r"norm_tgt", "target_norm"),
    (r"norm1", "norm"),
    (r"norm2", "feed_forward.norm"),
    (r"linear1", "feed_forward.wide"),
    (r"linear2", "feed_forward.narrow"),
    (r"attn_src", "own_attention"),
    (r"attn\b", "attention"),
    (r"linear_rpe", "relation"),
    (r"out_proj_", "out."),
)
UNUSED = re.compile(r"encoder_prior|latent_dist_prior|action_head\.log_std|tf_mp2mp.*norm_tgt")


def our_names(name: str) -> list[str]:
    """Names in `TrafficBotsNetwork` of the parameters that a public one holds, in the order of its rows."""
    for pattern, ours in NAMES:
        name = re.sub(pattern, ours, name)
    match = re.fullmatch(r"add_(navi|latent)\.(mlp_in|mlp)\.fc_layers\.(\d)\.(\w+)", name)
    if match:  # dropout layers between, which count
        given, part, layer, kind = match.groups()
        block = {"navi": "add_destination", "latent": "add_personality"}[given]
        name = f"{block}.{'given' if part == 'mlp_in' else 'joint'}.{int(layer) // 3 * 2}.{kind}"
    if "in_proj_" in name:
        return [name.replace("in_proj_", "query."), name.replace("in_proj_", "key_value.")]
    match = re.fullmatch(r"actions\.features\.(\d)\.4\.(\w+)", name)
    if match:
        return [f"actions.{output}.{match[1]}.{match[2]}" for output in ("acceleration", "yaw_rate")]
    return [name]


def our_weights(public: dict[str, np.ndarray]) -> dict[str, torch.Tensor]:
    """State dict of `TrafficBotsNetwork` from the public code's."""
    ours = {}
    for name, value in public.items():
        if UNUSED.search(name):
            continue
        own, tensor = our_names(name), torch.tensor(np.asarray(value))
        if len(own) == 1:
            ours[own[0]] = tensor
        else:
            first = len(tensor) // (3 if "in_proj_" in name else 2)
            ours.update(zip(own, tensor.split([first, len(tensor) - first])))
    return ours


def golden_scene(arrays: dict[str, np.ndarray], prefix: str = "hist") -> Scene:
    """Scene of the golden inputs; `prefix` "gt" = the whole log, "hist" = the history."""

    def tensor(name):
        value = torch.from_numpy(arrays[name])
        return (value if value.dtype in (torch.bool, torch.float32) else value.long())[None]

    return Scene(
        node_pose=tensor("mp_pose"),
        node_mask=tensor("mp_valid"),
        map_type=tensor("mp_type"),
        map_box=tensor("mp_boundary"),
        light_token=tensor("tl_token"),
        light_mask=torch.ones(1, len(arrays["tl_token"]), dtype=torch.bool),
        light_state=tensor("tl_state").clamp(min=0)[..., : arrays[f"{prefix}_valid"].shape[1]],
        agent_mask=torch.ones(1, len(arrays["ag_type"]), dtype=torch.bool),
        agent_class=tensor("ag_type"),
        size=tensor("ag_size"),
        valid=tensor(f"{prefix}_valid"),
        pose=tensor(f"{prefix}_pose"),
        motion=tensor(f"{prefix}_motion"),
        origin=torch.zeros(1, 3),
    )

"""Names of weights: those of the public CAT-K code for ours."""

from collections.abc import Iterable

PREFIX = "encoder."

_PLAIN, _MLP, _FOURIER, _ATTENTION = "plain", "mlp", "fourier", "attention"

_SUBMODULES = (
    ("map_encoder.feature_type", "map_encoder.type_pt_emb", _PLAIN),
    ("map_encoder.kind", "map_encoder.polygon_type_emb", _PLAIN),
    ("map_encoder.light", "map_encoder.light_pl_emb", _PLAIN),
    ("map_encoder.token", "map_encoder.token_emb", _MLP),
    ("map_encoder.relation", "map_encoder.r_pt2pt_emb", _FOURIER),
    ("map_encoder.layers", "map_encoder.pt2pt_layers", _ATTENTION),
    ("decoder.class_embedding", "agent_encoder.type_a_emb", _PLAIN),
    ("decoder.size", "agent_encoder.shape_emb", _MLP),
    ("decoder.tokens.0", "agent_encoder.token_emb_veh", _MLP),
    ("decoder.tokens.1", "agent_encoder.token_emb_ped", _MLP),
    ("decoder.tokens.2", "agent_encoder.token_emb_cyc", _MLP),
    ("decoder.motion", "agent_encoder.x_a_emb", _FOURIER),
    ("decoder.fusion", "agent_encoder.fusion_emb", _MLP),
    ("decoder.time_relation", "agent_encoder.r_t_emb", _FOURIER),
    ("decoder.map_relation", "agent_encoder.r_pt2a_emb", _FOURIER),
    ("decoder.agent_relation", "agent_encoder.r_a2a_emb", _FOURIER),
    ("decoder.time_layers", "agent_encoder.t_attn_layers", _ATTENTION),
    ("decoder.map_layers", "agent_encoder.pt2a_attn_layers", _ATTENTION),
    ("decoder.agent_layers", "agent_encoder.a2a_attn_layers", _ATTENTION),
    ("decoder.head", "agent_encoder.token_predict_head", _MLP),
)
"""Prefix of a submodule of the network here, its prefix in the public code, and the type of the submodule."""

_IN_FOURIER = {"frequencies": "freqs", "inputs": "mlps", "out": "to_out"}
_IN_ATTENTION = {
    "query": "to_q",
    "source_key": "to_k",
    "relation_key": "to_k_r",
    "source_value": "to_v",
    "relation_value": "to_v_r",
    "skip": "to_s",
    "gate": "to_g",
    "out": "to_out",
    "target_norm": "attn_prenorm_x_dst",
    "source_norm": "attn_prenorm_x_src",
    "relation_norm": "attn_prenorm_r",
    "out_norm": "attn_postnorm",
    "feed_forward.0": "ff_prenorm",
    "feed_forward.1": "ff_mlp.0",
    "feed_forward.4": "ff_mlp.3",
    "feed_forward.5": "ff_postnorm",
}


def catk_name(key: str) -> str:
    """The public code's name of a weight of this package."""
    # the longest prefix, as "decoder.tokens.1" is also a prefix of "decoder.tokens.10"
    submodules = (entry for entry in _SUBMODULES if key.startswith(entry[0] + "."))
    prefix, catk_prefix, module_type = max(submodules, key=lambda entry: len(entry[0]))
    name = key[len(prefix) + 1 :]
    if module_type == _MLP:
        name = f"mlp.{name}"
    elif module_type == _FOURIER:
        first, _, parameter = name.partition(".")
        name = f"{_IN_FOURIER[first]}.{parameter}"
    elif module_type == _ATTENTION:
        layer, _, name = name.partition(".")
        module, _, parameter = name.rpartition(".")
        name = f"{layer}.{_IN_ATTENTION[module]}.{parameter}"
    return f"{PREFIX}{catk_prefix}.{name}"


def find_aliases(names: Iterable[str]) -> dict[str, str]:
    """Second names of weights that the public code stores twice, each with the first name.

    There a single norm serves both ends of most relations.
    """
    return {
        name.replace(".attn_prenorm_x_dst.", ".attn_prenorm_x_src."): name
        for name in names
        if ".attn_prenorm_x_dst." in name and ".pt2a_attn_layers." not in name
    }

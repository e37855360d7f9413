"""Names of weights: those of the public CAT-K code for ours."""

from collections.abc import Iterable

PREFIX = "encoder."

_PLAIN, _MLP, _FOURIER, _ATTENTION = "plain", "mlp", "fourier", "attention"

_PARTS = (
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
"""Prefix of a part of the network here, its prefix there, and the kind of the part."""

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
    """The public code's name of one of our weights."""
    # the longest prefix, as "decoder.tokens.1" is also one of "decoder.tokens.10"
    own, theirs, kind = max((p for p in _PARTS if key.startswith(p[0] + ".")), key=lambda p: len(p[0]))
    rest = key[len(own) + 1 :]
    if kind == _MLP:
        rest = f"mlp.{rest}"
    elif kind == _FOURIER:
        first, _, inner = rest.partition(".")
        rest = f"{_IN_FOURIER[first]}.{inner}"
    elif kind == _ATTENTION:
        layer, _, inner = rest.partition(".")
        part, _, parameter = inner.rpartition(".")
        rest = f"{layer}.{_IN_ATTENTION[part]}.{parameter}"
    return f"{PREFIX}{theirs}.{rest}"


def alias_of(name: str) -> str | None:
    """Second name under which the public code stores the same weight: one norm for both ends of a relation."""
    if ".attn_prenorm_x_dst." in name and ".pt2a_attn_layers." not in name:
        return name.replace(".attn_prenorm_x_dst.", ".attn_prenorm_x_src.")
    return None


def aliases(names: Iterable[str]) -> dict[str, str]:
    """Second names of weights that are stored twice, each with its first name."""
    return {second: name for name in names if (second := alias_of(name))}

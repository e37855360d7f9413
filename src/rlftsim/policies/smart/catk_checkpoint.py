"""Checkpoints of the public CAT-K code, and token tables, which are no part of these: strict import, and export back.

policy = import_catk(Path("clsft.ckpt"), [Path("agent_vocab.npz"), Path("map_vocab.npz")]).policy
policy.save_pretrained(Path("models/clsft"))

Lightning checkpoints are pickles, read through torch's restricted unpickler without running code of the file. The few
foreign classes that hold settings (OmegaConf) are replaced by name with an inert stand-in, all further classes are
refused.
"""

import collections
import hashlib
import zipfile
from collections.abc import Callable, Iterable, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn

from rlftsim.errors import CheckpointError, ConfigError, DataError, printable
from rlftsim.jobs.arrays import find_misfits, read_npz, read_tensors
from rlftsim.jobs.documents import first_line
from rlftsim.jobs.files import save_tensors, write_atomically
from rlftsim.policies.checkpoint import join_first, outline, strip_wrappers
from rlftsim.policies.smart.config import SmartConfig, smart_mini, smart_nano, smart_tiny
from rlftsim.policies.smart.network import SmartNetwork
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.policy import Sampling
from rlftsim.tokens.map_tokens import WINDOW
from rlftsim.tokens.vocabulary import MAX_COORDINATE_M, MAX_TOKENS, STEPS_PER_TOKEN, Vocabulary

CATK_SAMPLING = Sampling(top_k=48)
"""Sampling of the public code in validation: with label smoothing a tenth of the probability is on senseless tokens."""
MOTION_TABLES = ("veh", "ped", "cyc")
MAP_TABLE = "traj_src"
_AGENT_SHAPE = (STEPS_PER_TOKEN + 1, 4, 2)

PUBLISHED_AGENT_FILE = "agent_vocab_555_s2.pkl"
PUBLISHED_NUM_TOKENS = 2048
_PUBLISHED = {
    "veh": "131c0714b245d5357b9ed24bb5ecf0d437b8f0072a7a7b9746a9ab34c0dc9bad",
    "ped": "3ba4fbdb7a6fc0ab1d0867e01af54cf2b26d5e09aa4b4586aa83630261cd80a9",
    "cyc": "f670da05e7a5eb3c789dd93864462b6ea945fe2ef51556f75002e9dc437374ac",
}
"""sha256 of the float32 bytes of the table that CAT-K published."""
_OMEGACONF = "dictconfig.DictConfig listconfig.ListConfig nodes.AnyNode base.ContainerMetadata base.Metadata"
"""Foreign classes, for which there is a stand-in."""
_HARMLESS = (Any, collections.defaultdict, list, dict, int)
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
    "query": "to_q", "skip": "to_s", "gate": "to_g", "out": "to_out",
    "source_key": "to_k", "relation_key": "to_k_r", "source_value": "to_v", "relation_value": "to_v_r",
    "target_norm": "attn_prenorm_x_dst", "source_norm": "attn_prenorm_x_src",
    "relation_norm": "attn_prenorm_r", "out_norm": "attn_postnorm",
    "feed_forward.0": "ff_prenorm", "feed_forward.1": "ff_mlp.0",
    "feed_forward.4": "ff_mlp.3", "feed_forward.5": "ff_postnorm",
}  # fmt: skip
PRESETS = {"nano": smart_nano, "mini": smart_mini, "tiny": smart_tiny}
_FIELD_OF_SETTING = {
    "hidden_dim": "dim", "num_freq_bands": "num_frequencies", "num_heads": "num_heads", "head_dim": "head_dim",
    "num_map_layers": "num_map_layers", "num_agent_layers": "num_decoder_layers",
    "pl2pl_radius": "map_radius_m", "pl2a_radius": "agent_map_radius_m", "a2a_radius": "agent_radius_m",
    "dropout": "dropout", "hist_drop_prob": "history_drop",
}  # fmt: skip
_SHAPE_PROBE = PREFIX + "agent_encoder.t_attn_layers.0.to_q.weight"
_HEAD_BIAS = PREFIX + "agent_encoder.token_predict_head.mlp.3.bias"


def read_catk_vocabulary(paths: Sequence[Path]) -> Vocabulary:
    """Token tables from npz files, or from a vocabulary file of this package.

    Args:
        paths: Files of type npz that together hold `veh`, `ped`, `cyc` [V, 6, 4, 2] and `traj_src` [P, 11, 2],
            meters; or a single `.safetensors` written by `Vocabulary.save`.

    Raises:
        CheckpointError: A table is missing or has the wrong size, or a file cannot be read.
    """
    if len(paths) == 1 and paths[0].suffix == ".safetensors":
        try:
            return Vocabulary.load(paths[0])
        except DataError as error:
            raise CheckpointError(str(error)) from None
    names, tables = (*MOTION_TABLES, MAP_TABLE), {}
    for path in paths:
        try:
            way_out = "not an npz of token tables (pickles are not read, see docs/catk.md)"
            tables |= read_npz(path, names, way_out, error=CheckpointError)
        except FileNotFoundError:
            raise CheckpointError(f"{path}: no such vocabulary.") from None
    source = ", ".join(str(p) for p in paths)
    return build_catk_vocabulary(tables, source)


def build_catk_vocabulary(tables: dict[str, np.ndarray], source: str, *, num_map_points: int = WINDOW) -> Vocabulary:
    """Vocabulary of the public code's token tables.

    Args:
        tables: `veh`, `ped`, `cyc` [V, 6, 4, 2] and `traj_src` [P, n, 2], meters.
        source: Files of the tables, which begin every message.
        num_map_points: Points n of a map piece.

    Raises:
        CheckpointError: A table is missing, has the wrong shape, or values that are no coordinates.
    """
    missing = [name for name in (*MOTION_TABLES, MAP_TABLE) if name not in tables]
    if missing:
        raise CheckpointError(f"{source}: no table {', '.join(missing)}: hand over veh, ped, cyc and traj_src.")
    _check_tables(tables, source, num_map_points)
    # classes in this package's order: vehicles, pedestrians, cyclists [3, V, 6, 4, 2]
    corners = torch.from_numpy(np.stack([tables[name] for name in MOTION_TABLES]).astype(np.float32))
    prototypes = torch.from_numpy(tables[MAP_TABLE].astype(np.float32))
    mask = torch.ones(corners.shape[:2], dtype=torch.bool)
    return Vocabulary(corners, mask, prototypes, origin=f"imported from {source}")


def has_published_tokens(vocabulary: Vocabulary) -> bool:
    """True if the motion tokens are those that CAT-K published, by sha256."""
    tables = (np.ascontiguousarray(table, np.float32).tobytes() for table in vocabulary.corners.cpu().numpy())
    return [hashlib.sha256(table).hexdigest() for table in tables] == [_PUBLISHED[name] for name in MOTION_TABLES]


def write_catk_vocabulary(vocabulary: Vocabulary, path: Path) -> None:
    """Write the tables as npz, in the form `read_catk_vocabulary` takes.

    Args:
        vocabulary: Vocabulary with equally many tokens in all classes.
        path: Path of the new npz file, written whole or not at all.

    Raises:
        DataError: The file cannot be written.
    """
    motions = dict(zip(MOTION_TABLES, vocabulary.corners.cpu().numpy()))
    tables = {**motions, MAP_TABLE: vocabulary.map_prototypes.cpu().numpy()}

    def write(temporary: Path) -> None:
        with temporary.open("wb") as file:
            np.savez(file, **tables)  # type: ignore[arg-type]

    write_atomically(path, write)


def _check_tables(tables: dict[str, np.ndarray], source: str, num_map_points: int) -> None:
    """Check shapes, types, numbers of tokens and coordinates of the tables.

    Raises:
        CheckpointError: A table differs from the form of the public code; the message names the first kind of mistake.
    """
    shapes = {name: ("V", *_AGENT_SHAPE) for name in MOTION_TABLES} | {MAP_TABLE: ("P", num_map_points, 2)}
    problems = [
        f"{name} has shape {tables[name].shape} instead of ({', '.join(map(str, shape))})"
        for name, shape in shapes.items()
        if tables[name].shape[1:] != shape[1:] or tables[name].ndim != len(shape)
    ]
    types = {name: tables[name].dtype for name in shapes}
    problems += [f"{name} holds {dtype}, not numbers" for name, dtype in types.items() if dtype.kind not in "fiu"]
    if not problems:
        counts = {len(tables[name]) for name in MOTION_TABLES}
        if not 1 <= min(counts) <= max(counts) <= MAX_TOKENS:
            problems = [f"a class has {max(counts)} tokens, there are 1 to {MAX_TOKENS}"]
        elif len(counts) > 1:
            problems = [f"veh, ped and cyc have different numbers of tokens ({', '.join(map(str, sorted(counts)))})"]
    if not problems:
        problems = [
            f"{name} holds values that are not finite, or beyond {MAX_COORDINATE_M:g} m"
            for name in shapes
            if not (np.abs(tables[name]) <= MAX_COORDINATE_M).all()
        ]
    if problems:
        raise CheckpointError(f"{source}: {'; '.join(problems)}.")


class _Inert:
    """Stand-in for foreign classes: holds the state of an object and runs no code."""

    def __setstate__(self, state: dict[str, Any]) -> None:
        self.__dict__.update(state)


def read_lightning(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Weights of a Lightning checkpoint, and the file's `hyper_parameters` as plain dictionaries, lists and values.

    Raises:
        CheckpointError: No such file, not a checkpoint, no weights inside, or objects that would have to run code to
            be read.
    """
    content = _unpickle(path)
    weights = content.get("state_dict") if isinstance(content, dict) else None
    if not isinstance(weights, dict) or not all(_is_weight(k, v) for k, v in weights.items()):
        raise CheckpointError(f"{path}: no weights under 'state_dict': is it a Lightning checkpoint of a model?")
    try:
        settings = _plain(content.get("hyper_parameters", {}))
    except RecursionError:
        raise CheckpointError(f"{path}: damaged, its settings hold themselves: get the file again.") from None
    return dict(weights), settings if isinstance(settings, dict) else {}


def find_group(settings: dict[str, Any], name: str) -> dict[str, Any]:
    """Group of settings of a name; empty where there is none."""
    group = settings.get(name)
    return group if isinstance(group, dict) else {}


def _is_weight(name: object, value: Any) -> bool:
    """True for a dense tensor on the CPU with all values stored: views may announce more than memory holds."""
    if not isinstance(name, str) or type(value) not in (Tensor, nn.Parameter) or value.layout != torch.strided:
        return False
    return value.device.type == "cpu" and value.numel() * value.element_size() <= value.untyped_storage().nbytes()


def _unpickle(path: Path) -> Any:
    if not path.is_file():
        raise CheckpointError(f"{path}: no such file.")
    try:
        if not zipfile.is_zipfile(path):
            raise CheckpointError(f"{path}: neither safetensors nor a Lightning checkpoint (a zip file by torch.save).")
        with zipfile.ZipFile(path) as archive:
            if any(member.compress_type != zipfile.ZIP_STORED for member in archive.infolist()):
                raise CheckpointError(f"{path}: packed, which torch.save never does: unpack it, or get the file again.")
        # list the classes that the pickle names before any is made
        classes: Any = [(_Inert, f"omegaconf.{name}") for name in _OMEGACONF.split()]
        classes += [(value, f"{value.__module__}.{value.__name__}") for value in _HARMLESS]
        named = torch.serialization.get_unsafe_globals_in_checkpoint(path)
        refused = sorted(set(named) - {name for _, name in classes})
        if refused:
            raise CheckpointError(f"{path}: refused, it holds {', '.join(refused)}: save it again with weights only.")
        # then let torch's restricted unpickler make the harmless classes, and stand-ins for the foreign
        with torch.serialization.safe_globals(classes):
            return torch.load(path, map_location="cpu", weights_only=True)
    except CheckpointError:
        raise
    except Exception as error:  # whatever damage makes of the code that reads it
        reason = first_line(error)
        raise CheckpointError(f"{path}: damaged or not a checkpoint ({reason}): get the file again.") from None


def _plain(value: Any) -> Any:
    """Settings as plain dictionaries, lists and values; values of other types become None."""
    if isinstance(value, _Inert):
        # OmegaConf keeps containers in `_content` and values in `_val`
        state = value.__dict__
        return _plain(state["_content"] if "_content" in state else state.get("_val"))
    if isinstance(value, dict):
        return {str(k): _plain(v) for k, v in value.items()}
    if isinstance(value, list | tuple):
        return [_plain(v) for v in value]
    return value if isinstance(value, str | int | float | bool) else None


def catk_name(key: str) -> str:
    """The public code's name of a weight of this package."""
    prefix, catk_prefix, module_type = next(entry for entry in _SUBMODULES if key.startswith(entry[0] + "."))
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


@dataclass(frozen=True, eq=False)
class CatkImport:
    """An imported model, with size and origin."""

    policy: SmartPolicy
    size: str
    """nano, mini, tiny or custom."""
    notes: tuple[str, ...]
    """Lines for the user: the source of the sizes, and the vocabulary."""


def import_catk(checkpoint: Path, vocabulary: Sequence[Path]) -> CatkImport:
    """Read a checkpoint of the public CAT-K code.

    Args:
        checkpoint: `.safetensors` with the keys of the public code's state dict, or a Lightning checkpoint.
        vocabulary: Files of the token tables that the model was trained with, see `read_catk_vocabulary`.

    Returns:
        The model in evaluation mode, with `catk_compat` on, so that the outputs are those of the public code, and with
        the sampling of its validation.

    Raises:
        CheckpointError: A file is damaged or holds foreign objects; keys are missing, unknown, of the wrong shape
            or unequal where they must be equal (the first are named); the vocabulary does not belong to the weights.
    """
    weights, settings = _read(checkpoint)
    imported = build_catk_policy(weights, settings, checkpoint, lambda: read_catk_vocabulary(vocabulary))
    note = _vocabulary_note(settings, has_published_tokens(imported.policy.vocabulary), checkpoint)
    source, draws = imported.notes
    return replace(imported, notes=(source, note, draws))


def build_catk_policy(
    weights: dict[str, Tensor],
    settings: dict[str, Any],
    checkpoint: Path,
    read_vocabulary: Callable[[], Vocabulary],
    *,
    num_map_points: int = WINDOW,
) -> CatkImport:
    """Model of the public code's weights; notes on sizes and sampling.

    Args:
        weights: All weights by the public code's names.
        settings: Groups `decoder` and `validation_rollout_sampling` of the public code; may be empty.
        checkpoint: File that begins every message.
        read_vocabulary: Reader of the token tables, called once the weights fit.
        num_map_points: Points of a map prototype.

    Raises:
        CheckpointError: Weights that do not fit, all of which are named, or a vocabulary of another size.
    """
    config, source = _find_config(weights, settings, checkpoint)
    head = weights.get(_HEAD_BIAS, torch.zeros(PUBLISHED_NUM_TOKENS))
    if head.dim() != 1 or not 1 <= len(head) <= MAX_TOKENS:
        raise CheckpointError(f"{checkpoint}: {_HEAD_BIAS} has shape {tuple(head.shape)}, not one number a token.")
    expected = outline(lambda: SmartNetwork(config, len(head), num_map_points=num_map_points))
    weights = _translate(weights, expected, str(checkpoint))
    tables = read_vocabulary()
    if tables.num_tokens != len(head) or not tables.token_mask.all():
        raise CheckpointError(
            f"{checkpoint}: predicts {len(head)} tokens a class, the vocabulary holds "
            f"{', '.join(str(int(n)) for n in tables.token_mask.sum(1))}: hand over the one it was trained with."
        )
    sampling = _find_sampling(settings)
    policy = SmartPolicy(config, tables, sampling)
    policy.network.load_state_dict(weights)
    sizes = (name for name, preset in PRESETS.items() if replace(preset(), catk_compat=True) == config)
    draws = f"samples among the {sampling.top_k} most likely tokens, temperature {sampling.temperature:g} (config.json)"
    return CatkImport(policy.eval(), next(sizes, "custom"), (source, draws))


def _find_sampling(settings: dict[str, Any]) -> Sampling:
    """Sampling that a checkpoint was validated with; the public code's default where the settings name none."""
    validated = find_group(settings, "validation_rollout_sampling")
    values = {"temperature": validated.get("temp"), "top_k": validated.get("num_k")}
    try:
        sampling = replace(CATK_SAMPLING, **{name: value for name, value in values.items() if value is not None})
    except ConfigError:
        return CATK_SAMPLING
    return sampling if sampling.temperature > 0 else CATK_SAMPLING


def export_catk(policy: SmartPolicy) -> dict[str, Tensor]:
    """Copies of a model's weights under the public code's names, on the CPU; a second import gives the same bits.

    Raises:
        CheckpointError: The model is goal-conditioned, comes from AlpaSim, or has a head that the public code lacks.
    """
    lacking = "has no form in the public CAT-K code"
    if policy.vocabulary.map_prototypes.shape[1] != WINDOW:
        raise CheckpointError(f"a model of AlpaSim, whose map pieces have other points, {lacking}.")
    if policy.is_goal_conditioned:
        raise CheckpointError(f"a goal-conditioned model {lacking}: export the one it came from.")
    for setting, reason in (("head_per_class", ", which has one head for all classes"), ("continuation_scores", "")):
        if getattr(policy.config, setting):
            raise CheckpointError(f"a model with {setting} {lacking}{reason}: train one with model.{setting}=false.")
    named = {catk_name(k): v.detach().cpu().clone() for k, v in policy.network.state_dict().items()}
    return named | {second: named[first].clone() for second, first in find_aliases(named).items()}


def write_catk(policy: SmartPolicy, path: Path) -> None:
    """Write `export_catk` as a safetensors file, whole or not at all.

    Args:
        policy: Goal-free model with a single head for all classes.
        path: Path of the new file, which ends in `.safetensors`.
    """
    save_tensors(path, export_catk(policy))


def _read(path: Path) -> tuple[dict[str, Tensor], dict[str, Any]]:
    """Weights by the public code's names, and the file's settings of the decoder and the tokens, empty without any."""
    if path.suffix == ".safetensors":
        missing, settings = f"{path}: no such file.", {}
        weights, _ = read_tensors(path, "get the file again", error=CheckpointError, missing=missing)
    else:
        weights, settings = read_lightning(path)
    weights = dict(strip_wrappers(weights, ()))
    if not any(key.startswith(PREFIX) for key in weights):
        weights = {PREFIX + key: value for key, value in weights.items()}
    return weights, find_group(settings, "model_config")


def _find_config(weights: dict[str, Tensor], settings: dict[str, Any], path: Path) -> tuple[SmartConfig, str]:
    """The architecture, and a note on the source: the file's settings, else the shapes of the weights."""
    # 1. a Lightning checkpoint has the settings. Radii and probabilities may be integers there, here they are floats
    decoder = find_group(settings, "decoder")
    values = {ours: decoder[theirs] for theirs, ours in _FIELD_OF_SETTING.items() if theirs in decoder}
    if len(values) == len(_FIELD_OF_SETTING) and isinstance(decoder.get("time_span"), int):
        try:
            defaults = vars(SmartConfig())
            typed = {name: type(defaults[name])(value) for name, value in values.items()}
            config = SmartConfig(**typed, history_tokens=decoder["time_span"] // STEPS_PER_TOKEN)
        except (TypeError, ValueError, OverflowError, ConfigError) as error:
            raise CheckpointError(f"{path}: settings of the decoder make no sense: {error}") from None
        return replace(config, catk_compat=True), "sizes and radii: from the checkpoint's settings"
    # 2. a safetensors file has none: the shapes of the weights say which of the published sizes, if any
    probe = weights.get(_SHAPE_PROBE)
    inner, dim = probe.shape if probe is not None and probe.dim() == 2 else (0, 0)
    depths = (
        len({key.split(".")[3] for key in weights if key.startswith(PREFIX + stem)})
        for stem in ("map_encoder.pt2pt_layers.", "agent_encoder.t_attn_layers.")
    )
    shapes = (dim, inner, *depths)
    for name, preset in PRESETS.items():
        size = preset()
        if shapes == (size.dim, size.num_heads * size.head_dim, size.num_map_layers, size.num_decoder_layers):
            return replace(size, catk_compat=True), f"sizes: recognized as {name}; radii: those of {name}"
    raise CheckpointError(
        f"{path}: not a SMART model of the public CAT-K code in one of the sizes {', '.join(PRESETS)} "
        "(other sizes need the Lightning checkpoint, which says which)."
    )


def _vocabulary_note(settings: dict[str, Any], is_published: bool, path: Path) -> str:
    """Note on the vocabulary: published or not, and the file that the checkpoint names.

    Raises:
        CheckpointError: The checkpoint names the published table, and the vocabulary is a different table.
    """
    named = find_group(settings, "token_processor").get("agent_token_file")
    if named == PUBLISHED_AGENT_FILE and not is_published:
        raise CheckpointError(f"{path}: was trained with {named}, the vocabulary is another one: hand over that table.")
    note = f"vocabulary: the published {PUBLISHED_AGENT_FILE}" if is_published else "vocabulary: not a published one"
    if named is None:
        return f"{note}; the checkpoint does not say which one it was trained with"
    doubt = ": make sure that it is the same table" if is_published and named != PUBLISHED_AGENT_FILE else ""
    return f"{note}; the checkpoint names {named}{doubt}"


def _translate(weights: dict[str, Tensor], expected: dict[str, Tensor], source: str) -> dict[str, Tensor]:
    """Weights under this package's names, those of a network's state dict.

    Raises:
        CheckpointError: Weights are missing, unknown, of the wrong shape or type, or unequal under a second name; the
            first are named.
    """
    # all names that must be there, second names of shared norms included
    keys = {catk_name(key): key for key in expected}
    aliases = find_aliases(keys)
    named = {name: expected[key] for name, key in keys.items()}
    named |= {second: named[first] for second, first in aliases.items()}
    # collect all problems, so that a user mends them at once
    problems = find_misfits(weights, named)
    floats = {name: value for name, value in sorted(weights.items()) if name in named and value.dtype == torch.float32}
    problems += [f"{name} holds values that are not finite" for name, x in floats.items() if not x.isfinite().all()]
    for second, first in sorted(aliases.items()):
        if second in weights and first in weights and not torch.equal(weights[second], weights[first]):
            problems.append(f"{second} differs from {first}, which must be the same")
    if problems:
        text = printable(join_first(problems, "; "))
        raise CheckpointError(f"{source}: {len(problems)} weights do not fit: {text}.")
    return {key: weights[name] for name, key in keys.items()}

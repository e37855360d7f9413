"""Checkpoints of the public CAT-K code: strict import, and export back.

policy = import_catk(Path("clsft.ckpt"), [Path("agent_vocab.npz"), Path("map_vocab.npz")]).policy
policy.save_pretrained(Path("models/clsft"))
"""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from rlftsim.errors import CheckpointError, ConfigError, printable
from rlftsim.jobs.arrays import read_tensors
from rlftsim.jobs.files import save_tensors
from rlftsim.policies.checkpoint import SHOWN_PROBLEMS, outline, strip_wrappers
from rlftsim.policies.smart.catk_keys import PREFIX, catk_name, find_aliases
from rlftsim.policies.smart.catk_vocabulary import (
    PUBLISHED_AGENT_FILE,
    PUBLISHED_NUM_TOKENS,
    has_published_tokens,
    read_catk_vocabulary,
)
from rlftsim.policies.smart.config import SmartConfig, smart_mini, smart_nano, smart_tiny
from rlftsim.policies.smart.lightning_file import find_group, read_lightning
from rlftsim.policies.smart.network import SmartNetwork
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.tokens.vocabulary import MAX_TOKENS, STEPS_PER_TOKEN

PRESETS = {"nano": smart_nano, "mini": smart_mini, "tiny": smart_tiny}

_FIELD_OF_SETTING = {
    "hidden_dim": "dim",
    "num_freq_bands": "num_frequencies",
    "num_heads": "num_heads",
    "head_dim": "head_dim",
    "num_map_layers": "num_map_layers",
    "num_agent_layers": "num_decoder_layers",
    "pl2pl_radius": "map_radius_m",
    "pl2a_radius": "agent_map_radius_m",
    "a2a_radius": "agent_radius_m",
    "dropout": "dropout",
    "hist_drop_prob": "history_drop",
}
_SHAPE_PROBE = PREFIX + "agent_encoder.t_attn_layers.0.to_q.weight"
_HEAD_BIAS = PREFIX + "agent_encoder.token_predict_head.mlp.3.bias"


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
        The model in evaluation mode, with `catk_compat` on, so that the outputs are those of the public code.

    Raises:
        CheckpointError: A file is damaged or holds foreign objects; keys are missing, unknown, of the wrong shape
            or unequal where they must be equal (the first are named); the vocabulary does not belong to the weights.
    """
    weights, settings = _read(checkpoint)
    config, source = _find_config(weights, settings, checkpoint)
    head = weights.get(_HEAD_BIAS, torch.zeros(PUBLISHED_NUM_TOKENS))
    if head.dim() != 1 or not 1 <= len(head) <= MAX_TOKENS:
        raise CheckpointError(f"{checkpoint}: {_HEAD_BIAS} has shape {tuple(head.shape)}, not one number a token.")
    weights = _translate(weights, outline(lambda: SmartNetwork(config, len(head))), str(checkpoint))
    tables = read_catk_vocabulary(vocabulary)
    if tables.num_tokens != len(head) or not tables.token_mask.all():
        raise CheckpointError(
            f"{checkpoint}: predicts {len(head)} tokens a class, the vocabulary holds "
            f"{', '.join(str(int(n)) for n in tables.token_mask.sum(1))}: hand over the one it was trained with."
        )
    note = _vocabulary_note(settings, has_published_tokens(tables), checkpoint)
    policy = SmartPolicy(config, tables)
    policy.network.load_state_dict(weights)
    sizes = (name for name, preset in PRESETS.items() if replace(preset(), catk_compat=True) == config)
    return CatkImport(policy.eval(), next(sizes, "custom"), (source, note))


def export_catk(policy: SmartPolicy) -> dict[str, Tensor]:
    """Copies of a model's weights under the public code's names, on the CPU; a second import gives the same bits.

    Raises:
        CheckpointError: The model is goal-conditioned, or has a head that the public code lacks.
    """
    lacking = "has no form in the public CAT-K code"
    if policy.is_goal_conditioned:
        raise CheckpointError(f"a goal-conditioned model {lacking}: export the one it came from.")
    if policy.config.head_per_class:
        raise CheckpointError(
            f"a model with head_per_class {lacking}, which has one head for all classes: "
            "train one with model.head_per_class=false."
        )
    if policy.config.continuation_scores:
        raise CheckpointError(
            f"a model with continuation_scores {lacking}: train one with model.continuation_scores=false."
        )
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
        try:
            weights, settings = read_tensors(path, "get the file again", error=CheckpointError)[0], {}
        except FileNotFoundError:
            raise CheckpointError(f"{path}: no such file.") from None
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
    # shapes of all names that must be there, second names of shared norms included
    keys = {catk_name(key): key for key in expected}
    aliases = find_aliases(keys)
    shapes = {name: expected[key].shape for name, key in keys.items()}
    shapes |= {second: shapes[first] for second, first in aliases.items()}
    # collect all problems, so that a user mends them at once
    problems = [f"missing {name}" for name in sorted(shapes.keys() - weights.keys())]
    problems += [f"unknown {name[:100]}" for name in sorted(weights.keys() - shapes.keys())]
    for name in sorted(shapes.keys() & weights.keys()):
        value = weights[name]
        if value.shape != shapes[name]:
            problems.append(f"{name} has shape {tuple(value.shape)} instead of {tuple(shapes[name])}")
        elif value.dtype != torch.float32:
            problems.append(f"{name} is {value.dtype} instead of torch.float32")
        elif not value.isfinite().all():
            problems.append(f"{name} holds values that are not finite")
    for second, first in sorted(aliases.items()):
        if second in weights and first in weights and not torch.equal(weights[second], weights[first]):
            problems.append(f"{second} differs from {first}, which must be the same")
    if problems:
        listed = "; ".join(problems[:SHOWN_PROBLEMS]) + (" …" if len(problems) > SHOWN_PROBLEMS else "")
        raise CheckpointError(f"{source}: {len(problems)} weights do not fit: {printable(listed)}.")
    return {key: weights[name] for name, key in keys.items()}

"""Checkpoints of the public CAT-K code: import, export, and everything that is refused."""

import json
import pickle
import zipfile
from dataclasses import replace

import numpy as np
import pytest
import torch
from safetensors.torch import load_file, save_file

from rlftsim.cli.main import main
from rlftsim.errors import CheckpointError
from rlftsim.policies.registry import load_policy
from rlftsim.policies.smart.catk_checkpoint import (
    PREFIX,
    export_catk,
    find_aliases,
    has_published_tokens,
    import_catk,
    read_catk_vocabulary,
    write_catk,
    write_catk_vocabulary,
)
from rlftsim.policies.smart.config import SmartConfig, smart_mini, smart_nano, smart_tiny
from rlftsim.policies.smart.policy import SmartPolicy
from rlftsim.rollout.policy import Sampling
from rlftsim.tokens.vocabulary import Vocabulary
from rlftsim.training.config import FEATURES
from small_things import write_synthetic

NUM_TOKENS = 5
HEAD = f"{PREFIX}agent_encoder.token_predict_head.mlp.3.bias"
SETTINGS = {
    "hidden_dim": 16, "num_freq_bands": 4, "num_heads": 2, "head_dim": 4, "num_map_layers": 1, "num_agent_layers": 1,
    "pl2pl_radius": 10, "pl2a_radius": 25, "a2a_radius": 35, "time_span": 15, "dropout": 0.1, "hist_drop_prob": 0.2,
}  # fmt: skip


def vocabulary(num_tokens=NUM_TOKENS):
    generator = torch.Generator().manual_seed(2)
    corners = torch.randn(3, num_tokens, 6, 4, 2, generator=generator)
    prototypes = torch.randn(7, 11, 2, generator=generator)
    return Vocabulary(corners, torch.ones(3, num_tokens, dtype=torch.bool), prototypes)


def fresh(config, num_tokens=NUM_TOKENS):
    torch.manual_seed(1)
    return SmartPolicy(replace(config, catk_compat=True), vocabulary(num_tokens)).eval()


@pytest.fixture(scope="module")
def policy():
    return fresh(smart_nano())


@pytest.fixture
def tables(policy, tmp_path):
    write_catk_vocabulary(policy.vocabulary, tmp_path / "tables.npz")
    return [tmp_path / "tables.npz"]


def same(a, b):
    a, b = a.network.state_dict(), b.network.state_dict()
    return a.keys() == b.keys() and all(torch.equal(a[k], b[k]) for k in a)


# ---- round trips ---------------------------------------------------------------------------------


def test_a_model_exported_and_imported_again_has_the_same_bits(policy, tables, tmp_path):
    write_catk(policy, tmp_path / "out.safetensors")
    imported = import_catk(tmp_path / "out.safetensors", tables)
    assert imported.size == "nano"
    assert imported.policy.config == policy.config
    assert not imported.policy.training
    assert same(imported.policy, policy)
    assert torch.equal(imported.policy.vocabulary.corners, policy.vocabulary.corners)
    assert torch.equal(imported.policy.vocabulary.map_prototypes, policy.vocabulary.map_prototypes)


def test_an_export_is_a_copy(policy):
    before = export_catk(policy)
    export_catk(policy)[HEAD].add_(1)
    assert torch.equal(export_catk(policy)[HEAD], before[HEAD])


def test_an_imported_model_can_be_saved_as_one_of_ours(policy, tables, tmp_path):
    write_catk(policy, tmp_path / "out.safetensors")
    imported = import_catk(tmp_path / "out.safetensors", tables).policy
    imported.save_pretrained(tmp_path / "model")
    loaded = SmartPolicy.from_pretrained(tmp_path / "model")
    assert loaded.config.catk_compat
    assert same(loaded, policy)


@pytest.mark.parametrize(
    ("validated", "sampling"),
    [
        ({"criterium": "topk_prob", "num_k": 5, "temp": 0.9}, Sampling(0.9, 5)),
        ({"num_k": 0}, Sampling(top_k=48)),
        ({"temp": 0.0}, Sampling(top_k=48)),
        ({}, Sampling(top_k=48)),
    ],
)
def test_an_imported_model_samples_as_the_public_code_validates(policy, tables, tmp_path, validated, sampling):
    config = {"validation_rollout_sampling": validated}
    torch.save({"state_dict": export_catk(policy), "hyper_parameters": {"model_config": config}}, tmp_path / "x.ckpt")
    imported = import_catk(tmp_path / "x.ckpt", tables)
    assert imported.policy.sampling == sampling
    assert any(f"among the {sampling.top_k} most likely tokens" in note for note in imported.notes)


def test_a_vocabulary_of_ours_will_do(policy, tmp_path):
    policy.vocabulary.save(tmp_path / "vocabulary.safetensors")
    write_catk(policy, tmp_path / "out.safetensors")
    assert same(import_catk(tmp_path / "out.safetensors", [tmp_path / "vocabulary.safetensors"]).policy, policy)


def test_other_sizes_come_with_their_settings(tables, tmp_path):
    config = SmartConfig(
        dim=16, num_frequencies=4, num_heads=2, head_dim=4, num_map_layers=1, num_decoder_layers=1,
        agent_map_radius_m=25.0, agent_radius_m=35.0, history_tokens=3, history_drop=0.2, catk_compat=True,
    )  # fmt: skip
    other = fresh(config)
    content = {"state_dict": export_catk(other), "hyper_parameters": {"model_config": {"decoder": SETTINGS}}}
    torch.save(content, tmp_path / "other.ckpt")
    imported = import_catk(tmp_path / "other.ckpt", tables)
    assert (imported.size, imported.policy.config) == ("custom", config)
    assert same(imported.policy, other)
    write_catk(other, tmp_path / "other.safetensors")
    with pytest.raises(CheckpointError, match="one of the sizes nano, mini, tiny"):
        import_catk(tmp_path / "other.safetensors", tables)


def test_the_command_line_takes_and_returns_a_model(policy, tables, tmp_path, capsys):
    write_catk(policy, tmp_path / "theirs.safetensors")
    names = [str(tmp_path / name) for name in ("theirs.safetensors", "model", "back.safetensors")]
    arguments = ["model", "import", "--from", "catk", names[0], "--vocabulary", str(tables[0]), "--out", names[1]]
    assert main(arguments) == 0
    assert "SMART nano" in capsys.readouterr().out
    assert "non-commercial" in (tmp_path / "model" / "README.md").read_text()
    assert main(["model", "export", names[1], "--to", "catk", names[2]]) == 0
    assert (tmp_path / "back.safetensors").read_bytes() == (tmp_path / "theirs.safetensors").read_bytes()
    assert (tmp_path / "back.vocabulary.npz").exists()
    assert main(arguments) == 2
    assert "is not empty" in capsys.readouterr().err
    assert main(["model", "export", names[1], "--to", "catk", str(tmp_path / "back.ckpt")]) == 2


def test_a_checkpoint_that_was_imported_is_calibrated_in_one_command(tables, tmp_path, capsys):
    write_synthetic(tmp_path / "data")
    config = SmartConfig(
        dim=16, num_frequencies=4, num_heads=2, head_dim=4, num_map_layers=1, num_decoder_layers=1,
        agent_map_radius_m=25.0, agent_radius_m=35.0, history_tokens=3, history_drop=0.2,
    )  # fmt: skip
    content = {"state_dict": export_catk(fresh(config)), "hyper_parameters": {"model_config": {"decoder": SETTINGS}}}
    torch.save(content, tmp_path / "theirs.ckpt")
    out, model, theirs = (str(tmp_path / name) for name in ("calibrated", "model", "theirs.ckpt"))
    words = ["finetune", "smart-tiny", "--method", "calibrate", "--data", str(tmp_path / "data"), "--out", out]
    words += ["--processes", "1", "--calibrate.num-rollouts", "2", "--model"]
    assert main([*words, theirs]) == 2
    assert "is a file: import it, rlftsim model import --from catk." in capsys.readouterr().err
    assert main(["model", "import", "--from", "catk", theirs, "--vocabulary", str(tables[0]), "--out", model]) == 0
    assert main([*words, model]) == 0
    calibrated, base = load_policy(out), load_policy(model)
    assert same(calibrated.base, base)
    assert calibrated.sampling == base.sampling == Sampling(top_k=48)
    assert [row["feature"] for row in calibrated.calibration["features"]] == list(FEATURES)


# ---- what is refused -----------------------------------------------------------------------------


def write_changed(policy, tmp_path, change):
    weights = export_catk(policy)
    change(weights)
    save_file(weights, tmp_path / "changed.safetensors")
    return tmp_path / "changed.safetensors"


def test_everything_that_does_not_fit_is_listed_at_once(policy, tables, tmp_path):
    layer = f"{PREFIX}agent_encoder.a2a_attn_layers.2"

    def change(weights):
        del weights[f"{layer}.to_q.bias"]
        weights[f"{layer}.to_k.bias"] = torch.zeros(32)
        weights[f"{layer}.to_v.weight"] = torch.zeros(64, 32)
        weights[f"{layer}.attn_prenorm_x_src.weight"] += 1
        weights[f"{layer}.to_g.bias"] = weights[f"{layer}.to_g.bias"].half()
        weights[f"{layer}.to_s.bias"][3] = torch.nan

    with pytest.raises(CheckpointError) as caught:
        import_catk(write_changed(policy, tmp_path, change), tables)
    message = str(caught.value)
    assert "6 weights do not fit" in message
    for words in (
        f"missing {layer}.to_q.bias",
        f"unknown {layer}.to_k.bias",
        f"{layer}.to_v.weight has shape (64, 32) instead of (32, 64)",
        f"{layer}.attn_prenorm_x_src.weight differs from {layer}.attn_prenorm_x_dst.weight",
        f"{layer}.to_g.bias is torch.float16",
        f"{layer}.to_s.bias holds values that are not finite",
    ):
        assert words in message


@pytest.mark.parametrize("alias", ["attn_prenorm_x_src", "attn_prenorm_x_dst"])
def test_both_names_of_a_shared_norm_must_be_there(alias, policy, tables, tmp_path):
    name = f"{PREFIX}map_encoder.pt2pt_layers.0.{alias}.bias"
    with pytest.raises(CheckpointError, match=f"missing {name}"):
        import_catk(write_changed(policy, tmp_path, lambda weights: weights.pop(name)), tables)


def test_a_missing_head_is_listed_like_any_other_key(policy, tables, tmp_path):
    with pytest.raises(CheckpointError, match=f"missing {HEAD}"):
        import_catk(write_changed(policy, tmp_path, lambda weights: weights.pop(HEAD)), tables)


class Foreign:
    def __reduce__(self):
        return (open, ("/nowhere/written-by-a-checkpoint", "w"))


def test_foreign_objects_are_refused_and_not_run(policy, tables, tmp_path):
    torch.save({"state_dict": export_catk(policy), "callbacks": Foreign()}, tmp_path / "foreign.ckpt")
    with pytest.raises(CheckpointError, match=r"refused, it holds (io|_io)\.open") as caught:
        import_catk(tmp_path / "foreign.ckpt", tables)
    assert "\n" not in str(caught.value)


@pytest.mark.parametrize(
    ("content", "words"),
    [
        (b"", "neither safetensors nor a Lightning checkpoint"),
        (pickle.dumps({"state_dict": {}}), "neither safetensors nor a Lightning checkpoint"),
    ],
    ids=["empty", "bare pickle"],
)
def test_files_of_other_kinds_are_refused(content, words, tables, tmp_path):
    (tmp_path / "x.ckpt").write_bytes(content)
    with pytest.raises(CheckpointError, match=words):
        import_catk(tmp_path / "x.ckpt", tables)


def save_packed(content, path):
    """A checkpoint whose members are compressed, as torch never writes them."""
    torch.save(content, path)
    with zipfile.ZipFile(path) as archive:
        members = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w", zipfile.ZIP_DEFLATED) as archive:
        for name, data in members.items():
            archive.writestr(name, data)


def looped():
    settings = {"decoder": []}
    settings["decoder"].append(settings)
    return settings


SPOILED = {
    "names that are no text": (lambda w: {"state_dict": {3: torch.zeros(1), **w}}, "no weights under 'state_dict'"),
    "a view of one number": (lambda w: {"state_dict": {**w, HEAD: torch.zeros(1).expand(10**9)}}, "no weights under"),
    "a sparse tensor": (lambda w: {"state_dict": {**w, HEAD: torch.zeros(5).to_sparse()}}, "no weights under"),
    "a head of two axes": (lambda w: {"state_dict": {**w, HEAD: torch.zeros(5, 2)}}, "not one number a token"),
    "settings that hold themselves": (
        lambda w: {"state_dict": w, "hyper_parameters": {"model_config": looped()}},
        "hold themselves",
    ),
    "settings of enormous sizes": (
        lambda w: {
            "state_dict": w,
            "hyper_parameters": {"model_config": {"decoder": {**SETTINGS, "num_agent_layers": 10**9}}},
        },
        "num_decoder_layers must be at most 256",
    ),
    "sizes of other weights": (
        lambda w: {
            "state_dict": w,
            "hyper_parameters": {"model_config": {"decoder": {**SETTINGS, "head_dim": 60_000}}},
        },
        "weights do not fit",
    ),
}  # fmt: skip


@pytest.mark.parametrize("name", SPOILED)
def test_checkpoints_are_checked_before_anything_is_built(name, policy, tables, tmp_path):
    change, words = SPOILED[name]
    torch.save(change(export_catk(policy)), tmp_path / "x.ckpt")
    with pytest.raises(CheckpointError, match=words) as error:
        import_catk(tmp_path / "x.ckpt", tables)
    assert "\n" not in str(error.value)


@pytest.mark.parametrize("config", [[], "x", {"decoder": 3}, {"token_processor": ["x"]}])
def test_settings_of_other_kinds_count_for_nothing(config, policy, tables, tmp_path):
    content = {"state_dict": export_catk(policy), "hyper_parameters": {"model_config": config}}
    torch.save(content, tmp_path / "x.ckpt")
    assert same(import_catk(tmp_path / "x.ckpt", tables).policy, policy)


def test_a_packed_checkpoint_is_refused_before_it_is_unpacked(policy, tables, tmp_path):
    save_packed({"state_dict": export_catk(policy)}, tmp_path / "x.ckpt")
    with pytest.raises(CheckpointError, match=r"packed, which torch\.save never does"):
        import_catk(tmp_path / "x.ckpt", tables)


@pytest.mark.parametrize("prefix", ["_orig_mod.", "module."])
def test_weights_of_compiled_and_distributed_models_are_imported(prefix, policy, tables, tmp_path):
    save_file({prefix + name: value for name, value in export_catk(policy).items()}, tmp_path / "x.safetensors")
    assert same(import_catk(tmp_path / "x.safetensors", tables).policy, policy)


def test_damaged_and_missing_files_are_refused(policy, tables, tmp_path):
    torch.save({"state_dict": export_catk(policy)}, tmp_path / "whole.ckpt")
    data = (tmp_path / "whole.ckpt").read_bytes()
    (tmp_path / "half.ckpt").write_bytes(data[: len(data) // 2])
    number_of_disks = data.rindex(b"PK\x06\x07") + 16
    (tmp_path / "disks.ckpt").write_bytes(data[:number_of_disks] + b"\x02" + data[number_of_disks + 1 :])
    (tmp_path / "half.safetensors").write_bytes(b"\x10" + bytes(20))
    torch.save({"weights": 1}, tmp_path / "none.ckpt")
    for name, words in {
        "half.ckpt": "neither safetensors nor",
        "disks.ckpt": "zipfiles that span multiple disks",
        "half.safetensors": "damaged safetensors",
        "none.ckpt": "no weights under 'state_dict'",
        "absent.ckpt": "no such file",
        "absent.safetensors": "no such file",
    }.items():
        with pytest.raises(CheckpointError, match=words):
            import_catk(tmp_path / name, tables)


def test_tables_of_the_wrong_size_are_refused(policy, tmp_path):
    write_catk(policy, tmp_path / "out.safetensors")
    good = dict(zip(("veh", "ped", "cyc"), policy.vocabulary.corners.numpy()))
    good["traj_src"] = policy.vocabulary.map_prototypes.numpy()
    short = {k: v[:3] if k != "traj_src" else v for k, v in good.items()}
    cases = {
        "no table traj_src": {k: v for k, v in good.items() if k != "traj_src"},
        "ped has shape": good | {"ped": good["ped"][:, :5]},
        "different numbers of tokens": good | {"cyc": good["cyc"][:3]},
        "values that are not finite": good | {"veh": good["veh"] * np.nan},
        "predicts 5 tokens a class, the vocabulary holds 3, 3, 3": short,
    }
    for words, tables in cases.items():
        np.savez(tmp_path / "tables.npz", **tables)
        with pytest.raises(CheckpointError, match=words):
            import_catk(tmp_path / "out.safetensors", [tmp_path / "tables.npz"])
    np.save(tmp_path / "tables.npy", np.array([{"veh": 1}], dtype=object))
    (tmp_path / "tables.pkl").write_bytes(pickle.dumps(good))
    for name, words in {"tables.npy": "pickles are not read", "tables.pkl": "not an npz", "no.npz": "no such"}.items():
        with pytest.raises(CheckpointError, match=words):
            import_catk(tmp_path / "out.safetensors", [tmp_path / name])


def test_a_vocabulary_other_than_the_one_a_checkpoint_names_is_refused(policy, tables, tmp_path):
    config = {"token_processor": {"agent_token_file": "agent_vocab_555_s2.pkl"}}
    torch.save({"state_dict": export_catk(policy), "hyper_parameters": {"model_config": config}}, tmp_path / "x.ckpt")
    with pytest.raises(CheckpointError, match=r"trained with agent_vocab_555_s2\.pkl, the vocabulary is another one"):
        import_catk(tmp_path / "x.ckpt", tables)


# ---- the public code's own files -----------------------------------------------------------------


@pytest.mark.official
def test_a_lightning_file_and_safetensors_give_the_same_model(golden, token_tables, nano):
    other = import_catk(golden.folder / "nano_seed1003.safetensors", token_tables)
    assert same(other.policy, nano)
    assert other.policy.config == nano.config == replace(smart_nano(), catk_compat=True)
    assert has_published_tokens(nano.vocabulary)


@pytest.mark.official
def test_export_gives_back_every_key_and_bit_of_the_public_file(golden, nano):
    theirs = load_file(golden.folder / "nano_seed1003.safetensors")
    ours = export_catk(nano)
    assert ours.keys() == theirs.keys()
    assert all(torch.equal(ours[k], theirs[k]) for k in theirs)


@pytest.mark.official
@pytest.mark.parametrize("preset", [smart_nano, smart_mini, smart_tiny])
def test_keys_and_shapes_of_every_size_are_the_public_ones(preset, golden):
    shapes = json.loads((golden.folder / "state_dict_shapes.json").read_text())[preset.__name__.removeprefix("smart_")]
    ours = export_catk(fresh(preset(), num_tokens=2048))
    assert {k.removeprefix(PREFIX): list(v.shape) for k, v in ours.items()} == shapes
    assert len(find_aliases(ours)) == 2 * (preset().num_map_layers + 2 * preset().num_decoder_layers)


@pytest.mark.official
def test_another_vocabulary_is_not_taken_for_the_published_one(token_tables, nano):
    assert not has_published_tokens(replace(nano.vocabulary, corners=nano.vocabulary.corners + 1e-6))
    assert read_catk_vocabulary(token_tables).num_tokens == 2048

"""Models in AlpaSim's layout, made here from models of this package: import, rollouts, and everything refused."""

import hashlib
import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
import yaml

import rlftsim as rs
import scenes
from alpasim_files import write_alpasim
from rlftsim.cli.main import main
from rlftsim.errors import CheckpointError
from rlftsim.policies.smart import alpasim_checkpoint
from rlftsim.policies.smart.alpasim_checkpoint import import_alpasim, read_pickled_arrays
from rlftsim.policies.smart.catk_checkpoint import export_catk
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import MapFeatures, MapFeatureType
from rlftsim.tokens.map_tokens import TRIPLE, split_map, tokenize_map

MAPS = "encoder.map_encoder."
L = MapFeatureType


@pytest.fixture
def layout(tmp_path):
    return write_alpasim(tmp_path / "models")


@pytest.fixture
def weights(layout):
    return torch.load(layout / "latest.ckpt", weights_only=True)["state_dict"]


def rewrite(layout, weights):
    torch.save({"state_dict": weights}, layout / "latest.ckpt")


# ---- what comes in ------------------------------------------------------------------------------------------------


def test_a_model_in_alpasims_layout_comes_in_by_a_command_and_drives_everybody(layout, tmp_path, capsys):
    assert main(["model", "import", str(layout), "--from", "alpasim", "--out", str(tmp_path / "model")]) == 0
    said = capsys.readouterr().out
    for path in (*layout.iterdir(), *(layout.parent / "tokens").iterdir()):
        digest = hashlib.sha256(path.read_bytes()).hexdigest()
        assert f"{path.name}: not a published file, sha256 {digest}" in said
    assert "not mapped: agents of other types move as vehicles" in said
    policy = rs.load_policy(tmp_path / "model")
    rollouts = rs.simulate(policy, scenes.junction_with_light(), num_rollouts=2)
    assert rollouts.position.shape[-2:] == (80, 2)
    assert rollouts.position.isfinite().all()
    assert (rollouts.position[:, :, :, -1] - rollouts.position[:, :, :, 0]).norm(dim=-1).max() > 1


def test_sizes_radii_and_sampling_are_those_of_its_settings(layout):
    policy = import_alpasim(layout).policy
    config = policy.config
    assert (config.dim, config.num_heads, config.head_dim, config.history_tokens) == (16, 2, 4, 3)
    assert (config.map_radius_m, config.agent_map_radius_m, config.agent_radius_m) == (10.0, 25.0, 35.0)
    assert (policy.sampling.top_k, policy.sampling.temperature) == (3, 0.8)
    assert not policy.training


def test_files_of_the_published_sha256_are_said_to_be_those(layout, monkeypatch):
    digest = hashlib.sha256((layout / "latest.ckpt").read_bytes()).hexdigest()
    monkeypatch.setitem(alpasim_checkpoint.PUBLISHED, "latest.ckpt", digest)
    assert f"latest.ckpt: the published file, sha256 {digest}" in import_alpasim(layout).notes


def test_map_pieces_are_embedded_as_there(layout, weights):
    """The sum that AlpaSim's map encoder makes: shape, sub-type 0, type and light 0."""
    policy = import_alpasim(layout).policy
    scenario = scenes.junction_with_light()
    tokens = tokenize_map(collate([scenario]), policy.vocabulary.map_prototypes)
    x = policy.vocabulary.map_prototypes.flatten(1)
    for stage in range(0, 7, 3):
        layer = {name: weights[f"{MAPS}token_emb.mlp.{stage}.{name}"] for name in ("weight", "bias")}
        x = x @ layer["weight"].T + layer["bias"]
        if stage < 6:
            norm = {name: weights[f"{MAPS}token_emb.mlp.{stage + 1}.{name}"] for name in ("weight", "bias")}
            x = torch.nn.functional.layer_norm(x, x.shape[-1:], **norm).relu()
    types = torch.tensor([5, 5, 5, 5, 1, 1, 0, 0, 0, 3])[tokens.type]
    wanted = x[tokens.token_id] + weights[f"{MAPS}polygon_type_emb.weight"][types]
    wanted = wanted + weights[f"{MAPS}type_pt_emb.weight"][0] + weights[f"{MAPS}light_pl_emb.weight"][0]
    encoder = policy.network.map_encoder
    encoder.layers = torch.nn.ModuleList()
    ours = encoder(tokens, policy.vocabulary.map_prototypes)
    torch.testing.assert_close(ours, wanted.flatten(0, 1), rtol=0, atol=1e-5)


def test_references_in_the_settings_are_followed(layout):
    settings = yaml.safe_load((layout / "config.yaml").read_text())
    settings["width"] = settings["model_config"]["decoder"]["hidden_dim"]
    settings["model_config"]["decoder"]["hidden_dim"] = "${width}"
    (layout / "config.yaml").write_text(yaml.safe_dump({"width": settings.pop("width"), "model": settings}))
    assert import_alpasim(layout).policy.config.dim == 16


def test_weights_of_other_modules_are_left_out_and_counted(layout, weights):
    rewrite(layout, {**weights, "critic.weight": torch.zeros(2)})
    assert "left out: 1 weights outside encoder.*, such as critic.weight" in import_alpasim(layout).notes


def test_such_a_model_has_no_form_in_the_public_code(layout):
    with pytest.raises(CheckpointError, match="a model of AlpaSim"):
        export_catk(import_alpasim(layout).policy)


# ---- map pieces -----------------------------------------------------------------------------------------------------


def cut(*features):
    scenario = replace(scenes.straight_road(), map_features=MapFeatures.of(list(features)))
    return split_map(scenario, TRIPLE)


def line(feature_type, *points, feature_id=1):
    return feature_id, feature_type, np.array([(*point, 0.0) for point in points])


def test_a_line_is_cut_into_pieces_of_eight_meters_the_last_of_which_ends_where_it_ends():
    pieces = cut(line(L.LANE_SURFACE_STREET, *((x, 0.0) for x in np.arange(0, 26.1, 0.5))))
    assert pieces.points[:, :, 0].tolist() == [[0, 4, 8], [8, 12, 16], [16, 20, 24], [20, 24, 26]]
    assert pieces.heading.tolist() == [0.0] * 4


def test_long_sides_are_no_gaps_and_bumps_and_driveways_are_no_crosswalks():
    corners = ((0, 0), (0, 20), (4, 20), (4, 0))
    pieces = cut(*(line(t, *corners, feature_id=t) for t in (L.CROSSWALK, L.SPEED_BUMP, L.DRIVEWAY)))
    assert set(pieces.type.tolist()) == {9}
    assert pieces.points[:2].tolist() == [[[0, 0], [0, 4], [0, 8]], [[0, 8], [0, 12], [0, 16]]]
    assert len(pieces.points) == 6
    assert pieces.heading[0] == pytest.approx(np.pi / 2)


def test_a_map_without_usable_lines_has_the_piece_out_of_reach():
    assert cut(line(L.LANE_SURFACE_STREET, (0, 0), (3, 0))).points.min() > 10_000


# ---- what is refused -------------------------------------------------------------------------------------------------


class Calls:
    def __reduce__(self):
        return eval, ("print('run')",)


@pytest.mark.parametrize("content", [Calls(), {"traj_src": Calls()}, {"traj_src": np.array([Calls()], object)}])
def test_a_pickle_that_would_run_code_is_refused_by_name(tmp_path, capsys, content):
    (tmp_path / "t.pkl").write_bytes(pickle.dumps(content))
    with pytest.raises(CheckpointError, match=r"t\.pkl: (refused, it holds builtins\.eval|damaged)"):
        read_pickled_arrays(tmp_path / "t.pkl")
    assert "run" not in capsys.readouterr().out


@pytest.mark.parametrize("protocol", range(3, pickle.HIGHEST_PROTOCOL + 1))
@pytest.mark.parametrize("order", ["C", "F"])
def test_arrays_come_back_from_every_protocol(tmp_path, protocol, order):
    array = np.asarray(np.random.default_rng(0).normal(size=(5, 3, 2)).astype(np.float32), order=order)
    (tmp_path / "t.pkl").write_bytes(pickle.dumps({"token_all": {"veh": array}, "n": 5}, protocol))
    tables = read_pickled_arrays(tmp_path / "t.pkl")
    assert tables.keys() == {"token_all"}
    np.testing.assert_array_equal(tables["token_all"]["veh"], array)


def test_a_pointer_of_git_lfs_is_named_as_such(layout):
    (layout / "latest.ckpt").write_text("version https://git-lfs.github.com/spec/v1\noid sha256:7c5a\nsize 69960427\n")
    with pytest.raises(CheckpointError, match=r"latest\.ckpt: a pointer of Git LFS, not the file: .*git lfs pull"):
        import_alpasim(layout)


@pytest.mark.parametrize(
    ("name", "shape", "message"),
    [
        (f"{MAPS}polygon_type_emb.weight", (5, 16), r"polygon_type_emb\.weight is \[5, 16\], not \[6 or more, 16\]"),
        (f"{MAPS}token_emb.mlp.0.weight", (128, 22), r"shape \(128, 22\) instead of \(128, 6\)"),
        ("encoder.agent_encoder.type_a_emb.weight", None, r"type_a_emb\.weight is missing"),
        ("encoder.agent_encoder.r_t_emb.freqs.weight", None, r"1 weights do not fit: missing .*r_t_emb"),
    ],
)
def test_weights_that_do_not_fit_are_named(layout, weights, name, shape, message):
    weights.pop(name)
    rewrite(layout, weights if shape is None else {**weights, name: torch.zeros(shape)})
    with pytest.raises(CheckpointError, match=message):
        import_alpasim(layout)


@pytest.mark.parametrize(
    ("edit", "message"),
    [
        (lambda s: s.pop("model_config"), "has no model_config"),
        (lambda s: s["model_config"]["token_processor"].pop("map_token_file"), "names no map_token_file"),
        (lambda s: s["model_config"]["token_processor"].update(map_token_file="/x/y.pkl"), r"tokens/y\.pkl: no such"),
        (lambda s: s["model_config"]["decoder"].update(num_heads=0), "settings of the decoder make no sense"),
    ],
)
def test_settings_that_say_nothing_are_refused(layout, edit, message):
    settings = yaml.safe_load((layout / "config.yaml").read_text())
    edit(settings)
    (layout / "config.yaml").write_text(yaml.safe_dump(settings))
    with pytest.raises(CheckpointError, match=message):
        import_alpasim(layout)


@pytest.mark.parametrize(
    ("words", "message"),
    [(["--from", "alpasim", "--vocabulary", "x.npz"], "no effect"), ([], "comes without its token tables")],
)
def test_token_tables_are_named_where_they_are_read(layout, tmp_path, capsys, words, message):
    assert main(["model", "import", str(layout), *words, "--out", str(tmp_path / "model")]) != 0
    assert message in capsys.readouterr().err

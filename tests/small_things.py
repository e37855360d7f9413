"""Small things under the names that the documentation uses: data sets, models, recipes, files of other tools."""

import pickle
import re
import tomllib
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from run_pages import ROOT, blocks_of

import rlftsim as rs
import scenes
import third_party
from alpasim_files import write_alpasim
from av2_files import write_av2
from gpudrive_files import write_file
from made_up import CPU, TINY
from rlftsim.evaluation import scenario_pages
from rlftsim.policies.registry import POLICIES
from rlftsim.policies.smart.catk_checkpoint import export_catk, write_catk_vocabulary
from rlftsim.policies.trafficbots.config import TrafficBotsConfig
from rlftsim.recipes.base import Recipe
from rlftsim.recipes.registry import RECIPES, recipe_by_name
from rlftsim.rollout.types import write_rollouts
from rlftsim.scenario.batch import collate
from rlftsim.scenario.tfrecord import write_records
from rlftsim.tokens.clustering import build_vocabulary
from rlftsim.viewer.film import to_film
from table_files import write_tables
from womd_messages import build_message

SHOWN = "9d639de83d6f5239"
"""The scenario that most pages show."""
GALLERY = tuple(dict.fromkeys(re.findall(r"--scenario (\w+)", (ROOT / "docs" / "gallery.md").read_text())))
"""Scenarios of the gallery."""
TINY_BOTS = TrafficBotsConfig(
    dim=32, num_heads=2, num_map_layers=1, num_light_layers=1, num_agent_layers=1, map_neighbors=4,
    light_neighbors=2, agent_map_neighbors=8, agent_light_neighbors=2, agent_neighbors=4, radius_m=100.0,
    light_radius_m=100.0, steps_per_pass=80, forcing_updates=2,
)  # fmt: skip


def write_synthetic(folder: Path, *named: str) -> None:
    """A few of the scenarios that ship: the smallest two of each split, or named ones in place of one."""
    data = rs.load_dataset("synthetic")
    counts = [data.index[f"num_{kind}"].to_numpy() for kind in ("vehicles", "pedestrians", "cyclists")]
    order = np.argsort(200 * sum(counts) + data.index["num_map_points"].to_numpy(), kind="stable").tolist()
    splits = data.index["split"].to_pylist()
    training, held_out = ([data[i] for i in order if splits[i] == name][:2] for name in ("training", "validation"))
    if named:
        held_out[1:] = [data[name] for name in named]
    ids = {scenario.scenario_id for scenario in held_out}
    rs.write_dataset(
        [*held_out, *training], folder, split=lambda one: "validation" if one.scenario_id in ids else "training"
    )


def write_womd(folder: Path) -> list[rs.Scenario]:
    """A data set with the splits of WOMD, of scenes drawn by hand. Returns those for training."""
    training = [scenes.junction_with_light("t1"), scenes.bend("t2"), scenes.straight_road("t3")]
    held_out = [scenes.straight_road("v1"), scenes.junction_with_light("v2")]
    splits = {one.scenario_id: "training" for one in training} | {one.scenario_id: "validation" for one in held_out}
    scenarios = [*training, *held_out, scenes.without_future("x1")]
    rs.write_dataset(scenarios, folder, split=lambda one: splits.get(one.scenario_id, "testing"))
    return training


def write_things(folder: Path) -> None:
    """Write everything that a page may take for granted, under the page's names."""
    # 1. data sets, and files to be converted
    write_synthetic(folder / "synthetic")
    write_synthetic(folder / "synthetic_shown", SHOWN)
    write_synthetic(folder / "synthetic_gallery", *GALLERY)
    training = write_womd(folder / "data" / "womd")
    write_womd(folder / "DATA")
    for split in ("training", "validation"):
        messages = [build_message(f"{split}-{number}", num_tracks=3 + number) for number in range(3)]
        path = folder / "womd" / split / f"{split}.tfrecord-00000-of-00001"
        path.parent.mkdir(parents=True)
        write_records(path, [message.SerializeToString() for message in messages])
    for place in ("av2/val", "argoverse2/val"):
        write_av2(folder / place, scenes.straight_road("0a1b2c3d"))
    write_tables(folder / "recordings")
    for number in range(2):
        write_file(folder / "GPUDrive_mini" / "validation", build_message(f"g{number}"))
    (folder / "logs").mkdir()
    (folder / "logs" / "monday.mylog").write_text("one\n")
    # 2. models
    vocabulary = build_vocabulary(training, TINY.tokens)[0]
    policy = TINY.new_policy(vocabulary).eval()
    for name in ("base", "tuned", "rlft", "nano"):
        policy.save_pretrained(folder / "runs" / name / "model")
    policy.with_goal_conditioning("indication", logit_bias=True).save_pretrained(folder / "runs" / "goals" / "model")
    vocabulary.save(folder / "runs" / "v.safetensors")
    vocabulary.save(folder / "runs" / "vocabulary.safetensors")
    entry = next(block for block in blocks_of(ROOT / "docs" / "submission.md") if block.title == "submission.toml")
    (folder / entry.title).write_text(entry.text)
    write_template(folder / "installed")
    # 3. rollouts of another simulator, and pickles as other code writes them
    scenario = scenes.straight_road("v1")
    rollouts = rs.simulate("constant_velocity", scenario, num_rollouts=2)
    (folder / "rollouts").mkdir()
    write_rollouts(folder / "rollouts", collate([scenario]), rollouts)
    write_pickles(folder, policy, folder / "rollouts" / "v1.npz")
    write_alpasim(folder / "trafficsim-models")


def write_template(folder: Path) -> None:
    """The plug-in template, as pip would have installed it."""
    template = ROOT / "docs" / "plugin_template"
    source = (template / "src" / "rlftsim_plugin" / "__init__.py").read_text()
    project = tomllib.loads((template / "pyproject.toml").read_text())["project"]
    third_party.install(folder, "rlftsim_plugin", source, project["entry-points"])


def write_pickles(folder: Path, policy: rs.SmartPolicy, rollouts: Path) -> None:
    """A checkpoint and tables of the public CAT-K code, and rollouts of codes on top of it."""
    compatible = type(policy)(replace(policy.config, catk_compat=True), policy.vocabulary)
    config = policy.config
    sizes = {
        "hidden_dim": config.dim, "num_freq_bands": config.num_frequencies, "num_heads": config.num_heads,
        "head_dim": config.head_dim, "num_map_layers": config.num_map_layers,
        "num_agent_layers": config.num_decoder_layers, "pl2pl_radius": 10, "pl2a_radius": 30, "a2a_radius": 60,
        "time_span": 30, "dropout": 0.1, "hist_drop_prob": 0.1,
    }  # fmt: skip
    content = {"state_dict": export_catk(compatible), "hyper_parameters": {"model_config": {"decoder": sizes}}}
    torch.save(content, folder / "epoch_031.ckpt")
    write_catk_vocabulary(policy.vocabulary, folder / "tables.npz")
    with np.load(folder / "tables.npz") as tables:
        agents = {name: tables[name] for name in ("veh", "ped", "cyc")}
        pieces = {"traj_src": tables["traj_src"]}
    np.savez(folder / "agent_vocab.npz", **agents)
    np.savez(folder / "map_tokens.npz", **pieces)
    (folder / "agent_vocab_555_s2.pkl").write_bytes(pickle.dumps({"token_all": agents}))
    (folder / "map_traj_token5.pkl").write_bytes(pickle.dumps(pieces))
    with np.load(rollouts) as file:
        content = {
            "scenario_id": str(file["scenario_id"]),
            "agent_id": file["object_ids"],
            "pred_traj": np.stack([file["x"], file["y"]], -1).transpose(1, 0, 2, 3),
            "pred_z": file["z"].transpose(1, 0, 2),
            "pred_head": file["heading"].transpose(1, 0, 2),
        }
    (folder / "predictions").mkdir()
    (folder / "predictions" / "v1.pkl").write_bytes(pickle.dumps(content))
    (folder / "messages").mkdir()
    (folder / "messages" / "v1.pkl").write_bytes(pickle.dumps(b"bytes of a message"))


def small(recipe: Recipe) -> Recipe:
    """A recipe with its sections and methods, of a tiny model and a few updates."""
    sizes = {"batch_size": 2, "epochs": 1.0, "device": CPU}
    methods = {
        name: replace(getattr(recipe, name), **sizes)
        for name in ("pretrain", "catk", "road", "gcsl")
        if getattr(recipe, name) is not None
    }
    model = TINY_BOTS if isinstance(recipe.model, TrafficBotsConfig) else TINY.model
    finetune = replace(recipe.finetune, num_rollouts=2, rollouts_per_pass=2, **sizes)
    calibrate = recipe.calibrate and replace(recipe.calibrate, num_rollouts=2, device=CPU)
    methods |= {"finetune": finetune, "calibrate": calibrate}
    return replace(recipe, tokens=recipe.tokens and TINY.tokens, model=model, **methods)


@contextmanager
def small_world(things: Path, commands: str) -> Iterator[None]:
    """Inside, "synthetic" has four scenarios; recipes, models that ship and films of reports are small.

    Args:
        things: folder that `write_things` has filled.
        commands: that are run. If they, or files of the current folder, name the scenario that pages show, then it is
            among the four, and the models are as they ship. Scenarios of the gallery have small models.
    """
    is_shown = SHOWN in commands or any(Path().rglob(f"*{SHOWN}*"))
    is_gallery = any(name in commands for name in GALLERY)
    folder = things / ("synthetic_shown" if is_shown else "synthetic_gallery" if is_gallery else "synthetic")
    models = {} if is_shown else {"demo-base": "base", "demo-tuned": "tuned", "demo-goals": "goals"}
    with pytest.MonkeyPatch.context() as patch:
        for name, run in models.items():
            patch.setitem(POLICIES._registered, name, lambda run=run: rs.load_policy(things / "runs" / run))
        patch.setattr("rlftsim.scenario.dataset.pack_path", lambda: folder)
        # a frame every two seconds
        patch.setattr(scenario_pages, "to_film", lambda path, scene, **_: to_film(path, scene, steps_per_frame=20))
        for name in RECIPES._shipped:
            recipe = small(recipe_by_name(name))
            patch.setitem(RECIPES._registered, name, lambda recipe=recipe: recipe)
        yield

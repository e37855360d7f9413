"""Planners that Stable-Baselines3 has learned: driven from their file, of which no pickle is read."""

import io
import pickle
import zipfile

import numpy as np
import pytest
import torch

from rlftsim.cli.main import main
from rlftsim.envs import EgoEnv
from rlftsim.envs.planner_episode import run_planner
from rlftsim.envs.planners.registry import hash_code, load_planner
from rlftsim.errors import ConfigError
from scenes import bend, straight_road

stable_baselines3 = pytest.importorskip("stable_baselines3")

from rlftsim.envs.driver_view import DriverView  # noqa: E402
from rlftsim.envs.sb3 import SB3VecEnv  # noqa: E402

KINDS = {
    "flat": {"policy": "MlpPolicy", "observation": "flat", "policy_kwargs": {"net_arch": [8]}},
    "view": {
        "policy": "MultiInputPolicy", "observation": "dict",
        "policy_kwargs": {"features_extractor_class": DriverView, "net_arch": {"pi": [], "vf": [8]}},
    },
    "ReLU": {
        "policy": "MlpPolicy", "observation": "flat", "action": "bicycle_discrete",
        "policy_kwargs": {"activation_fn": torch.nn.ReLU, "net_arch": [8, 8]},
    },
}  # fmt: skip


def save(path, kind="flat"):
    """A policy with fresh weights, as Stable-Baselines3 stores it."""
    settings = KINDS[kind]
    env = SB3VecEnv(
        1, scenarios=[straight_road()], traffic="replay", observation=settings["observation"],
        action=settings.get("action", "bicycle"),
    )  # fmt: skip
    model = stable_baselines3.PPO(
        settings["policy"], env, n_steps=8, batch_size=8, seed=1, policy_kwargs=settings["policy_kwargs"]
    )
    model.save(path)
    return model, settings["observation"]


@pytest.mark.parametrize("kind", KINDS)
def test_the_file_drives_as_the_policy_in_memory(kind, tmp_path):
    model, form = save(tmp_path / "ppo.zip", kind)
    planner = load_planner(f"sb3:{tmp_path}/ppo.zip")
    assert planner.action == KINDS[kind].get("action", "bicycle")
    env = EgoEnv(scenarios=[bend()], traffic="replay", action=planner.action, stop_on=())
    (((result,), _),) = run_planner(env.source, planner, [bend()], seed=0, rollouts=[0])
    mirror = EgoEnv(scenarios=[bend()], traffic="replay", action=planner.action, observation=form, stop_on=())
    seen, over = mirror.reset(seed=0)[0], False
    while not over:
        seen, _, terminated, truncated, _ = mirror.step(model.predict(seen, deterministic=True)[0])
        over = terminated or truncated
    np.testing.assert_array_equal(result.record.motion, mirror.result().record.motion)


def test_a_learned_planner_is_driven_by_name(tmp_path, capsys, monkeypatch):
    monkeypatch.chdir(tmp_path)
    save("ppo.zip")
    first = hash_code("sb3:ppo.zip")
    words = ["drive", "sb3:ppo.zip", "--data", "synthetic", "--limit", "1", "--traffic", "replay", "--out", "drive"]
    assert main(words) == 0
    assert "sb3:ppo.zip in replay, 1 scenarios" in capsys.readouterr().out
    assert [path.name for path in (tmp_path / "drive").glob("*.parquet")] == ["sb3.ppo.zip-replay.parquet"]
    save("ppo.zip", "view")
    assert hash_code("sb3:ppo.zip") != first  # other weights, another result


class Hostile:
    def __reduce__(self):
        return pytest.fail, ("code of the file was run",)


def rewrite(path, **entries):
    """The file with other entries."""
    with zipfile.ZipFile(path) as archive:
        contents = {name: archive.read(name) for name in archive.namelist()}
    with zipfile.ZipFile(path, "w") as archive:
        for name, content in {**contents, **entries}.items():
            archive.writestr(name, content)


def test_no_code_of_a_file_is_run(tmp_path):
    path = tmp_path / "ppo.zip"
    for hostile in (pickle.dumps(Hostile()), None):
        save(path)
        if hostile is None:
            file = io.BytesIO()
            torch.save({"action_net.bias": Hostile()}, file)
            hostile = file.getvalue()
        rewrite(path, **{"policy.pth": hostile})
        with pytest.raises(ConfigError, match=r"ppo.zip is no policy of PPO or A2C .*: load it in a file of your own"):
            load_planner(f"sb3:{path}")


@pytest.mark.parametrize(
    ("change", "message"),
    [
        (lambda path: path.unlink(), "no such file: name one that model.save wrote"),
        (lambda path: path.write_bytes(b"zip"), "File is not a zip file"),
        (lambda path: rewrite(path, data="[]"), "is no policy of PPO or A2C"),
        (lambda path: rewrite(path, data='{"policy_kwargs": {"features_extractor_class": "x"}}'), "features_extractor"),
    ],
)
def test_a_file_of_another_kind_is_refused_in_one_line(change, message, tmp_path):
    path = tmp_path / "ppo.zip"
    save(path)
    change(path)
    with pytest.raises(ConfigError, match=message):
        load_planner(f"sb3:{path}")


def test_tensors_larger_than_their_file_are_refused(tmp_path):
    path, file = tmp_path / "ppo.zip", io.BytesIO()
    save(path)
    weights = {"action_net.bias": torch.zeros(2), "mlp_extractor.policy_net.0.weight": torch.zeros(1).expand(2**40)}
    torch.save(weights, file)
    rewrite(path, **{"policy.pth": file.getvalue()})
    with pytest.raises(ConfigError, match="weights larger than their file"):
        load_planner(f"sb3:{path}")


def test_pictures_show_time_speed_traffic_and_the_score_at_the_end(monkeypatch):
    env = EgoEnv(
        scenarios=[straight_road()], traffic="constant_velocity", stop_on=(), render_mode="rgb_array", max_steps=3
    )
    drawn = []
    from rlftsim.viewer import film

    frame = film.Camera.frame
    monkeypatch.setattr(
        film.Camera,
        "frame",
        lambda camera, panels, *rest: drawn.append(panels[0].notes[-1]) or frame(camera, panels, *rest),
    )
    env.reset(seed=0)
    pictures = [env.render()]
    for _ in range(3):
        env.step(np.zeros(2, np.float32))
        pictures.append(env.render())
    speed = np.hypot(*env.result().record.agent_motion[0, 3:])
    score = env.result().planner.nuplan_style
    assert drawn[0] == f"0.0 s   {speed:.1f} m/s\nconstant_velocity"
    assert drawn[-1].splitlines()[0].startswith("0.3 s")
    assert drawn[-1].endswith(f"constant_velocity   score {score:.2f}")
    corners = [picture[40:80, 5:120] for picture in pictures]
    assert not np.array_equal(corners[0], corners[-1])

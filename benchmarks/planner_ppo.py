"""Stable-Baselines3's PPO learns to drive better than constant velocity within minutes of a CPU.

    python benchmarks/planner_ppo.py [--steps 120000] [--held-out synthetic] [--limit 40]

The policy is linear in nine numbers that have the units of its action, so that its first action is constant velocity
and each of its weights can be read. Trained on the synthetic training scenarios with replayed traffic; scored on
held-out ones against the planner `constant_velocity`, paired over scenarios.
"""

import time
from dataclasses import dataclass
from pathlib import Path

import numpy as np
import torch
import tyro
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecEnvWrapper

from rlftsim.envs import EgoEnv
from rlftsim.envs.driver_view import DriverView
from rlftsim.envs.planner_episode import run_planner
from rlftsim.envs.planner_scores import PlannerScores
from rlftsim.envs.planners.registry import Planner, load_planner
from rlftsim.envs.sb3 import SB3VecEnv
from rlftsim.envs.source import Source
from rlftsim.evaluation.compare import compare_paired

PARTS = ("nuplan_style", "no_at_fault_collision", "drivable_area", "making_progress", "progress", "comfort")


class Shaped(VecEnvWrapper):
    """A reward at each step, beside the events': stay on the route, keep one's distance and the limit, drive smoothly."""

    def __init__(self, venv: SB3VecEnv) -> None:
        super().__init__(venv)
        self._view = DriverView(venv.observation_space)

    def reset(self):
        return self.venv.reset()

    def step_async(self, actions):
        self._actions = actions
        self.venv.step_async(actions)

    def step_wait(self):
        seen, reward, done, notes = self.venv.step_wait()
        view = self._view({name: torch.as_tensor(value).float() for name, value in seen.items()}).numpy()
        left_over = (
            0.5 * np.minimum(np.abs(view[:, 0]), 1) + 0.5 * np.clip(view[:, 1], 0, 1)
            + 0.2 * np.clip(view[:, 2] - 0.8, 0, 1) + np.maximum(view[:, 4], 0) + 0.05 * np.square(self._actions).sum(1)
        )  # fmt: skip
        # after an end the observation is that of the next episode
        return seen, (reward + np.where(done, 0, 0.1 - left_over)).astype(np.float32), done, notes


@dataclass(frozen=True)
class Trained:
    """The mean action of a trained policy."""

    model: PPO

    def reset(self, info):
        pass

    def act(self, observation):
        return self.model.predict(observation, deterministic=True)[0]


@dataclass(frozen=True)
class Options:
    """Train, then score."""

    steps: int = 120_000
    """Steps of the environment."""
    held_out: str = "synthetic"
    """Data set with validation scenarios to score on."""
    limit: int = 40
    traffic: tuple[str, ...] = ("replay",)
    """Traffic to score in."""
    seed: int = 0
    out: Path | None = None
    """File for the trained policy, of Stable-Baselines3's format."""


def train(options: Options) -> PPO:
    """A policy trained with replayed traffic."""
    vector = SB3VecEnv(
        8, data="synthetic", split="training", traffic="replay", action="bicycle", stop_on=("collision", "offroad"),
        reward="progress - 5*at_fault - 5*offroad",
    )  # fmt: skip
    model = PPO(
        "MultiInputPolicy", Shaped(vector), n_steps=128, batch_size=256, n_epochs=10, learning_rate=3e-3, gamma=0.97,
        seed=options.seed,
        policy_kwargs={
            "features_extractor_class": DriverView, "net_arch": {"pi": [], "vf": [64, 64]}, "log_std_init": -1.5,
        },
    )  # fmt: skip
    begin, cpu = time.monotonic(), time.process_time()
    model.learn(options.steps)
    seconds = time.monotonic() - begin
    print(f"{options.steps} steps: {seconds:.0f} s, {time.process_time() - cpu:.0f} s of CPU time", flush=True)
    print(model.policy.action_net.weight.detach().numpy().round(2))
    if options.out is not None:
        model.save(options.out)
    return model


def drive(source: Source, planner: Planner, scenario_id: str) -> PlannerScores:
    (((result,), _),) = run_planner(source, planner, [source.scenario(scenario_id)], seed=0, rollouts=[0])
    return result.planner


def main(options: Options) -> None:
    torch.set_num_threads(1)
    planners = {"constant velocity": load_planner("constant_velocity"), "PPO": Trained(train(options))}
    for traffic in options.traffic:
        env = EgoEnv(
            split="validation", data=options.held_out, traffic=traffic, action="bicycle", stop_on=(), reward="none"
        )
        ids = env.source.scenario_ids[: options.limit]
        found = {name: [drive(env.source, planner, i) for i in ids] for name, planner in planners.items()}
        for part in PARTS:
            before, after = (np.array([float(getattr(one, part)) for one in found[name]]) for name in planners)
            print(f"{traffic}: {compare_paired(part, before, after)}", flush=True)


if __name__ == "__main__":
    main(tyro.cli(Options, description=__doc__))

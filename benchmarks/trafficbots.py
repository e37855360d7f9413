"""CPU time and memory of TrafficBots V1.5 at its default size, one thread, on a scene of random tensors.

    OMP_NUM_THREADS=1 python benchmarks/trafficbots.py [--quick] [--public FOLDER]

The sizes are 40 agents, 700 map tokens, 24 lights. FOLDER is a checkout of zhejz/TrafficBotsV1.5 (c87329d; its model
needs omegaconf and transforms3d): its network is then measured in turns with ours, padded to the 64, 1024 and 128 slots of its loader.
The rules that it checks at every step, its reward and its dynamics are left out.
"""

import argparse
import resource
import sys
import time
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path

import torch
from torch import Tensor

from rlftsim.policies.trafficbots.config import TrafficBotsConfig
from rlftsim.policies.trafficbots.imitation import compute_scene_loss, draw_training
from rlftsim.policies.trafficbots.policy import TrafficBotsPolicy
from rlftsim.policies.trafficbots.scene import Scene
from rlftsim.policies.trafficbots.state import Memo

NUM_AGENTS, NUM_MAP_TOKENS, NUM_LIGHTS, NUM_STEPS = 40, 700, 24, 91
NUM_DECISIONS = 80
PUBLIC_TRAINING_STEPS = 6
"""Of 80, more would not fit into memory: the time of one step times 80."""


def random_scene() -> Scene:
    """A scene of straight tokens and straight drivers, all directions, within 200 m."""
    torch.manual_seed(0)
    start = torch.cat([torch.rand(NUM_MAP_TOKENS, 2) * 400 - 200, torch.rand(NUM_MAP_TOKENS, 1) * 6.28], -1)
    along = torch.stack([start[:, 2].cos(), start[:, 2].sin()], -1)[:, None] * torch.arange(20.0)[:, None]
    nodes = torch.cat([start[:, None, :2] + along, start[:, None, 2:].expand(-1, 20, -1)], -1)
    pose = torch.cat([torch.rand(NUM_AGENTS, 2) * 200 - 100, torch.rand(NUM_AGENTS, 1) * 6.28], -1)
    time_s, speed = torch.arange(NUM_STEPS) * 0.1, 8 * torch.rand(NUM_AGENTS)
    way = (speed[:, None] * time_s)[..., None] * torch.stack([pose[:, 2].cos(), pose[:, 2].sin()], -1)[:, None]
    poses = torch.cat([pose[:, None, :2] + way, pose[:, None, 2:].expand(-1, NUM_STEPS, -1)], -1)
    motion = torch.zeros(NUM_AGENTS, NUM_STEPS, 3)
    motion[..., 0] = speed[:, None]
    return Scene(
        node_pose=nodes[None],
        node_mask=torch.ones(1, NUM_MAP_TOKENS, 20, dtype=torch.bool),
        map_type=torch.randint(0, 11, (1, NUM_MAP_TOKENS)),
        map_box=torch.tensor([[-500.0, 500.0, -500.0, 500.0]]),
        light_token=torch.randint(0, NUM_MAP_TOKENS, (1, NUM_LIGHTS)),
        light_mask=torch.ones(1, NUM_LIGHTS, dtype=torch.bool),
        light_state=torch.randint(0, 5, (1, NUM_LIGHTS, NUM_STEPS)),
        agent_mask=torch.ones(1, NUM_AGENTS, dtype=torch.bool),
        agent_class=torch.arange(NUM_AGENTS)[None] % 3,
        size=torch.tensor([4.6, 2.0, 1.6]).expand(1, NUM_AGENTS, 3),
        valid=torch.ones(1, NUM_AGENTS, NUM_STEPS, dtype=torch.bool),
        pose=poses[None],
        motion=motion[None],
        origin=torch.zeros(1, 3),
    )


class PublicCode:
    """The public model on the same scene, padded to the slots that its data loader fills."""

    AGENTS, MAP_TOKENS, LIGHTS = 64, 1024, 128

    def __init__(self, folder: Path, scene: Scene):
        sys.path.insert(0, str(folder / "src"))
        from models.traffic_bots import TrafficBots
        from omegaconf import OmegaConf

        config = OmegaConf.load(folder / "configs" / "model" / "sim_agent.yaml")
        settings = {name: value for name, value in config.model.items() if name != "_target_"}
        torch.manual_seed(0)
        self.model = TrafficBots(
            **settings, time_step_gt=90, action_dim=2, tl_mode="lane", navi_mode="dest", navi_dim=-1,
            n_mp_pl_node=20, mp_attr_dim=11, tl_state_dim=5, ag_motion_dim=3, ag_attr_dim=6,
        ).eval()  # fmt: skip
        self.latents = self.model.latent_encoder.out_dim

        def padded(values: Tensor, count: int) -> Tensor:
            return torch.cat([values, values.new_zeros(1, count - values.shape[1], *values.shape[2:])], 1)

        one_hot = torch.nn.functional.one_hot
        self.nodes = padded(scene.node_mask, self.MAP_TOKENS), padded(scene.node_pose, self.MAP_TOKENS)
        self.map_type = padded(one_hot(scene.map_type, 11), self.MAP_TOKENS)
        self.light_token = padded(scene.light_token, self.LIGHTS)
        self.light_mask, self.light_pose = padded(scene.light_mask, self.LIGHTS), padded(scene.light_pose, self.LIGHTS)
        self.light_state = padded(one_hot(scene.light_state, 5).float(), self.LIGHTS)  # [1, L, 91, 5]
        self.valid, self.pose = padded(scene.valid, self.AGENTS), padded(scene.pose, self.AGENTS)
        self.motion = padded(scene.motion, self.AGENTS)
        self.agent_type = padded(one_hot(scene.agent_class, 3).bool(), self.AGENTS)
        self.attributes = padded(torch.cat([scene.size, one_hot(scene.agent_class, 3).float()], -1), self.AGENTS)

    def encode_map(self) -> dict[str, Tensor]:
        """Map tokens."""
        mask, pose = self.nodes
        return self.model.mp_encoder(mask, self.map_type.float(), pose, self.map_type.bool())

    def begin(self, map_tokens: dict[str, Tensor]) -> dict[str, Tensor]:
        """Light tokens, and an empty history."""
        self.model.init()
        return self.model.tl_encoder.pre_compute(
            tl_valid=self.light_mask, tl_attr=self.light_token, tl_pose=self.light_pose, **map_tokens
        )

    def decide(self, step: int, map_tokens: dict[str, Tensor], light_tokens: dict[str, Tensor], latent: Tensor):
        """Distributions of actions and of the lights' next states, as in the closed loop."""
        exists = self.valid[:, :, step]
        destination = torch.zeros(exists.shape, dtype=torch.long)
        return self.model(
            exists, self.pose[:, :, step], self.motion[:, :, step], self.attributes, self.agent_type, latent, exists,
            destination, exists, True, self.light_state[:, :, step], light_tokens, map_tokens,
        )  # fmt: skip

    def train(self, num_steps: int) -> None:
        """Map, posterior and some steps of the closed loop, forward and backward; the reward is left out."""
        map_tokens = self.encode_map()
        light_tokens = self.begin(map_tokens)
        posterior = self.model.latent_encoder(
            ag_valid=self.valid, ag_attr=self.attributes, ag_motion=self.motion, ag_pose=self.pose,
            ag_type=self.agent_type, tl_state=self.light_state, mp_tokens=map_tokens, tl_tokens=light_tokens,
            posterior=True,
        )  # fmt: skip
        latent = posterior.distribution.rsample()
        loss = latent.square().mean()
        with torch.no_grad():
            for step in range(10):  # windows are full from then on, as ours are
                self.decide(step, map_tokens, light_tokens, latent)
        for step in range(10, 10 + num_steps):
            action, light = self.decide(step, map_tokens, light_tokens, latent)
            loss = loss + action.mean.square().mean() + light.logits.square().mean()
        loss.backward()


def peak_gib() -> float:
    """Largest resident memory of this process so far."""
    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="leave the training step out")
    parser.add_argument("--public", type=Path, help="checkout of the public code, measured in turns with ours")
    arguments = parser.parse_args()
    torch.set_num_threads(1)
    scene = random_scene()
    policy = TrafficBotsPolicy(TrafficBotsConfig()).eval()
    public = PublicCode(arguments.public, scene) if arguments.public else None
    ours: dict[str, float] = {}
    theirs: dict[str, float] = {}
    with torch.no_grad():
        context = policy.encode_scene(scene)
        if public:
            map_tokens = public.encode_map()
            light_tokens = public.begin(map_tokens)
            latent = torch.randn(1, public.AGENTS, public.latents)
            for step in range(10):  # a full history
                public.decide(step, map_tokens, light_tokens, latent)
        for _ in range(3):  # in turns: other work on the machine meets both
            least(ours, "map, once", lambda: policy.network.map(scene, scene.node_mask))
            least(ours, "map, and lights of all 80 decisions", lambda: policy.encode_scene(scene))
            for num_rollouts in (1, 4):
                state = policy.begin(context, num_rollouts, None, torch.rand(1, num_rollouts, NUM_AGENTS, 17))

                def decide(state=state) -> None:
                    # A fresh memo, so that the network runs.
                    fresh = replace(state, memo=Memo())
                    policy.advance(context, fresh, policy.decide(context, fresh).mean)

                for _ in range(3):
                    least(ours, f"decision, {num_rollouts} rollouts", decide)
            if public:
                least(theirs, "map, once", public.encode_map)
                for step in range(10, 13):
                    least(
                        theirs,
                        "decision, 1 rollouts",
                        lambda step=step: public.decide(step, map_tokens, light_tokens, latent),
                    )
    memory = {}
    if not arguments.quick:
        policy.train()
        labels = torch.randint(0, NUM_MAP_TOKENS, (1, NUM_AGENTS))
        labels = torch.where(scene.map_type.gather(1, labels) == 4, labels, -1)
        draws = draw_training(scene, policy.config, 0.3, hide=True)

        def train() -> None:
            compute_scene_loss(policy.network, scene, labels, scene.agent_mask, draws).loss.backward()

        before = peak_gib()
        least(ours, "training step", train)
        memory["ours"] = peak_gib() - before
        if public:
            public.model.train()
            times = {}
            for steps in (2, PUBLIC_TRAINING_STEPS):
                before = peak_gib()
                least(times, str(steps), lambda steps=steps: public.train(steps))
                memory[f"public code, {steps} steps"] = peak_gib() - before
            one = (times[str(PUBLIC_TRAINING_STEPS)] - times["2"]) / (PUBLIC_TRAINING_STEPS - 2)
            theirs["training step"] = times["2"] + (NUM_DECISIONS - 2) * one
    print("| | ours (CPU s) | public code (CPU s) | ratio |\n|---|--:|--:|--:|")
    for name, seconds in ours.items():
        other = theirs.get(name)
        print(f"| {name} | {seconds:.3f} |" + (f" {other:.3f} | {seconds / other:.2f} |" if other else " | |"))
    print("memory on top of what was used before, GiB:", {name: round(value, 2) for name, value in memory.items()})


def least(found: dict[str, float], name: str, call: Callable[[], object]) -> None:
    """Keep the least CPU time of a call under its name."""
    start = time.process_time()
    call()
    taken = time.process_time() - start
    found[name] = min(taken, found.get(name, taken))


if __name__ == "__main__":
    main()

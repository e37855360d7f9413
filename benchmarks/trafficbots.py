"""CPU time and memory of TrafficBots V1.5 at its default size, one thread, on a scene of random tensors.

    OMP_NUM_THREADS=1 python benchmarks/trafficbots.py [--quick]

The sizes are those at which the public code (zhejz/TrafficBotsV1.5 at c87329d) was measured: 40 agents, 700 map tokens,
24 lights. Its numbers are printed beside; they were taken on another machine (one thread of an EPYC core), so the ratio
of two machines is in the ratio of the two columns.
"""

import argparse
import resource
import time
from collections.abc import Callable
from dataclasses import replace

import torch

from rlftsim.policies.trafficbots.config import TrafficBotsConfig
from rlftsim.policies.trafficbots.imitation import draw_training, loss_of_scene
from rlftsim.policies.trafficbots.policy import TrafficBotsPolicy
from rlftsim.policies.trafficbots.scene import Scene

NUM_AGENTS, NUM_MAP_TOKENS, NUM_LIGHTS, NUM_STEPS = 40, 700, 24, 91
PUBLIC_S = {"map, once": 1.0, "decision, one rollout": 0.14, "decision, four rollouts": 0.56, "training step": 70.0}
PUBLIC_TRAINING_GIB = 17.0


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


def cpu_seconds(call: Callable[[], object], repeats: int) -> float:
    """Least CPU time of several calls."""
    taken = []
    for _ in range(repeats):
        start = time.process_time()
        call()
        taken.append(time.process_time() - start)
    return min(taken)


def main() -> None:
    """Measure, and print a table."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--quick", action="store_true", help="leave the training step out")
    quick = parser.parse_args().quick
    torch.set_num_threads(1)
    scene = random_scene()
    history = replace(scene, light_state=scene.light_state[..., :11])
    policy = TrafficBotsPolicy(TrafficBotsConfig()).eval()
    found = {}
    with torch.no_grad():
        found["map, once"] = cpu_seconds(lambda: policy.network.map(scene, scene.node_mask), 3)
        start = time.process_time()
        context = policy.encode_scene(history)
        encoding = time.process_time() - start
        for num_rollouts, name in ((1, "one rollout"), (4, "four rollouts")):
            state = policy.begin(context, num_rollouts, None, torch.rand(1, num_rollouts, NUM_AGENTS, 17))

            def decide(state=state) -> None:
                # A fresh memo, so that the network runs.
                fresh = replace(state, memo=type(state.memo)())
                policy.advance(context, fresh, policy.decide(context, fresh).mean)

            found[f"decision, {name}"] = cpu_seconds(decide, 5)
    if not quick:
        policy.train()
        labels = torch.randint(0, NUM_MAP_TOKENS, (1, NUM_AGENTS))
        labels = torch.where(scene.map_type.gather(1, labels) == 4, labels, -1)
        draws = draw_training(scene, policy.config, 0.3, hide=True)

        def train() -> None:
            loss_of_scene(policy.network, policy.config, scene, labels, scene.agent_mask, draws).loss.backward()

        found["training step"] = cpu_seconds(train, 1)
    print(f"map and lights of all 80 decisions, once: {encoding:.2f} s")
    print("| | ours (CPU s) | public code, other machine (CPU s) | ratio |\n|---|--:|--:|--:|")
    for name, seconds in found.items():
        print(f"| {name} | {seconds:.3f} | {PUBLIC_S[name]:g} | {seconds / PUBLIC_S[name]:.2f} |")
    peak = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss / 2**20
    print(f"peak memory {peak:.2f} GiB; the public code's training step {PUBLIC_TRAINING_GIB:g} GiB")


if __name__ == "__main__":
    main()

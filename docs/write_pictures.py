"""Write docs/traffic.webp, the film at the top of README and home page, and docs/demo/live.html, the demo page.

    python docs/write_pictures.py

Synthetic scenarios and the model that ships, seed 0: the same files every time on the same machine.
"""

from pathlib import Path

import rlftsim as rs
from rlftsim.viewer.film import to_film
from rlftsim.viewer.page import Animation, Panel, write_page
from rlftsim.viewer.scene import build_scene, logged_trajectories, rollout_trajectories

DOCS = Path(__file__).resolve().parent
FILM_SCENARIO = "9d639de83d6f5239"
VARIANTS = {"demo-base": rs.Sampling(), "demo-base, temperature 0.5": rs.Sampling(temperature=0.5)}
NUM_ROLLOUTS = 32
SHOWN_ROLLOUTS = 2
NUM_SCENARIOS = 6


def write_film(path: Path) -> None:
    """Film of one scenario: the log and two futures, 5 frames a second."""
    scenario = rs.load_dataset("synthetic", "validation")[FILM_SCENARIO]
    scene, rollouts = build_scene(scenario), rs.simulate("demo-base", scenario, num_rollouts=2, seed=0)
    futures = [rollout_trajectories(scenario, rollouts.select(slice(n, n + 1)), row=0) for n in range(2)]
    panels = [Panel("logged", logged_trajectories(scenario))]
    panels += [Panel(f"simulated, future {n + 1}", motion) for n, motion in enumerate(futures)]
    to_film(path, Animation(f"Scenario {FILM_SCENARIO}", scene, panels), every=2, dots_per_inch=70)


def write_demo(path: Path) -> None:
    """Page of the held-out scenarios with the fewest map points, each logged and simulated in two ways."""
    data = rs.load_dataset("synthetic", "validation")
    policy = rs.load_policy("demo-base")
    chosen = sorted(range(len(data)), key=lambda i: data.index["num_map_points"][i].as_py())[:NUM_SCENARIOS]
    animations = []
    for scenario in data[chosen]:
        scene = build_scene(scenario)
        panels, scores = [Panel("logged", logged_trajectories(scenario).with_overlaps(scene.agents))], []
        for name, sampling in VARIANTS.items():
            rollouts = rs.simulate(policy, scenario, num_rollouts=NUM_ROLLOUTS, seed=0, sampling=sampling)
            motion = rollout_trajectories(scenario, rollouts, row=0, max_rollouts=SHOWN_ROLLOUTS)
            panels.append(Panel(name, motion.with_overlaps(scene.agents)))
            scores.append(f"{name}: {rs.score(scenario, rollouts)}")
        title = f"Scenario {scenario.scenario_id}"
        animations.append(Animation(title, scene, panels, caption=". ".join(scores)))
    caption = (
        f"The {NUM_SCENARIOS} of {len(data)} held-out synthetic scenarios with the smallest maps, the first "
        f"{SHOWN_ROLLOUTS} of {NUM_ROLLOUTS} rollouts. Scores are of all {NUM_ROLLOUTS}, metric 2025; synthetic "
        "traffic says nothing about real traffic."
    )
    write_page(path, "Six scenarios, simulated in advance", animations, caption=caption)


if __name__ == "__main__":
    write_film(DOCS / "traffic.webp")
    (DOCS / "demo").mkdir(exist_ok=True)
    write_demo(DOCS / "demo" / "live.html")

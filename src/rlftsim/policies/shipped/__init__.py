"""Models that ship with the package, CC0, loaded by name: `load_policy("demo-base")`.

Their weights are stored in float16 and computed with in float32. A README in each folder says what a model was trained
on and how it scores.
"""

from pathlib import Path

from safetensors.torch import load_file

from rlftsim.policies.checkpoint import load_strictly
from rlftsim.policies.smart.policy import SmartPolicy

FOLDER = Path(__file__).parent


def demo_base() -> SmartPolicy:
    """SMART of the demo's size, pre-trained on synthetic scenarios: it reads the map, and is not fine-tuned."""
    return SmartPolicy.from_pretrained(FOLDER / "demo-base")


def demo_tuned() -> SmartPolicy:
    """`demo_base` after MLOO that holds speed: fewer collisions and less driving off the road, as fast as before."""
    return _with_weights(demo_base(), FOLDER / "demo-tuned" / "model.safetensors")


def demo_goals() -> SmartPolicy:
    """`demo_base` with a trained goal encoder: 192 weights more, and without goals the same to the last bit."""
    policy = demo_base().with_goal_conditioning("indication", logit_bias=True)
    return _with_weights(policy, FOLDER / "demo-goals" / "goals.safetensors")


def _with_weights(policy: SmartPolicy, file: Path) -> SmartPolicy:
    """The policy, with the weights that a file has."""
    load_strictly(policy.network, policy.network.state_dict() | load_file(file), source=str(file))
    return policy

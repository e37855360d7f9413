"""Models that ship with the package, CC0, loaded by name: `load_policy("demo-base")`.

Their weights are stored in float16 and computed with in float32. A README in each folder says what a model was trained
on and how it scores.
"""

from pathlib import Path

from rlftsim.policies.smart.policy import SmartPolicy


def demo_base() -> SmartPolicy:
    """SMART of the demo's size, pre-trained on 2 560 synthetic scenarios: it reads the map, and is not fine-tuned."""
    return SmartPolicy.from_pretrained(Path(__file__).parent / "demo-base")

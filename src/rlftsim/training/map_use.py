"""Map use: the nats that a model's predictions of logged tokens lose when the whole map is moved far away.

A model with a low loss may still not read the map: most tokens go straight on or stand still, which history alone
predicts. Turning tokens tell. Vehicles only, since vehicles follow lanes.
"""

from dataclasses import dataclass, replace
from typing import Any, cast

import torch
from jaxtyping import Bool, Float
from torch import Tensor
from torch.nn import functional

from rlftsim.rollout.policy import Prediction, PretrainablePolicy
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.tokens.vocabulary import CLASS_NAMES, Vocabulary

AWAY_M = 5000.0
"""The map is moved by this along both axes: farther than any model looks."""
TURNING_RAD = 0.06
"""A token that changes the heading by more than this in its half second is a turning one."""


@dataclass(frozen=True, eq=False)
class MapUse:
    """Losses of vehicle tokens with and without the map, as sums that add up over batches and processes."""

    sums: Float[Tensor, "2 3"]
    """Rows: all tokens, turning tokens. Columns: their number, loss with the map, loss without it (nats), float64."""

    @classmethod
    def zero(cls, device: torch.device | str = "cpu") -> "MapUse":
        """Sums of no token."""
        return cls(torch.zeros(2, 3, dtype=torch.float64, device=device))

    def __add__(self, addend: "MapUse") -> "MapUse":
        return MapUse(self.sums + addend.sums)

    def to_metrics(self, prefix: str = "") -> dict[str, float]:
        """Mean loss and map use (loss without minus with the map), nats per token, of all and of turning tokens.

        NaN where there was no such token.

        Args:
            prefix: put before every name.
        """
        count, with_map, without = self.sums.T  # [2] each
        values = {"loss": with_map / count, "map_use": (without - with_map) / count}
        return {
            f"{prefix}{name}{suffix}": float(value[row])
            for name, value in values.items()
            for row, suffix in enumerate(("", "_turning"))
        }


def predicts_tokens(policy: object) -> bool:
    """True for a policy with measurable map use: predictions of the tokens of a vocabulary along logged tracks."""
    return isinstance(policy, PretrainablePolicy) and isinstance(getattr(policy, "vocabulary", None), Vocabulary)


@torch.no_grad()
def measure_map_use(policy: PretrainablePolicy, batch: ScenarioBatch) -> MapUse:
    """Cross-entropy of the logged vehicles' tokens, with the map and with the map 5 km away.

    Args:
        policy: Policy with a vocabulary, in evaluation mode.
        batch: Scenarios with futures, on the policy's device.
    """
    shifted = []
    for scenario in batch.scenarios:
        points = scenario.map_features.points + AWAY_M
        shifted.append(replace(scenario, map_features=replace(scenario.map_features, points=points)))
    losses, turning = _vehicle_losses(policy, batch)
    without, _ = _vehicle_losses(policy, collate(shifted).to(batch.device))
    columns = torch.stack([torch.ones_like(losses), losses, without], -1).double()  # [r, 3]
    return MapUse(torch.stack([columns.sum(0), columns[turning].sum(0)]))


def _vehicle_losses(policy: PretrainablePolicy, batch: ScenarioBatch) -> tuple[Float[Tensor, "r"], Bool[Tensor, "r"]]:
    """Cross-entropy of each predicted vehicle token, nats; and True where the token turns."""
    vocabulary: Vocabulary = cast(Any, policy).vocabulary
    predicted: Prediction = policy.teacher_forced(batch, batch.agent_mask)
    vehicle = CLASS_NAMES.index("vehicle")
    rows = predicted.target_mask & (predicted.class_id == vehicle)
    target = predicted.target[rows]
    turn = vocabulary.poses[vehicle, target, -1, 2]  # [r], heading at the end of the token, rad
    return functional.cross_entropy(predicted.logits[rows], target, reduction="none"), turn.abs() > TURNING_RAD

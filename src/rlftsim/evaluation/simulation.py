"""What rollouts in files depend on: policy, scenarios and settings."""

from collections.abc import Sequence
from dataclasses import asdict, dataclass
from typing import Any

from rlftsim.goals.goals_file import GoalsFile
from rlftsim.rollout.entries import identify_entries
from rlftsim.rollout.fingerprint import fingerprint_policy
from rlftsim.rollout.policy import Policy, Sampling
from rlftsim.scenario.dataset import ScenarioDataset


@dataclass(frozen=True, eq=False)
class Simulation:
    """Input of a simulation; is handed to worker processes."""

    policy: Policy
    dataset: ScenarioDataset
    scenario_ids: Sequence[str]
    """In the order of the work."""
    num_rollouts: int
    num_steps: int
    seed: int
    sampling: Sampling
    goals: GoalsFile
    model: str
    """Name of the model, for people who read the description."""
    entries: str | None = None
    """Name or file of the model of who enters; None = nobody enters or leaves."""

    def describe(self) -> dict[str, Any]:
        """Values on which the rollouts depend, in types of JSON, and the name of the model, which may change."""
        identity = {
            "model": self.model,
            "policy": fingerprint_policy(self.policy),
            "data": self.dataset.fingerprint,
            "seed": self.seed,
            "num_rollouts": self.num_rollouts,
            "num_steps": self.num_steps,
            "sampling": asdict(self.sampling),
        }
        goal_entries = [[goal.scenario_id, goal.agent_id, goal.x, goal.y] for goal in self.goals.goals]
        entering = {} if self.entries is None else {"entries": identify_entries(self.entries)}
        return identity | ({"goals": goal_entries} if goal_entries else {}) | entering

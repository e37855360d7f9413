"""Variants of a run: each model with the goals, and goal-conditioned models also without, on the same seeds."""

from collections.abc import Iterator
from dataclasses import dataclass

from rlftsim.goals.goals_file import GoalEntry
from rlftsim.goals.placement import goals_of_batch
from rlftsim.goals.types import Goals
from rlftsim.scenario.batch import ScenarioBatch, collate
from rlftsim.scenario.types import count_steps
from rlftsim.studio import Refusal
from rlftsim.studio.bodies import USUAL_SECONDS, CheckBody, RunBody
from rlftsim.studio.session import Session


@dataclass(frozen=True)
class Variant:
    """A model, with or without goals, under the settings of a run."""

    model: str
    fingerprint: str
    split: str
    scenario: str
    seed: int
    temperature: float
    top_k: int | None
    seconds: int
    guidance: float = 1.0
    goals: tuple[GoalEntry, ...] = ()

    @property
    def num_steps(self) -> int:
        """Number of simulated steps."""
        return count_steps(float(self.seconds))

    def goals_in(self, batch: ScenarioBatch) -> Goals | None:
        """Goals in the frame of a batch of the scenario; None without goals."""
        return goals_of_batch(self.goals, batch) if self.goals else None


def build_variants(session: Session, body: RunBody) -> Iterator[Variant]:
    """Variants of a run: goal-conditioned models with the goals and without, the remaining models without.

    Args:
        session: Session with the scenarios and models that the request names.
        body: Request for a run: scenario, models, goals and sampling.

    Raises:
        Refusal: An unknown scenario or model, or goals or guidance that would have no effect.
        DataError: An impossible goal, or two goals of the same agent.
    """
    scenario = session.scenario(body.split, body.scenario)
    models = [session.model(name) for name in dict.fromkeys(body.models)]
    goals = to_goal_entries(body)
    goals_of_batch(goals, collate([scenario]))  # refuses impossible ones
    if goals and not any(model.takes_goals for model in models):
        raise Refusal(
            f"{', '.join(m.name for m in models)} is not goal-conditioned, {len(goals)} goals would have no effect.",
            hint="Take a model that was fine-tuned with goals (docs/goals.md), or remove the goals.",
        )
    if goals and body.seconds != USUAL_SECONDS:
        raise Refusal(
            f"goals are due after {USUAL_SECONDS} seconds, not after {body.seconds}.",
            hint=f"Simulate {USUAL_SECONDS} seconds, or remove the goals.",
        )
    settings = (body.split, body.scenario, body.seed, body.temperature, body.top_k, body.seconds)
    for model in models:
        if goals and model.takes_goals:
            guidance = body.guidance if model.can_guide else 1.0
            yield Variant(model.name, model.fingerprint, *settings, guidance=guidance, goals=goals)
        yield Variant(model.name, model.fingerprint, *settings)


def to_goal_entries(body: RunBody | CheckBody) -> tuple[GoalEntry, ...]:
    """Goals of a request as entries of a goals file, in millimeters.

    Raises:
        Refusal: An agent has two goals.
    """
    entries = tuple(GoalEntry(body.scenario, g.agent, round(g.x, 3), round(g.y, 3), g.label) for g in body.goals)
    agents = [entry.agent_id for entry in entries]
    twice = next((agent for agent in agents if agents.count(agent) > 1), None)
    if twice is not None:
        raise Refusal(f"agent {twice} has two goals: keep one of them.")
    return entries


def free_variant(variants: tuple[Variant, ...], index: int) -> int:
    """Index of the variant of the same model without goals, possibly `index`.

    Args:
        variants: All variants of a run; each model has a variant without goals.
        index: Index of a variant in the run.
    """
    model = variants[index].model
    return next(i for i, variant in enumerate(variants) if variant.model == model and not variant.goals)

"""Page of failures: films of the most probable, what would have avoided them, and whether the traffic was usual."""

from collections.abc import Sequence
from dataclasses import dataclass, replace
from html import escape
from pathlib import Path

import numpy as np
import torch
from jaxtyping import Float
from rich.table import Table

from rlftsim.envs.actions import MAX_BRAKING_MPS2
from rlftsim.envs.dangers import StepView
from rlftsim.envs.drivers import Driver
from rlftsim.envs.episode import Episode, EpisodeState
from rlftsim.envs.failure_study import ScenarioEstimate, Study, StudyConfig
from rlftsim.envs.failures import DrivenPath, Failure, FailureChain, choose_failures
from rlftsim.envs.record import Record
from rlftsim.envs.result import build_animation
from rlftsim.jobs.files import write_text
from rlftsim.scenario.types import CURRENT_STEP, STEP_S
from rlftsim.viewer.page import animation_html, page_html, read_asset

OTHER_PLANNERS = ("constant_velocity", "idm", "pdm")
"""Planners that drive among the same dice, to tell whether a failure could be avoided."""
EARLIER_STEPS = 20
"""Full braking begins so many steps before the event."""
BEFORE_STEPS, AFTER_STEPS = 30, 5
"""Steps of a film before and after the event."""


@dataclass(frozen=True, eq=False)
class Exhibit:
    """A failure as the page shows it."""

    number: int
    """Row of failures.parquet."""
    failure: Failure
    record: Record
    avoided_by: tuple[str, ...]
    """Planners, and full braking, with which the event does not happen among the same dice."""
    rank: float
    """Fraction of undisturbed episodes whose traffic is less probable, up to the event; NaN without a traffic model."""

    def facts(self) -> dict[str, str]:
        """What is known about the failure, in words."""
        failure = self.failure
        contact = f"{failure.contact.replace('_', ' ')}, {'planner' if failure.at_fault else 'other'} at fault"
        return {
            "scenario": failure.scenario_id,
            "probability": f"{failure.probability:.2g} in its scenario",
            "at": f"{failure.step * STEP_S:.1f} s",
            "contact": f"{contact}, closing at {failure.closing_mps:.1f} m/s" if failure.contact else "none",
            "avoided by": ", ".join(self.avoided_by) or "none that was tried",
            "ordinary traffic?": "no traffic model" if np.isnan(self.rank)
            else f"more probable than {self.rank:.0%} of undisturbed episodes",
            "again": f"rlftsim failures show FOLDER {self.number}",
        }  # fmt: skip


def build_exhibit(config: StudyConfig, number: int, failure: Failure) -> Exhibit:
    """A failure, driven again, and what others would have done.

    Args:
        config: Settings of the study.
        number: Row of failures.parquet.
        failure: Failure of that row.
    """
    chain, log = config.chain(failure.scenario_id), TrafficLog()
    record = chain.run_again(failure, log.observe).record
    others = [name for name in OTHER_PLANNERS if name != config.planner]
    avoided_by = [
        name for name in others
        if not _happens(config.chain(failure.scenario_id, planner=name), failure.dice)
    ]  # fmt: skip
    if not _happens(chain, failure.dice, brake(record, failure.step)):
        avoided_by.append(f"full braking {EARLIER_STEPS * STEP_S:g} s earlier")
    undisturbed = TrafficLog()
    dice = np.repeat(np.arange(config.pilot)[:, None], chain.num_blocks, 1)
    config.chain(failure.scenario_id).run(dice, observe=undisturbed.observe)
    rank = float(np.mean(undisturbed.until(failure.step)[: config.pilot] < log.until(failure.step)[0]))
    is_ranked = bool(log.log_prob)
    return Exhibit(number, failure, record, tuple(avoided_by), rank if is_ranked else np.nan)


class TrafficLog:
    """Log-probability of the decisions of all agents that follow the traffic model, as episodes side by side go on."""

    def __init__(self) -> None:
        self.steps: list[int] = []
        self.log_prob: list[np.ndarray] = []

    def observe(self, episode: Episode, state: EpisodeState) -> None:
        """Add the decision of the running block, once."""
        world, block = episode.world, state.world.block
        if world.policy is None or block is None or block.decision is None:
            return
        begun = (state.world.step - 1) // world.policy.steps_per_decision * world.policy.steps_per_decision
        if begun in self.steps:
            return
        with torch.no_grad():
            distribution = world.policy.decide(block.context, block.policy_state)
            log_prob = distribution.log_prob(block.decision, world.sampling)[:, 0].double().cpu().numpy()
        self.steps.append(begun)
        self.log_prob.append(np.where(world.drivers == Driver.POLICY, log_prob, 0.0).sum(1))

    def until(self, step: int) -> Float[np.ndarray, "B"]:
        """Sum over the decisions before a step."""
        return np.sum([value for begun, value in zip(self.steps, self.log_prob) if begun < step] or [[0.0]], axis=0)


def brake(record: Record, step: int) -> Float[np.ndarray, "T 5"]:
    """Motion of the planner's agent that leaves its path at no point, but brakes fully before an event.

    Args:
        record: Episode in which the event happens.
        step: Step of the event.
    """
    motion, begin = record.agent_motion.copy(), max(step - EARLIER_STEPS, 0)
    path = motion[begin:]
    reached = np.concatenate([[0.0], np.cumsum(np.hypot(*np.diff(path[:, :2], axis=0).T) + 1e-9)])
    speed = float(np.hypot(*path[0, 3:]))
    time = np.minimum(STEP_S * np.arange(len(path)), speed / MAX_BRAKING_MPS2)
    driven = speed * time - MAX_BRAKING_MPS2 / 2 * time**2
    heading = np.interp(driven, reached, np.unwrap(path[:, 2]))
    x, y = (np.interp(driven, reached, path[:, axis]) for axis in (0, 1))
    left = speed - MAX_BRAKING_MPS2 * time
    motion[begin:] = np.stack([x, y, heading, left * np.cos(heading), left * np.sin(heading)], -1)
    return motion[1:]


def _happens(chain: FailureChain, dice: Sequence[int], imposed: Float[np.ndarray, "T 5"] | None = None) -> bool:
    """True if the event happens with some dice; of an imposed motion, or as the chain's planner drives."""
    if imposed is None:
        return bool((chain.run(np.array([dice]))[0][0].danger >= 0).any())
    worst = -np.inf

    def observe(episode: Episode, state: EpisodeState) -> None:
        nonlocal worst
        worst = max(worst, chain.event.danger(StepView(episode, state, 0)))

    numbers = np.array(dice)
    parent = DrivenPath(numbers, imposed, np.full(len(imposed) + 1, np.nan), (), ())
    chain.run(numbers[None], np.array([chain.num_blocks]), [parent], observe)
    return worst >= 0


def format_study(study: Study) -> Table:
    """Table of the scenarios, the most probable event first, for `print_wide`."""
    event = study.config.event.replace("_", " ")
    table = Table(*HEADINGS, title=f"{event} of {study.config.planner} within 8 s")
    for row in study_rows(study):
        table.add_row(*row)
    return table


HEADINGS = ("scenario", "P", "95 %", "repeats", "Monte Carlo needs", "contact", "at fault")


def study_rows(study: Study) -> list[tuple[str, ...]]:
    """Cells of the table: a row per scenario, the most probable event first."""
    return [_cells(estimate) for estimate in sorted(study.scenarios, key=lambda estimate: -estimate.probability)]


def _cells(estimate: ScenarioEstimate) -> tuple[str, ...]:
    low, high = estimate.interval
    failures = [failure for repeat in estimate.repeats for failure in repeat.failures]
    contacts = sorted({failure.contact for failure in failures if failure.contact})
    weights = np.array([failure.probability for failure in failures])
    at_fault = weights[[failure.at_fault for failure in failures]].sum() / weights.sum() if failures else 0.0
    episodes = estimate.num_monte_carlo
    if not estimate.probability:
        interval = f"< {high:.2g}"
    else:
        interval = f"{low:.2g} to {high:.2g}" if np.isfinite(low) else "one repeat: none"
    return (
        estimate.pilot.scenario_id, f"{estimate.probability:.2g}", interval, str(len(estimate.repeats)),
        f"{episodes:.0f} episodes" if np.isfinite(episodes) else "", ", ".join(contacts).replace("_", " "),
        ("planner" if at_fault == 1 else "others" if at_fault == 0 else f"planner {at_fault:.0%}") if contacts else "",
    )  # fmt: skip


def write_failure_page(study: Study, path: Path, *, limit: int) -> None:
    """Write the page of a study.

    Args:
        study: Estimates and failures.
        path: File to write.
        limit: Largest number of failures with a film.
    """
    failures = study.failures
    shown = choose_failures(failures, limit)
    exhibits = [build_exhibit(study.config, failures.index(failure), failure) for failure in shown]
    cells = "".join(f"<th>{escape(heading)}</th>" for heading in HEADINGS)
    rows = "".join("<tr>" + "".join(f"<td>{escape(cell)}</td>" for cell in row) + "</tr>" for row in study_rows(study))
    title = f"Failures of {study.config.planner}"
    total = study.describe_total().replace("1 000 km", "1\u00a0000\u00a0km")  # no-break spaces
    intro = (
        f"{total}. Traffic: {study.config.traffic}, {study.config.model}. Every film is a sample of the traffic model: "
        "nothing is adversarial."
    )
    body = f'<h1>{escape(title)}</h1><p class="lead">{escape(intro)}</p>' + "\n".join(map(_exhibit_html, exhibits))
    table = f'<div class="table-scroll"><table class="failures-table"><tr>{cells}</tr>{rows}</table></div>'
    problems = "".join(f"<p>Left out: {escape(problem)}</p>" for problem in study.problems.values())
    body += f"<h2>Scenarios</h2>{table}{problems}"
    write_text(path, page_html(title, body, extra_css=read_asset("failures.css")))


def _exhibit_html(exhibit: Exhibit) -> str:
    step, record = exhibit.failure.step, exhibit.record
    animation = build_animation({"planner": record.first(min(step + AFTER_STEPS, record.steps))})
    first_step = CURRENT_STEP + max(step - BEFORE_STEPS, 0)
    facts = exhibit.facts().items()
    terms = "".join(f"<div><dt>{escape(name)}</dt><dd>{escape(text)}</dd></div>" for name, text in facts)
    figure = animation_html(replace(animation, first_step=first_step))
    return f'<section class="failure"><dl class="failure-facts">{terms}</dl>{figure}</section>'

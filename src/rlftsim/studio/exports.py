"""Files below `--out`: goals, rollouts, films, pages and scores. Clients name files, never paths."""

import json
from pathlib import Path

from rlftsim.goals.goals_file import parse_goals, write_goals
from rlftsim.jobs.files import errors_name, write_atomically, write_text
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout.types import write_rollouts
from rlftsim.scenario.batch import collate
from rlftsim.scenario.types import Scenario
from rlftsim.studio import Refusal
from rlftsim.studio.bodies import USUAL_SECONDS, ExportBody, SaveGoalsBody
from rlftsim.studio.runs import Run
from rlftsim.studio.session import Session
from rlftsim.submission.messages import encode_rollouts
from rlftsim.viewer.page import Animation, Panel, write_page
from rlftsim.viewer.scene import SceneMotion, build_scene, logged_trajectories, rollout_trajectories

ENDINGS = {
    "rollouts": "",
    "submission": ".binproto",
    "film-mp4": ".mp4",
    "film-webp": ".webp",
    "page": ".html",
    "scores": ".scores.json",
}
MAX_PAGE_ROLLOUTS = 4


def resolve_path(out: Path, name: str, *, replace: bool) -> Path:
    """Path of a file or folder directly below the folder of exports.

    Args:
        out: Folder of exports; made if missing.
        name: Name of the file with the ending, never a path.
        replace: True allows an existing file, to be replaced.

    Raises:
        DataError: The folder cannot be made.
        Refusal: The path would lie elsewhere, also through a symbolic link (403), or exists already (409).
    """
    path = out / name
    with errors_name(path):
        out.mkdir(parents=True, exist_ok=True)
    if path.is_symlink() or path.resolve().parent != out.resolve():
        raise Refusal(f"{name!r} does not lie below {out}: choose another name.", status=403)
    if path.exists() and not replace:
        raise Refusal(f"{path} exists.", status=409, hint="Choose another name, or replace it.")
    return path


def save_goals(session: Session, body: SaveGoalsBody) -> Path:
    """Write a goals file, whole, with the goals of scenarios that the session's data set lacks.

    Args:
        session: Session with the folder of exports.
        body: Request with the name of the file, without ending, and the text.

    Raises:
        DataError: The text is no goals file, in the words of `rlftsim goals check`.
        Refusal: As `resolve_path`.
    """
    file = parse_goals(body.text, f"{body.name}.json")
    path = resolve_path(session.out, f"{body.name}.json", replace=body.replace)
    write_goals(path, file)
    return path


def export(session: Session, run: Run, body: ExportBody) -> Path:
    """Write rollouts of a run in the form that the request names.

    Args:
        session: Session with the folder of exports and the scenario.
        run: Run with complete rollouts.
        body: Request with form, name of the file, variant, and first rollout of films and pages.

    Raises:
        Refusal: As `resolve_path`, or the rollouts are not complete, or too long for a submission.
        DataError: The file cannot be written.
    """
    rollouts = run.rollouts(body.variant)
    if body.rollout >= run.body.num_rollouts:
        raise Refusal(f"no rollout {body.rollout + 1}: this run has {run.body.num_rollouts}.")
    if body.kind == "submission" and run.body.seconds != USUAL_SECONDS:
        raise Refusal(f"a submission has {USUAL_SECONDS} seconds, these rollouts have {run.body.seconds}.")
    path = resolve_path(session.out, body.name + ENDINGS[body.kind], replace=body.replace)
    scenario = session.scenario(run.body.split, run.body.scenario)
    batch = collate([scenario])
    match body.kind:
        case "rollouts":
            resolve_path(path, f"{scenario.scenario_id}.npz", replace=body.replace)
            (path,) = write_rollouts(path, batch, rollouts)
        case "submission":
            (states,) = states_of_rollouts(batch, rollouts)
            message = encode_rollouts(scenario.scenario_id, states)
            write_atomically(path, lambda temporary: temporary.write_bytes(message))
        case "scores":
            scored = run.score(body.variant)
            write_text(path, json.dumps(scored.to_payload() | scored.explained(), indent=1) + "\n")
        case "page":
            animation = _build_animation(scenario, run, body.rollout, MAX_PAGE_ROLLOUTS)
            write_page(path, animation.title, [animation])
        case _:
            # Not at the top: matplotlib takes half a second, for which the page would wait.
            from rlftsim.viewer.film import to_film

            to_film(path, _build_animation(scenario, run, body.rollout, 1))
    return path


def _build_animation(scenario: Scenario, run: Run, first: int, count: int) -> Animation:
    """Log beside every variant, with `count` rollouts each and the metric's marks where there is a score."""
    scene, rollout_ids = build_scene(scenario), slice(first, first + count)
    # A log without the future would stand beside moving rollouts as an empty panel.
    panels = [Panel("logged", logged_trajectories(scenario).with_overlaps(scene.agents))] if scenario.has_future else []
    for index, variant in enumerate(run.variants):
        scored = run.simulated[index].scored.get((run.body.num_rollouts, run.body.metric))
        if scored is None:
            continue
        motion = rollout_trajectories(scenario, run.rollouts(index).select(rollout_ids), row=0)
        if scored.explanation is not None:
            marks = scored.explanation.rollouts
            flags = (None if values is None else values[rollout_ids] for values in (marks.collides, marks.offroad))
            motion = SceneMotion(motion.position, motion.heading, motion.valid, *flags)
        goals = f", {len(variant.goals)} goals" if variant.goals else ""
        panels.append(Panel(f"{variant.model}{goals}", motion))
    return Animation(f"Scenario {scenario.scenario_id}", scene, panels)

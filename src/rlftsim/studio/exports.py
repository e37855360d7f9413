"""Files below `--out`: goals, rollouts, films, pages and scores. Clients name files, never paths."""

import json
from pathlib import Path

from rlftsim.goals.goals_file import parse_goals, write_goals
from rlftsim.jobs.files import errors_name, write_atomically, write_text
from rlftsim.realism.from_rollouts import states_of_rollouts
from rlftsim.rollout.files import write_rollouts
from rlftsim.scenario.batch import collate
from rlftsim.studio.bodies import ExportBody, SaveGoalsBody
from rlftsim.studio.refusal import Refusal
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


def place_of(out: Path, name: str, *, replace: bool) -> Path:
    """Path of a file or folder directly below the folder of exports.

    Args:
        out: folder of exports; made if missing.
        name: stem and ending.
        replace: True = an existing file may be replaced.

    Raises:
        DataError: the folder cannot be made.
        Refusal: it would lie elsewhere, also through a symbolic link (403), or exists already (409).
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
    """Write a goals file, whole; scenarios that this data set lacks stay in it.

    Args:
        session: with the folder of exports.
        body: name and text.

    Raises:
        DataError: the text is no goals file, in the words of `rlftsim goals check`.
        Refusal: as `place_of`.
    """
    file = parse_goals(body.text, f"{body.name}.json")
    path = place_of(session.out, f"{body.name}.json", replace=body.replace)
    write_goals(path, file)
    return path


def export(session: Session, run: Run, body: ExportBody) -> Path:
    """Write rollouts of a run in some form.

    Args:
        session: with the folder of exports.
        run: that is complete.
        body: form, name, variant.

    Raises:
        Refusal: as `place_of`, or the rollouts are not complete.
        DataError: it cannot be written.
    """
    rollouts = run.rollouts(body.variant)
    if body.rollout >= run.body.num_rollouts:
        raise Refusal(f"no rollout {body.rollout + 1}: this run has {run.body.num_rollouts}.")
    path = place_of(session.out, body.name + ENDINGS[body.kind], replace=body.replace)
    scenario = session.scenario(run.body.split, run.body.scenario)
    batch = collate([scenario])
    match body.kind:
        case "rollouts":
            place_of(path, f"{scenario.scenario_id}.npz", replace=body.replace)
            (path,) = write_rollouts(path, batch, rollouts)
        case "submission":
            (states,) = states_of_rollouts(batch, rollouts)
            message = encode_rollouts(scenario.scenario_id, states)
            write_atomically(path, lambda temporary: temporary.write_bytes(message))
        case "scores":
            scored = run.score(body.variant)
            write_text(path, json.dumps(scored.to_payload() | scored.explained(), indent=1) + "\n")
        case "page":
            write_page(
                path, f"Scenario {scenario.scenario_id}", [_animation(session, run, body.rollout, MAX_PAGE_ROLLOUTS)]
            )
        case _:
            # Not at the top: matplotlib takes half a second, for which the page would wait.
            from rlftsim.viewer.film import to_film

            to_film(path, _animation(session, run, body.rollout, 1))
    return path


def _animation(session: Session, run: Run, first: int, count: int) -> Animation:
    """The log beside every variant, with a few rollouts each and the metric's marks where there is a score."""
    scenario = session.scenario(run.body.split, run.body.scenario)
    scene, chosen = build_scene(scenario), slice(first, first + count)
    # A log without its future would stand beside moving rollouts as an empty panel.
    panels = [Panel("logged", logged_trajectories(scenario).with_overlaps(scene.agents))] if scenario.has_future else []
    for index, variant in enumerate(run.variants):
        scored = run.simulated[index].scored.get((run.body.num_rollouts, run.body.metric))
        if scored is None:
            continue
        explained = scored.explanation
        motion = rollout_trajectories(scenario, run.rollouts(index).select(chosen), row=0)
        if explained is not None:
            marks = explained.rollouts
            motion = SceneMotion(
                motion.position, motion.heading, motion.valid,
                None if marks.collides is None else marks.collides[chosen],
                None if marks.offroad is None else marks.offroad[chosen],
            )  # fmt: skip
        goals = f", {len(variant.goals)} goals" if variant.goals else ""
        panels.append(Panel(f"{variant.model}{goals}", motion))
    return Animation(f"Scenario {scenario.scenario_id}", scene, panels)

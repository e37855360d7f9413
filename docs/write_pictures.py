"""Write the pictures of the site: the film at the top, the demo page, the gallery, the chart of the results.

    python docs/write_pictures.py                     # everything
    python docs/write_pictures.py gallery/planner     # one piece: traffic, demo, results or gallery/NAME

Synthetic scenarios and the models that ship, seed 0: the same files every time on the same machine. The gallery needs
the extra `env`, playwright and a chromium.
"""

import io
import re
import shutil
import subprocess
import sys
import tempfile
import textwrap
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from pathlib import Path

from matplotlib.backends.backend_agg import FigureCanvasAgg
from matplotlib.figure import Figure
from PIL import Image

import rlftsim as rs
from rlftsim.goals.types import PointById
from rlftsim.policies.registry import with_guidance
from rlftsim.viewer.film import to_film
from rlftsim.viewer.page import Animation, Panel, write_page
from rlftsim.viewer.scene import SceneView, build_scene, logged_trajectories, rollout_trajectories

DOCS = Path(__file__).resolve().parent
GALLERY = DOCS / "gallery"
FILM_SCENARIO = "9d639de83d6f5239"
VARIANTS = {"demo-base": "demo-base", "demo-tuned": "demo-tuned"}
NUM_ROLLOUTS = 32
SHOWN_ROLLOUTS = 2
NUM_SCENARIOS = 6


@dataclass(frozen=True)
class Simulated:
    """Rollouts of one panel."""

    model: str = "demo-tuned"
    temperature: float = 1.0
    goals: PointById | None = None
    guidance: float = 1.0

    def rollouts(self, scenario: rs.Scenario, num_rollouts: int) -> rs.Rollouts:
        """Rollouts with seed 0, those of `rlftsim simulate`."""
        policy = with_guidance(rs.load_policy(self.model), self.guidance)
        sampling = rs.Sampling(temperature=self.temperature)
        return rs.simulate(policy, scenario, num_rollouts=num_rollouts, seed=0, goals=self.goals, sampling=sampling)


@dataclass(frozen=True)
class Piece:
    """A piece of the gallery: NAME.webp, for films a page that plays, and commands that show the same."""

    name: str
    title: str
    text: str
    commands: tuple[str, ...]
    write: Callable[[Path], None]
    """Writes the picture; a film writes the page beside it."""
    is_film: bool = True


def close_up(scenario: rs.Scenario, radius: float = 45.0, center: tuple[float, float] | None = None) -> SceneView:
    """Scene around the ego.

    Args:
        scenario: one scenario.
        radius: half of the shown width, meters.
        center: of the picture, world frame, meters; None = the middle of the ego's logged way.
    """
    scene, log = build_scene(scenario), logged_trajectories(scenario)
    way = log.position[0, scene.agents.is_ego][0][log.valid[0, scene.agents.is_ego][0]]  # [steps, 2], map frame
    x, y = center - scenario.origin if center else (way.min(0) + way.max(0)) / 2
    return replace(scene, focus=(float(x), float(y), radius))


def film(
    scenario_id: str,
    panels: Mapping[str, Simulated | None],
    *,
    radius: float = 45.0,
    center: tuple[float, float] | None = None,
) -> Callable[[Path], None]:
    """Writer of a film and its page.

    Args:
        scenario_id: of the held-out synthetic scenarios.
        panels: title -> what is simulated, None = the log.
        radius: as in `close_up`.
        center: as in `close_up`.
    """

    def write(path: Path) -> None:
        scenario = rs.load_dataset("synthetic", "validation")[scenario_id]
        scene, log = close_up(scenario, radius, center), logged_trajectories(scenario)
        motions = {
            title: rollout_trajectories(scenario, simulated.rollouts(scenario, 1), row=0) if simulated else log
            for title, simulated in panels.items()
        }
        shown = [Panel(title, motion.with_overlaps(scene.agents)) for title, motion in motions.items()]
        animation = Animation(f"Scenario {scenario_id}", scene, shown)
        to_film(path, animation, steps_per_frame=2, dots_per_inch=80)
        write_page(path.with_suffix(".html"), animation.title, [animation])

    return write


def drawn(*commands: str, picture: str) -> Callable[[Path], None]:
    """Writer of a picture that commands draw.

    Args:
        commands: run one after the other in an empty folder.
        picture: the file, relative to the folder of the command; a page (.html) is photographed.
    """

    def write(path: Path) -> None:
        with tempfile.TemporaryDirectory() as folder:
            for command in commands:
                words = [sys.executable, "-m", *command.split()]
                subprocess.run(words, cwd=folder, check=True, stdout=subprocess.DEVNULL)
            found = Path(folder) / picture
            if found.suffix == ".webp":
                shutil.copyfile(found, path)
                return
            image = photograph(found) if found.suffix == ".html" else Image.open(found)
            image.convert("RGB").resize((900, round(900 * image.height / image.width))).save(path, quality=75, method=6)

    return write


def photograph(page: Path) -> Image.Image:
    """The first screens of a page."""
    from playwright.sync_api import sync_playwright

    with sync_playwright() as session:
        browser = session.chromium.launch(executable_path=shutil.which("chromium"), args=["--no-sandbox"])
        opened = browser.new_page(viewport={"width": 1000, "height": 1250}, reduced_motion="reduce")
        opened.goto(page.as_uri())
        opened.get_by_text("Which agent").scroll_into_view_if_needed()
        opened.wait_for_timeout(500)
        picture = Image.open(io.BytesIO(opened.screenshot()))
        browser.close()
    return picture


def simulate(model: str, scenario: str, out: str, more: str = " --export page") -> str:
    """Command that simulates a scenario."""
    return f"rlftsim simulate {model} --data synthetic --scenario {scenario} --out {out}{more}"


LEFT, CROWD, WALKERS, CORNER = "e77410beaa9f1e75", "4978b9a8e3f6368b", "1dc59c7592914940", "c7f74c372249ae91"
BRANCH, SEVEN, RISE = "0827749d3c33a3d1", "c4b1a5f56a185145", "7bf0e301b4cd6d1b"
PROPOSE = f"rlftsim goals propose synthetic --scenario {BRANCH} --agent 98 99 --out goals.json --picture goals.png"
AHEAD, RIGHT = (-191.2, -238.1), (-133.5, -185.9)
ASK = " --goal 191={},{} --guidance-scale 3 --export page"
FUTURES = simulate("demo-tuned", SEVEN, "futures", " --picture")
TURN = simulate("demo-goals", BRANCH, "turn", " --goal 99=102.6,76.9 --guidance-scale 3 --picture")
DRIVE = f"rlftsim drive pdm --model demo-tuned --data synthetic --scenario {SEVEN} --out drive --film first"
EXPLAIN = (simulate("demo-tuned", WALKERS, "scored", ""), "rlftsim score scored --data synthetic --explain pages")

PIECES = (
    Piece(
        "left", "A left turn at a light", "Every agent on the right moves by `demo-tuned`, the ego (blue) too.",
        (simulate("demo-tuned", LEFT, "left"),), film(LEFT, {"logged": None, "simulated": Simulated()}),
    ),
    Piece(
        "crowd", "Sixty-nine cars", "The most crowded of the held-out scenarios, most of it parked.",
        (simulate("demo-tuned", CROWD, "crowd"),), film(CROWD, {"logged": None, "simulated": Simulated()}),
    ),
    Piece(
        "walkers", "People on foot", "Eleven pedestrians (discs) and forty-three vehicles; red frames are collisions.",
        (simulate("demo-tuned", WALKERS, "walkers"),), film(WALKERS, {"logged": None, "simulated": Simulated()}),
    ),
    Piece(
        "futures", "Thirty-two futures at once", "Paths of the evaluated agents in 32 rollouts of the same moment.",
        (FUTURES,), drawn(FUTURES, picture=f"futures/{SEVEN}.png"), is_film=False,
    ),
    Piece(
        "maneuvers", "What could they do?",
        "Goals that the lanes allow, for two cars. They go into a goals file, which "
        "`rlftsim simulate --goals` takes.",
        (PROPOSE,), drawn(PROPOSE, picture="goals.png"), is_film=False,
    ),
    Piece(
        "goal", "The same car, two goals",
        "Car 191 is asked to go straight on, and to turn right. The others react, nothing else is changed.",
        tuple(
            simulate("demo-goals", CORNER, out, ASK.format(*goal)) for out, goal in (("ahead", AHEAD), ("right", RIGHT))
        ),
        film(
            CORNER,
            {
                "straight on": Simulated("demo-goals", goals={191: AHEAD}, guidance=3.0),
                "right": Simulated("demo-goals", goals={191: RIGHT}, guidance=3.0),
            },
            center=(-150.0, -200.0),
        ),
    ),
    Piece(
        "turn", "A goal against habit",
        "Car 99 comes at 12 m/s and is asked to turn left. Ten of its 32 futures do so, "
        "3 come within 2 m of the goal.",
        (TURN,), drawn(TURN, picture=f"turn/{BRANCH}.png"), is_film=False,
    ),
    Piece(
        "tuned", "Before and after fine-tuning",
        "Of the 40 held-out scenarios the one where the score rises most, from 0.59 to 0.69 (32 rollouts). The same "
        "random numbers in both.",
        (simulate("demo-base", RISE, "base"), simulate("demo-tuned", RISE, "tuned")),
        film(RISE, {"demo-base": Simulated("demo-base"), "demo-tuned": Simulated()}),
    ),
    Piece(
        "temperature", "Temperature 1 and 0.5", "Below 1 likely motions become likelier: calmer traffic, less variety.",
        (
            simulate("demo-base", CORNER, "warm"),
            simulate("demo-base", CORNER, "cool", " --temperature 0.5 --export page"),
        ),
        film(CORNER, {"temperature 1": Simulated("demo-base"), "0.5": Simulated("demo-base", temperature=0.5)}),
    ),
    Piece(
        "floor", "The floor", "Constant velocity, the simplest simulator, beside `demo-tuned`.",
        (simulate("constant_velocity", LEFT, "floor"),),
        film(LEFT, {"constant velocity": Simulated("constant_velocity"), "demo-tuned": Simulated()}),
    ),
    Piece(
        "planner", "A planner in the loop",
        "A PDM-style planner drives the ego among agents of the model, which answer, and among the logged ones, "
        "which do not.",
        (DRIVE,), drawn(DRIVE, picture=f"drive/{SEVEN}.webp"),
    ),
    Piece(
        "explained", "Where realism is lost", "The score of one scenario by "
        "feature, by agent and by step: a third of the page.",
        EXPLAIN, drawn(*EXPLAIN, picture=f"pages/{WALKERS}.html"), is_film=False,
    ),
)  # fmt: skip


def break_lines(command: str) -> str:
    """A command in lines of at most 80 characters."""
    return " \\\n    ".join(textwrap.wrap(command, 74, break_long_words=False, break_on_hyphens=False))


def gallery_text() -> str:
    """The page of the gallery, Markdown."""
    parts = [
        "# Gallery",
        "Twelve pieces, all of the held-out synthetic scenarios and the models that ship, seed 0; of films the first "
        "rollout. Scenarios were chosen to differ from each other, rollouts were not chosen. Each command shows the "
        "same on your machine; [the demo page](live.md) plays six more. Films that a rule alone chose, of an "
        "experiment with smaller models: [before and after](qualitative/qualitative.md).",
    ]
    for piece in PIECES:
        alternative = f"Film of {piece.title[0].lower()}{piece.title[1:]}" if piece.is_film else piece.title
        play = f" [Open in the player](gallery/{piece.name}.html)." if (GALLERY / f"{piece.name}.html").exists() else ""
        commands = "\n".join(map(break_lines, piece.commands))
        parts += [
            f"## {piece.title}", f"{piece.text}{play}",
            f"![{alternative}](gallery/{piece.name}.webp)",
            f"```sh\n{commands}\n```",
        ]  # fmt: skip
    return "\n\n".join([*parts, "Films and pages are written by `docs/write_pictures.py`."]) + "\n"


def write_film(path: Path) -> None:
    """Film of one scenario: the log and two futures, 5 frames a second."""
    scenario = rs.load_dataset("synthetic", "validation")[FILM_SCENARIO]
    scene, rollouts = close_up(scenario), Simulated().rollouts(scenario, 2)
    futures = [rollout_trajectories(scenario, rollouts.select(slice(n, n + 1)), row=0) for n in range(2)]
    panels = [Panel("logged", logged_trajectories(scenario))]
    panels += [Panel(f"simulated, future {n + 1}", motion) for n, motion in enumerate(futures)]
    to_film(path, Animation(f"Scenario {FILM_SCENARIO}", scene, panels), steps_per_frame=2, dots_per_inch=70)


def write_demo(path: Path) -> None:
    """Page of the held-out scenarios with the fewest map points, each logged and simulated by two models; that in which
    the second gains most comes first."""
    data = rs.load_dataset("synthetic", "validation")
    chosen = sorted(range(len(data)), key=lambda i: data.index["num_map_points"][i].as_py())[:NUM_SCENARIOS]
    animations: list[tuple[float, Animation]] = []
    for scenario in data[chosen]:
        scene = build_scene(scenario)
        panels, scores = [Panel("logged", logged_trajectories(scenario).with_overlaps(scene.agents))], {}
        for name, model in VARIANTS.items():
            rollouts = Simulated(model).rollouts(scenario, NUM_ROLLOUTS)
            motion = rollout_trajectories(scenario, rollouts, row=0, max_rollouts=SHOWN_ROLLOUTS)
            panels.append(Panel(name, motion.with_overlaps(scene.agents)))
            scores[name] = rs.score(scenario, rollouts)
        title, caption = f"Scenario {scenario.scenario_id}", ". ".join(f"{name}: {s}" for name, s in scores.items())
        base, tuned = (float(score.meta_metric) for score in scores.values())
        animations.append((tuned - base, Animation(title, scene, panels, caption=caption)))
    caption = (
        f"The {NUM_SCENARIOS} of {len(data)} held-out synthetic scenarios with the smallest maps, the largest gain "
        f"first, and the first {SHOWN_ROLLOUTS} of {NUM_ROLLOUTS} rollouts. Scores are of all {NUM_ROLLOUTS}, metric "
        "2025; synthetic traffic says nothing about real traffic."
    )
    shown = [animation for _, animation in sorted(animations, key=lambda entry: -entry[0])]
    write_page(path, "Six scenarios, simulated in advance", shown, caption=caption)


def read_gains() -> list[tuple[str, float, float, float]]:
    """Label, difference in RMM and its interval of each row of the tables in docs/results.md."""
    text = (DOCS / "results.md").read_text().replace("−", "-")
    number = r"([+-][\d.]+)"
    gains = []
    for table in re.split(r"^\*\*", text, flags=re.MULTILINE)[1:]:
        data = table.partition(" scenarios × ")[0]
        for method, *values in re.findall(rf"^\| (.+?) \| .+? \| {number} \[{number}, {number}\]", table, re.MULTILINE):
            gains.append((f"{method.replace('`', '')}: {data}", *map(float, values)))
    return gains


def draw_gains(path: Path) -> None:
    """Chart of the gains in docs/results.md with their intervals."""
    gains = read_gains()[::-1]
    figure = Figure(figsize=(9, 3.4), layout="constrained")
    axes = figure.add_subplot()
    for row, (_, gain, low, high) in enumerate(gains):
        axes.errorbar(gain, row, xerr=[[gain - low], [high - gain]], fmt="o", color="#1f6feb", capsize=4)
    axes.axvline(0, color="0.5", linewidth=1)
    axes.set_yticks(range(len(gains)), [label for label, *_ in gains])
    axes.set_xlabel("gain in RMM over the base, 95 % interval")
    axes.grid(axis="x", color="0.9")
    axes.spines[["top", "right", "left"]].set_visible(False)
    FigureCanvasAgg(figure).print_figure(path, dpi=110, format="webp", pil_kwargs={"lossless": True, "method": 6})


def main() -> None:
    """Write the named pictures, or all, and the page of the gallery."""
    writers = {
        "traffic": lambda: write_film(DOCS / "traffic.webp"),
        "demo": lambda: write_demo(DOCS / "demo/live.html"),
        "results": lambda: draw_gains(DOCS / "results.webp"),
    }
    for piece in PIECES:
        writers[f"gallery/{piece.name}"] = lambda piece=piece: piece.write(GALLERY / f"{piece.name}.webp")
    for folder in (GALLERY, DOCS / "demo"):
        folder.mkdir(exist_ok=True)
    for name in sys.argv[1:] or writers:
        writers[name]()
        print(name, flush=True)
    (DOCS / "gallery.md").write_text(gallery_text())


if __name__ == "__main__":
    main()

"""Times, frame rates and memory of the goal studio in Chromium, and the pictures and the film of docs/studio.md.

    python benchmarks/studio.py --model runs/goals --out studio_bench [--pictures docs/studio]

Prints a JSON line for each measurement. Needs the extra `studio`, playwright and a chromium.
"""

import argparse
import io
import json
import os
import shutil
import signal
import subprocess
import sys
import tempfile
import time
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from PIL import Image
from playwright.sync_api import Page, sync_playwright

from rlftsim.scenario.dataset import write_dataset
from rlftsim.scenario.open import open_dataset
from rlftsim.scenario.types import MapFeatures, Tracks

ARGUMENTS = ["--no-sandbox", "--disable-gpu", "--enable-precise-memory-info", "--js-flags=--expose-gc"]
LOADS = "studio.state.scene && studio.state.total > 0"
OVER = "!studio.state.isRunning && document.getElementById('run-status').dataset.over === studio.state.run"
EGO = "studio.state.scene.agents.find((agent) => agent[4] === 2)[0]"
FILM_SIZE, FRAMES_PER_S = (1280, 720), 5
GAPS = """([agents, count]) => new Promise((done) => {
  const s = studio.state, many = (list) => Array.from({ length: agents }, (_, i) => list[i % list.length]);
  studio.timeline.toggle(false);
  s.scene.agents = many(s.scene.agents).map((agent, i) => [i, ...agent.slice(1)]);
  s.log.agents = many(s.log.agents);
  const shift = (one, n) => ({ ...one, valid: new Uint8Array(91).fill(1), y: one.y.map((v) => v + 0.1 * n) });
  const rollouts = Array.from({ length: count }, (_, n) => s.log.agents.map((one) => shift(one, n)));
  s.panels.forEach((key) => s.variants.set(key, { name: key, rollouts, score: null, version: performance.now() }));
  studio.stage.draw();
  const stamps = [], tick = (stamp) => {
    stamps.push(stamp);
    if (stamp - stamps[0] < 3000) return requestAnimationFrame(tick);
    studio.timeline.toggle(false);
    done(stamps.slice(1).map((one, i) => one - stamps[i]));
  };
  s.time = 0; studio.timeline.toggle(true); requestAnimationFrame(tick);
})"""


def wait(page: Page, condition: str, seconds: float = 300) -> None:
    """The page forbids eval, so conditions are evaluated from outside."""
    end = time.monotonic() + seconds
    while not page.evaluate(f"() => Boolean({condition})"):
        if time.monotonic() > end:
            raise TimeoutError(f"{condition}: {page.inner_text('#run-status')} {page.inner_text('#toast')}")
        time.sleep(0.02)


def cpu_s(root: int) -> float:
    """CPU seconds of a process and all of its descendants so far."""
    parents, used = {}, {}
    for folder in Path("/proc").glob("[0-9]*"):
        try:
            fields = (folder / "stat").read_text().rpartition(")")[2].split()
        except OSError:
            continue
        parents[int(folder.name)] = int(fields[1])
        used[int(folder.name)] = (int(fields[11]) + int(fields[12])) / os.sysconf("SC_CLK_TCK")
    found = {root}
    while more := {process for process, parent in parents.items() if parent in found} - found:
        found |= more
    return sum(used.get(process, 0.0) for process in found)


def still(page: Page, path: Path) -> None:
    """A screenshot as webp."""
    Image.open(io.BytesIO(page.screenshot())).convert("RGB").save(path, quality=82, method=6)


def write_large(folder: Path) -> None:
    """A data set with a scenario of 128 agents and 38 000 map points: another one, repeated side by side."""
    (scenario, *_) = open_dataset("synthetic", "validation")
    tracks, features = scenario.tracks, scenario.map_features
    row = np.concatenate([[scenario.ego_index], np.resize(scenario.simulated_indices, 127)])
    shift = 4.0 * (np.arange(128) // len(scenario.simulated_indices))
    many = {name: getattr(tracks, name)[row] for name in ("object_type", "heading", "velocity", "size", "valid")}
    position = tracks.position[row] + np.stack([shift, shift, 0 * shift], -1)[:, None].astype(np.float32)
    crowd = Tracks(object_id=np.arange(128), position=position, **many)
    lines = [
        (k * 10_000 + int(one), int(kind), features.points[start:stop] + np.float32([3.0 * k, 3.0 * k, 0.0]))
        for k in range(1 + 38_000 // len(features.points))
        for one, kind, start, stop in zip(
            features.feature_id, features.feature_type, features.offsets[:-1], features.offsets[1:]
        )
    ]
    kept = np.searchsorted(np.cumsum([len(points) for _, _, points in lines]), 38_000)
    large = replace(
        scenario, scenario_id="large", tracks=crowd, map_features=MapFeatures.of(lines[: kept + 1]), ego_index=0,
        tracks_to_predict=np.arange(1, 9, dtype=np.int32), difficulty=np.zeros(8, np.int8),
        objects_of_interest=np.zeros(0, np.int64),
    )  # fmt: skip
    write_dataset([scenario, large], folder, split="validation")


def measure_large(browser, url: str) -> None:
    """Time from the click on a scenario of 128 agents and 38 000 map points to its picture, scene not in memory."""
    page = browser.new_page(viewport={"width": 1600, "height": 900}, reduced_motion="reduce")
    page.goto(url)
    wait(page, f"{LOADS} && studio.stage.panels[0].states")
    before = cpu_s(os.getpid())
    milliseconds = page.evaluate(
        """async () => {
          const begun = performance.now();
          await studio.openScenario("large");
          await new Promise((drawn) => requestAnimationFrame(() => requestAnimationFrame(drawn)));
          return performance.now() - begun;
        }"""
    )
    agents = page.evaluate("() => studio.state.scene.agents.length")
    used = round(cpu_s(os.getpid()) - before, 2)
    say("a large scenario opens", agents=agents, milliseconds=round(milliseconds), cpu_s=used)
    page.close()


def say(name: str, **values: object) -> None:
    print(json.dumps({"what": name, **values}), flush=True)


def measure(browser, begun: float, url: str) -> None:
    """Start, first rollouts, frame rates, memory."""
    page = browser.new_page(viewport={"width": 1600, "height": 900})
    page.goto(url)
    wait(page, f"{LOADS} && studio.state.playing && studio.state.time > 10.2")
    say("from the command to a playing scenario", seconds=round(time.monotonic() - begun, 2))
    page.keyboard.press("Space")
    for count in (8, 32):
        page.select_option("#rollouts", str(count))
        page.evaluate("() => { studio.state.seed += 1; }")
        page.locator(".panel canvas").first.focus()
        page.click("#simulate")
        wait(page, f"studio.state.isRunning === false && {OVER}")
        first = int(page.evaluate("() => document.getElementById('run-status').dataset.first"))
        say(
            "from the click to moving rollouts",
            rollouts=count,
            milliseconds=first,
            whole=page.inner_text("#run-status"),
        )
    for agents, count in ((120, 32), (27, 32)):
        page.evaluate("() => { studio.state.panels = ['log', studio.state.session.models.at(-1).name]; }")
        before = cpu_s(os.getpid())
        gaps = page.evaluate(GAPS, [agents, count])
        cpu_ms = 1000 * (cpu_s(os.getpid()) - before) / len(gaps)
        say(
            "frames",
            agents=agents,
            rollouts=count,
            per_second=round(1000 * len(gaps) / sum(gaps), 1),
            longest_ms=round(max(gaps)),
            cpu_ms=round(cpu_ms, 1),
        )
    heaps = []
    page.goto(url.partition("?")[0])
    wait(page, LOADS)
    for _ in range(2):
        for _ in range(20):
            page.keyboard.press("n")
            page.wait_for_timeout(150)
        page.evaluate("() => globalThis.gc?.()")
        heaps.append(round(page.evaluate("() => performance.memory.usedJSHeapSize") / 2**20, 1))
    say("JS heap after 20 and 40 scenarios", mebibytes=heaps)
    page.close()


class Film:
    """Screenshots at even times of a story that is told step by step, whatever the machine takes for a picture."""

    def __init__(self, page: Page) -> None:
        self.page, self.frames = page, []

    def shoot(self) -> None:
        picture = Image.open(io.BytesIO(self.page.screenshot(type="jpeg", quality=92))).convert("RGB")
        self.frames.append(np.asarray(picture))

    def hold(self, seconds: float) -> None:
        self.shoot()
        self.frames += self.frames[-1:] * (round(seconds * FRAMES_PER_S) - 1)

    def play(self, seconds: float, *, start: int = 10) -> None:
        for i in range(round(seconds * FRAMES_PER_S)):
            step = min(90, start + 10 * i / FRAMES_PER_S)
            self.page.evaluate(f"() => studio.timeline.seek({step})")
            self.page.wait_for_timeout(40)
            self.shoot()

    def write(self, path: Path) -> None:
        height, width, _ = self.frames[0].shape
        writer = imageio_ffmpeg.write_frames(
            str(path), (width, height), fps=FRAMES_PER_S, codec="libx264", macro_block_size=2, ffmpeg_log_level="error",
            output_params=["-crf", "30", "-preset", "veryslow", "-movflags", "+faststart"],
        )  # fmt: skip
        writer.send(None)
        for frame in self.frames:
            writer.send(np.ascontiguousarray(frame))
        writer.close()
        first, *rest = (Image.fromarray(frame).resize((960, 540)) for frame in self.frames)
        first.save(
            path.with_suffix(".webp"), save_all=True, append_images=rest, duration=1000 // FRAMES_PER_S, loop=0,
            quality=38, method=4,
        )  # fmt: skip


def simulate(page: Page) -> None:
    page.click("#simulate")
    wait(page, f"studio.state.run && {OVER}")


def tell(browser, url: str, folder: Path) -> None:
    """The loop of a user as a film, and pictures of the main states, light and dark."""
    folder.mkdir(parents=True, exist_ok=True)
    page = browser.new_page(viewport={"width": FILM_SIZE[0], "height": FILM_SIZE[1]}, reduced_motion="reduce")
    page.goto(url)
    wait(page, LOADS)
    page.wait_for_timeout(2500)
    film = Film(page)
    film.play(5)
    page.evaluate("() => studio.timeline.seek(10)")
    page.locator(".panel canvas").first.focus()
    while page.evaluate(f"() => studio.state.selected !== {EGO}"):
        page.keyboard.press("Tab")
    wait(page, "studio.state.proposals")
    film.hold(3)
    page.keyboard.press("1")
    wait(page, f"studio.state.run && {OVER}")
    film.play(8)
    page.evaluate("() => studio.timeline.seek(10)")
    simulate(page)
    film.hold(2)
    film.play(8)
    page.evaluate("() => studio.timeline.seek(45)")
    page.wait_for_timeout(300)
    still(page, folder / "goal.webp")
    page.keyboard.press("c")
    page.evaluate("() => studio.timeline.seek(10)")
    simulate(page)
    film.play(8)
    film.hold(2)
    page.get_by_role("button", name="by step").click()
    page.wait_for_timeout(600)
    film.hold(3)
    page.get_by_role("button", name="by agent").click()
    film.hold(3)
    page.get_by_role("button", name="by feature").click()
    page.keyboard.press("g")
    for _ in range(6):
        page.keyboard.press("Shift+ArrowUp")
        film.hold(0.4)
    page.keyboard.press("Enter")
    wait(page, f"studio.state.run && {OVER}")
    film.play(8)
    page.keyboard.press("Control+z")
    wait(page, f"studio.state.run && {OVER}")
    page.click("#export")
    page.wait_for_timeout(300)
    film.hold(4)
    page.keyboard.press("Escape")
    address = url + page.evaluate("() => location.hash")
    film.write(folder / "studio.mp4")
    page.close()
    for name, width, height, scheme in (("compare", 1920, 1080, "light"), ("dark", 1920, 1080, "dark")):
        page = browser.new_page(
            viewport={"width": width, "height": height}, color_scheme=scheme, reduced_motion="reduce"
        )
        page.goto(address)
        wait(page, f"{LOADS} && studio.state.run && {OVER}")
        page.evaluate("() => studio.timeline.seek(55)")
        page.wait_for_timeout(2500)
        still(page, folder / f"{name}.webp")
        page.close()


@contextmanager
def studio(*words: str) -> Iterator[str]:
    """The command in a process of its own: its address."""
    begun, command = time.monotonic(), [sys.executable, "-m", "rlftsim", "studio", "--no-browser", "--json", *words]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        try:
            url = json.loads(server.stdout.readline())["url"]
            seconds = round(time.monotonic() - begun, 2)
            say("from the command to the address", seconds=seconds, cpu_s=round(cpu_s(server.pid), 2))
            yield url
            begun = time.monotonic()
        finally:
            server.send_signal(signal.SIGINT)
    say("from Ctrl-C to the end", seconds=round(time.monotonic() - begun, 2))


def main() -> None:
    parser = argparse.ArgumentParser(description=__doc__)
    parser.add_argument("--model", action="append", required=True)
    parser.add_argument("--out", type=Path, required=True)
    parser.add_argument("--pictures", type=Path)
    parser.add_argument("--only-pictures", action="store_true")
    options = parser.parse_args()
    words = ["--out", str(options.out), *(word for model in options.model for word in ("--model", model))]
    begun = time.monotonic()
    with sync_playwright() as session:
        browser = session.chromium.launch(executable_path=shutil.which("chromium"), args=ARGUMENTS)
        with studio(*words) as url:
            if not options.only_pictures:
                measure(browser, begun, url)
            if options.pictures:
                tell(browser, url, options.pictures)
        if not options.only_pictures:
            with tempfile.TemporaryDirectory() as folder:
                write_large(Path(folder) / "large")
                with studio("--out", folder, "--data", str(Path(folder) / "large")) as url:
                    measure_large(browser, url)
        browser.close()


if __name__ == "__main__":
    main()

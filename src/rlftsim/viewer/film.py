"""Films of scenes: the panels of an animation side by side, step by step, in a file that plays anywhere."""

import itertools
import os
from collections.abc import Callable, Iterable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import imageio_ffmpeg
import numpy as np
from jaxtyping import UInt8
from matplotlib.artist import Artist
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from rlftsim.errors import ConfigError
from rlftsim.jobs.files import write_atomically
from rlftsim.jobs.interruption import ctrl_c_blocked
from rlftsim.scenario.types import CURRENT_STEP, TOTAL_STEPS
from rlftsim.viewer.page import Animation, Panel
from rlftsim.viewer.picture import draw_agents, draw_scene, light_dots

STEPS_PER_SECOND = 10
HOLD_AT_END_S = 1.0
JUMP = 1.2
"""Distance of views that follow each other, as a multiple of half of the shown width."""

Frame = UInt8[np.ndarray, "height width 3"]


def to_film(
    path: str | os.PathLike[str], animation: Animation, *, steps_per_frame: int = 1, dots_per_inch: int = 110
) -> None:
    """Write a film of an animation's first rollouts, from the current step on, in real time.

    Args:
        path: File to write, .mp4 (H.264), or .webp or .gif (play wherever pictures are shown); never half a file.
        animation: Scene and panels, each with the motion of the agents.
        steps_per_frame: Number of steps of 0.1 s between frames; 2 halves the size of the file.
        dots_per_inch: Resolution; 110 makes a panel 440 pixels wide.

    Raises:
        ConfigError: An ending that is no film's.
        DataError: The file cannot be written.
    """
    path = Path(path)
    write = find_writer(path)
    # The last frame stays for a while, or the end could not be seen before a player starts again.
    camera, rate = Camera(animation, dots_per_inch), STEPS_PER_SECOND / steps_per_frame
    num_steps = max(panel.trajectories.num_steps for panel in animation.panels)
    *earlier, last = range(CURRENT_STEP, num_steps, steps_per_frame)

    def write_frames(temporary: Path) -> None:
        # drawn as they are written: all frames of a minute would take a gigabyte
        frames = (camera.frame(animation.panels, step) for step in earlier)
        held = [camera.frame(animation.panels, last)] * (1 + round(HOLD_AT_END_S * rate))
        write(temporary, itertools.chain(frames, held), rate)

    write_atomically(path, write_frames)


class Camera:
    """Draws single frames of a scene. In films longer than 9.1 s the view follows the ego in jumps.

    Args:
        animation: Scene, and a panel for each picture side by side.
        dots_per_inch: Resolution; 110 makes a panel 440 pixels wide.
    """

    def __init__(self, animation: Animation, dots_per_inch: int):
        self.animation = animation
        self._figure, self._axes = draw_scene(animation)
        self._figure.set_dpi(dots_per_inch)
        self._canvas = FigureCanvasAgg(self._figure)
        self._centers = [animation.scene.focus[:2]] * len(self._axes)
        self._draw_ground()

    def _draw_ground(self) -> None:
        """Draw the maps, the slow part, once; every frame begins with a copy."""
        self._canvas.draw()
        self._ground = self._canvas.copy_from_bbox(self._figure.bbox)

    def _follow(self, panels: Sequence[Panel], step: int) -> None:
        """Move the view of panels with long motion so that the ego is not far from the middle."""
        radius = self.animation.scene.focus[2]
        row = int(self.animation.scene.agents.is_ego.argmax())
        centers = list(self._centers)
        for number, panel in enumerate(panels):
            if panel.trajectories.num_steps > TOTAL_STEPS:
                ego = panel.trajectories.position[0, row]  # [S, 2]
                start, now = ego[CURRENT_STEP], ego[min(step, len(ego) - 1)]
                x, y = start + JUMP * radius * np.round((now - start) / (JUMP * radius))
                centers[number] = float(x), float(y)
        if centers != self._centers:
            self._centers = centers
            for axis, (x, y) in zip(self._axes, centers):
                axis.set(xlim=(x - radius, x + radius), ylim=(y - radius, y + radius))
            self._draw_ground()

    def frame(self, panels: Sequence[Panel], step: int, light_step: int | None = None) -> Frame:
        """Picture of the agents at a step.

        Args:
            panels: Motion of the agents, for each panel of the animation.
            step: Step of the motion, 0 the first.
            light_step: Step of the log whose traffic lights are drawn; None = `step`.
        """
        scene, lights_at = self.animation.scene, step if light_step is None else light_step
        self._follow(panels, step)
        self._canvas.restore_region(self._ground)
        for axis, panel in zip(self._axes, panels):
            artists: list[Artist] = [*draw_agents(axis, scene.agents, panel, step), light_dots(axis, scene, lights_at)]
            if panel.notes:
                corner = {"transform": axis.transAxes, "va": "top", "bbox": {"color": "white", "alpha": 0.7, "pad": 2}}
                note = panel.notes[min(step, len(panel.notes) - 1)]  # its episode may have ended before others
                artists.append(axis.text(0.02, 0.98, note, fontsize=8, **corner))
            for shape in artists:
                axis.draw_artist(shape)
                shape.remove()
        pixels = np.asarray(self._canvas.buffer_rgba())[..., :3]
        # H.264 wants even sizes. The copy is needed because the canvas reuses its buffer.
        return pixels[: len(pixels) // 2 * 2, : pixels.shape[1] // 2 * 2].copy()


def _write_mp4(path: Path, frames: Iterable[Frame], frames_per_second: float) -> None:
    frames = iter(frames)
    first = next(frames)
    height, width, _ = first.shape
    writer = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=round(frames_per_second), codec="libx264", quality=5, macro_block_size=2,
        output_params=["-f", "mp4", "-movflags", "+faststart"], ffmpeg_log_level="error",
    )  # fmt: skip
    with ctrl_c_blocked():  # it starts ffmpeg, which would print lines of its own after Ctrl-C
        writer.send(None)
    for frame in itertools.chain([first], frames):
        writer.send(np.ascontiguousarray(frame))
    writer.close()


def _write_pictures(path: Path, frames: Iterable[Frame], frames_per_second: float, **options: Any) -> None:
    first, *later = (Image.fromarray(frame) for frame in frames)
    duration = round(1000 / frames_per_second)
    first.save(path, save_all=True, append_images=later, duration=duration, loop=0, **options)


WRITERS: dict[str, Callable[[Path, Iterable[Frame], float], None]] = {
    ".mp4": _write_mp4,
    ".webp": partial(_write_pictures, format="WEBP", quality=60, method=4),
    ".gif": partial(_write_pictures, format="GIF"),
}
"""Function that writes a film, by the ending of the file."""


def find_writer(path: Path) -> Callable[[Path, Iterable[Frame], float], None]:
    """Function that writes a film of the ending.

    Raises:
        ConfigError: An ending that is no film's.
    """
    write = WRITERS.get(path.suffix.lower())
    if write is None:
        raise ConfigError(f"{path}: a film is {' or '.join(WRITERS)}, choose one of these endings.")
    return write

"""Films of scenes: the panels of an animation side by side, step by step, in a file that plays anywhere."""

import os
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from rlftsim.errors import ConfigError
from rlftsim.jobs.files import write_whole
from rlftsim.scenario.types import CURRENT_STEP
from rlftsim.viewer.page import Animation, Panel
from rlftsim.viewer.picture import agent_shapes, draw_scene, light_dots

STEPS_PER_SECOND = 10
HOLD_AT_END_S = 1.0

Frame = UInt8[np.ndarray, "height width 3"]


def to_film(
    path: str | os.PathLike[str], animation: Animation, *, steps_per_frame: int = 1, dots_per_inch: int = 110
) -> None:
    """Write a film of an animation's first rollouts, from the current step on, in real time.

    Args:
        path: file to write, .mp4 (H.264) or .webp (plays wherever pictures are shown); nothing half-written is left
            there.
        animation: scene and panels.
        steps_per_frame: steps of 0.1 s between frames.
        dots_per_inch: 110 makes a panel 440 pixels wide.

    Raises:
        ConfigError: another ending.
        DataError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix not in WRITERS:
        raise ConfigError(f"{path}: a film is {' or '.join(WRITERS)}, choose one of these endings.")
    # The last frame stays for a while, or the end could not be seen before a player starts again.
    films = list(_frames(animation, steps_per_frame, dots_per_inch))
    films += films[-1:] * round(HOLD_AT_END_S * STEPS_PER_SECOND / steps_per_frame)
    write_whole(path, lambda temporary: WRITERS[path.suffix](temporary, films, STEPS_PER_SECOND / steps_per_frame))


class Camera:
    """Draws single frames of a scene.

    Args:
        animation: scene and panels.
        dots_per_inch: 110 makes a panel 440 pixels wide.
    """

    def __init__(self, animation: Animation, dots_per_inch: int):
        self.animation = animation
        self._figure, self._axes = draw_scene(animation)
        self._figure.set_dpi(dots_per_inch)
        self._canvas = FigureCanvasAgg(self._figure)
        self._canvas.draw()
        # The map is drawn once and copied under every frame, because it takes most of the time.
        self._ground = self._canvas.copy_from_bbox(self._figure.bbox)

    def frame(self, panels: Sequence[Panel], step: int, light_step: int | None = None) -> Frame:
        """Picture of the agents at one step.

        Args:
            panels: motion, one for each panel of the animation.
            step: of the motion.
            light_step: of the log, for traffic lights; None = `step`.
        """
        scene, lights_at = self.animation.scene, step if light_step is None else light_step
        self._canvas.restore_region(self._ground)
        for axis, panel in zip(self._axes, panels):
            shapes = agent_shapes(scene.agents, panel, step)
            for shape in shapes:
                axis.add_collection(shape, autolim=False)
            for shape in (*shapes, light_dots(axis, scene, lights_at)):
                axis.draw_artist(shape)
                shape.remove()
        drawn = np.asarray(self._canvas.buffer_rgba())[..., :3]
        # H.264 wants even sizes. The copy is needed because the canvas reuses its buffer.
        return drawn[: len(drawn) // 2 * 2, : drawn.shape[1] // 2 * 2].copy()


def _frames(animation: Animation, steps_per_frame: int, dots_per_inch: int) -> Iterator[Frame]:
    """Frames of a film, one every so many steps."""
    camera = Camera(animation, dots_per_inch)
    num_steps = max(panel.trajectories.num_steps for panel in animation.panels)
    for step in range(CURRENT_STEP, num_steps, steps_per_frame):
        yield camera.frame(animation.panels, step)


def _write_mp4(path: Path, frames: list[Frame], frames_per_second: float) -> None:
    height, width, _ = frames[0].shape
    writer = imageio_ffmpeg.write_frames(
        str(path), (width, height), fps=round(frames_per_second), codec="libx264", quality=5, macro_block_size=2,
        output_params=["-f", "mp4", "-movflags", "+faststart"], ffmpeg_log_level="error",
    )  # fmt: skip
    writer.send(None)  # starts the generator
    for frame in frames:
        writer.send(np.ascontiguousarray(frame))
    writer.close()


def _write_webp(path: Path, frames: list[Frame], frames_per_second: float) -> None:
    first, *rest = (Image.fromarray(frame) for frame in frames)
    first.save(
        path, format="WEBP", save_all=True, append_images=rest, duration=round(1000 / frames_per_second), loop=0,
        quality=60, method=4,
    )  # fmt: skip


WRITERS: dict[str, Callable[[Path, list[Frame], float], None]] = {".mp4": _write_mp4, ".webp": _write_webp}

"""Films of scenes: the panels of an animation side by side, step by step, in a file that plays anywhere."""

import os
from collections.abc import Callable, Iterator
from pathlib import Path

import imageio_ffmpeg
import numpy as np
from jaxtyping import UInt8
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

from rlftsim.atomic_io import write_whole
from rlftsim.errors import ConfigError
from rlftsim.scenario.types import CURRENT_STEP
from rlftsim.viewer.page import Animation
from rlftsim.viewer.picture import agent_shapes, draw_scene, light_dots

STEPS_PER_SECOND = 10
HOLD_AT_END_S = 1.0


def to_film(path: str | os.PathLike[str], animation: Animation, *, every: int = 1, dots_per_inch: int = 110) -> None:
    """Write a film of an animation's first rollouts, from the current step on, in real time.

    Args:
        path: file to write, .mp4 (H.264) or .webp (plays wherever pictures are shown); nothing half-written is left
            there.
        animation: scene and panels.
        every: steps of 0.1 s between frames.
        dots_per_inch: 110 makes a panel 440 pixels wide.

    Raises:
        ConfigError: another ending.
        DataError: the file cannot be written.
    """
    path = Path(path)
    if path.suffix not in WRITERS:
        raise ConfigError(f"{path}: a film is {' or '.join(WRITERS)}, choose one of these endings.")
    # The last frame stays for a while, or the end could not be seen before a player starts again.
    films = list(_frames(animation, every, dots_per_inch))
    films += films[-1:] * round(HOLD_AT_END_S * STEPS_PER_SECOND / every)
    write_whole(path, lambda temporary: WRITERS[path.suffix](temporary, films, STEPS_PER_SECOND / every))


Frame = UInt8[np.ndarray, "height width 3"]


def _frames(animation: Animation, every: int, dots_per_inch: int) -> Iterator[Frame]:
    """Frames of a film, one every so many steps."""
    figure, axes = draw_scene(animation)
    figure.set_dpi(dots_per_inch)
    canvas = FigureCanvasAgg(figure)
    canvas.draw()
    # The map is drawn once and copied under every frame, because it takes most of the time.
    ground = canvas.copy_from_bbox(figure.bbox)
    num_steps = max(panel.trajectories.num_steps for panel in animation.panels)
    for step in range(CURRENT_STEP, num_steps, every):
        canvas.restore_region(ground)
        for axis, panel in zip(axes, animation.panels):
            shapes = agent_shapes(animation.scene.agents, panel, step)
            for shape in shapes:
                axis.add_collection(shape, autolim=False)
            for shape in (*shapes, light_dots(axis, animation.scene, step)):
                axis.draw_artist(shape)
                shape.remove()
        drawn = np.asarray(canvas.buffer_rgba())[..., :3]
        # H.264 wants even sizes. The copy is needed because the canvas reuses its buffer.
        yield drawn[: len(drawn) // 2 * 2, : drawn.shape[1] // 2 * 2].copy()


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

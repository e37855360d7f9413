"""Scenes as films."""

import os
import signal
import threading
from dataclasses import replace
from pathlib import Path

import imageio_ffmpeg
import numpy as np
import pytest
from matplotlib.backends.backend_agg import FigureCanvasAgg
from PIL import Image

import rlftsim as rs
import scenes
from rlftsim.errors import ConfigError
from rlftsim.viewer.film import find_writer, to_film
from rlftsim.viewer.picture import draw_scene


def read_mp4(path):
    frames = imageio_ffmpeg.read_frames(str(path))
    meta = next(frames)
    width, height = meta["size"]
    return meta, [np.frombuffer(frame, np.uint8).reshape(height, width, 3) for frame in frames]


def blue_columns(frame):
    """Where the ego is in each half of a picture, left to right: its color is nobody else's."""
    frame = frame[: int(len(frame) * 0.85)].astype(int)  # above the legend
    is_blue = (frame[..., 2] > 150) & (frame[..., 0] < 90)
    return [float(np.nonzero(half)[1].mean()) for half in np.split(is_blue, [frame.shape[1] // 2], axis=1)]


def test_ctrl_c_of_the_terminal_is_no_matter_of_ffmpeg(tmp_path, capfd):
    def children():
        return set(Path(f"/proc/{os.getpid()}/task/{threading.get_native_id()}/children").read_text().split())

    def frames():
        before = children()  # other tests of this process may have left theirs, such as a tracker of shared memory
        yield np.zeros((64, 64, 3), np.uint8)
        (process,) = children() - before
        os.kill(int(process), signal.SIGINT)
        yield np.zeros((64, 64, 3), np.uint8)

    find_writer(tmp_path / "film.mp4")(tmp_path / "film.mp4", frames(), 10.0)
    assert len(read_mp4(tmp_path / "film.mp4")[1]) == 2
    assert capfd.readouterr().err == ""


def test_an_mp4_plays_the_future_in_real_time_and_everybody_moves(animation, tmp_path):
    to_film(tmp_path / "film.mp4", animation, dots_per_inch=50)
    meta, frames = read_mp4(tmp_path / "film.mp4")
    assert meta["fps"] == 10
    assert len(frames) == 81 + 10  # from the current step on, and a second to look at the end
    assert frames[0].shape[1] == 400
    now, later = blue_columns(frames[0]), blue_columns(frames[20])
    assert all(after - before > 10 for before, after in zip(now, later))  # the ego drives to the right in both panels


@pytest.mark.parametrize("ending", ["webp", "gif"])
def test_a_moving_picture_plays_where_pictures_are_shown(ending, animation, tmp_path):
    to_film(tmp_path / f"film.{ending}", animation, steps_per_frame=10, dots_per_inch=50)
    with Image.open(tmp_path / f"film.{ending}") as film:
        assert film.is_animated
        assert film.size == (400, 234)
        first = np.array(film.convert("RGB"))
        film.seek(2)
        assert not np.array_equal(first, np.array(film.convert("RGB")))


def test_other_endings_are_refused_by_name(animation, tmp_path):
    with pytest.raises(ConfigError, match=r"film.avi: a film is .mp4 or .webp or .gif"):
        to_film(tmp_path / "film.avi", animation)
    assert not list(tmp_path.iterdir())


def test_legend_and_small_print_of_a_single_panel_stay_inside_the_picture(animation):
    noted = replace(animation.scene, note="Made from the recordings of a city (example.org), license. " * 2)
    figure, _ = draw_scene(replace(animation, scene=noted, panels=animation.panels[:1]))
    FigureCanvasAgg(figure).draw()
    for part in (figure.legends[0], figure.texts[-1]):
        box = part.get_window_extent()
        assert figure.bbox.x0 <= box.x0
        assert box.x1 <= figure.bbox.x1


def test_a_long_film_follows_the_ego(tmp_path):
    scenario = scenes.build_scenario("fast", (scenes.Mover(speed_mps=15.0),), scenes.straight_map())
    rollouts = rs.simulate("constant_velocity", scenario, num_rollouts=1, seconds=20.0)
    rs.film(scenario, rollouts, tmp_path / "film.mp4")
    _, frames = read_mp4(tmp_path / "film.mp4")
    for frame in frames[::10]:
        half = frame[: int(len(frame) * 0.85), frame.shape[1] // 2 :].astype(int)  # the rollouts beside the log
        assert ((half[..., 2] > 150) & (half[..., 0] < 90)).any()

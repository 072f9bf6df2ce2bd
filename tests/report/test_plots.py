"""Tests of the images that a run writes: the curve and the video."""

import contextlib
import sys
import types
import warnings

import numpy as np
import pytest
from PIL import Image

from jaxrl_vis.errors import RequestError
from jaxrl_vis.report import plots, videos


def make_rows(seeds: int, evaluations: int) -> list[dict]:
    return [
        {"seed": seed, "env_steps": 4000 * k, "eval/success": k / (k + 1 + seed), "eval/goal_distance": 0.2 / (k + seed)}
        for seed in range(seeds)
        for k in range(1, evaluations + 1)
    ]


def make_images(channels: int, size: int = 16, per_step: bool = False) -> videos.EpisodeImages:
    greys = np.random.default_rng(0).integers(0, 255, (3, 6, 1, size, size), np.uint8)
    frames = np.repeat(greys, channels, axis=2)
    success = np.array([True, False, True])
    if per_step:
        success = np.arange(6)[None] >= np.array([[3], [9], [5]])
    return videos.EpisodeImages(frames, frames[:, -1], success)


def count_colour(image: Image.Image, colour: tuple[int, int, int]) -> int:
    near = np.abs(np.asarray(image.convert("RGB"), int) - colour).max(-1) <= 12
    return int(near.sum())


@pytest.mark.parametrize(("seeds", "evaluations"), [(1, 1), (1, 5), (5, 20)])
def test_the_curve_is_drawn(tmp_path, seeds, evaluations):
    path = tmp_path / "curve.png"
    assert plots.plot_run(make_rows(seeds, evaluations), path, "VisualFetchReach", "oracle", "m", 0.05)
    image = Image.open(path)
    assert image.width > 1200 and image.height > 500 and 10_000 < path.stat().st_size < 300_000
    assert count_colour(image, (15, 123, 108)) > 20 and count_colour(image, (180, 83, 31)) > 20


def test_gaps_and_nothing_at_all(tmp_path):
    rows = make_rows(2, 3)
    rows[1]["eval/success"] = None
    del rows[4]
    steps, values = plots.gather(rows, "eval/success")
    assert steps.tolist() == [4000, 8000, 12000] and values.shape == (2, 3)
    assert np.isnan(values).sum() == 2 and values[0, 0] == pytest.approx(0.5)
    assert plots.plot_run(rows, tmp_path / "curve.png", "gaps")
    assert not plots.plot_run([], tmp_path / "none.png", "none") and not (tmp_path / "none.png").exists()


@pytest.mark.parametrize("channels", [1, 3, 4])
def test_a_video_shows_the_observation_beside_the_goal(tmp_path, channels):
    path = tmp_path / "video.gif"
    videos.write_video(make_images(channels), path, frame_seconds=0.05)
    image = Image.open(path)
    rows = 2 if channels == 4 else 1
    assert image.n_frames == 18 and image.info["loop"] == 0
    assert 520 < image.width < 640 and 256 * rows < image.height < 256 * rows + 60 * rows + 80
    green, red = [], []
    for t in (0, 5, 11, 17):  # a first frame, and the last of each episode
        image.seek(t)
        green.append(count_colour(image, (62, 207, 142)) > 2000)
        red.append(count_colour(image, (226, 109, 92)) > 2000)
    assert green == [False, True, False, True]
    if channels == 3:  # the depth's colours are close to this red
        assert red == [False, False, True, False]


def test_colours_survive_enlargement(tmp_path):
    frames = np.zeros((1, 2, 3, 8, 8), np.uint8)
    frames[:, :, 0, :4] = 250
    episodes = videos.EpisodeImages(frames, frames[:, -1], np.array([False]))
    images, seconds = videos.draw_frames(episodes, 0.04, max_episodes=1)
    assert seconds == [0.04, 1.0]
    assert count_colour(images[0], (250, 0, 0)) == 2 * 256 * 128


def test_borders_turn_green_when_success_is_known_at_each_step():
    images, _ = videos.draw_frames(make_images(3, per_step=True), 0.04, max_episodes=1)
    assert [count_colour(image, (62, 207, 142)) > 2000 for image in images] == [False] * 3 + [True] * 3


def test_other_formats(tmp_path):
    episodes = make_images(4)
    videos.write_video(episodes, tmp_path / "a.html")
    assert "data:image/gif;base64," in (tmp_path / "a.html").read_text()
    videos.write_video(episodes, tmp_path / "deep" / "a.png")
    assert Image.open(tmp_path / "deep" / "a.png").width > 700
    with pytest.raises(RequestError, match="must end in one of"):
        videos.write_video(episodes, tmp_path / "a.webm")
    vectors = videos.EpisodeImages(np.zeros((2, 6, 10), np.float32), np.zeros((2, 10), np.float32), np.zeros(2))
    with pytest.raises(RequestError, match="not images"):
        videos.write_video(vectors, tmp_path / "b.gif")


def test_frames_of_an_mp4_have_even_sizes_and_starting_ffmpeg_warns_of_nothing(tmp_path, monkeypatch, recwarn):
    class Writer(contextlib.AbstractContextManager):
        frames: list[np.ndarray] = []

        def __exit__(self, *error):
            pass

        def append_data(self, frame):
            self.frames.append(frame)
            warnings.warn(
                "os.fork() was called. os.fork() is incompatible with multithreaded code", RuntimeWarning, stacklevel=1
            )

    monkeypatch.setitem(sys.modules, "imageio_ffmpeg", types.ModuleType("imageio_ffmpeg"))
    monkeypatch.setattr("imageio.v2.get_writer", lambda *args, **options: Writer())
    episodes = make_images(1)
    videos.write_video(episodes, tmp_path / "a.mp4")
    (odd,) = {image.size for image in videos.draw_frames(episodes, 0.04, 6)[0]}
    assert odd[1] % 2
    assert {frame.shape for frame in Writer.frames} == {(odd[1] + 1, odd[0] + odd[0] % 2, 3)}
    assert not recwarn.list


def test_mp4_needs_a_package_and_says_so(tmp_path):
    try:
        import imageio_ffmpeg  # noqa: F401
    except ImportError:
        with pytest.raises(RequestError, match="imageio-ffmpeg"):
            videos.write_video(make_images(3), tmp_path / "a.mp4")
    else:
        videos.write_video(make_images(3), tmp_path / "a.mp4")
        assert (tmp_path / "a.mp4").stat().st_size > 1000

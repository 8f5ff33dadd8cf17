"""Films of motions: their speed, their camera, and videos that MuJoCo draws."""

from __future__ import annotations

import io
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose
from PIL import Image

import mjfim
from mjfim.arrays import Array
from mjfim.errors import NoVideoError, RecordingError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System, simulate_system
from mjfim.output.film import Film, film_of, film_of_motions, film_speed, positions_at
from mjfim.output.page import DESIGNED, IDENTIFIED, INITIAL, MEASURED
from mjfim.output.video import Video, render, report_video, require_format
from mjfim.records.trajectory import Trajectory
from tests.support import results
from tests.support.cart_pendulum import cart_pendulum
from tests.support.paths import MODELS

SWING = """
<mujoco>
  <worldbody>
    <body><joint axis="0 1 0"/><geom type="capsule" fromto="0 0 0 0 0 -1" size=".1"/></body>
  </worldbody>
</mujoco>
"""

FLYING = """
<mujoco>
  <worldbody><body name="flyer"><freejoint/><geom size=".1" mass="1000"/></body></worldbody>
</mujoco>
"""


@pytest.fixture(scope="module")
def swing() -> mujoco.MjModel:
    """A pendulum."""
    return mujoco.MjModel.from_xml_string(SWING)


@pytest.fixture(scope="module")
def flying() -> mujoco.MjModel:
    """A free body."""
    return mujoco.MjModel.from_xml_string(FLYING)


def motion(t: Array, qpos: Array) -> Trajectory:
    """A motion of which only positions matter."""
    nothing = np.zeros((len(t), 0))
    return Trajectory(t=t, qpos=qpos, qvel=nothing, act=nothing, ctrl=nothing[:-1])


def swinging(seconds: float, amplitude: float = 0.5) -> Trajectory:
    """A swing with a sample every 10 ms."""
    t = np.linspace(0.0, seconds, round(100 * seconds) + 1)
    return motion(t, amplitude * np.sin(3.0 * t)[:, None])


def identified(model: mujoco.MjModel, *motions: Trajectory) -> Film:
    """A film of an identified motion, with a measured one as a ghost."""
    terms = (IDENTIFIED, MEASURED)
    return film_of_motions(model, [list(zip(terms, motions, strict=False))])


def drawn(film: Film, kind: str) -> Video:
    """Draw a film in two seconds; skip the test where nothing can be drawn."""
    try:
        return render(film, kind, 2.0)  # type: ignore[arg-type]
    except NoVideoError as reason:
        pytest.skip(f"no video here: {reason}")


class TestFilm:
    @pytest.mark.parametrize(
        ("seconds", "speed"),
        [(4.0, 1.0), (20.0, 1.0), (30.0, 2.0), (500.0, 2.0), (2.0, 0.5), (0.01, 0.002)],
    )
    def test_speed_makes_a_film_of_some_seconds(self, seconds: float, speed: float) -> None:
        assert film_speed(seconds) == speed

    def test_captions(self, swing: mujoco.MjModel) -> None:
        """Motions stand beside each other, a ghost behind one; a long motion ends early."""
        four, higher = swinging(4.0), swinging(4.0, 0.6)
        beside = film_of_motions(swing, [[(INITIAL, four)], [(DESIGNED, four)]])
        assert beside.caption == "The initial motion beside the designed motion, in real time."

        behind = identified(swing, four, higher)
        assert behind.named == [{"identified": False, "measured": True}]
        words = "The identified motion and the measured motion (transparent)"
        assert behind.caption.startswith(words)

        long = identified(swing, swinging(100.0))
        assert long.t[-1] == pytest.approx(40.0)
        assert long.caption == (
            "The identified motion, 2 times faster than real time. "
            "Only the first 40 s are shown; 60 s follow."
        )

    def test_rehearsed_robots_are_ghosts_behind_the_design(self) -> None:
        """The least safe and the safest one; a robot that leaves a limit has its own word."""
        system = System.resolve(mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml"))
        t = np.linspace(0.0, 4.0, 101)
        moves = np.multiply.outer([1.0, 1.2, 0.9, 1.1], np.sin(np.column_stack([t, 2.0 * t])))
        motions = dict(zip((3, 1, 2), moves[1:], strict=True))
        safe = results.rehearsal(motion_times=t, motions=motions)
        margins = safe.margins.copy()
        margins[3] = -0.1
        designed = replace(results.evaluation(0.1, 50), trajectory=motion(t, moves[0]))
        design = results.design(initial=designed, final=designed, rehearsal=safe)
        film = film_of(system, replace(design, rehearsal=replace(safe, margins=margins)))
        left, right = film.tracks
        assert [term for term, _ in left] == ["initial"]
        assert film.named[1] == {"designed": False, "unsafe": True, "rehearsed": True}
        for (_, drawn), qpos in zip(right, moves[[0, 1, 3]], strict=True):
            assert_allclose(drawn, qpos, atol=1e-12)

        # Two safe robots are named once.
        film = film_of(system, design)
        assert len(film.tracks[1]) == 3 and film.caption.count("rehearsed") == 1

    def test_positions_between_samples_turn_the_shortest_way(self, flying: mujoco.MjModel) -> None:
        begin, middle, end = (
            np.array([x, 0.0, 0.0, np.cos(0.6 * x), 0.0, 0.0, np.sin(0.6 * x)])
            for x in (0.0, 0.5, 1.0)
        )

        # The other sign of the quaternion is the same rotation.
        rows = np.stack([begin, [1.0, 1.0, 1.0, -1.0, 1.0, 1.0, -1.0] * end])
        found = positions_at(flying, np.array([0.0, 2.0]), rows, np.array([-1.0, 1.0, 9.0]))
        assert_allclose(found[:2], [begin, middle], atol=1e-12)
        assert_allclose(found[2, :3], end[:3])

    @pytest.mark.parametrize("scale", [1e-3, 1.0, 1e3])
    @pytest.mark.parametrize(("distance", "follows"), [(0.1, False), (5.0, True)])
    def test_camera_follows_a_body_that_travels_far(
        self, distance: float, follows: bool, scale: float
    ) -> None:
        text = FLYING.replace('size=".1"', f'size="{0.1 * scale}"')
        model = mujoco.MjModel.from_xml_string(text)
        t = np.linspace(0.0, 4.0, 41)
        qpos = np.tile(model.qpos0, (41, 1))
        qpos[:, 0] = scale * distance * t / 4.0

        film = identified(model, motion(t, qpos))
        assert [len(trail) for trail in film.trails] == [100 if follows else 0]
        travelled = film.targets[0, -1, 0] - film.targets[0, 0, 0]
        assert travelled == pytest.approx(scale * distance if follows else 0.0, rel=0.1)

    @pytest.mark.parametrize(("axis", "size"), [("0 0 1", (640, 360)), ("0 1 0", (480, 480))])
    def test_the_shape_of_a_view_makes_the_robot_large(
        self, axis: str, size: tuple[int, int]
    ) -> None:
        """A rod that turns in the horizontal plane is wide, one in an upright plane is square."""
        text = SWING.replace("0 1 0", axis).replace("0 0 -1", "0.8 0 -0.1")
        t = np.linspace(0.0, 4.0, 81)
        turning = motion(t, 0.5 * np.pi * t[:, None])
        assert identified(mujoco.MjModel.from_xml_string(text), turning).size == size


class TestVideo:
    def test_other_endings_are_refused(self) -> None:
        assert require_format(Path("a.GIF")) == "gif"
        with pytest.raises(RecordingError, match=r"ends in \.mp4 or \.gif"):
            require_format(Path("a.avi"))

    @pytest.mark.parametrize(
        ("back_end", "said"),
        [
            ("disable", "MUJOCO_GL turns drawing off"),
            ("nonsense", "nothing with the variable MUJOCO_GL=nonsense"),
        ],
    )
    def test_without_a_context_there_is_a_sentence(
        self, back_end: str, said: str, swing: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("MUJOCO_GL", back_end)
        with pytest.raises(NoVideoError, match=said):
            render(identified(swing, swinging(1.0)), "gif")

    def test_a_report_says_why_it_has_no_video(self) -> None:
        """Nothing is drawn while tests run, see `tests/conftest.py`."""
        system = System.resolve(cart_pendulum())
        resting = motion(np.array([0.0, 1.0]), np.zeros((2, 2)))
        assert report_video(system, resting) == (
            None,
            "There is no video of the robot: the variable MUJOCO_GL turns drawing off.",
        )

        # A motion that diverged cannot be drawn anywhere.
        diverged = motion(np.array([0.0, 1.0]), np.full((2, 2), np.nan))
        video, sentence = report_video(system, diverged)
        assert video is None
        assert "positions that are not finite" in sentence

    @pytest.mark.parametrize(("seconds", "follow"), [(3.0, 1.0), (4.0, 0.0)])
    def test_the_rest_of_a_recording_is_said(self, seconds: float, follow: float) -> None:
        """An estimate may hold the motion of a part of its recording."""
        task = DesignTask.resolve(cart_pendulum())
        recording, whole = simulate_system(task.system, task.initial, 0), task.initial
        rows = round(seconds / task.dt) + 1
        shown = motion(whole.t[:rows], whole.qpos[:rows])
        estimate: Any = SimpleNamespace(motion=shown, recordings=[recording], theta=task.theta)
        caption = film_of(task.system, estimate).caption
        assert ("1 s follow" in caption) == (follow > 0.0)
        assert ("follow" in caption) == (follow > 0.0)
        assert "measured motion (transparent)" in caption

    @pytest.mark.slow
    @pytest.mark.usefixtures("drawing")
    def test_too_slow_for_a_report(self, swing: mujoco.MjModel) -> None:
        film = identified(swing, swinging(3.0))
        drawn(film, "gif")
        with pytest.raises(NoVideoError, match=r"drawing it takes about \d+ s here"):
            render(film, "gif", seconds=1e-3, fewest_frames=7.0)

    @pytest.mark.slow
    @pytest.mark.usefixtures("drawing")
    def test_mp4_shows_both_motions(self, swing: mujoco.MjModel, tmp_path: Path) -> None:
        av = pytest.importorskip("av", reason="mp4 needs the extra `video`")
        still, moving = swinging(4.0, 0.0), swinging(4.0, 1.0)
        motions = [[(INITIAL, still)], [(DESIGNED, moving)]]
        video = drawn(film_of_motions(swing, motions), "mp4")

        assert video.media_type == "video/mp4" and len(video.data) < 2_000_000
        with av.open(io.BytesIO(video.data)) as container:
            stream = container.streams.video[0]
            assert (stream.codec.name, stream.pix_fmt) == ("h264", "yuv420p")
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]
        assert frames[0].shape[:2] == (video.height, video.width)

        # The left pendulum stands still, the right one moves.
        first, later = frames[0].astype(int), frames[len(frames) // 8].astype(int)
        change = np.abs(first - later)[40:380].max(axis=(0, 2))
        half = video.width // 2
        assert change[: half - 20].max() < 40 < change[half + 20 :].max()

    @pytest.mark.slow
    @pytest.mark.usefixtures("drawing")
    @pytest.mark.parametrize("kind", ["gif", "webp"])
    def test_pictures_repeat_for_ever(self, kind: str, swing: mujoco.MjModel) -> None:
        video = drawn(identified(swing, swinging(3.0), swinging(3.0, 0.6)), kind)
        with Image.open(io.BytesIO(video.data)) as picture:
            assert picture.format == kind.upper()
            assert picture.size == (video.width, video.height)
            assert picture.info["loop"] == 0
            frames = getattr(picture, "n_frames", 1)
            picture.seek(1)
            picture.load()
            assert frames * picture.info["duration"] == pytest.approx(3000.0, rel=0.1)


def test_a_motion_of_another_model_is_no_video(tmp_path: Path) -> None:
    other = mjfim.Experiment.from_file(MODELS / "double_pendulum.toml")
    motion = DesignTask.resolve(cart_pendulum(horizon=0.5)).initial
    with pytest.raises(RecordingError, match="the motion of the video: made for"):
        mjfim.save_video(other, motion, tmp_path / "x.gif")
    assert not (tmp_path / "x.gif").exists()

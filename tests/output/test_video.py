"""Films of motions: their speed, their camera, and videos that MuJoCo draws."""

from __future__ import annotations

import io
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from PIL import Image

import mjfim
from mjfim.arrays import Array
from mjfim.cli import common
from mjfim.errors import RecordingError
from mjfim.experiment.system import System
from mjfim.output import vocabulary
from mjfim.output.video import NoVideoError, VideoBegun, picture, process, rendering
from mjfim.output.video.film import (
    Film,
    film_of_estimate,
    film_of_trajectories,
    film_speed,
    positions_at,
)
from mjfim.output.video.process import back_ends
from mjfim.output.video.record import Video, format_of
from mjfim.output.video.rendering import Effort, render
from mjfim.output.video.worker import counted_seconds
from mjfim.records.trajectory import Trajectory
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

# Few and small frames, so that a test takes little time.
QUICK = Effort(seconds=2.0, fewest_frames=0.0)


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


def test_lines_cast_no_shadow(swing: mujoco.MjModel) -> None:
    """The path of a robot and the floor are decoration, which MuJoCo leaves out of shadows."""
    scene = mujoco.MjvScene(swing, 2)
    scene.geoms[0].category = int(mujoco.mjtCatBit.mjCAT_DYNAMIC)
    colour = np.ones(4, dtype=np.float32)
    picture._add_line(scene, np.zeros(3), np.ones(3), 0.01, colour)
    assert scene.ngeom == 1
    assert scene.geoms[0].category == int(mujoco.mjtCatBit.mjCAT_DECOR)


def drawn(film: Film, kind: str) -> Video:
    """Draw a film; skip the test where nothing can be drawn."""
    try:
        return render(film, kind, QUICK)  # type: ignore[arg-type]
    except NoVideoError as reason:
        pytest.skip(f"no video here: {reason}")


class TestFilm:
    @pytest.mark.parametrize(
        ("seconds", "speed"),
        [(4.0, 1.0), (20.0, 1.0), (30.0, 2.0), (500.0, 2.0), (2.0, 0.5), (0.01, 0.002)],
    )
    def test_speed_makes_a_film_of_some_seconds(self, seconds: float, speed: float) -> None:
        assert film_speed(seconds) == speed

    def test_a_long_motion_ends_early_and_says_so(self, swing: mujoco.MjModel) -> None:
        film = film_of_estimate(swing, swinging(100.0), None)
        assert film.t[-1] == pytest.approx(40.0)
        assert film.caption == (
            "The identified motion, 2 times faster than real time. "
            "Only the first 40 s are shown; 60 s follow."
        )

    def test_the_rest_of_a_recording_that_is_longer_than_the_motion_is_said(
        self, swing: mujoco.MjModel
    ) -> None:
        for seconds, recorded, text in (
            (10.0, 60.0, "Only the first 10 s are shown; 50 s follow."),
            (100.0, 160.0, "Only the first 40 s are shown; 120 s follow."),
        ):
            film = film_of_estimate(swing, swinging(seconds), swinging(seconds), recorded)
            assert film.caption.endswith(text)
        film = film_of_estimate(swing, swinging(10.0), swinging(10.0), 10.0001)
        assert "follow" not in film.caption

    def test_initial_is_beside_designed(self, swing: mujoco.MjModel) -> None:
        named = {"initial": swinging(4.0), "final": swinging(4.0, 1.0)}
        film = film_of_trajectories(swing, named)

        words = [[track.word for track in view.tracks] for view in film.views]
        assert words == [["initial"], ["designed"]]
        assert film.caption == "The initial motion beside the designed motion, in real time."

    def test_measured_is_a_ghost_over_identified(self, swing: mujoco.MjModel) -> None:
        film = film_of_estimate(swing, swinging(4.0), swinging(4.0, 0.6))
        (view,) = film.views
        robot, ghost = view.tracks
        assert (robot.word, ghost.word) == ("identified", "measured")
        assert robot.opacity == 1.0 > ghost.opacity
        assert ghost.colour == vocabulary.MEASURED.rgb
        assert film.caption.startswith(
            "The identified motion and the measured motion (transparent)"
        )

    def test_positions_between_samples_turn_the_shortest_way(self, flying: mujoco.MjModel) -> None:
        begin = np.array([0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0])
        half_turn = np.array([1.0, 0.0, 0.0, np.cos(0.6), 0.0, 0.0, np.sin(0.6)])

        # The other sign of the quaternion is the same rotation.
        half_turn[3:] *= -1.0
        found = positions_at(
            flying, np.array([0.0, 2.0]), np.stack([begin, half_turn]), np.array([-1.0, 1.0, 9.0])
        )
        np.testing.assert_allclose(found[0], begin)
        middle = [0.5, 0.0, 0.0, np.cos(0.3), 0.0, 0.0, np.sin(0.3)]
        np.testing.assert_allclose(found[1], middle, atol=1e-12)
        np.testing.assert_allclose(found[2, :3], half_turn[:3])

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

        film = film_of_estimate(model, motion(t, qpos), None)
        assert film.follows == follows
        (view,) = film.views
        travelled = view.target[-1, 0] - view.target[0, 0]
        assert travelled == pytest.approx(scale * distance if follows else 0.0, rel=0.1)

    @pytest.mark.parametrize(("axis", "size"), [("0 0 1", (640, 360)), ("0 1 0", (480, 480))])
    def test_the_shape_of_a_view_makes_the_robot_large(
        self, axis: str, size: tuple[int, int]
    ) -> None:
        """A rod that turns in the horizontal plane is wide, one in an upright plane is square."""
        text = SWING.replace('axis="0 1 0"', f'axis="{axis}"').replace("0 0 -1", "0.8 0 -0.1")
        t = np.linspace(0.0, 4.0, 81)
        turning = motion(t, 2.0 * np.pi * t[:, None] / t[-1])
        film = film_of_estimate(mujoco.MjModel.from_xml_string(text), turning, None)
        assert film.camera.size == size


class TestVideo:
    def test_other_endings_are_refused(self) -> None:
        assert format_of(Path("a.MP4")) == "mp4"
        with pytest.raises(RecordingError, match=r"ends in \.mp4 or \.gif"):
            format_of(Path("a.avi"))

    def test_drawing_may_be_turned_off(
        self, swing: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("MUJOCO_GL", "disable")
        with pytest.raises(NoVideoError, match="MUJOCO_GL turns drawing off"):
            render(film_of_estimate(swing, swinging(1.0), None), "gif")

    def test_a_report_says_why_it_has_no_video(self) -> None:
        """Nothing is drawn while tests run, see `tests/conftest.py`."""
        system = System.resolve(mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml"))
        resting = motion(np.array([0.0, 1.0]), np.zeros((2, 2)))
        with VideoBegun(system, resting) as begun:
            drawn = begun.result()
        assert drawn == (
            None,
            "There is no video of the robot: the variable MUJOCO_GL turns drawing off.",
        )

        # A motion that diverged cannot be drawn anywhere.
        diverged = motion(np.array([0.0, 1.0]), np.full((2, 2), np.nan))
        with VideoBegun(system, diverged) as begun:
            video, sentence = begun.result()
        assert video is None
        assert "positions that are not finite" in sentence

    def test_a_process_that_waits_draws_the_first_film_and_ends(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """One that nobody needs ends with its context."""
        monkeypatch.setattr(process, "PROGRAM", "import sys; print(sys.stdin.readline())")
        with process.process_waiting():
            assert process._waiting == {}  # drawing is turned off while tests run

        monkeypatch.setenv("MUJOCO_GL", "egl")
        with process.process_waiting():
            (waiting,) = process._waiting.values()
            with process.process_for(tmp_path, "egl") as drawing:
                assert drawing is waiting
                assert drawing.wait(timeout=60.0) == 0
        with process.process_waiting():
            (waiting,) = process._waiting.values()
        assert waiting.poll() is not None

    def test_a_process_that_was_ended_from_outside_is_replaced(
        self, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        """One that has failed is not: it shows that this kind of context does not work."""
        monkeypatch.setenv("MUJOCO_GL", "egl")
        for program, is_replaced in (("raise SystemExit(3)", True), ("raise ValueError", False)):
            monkeypatch.setattr(process, "PROGRAM", program)
            with process.process_waiting():
                (waiting,) = process._waiting.values()
                waiting.wait(timeout=60.0)
                with process.process_for(tmp_path, "egl") as drawing:
                    assert (drawing is not waiting) == is_replaced

    def test_without_another_process_there_is_no_video(
        self, swing: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        def fail(*_: Any, **__: Any) -> Any:
            raise OSError("no memory")

        monkeypatch.setenv("MUJOCO_GL", "egl")
        monkeypatch.setattr("mjfim.output.video.process.subprocess.Popen", fail)
        with process.process_waiting():
            assert process._waiting == {}
            reason = r"the process that draws it cannot be started \(no memory\)"
            with pytest.raises(NoVideoError, match=reason):
                render(film_of_estimate(swing, swinging(1.0), None), "gif")

    @pytest.mark.parametrize(("cores", "begun"), [(1, []), (2, ["pictures", "video"])])
    def test_a_single_processor_lets_no_process_wait(
        self, cores: int, begun: list[str], monkeypatch: pytest.MonkeyPatch
    ) -> None:
        started: list[str] = []

        @contextmanager
        def waiting() -> Iterator[None]:
            started.append("video")
            yield

        def pictures() -> None:
            started.append("pictures")

        monkeypatch.setattr("mjfim.parallel.cores", lambda: cores)
        monkeypatch.setattr(common, "_may_start_processes", True)
        monkeypatch.setattr(process, "process_waiting", waiting)
        monkeypatch.setattr("mjfim.output.drawing.DrawingProcess", pictures)
        with ExitStack() as claims:
            monkeypatch.setattr(common, "_claims", claims)
            common.draw_elsewhere(with_video=True)
        assert started == begun

    @pytest.mark.parametrize(
        ("wall", "processor", "counted"),
        [(1.0, 0.9, 0.9), (1.0, 1.9, 1.0), (2.0, 0.04, 1.0)],
        ids=["others use the processor", "two processors draw", "a graphics card draws"],
    )
    def test_waiting_for_a_graphics_card_counts(
        self, wall: float, processor: float, counted: float
    ) -> None:
        assert counted_seconds(wall, processor) == pytest.approx(counted)

    def test_a_stated_context_is_the_only_one(self, monkeypatch: pytest.MonkeyPatch) -> None:
        monkeypatch.setenv("MUJOCO_GL", "egl")
        assert back_ends() == ("egl",)
        monkeypatch.delenv("MUJOCO_GL")
        assert len(back_ends()) >= 1

    @pytest.mark.slow
    def test_a_context_that_cannot_be_opened_gives_a_sentence(
        self, swing: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setenv("MUJOCO_GL", "nonsense")
        with pytest.raises(NoVideoError, match="nothing with the variable MUJOCO_GL=nonsense"):
            render(film_of_estimate(swing, swinging(1.0), None), "gif")

    @pytest.mark.slow
    @pytest.mark.usefixtures("drawing")
    def test_a_driver_that_hangs_is_ended(
        self, swing: mujoco.MjModel, monkeypatch: pytest.MonkeyPatch
    ) -> None:
        monkeypatch.setattr(process, "PROGRAM", "import time; time.sleep(600.0)")
        monkeypatch.setattr(rendering, "START_SECONDS", 0.1)
        quick = Effort(seconds=0.1)
        with pytest.raises(NoVideoError, match=r"did not end within|took too long"):
            render(film_of_estimate(swing, swinging(1.0), None), "gif", quick)

    @pytest.mark.slow
    @pytest.mark.usefixtures("drawing")
    def test_mp4_shows_both_motions(self, swing: mujoco.MjModel, tmp_path: Path) -> None:
        av = pytest.importorskip("av", reason="mp4 needs the extra `video`")
        named = {"initial": swinging(4.0, 0.0), "final": swinging(4.0, 1.0)}
        video = drawn(film_of_trajectories(swing, named), "mp4")
        video.save(tmp_path / "film.mp4")

        assert video.media_type == "video/mp4"
        assert 1000 < len(video.data) < 2_000_000
        with av.open(str(tmp_path / "film.mp4")) as container:
            stream = container.streams.video[0]
            assert (stream.codec.name, stream.pix_fmt) == ("h264", "yuv420p")
            assert (stream.width, stream.height) == (video.width, video.height)
            frames = [frame.to_ndarray(format="rgb24") for frame in container.decode(stream)]

        # The left pendulum stands still, the right one moves.
        first, later = frames[0].astype(int), frames[len(frames) // 8].astype(int)
        change = np.abs(first - later)[40:380].max(axis=(0, 2))
        half = video.width // 2
        assert change[: half - 20].max() < 40 < change[half + 20 :].max()

    @pytest.mark.slow
    @pytest.mark.usefixtures("drawing")
    def test_gif_repeats_for_ever(self, swing: mujoco.MjModel) -> None:
        video = drawn(film_of_estimate(swing, swinging(3.0), swinging(3.0, 0.6)), "gif")
        with Image.open(io.BytesIO(video.data)) as picture:
            assert picture.format == "GIF"
            assert picture.size == (video.width, video.height)
            assert picture.info["loop"] == 0
            duration = picture.info["duration"] * getattr(picture, "n_frames", 1)
        assert duration == pytest.approx(3000.0, rel=0.1)

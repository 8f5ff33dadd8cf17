"""The stand-alone player: it plays simulated robots in plain MuJoCo, by a clock of their own."""

from __future__ import annotations

import importlib.util
import re
import subprocess
import sys
from collections.abc import Callable
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import Mock

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mjfim
from mjfim.experiment import System
from mjfim.output.export.design import write_player
from mjfim.output.export.trajectories import RobotPlan
from mjfim.recordings import read_recording
from mjfim.recordings.formats import read_table
from tests.output.conftest import Designed
from tests.support.cli import done
from tests.support.numerics import body_task
from tests.support.paths import MODELS

NAMES = ("qpos:slide", "qpos:hinge", "qvel:slide", "qvel:hinge")


class SimulatedRobot:
    """A cart-pendulum in plain MuJoCo, with its own clock, noise and the functions of a robot.

    Attributes:
        sent: The controls that were sent.
        before_row: Called by number of the reading; the check of the start is number 0.
    """

    def __init__(self, sigma: float = 0.0, seed: int = 0) -> None:
        self.model = mujoco.MjModel.from_xml_path(str(MODELS / "cart_pendulum.xml"))
        self.data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        self.sent: list[np.ndarray] = []
        self.before_row: dict[int, Callable[[], None]] = {}
        self._sigma, self._rng, self._readings = sigma, np.random.default_rng(seed), 0

    def read_state(self) -> dict[str, float]:
        self.before_row.get(self._readings, lambda: None)()
        self._readings += 1
        state = np.concatenate([self.data.qpos, self.data.qvel])
        state += self._sigma * self._rng.standard_normal(len(state))
        return dict(zip(NAMES, state.tolist(), strict=True))

    def send_control(self, u: np.ndarray) -> None:
        self.sent.append(u.copy())
        self.data.ctrl[:] = u

    def sleep(self, seconds: float) -> None:
        mujoco.mj_step(self.model, self.data, round(seconds / self.model.opt.timestep))


@pytest.fixture(scope="module")
def script(cart: Designed, tmp_path_factory: pytest.TempPathFactory) -> Path:
    """The player of this design."""
    path = tmp_path_factory.mktemp("player") / "play.py"
    mjfim.export_design(*cart, path, to="player")
    return path


def imported(path: Path) -> Any:
    """A module by its path, as a user imports it."""
    spec = importlib.util.spec_from_file_location("exported_player", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


@pytest.fixture
def player(script: Path) -> Any:
    return imported(script)


def played(player: Any, robot: SimulatedRobot, path: Path, **options: Any) -> str:
    """Play on a simulated robot, in its own time."""
    player.time = SimpleNamespace(perf_counter=lambda: robot.data.time, sleep=robot.sleep)
    return str(player.play(robot, str(path), **options))


@pytest.mark.parametrize("feedback", [False, True])
@pytest.mark.slow
def test_parameters_are_identified_from_what_the_player_records(
    feedback: bool,
    player: Any,
    cart: Designed,
    tmp_path: Path,
) -> None:
    """A robot with the true parameters and the stated noise, with and without the gains."""
    log = tmp_path / "recording.csv"
    robot = SimulatedRobot(sigma=0.05, seed=3)
    said = played(player, robot, log, feedback=feedback)
    assert said.startswith("sent 400 rows, 0 left out") and said.endswith(str(log))

    system = System.resolve(cart[0])
    recording = read_recording(log, system.channels)
    assert_array_equal(recording.ctrl, np.array(robot.sent[:400]))
    assert np.array_equal(recording.ctrl, cart[1].trajectory.ctrl) is not feedback
    estimate = mjfim.identify(cart[0], [recording])
    off = np.abs(np.array(estimate.theta) - [2.0, 1.0, 1.0])
    assert (off < 0.5 * np.ptp(np.array(estimate.interval), axis=1)).all()
    # Feedback puts the noise of a measurement into the control, which looks like a delay.
    assert not estimate.misfit or (feedback and estimate.missing_terms[0].path == "output:delay")


def test_feedback_is_the_gain_times_the_deviation_within_limits(
    player: Any, cart: Designed, tmp_path: Path
) -> None:
    """Each control is that of a loop of its own; those beyond the limits are clipped."""
    robot = SimulatedRobot()
    robot.data.qpos[:] += [0.3, -0.1]
    player.START_TOLERANCE = np.inf
    log = tmp_path / "recording.csv"
    said = played(player, robot, log, feedback=True)
    found, planned = read_table(log), cart[1].trajectory.state
    measured = np.column_stack([found[name] for name in NAMES])
    assert abs(measured[0] - [0.3, np.pi - 0.1, 0.0, 0.0]).max() < 1e-12
    gains = cart[1].final.gain[:, 0]
    feedback = np.einsum("ki,ki->k", gains, planned[:-1] - measured[:-1])
    wanted = cart[1].trajectory.ctrl[:, 0] + feedback
    sent = found["ctrl:force"]
    assert_allclose(sent[:-1], np.clip(wanted, -20.0, 20.0), atol=1e-9)
    assert f"{int((np.abs(wanted) > 20.0).sum())} clipped" in said
    assert np.isnan(sent[-1]) and len(found["t"]) == 401


def test_what_is_not_measured_has_no_feedback(player: Any, tmp_path: Path) -> None:
    planned = player.X[5]
    some = player.deviation(planned, {"qpos:hinge": planned[1] - 0.1, "qvel:slide": float("nan")})
    assert_allclose(some, [0.0, 0.1, 0.0, 0.0], atol=1e-15)
    with pytest.raises(ValueError, match="'qpos:hing' is not in the model"):
        player.measured(SimpleNamespace(read_state=lambda: {"qpos:hing": 0.0}))


def test_rotations_are_subtracted_as_mujoco_does(tmp_path: Path) -> None:
    """Deviations of free and ball joints agree with mj_differentiatePos at random states."""
    quick = {"descent": {"max_iterations": 1}, "rehearsal": {"robots": 0}}
    task = body_task(tmp_path, rate=25.0, horizon=0.4, **quick)
    write_player(tmp_path / "play.py", RobotPlan.of(mjfim.design(task.experiment), task.system))
    player = imported(tmp_path / "play.py")

    model, rng = task.system.model, np.random.default_rng(1)
    for planned in player.X:
        state = planned + 0.5 * rng.standard_normal(len(planned))
        for q, _ in player.DESIGN["quaternions"]:
            state[q : q + 4] /= np.linalg.norm(state[q : q + 4])
        wanted = np.zeros(model.nv)
        mujoco.mj_differentiatePos(model, wanted, 1.0, state[: model.nq], planned[: model.nq])
        found = player.deviation(planned, dict(zip(player.STATE, state.tolist(), strict=True)))
        assert_allclose(found[: model.nv], wanted, atol=1e-12)
        assert_allclose(found[model.nv :], (planned - state)[model.nq :], atol=1e-15)


@pytest.mark.parametrize("error", [KeyboardInterrupt, OSError])
@pytest.mark.parametrize("has_stop", [False, True])
def test_an_early_end_makes_the_robot_safe_and_keeps_the_recording(
    error: type[BaseException], has_stop: bool, player: Any, tmp_path: Path
) -> None:
    """After Ctrl-C or an error, `stop` is called, or motors get 0."""
    robot, stopped = SimulatedRobot(), []
    robot.before_row[21] = Mock(side_effect=error)
    if has_stop:
        robot.stop = lambda: stopped.append(len(robot.sent))
    with pytest.raises(error):
        played(player, robot, tmp_path / "recording.csv")
    assert stopped == ([20] if has_stop else [])
    assert len(robot.sent) == (20 if has_stop else 21)
    assert has_stop or robot.sent[-1] == 0.0
    assert len(read_table(tmp_path / "recording.csv")["t"]) == 20


def test_a_late_computer_leaves_rows_out_and_keeps_the_time(
    player: Any, cart: Designed, tmp_path: Path
) -> None:
    """After a pause of 30 ms the next row is that of the clock; the motion ends on time."""
    robot = SimulatedRobot()
    robot.before_row[101] = lambda: robot.sleep(0.03)
    said = played(player, robot, tmp_path / "recording.csv")
    found = read_table(tmp_path / "recording.csv")
    assert said.startswith("sent 398 rows, 2 left out")
    assert_allclose(found["t"][98:103], [0.98, 0.99, 1.0, 1.03, 1.04], atol=1e-9)
    assert_array_equal(found["ctrl:force"][101], cart[1].trajectory.ctrl[103, 0])
    assert found["t"][-1] == pytest.approx(4.0, abs=1e-9)


def test_nothing_is_sent_far_from_the_start(player: Any, tmp_path: Path) -> None:
    robot = SimulatedRobot()
    robot.data.qpos[1] = 0.0
    with pytest.raises(ValueError, match=r"qpos:hinge is 0, but the design begins at 3\.14"):
        played(player, robot, tmp_path / "recording.csv")
    assert not robot.sent and not list(tmp_path.iterdir())

    (tmp_path / "recording.csv").write_text("mine", encoding="utf-8")
    with pytest.raises(FileExistsError, match="choose another name"):
        played(player, robot, tmp_path / "recording.csv")


@pytest.mark.slow
def test_the_player_runs_as_a_program(script: Path, tmp_path: Path) -> None:
    """Without a robot it says what the design needs; with one it plays and says what it did."""
    python = (sys.executable, str(script))
    said = subprocess.run(python, capture_output=True, text=True, check=True).stdout
    assert "4 s, 400 rows at 100 Hz" in said and "Use them where small errors grow" in said
    assert "limits of force: [-20.] to [20.]" in said

    robot = tmp_path / "my_robot.py"
    robot.write_text("def read_state():\n    return {}\n\nsend_control = print\n", "utf-8")
    words = (*python, str(robot), str(tmp_path / "recording.csv"), "--feedback")
    said = subprocess.run(words, capture_output=True, text=True, check=True).stdout
    assert "left out, 0 clipped; wrote" in said.splitlines()[-1]
    assert len(read_table(tmp_path / "recording.csv")["t"]) > 100


def test_the_player_stands_alone(script: Path) -> None:
    """It imports the standard library and NumPy only."""
    text = script.read_text(encoding="utf-8")
    imported_modules = set(re.findall(r"^ *(?:import|from) (\w+)", text, re.MULTILINE))
    assert imported_modules - sys.stdlib_module_names == {"numpy"}


def test_servos_hold_their_last_command(arm: Designed, tmp_path: Path) -> None:
    """The safe control of a position servo is no number."""
    mjfim.export_design(*arm, tmp_path / "play.py", to="player")
    player = imported(tmp_path / "play.py")
    assert np.isnan(player.SAFE).all() and player.LOWER[0] == -2.6


def test_the_verb_writes_the_player(cart: Designed, tmp_path: Path) -> None:
    cart[1].save(tmp_path / "design")
    words = ("export", tmp_path / "design", "--experiment", MODELS / "cart_pendulum.toml")
    done(*words, "--to", "player", "-o", tmp_path / "play.py")
    assert imported(tmp_path / "play.py").COUNT == 400

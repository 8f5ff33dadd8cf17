"""The stand-alone player: it plays simulated robots in plain MuJoCo, by a clock of their own."""

from __future__ import annotations

import ast
import importlib.util
import signal
import sys
from collections.abc import Callable
from functools import partial
from pathlib import Path
from types import ModuleType
from typing import Any

import mujoco
import numpy as np
import pytest

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.experiment import System
from mjfim.output import archive
from mjfim.output.playback import GAIN_NOTE
from mjfim.output.robot.plan import RobotPlan
from mjfim.output.robot.player_script import player_source
from mjfim.recordings import read_recording
from mjfim.recordings.formats.read import read_table
from tests.support.cli import run
from tests.support.numerics import body_task
from tests.support.paths import MODELS

CART = MODELS / "cart_pendulum.toml"


class SimulatedRobot:
    """A cart-pendulum in plain MuJoCo, with its own clock, noise and two functions for the player.

    Attributes:
        sent: The controls that were sent.
    """

    def __init__(self, model: Path, sigma: float = 0.0, seed: int = 0) -> None:
        self.model = mujoco.MjModel.from_xml_path(str(model))
        self.data = mujoco.MjData(self.model)
        mujoco.mj_resetDataKeyframe(self.model, self.data, 0)
        self.sent: list[np.ndarray] = []
        self._sigma, self._rng = sigma, np.random.default_rng(seed)

    def read_state(self) -> dict[str, float]:
        state = np.concatenate([self.data.qpos, self.data.qvel])
        state += self._sigma * self._rng.standard_normal(len(state))
        names = ("qpos:slide", "qpos:hinge", "qvel:slide", "qvel:hinge")
        return dict(zip(names, state.tolist(), strict=True))

    def send_control(self, u: np.ndarray) -> None:
        self.sent.append(u.copy())
        self.data.ctrl[:] = u

    def clock(self) -> float:
        return float(self.data.time)

    def sleep(self, seconds: float) -> None:
        mujoco.mj_step(self.model, self.data, round(seconds / self.model.opt.timestep))


@pytest.fixture(scope="module")
def cart() -> tuple[mjfim.Experiment, mjfim.Design]:
    """A design of the cart-pendulum whose control has limits."""
    stated = mjfim.Experiment.from_file(CART)
    stated = stated.replace(
        descent={"max_iterations": 2}, limits={"control": {"force": [-20.0, 20.0]}}
    )
    return stated, mjfim.design(stated)


@pytest.fixture(scope="module")
def player(
    cart: tuple[mjfim.Experiment, mjfim.Design], tmp_path_factory: pytest.TempPathFactory
) -> ModuleType:
    """The player of this design, imported by its path as a user does."""
    path = tmp_path_factory.mktemp("player") / "play.py"
    mjfim.export_design(*cart, path, to="player")
    return imported(path)


def imported(path: Path) -> ModuleType:
    """A module by its path."""
    spec = importlib.util.spec_from_file_location("exported_player", path)
    assert spec is not None and spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    spec.loader.exec_module(module)
    return module


def played(player: ModuleType, robot: SimulatedRobot, path: Path, **options: Any) -> Any:
    """Play on a simulated robot, in its own time."""
    functions = (options.pop("read_state", robot.read_state), robot.send_control)
    return player.play(
        *functions, output=str(path), clock=robot.clock, sleep=robot.sleep, **options
    )


@pytest.mark.parametrize("feedback", [False, True])
@pytest.mark.slow
def test_parameters_are_identified_from_what_the_player_records(
    feedback: bool,
    player: ModuleType,
    cart: tuple[mjfim.Experiment, mjfim.Design],
    tmp_path: Path,
) -> None:
    """A robot with the true parameters and the stated noise, with and without the gains."""
    log = tmp_path / "recording.csv"
    robot = SimulatedRobot(MODELS / "cart_pendulum.xml", sigma=0.05, seed=3)
    report = played(player, robot, log, feedback=feedback)
    assert (report.rows, report.skipped, report.interrupted) == (400, 0, False)
    assert report.output == str(log) and report.latest < 1e-9

    system = System.resolve(cart[0])
    recording = read_recording(log, system.channels)
    np.testing.assert_array_equal(recording.ctrl, np.array(robot.sent[:400]))
    assert np.array_equal(recording.ctrl, cart[1].trajectory.ctrl) is not feedback
    estimate = mjfim.identify(cart[0], [recording])
    off = np.abs(np.array(estimate.theta) - [2.0, 1.0, 1.0])
    assert (off < 0.5 * np.ptp(np.array(estimate.interval), axis=1)).all()
    # Feedback puts the noise of a measurement into the control, which looks like a delay.
    assert not estimate.misfit or (feedback and estimate.missing_terms[0].path == "output:delay")


def test_feedback_is_the_gain_times_the_deviation_within_limits(
    player: ModuleType, cart: tuple[mjfim.Experiment, mjfim.Design], tmp_path: Path
) -> None:
    """Each control is that of a loop of its own; those beyond the limits are clipped."""
    robot = SimulatedRobot(MODELS / "cart_pendulum.xml")
    robot.data.qpos[:] += [0.3, -0.1]
    log = tmp_path / "recording.csv"
    report = played(player, robot, log, feedback=True, start_tolerance=np.inf)
    found, planned = read_table(log), cart[1].trajectory.state
    measured = np.column_stack(
        [found[name] for name in ("qpos:slide", "qpos:hinge", "qvel:slide", "qvel:hinge")]
    )
    assert abs(measured[0] - [0.3, np.pi - 0.1, 0.0, 0.0]).max() < 1e-12
    wanted = [
        u + K @ (p - m)
        for u, K, p, m in zip(
            cart[1].trajectory.ctrl, cart[1].final.gain, planned[:-1], measured[:-1], strict=True
        )
    ]
    np.testing.assert_allclose(
        found["ctrl:force"][:-1], np.clip(np.array(wanted)[:, 0], -20.0, 20.0), atol=1e-9
    )
    assert report.clipped == int((np.abs(wanted) > 20.0).sum())
    assert np.isnan(found["ctrl:force"][-1]) and len(found["t"]) == 401


def test_what_is_not_measured_has_no_feedback(player: ModuleType, tmp_path: Path) -> None:
    """Missing entries count as planned; a list holds all positions, then all velocities."""
    plan = player.Plan.of(player.SETTINGS, player.ROWS)
    some = plan.deviation(5, {"qpos:hinge": plan.states[5, 1] - 0.1, "qvel:slide": float("nan")})
    np.testing.assert_allclose(some, [0.0, 0.1, 0.0, 0.0], atol=1e-15)
    assert plan.measured([1, 2, 3, 4])["qvel:slide"] == 3.0
    with pytest.raises(player.PlayError, match="returned 3 numbers; expected 4, which are qpos:"):
        plan.measured([1, 2, 3])
    with pytest.raises(player.PlayError, match="'qpos:hing', which is not in the model"):
        plan.measured({"qpos:hing": 0.0})


def test_rotations_are_subtracted_as_mujoco_does(tmp_path: Path) -> None:
    """Deviations of free and ball joints agree with mj_differentiatePos at random states."""
    task = body_task(tmp_path, rate=25.0, horizon=0.4)
    design = mjfim.design(task.experiment.replace(descent={"max_iterations": 1}))
    path = tmp_path / "play.py"
    path.write_text(player_source(RobotPlan.of(design, task.system)), encoding="utf-8")
    player = imported(path)
    plan = player.Plan.of(player.SETTINGS, player.ROWS)

    model, rng = task.system.model, np.random.default_rng(1)
    for row in range(len(plan.ctrl)):
        state = plan.states[row] + 0.5 * rng.standard_normal(plan.states.shape[1])
        for q, _ in plan.quaternions:
            state[q : q + 4] /= np.linalg.norm(state[q : q + 4])
        wanted = np.zeros(model.nv)
        mujoco.mj_differentiatePos(
            model, wanted, 1.0, state[: model.nq], plan.states[row, : model.nq]
        )
        measured = dict(zip(plan.names, state.tolist(), strict=True))
        found = plan.deviation(row, measured)
        np.testing.assert_allclose(found[: model.nv], wanted, atol=1e-12)
        np.testing.assert_allclose(
            found[model.nv :], plan.states[row, model.nq :] - state[model.nq :], atol=1e-15
        )


def after(rows: int, robot: SimulatedRobot, action: Callable[[], None]) -> Callable[[], Any]:
    """A `read_state` that does something at a row; the check of the start reads once before."""
    count = iter(range(-1, 10_000))

    def read_state() -> Any:
        if next(count) == rows:
            action()
        return robot.read_state()

    return read_state


def test_ctrl_c_makes_the_robot_safe_and_keeps_the_recording(
    player: ModuleType, tmp_path: Path
) -> None:
    """The row is finished, then motors get 0; the signals do again what they did before."""
    robot = SimulatedRobot(MODELS / "cart_pendulum.xml")
    before = signal.getsignal(signal.SIGINT)
    press = after(20, robot, lambda: signal.raise_signal(signal.SIGINT))
    report = played(player, robot, tmp_path / "recording.csv", read_state=press)
    assert report.interrupted and report.rows == 21
    assert len(robot.sent) == 22 and robot.sent[-1] == 0.0
    assert len(read_table(tmp_path / "recording.csv")["t"]) == 21
    assert signal.getsignal(signal.SIGINT) is before


def test_an_error_of_the_robot_makes_it_safe_too(player: ModuleType, tmp_path: Path) -> None:
    """The error is raised after `stop` was called and the recording written."""
    robot, stopped = SimulatedRobot(MODELS / "cart_pendulum.xml"), []

    def fail() -> None:
        raise OSError("no answer")

    with pytest.raises(OSError, match="no answer"):
        played(
            player,
            robot,
            tmp_path / "recording.csv",
            read_state=after(5, robot, fail),
            stop=lambda: stopped.append(len(robot.sent)),
        )
    assert stopped == [5] and len(read_table(tmp_path / "recording.csv")["t"]) == 5


def test_a_late_computer_leaves_rows_out_and_keeps_the_time(
    player: ModuleType, cart: tuple[mjfim.Experiment, mjfim.Design], tmp_path: Path
) -> None:
    """After a pause of 35 ms the next row is that of the clock; the motion ends on time."""
    robot = SimulatedRobot(MODELS / "cart_pendulum.xml")
    pause = after(100, robot, lambda: robot.sleep(0.03))
    report = played(player, robot, tmp_path / "recording.csv", read_state=pause)
    found = read_table(tmp_path / "recording.csv")
    assert report.skipped == 2 and report.rows == 398
    np.testing.assert_allclose(found["t"][98:103], [0.98, 0.99, 1.0, 1.03, 1.04], atol=1e-9)
    np.testing.assert_array_equal(found["ctrl:force"][101], cart[1].trajectory.ctrl[103, 0])
    assert found["t"][-1] == pytest.approx(4.0, abs=1e-9)


def test_nothing_is_sent_far_from_the_start(player: ModuleType, tmp_path: Path) -> None:
    robot = SimulatedRobot(MODELS / "cart_pendulum.xml")
    robot.data.qpos[1] = 0.0
    with pytest.raises(player.PlayError, match=r"qpos:hinge is 0, but the design begins at 3\.14"):
        played(player, robot, tmp_path / "recording.csv")
    assert not robot.sent and not list(tmp_path.iterdir())

    (tmp_path / "recording.csv").write_text("mine", encoding="utf-8")
    with pytest.raises(FileExistsError, match="choose another name"):
        played(player, robot, tmp_path / "recording.csv")


def test_controls_beyond_their_limits_are_refused(player: ModuleType) -> None:
    narrow = {**player.SETTINGS, "upper": [0.5]}
    with pytest.raises(player.PlayError, match=r"planned control force is .* outside -20 to 0\.5"):
        player.Plan.of(narrow, player.ROWS)


def test_the_player_runs_as_a_program(
    player: ModuleType,
    tmp_path: Path,
    capsys: pytest.CaptureFixture[str],
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Without a robot it says what the design needs; with one it plays and says what it did."""
    assert player.main([]) == 0
    said = capsys.readouterr().out
    assert "4 s, 400 rows at 100 Hz" in said and "Use them where small errors grow" in said
    assert "limits -20 to 20" in said

    # A clock that runs as fast as it is asked.
    now = [0.0]
    monkeypatch.setattr(
        player,
        "play",
        partial(
            player.play,
            clock=lambda: now[0],
            sleep=lambda seconds: now.__setitem__(0, now[0] + seconds),
        ),
    )
    robot = tmp_path / "my_robot.py"
    robot.write_text(
        "def read_state():\n    return {}\n\ndef send_control(u):\n    pass\n", encoding="utf-8"
    )
    assert player.main([str(robot), "-o", str(tmp_path / "recording.csv")]) == 0
    assert "sent 400 rows, 0 left out, 0 clipped" in capsys.readouterr().out


def test_the_player_stands_alone(player: ModuleType) -> None:
    """It imports the standard library and NumPy only."""
    assert player.__file__ is not None
    tree = ast.parse(Path(player.__file__).read_text(encoding="utf-8"))
    found = {
        name.split(".")[0]
        for node in ast.walk(tree)
        for name in (
            [alias.name for alias in node.names]
            if isinstance(node, ast.Import)
            else [node.module or ""]
            if isinstance(node, ast.ImportFrom)
            else []
        )
    }
    assert found - set(sys.stdlib_module_names) == {"numpy"}


def test_servos_hold_their_last_command(tmp_path: Path) -> None:
    """The safe control of a position servo is no number; that of a motor is 0 within limits."""
    stated = mjfim.Experiment.from_file(MODELS / "servo_arm.toml")
    stated = stated.replace(horizon=0.5, descent={"max_iterations": 1})
    mjfim.export_design(stated, mjfim.design(stated), tmp_path / "play.py", to="player")
    player = imported(tmp_path / "play.py")
    assert player.SETTINGS["safe"] == [None] * 4 and player.SETTINGS["lower"][0] == -2.6


def test_the_header_of_the_design_says_when_to_use_the_gains(
    cart: tuple[mjfim.Experiment, mjfim.Design], tmp_path: Path
) -> None:
    """Readers of columns are not disturbed: the note is the name of a last column of zeros."""
    archive.write_design(tmp_path, cart[1], System.resolve(cart[0]))
    lines = (tmp_path / "design.csv").read_text(encoding="utf-8").splitlines()
    assert lines[0].split(",")[-1] == f'"note: {GAIN_NOTE}"' and "Use them where" in lines[0]
    assert {line.split(",")[-1] for line in lines[1:]} == {"0"}
    again = cart[0].replace(initial={"control": str(tmp_path / "design.csv")})
    np.testing.assert_array_equal(DesignTask.resolve(again).initial.ctrl, cart[1].trajectory.ctrl)


def test_the_verb_writes_the_player(
    cart: tuple[mjfim.Experiment, mjfim.Design], tmp_path: Path
) -> None:
    cart[1].save(tmp_path / "design")
    words = ("export", tmp_path / "design", "--experiment", CART, "--to", "player")
    done = run(*words, "-o", tmp_path / "play.py")
    assert done.exit_code == 0, done.stderr
    assert len(imported(tmp_path / "play.py").ROWS) == 402

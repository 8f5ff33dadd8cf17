"""The live meter: σ from the rows of a stream, compared with that of the whole recording."""

from __future__ import annotations

import gzip
import json
from collections.abc import Iterator
from dataclasses import replace

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

import mjfim
from mjfim.errors import ExperimentError, RecordingError, SimulationDivergedError
from mjfim.experiment.system import System
from mjfim.identification import meter as meter_module
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.search import FitTask
from mjfim.information.criteria import standard_deviations
from mjfim.records.trajectory import Recording
from tests.support.cart_pendulum import cart_pendulum, logs_of
from tests.support.paths import SHARED_DATA, SHARED_MODELS

Array = NDArray[np.float64]

# Relative difference between one-sided differences of a stream and two-sided ones of a recording.
TOLERANCE = 1e-3

# The true robot, and the same robot as its user knows it.
STUDY = cart_pendulum()
AT_GUESS = {"cost": {"linearize_at": "guess"}}


@pytest.fixture(scope="module")
def log() -> Recording:
    """Four seconds at 100 Hz."""
    return logs_of(STUDY, 1)[0]


def rows_of(log: Recording) -> tuple[Array, Array, Array]:
    """Times, controls and outputs; the last control acts after the end."""
    return log.t, np.concatenate([log.ctrl, log.ctrl[-1:]]), log.y


def watched(
    experiment: mjfim.Experiment, log: Recording, rng: np.random.Generator | None = None
) -> mjfim.Watch:
    """What is known at the end of a stream, read every few rows, or at the end only."""
    meter = mjfim.Meter(experiment, threads=1)
    assert meter.system.outputs.names == log.outputs
    for row in zip(*rows_of(log), strict=True):
        meter.add(*row)
        if rng is not None and rng.random() < 0.05:
            meter.read()
    return meter.read(ended=True)


def std_of_recording(experiment: mjfim.Experiment, log: Recording) -> Array:
    """(p,) formal standard deviations of the least-squares problem of a fit, at the guess."""
    problem = FitProblem.of(System.resolve(experiment, threads=1), [log])
    condensed = problem.condense(problem.begin(problem.parameters.guess))
    assert condensed is not None
    return standard_deviations(condensed.information())


@pytest.mark.parametrize(
    "fit",
    [
        pytest.param({}, id="from the stated start"),
        pytest.param({"start": "measured"}, id="from a measured start"),
        pytest.param({"segments": 0.5}, id="segments"),
        pytest.param({"segments": 1.0, "hold": ["m"]}, id="a held parameter"),
    ],
)
def test_a_stream_tells_what_a_fit_of_the_recording_predicts(
    fit: dict[str, object], log: Recording
) -> None:
    experiment = cart_pendulum(fit=fit)
    found = watched(experiment, log, np.random.default_rng(2))
    np.testing.assert_allclose(found.std, std_of_recording(experiment, log), rtol=TOLERANCE)
    assert found.rows == len(log.t) and found.t[-1] == pytest.approx(4.0)
    # Formal standard deviations only fall.
    known = np.isfinite(found.std_over_time).all(axis=1)
    falls = np.diff(found.std_over_time[known], axis=0)
    assert known.sum() > 10 and (falls <= 1e-9 * found.std).all()


def test_a_stream_may_begin_in_the_middle_of_a_motion(log: Recording) -> None:
    """As in a fit, the initial state is estimated then, and a sentence says so."""
    late = Recording(t=log.t[100:], ctrl=log.ctrl[100:], y=log.y[100:], outputs=log.outputs)
    found = watched(STUDY, late, np.random.default_rng(9))
    assert "does not begin where [initial] says" in found.warnings[0]
    problem = FitTask.of(System.resolve(STUDY, threads=1), [late]).problem()
    condensed = problem.condense(problem.begin(problem.parameters.guess))
    assert problem.free_starts and condensed is not None
    # The state at the begin follows from the first rows alone, which is the same in both.
    expected = standard_deviations(condensed.information())
    np.testing.assert_allclose(found.std, expected, rtol=TOLERANCE)


def test_a_stream_tells_what_check_predicts(log: Recording) -> None:
    experiment = cart_pendulum(**AT_GUESS, rehearsal={"robots": 0})
    log = log.first_rows(201)
    check = mjfim.check(experiment, [log], threads=1, progress=False)
    steps = check.steps
    assert steps is None or steps.confirmed.all()
    found = watched(experiment, log, np.random.default_rng(3))
    np.testing.assert_allclose(found.std, [row.std for row in check.rows], rtol=TOLERANCE)


def test_the_information_is_that_of_plain_simulations(log: Recording) -> None:
    experiment = cart_pendulum()
    system = System.resolve(experiment, threads=1)
    guess = system.parameters.guess

    def outputs(theta: Array) -> Array:
        """States at the samples, by a plain loop."""
        model = system.model_at(theta)
        data = mujoco.MjData(model)
        mujoco.mj_resetDataKeyframe(model, data, 0)
        states = []
        for u in log.ctrl:
            data.ctrl[:] = u
            mujoco.mj_step(model, data, nstep=round(0.01 / model.opt.timestep))
            states.append(np.concatenate([data.qpos, data.qvel]))
        return np.array(states)

    moves = 1e-5 * np.diag(guess)
    G = np.stack([(outputs(guess + h) - outputs(guess - h)) / (2.0 * h.sum()) for h in moves], -1)
    rows = (G / system.noise.sigma[:, None]).reshape(-1, len(guess))
    expected = np.sqrt(np.diag(np.linalg.inv(rows.T @ rows)))
    np.testing.assert_allclose(watched(experiment, log).std, expected, rtol=TOLERANCE)


def test_an_end_that_is_no_whole_segment_counts_nearly_as_in_a_fit(log: Recording) -> None:
    experiment = cart_pendulum(fit={"segments": 0.7})
    found = watched(experiment, log, np.random.default_rng(4))
    np.testing.assert_allclose(found.std, std_of_recording(experiment, log), rtol=0.1)


def test_every_row_is_simulated_once(log: Recording) -> None:
    def steps(rng: np.random.Generator | None, rows: int) -> int:
        """Engine steps of a stream."""
        meter = mjfim.Meter(STUDY, threads=1)
        t, ctrl, y = (column[:rows] for column in rows_of(log))
        for row in range(rows):
            meter.add(t[row], ctrl[row], y[row])
            if rng is not None and rng.random() < 0.1:
                meter.read()
        meter.read(ended=True)
        return meter.system.plant.simulator.steps

    begin, half, whole = (steps(np.random.default_rng(5), rows) for rows in (30, 200, 370))
    assert whole - half == half - begin
    assert steps(None, 370) == whole


def test_rows_between_samples_and_missing_values(log: Recording) -> None:
    rng = np.random.default_rng(6)
    t = log.t + np.append(0.0, rng.uniform(0.0, 0.004, len(log.t) - 1))
    y = np.where(rng.random(log.y.shape) < 0.2, np.nan, log.y)
    jittered = Recording(t=t, ctrl=log.ctrl, y=y, outputs=log.outputs)
    found = watched(STUDY, jittered, rng)
    np.testing.assert_allclose(found.std, std_of_recording(STUDY, jittered), rtol=TOLERANCE)


def test_priors_count_as_in_a_fit(log: Recording) -> None:
    stated = {"c": {"target": "joint/hinge:damping", "guess": 1.0, "prior": 0.01, "wanted": 0.02}}
    experiment = STUDY.replace(parameters=stated)
    found = watched(experiment, log)
    j = found.parameters.index("c")
    assert found.std[j] < 0.01 and found.enough
    np.testing.assert_allclose(found.std, std_of_recording(experiment, log), rtol=TOLERANCE)
    # At the first result, the prior alone suffices.
    assert found.reached[j] < np.inf and found.asked.tolist() == [j]


def test_what_cannot_be_told_apart_is_never_enough(log: Recording) -> None:
    experiment = STUDY.replace(
        parameters={
            "gear": {"target": "actuator/force:gear[0]"},
            "gain": {"target": "actuator/force:gainprm[0]"},
        }
    )
    found = watched(experiment, log)
    std = dict(zip(found.parameters, found.std.tolist(), strict=True))
    assert std["gear"] == std["gain"] == np.inf and np.isfinite(std["l"])
    assert not found.enough


def test_the_time_that_is_left_follows_from_the_rate(log: Recording) -> None:
    found = watched(STUDY, log, np.random.default_rng(7))
    asked = replace(found, wanted=found.std / np.sqrt(2.0))
    # All information so far came in 4 s, so that as much again takes about 4 s.
    assert asked.seconds_left == pytest.approx(4.0, rel=0.05)


def test_a_long_stream_keeps_a_bounded_history(
    log: Recording, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(meter_module, "MAX_TIMES", 20)
    meter = mjfim.Meter(STUDY, threads=1)
    for k, row in enumerate(zip(*rows_of(log), strict=True)):
        meter.add(*row)
        if k % 4 == 0:
            meter.read()
    found = meter.read(ended=True)
    assert len(found.t) <= 2 * 20 + 1 and found.t[-1] == pytest.approx(4.0)
    np.testing.assert_allclose(found.std, watched(STUDY, log).std, rtol=TOLERANCE)
    assert found.t[0] == 0.0 and np.diff(found.t).max() < 0.5


class TestMisuse:
    def test_rows_of_another_shape(self) -> None:
        meter = mjfim.Meter(STUDY, threads=1)
        for ctrl, measured in (([0.0, 1.0], np.zeros(4)), ([0.0], np.zeros(3))):
            with pytest.raises(RecordingError, match="expected 1 and 4"):
                meter.add(0.0, ctrl, measured)

    def test_times_that_do_not_increase(self) -> None:
        meter = mjfim.Meter(STUDY, threads=1)
        meter.add(0.0, [0.0], np.zeros(4))
        with pytest.raises(RecordingError, match="it must increase"):
            meter.add(0.0, [0.0], np.zeros(4))
        with pytest.raises(RecordingError, match="'ctrl:force' has no value"):
            meter.add(0.1, [np.nan], np.zeros(4))

    def test_a_clock_that_jumps(self) -> None:
        meter = mjfim.Meter(STUDY, threads=1)
        for t in (0.0, 0.01, 0.9):
            meter.add(t, [0.0], np.zeros(4))
        with pytest.raises(RecordingError, match=r"a gap of 1e\+06 s; .* raise recording.gap"):
            meter.add(1e6, [0.0], np.zeros(4))
        # A slow recording has no gaps.
        slow = mjfim.Meter(STUDY, threads=1)
        for t in (0.0, 3.0, 6.0):
            slow.add(t, [0.0], np.zeros(4))

    def test_too_few_rows(self) -> None:
        meter = mjfim.Meter(STUDY, threads=1)
        meter.add(0.0, [0.0], np.zeros(4))
        meter.add(0.01, [0.0], np.zeros(4))
        assert not np.isfinite(meter.std).any()
        with pytest.raises(RecordingError, match="too few rows"):
            meter.read(ended=True)

    def test_a_model_that_diverges(self) -> None:
        meter = mjfim.Meter(STUDY, threads=1)
        for k in range(100):
            meter.add(0.01 * k, [1e9], np.zeros(4))
        with pytest.raises(SimulationDivergedError, match="segments = SECONDS"):
            meter.read()

    def test_control_laws(self) -> None:
        law = {"force": {"kp": 1.0}}
        with pytest.raises(ExperimentError, match="without control laws"):
            mjfim.Meter(cart_pendulum(controllers=law), threads=1)


JOINTS = ("shoulder_pan", "shoulder_lift", "elbow_flex", "wrist_flex", "wrist_roll", "gripper")


def so101(rows: int) -> tuple[mjfim.Experiment, Recording]:
    """24 unknowns of a six-joint arm, and the begin of its measured motion."""

    def column(file: str, name: str) -> Iterator[list[float]]:
        """The arrays that the cells of a column hold."""
        with gzip.open(SHARED_DATA / "sage_so101" / "multisine" / file, "rt") as lines:
            place = next(lines).strip().split(",").index(name)
            for _, line in zip(range(rows), lines, strict=False):
                head, *arrays = line.strip().split(',"')
                cells = [*head.split(","), *(array.rstrip('"') for array in arrays)]
                yield json.loads(cells[place])

    fields = {
        "kp": ("actuator/{}:kp", 17.8),
        "damping": ("joint/{}:damping", None),
        "friction": ("joint/{}:frictionloss", None),
        "armature": ("joint/{}:armature", None),
    }
    parameters = {
        f"{name}_{joint}": {"target": path.format(joint), **({"guess": guess} if guess else {})}
        for joint in JOINTS
        for name, (path, guess) in fields.items()
    }
    experiment = mjfim.Experiment(
        model=str(SHARED_MODELS / "so101" / "so101_nomesh.xml"),
        rate=50.0,
        parameters=parameters,
        noise={f"qpos:{joint}": 1.5e-3 for joint in JOINTS},
        source="so101.toml",
    )
    recording = Recording(
        t=1e-6 * np.array(list(column("state_motor.csv.gz", "timestamp"))),
        ctrl=np.array(list(column("control.csv.gz", "positions")))[:-1],
        y=np.array(list(column("state_motor.csv.gz", "positions"))),
        outputs=tuple(f"qpos:{joint}" for joint in JOINTS),
    )
    return experiment, recording


@pytest.mark.slow
@pytest.mark.parametrize(("segments", "tolerance"), [("whole", TOLERANCE), (1.0, 0.1)])
def test_a_measured_arm_of_24_parameters(segments: object, tolerance: float) -> None:
    """In the fit, segments are 1.003 s long, so that they begin in slightly other states."""
    experiment, log = so101(rows=151)
    experiment = experiment.replace(fit={"start": "measured", "segments": segments})
    found = watched(experiment, log, np.random.default_rng(8))
    assert len(found.parameters) == 24
    np.testing.assert_allclose(found.std, std_of_recording(experiment, log), rtol=tolerance)

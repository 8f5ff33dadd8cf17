"""The live meter: σ from the rows of a stream, compared with that of the whole recording."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

import mjfim
from mjfim.errors import ExperimentError, RecordingError, SimulationDivergedError
from mjfim.experiment.system import System
from mjfim.identification import meter as meter_module
from mjfim.identification.search import FitTask
from mjfim.information.criteria import standard_deviations
from mjfim.records.trajectory import Recording
from tests.support.cart_pendulum import cart_pendulum, logs_of

Array = NDArray[np.float64]

# Relative difference between one-sided differences of a stream and two-sided ones of a recording.
TOLERANCE = 1e-3

# The true robot, and the same robot as its user knows it.
STUDY = cart_pendulum()


@pytest.fixture(scope="module")
def log() -> Recording:
    """Four seconds at 100 Hz."""
    return logs_of(STUDY, 1)[0]


def watched(
    experiment: mjfim.Experiment,
    log: Recording,
    rng: np.random.Generator | None = None,
    share: float = 0.05,
) -> mjfim.Watch:
    """What is known at the end of a stream, read after a share of the rows, or at the end only.

    The last control acts after the end.
    """
    meter = mjfim.Meter(experiment, threads=1)
    assert meter.system.outputs.names == log.outputs
    for row in zip(log.t, np.append(log.ctrl, log.ctrl[-1:], axis=0), log.y, strict=True):
        meter.add(*row)
        if rng is not None and rng.random() < share:
            meter.read()
    return meter.read(ended=True)


def std_of_recording(experiment: mjfim.Experiment, log: Recording) -> Array:
    """(p,) formal standard deviations of the least-squares problem of a fit, at the guess."""
    problem = FitTask.of(System.resolve(experiment, threads=1), [log]).problem()
    condensed = problem.condense(problem.begin(problem.parameters.guess))
    return standard_deviations(condensed.information())


def late(log: Recording) -> Recording:
    """A log that begins in the middle of the motion."""
    return Recording(t=log.t[100:], ctrl=log.ctrl[100:], y=log.y[100:], outputs=log.outputs)


def irregular(log: Recording) -> Recording:
    """A log with rows between the samples and missing values."""
    rng = np.random.default_rng(6)
    t = log.t + np.append(0.0, rng.uniform(0.0, 0.004, len(log.t) - 1))
    return replace(log, t=t, y=np.where(rng.random(log.y.shape) < 0.2, np.nan, log.y))


@pytest.mark.parametrize(
    ("fit", "changed", "rtol"),
    [
        ({}, replace, TOLERANCE),
        ({}, late, TOLERANCE),
        ({}, irregular, TOLERANCE),
        ({"start": "measured"}, replace, TOLERANCE),
        ({"segments": 0.5}, replace, TOLERANCE),
        ({"segments": 1.0, "hold": ["m"]}, replace, TOLERANCE),
        # The end is no whole segment.
        ({"segments": 0.7}, replace, 0.1),
    ],
)
def test_a_stream_tells_what_a_fit_of_the_recording_predicts(
    fit: dict[str, object], changed: Any, rtol: float, log: Recording
) -> None:
    experiment, given = cart_pendulum(fit=fit), changed(log)
    found = watched(experiment, given, np.random.default_rng(2))
    assert_allclose(found.std, std_of_recording(experiment, given), rtol=rtol)
    assert found.rows == len(given.t) and found.t[-1] == pytest.approx(np.ptp(given.t), abs=0.01)
    said = any("does not begin where [initial] says" in each for each in found.warnings)
    assert said == (changed is late)
    # Formal standard deviations only fall.
    known = np.isfinite(found.std_over_time).all(axis=1)
    falls = np.diff(found.std_over_time[known], axis=0)
    assert known.sum() > 10 and (falls <= 1e-9 * found.std).all()


def test_priors_count_as_in_a_fit(log: Recording) -> None:
    stated = {"c": {"target": "joint/hinge:damping", "guess": 1.0, "prior": 0.01, "wanted": 0.02}}
    experiment = STUDY.replace(parameters=stated)
    found = watched(experiment, log)
    j = found.parameters.index("c")
    assert found.std[j] < 0.01 and found.enough
    assert_allclose(found.std, std_of_recording(experiment, log), rtol=TOLERANCE)
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
    found = watched(STUDY, log, np.random.default_rng(10), share=0.25)
    assert len(found.t) <= 2 * 20 + 1 and found.t[-1] == pytest.approx(4.0)
    assert_allclose(found.std, std_of_recording(STUDY, log), rtol=TOLERANCE)
    assert found.t[0] == 0.0 and np.diff(found.t).max() < 0.5


AT_REST = [(0.01 * k, [0.0], np.zeros(4)) for k in range(2)]


@pytest.mark.parametrize(
    ("rows", "error", "said"),
    [
        ([(0.0, [0.0, 1.0], np.zeros(4))], RecordingError, "expected 1 and 4"),
        ([(0.0, [0.0], np.zeros(3))], RecordingError, "expected 1 and 4"),
        ([AT_REST[0], AT_REST[0]], RecordingError, "it must increase"),
        ([(0.1, [np.nan], np.zeros(4))], RecordingError, "'ctrl:force' has no value"),
        (
            [*AT_REST, (0.9, [0.0], np.zeros(4)), (1e6, [0.0], np.zeros(4))],
            RecordingError,
            r"a gap of 1e\+06 s; .* raise recording.gap",
        ),
        (AT_REST, RecordingError, "too few rows"),
        (
            [(0.01 * k, [1e9], np.zeros(4)) for k in range(100)],
            SimulationDivergedError,
            "segments = SECONDS",
        ),
    ],
)
def test_misuse_is_explained(rows: list[Any], error: type[Exception], said: str) -> None:
    meter = mjfim.Meter(STUDY, threads=1)
    with pytest.raises(error, match=said):  # noqa: PT012
        for row in rows:
            meter.add(*row)
        assert len(rows) > 2 or not np.isfinite(meter.std).any()
        meter.read(ended=True)


def test_control_laws_are_refused() -> None:
    with pytest.raises(ExperimentError, match="without control laws"):
        mjfim.Meter(cart_pendulum(controllers={"force": {"kp": 1.0}}), threads=1)


def test_a_slow_recording_has_no_gaps() -> None:
    slow = mjfim.Meter(STUDY, threads=1)
    for t in (0.0, 3.0, 6.0):
        slow.add(t, [0.0], np.zeros(4))

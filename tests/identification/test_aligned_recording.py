"""Recordings on the sample grid.

The control keeps its impulse, measured values stay unchanged, and messages name faults.
"""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.errors import RecordingError
from mjfim.excitation.task import DesignTask
from mjfim.identification.aligned_recording import (
    align,
    measured_trajectory,
    resample_control,
)
from mjfim.records.trajectory import Recording
from tests.support.numerics import Array, body_task, cart_task
from tests.support.terms import recorded

DT = 0.01


@pytest.fixture(scope="module")
def task(tmp_path_factory: pytest.TempPathFactory) -> DesignTask:
    return cart_task(tmp_path_factory.mktemp("cart"))


@pytest.fixture(scope="module")
def body(tmp_path_factory: pytest.TempPathFactory) -> DesignTask:
    return body_task(tmp_path_factory.mktemp("body"), noise={"state": 0.01})


@pytest.mark.parametrize("mean", [0.11 * DT, DT, 2.3 * DT, 17.0 * DT])
def test_every_sample_holds_the_mean_of_the_control(mean: float) -> None:
    """The integral of the control from the first row to any sample is that of the recording.

    Rows are at random times, some of them close together, with gaps. Beyond the end, the last value
    is held.
    """
    rng = np.random.default_rng(round(mean / DT * 100))
    for _ in range(60):
        gaps = rng.choice([0.001, 0.3, 1.0, 1.0, 1.0, 1.7, 9.0], rng.integers(2, 60))
        t = np.append(0.0, np.cumsum(mean * gaps * rng.uniform(0.5, 1.5)))
        ctrl = rng.uniform(-5.0, 5.0, (len(t) - 1, 2)) + 100.0
        found = resample_control(t, ctrl, DT)
        edges = np.arange(len(found) + 1) * DT
        assert edges[-1] >= t[-1] - 0.01 * DT
        assert len(found) == 1 or edges[-2] < t[-1]
        begins, ends = t[:-1], np.append(t[1:-1], np.inf)
        expected = (np.clip(edges[1:, None], begins, ends) - begins) @ ctrl
        assert_allclose(np.cumsum(found, axis=0) * DT, expected, rtol=1e-10)


def test_control_on_the_grid_is_unchanged() -> None:
    """It is exactly equal, also after many samples; a row holds until the next one."""
    rng = np.random.default_rng(0)
    ctrl = rng.standard_normal((200_000, 3))
    assert_array_equal(resample_control(np.arange(200_001) * DT, ctrl, DT), ctrl)
    rows = rng.standard_normal((40, 1))
    coarse = resample_control(np.arange(41) * 5 * DT, rows, DT)
    assert_array_equal(coarse, np.repeat(rows, 5, axis=0))


def log(task: DesignTask, **changes: Any) -> Recording:
    """A recording of noise on the grid with some fields replaced."""
    rng = np.random.default_rng(0)
    values = {
        "t": np.arange(31) * task.dt,
        "ctrl": rng.standard_normal((30, len(task.controls))),
        "y": rng.standard_normal((31, len(task.system.outputs))),
        "outputs": task.system.outputs.names,
        "name": "x.csv",
    }
    return Recording(**{**values, **changes})


def test_a_recording_on_the_grid_is_unchanged(task: DesignTask) -> None:
    """Such a recording may have any first time, and its columns any order.

    Time stamps may deviate by a hundredth of a sample. Columns may be missing, and the last row may
    have a control.
    """
    plain = log(task)
    jitter = np.random.default_rng(1).uniform(-4e-5, 4e-5, len(plain.t))
    more = np.append(plain.ctrl, [[np.nan]], axis=0)
    for t, ctrl in ((plain.t, more), (plain.t + 1.7e9, plain.ctrl), (plain.t + jitter, plain.ctrl)):
        aligned = align(task.system, log(task, t=t, ctrl=ctrl))
        assert aligned.on_grid
        assert_allclose(aligned.t, plain.t, rtol=0, atol=1e-15)
        assert_array_equal(aligned.ctrl, plain.ctrl)
        assert_array_equal(aligned.y, plain.y)
    with pytest.raises(ValueError, match="read-only"):
        aligned.y[0, 0] = 1.0
    swapped = log(task, y=plain.y[:, [3, 0]], outputs=("qvel:hinge", "qpos:slide"))
    aligned = align(task.system, swapped)
    assert_array_equal(aligned.y[:, [3, 0]], swapped.y)
    assert aligned.measured.sum() == 2 * len(plain.t)


def test_a_recording_between_the_samples_keeps_its_times(task: DesignTask) -> None:
    """Its values do not change either; only the control is averaged.

    A recording on the grid stays there where rows are missing.
    """
    plain = log(task)
    t = np.sort(np.random.default_rng(2).uniform(0.0, 0.3, len(plain.t)))
    aligned = align(task.system, log(task, t=t + 5.0))
    assert not aligned.on_grid
    assert_allclose(aligned.t, t - t[0], rtol=0, atol=1e-12)
    assert_array_equal(aligned.y, plain.y)
    averaged = resample_control(t - t[0], plain.ctrl, task.dt)
    assert_allclose(aligned.ctrl, averaged, rtol=0, atol=1e-9)
    kept = np.delete(np.arange(31), [4, 5, 20])
    changes = {"t": plain.t[kept], "ctrl": plain.ctrl[kept[:-1]], "y": plain.y[kept]}
    sparse = align(task.system, log(task, **changes))
    assert sparse.on_grid
    held = np.concatenate([np.arange(4), [3, 3], np.arange(6, 20), [19], np.arange(21, 30)])
    assert_array_equal(sparse.ctrl, plain.ctrl[held])


def test_two_rows_of_one_sample_do_not_shift_the_control(task: DesignTask) -> None:
    """One time stamp is repeated and one row is missing.

    The numbers of rows and samples agree then, but not every sample has a row.
    """
    plain = log(task)
    t = np.array(plain.t)
    t[8] = t[7] + 0.005 * task.dt
    aligned = align(task.system, log(task, t=t))
    assert_allclose(aligned.ctrl[8], plain.ctrl[8], rtol=0, atol=0.05)
    assert_allclose(aligned.ctrl[7], plain.ctrl[8], rtol=0, atol=0.05)


GRID = np.arange(31) * DT


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        (
            {"t": GRID[:2], "ctrl": np.zeros((1, 1)), "y": np.zeros((2, 4))},
            "too few rows.*2.*at least 3",
        ),
        ({"t": np.append(GRID[:30], 0.28)}, "'t' does not increase in data row 31"),
        ({"t": np.where(GRID[12] == GRID, np.nan, GRID)}, "'t' does not increase in data row 13"),
        ({"ctrl": np.zeros((20, 1))}, r"control has shape \(20, 1\); expected 30 rows of 1"),
        (
            {"ctrl": np.where(np.arange(30) == 4, np.nan, 0.0)[:, None]},
            "control in data row 5 is NaN",
        ),
        ({"outputs": ("a", "b", "c", "d")}, "no measured column.*qpos:hinge"),
    ],
)
def test_faults_are_named(task: DesignTask, changes: dict[str, Any], words: str) -> None:
    with pytest.raises(RecordingError, match=rf"x\.csv: .*{words}"):
        align(task.system, log(task, **changes))


def aligned_prediction(task: DesignTask, flipped: Array | float = 1.0) -> tuple[Array, Array]:
    """What the model predicts, and the aligned values of a log of it, or of its other signs."""
    made = recorded(task.system, task.control, theta=task.parameters.guess, share=0.0)
    return made.y, align(task.system, replace(made, y=made.y * flipped)).y


def test_quaternions_get_the_sign_of_the_model(body: DesignTask) -> None:
    """Random signs and gaps are replaced by the continuous curve that the model predicts."""
    names = body.system.outputs.names
    signs = np.ones((len(body.control) + 1, len(names)))
    rng = np.random.default_rng(0)
    for joint in ("float", "ball"):
        columns = [names.index(f"qpos:{joint}.q{a}") for a in "wxyz"]
        signs[:, columns] *= rng.choice([-1.0, 1.0], (len(signs), 1))
        signs[10:20, columns] = np.nan
    y, aligned = aligned_prediction(body, signs)
    assert_array_equal(aligned, y * np.abs(signs))


def test_a_part_of_a_quaternion_keeps_its_sign(tmp_path: Path) -> None:
    """A single component may cross zero; it does not show whether q or -q was recorded."""
    some = body_task(tmp_path, noise={"qpos:float.qx": 0.01, "qpos:ball.qy": 0.01}, horizon=3.0)
    y, aligned = aligned_prediction(some)
    assert (np.ptp(np.sign(y), axis=0) == 2.0).any(), "nothing crosses zero"
    assert_array_equal(aligned, y)


def test_measured_trajectory_bridges_gaps(task: DesignTask, body: DesignTask) -> None:
    """Gaps are interpolated; the result is None where a position was never measured.

    A velocity that was not measured is not zero.
    """
    y = np.array(log(task).y)
    y[10:13, 1] = np.nan
    y[:, 2] = np.nan
    shown = measured_trajectory(task.system, log(task, y=y))
    assert_array_equal(shown.qvel, y[:, 2:])
    assert_array_equal(shown.qpos[:, 0], y[:, 0])
    assert_allclose(shown.qpos[11, 1], 0.5 * (y[9, 1] + y[13, 1]))
    y[:, 1] = np.nan
    assert measured_trajectory(task.system, log(task, y=y)) is None
    assert measured_trajectory(task.system, log(task, y=y[:, :1], outputs=("qpos:slide",))) is None
    turned = measured_trajectory(body.system, log(body))
    assert_allclose(np.linalg.norm(turned.qpos[:, 3:7], axis=1), 1.0)

    # The rows of a part are the same, also those of a clock that does not begin at zero.
    late = log(body, t=GRID + 100.0)
    part = measured_trajectory(body.system, late, GRID[19])
    assert len(part.t) == 20 and len(part.ctrl) == 19
    assert_array_equal(part.qpos, turned.qpos[:20])

"""Segments of recordings: every row belongs to one segment with a measured initial state."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.errors import RecordingError
from mjfim.excitation.task import DesignTask
from mjfim.identification.aligned_recording import AlignedRecording, align
from mjfim.identification.identify import identify_system
from mjfim.identification.segments import (
    MIN_SAMPLES,
    Segment,
    batches,
    cut_into_segments,
    measured_initial_states,
)
from mjfim.records.trajectory import Recording
from tests.support.numerics import Array, body_task, cart_task, require_found
from tests.support.terms import recorded

HORIZON = 2.0


@pytest.fixture(scope="module")
def task(tmp_path_factory: pytest.TempPathFactory) -> DesignTask:
    return cart_task(tmp_path_factory.mktemp("cart"), horizon=HORIZON)


@pytest.fixture(scope="module")
def body(tmp_path_factory: pytest.TempPathFactory) -> DesignTask:
    return body_task(tmp_path_factory.mktemp("body"), noise={"state": 0.01}, horizon=HORIZON)


def truth(task: DesignTask, factor: float = 1.1) -> Array:
    """(N+1, ny) outputs at parameters that are a multiple of the guess."""
    theta = factor * task.parameters.guess
    return recorded(task.system, task.control, theta=theta, share=0.0).y


def aligned_log(
    task: DesignTask,
    y: Array | None = None,
    rows: Array | None = None,
    hidden: tuple[str, ...] = (),
) -> AlignedRecording:
    """A noise-free recording of some rows, without the hidden columns."""
    y = truth(task) if y is None else y
    rows = np.arange(len(y)) if rows is None else rows
    names = task.system.outputs.names
    kept = [i for i, name in enumerate(names) if not name.startswith(hidden)]
    recording = Recording(
        t=rows * task.dt,
        ctrl=task.control[rows[:-1]],
        y=y[rows][:, kept],
        outputs=tuple(names[i] for i in kept),
        name="x.csv",
    )
    return align(task.system, recording)


def require_rows_covered_once(
    segments: tuple[Segment, ...], recordings: list[AlignedRecording]
) -> None:
    """Require that every row belongs to exactly one segment, which simulates its time."""
    for i, one in enumerate(recordings):
        rows = np.concatenate([np.arange(len(one.t))[p.rows] for p in segments if p.recording == i])
        assert_array_equal(rows, np.arange(len(one.t)))
    for p in segments:
        t = recordings[p.recording].t[p.rows] / recordings[p.recording].dt
        assert t[0] >= p.begin - 1e-9
        assert t[-1] <= p.begin + p.samples + 0.011


@pytest.mark.parametrize("length", [0.04, 0.17, 0.33, 1.0, 9.0, None])
@pytest.mark.parametrize("lead", [0.0, 0.004, 0.03])
def test_every_row_is_in_one_segment(task: DesignTask, length: float | None, lead: float) -> None:
    """Recordings may be complete, have missing rows or lie off the grid.

    Segments have nearly the requested length.
    """
    rng = np.random.default_rng(0)
    some = np.append(0, np.sort(rng.choice(200, 120, replace=False)) + 1)
    whole, sparse = aligned_log(task), aligned_log(task, rows=some)
    off = replace(whole, t=np.append(0.0, np.sort(rng.uniform(0.0, HORIZON, 200))), on_grid=False)
    assert whole.on_grid and sparse.on_grid
    segments = cut_into_segments(task.system, [whole, sparse, off], length, lead)
    require_rows_covered_once(segments, [whole, sparse, off])

    of_whole = [p for p in segments if p.recording == 0]
    wanted = HORIZON if length is None else min(length, HORIZON)
    assert len(of_whole) == round(HORIZON / wanted)
    starts = np.array([p.rows.start for p in of_whole])
    assert len(of_whole) == 1 or np.ptp(np.diff(starts)) <= 1

    # Segments simulate the lead before their first row, as far as there is one.
    ahead = int(np.ceil(lead / task.dt))
    begins = np.array([p.begin for p in of_whole])
    assert_array_equal(starts - begins, np.minimum(ahead, starts))
    assert min(p.samples - min(ahead, p.begin) for p in of_whole) >= MIN_SAMPLES


def test_segments_that_are_too_short_are_refused(task: DesignTask) -> None:
    """The message has the file, the key, its value and the smallest length."""
    with pytest.raises(
        RecordingError, match=r"x\.csv: fit\.segments = 0\.03 s is too short.*4 samples of 0\.01 s"
    ):
        cut_into_segments(task.system, [aligned_log(task)], 0.03, 0.0)


@pytest.mark.parametrize("hidden", [(), ("qvel",)])
@pytest.mark.parametrize("gaps", [False, True])
def test_measured_starts_are_where_the_motion_was(
    task: DesignTask, hidden: tuple[str, ...], gaps: bool
) -> None:
    """Initial states of a slide and a hinge agree with the simulated motion.

    Velocities are measured, or computed from the positions.
    """
    y = truth(task)
    begins = np.array([0, 3, 60, 117, 199])
    missing = np.random.default_rng(0).random(y.shape) < 0.3 * gaps
    log = aligned_log(task, np.where(missing, np.nan, y), hidden=hidden)
    error = np.abs(measured_initial_states(task.system, log, begins) - y[begins]) / np.ptp(
        y, axis=0
    )
    assert error[:, :2].max() < 0.02
    assert error[:, 2:].max() < (0.15 if hidden else 0.1)
    assert error[2:4, 2:].max() < 0.05
    assert np.abs(y[begins[2:], :2] - y[0, :2]).max() > 0.1, "the motion is too small"


def test_noise_is_averaged_over_the_rows_around(task: DesignTask) -> None:
    """Initial states are more accurate than single rows."""
    y, begins = truth(task), np.arange(15, 185, 2)
    noisy = y + 0.02 * np.random.default_rng(0).standard_normal(y.shape)
    states = measured_initial_states(task.system, aligned_log(task, noisy), begins)
    assert np.std((states - y[begins])[:, :2]) < 0.5 * 0.02


def test_a_free_body_starts_with_its_orientation(body: DesignTask) -> None:
    """The quaternion is that of the nearest row, scaled to unit length.

    This holds for a free joint and for a ball joint.
    """
    y = truth(body)
    begins = np.array([0, 50, 133])
    noisy = np.array(y)
    noisy[:, 3:11] *= 1.01
    states = measured_initial_states(body.system, aligned_log(body, noisy), begins)
    assert_allclose(states[:, 3:11], y[begins, 3:11], rtol=0, atol=1e-9)
    for part, share in ((slice(3), 0.02), (slice(11, None), 0.1)):
        error = np.abs(states[:, part] - y[begins, part]).max()
        assert error < share * np.ptp(y[:, part])


@pytest.mark.parametrize("hidden", [("qvel",), ("qpos:ball", "qvel"), ("qpos:float.x",)])
def test_unmeasured_states_follow_the_model_at_the_guess(
    body: DesignTask, hidden: tuple[str, ...]
) -> None:
    """Rotational velocities come from the model if the recording has only orientations.

    Positions and orientations that are not measured come from the model as well.
    """
    y, guess, begins = truth(body), truth(body, 1.0), np.array([0, 40, 120])
    states = measured_initial_states(body.system, aligned_log(body, y, hidden=hidden), begins)
    from_model = {
        ("qvel",): slice(14, 20),
        ("qpos:ball", "qvel"): slice(7, 11),
        ("qpos:float.x",): slice(1),
    }[hidden]
    assert_allclose(states[:, from_model], guess[begins, from_model], atol=1e-9)
    assert_allclose(states[:, 3:7], y[begins, 3:7], rtol=0, atol=1e-9)
    error = np.abs(states[:, 11:14] - y[begins, 11:14]).max()
    assert error < 0.1 * np.ptp(y[:, 11:14])


@pytest.mark.parametrize("fit", [{"start": "measured"}, {"segments": 0.5}])
@pytest.mark.parametrize("names", [("qpos:hinge",), ("qvel:hinge",)])
@pytest.mark.slow
def test_an_initial_position_that_no_output_shows_does_not_disturb_the_fit(
    tmp_path: Path, fit: dict[str, object], names: tuple[str, ...]
) -> None:
    """No output depends on the position of the cart.

    Its derivatives are round-off, which must not influence the search.
    """
    noise = dict.fromkeys(names, 0.01)
    unseen = cart_task(tmp_path, horizon=1.5, noise=noise, fit={**fit, "bootstrap": 0})
    theta = 1.1 * unseen.parameters.guess
    found = identify_system(unseen.system, [recorded(unseen.system, unseen.control, theta=theta)])
    require_found(found, theta)


def segment(samples: int) -> Segment:
    return Segment(recording=0, begin=0, samples=samples, rows=slice(0, 1), start=np.zeros(1))


def test_batches_contain_every_segment_once_within_the_limit() -> None:
    """Segments of a batch have similar length; only a single segment may exceed the limit."""
    samples = np.random.default_rng(0).integers(4, 120, 60)
    segments = [segment(int(n)) for n in samples]
    for most in (10, 200, 5000):
        found = list(batches(segments, most))
        assert sorted(i for batch in found for i in batch) == list(range(60))
        for batch in found:
            longest, shortest = samples[batch].max(), samples[batch].min()
            assert len(batch) == 1 or len(batch) * longest <= most
            assert longest <= 1.1 * shortest
    assert len(list(batches([segment(50)] * 40, 1000))) == 2
    assert list(batches([], 100)) == []

"""Initial controls of a design: names, ranges, fading at both ends, and repeated designs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.errors import ExperimentError, RecordingError
from mjfim.excitation.initial_controls import initial_controls_of
from mjfim.excitation.task import DesignTask
from mjfim.experiment.initial import fourier_basis
from tests.support.limits import arm_task

SWING = {
    "kind": "sine",
    "amplitude": {"shoulder": 0.1, "elbow": 0.3},
    "offset": 0.2,
    "frequency": 1.0,
}
LIMITS = {"control": {"shoulder": (-0.35, 0.3)}}


def arm(folder: Path, **tables: Any) -> DesignTask:
    """The arm for a second."""
    return arm_task(folder, **{"horizon": 1.0, "control": SWING, "limits": LIMITS, **tables})


def test_the_given_control_takes_the_place_of_the_initial_one(tmp_path: Path) -> None:
    """The seed alone decides random controls."""
    task = arm(tmp_path, descent={"starts": 3, "fourier": (1.5,), "seed": 4})
    starts, given = (list(initial_controls_of(task, each)) for each in (None, 0.5 * task.control))
    random = ["Fourier series of 1.5 Hz", "multisine 1 of 2", "multisine 2 of 2"]
    assert [s.name for s in starts] == ["initial control", *random]
    assert [s.name for s in given] == ["given control", *random]
    assert_array_equal(starts[0].control, task.control)
    assert_array_equal(given[0].control, 0.5 * task.control)
    for own, other in zip(starts[1:], given[1:], strict=True):
        assert_array_equal(own.control, other.control)
    assert len({s.control.tobytes() for s in starts}) == 4
    other = list(initial_controls_of(arm(tmp_path, descent={"starts": 3, "seed": 5}), None))
    assert not np.array_equal(other[1].control, starts[2].control)


def test_random_controls_have_up_to_six_times_the_amplitude_within_their_range(
    tmp_path: Path,
) -> None:
    task = arm(tmp_path, descent={"starts": 40})
    controls = np.array([s.control for s in initial_controls_of(task, None)][1:])
    assert (controls[..., 0].max(), controls[..., 0].min()) == (0.3, -0.35)
    initial = task.control[:, 1]
    away = np.abs(controls[..., 1] - initial.mean()).max(axis=1)
    peaks = away / np.abs(initial - initial.mean()).max()
    assert 1.0 - 1e-9 <= peaks.min() < 2.0
    assert 5.0 < peaks.max() <= 6.0 + 1e-9


@pytest.mark.parametrize("begins", [False, True])
@pytest.mark.parametrize("ends", [False, True])
def test_random_controls_rise_from_the_holding_control_and_fade(
    begins: bool, ends: bool, tmp_path: Path
) -> None:
    boundary = {"start": "rest" if begins else "given", "end": "rest" if ends else "free"}
    task = arm(tmp_path, boundary=boundary, descent={"starts": 6})
    middle = task.initial_hold if begins else task.control.mean(axis=0)
    for start in list(initial_controls_of(task, None))[1:]:
        away = np.abs(start.control - middle)
        assert bool((away[0] < 1e-12).all()) is begins
        assert bool((away[90:] < 1e-12).all()) is ends
        assert away[10:80].max() > 0.3
        if begins:
            assert (away[1] < 0.25 * away.max(axis=0) + 1e-12).all()


@pytest.mark.parametrize(("begins", "ends"), [(False, False), (True, True)])
def test_a_fourier_series_comes_with_its_basis(begins: bool, ends: bool, tmp_path: Path) -> None:
    """It has fifteen harmonics, or those below the bandwidth."""
    boundary = {"start": "rest" if begins else "given", "end": "rest" if ends else "free"}
    for bandwidth, harmonics in ((None, 15), (7.0, 4)):
        limits = {**LIMITS, **({"bandwidth": bandwidth} if bandwidth else {})}
        task = arm(tmp_path, boundary=boundary, limits=limits, descent={"fourier": (1.5,)})
        series = list(initial_controls_of(task, None))[1].curves
        assert series is not None
        assert_array_equal(series, fourier_basis(task.t, 1.0, 1.5, harmonics, begins, ends))


@pytest.mark.parametrize(("limits", "most"), [({}, 50), ({"bandwidth": 5.0}, 5)])
def test_a_series_without_any_harmonic_is_refused(limits: Any, most: int, tmp_path: Path) -> None:
    task = arm(tmp_path, limits=limits, descent={"fourier": (60.0,)})
    message = rf"descent\.fourier: 60 Hz is above the bandwidth of {most} Hz"
    with pytest.raises(ExperimentError, match=message):
        list(initial_controls_of(task, None))


def test_an_earlier_design_is_repeated_until_the_horizon_ends(tmp_path: Path) -> None:
    """Its rows have the rate of the earlier design; the last row has no control."""
    lines = [f"{k * 0.02},{0.01 * k},{-0.02 * k},0.0" for k in range(20)] + ["0.4,nan,nan,0.0"]
    for name, count in (("old.csv", 21), ("short.csv", 5)):
        text = "\n".join(["t,ctrl:shoulder,ctrl:elbow,qpos:elbow", *lines[:count]])
        (tmp_path / name).write_text(text + "\n", encoding="utf-8")
    files = [str(tmp_path / name) for name in ("old.csv", "short.csv")]
    starts = list(initial_controls_of(arm(tmp_path, descent={"previous": files}), None))[1:]
    assert [start.name for start in starts] == [f"previous design {file}" for file in files]
    for start, length in zip(starts, (20, 5), strict=True):
        row = (np.arange(100) // 2) % length
        assert_allclose(start.control, np.stack([0.01 * row, -0.02 * row], axis=1), atol=1e-12)
    missing = arm(tmp_path, descent={"previous": ("gone.csv",)})
    with pytest.raises(RecordingError, match=r"gone\.csv: no such file"):
        list(initial_controls_of(missing, None))


def test_a_repeated_control_is_the_first_part_of_the_initial_one_faded_to_rest(
    tmp_path: Path,
) -> None:
    boundary, limits = {"start": "rest", "end": "rest"}, {**LIMITS, "control_rate": 5.0}
    task = arm(tmp_path, boundary=boundary, limits=limits, descent={"repeats": (2, 4)})
    half, quarter = list(initial_controls_of(task, None))[1:]
    assert (half.name, half.repeats, len(half.control)) == ("2 times a design of 0.5 s", 2, 50)
    assert (quarter.repeats, len(quarter.control)) == (4, 25)
    assert_allclose(half.control[0], task.centre)
    assert_allclose(half.control[6:37], task.control[6:37])
    assert np.abs(half.control[-1] - task.centre).max() < 1e-9


@pytest.mark.parametrize(
    ("tables", "message"),
    [
        ({"descent": {"repeats": (7,)}}, ": 7 does not divide the 100 samples"),
        ({"descent": {"repeats": (100,)}}, ": 100 leaves 1 of 100 samples; needs 2"),
        (
            {"limits": {}, "cost": {"control": 1.0}, "descent": {"repeats": (2,)}},
            " needs hard limits",
        ),
    ],
)
def test_repeats_that_do_not_divide_or_lack_limits_are_refused(
    tables: Any, message: str, tmp_path: Path
) -> None:
    with pytest.raises(ExperimentError, match=rf"descent\.repeats{message}"):
        initial_controls_of(arm(tmp_path, **tables), None)

"""A recording that is given twice is refused, whatever its name is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mjfim.errors import RecordingError
from mjfim.identification.search import refuse_same_data
from mjfim.records.trajectory import Recording


def recording(seed: int = 0, name: str = "a.csv") -> Recording:
    """A short recording of noise with a missing value."""
    rng = np.random.default_rng(seed)
    y = rng.standard_normal((50, 2))
    y[3, 1] = np.nan
    t = np.arange(50) * 0.01
    return Recording(t=t, ctrl=rng.standard_normal((49, 1)), y=y, outputs=("q", "v"), name=name)


def test_copies_are_refused() -> None:
    """A copy has another name, and its clock may be rounded and begin at another time."""
    copy = dataclasses.replace(recording(name="b.csv"), t=100.0 + recording().t.round(5))
    with pytest.raises(
        RecordingError, match=r"b\.csv holds the same data as a\.csv: .* count twice"
    ):
        refuse_same_data([recording(), recording(1), copy], [])
    with pytest.raises(RecordingError, match=r"b\.csv holds the same data as a\.csv: a fitted"):
        refuse_same_data([recording(1), recording()], [copy])
    with pytest.raises(RecordingError, match="count twice"):
        refuse_same_data([recording(1)], [recording(), copy])
    with pytest.raises(RecordingError, match=r"b\.csv is given twice: a fitted"):
        refuse_same_data([copy, recording(1)], [dataclasses.replace(copy)])


def test_a_copy_may_write_zeros_and_missing_values_in_another_way() -> None:
    """Zero has two signs, and a missing value many bit patterns."""
    first = np.array(recording().y)
    second = np.array(recording().y)
    first[0] = [0.0, np.nan]
    second[0] = [-0.0, -np.nan]
    one, other = (
        dataclasses.replace(recording(name=n), y=y)
        for n, y in zip("ab", (first, second), strict=True)
    )
    with pytest.raises(RecordingError, match="b holds the same data as a"):
        refuse_same_data([one, recording(1), other], [])


@pytest.mark.parametrize("changed", ["t", "ctrl", "y"])
def test_other_recordings_are_accepted(changed: str) -> None:
    """One other value is enough, and so is a clock of another rate."""
    other = np.array(getattr(recording(), changed))
    if changed == "t":
        other *= 2.0
    else:
        other[-1, 0] += 1e-9
    refuse_same_data([recording()], [dataclasses.replace(recording(), **{changed: other})])


def test_recordings_of_other_shapes_are_accepted() -> None:
    long = recording()
    short = dataclasses.replace(long, t=long.t[:40], ctrl=long.ctrl[:39], y=long.y[:40])
    other = dataclasses.replace(long, outputs=("q", "w"))
    refuse_same_data([long, short], [other])

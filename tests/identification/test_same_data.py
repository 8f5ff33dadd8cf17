"""A recording that is given twice is refused, whatever its name is."""

from __future__ import annotations

import dataclasses

import numpy as np
import pytest

from mjfim.errors import RecordingError
from mjfim.identification.search import refuse_same_data
from mjfim.records.trajectory import Recording


def recording(seed: int = 0, name: str = "a.csv", sign: float = 1.0) -> Recording:
    """A short recording of noise with a zero and a missing value of some sign."""
    rng = np.random.default_rng(seed)
    y = rng.standard_normal((50, 2))
    y[3] = [sign * 0.0, sign * np.nan]
    t = np.arange(50) * 0.01
    return Recording(t=t, ctrl=rng.standard_normal((49, 1)), y=y, outputs=("q", "v"), name=name)


def test_copies_are_refused() -> None:
    """A copy has another name, and its clock may be rounded and begin at another time.

    Zero has two signs, and a missing value many bit patterns.
    """
    first, other = recording(), recording(1)
    copy = recording(name="b.csv", sign=-1.0)
    copy = dataclasses.replace(copy, t=100.0 + copy.t.round(5))
    same = r"b\.csv holds the same data as a\.csv: "
    for fitted, held_out, said in (
        ([first, other, copy], [], f"{same}.* count twice"),
        ([other, first], [copy], f"{same}a fitted"),
        ([other], [first, copy], f"{same}.* count twice"),
        ([copy, other], [dataclasses.replace(copy)], r"b\.csv is given twice: a fitted"),
    ):
        with pytest.raises(RecordingError, match=said):
            refuse_same_data(fitted, held_out)


def test_other_recordings_are_accepted() -> None:
    """One other value is enough, and so is a clock of another rate, or another shape."""
    plain = recording()
    others = [
        dataclasses.replace(plain, t=2.0 * plain.t),
        dataclasses.replace(plain, ctrl=plain.ctrl + 1e-9 * np.eye(49, 1, -48)),
        dataclasses.replace(plain, y=plain.y + 1e-9 * np.eye(50, 2, -49)),
        dataclasses.replace(plain, outputs=("q", "w")),
        plain.first_rows(40),
    ]
    refuse_same_data([plain, *others[:3]], others[3:])

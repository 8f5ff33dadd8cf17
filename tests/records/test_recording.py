"""Recordings refuse what is no measurement, and nobody can change their arrays."""

from __future__ import annotations

import numpy as np
import pytest

from mjfim.errors import RecordingError
from mjfim.records.trajectory import Recording


@pytest.mark.parametrize("name", ["t", "y"])
def test_truth_values_are_refused(name: str) -> None:
    arrays = {"t": np.arange(3.0), "ctrl": np.zeros((2, 1)), "y": np.zeros((3, 1))}
    arrays[name] = arrays[name] > 0.0
    with pytest.raises(RecordingError, match=f"run 7: '{name}' holds truth values"):
        Recording(outputs=("qpos:a",), name="run 7", **arrays)


def test_a_later_change_of_the_caller_changes_no_recording() -> None:
    t = np.arange(3.0)
    made = Recording(t=t, ctrl=[[0.0], [1.0]], y=np.zeros((3, 1)), outputs=("qpos:a",))  # type: ignore[arg-type]
    t[1] = 7.0
    assert made.t.tolist() == [0.0, 1.0, 2.0]
    assert not (made.t.flags.writeable or made.ctrl.flags.writeable or made.y.flags.writeable)
    assert made.summary()["nu"] == 1

"""Recordings refuse what is no measurement."""

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

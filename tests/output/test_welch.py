"""Spectral densities of long series are those of SciPy, although they are computed part by part."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.signal import welch as reference

from mjfim.output.plots import estimate


@pytest.mark.parametrize(("count", "length"), [(1000, 100), (999, 101), (256, 256), (300, 257)])
def test_parts_give_the_density_of_the_whole(
    count: int, length: int, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setattr(estimate, "SEGMENTS_AT_ONCE", 3)
    x = np.random.default_rng(0).normal(size=count)
    frequencies, density = estimate.power_density(x, 10.0, length)
    expected, wanted = reference(x, 10.0, nperseg=length, detrend=False)
    assert_array_equal(frequencies, expected)
    assert_allclose(density, wanted, rtol=1e-12)

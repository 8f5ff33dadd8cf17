"""Output delay: a shifted curve, its derivative by the delay, its adjoint, and its values before
the first sample.
"""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.plant.outputs import OutputDelay
from tests.support.numerics import Array, cart_task

DT = 0.01
T = np.arange(120) * DT


def curve(t: Array) -> Array:
    """Two smooth columns, of which one changes faster."""
    return np.stack([np.sin(5.0 * t) + 0.3 * t, np.exp(-t) * np.cos(9.0 * t)], axis=1)


@pytest.mark.parametrize("delay", [0.3, 0.97, 2.6])
def test_a_cubic_is_shifted_exactly_and_a_quartic_is_not(delay: float) -> None:
    """This holds at all samples, including the first ones."""
    output_delay = OutputDelay.on_grid(30, delay, 1.0)
    t = np.arange(30.0)
    for degree in range(5):
        shifted = np.where(t < delay, 0.0**degree, (t - delay) ** degree)
        error = np.abs(output_delay.apply(t**degree) - shifted).max()
        assert (error < 1e-8) == (degree <= 3)


@pytest.mark.parametrize("delay", [0.0, 0.3, 1.0, 2.6])
def test_nothing_depends_on_samples_after_the_delayed_time(delay: float) -> None:
    """Later samples contain the feedback of a controller on the noise of this measurement."""
    output_delay = OutputDelay.on_grid(12, delay, 1.0)
    sample, row = np.arange(12)[None, :], np.arange(12)[:, None]
    later = (sample > np.ceil(row - delay)) & (row - delay >= 3)
    assert not output_delay.weights.toarray()[later].any()
    assert not output_delay.weight_slopes.toarray()[later].any()


def test_before_the_first_sample_the_first_value_is_held() -> None:
    """It does not change with the delay; a negative delay holds the last value after the last
    sample.
    """
    y = curve(T)
    late, lead = (OutputDelay.on_grid(len(T), delay, DT) for delay in (0.055, -0.055))
    assert_array_equal(late.apply(y)[:6], y[[0] * 6])
    assert_allclose(lead.apply(y)[-6:], y[[-1] * 6], rtol=0, atol=1e-14)
    assert_allclose(lead.apply(y)[:-8], curve(T + 0.055)[:-8], rtol=0, atol=1e-5)
    slope = late.derivative(y)
    assert not slope[:6].any() and slope[6:].any(axis=1).all()
    assert not lead.derivative(y)[-5:].any()
    assert_array_equal(OutputDelay.on_grid(len(T), 100.0, DT).apply(y), y[[0] * len(T)])


@pytest.mark.parametrize("delay", [0.0042, 0.0337, -0.0125])
def test_the_derivative_by_the_delay(delay: float) -> None:
    at = [OutputDelay.on_grid(len(T), delay + h, DT).apply(curve(T)) for h in (1e-6, -1e-6)]
    slope = (at[0] - at[1]) / 2e-6
    rate = OutputDelay.on_grid(len(T), delay, DT).derivative(curve(T))
    assert_allclose(rate, slope, rtol=1e-6, atol=1e-7)


def test_adjoints_by_dot_products() -> None:
    """`<v, L y> = <L' v, y>` for arrays of any rank; shapes are kept."""
    rng = np.random.default_rng(0)
    output_delay = OutputDelay.on_grid(50, 0.0273, DT)
    for shape in ((50,), (50, 3), (50, 2, 4)):
        y, v = rng.standard_normal(shape), rng.standard_normal(shape)
        for forward, backward in (
            (output_delay.apply, output_delay.apply_transposed),
            (output_delay.derivative, output_delay.derivative_transposed),
        ):
            assert forward(y).shape == backward(v).shape == shape
            left, right = np.sum(v * forward(y)), np.sum(backward(v) * y)
            assert left == pytest.approx(right, rel=1e-12)
            assert np.sum(v * backward(y)) != pytest.approx(left, rel=1e-3), (
                "not its own adjoint: a weak test"
            )


def test_the_sensitivity_to_a_delay_is_the_derivative_of_delayed_outputs(tmp_path: Path) -> None:
    """Predictions of the plant at two delays agree with G; a horizon of two samples works too."""
    task = cart_task(tmp_path, nuisance={"delay": 0.01})
    moved = np.tile(task.theta, (4, 1))
    moved[:, -1] = 0.0137, 0.0138, 0.0136, 0.0
    y, G = task.plant.derivatives.predict(moved[0], task.control)
    _, up, down, plain = task.plant.measure(moved, task.control)[0]
    assert_allclose(G[..., -1], (up - down) / 2e-4, rtol=1e-6, atol=1e-5)
    shifted = OutputDelay.on_grid(len(plain), 0.0137, task.dt).apply(plain)
    assert_allclose(y, shifted, rtol=0, atol=1e-12)
    short = cart_task(tmp_path, horizon=0.02, nuisance={"delay": True})
    assert np.isfinite(short.plant.derivatives.predict(moved[0], short.control)[0]).all()

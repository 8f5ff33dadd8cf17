"""The honest covariance: agreement with intervals, and combinations that are known well."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.linalg import block_diag

from mjfim.experiment.system import System
from mjfim.identification.assessment.honest_covariance import (
    AGREEMENT,
    agreeing_covariance,
    between_covariance,
    honest_covariance,
    interval_std,
    with_honest_covariance,
)
from mjfim.identification.assessment.robust_covariance import Uncertainty
from tests.identification.test_horizons import made_study
from tests.identification.test_parameter_draws import COVARIANCE, STD, estimated
from tests.support.cart_pendulum import cart_pendulum
from tests.support.numerics import Array

# Mass and lever, known to 10 % each, and their product to 0.1 %.
PRODUCT = np.array([1.0, 1.0]) / np.sqrt(2.0)
KNOWN = 1e-3
NARROW = 0.02 * np.eye(2) + (KNOWN**2 - 0.02) * np.outer(PRODUCT, PRODUCT)


def size(covariance: Array, weights: Array) -> float:
    """Standard deviation of a combination."""
    return float(np.sqrt(weights @ covariance @ weights))


@pytest.fixture(scope="module")
def system() -> System:
    return System.resolve(cart_pendulum())


# ---- agreement with intervals


def test_standard_deviations_agree_with_all_intervals() -> None:
    rng = np.random.default_rng(1)
    factor = rng.standard_normal((6, 6)) * np.geomspace(1e-6, 1e3, 6)[:, None]
    covariance = factor @ factor.T
    scale = np.sqrt(np.diag(covariance))
    wanted = scale * [1.0, 0.3, 3.0, 0.0, np.nan, 1.0]
    found = agreeing_covariance(covariance, wanted)
    ratio = np.sqrt(np.diag(found))[[0, 1, 2, 5]] / wanted[[0, 1, 2, 5]]
    assert (ratio > 1.0 - 1e-9).all()
    assert ratio[2] < 1.0 + AGREEMENT + 1e-9
    assert not found[3].any()
    assert np.linalg.eigvalsh(found / np.outer(scale, scale)).min() > -1e-9

    # A common factor changes no correlation.
    std = np.sqrt(np.diag(NARROW))
    for factor in (1.0, 9.0):
        assert_allclose(agreeing_covariance(factor * NARROW, std), NARROW, rtol=1e-9)

    # Parameters about which the covariance says nothing are uncorrelated.
    alone = agreeing_covariance(np.zeros((2, 2)), np.array([2.0, 0.0]))
    assert_array_equal(alone, [[4.0, 0.0], [0.0, 0.0]])


# ---- its parts


def uncertainty(each: Array, between: Array, apart: tuple[int, ...]) -> Uncertainty:
    """Robust uncertainty of unknowns on which recordings disagree."""
    c = each.shape[1]
    return Uncertainty(
        sandwich=np.zeros(c),
        interval=np.zeros((c, 2)),
        between=between,
        apart=apart,
        each=each,
        draws=np.zeros((0, c)),
        covariance=np.zeros((c, c)),
    )


def test_recordings_disagree_along_what_differs_between_them() -> None:
    """Mass and lever of 20 recordings, with one product, and a third unknown that agrees."""
    deviation = 0.1 * np.random.default_rng(2).standard_normal(20)
    each = 1.0 + np.outer(deviation, [1.0, -1.0, 0.0])
    between = np.array([0.1, 0.1, 0.0])
    product = np.append(PRODUCT, 0.0)

    # Two recordings show one direction only.
    for count in (20, 2):
        found = between_covariance(uncertainty(each[:count], between, (0, 1)))
        assert size(found, product) == pytest.approx(0.1 / np.sqrt(count), rel=1e-6)
        assert not found[2].any()
        assert count == 2 or np.sqrt(np.diag(found)) == pytest.approx(between)

    # Recordings of which none determines all unknowns.
    unknown = between_covariance(uncertainty(np.full((3, 3), np.nan), between, (0, 1)))
    assert_array_equal(unknown, np.diag(between**2))


def test_lengths_and_selections_widen_along_their_differences(system: System) -> None:
    """Mass and lever are 0.5 apart over whole recordings, with one product.

    Chance explains the difference of the lever alone, which follows that of the mass.
    """
    covariance = block_diag(NARROW, 0.01)
    theta = system.parameters.guess
    study = made_study(
        chosen=0,
        parameters=system.parameters.names,
        units=("", "", ""),
        theta=theta + np.array([[0.0, 0.0, 0.0], [0.5, -0.5, 0.0]]),
        half_widths=np.zeros((2, 3)),
        is_apart=np.array([[False] * 3, [True, False, False]]),
    )
    narrow = estimated(system, covariance)
    wide = replace(narrow, horizons=study, interval=study.widened(narrow.interval))

    # Estimates without each of five parts of the data.
    first = with_honest_covariance(narrow, system.parameters, covariance)
    shifts = np.array([-0.2, -0.1, 0.0, 0.1, 0.2])
    half = 2.776 * np.sqrt(4 / 5 * np.sum(shifts**2))
    interval = first.interval + np.outer([half, half, 0.0], [-1.0, 1.0])
    parts = {"without_parts": theta + np.outer(shifts, [1.0, -1.0, 0.0])}

    for widened, *known, settings in (
        (wide, covariance, {}),
        (replace(first, interval=interval), parts),
    ):
        honest = with_honest_covariance(widened, system.parameters, *known, **settings)
        found = honest.honest_covariance
        std = interval_std(system.parameters, widened)
        assert std[0] > 1.5 * np.sqrt(NARROW[0, 0])
        ratio = np.sqrt(np.diag(found)) / std
        assert (ratio >= 1.0 - 1e-9).all()
        assert ratio[0] <= 1.0 + AGREEMENT + 1e-9
        assert size(found, np.append(PRODUCT, 0.0)) == pytest.approx(KNOWN, rel=0.2)


# ---- estimates


def test_it_is_kept_and_earlier_estimates_have_none(system: System) -> None:
    earlier, parameters = estimated(system, COVARIANCE), system.parameters
    saved = with_honest_covariance(earlier, parameters, 4.0 * COVARIANCE)
    assert_array_equal(honest_covariance(parameters, saved), saved.honest_covariance)

    # Without it, formal correlations count.
    assert_allclose(honest_covariance(parameters, earlier), COVARIANCE, rtol=1e-4)
    assert with_honest_covariance(earlier, parameters) is earlier

    # Parameters that no recording determines, and values that differ between recordings.
    unknown = block_diag(COVARIANCE[:2, :2], np.inf)
    found = with_honest_covariance(earlier, parameters, unknown).honest_covariance
    assert_allclose(np.sqrt(np.diag(found)), [*STD[:2], np.inf], rtol=AGREEMENT)
    differing = replace(saved, per_recording={"c": (1.0, 3.0)})
    added = honest_covariance(parameters, differing) - saved.honest_covariance
    assert_allclose(added, np.diag([0.0, 0.0, 2.0]), atol=1e-12)

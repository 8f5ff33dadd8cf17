"""Parametrisations of a body's inertia: their inverses, their meaning in the dynamics, what they
refuse.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from mjfim.model.inertia import (
    INERTIA_PARAMETRISATIONS,
    BodyInertia,
    InertiaParametrisation,
    from_logcholesky,
    to_barycentric,
    to_logcholesky,
)

Array = NDArray[np.float64]


def cloud(seed: int) -> tuple[Array, Array]:
    """Masses and places of random points."""
    rng = np.random.default_rng(seed)
    spread, centre = rng.uniform(0.1, 1.0, 3), rng.uniform(-0.5, 0.5, 3)
    return rng.uniform(0.1, 1.0, 6), centre + spread * rng.standard_normal((6, 3))


def tensor(weights: Array, points: Array) -> Array:
    """Inertia of points about the origin, by its definition."""
    pairs = zip(weights, points, strict=True)
    return np.sum([w * (r @ r * np.eye(3) - np.outer(r, r)) for w, r in pairs], axis=0)


def solid(seed: int) -> BodyInertia:
    """Body of random points: physical by construction."""
    weights, points = cloud(seed)
    com = weights @ points / weights.sum()
    return BodyInertia(mass=float(weights.sum()), com=com, inertia=tensor(weights, points - com))


@pytest.mark.parametrize("chart", INERTIA_PARAMETRISATIONS.values(), ids=INERTIA_PARAMETRISATIONS)
def test_every_parametrisation_has_an_inverse(chart: InertiaParametrisation) -> None:
    for body in map(solid, range(20)):
        v = chart.coordinates(body)
        again = chart.inertia(v)
        assert v.shape == (10,)
        assert again.mass == pytest.approx(body.mass, rel=1e-12)
        assert_allclose(again.com, body.com, rtol=1e-11, atol=1e-13)
        assert_allclose(again.inertia, body.inertia, rtol=1e-9, atol=1e-12)


def test_barycentric_coordinates_are_moments_about_the_origin() -> None:
    weights, points = cloud(2)
    I = tensor(weights, points)  # noqa: E741
    entries = [*np.diag(I), I[0, 1], I[0, 2], I[1, 2]]
    found = to_barycentric(solid(2))
    assert_allclose(found, [weights.sum(), *(weights @ points), *entries], rtol=1e-12)


def test_log_cholesky_is_the_factor_of_the_pseudo_inertia() -> None:
    """`J = U U'`, U by the ten numbers of the paper."""
    v = 0.5 * np.random.default_rng(7).standard_normal(10)
    a, d1, d2, d3, s12, s23, s13, t1, t2, t3 = v
    U = np.diag(np.exp([d1, d2, d3, 0.0]))
    U[0, 1:], U[1, 2:], U[2, 3] = (s12, s13, t1), (s23, t2), t3
    body = from_logcholesky(v)
    h = body.mass * body.com
    J = np.zeros((4, 4))
    J[:3, :3] = body.second_moments + np.outer(h, h) / body.mass
    J[3, :3] = J[:3, 3] = h
    J[3, 3] = body.mass
    assert_allclose(np.exp(2.0 * a) * U @ U.T, J, rtol=1e-12, atol=1e-14)


@pytest.mark.parametrize(
    ("moments", "is_solid"),
    [
        ((0.0, 0.0, 0.0), False),
        ((0.1, 0.1, 0.0), False),
        ((0.3, 0.2, 0.1), False),
        ((0.3 * (1 + 1e-12), 0.2, 0.1), False),
        ((0.5, 0.2, 0.1), False),
        ((0.3 * (1 - 1e-6), 0.2, 0.1), True),
    ],
)
def test_points_rods_and_plates_have_no_log_cholesky(
    moments: tuple[float, ...], is_solid: bool
) -> None:
    turned = solid(8).principal_axes()[1]
    body = BodyInertia.from_principal(2.0, np.array([0.1, 0.2, 0.3]), np.array(moments), turned)
    for chart in ("central", "barycentric"):
        assert np.isfinite(INERTIA_PARAMETRISATIONS[chart].coordinates(body)).all()
    if is_solid:
        again = from_logcholesky(to_logcholesky(body)).inertia
        assert_allclose(again, body.inertia, rtol=1e-8, atol=1e-12)
        return
    with pytest.raises(ValueError, match=r"a point, a rod or a plate"):
        to_logcholesky(body)


def test_magnitudes_follow_the_units() -> None:
    body, kilo, centi = solid(9), 1000.0, 100.0
    other = BodyInertia(
        mass=kilo * body.mass, com=centi * body.com, inertia=kilo * centi**2 * body.inertia
    )
    factor = {"kg": kilo, "kg m": kilo * centi, "kg m²": kilo * centi**2, "m": centi, "": 1.0}
    for chart in INERTIA_PARAMETRISATIONS.values():
        assert len(set(chart.names)) == len(chart.units) == 10
        own = chart.magnitudes(body)
        assert (own > 0.0).all()
        converted = own * [factor[u] for u in chart.units]
        assert_allclose(chart.magnitudes(other), converted, rtol=1e-12)

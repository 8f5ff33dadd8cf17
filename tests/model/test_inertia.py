"""Parametrisations of a body's inertia: their inverses, their meaning in the dynamics, what they
refuse.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose
from numpy.typing import NDArray

from mjfim.model.inertia import (
    INERTIA_ENTRIES,
    INERTIA_PARAMETRISATIONS,
    BodyInertia,
    InertiaParametrisation,
    from_logcholesky,
    to_barycentric,
    to_logcholesky,
)

Array = NDArray[np.float64]

# A chain of a hinge, a ball joint and a slide with an offset body at its end.
CHAIN = """
<mujoco>
  <option gravity="1 -2 -9.81"/>
  <worldbody>
    <body name="base">
      <joint type="hinge" axis="0 .6 .8"/>
      <inertial pos=".1 0 .2" mass="1" diaginertia=".1 .12 .11"/>
      <body name="middle" pos=".2 .1 .5" euler="20 40 10">
        <joint type="ball"/>
        <inertial pos="0 .1 .2" mass=".7" diaginertia=".05 .04 .03"/>
        <body name="tip" pos=".1 -.2 .3" euler="-50 10 70">
          <joint type="slide" axis=".6 0 .8"/><joint type="hinge" axis="1 0 0" pos=".1 0 0"/>
          <inertial pos="{com}" mass="{mass}" fullinertia="{inertia}"/>
        </body>
      </body>
    </body>
  </worldbody>
</mujoco>
"""


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


def compiled(body: BodyInertia) -> Any:
    """The chain with this body at its end; MuJoCo refuses to compile unphysical bodies."""
    tensor = [body.inertia[pair] for pair in INERTIA_ENTRIES]
    text = CHAIN.format(com=spelled(body.com), mass=repr(body.mass), inertia=spelled(tensor))
    return mujoco.MjModel.from_xml_string(text)


def spelled(numbers: Any) -> str:
    """Numbers of an MJCF attribute with every digit."""
    return " ".join(repr(float(n)) for n in numbers)


def dynamics(body: BodyInertia) -> Array:
    """Mass matrix, bias forces and energies of the chain in some pose and motion, as one vector."""
    model = compiled(body)
    data, M = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    rng = np.random.default_rng(5)
    mujoco.mj_integratePos(model, data.qpos, rng.standard_normal(model.nv), 1.0)
    data.qvel[:] = rng.standard_normal(model.nv)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, M)
    mujoco.mj_energyPos(model, data)
    mujoco.mj_energyVel(model, data)
    return np.concatenate([M.ravel(), data.qfrc_bias, data.energy])


@pytest.mark.parametrize("chart", INERTIA_PARAMETRISATIONS.values(), ids=INERTIA_PARAMETRISATIONS)
def test_every_parametrisation_has_an_inverse(chart: InertiaParametrisation) -> None:
    """Coordinates give the inertia, and the inertia gives the coordinates."""
    for body in map(solid, range(20)):
        v = chart.coordinates(body)
        again = chart.inertia(v)
        assert v.shape == (10,)
        assert again.mass == pytest.approx(body.mass, rel=1e-12)
        assert_allclose(again.com, body.com, rtol=1e-11, atol=1e-13)
        assert_allclose(again.inertia, body.inertia, rtol=1e-9, atol=1e-12)


def test_barycentric_coordinates_are_moments_about_the_origin() -> None:
    """They agree with sums over points, by their definition."""
    weights, points = cloud(2)
    I = tensor(weights, points)  # noqa: E741
    entries = [*np.diag(I), I[0, 1], I[0, 2], I[1, 2]]
    found = to_barycentric(solid(2))
    assert_allclose(found, [weights.sum(), *(weights @ points), *entries], rtol=1e-12)


def test_the_dynamics_are_linear_in_barycentric_coordinates() -> None:
    """MuJoCo's mass matrix, bias forces and energies of a mixture are the mixture of those; not so
    in the others.
    """
    first, second = solid(3), solid(4)
    wanted = 0.4 * dynamics(first) + 0.6 * dynamics(second)
    errors = {}
    for name, chart in INERTIA_PARAMETRISATIONS.items():
        mixture = 0.4 * chart.coordinates(first) + 0.6 * chart.coordinates(second)
        mixed = dynamics(chart.inertia(mixture))
        errors[name] = np.abs(mixed - wanted).max() / np.abs(mixed).max()
    assert errors["barycentric"] < 1e-12
    assert errors["logcholesky"] > 1e-3 and errors["central"] > 1e-3, "a weak test"


def test_log_cholesky_is_physical_for_every_vector() -> None:
    """MuJoCo compiles each of them, triangle inequality included; ten random central ones mostly
    fail.
    """
    rng = np.random.default_rng(6)
    failed = 0
    for v in rng.standard_normal((100, 10)):
        body = from_logcholesky(v)
        moments, _ = body.principal_axes()
        assert body.mass > 0.0 and moments[2] > 0.0 and moments[1] + moments[2] > moments[0]
        assert compiled(body).body("tip").mass[0] == pytest.approx(body.mass)
        try:
            compiled(INERTIA_PARAMETRISATIONS["central"].inertia(np.append(abs(v[0]), v[1:])))
        except ValueError:
            failed += 1
    assert failed > 90


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
    """Bodies with a singular or unphysical pseudo-inertia are refused, thicker ones accepted."""
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
    """Magnitudes in other units of mass and length are those converted."""
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

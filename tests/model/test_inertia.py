"""Parametrisations of a body's inertia: their inverses, their meaning in the dynamics, what they
refuse.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.typing import NDArray

from mjfim.model.inertia import (
    INERTIA_ENTRIES,
    INERTIA_PARAMETRISATIONS,
    BodyInertia,
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


def solids(count: int, seed: int) -> list[BodyInertia]:
    """Bodies of random points: physical by construction."""
    rng, found = np.random.default_rng(seed), []
    for _ in range(count):
        weights = rng.uniform(0.1, 1.0, 6)
        points = rng.standard_normal((6, 3)) * rng.uniform(0.1, 1.0, 3) + rng.uniform(-0.5, 0.5, 3)
        com = weights @ points / weights.sum()
        about = points - com
        found.append(
            BodyInertia(
                mass=float(weights.sum()),
                com=com,
                inertia=sum(
                    w * (r @ r * np.eye(3) - np.outer(r, r))
                    for w, r in zip(weights, about, strict=True)
                ),
            )
        )
    return found


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


@pytest.mark.parametrize("chart", INERTIA_PARAMETRISATIONS)
def test_every_parametrisation_has_an_inverse(chart: str) -> None:
    """Coordinates give the inertia, and the inertia gives the coordinates."""
    for body in solids(20, 0):
        v = INERTIA_PARAMETRISATIONS[chart].coordinates(body)
        again = INERTIA_PARAMETRISATIONS[chart].inertia(v)
        assert v.shape == (10,)
        assert again.mass == pytest.approx(body.mass, rel=1e-12)
        np.testing.assert_allclose(again.com, body.com, rtol=1e-11, atol=1e-13)
        np.testing.assert_allclose(again.inertia, body.inertia, rtol=1e-9, atol=1e-12)
        np.testing.assert_allclose(
            INERTIA_PARAMETRISATIONS[chart].coordinates(again), v, rtol=1e-9, atol=1e-11
        )


def test_barycentric_coordinates_are_moments_about_the_origin() -> None:
    """They agree with sums over points, by their definition."""
    rng = np.random.default_rng(2)
    weights, points = rng.uniform(0.1, 1.0, 5), rng.standard_normal((5, 3))
    com = weights @ points / weights.sum()
    about = sum(
        w * (r @ r * np.eye(3) - np.outer(r, r)) for w, r in zip(weights, points - com, strict=True)
    )
    origin = sum(
        w * (r @ r * np.eye(3) - np.outer(r, r)) for w, r in zip(weights, points, strict=True)
    )
    v = to_barycentric(BodyInertia(mass=float(weights.sum()), com=com, inertia=about))
    np.testing.assert_allclose(
        v, [weights.sum(), *(weights @ points), *(origin[p] for p in INERTIA_ENTRIES)], rtol=1e-12
    )


def test_the_dynamics_are_linear_in_barycentric_coordinates() -> None:
    """MuJoCo's mass matrix, bias forces and energies of a mixture are the mixture of those; not so
    in the others.
    """
    first, second = solids(2, 3)
    ends = dynamics(first), dynamics(second)
    errors = {}
    for name, chart in INERTIA_PARAMETRISATIONS.items():
        mixed = dynamics(
            chart.inertia(0.4 * chart.coordinates(first) + 0.6 * chart.coordinates(second))
        )
        errors[name] = np.abs(mixed - (0.4 * ends[0] + 0.6 * ends[1])).max() / np.abs(mixed).max()
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
    """`J = U U'`, U by the ten numbers of the paper, J from points."""
    rng = np.random.default_rng(7)
    v = 0.5 * rng.standard_normal(10)
    a, d1, d2, d3, s12, s23, s13, t1, t2, t3 = v
    U = np.exp(a) * np.array(
        [
            [np.exp(d1), s12, s13, t1],
            [0, np.exp(d2), s23, t2],
            [0, 0, np.exp(d3), t3],
            [0, 0, 0, 1.0],
        ]
    )
    body = from_logcholesky(v)
    J, h = U @ U.T, body.mass * body.com
    S = body.second_moments + np.outer(h, h) / body.mass
    np.testing.assert_allclose(
        J, np.block([[S, h[:, None]], [h[None], np.array([[body.mass]])]]), rtol=1e-12, atol=1e-14
    )


@pytest.mark.parametrize(
    "moments",
    [
        (0.0, 0.0, 0.0),
        (0.1, 0.1, 0.0),
        (0.3, 0.2, 0.1),
        (0.3 * (1 + 1e-12), 0.2, 0.1),
        (0.5, 0.2, 0.1),
    ],
)
def test_points_rods_and_plates_have_no_log_cholesky(moments: tuple[float, ...]) -> None:
    """Bodies with a singular or unphysical pseudo-inertia are refused, thicker ones accepted."""
    turned = solids(1, 8)[0].principal_axes()[1]
    body = BodyInertia.from_principal(2.0, np.array([0.1, 0.2, 0.3]), np.array(moments), turned)
    with pytest.raises(ValueError, match=r"a point, a rod or a plate"):
        to_logcholesky(body)
    for chart in ("central", "barycentric"):
        assert np.isfinite(INERTIA_PARAMETRISATIONS[chart].coordinates(body)).all()
    thick = BodyInertia.from_principal(
        2.0, np.array([0.1, 0.2, 0.3]), np.array([0.3 * (1 - 1e-6), 0.2, 0.1]), turned
    )
    np.testing.assert_allclose(
        from_logcholesky(to_logcholesky(thick)).inertia, thick.inertia, rtol=1e-8, atol=1e-12
    )


def test_magnitudes_follow_the_units() -> None:
    """Magnitudes in other units of mass and length are those converted."""
    body = solids(1, 9)[0]
    kilo, centi = 1000.0, 100.0
    other = BodyInertia(
        mass=kilo * body.mass, com=centi * body.com, inertia=kilo * centi**2 * body.inertia
    )
    factor = {"kg": kilo, "kg m": kilo * centi, "kg m²": kilo * centi**2, "m": centi, "": 1.0}
    for chart in INERTIA_PARAMETRISATIONS.values():
        assert len(chart.names) == len(set(chart.names)) == len(chart.units) == 10
        np.testing.assert_allclose(
            chart.magnitudes(other),
            chart.magnitudes(body) * [factor[u] for u in chart.units],
            rtol=1e-12,
        )
        assert (chart.magnitudes(body) > 0.0).all()

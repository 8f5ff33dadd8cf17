"""Moves and differences of states against those of MuJoCo, on a model with every type of joint."""

from __future__ import annotations

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.plant.batch import state_space
from tests.support.numerics import Loop

EVERY_JOINT = """
<mujoco>
  <worldbody>
    <body><joint type="slide"/><geom size="0.1"/>
      <body><joint type="ball"/><geom size="0.1"/>
        <body><joint type="hinge"/><joint type="slide" axis="1 0 0"/><geom size="0.1"/></body>
      </body>
    </body>
    <body><freejoint/><geom size="0.1"/>
      <body><joint type="hinge"/><geom size="0.1"/>
        <body><joint type="ball"/><geom size="0.1"/></body></body>
    </body>
  </worldbody>
  <actuator><general joint="" dyntype="integrator"/></actuator>
</mujoco>
""".replace('joint=""', 'joint="first"').replace('type="slide"/>', 'name="first" type="slide"/>', 1)

COUNT = 200


@pytest.fixture(scope="module")
def model():
    """Model with the joints slide, ball, hinge, slide, free, hinge and ball; one activation."""
    return mujoco.MjModel.from_xml_string(EVERY_JOINT)


def random_states(space, rng: np.random.Generator, count: int = COUNT) -> np.ndarray:
    """States with unit quaternions anywhere on the sphere."""
    states = rng.normal(size=(count, space.nq + space.nv + space.na))
    for q, _ in space.quaternions:
        states[:, q : q + 4] /= np.linalg.norm(states[:, q : q + 4], axis=1, keepdims=True)
    return states


def random_steps(space, longest: float, rng: np.random.Generator, count: int = COUNT) -> np.ndarray:
    """Tangent vectors whose rotations have any direction and at most the `longest` length [rad]."""
    dx = rng.normal(size=(count, space.nx))
    for _, v in space.quaternions:
        lengths = np.linalg.norm(dx[:, v : v + 3], axis=1, keepdims=True)
        dx[:, v : v + 3] *= rng.uniform(0.0, longest, (count, 1)) / lengths
    return dx


@pytest.mark.parametrize("longest", [1e-9, 1e-3, 1.0, 3.1, 10.0])
def test_plus_and_minus_are_those_of_mujoco(model, longest: float) -> None:
    space, loop, rng = state_space(model), Loop(model, 1), np.random.default_rng(1)
    states, dx = random_states(space, rng), random_steps(space, longest, rng)
    moved = np.array([loop.plus(x, d) for x, d in zip(states, dx, strict=True)])
    assert_allclose(space.plus(states, dx), moved, rtol=0, atol=1e-14)

    expected = np.array([loop.minus(a, b) for a, b in zip(moved, states, strict=True)])
    assert_allclose(space.minus(moved, states), expected, rtol=0, atol=1e-12)
    # Rotations reach nearly half a turn.
    assert np.linalg.norm(expected[:, 1:4], axis=1).max() > 0.97 * min(longest, 3.1)


def test_the_derivative_of_minus_agrees_with_differences(model) -> None:
    """This also holds where rotations are small, and where they are nearly half a turn."""
    space, rng, h = state_space(model), np.random.default_rng(9), 1e-6
    origin = random_states(space, rng, 1)[0]
    for longest in (1e-9, 1e-2, 3.0):
        dx = random_steps(space, longest, rng, 1)[0]
        state = space.plus(origin, dx)
        moved = space.plus(state, h * np.eye(space.nx)), space.plus(state, -h * np.eye(space.nx))
        slope = (space.minus(moved[0], origin) - space.minus(moved[1], origin)).T / (2 * h)
        assert_allclose(
            space.minus_derivative(space.minus(state, origin)), slope, rtol=0, atol=1e-7
        )
    assert np.abs(slope - np.eye(space.nx)).max() > 0.1

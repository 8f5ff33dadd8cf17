"""Null spaces of synthetic sensitivities and of a double pendulum whose base parameters are known
in closed form.
"""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.information.null_space import NullSpace, find_null_space, parameter_groups
from tests.support.numerics import Array, make_task, sensitivity_of

SIZES = np.array([1e-6, 1e-3, 1.0, 1e3, 1e6])


def rows(null: Array, seed: int = 0, n: int = 60) -> Array:
    """Random (n, p) whose null space, with parameters in units of their sizes, is spanned by the
    columns of null: (p, k).
    """
    p, k = null.shape
    seen = np.linalg.qr(null, mode="complete")[0][:, k:]
    return np.random.default_rng(seed).normal(size=(n, p - k)) @ seen.T


def look(J: Array, error: Array | None = None, size: Array = SIZES, **changes) -> NullSpace:
    """Null space of rows whose parameters have these sizes and no prior."""
    p = len(size)
    given = {"scale": size, "interest": np.arange(p), "prior": np.zeros((p, p)), **changes}
    return find_null_space(J, error, size, **given)


def same_span(found: Array, expected: Array) -> bool:
    """Tell whether two matrices span one space."""
    a, b = np.linalg.qr(found)[0], np.linalg.qr(expected)[0]
    return a.shape == b.shape and np.linalg.svd(a.T @ b)[1].min() > 1.0 - 1e-9


NULLS = {
    "one pair": np.array([[1.0, 0.0, 0.0, 0.0, -1.0]]).T,
    "one of all": np.array([[1.0, -2.0, 0.5, 3.0, -1.0]]).T,
    "two": np.array([[1.0, -1.0, 0.0, 0.0, 0.0], [0.0, 0.0, 1.0, 2.0, -1.0]]).T,
    "three that share members": np.random.default_rng(1).normal(size=(5, 3)),
}


@pytest.mark.parametrize("noise", [0.0, 1e-11], ids=["exact", "round-off"])
@pytest.mark.parametrize("case", NULLS)
def test_a_known_null_space_is_found_for_parameters_of_any_size(case: str, noise: float) -> None:
    null = NULLS[case]
    J = rows(null) / SIZES
    error = noise * np.random.default_rng(2).normal(size=J.shape) / SIZES
    found = look(J + error, 4.0 * error)
    assert found.count == null.shape[1]
    assert same_span(found.directions / SIZES[:, None], null)
    assert_allclose(found.basis.T @ found.basis, np.eye(5 - found.count), atol=1e-12)
    assert_allclose(found.basis.T @ null, 0.0, atol=1e-8)  # the scales here are the sizes


@pytest.mark.parametrize("weak", [1e-3, 1e-5])
def test_a_weak_but_visible_parameter_is_not_called_invisible(weak: float) -> None:
    J = np.random.default_rng(3).normal(size=(60, 5)) * [1.0, 1e3, 1.0, weak, 1.0] / SIZES
    rng = np.random.default_rng(4)
    # the differences of a strong parameter are in error by more than the weak one does at all
    error = rng.normal(size=J.shape) * np.abs(J).max(axis=0) * 1e-9
    found = look(J + error, error)
    assert found.count == 0
    assert found.smallest > 0.5


def test_nearly_alike_columns_are_visible_down_to_the_error_of_the_differences() -> None:
    rng = np.random.default_rng(5)
    J = rng.normal(size=(60, 2))
    J[:, 1] = J[:, 0] + 1e-6 * J[:, 1]
    exact, vague = (look(J, e * rng.normal(size=J.shape), np.ones(2)) for e in (1e-12, 1e-6))
    assert (exact.count, vague.count) == (0, 1)
    assert exact.smallest < 1e-5
    assert_allclose(vague.directions[0], -vague.directions[1], rtol=1e-4)


@pytest.mark.parametrize("alive", [0, 1, 4])
def test_parameters_without_effect_are_silent(alive: int) -> None:
    J = np.zeros((60, 5))
    J[:, :alive] = np.random.default_rng(6).normal(size=(60, alive)) / SIZES[:alive]
    found = look(J)
    assert found.silent == tuple(range(alive, 5))
    assert found.count == 5 - alive
    assert found.basis.shape == (5, alive)
    assert np.abs(found.basis[alive:]).max(initial=0.0) < 1e-12
    assert (found.smallest > 0.5) == (alive > 0)


def test_round_off_beside_strong_parameters_is_silent_and_a_weak_exact_effect_is_not() -> None:
    rng = np.random.default_rng(7)
    J = np.column_stack([1e5 * rng.normal(size=60), 1e-4 * rng.normal(size=60)])
    assert look(J, np.column_stack([np.zeros(60), J[:, 1]]), np.ones(2)).silent == (
        1,
    )  # it changes with the step
    assert look(J, np.column_stack([np.zeros(60), 1e-3 * J[:, 1]]), np.ones(2)).silent == ()


def test_a_single_wanted_parameter_confounded_with_a_nuisance_is_hidden() -> None:
    rng = np.random.default_rng(8)
    wanted = 1e5 * rng.normal(size=60)
    J = np.column_stack([wanted, -3.0 * wanted + 1e-6 * rng.normal(size=60)])
    error = 1e-6 * rng.normal(size=J.shape)
    for known in (None, error):
        assert look(J, known, np.ones(2), interest=np.array([0])).silent == (0,)
    J[:, 1] += 100.0 * rng.normal(size=60)
    seen = look(J, error, np.ones(2), interest=np.array([0]))
    assert seen.count == 0
    assert seen.smallest < 1e-3  # little is left of it: a doubt that deserves a second look


def test_a_direction_known_to_be_invisible_stays_so_despite_large_round_off() -> None:
    chaotic = np.random.default_rng(10).normal(size=(60, 5)) / SIZES  # everything seems to show
    one, two = NULLS["one of all"], NULLS["two"]
    # what the rows do not show is added to what is known
    for J, known, expected in (
        (chaotic, one, one),
        (rows(two[:, :1]) / SIZES, two[:, 1:], two),
        (rows(two) / SIZES, two[:, 1:], two),
    ):
        found = look(J, known=known * SIZES[:, None])
        assert same_span(found.directions / SIZES[:, None], expected)
        assert found.silent == ()
    assert look(chaotic, known=np.eye(5)[:, [1]]).silent == (1,)


def test_groups_name_their_members_and_identifiable_combinations() -> None:
    found = look(rows(NULLS["two"]), size=np.ones(5))
    first, second = map(str, parameter_groups(found, "abcde", np.ones(5), [""] * 5))
    assert first == "a and b only as a + b"
    assert second.startswith("c, d and e only as ")


@pytest.mark.parametrize("case", NULLS)
def test_combinations_of_groups_do_not_change_along_the_null_space(case: str) -> None:
    found = look(rows(NULLS[case]) / SIZES)
    groups = parameter_groups(found, "abcde", SIZES, [""] * 5)
    assert sum(len(g.members) - len(g.combinations) for g in groups) == found.count
    for group in groups:
        for combination in group.combinations:
            assert set(combination) <= set(group.members)
            assert next(iter(combination.values())) == 1.0
            at = ["abcde".index(name) for name in combination]
            terms = np.array([*combination.values()])[:, None] * found.directions[at]
            assert_allclose(terms.sum(axis=0), 0.0, atol=1e-7 * np.abs(terms).max())


LENGTH = 0.7
DOUBLE = """
<mujoco model="double">
  <option timestep="0.01" integrator="RK4"><flag contact="disable"/></option>
  <worldbody>
    <body name="a">
      <joint name="ja" type="hinge" axis="0 1 0" damping="0.1"/>
      <inertial pos="0.05 0.02 0.3" mass="1.5" fullinertia="0.05 0.06 0.02 0.001 0.002 -0.001"/>
      <body name="b" pos="0 0 0.7">
        <joint name="jb" type="hinge" axis="0 1 0" damping="0.1"/>
        <inertial pos="-0.03 0.01 0.25" mass="0.8"
          fullinertia="0.02 0.025 0.01 0.0005 -0.001 0.001"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="ta" joint="ja"/><motor name="tb" joint="jb"/></actuator>
</mujoco>
"""


def test_a_double_pendulum_shows_its_base_parameters(tmp_path) -> None:
    """Both inertias are unknown, both joints driven and measured."""
    parameters = {name: {"inertial": name, "coordinates": "barycentric"} for name in "ab"}
    control = {"kind": "multisine", "amplitude": 2.0, "frequency": 1.0}
    initial = {"qpos": (0.4, 0.5), "control": control}
    task = make_task(
        DOUBLE, tmp_path, parameters=parameters, noise={"state": 1e-3}, initial=initial, horizon=1.0
    )
    seen = task.identifiability_test.along(task.initial, sensitivity_of(task))
    assert (seen.along_trajectory.count, seen.along_all.count) == (14, 14)
    lumped, silent = seen.groups_along_all
    # first moment m1 r1 + l m2 and inertia J1 + l^2 m2 about the first hinge, each a textbook base
    # parameter
    assert lumped.members == ("a.mz", "a.Jyy", "b.mass")
    for combination, member, power in zip(
        lumped.combinations, lumped.members, (1, 2), strict=False
    ):
        assert [*combination] == [member, "b.mass"]
        assert [*combination.values()] == pytest.approx([1.0, LENGTH**power], rel=1e-5)
    visible = {"a.mx", "b.mx", "b.mz", "b.Jyy", *lumped.members}
    assert set(silent.members) == set(seen.names) - visible
    assert silent.combinations == ()

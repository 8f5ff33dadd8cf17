"""Functions of arrays: scaling to a unit diagonal, the pseudo-inverse, evenly spread indices."""

from __future__ import annotations

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.arrays import (
    evenly_spread_indices,
    freeze,
    scaled_pseudo_inverse,
    scaled_to_unit_diagonal,
)

# Changes of the units of three parameters.
UNITS = np.array([1e-8, 1.0, 1e6])


def semidefinite(rank: int) -> np.ndarray:
    """Return a random symmetric positive semidefinite matrix (3, 3) of a rank."""
    root = np.random.default_rng(rank).normal(size=(3, rank))
    return root @ root.T


def test_scaling_gives_a_unit_diagonal_whatever_the_units() -> None:
    """Stacks of matrices are scaled as well, and a row of zeros stays zero."""
    plain, _ = scaled_to_unit_diagonal(semidefinite(3))

    stacked = np.stack([semidefinite(3) * np.outer(UNITS, UNITS), np.diag([4.0, 0.0, 9.0])])
    scaled, scale = scaled_to_unit_diagonal(stacked)

    assert_allclose(scaled[0], plain, rtol=1e-12)
    assert_array_equal(scaled[1], np.diag([1.0, 0.0, 1.0]))
    assert scale[1, [0, 2]].tolist() == [2.0, 3.0]


def test_the_pseudo_inverse_of_a_regular_matrix_is_its_inverse_in_any_units() -> None:
    H = semidefinite(3)
    inverse = np.linalg.inv(H)
    found = scaled_pseudo_inverse(H * np.outer(UNITS, UNITS), 1e-14)
    assert_allclose(found * np.outer(UNITS, UNITS), inverse, rtol=1e-8)


@pytest.mark.parametrize("rank", [1, 2])
def test_the_pseudo_inverse_of_a_singular_matrix_is_a_generalised_inverse(rank: int) -> None:
    H = semidefinite(rank)
    inverse = scaled_pseudo_inverse(H, 1e-12)
    assert_allclose(H @ inverse @ H, H, atol=1e-10)
    assert_allclose(inverse, inverse.T, atol=1e-12)
    assert np.linalg.matrix_rank(inverse, tol=1e-8) == rank


@pytest.mark.parametrize(("count", "limit"), [(10, 4), (3, 8), (1, 1), (1000, 1000)])
def test_spread_indices_reach_from_the_first_to_the_last_row(count: int, limit: int) -> None:
    indices = evenly_spread_indices(count, limit)
    assert len(indices) == min(count, limit)
    assert indices[0] == 0
    assert indices[-1] == (count - 1 if len(indices) > 1 else 0)
    assert (np.diff(indices) > 0).all()


def test_records_share_arrays_that_nobody_can_change() -> None:
    """Arrays that can be written are copied, and so are views of them."""

    class Holder:
        """A record with one array."""

        def __init__(self, array: np.ndarray) -> None:
            self.array = array

    own = np.arange(6.0)
    view = own[:3]
    view.setflags(write=False)
    frozen = np.arange(6.0)
    frozen.setflags(write=False)
    for given, is_shared in ((own, False), (view, False), (frozen, True), (frozen[:3], True)):
        holder = Holder(given)
        freeze(holder, "array")
        assert np.array_equal(holder.array, given) and not holder.array.flags.writeable
        assert np.shares_memory(holder.array, given) == is_shared

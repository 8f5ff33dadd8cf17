"""The parameters that a motion identifies, chosen by the Fisher information."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from mjfim.arrays import Array

# Largest relative standard deviation of a proposed parameter along the initial control. A designed
# motion gives several times more information than the initial one.
LARGEST_STD = 0.3

# Largest number of proposed parameters, so that a design takes a minute.
MOST_PARAMETERS = 10

# A parameter belongs to a direction without effect if its share in it is larger than this.
LEAST_SHARE = 1e-4


def identifiable(
    F: Array,
    sizes: Array,
    told_apart: Callable[[Sequence[int]], Sequence[int]] = lambda members: members,
    *,
    most: int = MOST_PARAMETERS,
) -> Sequence[int]:
    """Choose parameters that a motion identifies together, one after the other.

    A parameter is taken if the standard deviations of all chosen ones stay below a share of their
    sizes. Those that a test cannot tell apart from the others make room for later ones.

    Args:
        F: (p, p) Fisher information [1 / theta-unit²].
        sizes: (p,) sizes with which the standard deviations are compared [theta-unit].
        told_apart: Returns the members of a choice that can be told apart.
        most: Largest number of parameters.

    Returns:
        Indices of the chosen parameters in their order; the one that is known best where none is
        known well enough.
    """
    # Information about relative changes, in which units do not matter.
    relative = F * np.outer(sizes, sizes)
    candidates = list(range(len(sizes)))

    # A choice that passes the test is final; every other one loses a candidate.
    while True:
        chosen = _known_together(relative, candidates, most)
        kept = told_apart(chosen) if chosen else chosen
        if len(kept) == len(chosen):
            break
        hidden = set(chosen) - set(kept)
        candidates = [i for i in candidates if i not in hidden]

    return chosen or [int(np.argmax(np.diag(relative)))]


def _known_together(relative: Array, candidates: Sequence[int], most: int) -> list[int]:
    """Choose candidates in their order, as many as are known accurately together.

    Args:
        relative: (p, p) information about relative changes of the parameters.
        candidates: Indices of the parameters that may be chosen.
        most: Largest number of parameters.
    """
    chosen: list[int] = []
    for i in candidates:
        if len(chosen) == most:
            break
        if _largest_std(relative, [*chosen, i]) <= LARGEST_STD:
            chosen.append(i)
    return chosen


def separable(directions: Array) -> Sequence[int]:
    """Choose parameters such that no combination of them is without effect.

    The first ones are kept, because parameters stand in the order of preference.

    Args:
        directions: (p, k) independent directions without effect, relative to the sizes of the
            parameters.

    Returns:
        Indices of p - k parameters, ascending.
    """
    p, k = directions.shape
    unit = directions / np.maximum(np.linalg.norm(directions, axis=0), np.finfo(float).tiny)

    # Without a parameter that a direction needs, the rest of this direction has an effect.
    kept: list[int] = []
    dropped: list[int] = []
    for i in reversed(range(p)):
        tried = [*dropped, i]
        is_needed = np.linalg.matrix_rank(unit[tried], tol=LEAST_SHARE) == len(tried)
        if len(dropped) < k and is_needed:
            dropped.append(i)
        else:
            kept.append(i)
    return sorted(kept)


def _largest_std(F: Array, members: list[int]) -> float:
    """Largest standard deviation of some parameters that are estimated together."""
    part = F[np.ix_(members, members)]
    diagonal = np.sqrt(np.diag(part))
    if not np.isfinite(part).all() or not (diagonal > 0.0).all():
        return np.inf

    # Scaling by the diagonal keeps the eigenvalues comparable.
    correlation = part / np.outer(diagonal, diagonal)
    values, vectors = np.linalg.eigh(correlation)
    if values[0] <= len(members) * np.finfo(float).eps * 1e3:
        return np.inf
    variances = (vectors**2 / values).sum(axis=1) / diagonal**2
    return float(np.sqrt(variances.max()))

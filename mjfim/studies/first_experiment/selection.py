"""The parameters that a motion identifies, chosen by the Fisher information."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjfim.arrays import Array

# Largest relative standard deviation of a proposed parameter along the initial control. A designed
# motion gives several times more information than the initial one.
LARGEST_STD = 0.3

# Largest number of proposed parameters, so that a design takes a minute.
MOST_PARAMETERS = 10


def identifiable(F: Array, sizes: Array, *, most: int = MOST_PARAMETERS) -> Sequence[int]:
    """Choose parameters that a motion identifies together, one after the other.

    Args:
        F: (p, p) information of the motion [1 / (theta_i theta_j unit)].
        sizes: (p,) sizes of the parameters [theta-unit].
        most: Largest number of parameters.

    Returns:
        Indices of the candidates, in their order, that are known accurately together; the one about
        which most is known where there are none.
    """
    # Information about relative changes, in which units do not matter.
    relative = F * np.outer(sizes, sizes)
    chosen: list[int] = []
    for i in range(len(sizes)):
        if len(chosen) < most and _largest_std(relative, [*chosen, i]) <= LARGEST_STD:
            chosen.append(i)
    return chosen or [int(np.argmax(np.diag(relative)))]


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

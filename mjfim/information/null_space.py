"""The null space of sensitivities: combinations of parameters without effect on the measurements.

A direction n with `G n = 0` at every sample is in the null space. The columns of the stacked,
whitened G are scaled to unit length, so that a parameter with a weak effect is not mistaken for
one without effect. Singular values below the error of G count as zero; this error is the change of
G with a difference step that is four times longer.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjfim.arrays import Array, record
from mjfim.records.check import Combination, ParameterGroup

# Ratio of the second difference step to the first one; the change of G between them is its error.
COARSER_STEP_FACTOR = 4.0

# A normalised singular value above this number is certainly not round-off, so that one difference
# step is enough.
CLEAR_SINGULAR_VALUE = 1e-4

# Bounds of the threshold below which a normalised singular value counts as zero: values below the
# first number always do, values above the second number never do.
ZERO_SINGULAR_VALUES = (1e-9, 1e-5)

# The threshold for a singular value is this multiple of the error of G, within the bounds above.
ERROR_FACTOR = 3.0

# A parameter has no effect if a change by its size changes the data by at most this number of
# standard deviations.
LEAST_EFFECT = 1e-6

# A column is compared with its error only if it is below this fraction of the strongest column.
LEAST_RELATIVE_EFFECT = 1e-7

# Such a weak column counts as zero if it is below this multiple of its error.
COLUMN_ERROR_FACTOR = 5.0

# Coefficients of a combination below this fraction of the largest one are round-off; they are
# compared after multiplication with the sizes of the parameters.
LEAST_COEFFICIENT = 1e-4

# Directions are linearly dependent if a singular value is below this fraction of the largest one.
DEPENDENT = 1e-6

# Lower bound of a norm by which a column is divided; it avoids a division by zero.
SMALLEST_NORM = 1e-300

# A parameter is lumped into others if the remainder of its row exceeds a fraction of the longest
# row. These fractions are tried in turn, because a small remainder leads to large coefficients.
LUMPING_SHARES = (0.05, 1e-3, 1e-6)

# Order in which parameters are lumped into others, by unit, as is usual for chains of bodies.
# Parameters with other units come last.
LUMPING_ORDER = {"kg": 0, "kg m": 1, "kg m²": 2}


@record
class NullSpace:
    """Directions of the t wanted parameters without any effect.

    Attributes:
        directions: (t, k) directions [theta-unit].
        silent: Indices of the wanted parameters that have no effect alone.
        basis: (t, t-k) orthonormal combinations with an effect, in scaled units.
        smallest: Distance from a larger null space, 0 to 1: the smallest singular value of the
            normalised columns with an effect, times the smallest fraction of such a column that
            nuisance parameters do not explain.
    """

    directions: Array
    silent: tuple[int, ...]
    basis: Array
    smallest: float

    @property
    def count(self) -> int:
        """Number k of directions without effect."""
        return int(self.directions.shape[1])


def find_null_space(
    J: Array,
    error: Array | None,
    size: Array,
    scale: Array,
    interest: np.ndarray,
    prior: Array,
    *,
    known: Array | None = None,
) -> NullSpace:
    """Find the null space of stacked, whitened rows of G.

    Args:
        J: (n, p) rows [1 / theta-unit].
        error: (n, p) their change with a longer difference step; None if it is not known.
        size: (p,) magnitudes of the parameters [theta-unit].
        scale: (p,) units of the basis [theta-unit].
        interest: (t,) indices of the wanted parameters.
        prior: (p, p) prior information, whose diagonal counts as data for the nuisance parameters.
        known: (t, k) directions that are known to have no effect.

    Returns:
        The null space of the wanted parameters.
    """
    J, error, length_before = _wanted_columns(J, error, size, interest, prior)
    length = np.linalg.norm(J, axis=0)

    # A parameter is dead if it has no effect, or only one that nuisance parameters explain.
    explained = length <= ZERO_SINGULAR_VALUES[0] * length_before
    round_off = length <= COLUMN_ERROR_FACTOR * np.linalg.norm(error, axis=0)
    weak = length <= LEAST_RELATIVE_EFFECT * length_before.max(initial=0.0)
    dead = (length <= LEAST_EFFECT) | explained | (round_off & weak)
    left_by_nuisance = length / np.maximum(length_before, SMALLEST_NORM)
    least_share = float(left_by_nuisance[~dead].min(initial=1.0))

    # Columns without effect and known directions are in the null space. Further directions are
    # searched orthogonally to them.
    t = len(interest)
    found = np.eye(t)[:, dead]
    if known is not None:
        found = _independent(np.concatenate([found, known / size[interest][:, None]], axis=1))
        Q = np.linalg.qr(found)[0]
        J = J - (J @ Q) @ Q.T
        error = error - (error @ Q) @ Q.T

    live = ~dead & (np.linalg.norm(J, axis=0) > ZERO_SINGULAR_VALUES[0] * length)
    hidden, smallest = _hidden_directions(J, error, live)
    found = _independent(np.concatenate([found, hidden], axis=1))
    directions = found * size[interest][:, None]
    # A parameter is silent if its axis lies in the span of the directions.
    inside = np.sum(np.linalg.qr(found)[0] ** 2, axis=1)
    complement = np.linalg.qr(directions / scale[interest][:, None], mode="complete")[0]

    return NullSpace(
        directions=directions,
        silent=tuple(np.flatnonzero(inside > 1.0 - LEAST_COEFFICIENT**2).tolist()),
        basis=complement[:, directions.shape[1] :],
        smallest=smallest * least_share,
    )


def has_weak_column(J: Array, size: Array) -> bool:
    """Whether a parameter has so little effect that only the error of G tells it from round-off.

    Args:
        J: (n, p) rows of the stacked, whitened G [1 / theta-unit].
        size: (p,) magnitudes of the parameters [theta-unit].
    """
    length = np.linalg.norm(J * size, axis=0)
    return bool((length <= LEAST_RELATIVE_EFFECT * length.max(initial=0.0)).any())


def _wanted_columns(
    J: Array, error: Array | None, size: Array, interest: np.ndarray, prior: Array
) -> tuple[Array, Array, Array]:
    """Columns of the wanted parameters, from which the effects of nuisance parameters are removed.

    The arguments are those of `find_null_space`.

    Returns:
        (n, t) effects of each parameter changed by its size [standard deviations], their (n, t)
        errors, and the (t,) lengths of the columns before the removal.
    """
    J = J * size
    error = np.zeros_like(J) if error is None else error * size
    length_before = np.linalg.norm(J[:, interest], axis=0)

    nuisance = np.setdiff1d(np.arange(len(size)), interest)
    if len(nuisance):
        # The priors of nuisance parameters are further rows of data, without error.
        prior_rows = np.sqrt(np.diag(np.diag(prior)))[nuisance] * size
        J = np.concatenate([J, prior_rows])
        error = np.concatenate([error, np.zeros_like(prior_rows)])

        columns = J[:, nuisance]
        length = np.linalg.norm(columns, axis=0)
        columns = columns[:, length > 0.0] / length[length > 0.0]
        U, sizes, _ = np.linalg.svd(columns, full_matrices=False)
        Q = U[:, sizes > ZERO_SINGULAR_VALUES[0]]
        J = J - Q @ (Q.T @ J)
        error = error - Q @ (Q.T @ error)

    return J[:, interest], error[:, interest], length_before


def _hidden_directions(J: Array, error: Array, live: np.ndarray) -> tuple[Array, float]:
    """Directions among the live columns whose effect is no larger than the error.

    Args:
        J: (n, t) columns.
        error: (n, t) their error.
        live: (t,) True for the columns to combine.

    Returns:
        (t, k) unit directions, and the smallest normalised singular value of the others.
    """
    columns = np.flatnonzero(live)
    if not len(columns):
        return np.zeros((len(live), 0)), 0.0

    norm = np.maximum(np.linalg.norm(J[:, columns], axis=0), SMALLEST_NORM)
    triangle = np.linalg.qr(J[:, columns] / norm, mode="r")
    _, values, V = np.linalg.svd(triangle)
    values = np.concatenate([values, np.zeros(len(columns) - len(values))])

    size_of_error = np.linalg.norm(error[:, columns] / norm, 2)
    zero = values <= np.clip(ERROR_FACTOR * size_of_error, *ZERO_SINGULAR_VALUES)

    found = np.zeros((len(live), int(zero.sum())))
    found[columns] = V[zero].T / norm[:, None]
    unit = found / np.maximum(np.linalg.norm(found, axis=0), SMALLEST_NORM)
    return unit, float(values[~zero].min(initial=1.0))


def _independent(directions: Array) -> Array:
    """Orthonormal columns that span the space of (t, m) directions."""
    U, sizes, _ = np.linalg.svd(directions, full_matrices=False)
    largest = max(sizes.max(initial=0.0), SMALLEST_NORM)
    return U[:, sizes > DEPENDENT * largest]


def parameter_groups(
    null: NullSpace, names: Sequence[str], size: Array, units: Sequence[str]
) -> tuple[ParameterGroup, ...]:
    """Describe a null space by groups of parameters and their identifiable combinations.

    Args:
        null: The null space.
        names: Names of the t wanted parameters.
        size: (t,) their magnitudes, by which coefficients are recognised as round-off [theta-unit].
        units: Their units, which determine the parameters that are lumped into others.

    Returns:
        The groups. Parameters without any effect form the last one, which has no combinations.
    """
    N = null.directions
    lumped = _lumped_parameters(N / size[:, None], units)
    base = np.setdiff1d(np.arange(len(N)), lumped)
    coefficients = _lumping_coefficients(N, size, lumped, base)

    # A lumped parameter and the parameters into which it is lumped belong to one group.
    links = []
    for j, f in enumerate(lumped.tolist()):
        partners = base[coefficients[:, j] != 0.0].tolist()
        links.append({f, *partners})

    groups = []
    for members in _joined(links):
        if members <= set(null.silent):
            continue
        rows: list[Combination] = []
        for b, row in zip(base.tolist(), coefficients, strict=True):
            if b in members:
                used = {names[lumped[j]]: float(row[j]) for j in np.flatnonzero(row).tolist()}
                rows.append({names[b]: 1.0, **used})
        member_names = tuple(names[m] for m in sorted(members))
        groups.append(ParameterGroup(members=member_names, combinations=tuple(rows)))

    if null.silent:
        silent = tuple(names[m] for m in null.silent)
        groups.append(ParameterGroup(members=silent, combinations=()))
    return tuple(groups)


def _lumping_coefficients(N: Array, size: Array, lumped: np.ndarray, base: np.ndarray) -> Array:
    """(b, k) coefficients with which the k lumped parameters are added to the b others.

    Coefficients that are round-off are set to zero.

    Args:
        N: (t, k) directions of the null space [theta-unit].
        size: (t,) magnitudes of the parameters [theta-unit].
        lumped: (k,) indices of the lumped parameters.
        base: (b,) indices of the others.
    """
    coefficients = -N[base] @ np.linalg.inv(N[lumped])
    relative = np.abs(coefficients * size[lumped] / size[base][:, None])
    threshold = LEAST_COEFFICIENT * max(1.0, relative.max(initial=0.0))
    return np.where(relative > threshold, coefficients, 0.0)


def _lumped_parameters(N: Array, units: Sequence[str]) -> np.ndarray:
    """Choose k parameters that are lumped into the others; their rows of N are independent.

    Masses are chosen first, then first moments and inertias. Among parameters of one unit, those
    declared last are chosen first.

    Args:
        N: (t, k) directions of the null space, relative to the sizes of the parameters.
        units: Units of the t parameters.

    Returns:
        (k,) indices, ascending.
    """
    last = len(LUMPING_ORDER)
    order = sorted(range(len(N)), key=lambda i: (LUMPING_ORDER.get(units[i], last), -i))
    longest = np.linalg.norm(N, axis=1).max(initial=0.0)
    chosen: list[int] = []
    spanned = np.zeros((0, N.shape[1]))

    for share in LUMPING_SHARES:
        for i in order:
            if len(chosen) == N.shape[1]:
                break
            remainder = N[i] - spanned.T @ (spanned @ N[i])
            length = np.linalg.norm(remainder)
            if i not in chosen and length > share * longest:
                chosen.append(i)
                spanned = np.concatenate([spanned, (remainder / length)[None]])
    return np.sort(np.array(chosen, dtype=np.intp))


def _joined(sets: list[set[int]]) -> list[set[int]]:
    """Unions of sets that share members, in the order of their least members."""
    joined: list[set[int]] = []
    for new in sets:
        touching = [other for other in joined if other & new]
        apart = [other for other in joined if not other & new]
        joined = [*apart, new.union(*touching)]
    return sorted(joined, key=min)

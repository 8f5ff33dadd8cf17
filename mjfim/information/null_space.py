"""Which combinations of parameters show in the measurements at all, told apart from round-off by a second difference step.

A direction n with `G n = 0` at every sample is invisible. The columns of the stacked, whitened G are brought to unit length,
so that a weak parameter is not mistaken for an invisible one; singular values below the error of G (the change of G with a
four times longer step) count as zero.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.records.combinations import Combination, ParameterGroup

COARSER_STEP_FACTOR = 4.0  # the second step, times the first
CLEAR_SINGULAR_VALUE = 1e-4  # a normalised singular value above it needs no second look
TOLERANCE = (1e-9, 1e-5)
LEAST_EFFECT = 1e-6  # standard deviations that the data move when a parameter changes by all its size: no effect
LEAST_RELATIVE_EFFECT = (
    1e-7  # of the strongest column; an error of the difference may exceed a column only below it
)
LEAST_COEFFICIENT = 1e-4  # coefficients of a combination below it, in natural units, are round-off


@dataclass(frozen=True, eq=False)
class NullSpace:
    """Invisible directions of the t wanted parameters.

    directions: (t, k) in raw units;  silent: indices of wanted parameters that change nothing by themselves
    basis: (t, t-k) orthonormal, the visible combinations in scaled units
    smallest: least singular value of the visible part, columns normalised, times the least share of a column that nuisance
    leaves (1: orthogonal; 0: none to be told from zero)
    """

    directions: Array
    silent: tuple[int, ...]
    basis: Array
    smallest: float

    @property
    def count(self) -> int:
        """Number k of invisible directions."""
        return int(self.directions.shape[1])


def find_null_space(
    J: Array,
    error: Array | None,
    size: Array,
    scale: Array,
    interest: np.ndarray,
    prior: Array,
    known: Array | None = None,
) -> NullSpace:
    """Invisible directions of stacked, whitened rows of G.

    J: (n, p);  error: (n, p) its change with a longer difference step, None where that is not known
    size: (p,) the parameters' own magnitudes;  scale: (p,) units of the basis;  interest: (t,) indices
    prior: (p, p), whose nuisance part counts as data;  known: (t, k) directions that are invisible for another reason
    """
    J, error = J * size, np.zeros_like(J) if error is None else error * size
    whole = np.linalg.norm(J[:, interest], axis=0)
    nuisance = np.setdiff1d(np.arange(len(size)), interest)
    if len(nuisance):
        told = np.sqrt(np.diag(np.diag(prior)))[nuisance] * size
        J, error = np.concatenate([J, told]), np.concatenate([error, np.zeros_like(told)])
        Q = _range(J[:, nuisance])
        J, error = J - Q @ (Q.T @ J), error - Q @ (Q.T @ error)
    J, error, t = J[:, interest], error[:, interest], len(interest)
    length, doubt = np.linalg.norm(J, axis=0), np.linalg.norm(error, axis=0)
    dead = (length <= LEAST_EFFECT) | (length <= TOLERANCE[0] * whole)
    dead |= (length <= 5.0 * doubt) & (length <= LEAST_RELATIVE_EFFECT * whole.max(initial=0.0))
    share = float((length / np.maximum(whole, 1e-300))[~dead].min(initial=1.0))
    own = np.eye(t)[:, dead]
    if known is not None and known.shape[1]:
        own = _independent(np.concatenate([own, known / size[interest][:, None]], axis=1))
        Q = np.linalg.qr(own)[0]
        J, error = J - (J @ Q) @ Q.T, error - (error @ Q) @ Q.T
    live = ~dead & (np.linalg.norm(J, axis=0) > TOLERANCE[0] * length)
    found, smallest = _hidden(J, error, live)
    own = _independent(np.concatenate([own, found], axis=1))
    raw = own * size[interest][:, None]
    k = raw.shape[1]
    full = np.linalg.qr(raw / scale[interest][:, None], mode="complete")[0] if k else np.eye(t)
    silent = (
        np.sum(np.linalg.qr(own)[0] ** 2, axis=1) > 1.0 - LEAST_COEFFICIENT**2
        if k
        else np.zeros(t, dtype=bool)
    )
    return NullSpace(
        raw, tuple(int(i) for i in np.flatnonzero(silent)), full[:, k:], smallest * share
    )


def _hidden(J: Array, error: Array, live: np.ndarray) -> tuple[Array, float]:
    """Directions (t, k) among the live columns whose effect is no larger than the error, and the least effect of the rest."""
    columns = np.flatnonzero(live)
    if not len(columns):
        return np.zeros((len(live), 0)), 0.0
    unit = np.maximum(np.linalg.norm(J[:, columns], axis=0), 1e-300)
    values, V = np.linalg.svd(np.linalg.qr(J[:, columns] / unit, mode="r"))[1:]
    values = np.concatenate([values, np.zeros(len(columns) - len(values))])
    hidden = values <= np.clip(3.0 * np.linalg.norm(error[:, columns] / unit, 2), *TOLERANCE)
    found = np.zeros((len(live), int(hidden.sum())))
    found[columns] = V[hidden].T / unit[:, None]
    return found / np.maximum(np.linalg.norm(found, axis=0), 1e-300), float(
        values[~hidden].min(initial=1.0)
    )


def _independent(directions: Array) -> Array:
    """Orthonormal columns that span the same directions."""
    U, s, _ = np.linalg.svd(directions, full_matrices=False)
    return np.asarray(U[:, s > 1e-6 * max(s.max(initial=0.0), 1e-300)])


def _range(A: Array) -> Array:
    """Orthonormal basis of the range of A, columns compared at unit length."""
    length = np.linalg.norm(A, axis=0)
    some = length > 0.0
    U, s, _ = np.linalg.svd(A[:, some] / length[some], full_matrices=False)
    return np.asarray(U[:, s > TOLERANCE[0]])


def parameter_groups(
    null: NullSpace, names: Sequence[str], size: Array, units: Sequence[str]
) -> tuple[ParameterGroup, ...]:
    """The invisible directions in the user's words: groups of parameters and the combinations that remain of them.

    names, size, units: of the t wanted parameters; sizes decide which coefficients are round-off. Parameters without any
    effect make one group.
    """
    N = null.directions
    if not null.count:
        return ()
    lumped = _lumped(N / size[:, None], units)
    base = np.setdiff1d(np.arange(len(N)), lumped)
    coefficients = -N[base] @ np.linalg.inv(N[lumped])
    relative = coefficients * size[lumped] / size[base][:, None]
    coefficients = np.where(
        np.abs(relative) > LEAST_COEFFICIENT * max(1.0, np.abs(relative).max(initial=0.0)),
        coefficients,
        0.0,
    )
    links = [
        {int(f), *(int(b) for b, c in zip(base, coefficients[:, j], strict=True) if c)}
        for j, f in enumerate(lumped)
    ]
    groups, none = [], [names[m] for m in null.silent]
    for members in _joined(links):
        if members <= set(null.silent):
            continue
        rows = []
        for i, b in enumerate(base):
            if b in members:
                parts = [
                    (int(f), float(coefficients[i, j]))
                    for j, f in enumerate(lumped)
                    if coefficients[i, j]
                ]
                rows.append(
                    Combination(
                        members=(names[b], *(names[f] for f, _ in parts)),
                        coefficients=(1.0, *(c for _, c in parts)),
                    )
                )
        groups.append(
            ParameterGroup(
                members=tuple(names[m] for m in sorted(members)), combinations=tuple(rows)
            )
        )
    return (
        (*groups, ParameterGroup(members=tuple(none), combinations=())) if none else tuple(groups)
    )


def _lumped(N: Array, units: Sequence[str]) -> np.ndarray:
    """k parameters that are lumped into the others: independent rows of N: (t, k).

    As is usual for chains of bodies, masses go first, then first moments and inertias, those declared last before the others.
    """
    rank = {"kg": 0, "kg m": 1, "kg m²": 2}
    order = sorted(range(len(N)), key=lambda i: (rank.get(units[i], 3), -i))
    chosen: list[int] = []
    found = np.zeros((0, N.shape[1]))
    for least in (
        0.05,
        1e-3,
        1e-6,
    ):  # rows that stand out come first, lest the coefficients explode
        for i in order:
            if len(chosen) == N.shape[1]:
                break
            row = N[i] - found.T @ (found @ N[i])
            length = np.linalg.norm(row)
            if i not in chosen and length > least * np.linalg.norm(N, axis=1).max():
                chosen.append(i)
                found = np.concatenate([found, (row / length)[None]])
    return np.sort(np.array(chosen, dtype=np.intp))


def _joined(sets: list[set[int]]) -> list[set[int]]:
    """Unions of sets that share members, in the order of their least member."""
    out: list[set[int]] = []
    for new in sets:
        touching = [s for s in out if s & new]
        out = [s for s in out if not s & new] + [new.union(*touching)]
    return sorted(out, key=min)

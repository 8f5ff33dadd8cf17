"""Records of parameter combinations that can be identified."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array


@dataclass(frozen=True, kw_only=True)
class Combination:
    """A visible combination `sum_i coefficients_i * parameter_i`, its first member with coefficient 1."""

    members: tuple[str, ...]
    coefficients: tuple[float, ...]

    def __str__(self) -> str:
        head, *rest = zip(self.members, self.coefficients, strict=True)
        return " ".join(
            [head[0], *(f"{'+' if c > 0 else '-'} {_number(abs(c))}{name}" for name, c in rest)]
        )


def combination_matrix(groups: Sequence[ParameterGroup], names: Sequence[str]) -> Array:
    """(c, t) coefficients of all combinations of the groups, over the named parameters."""
    combinations = [c for group in groups for c in group.combinations]
    rows = np.zeros((len(combinations), len(names)))
    for row, combination in zip(rows, combinations, strict=True):
        for member, coefficient in zip(combination.members, combination.coefficients, strict=True):
            row[list(names).index(member)] = coefficient
    return rows


@dataclass(frozen=True, kw_only=True)
class ParameterGroup:
    """Parameters that are visible only together: as `combinations`, fewer than members; none where all are invisible."""

    members: tuple[str, ...]
    combinations: tuple[Combination, ...]

    def __str__(self) -> str:
        names = join_names(self.members)
        if not self.combinations:
            return f"{names}: no effect on anything that is measured"
        return f"{names} only as {', '.join(str(c) for c in self.combinations)}"


def _number(value: float) -> str:
    return "" if abs(value - 1.0) < 1e-6 else f"{value:.4g} "


def join_names(names: Sequence[str]) -> str:
    """`a, b and c`."""
    return names[0] if len(names) == 1 else f"{', '.join(names[:-1])} and {names[-1]}"

"""Records of identifiable combinations of parameters that are not identifiable alone."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import first_ones, shortened

# A coefficient that differs from 1 by less than this number is not written.
UNIT_COEFFICIENT_TOLERANCE = 1e-6

# Longest list of the members of a group in a message [characters].
MEMBERS_TEXT = 120

# Longest text of a combination, and of all combinations of a group, in a message [characters].
COMBINATION_TEXT = 90
COMBINATIONS_TEXT = 180

# Longest text of several groups in a message [characters].
GROUPS_TEXT = 320


@dataclass(frozen=True, kw_only=True)
class Combination:
    """An identifiable linear combination `sum_i coefficients_i * parameter_i`.

    Attributes:
        members: Names of the parameters.
        coefficients: Coefficient of each parameter; the first one is 1.
    """

    members: tuple[str, ...]
    coefficients: tuple[float, ...]

    def __str__(self) -> str:
        return " ".join(self._terms(self.members))

    @property
    def short(self) -> str:
        """The combination in a message; of many terms the first ones and the number of the others.

        Very long names are shortened.
        """
        terms = self._terms([shortened(name) for name in self.members])
        return first_ones(terms, " ", COMBINATION_TEXT)

    def _terms(self, names: Sequence[str]) -> list[str]:
        """Return the terms with given names of the members."""
        terms = [names[0]]
        for name, coefficient in zip(names[1:], self.coefficients[1:], strict=True):
            sign = "+" if coefficient > 0 else "-"
            terms.append(f"{sign} {_factor(abs(coefficient))}{name}")
        return terms


@dataclass(frozen=True, kw_only=True)
class ParameterGroup:
    """Parameters that are identifiable only together.

    Attributes:
        members: Names of the parameters.
        combinations: The identifiable combinations, fewer than members; empty if no member has an
            effect.
    """

    members: tuple[str, ...]
    combinations: tuple[Combination, ...]

    def __str__(self) -> str:
        names = join_names(self.members)
        if not self.combinations:
            return f"{names}: no effect on any measured output"
        return f"{names} only as {', '.join(str(c) for c in self.combinations)}"

    @property
    def short(self) -> str:
        """The group in a message; of many names and terms the first ones are shown."""
        if len(str(self)) <= COMBINATIONS_TEXT:
            return str(self)

        names = self.short_names
        if not self.combinations:
            return f"{names}: no effect on any measured output"
        combinations = [combination.short for combination in self.combinations]
        return f"{names} only as {first_ones(combinations, longest=COMBINATIONS_TEXT)}"

    @property
    def short_names(self) -> str:
        """The members in a message; of many members the first ones and the number of the others."""
        names = join_names(self.members)
        return (
            names
            if len(names) <= MEMBERS_TEXT
            else first_ones([shortened(name) for name in self.members], longest=MEMBERS_TEXT)
        )

    def summary(self) -> dict[str, Any]:
        """Return the contents of one group in check.json."""
        identifiable = [
            dict(zip(c.members, c.coefficients, strict=True)) for c in self.combinations
        ]
        return {
            "members": list(self.members),
            "identifiable": identifiable,
            "words": str(self),
        }


def combination_matrix(groups: Sequence[ParameterGroup], names: Sequence[str]) -> Array:
    """Return the coefficients of all combinations of several groups as a matrix.

    Args:
        groups: Groups of parameters.
        names: Names of the t parameters, one per column.

    Returns:
        (c, t) coefficients, one row per combination.
    """
    combinations = [c for group in groups for c in group.combinations]
    column_of = {name: j for j, name in enumerate(names)}

    matrix = np.zeros((len(combinations), len(names)))
    for row, combination in zip(matrix, combinations, strict=True):
        for member, coefficient in zip(combination.members, combination.coefficients, strict=True):
            row[column_of[member]] = coefficient
    return matrix


def groups_in_words(groups: Sequence[ParameterGroup]) -> str:
    """Describe groups in a message; of many groups the first ones and the number of the others.

    Args:
        groups: The groups.
    """
    return first_ones([group.short for group in groups], "; ", GROUPS_TEXT)


def join_names(names: Sequence[str]) -> str:
    """Return names as a list in a sentence: `a, b and c`."""
    if len(names) == 1:
        return names[0]
    return f"{', '.join(names[:-1])} and {names[-1]}"


def _factor(coefficient: float) -> str:
    """Return the text of a coefficient in front of a name; empty if the coefficient is 1."""
    if abs(coefficient - 1.0) < UNIT_COEFFICIENT_TOLERANCE:
        return ""
    return f"{coefficient:.4g} "

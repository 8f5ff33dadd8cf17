"""Records of the comparison of two robots, or of one robot before and after."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mjfim.arrays import Array, freeze
from mjfim.records.combinations import join_names
from mjfim.records.differences import difference_text, p_text, value_text
from mjfim.records.shown import ShownRecord

# Number of parameters that a sentence names.
MAX_NAMED = 3


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
class RobotComparison(ShownRecord):
    """Result of `mjfim.compare_estimates`: differences of two estimates, and what they mean.

    Attributes:
        names: Names of the two robots.
        recordings: Number of recordings of each robot.
        parameters: Names of the q parameters that both estimates determine.
        units: Their units; may be empty.
        is_single: (q,) 1 for single numbers; 0 for entries of vectors and tensors, and for
            coordinates that may be zero, of which a percentage means nothing.
        values: (2, q) estimates of both robots [theta-unit].
        std: (2, q) their honest standard deviations, with the scatter between recordings
            [theta-unit].
        interval: (q, 2) 95 % intervals of the differences, second less first robot [theta-unit].
        p: (q,) p-values of equal parameters, corrected for the number of tests by the method of
            Holm.
        detectable: (q,) differences that would have been found with a probability of 80 %
            [theta-unit].
        joint_p: p-value of the hypothesis that all parameters are equal, corrected likewise.
        level: Probability to find any difference where there is none.
        remarks: Sentences that limit the comparison, the most serious ones first.
        is_reliable: False where one of the estimates is not reliable, or does not fit.
    """

    names: tuple[str, ...]
    recordings: tuple[int, ...]
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    is_single: Array
    values: Array
    std: Array
    interval: Array
    p: Array
    detectable: Array
    joint_p: float
    level: float
    remarks: tuple[str, ...] = ()
    is_reliable: bool = True

    file_stem: ClassVar[str] = "robots"
    made_by: ClassVar[str] = "`mjfim compare-robots DIR_A DIR_B -o DIR`"

    def __post_init__(self) -> None:
        freeze(self, "is_single", "values", "std", "interval", "p", "detectable")

    @property
    def difference(self) -> Array:
        """(q,) second less first robot [theta-unit]."""
        return np.asarray(self.values[1] - self.values[0])

    @property
    def order(self) -> np.ndarray:
        """(q,) indices of the parameters, the most significant difference first."""
        sigmas = np.abs(self.difference) / np.hypot(*self.std)
        return np.lexsort((-sigmas, self.p))

    @property
    def changed(self) -> tuple[int, ...]:
        """Indices of the parameters that differ, the most significant one first."""
        return tuple(j for j in self.order.tolist() if self.p[j] <= self.level)

    @property
    def differs(self) -> bool:
        """Whether the robots differ, in single parameters or in all of them together."""
        return bool(self.changed) or self.joint_p <= self.level

    def sentence(self, j: int) -> str:
        """Say how a parameter differs.

        Args:
            j: Index of the parameter.
        """
        (first, second), (first_std, second_std) = self.values[:, j], self.std[:, j]
        unit = self.units[j]
        difference = difference_text(
            second, first, first_std, unit, is_single=bool(self.is_single[j])
        )
        numbers = f"{value_text(second, second_std)} against {value_text(first, first_std)} {unit}"
        return (
            f"{self.parameters[j]} of {self.names[1]} is {difference} that of {self.names[0]}: "
            f"{numbers.rstrip()}, {p_text(self.p[j])}"
        )

    @property
    def sensitivity(self) -> str:
        """Sentence that says which differences would have been found."""
        parts = []
        for j in np.argsort(self.relative_detectable, kind="stable")[:MAX_NAMED]:
            share = self.relative_detectable[j]
            amount = f"{self.detectable[j]:.2g} {self.units[j]}".rstrip()
            if self.is_single[j] and share < 1.0:
                amount = f"{100.0 * share:.2g} %"
            parts.append(f"{amount} in {self.parameters[j]}")
        more = len(self.parameters) - len(parts)
        others = f" (and {more} more, see the table)" if more else ""
        return f"A change of {join_names(parts)}{others} would have been found with 80 % power."

    @property
    def relative_detectable(self) -> Array:
        """(q,) differences that would have been found, over the value of the first robot."""
        size = np.abs(self.values[0])
        return np.asarray(self.detectable / np.where(size > 0.0, size, np.nan))

    def __str__(self) -> str:
        first, second = self.names
        if not self.parameters:
            return f"There is no parameter that both {first} and {second} determine."
        if self.changed:
            names = join_names([self.parameters[j] for j in self.changed])
            return f"There is a difference between {first} and {second} in {names}."
        if self.differs:
            return (
                f"There is a difference between {first} and {second}, but the data do not say in "
                f"which single parameter ({p_text(self.joint_p)} for all parameters together)."
            )
        return f"The data show no difference between {first} and {second}. {self.sensitivity}"

    def summary(self) -> dict[str, Any]:
        """Return the contents of robots.json."""
        return {
            "names": list(self.names),
            "words": str(self),
            "differs": self.differs,
            "changes": [self.sentence(j) for j in self.changed],
            "reliable": self.is_reliable,
            "remarks": list(self.remarks),
            "recordings": list(self.recordings),
            "parameters": list(self.parameters),
            "units": list(self.units),
            "values": self.values,
            "std": self.std,
            "difference": self.difference,
            "interval": self.interval,
            "p": self.p,
            "detectable": self.detectable,
            "joint_p": self.joint_p,
            "level": self.level,
        }

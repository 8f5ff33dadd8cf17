"""Record of fits over segments of several lengths, and of their predictions over several times."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mjfim.arrays import Array, freeze
from mjfim.records.combinations import join_names

# Ratio of the errors over the longest and the shortest horizon above which they grow.
GROWTH = 1.2

# Smallest error in a denominator.
SMALLEST_ERROR = 1e-150


@dataclass(frozen=True, eq=False, kw_only=True)
class HorizonStudy:
    """Fits over segments of different lengths, and how well each predicts left-out data.

    Each fit predicts parts of the data from the others, over times of each length. The longest
    length is chosen whose predictions over all these times are not clearly worse than the best
    ones, because longer segments give more accurate estimates.

    Attributes:
        lengths: (L,) lengths of the segments, which are the prediction horizons as well [s]. The
            last one is that of whole recordings, if these were fitted.
        errors: (L, L) error of left-out data of the fit over each length, in each horizon [standard
            deviations of the noise].
        chosen: Index of the chosen length.
        is_whole: Whether the last length is that of whole recordings.
        parameters: Names of the p parameters.
        units: (p,) their units.
        theta: (L, p) estimates by each fit [theta-unit].
        half_widths: (L, p) half widths of their 95 % intervals, by the scatter between the
            estimates without each part of the data [theta-unit].
        is_apart: (L, p) whether an estimate differs from that of the chosen length by more than
            chance explains.
        why_not_used: Why the estimate is over whole recordings although segments were chosen, in
            words; empty where it is over the chosen length.
    """

    lengths: Array
    errors: Array
    chosen: int
    is_whole: bool
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    theta: Array
    half_widths: Array
    is_apart: Array
    why_not_used: str = ""

    def __post_init__(self) -> None:
        """Freeze the arrays."""
        freeze(self, "lengths", "errors", "theta", "half_widths", "is_apart")

    @property
    def chosen_whole(self) -> bool:
        """Whether whole recordings were chosen."""
        return self.is_whole and self.chosen == len(self.lengths) - 1

    @property
    def dependent(self) -> tuple[str, ...]:
        """Names of the parameters whose estimate depends on the length of the segments."""
        columns = np.flatnonzero(np.asarray(self.is_apart, dtype=bool).any(axis=0))
        return tuple(self.parameters[j] for j in columns)

    @property
    def is_used(self) -> bool:
        """Whether the estimate is over the chosen length."""
        return not self.why_not_used

    @property
    def relative_errors(self) -> Array:
        """(L,) error of each fit over the smallest one in each horizon, as root mean square."""
        errors = np.asarray(self.errors)
        least = np.where(np.isfinite(errors), errors, np.inf).min(axis=0)
        ratios = errors / np.maximum(least, SMALLEST_ERROR)
        return np.asarray(np.sqrt(np.mean(ratios**2, axis=1)))

    def name_of(self, index: int) -> str:
        """A length in words.

        Args:
            index: Index of the length.
        """
        if self.is_whole and index == len(self.lengths) - 1:
            return "whole recordings"
        return f"segments of {self.lengths[index]:.2g} s"

    def widened(self, interval: Array) -> Array:
        """Intervals that also hold the estimates of other lengths that chance does not explain.

        Where the estimate is not over the chosen length, they hold the one over it as well.

        Args:
            interval: (p, 2) intervals of the estimate [theta-unit].

        Returns:
            (p, 2) intervals.
        """
        apart = np.array(self.is_apart, dtype=bool)
        if not self.is_used:
            apart[self.chosen] = apart.any(axis=0)
        low = np.where(apart, self.theta, np.inf).min(axis=0)
        high = np.where(apart, self.theta, -np.inf).max(axis=0)
        return np.column_stack([np.minimum(interval[:, 0], low), np.maximum(interval[:, 1], high)])

    def __str__(self) -> str:
        uses = () if self.is_used else (self.about_use,)
        return " ".join([self.about_choice, *uses, self.about_growth, *self.findings])

    @property
    def about_choice(self) -> str:
        """Sentence that says which length was chosen."""
        first, last = self.lengths[0], self.lengths[-1]
        ratios = self.relative_errors
        text = (
            "The model does not explain the recordings, so the length of the segments matters: "
            f"{self.name_of(self.chosen)} were chosen, the longest ones whose predictions of "
            f"left-out data over times of {first:.2g} to {last:.2g} s are not clearly worse than "
            f"the best (error over the smallest one for each time: {ratios[self.chosen]:.3g}"
        )
        others = [i for i in range(len(self.lengths)) if i != self.chosen]
        listed = [f"{ratios[i]:.3g} with {self.name_of(i)}" for i in others]
        return f"{text}, {join_names(listed)})."

    @property
    def about_use(self) -> str:
        """Sentence that says why the estimate is over whole recordings; empty where it is not."""
        if self.is_used:
            return ""
        return (
            f"The estimate is over whole recordings, not over {self.name_of(self.chosen)}: "
            f"{self.why_not_used}."
        )

    @property
    def about_growth(self) -> str:
        """Sentence that says what the error against the horizon means."""
        errors = self.errors[self.chosen]
        if errors[-1] > GROWTH * errors[0]:
            return (
                f"The error grows from {errors[0]:.3g} σ over {self.lengths[0]:.2g} s to "
                f"{errors[-1]:.3g} σ over {self.lengths[-1]:.2g} s: the model misses an effect "
                "that adds up with time."
            )
        return (
            f"The error is {errors[0]:.3g} σ over {self.lengths[0]:.2g} s and {errors[-1]:.3g} σ "
            f"over {self.lengths[-1]:.2g} s: the model misses an effect that does not add up with "
            "time, or the noise is larger than stated."
        )

    @property
    def findings(self) -> tuple[str, ...]:
        """A sentence for each parameter whose estimate depends on the length of the segments."""
        found = []
        for name in self.dependent:
            j = self.parameters.index(name)
            unit = f" {self.units[j]}" if self.units[j] else ""
            values = [
                f"{self.theta[i, j]:.4g}{unit} with {self.name_of(i)}"
                for i in range(len(self.lengths))
                if self.is_apart[i, j] or i == self.chosen
            ]
            found.append(
                f"{name} depends on the length: {join_names(values)}; this is more than chance "
                "explains, so the model misses something, and the interval covers these values."
            )
        return tuple(found)

    def summary(self) -> dict[str, Any]:
        """Return the contents of `horizons` in estimate.json."""
        return {
            "words": str(self),
            "lengths": self.lengths.tolist(),
            "errors": self.errors.tolist(),
            "chosen": self.chosen,
            "is_used": self.is_used,
            "is_whole": self.is_whole,
            "theta": self.theta.tolist(),
            "half_widths": self.half_widths.tolist(),
            "depends_on_length": list(self.dependent),
        }

"""Records of differences between recordings of one robot, and between two robots."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjfim.arrays import NORMAL_95, Array, record
from mjfim.records.base import Record, ShownRecord
from mjfim.records.check import join_names

# Difference over the value it is compared with, up to which it is written in percent.
LARGEST_SHARE = 10.0


# Smallest p-value that is written as a number.
SMALLEST_P = 1e-15


def difference_text(
    value: float, reference: float, reference_std: float, unit: str, *, is_single: bool
) -> str:
    """Write how far a value is above or below another one, in percent where this means something.

    Args:
        value: The value.
        reference: The other one, in the same unit.
        reference_std: Its standard deviation.
        unit: The unit; may be empty.
        is_single: Whether the value is a single number, such as a mass. The entry of a vector, and
            a coordinate that may be zero, have no percentage.
    """
    above = "above" if value > reference else "below"
    change, size = abs(value - reference), abs(reference)

    # A percentage of a value that may be zero means nothing.
    is_positive = value * reference > 0.0 and size > NORMAL_95 * reference_std
    if is_single and is_positive and change <= LARGEST_SHARE * size:
        return f"{100.0 * change / size:.2g} % {above}"
    amount = f"{change:.2g} {unit}".rstrip()
    return f"{amount} {above}"


def value_text(value: float, std: float) -> str:
    """Write a value with half the width of its 95 % interval.

    Args:
        value: The value.
        std: Its standard deviation.
    """
    return f"{value:.3g} ± {NORMAL_95 * std:.2g}"


def p_text(p: float) -> str:
    """Write a p-value.

    Args:
        p: The p-value.
    """
    return f"p = {p:.1g}" if p >= SMALLEST_P else f"p < {SMALLEST_P:g}"


# p-value up to which recordings are said to disagree on a parameter.
SIGNIFICANCE = 1e-3


# Largest number of recordings among which scatter and a single odd one look alike.
FEW = 5


@record
class OddRecording(Record):
    """A recording that differs from all others.

    Attributes:
        index: Index of the recording.
        name: Its name.
        p: p-value, corrected for the number of tests.
        parameters: Names of the parameters in which it differs, the most significant one first;
            empty where only combinations of parameters differ.
        differences: How each of them differs, in words.
    """

    index: int
    name: str
    p: float
    parameters: tuple[str, ...]
    differences: tuple[str, ...]

    def __str__(self) -> str:
        if not self.parameters:
            return (
                f"{self.name} is odd: combinations of its parameters differ from those of the "
                f"other recordings ({p_text(self.p)})"
            )
        return f"{self.name} is odd: {'; '.join(self.differences)}"


@record
class RecordingComparison(Record):
    """Values that single recordings suggest, and their scatter.

    Each value is one Gauss-Newton step away from the estimate of all recordings.

    Attributes:
        recordings: Names of the K recordings.
        parameters: Names of q parameters that belong to the robot.
        units: Their units; may be empty.
        is_stated: (q,) 1 for parameters that are stated to differ between recordings, which are not
            tested; 0 for the others.
        values: (K, q) values that each recording alone suggests; NaN where it does not determine
            the parameter [theta-unit].
        std: (K, q) standard deviations of the values, without the scatter between recordings
            [theta-unit].
        mean: (q,) mean over the recordings, which allows for their scatter [theta-unit].
        interval: (q, 2) 95 % interval of the mean [theta-unit].
        tau: (q,) standard deviations between recordings [theta-unit].
        share: (q,) I²: share of the scatter that is between recordings, 0 to 1.
        p: (q,) p-value of the hypothesis that a parameter is equal in all recordings, corrected for
            the number of parameters; 1 where nothing is tested.
        prediction: (q, 2) 95 % interval of what another recording would suggest alone; infinite
            with fewer than three [theta-unit].
        joint_p: p-value of the hypothesis that all parameters are equal in all recordings.
        odd: Recordings that differ from the others, the most significant one first.
    """

    recordings: tuple[str, ...]
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    is_stated: Array
    values: Array
    std: Array
    mean: Array
    interval: Array
    tau: Array
    share: Array
    p: Array
    prediction: Array
    joint_p: float
    odd: tuple[OddRecording, ...]

    in_json = (
        "words",
        "recordings",
        "parameters",
        "values",
        "std",
        "mean",
        "interval",
        "tau",
        "share",
        "p",
        "prediction",
        "joint_p",
    )

    @property
    def order(self) -> np.ndarray:
        """(q,) indices of the parameters, those that differ most first."""
        return np.argsort(np.where(self.is_stated > 0.0, 0.0, self.p), kind="stable")

    @property
    def apart(self) -> tuple[int, ...]:
        """Indices of the parameters on which the recordings disagree."""
        return tuple(np.flatnonzero(self.p <= SIGNIFICANCE).tolist())

    def __str__(self) -> str:
        if self.odd:
            few = (
                f" With {len(self.recordings)} recordings, an odd one can hardly be told from "
                "recordings that all scatter."
            )
            sentences = ". ".join(str(odd) for odd in self.odd)
            return f"{sentences}.{few if len(self.recordings) <= FEW else ''}"
        alone = ", without a single one that is odd" if "more than" in self.finding else ""
        return f"The recordings {self.finding}{alone}."

    @property
    def separate(self) -> tuple[int, ...]:
        """Indices of the parameters for which the 95 % intervals of two recordings do not meet."""
        reach = NORMAL_95 * np.where(np.isfinite(self.values), self.std, np.inf)
        values = np.nan_to_num(self.values)
        is_apart = (values - reach).max(axis=0) > (values + reach).min(axis=0)
        return tuple(np.flatnonzero(is_apart & (self.is_stated == 0.0)).tolist())

    @property
    def finding(self) -> str:
        """Finding on all recordings together, as the end of a sentence."""
        by_more = "by more than their noise explains"
        if self.joint_p <= SIGNIFICANCE and not self.apart:
            return f"differ in combinations of the parameters {by_more} ({p_text(self.joint_p)})"
        found = self.apart or self.separate
        names = join_names([self.parameters[j] for j in found]) if found else ""
        if self.apart:
            return f"differ in {names} {by_more}"
        return f"may differ in {names} (intervals apart)" if names else "agree within their noise"

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        return {
            **super().summary(),
            "stated_to_differ": [bool(stated) for stated in self.is_stated],
            "odd": [
                {
                    "recording": odd.name,
                    "p": odd.p,
                    "words": str(odd),
                    "parameters": list(odd.parameters),
                }
                for odd in self.odd
            ],
        }


# Difference over the value of the first robot that needs a word even where chance may explain it.
LARGE = 0.25


# Number of parameters that a sentence names.
MAX_NAMED = 3


@record
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

    file_stem = "robots"
    made_by = "`mjfim compare-robots DIR_A DIR_B -o DIR`"
    in_json = (
        "names",
        "words",
        "differs",
        "is_reliable",
        "remarks",
        "recordings",
        "parameters",
        "units",
        "values",
        "std",
        "difference",
        "interval",
        "p",
        "detectable",
        "joint_p",
        "level",
    )
    json_names = {"is_reliable": "reliable"}

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
    def doubtful(self) -> tuple[int, ...]:
        """Indices of the parameters that may differ, although this is not proven.

        The interval of the difference excludes zero, but not by enough for the number of tests, or
        the estimates differ much, which chance may explain.
        """
        is_far = np.prod(self.interval, axis=1) > 0.0
        is_far |= (self.is_single > 0.0) & (
            np.abs(self.difference) > LARGE * np.abs(self.values[0])
        )
        return tuple(j for j in self.order.tolist() if is_far[j] and self.p[j] > self.level)

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
        return self.detectable / np.where(size > 0.0, size, np.nan)

    @property
    def words(self) -> str:
        """The result in a sentence or two."""
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
        if self.doubtful:
            return f"The data do not prove a difference, but {self.sentence(self.doubtful[0])}."
        return f"The data show no difference between {first} and {second}. {self.sensitivity}"

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        return {
            **super().summary(),
            "changes": [self.sentence(j) for j in self.changed],
        }

"""Records of the comparison of recordings: what each says alone, their scatter, and odd ones."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mjfim.arrays import Array, freeze
from mjfim.records.combinations import join_names
from mjfim.records.differences import difference_text, p_text, value_text

# p-value up to which recordings are said to disagree on a parameter.
SIGNIFICANCE = 1e-3

# Largest number of recordings among which scatter and a single odd one look alike.
FEW = 5


@dataclass(frozen=True, kw_only=True)
class OddParameter:
    """A parameter in which one recording differs from the others.

    Attributes:
        name: Name of the parameter.
        unit: Its unit; may be empty.
        value: Value that the recording alone suggests [unit].
        std: Standard deviation of this value [unit].
        others: Value that the other recordings suggest [unit].
        others_std: Standard deviation of that value [unit].
        p: p-value of the difference, corrected for the number of recordings and parameters.
        is_single: False for the entry of a vector or tensor, of which a percentage means nothing.
    """

    name: str
    unit: str
    value: float
    std: float
    others: float
    others_std: float
    p: float
    is_single: bool = True

    def __str__(self) -> str:
        difference = difference_text(
            self.value, self.others, self.others_std, self.unit, is_single=self.is_single
        )
        own, others = value_text(self.value, self.std), value_text(self.others, self.others_std)
        numbers = f"{own} against {others} {self.unit}".rstrip()
        return f"its {self.name} is {difference} that of the others ({numbers}, {p_text(self.p)})"


@dataclass(frozen=True, kw_only=True)
class OddRecording:
    """A recording that differs from all others.

    Attributes:
        index: Index of the recording.
        name: Its name.
        p: p-value, corrected for the number of tests.
        parameters: Parameters in which it differs, the most significant one first; empty where only
            combinations of parameters differ.
    """

    index: int
    name: str
    p: float
    parameters: tuple[OddParameter, ...]

    def __str__(self) -> str:
        if not self.parameters:
            return (
                f"{self.name} is odd: combinations of its parameters differ from those of the "
                f"other recordings ({p_text(self.p)})"
            )
        return f"{self.name} is odd: {'; '.join(str(parameter) for parameter in self.parameters)}"


@dataclass(frozen=True, eq=False, kw_only=True)
class RecordingComparison:
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

    def __post_init__(self) -> None:
        freeze(self, "is_stated", "values", "std", "mean", "interval", "tau", "share", "p")
        freeze(self, "prediction")

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
        if self.apart:
            names = join_names([self.parameters[j] for j in self.apart])
            return (
                f"The recordings differ in {names} by more than their noise explains, without a "
                "single one that is odd."
            )
        if self.joint_p <= SIGNIFICANCE:
            return (
                "The recordings differ in combinations of the parameters by more than their noise "
                f"explains ({p_text(self.joint_p)}), without a single one that is odd."
            )
        return (
            "The recordings agree: what each of them suggests alone differs no more than its noise "
            "explains."
        )

    def summary(self) -> dict[str, Any]:
        """Return the contents of `recording_comparison` in estimate.json."""
        return {
            "words": str(self),
            "recordings": list(self.recordings),
            "parameters": list(self.parameters),
            "stated_to_differ": [bool(stated) for stated in self.is_stated],
            "values": self.values,
            "std": self.std,
            "mean": self.mean,
            "interval": self.interval,
            "tau": self.tau,
            "share": self.share,
            "p": self.p,
            "prediction": self.prediction,
            "joint_p": self.joint_p,
            "odd": [
                {
                    "recording": odd.name,
                    "p": odd.p,
                    "words": str(odd),
                    "parameters": [parameter.name for parameter in odd.parameters],
                }
                for odd in self.odd
            ],
        }

"""Record of a control law in the loop with which recordings were simulated."""

from __future__ import annotations

import math
from dataclasses import asdict, dataclass
from typing import Any

# Share of clipped samples below which it is not worth a word.
RARELY = 1e-3

# Range of a control without limits.
NO_RANGE = [-math.inf, math.inf]


@dataclass(frozen=True, kw_only=True)
class ControlLawInLoop:
    """Law with which the driver of an actuator computes the control.

    Attributes:
        actuator: Name of the actuator.
        joint: Name of the joint whose position it controls.
        rate: Rate at which it is evaluated [Hz].
        columns: Columns of the log that it reads.
        numbers: Its numbers by the keys of the experiment file, those without effect left out; both
            ends of a range have an index, as in `saturation[0]`.
        units: Unit of each of these numbers; may be empty.
        estimated: Keys of the numbers that are parameters.
        clipped: Share of the samples at which the limits of the law clip its control, 0 to 1.
        is_servo: Whether a position servo of MJCF is the same law, but for its rate.
    """

    actuator: str
    joint: str
    rate: float
    columns: tuple[str, ...]
    numbers: dict[str, float]
    units: dict[str, str]
    estimated: tuple[str, ...]
    clipped: float
    is_servo: bool

    @property
    def numbers_in_words(self) -> str:
        """The numbers with their units; both ends of the range of the control stand together."""
        words = [
            f"{key} = {value:.5g} {self.units[key]}".rstrip()
            for key, value in self.numbers.items()
            if not key.endswith("]")
        ]
        ends = [self.numbers.get(f"saturation[{i}]", side) for i, side in enumerate(NO_RANGE)]
        if ends != NO_RANGE:
            low, high = (f"{end:.5g}" for end in ends)
            unit = next(unit for key, unit in self.units.items() if key.endswith("]"))
            words.append(f"saturation = {low} to {high} {unit}".rstrip())
        return ", ".join(words)

    def __str__(self) -> str:
        sentence = (
            f"The control of {self.actuator} is that of its law in the loop, evaluated at "
            f"{self.rate:g} Hz: {self.numbers_in_words}"
        )
        if self.clipped > RARELY:
            sentence += f"; its limits clip it at {100.0 * self.clipped:.2g} % of the samples"
        if self.is_servo:
            sentence += "; but for its rate, it is the law of <position> in MJCF with kv = kd"
        return f"{sentence}."

    @property
    def toml(self) -> str:
        """The numbers as a line of an experiment file, with all their digits."""
        entries = [
            f"{key} = {value!r}" for key, value in self.numbers.items() if not key.endswith("]")
        ]
        ends = [self.numbers.get(f"saturation[{i}]", side) for i, side in enumerate(NO_RANGE)]
        if ends != NO_RANGE:
            entries.append(f"saturation = [{ends[0]!r}, {ends[1]!r}]")
        return f"controllers.{self.actuator} = {{ {', '.join(entries)} }}"

    def summary(self) -> dict[str, Any]:
        """Return the contents of an entry of `controllers` in estimate.json."""
        return {**asdict(self), "words": str(self), "toml": self.toml}

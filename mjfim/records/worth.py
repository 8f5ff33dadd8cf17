"""Records of what would make an experiment more accurate: sensors, data, limits."""

from __future__ import annotations

from dataclasses import field
from typing import Any

import numpy as np

from mjfim.arrays import Array, record
from mjfim.records.base import Record, ShownRecord

# Wanted standard deviation where none is stated, relative to the size of the parameter.
DEFAULT_RELATIVE_STD = 0.05

# Share by which a price widens a range or lengthens an experiment.
PRICED_SHARE = 0.1


@record
class SensorWorth(Record):
    """Worth of one sensor, or of all sensors of a kind, for p parameters.

    Attributes:
        name: Name of the sensor.
        noise: Standard deviation of its noise with its unit, in words; empty for several sensors.
        is_added: Whether the model lacks it.
        without: (p,) standard deviations with all sensors but this one [theta-unit].
        present: (p,) standard deviations with all sensors and this one [theta-unit].
        alone: (p,) standard deviations with this sensor alone [theta-unit].
        halved: (p,) standard deviations with all sensors and half of its noise [theta-unit].
    """

    name: str
    noise: str
    is_added: bool
    without: Array
    present: Array
    alone: Array
    halved: Array


@record
class Price(Record):
    """Price of one restriction of a design.

    Attributes:
        name: What restricts the design: the title of a limit, `time` or `end state`.
        step: By how much it is relaxed, in words.
        predicted: Relative change of σ by the multiplier of the barrier; NaN without one.
        redesigned: Relative change of σ in a new design; NaN where none was made.
    """

    name: str
    step: str
    predicted: float = np.nan
    redesigned: float = np.nan

    @classmethod
    def of_limit(cls, title: str, exponent: float) -> Price:
        """The price of a limit by its multiplier: σ falls as `range^-exponent`."""
        change = (1.0 + PRICED_SHARE) ** -exponent - 1.0
        return cls(name=title, step=f"{100 * PRICED_SHARE:g} % wider", predicted=change)

    @property
    def change(self) -> float:
        """Relative change of σ, by a new design where there is one."""
        return self.predicted if np.isnan(self.redesigned) else self.redesigned


@record
class Worth(ShownRecord):
    """Result of `mjfim.worth`: which sensor, which data and which limit would help.

    Attributes:
        source: The motion, in words.
        horizon: Its duration [s].
        parameters: Names of the p parameters.
        units: Their units; may be empty.
        target: (p,) wanted standard deviations, stated or 5 % of the size; NaN for nuisance
            parameters, for those that no sensor determines alone and, where some are stated, for
            those without one [theta-unit].
        is_stated: Whether the experiment states these standard deviations.
        std: (p,) standard deviations with all sensors of the experiment [theta-unit].
        repeated: (p,) standard deviations after two repetitions [theta-unit].
        faster: (p,) standard deviations with twice as many samples a second [theta-unit].
        sensors: What each sensor tells; kinds of several sensors come behind them.
        fewest: The smallest set of sensors that reaches the wanted standard deviations; empty
            where all together do not reach them.
        prices: What restrictions of the design cost.
    """

    source: str
    horizon: float
    parameters: tuple[str, ...]
    units: tuple[str, ...]
    target: Array
    is_stated: bool
    std: Array
    repeated: Array
    faster: Array
    sensors: tuple[SensorWorth, ...]
    fewest: tuple[str, ...] = ()
    prices: tuple[Price, ...] = field(default=())

    file_stem = "worth"
    made_by = "`mjfim worth EXPERIMENT -o DIR`"

    @property
    def goal(self) -> str:
        """The wanted accuracy of a parameter, in words."""
        return "the wanted σ" if self.is_stated else f"a σ of {100 * DEFAULT_RELATIVE_STD:g} %"

    @property
    def dearest(self) -> list[Price]:
        """The prices, the highest first; those that are not known come last."""
        return sorted(self.prices, key=lambda price: (np.isnan(price.change), price.change))

    @property
    def single(self) -> tuple[SensorWorth, ...]:
        """The single sensors, without their kinds."""
        return tuple(each for each in self.sensors if each.noise)

    def ratio(self, std: Array) -> float:
        """Largest ratio of standard deviations, (p,), to the wanted ones."""
        return float(np.nanmax(std / self.target))

    def worst(self, std: Array) -> str:
        """The parameter with this ratio, which limits the accuracy."""
        return self.parameters[int(np.nanargmax(std / self.target))]

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON, with names in place of the order of parameters."""

        def by_name(value: Any) -> Any:
            """Values of the parameters by their names."""
            if isinstance(value, np.ndarray):
                return dict(zip(self.parameters, value.tolist(), strict=True))
            return value

        found = {key: by_name(value) for key, value in super().summary().items()}
        sensors = [
            {key: by_name(value) for key, value in each.items()} for each in found["sensors"]
        ]
        return {**found, "sensors": sensors}

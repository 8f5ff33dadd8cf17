"""Records of what makes parameters accurate: sensors, data, limits, and the rows of a stream."""

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

# Time from whose information the rate of the information follows [s].
RECENT_SECONDS = 5.0


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

    @property
    def improved(self) -> Array:
        """(p,) standard deviations with half of the noise, or with a sensor that is added."""
        return self.present if self.is_added else self.halved


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
    def costliest(self) -> list[Price]:
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


@record
class Watch(ShownRecord):
    """Result of `mjfim watch`: formal standard deviations at the guess, from the rows so far.

    Attributes:
        parameters: Names of the p parameters, without nuisance parameters and those that are held.
        units: Their units; may be empty.
        sizes: (p,) their sizes, of which percent are taken [theta-unit].
        wanted: (p,) wanted standard deviations, stated or 5 % of the size; infinite, where some are
            stated, for those without one [theta-unit].
        is_stated: Whether the experiment states these standard deviations.
        t: (k,) times since the first row, of a long stream not all of them [s].
        std_over_time: (k, p) standard deviations from the rows up to these times; infinite where a
            parameter is not determined [theta-unit].
        reached: (p,) times at which the wanted standard deviations were reached; infinite where
            they were not [s].
        rows: Number of rows that were used.
        left_out: Number of faulty rows.
        warnings: What else the user should know.
    """

    parameters: tuple[str, ...]
    units: tuple[str, ...]
    sizes: Array
    wanted: Array
    is_stated: bool
    t: Array
    std_over_time: Array
    reached: Array
    rows: int
    left_out: int = 0
    warnings: tuple[str, ...] = ()

    file_stem = "watch"
    made_by = "`mjfim watch EXPERIMENT -o DIR`"
    in_json = (
        "rows",
        "left_out",
        "seconds",
        "enough",
        "parameters",
        "units",
        "std",
        "wanted",
        "reached",
        "warnings",
    )

    @property
    def goal(self) -> str:
        """What is wanted of a parameter, in words."""
        return "the wanted σ" if self.is_stated else f"a σ of {100 * DEFAULT_RELATIVE_STD:g} %"

    @property
    def seconds(self) -> float:
        """Time of the last result [s]."""
        return float(self.t[-1])

    @property
    def std(self) -> Array:
        """(p,) standard deviations from all rows [theta-unit]."""
        return np.asarray(self.std_over_time[-1])

    @property
    def asked(self) -> np.ndarray:
        """Numbers of the parameters of which a standard deviation is wanted."""
        return np.flatnonzero(np.isfinite(self.wanted))

    @property
    def enough(self) -> bool:
        """Whether every wanted standard deviation was reached."""
        return bool(np.isfinite(self.reached[self.asked]).all())

    @property
    def seconds_left(self) -> Array:
        """(p,) times until the wanted standard deviations are reached [s].

        The information grows as in the last seconds; infinite where it did not grow.
        """
        begin = int(np.searchsorted(self.t[:-1], self.t[-1] - RECENT_SECONDS, side="right")) - 1
        information = self.std_over_time[[max(begin, 0), -1]] ** -2.0
        gained = information[1] - information[0]
        missing = np.maximum(self.wanted**-2.0 - information[1], 0.0)
        with np.errstate(divide="ignore", invalid="ignore"):
            left = missing * (self.t[-1] - self.t[max(begin, 0)]) / gained
        return np.where(gained > 0.0, left, np.inf)

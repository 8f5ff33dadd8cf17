"""Record of a live meter: the accuracy of the parameters over the time of a stream."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array, record
from mjfim.records.base import ShownRecord
from mjfim.records.worth import DEFAULT_RELATIVE_STD

# Time from whose information the rate of the information follows [s].
RECENT_SECONDS = 5.0


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

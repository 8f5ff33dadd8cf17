"""What a result says about each parameter, by name, by target, and as a table."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import field
from importlib import import_module
from typing import Any

import numpy as np

from mjfim.arrays import NORMAL_95, Array, record
from mjfim.errors import MjfimError, unknown
from mjfim.records.base import Record, ShownRecord

# Module that writes numbers for people; records must not depend on the output.
WORDS = "mjfim.output.words"


@record
class ParameterValue(Record):
    """One parameter in a result; it prints as `0.203 ± 0.004 N m s/rad`, the 95 % interval.

    Attributes:
        name: Its name.
        targets: The numbers of the model that it sets, such as `joint/a:damping`.
        unit: Its unit; may be empty.
        value: Its value: the estimate, or the guess at which σ was predicted [unit].
        std: Standard deviation; infinite or NaN where the parameter is not determined [unit].
        interval: Lower and upper end of the 95 % interval [unit].
        further: Other numbers about it, which `table` shows.
    """

    name: str
    targets: tuple[str, ...]
    unit: str
    value: float
    std: float
    interval: tuple[float, float]
    further: dict[str, float] = field(default_factory=dict)

    def __str__(self) -> str:
        low, high = self.interval
        text: str = import_module(WORDS).format_with_uncertainty(self.value, 0.5 * (high - low))
        return f"{text} {self.unit}".rstrip()

    __repr__ = __str__

    def __float__(self) -> float:
        return self.value


class ParameterResult(ShownRecord):
    """Base class of results about parameters.

    `result["a"]` and `result["joint/a:damping"]` are the `ParameterValue` of a parameter, by its
    name and by what it sets in the model.
    """

    def each(self) -> Iterator[ParameterValue]:
        """What the result says about each parameter, in the order of the experiment."""
        raise NotImplementedError

    def __getitem__(self, key: str) -> ParameterValue:
        known = {target: value for value in self.each() for target in value.targets}
        known |= {value.name: value for value in self.each()}
        if not isinstance(key, str) or key not in known:
            raise MjfimError(unknown("parameter", key, known))
        return known[key]

    def table(self) -> Any:
        """What the result says about each parameter, one row each [unit of the parameter].

        Returns:
            A pandas.DataFrame; a list of dictionaries where pandas is not installed.
        """
        rows = [
            {
                "parameter": each.name,
                "target": ", ".join(each.targets),
                "unit": each.unit,
                "value": each.value,
                "std": each.std,
                "low": each.interval[0],
                "high": each.interval[1],
                **each.further,
            }
            for each in self.each()
        ]
        try:
            pandas = import_module("pandas")
        except ImportError:
            return rows
        return pandas.DataFrame(rows)


def listed_values(
    names: Sequence[str],
    units: Sequence[str],
    values: Array,
    std: Array,
    targets: Sequence[tuple[str, ...]] = (),
    interval: Array | None = None,
    **further: Array,
) -> Iterator[ParameterValue]:
    """Yield what columns say about p parameters.

    Args:
        names: Names of the parameters.
        units: Their units.
        values: (p,) their values.
        std: (p,) their standard deviations.
        targets: What each of them sets in the model; empty where it is not known.
        interval: (p, 2) their 95 % intervals; default: those of a normal distribution.
        **further: (p,) other numbers by their names.
    """
    if interval is None:
        interval = np.asarray(values)[:, None] + np.outer(std, [-NORMAL_95, NORMAL_95])
    for j, name in enumerate(names):
        low, high = interval[j].tolist()
        yield ParameterValue(
            name=name,
            targets=targets[j] if targets else (),
            unit=units[j],
            value=float(values[j]),
            std=float(std[j]),
            interval=(low, high),
            further={key: float(column[j]) for key, column in further.items()},
        )

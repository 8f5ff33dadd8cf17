"""Numbers with a unit, such as "90 deg", and the closed table of units that a user may state.

A number with a unit is converted to SI units when it is read. It remembers its unit, so that the
place where the model is known can refuse a mass that stands for an angle.

Angles are a quantity of their own here: "100 Hz" is not an angular velocity. They are ignored only
beside a mass, because the same torque is written "N m" and "N m/rad".
"""

from __future__ import annotations

import math
import re
from collections.abc import Callable
from dataclasses import dataclass
from typing import Any

from pydantic import GetCoreSchemaHandler, GetJsonSchemaHandler
from pydantic_core import (
    CoreSchema,
    PydanticCustomError,
    PydanticSerializationUnexpectedValue,
    core_schema,
)

from mjfim.arrays import record
from mjfim.errors import listed, shortened, unknown

# One turn [rad].
TURN = 2.0 * math.pi

# Exponents of angle, length, mass, time and electric current in a unit.
Exponents = tuple[int, ...]
NO_DIMENSION: Exponents = (0, 0, 0, 0, 0)
MASS = 2

# Factor to SI units and exponents of every symbol.
SYMBOLS: dict[str, tuple[float, Exponents]] = {
    "rad": (1.0, (1, 0, 0, 0, 0)),
    "deg": (TURN / 360.0, (1, 0, 0, 0, 0)),
    "°": (TURN / 360.0, (1, 0, 0, 0, 0)),
    "rev": (TURN, (1, 0, 0, 0, 0)),
    "rpm": (TURN / 60.0, (1, 0, 0, -1, 0)),
    "m": (1.0, (0, 1, 0, 0, 0)),
    "g": (1e-3, (0, 0, 1, 0, 0)),
    "s": (1.0, (0, 0, 0, 1, 0)),
    "min": (60.0, (0, 0, 0, 1, 0)),
    "Hz": (1.0, (0, 0, 0, -1, 0)),
    "N": (1.0, (0, 1, 1, -2, 0)),
    "Nm": (1.0, (0, 2, 1, -2, 0)),
    "Pa": (1.0, (0, -1, 1, -2, 0)),
    "T": (1.0, (0, 0, 1, -2, -1)),
}

# Other spellings, as programs write them.
SPELLINGS = {"degree": "deg", "radian": "rad", "sec": "s", "second": "s", "RPM": "rpm"}
for _word, _symbol in SPELLINGS.items():
    SYMBOLS[_word] = SYMBOLS[f"{_word}s"] = SYMBOLS[_symbol]

# Symbols that may have a prefix, and the prefixes.
WITH_PREFIX = ("rad", "m", "g", "s", "Hz", "N", "Nm", "Pa", "T")
PREFIXES = {"n": 1e-9, "u": 1e-6, "µ": 1e-6, "μ": 1e-6, "m": 1e-3, "c": 1e-2, "k": 1e3, "M": 1e6}

for _prefix, _size in PREFIXES.items():
    for _symbol in WITH_PREFIX:
        _factor, _exponents = SYMBOLS[_symbol]
        SYMBOLS.setdefault(_prefix + _symbol, (_size * _factor, _exponents))

# Units that messages propose, where they fit.
USUAL_UNITS = (
    *("rad", "deg", "rev", "rad/s", "deg/s", "rev/s", "rpm", "rad/s²", "deg/s²"),
    *("m", "cm", "mm", "m/s", "cm/s", "mm/s", "m/s²", "kg", "g", "s", "ms", "min", "Hz", "kHz"),
    *("N", "mN", "kN", "N m", "mN m", "N/s", "N m/s", "kg m²", "g cm²", "N/m", "N m/rad"),
    *("N s/m", "N m s/rad", "kg/m³", "g/cm³", "Pa s", "T", "mT"),
)

# A number and a unit with an optional space between them, and one factor of a unit.
QUANTITY = r"^\s*([-+]?(?:\d+\.?\d*|\.\d+)(?:[eE][-+]?\d+)?)\s*([^\s\d.+-].*?)\s*$"
FACTOR = re.compile(r"^([A-Za-zµμ°]+)(?:(?:\^|\*\*)?(-?\d)|([²³]))?$")
EXPONENT_SIGNS = {"²": 2, "³": 3}


@record
class Unit:
    """A unit of the closed table, or a product of such units.

    Attributes:
        factor: What a number in this unit is multiplied by to be in SI units.
        exponents: Exponents of angle, length, mass, time and electric current.
    """

    factor: float
    exponents: Exponents

    @classmethod
    def parse(cls, text: str) -> Unit:
        """Read a unit.

        Args:
            text: Symbols with optional exponents, joined by spaces, `*` or `·`, each after `/`
                divides: `N m s/rad`, `kg m²`, `m/s^2`.

        Returns:
            The unit.

        Raises:
            ValueError: A symbol is not in the table; the message proposes the most similar one.
        """
        factor, exponents = 1.0, NO_DIMENSION
        parts = re.split(r"\s*([*·/])\s*|\s+", f"* {text.strip().replace('**', '^')}")[1:]
        for sign, part in zip(parts[::2], parts[1::2], strict=True):
            symbol = FACTOR.match(part)
            if symbol is None:
                raise ValueError(unknown("unit", text, USUAL_UNITS))

            power = int(symbol[2] or EXPONENT_SIGNS.get(symbol[3], 1))
            power = -power if sign == "/" else power
            if symbol[1] not in SYMBOLS:
                raise ValueError(unknown("unit", symbol[1], USUAL_UNITS))
            size, of_symbol = SYMBOLS[symbol[1]]
            factor *= size**power
            exponents = tuple(a + power * b for a, b in zip(exponents, of_symbol, strict=True))
        return cls(factor=factor, exponents=exponents)

    def measures(self, other: Unit) -> bool:
        """Whether numbers of this unit can be converted to another one.

        Args:
            other: The other unit.
        """
        if self.exponents[MASS]:
            return self.exponents[1:] == other.exponents[1:]
        return self.exponents == other.exponents


def is_unit(text: str) -> bool:
    """Whether a text, such as "rad/s", is a unit of the table."""
    try:
        return bool(Unit.parse(text))
    except ValueError:
        return False


def name_and_unit(title: str) -> tuple[str, str]:
    """Split the title of a column, such as "q1 [rad]" or "q1 (deg)", into its name and its unit.

    Args:
        title: The title. What is in its brackets may also be an index.

    Returns:
        The name and the unit; the title and an empty text where it states no known unit.
    """
    found = re.fullmatch(r"(.*?\S)\s*[\[(]\s*([^\d\[\]()][^\[\]()]*?)\s*[\])]", title)
    return (found[1], found[2]) if found and is_unit(found[2]) else (title, "")


def units_like(unit: str) -> list[str]:
    """Usual units of the quantity that a unit measures.

    Args:
        unit: A unit; empty for a quantity that has none.
    """
    wanted = Unit.parse(unit)
    return [name for name in USUAL_UNITS if Unit.parse(name).measures(wanted)]


class Quantity(float):
    """A number in SI units that the user has stated with a unit.

    Attributes:
        text: What the user has stated.
        unit: The stated unit.
    """

    text: str
    unit: Unit

    def __new__(cls, value: float, text: str, unit: Unit) -> Quantity:
        """Make a number in SI units.

        Args:
            value: The number in SI units.
            text: What the user has stated.
            unit: The stated unit.
        """
        number = super().__new__(cls, value)
        number.text = text
        number.unit = unit
        return number

    def __getnewargs__(self) -> tuple[float, str, Unit]:  # type: ignore[override]
        """Arguments with which a copy is made, also in another process."""
        return float(self), self.text, self.unit

    @classmethod
    def parse(cls, text: str) -> Quantity:
        """Read a number with a unit.

        Args:
            text: The number and its unit, for example "90 deg".

        Returns:
            The number in SI units.

        Raises:
            PydanticCustomError: The text is not a number with a known unit.
        """
        found = re.match(QUANTITY, text)
        if found is None:
            raise _fault("quantity_type", 'should be a number, or with its unit as in "90 deg"')

        try:
            unit = Unit.parse(found[2])
        except ValueError as error:
            raise _fault("quantity_unit", str(error)) from None
        return cls(float(found[1]) * unit.factor, text, unit)


def wrong_unit(number: Quantity, units: list[str]) -> str | None:
    """Say what is wrong with the unit of a number.

    Args:
        number: The number.
        units: Units of all the numbers of the model that it states; empty texts for those whose
            unit does not follow from the model.

    Returns:
        What is wrong and what would be right; None if the unit fits.
    """
    shown = shortened(repr(number.text))
    if not units or "" in units:
        return (
            f"{shown} has a unit, but the model does not say in which unit this number is; state "
            "a plain number in the model's unit"
        )
    measured = [number.unit.measures(Unit.parse(unit)) for unit in units]
    if all(measured):
        return None
    if any(measured):
        return (
            f"{shown} would stand for numbers in {' and '.join(units)}; state each of them by its "
            "name, or a plain number"
        )
    alike = list(dict.fromkeys(other for unit in units for other in units_like(unit)))
    stated = " or ".join(units)
    return (
        f"{shown} is no number in {stated}; valid are a plain number in {stated}, or the units "
        f"{listed(alike)}"
    )


@dataclass(frozen=True)
class WithUnit:
    """Mark of a number in a table of the experiment file that may be stated with a unit.

    Attributes:
        unit: SI unit of the number; None where it depends on the model, so that `System` checks
            it.
    """

    unit: str | None = None

    def __get_pydantic_core_schema__(
        self, source: Any, handler: GetCoreSchemaHandler
    ) -> CoreSchema:
        """Validate a number, or a text with a number and a unit."""
        return core_schema.no_info_wrap_validator_function(
            self._validated,
            handler(source),
            serialization=core_schema.plain_serializer_function_ser_schema(_number),
        )

    def __get_pydantic_json_schema__(
        self, schema: CoreSchema, handler: GetJsonSchemaHandler
    ) -> dict[str, Any]:
        """Describe a number or a text."""
        text = {"type": "string", "format": "quantity", "pattern": QUANTITY}
        return {"anyOf": [handler(schema), text]}

    def _validated(self, value: Any, check: Callable[[Any], float]) -> float:
        """The number in SI units; it is a `Quantity` where a unit was stated."""
        if isinstance(value, str):
            value = Quantity.parse(value)
        if not isinstance(value, Quantity):
            return check(value)

        fault = None if self.unit is None else wrong_unit(value, [self.unit])
        if fault is not None:
            raise _fault("quantity_unit", fault)
        return Quantity(check(float(value)), value.text, value.unit)


def _fault(kind: str, sentence: str) -> PydanticCustomError:
    """A fault of pydantic; braces would be places for values in its message."""
    return PydanticCustomError(kind, sentence.replace("{", "(").replace("}", ")"))


def _number(value: Any) -> float:
    """A number as it is; anything else belongs to another branch of a union."""
    if isinstance(value, bool) or not isinstance(value, (int, float)):
        raise PydanticSerializationUnexpectedValue("no number")
    return value

"""Tables of the experiment file: their base class, and the table `[recording]`.

The base class has the kinds of numbers, and messages about faults. The table `[recording]` says how
the columns of a log become a recording.
"""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Annotated, Any, ClassVar, Literal

from pydantic import (
    AfterValidator,
    BaseModel,
    ConfigDict,
    Field,
    ModelWrapValidatorHandler,
    ValidationError,
    model_validator,
)
from pydantic_core import InitErrorDetails, PydanticCustomError

from mjfim.errors import shortened, unknown
from mjfim.recordings.quantities import WithUnit

# Sizes between which the squares and quotients of numbers neither vanish nor overflow. No physical
# quantity in any unit is outside.
SMALLEST_SIZE = 1e-100
LARGEST_SIZE = 1e100

# pydantic's names of faults end so if a value has the wrong type or is none of the allowed words.
WRONG_TYPE = ("_type", "literal_error")

# Length of a message after which further faults are only counted [characters].
LONG_MESSAGE = 400

# What a value should be, by pydantic's name of the fault.
WORDS = {
    "dict_type": "should be a table",
    "model_type": "should be a table",
    "tuple_type": "should be a list",
    "bool_type": "should be true or false",
    "missing": "this key is required",
}

# Beginnings of pydantic's messages, and what replaces them.
WORDING = {
    "Value error, ": "",
    "Input should be a valid integer": "should be an integer",
    "Input should be a valid ": "should be a ",
    "Input should": "should",
}


def _usable_size(value: float) -> float:
    """Refuse a number with whose square one cannot compute, except infinity."""
    is_ordinary = value == 0.0 or SMALLEST_SIZE <= abs(value) <= LARGEST_SIZE
    if is_ordinary or not math.isfinite(value):
        return value
    raise ValueError(f"should be of a size from {SMALLEST_SIZE:g} to {LARGEST_SIZE:g}")


# Types of numbers in the experiment file. A bound of a range may be infinite.
UsableSize = AfterValidator(_usable_size)
Positive = Annotated[float, Field(gt=0, allow_inf_nan=False, strict=True), UsableSize]
NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True), UsableSize]
Finite = Annotated[float, Field(allow_inf_nan=False, strict=True), UsableSize]
Bound = Annotated[float, Field(strict=True), UsableSize]
Integer = Annotated[int, Field(strict=True)]
Boolean = Annotated[bool, Field(strict=True)]

# Numbers that may be stated with a unit, which `System` compares with that of the model.
PositiveWithUnit = Annotated[Positive, WithUnit()]
FiniteWithUnit = Annotated[Finite, WithUnit()]
RangeWithUnit = tuple[Annotated[Bound, WithUnit()], Annotated[Bound, WithUnit()]]

# Numbers whose unit is always the same.
Seconds = Annotated[Positive, WithUnit("s")]
Hertz = Annotated[Positive, WithUnit("Hz")]
Metres = Annotated[Positive, WithUnit("m")]
Height = Annotated[Finite, WithUnit("m")]
Period = tuple[Annotated[Bound, WithUnit("s")], Annotated[Bound, WithUnit("s")]]


class Section(BaseModel):
    """A table of the experiment file; it is immutable and refuses unknown keys.

    Attributes:
        only_in_python: Keys that a file cannot state.
    """

    model_config = ConfigDict(extra="forbid", frozen=True)
    only_in_python: ClassVar[tuple[str, ...]] = ()

    def __repr_args__(self) -> Iterator[tuple[str | None, Any]]:
        """What is stated, without the many defaults."""
        shown = self.model_fields_set - {*self.only_in_python}
        return ((name, value) for name, value in super().__repr_args__() if name in shown)

    @model_validator(mode="wrap")
    @classmethod
    def _in_words(cls, values: Any, check: ModelWrapValidatorHandler[Section]) -> Section:
        """Say what is wrong with a value in the words of the experiment file."""
        try:
            return check(values)
        except ValidationError as error:
            faults = error.errors(include_url=False)
        raise ValidationError.from_exception_data(cls.__name__, [cls._worded(f) for f in faults])

    @classmethod
    def _worded(cls, fault: Any) -> InitErrorDetails:
        """A fault with the message that people see."""
        words = fault.get("ctx", {}).get("words") or cls._words(fault)
        return {
            "type": PydanticCustomError(fault["type"], "{words}", {"words": words}),
            "loc": fault["loc"],
            "input": fault["input"],
        }

    @classmethod
    def _words(cls, fault: Any) -> str:
        """Sentence on one value of this table: what is wrong, and what would be right."""
        kind = fault["type"]
        # A value inside of a field has a longer place.
        field = cls.model_fields.get(".".join(map(str, fault["loc"])))
        if kind == "extra_forbidden":
            return unknown("key", str(fault["loc"][-1]), cls.valid_keys())
        if kind == "missing" and field and field.description:
            sentence = field.description.split(". ")[0].removesuffix(".")
            return f"{WORDS[kind]}: {sentence[0].lower()}{sentence[1:]}"
        if kind == "dict_type" and field and field.examples:
            entries = [f"{name} = {value}" for name, value in field.examples[0].items()]
            return f"{WORDS[kind]} by name, for example {{ {', '.join(entries)} }}"
        if kind == "too_short":
            return f"needs {fault['ctx']['min_length']} or more entries"
        message: str = WORDS.get(kind, fault["msg"])
        for begin, instead in WORDING.items():
            message = message.replace(begin, instead)
        return message

    @classmethod
    def valid_keys(cls) -> list[str]:
        """Keys that a file may state, in the order of their definition."""
        return [key for key in cls.model_fields if key not in cls.only_in_python]


def explain(error: ValidationError, source: str, values: Mapping[str, Any]) -> str:
    """Explain every fault of an experiment by the keys that the user wrote.

    Args:
        error: What pydantic found.
        source: Name of the file or the experiment.
        values: What the user wrote.

    Returns:
        A line for each key with a fault; of many faults the first ones and the number of others.
    """
    faults_by_key: dict[str, list[Any]] = {}
    for fault in error.errors(include_url=False):
        faults_by_key.setdefault(".".join(_keys(values, fault)), []).append(fault)

    # pydantic repeats a fault inside a table for the table itself. Only the innermost key, which
    # is the most specific one, is reported.
    outer = {key[:i] for key in faults_by_key for i, letter in enumerate(key) if letter == "."}
    innermost = [key for key in faults_by_key if key not in outer]
    lines: list[str] = []
    for key in innermost:
        if sum(map(len, lines)) > LONG_MESSAGE:
            lines.append(f"{source}: and {len(innermost) - len(lines)} further faults")
            break
        place = shortened(key) if key else "experiment"
        lines.append(f"{source}: {place}: {_sentence(faults_by_key[key])}")
    return "\n".join(lines)


def _keys(values: Any, fault: Any) -> list[str]:
    """Keys of the faulty value; pydantic's names of the branches of a union are left out."""
    keys = []
    for i, part in enumerate(fault["loc"], start=1):
        is_inside = isinstance(values, Mapping) or (
            isinstance(values, Sequence) and not isinstance(values, str)
        )
        try:
            values = values[part] if is_inside else None
        except (KeyError, IndexError, TypeError):
            if fault["type"] != "missing" or i < len(fault["loc"]):
                continue
        if is_inside:
            keys.append(str(part))
    return keys


def _sentence(faults: Sequence[Any]) -> str:
    """Say what is wrong with one key."""
    # The user meant a branch whose type fits, even if the value is not valid there. If it fits no
    # branch, all of them are suggested.
    fault = next((f for f in faults if not f["type"].endswith(WRONG_TYPE)), faults[0])
    only_types = fault["type"].endswith(WRONG_TYPE)
    shown = [f["msg"] for f in faults if only_types or f["type"] == fault["type"]]
    first, *others = dict.fromkeys(shown)
    sentence = " or ".join([first, *(message.removeprefix("should be ") for message in others)])
    given = fault["input"]
    is_simple = isinstance(given, (str, int, float)) and fault["type"] != "extra_forbidden"
    return f"{sentence} (got {shortened(repr(given))})" if is_simple else sentence


# Units that a column of a log may have; their factors are in `mjfim.recordings.quantities`.
LogUnit = Literal[
    "rad", "deg", "rev", "rad/s", "deg/s", "rev/s", "rpm", "m", "cm", "mm", "m/s", "mm/s"
]


# Beginnings of the names of columns that control laws read, and of all columns that drive a
# simulation.
LAW_PREFIXES = ("reference:", "reference_velocity:", "feedforward:", "gain:", "enable:")
INPUT_PREFIXES = ("ctrl:", *LAW_PREFIXES)


class ColumnSpec(Section):
    """Rule by which one column of a recording is computed from the columns of a log.

    The value is `(scale * unit * raw + offset)` times the product of the columns in `multiply_by`.
    """

    column: str = Field(description="Name of the column in the log.")
    unit: LogUnit | None = Field(
        default=None, description="Unit of the column in the log. Default: the model's unit."
    )
    scale: Finite = Field(
        default=1.0, description="Factor by which the raw numbers are multiplied."
    )
    offset: Finite = Field(
        default=0.0, description="Constant that is added after scaling [unit of the model]."
    )
    signed: Literal[8, 16, 32] | None = Field(
        default=None,
        description=(
            "Number of bits of signed integers that the log holds as unsigned ones. Default: the "
            "numbers in the log already have a sign."
        ),
    )
    period: Positive | None = Field(
        default=None,
        description=(
            "Raw number at which a counter starts again from 0; these jumps are removed. Default: "
            "the column is not a counter."
        ),
    )
    unwrap: Boolean = Field(
        default=False, description="true: jumps of an angle by a whole turn are removed."
    )
    multiply_by: tuple[str, ...] = Field(
        default=(),
        description="Further columns or constants of the log by which the value is multiplied.",
    )


class RecordingSpec(Section):
    """Rules by which the log of a robot becomes a recording.

    By default, the log has the columns of the CSV files that mjfim writes.
    """

    time: str = Field(default="t", description="Column of the time stamps.")
    time_unit: Literal["s", "ms", "us", "ns"] = Field(
        default="s", description="Unit of the time stamps."
    )
    records: str | None = Field(
        default=None,
        description=(
            "Path of the list of records inside a JSON file, as keys joined by dots, such as "
            "`data.entries`. Default: the only list of records that the file holds."
        ),
    )
    topics: tuple[str, ...] = Field(
        default=(),
        description=(
            "Topics of the joint states of a ROS bag. Default: the only such topic in the bag."
        ),
    )
    episodes: tuple[Annotated[int, Field(ge=0, strict=True)], ...] = Field(
        default=(),
        description=(
            "Numbers of the episodes of a LeRobot dataset, each of which is one recording. "
            "Default: all episodes."
        ),
    )
    window: Period | None = Field(
        default=None,
        description=(
            "First and last time that are used, counted from the first row [s]. Default: all rows."
        ),
    )
    gap: Seconds = Field(
        default=0.1,
        description="Longest accepted gap in the time stamps or in a column [s].",
    )
    columns: dict[str, str | Finite | ColumnSpec] = Field(
        default={},
        description=(
            "Sources of the columns of the recording, by `ctrl:<actuator>`, `qpos:<joint>`, "
            "`qvel:<joint>` or sensor, and with a law in `controllers` by `reference:<actuator>` "
            "and what else it reads: the name of a column of the log, or a table; for a control "
            "also a number, its constant value (0.0 for a motor that is off). Default: the "
            "columns of the log have these names."
        ),
    )

    @model_validator(mode="after")
    def _window_increases(self) -> RecordingSpec:
        """Refuse a window that begins before the log or ends before it begins."""
        if self.window is not None and not 0.0 <= self.window[0] < self.window[1]:
            raise ValueError(f"window {list(self.window)} needs 0 <= begin < end")
        return self

    @property
    def sources(self) -> dict[str, ColumnSpec]:
        """Rule of every stated column of a log; a mere name becomes a rule without conversion."""
        return {
            name: ColumnSpec(column=source) if isinstance(source, str) else source
            for name, source in self.columns.items()
            if not isinstance(source, float)
        }

    @property
    def constants(self) -> dict[str, float]:
        """Constant values, which no column of a log holds [unit of the model]."""
        return {name: source for name, source in self.columns.items() if isinstance(source, float)}

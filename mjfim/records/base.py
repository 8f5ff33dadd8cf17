"""Base classes of all records: read-only arrays, JSON from the fields, files without pickles.

Results of verbs have a verdict, and results about parameters say what is known of each of them.

Every result of the package is a record of `mjfim.records`, or of the module that computes it.
"""

from __future__ import annotations

import json
import os
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import field, fields, is_dataclass
from enum import Enum, StrEnum
from functools import cache
from importlib import import_module
from operator import attrgetter
from pathlib import Path
from reprlib import Repr
from typing import Any, ClassVar, NamedTuple, Self

import numpy as np

from mjfim.arrays import NORMAL_95, Array, freeze, record
from mjfim.errors import MjfimError, RecordingError, in_words, unknown
from mjfim.files import read_arrays, write_arrays, write_json

# Name of the text array in an npz file that holds all fields of a record that are not arrays.
RECORD = "record"

# Version of the files; another one is refused.
VERSION = 5

# Largest number of characters of one value, and of entries of a sequence, in a short text.
MAX_VALUE_LENGTH = 48
MAX_ENTRIES = 4

# Largest number of numbers of an array in a short text.
MAX_NUMBERS = 12

# Modules that describe records, print them, show them as HTML, and draw their figures. They are
# imported by name where they are used, because records must not depend on the output.
PAGES = "mjfim.output.pages"
TERMINAL = "mjfim.output.terminal"
PRESENTATION = "mjfim.output.report"
PICTURES = "mjfim.output.plots.pictures"
WORDS = "mjfim.output.words"


def no_array(*shape: int) -> Any:
    """Field whose default is an array without entries, for what was not computed."""
    return field(default_factory=lambda: np.zeros(shape or (0,)))


class NamedEnum(Enum):
    """Base class of outcomes. Files hold their names; their values are sentences for people."""

    @classmethod
    def _missing_(cls, value: object) -> Any:
        """The member with a name, as pydantic asks for it when it reads a file."""
        return cls.__members__.get(str(value))


class Level(StrEnum):
    """Quality of a result."""

    GOOD = "good"
    DOUBTFUL = "doubtful"
    BAD = "bad"


class Verdict(NamedTuple):
    """What to think of a result, and what to do next.

    Attributes:
        sentence: The result in a sentence.
        level: How good it is.
        ok: Whether what was asked for was reached. The command line exits with 0 then, else with 1.
        reasons: What is to be fixed first, and what limits the result.
        next: What to do next, the most useful step first.
    """

    sentence: str
    level: Level
    ok: bool = False
    reasons: tuple[str, ...] = ()
    next: tuple[str, ...] = ()

    def __str__(self) -> str:
        next_step = [f"Next: {step}" for step in self.next[:1]]
        return "\n".join([f"{self.level.upper()}: {self.sentence}", *self.reasons, *next_step])


class Record:
    """Base class of records. The decorator `record` makes a dataclass of each of them.

    Attributes:
        array_fields: Names of the fields that are arrays.
        in_json: Paths of fields and properties that JSON files show; default: all fields.
        json_names: Name in JSON by the path, where it is not the last part of the path.
    """

    array_fields: ClassVar[tuple[str, ...]] = ()
    in_json: ClassVar[tuple[str, ...]] = ()
    json_names: ClassVar[Mapping[str, str]] = {}

    # Pydantic refuses fields that the record does not have.
    __pydantic_config__: ClassVar[Mapping[str, Any]] = {"extra": "forbid"}

    def __post_init__(self) -> None:
        for name in self.array_fields:
            value = getattr(self, name)
            try:
                freeze(self, *([] if value is None else [name]))
            except (TypeError, ValueError):
                kind = type(self).__name__
                raise RecordingError(
                    f"{kind}: {name}: needs an array of numbers; not {in_words(value)}"
                ) from None

    def __repr__(self) -> str:
        names = [each.name for each in fields(self) if each.repr]  # type: ignore[arg-type]
        lines = [f"  {name}={_short_text(getattr(self, name))}" for name in names]
        return "\n".join([f"{type(self).__name__}(", *lines, ")"])

    @property
    def words(self) -> str:
        """The record as a text for people."""
        return str(self)

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON files, which people and other programs read."""
        found = {}
        names = [each.name for each in fields(self)]  # type: ignore[arg-type]
        for path in self.in_json or names:
            key = self.json_names.get(path, path.rpartition(".")[2])
            found[key] = _summary(attrgetter(path)(self))
        return found


class SavedRecord(Record):
    """Base class of records that can be saved and loaded.

    Attributes:
        file_stem: Name of the two files without their endings.
        made_by: Command or function that writes the files, for messages.
        array_names: Names of arrays in the npz file by their path; default: the path.
    """

    file_stem: ClassVar[str]
    made_by: ClassVar[str]
    array_names: ClassVar[Mapping[str, str]] = {}

    def save(self, folder: str | Path) -> None:
        """Write the record's JSON file and npz file; an incomplete file never remains."""
        self.save_archive(folder)
        write_json(Path(folder) / f"{self.file_stem}.json", self.summary())

    def save_archive(self, folder: str | Path) -> None:
        """Write the npz file alone, from which `load` builds the record."""
        write_arrays(Path(folder) / f"{self.file_stem}.npz", self._archived())

    def as_saved(self) -> Self:
        """The record as `load` would build it, without any file."""
        return self._from_archive(self._archived(), Path(self.file_stem))

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a record that was saved.

        Args:
            path: The folder, or one of the record's two files.

        Raises:
            RecordingError: There is no such record, or it is damaged, or of another version.
        """
        path = Path(path)
        names = f"{cls.file_stem}.json", f"{cls.file_stem}.npz"
        if not path.exists():
            raise RecordingError(f"{path}: no such file or folder")
        if not path.is_dir() and path.suffix not in (".json", ".npz"):
            raise RecordingError(
                f"{path}: {cls.__name__}.load takes a folder, a {names[0]} or a {names[1]}"
            )

        archive = path / names[1] if path.is_dir() else path.with_suffix(".npz")
        if not archive.is_file():
            raise RecordingError(
                f"{archive}: this file is missing, but {cls.__name__}.load needs it; "
                f"write it again with {cls.made_by}"
            )
        return cls._from_archive(read_arrays(archive, cls.file_stem), archive)

    def _archived(self) -> dict[str, np.ndarray]:
        """The arrays of the npz file; one of them is the text of all other fields."""
        arrays: dict[str, np.ndarray] = {}
        values = _stored(self, "", arrays, self.array_names)
        text = json.dumps({"type": type(self).__name__, "version": VERSION, "fields": values})
        return {**arrays, RECORD: np.array(text)}

    @classmethod
    def _from_archive(cls, arrays: Mapping[str, np.ndarray], path: Path) -> Self:
        """Build the record from the arrays of its npz file."""
        advice = f"write it again with {cls.made_by}"
        try:
            content = json.loads(str(arrays[RECORD]))
            kind, version, values = content["type"], content["version"], content["fields"]
        except (ValueError, KeyError, TypeError):
            raise RecordingError(
                f"{path}: the array {RECORD!r} is missing or of another version of mjfim; {advice}"
            ) from None

        if kind != cls.__name__:
            raise RecordingError(f"{path}: holds a record of type {kind}, not {cls.__name__}")
        if version != VERSION:
            raise RecordingError(f"{path}: has version {version}, not {VERSION}; {advice}")

        try:
            made: Self = _reader(cls).validate_json(  # type: ignore[arg-type]
                json.dumps(values), strict=True, context=dict(arrays)
            )
        except ValueError as error:
            fault = error.errors()[0]  # type: ignore[attr-defined]
            place = ".".join(str(part) for part in fault["loc"])
            raise RecordingError(
                f"{path}: not a {cls.__name__} of this version of mjfim: the field {place!r}: "
                f"{fault['msg']}; {advice}"
            ) from None
        return made


class ShownRecord(SavedRecord):
    """Base class of the results of verbs, which can also be shown, printed and drawn."""

    @property
    def verdict(self) -> Verdict:
        """How good the result is, why, and what to do next, as the command line says it."""
        found: Verdict = import_module(PAGES).page_of(self).verdict
        return found

    def __str__(self) -> str:
        text: str = import_module(TERMINAL).text_of(import_module(PAGES).page_of(self))
        return text

    @property
    def pictures(self) -> tuple[str, ...]:
        """Names of the figures that `plot` can draw, the usual one first."""
        names: tuple[str, ...] = import_module(PICTURES).picture_names(self)
        return names

    def plot(self, picture: str | None = None, *, file: str | os.PathLike[str] = "") -> Any:
        """Draw a figure of the record. The command line writes the same figures.

        Args:
            picture: Name of the figure; default: the usual one, see `pictures`.
            file: Also write the figure into a file of this name; the ending states the format.

        Returns:
            The Matplotlib figure.
        """
        return import_module(PICTURES).draw(self, picture, file)

    def _repr_html_(self) -> str:
        """Return the tables and sentences of the record as HTML, for notebooks."""
        html: str = import_module(PRESENTATION).as_html(self)
        return html


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


def _summary(value: Any) -> Any:
    """A value as it is shown in JSON: summaries of records, names of outcomes."""
    if isinstance(value, Record):
        return value.summary()
    if isinstance(value, Mapping):
        return {key: _summary(entry) for key, entry in value.items()}
    if isinstance(value, (tuple, list)):
        return [_summary(entry) for entry in value]
    if isinstance(value, Enum):
        return getattr(value, "in_json", value.name.lower())
    return value


def _stored(value: Any, path: str, arrays: dict[str, np.ndarray], names: Mapping[str, str]) -> Any:
    """A value as it is written into the text of an npz file.

    Args:
        value: The value.
        path: Its path from the record.
        arrays: The arrays that were found so far, by their names; those of the value are added.
        names: Names of arrays by their path, where they differ from the path.
    """
    prefix = f"{path}." if path else ""
    if isinstance(value, np.ndarray):
        name = names.get(path, path)
        arrays[name] = value
        return name
    if is_dataclass(value):
        return {
            each.name: _stored(getattr(value, each.name), f"{prefix}{each.name}", arrays, names)
            for each in fields(value)
            if each.metadata.get("saved", True)
        }
    if hasattr(value, "stated"):
        return value.stated()
    if isinstance(value, Mapping):
        return {
            key: _stored(entry, f"{prefix}{place}", arrays, names)
            for place, (key, entry) in enumerate(value.items())
        }
    if isinstance(value, (tuple, list)):
        return [_stored(entry, f"{prefix}{i}", arrays, names) for i, entry in enumerate(value)]
    if isinstance(value, Enum):
        return value.name
    return value.item() if isinstance(value, np.generic) else value


@cache
def _reader(kind: type) -> Any:
    """The adapter of pydantic that builds a record from the text of an npz file."""
    from pydantic import TypeAdapter  # slow, and needed only where a file is read

    return TypeAdapter(kind)


class _ShortRepr(Repr):
    """Short texts of values; of large arrays, mappings and sequences only the size."""

    def __init__(self) -> None:
        super().__init__()
        self.maxstring = self.maxother = MAX_VALUE_LENGTH
        self.maxtuple = MAX_ENTRIES

    def repr1(self, value: Any, level: int) -> str:
        if isinstance(value, np.ndarray):
            return _short_array(value)
        if isinstance(value, Enum):
            return f"{type(value).__name__}.{value.name}"
        if is_dataclass(value):
            return f"<{type(value).__name__}>"
        if isinstance(value, Mapping) and value:
            return f"<{len(value)} entries>"
        text = super().repr1(value, level)
        is_long = isinstance(value, (tuple, list)) and len(text) > MAX_VALUE_LENGTH
        return f"<{len(value)} values>" if is_long else text


_short_text = _ShortRepr().repr


def _short_array(array: np.ndarray) -> str:
    """The numbers of a small array; how many a large one has, and their range."""
    if array.size <= MAX_NUMBERS:
        written: Any = {"float_kind": lambda number: f"{number:.5g}"}
        return " ".join(np.array2string(array, formatter=written, separator=", ").split())
    finite = array[np.isfinite(array)]
    span = f", {finite.min():.3g} to {finite.max():.3g}" if finite.size else ""
    return f"<{' × '.join(map(str, array.shape))} numbers{span}>"

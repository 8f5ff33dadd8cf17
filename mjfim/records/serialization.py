"""Saving and loading of records, without pickles.

A saved record consists of two files whose names differ in the ending only, for example:

* `design.json` holds the record's summary: the keys that users and other programs read.
* `design.npz` holds the complete record. Each array of the record is an array of the file; the text
  array `record` holds all other fields as JSON, with the name of an array in place of the array.

JSON has neither infinity nor NaN. Summaries contain `null` instead; the text array `record`
contains "inf", "-inf" or "nan", and the type of the field shows that this is a number.
"""

from __future__ import annotations

import json
import math
import zipfile
from collections.abc import Mapping
from dataclasses import MISSING, Field, fields, is_dataclass
from enum import Enum
from functools import cache
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, ClassVar, Self, Union, get_args, get_origin, get_type_hints

import numpy as np
from pydantic import BaseModel
from pydantic_core import PydanticSerializationError

from mjfim.arrays import Array
from mjfim.atomic_io import replacing
from mjfim.errors import RecordingError, RenamedFields
from mjfim.records.short_text import short_text
from mjfim.records.unpacked_size import (
    DAMAGED_ARCHIVE,
    Header,
    array_headers,
    check_is_archive,
)

# Name of the text array in an npz file that holds all fields of a record that are not arrays.
RECORD = "record"

# Size of all arrays of a file above which they are not compressed [bytes].
MAX_COMPRESSED_BYTES = 64 * 2**20

# Words for numbers that JSON does not have.
NOT_FINITE = {"nan": math.nan, "inf": math.inf, "-inf": -math.inf}


# ---- JSON for people


def as_json(values: Mapping[str, Any]) -> str:
    """Render values as readable JSON.

    Args:
        values: Mappings, sequences, arrays, numbers, strings and None, which may be nested.

    Returns:
        Standard JSON with a line break at its end. Numbers that are not finite become null, because
        JSON has no word for them.
    """
    return json.dumps(_plain(values), indent=2, allow_nan=False) + "\n"


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write values as a JSON file; an incomplete file never remains.

    Args:
        path: File to write; its folder is created if it does not exist.
        values: Contents, as for `as_json`.
    """
    with replacing(path) as temporary:
        temporary.write_text(as_json(values), encoding="utf-8")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Args:
        path: File to read.

    Returns:
        The object's values by key.

    Raises:
        RecordingError: The file cannot be read, or does not hold a JSON object.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror}") from None
    except ValueError:
        raise RecordingError(f"{path}: not a JSON file") from None

    if not isinstance(values, dict):
        raise RecordingError(f"{path}: not a JSON object")
    return values


def _plain(value: Any) -> Any:
    """Replace arrays and NumPy scalars by lists and numbers, and non-finite numbers by None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if isinstance(value, np.ndarray):
        return _plain(value.tolist())
    if isinstance(value, (float, np.floating)):
        return float(value) if np.isfinite(value) else None
    if isinstance(value, np.integer):
        return int(value)
    return value


# ---- npz files


def read_arrays(path: Path, kind: str) -> dict[str, np.ndarray]:
    """Read all arrays of an npz file; pickled objects are refused.

    Args:
        path: File to read.
        kind: Expected kind of file, for messages, such as "design" or "estimate".

    Returns:
        Arrays by name.

    Raises:
        RecordingError: The file does not exist, is damaged, or holds pickles.
    """
    if path.is_dir():
        raise RecordingError(f"{path}: this is a folder; name the {kind} file (.npz) in it")
    if not path.is_file():
        raise RecordingError(f"{path}: no such {kind} file")

    check_is_archive(path, kind)
    try:
        with zipfile.ZipFile(path) as archive:
            headers = array_headers(path, archive)
        _refuse_pickles(path, kind, headers)

        with path.open("rb") as stream, np.load(stream, allow_pickle=False) as loaded:
            return {name: loaded[name] for name in headers}
    except DAMAGED_ARCHIVE as error:
        raise RecordingError(
            f"{path}: not a {kind} archive (npz without pickles), or damaged: {error}"
        ) from None


def _refuse_pickles(path: Path, kind: str, headers: Mapping[str, Header]) -> None:
    """Refuse arrays of Python objects, which NumPy can only unpickle."""
    for name, (_, dtype) in headers.items():
        if dtype.hasobject:
            raise RecordingError(
                f"{path}: not a {kind} archive (npz without pickles): array {name!r} holds "
                "pickles, which are refused"
            )


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays as an npz file; an incomplete file never remains.

    Large arrays hold measured values, whose noise can hardly be compressed; that would take longer
    than anything else.

    Args:
        path: File to write; its folder is created if it does not exist.
        arrays: Arrays of numbers or text by name.
    """
    with replacing(path) as temporary, temporary.open("wb") as stream:
        size = sum(array.nbytes for array in arrays.values())
        save = np.savez if size > MAX_COMPRESSED_BYTES else np.savez_compressed
        save(stream, allow_pickle=False, **arrays)


# ---- records to plain values, and back


class MalformedRecordError(ValueError):
    """Plain values that do not fit the fields of a record; the message names the field."""


class _Encoder:
    """Converter of a record to plain JSON values, which collects the record's arrays.

    Attributes:
        arrays: The arrays by name.
    """

    def __init__(self, names: Mapping[str, str]) -> None:
        """Start with no arrays.

        Args:
            names: Short names of arrays, by path in the record; the names of other arrays are
                their paths.
        """
        self.arrays: dict[str, np.ndarray] = {}
        self._known_names = names
        self._name_of: dict[int, tuple[str, np.ndarray]] = {}

    def encode(self, hint: Any, value: Any, path: str) -> Any:
        """Return the plain value of one field, and collect its arrays.

        Args:
            hint: Type of the field.
            value: Its value.
            path: Path of the field: the names of the fields that lead to it, joined by dots.

        Returns:
            A value that JSON can hold; the name of the array in place of an array.
        """
        if _optional(hint) is not None:
            return None if value is None else self.encode(_optional(hint), value, path)

        origin = get_origin(hint)
        if origin is np.ndarray:
            return self._keep(value, path)
        if origin is tuple:
            entry_hint = get_args(hint)[0]
            return [self.encode(entry_hint, entry, _join(path, i)) for i, entry in enumerate(value)]
        if origin is dict:
            entry_hint = get_args(hint)[1]
            return {
                str(key): self.encode(entry_hint, entry, _join(path, i))
                for i, (key, entry) in enumerate(value.items())
            }
        if isinstance(hint, type) and issubclass(hint, BaseModel):
            return _encode_table(value, path)
        if isinstance(hint, type) and is_dataclass(hint):
            hints = _hints(hint)
            return {
                field.name: self.encode(
                    hints[field.name], getattr(value, field.name), _join(path, field.name)
                )
                for field in fields(hint)
            }
        return _encode_scalar(hint, value, path)

    def _keep(self, value: np.ndarray, path: str) -> str:
        """Collect an array and return its name.

        An array that occurs twice is collected once, unless it has a documented name, which other
        programs read.
        """
        array = np.asarray(value)
        if id(array) in self._name_of and path not in self._known_names:
            return self._name_of[id(array)][0]

        name = self._known_names.get(path, path)
        self.arrays[name] = array
        self._name_of[id(array)] = (name, array)
        return name


def _encode_table(value: BaseModel, path: str) -> dict[str, Any]:
    """Return plain values of the keys that an experiment states, and of those only Python has."""
    try:
        stated = value.model_dump(mode="json", exclude_unset=True)
    except PydanticSerializationError:
        raise TypeError(f"{path}: a parameter that is a Python function cannot be saved") from None

    # The contents of packed files are not part of what an experiment states.
    hidden = {
        name: str(getattr(value, name))
        for name, field in type(value).model_fields.items()
        if field.exclude and isinstance(getattr(value, name), str | Path)
    }
    return {**stated, **hidden}


def _encode_scalar(hint: Any, value: Any, path: str) -> Any:
    """Return the JSON value of a member of an enumeration, a truth value, a number or a text."""
    if issubclass(hint, Enum):
        return value.name
    if hint in (bool, int, str):
        return hint(value)
    if hint is float:
        number = float(value)
        return number if math.isfinite(number) else str(number)
    raise TypeError(f"{path}: values of type {hint} cannot be saved")


def _decode(hint: Any, value: Any, arrays: Mapping[str, np.ndarray], path: str) -> Any:
    """Build the value of one field from plain values and arrays; the inverse of `_Encoder.encode`.

    Raises:
        MalformedRecordError: The plain value does not fit the type of the field.
    """
    if _optional(hint) is not None:
        return None if value is None else _decode(_optional(hint), value, arrays, path)

    origin = get_origin(hint)
    if origin is np.ndarray:
        return _array(value, arrays, path)
    if origin is tuple:
        entry_hint = get_args(hint)[0]
        entries = _expect(list, value, path)
        return tuple(
            _decode(entry_hint, entry, arrays, _join(path, i)) for i, entry in enumerate(entries)
        )
    if origin is dict:
        entry_hint = get_args(hint)[1]
        table = _expect(dict, value, path)
        return {
            key: _decode(entry_hint, entry, arrays, _join(path, key))
            for key, entry in table.items()
        }
    if isinstance(hint, type) and issubclass(hint, BaseModel):
        return hint(**_expect(dict, value, path))
    if is_dataclass(hint):
        return _decode_record(hint, _expect(dict, value, path), arrays, path)
    return _decode_scalar(hint, value, path)


def _decode_record(
    kind: Any, values: Mapping[str, Any], arrays: Mapping[str, np.ndarray], path: str
) -> Any:
    """Build a record from the plain values of its fields; fields with a default may be absent."""
    hints = _hints(kind)
    known = {field.name: field for field in fields(kind)}

    for name in values:
        if name not in known:
            raise MalformedRecordError(f"the field {_join(path, name)!r} is unknown")
    for name, field in known.items():
        if name not in values and not _has_default(field):
            raise MalformedRecordError(f"the field {_join(path, name)!r} is missing")

    decoded = {
        name: _decode(hints[name], value, arrays, _join(path, name))
        for name, value in values.items()
    }
    return kind(**decoded)


def _decode_scalar(hint: Any, value: Any, path: str) -> Any:
    """Build a member of an enumeration, a truth value, a number or a text."""
    if issubclass(hint, Enum):
        if value not in hint.__members__:
            raise MalformedRecordError(
                f"the field {path!r} holds {value!r}, which is not a {hint.__name__}"
            )
        return hint[value]
    if hint is float:
        if isinstance(value, str) and value in NOT_FINITE:
            return NOT_FINITE[value]
        if isinstance(value, bool) or not isinstance(value, (int, float)):
            raise MalformedRecordError(f"the field {path!r} holds {value!r}, which is not a number")
        return float(value)
    return _expect(hint, value, path)


def _array(value: Any, arrays: Mapping[str, np.ndarray], path: str) -> Array:
    """Look up the array of numbers that a field names."""
    if not isinstance(value, str) or value not in arrays:
        raise MalformedRecordError(f"the array {value!r} of the field {path!r} is missing")
    array = arrays[value]
    if array.dtype.kind not in "fiub":
        raise MalformedRecordError(f"the array {value!r} does not hold numbers")
    return array


def _expect(kind: type, value: Any, path: str) -> Any:
    """Return the value if it has the expected JSON type."""
    if type(value) is not kind:
        raise MalformedRecordError(
            f"the field {path!r} holds {value!r}, which is not of type {kind.__name__}"
        )
    return value


def _optional(hint: Any) -> Any:
    """Return the type of an optional field without None; None if the field is not optional."""
    if get_origin(hint) not in (Union, UnionType):
        return None
    others = [entry for entry in get_args(hint) if entry is not NoneType]
    return others[0]


@cache
def _hints(kind: Any) -> dict[str, Any]:
    """Return the types of a record's fields by name."""
    return get_type_hints(kind)


def _has_default(field: Field[Any]) -> bool:
    """Return whether a field may be left out when its record is built."""
    return field.default is not MISSING or field.default_factory is not MISSING


def _join(path: str, name: str | int) -> str:
    """Return the path of a field inside another one."""
    return f"{path}.{name}" if path else str(name)


# ---- base class of records


class SavedRecord(RenamedFields):
    """Base class of records that can be saved and loaded; a record is a dataclass.

    Attributes:
        file_stem: Name of the record's files without their endings.
        made_by: Command or call with which a user makes the files.
        array_names: Short names of arrays in the npz file, by path in the record.
    """

    file_stem: ClassVar[str]
    made_by: ClassVar[str]
    array_names: ClassVar[Mapping[str, str]] = {}

    def __repr__(self) -> str:
        return short_text(self)

    def summary(self) -> dict[str, Any]:
        """Return the contents of the record's JSON file, which users and other programs read."""
        raise NotImplementedError

    def save(self, folder: str | Path) -> None:
        """Write the record's two files; an incomplete file never remains.

        Args:
            folder: Folder for `<file_stem>.json` and `<file_stem>.npz`; it is created if it does
                not exist.
        """
        self.save_archive(folder)
        write_json(Path(folder) / f"{self.file_stem}.json", self.summary())

    def save_archive(self, folder: str | Path) -> None:
        """Write the npz file alone, from which `load` builds the record.

        Args:
            folder: Folder for `<file_stem>.npz`; it is created if it does not exist.
        """
        write_arrays(Path(folder) / f"{self.file_stem}.npz", self._archived())

    def as_saved(self) -> Self:
        """The record as `load` builds it from its files, which are not read.

        Its arrays are those of this record, as far as nobody can change them.
        """
        arrays = self._archived()
        values = json.loads(str(arrays[RECORD]))["fields"]
        record: Self = _decode_record(type(self), values, arrays, "")
        return record

    def _archived(self) -> dict[str, np.ndarray]:
        """The arrays of the npz file."""
        encoder = _Encoder(self.array_names)
        kind = type(self)
        values = encoder.encode(kind, self, "")
        text = json.dumps({"type": kind.__name__, "fields": values}, allow_nan=False)
        return {**encoder.arrays, RECORD: np.array(text)}

    @classmethod
    def load(cls, path: str | Path) -> Self:
        """Read a record that was saved.

        Args:
            path: The folder of its files, or one of the two files.

        Returns:
            The record, equal to the one that was saved.

        Raises:
            RecordingError: The npz file is missing or damaged, holds another kind of record, or
                was written by an early version of mjfim. The message says how to write it again.
        """
        archive = cls._archive_of(Path(path))
        arrays = read_arrays(archive, cls.file_stem)

        # Records share arrays that nobody can change.
        for array in arrays.values():
            array.setflags(write=False)
        values = cls._fields_in(archive, arrays)

        try:
            record: Self = _decode_record(cls, values, arrays, "")
        except (MalformedRecordError, TypeError, ValueError, IndexError) as error:
            raise RecordingError(
                f"{archive}: not a {cls.__name__} of this version of mjfim: {error}; "
                f"{cls._advice()}"
            ) from None
        return record

    @classmethod
    def _archive_of(cls, path: Path) -> Path:
        """Return the npz file that belongs to a folder or to a file."""
        json_name, archive_name = f"{cls.file_stem}.json", f"{cls.file_stem}.npz"
        if not path.exists():
            raise RecordingError(f"{path}: no such file or folder")

        if path.is_dir():
            archive = path / archive_name
        elif path.suffix in (".json", ".npz"):
            archive = path.with_suffix(".npz")
        else:
            raise RecordingError(
                f"{path}: {cls.__name__}.load takes a folder, a {json_name} or a {archive_name}"
            )

        if not archive.is_file():
            raise RecordingError(
                f"{archive}: this file is missing, but {cls.__name__}.load needs it; "
                f"{cls._advice()}"
            )
        return archive

    @classmethod
    def _fields_in(cls, archive: Path, arrays: Mapping[str, np.ndarray]) -> dict[str, Any]:
        """Return the plain values of the record that an npz file holds."""
        if RECORD not in arrays:
            raise RecordingError(
                f"{archive}: the array {RECORD!r} is missing, which {cls.__name__}.load needs; the "
                "file was written by an older version of mjfim or by another program; "
                f"{cls._advice()}"
            )

        try:
            content = json.loads(str(arrays[RECORD]))
            kind, values = content["type"], content["fields"]
        except (ValueError, KeyError, TypeError):
            raise RecordingError(
                f"{archive}: the array {RECORD!r} was not written by mjfim; {cls._advice()}"
            ) from None

        if kind != cls.__name__ or not isinstance(values, dict):
            raise RecordingError(f"{archive}: holds a record of type {kind}, not {cls.__name__}")
        return values

    @classmethod
    def _advice(cls) -> str:
        """Return the end of a message, which says how to write the files again."""
        return f"write it again with {cls.made_by}"

"""Reader of JSON logs, which hold a list of records or one list of numbers per column."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError, listed, unknown
from mjfim.recordings.formats.table import NOT_NUMERIC, Table, length_fault, one_line
from mjfim.recordings.spec import RecordingSpec

# JSON values that are numbers; true is 1 and false is 0.
NUMBERS = (bool, int, float)


def read_json(path: Path, spec: RecordingSpec) -> Table:
    """Read the records of a JSON file; without records, its lists of numbers are the columns.

    A field inside an object is named `a.b`, and an item of a list `a[0]`. A null is an empty field.
    Numbers outside the list of records are constants, which hold for all rows.

    Args:
        path: The file.
        spec: The `[recording]` table; its `records` may name the list of records.

    Returns:
        All columns.

    Raises:
        RecordingError: The file is damaged, or it is not clear which list holds the records.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"), object_pairs_hook=_object)
        return _table(path, content, spec)
    except (ValueError, OSError) as error:
        raise RecordingError(
            f"{path}: not readable JSON (damaged or truncated?): {one_line(error)}"
        ) from None
    except RecursionError:
        raise RecordingError(f"{path}: not readable JSON: nested too deeply") from None


def _table(path: Path, content: Any, spec: RecordingSpec) -> Table:
    """Columns of the records, and of the constants outside the list of records."""
    keys = _keys_of_records(path, content, spec)
    if keys is None:
        return _table_of_lists(path, content, spec.time)

    records = content
    for key in keys:
        records = records[key]
    columns, faults, truth_values = _columns_of_records(records)

    # A field of the records takes precedence over a constant with this name.
    for name, value in _leaves(_without_records(content, keys)):
        if name in columns or name in faults:
            continue
        if isinstance(value, NUMBERS):
            columns[name] = np.full(len(records), _number(value))
            if isinstance(value, bool):
                truth_values.add(name)
        elif isinstance(value, str):
            faults[name] = NOT_NUMERIC

    return Table(source=path, columns=columns, faults=faults, truth_values=frozenset(truth_values))


def _object(pairs: list[tuple[str, Any]]) -> dict[str, Any]:
    """Build a JSON object from its keys and values; refuse a key that occurs twice."""
    content = dict(pairs)
    if len(content) < len(pairs):
        keys = [key for key, _ in pairs]
        twice = next(key for key in keys if keys.count(key) > 1)
        raise ValueError(f"the key {twice!r} occurs twice in one object")
    return content


def _keys_of_records(path: Path, content: Any, spec: RecordingSpec) -> tuple[str, ...] | None:
    """Keys that lead to the list of records; None if the file has lists of numbers instead."""
    if spec.records is not None:
        return _stated_keys(path, content, spec.records)

    found = list(_lists_of_records(content))
    if len(found) > 1:
        paths = listed([".".join(keys) for keys in found])
        raise RecordingError(
            f"{path}: several lists of records: {paths}; select one by recording.records"
        )
    if found:
        return found[0]

    if isinstance(content, Mapping) and any(isinstance(v, list) for v in content.values()):
        return None
    raise RecordingError(
        f"{path}: holds no list of records (objects); a log is such a list, or an object that "
        "holds one"
    )


def _stated_keys(path: Path, content: Any, stated: str) -> tuple[str, ...]:
    """Keys of the list of records that the experiment file names by a dotted path."""
    keys = tuple(stated.split("."))

    found = content
    for key in keys:
        if not isinstance(found, Mapping) or key not in found:
            valid = [".".join(other) for other in _lists_of_records(content)]
            fault = unknown("list of records", stated, valid)
            raise RecordingError(f"{path}: recording.records: {fault}")
        found = found[key]

    if not _is_records(found):
        raise RecordingError(
            f"{path}: recording.records: {stated!r} is not a list of records (objects)"
        )
    return keys


def _is_records(value: Any) -> bool:
    """Whether a value is a list of objects that is not empty."""
    return isinstance(value, list) and bool(value) and all(isinstance(v, Mapping) for v in value)


def _lists_of_records(value: Any, keys: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    """Keys of every list of records inside a value; `keys` lead to the value."""
    if _is_records(value):
        yield keys
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _lists_of_records(inner, (*keys, key))


def _without_records(content: Any, keys: tuple[str, ...]) -> dict[str, Any]:
    """Content of the file without the list of records."""
    if not keys:
        return {}

    first, *rest = keys
    others = {key: value for key, value in content.items() if key != first}
    if rest:
        others[first] = _without_records(content[first], tuple(rest))
    return others


def _leaves(value: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Dotted names and values of nested objects; every value that is not an object is yielded."""
    for key, inner in value.items():
        if isinstance(inner, Mapping):
            yield from _leaves(inner, f"{prefix}{key}.")
        else:
            yield prefix + key, inner


def _columns_of_records(
    records: Sequence[Mapping[str, Any]],
) -> tuple[dict[str, Array], dict[str, str], set[str]]:
    """Columns and faults by name, and the names of columns that hold truth values.

    Fields may be missing in some of the records.
    """
    columns: dict[str, Array] = {}
    faults: dict[str, str] = {}
    truth_values: set[str] = set()
    lengths: dict[str, int] = {}

    for row, record in enumerate(records):
        for field, value in _leaves(record):
            items = {field: value}
            if isinstance(value, list):
                items = {f"{field}[{i}]": item for i, item in enumerate(value)}
                faults.update(_ragged(field, value, row, lengths))

            for name, item in items.items():
                if not (item is None or isinstance(item, NUMBERS)):
                    faults.setdefault(name, NOT_NUMERIC)
                    continue

                if isinstance(item, bool):
                    truth_values.add(name)

                column = columns.get(name)
                if column is None:
                    column = columns[name] = np.full(len(records), np.nan)
                column[row] = _number(item)

    usable = {name: column for name, column in columns.items() if name not in faults}
    return usable, faults, truth_values


def _ragged(field: str, items: list[Any], row: int, lengths: dict[str, int]) -> dict[str, str]:
    """Faults of a list field whose length differs from its length in the first record.

    lengths: length of each list field in the first record; a new field is added.
    """
    first = lengths.setdefault(field, len(items))
    if first == len(items):
        return {}

    fault = f"is ragged: {len(items)} numbers in record {row + 1}, {first} before"
    return {f"{field}[{i}]": fault for i in range(max(first, len(items)))}


def _table_of_lists(path: Path, content: Mapping[str, Any], time: str) -> Table:
    """Columns of a file with one list of numbers per column."""
    values = dict(_leaves(content))
    lists = {name: value for name, value in values.items() if isinstance(value, list)}
    if time not in lists:
        found = listed([*lists])
        raise RecordingError(f"{path}: column {time!r} is missing; found: {found}")

    rows = len(lists[time])
    columns: dict[str, Array] = {}
    faults: dict[str, str] = {}
    truth_values: set[str] = set()
    for name, value in values.items():
        # A single value is a constant, which holds for all rows; a single null is none.
        items = value if name in lists else [value]
        if any(isinstance(item, bool) for item in items):
            truth_values.add(name)

        if name in lists and len(value) != rows:
            faults[name] = length_fault(len(value), time, rows)
        elif name in lists and all(v is None or isinstance(v, NUMBERS) for v in value):
            columns[name] = np.array([_number(v) for v in value], dtype=np.float64)
        elif isinstance(value, NUMBERS):
            columns[name] = np.full(rows, _number(value))
        else:
            faults[name] = NOT_NUMERIC

    return Table(source=path, columns=columns, faults=faults, truth_values=frozenset(truth_values))


def _number(value: float | None) -> float:
    """Value of a field as float64: NaN if it is empty, infinite if it is too large."""
    if value is None:
        return float("nan")
    try:
        return float(value)
    except OverflowError:
        return float("inf")

"""JSON logs as columns: a list of records, in whatever object it stands."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError, unknown
from mjfim.recordings.formats.table import Table, said
from mjfim.recordings.spec import RecordingSpec

NUMBERS = (bool, int, float)
TEXT = "is not numeric"


def read_nested(path: Path, spec: RecordingSpec) -> Table:
    """Columns of a JSON file: fields of its records (`a.b` inside objects, `a[0]` inside lists), true as 1, null as empty.

    Numbers beside the list hold for all rows. Where there are no records, lists of numbers are columns.
    Raises RecordingError where the file is damaged or where the records are is not clear.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
        return _table(path, content, spec)
    except (ValueError, OSError) as error:
        raise RecordingError(
            f"{path}: not readable JSON (damaged or truncated?): {said(error)}"
        ) from None
    except RecursionError:
        raise RecordingError(f"{path}: not readable JSON: nested too deeply") from None


def _table(path: Path, content: Any, spec: RecordingSpec) -> Table:
    place = _place(path, content, spec)
    if place is None:
        return _lists(path, content, spec.time)
    records = content
    for key in place:
        records = records[key]
    columns, faults = _fields(records)
    for name, value in _flat(_without(content, place)):
        if name in columns or name in faults:
            continue
        if isinstance(value, NUMBERS):
            columns[name] = np.full(len(records), _number(value))
        elif isinstance(value, str):
            faults[name] = TEXT
    return Table(path, columns, faults)


def _place(path: Path, content: Any, spec: RecordingSpec) -> tuple[str, ...] | None:
    """Keys that lead to the records; None where the file has lists of numbers instead."""
    if spec.records is not None:
        place = tuple(spec.records.split("."))
        found = content
        for key in place:
            if not isinstance(found, Mapping) or key not in found:
                valid = [".".join(p) for p in _lists_of_objects(content)]
                raise RecordingError(
                    f"{path}: recording.records: {unknown('list of records', spec.records, valid)}"
                )
            found = found[key]
        if not _is_records(found):
            raise RecordingError(
                f"{path}: recording.records: {spec.records!r} is not a list of records (objects)"
            )
        return place
    lists = list(_lists_of_objects(content))
    if len(lists) > 1:
        listed = ", ".join(".".join(p) for p in lists)
        raise RecordingError(
            f"{path}: several lists of records: {listed}; say which by recording.records"
        )
    if lists:
        return lists[0]
    if isinstance(content, Mapping) and any(isinstance(v, list) for v in content.values()):
        return None
    raise RecordingError(
        f"{path}: holds no list of records (objects); a log is one, or an object that holds one"
    )


def _is_records(value: Any) -> bool:
    return isinstance(value, list) and bool(value) and all(isinstance(v, Mapping) for v in value)


def _lists_of_objects(value: Any, place: tuple[str, ...] = ()) -> Iterator[tuple[str, ...]]:
    if _is_records(value):
        yield place
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _lists_of_objects(inner, (*place, key))


def _without(content: Any, place: tuple[str, ...]) -> dict[str, Any]:
    """What stands beside the records."""
    if not place:
        return {}
    inner = {place[0]: _without(content[place[0]], place[1:])} if len(place) > 1 else {}
    return {**{k: v for k, v in content.items() if k != place[0]}, **inner}


def _flat(value: Mapping[str, Any], prefix: str = "") -> Iterator[tuple[str, Any]]:
    """Leaves by dotted name."""
    for key, inner in value.items():
        if isinstance(inner, Mapping):
            yield from _flat(inner, f"{prefix}{key}.")
        else:
            yield prefix + key, inner


def _fields(records: Sequence[Mapping[str, Any]]) -> tuple[dict[str, Array], dict[str, str]]:
    """Columns and faults of records, which need not have the same fields."""
    columns, faults, widths = dict[str, Array](), dict[str, str](), dict[str, int]()
    for row, record in enumerate(records):
        for field, value in _flat(record):
            leaves = [(field, value)]
            if isinstance(value, list):
                leaves = [(f"{field}[{i}]", v) for i, v in enumerate(value)]
                if widths.setdefault(field, len(value)) != len(value):
                    ragged = f"is ragged: {len(value)} numbers in record {row + 1}, {widths[field]} before"
                    faults.update(
                        {f"{field}[{i}]": ragged for i in range(max(len(value), widths[field]))}
                    )
            for name, leaf in leaves:
                if leaf is None or isinstance(leaf, NUMBERS):
                    column = columns.get(name)
                    if column is None:
                        column = columns[name] = np.full(len(records), np.nan)
                    column[row] = np.nan if leaf is None else _number(leaf)
                else:
                    faults.setdefault(name, TEXT)
    return {name: column for name, column in columns.items() if name not in faults}, faults


def _lists(path: Path, content: Mapping[str, Any], time: str) -> Table:
    """One list of numbers per column."""
    lists = {name: value for name, value in _flat(content) if isinstance(value, list)}
    if time not in lists:
        raise RecordingError(
            f"{path}: column {time!r} is missing; found: {', '.join(lists) or 'none'}"
        )
    rows, columns, faults = len(lists[time]), dict[str, Array](), dict[str, str]()
    for name, value in _flat(content):
        if isinstance(value, list) and len(value) != rows:
            faults[name] = (
                f"has {len(value)} rows where {time!r} has {rows}; all columns need equally many"
            )
        elif isinstance(value, list) and all(v is None or isinstance(v, NUMBERS) for v in value):
            columns[name] = np.array(
                [np.nan if v is None else _number(v) for v in value], dtype=np.float64
            )
        elif isinstance(value, NUMBERS):
            columns[name] = np.full(rows, _number(value))
        else:
            faults[name] = TEXT
    return Table(path, columns, faults)


def _number(value: float) -> float:
    """As float64, infinite where it is beyond it."""
    try:
        return float(value)
    except OverflowError:
        return float("inf")

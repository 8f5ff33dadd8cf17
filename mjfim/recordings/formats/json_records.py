"""Reader of JSON logs, which hold a list of records or one list of numbers per column."""

from __future__ import annotations

import json
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

from mjfim.errors import RecordingError, listed, unknown
from mjfim.recordings.formats.table import Table, leaves, one_line
from mjfim.recordings.spec import RecordingSpec

Records = Sequence[Mapping[str, Any]]


def read_json(path: Path, spec: RecordingSpec) -> Table:
    """Read the records of a JSON file; without records, its lists of numbers are the columns.

    Values beside the list of records are constants, which hold for all rows.

    Raises:
        RecordingError: The file is damaged, or it holds no records, or several lists of them.
    """
    try:
        content = json.loads(path.read_text(encoding="utf-8"))
    except (ValueError, OSError, RecursionError) as error:
        raise RecordingError(
            f"{path}: not readable JSON (damaged or truncated?): {one_line(error)}"
        ) from None

    lists = dict(_lists_of_records(content))
    outside = dict(leaves(content)) if isinstance(content, Mapping) else {}
    if not lists and any(isinstance(value, list) for value in outside.values()):
        return Table.of(path, outside, spec)
    records = _chosen(path, lists, spec.records)
    rows = [dict(leaves(record)) for record in records]
    names = dict.fromkeys(name for row in rows for name in row)
    constants = {n: value for n, value in outside.items() if not isinstance(value, list)}
    return Table.of(path, constants | {n: [row.get(n) for row in rows] for n in names}, spec)


def _lists_of_records(value: Any, place: str = "") -> Iterator[tuple[str, Records]]:
    """Dotted name and contents of every list of objects inside a value."""
    if isinstance(value, list) and value and all(isinstance(v, Mapping) for v in value):
        yield place, value
    elif isinstance(value, Mapping):
        for key, inner in value.items():
            yield from _lists_of_records(inner, f"{place}.{key}" if place else key)


def _chosen(path: Path, lists: Mapping[str, Records], stated: str | None) -> Records:
    """The list of records that the experiment file names, or the only one."""
    if stated is not None and stated not in lists:
        fault = unknown("list of records", stated, lists)
        raise RecordingError(f"{path}: recording.records: {fault}")
    if stated is not None:
        return lists[stated]
    if len(lists) > 1:
        raise RecordingError(
            f"{path}: several lists of records: {listed([*lists])}; select one by recording.records"
        )
    if not lists:
        raise RecordingError(
            f"{path}: holds no list of records (objects); a log is such a list, or an object that "
            "holds one"
        )
    return next(iter(lists.values()))

"""Tables of an experiment file as TOML, to be copied into the file."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import tomlkit
from tomlkit.items import InlineTable


def table_text(name: tuple[str, ...], table: Mapping[str, object], remark: str = "") -> str:
    """A table of an experiment file, with a line for each key.

    Args:
        name: Its name and those of the tables that contain it, the outermost one first.
        table: The table.
        remark: Comment below its heading; may be empty.

    Returns:
        Lines of TOML without a line break at the end.
    """
    document = tomlkit.document()
    outer: Any = document
    for part in name[:-1]:
        inner = tomlkit.table(is_super_table=True)
        outer.add(part, inner)
        outer = inner

    written = tomlkit.table()
    if remark:
        written.add(tomlkit.comment(remark))
    for key, value in table.items():
        written.add(key, _value(value))
    outer.add(name[-1], written)
    return tomlkit.dumps(document).strip()


def _value(value: object) -> Any:
    """A value; tables in it are written in one line, and lists of them with a line for each."""
    if isinstance(value, Mapping):
        return _inline(value)
    if isinstance(value, list) and value and isinstance(value[0], Mapping):
        array = tomlkit.array()
        array.extend(_inline(entry) for entry in value)
        return array.multiline(True)
    return value


def _inline(values: Mapping[str, object]) -> InlineTable:
    """A table in one line."""
    table = tomlkit.inline_table()
    for key, value in values.items():
        table.add(key, _value(value))
    return table

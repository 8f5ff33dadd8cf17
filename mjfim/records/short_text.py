"""Short texts of records, for the prompt of Python and for messages of tests."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import fields, is_dataclass
from enum import Enum
from typing import Any

import numpy as np

# Largest number of characters of one value.
MAX_VALUE_LENGTH = 48

# Largest number of entries of a sequence that are shown.
MAX_ENTRIES = 4


def short_text(record: Any) -> str:
    """Describe a record by one line for each field; arrays and long values by their size.

    Args:
        record: A dataclass.
    """
    lines = [f"  {field.name}={_short(getattr(record, field.name))}" for field in fields(record)]
    return "\n".join([f"{type(record).__name__}(", *lines, ")"])


def _short(value: Any) -> str:
    """Describe a value in a few words."""
    if isinstance(value, np.ndarray):
        return f"<array of shape {value.shape}>"
    if isinstance(value, Enum):
        return f"{type(value).__name__}.{value.name}"
    if is_dataclass(value) and not isinstance(value, type):
        return f"<{type(value).__name__}>"
    if isinstance(value, Mapping):
        return f"<{len(value)} entries>" if value else "{}"
    if isinstance(value, (tuple, list)):
        return _short_sequence(value)

    text = repr(value)
    return text if len(text) <= MAX_VALUE_LENGTH else f"{text[:MAX_VALUE_LENGTH]}…"


def _short_sequence(values: tuple[Any, ...] | list[Any]) -> str:
    """Describe a sequence: its entries where they are few and simple, else their number."""
    simple = all(isinstance(value, (str, int, float, bool)) for value in values)
    if simple and len(values) <= MAX_ENTRIES:
        text = repr(tuple(values))
        if len(text) <= MAX_VALUE_LENGTH:
            return text

    kinds = {type(value).__name__ for value in values}
    kind = kinds.pop() if len(kinds) == 1 else "values"
    return f"<{len(values)} × {kind}>" if values else "()"

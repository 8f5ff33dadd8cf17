"""Names of the figures of which a result may have several, known before anything is drawn."""

from __future__ import annotations

import re


def fit_names(count: int) -> tuple[str, ...]:
    """Return the names of the figures of the fits of `count` recordings."""
    if count == 1:
        return ("fit",)
    return tuple(f"fit_{i + 1}" for i in range(count))


def held_out_names(count: int) -> tuple[str, ...]:
    """Return the names of the figures of the predictions of `count` held-out recordings."""
    if count == 1:
        return ("held_out",)
    return tuple(f"held_out_{i + 1}" for i in range(count))


def histogram_name(parameter: str) -> str:
    """Return the name of the histogram of a parameter."""
    safe_name = re.sub(r"[^\w.-]", "_", parameter)
    return f"histogram_{safe_name}"

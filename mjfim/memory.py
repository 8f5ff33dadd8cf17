"""Memory that work needs, compared with the memory that is there, before the work begins."""

from __future__ import annotations

import psutil

from mjfim.errors import ExperimentError

# Largest fraction of the available memory that one computation may need by its estimate.
USABLE_FRACTION = 0.8

# Bytes of one number.
NUMBER_BYTES = 8


def available_memory() -> float:
    """Return the memory that new work can use without swapping [bytes]."""
    return float(psutil.virtual_memory().available)


def require_memory(numbers: float, cause: str, *, available: float | None = None) -> None:
    """Refuse work whose arrays do not fit into the available memory.

    Args:
        numbers: Numbers of double precision that the work holds at the same time.
        cause: Key or option with its value, for the message.
        available: Memory that is there [bytes]; None for that of this machine.

    Raises:
        ExperimentError: The memory is too small.
    """
    free = available_memory() if available is None else available
    needed, usable = NUMBER_BYTES * numbers, USABLE_FRACTION * free
    if fits_memory(needed, free):
        return

    raise ExperimentError(
        f"{cause}: this needs about {needed / 2**30:.3g} GiB of memory, and "
        f"{usable / 2**30:.3g} GiB are available; at most {usable / needed:.2g} times this size is "
        "possible"
    )


def fits_memory(needed: float, available: float | None = None) -> bool:
    """Whether work fits into the available memory.

    Args:
        needed: Memory of the work [bytes].
        available: Memory that is there [bytes]; None for that of this machine.
    """
    free = available_memory() if available is None else available
    return needed <= USABLE_FRACTION * free

"""Names and columns that fit into the width of a table."""

from __future__ import annotations

# Largest number of parameters or outputs that have a column each.
MAX_COLUMNS = 7


def shortened(path: str, width: int) -> str:
    """Return the end of a path, which distinguishes files.

    Args:
        path: The path.
        width: Largest number of characters.
    """
    name = path.rsplit("/", 1)[-1]
    return name if len(name) <= width else f"…{name[1 - width :]}"

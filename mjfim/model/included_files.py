"""The files of a model: an MJCF file and the files that it includes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar

Context = TypeVar("Context")

# Reads a file, with what its parent says about it; returns the files that it names, with theirs.
Reader = Callable[[Path, Context], Sequence[tuple[str, Context]]]


def read_with_included_files(path: Path, context: Context, read: Reader[Context]) -> None:
    """Read an MJCF file and the files that it names, each of them once.

    As in MuJoCo, names are relative to the folder of the main file. Files that do not exist are
    left to MuJoCo, which describes the fault.

    Args:
        path: The main file.
        context: What the reader needs to know about the main file.
        read: Reads one file.
    """
    waiting = [(path, context)]
    known = {path.resolve()}

    # The list grows while it is read.
    for file, stated in waiting:
        for name, other_context in read(file, stated):
            other = path.parent / name
            if other.is_file() and other.resolve() not in known:
                known.add(other.resolve())
                waiting.append((other, other_context))

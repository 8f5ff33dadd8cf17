"""The files of a model: an MJCF file and the files that it includes."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from pathlib import Path
from typing import TypeVar
from xml.parsers import expat

Context = TypeVar("Context")

# Reads a file, with what its parent says about it; returns the files that it names, with theirs.
Reader = Callable[[Path, Context], Sequence[tuple[str, Context]]]


def included_file(main: Path, including: Path, name: str) -> Path | None:
    """Find the file that an `<include>` names.

    As in MuJoCo, names are relative to the folder of the main file, or if there is no such file, to
    that of the file that names it.

    Args:
        main: The main file.
        including: The file that names another one.
        name: Name of the other file.

    Returns:
        The other file; None if there is none.
    """
    places = (main.parent / name, including.parent / name)
    return next((place for place in places if place.is_file()), None)


def read_elements(
    path: Path,
    start: Callable[[str, dict[str, str]], None],
    end: Callable[[str], None] | None = None,
) -> bool:
    """Read the elements of an XML file.

    A file that is not readable is left to MuJoCo, which describes the fault.

    Args:
        path: The file.
        start: Called with the name and the attributes of each element.
        end: Called with its name where it ends; None where that does not matter.

    Returns:
        False if the file is not readable XML.
    """
    parser = expat.ParserCreate()
    parser.StartElementHandler = start
    parser.EndElementHandler = end
    try:
        parser.Parse(path.read_bytes(), True)
    except (expat.ExpatError, OSError):
        return False
    return True


def read_with_included_files(path: Path, context: Context, read: Reader[Context]) -> None:
    """Read an MJCF file and the files that it names, each of them once.

    Files that do not exist are left to MuJoCo, which describes the fault.

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
            other = included_file(path, file, name)
            if other is not None and other.resolve() not in known:
                known.add(other.resolve())
                waiting.append((other, other_context))

"""Every file at a final name has to be whole: it loads or parses."""

from __future__ import annotations

import csv
import json
import re
from collections.abc import Iterable
from pathlib import Path

import mujoco
import numpy as np

# Temporary files of `mjfim.files`: a dot, the stem of the final name, a dash, random letters.
TEMPORARY = re.compile(r"^\..+[-_][a-z0-9_]{8}(\.[a-z.]+)?$")

# A picture of one pixel, which stands for the figures where drawing them takes too long.
PIXEL = bytes.fromhex(
    "89504e470d0a1a0a0000000d49484452000000010000000108060000001f15c489"
    "0000000d49444154789c626001000000ffff030000060005"
    "57bfabd40000000049454e44ae426082"
)


def _json(path: Path) -> None:
    """Parse a JSON file; NaN and infinity are no JSON."""

    def refuse(name: str) -> None:
        raise ValueError(f"{name} is no JSON")

    json.loads(path.read_text(encoding="utf-8"), parse_constant=refuse)


def _npz(path: Path) -> None:
    """Read every array of an npz file."""
    with path.open("rb") as stream, np.load(stream, allow_pickle=False) as file:
        for name in file.files:
            _ = file[name]


def _csv(path: Path) -> None:
    """Read a table, whose rows all have the length of the header."""
    with path.open(newline="", encoding="utf-8") as stream:
        widths = {len(row) for row in csv.reader(stream)}
    if len(widths) != 1:
        raise ValueError(f"rows of {sorted(widths)} fields")


def _png(path: Path) -> None:
    """Check the first and the last chunk of a picture."""
    content = path.read_bytes()
    if not (content.startswith(b"\x89PNG") and content.endswith(b"IEND\xaeB`\x82")):
        raise ValueError("not a whole PNG")


def _rrd(path: Path) -> None:
    """Check the beginning of a Rerun file, and that its end is there."""
    content = path.read_bytes()
    if not content.startswith(b"RRF2") or len(content) < 100:
        raise ValueError("not a Rerun file")


def _xml(path: Path) -> None:
    """Compile a model."""
    mujoco.MjModel.from_xml_path(str(path))


READERS = {
    ".json": _json,
    ".npz": _npz,
    ".csv": _csv,
    ".png": _png,
    ".rrd": _rrd,
    ".xml": _xml,
}


def faults_of(path: Path) -> list[str]:
    """Describe what is wrong with a file of results; nothing if it is whole."""
    try:
        READERS.get(path.suffix, Path.stat)(path)
    except Exception as error:
        return [f"{path.name} is not whole: {error}"]
    return []


def faults_in(files: Iterable[Path], *, may_be_temporary: bool = False) -> list[str]:
    """Describe the files that are not whole, and temporary files that should have been removed."""
    found: list[str] = []
    for path in sorted(file for file in files if file.is_file()):
        # A temporary file should have been renamed or removed.
        if TEMPORARY.match(path.name) is None:
            found += faults_of(path)
        elif not may_be_temporary:
            found.append(f"{path.name} is a temporary file that stayed")
    return found

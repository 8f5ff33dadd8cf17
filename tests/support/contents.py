"""What files of results hold, apart from what differs from run to run."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

# Files of which only the presence is compared: views hold random identifiers, and pictures times.
NOT_COMPARED = (".rrd", ".png")

# Reports and tables, whose measured times are left out.
TEXTS = (".html", ".md", ".tex")

# A measured time in a text, such as `18.2 s`.
DURATION = re.compile(r"\d[\d.]*(e[-+]\d+)? (s|min|h)\b")

# A picture or video inside a report. The size of a video, and the number of its frames, are what
# could be drawn in a limited time.
EMBEDDED = re.compile(r'<(?:img|video) [^>]*>|"data:[^"]*"')


def without_times(value: Any) -> Any:
    """JSON values without the measured times, in the order of the file."""
    if isinstance(value, dict):
        return [(key, without_times(entry)) for key, entry in value.items() if key != "seconds"]
    if isinstance(value, list):
        return [without_times(entry) for entry in value]
    return value


def with_arrays(value: Any, arrays: dict[str, bytes]) -> Any:
    """JSON values with the arrays in place of their names.

    Two fields with equal values may name the same array, or one each.
    """
    if isinstance(value, list | tuple):
        return [with_arrays(entry, arrays) for entry in value]
    return arrays.get(value, value) if isinstance(value, str) else value


def contents_of(file: Path) -> Any:
    """The bytes of a file, or its arrays and JSON values without measured times."""
    if file.suffix in NOT_COMPARED:
        return file.suffix
    if file.suffix == ".json":
        return without_times(json.loads(file.read_text(encoding="utf-8")))
    if file.suffix in TEXTS:
        text = file.read_text(encoding="utf-8")
        return DURATION.sub("", EMBEDDED.sub("", text))
    if file.suffix != ".npz":
        return file.read_bytes()

    with np.load(file) as archive:
        arrays = {key: archive[key].tobytes() for key in archive if key != "record"}
        record = without_times(json.loads(str(archive["record"])))

    # Each array is that of a field, so that nothing is left out of the comparison.
    assert set(arrays) <= set(re.findall(r'"([^"]*)"', json.dumps(record)))
    return with_arrays(record, arrays)


def contents(folder: Path) -> dict[str, Any]:
    """Contents of every file of a folder and of its subfolders, by its path in the folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {file.relative_to(folder).as_posix(): contents_of(file) for file in files}

"""What files of results hold, apart from what differs from run to run."""

from __future__ import annotations

import json
import re
from pathlib import Path
from typing import Any

import numpy as np

# Files of which only the presence is compared: views hold random identifiers, and pictures times.
NOT_COMPARED = (".rrd", ".png")

# A measured time in a report, such as `18.2 s`.
DURATION = re.compile(r"\d[\d.]*(e[-+]\d+)? (s|min|h)\b")


def without_times(value: Any) -> Any:
    """JSON values without the measured times, in the order of the file."""
    if isinstance(value, dict):
        return [(key, without_times(entry)) for key, entry in value.items() if key != "seconds"]
    if isinstance(value, list):
        return [without_times(entry) for entry in value]
    return value


def contents_of(file: Path) -> Any:
    """The bytes of a file, or its arrays and JSON values without measured times."""
    if file.suffix in NOT_COMPARED:
        return file.suffix
    if file.suffix == ".json":
        return without_times(json.loads(file.read_text(encoding="utf-8")))
    if file.suffix == ".html":
        return DURATION.sub("", file.read_text(encoding="utf-8"))
    if file.suffix != ".npz":
        return file.read_bytes()

    with np.load(file) as arrays:
        rest = {key: arrays[key].tobytes() for key in arrays if key != "record"}
        record = without_times(json.loads(str(arrays["record"])))
    return rest, record


def contents(folder: Path) -> dict[str, Any]:
    """Contents of every file of a folder and of its subfolders, by its path in the folder."""
    files = sorted(path for path in folder.rglob("*") if path.is_file())
    return {file.relative_to(folder).as_posix(): contents_of(file) for file in files}

"""Where results may be written, and where earlier ones are found."""

from __future__ import annotations

import json
import os
from pathlib import Path

from mjfim.errors import RecordingError


def recording_of(source: Path) -> Path:
    """The .rrd that a folder or file names."""
    if not source.exists():
        raise RecordingError(f"{source}: no such file or folder")
    if source.is_dir():
        for name in ("design.rrd", "estimate.rrd"):
            if (source / name).is_file():
                return source / name
        raise RecordingError(f"{source}: no design.rrd or estimate.rrd in this folder")
    if source.suffix != ".rrd":
        raise RecordingError(f"{source}: give a folder of results, an .rrd file or a design .npz")
    return source


def experiment_beside(source: Path) -> Path:
    """Experiment file that the design.json beside an npz names."""
    beside = source.parent / "design.json"
    try:
        named = json.loads(beside.read_text(encoding="utf-8"))["experiment"]
        return source.parent.resolve() / str(Path(named))
    except (OSError, ValueError, KeyError, TypeError):
        raise RecordingError(
            f"{source}: no usable design.json beside it; name the experiment with --experiment"
        ) from None


def check_folder(folder: Path) -> None:
    """Fail before the work, not after it, where results cannot be written."""
    existing = next(p for p in (folder, *folder.absolute().parents) if p.exists())
    if not existing.is_dir():
        raise RecordingError(f"{existing}: is a file; -o needs a folder")
    if not os.access(existing, os.W_OK):
        raise RecordingError(f"{existing}: no permission to write here")


def check_file(path: Path) -> None:
    """Fail before the work where a file cannot be written."""
    if path.is_dir():
        raise RecordingError(f"{path}: is a folder; -o and --save need a file here")
    check_folder(path.parent)

"""Files that a verb reads, looked at before the rooms are imported, which takes a second or more.

A missing file and a mistake in an experiment file are said at once. The rooms say the same of files
that Python programs name.
"""

from __future__ import annotations

from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any

from mjfim.errors import ModelError, RecordingError
from mjfim.experiment.experiment_file import read_tables


def require_inputs(arguments: Mapping[str, Any]) -> None:
    """Refuse paths and files of a verb that cannot be read.

    Args:
        arguments: Arguments of the verb by their names.

    Raises:
        ExperimentError: The experiment file is missing, is not TOML, or has a wrong key or value.
        ModelError: The model is missing.
        RecordingError: A recording or a design is missing, or a path is not UTF-8.
    """
    _require_utf8_paths(arguments.values())
    experiment, model = arguments.get("experiment"), arguments.get("model")
    if isinstance(experiment, Path) and not _is_stream(experiment):
        read_tables(experiment)
    if isinstance(model, Path) and not model.exists():
        raise ModelError(f"{model}: no such model file")

    design = arguments.get("design_file")
    if isinstance(design, Path) and not design.exists():
        raise RecordingError(f"{design}: no such design file")

    # Episodes of a dataset, whose names have no ending, are no files of their own.
    keys = ("recordings", "held_out", "without")
    for path in (path for key in keys for path in arguments.get(key) or ()):
        if path.suffix and not path.exists():
            raise RecordingError(f"{path}: no such file")

    # The tables are checked last, because their module takes longest to import.
    if isinstance(experiment, Path) and not _is_stream(experiment):
        from mjfim.experiment.schema import Experiment

        Experiment.from_file(experiment)


def _is_stream(path: Path) -> bool:
    """Whether a file is a pipe or a device, which cannot be read twice."""
    return path.is_fifo() or path.is_char_device()


def _require_utf8_paths(values: Iterable[Any]) -> None:
    """Refuse paths that libraries cannot open.

    Args:
        values: Arguments of a verb; only paths and lists of paths are looked at.

    Raises:
        RecordingError: A path has characters that are not UTF-8 in the present locale.
    """
    for value in values:
        for path in value if isinstance(value, list) else [value]:
            try:
                str(path).encode("utf-8")
            except UnicodeEncodeError:
                raise RecordingError(
                    f"{path}: this path has characters that are not UTF-8 in the present locale; "
                    "rename it, or set a UTF-8 locale, for example LC_ALL=C.UTF-8"
                ) from None

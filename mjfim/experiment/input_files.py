"""The files that an experiment reads."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

import mujoco

from mjfim.experiment.schema import Experiment


def input_files(experiment: Experiment, further: Iterable[Path | None] = ()) -> tuple[Path, ...]:
    """List the files of an experiment and of a call, none of which a result may replace.

    Args:
        experiment: The experiment.
        further: Further files and folders that the call reads; None is left out.

    Returns:
        The experiment file, the model with its included files and assets, controls, earlier
        results, and the further files. In place of a folder, all files in it.
    """
    named = [*experiment.descent.previous, *experiment.earlier]
    if isinstance(experiment.initial.control, str):
        named.append(experiment.initial.control)

    files = [Path(experiment.source), *_model_files(experiment.directory / experiment.model)]
    files += [experiment.directory / name for name in named]
    for path in further:
        if path is not None:
            files += sorted(path.iterdir()) if path.is_dir() else [path]
    return tuple(files)


def _model_files(path: Path) -> list[Path]:
    """List an MJCF file, the files that it includes, and its assets."""
    try:
        return [path, *map(Path, mujoco.mju_getXMLDependencies(str(path)))]
    except (ValueError, mujoco.FatalError):
        return [path]

"""The files that an experiment reads."""

from __future__ import annotations

from collections.abc import Iterable
from pathlib import Path

from mjfim.experiment.packing import tables_of
from mjfim.experiment.schema import Experiment
from mjfim.model.model_files import files_of_model


def input_files(experiment: Experiment, further: Iterable[Path | None] = ()) -> tuple[Path, ...]:
    """List the files of an experiment and of a call, none of which a result may replace.

    Args:
        experiment: The experiment.
        further: Further files and folders that the call reads; None is left out.

    Returns:
        The experiment file, the model with its included files and assets, controls, earlier
        results, and the further files. In place of a folder, all files in it.
    """
    model = experiment.directory / experiment.model
    files = [Path(experiment.source), *files_of_model(model)]
    files += [experiment.directory / name for name in tables_of(experiment)]
    for path in further:
        if path is not None:
            files += sorted(path.iterdir()) if path.is_dir() else [path]
    return tuple(files)

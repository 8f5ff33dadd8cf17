"""The files that an experiment reads, on the disk or packed in the experiment."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path

from mjfim.errors import ExperimentError, ModelError
from mjfim.experiment.schema import Experiment
from mjfim.model.loading import ModelSource, packed_model
from mjfim.model.model_files import PackedFiles, files_of_model


@contextmanager
def named_file(experiment: Experiment) -> Iterator[None]:
    """Put the name of the experiment file before the message of an ExperimentError."""
    try:
        yield
    except ExperimentError as error:
        raise ExperimentError(f"{experiment.source}: {error}") from None


def input_files(
    experiment: Experiment | None, further: Iterable[Path | None] = ()
) -> tuple[Path, ...]:
    """List the files of an experiment and of a call, none of which a result may replace.

    Args:
        experiment: The experiment; None for a call without one.
        further: Files and folders of the call, such as recordings; None for those it lacks.
    """
    files = []
    if experiment is not None:
        model = experiment.directory / experiment.model
        files = [Path(experiment.source), *files_of_model(model)]
        files += [experiment.directory / name for name in experiment.tables]
    for path in further:
        if path is not None:
            files += sorted(path.iterdir()) if path.is_dir() else [path]
    return tuple(files)


def for_workers(experiment: Experiment, source: ModelSource) -> Experiment:
    """Make a packed copy for orders, of which each worker process receives the files once.

    Args:
        experiment: The experiment.
        source: Its model, whose files are read once.

    Returns:
        The copy, which is pickled with the hash of its files. It is for orders of workers only.

    Raises:
        ExperimentError: A file cannot be read.
    """
    before = experiment.files or PackedFiles.of(source.stated.contents)
    tables = [experiment.directory / name for name in experiment.tables]
    files = PackedFiles.read([*map(Path, before.contents), *tables], before)
    return experiment.model_copy(update={"files": files.shared()})


def with_model(experiment: Experiment) -> Experiment:
    """Make a copy that holds the files of its model as they are now; later edits do not matter.

    Raises:
        ExperimentError: A file cannot be read.
        ModelError: There is no such model file.
    """
    path = experiment.directory / experiment.model
    try:
        files = (experiment.files or PackedFiles.of({})).with_model(path)
    except ModelError as error:
        raise ModelError(f"{experiment.source}: {error}") from None
    return experiment.model_copy(update={"files": files})


def model_of(experiment: Experiment) -> ModelSource:
    """Load the model of an experiment, which is parsed once in a process as long as it is the same.

    Raises:
        ExperimentError: A file cannot be read.
        ModelError: The model cannot be used.
    """
    files = with_model(experiment).files
    assert files is not None
    return packed_model(files, experiment.directory / experiment.model)


@contextmanager
def opened(experiment: Experiment, name: str) -> Iterator[Path]:
    """Give a file by its path as the experiment states it.

    It may be packed in the experiment; then it exists inside the block only.
    """
    path = experiment.directory / name
    content = None if experiment.files is None else experiment.files.content(path)
    if content is None:
        yield path
        return

    with tempfile.TemporaryDirectory(prefix="mjfim-") as folder:
        file = Path(folder) / path.name
        file.write_bytes(content)
        yield file

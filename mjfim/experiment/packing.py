"""Packed experiments, which contain their files, and access to the files of any experiment."""

from __future__ import annotations

import tempfile
from collections.abc import Iterable, Iterator
from contextlib import AbstractContextManager, contextmanager
from pathlib import Path

from mjfim.errors import ModelError
from mjfim.experiment.schema import Experiment
from mjfim.model.loading import ModelSource, packed_model
from mjfim.model.model_files import PackedFiles, files_of_model


def packed(experiment: Experiment) -> Experiment:
    """Make a copy that contains all its files. See `Experiment.packed`."""
    before = experiment.files or PackedFiles.of({})
    model = experiment.directory / experiment.model
    tables = [experiment.directory / name for name in tables_of(experiment)]
    if all(before.content(file) is not None for file in (model, *tables)):
        return experiment

    # A packed model contains what it includes.
    needed = [*map(Path, before.contents), *tables]
    if before.content(model) is None:
        if not model.is_file():
            raise ModelError(f"{model}: no such model file")
        needed += files_of_model(model)
    return experiment.model_copy(update={"files": PackedFiles.read(needed, before)})


def for_workers(
    experiment: Experiment, source: ModelSource, further: Iterable[Path] = ()
) -> Experiment:
    """Make a packed copy for orders, of which each worker process receives the files once.

    Args:
        experiment: The experiment.
        source: Its model, whose files are read once.
        further: Further files that the orders need; `opened_file` gives them by their paths.

    Returns:
        The copy, which is pickled with the hash of its files. It is for `parallel.carry_out` only.

    Raises:
        ExperimentError: A file cannot be read.
    """
    before = experiment.files or PackedFiles.of({})
    kept = {Path(name): content for name, content in before.contents.items()}
    if before.content(source.path) is None:
        kept.update(source.contents)

    tables = [experiment.directory / name for name in tables_of(experiment)]
    files = PackedFiles.read([*kept, *tables, *further], PackedFiles.of(kept))
    return experiment.model_copy(update={"files": files.shared()})


def tables_of(experiment: Experiment) -> tuple[str, ...]:
    """Names of the files that an experiment states besides its model.

    Returns:
        The table of the initial control, previous designs and earlier results.
    """
    named = [*experiment.descent.previous, *experiment.earlier]
    if isinstance(experiment.initial.control, str):
        named.append(experiment.initial.control)
    return tuple(dict.fromkeys(named))


def model_of(experiment: Experiment) -> ModelSource:
    """Load the model of an experiment.

    Args:
        experiment: The experiment. The model of a packed one is parsed once in a process.

    Raises:
        ModelError: The model cannot be used.
    """
    path = experiment.directory / experiment.model
    if experiment.files is None or experiment.files.content(path) is None:
        if not path.is_file():
            raise ModelError(
                f"{experiment.source}: model: {path}: no such model file; state the path of an "
                "MJCF or URDF, which begins in the folder of the experiment file"
            )
        return ModelSource(path)
    return packed_model(experiment.files, path)


def opened(experiment: Experiment, name: str) -> AbstractContextManager[Path]:
    """Give a file that an experiment states, other than its model.

    Args:
        experiment: The experiment.
        name: Path as the experiment states it.

    Returns:
        See `opened_file`.
    """
    return opened_file(experiment, experiment.directory / name)


@contextmanager
def opened_file(experiment: Experiment, path: Path) -> Iterator[Path]:
    """Give a file that may be packed in an experiment.

    Args:
        experiment: The experiment.
        path: The file.

    Yields:
        The file on the disk. That of a packed experiment exists inside the block only.
    """
    content = None if experiment.files is None else experiment.files.content(path)
    if content is None:
        yield path
        return

    with tempfile.TemporaryDirectory(prefix="mjfim-") as folder:
        file = Path(folder) / path.name
        file.write_bytes(content)
        yield file

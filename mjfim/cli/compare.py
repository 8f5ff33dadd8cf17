"""`mjfim compare` and `mjfim compare-robots`: excitations of equal budget, and two robots."""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import ExperimentFile, Run, verb
from mjfim.cli.progress import progress
from mjfim.errors import NoResultError
from mjfim.files import relative_name

# Longest time of a method [s]: a week.
MAX_SECONDS = 604_800.0


@verb()
def compare(
    experiment: ExperimentFile,
    run: Run,
    seconds: Annotated[
        float, typer.Option(min=0.0, max=MAX_SECONDS, help="Time of each method in seconds.")
    ] = 60.0,
    methods: Annotated[
        str | None,
        typer.Option(
            metavar="NAME,...",
            help="Baselines to run before the design: chirp, multisine, steps, fourier5, "
            "fourier15, splines.",
        ),
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the baselines.")] = 0,
) -> int:
    """Compare the design with chirps, multisines, Fourier series and splines of equal budget.

    The exit code is 1 if one of them is better than the design.
    """
    stated = mjfim.Experiment.from_file(experiment)

    from mjfim.experiment.system import System
    from mjfim.studies.compare import chosen_methods

    system = System.resolve(stated, threads=run.threads)
    chosen = None
    if methods is not None:
        chosen = [name.strip() for name in methods.split(",") if name.strip()]
    controls = (f"control_{name}.csv" for name in chosen_methods(system, chosen))
    run.claim(mjfim.Comparison, stated, further=(*controls, "control_design.csv"))

    with run.workers() as workers, progress("comparing") as show:
        result = mjfim.compare(
            stated,
            seconds=seconds,
            seed=seed,
            methods=chosen,
            callback=show,
            executor=workers,
            threads=run.threads,
        )
    if not result.rows:
        raise NoResultError

    return run.finish(result, system)


# Files of an estimate.
ESTIMATE_FILES = ("estimate.json", "estimate.npz")

# Files that `estimate.json` names, in words.
ORIGINS = {"experiment": "experiment files", "model": "models"}


@verb(without=("threads", "executor"))
def compare_robots(
    first: Annotated[
        Path, typer.Argument(metavar="DIR_A", help="Folder of `mjfim identify` of the first robot.")
    ],
    second: Annotated[
        Path,
        typer.Argument(
            metavar="DIR_B",
            help="Folder of `mjfim identify` of the second robot, or of the first one later.",
        ),
    ],
    run: Run,
) -> int:
    """Say which parameters of two robots differ, or what changed in one robot since.

    The exit code is 1 if they differ, or if one of the estimates is not reliable.
    """
    from dataclasses import replace

    estimates = [mjfim.Estimate.load(folder) for folder in (first, second)]
    inputs = [folder / name for folder in (first, second) for name in ESTIMATE_FILES]
    run.claim(mjfim.RobotComparison, None, inputs)
    result = mjfim.compare_estimates(*estimates, names=_names(first, second))
    result = replace(result, remarks=(*result.remarks, *_differences_of_files(first, second)))

    origin = {
        "first": relative_name(first, run.output),
        "second": relative_name(second, run.output),
    }
    return run.finish(result, None, further=origin)


def _names(first: Path, second: Path) -> tuple[str, str]:
    """Names of both robots: the last parts of the folders in which they differ."""
    parts = [_folder_of(path).resolve().parts for path in (first, second)]
    longest = max(map(len, parts))
    for count in range(1, longest):
        names = ["/".join(each[-count:]) for each in parts]
        if names[0] != names[1]:
            return names[0], names[1]
    return str(first), str(second)


def _folder_of(path: Path) -> Path:
    """The folder of an estimate, of which one of the files may be named."""
    return path if path.is_dir() else path.parent


def _differences_of_files(first: Path, second: Path) -> Iterator[str]:
    """Yield sentences on experiments and models that differ between two estimates."""
    from mjfim.errors import RecordingError
    from mjfim.files import read_json

    try:
        stated = [read_json(_folder_of(path) / "estimate.json") for path in (first, second)]
    except RecordingError:
        return

    for key, words in ORIGINS.items():
        files = [
            _folder_of(path) / str(values.get(key))
            for path, values in zip((first, second), stated, strict=True)
        ]
        if not all(file.is_file() for file in files):
            yield f"the {words} of the estimates are not where they were, and are not compared"
        elif files[0].read_bytes() != files[1].read_bytes():
            yield (
                f"the {words} of the estimates differ ({files[0].resolve()} and "
                f"{files[1].resolve()}); numbers in them that are no parameters can shift others"
            )

"""`mjfim design`: the most informative experiment within the limits."""

from __future__ import annotations

from collections.abc import Callable, Iterator
from concurrent.futures import Executor
from contextlib import contextmanager
from typing import Annotated

import typer

import mjfim
from mjfim.cli.common import (
    AsJson,
    ExperimentFile,
    Folder,
    Threads,
    _say,
    errors,
    progress,
    verb,
    writing,
)
from mjfim.excitation.design import design_task
from mjfim.excitation.shortest_horizon import OutOfReachError, ShortestExperiment
from mjfim.excitation.task import DesignTask
from mjfim.output.folders import check_folder
from mjfim.output.summaries import describe_design
from mjfim.output.text import render
from mjfim.parallel import Pool
from mjfim.records.design import HistoryRow
from mjfim.records.serialization import write_json


@contextmanager
def several(task: DesignTask) -> Iterator[Executor | None]:
    """Processes for the starts of a design under hard limits; None where one start has all threads to itself."""
    d = task.experiment.descent
    count = d.starts + len(d.previous) + len(d.fourier) + len(d.repeats)
    if count == 1 or not task.is_limited:
        yield None
        return
    with Pool(min(count, task.plant.simulator.threads)) as pool:
        yield pool


@verb
def design(
    experiment: ExperimentFile,
    output: Folder,
    as_json: AsJson = False,
    starts: Annotated[
        int | None, typer.Option(min=1, help="Number of starts; overrides [descent] starts.")
    ] = None,
    shortest: Annotated[
        bool,
        typer.Option(
            "--shortest", help="Find the shortest horizon at which every `wanted` σ is reached."
        ),
    ] = False,
    threads: Threads = None,
) -> None:
    """Design the excitation that reveals most about the parameters."""
    stated = mjfim.Experiment.from_file(experiment)
    if starts is not None:
        stated = stated.replace(descent={"starts": starts})
    task = DesignTask.resolve(stated, threads=threads)
    check_folder(output)
    with several(task) as executor, progress() as bar:
        progress_task = bar.add_task("designing", total=None)

        def monitor(row: HistoryRow) -> None:
            text = f"iteration {row.iteration:3d}  J {row.cost:.6g}  λ_min {row.min_eigenvalue:.5g}  slope {row.slope:.1e}"
            bar.update(progress_task, description=text)
            if not errors.is_terminal and row.iteration % 10 == 0:
                errors.print(text)

        found = _shortest(task, monitor, executor) if shortest else None
        result = design_task(task, monitor, executor=executor) if found is None else found.design
    if found is not None:
        task = DesignTask.resolve(found.experiment, threads=threads)
    with writing(output) as results:
        results.leave_design(output, result, task.system)
        if found is not None:
            write_json(output / "shortest.json", found.summary())
    told = {} if found is None else {"shortest": found.summary()}
    _say(
        as_json,
        {**result.summary(), **told},
        render(describe_design(result, task.system.units)),
    )
    if found is not None:
        errors.print(
            f"{found}\nto go on with it, state horizon = {found.horizon:g} in {experiment}",
            markup=False,
        )
    errors.print(f"wrote {output}/ (see it move: mjfim replay {output})")
    if not result.success:
        errors.print(f"mjfim: {'; '.join([result.status.value, *result.warnings])}", markup=False)
    raise typer.Exit(0 if result.success and (found is None or found.closed) else 1)


def _shortest(
    task: DesignTask, monitor: Callable[[HistoryRow], None], executor: Executor | None
) -> ShortestExperiment:
    """The shortest design, every duration told on the way; exit code 1 where none is long enough."""
    try:
        return mjfim.shortest_experiment(
            task.experiment,
            monitor=monitor,
            threads=task.plant.simulator.threads,
            report=lambda tried: errors.print(str(tried), markup=False),
            executor=executor,
        )
    except OutOfReachError as error:
        errors.print(f"mjfim: {error}", markup=False)
        raise typer.Exit(1) from None

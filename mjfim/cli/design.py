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
from mjfim.excitation.shortest_horizon import OutOfReachError, Shortest
from mjfim.experiment.system import Setup
from mjfim.output import text as report
from mjfim.output.folders import check_folder
from mjfim.parallel import Pool
from mjfim.records.design import HistoryRow
from mjfim.records.serialization import write_json


@contextmanager
def several(setup: Setup) -> Iterator[Executor | None]:
    """Processes for the starts of a design under hard limits; None where one start has all threads to itself."""
    d = setup.experiment.descent
    count = d.starts + len(d.previous) + len(d.fourier) + len(d.repeats)
    if count == 1 or not setup.enforced:
        yield None
        return
    with Pool(min(count, setup.plant.simulator.threads)) as pool:
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
    setup = Setup(stated, threads)
    check_folder(output)
    with several(setup) as executor, progress() as bar:
        task = bar.add_task("designing", total=None)

        def monitor(row: HistoryRow) -> None:
            text = f"iteration {row.iteration:3d}  J {row.cost:.6g}  λ_min {row.min_eigenvalue:.5g}  slope {row.slope:.1e}"
            bar.update(task, description=text)
            if not errors.is_terminal and row.iteration % 10 == 0:
                errors.print(text)

        found = _shortest(setup, monitor, executor) if shortest else None
        result = mjfim.design(setup, monitor, executor=executor) if found is None else found.design
    if found is not None:
        setup = Setup(found.experiment, threads)
    with writing(output) as results:
        results.leave_design(output, result, setup)
        if found is not None:
            write_json(output / "shortest.json", found.summary())
    told = {} if found is None else {"shortest": found.summary()}
    _say(
        as_json,
        {**result.summary(), **told},
        report.design_report(result, setup.units),
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
    setup: Setup, monitor: Callable[[HistoryRow], None], executor: Executor | None
) -> Shortest:
    """The shortest design, every duration told on the way; exit code 1 where none is long enough."""
    try:
        return mjfim.shortest(
            setup.experiment,
            monitor=monitor,
            threads=setup.plant.simulator.threads,
            report=lambda tried: errors.print(str(tried), markup=False),
            executor=executor,
        )
    except OutOfReachError as error:
        errors.print(f"mjfim: {error}", markup=False)
        raise typer.Exit(1) from None

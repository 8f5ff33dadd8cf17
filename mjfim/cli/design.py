"""`mjfim design`: the experiment with the most information within the limits."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import replace
from typing import TYPE_CHECKING, Annotated

import typer

import mjfim
from mjfim.amounts import MAX_STARTS
from mjfim.cli.common import (
    AsJson,
    ExperimentFile,
    Folder,
    Force,
    LiveView,
    Pictures,
    Threads,
    Verbose,
    VideoFile,
    claim_folder,
    claim_video,
    draw_elsewhere,
    errors,
    is_elsewhere,
    print_result,
    progress,
    say_written,
    verb,
    watched,
    write_wanted_video,
    writing,
)
from mjfim.cli.executors import LOCAL, ExecutorPlace, started_executor, stated_executor
from mjfim.errors import first_ones
from mjfim.output.picture_format import PictureFormat
from mjfim.parallel.budget import StopToken, stop_on_interrupt

if TYPE_CHECKING:
    from concurrent.futures import Executor

    from mjfim.excitation.shortest_horizon import ShortestExperiment
    from mjfim.excitation.task import DesignTask
    from mjfim.parallel import Workers
    from mjfim.parallel.stated import StatedExecutor
    from mjfim.records.design import Design
    from mjfim.records.events import Callback

# Time after which a design ends that states none [s].
DEFAULT_SECONDS = 120.0


@contextmanager
def several(task: DesignTask, stated: StatedExecutor) -> Iterator[Workers | None]:
    """Start the workers for the initial controls of a design.

    Args:
        task: The design.
        stated: Where they are, as the user states it.

    Yields:
        The workers; None on this computer for a single initial control, and for few of them without
        hard limits, each of which uses all threads.
    """
    threads = task.plant.simulator.threads
    descent = task.experiment.descent
    further = len(descent.previous) + len(descent.fourier) + len(descent.repeats)
    count = descent.starts + further
    if not task.is_limited and count < (stated.processes or threads):
        count = 1
    with started_executor(stated, count, threads) as workers:
        yield workers


@verb
def design(
    experiment: ExperimentFile,
    output: Folder,
    as_json: AsJson = False,
    verbose: Verbose = False,
    starts: Annotated[
        int | None,
        typer.Option(
            min=1, max=MAX_STARTS, help="Number of initial controls; overrides descent.starts."
        ),
    ] = None,
    shortest: Annotated[
        bool,
        typer.Option(
            "--shortest", help="Find the shortest horizon at which every `wanted` σ is reached."
        ),
    ] = False,
    pictures: Pictures = PictureFormat.PNG,
    video: VideoFile = None,
    live: LiveView = None,
    force: Force = False,
    threads: Threads = None,
    executor: ExecutorPlace = LOCAL,
) -> None:
    """Design the excitation that gives the most information about the parameters."""
    draw_elsewhere()
    from mjfim.excitation.design import design_budget, design_task
    from mjfim.excitation.task import DesignTask
    from mjfim.excitation.task_parts import require_design_keys
    from mjfim.experiment.input_files import input_files
    from mjfim.experiment.system import System
    from mjfim.output import archive
    from mjfim.output.folders import DESIGN_FILES, SHORTEST_FILES
    from mjfim.output.presentation import describe

    place = stated_executor(executor)
    stated = mjfim.Experiment.from_file(experiment)
    if starts is not None:
        stated = stated.replace(descent={"starts": starts})
    system = System.resolve(stated, threads=threads)
    require_design_keys(system)

    # A design that states no time ends all the same. The shortest horizon takes many designs.
    has_default = stated.descent.seconds is None and not shortest
    task = _timed(DesignTask.of(system), has_default)
    most = None if shortest else task.experiment.descent.seconds
    names = (*DESIGN_FILES, *(SHORTEST_FILES if shortest else ()))
    claim_video(video, input_files(stated), force=force)
    claim_folder(output, pictures.files(names), input_files(stated), force=force)

    with (
        several(task, place) as workers,
        progress("designing", at_most=most) as display,
        watched(live, system, display) as show,
        stop_on_interrupt() as stop,
    ):
        found = _shortest(task, show, workers, stop) if shortest else None
        if found is not None:
            result = found.design
        else:
            budget = design_budget(task, stop)
            result = design_task(task, callback=show, executor=workers, budget=budget)

    # The files of the shortest experiment describe its horizon, not the stated one.
    if found is not None:
        task = DesignTask.resolve(found.experiment, threads=threads)
    values = archive.summary_with_origin(result, task.system, output)
    if found is not None:
        values["shortest"] = found.summary()
    summary = describe(result)
    print_result(as_json, values, summary, verbose=verbose)
    with writing(output) as results:
        results.write_result(output, result, task.system, pictures)
        if found is not None:
            found.save(output)
    write_wanted_video(video, task.system, result)

    if found is not None:
        errors.print(f"mjfim: {found}" if not found.reached else f"{found}", markup=False)
    if found is not None and found.reached:
        errors.print(
            f"to use this horizon further, state horizon = {found.horizon:g} in {experiment}",
            markup=False,
        )
    say_written(output, f"\nto see the motion: mjfim replay {output}")
    if is_elsewhere(as_json) and not result.success:
        errors.print(f"mjfim: {'; '.join([result.outcome, *result.warnings])}", markup=False)
    if not result.separable:
        errors.print(f"mjfim: {_inseparable(result)}", markup=False)
    _say_if_default_ended(result, has_default)
    is_done = result.sound and result.separable and (found is None or found.closed)
    raise typer.Exit(0 if is_done else 1)


def _timed(task: DesignTask, has_default: bool) -> DesignTask:
    """A design that ends after the default time where it states none."""
    if not has_default:
        return task
    experiment = task.experiment.replace(descent={"seconds": DEFAULT_SECONDS})
    return replace(task, system=replace(task.system, experiment=experiment))


def _inseparable(result: Design) -> str:
    """Sentence about parameters that do the same, which `mjfim check` says, too."""
    groups = first_ones(result.combinations, "; ")
    return (
        "the design is made for combinations of parameters, because no control separates these "
        f"parameters: {groups}. Remove or fix one of each group, give it a prior, or measure "
        "another output"
    )


def _say_if_default_ended(result: Design, has_default: bool) -> None:
    """Say that the default time has ended a design, and how to state another one."""
    if has_default and result.seconds >= DEFAULT_SECONDS:
        errors.print(
            f"mjfim: the design ended after {DEFAULT_SECONDS:g} s, the default time; `seconds` in "
            "the table [descent] states another one",
            markup=False,
        )


def _shortest(
    task: DesignTask, callback: Callback, executor: Executor | None, stop: StopToken
) -> ShortestExperiment:
    """Find the shortest experiment; exit with code 1 if the longest one misses a target."""
    from mjfim.excitation.shortest_horizon import OutOfReachError

    try:
        return mjfim.shortest_experiment(
            task.experiment,
            callback=callback,
            threads=task.plant.simulator.threads,
            executor=executor,
            stop=stop,
        )
    except OutOfReachError as error:
        errors.print(f"mjfim: {error}", markup=False)
        raise typer.Exit(1) from None

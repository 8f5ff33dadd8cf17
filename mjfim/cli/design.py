"""`mjfim design`: the experiment with the most information within the limits."""

from __future__ import annotations

from contextlib import ExitStack
from typing import TYPE_CHECKING, Annotated

import typer

import mjfim
from mjfim.cli.common import (
    ExperimentFile,
    LiveView,
    Run,
    VideoFile,
    draw_elsewhere,
    verb,
    write_wanted_video,
)
from mjfim.cli.progress import progress, say_from_program, watched
from mjfim.errors import MAX_STARTS

if TYPE_CHECKING:
    from mjfim.excitation.task import DesignTask

# Time after which a design ends that states none [s].
DEFAULT_SECONDS = 120.0


@verb()
def design(
    experiment: ExperimentFile,
    run: Run,
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
    video: VideoFile = None,
    live: LiveView = None,
) -> int:
    """Design the excitation that gives the most information about the parameters."""
    stated = mjfim.Experiment.from_file(experiment)
    draw_elsewhere()

    from mjfim.excitation.shortest_horizon import OutOfReachError
    from mjfim.excitation.task import DesignTask
    from mjfim.experiment.controls import require_design_keys
    from mjfim.experiment.system import System

    if starts is not None:
        stated = stated.replace(descent={"starts": starts})
    # A design that states no time ends all the same. The shortest horizon takes many designs.
    has_default = stated.descent.seconds is None and not shortest
    if has_default:
        stated = stated.replace(descent={"seconds": DEFAULT_SECONDS})
    system = System.resolve(stated, threads=run.threads)
    require_design_keys(system)
    task = DesignTask.of(system)

    names = ("shortest.json", "shortest.npz") if shortest else ()
    run.claim(mjfim.Design, stated, further=names, video=video)

    found = None
    with ExitStack() as during:
        workers = during.enter_context(run.workers(_tasks(task, run), _cores(task)))
        most = None if shortest else stated.descent.seconds
        display = during.enter_context(progress("designing", at_most=most))
        show = during.enter_context(watched(live, system, display))
        if shortest:
            try:
                found = mjfim.shortest_experiment(
                    stated, callback=show, threads=run.threads, executor=workers
                )
            except OutOfReachError as error:
                say_from_program(str(error))
                return 1
            result = found.design
        else:
            result = mjfim.design(stated, callback=show, threads=run.threads, executor=workers)

    further, remarks = {}, [f"to see the motion: mjfim replay {run.output}"]
    if found is not None:
        # The files describe the shortest horizon, not the stated one.
        system = System.resolve(found.experiment, threads=run.threads)
        further["shortest"] = found.summary()
        found.save(run.output)
        remarks.append(f"{found}" if found.reached else f"mjfim: {found}")
        if found.reached:
            state = f"state horizon = {found.horizon:g} in {experiment}"
            remarks.append(f"to use this horizon further, {state}")
    if has_default and result.seconds >= DEFAULT_SECONDS:
        remarks.append(
            f"mjfim: the design ended after {DEFAULT_SECONDS:g} s, the default time; `seconds` in "
            "the table [descent] states another one"
        )
    code = run.finish(result, system, design=run.output, further=further, remarks=remarks)
    write_wanted_video(video, system, result)
    return code or int(found is not None and not found.closed)


def _cores(task: DesignTask) -> int:
    """Processes of this computer that a design may use."""
    return int(task.plant.simulator.threads)


def _tasks(task: DesignTask, run: Run) -> int:
    """Number of the initial controls of a design that are worth a process each.

    Without limits, fewer than one for each core use all cores one after the other.
    """
    descent = task.experiment.descent
    further = len(descent.previous) + len(descent.fourier) + len(descent.repeats)
    count = descent.starts + further
    stated = run.executor.partition(":")[2]
    processes = int(stated) if stated.isdecimal() else _cores(task)
    return count if task.is_limited or count >= processes else 1

"""Robustness of a design against differences between the model and the robot.

The design is played on simulated robots that differ from the model, and each robot is then
identified from its recording.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path

import numpy as np
import scipy
from threadpoolctl import threadpool_limits

from mjfim.errors import NoResultError
from mjfim.experiment.packing import for_workers
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.parallel import ExecutorLike, results_on
from mjfim.parallel.budget import StopToken, stop_on_interrupt
from mjfim.records.events import Callback, StudyEvent, shown_progress
from mjfim.records.studies import (
    CONFIDENCE,
    LATENCY,
    AssessedLimit,
    RobotConditions,
    RobotRun,
    Robustness,
)
from mjfim.studies.robot_bench import RobotBench


def assess_robustness(
    experiment: Experiment,
    design: str | Path,
    *,
    conditions: RobotConditions | None = None,
    runs: int = 100,
    callback: Callback | None = None,
    executor: ExecutorLike | None = None,
    stop: StopToken | None = None,
    progress: bool = True,
) -> Robustness:
    """Play a design on simulated robots that differ from the model, and identify each of them.

    Every parameter of a robot has an error of the stated relative size, whose sign is random. The
    robot stands still at its equilibrium before it begins. Limits are checked at every engine step.
    The fit starts at the guess. The delay and the initial positions that depend on the parameters
    are further unknowns.

    Args:
        experiment: The experiment of the design.
        design: Folder of the design, or its design.csv.
        conditions: Differences between the robots and the model; None for errors of 20 % and a
            latency of 5 ms.
        runs: Number of robots.
        callback: Called with a `StudyEvent` after every robot.
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process. It
            plays several robots side by side.
        stop: Ends the study early; the robots that are finished count.
        progress: False for no bar of progress in a notebook; a callback replaces the bar as well.

    Returns:
        Errors of the estimates and margins of the limits, over all finished robots.

    Raises:
        ExperimentError: The duration of the design is not that of the experiment, or the conditions
            cannot be simulated.
        RecordingError: The design cannot be read.
        NoResultError: The study was stopped before any robot was finished.
    """
    table = Path(design)
    table = table if table.is_file() else table / "design.csv"
    if conditions is None:
        conditions = RobotConditions(latency=default_latency(experiment))
    bench = RobotBench(experiment, table, conditions)

    found: list[RobotRun] = []
    with (
        stop_on_interrupt(stop) as token,
        shown_progress("playing the design", callback, progress) as show,
    ):

        def make(threads: int) -> Callable[[], RobotBench]:
            """Return what makes the bench in a process, which needs no file of this one."""
            packed = for_workers(experiment, bench.stated.system.source, [table])
            return partial(RobotBench, packed, table, bench.conditions)

        for run in results_on(bench, make, _run_until_stopped, range(runs), executor, token):
            if run is None:
                continue
            found.append(run)
            if show is None:
                continue

            event = StudyEvent(
                study="robustness",
                part="robots",
                index=len(found) - 1,
                count=runs,
                share=1.0,
                message=f"{len(found)} of {runs} robots",
            )
            show(event)

    if not found:
        raise NoResultError("the study was stopped before any robot was finished")
    return summarize_runs(bench, found)


def default_latency(experiment: Experiment) -> float:
    """Delay of the control where none is stated.

    Args:
        experiment: The experiment.

    Returns:
        5 ms, rounded up to whole timesteps of the engine [s]; 0 without actuators, because there is
        no control that could be late.
    """
    system = System.resolve(experiment, threads=1)
    if not system.controls:
        return 0.0
    timestep = float(system.model.opt.timestep)
    return float(np.ceil(LATENCY / timestep - 1e-6) * timestep)


def summarize_runs(bench: RobotBench, runs: Sequence[RobotRun]) -> Robustness:
    """Compare the estimates and margins of all robots with the true values and with the plan.

    Args:
        bench: The bench on which the robots were played.
        runs: The robots.
    """
    task = bench.task
    names = task.parameters.names
    shape = (-1, len(names))

    # Only robots that could be identified count for the errors.
    good = [run for run in runs if np.isfinite(run.estimate).all()]
    error = np.array([run.estimate - run.theta for run in good]).reshape(shape)
    std = np.array([run.std for run in good]).reshape(shape)
    std = np.where(np.isfinite(std).all(axis=0), std, np.nan)

    # Joint confidence regions: of the parameters that the experiment states, and of all unknowns.
    identified = np.isfinite(std).all(axis=0)
    stated = np.isin(names, bench.stated.parameters.names)

    squared = [(run.theta - task.parameters.guess) ** 2 for run in runs]
    return Robustness(
        conditions=bench.conditions,
        names=names,
        units=task.system.units,
        limits=tuple(
            AssessedLimit(
                kind=limit.kind,
                name=limit.name,
                lower=limit.lower,
                upper=limit.upper,
                scale=limit.scale,
            )
            for limit in bench.limits
        ),
        wrong=np.sqrt(np.mean(squared, axis=0)),
        z=error / std,
        error=error,
        std=std,
        predicted=bench.predicted(),
        joint=(_covered(good, identified & stated), _covered(good, identified)),
        margins=np.array([run.margins for run in runs]),
        planned=bench.planned(),
        fit=float(np.mean([run.fit for run in good])) if good else np.nan,
        misfits=sum(run.misfit for run in runs),
        restarted=sum(run.restarted for run in runs),
        troubles=dict(Counter(run.trouble for run in runs if run.trouble)),
    )


def _covered(runs: Sequence[RobotRun], selected: np.ndarray) -> int:
    """Number of robots whose true values lie in the joint confidence region of some parameters.

    Args:
        runs: Identified robots.
        selected: (p,) True for the parameters of the region.
    """
    indices = np.flatnonzero(selected)
    threshold = scipy.stats.chi2.ppf(CONFIDENCE, len(indices))
    return int(sum(run.squared_distance(indices) <= threshold for run in runs))


def _run_until_stopped(bench: RobotBench, number: int, stop: StopToken) -> RobotRun | None:
    """Play one robot, with one thread; None after a request to stop."""
    with threadpool_limits(1), stop_on_interrupt(stop):
        run = bench.run(number)
    return None if stop.requested else run

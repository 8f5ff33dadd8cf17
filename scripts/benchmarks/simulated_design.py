"""Efficiency of a design from many starts on simulated clusters of any size."""

from __future__ import annotations

from collections.abc import Hashable, Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any
from unittest.mock import patch

import numpy as np

import mjfim
from mjfim.arrays import Array
from mjfim.excitation import control_search
from mjfim.excitation import design as design_module
from mjfim.excitation.constrained import ConstrainedSlice
from mjfim.excitation.evaluation import point_at_stated_rate
from mjfim.excitation.initial_controls import InitialControl, initial_controls_of
from mjfim.excitation.judging import JudgeOrder
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.rounds import Judgement
from mjfim.excitation.task import DesignTask
from scripts.benchmarks.simulated_cluster import MeasuredTasks, simulated

# Time that a task needs to reach a worker of a cluster, and its result to return [s].
LATENCY = 5e-3

# What stands between the name of a start and the number of its copy.
COPY = ", copy "


@dataclass(frozen=True, kw_only=True)
class Efficiency:
    """A design on a simulated cluster.

    Attributes:
        workers: Number of workers.
        seconds: Simulated time of the whole design [s].
        efficiency: Length of all tasks together, over workers times `seconds`.
        of_searches: The same from the first task to the last one, without what the caller does
            before and after them.
        iterations: Number of iterations of all searches, which does not depend on the number of
            workers if they make the same decisions.
        caller: CPU time of the caller, whom all workers wait for if it is busy [s].
        pickling: The part of it in which orders are pickled and results unpickled [s].
        tasks: Number of tasks.
        task_seconds: Mean length of a task [s].
    """

    workers: int
    seconds: float
    efficiency: float
    of_searches: float
    iterations: int
    caller: float
    pickling: float
    tasks: int
    task_seconds: float


def efficiencies(
    experiment: mjfim.Experiment, starts: int, counts: Sequence[int]
) -> Iterator[Efficiency]:
    """Schedule a design from many starts on one worker and on more.

    The searches from the initial controls that the experiment states are carried out once for each
    length of slices. Every further start takes as long as one of them, and finds the same.

    Args:
        experiment: Experiment under hard limits; its number of starts is that of the searches that
            are carried out.
        starts: Number of starts that are scheduled.
        counts: Numbers of workers.

    Yields:
        The efficiency on each number of workers.
    """
    task = DesignTask.resolve(experiment, threads=1)
    tasks = _MeasuredSearches()

    # Slices are longer on more workers. Each length is carried out and measured once, at the speed
    # that the computer has then. So tasks of one run are compared with each other only.
    for number in counts:
        found = _simulated_seconds(task, tasks, starts, number)
        yield Efficiency(
            workers=number,
            seconds=found.whole,
            efficiency=found.busy / (number * found.whole),
            of_searches=found.busy / (number * found.searches),
            iterations=found.iterations,
            caller=found.caller,
            pickling=found.pickling,
            tasks=found.tasks,
            task_seconds=found.busy / found.tasks,
        )


@dataclass(frozen=True, kw_only=True)
class _Times:
    """Simulated times of a design [s].

    Attributes:
        whole: The whole design.
        searches: From the first task to the last one.
        busy: All tasks together.
        caller: The caller's own work.
        pickling: The part of it in which it pickles and unpickles.
        tasks: Number of tasks.
        iterations: Number of iterations of all searches.
    """

    whole: float
    searches: float
    busy: float
    caller: float
    pickling: float
    tasks: int
    iterations: int


def _simulated_seconds(
    task: DesignTask, tasks: _MeasuredSearches, starts: int, workers: int
) -> _Times:
    """Design on a simulated cluster."""

    def many(*args: Any, **kwargs: Any) -> Iterator[InitialControl]:
        """The stated initial controls again and again, under other names."""
        found = list(initial_controls_of(*args, **kwargs))
        names = (_copy_name(found, i) for i in range(starts))
        return (replace(found[i % len(found)], name=name) for i, name in enumerate(names))

    evaluated: dict[tuple[int, bytes], Any] = {}

    def evaluated_once(stage: DescentLevel, control: Array) -> Any:
        """The point of a control, evaluated once: all copies of a start find the same control."""
        key = id(stage), control.tobytes()
        if key not in evaluated:
            evaluated[key] = point_at_stated_rate(stage, control)
        return evaluated[key]

    with (
        patch.object(design_module, "initial_controls_of", many),
        patch.object(control_search, "point_at_stated_rate", evaluated_once),
        simulated(workers, tasks, LATENCY) as cluster,
    ):
        found = design_module.design_task(task, executor=cluster.workers)
    return _Times(
        whole=cluster.now,
        searches=cluster.searching,
        busy=cluster.busy,
        caller=cluster.caller,
        pickling=cluster.pickling,
        tasks=cluster.count,
        iterations=sum(start.iterations for start in found.starts),
    )


def _copy_name(found: Sequence[InitialControl], i: int) -> str:
    """Name of a copy of a start; the first ones keep theirs."""
    name = str(found[i % len(found)].name)
    return name if i < len(found) else f"{name}{COPY}{i // len(found)}"


class _MeasuredSearches(MeasuredTasks):
    """Searches, or slices of searches, of which copies take as long and find the same."""

    def __init__(self) -> None:
        super().__init__(key_of=_key)

    def done(self, fn: Any, args: tuple[Any, ...]) -> tuple[Any, float]:
        """Result of a slice or of a judgement under the name of its start, and its CPU time [s]."""
        found, seconds = super().done(fn, args)
        name = _start(args[0]).name
        renamed = replace(found, result=replace(found.result, name=name))
        if isinstance(found, Judgement) and found.following is not None:
            renamed = replace(renamed, following=replace(found.following, name=name))
        return renamed, seconds


def _key(args: tuple[Any, ...]) -> Hashable:
    """Return what tells a slice or a judgement from others, apart from copies of its start."""
    (order,) = args
    name = _start(order).name.partition(COPY)[0]
    if isinstance(order, JudgeOrder):
        return name, repr(order.judge), np.asarray(order.result.control).tobytes()

    search = order.search
    common = name, str(search.variant), search.schedule.first, tuple(search.tightening.items())
    done = 0 if order.before is None else len(order.before.result.history)
    begun = search.start.control.tobytes()

    # Slices are longer on more workers.
    return (*common, begun, search.max_iterations, done, order.seconds)


def _start(order: ConstrainedSlice | JudgeOrder) -> InitialControl:
    """The start of an order."""
    return order.begun if isinstance(order, JudgeOrder) else order.search.start


def save_curves(curves: Mapping[str, Sequence[Efficiency]], wanted: float, path: Path) -> None:
    """Draw the efficiency over the number of workers.

    Args:
        curves: The efficiencies of each experiment, by its name.
        wanted: Efficiency that is wanted.
        path: PNG to write.
    """
    import matplotlib.pyplot as plt

    figure, axes = plt.subplots(figsize=(6.4, 4.0), layout="constrained")
    for number, (name, rows) in enumerate(curves.items()):
        workers = [row.workers for row in rows]
        colour = f"C{number}"
        whole, searches = [[row.efficiency for row in rows], [row.of_searches for row in rows]]
        axes.semilogx(workers, whole, "o-", base=2, color=colour, label=name)
        axes.semilogx(workers, searches, "s--", base=2, color=colour, label=f"{name}, searches")
        axes.set_xticks(workers, [str(number) for number in workers])
    axes.axhline(wanted, color="0.5", lw=1.0, label=f"wanted: {wanted:g}")
    axes.set(xlabel="simulated workers", ylabel="efficiency", ylim=(0.0, 1.05))
    axes.legend()
    path.parent.mkdir(parents=True, exist_ok=True)
    figure.savefig(path, dpi=120)
    plt.close(figure)

"""A design at an estimate, with the information of recordings so far as known before.

What the criterion compares does not move with the estimate: each parameter keeps the scale that it has in the experiment as
stated. Nor does the price of effort. The first design pays what a relative gain of information is worth to it, phi_1 = J's
share of information there: d(log phi) * phi_1 = d(effort). The n-th of equal experiments changes log phi by 1/n only, so
there phi weighs n phi_1 / phi_n times as much as stated (n times with D, whose phi is a logarithm). Otherwise every round
would be gentler than the last, and a round at smaller values than guessed gentler than the first.
"""

from __future__ import annotations

from collections.abc import Sequence
from concurrent.futures import Executor
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import StopToken, stop_on_interrupt
from mjfim.errors import MjfimError, SimulationDivergedError
from mjfim.excitation.design import design_budget, design_task
from mjfim.excitation.evaluation import evaluate_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.records.design import Design, Status
from mjfim.records.estimate import Estimate
from mjfim.records.events import DesignCallback

INSIDE = 1e-3  # of a parameter's size, or a quarter of its range, that a design keeps from bounds
KNOWN = 2.5  # standard deviations about the estimate from which a robust redesign draws its samples


@dataclass(frozen=True, eq=False)
class Past:
    """What a redesign knows. estimate: from all recordings so far;  count: of them

    begun, first: (p,) and (N, nu), where the first design was made and its control;  last: (N, nu) the last one's
    """

    estimate: Estimate
    count: int
    begun: Array
    first: Array
    last: Array


def redesigned(
    base: DesignTask,
    past: Past,
    theta: Array,
    callback: DesignCallback | None = None,
    executor: Executor | None = None,
) -> Design:
    """The better of the designs from the initial control and from the last one's, at theta: (p,).

    base: of the experiment as stated. Raises as `design` does.
    """
    moved = restated(base, theta, past.estimate)
    told = past.estimate.data
    moved = moved.replace(cost={"information": _worth(base, moved, past)})
    task = base.restated(moved, added_information=told)
    with stop_on_interrupt() as stop:
        found = [
            design_task(
                task, callback=callback, executor=executor, budget=design_budget(task, stop)
            )
        ]
        found += _from_last_control(base, moved, past, callback, stop, found[0])
    if found[-1].status is Status.INTERRUPTED:
        return found[-1]
    return min(found, key=lambda d: (d.status is Status.INFEASIBLE, d.final.cost))


def _from_last_control(
    base: DesignTask,
    moved: Experiment,
    past: Past,
    callback: DesignCallback | None,
    stop: StopToken,
    first: Design,
) -> list[Design]:
    """The design that begins with the last control; empty where that does not fit or diverges."""
    if past.last.shape != first.trajectory.ctrl.shape or first.status is Status.INTERRUPTED:
        return []

    alone = moved.replace(descent={"starts": 1, "previous": (), "fourier": (), "repeats": ()})
    task = base.restated(alone, added_information=past.estimate.data)
    try:
        return [
            design_task(
                task,
                callback=callback,
                initial_control=past.last,
                budget=design_budget(task, stop),
            )
        ]
    except SimulationDivergedError:
        # The old control may be too much for the new values.
        return []


def _worth(base: DesignTask, moved: Experiment, past: Past) -> float:
    """Weight of the criterion at which a relative gain of information costs as much effort as in the first design."""
    stated, count = moved.cost.information, past.count + 1
    if moved.cost.criterion == "D":
        return stated * count
    try:
        begun = _phi(base.restated(restated(base, past.begun)), past.first)
        now = _phi(base.restated(moved, added_information=past.estimate.data), past.last)
    except (MjfimError, ValueError):
        return stated * count**2  # as of equal experiments
    return float(stated * count * begun / now)


def _phi(task: DesignTask, control: Array) -> float:
    """Criterion along a control: (N, nu). Raises where there is none."""
    if control.shape != task.control.shape:
        raise ValueError(f"a control of {control.shape} instead of {task.control.shape}")
    value = evaluate_task(task, task.plant.simulate(task.theta, control)).criterion
    if not (np.isfinite(value) and value > 0.0):
        raise SimulationDivergedError(f"criterion {value}")
    return value


def restated(
    base: DesignTask, theta: Array | None = None, estimate: Estimate | None = None
) -> Experiment:
    """The experiment as a redesign states it: guesses at theta, (p,), scales as they are, no true values.

    Guesses keep a little inside bounds. A whole inertia moves only where the recordings show all of its coordinates. With
    [robust], the bounds are drawn to what is known by now, from which its samples come.
    """
    e, p = base.experiment, base.parameters
    tables: dict[str, dict[str, Any]] = {}
    place = {name: j for j, name in enumerate(p.names)}
    for name, spec in e.parameters.items():
        table = spec.model_dump(exclude_unset=True)
        table.pop("true", None)
        if spec.inertial is None:
            tables[name] = {**table, **_moved(base, place[name], theta, estimate)}
            continue
        members = [j for j, q in enumerate(p.parameters) if q.group == name]
        if theta is None or estimate is None or not _shown(base, members, estimate):
            tables[name] = table
            continue
        for j in members:
            own = p.parameters[j]
            alone = {"target": own.targets[0].path, "unit": own.unit, "nuisance": own.nuisance}
            if own.prior is not None:
                alone["prior"] = own.prior
            tables[own.name] = {**alone, **_moved(base, j, theta, estimate)}
    values = e.model_dump(exclude_unset=True)
    cost = {**values.get("cost", {}), "linearize_at": "guess"}
    return Experiment(
        **{**values, "parameters": tables, "cost": cost}, directory=e.directory, source=e.source
    )


def _moved(
    base: DesignTask, j: int, theta: Array | None, estimate: Estimate | None
) -> dict[str, Any]:
    """Keys of a parameter that a redesign states anew."""
    own, size = base.parameters.parameters[j], float(base.parameters.magnitude[j])
    low, high = own.bounds
    if theta is None:
        return {"guess": own.guess, "scale": own.scale}
    gap = min(INSIDE * size, 0.25 * (high - low))
    guess = float(np.clip(theta[j], low + gap, high - gap))
    keys = {"guess": guess, "scale": own.scale}
    drawn = base.experiment.robust is not None and (
        own.prior is not None or np.isfinite(own.bounds).all()
    )
    if drawn and estimate is not None and np.isfinite(estimate.std[j]):
        reach = max(KNOWN * float(estimate.std[j]), 1e-9 * size)
        return {**keys, "bounds": (max(low, guess - reach), min(high, guess + reach))}
    return keys


def _shown(base: DesignTask, members: Sequence[int], estimate: Estimate) -> bool:
    """Whether the recordings show every one of some parameters: to move one by its size moves them by more than the noise."""
    at = np.asarray(members)
    return bool((np.diag(estimate.data)[at] * base.parameters.magnitude[at] ** 2 > 1.0).all())

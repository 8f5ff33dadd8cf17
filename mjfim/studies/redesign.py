"""Design at an estimate, with the information of the recordings so far as prior information.

The scales of the parameters remain those of the stated experiment, so that criteria of different
rounds can be compared. The balance between information and effort must remain as well. In the first
design, phi_1 is the share of the information in J, and `d(log phi) * phi_1 = d(effort)` at the
optimum. The n-th of equal experiments changes log phi by 1/n only, so phi is weighted by n phi_1 /
phi_n there (by n with D-optimality, whose phi is a logarithm). Otherwise every round would use less
effort than the one before, and a round at values below the guess less than the first round.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import MjfimError, SimulationDivergedError
from mjfim.excitation.design import design_budget, design_task
from mjfim.excitation.evaluation import criterion_of
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.parallel import ExecutorLike
from mjfim.parallel.budget import StopToken
from mjfim.records.campaign import Round
from mjfim.records.design import Design, Status
from mjfim.records.estimate import Estimate
from mjfim.records.events import Callback

# Smallest distance of guesses from bounds, relative to the size of a parameter.
BOUND_GAP = 1e-3

# Largest value of that distance, as a share of the range between the bounds.
MAX_BOUND_GAP = 0.25

# A robust redesign draws its samples within this number of standard deviations about the estimate.
SAMPLING_RANGE = 2.5

# Smallest value of that range, relative to the size of a parameter, so that bounds do not coincide.
MIN_SAMPLING_RANGE = 1e-9


def redesign(
    base: DesignTask,
    rounds: Sequence[Round],
    theta: Array,
    *,
    callback: Callback | None = None,
    executor: ExecutorLike | None = None,
    stop: StopToken | None = None,
) -> Design:
    """Design again with the information of the recordings so far.

    One design starts at the initial control and one at the control of the last design; the better
    of the two is returned.

    Args:
        base: Task of the experiment as stated.
        rounds: Earlier rounds.
        theta: (p,) parameters at which the design is made [theta-unit].
        callback: Called with a `DesignEvent` for every iterate.
        executor: Runs several optimisations at once, under hard limits.
        stop: Ends the design early.

    Raises:
        MjfimError: As `mjfim.design` raises it.
    """
    last = rounds[-1]
    known = last.estimate.data
    moved = restate_experiment(base, theta, last.estimate)
    weight = _information_weight(base, moved, rounds)
    moved = moved.replace(cost={"information": weight})

    task = base.restated(moved, added_information=known)
    first = design_task(
        task, callback=callback, executor=executor, budget=design_budget(task, stop)
    )
    if last.control.shape != task.control.shape or first.status is Status.INTERRUPTED:
        return first

    # The second design starts at the control of the last design, and nowhere else.
    only_start = {"starts": 1, "previous": (), "fourier": (), "repeats": ()}
    task = base.restated(moved.replace(descent=only_start), added_information=known)
    try:
        second = design_task(
            task,
            callback=callback,
            initial_control=last.control,
            budget=design_budget(task, stop),
        )
    except SimulationDivergedError:
        # The old control may be too strong for the new parameters.
        return first

    if second.status is Status.INTERRUPTED:
        return second
    return min(
        (first, second),
        key=lambda design: (design.status is Status.INFEASIBLE, design.final.cost),
    )


def _information_weight(base: DesignTask, moved: Experiment, rounds: Sequence[Round]) -> float:
    """Weight of the criterion that keeps the balance between information and effort.

    A relative gain of information then costs as much effort as in the first design.
    """
    stated = moved.cost.information
    count = sum(len(each.recordings) for each in rounds) + 1
    if moved.cost.criterion == "D":
        return stated * count

    first_task = base.restated(restate_experiment(base, rounds[0].theta))
    task = base.restated(moved, added_information=rounds[-1].estimate.data)
    try:
        first = criterion_of(first_task, rounds[0].control)
        last = criterion_of(task, rounds[-1].control)
    except (MjfimError, ValueError):
        # Where a value is missing, take the weight for equal experiments.
        return stated * count**2

    return float(stated * count * first / last)


def restate_experiment(
    base: DesignTask, theta: Array | None = None, estimate: Estimate | None = None
) -> Experiment:
    """State the experiment of a redesign.

    Its guesses are the given parameters, its scales are unchanged, and it has no true values.
    Guesses keep a small distance from bounds. The parameters of a declared inertia change only
    where the recordings determine all of them. With `[robust]`, whose samples are drawn between the
    bounds, the bounds shrink to a region about the estimate.

    Args:
        base: Task of the experiment as stated.
        theta: (p,) new guesses [theta-unit]; None keeps the stated ones.
        estimate: Estimate from the recordings so far, or None.
    """
    experiment, p = base.experiment, base.parameters
    index_of = {name: j for j, name in enumerate(p.names)}
    tables: dict[str, dict[str, Any]] = {}

    for name, spec in experiment.parameters.items():
        table = spec.model_dump(exclude_unset=True)
        table.pop("true", None)
        if spec.inertial is None:
            tables[name] = {**table, **_restated_keys(base, index_of[name], theta, estimate)}
            continue

        # A declared inertia is either kept, or replaced by its individual parameters.
        # The recordings have to determine all of them, each more accurately than its size.
        members = [j for j, parameter in enumerate(p.parameters) if parameter.group == name]
        if (
            theta is None
            or estimate is None
            or not (np.diag(estimate.data)[members] * p.magnitude[members] ** 2 > 1.0).all()
        ):
            tables[name] = table
            continue
        for j in members:
            parameter = p.parameters[j]
            member: dict[str, Any] = {
                "target": parameter.targets[0].path,
                "unit": parameter.unit,
                "nuisance": parameter.nuisance,
            }
            if parameter.prior is not None:
                member["prior"] = parameter.prior
            tables[p.names[j]] = {**member, **_restated_keys(base, j, theta, estimate)}

    values = experiment.model_dump(exclude_unset=True)
    values["parameters"] = tables
    values["cost"] = {**values.get("cost", {}), "linearize_at": "guess"}
    return experiment.restated(values)


def _restated_keys(
    base: DesignTask, index: int, theta: Array | None, estimate: Estimate | None
) -> dict[str, Any]:
    """Keys that a redesign changes in the table of a parameter.

    These are the guess, the scale and, with `[robust]`, the bounds.
    """
    parameter = base.parameters.parameters[index]
    size = float(base.parameters.magnitude[index])
    if theta is None:
        return {"guess": parameter.guess, "scale": parameter.scale}

    low, high = parameter.bounds
    gap = min(BOUND_GAP * size, MAX_BOUND_GAP * (high - low))
    guess = float(np.clip(theta[index], low + gap, high - gap))
    keys: dict[str, Any] = {"guess": guess, "scale": parameter.scale}

    # Robust designs sample parameters that have a prior or bounds.
    is_bounded = bool(np.isfinite(parameter.bounds).all())
    is_sampled = base.experiment.robust is not None and (parameter.prior is not None or is_bounded)
    if is_sampled and estimate is not None and np.isfinite(estimate.std[index]):
        reach = max(SAMPLING_RANGE * float(estimate.std[index]), MIN_SAMPLING_RANGE * size)
        keys["bounds"] = (max(low, guess - reach), min(high, guess + reach))
    return keys

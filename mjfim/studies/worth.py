"""`mjfim.worth`: which sensor, which data and which limit would make an experiment more accurate.

What sensors tell follows from one linearisation of the motion, also for sensors that the model
lacks. The prices of limits are multipliers of the design; within a given time each is checked by a
new design that begins at the present one.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import replace
from itertools import starmap
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, unknown
from mjfim.excitation.evaluation import designable, identifiability_along, require_evaluated
from mjfim.excitation.search.descent import Barrier, Ground
from mjfim.excitation.search.interior_problem import DIVERGED_POINT
from mjfim.excitation.search.levels import DescentLevel
from mjfim.excitation.sensors import sensing_along
from mjfim.excitation.task import DesignTask
from mjfim.experiment.arguments import checked
from mjfim.experiment.controls import require_design_keys
from mjfim.experiment.given import check_fits
from mjfim.experiment.schema import Experiment, ExperimentLike, experiment_of
from mjfim.experiment.system import System
from mjfim.model.coordinates import ScalarJoint
from mjfim.model.loading import ModelSource
from mjfim.parallel import one_blas_thread
from mjfim.parallel.budget import Budget, StopToken, stop_on_interrupt
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from mjfim.records.design import Design
from mjfim.records.events import begin_stage, shown_progress
from mjfim.records.worth import PRICED_SHARE, Price, Worth

# Sensors that can be added at a place of the model, by their words.
AT_SITES = {
    "accelerometer": mujoco.mjtSensor.mjSENS_ACCELEROMETER,
    "gyro": mujoco.mjtSensor.mjSENS_GYRO,
    "force": mujoco.mjtSensor.mjSENS_FORCE,
    "moment": mujoco.mjtSensor.mjSENS_TORQUE,
}

# Sensors that can be added at a joint. MuJoCo has none of its acceleration, which follows from the
# velocities of two samples.
AT_JOINTS = ("torque", "acceleration")

# Barrier of a new design, which begins near its optimum and has one stage. The stage ends at this
# slope of the merit, relative to the weight.
BARRIER = Barrier(first=1e-3, last=1e-3)
SETTLED = 1e-3


@checked
def worth(
    experiment: ExperimentLike,
    design: Design | None = None,
    *,
    add: Mapping[str, float] | None = None,
    seconds: float = 0.0,
    threads: int | None = None,
    stop: StopToken | None = None,
    progress: bool = True,
) -> Worth:
    """Find out what would make an experiment more accurate.

    Args:
        experiment: The experiment.
        design: A design of it; None for the initial control, for which limits have no price.
        add: Standard deviations of the noise of sensors that the model lacks [SI unit], by
            `torque` and `acceleration` (all joints) or `torque:<joint>`, and by `gyro:<place>`,
            `accelerometer:<place>`, `force:<place>` and `moment:<place>` at a site or body.
        seconds: Time in which new designs check the prices of the limits [s].
        threads: Threads of MuJoCo; None for all cores.
        stop: Ends the new designs early, as Ctrl-C does.
        progress: False for no sign of progress in a notebook.

    Raises:
        ExperimentError: A sensor or its place is unknown.
        SimulationDivergedError: The motion cannot be simulated.
    """
    with stop_on_interrupt(stop) as token, shown_progress("comparing", None, progress):
        budget = Budget(seconds=seconds, stop=token)
        return _worth(experiment_of(experiment), design, dict(add or {}), threads, budget)


@one_blas_thread()
def _worth(
    experiment: Experiment,
    design: Design | None,
    add: Mapping[str, float],
    threads: int | None,
    budget: Budget,
) -> Worth:
    """See `worth`; the budget is for new designs."""
    if design is not None and experiment.limits.reserve == "auto":
        experiment = experiment.replace(limits={"reserve": design.reserve})
    system = System.resolve(experiment, threads=threads)
    require_design_keys(system)

    begin_stage("simulating the motion and its sensitivities")
    measured, names = _with_sensors(system, add)
    task = DesignTask.of(measured)
    trajectory, source = task.initial, "the initial control"
    if design is not None:
        check_fits("the design", design.trajectory, system)
        task = task.released_as(design.trajectory.state[0])
        trajectory = task.plant.simulate(task.theta, design.trajectory.ctrl)
        source = "the design"
    point = task.problem.point(trajectory, CENTRAL_DIFFERENCES)
    require_evaluated(task, point)
    accelerations = {
        joint: sigma
        for key, sigma in add.items()
        if key.startswith("acceleration")
        for joint in _at_joints(system, key)
    }
    identifiability = identifiability_along(task, point)
    sensing = sensing_along(task, point, identifiability, names, accelerations)
    found = sensing.worth(source, task.horizon)
    if design is None or design.worth is None:
        return found

    prices = design.worth.prices
    stated = DesignTask.of(system)
    if budget.exhausted is None and stated.is_limited and stated.release is None:
        prices = tuple(_checked_prices(stated, design.trajectory.ctrl, prices, budget))
    return replace(found, prices=prices)


# ---- sensors that the model lacks


def _at_joints(system: System, key: str) -> list[ScalarJoint]:
    """The joints that a key of added sensors names: one of them, or all that have such a sensor."""
    kind, _, place = key.partition(":")
    by_name = {joint.name: joint for joint in system.coordinates}
    if place and place not in by_name:
        raise ExperimentError(f"add: {unknown('joint', place, list(by_name))}")
    if place:
        return [by_name[place]]
    if kind == "acceleration":
        return list(by_name.values())
    model = system.model
    at_joint = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    driven = set(model.actuator_trnid[at_joint, 0].tolist())
    return [joint for joint in by_name.values() if joint.joint in driven]


def _with_sensors(system: System, add: Mapping[str, float]) -> tuple[System, list[str]]:
    """The system with sensors that its model lacks, and their names; without accelerations."""
    for key in add:
        if key.partition(":")[0] not in (*AT_JOINTS, *AT_SITES):
            raise ExperimentError(f"add: {unknown('sensor', key, [*AT_JOINTS, *AT_SITES])}")
    stated = system.source.stated
    spec = stated.spec.copy()
    noise: dict[str, float] = {}
    for key, sigma in add.items():
        kind, _, place = key.partition(":")
        if kind in AT_SITES:
            name = f"{kind} of {place}"
            _add_at_site(spec, name, place, AT_SITES[kind])
            noise[name] = sigma
        if kind == "torque":
            for joint in _at_joints(system, key):
                name = f"torque of {joint.name}"
                spec.add_sensor(
                    name=name,
                    type=mujoco.mjtSensor.mjSENS_JOINTACTFRC,
                    objtype=mujoco.mjtObj.mjOBJ_JOINT,
                    objname=joint.name,
                )
                noise[name] = sigma
    if not noise:
        return system, []

    # The noise that the MJCF states counts only where the experiment states none.
    experiment = system.experiment
    sensors = stated.coordinates.sensors
    known = {each.groups[0]: each.sigma for each in sensors if each.sigma > 0.0}
    own = dict(experiment.noise) or ({} if experiment.correlated else known)
    source = ModelSource(stated.path, spec, stated.files)
    source.contents = stated.contents
    measured = experiment.replace(noise={**own, **noise})
    return System.resolve(measured, threads=system.threads, source=source), list(noise)


def _add_at_site(spec: Any, name: str, place: str, kind: mujoco.mjtSensor) -> None:
    """Add a sensor to a spec, at a site or at the origin of a body."""
    sites = [site.name for site in spec.sites]
    bodies = [body.name for body in spec.bodies[1:]]
    if place not in (*sites, *bodies):
        raise ExperimentError(f"add: {unknown('site or body', place, [*sites, *bodies])}")
    if place not in sites:
        spec.body(place).add_site(name=name)
    site = place if place in sites else name
    spec.add_sensor(name=name, type=kind, objtype=mujoco.mjtObj.mjOBJ_SITE, objname=site)


# ---- prices


def _checked_prices(
    task: DesignTask, control: Array, predicted: Sequence[Price], budget: Budget
) -> Iterator[Price]:
    """Prices with the results of new designs, as many as there is time for.

    Args:
        task: The task, which has limits.
        control: (N, nu) control of the design [u-unit].
        predicted: Prices by multipliers.
        budget: Time of all new designs.

    Yields:
        The prices; that of time and that of the end follow those of limits.
    """
    relaxed, basis = task.relaxed(), designable(task).basis
    limits = {limit.title: limit for limit in task.limits}
    present, exponents = _redesigned(relaxed, basis, control, budget.share(1 / (len(limits) + 3)))
    if exponents:
        predicted = tuple(starmap(Price.of_limit, exponents.items()))

    changed = []
    for price in sorted(predicted, key=lambda price: price.change):
        if price.name not in limits:
            continue
        wide = limits[price.name].widened(PRICED_SHARE)
        others = [limit for limit in task.limits if limit.title != price.name]
        changed.append((price, replace(relaxed, limits=(*others, wide)), control))

    # A longer motion begins as a motion that holds its last control.
    samples = max(round((1.0 + PRICED_SHARE) * task.samples), task.samples + 1)
    longer = control[np.minimum(np.arange(samples), task.samples - 1)]
    time = Price(name="time", step=f"{(samples - task.samples) * task.dt:.3g} s more")
    changed.append((time, relaxed.with_horizon(samples * task.dt, longer), longer))
    if task.experiment.boundary.end != "free":
        free = task.restated(task.experiment.replace(boundary={"end": "free"}))
        changed.append((Price(name="end state", step="left free"), free.relaxed(), control))

    for place, (price, other, begin) in enumerate(changed):
        if budget.stop.requested:
            yield price
            continue
        begin_stage(f"designing with {price.name} {price.step}", place, len(changed))
        found, _ = _redesigned(other, basis, begin, budget.share(1 / (len(changed) - place)))
        yield replace(price, redesigned=float(np.exp(found - present)) - 1.0)


def _redesigned(
    task: DesignTask, basis: Array | None, control: Array, budget: Budget
) -> tuple[float, dict[str, float]]:
    """Design again from a control that is nearly optimal.

    Returns:
        Logarithm of the σ that the criterion minimises, NaN where the time was too short; and the
        exponents of the limits.
    """
    ground = Ground.of(DescentLevel(task, basis))
    begin = ground.begin(control, budget)
    problem = ground.problem(BARRIER, BARRIER.last, {})
    point = DIVERGED_POINT if begin is None else problem.point(begin)
    if point.values is None:
        return np.nan, {}
    iterations = task.experiment.descent.max_iterations
    for step in ground.stage(BARRIER, problem, point, ground.direction(), iterations, budget):
        if budget.exhausted is not None or step.iterate.slope <= SETTLED * BARRIER.last:
            break
    if budget.exhausted is not None:
        return np.nan, {}
    point = step.iterate.point
    # At the minimum, errors of the motion change the sum of merit and barrier least.
    return 0.5 * problem.value(point), problem.prices(point, task.controls)

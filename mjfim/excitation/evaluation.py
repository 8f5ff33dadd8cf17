"""Evaluation of controls and designs.

A trajectory is evaluated for its information and its cost. What the initial control shows decides
whether a design can begin. The evaluation of a finished design gives its warnings and its record.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import (
    ExperimentError,
    SimulationDivergedError,
    UnidentifiableError,
    first_ones,
    listed,
)
from mjfim.excitation.limits.limits import unsupported_ranges
from mjfim.excitation.limits.verification import (
    SAME_STATE_TOLERANCE,
    Verification,
)
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.search.levels import DescentLevel, regulator_for
from mjfim.excitation.task import DesignTask
from mjfim.experiment.arguments import checked
from mjfim.experiment.controls import (
    require_design_keys,
    require_horizon_and_control,
    stated_inputs,
)
from mjfim.experiment.given import TrajectoryLike, check_fits
from mjfim.experiment.packing import named_file
from mjfim.experiment.schema import ExperimentLike
from mjfim.experiment.stated_units import probable_degrees
from mjfim.experiment.system import System, simulate_system
from mjfim.information.identifiability import PROBES, Identifiability
from mjfim.optimize.lq import largest_amplification, regulator
from mjfim.parallel import one_blas_thread
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from mjfim.records.check import GROUPS_TEXT, groups_in_words
from mjfim.records.design import Design, Evaluation
from mjfim.records.trajectory import Recording, Trajectory

# Growth of a disturbance along a trajectory without feedback above which the user is warned.
UNSTABLE_GROWTH = 1e3

# Size of the deviations that are simulated, relative to that of the states; deviations that are
# large at the end, likewise; and times from which deviations are simulated.
DEVIATION, LARGE_DEVIATION, BEGINS = 1e-5, 0.1, 4


# ---- points


def point_at_stated_rate(stage: DescentLevel, control: Array) -> DesignPoint | None:
    """Evaluate a control at the sample rate that the experiment states.

    Args:
        stage: The task and the criterion.
        control: (N, nu) control [u-unit].

    Returns:
        The point; None where the simulation diverges.
    """
    task = stage.task
    try:
        trajectory = task.plant.simulate(task.theta, control)
    except SimulationDivergedError:
        return None
    return stage.problem.point(trajectory)


def evaluate_point(stage: DescentLevel, point: DesignPoint) -> Evaluation:
    """Collect all results along a trajectory, with the regulator about it.

    Args:
        stage: The task and the criterion.
        point: The trajectory with its information and its cost.

    Raises:
        SimulationDivergedError: The trajectory diverges.
    """
    task, information = stage.task, stage.problem.information
    if (
        point.trajectory is None
        or point.sensitivity is None
        or point.information is None
        or point.criterion is None
    ):
        raise SimulationDivergedError("the trajectory diverges")

    gain, growth = regulation_along(task, point.trajectory)
    return Evaluation(
        trajectory=point.trajectory,
        gain=gain,
        sensitivity=point.sensitivity.psi,
        information=point.information,
        eigenvalues=point.criterion.eigenvalues,
        std=information.std(point.information),
        std_over_time=information.accumulated_std(point.sensitivity),
        criterion=point.criterion.value,
        cost=point.cost,
        growth=growth,
    )


# ---- growth of disturbances


def growth_along(task: DesignTask, trajectory: Trajectory) -> float:
    """Largest open-loop amplification of a small deviation along a trajectory."""
    A = task.plant.derivatives.jacobians(task.theta, trajectory)[0]
    return _growth(task, trajectory, A)


def regulation_along(task: DesignTask, trajectory: Trajectory) -> tuple[Array, float]:
    """Gains (N, nu, nx) about a trajectory, and the open-loop growth of a small deviation."""
    A, B, _, _ = task.plant.derivatives.jacobians(task.theta, trajectory)
    weights = regulator_for(task)
    gain = regulator(A, B, weights.Q, weights.R, weights.terminal)
    return gain, _growth(task, trajectory, A)


def _growth(task: DesignTask, trajectory: Trajectory, A: Array) -> float:
    """Largest open-loop amplification by transition matrices (N, nx, nx), where motions confirm it.

    Products of derivatives at a contact with friction may grow although deviations do not.
    """
    plant, sizes = task.plant, task.sizes[: task.space.nx]
    growth = largest_amplification(A, sizes)
    if not growth > UNSTABLE_GROWTH:
        return growth
    model, steps = plant.model(task.theta), DEVIATION * np.diag(sizes)
    steps, largest = np.concatenate([steps, -steps]), DEVIATION
    count = len(trajectory.ctrl)
    for first in range(0, count, -(-count // BEGINS)):
        states, ctrl = trajectory.state[first:], trajectory.ctrl[first:]
        starts = task.space.plus(np.repeat(states[:1], len(steps), axis=0), steps)
        found = plant.simulator.rollout([model], starts, np.repeat(ctrl[None], len(steps), axis=0))
        moved = task.space.minus(found.states, states) / sizes
        largest = max(largest, float(np.linalg.norm(moved, axis=2).max()))
        if not (found.finite.all() and largest < LARGE_DEVIATION):
            return growth
    return largest / DEVIATION


def growth_warning(growth: float) -> str | None:
    """Warning about strong growth of small disturbances; None where the growth is not strong."""
    if not growth > UNSTABLE_GROWTH:
        return None

    return (
        f"a small disturbance grows up to {growth:.1e}-fold along this trajectory when its control "
        "is played open loop; the predicted σ assumes that there is no disturbance"
    )


# ---- a given control


@checked
def simulate(
    experiment: ExperimentLike,
    trajectory: TrajectoryLike | Array | None = None,
    seed: int | np.random.Generator = 0,
    *,
    threads: int | None = None,
) -> Recording:
    """Simulate a recording at the `true` parameter values.

    The trajectory's control is applied open loop, and noise is added to the measured samples. The
    motion begins at the initial state of the experiment. Where a design chooses the release, it
    begins at the first state of the trajectory.

    Args:
        experiment: The experiment, or the path of its file.
        trajectory: The trajectory or design whose control is applied, or (N, nu) controls. With
            control laws, these are the columns of a log that the laws read. Default: the initial
            motion of the experiment.
        seed: Seed of the noise, or a generator of random numbers.
        threads: Threads for the engine; default: one per core.

    Returns:
        The recording; outputs that are not measured at a sample are NaN.

    Raises:
        ExperimentError: Something is wrong in the experiment, or the controls have a wrong shape.
        SimulationDivergedError: The simulation diverges under this control.
    """
    system = System.resolve(experiment, threads=threads)
    if not (trajectory is None or isinstance(trajectory, (Trajectory, Design))):
        inputs = np.asarray(trajectory, dtype=np.float64)
        if inputs.ndim != 2 or inputs.shape[1] != len(system.inputs):
            raise ExperimentError(
                f"{system.experiment.source}: simulate: controls of shape {inputs.shape}; expected "
                f"a row for each sample with {len(system.inputs)} columns: {listed(system.inputs)}"
            )
        at_rest = np.tile(system.nominal_initial_state, (len(inputs) + 1, 1))
        trajectory = system.plant.trajectory(at_rest, inputs)
    motion = motion_of(system, trajectory, "simulate without a design")
    return simulate_system(system, motion, seed)


def motion_of(system: System, given: TrajectoryLike | None, work: str) -> Trajectory:
    """The trajectory of a motion; without one, the initial motion of the experiment.

    Args:
        system: The system.
        given: The motion, or None.
        work: Name of the work that needs it, for messages.

    Raises:
        ExperimentError: The experiment states no initial motion.
        RecordingError: The motion was made for another model or another rate.
    """
    if given is None:
        if system.laws is not None:
            require_horizon_and_control(system, work)
            with named_file(system.experiment):
                inputs = stated_inputs(system)
            return system.plant.simulate(system.theta, inputs)
        require_design_keys(system, work)
        return DesignTask.of(system).initial
    found = given.trajectory if isinstance(given, Design) else given
    check_fits("the motion", found, system)
    return found


@checked
def evaluate(
    experiment: ExperimentLike,
    trajectory: TrajectoryLike | None = None,
    *,
    threads: int | None = None,
) -> Evaluation:
    """Evaluate the information and the cost along the control of a given trajectory.

    The control is simulated at the experiment's theta.

    Args:
        experiment: The experiment.
        trajectory: The trajectory or design whose control is simulated; default: the initial
            motion.
        threads: Threads for the engine; default: one per core.

    Returns:
        The information, the standard deviations and the cost along the simulated trajectory.

    Raises:
        ExperimentError: Something is wrong or missing in the experiment; the message names the key.
        ModelError: The model cannot be used.
        SimulationDivergedError: The simulation diverges under this control.
    """
    task = DesignTask.resolve(experiment, threads=threads)
    return evaluate_task(task, motion_of(task.system, trajectory, "evaluate"))


@one_blas_thread()
def evaluate_task(task: DesignTask, trajectory: Trajectory) -> Evaluation:
    """Evaluate the control of a trajectory in a resolved task. See `evaluate`."""
    return _evaluate_control(task.released_as(trajectory.state[0]), trajectory.ctrl)


def criterion_of(task: DesignTask, control: Array) -> float:
    """Compute the criterion phi along a control.

    Args:
        task: The task.
        control: (N, nu) control [u-unit].

    Returns:
        The criterion, finite and positive.

    Raises:
        ValueError: The control does not fit the task.
        MjfimError: The criterion is not finite and positive, or cannot be computed.
    """
    if control.shape != task.control.shape:
        raise ValueError(f"a control of shape {control.shape} instead of {task.control.shape}")

    value = _evaluate_control(task, control).criterion
    if not (np.isfinite(value) and value > 0.0):
        raise SimulationDivergedError(
            f"the criterion of this control is {value}; it must be finite and positive"
        )
    return value


def _evaluate_control(task: DesignTask, control: Array) -> Evaluation:
    """Evaluate a control: (N, nu), in a resolved task."""
    simulated = task.plant.simulate(task.theta, control)
    point = task.problem.point(simulated, CENTRAL_DIFFERENCES)
    if point.trajectory is None or point.sensitivity is None:
        raise SimulationDivergedError("the trajectory diverges when the parameters change slightly")

    identifiability = task.identifiability_test.along(point.trajectory, point.sensitivity)
    stage = DescentLevel(task, identifiability.basis)
    return evaluate_point(stage, stage.problem.reevaluated(point))


# ---- warnings about a design


def design_warnings(
    final: Evaluation,
    found: Verification,
    task: DesignTask,
    clamped: tuple[str, ...],
) -> Iterator[str]:
    """Make the warnings that a user has to know before running a design.

    Args:
        final: Evaluation of the design.
        found: Its limits at every engine step of the unmodified model.
        task: The task of the design.
        clamped: Names of the actuators that reach their forcerange along it.

    Yields:
        Warnings, each a sentence.
    """
    if clamped:
        yield (
            f"forcerange clamps {listed(clamped)} along the design: its derivatives do not hold "
            "there, it may rest on spurious information caused by the saturation, and the descent "
            "may have stopped early; raise cost.control or begin with a smaller initial control"
        )
    unstable = growth_warning(final.growth)
    if unstable is not None:
        yield unstable
    for kind, margin in found.margins.items():
        if not margin < 0.0:
            continue
        advice = "widen them, begin with a smaller initial control, or give the design more time"
        if kind in found.unenforced:
            advice = (
                "they are checked, not enforced; raise cost.control or cost.tracking until they "
                "hold before running this on hardware"
            )
        where = ""
        if kind in found.by_stated_solver:
            where = " with the solver settings of the MJCF (tolerance, iterations, warm start) only"
        yield f"{kind} limits are exceeded by {-margin:.3g}{where}: {advice}"
    yield from open_boundary_warnings(task)
    if found.deviation > SAME_STATE_TOLERANCE:
        yield (
            f"played on the unmodified model, the design deviates by up to {found.deviation:.2g} "
            "of the size of its states: a clamp, stop or contact acts"
        )


def open_boundary_warnings(task: DesignTask) -> Iterator[str]:
    """Make the warnings about motions that the stated limits and boundaries allow.

    Args:
        task: The task.

    Yields:
        Warnings, each a sentence.
    """
    experiment = task.experiment
    enforced = task.limits if experiment.limits.enforce else ()
    with_rate = {limit.name for limit in enforced if limit.kind == "control_rate"}

    at_rest = "rest" in (experiment.boundary.start, experiment.boundary.end)
    may_jump = experiment.limits.bandwidth is None and not with_rate.issuperset(task.controls)
    if at_rest and may_jump:
        yield (
            "the control may jump where the design begins or ends at rest: for a smooth control "
            "state limits.control_rate or limits.bandwidth"
        )

    if experiment.limits.enforce:
        unsupported = unsupported_ranges(task.system.model)
        if unsupported:
            yield (
                f"the MJCF's ranges of {listed(unsupported)} are not among the limits of the "
                "design: it may run into them"
            )
    yield from probable_degrees(experiment, task.system.source)


# ---- whether a design can begin


def identifiability_along(task: DesignTask, begin: DesignPoint) -> Identifiability:
    """Find the combinations of parameters that can be identified.

    They are looked for along the control with which the search begins and along random controls.
    """
    require_evaluated(task, begin)
    assert begin.trajectory is not None and begin.sensitivity is not None
    return task.identifiability_test.along(begin.trajectory, begin.sensitivity)


def require_evaluated(task: DesignTask, begin: DesignPoint) -> None:
    """Raise SimulationDivergedError where the control with which a search begins diverges."""
    values = (begin.information, begin.trajectory, begin.sensitivity)
    if all(value is not None for value in values):
        return

    reason = "when the parameters change slightly along the initial control"
    if task.samples_of_parameters is not None:
        reason += (
            ", or at a parameter sample of [robust]; state bounds within which the model is valid"
        )
    raise SimulationDivergedError(f"the simulation diverges {reason}")


def designable(task: DesignTask) -> Identifiability:
    """Find what can be identified, and require that a design can begin at the initial control.

    Args:
        task: The task.

    Returns:
        The combinations that are identifiable along the initial control and along random ones.

    Raises:
        UnidentifiableError: A parameter has no effect, or the initial control does not excite it.
        SimulationDivergedError: The simulation diverges along the initial control.
    """
    first = task.problem.point(task.initial, CENTRAL_DIFFERENCES)
    identifiability = identifiability_along(task, first)
    require_designable(task, identifiability)
    return identifiability


def _without_effect(silent: Sequence[str], tried: str) -> UnidentifiableError:
    """The error of parameters without any effect along the motions that were tried."""
    quoted = listed([f"parameters.{name}" for name in silent])
    is_one = len(silent) == 1
    return UnidentifiableError(
        f"{quoted} {'changes' if is_one else 'change'} nothing in the measured "
        f"outputs, neither along the initial {tried} nor along {PROBES} random {tried}s; "
        f"remove {'it' if is_one else 'them'}, or measure a quantity that shows the effect"
    )


def require_designable(task: DesignTask, identifiability: Identifiability) -> None:
    """Require that every parameter has an effect, and that the initial control excites it.

    The initial control has to excite every combination of parameters that a random control
    excites. Single parameters of an inertia that `inertial` states may have no effect. The design
    then works on the combinations that have one.

    Args:
        task: The task.
        identifiability: The combinations that can be identified.

    Raises:
        UnidentifiableError: A parameter has no effect on the outputs, or the initial control does
            not excite it.
    """
    along_all = identifiability.along_all
    parameters = task.parameters
    estimated = [parameters.parameters[j] for j in parameters.interest]

    silent = [estimated[i].name for i in along_all.silent if not estimated[i].group]
    if silent:
        raise _without_effect(silent, "control" if task.release is None else "release")

    # A criterion that asks for combinations that cannot be identified.
    if task.contrast is not None:
        information = replace(task.information, basis=identifiability.basis)
        if not information.is_estimable(task.contrast).all():
            raise UnidentifiableError(
                "cost.combination or cost.subset states a combination that cannot be identified; "
                "identifiable are: " + groups_in_words(identifiability.groups_along_all)
            )

    if not along_all.basis.shape[1]:
        raise UnidentifiableError("no parameter has an effect on the measured outputs")

    # Combinations that random controls excite, but the initial one does not. A search over all
    # releases does not begin at the initial one.
    if task.release is not None:
        return
    if identifiability.along_trajectory.count > along_all.count:
        groups = identifiability.groups_along_trajectory
        names = [group.short if group.combinations else group.short_names for group in groups]
        unexcited = first_ones(names, "; ", GROUPS_TEXT)
        raise UnidentifiableError(
            f"the initial control does not excite: {unexcited}. Other controls do: begin with one "
            "that moves the joints of these parameters, for example a multisine"
        )

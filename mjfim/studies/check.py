"""`mjfim.check`: the parameters that an experiment or recordings can identify, and how accurately.

It needs no fit. A self-test compares three numbers along one trajectory: dy/dtheta by two
difference steps, psi by rollouts against its linear recursion, and the slope of the cost against
differences of the cost through the projection operator.
"""

from __future__ import annotations

from bisect import bisect_left
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import replace
from functools import partial
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import MjfimError, RecordingError, SimulationDivergedError
from mjfim.excitation.evaluation import (
    growth_warning,
    motion_of,
    regulation_along,
    require_designable,
    require_evaluated,
)
from mjfim.excitation.initial_controls import initial_controls_of
from mjfim.excitation.limits.limits import ReleaseSpace
from mjfim.excitation.limits.verification import all_violations_of, require_feasible_start
from mjfim.excitation.objective import DesignPoint, DesignProblem
from mjfim.excitation.rehearsal import rehearsed, steps_along
from mjfim.excitation.search.levels import regulator_for, require_coarse_factor
from mjfim.excitation.sensors import sensing_along
from mjfim.excitation.task import (
    LEAST_PROBE_AMPLITUDE,
    MOST_PROBE_AMPLITUDE,
    RANDOM_HARMONICS,
    DesignTask,
)
from mjfim.experiment.arguments import checked
from mjfim.experiment.controls import require_design_keys
from mjfim.experiment.given import RecordingsLike, TrajectoryLike, recordings_of
from mjfim.experiment.initial import multisine
from mjfim.experiment.schema import ExperimentLike
from mjfim.experiment.stated_units import probable_degrees
from mjfim.experiment.system import System, SystemOrder, order_of
from mjfim.identification.fit_problem import FitProblem, sensitivity_rows
from mjfim.identification.fit_workers import FitWorkers
from mjfim.identification.search import refuse_same_data
from mjfim.identification.segments import recorded_release
from mjfim.information.criteria import shared
from mjfim.information.finite_steps import valley, visible_columns
from mjfim.information.fisher import FisherInformation
from mjfim.information.identifiability import Identifiability, IdentifiabilityTest, RowsAndError
from mjfim.model.control_laws import ControlLaws
from mjfim.optimize.directions import LBFGS
from mjfim.optimize.lq import LinearRecursion, TangentCurve
from mjfim.parallel import ExecutorLike, one_blas_thread, results_on
from mjfim.parallel.budget import Budget, StopToken, stop_on_interrupt
from mjfim.plant.active_constraints import first_active_constraint
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from mjfim.records.check import (
    Check,
    ParameterCheck,
    SelfTest,
    findings_of_check,
)
from mjfim.records.design import LimitViolation
from mjfim.records.events import begin_stage, shown_progress
from mjfim.records.trajectory import Recording, Sensitivity, Trajectory
from mjfim.records.worth import DEFAULT_RELATIVE_STD

# Steps along the tested curve, in units of the plant's difference steps. The smaller error of the
# two counts.
SLOPE_STEPS = (1e-3, 1e-4)

# Smallest slope by which an error is divided; it prevents a division by zero.
LEAST_SLOPE = 1e-300


def self_test(
    task: DesignTask,
    problem: DesignProblem,
    point: DesignPoint,
    stop: Callable[[], bool],
) -> SelfTest:
    """Test the derivatives about one trajectory.

    Args:
        task: Task whose model is tested.
        problem: Cost whose slope is tested.
        point: Trajectory with the cost there, computed with central differences.
        stop: Asked before each of the two tests; true leaves out the rest of them.

    Raises:
        SimulationDivergedError: The trajectory diverges when the parameters change a little.
    """
    trajectory = point.trajectory
    sensitivity = point.sensitivity
    if trajectory is None or sensitivity is None:
        raise SimulationDivergedError("the trajectory diverges when the parameters change a little")

    tests = {
        "recursion": partial(recursion_error, task, trajectory, sensitivity),
        "slope": partial(slope_error, task, problem, point),
    }
    tested = SelfTest(recursion=np.nan, slope=np.nan, finished=False)
    for number, (name, error) in enumerate(tests.items()):
        if stop():
            return tested
        begin_stage(f"testing the derivatives: {name}", number, len(tests))
        # A state does not show what control laws remember: there is no recursion and no slope.
        found: dict[str, Any] = {name: error() if task.plant.laws is None else 0.0}
        tested = replace(tested, **found)
    tested = replace(tested, finished=True)

    # Where contacts, dry friction or limits act, derivatives differ from differences.
    if tested.passed:
        return tested
    active = first_active_constraint(task.system.model_at(task.theta), trajectory)
    return tested if active is None else replace(tested, acting=active[1])


def recursion_error(task: DesignTask, trajectory: Trajectory, sensitivity: Sensitivity) -> float:
    """Compare psi by rollouts with psi by the recursion `psi_{k+1} = A_k psi_k + E_k`.

    Args:
        task: Task whose model is tested.
        trajectory: Trajectory of N samples.
        sensitivity: psi: (N+1, nx, p) [x-unit / theta-unit] and G: (N+1, ny, p) along it, by
            rollouts.

    Returns:
        Largest difference, relative to the largest entry of each parameter's psi; infinite where
        the motion diverges.
    """
    try:
        linear = task.plant.derivatives.linearize(task.theta, trajectory)
    except SimulationDivergedError:
        return np.inf

    psi = sensitivity.psi
    recursion = LinearRecursion(linear.A)
    columns = [recursion.forward(psi[0, :, j], linear.E[..., j]) for j in range(psi.shape[2])]
    expected = np.stack(columns, axis=2)

    # The psi of a parameter without measurable effect is round-off, which does not test the
    # recursion.
    size = np.abs(psi).max(axis=(0, 1))
    whitened = task.system.noise.whiten(sensitivity.G)
    visible = (size > 0.0) & visible_columns(task.parameters, whitened)
    if not visible.any():
        return 0.0

    return float((np.abs(expected - psi).max(axis=(0, 1))[visible] / size[visible]).max())


def slope_error(task: DesignTask, problem: DesignProblem, point: DesignPoint) -> float:
    """Compare the slope `DJ . zeta` of the cost with differences of the cost.

    zeta is the first descent direction; the central differences are those of `J(P(xi + gamma
    zeta))`.

    Args:
        task: Task whose model is tested.
        problem: Cost whose slope is tested.
        point: Trajectory with the cost there.

    Returns:
        Relative error; NaN where the cost is infinite, infinite where a moved trajectory diverges,
        or where the motion is too unstable for a direction. It is 0 for a model without actuators,
        whose cost has no slope along a control.
    """
    if not np.isfinite(point.cost) or point.trajectory is None:
        return float("nan")
    if not task.controls:
        return 0.0

    expansion = problem.expand(point)
    # Without a weight on every control, the direction would divide by zero.
    weights, metric = task.control_weight, regulator_for(task).R
    if (weights > 0.0).all():
        metric = np.diag(weights) * task.dt
    try:
        K = regulator_for(task).gain(expansion)
        zeta = LBFGS(metric)(expansion, K)
    except np.linalg.LinAlgError:
        return np.inf

    # Scale the curve so that its largest entry is one difference step of the plant.
    sizes = task.plant.derivatives.difference_sizes(point.trajectory)
    nx = zeta.z.shape[1]
    largest = max(np.abs(zeta.z / sizes[:nx]).max(), np.abs(zeta.v / sizes[nx:]).max())
    if largest == 0.0:
        return 0.0

    unit = TangentCurve(z=zeta.z / largest, v=zeta.v / largest)
    expected = expansion.slope(unit)
    errors = []
    for step in SLOPE_STEPS:
        sides = [problem.value(problem.project(point, unit, s, K)) for s in (step, -step)]
        if np.isfinite(sides).all():
            measured = (sides[0] - sides[1]) / (2.0 * step)
            errors.append(abs(measured - expected) / max(abs(expected), LEAST_SLOPE))
    return float(min(errors, default=np.inf))


# Columns of a log that are no signals, but say which law acts.
SWITCHES = ("gain:", "enable:")


def _state_slopes(laws: ControlLaws, inputs: Array, dt: float) -> None:
    """Set velocities of references, among inputs (N, w) that the caller owns, to their slopes."""
    for law in laws.laws:
        if "reference_velocity" in law.columns:
            reference = inputs[:, law.columns["reference"]]
            inputs[:, law.columns["reference_velocity"]] = np.gradient(reference, dt)


def random_references(task: DesignTask, count: int) -> Iterator[Trajectory]:
    """Simulate closed loops under random multisines in place of the inputs of a log.

    They are up to twice as large as the inputs, about their means. Factors of gains and the columns
    that switch laws on stay as they are; velocities of references are the slopes of the references.

    Args:
        task: The task along a recording, with control laws.
        count: Number of motions.

    Yields:
        Motions; those that diverge are left out.
    """
    laws = task.system.laws
    assert laws is not None
    rng = np.random.default_rng(task.experiment.descent.seed)
    logged = task.initial.ctrl
    mean = logged.mean(axis=0)
    peak = np.abs(logged - mean).max(axis=0)
    kept = [i for i, name in enumerate(laws.columns) if name.startswith(SWITCHES)]
    for _ in range(count):
        share = rng.uniform(LEAST_PROBE_AMPLITUDE, MOST_PROBE_AMPLITUDE)
        wave = multisine(task.t, logged.shape[1], 1.0 / task.horizon, RANDOM_HARMONICS, rng)
        inputs = mean + share * peak * wave
        inputs[:, kept] = logged[:, kept]
        _state_slopes(laws, inputs, task.dt)
        try:
            yield task.plant.simulate(task.theta, inputs)
        except SimulationDivergedError:
            continue


# Number of repetitions above which a target accuracy counts as unreachable.
MAX_REPETITIONS = 1_000_000_000

# Largest number of samples of a recording along which the derivatives are tested.
MAX_TESTED_SAMPLES = 2000


@checked
def check(
    experiment: ExperimentLike,
    recordings: RecordingsLike = (),
    trajectory: TrajectoryLike | None = None,
    *,
    threads: int | None = None,
    stop: StopToken | None = None,
    progress: bool = True,
    executor: ExecutorLike | None = None,
) -> Check:
    """Check which parameters can be identified, at the parameter values that a design uses.

    Without recordings and without a trajectory, the initial control of the experiment is checked.

    Args:
        experiment: Experiment to check.
        recordings: Recordings that are checked instead of the initial control.
        trajectory: Trajectory, of a design for example, whose control is checked instead.
        threads: Threads of MuJoCo; None for all cores.
        stop: Ends the check early, as Ctrl-C does; the record then says what is missing.
        progress: False for no sign of progress in a notebook.
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process. It
            differentiates recordings side by side, and random motions where these are needed.

    Raises:
        RecordingError: Recordings are unusable, or given together with a trajectory.
        SimulationDivergedError: The trajectory cannot be simulated.
    """
    with shown_progress("checking", None, progress):
        system = System.resolve(experiment, threads=threads)
        logs = recordings_of(system, recordings)
        if logs and trajectory is not None:
            raise RecordingError("check either recordings or a designed trajectory, not both")
        if logs:
            return check_recordings(system, logs, stop, executor)
        require_design_keys(system, "check without recordings")
        motion = None if trajectory is None else motion_of(system, trajectory, "check")
        return check_task(DesignTask.of(system), motion, stop, executor)


@one_blas_thread()
def check_task(
    task: DesignTask,
    trajectory: Trajectory | None = None,
    stop: StopToken | None = None,
    executor: ExecutorLike | None = None,
) -> Check:
    """Check the initial control of a task, or the control of a trajectory.

    Args:
        task: Task without priors from other recordings.
        trajectory: Trajectory whose control is checked; None for the initial control.
        stop: Ends the check early, as Ctrl-C does.
        executor: Where random motions are differentiated; None for this process.

    Raises:
        SimulationDivergedError: The trajectory cannot be simulated.
    """
    source = "the initial control" if task.controls else "the initial state"
    curve = task.initial
    if trajectory is not None:
        task = replace(task.released_as(trajectory.state[0]), release=task.release)
        curve, source = task.plant.simulate(task.theta, trajectory.ctrl), "the given trajectory"

    begin_stage("simulating the motion and its sensitivities")
    problem, point = _evaluate(task, curve)
    # A start that diverges is refused in the words of a design.
    if trajectory is None:
        require_evaluated(task, point)
    sensitivity, information = _known(point)

    # From here on, there is something to report when the check is stopped.
    with stop_on_interrupt(stop) as token:
        return _checked(
            task,
            problem,
            point,
            partial(_identifiability_test(task, executor, token).along, curve, sensitivity),
            _common_information(task, [information - task.information.prior]),
            token,
            source=source,
            duration=float(curve.t[-1]),
            is_start=trajectory is None,
            is_motion=True,
        )


@one_blas_thread()
def check_recordings(
    system: System,
    recordings: Sequence[Recording],
    stop: StopToken | None = None,
    executor: ExecutorLike | None = None,
) -> Check:
    """Check which parameters recordings identify; derivatives are tested along the longest one.

    Args:
        system: System to which the recordings belong.
        recordings: The recordings.
        stop: Ends the check early, as Ctrl-C does.
        executor: Where the recordings are differentiated; None for this process.

    Raises:
        RecordingError: Recordings are unusable.
        SimulationDivergedError: A recording cannot be simulated.
    """
    refuse_same_data(recordings, ())
    begin_stage("simulating the recordings")
    fit = FitProblem.of(system, recordings, data_only=True)
    if executor is not None:
        fit = replace(fit, workers=FitWorkers(executor))
    longest = max(fit.recordings, key=lambda recording: len(recording.ctrl))
    release, control = recorded_release(system, longest), longest.ctrl[:MAX_TESTED_SAMPLES]
    is_free = system.experiment.initial.free
    task = DesignTask.along(system.released(release) if is_free else system, control)
    if is_free:
        task = replace(task, release=ReleaseSpace.of(system, task.limits))
    problem, point = _evaluate(task, task.initial)
    _known(point)

    # Rows of G at the times of the measurements, and the error of their finite differences.
    fit = fit.with_noise(replace(fit.noise, covariance=task.system.noise.covariance))
    recorded = sensitivity_rows(fit, fit.begin(task.theta))
    J, error = (np.concatenate(part) for part in zip(*recorded, strict=True))
    count = len(recordings)
    # Segments of a recording have its parameters in common.
    of_each = np.zeros((count, len(task.theta), len(task.theta)))
    for segment, (rows, _) in zip(fit.segments, recorded, strict=True):
        of_each[segment.recording] += rows.T @ rows
    # From here on, there is something to report when the check is stopped.
    with stop_on_interrupt(stop) as token:
        return _checked(
            task,
            problem,
            point,
            partial(_identifiability_test(task, executor, token).of_rows, task.initial, J, error),
            _common_information(task, of_each),
            token,
            source=f"{count} recording{'s' if count > 1 else ''}",
            duration=float(sum(recording.t[-1] for recording in fit.recordings)),
            is_start=False,
        )


# ---- what is looked at


def _evaluate(task: DesignTask, curve: Trajectory) -> tuple[DesignProblem, DesignPoint]:
    """The cost of a task, evaluated along a trajectory."""
    running = replace(task.problem.running, desired_state=curve.state)
    problem = replace(task.problem, running=running)
    return problem, problem.point(curve, CENTRAL_DIFFERENCES)


def _known(point: DesignPoint) -> tuple[Sensitivity, Array]:
    """Sensitivities and information of a motion. Raises SimulationDivergedError without them."""
    if point.information is None or point.sensitivity is None:
        raise SimulationDivergedError("the simulation diverges when the parameters change a little")
    return point.sensitivity, point.information


def _identifiability_test(
    task: DesignTask, executor: ExecutorLike | None, stop: StopToken
) -> IdentifiabilityTest:
    """The test of a task; an executor differentiates its random motions."""
    test = task.identifiability_test
    if task.system.laws is not None:
        test = replace(test, probes=partial(random_references, task))
    if executor is None:
        return test

    def make(threads: int) -> Callable[[], IdentifiabilityTest]:
        """Return what makes the test in a worker."""
        return partial(_made_test, order_of(task.system, threads), test.theta, test.earlier)

    def differentiated(probes: Iterable[Trajectory]) -> Iterator[RowsAndError | None]:
        """Differentiate motions on the workers."""
        return results_on(test, make, _rows_along, list(probes), executor, Budget(stop=stop))

    return replace(test, differentiated=differentiated)


def _made_test(order: SystemOrder, theta: Array, earlier: Array) -> IdentifiabilityTest:
    """Make a test in a worker, which has no random motions of its own."""
    made = order()
    return IdentifiabilityTest(
        plant=made.plant,
        parameters=made.parameters,
        noise=made.noise,
        theta=theta,
        earlier=earlier,
        probes=lambda count: iter(()),
    )


def _rows_along(test: IdentifiabilityTest, probe: Trajectory, _: StopToken) -> RowsAndError | None:
    return test.rows_along(probe)


def _common_information(task: DesignTask, matrices: Iterable[Array]) -> Array:
    """(p, p) sum of information matrices about the parameters that all recordings share."""
    p = task.parameters
    every = [shared(each, p.prior_information, p.recording_specific) for each in matrices]
    return sum(every, np.zeros_like(task.prior))


# ---- what is found


def _checked(
    task: DesignTask,
    problem: DesignProblem,
    point: DesignPoint,
    test: Callable[[Callable[[], bool]], Identifiability],
    data: Array,
    stop: StopToken,
    *,
    source: str,
    duration: float,
    is_start: bool,
    is_motion: bool = False,
) -> Check:
    """The record for the user; what a request to stop leaves out is named in it.

    Args:
        task: The task.
        problem: Its cost about the motion along which derivatives are tested.
        point: This motion.
        test: Test of identifiability; it gets a function that says whether to stop.
        data: (p, p) information of the data alone.
        stop: Ends the check early.
        source: What is checked, in words.
        duration: Duration of the data [s].
        is_start: Whether it is the initial control, at which a design begins.
        is_motion: Whether it is one motion that a robot could play.
    """
    missing = []

    # Random controls are tried only where there is a doubt.
    begin_stage("testing which parameters can be told apart")
    found = test(lambda: stop.requested)
    here, everywhere = found.along_trajectory, found.along_all
    if here.count and stop.requested:
        missing.append("what other controls would show")
    # The slope is that of a criterion of the identifiable combinations.
    visible = replace(problem, information=replace(problem.information, basis=found.basis))
    tested = self_test(task, visible, visible.reevaluated(point), lambda: stop.requested)
    if not tested.finished:
        missing.append("the test of the derivatives")
    refused: tuple[str, ...] = ()
    violations: tuple[LimitViolation, ...] = ()
    # Without actuators there is no control that a design could begin with.
    if is_start and task.controls and task.release is None and not stop.requested:
        refused, violations = _refusals(task, found)

    # Standard deviations of the wanted parameters. They are infinite where a parameter cannot be
    # identified individually.
    basis = here.basis if here.count else None
    information = replace(task.information, prior=task.prior, basis=basis)
    total = data + task.prior
    covariance = information.covariance(total)
    spread = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(spread, spread)
    std = np.full(len(task.parameters), np.inf)
    std[task.parameters.interest] = np.nan_to_num(spread, nan=np.inf)

    # Along one motion, standard deviations are checked by finite steps, and two robots show what it
    # does not determine. Recordings are fitted in segments, which respond otherwise.
    steps, robots, motion, known = None, None, point.trajectory, point.information
    if is_motion and not stop.requested and motion is not None and known is not None:
        along = information.std(known)
        steps = steps_along(task, motion, known, along)
        odd = ~steps.confirmed
        std[odd] *= steps.std[odd] / along[odd]
        robots = valley(
            [(task.plant, motion)],
            task.system.noise,
            task.theta,
            information=known,
            prior=information.prior,
            std=std,
        )

    # A motion that a robot could play is rehearsed as that of a design is.
    rehearsal, warning = None, ""
    if steps is not None and known is not None and motion is not None and not refused:
        begin_stage("rehearsing the motion")
        gain, growth = regulation_along(task, motion)
        rehearsal = rehearsed(task, motion, gain, known, steps, growth)
        warning = growth_warning(growth) or ""

    # What each sensor tells along one motion.
    worth = None
    if steps is not None:
        worth = sensing_along(task, point, found).worth(source, duration)

    # Eigenvalues of the criterion, without combinations that no experiment can identify.
    criterion = replace(task.information, basis=found.basis)
    eigenvalues = criterion.evaluate(data + criterion.prior).eigenvalues
    # Groups that the checked data do not separate, although another control would.
    never = {str(group) for group in found.groups_along_all}
    groups = found.groups_along_trajectory if here.count > everywhere.count else ()
    not_excited = tuple(group for group in groups if str(group) not in never)
    values = task.theta[task.parameters.interest]

    check = Check(
        source=source,
        horizon=duration,
        rows=tuple(_rows(task, data, duration, information, std)),
        wanted=found.names,
        information=total,
        eigenvalues=np.maximum(eigenvalues, 0.0),
        correlation=correlation,
        not_separable=found.groups_along_all,
        not_excited=not_excited,
        self_test=tested,
        steps=steps,
        rehearsal=rehearsal,
        worth=worth,
        valley=robots,
        is_start=is_start,
        findings=(),
        inflation=task.inflation,
        combined=() if not_excited else found.combinations(information, values, total, total),
        missing=tuple(missing),
        refused=refused,
        violations=violations,
    )
    degrees = probable_degrees(task.experiment, task.system.source)
    warnings = [warning] if warning else []
    return replace(check, findings=(*warnings, *findings_of_check(check), *degrees))


def _refusals(
    task: DesignTask, identifiability: Identifiability
) -> tuple[tuple[str, ...], tuple[LimitViolation, ...]]:
    """Reasons of a design to refuse its initial control, and the limits that this violates."""
    refused: list[str] = []
    is_kept = True
    for require in (
        lambda: require_feasible_start(task),
        lambda: require_coarse_factor(task),
        lambda: initial_controls_of(task, None),
        lambda: require_designable(task, identifiability),
    ):
        try:
            require()
        except MjfimError as error:
            # A start that cannot be kept says all about the limits.
            is_kept = is_kept and bool(refused)
            refused.append(str(error))
    return tuple(refused), all_violations_of(task, task.initial) if is_kept else ()


def _rows(
    task: DesignTask, data: Array, duration: float, information: FisherInformation, std: Array
) -> Iterator[ParameterCheck]:
    """Predicted accuracy of every parameter; std: (p,) [theta-unit]."""
    p, theta = task.parameters, task.theta
    for j, (parameter, size) in enumerate(zip(p.parameters, p.sizes(theta).tolist(), strict=True)):
        wanted = parameter.wanted or DEFAULT_RELATIVE_STD * size
        repetitions = 0
        if not parameter.nuisance:
            repetitions = _repetitions(task, data, information, j, wanted / float(std[j]))
        yield ParameterCheck(
            name=parameter.name,
            unit=parameter.unit,
            value=float(theta[j]),
            nuisance=parameter.nuisance,
            size=size,
            std=float(std[j]),
            relative=float(std[j] / size),
            wanted=wanted,
            stated=parameter.wanted is not None,
            repetitions=repetitions,
            seconds=repetitions * duration,
            targets=tuple(target.path for target in parameter.targets),
        )


def _repetitions(
    task: DesignTask, data: Array, information: FisherInformation, parameter: int, share: float
) -> int:
    """Smallest number of repetitions that leave a share of the present σ; 0 for none."""
    place = np.flatnonzero(task.parameters.interest == parameter)[0]

    def variance(repetitions: int) -> float:
        return float(information.covariance(repetitions * data + task.prior)[place, place])

    present = variance(1)

    def suffices(repetitions: int) -> bool:
        return variance(repetitions) <= present * share**2

    if share >= 1.0:
        return 1
    found = bisect_left(range(MAX_REPETITIONS + 1), True, lo=2, key=suffices)
    return found if found <= MAX_REPETITIONS else 0

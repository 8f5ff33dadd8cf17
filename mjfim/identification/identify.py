"""Least-squares identification of parameters from recordings.

One search over all data begins at the best start that is known: the stated one, the first rows, the
equation of motion, or a subset of the data. Where its result does not explain the data, other
starts follow, and then other lengths of the segments. The best result is kept.
"""

from __future__ import annotations

import time
from collections import Counter
from collections.abc import Callable, Sequence
from dataclasses import replace
from pathlib import PurePath

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError, WrongLogError, listed
from mjfim.experiment.arguments import checked
from mjfim.experiment.given import Arrays, RecordingsLike, recordings_of
from mjfim.experiment.schema import ExperimentLike
from mjfim.experiment.system import System
from mjfim.identification.assessment.accuracy import FitResult
from mjfim.identification.assessment.report import estimate_from
from mjfim.identification.assessment.residual_tests import fit_quality, misfit_reasons
from mjfim.identification.fit_problem import FitProblem, have_same_initial_states, sensitivity_rows
from mjfim.identification.fit_workers import FitWorkers
from mjfim.identification.inverse_dynamics import refuse_gross_error
from mjfim.identification.inverse_dynamics.gross_errors import STATE, column_line
from mjfim.identification.linear_coordinates import cad_bodies, columns_of
from mjfim.identification.search import (
    MISSED_ROUGH_SHARE,
    FitSearch,
    FitTask,
    Method,
    first_subset,
    of_subset,
    quick_subset,
    with_length,
)
from mjfim.identification.segments import measured_states
from mjfim.identification.starts import (
    SPREAD_STARTS,
    begin_fit,
    choose_length,
    describe_extreme_value,
    start_beyond_stops,
    start_from_segments,
)
from mjfim.information.criteria import standard_deviations
from mjfim.information.null_space import (
    CLEAR_SINGULAR_VALUE,
    NullSpace,
    find_null_space,
    has_weak_column,
)
from mjfim.model.variants import allows_dry_friction_only
from mjfim.optimize.levenberg_marquardt import (
    SearchSettings,
    Solution,
    UnknownValues,
    minimise,
)
from mjfim.parallel import ExecutorLike, one_blas_thread
from mjfim.parallel.budget import Budget, StopToken, stop_on_interrupt
from mjfim.plant.active_constraints import acting_constraints, forward_samples
from mjfim.recordings.checks import contradiction_remarks
from mjfim.recordings.section import ColumnSpec
from mjfim.records.estimate import Estimate, Restart
from mjfim.records.events import FitEvent, begin_stage, shown_progress
from mjfim.records.trajectory import Recording

# Share of each segment on which combinations without effect are searched for first, with one-sided
# differences. Only where all data leave a doubt, differences of two lengths show how large the
# error is.
SHARE_THAT_DETERMINES = 0.2

# Difference of two costs that is not relevant. A step to the minimum that is 0.14 standard
# deviations long lowers the cost by this much.
SAME_COST = 1e-2

# Largest number of times that a fit begins on the other side of a touch of a stop or a contact.
MAX_TOUCH_ROUNDS = 4

# Factor by which differences are shorter next to a jump of the residuals.
SHORTER_DIFFERENCES = 0.01

# How a search ends whose next step would lead over a jump of the residuals.
AT_JUMP = "converged: next to a jump of the residuals, where a stop or a contact comes or goes"

# Largest deviation of an encoder's scale that is tried as the cause of another begin.
MAX_SHARE = 0.5

# Reason for an estimate over whole recordings, although segments predict left-out data better.
DIVERGED = "the fit over this length diverged"

Callback = Callable[[FitEvent], None]


@checked
def identify(
    experiment: ExperimentLike,
    recordings: RecordingsLike = (),
    *,
    method: Method = "least_squares",
    start: Array | None = None,
    held_out: RecordingsLike = (),
    callback: Callback | None = None,
    threads: int | None = None,
    stop: StopToken | None = None,
    progress: bool = True,
    executor: ExecutorLike | None = None,
    **arrays: Arrays,
) -> Estimate:
    """Estimate parameters from recordings, with the settings of the table `[fit]`.

    The stated `std` is formal: it is the accuracy only if the model and the noise are right.
    `misfit` is true when they are not, and `interval` remains valid where residuals are
    autocorrelated. Ctrl-C ends the search with the best result so far.

    Args:
        experiment: Model, parameters and noise, or the path of its file; nothing else needs to be
            stated.
        recordings: Recordings to which the parameters are fitted: recordings, paths of logs, tables
            of arrays, or a `ModelSequences` of mujoco.sysid; one needs no list.
        method: `least_squares` (inside the bounds) or `newton` (the paper's method, without
            bounds).
        start: (p,) parameters at which the search starts; default: the guess.
        held_out: Recordings that are predicted, not fitted.
        callback: Called with every iterate.
        threads: Threads for the engine; default: one per core.
        stop: Token that ends the search with the best result so far.
        progress: False for no bar of progress in a notebook; a callback replaces the bar as well.
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process. It
            simulates parts of much data, searches from several starts, and predicts parts of the
            data from the others side by side.
        **arrays: One recording as MuJoCo's arrays, or as tables of columns by joint, actuator or
            sensor: (M,) `t`, (M or M-1, nu) `ctrl`, (M, nq) `qpos`, (M, nv) `qvel` and
            (M, nsensordata) `sensordata`; NaN where nothing was measured.

    Returns:
        The estimate with its accuracy and warnings.

    Raises:
        ExperimentError: Something is wrong in the experiment or in the arguments.
        RecordingError: A recording cannot be used.
        WrongLogError: A gross error of the recordings, such as a control with the wrong sign,
            explains them; the message has the lines that cure it.
        SimulationDivergedError: The model diverges at the start.
    """
    with shown_progress("identifying", callback, progress) as show:
        system = System.resolve(experiment, threads=threads)
        return identify_system(
            system,
            recordings_of(system, recordings, arrays),
            method=method,
            start=start,
            held_out=recordings_of(system, held_out),
            callback=show,
            stop=stop,
            executor=executor,
        )


def identify_system(
    system: System,
    recordings: Sequence[Recording],
    *,
    method: Method = "least_squares",
    start: Array | None = None,
    held_out: Sequence[Recording] = (),
    callback: Callback | None = None,
    stop: StopToken | None = None,
    executor: ExecutorLike | None = None,
) -> Estimate:
    """Estimate the parameters of a resolved system.

    Args:
        system: Model, parameters, outputs and noise.
        recordings: Recordings to which the parameters are fitted.
        method: Method of the search.
        start: (p,) parameters at which the search starts; default: the guess.
        held_out: Recordings that are predicted, not fitted.
        callback: Called with every iterate.
        stop: Token that ends the search with the best result so far.
        executor: Where the work is done (`mjfim.ExecutorLike`); None for this process.

    Returns:
        The estimate with its accuracy and warnings.

    Raises:
        ExperimentError: Something is wrong in the arguments.
        RecordingError: A recording cannot be used.
        WrongLogError: A gross error of the recordings explains them.
        SimulationDivergedError: The model diverges at the start.
    """
    task = FitTask.of(system, recordings, method=method, start=start, held_out=held_out)
    begun = time.perf_counter()
    steps_before = task.system.plant.engine_steps

    with one_blas_thread(), stop_on_interrupt(stop) as token:
        workers = None if executor is None else FitWorkers(executor)
        search = FitSearch(task=task, budget=Budget(stop=token), callback=callback)
        estimate = estimate_from(fit_task(search, workers), search.budget)

    return replace(
        estimate,
        seconds=time.perf_counter() - begun,
        steps=task.system.plant.engine_steps - steps_before,
    )


def fit_task(
    search: FitSearch, workers: FitWorkers | None = None, *, checks_log: bool = True
) -> FitResult:
    """Search for the parameters of a task from its start.

    Args:
        search: The searches of the identification.
        workers: Workers that do parts of the work; None for this process.
        checks_log: Whether gross errors of the recordings are looked for first.

    Raises:
        WrongLogError: A gross error of the recordings explains them.
        SimulationDivergedError: The simulation diverges at the start, and no other start is found.
        RecordingError: The recordings do not fit the experiment.
    """
    stated = search.task
    problem, held_out = _problems(stated, workers)
    if checks_log and stated.method != "newton":
        _check_log(problem, stated)
    search, dynamics, instead = begin_fit(search, problem)
    task = search.task
    repeats = task.settings.segment_length is None and task.method != "newton"

    # Combinations of parameters that no recording determines are held at their start values.
    begin_stage("testing what the recordings determine")
    subset = quick_subset(problem)
    begin = problem.begin(task.start)
    null_space = _unseen_directions(task, problem.of_segments(subset), task.start)
    problem = problem.pinned(task.start, null_space)

    # With much data, the search begins on a subset. A request to stop ends it there.
    begin = search.best_start(problem, begin)
    searched, status = problem, ""
    if search.interrupted:
        first = first_subset(problem)
        if len(first) < len(problem.segments):
            searched, begin = problem.of_segments(first), of_subset(begin, first)
            status = f", from {len(first)} of {len(problem.segments)} segments"
            subset = np.arange(len(first))
    weighted, solution = search.solve(searched, begin, is_first=repeats)
    fit = FitResult(
        task=stated,
        problem=weighted,
        solution=replace(solution, status=solution.status + status),
        quality=fit_quality(weighted, solution),
        null_space=null_space,
        held_out=held_out,
        subset=subset,
        restart=None,
        inverse_dynamics=dynamics,
        begun_instead=instead,
    )

    if checks_log and repeats and stated.elsewhere and is_doubtful(fit):
        _refuse_other_reading(search, fit)

    # A result that does not explain the data may be a local minimum: fits over short segments give
    # other starts, the second time from many starts where most of the motion is unexplained.
    if repeats:
        for is_spread in (False, True):
            is_poor = bool(fit.quality.unexplained) if is_spread else is_doubtful(fit)
            if search.interrupted or not is_poor:
                break
            fit = _restarted(search, problem, fit, is_spread=is_spread)
    fit = _with_solution(fit, *search.converged(fit.problem, fit.solution))

    if repeats:
        fit = _beyond_stops(search, fit)

    fit = _with_lost_held(search, fit)

    # Where the model does not explain whole recordings, the length of the segments matters.
    chooses_length = task.settings.segments is None and task.method != "newton"
    if chooses_length and not search.interrupted and is_doubtful(fit):
        fit = _over_chosen_length(search, problem, fit)
    return fit


def _check_log(problem: FitProblem, task: FitTask) -> None:
    """Refuse a gross error of the recordings, where no other fault of theirs is known."""
    channels, logs = task.system.channels, task.recordings
    is_faulty = bool(describe_extreme_value(logs, channels.control_columns))
    if not (is_faulty or any(any(contradiction_remarks(channels, each)) for each in logs)):
        begin_stage("looking for gross errors of the recordings")
        refuse_gross_error(problem.system, problem.recordings, task.start)


def _refuse_other_reading(search: FitSearch, fit: FitResult) -> None:
    """Refuse recordings that another zero or scale of their encoders explains, the model alone not.

    At rest, a log with such an error begins elsewhere in positions only. A fit from the stated
    initial state finds the zeros, or the scales, beside the parameters.

    Raises:
        WrongLogError: The fit explains the recordings. The message has the lines that cure them.
    """
    task = fit.task
    system, begins = task.system, [by for _, by in task.elsewhere]
    first = fit.problem.recordings[0]
    places = measured_states(system, first)
    columns = {system.outputs.names[j]: j for x, j in places.items() if x < system.space.nq}
    names = sorted({name for by in begins for name in by})
    paths = {target.path for each in system.parameters.parameters for target in each.targets}
    if paths & {f"output/{name}:bias" for name in names}:
        return
    recordings = (*task.recordings, *task.held_out)
    if not {*names} <= {*columns} or len(begins) < len(recordings):
        return

    zeros = np.array([np.mean([by.get(name, 0.0) for by in begins]) for name in names])
    stated_begin = first.y[0, [columns[name] for name in names]] - zeros
    guesses = {"bias": zeros}
    if (np.abs(zeros) < MAX_SHARE * np.abs(stated_begin)).all():
        guesses["scale"] = zeros / stated_begin
    initial = system.experiment.initial.model_copy(update={"free": {}})
    experiment = system.experiment.model_copy(update={"initial": initial})
    cures: dict[float, tuple[str, Array]] = {}
    for kind, sizes in guesses.items():
        unknown = {
            f"?{name}": {"target": f"output/{name}:{kind}", "guess": size, "scale": abs(size)}
            for name, size in zip(names, sizes.tolist(), strict=True)
        }
        shifted = System.resolve(
            experiment.replace(parameters=unknown), threads=system.threads, source=system.source
        )
        other = FitTask.of(shifted, task.recordings)
        problem = other.problem()
        try:
            solved = replace(search, task=other).solve(problem, problem.begin(other.start), kind)
        except SimulationDivergedError:
            continue
        explained = _with_solution(replace(fit, task=other), *solved)
        if not other.elsewhere and not is_doubtful(explained):
            cures[explained.solution.cost] = kind, explained.solution.unknowns.theta[-len(names) :]
    if not cures:
        return
    kind, found = cures[min(cures)]
    stated = experiment.recording.sources
    lines = []
    for name, value in zip(names, found.tolist(), strict=True):
        change = {"offset": -value} if kind == "bias" else {"factor": 1.0 / (1.0 + value)}
        lines.append(column_line(name, stated.get(name, ColumnSpec(column=name)), **change))
    word = "zero" if kind == "bias" else kind
    raise WrongLogError(
        f"{listed([PurePath(each.name).name for each in recordings])}: another {word} of "
        f"{listed(names)}; without this error the model explains the motion. "
        f"{STATE}{'; '.join(lines)}"
    )


def _with_lost_held(search: FitSearch, fit: FitResult) -> FitResult:
    """The fit in which combinations are held that the recordings do not determine at the estimate.

    The speed of a Stribeck friction, for example, has no effect where the friction vanishes.
    """
    information = fit.solution.condensed.information()
    if np.isfinite(standard_deviations(information)).all():
        return fit
    lost = _unseen_directions(search.task, fit.problem, fit.theta)
    if not lost.count:
        # Longer differences may show an effect, such as that of a limit which is hardly reached.
        columns = np.flatnonzero(np.diag(information) == 0.0)
        silent = np.unique(fit.problem.parameter_of_column[columns])
        if not len(silent):
            return fit
        axes = np.eye(len(fit.theta))
        lost = NullSpace(
            directions=np.concatenate([fit.null_space.directions, axes[:, silent]], axis=1),
            silent=(*fit.null_space.silent, *silent.tolist()),
            basis=np.delete(axes, silent, axis=1),
            smallest=0.0,
        )
    held = fit.problem.pinned(fit.theta, lost)
    found = _fitted_from(search, held, fit.solution.unknowns, "all data, held", fit)
    return fit if found is None else replace(found, null_space=lost)


# Beginnings of the descriptions of what a motion touches, and largest number of samples that are
# looked at.
TOUCHES = ("contact ", "limit of ", "friction or limit of ")
MAX_TOUCHED_SAMPLES = 20_000


def _touched_in(fit: FitResult) -> str:
    """Stops and contacts that act along the fitted motions, in words; empty without any."""
    problem, at = fit.problem, fit.solution.unknowns
    model, found = problem.system.plant.model(problem.theta(at)), Counter[str]()
    if allows_dry_friction_only(model):
        return ""
    samples = 0
    for i in range(len(problem.recordings)):
        motion = problem.motion(at, i, max(MAX_TOUCHED_SAMPLES - samples, 1))
        if motion is None:
            continue
        samples += motion.samples
        for _, data in forward_samples(model, motion, range(motion.samples)):
            acting = set(acting_constraints(model, data))
            found.update(name for name in acting if name.startswith(TOUCHES))
    found_in = [f"{name} in {n} of {samples} samples" for name, n in found.items()]
    return listed(found_in) if found_in else ""


def _beyond_stops(search: FitSearch, fit: FitResult) -> FitResult:
    """The fit, or a better one where a joint stop or a contact acts.

    The residuals jump there, and a search ends at the jump.
    """
    touches = _touched_in(fit) if is_doubtful(fit) or fit.solution.stuck else ""
    for _ in range(MAX_TOUCH_ROUNDS if touches else 0):
        cost = fit.solution.cost
        start = start_beyond_stops(search, fit) if is_doubtful(fit) else None
        if start is None or search.interrupted:
            break
        fit = _fitted_from(search, fit.problem, start, "all data, beyond stops", fit) or fit
        # After a small gain, further rounds of searches take long and gain even less.
        if fit.solution.cost > (1.0 - MISSED_ROUGH_SHARE) * cost:
            break
    if touches and fit.solution.stuck and not is_doubtful(fit):
        # Differences that straddle the jump are no slopes. The minimum may be at the jump itself.
        finer = fit.problem.with_longer_differences(SHORTER_DIFFERENCES)
        words = "all data, shorter differences"
        fit = _fitted_from(search, finer, fit.solution.unknowns, words, fit) or fit
        ended = replace(fit.solution, success=True, stuck=False, status=AT_JUMP)
        fit = replace(fit, solution=ended if fit.solution.stuck else fit.solution)
    return replace(fit, touches=touches)


def is_doubtful(fit: FitResult) -> bool:
    """Whether a fit may have ended in a local minimum, or before a minimum."""
    quality, is_stated = fit.quality, fit.task.noise_is_stated
    if quality.unexplained or not (fit.solution.success or is_stated):
        return True
    tests, worst = quality.whiteness, quality.worst_residual
    return bool(misfit_reasons(quality.chi2, quality.dof, is_stated, tests, (), worst))


def _with_solution(fit: FitResult, problem: FitProblem, solution: Solution) -> FitResult:
    """The fit with another solution."""
    if solution is fit.solution:
        return fit
    quality = fit_quality(problem, solution)
    return replace(fit, problem=problem, solution=solution, quality=quality)


def _fitted_from(
    search: FitSearch,
    problem: FitProblem,
    begin: UnknownValues,
    phase: str,
    fit: FitResult,
    cost_to_beat: float = np.inf,
) -> FitResult | None:
    """A fit with the solution over a problem from other unknowns; None where it diverges."""
    try:
        found = search.solve(problem, begin, phase, cost_to_beat=cost_to_beat)
        return _with_solution(fit, *found)
    except SimulationDivergedError:
        return None


def _restarted(
    search: FitSearch, problem: FitProblem, fit: FitResult, *, is_spread: bool
) -> FitResult:
    """The fit, or its repetition from fits over segments if that costs less."""
    start, lengths, dynamics = start_from_segments(
        search, problem, fit.null_space, spread=is_spread
    )
    if not lengths:
        return fit
    before = fit.solution.cost
    restart = Restart(
        lengths=lengths,
        cost_before=before,
        cost=before,
        by_dynamics=dynamics is not None,
        starts=SPREAD_STARTS if is_spread else 1,
    )
    fit = replace(fit, inverse_dynamics=fit.inverse_dynamics or dynamics)
    again = None
    if start is not None:
        compared = problem.with_noise(fit.problem.noise)
        start = search.better_start(compared, start, fit.solution.unknowns)
    if start is not None:
        again = _fitted_from(search, problem, start, "again all data", fit, before)

    # Costs can be compared only with the same noise. Of two equal fits, that which has converged.
    if again is not None:
        cost = fit.problem.cost(again.solution.unknowns)
        if fit.solution.rough and before > cost > (1.0 - MISSED_ROUGH_SHARE) * before:
            fit = _with_solution(fit, *search.converged(fit.problem, fit.solution))
            before = fit.solution.cost
            restart = replace(restart, cost_before=before, cost=before)
        converges = again.solution.success and not fit.solution.success
        if before - cost > SAME_COST or (converges and before - cost > -SAME_COST):
            first = restart if fit.restart is None else fit.restart
            restart = replace(restart, cost_before=first.cost_before, cost=cost)
            return replace(again, restart=restart)
    return replace(fit, restart=fit.restart or restart)


def _over_chosen_length(search: FitSearch, problem: FitProblem, fit: FitResult) -> FitResult:
    """The fit over the length of segments that predicts left-out data best."""
    choice = choose_length(search, problem.with_noise(fit.problem.noise), fit)
    if choice is None or search.interrupted:
        return fit
    study, length, theta = choice
    cut = None if length is None else problem.cut(length)
    if length is None or cut is None:
        return replace(fit, horizons=study)
    task = with_length(search.task, length)
    cut = cut.pinned(task.start, fit.null_space)
    chosen = replace(search, task=task)
    words = f"segments of {length:.2g} s"
    begin = chosen.with_initial_states(cut, cut.begin(theta))
    found = _fitted_from(chosen, cut, begin, words, fit)
    if found is None:
        return replace(fit, horizons=replace(study, why_not_used=DIVERGED))
    return replace(
        found,
        task=replace(task, start=fit.task.start),
        held_out=None if fit.held_out is None else fit.held_out.cut(length),
        subset=quick_subset(cut),
        horizons=study,
    )


def refit_task(
    search: FitSearch,
    near: FitResult,
    workers: FitWorkers | None = None,
    *,
    is_only_compared: bool = True,
    other_start: Array | None = None,
) -> FitResult:
    """Search for the parameters of a task near its start, where a similar fit has ended.

    Args:
        search: The searches, with the start of the task.
        near: The similar fit, which has the initial states of the begin.
        workers: Workers that do parts of the work; None for this process.
        is_only_compared: Whether the fit is only compared with others.
        other_start: (p,) another start, which is taken if it costs less.
    """
    task = search.task
    problem, held_out = _problems(task, workers)
    subset = quick_subset(problem)
    null_space = _unseen_directions(task, problem.of_segments(subset), task.start)
    problem = problem.pinned(task.start, null_space)
    starts = [task.start] if other_start is None else [task.start, other_start]
    begins = [_begin_near(problem, problem.begin(start), near) for start in starts]
    begin = begins[0] if len(begins) == 1 else min(begins, key=problem.cost)
    nearby = replace(search, begins_near=True)
    found = nearby.solve(problem, begin, "near a similar fit", is_only_compared=is_only_compared)
    if not is_only_compared:
        found = nearby.converged(*found)
    return FitResult(
        task=task,
        problem=found[0],
        solution=found[1],
        quality=fit_quality(*found),
        null_space=null_space,
        held_out=held_out,
        subset=subset,
        restart=None,
    )


def _begin_near(problem: FitProblem, begin: UnknownValues, near: FitResult) -> UnknownValues:
    """The unknowns at the begin of a search, those besides theta as a similar fit has found them.

    Args:
        problem: The problem.
        begin: Its unknowns at the parameters where the search begins.
        near: The similar fit to the same recordings.
    """
    found = near.solution.unknowns

    if have_same_initial_states(problem, near.problem):
        begin = replace(begin, private=found.private)

    # A parameter with a value for each recording keeps these values.
    names, known = problem.parameters.names, near.problem.parameters.names
    columns = {known[j]: column for column, j in enumerate(near.problem.per_recording.tolist())}
    per_recording = np.array(begin.per_recording)
    for place, j in enumerate(problem.per_recording.tolist()):
        if names[j] in columns:
            per_recording[:, place] = found.per_recording[:, columns[names[j]]]
    return replace(begin, per_recording=per_recording)


def _problems(task: FitTask, workers: FitWorkers | None) -> tuple[FitProblem, FitProblem | None]:
    """The least-squares problems of the fitted and of the held-out recordings."""
    problem = replace(task.problem(), workers=workers)
    if not task.held_out:
        return problem, None
    held_out = FitProblem.of(task.system, task.held_out)
    if task.predicts_whole:
        held_out = held_out.cut(None) or held_out
    return problem, replace(held_out, workers=workers)


def least_squares(
    problem: FitProblem,
    start: Array,
    settings: SearchSettings | None = None,
    budget: Budget | None = None,
) -> Solution:
    """Minimise the cost of a problem by Levenberg-Marquardt inside the bounds.

    Args:
        problem: Residuals as functions of the unknowns.
        start: (p,) parameters at which the search starts.
        settings: Tolerance and number of iterations.
        budget: Time and stop token; default: no limit.

    Returns:
        The solution.

    Raises:
        SimulationDivergedError: The simulation diverges at the start.
    """
    found = minimise(problem, problem.begin(start), settings or SearchSettings(), budget)
    if found is None:
        raise SimulationDivergedError("the simulation diverges at the start of the fit")
    return found


def _unseen_directions(task: FitTask, problem: FitProblem, theta: Array) -> NullSpace:
    """Directions at theta about which the data contain no information."""
    parameters = task.system.parameters
    tested = ~np.isin(parameters.names, task.settings.hold)
    tested[columns_of(cad_bodies(parameters))] = False
    free = np.flatnonzero(tested)
    count = len(free)
    if not count:
        none = np.zeros((len(parameters), 0))
        return NullSpace(directions=none, silent=(), basis=np.eye(len(parameters)), smallest=1.0)
    for part, with_error in (
        (problem.of_first_parts(SHARE_THAT_DETERMINES), False),
        (problem, False),
        (problem, True),
    ):
        begin = part.begin(theta)
        rows = sensitivity_rows(part, begin, with_error=with_error, wanted=tested)
        # Priors are further rows, which have no error of finite differences.
        prior = parameters.prior_rows
        J = np.concatenate([*(row for row, _ in rows), prior])[:, free]
        change = np.concatenate([*(error for _, error in rows), np.zeros_like(prior)])[:, free]
        found = find_null_space(
            J,
            change,
            parameters.magnitude[free],
            parameters.scale[free],
            np.arange(count),
            np.zeros((count, count)),
        )
        is_clear = not found.count and found.smallest > CLEAR_SINGULAR_VALUE
        if is_clear and not has_weak_column(J, parameters.magnitude[free]):
            break
    directions = np.zeros((len(parameters), found.count))
    directions[free] = found.directions
    silent = tuple(free[list(found.silent)].tolist())
    return replace(found, directions=directions, silent=silent)

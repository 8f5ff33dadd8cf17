"""`mjfim.check`: what an experiment, or recordings that are there already, can tell about the parameters, before any fit."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError, SimulationDivergedError
from mjfim.excitation.objective import DesignPoint, DesignProblem
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.residuals import FitProblem
from mjfim.information.fisher import FisherInformation
from mjfim.information.identifiability import Identifiability
from mjfim.information.marginal import shared
from mjfim.plant.derivatives import CENTRAL_DIFFERENCES
from mjfim.records.check import (
    CONFOUNDED_CORRELATION,
    Check,
    ConfoundedPair,
    ParameterCheck,
    SelfTest,
)
from mjfim.records.combinations import ParameterGroup, join_names
from mjfim.records.recording import Recording
from mjfim.records.trajectory import Trajectory
from mjfim.studies.derivative_test import self_test

DEFAULT_WANTED = 0.05  # of a parameter's own size, where none is stated
MOST = 1_000_000_000
LONGEST_LINE = 400

# Samples of a recording along which the derivatives are tested.
MOST_TESTED_SAMPLES = 2000


def check(
    experiment: Experiment,
    recordings: Sequence[Recording] = (),
    trajectory: Trajectory | None = None,
    threads: int | None = None,
) -> Check:
    """Look at an experiment's initial trajectory, at a given one (a design), or at recordings, at the design's theta.

    Raises SimulationDivergedError where that cannot be simulated, RecordingError for unusable recordings.
    """
    if recordings and trajectory is not None:
        raise RecordingError("check either recordings or a designed trajectory, not both")

    if recordings:
        return check_recordings(System.resolve(experiment, threads=threads), recordings)
    return check_task(DesignTask.resolve(experiment, threads=threads), trajectory)


def check_task(task: DesignTask, trajectory: Trajectory | None = None) -> Check:
    """Check along the initial control of a task, or along the control of a trajectory. See `check`."""
    curve, source = task.initial, "the initial control"
    if trajectory is not None:
        curve, source = task.plant.simulate(task.theta, trajectory.ctrl), "the given trajectory"

    problem, point = _evaluated(task, curve)
    if point.information is None or point.sensitivity is None:
        raise SimulationDivergedError("the simulation diverges when the parameters move a little")

    seen = task.observer.identifiability(curve, point.sensitivity)
    tested = _self_tested(task, problem, point, seen)

    data = point.information - task.information.prior
    return _concluded(task, seen, _shared(task, [data]), float(curve.t[-1]), source, tested)


def check_recordings(system: System, recordings: Sequence[Recording]) -> Check:
    """Check what recordings tell; derivatives are tested along the longest of them."""
    fit = FitProblem.of(system, recordings, data_only=True)
    longest = max(fit.aligned, key=lambda track: len(track.ctrl))
    task = DesignTask.along(system, longest.ctrl[:MOST_TESTED_SAMPLES])

    problem, point = _evaluated(task, task.initial)
    if point.information is None or point.sensitivity is None:
        raise SimulationDivergedError("the simulation diverges when the parameters move a little")

    # Rows of G at the times at which the recordings were measured, and the error of their differences.
    recorded = fit.sensed(fit.begin(task.theta))
    J, error = (np.concatenate(part) for part in zip(*recorded, strict=True))
    seen = task.observer.identifiability_of_rows(task.initial, J, error)
    tested = _self_tested(task, problem, point, seen)

    count = len(recordings)
    source = f"{count} recording{'s' if count > 1 else ''}"
    duration = float(sum(track.t[-1] for track in fit.aligned))
    data = _shared(task, [rows.T @ rows for rows, _ in recorded])
    return _concluded(task, seen, data, duration, source, tested)


def _evaluated(task: DesignTask, curve: Trajectory) -> tuple[DesignProblem, DesignPoint]:
    """The cost of a task with a trajectory as its own reference, and the trajectory's point."""
    problem = task.problem
    problem = replace(problem, running=replace(problem.running, desired=curve.state))
    return problem, problem.point(curve, CENTRAL_DIFFERENCES)


def _self_tested(
    task: DesignTask, problem: DesignProblem, point: DesignPoint, seen: Identifiability
) -> SelfTest:
    """Test the derivatives along a point, for the combinations that can be identified."""
    visible = replace(problem, information=replace(problem.information, basis=seen.basis))
    return self_test(task, visible, visible.reevaluated(point))


def _shared(task: DesignTask, matrices: Sequence[Array]) -> Array:
    """(p, p) sum of what several experiments tell about their common parameters; initial states are marginalised."""
    p = task.parameters
    parts = (shared(each, p.prior_information, p.recording_specific) for each in matrices)
    return np.asarray(sum(parts, start=np.zeros_like(task.prior)))


def _concluded(
    task: DesignTask,
    seen: Identifiability,
    data: Array,
    horizon: float,
    source: str,
    tested: SelfTest,
) -> Check:
    """data: (p, p) of all that was looked at, each start's own nuisance marginalised"""
    p = task.parameters
    information = replace(
        task.information,
        prior=task.prior,
        basis=seen.along_trajectory.basis if seen.along_trajectory.count else None,
    )
    total = data + task.prior
    covariance = information.covariance(total)
    std = np.full(len(p), np.inf)
    std[p.interest] = np.nan_to_num(np.sqrt(np.diag(covariance)), nan=np.inf)
    rows = tuple(_rows(task, information, data, std, horizon))
    spread = np.sqrt(np.diag(covariance))
    correlation = covariance / np.outer(spread, spread)
    confounded = tuple(_pairs(seen.names, correlation))
    criterion = task.information
    visible = replace(criterion, basis=seen.basis)
    never, more = seen.groups_along_all, seen.along_trajectory.count > seen.along_all.count
    known = {str(g) for g in never}
    not_here = tuple(g for g in seen.groups_along_trajectory if str(g) not in known) if more else ()
    eigenvalues = np.maximum(visible.evaluate(data + criterion.prior).eigenvalues, 0.0)
    verdict = tuple(_verdict(rows, never, not_here, confounded, tested, source))
    combined = (
        () if not_here else seen.combinations(information, task.theta[p.interest], total, total)
    )
    return Check(
        source=source,
        horizon=horizon,
        rows=rows,
        wanted=seen.names,
        information=total,
        eigenvalues=eigenvalues,
        correlation=correlation,
        confounded=confounded,
        not_separable=never,
        not_excited=not_here,
        self_test=tested,
        verdict=verdict,
        combined=combined,
    )


def _rows(
    task: DesignTask, information: FisherInformation, data: Array, std: Array, horizon: float
) -> Iterator[ParameterCheck]:
    p = task.parameters
    for j, parameter in enumerate(p.parameters):
        value = float(task.theta[j])
        plain = parameter.size == abs(parameter.guess) and value != 0.0
        size = abs(value) if plain else float(p.magnitude[j])
        stated = parameter.wanted is not None
        wanted = parameter.wanted or DEFAULT_WANTED * size
        needed = 0 if parameter.nuisance else _repetitions(information, data, task.prior, j, wanted)
        yield ParameterCheck(
            name=parameter.name,
            unit=parameter.unit,
            value=value,
            nuisance=parameter.nuisance,
            size=size,
            std=float(std[j]),
            relative=float(std[j] / size),
            wanted=wanted,
            stated=stated,
            repetitions=needed,
            seconds=needed * horizon,
        )


def _repetitions(
    information: FisherInformation, data: Array, prior: Array, parameter: int, wanted: float
) -> int:
    """Least number of repetitions whose information, with the prior, brings a parameter to the wanted sigma; 0: none do."""
    t = np.arange(len(data)) if information.interest is None else information.interest
    place = int(np.flatnonzero(t == parameter)[0])

    def reached(n: int) -> bool:
        """True where n repetitions are enough."""
        variance = information.covariance(n * data + prior)[place, place]
        return bool(variance <= wanted**2)

    low, high = 0, 1
    while not reached(high):
        low, high = high, 2 * high
        if high > MOST:
            return 0
    while high - low > 1:
        middle = (low + high) // 2
        low, high = (low, middle) if reached(middle) else (middle, high)
    return high


def _pairs(names: Sequence[str], correlation: Array) -> Iterator[ConfoundedPair]:
    """Confounded pairs, the worst first."""
    found = [
        ConfoundedPair(first=names[i], second=names[j], correlation=float(correlation[i, j]))
        for i in range(len(names))
        for j in range(i + 1, len(names))
        if abs(correlation[i, j]) > CONFOUNDED_CORRELATION
    ]
    yield from sorted(found, key=lambda pair: -abs(pair.correlation))


def _brief(groups: Sequence[ParameterGroup]) -> str:
    """Groups in words, or only how many where that would fill a page."""
    said = "; ".join(str(group) for group in groups)
    if len(said) <= LONGEST_LINE:
        return said
    members = sum(len(group.members) for group in groups)
    return f"{members} parameters in {len(groups)} groups (listed under combinations)"


def _verdict(
    rows: Sequence[ParameterCheck],
    never: Sequence[ParameterGroup],
    not_here: Sequence[ParameterGroup],
    confounded: Sequence[ConfoundedPair],
    tested: SelfTest,
    source: str,
) -> Iterator[str]:
    """Sentences that a person can act on, the gravest first."""
    if tested.roughness is not None:
        yield f"{tested.roughness}"
    elif not tested.passed:
        yield (
            f"derivatives do not agree (psi recursion {tested.recursion:.1e}, slope {tested.slope:.1e}); {tested.likely_cause}. "
            "Shorten horizon or timestep, or smooth the switch, before trusting numbers here"
        )
    known = {row.name for row in rows if np.isfinite(row.std)}
    open_ = [group for group in never if not set(group.members) <= known]
    settled = [group for group in never if set(group.members) <= known]
    if open_:
        yield (
            f"no control from this start tells apart (nor did random ones): {_brief(open_)}. Take out or fix one of each group, "
            "give it a prior, or measure something else; a design works on the combinations"
        )
    if settled:
        yield f"told apart by priors only, not by data: {'; '.join(join_names(group.members) for group in settled)}"
    if not_here:
        yield f"not visible from {source}, but another control would show: {_brief(not_here)}. Move those joints more"
    wanted = [row for row in rows if not row.nuisance]
    alone = [row for row in wanted if np.isfinite(row.std)]
    late = [row for row in alone if row.repetitions != 1]
    if not alone:
        yield "nothing can be identified from this"
        return
    worst = max(alone, key=lambda row: row.std / row.wanted)
    if not late and tested.passed and not open_ and not not_here:
        yield f"all that can be told alone reaches its wanted sigma from {source}: nothing more is needed"
    elif late:
        reach = (
            f"{worst.repetitions:,} repetitions ({worst.seconds:,.0f} s)"
            if worst.repetitions
            else "no repetition"
        )
        yield (
            f"not known to the wanted sigma from {source} alone: {len(late)} of {len(alone)} parameters, above all "
            f"{worst.name}: {reach} for {worst.wanted:.3g}. An excitation that is designed (`mjfim design`) tells more"
        )
    if confounded:
        said = ", ".join(f"{p.first} / {p.second} ({p.correlation:+.3f})" for p in confounded[:5])
        more = f" and {len(confounded) - 5} more pairs" if len(confounded) > 5 else ""
        yield f"hardly told apart (correlation): {said}{more}; fixing one of a pair sharpens the other"

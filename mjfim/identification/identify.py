"""Batch least squares in MuJoCo: `min_theta sum_k |Sigma^-1/2 (y~_k - y_k(theta))|^2` over one or several recordings.

The Jacobian is the sensitivity G = dy/dtheta. `newton` is the paper's Newton-Raphson with the Hessian of its Fisher
information (Gauss-Newton); the default is Levenberg-Marquardt inside the bounds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Literal, TypeVar, get_args

import numpy as np
from threadpoolctl import threadpool_limits

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.budget import Budget, StopToken, stop_on_interrupt
from mjfim.errors import ExperimentError, SimulationDivergedError, unknown
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.accuracy import Accuracy, accuracy
from mjfim.identification.cross_validation import predicted
from mjfim.identification.fit_quality import FitQuality, fit_quality
from mjfim.identification.missing_terms import find_missing_terms
from mjfim.identification.residual_tests import reasons, smaller
from mjfim.identification.residuals import LARGE, FitProblem
from mjfim.information.null_space import NullSpace, find_null_space
from mjfim.model.parameter_samples import sample_parameters
from mjfim.model.parameters import ParameterSet
from mjfim.optimize.levenberg_marquardt import (
    IterationReport,
    SearchSettings,
    Solution,
    UnknownValues,
    minimise,
)
from mjfim.plant.noise import Noise
from mjfim.recordings.plausibility import plausibility_remarks
from mjfim.records.estimate import Estimate, MissingTerm
from mjfim.records.events import FitEvent
from mjfim.records.recording import Recording

NEWTON = SearchSettings(max_iterations=50, tolerance=1e-5, damped=False)
SETTLED = 0.01  # relative change of a sigma that is estimated, below which it is
ROUNDS = 10  # of estimating sigmas
FLOOR = 1e-3  # of the stated sigma, below which an estimated one does not fall
CLOSE = 1e-3  # standard deviations, a step below which is the last
NUDGES = 2  # iterations for the starts of all pieces of much data, before theta moves again
BRIEF = 8  # iterations of a further start, before the best goes on
SAMPLE = 40_000  # samples of a part of the data on which a search over much of it begins
FAR = 4.0  # prior standard deviations from the guess that are worth a word
Method = Literal["least_squares", "newton"]
Callback = Callable[[FitEvent], None]
Found = TypeVar("Found")


def identify(
    experiment: Experiment,
    recordings: Sequence[Recording],
    *,
    method: Method = "least_squares",
    start: Array | None = None,
    held_out: Sequence[Recording] = (),
    callback: Callback | None = None,
    threads: int | None = None,
    stop: StopToken | None = None,
) -> Estimate:
    """Estimate the parameters from recordings, starting at the guess (or `start`: (p,)), as the table `fit` says.

    The stated std is formal: it is accuracy only if the model and the noise are right; `misfit` says when they are not, and
    `interval` is honest where residuals follow one another.
    held_out: recordings that are predicted, not fitted;  callback: called with every iterate (`FitEvent`)
    Ctrl-C ends the search with the best so far. Raises RecordingError for unusable recordings, SimulationDivergedError where the
    model diverges at the start.
    """
    system = System.resolve(experiment, threads=threads)
    return identify_system(
        system,
        recordings,
        method=method,
        start=start,
        held_out=held_out,
        callback=callback,
        stop=stop,
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
) -> Estimate:
    """Estimate the parameters of a resolved system. See `identify`."""
    if method not in get_args(Method):
        raise ExperimentError(unknown("method", method, get_args(Method)))
    theta0 = system.parameters.guess if start is None else np.asarray(start, dtype=np.float64)
    if theta0.shape != system.parameters.guess.shape:
        raise ExperimentError(
            f"start: {theta0.shape} numbers, wanted one per parameter: {', '.join(system.parameters.names)}"
        )
    if method == "least_squares":
        theta0 = np.clip(theta0, system.parameters.lower, system.parameters.upper)
    with threadpool_limits(
        1, user_api="blas"
    ):  # small matrices: threads of BLAS only wait for each other
        return _Identification(system, recordings, method, theta0, held_out, callback).run(stop)


def least_squares(
    fit: FitProblem,
    start: Array,
    search: SearchSettings | None = None,
    budget: Budget | None = None,
) -> Solution:
    """Levenberg-Marquardt inside the bounds from theta: (p,). Raises SimulationDivergedError where that diverges.

    `interrupted` of the solution is True where the budget's token stopped the search.
    """
    found = minimise(fit, fit.begin(start), search or SearchSettings(), budget)
    if found is None:
        raise SimulationDivergedError("the simulation diverges at the start of the fit")
    return found


def newton_raphson(fit: FitProblem, start: Array, budget: Budget | None = None) -> Solution:
    """The paper's iterator `theta - (J'J)^-1 J'r`, its step halved while the residual would grow. Bounds are not used.

    Stops when a step is below 1e-5 standard deviations. Raises SimulationDivergedError where the start diverges.
    """
    return least_squares(fit.unbounded(), start, NEWTON, budget)


class _Identification:
    """One call of `identify`. fit: with the noise as known by now"""

    def __init__(
        self,
        system: System,
        recordings: Sequence[Recording],
        method: Method,
        theta0: Array,
        held_out: Sequence[Recording],
        callback: Callback | None,
    ) -> None:
        self.clock, self.steps = time.perf_counter(), system.plant.engine_steps
        self.system, self.method, self.theta0, self.callback = system, method, theta0, callback
        self.budget = Budget()
        fit = FitProblem.of(system, recordings)
        self.fit = fit.unbounded() if method == "newton" else fit
        self.held_out = FitProblem.of(system, held_out) if held_out else None
        self.interrupted = False
        self.stated = system.experiment.fit.noise == "stated"
        if not self.stated and system.noise.correlated:
            raise ExperimentError(
                f'{system.experiment.source}: fit.noise = "estimated" takes outputs as uncorrelated; take `correlated` out'
            )

    def run(self, stop: StopToken | None) -> Estimate:
        """From the start to the report; Ctrl-C ends the search with the best so far."""
        with stop_on_interrupt(stop) as token:
            self.budget = Budget(stop=token)
            return self._run()

    def _run(self) -> Estimate:
        fit, system = self.fit, self.system
        begin = fit.begin(self.theta0)
        if not np.isfinite(self._sample(fit).cost(self._sampled(begin))):
            raise SimulationDivergedError(
                f"the simulation diverges at the start {dict(zip(system.parameters.names, self.theta0, strict=True))}"
            )
        null = self._null(fit)
        fit.pin(self.theta0, null)
        solution = self._settled(self._best(begin))
        return self._report(solution, null)

    def _null(self, fit: FitProblem) -> NullSpace:
        """Directions of theta that neither the recordings nor the priors tell, at the start of the search."""
        p, some = self.system.parameters, self._sample(fit)
        J, error = (
            np.concatenate(part) for part in zip(*some.sensed(some.begin(self.theta0)), strict=True)
        )
        weight = np.sqrt(np.diag(np.diag(p.prior_information)))
        J, error = np.concatenate([J, weight]), np.concatenate([error, np.zeros_like(weight)])
        return find_null_space(
            J, error, p.magnitude, p.scale, np.arange(len(p)), np.zeros_like(weight)
        )

    def _sample(self, fit: FitProblem) -> FitProblem:
        """Of the pieces that are quick to look at."""
        return fit.part(self._places)

    @cached_property
    def _places(self) -> np.ndarray:
        """Pieces all over the data that are quick to look at; all of them where that is quick."""
        fit, count = self.fit, len(self.fit.pieces)
        quick = fit.samples <= SAMPLE or count == 1
        return evenly_spread_indices(
            count, count if quick else max(int(SAMPLE * count / fit.samples), 1)
        )

    def _sampled(self, at: UnknownValues) -> UnknownValues:
        return replace(at, private=at.private[self._places])

    @property
    def _search(self) -> SearchSettings:
        """What the user stated; much data is not linearised more often than is needed."""
        if self.method == "newton":
            return NEWTON
        search = SearchSettings(
            max_iterations=self.system.experiment.fit.max_iterations, tolerance=CLOSE
        )
        if self.fit.samples * 2 * len(self.system.parameters) >= LARGE * 10:
            return replace(search, tolerance=1e-2, relinearise_at_end=False)
        return search

    def _reported(self, phase: str) -> Callable[[IterationReport], None] | None:
        """Callback of the optimiser that reports its iterations as events of a phase."""
        callback = self.callback
        if callback is None:
            return None

        def report(done: IterationReport) -> None:
            callback(
                FitEvent(
                    phase=phase, iteration=done.iteration, cost=done.cost, step=done.step_length
                )
            )

        return report

    def _minimise(
        self, fit: FitProblem, at: UnknownValues, search: SearchSettings, phase: str
    ) -> Solution:
        """Solution of a search. Raises SimulationDivergedError where its start diverges."""
        found = minimise(fit, at, search, self.budget, self._reported(phase))
        if found is None:
            raise SimulationDivergedError(
                f"the simulation diverges next to the start of the fit ({phase})"
            )
        self.interrupted = self.interrupted or found.interrupted
        return found

    def _placed(self, fit: FitProblem, begin: UnknownValues, iterations: int) -> UnknownValues:
        """Starts that the data show roughly, at their best for theta as it is: far from it, theta would follow their errors."""
        if not fit.measured or self.interrupted:
            return begin
        search = SearchSettings(max_iterations=iterations, tolerance=0.1, relinearise_at_end=False)
        found = minimise(
            fit.frozen(), begin, search, self.budget, self._reported("where pieces start")
        )
        self.interrupted = found is not None and found.interrupted
        return begin if found is None else found.unknowns

    def _best(self, begin: UnknownValues) -> UnknownValues:
        """Where the search over all data begins: the best end of short searches from several starts, on some of the data."""
        some, count = self._sample(self.fit), self.system.experiment.fit.starts
        whole = len(some.pieces) == len(self.fit.pieces)
        placed = self._placed(some, self._sampled(begin), BRIEF)
        if whole and count == 1:
            return placed
        found = [
            self._minimise(
                some, placed, replace(self._search, relinearise_at_end=False), "some of the data"
            )
        ]
        for k, theta in enumerate([] if self.interrupted else self._thetas(count)):
            search = SearchSettings(max_iterations=BRIEF, tolerance=1e-2, relinearise_at_end=False)
            other = minimise(
                some,
                some.begin(theta),
                search,
                self.budget,
                self._reported(f"start {k + 2} of {count}"),
            )
            if other is not None:
                found.append(other)
                self.interrupted = other.interrupted
            if self.interrupted:
                break
        best = min(found, key=lambda s: s.cost).unknowns
        if whole:
            return best
        starts = np.array(begin.private)
        starts[self._places] = best.private
        return self._placed(self.fit, replace(best, private=starts), NUDGES)

    def _thetas(self, count: int) -> Array:
        """(count - 1, p) random starts."""
        if count == 1:
            return np.zeros((0, len(self.theta0)))
        system = self.system
        seed = system.experiment.fit.seed
        return sample_parameters(system.parameters, self.theta0, count, seed, system.impossible)[1:]

    def _settled(self, begin: UnknownValues) -> Solution:
        """The minimum, with sigmas that agree with the residuals where they are to be estimated."""
        solution = self._minimise(self.fit, begin, self._search, "all data")
        for _ in range(0 if self.stated else ROUNDS):
            if solution.interrupted:
                break
            before = self.fit.noise.sigma
            sigma = self._sigma(solution.unknowns)
            self.fit = self.fit.reweighted(
                Noise(covariance=np.diag(sigma**2), strides=self.fit.noise.strides)
            )
            change = float(np.abs(sigma / before - 1.0).max())
            solution = self._minimise(
                self.fit, solution.unknowns, self._search, "all data, sigmas estimated"
            )
            if change < SETTLED:
                break
        return solution

    def _sigma(self, at: UnknownValues) -> Array:
        """(ny,) of the residuals; with a robust loss from their median, which outliers hardly move."""
        fit, robust = self.fit, self.system.experiment.fit.loss != "linear"
        values = fit.predicted(at)
        if values is None:
            return np.array(fit.noise.sigma)
        sigma, free = np.array(fit.noise.sigma), fit.count / max(fit.count - fit.size, 1)
        for j, r in enumerate(fit.errors(values)):
            if len(r):
                spread = (
                    1.4826 * float(np.median(np.abs(r)))
                    if robust
                    else float(np.sqrt(np.mean(r**2) * free))
                )
                sigma[j] = max(spread, FLOOR * self.system.noise.sigma[j])
        return sigma

    def _report(self, solution: Solution, null: NullSpace) -> Estimate:
        system, fit, at = self.system, self.fit, solution.unknowns
        p, theta, rest = system.parameters, fit.theta(at), fit_quality(fit, solution)
        missing = self._afterwards(lambda: () if rest.unexplained else self._missing(at))
        predictions = self._afterwards(lambda: predicted(fit, at, self.held_out, self.budget))
        why = reasons(rest.chi2, rest.dof, self.stated, rest.white, missing)
        known = accuracy(fit, solution, null, rest.times(sum(len(t.t) for t in fit.aligned)))
        near = 1e-6 * p.magnitude
        outside = bool(((theta < p.lower - near) | (theta > p.upper + near)).any())
        touch = np.minimum(theta - p.lower, p.upper - theta) < near
        at_bound = tuple(name for name, hit in zip(p.names, touch, strict=True) if hit)
        return Estimate(
            parameters=p.names,
            units=system.units,
            prior=p.prior_information,
            theta=theta,
            std=known.std,
            covariance=known.covariance,
            initial_theta=self.theta0,
            chi2=rest.chi2,
            dof=rest.dof,
            status=solution.status,
            success=solution.success and not (known.singular or outside or known.lost),
            misfit=bool(why),
            iterations=solution.iterations,
            residual_rms=rest.rms,
            at_bound=at_bound,
            predicted=rest.predicted,
            recordings=tuple(self._seen(i) for i in range(len(fit.aligned))),
            warnings=tuple(self._sentences(solution, rest, known, why, missing, at_bound, outside)),
            combinations=tuple(str(group) for group in known.groups),
            data=known.data,
            std_sandwich=known.sandwich,
            interval=known.interval,
            between_recordings=known.between,
            sigma=dict(zip(system.outputs.names, fit.noise.sigma.tolist(), strict=True)),
            reasons=why,
            whiteness=rest.white,
            sloppy=tuple(name for name, _ in known.sloppy),
            missing_terms=missing,
            per_recording={
                p.names[j]: tuple(at.per_recording[:, i].tolist())
                for i, j in enumerate(fit.layout.own)
            },
            worst_residual=rest.worst if why else None,
            predictions=predictions,
            robust_uncertainty=known.detail,
            motion=fit.motion(at, 0),
            interrupted=self.interrupted,
            seconds=time.perf_counter() - self.clock,
            steps=system.plant.engine_steps - self.steps,
        )

    def _afterwards(self, work: Callable[[], tuple[Found, ...]]) -> tuple[Found, ...]:
        """Result of work after the estimate; empty, without costing the estimate, where somebody asked to stop."""
        found = () if self.interrupted else work()
        self.interrupted = self.interrupted or self.budget.stop.requested
        return () if self.interrupted else found

    def _missing(self, at: UnknownValues) -> tuple[MissingTerm, ...]:
        """Terms that the model lacks, from recordings, or of much data from pieces of them."""
        some = self._sample(self.fit)
        return find_missing_terms(some, self.fit.recordings, self._places, self._sampled(at))

    def _seen(self, i: int) -> Recording:
        """A recording in the order of the outputs, as it was fitted."""
        track = self.fit.aligned[i]
        held = self.fit.recordings[i].ctrl[: len(track.t) - 1]
        return Recording(
            t=track.t, ctrl=held, y=track.y, outputs=self.system.outputs.names, name=track.name
        )

    def _sentences(
        self,
        solution: Solution,
        rest: FitQuality,
        known: Accuracy,
        why: Sequence[str],
        missing: Sequence[MissingTerm],
        at_bound: tuple[str, ...],
        outside: bool,
    ) -> Iterator[str]:
        """What a user should know besides the numbers, the gravest first."""
        p, fit = self.system.parameters, self.fit
        if self.interrupted and not solution.interrupted:
            yield "interrupted after the search: what was not fitted is not predicted"
        if rest.unexplained:
            yield (
                f"the fit hardly explains {', '.join(rest.unexplained)}: probably a local minimum. Shorter pieces (fit.segments),"
                " more starts (fit.starts) or a better guess may find a better one"
            )
        yield from (
            f"the recordings tell {group}; the rest was held at the start" for group in known.groups
        )
        if known.singular:
            yield "the recordings do not determine all parameters: the information is singular"
        if why:
            wrong = "The model or the noise is" if self.stated else "The model is"
            yield f"misfit: {'; '.join(why)}. {wrong} wrong, and the formal standard errors are not accuracy"
        elif self.stated and smaller(rest.chi2, rest.dof):
            yield f"residuals are only {np.sqrt(rest.chi2 / rest.dof):.2f} x the stated noise: sigma is overstated"
        if known.detail is not None and known.detail.apart:
            names = [p.names[fit.layout.places[j]] for j in known.detail.apart]
            yield (
                f"recordings disagree on {', '.join(names)} by more than their own scatter: what differs between them is not "
                "in the model; the intervals allow for it"
            )
        if outside:
            yield f"outside its bounds, which newton does not keep: {', '.join(at_bound)}; use least_squares"
        elif at_bound:
            yield f"at a bound: {', '.join(at_bound)}; the formal standard errors do not hold there"
        if why and rest.worst is not None:
            yield f"residuals are {rest.worst}"
        yield from (f"the residuals look like {term}" for term in missing)
        yield from _far(p, fit.theta(solution.unknowns))
        yield from (f"sloppy: {name} {said}" for name, said in known.sloppy)
        yield from (
            f"poor data in {Path(r.name).name}: {said}"
            for r in fit.recordings
            for said in plausibility_remarks(self.system.channels, r)
        )


def _far(p: ParameterSet, theta: Array) -> Iterator[str]:
    """Estimates that the stated priors hardly allow."""
    for parameter, value in zip(p.parameters, theta, strict=True):
        if parameter.prior is not None and abs(value - parameter.guess) > FAR * parameter.prior:
            times = abs(value - parameter.guess) / parameter.prior
            yield f"{parameter.name} is {times:.0f} prior standard deviations from its guess: one of them is wrong"

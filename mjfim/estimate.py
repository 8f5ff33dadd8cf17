"""Batch least squares in MuJoCo: `min_theta sum_k |Sigma^-1/2 (y~_k - y_k(theta))|^2` over one or several recordings.

The Jacobian is the sensitivity G = dy/dtheta. `newton` is the paper's Newton-Raphson with the Hessian of its Fisher
information (Gauss-Newton); the default is Levenberg-Marquardt inside the bounds.
"""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Literal, TypeVar, get_args

import numpy as np
from threadpoolctl import threadpool_limits

from mjfim.condensed import Condensed
from mjfim.earlier import marginal
from mjfim.errors import ExperimentError, SimulationDiverged, unknown
from mjfim.estimated import Estimate
from mjfim.experiment import Experiment
from mjfim.fisher import standard_deviations
from mjfim.identifiability import Group, Null, grouped, invisible
from mjfim.levenberg import INTERRUPTED, Progress, Search, Solution, Unknowns, minimise
from mjfim.logs import doubts
from mjfim.misfit import Place, reasons, smaller, worst_place
from mjfim.noise import Noise
from mjfim.prediction import predicted
from mjfim.residuals import LARGE, Fit
from mjfim.robust import sampled
from mjfim.setup import Setup
from mjfim.suspects import Suspect, suspects
from mjfim.trajectory import Array, Recording
from mjfim.uncertainty import Uncertainty, together, uncertainty
from mjfim.whiteness import whiteness

NEWTON = Search(iterations=50, tolerance=1e-5, damped=False)
SETTLED = 0.01  # relative change of a sigma that is estimated, below which it is
ROUNDS = 10  # of estimating sigmas
FLOOR = 1e-3  # of the stated sigma, below which an estimated one does not fall
CLOSE = 1e-3  # standard deviations, a step below which is the last
NUDGES = 2  # iterations for the starts of all pieces of much data, before theta moves again
BRIEF = 8  # iterations of a further start, before the best goes on
SAMPLE = 40_000  # samples of a part of the data on which a search over much of it begins
SLOPPY = 0.25  # half of an interval over the value, from which a parameter is hardly known
TRADED = 0.5  # correlation from which another parameter can stand in for one
Method = Literal["least_squares", "newton"]
Tell = Callable[[str, Progress], None]
Found = TypeVar("Found")


def identify(
    experiment: Experiment | Setup,
    recordings: Sequence[Recording],
    method: Method = "least_squares",
    start: Array | None = None,
    held_out: Sequence[Recording] = (),
    tell: Tell | None = None,
) -> Estimate:
    """Estimate the parameters from recordings, starting at the guess (or `start`: (p,)), as the table `fit` says.

    The stated std is formal: it is accuracy only if the model and the noise are right; `misfit` says when they are not, and
    `interval` is honest where residuals follow one another.
    held_out: recordings that are predicted, not fitted;  tell: called with every iterate, and what it belongs to
    Ctrl-C ends the search with the best so far. Raises RecordingError for unusable recordings, SimulationDiverged where the
    model diverges at the start.
    """
    if method not in get_args(Method):
        raise ExperimentError(unknown("method", method, get_args(Method)))
    setup = experiment if isinstance(experiment, Setup) else Setup(experiment)
    theta0 = setup.parameters.guess if start is None else np.asarray(start, dtype=np.float64)
    if theta0.shape != setup.parameters.guess.shape:
        raise ExperimentError(
            f"start: {theta0.shape} numbers, wanted one per parameter: {', '.join(setup.parameters.names)}"
        )
    if method == "least_squares":
        theta0 = np.clip(theta0, setup.parameters.lower, setup.parameters.upper)
    with threadpool_limits(1, user_api="blas"):  # small matrices: threads of BLAS only wait for each other
        return _Identification(setup, recordings, method, theta0, held_out, tell).run()


def least_squares(fit: Fit, start: Array, search: Search | None = None) -> Solution:
    """Levenberg-Marquardt inside the bounds from theta: (p,). Raises SimulationDiverged where that diverges.

    Half a search is none: Ctrl-C is raised anew.
    """
    found = minimise(fit, fit.begin(start), search or Search())
    if found is None:
        raise SimulationDiverged("the simulation diverges at the start of the fit")
    if found.interrupted:
        raise KeyboardInterrupt
    return found


def newton_raphson(fit: Fit, start: Array) -> Solution:
    """The paper's iterator `theta - (J'J)^-1 J'r`, its step halved while the residual would grow. Bounds are not used.

    Stops when a step is below 1e-5 standard deviations. Raises SimulationDiverged where the start diverges.
    """
    return least_squares(fit.unbounded(), start, NEWTON)


class _Identification:
    """One call of `identify`. fit: with the noise as known by now"""

    def __init__(
        self,
        setup: Setup,
        recordings: Sequence[Recording],
        method: Method,
        theta0: Array,
        held_out: Sequence[Recording],
        tell: Tell | None,
    ) -> None:
        self.clock, self.steps = time.perf_counter(), setup.plant.steps
        self.setup, self.method, self.theta0, self.tell = setup, method, theta0, tell
        fit = Fit(setup, recordings)
        self.fit = fit.unbounded() if method == "newton" else fit
        self.held_out = Fit(setup, held_out) if held_out else None
        self.interrupted = False
        self.stated = setup.experiment.fit.noise == "stated"
        if not self.stated and setup.noise.correlated:
            raise ExperimentError(
                f'{setup.experiment.source}: fit.noise = "estimated" takes outputs as uncorrelated; take `correlated` out'
            )

    def run(self) -> Estimate:
        """From the start to the report."""
        fit, setup = self.fit, self.setup
        begin = fit.begin(self.theta0)
        if not np.isfinite(self._sample(fit).cost(self._sampled(begin))):
            raise SimulationDiverged(
                f"the simulation diverges at the start {dict(zip(setup.parameters.names, self.theta0, strict=True))}"
            )
        null = self._null(fit)
        fit.pin(self.theta0, null)
        solution = self._settled(self._best(begin))
        return self._report(solution, null)

    def _null(self, fit: Fit) -> Null:
        """Directions of theta that neither the recordings nor the priors tell, at the start of the search."""
        p, some = self.setup.parameters, self._sample(fit)
        J, error = (np.concatenate(part) for part in zip(*some.sensed(some.begin(self.theta0)), strict=True))
        weight = np.sqrt(np.diag(np.diag(p.prior_information)))
        J, error = np.concatenate([J, weight]), np.concatenate([error, np.zeros_like(weight)])
        return invisible(J, error, p.step, p.scale, np.arange(len(p)), np.zeros_like(weight))

    def _sample(self, fit: Fit) -> Fit:
        """Pieces all over the data that are quick to look at; all of them where that is quick."""
        self._places = np.arange(len(fit.pieces))
        if fit.samples > SAMPLE and len(fit.pieces) > 1:
            count = max(int(SAMPLE * len(fit.pieces) / fit.samples), 1)
            self._places = np.unique(np.linspace(0, len(fit.pieces) - 1, count).astype(int))
        return fit.part(self._places)

    def _sampled(self, at: Unknowns) -> Unknowns:
        return replace(at, starts=at.starts[self._places])

    @property
    def _search(self) -> Search:
        """What the user stated; much data is not linearised more often than is needed."""
        if self.method == "newton":
            return NEWTON
        search = Search(iterations=self.setup.experiment.fit.max_iterations, tolerance=CLOSE)
        if self.fit.samples * 2 * len(self.setup.parameters) >= LARGE * 10:
            return replace(search, tolerance=1e-2, fresh=False)
        return search

    def _told(self, what: str) -> Callable[[Progress], None] | None:
        tell = self.tell
        return None if tell is None else (lambda progress: tell(what, progress))

    def _minimise(self, fit: Fit, at: Unknowns, search: Search, what: str) -> Solution:
        if self.interrupted:  # where all stands by now, for the report
            search = replace(search, iterations=0)
        found = minimise(fit, at, search, self._told(what))
        if found is not None and (found.interrupted or self.interrupted):
            self.interrupted = True
            return replace(found, interrupted=True, success=False, status=INTERRUPTED)
        if found is None:
            raise SimulationDiverged(f"the simulation diverges next to the start of the fit ({what})")
        return found

    def _placed(self, fit: Fit, begin: Unknowns, iterations: int) -> Unknowns:
        """Starts that the data show roughly, at their best for theta as it is: far from it, theta would follow their errors."""
        if not fit.measured or self.interrupted:
            return begin
        search = Search(iterations=iterations, tolerance=0.1, fresh=False)
        found = minimise(fit.frozen(), begin, search, self._told("where pieces start"))
        self.interrupted = found is not None and found.interrupted
        return begin if found is None else found.unknowns

    def _best(self, begin: Unknowns) -> Unknowns:
        """Where the search over all data begins: the best end of short searches from several starts, on some of the data."""
        some, count = self._sample(self.fit), self.setup.experiment.fit.starts
        whole = len(some.pieces) == len(self.fit.pieces)
        placed = self._placed(some, self._sampled(begin), BRIEF)
        if whole and count == 1:
            return placed
        found = [self._minimise(some, placed, replace(self._search, fresh=False), "some of the data")]
        for k, theta in enumerate([] if self.interrupted else self._thetas(count)):
            search = Search(iterations=BRIEF, tolerance=1e-2, fresh=False)
            try:
                other = minimise(some, some.begin(theta), search, self._told(f"start {k + 2} of {count}"))
            except KeyboardInterrupt:  # before its first iterate
                self.interrupted = True
                break
            if other is not None:
                found.append(other)
                self.interrupted = other.interrupted
            if self.interrupted:
                break
        best = min(found, key=lambda s: s.cost).unknowns
        if whole:
            return best
        starts = np.array(begin.starts)
        starts[self._places] = best.starts
        return self._placed(self.fit, replace(best, starts=starts), NUDGES)

    def _thetas(self, count: int) -> Array:
        """(count - 1, p) random starts."""
        if count == 1:
            return np.zeros((0, len(self.theta0)))
        setup = self.setup
        seed = setup.experiment.fit.seed
        return sampled(setup.parameters, self.theta0, count, seed, setup.impossible)[1:]

    def _settled(self, begin: Unknowns) -> Solution:
        """The minimum, with sigmas that agree with the residuals where they are to be estimated."""
        solution = self._minimise(self.fit, begin, self._search, "all data")
        for _ in range(0 if self.stated else ROUNDS):
            if solution.interrupted:
                break
            before = self.fit.noise.sigma
            sigma = self._sigma(solution.unknowns)
            self.fit = self.fit.reweighted(Noise(np.diag(sigma**2), self.fit.noise.strides))
            change = float(np.abs(sigma / before - 1.0).max())
            solution = self._minimise(self.fit, solution.unknowns, self._search, "all data, sigmas estimated")
            if change < SETTLED:
                break
        return solution

    def _sigma(self, at: Unknowns) -> Array:
        """(ny,) of the residuals; with a robust loss from their median, which outliers hardly move."""
        fit, robust = self.fit, self.setup.experiment.fit.loss != "linear"
        values = fit.predicted(at)
        if values is None:
            return np.array(fit.noise.sigma)
        sigma, free = np.array(fit.noise.sigma), fit.count / max(fit.count - fit.size, 1)
        for j in range(len(sigma)):
            parts = zip(values, fit.tracks, fit.masks, strict=True)
            r = np.concatenate([(y - t.y)[mask[:, j], j] for y, t, mask in parts])
            if len(r):
                spread = 1.4826 * float(np.median(np.abs(r))) if robust else float(np.sqrt(np.mean(r**2) * free))
                sigma[j] = max(spread, FLOOR * self.setup.noise.sigma[j])
        return sigma

    def _report(self, solution: Solution, null: Null) -> Estimate:
        setup, fit, at = self.setup, self.fit, solution.unknowns
        p, theta = setup.parameters, fit.theta(at)
        covariance, std = self._formal(solution)
        groups = grouped(null, p.names, p.step, [q.unit for q in p.parameters])
        lumped = np.isin(p.names, [name for group in groups for name in group.members])
        std = np.where(lumped, np.inf, std)
        covariance = np.where(np.logical_or.outer(lumped, lumped), np.inf, covariance)
        lost = lumped & np.array([not q.group for q in p.parameters])
        values = fit.predicted(at)
        if values is None:
            raise SimulationDiverged("the simulation diverges near the estimate")
        whitened = self._whitened(values)
        inside = self._inside(whitened)
        chi2 = float(np.nansum(inside**2)) / fit.loss.inliers
        dof = max(int(np.isfinite(inside).sum()) - solution.condensed.rank, 1)
        white = tuple(whiteness(name, [z[:, j] for z in whitened]) for j, name in enumerate(setup.outputs.names))
        names, times = [Path(t.name).name for t in fit.tracks], [t.t for t in fit.tracks]
        worst = worst_place(setup.outputs.names, names, times, whitened)
        missing = self._afterwards(lambda: self._missing(at))
        why = reasons(chi2, dof, self.stated, white, missing)
        near = 1e-6 * p.step
        at_bound = tuple(n for n, d in zip(p.names, self._room(theta), strict=True) if d < 1e-6)
        outside = bool(((theta < p.lower - near) | (theta > p.upper + near)).any())
        rows = sum(len(t.t) for t in fit.tracks)
        honest = self._honest(solution, [w.time * rows / max(w.count, 1) for w in white])
        sandwich, interval, between = self._spread(theta, std, honest)
        loose = tuple(_sloppy(setup, theta, interval, covariance))
        singular = not np.isfinite(std[~lumped]).all()
        predictions = self._afterwards(lambda: predicted(fit, at, self.held_out))
        sentences = [
            *(
                ["interrupted after the search: what was not fitted is not predicted"]
                if self.interrupted and not solution.interrupted
                else []
            ),
            *self._warnings(chi2, dof, why, at_bound, singular, outside, groups, honest),
            *_hints(missing, worst if why else None),
            *(f"sloppy: {name} {said}" for name, said in loose),
            *(f"poor data in {Path(r.name).name}: {said}" for r in fit.recordings for said in doubts(setup, r)),
        ]
        return Estimate(
            parameters=p.names,
            theta=theta,
            std=std,
            covariance=covariance,
            initial_theta=self.theta0,
            chi2=chi2,
            dof=dof,
            status=solution.status,
            success=solution.success and not singular and not outside and not lost.any(),
            misfit=bool(why),
            iterations=solution.iterations,
            residual_rms=self._rms(values),
            at_bound=at_bound,
            predicted=tuple(values),
            recordings=tuple(self._seen(i) for i in range(len(fit.tracks))),
            warnings=tuple(sentences),
            combinations=tuple(str(group) for group in groups),
            data=self._data(solution.condensed),
            sandwich=sandwich,
            interval=interval,
            between=between,
            sigma=dict(zip(setup.outputs.names, fit.noise.sigma.tolist(), strict=True)),
            reasons=why,
            whiteness=white,
            sloppy=tuple(name for name, _ in loose),
            suspects=missing,
            each=self._each(at),
            worst=worst if why else None,
            predictions=predictions,
            detail=honest,
            motion=fit.motion(at, 0),
            interrupted=self.interrupted,
            seconds=time.perf_counter() - self.clock,
            steps=setup.plant.steps - self.steps,
        )

    def _afterwards(self, work: Callable[[], tuple[Found, ...]]) -> tuple[Found, ...]:
        """What the work says of the estimate; Ctrl-C ends it without costing the estimate."""
        try:
            return () if self.interrupted else work()
        except KeyboardInterrupt:
            self.interrupted = True
            return ()

    def _missing(self, at: Unknowns) -> tuple[Suspect, ...]:
        """Terms that the model lacks, from recordings, or of much data from pieces of them."""
        some = self._sample(self.fit)
        return suspects(some, self.fit.recordings, self._places, self._sampled(at))

    def _room(self, theta: Array) -> Array:
        """(p,) distance to the nearest bound over the parameter's size."""
        p = self.setup.parameters
        return np.asarray(np.minimum(theta - p.lower, p.upper - theta) / p.step)

    def _formal(self, solution: Solution) -> tuple[Array, Array]:
        """(p, p) covariance and (p,) standard deviations; of what recordings have of their own, the first one's."""
        fit, layout, condensed = self.fit, self.fit.layout, solution.condensed
        H = condensed.information()
        std = standard_deviations(H)
        singular = not np.isfinite(std).all()
        whole = np.full_like(H, np.inf) if singular else np.linalg.inv(H)
        p, first = len(self.setup.parameters), layout.first
        places = layout.places[first]
        covariance, spread = np.zeros((p, p)), np.zeros(p)
        covariance[np.ix_(places, places)], spread[places] = whole[np.ix_(first, first)], std[first]
        private = layout.private
        n = len(private)
        if n and not fit.measured:
            R = condensed.triangles[0, :n, :n]
            free = np.linalg.matrix_rank(R) == n and not singular
            C = condensed.eliminated[0]
            alone = np.linalg.inv(R.T @ R) + C @ whole @ C.T if free else np.full((n, n), np.inf)
            cross = (C @ whole)[:, first] if free else np.full((n, len(first)), np.inf)
            covariance[np.ix_(private, private)] = alone
            covariance[np.ix_(private, places)] = cross
            covariance[np.ix_(places, private)] = cross.T
            spread[private] = np.sqrt(np.diag(alone))
        return covariance, spread

    def _whitened(self, values: Sequence[Array]) -> list[Array]:
        """(M, ny) whitened measured - predicted of every recording, NaN where nothing counts."""
        out = []
        for y, track, mask in zip(values, self.fit.tracks, self.fit.masks, strict=True):
            z = np.full(y.shape, np.nan)
            z[mask] = self.fit.noise.whiten_present(np.where(mask, track.y - y, 0.0), mask)
            out.append(z)
        return out

    def _inside(self, whitened: Sequence[Array]) -> Array:
        """All whitened residuals; with a robust loss without outliers."""
        every = np.concatenate([z.ravel() for z in whitened])
        return np.where(np.abs(every) <= self.fit.loss.outlier, every, np.nan)

    def _honest(self, solution: Solution, times: Sequence[float]) -> Uncertainty | None:
        """What the blocks of the last linearisation say; None where a common unknown is not determined."""
        fit, spec = self.fit, self.setup.experiment.fit
        if not np.isfinite(standard_deviations(solution.condensed.information())).all():
            return None
        recording, rows = fit.blocks
        total = sum(len(t.t) for t in fit.tracks)
        length = together(times, total)
        if spec.blocks is not None:
            length = spec.blocks * total / sum(float(t.t[-1]) for t in fit.tracks)
        rng = np.random.default_rng(spec.seed)
        place = fit.place(solution.unknowns)
        return uncertainty(solution.condensed, place, recording, rows, length, spec.bootstrap, rng)

    def _spread(self, theta: Array, std: Array, honest: Uncertainty | None) -> tuple[Array, Array, Array]:
        """(p,) sandwich deviations, (p, 2) intervals, (p,) deviations between recordings; formal ones where there are none."""
        sandwich, between = np.array(std), np.zeros(len(std))
        interval = np.column_stack([theta - 1.96 * std, theta + 1.96 * std])
        layout, p = self.fit.layout, self.setup.parameters
        if honest is not None:
            columns = layout.first
            places = layout.places[columns]
            known = np.isfinite(std[places])
            places, columns = places[known], columns[known]
            sandwich[places], between[places] = honest.sandwich[columns], honest.between[columns]
            interval[places] = honest.interval[columns]
        low = np.maximum(interval[:, 0], np.minimum(p.lower, theta))
        high = np.minimum(interval[:, 1], np.maximum(p.upper, theta))
        return sandwich, np.column_stack([low, high]), between

    def _data(self, condensed: Condensed) -> Array:
        """(p, p) information of the recordings alone about what they share, everything else marginalised."""
        p, layout = self.setup.parameters, self.fit.layout
        H, places = condensed.information(outer=False), layout.places
        kept, out = np.arange(len(layout.shared)), np.zeros((len(p), len(p)))
        prior = p.prior_information[np.ix_(places, places)] * np.eye(len(places))
        out[np.ix_(layout.shared, layout.shared)] = marginal(H, prior, kept)
        return out

    def _each(self, at: Unknowns) -> dict[str, tuple[float, ...]]:
        """What every recording has of its own."""
        names = self.setup.parameters.names
        return {names[j]: tuple(at.own[:, i].tolist()) for i, j in enumerate(self.fit.layout.own)}

    def _rms(self, values: Sequence[Array]) -> dict[str, float]:
        found = {}
        for j, name in enumerate(self.setup.outputs.names):
            parts = zip(values, self.fit.tracks, self.fit.masks, strict=True)
            r = np.concatenate([(y - t.y)[mask[:, j], j] for y, t, mask in parts])
            if len(r):
                found[name] = float(np.sqrt(np.mean(r**2)))
        return found

    def _seen(self, i: int) -> Recording:
        """A recording in the order of the outputs, as it was fitted."""
        track = self.fit.tracks[i]
        held = self.fit.recordings[i].ctrl[: len(track.t) - 1]
        return Recording(track.t, held, track.y, self.setup.outputs.names, track.name)

    def _warnings(
        self,
        chi2: float,
        dof: int,
        why: Sequence[str],
        at_bound: tuple[str, ...],
        singular: bool,
        outside: bool,
        groups: Sequence[Group],
        honest: Uncertainty | None,
    ) -> Iterator[str]:
        yield from (f"the recordings tell {group}; the rest was held at the start" for group in groups)
        if singular:
            yield "the recordings do not determine all parameters: the information is singular"
        if why:
            wrong = "The model or the noise is" if self.stated else "The model is"
            yield f"misfit: {'; '.join(why)}. {wrong} wrong, and the formal standard errors are not accuracy"
        elif self.stated and smaller(chi2, dof):
            yield f"residuals are only {np.sqrt(chi2 / dof):.2f} x the stated noise: sigma is overstated"
        if honest is not None and honest.apart:
            names = [self.setup.parameters.names[self.fit.layout.places[j]] for j in honest.apart]
            yield (
                f"recordings disagree on {', '.join(names)} by more than their own scatter: what differs between them is not "
                "in the model; the intervals allow for it"
            )
        if outside:
            yield f"outside its bounds, which newton does not keep: {', '.join(at_bound)}; use least_squares"
        elif at_bound:
            yield f"at a bound: {', '.join(at_bound)}; the formal standard errors do not hold there"


def _hints(missing: Sequence[Suspect], worst: Place | None) -> Iterator[str]:
    """Where a misfit shows, and what might be behind it."""
    if worst is not None:
        yield f"residuals are {worst}"
    for term in missing:
        yield f"the residuals look like {term}"


def _sloppy(setup: Setup, theta: Array, interval: Array, covariance: Array) -> Iterator[tuple[str, str]]:
    """Wanted parameters that the data hardly tell, and in words what they may be traded for."""
    p = setup.parameters
    told = np.isfinite(np.diag(covariance))
    spread = np.sqrt(np.maximum(np.where(told, np.diag(covariance), 1.0), 1e-300))
    for j in p.interest:
        half = 0.5 * float(interval[j, 1] - interval[j, 0])
        size = max(abs(float(theta[j])), 1e-3 * float(p.step[j]))
        if not np.isfinite(half) or half <= SLOPPY * size:
            continue
        together = np.where(told, covariance[j], 0.0) / (spread * spread[j])
        together[j] = 0.0
        other = int(np.argmax(np.abs(together)))
        traded = f"; it is traded for {p.names[other]} (correlation {together[other]:+.2f})"
        known = (
            f"is known to ±{100 * half / size:.0f} % only" if half < 10 * size else "may be anything in its interval"
        )
        yield p.names[j], known + (traded if abs(together[other]) > TRADED else "")

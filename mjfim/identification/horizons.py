"""Choice of the length of the segments, by predictions of left-out data over several times.

Where a model does not explain the data, its estimates depend on the length of the segments: short
ones show quick effects, long ones show what adds up. Fits over each of several lengths predict
parts of the data that were left out, over times of each length. The lengths are compared by the
relative error over all these times, so that no time dominates because its errors are larger.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from typing import Literal

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.identification.continuation import WholeFit
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.held_out_losses import BLOCKS, HeldOutLosses, losses_by_block
from mjfim.identification.jackknife import jackknife_std, student_quantile
from mjfim.identification.leave_out_fits import fit_to_others, leave_out_steps
from mjfim.identification.left_out_parts import (
    MAX_FOLDS,
    LeftOutPart,
    left_out_parts,
    with_initial_states,
)
from mjfim.identification.next_step import spread_over_data
from mjfim.identification.searches import FitSearch
from mjfim.identification.segment_fits import problem_of_segments, segment_lengths
from mjfim.identification.task import FitTask
from mjfim.information.null_space import NullSpace
from mjfim.optimize.levenberg_marquardt import InterruptedPassError, Solution
from mjfim.records.estimate import HorizonStudy
from mjfim.records.events import begin_stage

# Number of samples of a fit, and of the predictions over one horizon; of more data, segments that
# are spread over them are used.
MAX_SAMPLES = 10_000

# Number of samples of all recordings above which whole recordings are not among the lengths.
MAX_WHOLE_SAMPLES = 50_000

# Share of the mean loss by which predictions have to be worse before a shorter length is chosen.
RELEVANT_SHARE = 0.01

# Smallest number of parts of the data whose scatter tells differences from chance, and the
# probability of a difference by chance.
MIN_PARTS = 3
SIGNIFICANCE = 0.01

# Probability that an interval holds the true value.
CONFIDENCE = 0.95


@dataclass(frozen=True, kw_only=True, eq=False)
class HorizonChoice:
    """Lengths of segments that were compared, and the fit over the chosen length.

    Attributes:
        study: The comparison.
        length: Length of the chosen segments [s]; None for whole recordings.
        theta: (p,) estimate of the fit over the chosen length [theta-unit].
    """

    study: HorizonStudy
    length: float | None
    theta: Array


@dataclass(frozen=True, kw_only=True, eq=False)
class _LengthFit:
    """Fit over segments of one length.

    Attributes:
        length: Length of the segments [s]; None for whole recordings.
        theta: (p,) estimate [theta-unit].
        without: (K, p) estimates without each part of the data [theta-unit].
    """

    length: float | None
    theta: Array
    without: Array


def choose_horizon(
    search: FitSearch, problem: FitProblem, whole: WholeFit, null_space: NullSpace
) -> HorizonChoice | None:
    """Compare lengths of segments by predictions of left-out data, and choose one.

    Args:
        search: The searches of the identification.
        problem: Problem of the whole recordings, with the stated noise.
        whole: Its solution.
        null_space: Combinations of parameters that the fit holds.

    Returns:
        The choice; None after a request to stop, where fewer than two lengths are possible, and
        where parameters move the stated initial state, which segments do not have.
    """
    task = search.task
    parameters = task.system.parameters
    if parameters.initial_state_derivative(task.system.space.nx).any():
        return None

    try:
        study = _Study(search=search, problem=problem, whole=whole, null_space=null_space)
        return study.choice()
    except InterruptedPassError:
        return None


@dataclass(frozen=True, kw_only=True, eq=False)
class _Study:
    """Fits and predictions of one comparison.

    Attributes:
        search: The searches of the identification.
        problem: Problem of the whole recordings, with the stated noise.
        whole: Its solution.
        null_space: Combinations of parameters that the fits hold.
    """

    search: FitSearch
    problem: FitProblem
    whole: WholeFit
    null_space: NullSpace

    @property
    def task(self) -> FitTask:
        """The task of the identification."""
        return self.search.task

    def choice(self) -> HorizonChoice | None:
        """Compare all lengths."""
        problems = self._problems()
        parts = _parts(self.problem)
        fits: list[_LengthFit] = []
        kept: list[FitProblem] = []
        for number, (length, problem) in enumerate(problems):
            begin_stage("comparing lengths of the segments", number, len(problems))
            found = self._fitted(length, problem, parts)
            if self.search.interrupted():
                return None
            if found is not None:
                fits.append(found)
                kept.append(problem)
        if len(fits) < 2:
            return None

        # Losses of each fit over each horizon.
        losses = [[self._losses(fit, problem, parts) for problem in kept] for fit in fits]
        if self.search.interrupted():
            return None
        chosen = _chosen([_over_all_horizons(losses, i) for i in range(len(fits))])
        return HorizonChoice(
            study=self._study(fits, losses, chosen),
            length=fits[chosen].length,
            theta=fits[chosen].theta,
        )

    def _problems(self) -> list[tuple[float | None, FitProblem]]:
        """Lengths of segments [s], shortest first, and their problems; None for the whole."""
        noise = self.whole.problem.noise
        found: list[tuple[float | None, FitProblem]] = []
        for length in segment_lengths(self.problem.recordings):
            part = problem_of_segments(self.problem, self.task, self.task.system, length)
            if part is not None:
                found.append((length, part))
        if self.problem.sample_count <= MAX_WHOLE_SAMPLES:
            found.append((None, self.problem))

        theta = self.task.start
        return [
            (length, _affordable(part.with_noise(noise)).pinned(theta, self.null_space))
            for length, part in found
        ]

    def _fitted(
        self, length: float | None, problem: FitProblem, parts: Sequence[LeftOutPart]
    ) -> _LengthFit | None:
        """Fit segments of a length, also without each part; None where a simulation diverges."""
        theta = self.whole.problem.theta(self.whole.solution.unknowns)
        name = "whole recordings" if length is None else f"segments of {length:.2g} s"
        begin = self.search.with_initial_states(problem, problem.begin(theta))
        try:
            weighted, solution = self.search.solve(
                problem, begin, f"comparison, {name}", is_rough=True
            )
        except SimulationDivergedError:
            return None

        without = self._without_parts(weighted, solution, parts)
        if without is None:
            return None
        return _LengthFit(length=length, theta=weighted.theta(solution.unknowns), without=without)

    def _without_parts(
        self, problem: FitProblem, solution: Solution, parts: Sequence[LeftOutPart]
    ) -> Array | None:
        """(K, p) estimates without each part; None where one of them is not possible."""
        found = []
        for step in leave_out_steps(problem, solution, parts):
            others = fit_to_others(problem, step, self.search.budget)
            if others is None:
                return None
            found.append(problem.theta(others.unknowns))
        return np.array(found)

    def _losses(
        self, fit: _LengthFit, problem: FitProblem, parts: Sequence[LeftOutPart]
    ) -> HeldOutLosses:
        """Losses of a fit over one horizon: that of a problem.

        Args:
            fit: The fit.
            problem: Problem of segments as long as the horizon.
            parts: Parts of the data that are predicted from the others.
        """
        pieces = sum(len(part.recordings) for part in parts)
        blocks = -(-BLOCKS // max(pieces, 1))
        found = []
        for part, theta in zip(parts, fit.without, strict=True):
            masks = part.masks(problem)
            predicted, at = with_initial_states(problem, theta, masks, self.search.budget)
            y = predicted.predict(at)
            sigma = self.problem.noise.sigma
            losses, counts = losses_by_block(problem, y, masks, part.recordings, blocks, sigma)
            found.append((losses, counts))

        return HeldOutLosses(
            losses=np.concatenate([losses for losses, _ in found]),
            counts=np.concatenate([counts for _, counts in found]),
            parts=np.repeat(np.arange(len(found)), [len(losses) for losses, _ in found]),
            estimates=fit.without,
        )

    def _study(
        self, fits: Sequence[_LengthFit], losses: Sequence[Sequence[HeldOutLosses]], chosen: int
    ) -> HorizonStudy:
        """The record of the comparison."""
        longest = max(float(recording.t[-1]) for recording in self.problem.recordings)
        lengths = [longest if fit.length is None else fit.length for fit in fits]
        parameters = self.task.system.parameters
        is_apart = [_is_apart(fit, fits[chosen]) for fit in fits]
        return HorizonStudy(
            lengths=np.array(lengths),
            errors=np.array([[each.error for each in row] for row in losses]),
            chosen=chosen,
            is_whole=fits[-1].length is None,
            parameters=parameters.names,
            units=tuple(self.task.system.units),
            theta=np.array([fit.theta for fit in fits]),
            half_widths=np.array([_half_width(fit.without, CONFIDENCE) for fit in fits]),
            is_apart=np.array(is_apart),
        )


def _parts(problem: FitProblem) -> tuple[LeftOutPart, ...]:
    """Parts that are left out: groups of recordings, or stretches of a few ones."""
    count = len(problem.recordings)
    if count >= MAX_FOLDS:
        return tuple(left_out_parts(problem))

    parts = []
    for i, recording in enumerate(problem.recordings):
        bounds = np.linspace(0.0, float(recording.t[-1]), -(-MAX_FOLDS // count) + 1)
        ends = [*bounds[1:-1].tolist(), np.inf]
        for begin, end in zip(bounds[:-1].tolist(), ends, strict=True):
            name = f"{recording.name} from {begin:.3g} s"
            parts.append(LeftOutPart(name=name, recordings=(i,), begin=begin, end=end))
    return tuple(parts)


def _affordable(problem: FitProblem) -> FitProblem:
    """Segments of a problem, spread over the data, that can be simulated often."""
    count = len(problem.segments)
    wanted = max(int(MAX_SAMPLES * count / problem.sample_count), MAX_FOLDS)
    if wanted >= count:
        return problem
    return problem.of_segments(spread_over_data(count, wanted))


def _over_all_horizons(losses: Sequence[Sequence[HeldOutLosses]], index: int) -> HeldOutLosses:
    """Losses of one fit over all horizons, each relative to the smallest mean loss there.

    Args:
        losses: Losses of each fit over each horizon.
        index: Index of the fit.
    """
    row = losses[index]
    least = [
        min(each[h].error ** 2 for each in losses if np.isfinite(each[h].error))
        for h in range(len(row))
    ]
    scales = np.maximum(least, np.finfo(float).tiny)
    return HeldOutLosses(
        losses=np.concatenate([each.losses / s for each, s in zip(row, scales, strict=True)]),
        counts=np.concatenate([each.counts for each in row]),
        parts=np.concatenate([each.parts for each in row]),
        estimates=row[0].estimates,
    )


def _chosen(losses: Sequence[HeldOutLosses]) -> int:
    """Index of the longest segments whose predictions are not clearly worse than the best ones."""
    best = min(losses, key=lambda each: each.error)
    relevant = RELEVANT_SHARE * best.error**2
    good = []
    for i, each in enumerate(losses):
        reduction = each.reduction(best)
        if not (reduction.is_clear and reduction.mean > relevant):
            good.append(i)
    return max(good)


def _half_width(without: Array, confidence: float) -> Array:
    """(p,) half widths of intervals by the jackknife over K parts; NaN with fewer than two.

    Args:
        without: (K, p) values without each part.
        confidence: Probability that an interval holds the true value.
    """
    if len(without) < 2:
        return np.full(without.shape[1], np.nan)
    return student_quantile(len(without), confidence) * jackknife_std(without)


def _is_apart(fit: _LengthFit, chosen: _LengthFit) -> np.ndarray:
    """(p,) whether estimates differ by more than the scatter of their differences explains."""
    if fit is chosen or len(fit.without) < MIN_PARTS:
        return np.zeros(len(fit.theta), dtype=bool)
    allowed = _half_width(fit.without - chosen.without, 1.0 - SIGNIFICANCE)
    return np.asarray(np.abs(fit.theta - chosen.theta) > allowed)


def with_length(task: FitTask, length: float | Literal["whole"] | None) -> FitTask:
    """The task of fitting segments of a length.

    Args:
        task: The task.
        length: The length [s], or "whole"; None for a length that the fit chooses.
    """
    system = task.system
    settings = task.settings.model_copy(update={"segments": length})
    experiment = system.experiment.model_copy(update={"fit": settings})
    return replace(task, system=replace(system, experiment=experiment), settings=settings)

"""Losses of predictions of left-out data, by which models with different terms are compared.

Each part of the data is predicted by a fit to the other parts (cross-validation). The losses of two
models are compared block by block, because the errors of both are large in the same places: the
scatter of the differences between blocks gives the standard error of their mean.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from mjfim.arrays import Array, freeze
from mjfim.budget import Budget
from mjfim.identification.cross_validation import of_folds
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.jackknife import jackknife_std
from mjfim.identification.leave_out_fits import (
    LeaveOutStep,
    fit_to_others,
    leave_out_steps,
    predicted_part,
)
from mjfim.identification.left_out_parts import (
    MAX_FOLDS,
    LeftOutPart,
    affordable_part,
    left_out_parts,
)
from mjfim.optimize.levenberg_marquardt import Solution

# Number of blocks into which all data are divided. Errors of neighbouring samples are alike, those
# of different blocks nearly independent.
BLOCKS = 20

# Fewest segments in each left-out part of a single recording, and fewest parts that consist of
# segments.
MIN_SEGMENTS_PER_PART = 2
MIN_STRETCHES = 2

# Share of the mean loss below which a difference between two models does not count, however small
# its scatter is. Models that no data tell apart differ by where their searches ended.
EQUAL_LOSS = 1e-3


@dataclass(frozen=True, kw_only=True, eq=False)
class HeldOutLosses:
    """Losses of predictions of left-out data.

    Attributes:
        losses: (n,) sum of the loss in each block [squared standard deviations of the noise];
            infinite where the simulation diverges.
        counts: (n,) number of values in each block.
        parts: (n,) index of the left-out part to which each block belongs.
        estimates: (K, p) parameters from the data without each part [theta-unit].
    """

    losses: Array
    counts: Array
    parts: np.ndarray
    estimates: Array

    def __post_init__(self) -> None:
        freeze(self, "losses", "counts", "estimates")
        self.parts.setflags(write=False)

    @property
    def error(self) -> float:
        """Root mean loss of a value [standard deviations of the noise]."""
        return float(np.sqrt(self.losses.sum() / self.counts.sum()))

    def reduction(self, other: HeldOutLosses) -> Reduction:
        """By how much another model predicts the same data better than this one.

        Args:
            other: The losses of the other model on the same blocks.
        """
        if not np.isfinite(other.losses).all():
            return Reduction(mean=-np.inf, standard_error=np.inf)
        if not np.isfinite(self.losses).all():
            return Reduction(mean=np.inf, standard_error=0.0)

        # Blocks of one recording are alike where something differs from recording to recording, so
        # that the scatter between the parts counts as well.
        difference = self.losses - other.losses
        n_parts = int(self.parts.max()) + 1
        by_part = np.bincount(self.parts, difference, n_parts).astype(float)
        counts_by_part = np.bincount(self.parts, self.counts, n_parts).astype(float)
        standard_error = max(
            _standard_error(difference, self.counts), _standard_error(by_part, counts_by_part)
        )
        mean = float(difference.sum() / self.counts.sum())
        least = EQUAL_LOSS * float(min(self.losses.sum(), other.losses.sum()) / self.counts.sum())
        return Reduction(mean=mean, standard_error=standard_error, least=least)

    @property
    def jackknife(self) -> Array:
        """(p,) standard errors of the estimates by leaving out each part [theta-unit].

        NaN with fewer than two parts.
        """
        return jackknife_std(self.estimates)


@dataclass(frozen=True, kw_only=True)
class Reduction:
    """Reduction of the mean loss of a value by another model.

    Attributes:
        mean: The reduction; negative where the other model predicts worse.
        standard_error: Its standard error.
        least: Reduction below which both models predict equally well.
    """

    mean: float
    standard_error: float
    least: float = 0.0

    @property
    def is_clear(self) -> bool:
        """Whether the other model predicts better by more than one standard error."""
        return self.mean > max(self.standard_error, self.least)


def _standard_error(sums: Array, counts: Array) -> float:
    """Standard error of the mean of values of which sums over independent groups are known.

    The variance of the total is that of the sums around the common mean of a value; 0 with a single
    group.

    Args:
        sums: (n,) sums of the values of each group.
        counts: (n,) number of values in each group.
    """
    n = len(sums)
    if n < 2:
        return 0.0
    scatter = sums - sums.sum() / counts.sum() * counts
    variance = float(np.sum(scatter**2)) * n / (n - 1)
    return float(np.sqrt(variance) / counts.sum())


def held_out_losses(
    problem: FitProblem, solution: Solution, sigma: Array, budget: Budget
) -> HeldOutLosses | None:
    """Predict every part of the data by a fit to the other parts.

    Args:
        problem: Problem of all data, with the noise by which the fits weight them.
        solution: Its solution.
        sigma: (ny,) noise by which errors are divided before they are compared [y-unit]. It has to
            be the same for all models that are compared.
        budget: Ends the work early.

    Returns:
        The losses; None after a request to stop, and where there are no parts that can be left out.
    """
    problem, solution = affordable_part(problem, solution)
    parts = _parts(problem)
    pieces = sum(len(part.recordings) for part in parts)
    blocks = -(-BLOCKS // max(pieces, 1))
    steps = leave_out_steps(problem, solution, parts)
    folds = [partial(_losses_of_part, step=step, blocks=blocks, sigma=sigma) for step in steps]
    found = [losses for losses in of_folds(problem, folds, budget) if losses is not None]
    if budget.exhausted is not None or not found:
        return None

    return HeldOutLosses(
        losses=np.concatenate([each.losses for each in found]),
        counts=np.concatenate([each.counts for each in found]),
        parts=np.repeat(np.arange(len(found)), [len(each.losses) for each in found]),
        estimates=np.concatenate([each.estimates for each in found]),
    )


def _parts(problem: FitProblem) -> tuple[LeftOutPart, ...]:
    """Parts that are left out: groups of recordings, or stretches of a single recording."""
    if len(problem.recordings) > 1:
        return tuple(left_out_parts(problem))

    # Stretches begin with a segment where there are enough of them, because a segment whose initial
    # state is free is then predicted as a whole. Otherwise they have equal numbers of rows.
    recording = problem.recordings[0]
    rows = np.array([segment.rows.start for segment in problem.segments])
    if len(rows) < MIN_SEGMENTS_PER_PART * MIN_STRETCHES:
        rows = np.flatnonzero(problem.masks[0].any(axis=1))
        groups = min(MAX_FOLDS, len(rows))
    else:
        groups = min(MAX_FOLDS, len(rows) // MIN_SEGMENTS_PER_PART)
    times = [float(recording.t[group[0]]) for group in np.array_split(rows, groups)]
    return tuple(
        LeftOutPart(
            name=f"{recording.name} from {begin:.3g} s", recordings=(0,), begin=begin, end=end
        )
        for begin, end in zip(times, [*times[1:], np.inf], strict=True)
    )


def _losses_of_part(
    problem: FitProblem,
    budget: Budget,
    *,
    step: LeaveOutStep,
    blocks: int,
    sigma: Array,
) -> HeldOutLosses | None:
    """Losses of the prediction of one part by a fit to the others.

    Args:
        problem: Problem of all parts.
        budget: Ends the fit early.
        step: Step of the fit to all data to the fit without the part.
        blocks: Number of blocks into which each recording of the part is divided.
        sigma: (ny,) noise by which errors are divided [y-unit].

    Returns:
        The losses; None after a request to stop, and where the others cannot be fitted.
    """
    others = fit_to_others(problem, step, budget)
    if others is None:
        return None

    masks = step.part.masks(problem)
    predicted_problem, at = predicted_part(problem, others, masks, budget)
    predicted = predicted_problem.predict(at)
    if budget.exhausted is not None:
        return None

    losses, counts = losses_by_block(problem, predicted, masks, step.part.recordings, blocks, sigma)
    return HeldOutLosses(
        losses=losses,
        counts=counts,
        parts=np.zeros(len(counts), dtype=np.intp),
        estimates=problem.theta(others.unknowns)[None],
    )


def losses_by_block(
    problem: FitProblem,
    predicted: Sequence[Array] | None,
    masks: Sequence[np.ndarray],
    recordings: Sequence[int],
    blocks: int,
    sigma: Array,
) -> tuple[Array, Array]:
    """Losses of predictions, summed over blocks of rows.

    Args:
        problem: Problem with the recordings.
        predicted: (M, ny) predicted outputs of every recording [y-unit]; None where the simulation
            diverges.
        masks: (M, ny) for every recording, True for the predicted values.
        recordings: Indices of the recordings.
        blocks: Number of blocks into which each recording is divided.
        sigma: (ny,) noise by which errors are divided [y-unit].

    Returns:
        (n,) sums of the loss, infinite where the simulation diverges, and (n,) numbers of values.
    """
    losses: list[float] = []
    counts: list[float] = []
    for i in recordings:
        rows = np.flatnonzero(masks[i].any(axis=1))
        for block in np.array_split(rows, min(blocks, len(rows)) or 1):
            counted = masks[i][block]
            counts.append(float(counted.sum()))
            if predicted is None:
                losses.append(np.inf)
                continue
            error = (predicted[i][block] - problem.recordings[i].y[block]) / sigma
            losses.append(problem.loss.value(error[counted]))
    return np.array(losses), np.array(counts)

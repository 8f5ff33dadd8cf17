"""Data that are left out of a fit or held out, and their prediction by the fit to the others.

A step of the fit to all data leads close to the fit without a part, because its linearisation
contains the rows of every block (the infinitesimal jackknife, Giordano et al., A Swiss army
infinitesimal jackknife, 2019). One simulation of the other data shows whether it does; otherwise a
search follows. Models with different terms are compared by the losses of these predictions. The
initial state of a predicted part is estimated from that part.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import TypeVar

import numpy as np

from mjfim.arrays import Array, evenly_spread_indices, record
from mjfim.experiment.arguments import checked
from mjfim.experiment.given import RecordingsLike, recordings_of
from mjfim.experiment.schema import ExperimentLike
from mjfim.experiment.system import System
from mjfim.identification.assessment.honest_covariance import jackknife_std
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.fit_workers import ProblemWork
from mjfim.identification.search import of_subset
from mjfim.optimize.levenberg_marquardt import (
    WEAK_DAMPING,
    SearchSettings,
    Solution,
    UnknownValues,
    minimise,
)
from mjfim.parallel import one_blas_thread
from mjfim.parallel.budget import Budget
from mjfim.records.estimate import Prediction, PredictionErrors
from mjfim.records.events import begin_stage

T = TypeVar("T")

# Largest number of groups of recordings that are left out in turn.
MAX_FOLDS = 5

# Share of a single recording, at its end, that is predicted from the part before.
PREDICTED_SHARE = 0.25

# Largest number of samples in a cross-validation; of more data, a subset of the segments is used.
MAX_SAMPLES = 200_000

# Settings of the searches for theta without a part of the data, and for initial states. Few
# iterations are enough, because these searches begin close to their result, and errors of
# predictions hardly change with a step that lowers the cost by a ten-thousandth. Initial states may
# miss ten times as much: the errors of the tested predictions change by 1e-4 of their size.
SEARCH = SearchSettings(
    max_iterations=8,
    tolerance=1e-2,
    relinearise_at_end=False,
    rough_share=1e-4,
    stagnant_share=1e-3,
)
INITIAL_STATES = replace(SEARCH, rough_share=1e-3)

# First rows of a segment that show its initial state. Later ones hardly do, and cost time.
INITIAL_STATE_ROWS = 500

# Share of the predicted decrease of the cost that a step to the fit without a part may miss. The
# errors of predictions hardly change with what is left of it.
ALLOWED_SHARE = 0.1

# Dampings of the steps that are tried in turn. A step without damping is long in directions that
# the data hardly determine, in which the linearisation does not hold so far.
DAMPINGS = (WEAK_DAMPING, 1e-4, 1e-3, 1e-2)

# Share of the decrease by the step without damping that a damped one has to predict.
ENOUGH_SHARE = 0.7


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
class LeftOutPart:
    """A part of the data that is left out of a fit.

    Attributes:
        name: Name of the part for the user. A worker does not know it: the problem there has only
            the recordings that it needs, which may have other names.
        recordings: Indices of the recordings that contain the part.
        begin: Time at which the part begins in each of them [s].
        end: Time before which it ends [s].
    """

    name: str
    recordings: tuple[int, ...]
    begin: float = -np.inf
    end: float = np.inf

    def masks(self, problem: FitProblem) -> list[np.ndarray]:
        """(M, ny) for every recording, True for the values of the part.

        Args:
            problem: Problem of all parts.
        """
        masks = masks_of(problem.masks, self.recordings)
        for i in self.recordings:
            t = problem.recordings[i].t
            masks[i] = masks[i] & ((t >= self.begin) & (t < self.end))[:, None]
        return masks


def masks_of(masks: Sequence[np.ndarray], recordings: Sequence[int]) -> list[np.ndarray]:
    """The masks of some recordings; False for all values of the others."""
    return [mask if i in recordings else np.zeros_like(mask) for i, mask in enumerate(masks)]


def left_out_parts(problem: FitProblem) -> Iterator[LeftOutPart]:
    """Parts of the data that are left out in turn.

    They are groups of recordings, or the end of a single recording.
    """
    count = len(problem.recordings)
    if count == 1:
        recording = problem.recordings[0]
        yield LeftOutPart(
            name=f"last {100 * PREDICTED_SHARE:.0f} % of {recording.name}",
            recordings=(0,),
            begin=(1.0 - PREDICTED_SHARE) * float(recording.t[-1]),
        )
        return

    for group in np.array_split(np.arange(count), min(count, MAX_FOLDS)):
        indices = tuple(group.tolist())
        name = ", ".join(problem.recordings[i].name for i in indices)
        yield LeftOutPart(name=name, recordings=indices)


def affordable_part(problem: FitProblem, solution: Solution) -> tuple[FitProblem, Solution]:
    """All segments of a problem; of much data, evenly spread ones, which are enough.

    Args:
        problem: Problem of all segments.
        solution: Its solution.

    Returns:
        The problem of the segments, and the solution with their unknowns and their linearisation.
    """
    count = len(problem.segments)
    if problem.sample_count <= MAX_SAMPLES or count == 1:
        return problem, solution

    wanted = max(MAX_SAMPLES * count // problem.sample_count, 2)
    subset = evenly_spread_indices(count, wanted)
    part = replace(
        solution,
        unknowns=of_subset(solution.unknowns, subset),
        condensed=solution.condensed.of_segments(subset),
    )
    return problem.of_segments(subset), part


def _other_values(problem: FitProblem, masks: Sequence[np.ndarray]) -> list[np.ndarray]:
    """Masks of the values that are not in some masks: (M, ny) for every recording.

    A segment that has no others keeps its values.
    """
    known = [np.zeros_like(mask) for mask in masks]
    for segment in problem.segments:
        i, rows = segment.recording, segment.rows
        counted = problem.masks[i][rows]
        others = counted & ~masks[i][rows]
        known[i][rows] = others if others.any() else counted
    return known


def with_initial_states(
    problem: FitProblem, theta: Array, masks: Sequence[np.ndarray], budget: Budget
) -> tuple[FitProblem, UnknownValues]:
    """The segments with values in some masks: (M, ny) for every recording, and their unknowns.

    Unknown initial states are estimated from the other values of a segment, or from the predicted
    ones where it has no others. theta: (p,).
    """
    problem = problem.of_segments(problem.masked(masks).segments_with_values)
    at = problem.begin(theta)
    if problem.unknown_count <= len(problem.shared):
        return problem, at

    # Deviations of the initial state that were fitted belong to other recordings.
    begin = replace(at, private=problem.begin(problem.parameters.guess).private)
    held = problem.masked(_other_values(problem, masks)).with_shared_held()
    first = held.of_first_parts(1.0, INITIAL_STATE_ROWS)
    if len(first.segments_with_values) == len(held.segments):
        held = first
    found = minimise(held, begin, INITIAL_STATES, budget)
    return problem, at if found is None else found.unknowns


def fit_without(
    problem: FitProblem, budget: Budget, *, solution: Solution, part: LeftOutPart
) -> UnknownValues | None:
    """Fit theta to all data but one part.

    Args:
        problem: Problem of all parts.
        budget: Ends the fit early.
        solution: Its solution.
        part: The part that is left out.

    Returns:
        The unknowns; None where there are no other data, where the simulation diverges, and after a
        request to stop.
    """
    masks = part.masks(problem)
    others = problem.masked([~mask for mask in masks])
    segments = others.segments_with_values
    if not len(segments):
        return None
    others = others.of_segments(segments)

    # A step is the fit if it lowers the cost nearly as far as the linearisation predicts.
    at, condensed = solution.unknowns, solution.condensed
    begin = of_subset(at, segments)
    cost = others.cost(begin)
    starts = [(cost, begin)]
    remaining = condensed.without_blocks(problem.blocks_containing(masks))
    values = problem.common_values(at)
    lower, upper = problem.lower - values, problem.upper - values
    first = 0.0
    for damping in DAMPINGS:
        step = remaining.step(damping, condensed.column_norms, lower, upper)
        first = max(first, step.predicted_decrease)
        if step.predicted_decrease < ENOUGH_SHARE * first:
            break
        moved = problem.moved(at, step, 1.0)
        end = of_subset(moved, segments)
        cost_at_end = others.cost(end)
        missed = cost_at_end - (cost - step.predicted_decrease)
        if missed <= max(ALLOWED_SHARE * step.predicted_decrease, SEARCH.rough_share * cost):
            return None if budget.exhausted is not None else moved
        starts.append((cost_at_end, end))

    # The data that are left out may have led the estimate to a minimum that the others lack.
    guess = others.begin(problem.parameters.guess)
    starts.append((others.cost(guess), guess))
    # Of long logs, a search takes long, and the end of a step that lowers the cost is near enough.
    least, best = min(starts, key=lambda start: start[0])
    if problem.system.experiment.fit.seconds is not None and least < cost:
        return None if budget.exhausted is not None else best
    found = minimise(others, best, SEARCH, budget)
    return None if found is None or budget.exhausted is not None else found.unknowns


def of_parts(problem: FitProblem, works: Sequence[ProblemWork[T]], budget: Budget) -> Iterator[T]:
    """Yield the results of a work on each left-out part, here or side by side on workers.

    Args:
        problem: Problem of all parts.
        works: The works on it.
        budget: Ends them early.
    """
    begin_stage("predicting each part from the others", 0, len(works))
    for number, result in enumerate(problem.of_whole(works, budget), start=1):
        if number < len(works):
            begin_stage("predicting each part from the others", number, len(works))
        yield result


# ---- losses


@record
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

    @property
    def error(self) -> float:
        """Root mean loss of a value [standard deviations of the noise]."""
        return float(np.sqrt(self.losses.sum() / self.counts.sum()))

    def reduction(self, other: HeldOutLosses) -> tuple[float, float]:
        """Reduction of the mean loss of a value by another model.

        Args:
            other: The losses of the other model on the same blocks.

        Returns:
            The reduction, negative where the other model predicts worse, and its standard error.
        """
        if not np.isfinite(other.losses).all():
            return -np.inf, np.inf
        if not np.isfinite(self.losses).all():
            return np.inf, 0.0

        # Blocks of one recording are alike where something differs from recording to recording, so
        # that the scatter between the parts counts as well.
        difference = self.losses - other.losses
        by_part, counts_by_part = (
            np.bincount(self.parts, each).astype(float) for each in (difference, self.counts)
        )
        standard_error = max(
            _standard_error(difference, self.counts), _standard_error(by_part, counts_by_part)
        )
        return float(difference.sum() / self.counts.sum()), standard_error

    def is_clearly_above(self, other: HeldOutLosses) -> bool:
        """Whether another model predicts the same data better by more than one standard error.

        Args:
            other: The losses of the other model on the same blocks.
        """
        mean, standard_error = self.reduction(other)
        least = EQUAL_LOSS * min(self.losses.sum(), other.losses.sum()) / self.counts.sum()
        return bool(mean > max(standard_error, least))

    @property
    def jackknife(self) -> Array:
        """(p,) standard errors of the estimates by leaving out each part [theta-unit].

        NaN with fewer than two parts.
        """
        return jackknife_std(self.estimates)


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
    problem: FitProblem,
    solution: Solution,
    sigma: Array,
    budget: Budget,
    to_beat: HeldOutLosses | None = None,
) -> HeldOutLosses | None:
    """Predict every part of the data by a fit to the other parts.

    A model whose losses on some parts exceed those of another model on all parts cannot predict
    better. The other parts are not predicted then, and count as predicted without error.

    Args:
        problem: Problem of all data, with the noise by which the fits weight them.
        solution: Its solution.
        sigma: (ny,) noise by which errors are divided before they are compared [y-unit]. It has to
            be the same for all models that are compared.
        budget: Ends the work early.
        to_beat: Losses of a model that predicts the same blocks; None to predict all parts.

    Returns:
        The losses; None after a request to stop, and where there are no parts that can be left out.
    """
    problem, solution = affordable_part(problem, solution)
    parts = _parts(problem)
    work = partial(_losses_of_part, solution=solution, blocks=blocks_of(parts), sigma=sigma)
    works = [partial(work, part=part) for part in parts]
    found: list[HeldOutLosses] = []
    lost, most = 0.0, np.inf if to_beat is None else to_beat.losses.sum()
    for losses in of_parts(problem, works, budget):
        if losses is not None:
            found.append(losses)
            lost += losses.losses.sum()
        if lost > most:
            break
    if budget.exhausted is not None or not found:
        return None
    joined = joined_losses(found)
    if to_beat is None or lost <= most:
        return joined
    unpredicted = np.zeros(len(to_beat.losses) - len(joined.losses))
    all_losses = np.concatenate([joined.losses, unpredicted])
    return replace(to_beat, losses=all_losses, estimates=joined.estimates)


def _parts(problem: FitProblem) -> tuple[LeftOutPart, ...]:
    """Parts that are left out: groups of recordings, or stretches of a single recording."""
    if len(problem.recordings) > 1:
        return tuple(left_out_parts(problem))

    # Stretches begin with a segment where there are enough of them, because a segment whose initial
    # state is free is then predicted as a whole. Otherwise they have equal numbers of rows.
    recording = problem.recordings[0]
    rows, least = np.array([each.rows.start for each in problem.segments]), MIN_SEGMENTS_PER_PART
    if len(rows) < MIN_SEGMENTS_PER_PART * MIN_STRETCHES:
        rows, least = np.flatnonzero(problem.masks[0].any(axis=1)), 1
    groups = np.array_split(rows, min(MAX_FOLDS, len(rows) // least))
    times = [float(recording.t[group[0]]) for group in groups]
    return stretches_of(recording.name, 0, times)


def stretches_of(name: str, recording: int, times: Sequence[float]) -> tuple[LeftOutPart, ...]:
    """Stretches of a recording, each of which ends where the next one begins.

    Args:
        name: Name of the recording.
        recording: Its index.
        times: Times at which the stretches begin [s].
    """
    return tuple(
        LeftOutPart(
            name=f"{name} from {begin:.3g} s", recordings=(recording,), begin=begin, end=end
        )
        for begin, end in zip(times, [*times[1:], np.inf], strict=True)
    )


def _losses_of_part(
    problem: FitProblem,
    budget: Budget,
    *,
    solution: Solution,
    part: LeftOutPart,
    blocks: int,
    sigma: Array,
) -> HeldOutLosses | None:
    """Losses of the prediction of one part by a fit to the others; None without others."""
    others = fit_without(problem, budget, solution=solution, part=part)
    if others is None:
        return None
    found = losses_of(problem, others.theta, part, blocks, sigma, budget)
    if budget.exhausted is not None:
        return None
    return replace(found, estimates=problem.theta(others)[None])


def joined_losses(found: Sequence[HeldOutLosses]) -> HeldOutLosses:
    """The losses of all left-out parts."""
    return HeldOutLosses(
        losses=np.concatenate([each.losses for each in found]),
        counts=np.concatenate([each.counts for each in found]),
        parts=np.repeat(np.arange(len(found)), [len(each.losses) for each in found]),
        estimates=np.concatenate([each.estimates for each in found]),
    )


def blocks_of(parts: Sequence[LeftOutPart]) -> int:
    """Number of blocks into which each recording of each part is divided."""
    pieces = sum(len(part.recordings) for part in parts)
    return -(-BLOCKS // max(pieces, 1))


def losses_of(
    problem: FitProblem, theta: Array, part: LeftOutPart, blocks: int, sigma: Array, budget: Budget
) -> HeldOutLosses:
    """Losses of the prediction of one part at theta, summed over blocks of rows.

    Args:
        problem: Problem with the recordings.
        theta: (p,) parameters.
        part: The part.
        blocks: Number of blocks into which each recording is divided.
        sigma: (ny,) noise by which errors are divided [y-unit].
        budget: Ends the search for initial states early.
    """
    masks = part.masks(problem)
    predicting, at = with_initial_states(problem, theta, masks, budget)
    predicted = predicting.predict(at)
    losses = []
    counts = []
    for i in part.recordings:
        rows = np.flatnonzero(masks[i].any(axis=1))
        for block in np.array_split(rows, min(blocks, len(rows)) or 1):
            counted = masks[i][block]
            counts.append(float(counted.sum()))
            if predicted is None:
                losses.append(np.inf)
                continue
            error = (predicted[i][block] - problem.recordings[i].y[block]) / sigma
            losses.append(problem.loss.value(error[counted]))
    return HeldOutLosses(
        losses=np.array(losses),
        counts=np.array(counts),
        parts=np.zeros(len(counts), dtype=np.intp),
        estimates=theta[None],
    )


@checked
@one_blas_thread()
def predict(
    experiment: ExperimentLike,
    theta: Array,
    recordings: RecordingsLike,
    *,
    threads: int | None = None,
) -> tuple[PredictionErrors, ...]:
    """Prediction errors of a model on recordings.

    Theta is given. Only the unknowns of each recording are estimated, for example its initial
    state.

    Args:
        experiment: Model, parameters and noise.
        theta: (p,) parameter values [theta-unit].
        recordings: Recordings to predict.
        threads: Threads for the engine; default: one per core.

    Returns:
        The errors for each recording.

    Raises:
        ExperimentError: Something is wrong in the experiment.
        RecordingError: A recording cannot be used.
    """
    system = System.resolve(experiment, threads=threads)
    values = system.theta_of("theta", theta)
    problem = FitProblem.of(system, recordings_of(system, recordings))
    return tuple(
        _predicted(problem, values, masks_of(problem.masks, [i]), recording.name, Budget())[0]
        for i, recording in enumerate(problem.recordings)
    )


def predict_unfitted(
    problem: FitProblem, solution: Solution, held_out: FitProblem | None, budget: Budget
) -> tuple[Prediction, ...]:
    """Predict data that were not fitted.

    These are the held-out recordings. Without any, every part of the data is predicted from the
    other parts.

    Args:
        problem: Problem of the fitted recordings.
        solution: Its solution.
        held_out: Problem of held-out recordings; None without any.
        budget: When it is exhausted, only the predictions that were made before are returned.

    Returns:
        The predictions.
    """
    if held_out is None:
        return tuple(_cross_validate(problem, solution, budget))
    return tuple(_predict_held_out(held_out, solution.unknowns.theta, budget))


def _predict_held_out(held_out: FitProblem, theta: Array, budget: Budget) -> Iterator[Prediction]:
    """Prediction of every held-out recording at theta: (p,)."""
    for i in range(len(held_out.recordings)):
        if budget.exhausted is not None:
            return
        begin_stage("predicting held-out recordings", i, len(held_out.recordings))
        name, masks = held_out.recordings[i].name, masks_of(held_out.masks, [i])
        prediction, outputs = _prediction(held_out, theta, masks, name, budget)
        identified, nominal = (each[i] for each in outputs)
        yield replace(
            prediction, held_out=True, identified_outputs=identified, nominal_outputs=nominal
        )


def _cross_validate(
    problem: FitProblem, solution: Solution, budget: Budget
) -> Iterator[Prediction]:
    """Prediction of every part of the data by a fit to the others."""
    whole = problem
    problem, solution = affordable_part(problem, solution)
    parts = []
    for part in left_out_parts(problem):
        tested, count = (
            sum(segment.recording in part.recordings for segment in each.segments)
            for each in (problem, whole)
        )
        note = "" if tested == count else f" ({tested} of {count} segments)"
        if tested:
            parts.append(replace(part, name=part.name + note))
    works = [partial(_prediction_by_others, solution=solution, part=part) for part in parts]
    for prediction in of_parts(problem, works, budget):
        if budget.exhausted is not None:
            return
        if prediction is not None:
            yield prediction


def _prediction_by_others(
    problem: FitProblem, budget: Budget, *, solution: Solution, part: LeftOutPart
) -> Prediction | None:
    """Prediction of one part of the data by a fit to the others; None without others.

    The fitted recordings are in the estimate anyway, so that only errors are kept.
    """
    others = fit_without(problem, budget, solution=solution, part=part)
    if others is None:
        return None
    return _prediction(problem, others.theta, part.masks(problem), part.name, budget)[0]


def _prediction(
    problem: FitProblem, theta: Array, masks: Sequence[np.ndarray], name: str, budget: Budget
) -> tuple[Prediction, tuple[list[Array], list[Array]]]:
    """The prediction of the values in some masks, and the outputs of both models; see `_predicted`.

    The models are those at theta: (p,) and at the guess.
    """
    errors, outputs = _predicted(problem, theta, masks, name, budget)
    guess = problem.parameters.guess
    nominal, nominal_outputs = _predicted(problem, guess, masks, name, budget)
    prediction = Prediction(name=name, identified=errors, nominal=nominal, held_out=False)
    return prediction, (outputs, nominal_outputs)


def _predicted(
    problem: FitProblem, theta: Array, masks: Sequence[np.ndarray], name: str, budget: Budget
) -> tuple[PredictionErrors, list[Array]]:
    """Predict the values in some masks: (M, ny) for every recording, at theta: (p,).

    Returns:
        The errors, and for every recording the (M, ny) outputs, NaN where the model diverges.
    """
    part, at = with_initial_states(problem, theta, masks, budget)
    predicted = part.predict(at)
    names = problem.system.outputs.names
    rms, mae = np.full((2, len(names)), np.nan)
    counted = part.masked(masks)
    for j in range(len(names)):
        errors = np.zeros(0) if predicted is None else counted.errors_of(j, predicted)
        if len(errors):
            rms[j] = np.sqrt(np.mean(errors**2))
            mae[j] = np.mean(np.abs(errors))
    found = PredictionErrors(name=name, outputs=names, rms=rms, mae=mae)
    return found, predicted or [np.full(mask.shape, np.nan) for mask in masks]

"""Predictions of data that were not fitted, by the identified and by the nominal model.

Without held-out recordings, parts of the fitted ones are left out in turn, and theta is fitted to
the other parts. The initial state of a predicted part is estimated from that part, for both models.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from contextlib import suppress
from dataclasses import dataclass, replace
from functools import partial

import numpy as np

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.budget import Budget
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.batch_workers import LARGEST_SENT_BYTES, ProblemWork
from mjfim.identification.fit_problem import FitProblem
from mjfim.optimize.levenberg_marquardt import (
    InterruptedPassError,
    SearchSettings,
    UnknownValues,
    minimise,
)
from mjfim.parallel import one_blas_thread
from mjfim.records.estimate import Prediction, PredictionErrors
from mjfim.records.progress import begin_stage
from mjfim.records.recording import Recording

# Largest number of groups of recordings that are left out in turn.
MAX_FOLDS = 5

# Share of a single recording, at its end, that is predicted from the part before.
PREDICTED_SHARE = 0.25

# Largest number of samples in a cross-validation; of more data, a subset of the segments is used.
MAX_SAMPLES = 200_000

# Settings of the searches for theta without a part of the data, and for initial states. Few
# iterations are enough, because these searches begin close to their result, and errors of
# predictions hardly change with a step that lowers the cost by a ten-thousandth.
SEARCH = SearchSettings(
    max_iterations=8, tolerance=1e-2, relinearise_at_end=False, rough_share=1e-4
)


@one_blas_thread()
def predict(
    experiment: Experiment,
    theta: Array,
    recordings: Sequence[Recording],
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
    problem = FitProblem.of(system, recordings)
    values = np.asarray(theta)
    return tuple(
        _errors(problem, values, _masks_of(problem.masks, [i]), recording.name, Budget())
        for i, recording in enumerate(problem.recordings)
    )


def predict_unfitted(
    problem: FitProblem, at: UnknownValues, held_out: FitProblem | None, budget: Budget
) -> tuple[Prediction, ...]:
    """Predict data that were not fitted.

    These are the held-out recordings. Without any, every part of the data is predicted from the
    other parts.

    Args:
        problem: Problem of the fitted recordings.
        at: Its solution.
        held_out: Problem of held-out recordings; None without any.
        budget: When it is exhausted, only the predictions that were made before are returned.

    Returns:
        The predictions.
    """
    found = (
        _cross_validate(problem, at, budget)
        if held_out is None
        else _predict_held_out(held_out, at, budget)
    )
    predictions: list[Prediction] = []
    with suppress(InterruptedPassError):
        predictions.extend(found)
    return tuple(predictions)


def _predict_held_out(
    held_out: FitProblem, at: UnknownValues, budget: Budget
) -> Iterator[Prediction]:
    """Prediction of every held-out recording."""
    for i in range(len(held_out.recordings)):
        if budget.exhausted is not None:
            return
        begin_stage("predicting held-out recordings", i, len(held_out.recordings))
        part = _Part(name=held_out.recordings[i].name, recordings=(i,))
        yield _prediction(held_out, at.theta, part, True, budget)


@dataclass(frozen=True, kw_only=True, eq=False)
class _Part:
    """A part of the data that is predicted.

    Attributes:
        name: Name of the part for the user. A worker does not know it: the problem there has only
            the recordings that it needs, which may have other names.
        recordings: Indices of the recordings that contain the part.
        is_end: True for the end of these recordings alone.
    """

    name: str
    recordings: tuple[int, ...]
    is_end: bool = False

    def masks(self, problem: FitProblem) -> list[np.ndarray]:
        """(M, ny) for every recording, True for the values of the part.

        Args:
            problem: Problem of all parts.
        """
        masks = _masks_of(problem.masks, self.recordings)
        if not self.is_end:
            return masks

        for i in self.recordings:
            t = problem.recordings[i].t
            masks[i] = masks[i] & (t >= (1.0 - PREDICTED_SHARE) * t[-1])[:, None]
        return masks


def _cross_validate(problem: FitProblem, at: UnknownValues, budget: Budget) -> Iterator[Prediction]:
    """Prediction of every part of the data by a fit to the others."""
    # With much data, a subset of evenly spread segments is enough.
    whole = problem
    count = len(problem.segments)
    if problem.sample_count > MAX_SAMPLES and count > 1:
        wanted = max(MAX_SAMPLES * count // problem.sample_count, 2)
        subset = evenly_spread_indices(count, wanted)
        problem = problem.of_segments(subset)
        at = replace(at, private=at.private[subset])

    parts = [
        replace(part, name=part.name + _note_of_subset(part.recordings, problem, whole))
        for part in _parts(problem)
        if any(segment.recording in part.recordings for segment in problem.segments)
    ]
    folds = [partial(_prediction_by_others, at=at, part=part) for part in parts]
    for prediction in _of_folds(problem, folds, budget):
        if budget.exhausted is not None:
            return
        if prediction is not None:
            yield prediction


def _of_folds(
    problem: FitProblem, folds: Sequence[ProblemWork[Prediction | None]], budget: Budget
) -> Iterator[Prediction | None]:
    """Predictions of all parts, in one process or side by side on workers."""
    # A worker that does a whole fold waits for nobody, but needs all recordings. Where they are
    # large, or where there would be nothing to do for many workers, the workers share each pass
    # over the data instead.
    workers = problem.workers
    is_large = problem.recording_bytes > LARGEST_SENT_BYTES
    found: Iterable[Prediction | None]
    if workers is None or is_large or len(folds) < workers.count:
        found = (fold(problem, budget) for fold in folds)
    else:
        found = workers.of_whole(problem, folds, budget)

    begin_stage("predicting each part from the others", 0, len(folds))
    for number, prediction in enumerate(found, start=1):
        if number < len(folds):
            begin_stage("predicting each part from the others", number, len(folds))
        yield prediction


def _prediction_by_others(
    problem: FitProblem, budget: Budget, *, at: UnknownValues, part: _Part
) -> Prediction | None:
    """Prediction of one part of the data by a fit to the others.

    Args:
        problem: Problem of all parts.
        budget: Ends the fit early.
        at: Unknowns at the fit to all parts.
        part: The part.

    Returns:
        The prediction; None where there are no other data, where the simulation diverges, and after
        a request to stop.
    """
    others = problem.masked([~mask for mask in part.masks(problem)])
    segments = others.segments_with_values
    if not len(segments):
        return None

    # The data that are left out may have led the estimate to a minimum that the others lack. The
    # fit to the others then begins at the guess.
    others = others.of_segments(segments)
    guess = problem.system.parameters.guess
    begins = [replace(at, private=at.private[segments]), others.begin(guess)]
    found = minimise(others, min(begins, key=others.cost), SEARCH, budget)
    if found is None or budget.exhausted is not None:
        return None
    return _prediction(problem, found.unknowns.theta, part, False, budget)


def _parts(problem: FitProblem) -> Iterator[_Part]:
    """Parts of the data that are left out in turn.

    They are groups of recordings, or the end of a single recording.
    """
    count = len(problem.recordings)
    if count == 1:
        name = f"last {100 * PREDICTED_SHARE:.0f} % of {problem.recordings[0].name}"
        yield _Part(name=name, recordings=(0,), is_end=True)
        return

    for group in np.array_split(np.arange(count), min(count, MAX_FOLDS)):
        indices = tuple(group.tolist())
        name = ", ".join(problem.recordings[i].name for i in indices)
        yield _Part(name=name, recordings=indices)


def _note_of_subset(recordings: Sequence[int], subset: FitProblem, whole: FitProblem) -> str:
    """How many segments of some recordings are in a subset; empty where all of them are."""
    tested, count = (
        sum(segment.recording in recordings for segment in problem.segments)
        for problem in (subset, whole)
    )
    return "" if tested == count else f" ({tested} of {count} segments)"


def _masks_of(masks: Sequence[np.ndarray], recordings: Sequence[int]) -> list[np.ndarray]:
    """The masks of some recordings; False for all values of the others."""
    return [mask if i in recordings else np.zeros_like(mask) for i, mask in enumerate(masks)]


def _prediction(
    problem: FitProblem, theta: Array, part: _Part, held_out: bool, budget: Budget
) -> Prediction:
    """Errors of the model at theta: (p,), and of the nominal model, on a part of the data."""
    name, masks = part.name, part.masks(problem)
    guess = problem.system.parameters.guess

    # The fitted recordings are in the estimate anyway.
    if not held_out:
        return Prediction(
            name=name,
            identified=_errors(problem, theta, masks, name, budget),
            nominal=_errors(problem, guess, masks, name, budget),
            held_out=False,
        )

    errors, outputs = _predicted(problem, theta, masks, name, budget)
    nominal_errors, nominal_outputs = _predicted(problem, guess, masks, name, budget)
    i = part.recordings[0]
    return Prediction(
        name=name,
        identified=errors,
        nominal=nominal_errors,
        held_out=True,
        identified_outputs=outputs[i],
        nominal_outputs=nominal_outputs[i],
    )


def _errors(
    problem: FitProblem, theta: Array, masks: Sequence[np.ndarray], name: str, budget: Budget
) -> PredictionErrors:
    """Errors of the values in some masks: (M, ny) for every recording, at theta: (p,)."""
    part, at = _begun(problem, theta, masks, budget)
    return _errors_of(problem, part.masked(masks).errors_at(at), name)


def _predicted(
    problem: FitProblem, theta: Array, masks: Sequence[np.ndarray], name: str, budget: Budget
) -> tuple[PredictionErrors, list[Array]]:
    """Predict the values in some masks: (M, ny) for every recording, at theta: (p,).

    Returns:
        The errors, and for every recording the (M, ny) outputs, NaN where the model diverges.
    """
    part, at = _begun(problem, theta, masks, budget)
    predicted = part.predict(at)
    if predicted is None:
        diverged = [np.full(mask.shape, np.nan) for mask in masks]
        return _errors_of(problem, None, name), diverged
    return _errors_of(problem, part.masked(masks).errors(predicted), name), predicted


def _begun(
    problem: FitProblem, theta: Array, masks: Sequence[np.ndarray], budget: Budget
) -> tuple[FitProblem, UnknownValues]:
    """The segments with values in some masks: (M, ny) for every recording, and their unknowns.

    Unknown initial states are estimated from the other values of a segment, or from the predicted
    ones where it has no others. theta: (p,).
    """
    problem = problem.of_segments(problem.masked(masks).segments_with_values)
    at = problem.begin(theta)
    if problem.unknown_count <= len(problem.layout.shared):
        return problem, at

    # Deviations of the initial state that were fitted belong to other recordings.
    private = np.zeros_like(at.private)
    if not problem.layout.free_starts:
        guess = problem.system.parameters.guess[problem.layout.private]
        private = np.tile(guess, (len(problem.segments), 1))

    known = problem.masked(_masks_for_initial_states(problem, masks))
    begin = replace(at, private=private)
    found = minimise(known.with_shared_held(), begin, SEARCH, budget)
    return problem, at if found is None else found.unknowns


def _errors_of(problem: FitProblem, errors: Sequence[Array] | None, name: str) -> PredictionErrors:
    """Sizes of the errors of every output; NaN without any, or where the model diverges."""
    outputs = problem.system.outputs.names
    rms = np.full(len(outputs), np.nan)
    mae = np.full(len(outputs), np.nan)
    for j, of_output in enumerate(errors or []):
        if len(of_output):
            rms[j] = np.sqrt(np.mean(of_output**2))
            mae[j] = np.mean(np.abs(of_output))
    return PredictionErrors(name=name, outputs=outputs, rms=rms, mae=mae)


def _masks_for_initial_states(
    problem: FitProblem, predicted: Sequence[np.ndarray]
) -> list[np.ndarray]:
    """(M, ny) for every recording, True for the values from which initial states are estimated."""
    masks = [np.zeros_like(mask) for mask in problem.masks]
    for segment in problem.segments:
        i = segment.recording
        rows = segment.rows
        counted = problem.masks[i][rows]

        # The predicted values are used only where a segment has no others.
        others = counted & ~predicted[i][rows]
        masks[i][rows] = others if others.any() else counted
    return masks

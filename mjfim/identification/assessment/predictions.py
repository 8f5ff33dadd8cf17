"""Predictions of data that were not fitted, by the identified and by the nominal model.

Without held-out recordings, parts of the fitted ones are left out in turn, and theta is fitted to
the other parts. The initial state of a predicted part is estimated from that part, for both models.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace
from functools import partial

import numpy as np

from mjfim.arrays import Array
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.left_out import (
    LeftOutPart,
    affordable_part,
    fit_without,
    left_out_parts,
    masks_of,
    of_parts,
    with_initial_states,
)
from mjfim.optimize.levenberg_marquardt import Solution
from mjfim.parallel import one_blas_thread
from mjfim.parallel.budget import Budget
from mjfim.records.estimate import Prediction, PredictionErrors
from mjfim.records.events import begin_stage
from mjfim.records.trajectory import Recording


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
        name = held_out.recordings[i].name
        masks = masks_of(held_out.masks, [i])
        errors, outputs = _predicted(held_out, theta, masks, name, budget)
        guess = held_out.system.parameters.guess
        nominal_errors, nominal_outputs = _predicted(held_out, guess, masks, name, budget)
        yield Prediction(
            name=name,
            identified=errors,
            nominal=nominal_errors,
            held_out=True,
            identified_outputs=outputs[i],
            nominal_outputs=nominal_outputs[i],
        )


def _cross_validate(
    problem: FitProblem, solution: Solution, budget: Budget
) -> Iterator[Prediction]:
    """Prediction of every part of the data by a fit to the others."""
    whole = problem
    problem, solution = affordable_part(problem, solution)
    parts = [
        replace(part, name=part.name + _note_of_subset(part.recordings, problem, whole))
        for part in left_out_parts(problem)
        if any(segment.recording in part.recordings for segment in problem.segments)
    ]
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
    guess, masks = problem.system.parameters.guess, part.masks(problem)
    return Prediction(
        name=part.name,
        identified=_predicted(problem, others.theta, masks, part.name, budget)[0],
        nominal=_predicted(problem, guess, masks, part.name, budget)[0],
        held_out=False,
    )


def _note_of_subset(recordings: Sequence[int], subset: FitProblem, whole: FitProblem) -> str:
    """How many segments of some recordings are in a subset; empty where all of them are."""
    tested, count = (
        sum(segment.recording in recordings for segment in problem.segments)
        for problem in (subset, whole)
    )
    return "" if tested == count else f" ({tested} of {count} segments)"


def _predicted(
    problem: FitProblem, theta: Array, masks: Sequence[np.ndarray], name: str, budget: Budget
) -> tuple[PredictionErrors, list[Array]]:
    """Predict the values in some masks: (M, ny) for every recording, at theta: (p,).

    Returns:
        The errors, and for every recording the (M, ny) outputs, NaN where the model diverges.
    """
    part, at = with_initial_states(problem, theta, masks, budget)
    predicted = part.predict(at)
    errors = [] if predicted is None else part.masked(masks).errors(predicted)
    names = problem.system.outputs.names
    rms, mae = np.full((2, len(names)), np.nan)
    for j, of_output in enumerate(errors):
        if len(of_output):
            rms[j] = np.sqrt(np.mean(of_output**2))
            mae[j] = np.mean(np.abs(of_output))
    found = PredictionErrors(name=name, outputs=names, rms=rms, mae=mae)
    return found, predicted or [np.full(mask.shape, np.nan) for mask in masks]

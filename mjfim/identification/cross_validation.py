"""Predictions of what was not fitted: held-out recordings, or parts of the fitted ones in turn, against the nominal model.

The parameters stay as they were fitted to the rest; what belongs to the held-out piece alone, its start, is found from it, for
the identified and for the nominal model alike.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.budget import Budget
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.identification.residuals import FitProblem
from mjfim.optimize.levenberg_marquardt import SearchSettings, UnknownValues, minimise
from mjfim.records.estimate import Prediction, PredictionErrors
from mjfim.records.recording import Recording

FOLDS = 5  # at most
REST = 0.25  # of a single recording that is predicted from what comes before
MANY = 400_000  # samples of a fit to a part at most
STEPS = 8  # Levenberg-Marquardt steps of a fit without a part, and of a start


def predict(
    experiment: Experiment,
    theta: Array,
    recordings: Sequence[Recording],
    *,
    threads: int | None = None,
) -> tuple[PredictionErrors, ...]:
    """Errors of a model at theta: (p,) on recordings; only what belongs to a recording alone is found from it.

    Raises RecordingError for unusable recordings.
    """
    system = System.resolve(experiment, threads=threads)
    fit = FitProblem.of(system, recordings)
    return tuple(
        _errors(fit, np.asarray(theta), _alone(fit.masks, i), fit.aligned[i].name)
        for i in range(len(fit.aligned))
    )


def predicted(
    fit: FitProblem, at: UnknownValues, held_out: FitProblem | None, budget: Budget | None = None
) -> tuple[Prediction, ...]:
    """Of held-out recordings; without any, of recordings in turn, or of the last quarter of a single one.

    Where the budget is exhausted, parts that were not predicted by then are missing.
    """
    budget = Budget() if budget is None else budget
    nominal = fit.system.parameters.guess
    if held_out is not None:
        masks = held_out.masks
        return tuple(
            _judged(held_out, at.theta, nominal, _alone(masks, i), (i,), True, budget)
            for i in range(len(masks))
            if budget.exhausted is None
        )
    return tuple(_folds(fit, at, nominal, budget))


def _folds(
    fit: FitProblem, at: UnknownValues, nominal: Array, budget: Budget
) -> Iterator[Prediction]:
    """What the rest says of each part; of much data, pieces all over it."""
    if fit.samples > MANY and len(fit.pieces) > 1:
        places = evenly_spread_indices(
            len(fit.pieces), max(MANY * len(fit.pieces) // fit.samples, 2)
        )
        fit, at = fit.part(places), replace(at, private=at.private[places])
    for names, masks in _parts(fit):
        rest = fit.masked([~mask for mask in masks])
        some = rest.occupied
        if not len(some):
            continue
        begin = replace(at, private=at.private[some])
        settings = SearchSettings(max_iterations=STEPS, tolerance=1e-2, relinearise_at_end=False)
        found = minimise(rest.part(some), begin, settings, budget)
        if budget.exhausted is not None:
            return
        if found is not None:
            yield _judged(fit, found.unknowns.theta, nominal, masks, names, False, budget)


def _parts(fit: FitProblem) -> Iterator[tuple[tuple[int, ...], list[np.ndarray]]]:
    """Recordings in at most so many groups, and their masks; of a single one its end."""
    count = len(fit.aligned)
    if count == 1:
        track = fit.aligned[0]
        late = track.t >= (1.0 - REST) * track.t[-1]
        yield (0,), [np.broadcast_to(late[:, None], track.y.shape)]
        return
    for group in np.array_split(np.arange(count), min(count, FOLDS)):
        yield tuple(int(i) for i in group), _alone(fit.masks, *group)


def _alone(masks: Sequence[np.ndarray], *kept: int) -> list[np.ndarray]:
    """The masks of some recordings, nothing of the others."""
    return [mask if i in kept else np.zeros_like(mask) for i, mask in enumerate(masks)]


def _judged(
    fit: FitProblem,
    theta: Array,
    nominal: Array,
    masks: Sequence[np.ndarray],
    tracks: Sequence[int],
    held_out: bool,
    budget: Budget,
) -> Prediction:
    name = ", ".join(fit.aligned[i].name for i in tracks)
    if len(fit.aligned) == 1 and not held_out:
        name = f"last {100 * REST:.0f} % of {name}"
    own, plain = (_errors(fit, value, masks, name, budget) for value in (theta, nominal))
    return Prediction(name=name, identified=own, nominal=plain, held_out=held_out)


def _errors(
    fit: FitProblem,
    theta: Array,
    masks: Sequence[np.ndarray],
    name: str,
    budget: Budget | None = None,
) -> PredictionErrors:
    """Errors at theta: (p,) of the values that the masks: (M, ny) of each track hold.

    Unknown starts are found from what else a piece measures, or from those values where they are all it has.
    """
    fit = fit.part(fit.masked(masks).occupied)
    now, nominal = fit.begin(theta), fit.system.parameters.guess[fit.layout.private]
    if fit.size > len(fit.layout.shared):
        # a nuisance start of the fitted recordings says nothing of this one's
        starts = (
            np.zeros_like(now.private) if fit.measured else np.tile(nominal, (len(fit.pieces), 1))
        )
        search = SearchSettings(max_iterations=STEPS, tolerance=1e-2, relinearise_at_end=False)
        found = minimise(
            fit.masked(_learned(fit, masks)).frozen(), replace(now, private=starts), search, budget
        )
        now = now if found is None else found.unknowns
    values, outputs = fit.predicted(now), fit.system.outputs.names
    rms, mae = np.full(len(outputs), np.nan), np.full(len(outputs), np.nan)
    for j, error in enumerate([] if values is None else fit.masked(masks).errors(values)):
        if len(error):
            rms[j], mae[j] = np.sqrt(np.mean(error**2)), np.mean(np.abs(error))
    return PredictionErrors(name=name, outputs=outputs, rms=rms, mae=mae)


def _learned(fit: FitProblem, masks: Sequence[np.ndarray]) -> list[np.ndarray]:
    """What starts are found from."""
    found = [np.zeros_like(mask) for mask in fit.masks]
    for piece in fit.pieces:
        own = fit.masks[piece.track][piece.rows]
        rest = own & ~masks[piece.track][piece.rows]
        found[piece.track][piece.rows] = rest if rest.any() else own
    return found

"""Whether a search over much data needs another linearisation, tested on a part of the data."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace

import numpy as np

from mjfim.arrays import Array, scaled_to_unit_diagonal
from mjfim.identification.fit_problem import FitProblem
from mjfim.optimize.condensed_least_squares import Condensed, Step
from mjfim.optimize.levenberg_marquardt import NextStepLength, UnknownValues
from mjfim.plant.noise import Noise

# Share of the segments of the test, their smallest number, and the largest share that this may be:
# a test of more segments saves too little of a linearisation of all of them.
TESTED_SHARE = 0.1
MIN_TESTED_SEGMENTS = 15
LARGEST_TESTED_SHARE = 0.3

# Smallest information of the tested segments about a parameter, as a share of what as many segments
# hold on average. With less, the test says nothing about the parameter.
FAIR_SHARE = 0.5

# Multiples of the golden ratio, modulo 1, spread evenly without a period.
GOLDEN_RATIO = 0.6180339887498949

# Noise with which the latest linearisation is weighted; None where it is another one at the
# unknowns to which the linearisation led.
LastingNoise = Callable[[UnknownValues], Noise | None]


def next_step_on_part(
    problem: FitProblem, lasting_noise: LastingNoise | None = None
) -> NextStepLength | None:
    """Make the test of a search over all segments of a problem.

    Some segments, spread over the data, are linearised anew. How much their gradients differ from
    those that the old linearisation predicts shows how far the next step would lead.

    Args:
        problem: Problem of all segments.
        lasting_noise: Noise of the linearisations, where it is estimated; default: that of the
            problem.

    Returns:
        The test; None where there are too few segments for it.
    """
    count = len(problem.segments)
    wanted = max(int(TESTED_SHARE * count), MIN_TESTED_SEGMENTS)
    if wanted > LARGEST_TESTED_SHARE * count:
        return None
    tested = spread_over_data(count, wanted)
    part = problem.of_segments(tested)

    def length(condensed: Condensed, step: Step, at: UnknownValues) -> float:
        """Length of the step that follows [standard deviations]; infinite where it is unknown."""
        # A bound that stops the step leaves a gradient, which is no sign of another step.
        values = problem.common_values(at)
        if (values <= problem.lower).any() or (values >= problem.upper).any():
            return np.inf
        if _holds_too_little(condensed, tested, len(problem.layout.shared)):
            return np.inf

        # Gradients can be compared only if they are weighted with the same noise.
        noise = problem.noise if lasting_noise is None else lasting_noise(at)
        if noise is None:
            return np.inf
        anew = part.with_noise(noise).condense(replace(at, private=at.private[tested]))
        if anew is None:
            return np.inf

        # The gradient is that of the old linearisation, plus what the tested segments add to it.
        predicted = condensed.gradients_after(step.common)
        change = (anew.gradients_after(np.zeros_like(step.common)) - predicted[tested]).sum(axis=0)
        rows = condensed.common_rows
        of_priors = rows[:, :-1].T @ (rows[:, :-1] @ step.common + rows[:, -1])
        gradient = predicted.sum(axis=0) + of_priors + change * (count / len(tested))
        return _length_of_step(condensed, gradient)

    return length


def spread_over_data(count: int, wanted: int) -> np.ndarray:
    """Indices of some segments: one of each of equal stretches of the data, the first one included.

    The place inside the stretch varies, so that segments of recordings of equal length are not all
    taken at the same time of their recording.

    Args:
        count: Number of segments.
        wanted: Number of stretches, at most `count`.

    Returns:
        (wanted,) ascending indices; fewer where stretches of less than two segments share one.
    """
    stretch = np.arange(wanted)
    place = stretch * GOLDEN_RATIO % 1.0
    return np.unique(((stretch + place) * (count / wanted)).astype(np.intp))


def _holds_too_little(condensed: Condensed, tested: np.ndarray, shared: int) -> bool:
    """Whether some segments hold too little information about one of the shared parameters."""
    count = condensed.segment_count
    J = condensed.reduced_rows()[:, :shared].reshape(count, -1, shared)
    squares = np.sum(J**2, axis=1)
    fair = squares.sum(axis=0) * (len(tested) / count)
    return bool((squares[tested].sum(axis=0) < FAIR_SHARE * fair).any())


def _length_of_step(condensed: Condensed, gradient: Array) -> float:
    """Length of the step [standard deviations] that a gradient (c,) causes.

    It is infinite where round-off of the information hides it.
    """
    scaled, scale = scaled_to_unit_diagonal(condensed.information())
    gradient = gradient / scale
    try:
        square = float(gradient @ np.linalg.solve(scaled, gradient))
    except np.linalg.LinAlgError:
        return np.inf
    return float(np.sqrt(square)) if square >= 0.0 else np.inf

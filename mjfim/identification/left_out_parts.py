"""Parts of the data that are left out of a fit, and predicted by it.

The initial state of a predicted part is estimated from that part itself.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array, evenly_spread_indices
from mjfim.budget import Budget
from mjfim.identification.fit_problem import FitProblem
from mjfim.optimize.levenberg_marquardt import (
    SearchSettings,
    Solution,
    UnknownValues,
    minimise,
)

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
    unknowns = solution.unknowns
    part = replace(
        solution,
        unknowns=replace(unknowns, private=unknowns.private[subset]),
        condensed=solution.condensed.of_segments(subset),
    )
    return problem.of_segments(subset), part


def with_initial_states(
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

"""Search for signals of a log whose sign is opposite to that of the model.

A control or an angle that counts in the other direction leaves residuals as large as the motion.
Where a fit is so poor, the fit is repeated with one sign changed at a time. A sign looks flipped if
the change makes the sum of squared residuals much smaller.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import dataclass, replace

import numpy as np

from mjfim.errors import RecordingError
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.task import FitTask
from mjfim.information.null_space import NullSpace
from mjfim.optimize.levenberg_marquardt import SearchSettings, minimise
from mjfim.parallel.budget import Budget
from mjfim.plant.outputs import Noise
from mjfim.records.check import join_names
from mjfim.records.trajectory import Recording

# Sum of squared residuals per degree of freedom above which signs are looked at.
POOR_FIT = 4.0

# Factor by which a changed sign has to make the sum of squared residuals smaller. Where the noise
# is known, a smaller factor is enough if the residuals that remain are about as large as the noise.
MIN_IMPROVEMENT = 10.0
MIN_IMPROVEMENT_TO_NOISE = 1.5
EXPLAINED = 1.3

# Signs whose sums of squares are within this factor explain the residuals equally well.
TIE = 2.0

# Beginnings of the names of inputs that have a sign.
SIGNED_INPUTS = ("ctrl:", "reference:", "feedforward:")

# Largest number of signs with which the fit is repeated, and iterations of such a fit.
MAX_FITS = 4
ITERATIONS = 15
TOLERANCE = 1e-2


@dataclass(frozen=True, kw_only=True)
class Sign:
    """Signals of a log that have one sign.

    Attributes:
        description: The signals in words.
        control: Index of the control; None for measured outputs.
        outputs: Names of the measured outputs; none for a control.
    """

    description: str
    control: int | None = None
    outputs: tuple[str, ...] = ()

    def flipped(self, recording: Recording) -> Recording:
        """Return a recording with the other sign.

        Args:
            recording: The recording.
        """
        ctrl, y = np.array(recording.ctrl), np.array(recording.y)
        if self.control is not None:
            ctrl[:, self.control] *= -1.0
        for name in self.outputs:
            y[:, recording.outputs.index(name)] *= -1.0
        return replace(recording, ctrl=ctrl, y=y)


def flipped_signs(
    task: FitTask,
    fitted: FitProblem,
    enough: float,
    segments: np.ndarray,
    null_space: NullSpace,
    budget: Budget,
) -> tuple[str, ...]:
    """Find the signs that look flipped after a poor fit.

    Args:
        task: The task of the fit.
        fitted: The problem of the fit, which has its noise.
        enough: Largest sum of squared residuals in some segments that explains them.
        segments: Indices of these segments.
        null_space: Combinations of parameters that the fit held.
        budget: Budget with the stop token.

    Returns:
        The signals in words, each of which explains the residuals; empty where none does, and after
        a request to stop.
    """
    problems = []
    for sign in _signs(task):
        flipped = _problem(task, sign, fitted.noise)
        if flipped is not None:
            problem = flipped.pinned(task.start, null_space).of_segments(segments)
            cost = problem.cost(problem.begin(task.start))
            problems.append((cost if np.isfinite(cost) else np.inf, sign, problem))

    # The fit is repeated with the signs that explain most at its start.
    problems.sort(key=lambda entry: entry[0])
    found = []
    settings = SearchSettings(
        max_iterations=ITERATIONS, tolerance=TOLERANCE, relinearise_at_end=False
    )
    for cost, sign, problem in problems[:MAX_FITS]:
        if budget.stop.requested:
            return ()
        if np.isfinite(cost):
            solution = minimise(problem, problem.begin(task.start), settings, budget)
            if solution is not None:
                found.append((2.0 * solution.cost, sign.description))

    best = min((value for value, _ in found), default=np.inf)
    if best > enough or budget.stop.requested:
        return ()
    return tuple(words for value, words in found if value <= TIE * best)


def sufficient_squares(squares: float, count: int, *, noise_is_stated: bool) -> float:
    """Largest sum of squared residuals with another sign that makes the stated sign doubtful.

    Args:
        squares: Sum of squared residuals with the stated signs.
        count: Number of residuals.
        noise_is_stated: False where the noise is estimated from the residuals.
    """
    much_better = squares / MIN_IMPROVEMENT
    if not noise_is_stated:
        return much_better
    return max(much_better, min(EXPLAINED * count, squares / MIN_IMPROVEMENT_TO_NOISE))


def sentence_about_signs(signs: Sequence[str]) -> str:
    """Warning about signs that look flipped.

    Args:
        signs: The signals in words, at least one.
    """
    if len(signs) == 1:
        return (
            f"the sign of {signs[0]} looks flipped: with the other sign the model explains the "
            "recordings. State scale = -1.0 for it in [recording.columns], or turn the axis or the "
            "gear in the MJCF"
        )
    return (
        f"one of these signs looks flipped: {join_names(signs)}; with the other sign of any of "
        "them the model explains the recordings. State scale = -1.0 for it in [recording.columns], "
        "or turn the axis or the gear in the MJCF"
    )


def _signs(task: FitTask) -> Iterator[Sign]:
    """All signs that may be flipped: of controls, joints, and single outputs."""
    system = task.system
    for i, name in enumerate(system.inputs):
        if not name.startswith(SIGNED_INPUTS):
            continue
        described = f"control {name.removeprefix('ctrl:')}" if name.startswith("ctrl:") else name
        yield Sign(description=described, control=i)

    measured = set.intersection(*(set(recording.outputs) for recording in task.recordings))
    names = [name for name in system.outputs.names if name in measured]
    sensors = {component.name for component in system.source.coordinates.sensors}
    for joint in system.coordinates:
        columns = (joint.position_column, joint.velocity_column)
        own = tuple(name for name in columns if name in names)
        if len(own) == len(columns):
            yield Sign(description=f"joint {joint.name}", outputs=own)
        for name in own:
            yield Sign(description=name, outputs=(name,))
    for name in names:
        if name in sensors:
            yield Sign(description=f"sensor {name}", outputs=(name,))


def _problem(task: FitTask, sign: Sign, noise: Noise) -> FitProblem | None:
    """The problem with another sign and the noise of the fit; None where it cannot be posed."""
    flipped = replace(task, recordings=tuple(map(sign.flipped, task.recordings)))
    try:
        return flipped.problem().with_noise(noise)
    except RecordingError:
        return None

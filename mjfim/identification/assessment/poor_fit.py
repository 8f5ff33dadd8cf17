"""Causes of a poor fit: signals with the wrong sign, and motions that no simulation follows.

A control or an angle that counts in the other direction leaves residuals as large as the motion.
Where a fit is so poor, it is repeated with one sign changed at a time. A sign looks flipped if the
change makes the sum of squared residuals much smaller.

Unstable and chaotic motions amplify a deviation exponentially. The residuals of one simulation over
a long time then have many local minima, in which a fit ends. Shorter segments avoid that.
"""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from dataclasses import replace

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError, SimulationDivergedError, listed
from mjfim.identification.assessment.accuracy import FitResult
from mjfim.identification.assessment.residual_tests import are_white
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.search import FitTask
from mjfim.identification.segments import MIN_SAMPLES
from mjfim.model.variants import allows_dry_friction_only
from mjfim.optimize.levenberg_marquardt import SearchSettings, UnknownValues, minimise
from mjfim.parallel.budget import Budget
from mjfim.plant.active_constraints import acting_constraints, forward_samples
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


def flipped_signs(result: FitResult, budget: Budget) -> tuple[str, ...]:
    """Find the signs that look flipped after a very poor fit.

    Args:
        result: The fit.
        budget: Budget with the stop token.

    Returns:
        The signals in words, each of which explains the residuals; empty where none does, where the
        fit is not poor enough, and after a request to stop.
    """
    task, quality, noise = result.task, result.quality, result.problem.noise
    is_poor = task.noise_is_stated and quality.chi2 > POOR_FIT * quality.dof
    is_poor &= not are_white(quality.whiteness)
    if not (is_poor or quality.unexplained):
        return ()

    # Largest sum of squared residuals with another sign that makes the stated sign doubtful.
    problem, at = result.quick
    squares = 2.0 * problem.cost(at)
    enough = squares / MIN_IMPROVEMENT
    if task.noise_is_stated:
        of_noise = min(EXPLAINED * problem.value_count, squares / MIN_IMPROVEMENT_TO_NOISE)
        enough = max(enough, of_noise)

    problems = []
    for words, controls, outputs in _signs(task):
        recordings = tuple(_flipped(each, controls, outputs) for each in task.recordings)
        try:
            flipped = replace(task, recordings=recordings).problem()
        except RecordingError:
            continue
        problem = flipped.with_noise(noise).pinned(task.start, result.null_space)
        problem = problem.of_segments(result.subset)
        cost = problem.cost(problem.begin(task.start))
        problems.append((cost if np.isfinite(cost) else np.inf, words, problem))

    # The fit is repeated with the signs that explain most at its start.
    problems.sort(key=lambda entry: entry[0])
    found = []
    settings = SearchSettings(
        max_iterations=ITERATIONS, tolerance=TOLERANCE, relinearise_at_end=False
    )
    for cost, words, problem in problems[:MAX_FITS]:
        if budget.stop.requested:
            return ()
        if np.isfinite(cost):
            solution = minimise(problem, problem.begin(task.start), settings, budget)
            if solution is not None:
                found.append((2.0 * solution.cost, words))

    best = min((value for value, _ in found), default=np.inf)
    if best > enough or budget.stop.requested:
        return ()
    return tuple(words for value, words in found if value <= TIE * best)


def _flipped(recording: Recording, controls: Sequence[int], outputs: Sequence[str]) -> Recording:
    """A recording with the other sign of some controls and outputs."""
    ctrl, y = np.array(recording.ctrl), np.array(recording.y)
    ctrl[:, list(controls)] *= -1.0
    y[:, [recording.outputs.index(name) for name in outputs]] *= -1.0
    return replace(recording, ctrl=ctrl, y=y)


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


def _signs(task: FitTask) -> Iterator[tuple[str, Sequence[int], Sequence[str]]]:
    """All signs that may be flipped, in words, with their controls and their measured outputs."""
    system = task.system
    for i, name in enumerate(system.inputs):
        if name.startswith(SIGNED_INPUTS):
            is_control = name.startswith("ctrl:")
            yield f"control {name.removeprefix('ctrl:')}" if is_control else name, [i], []

    measured = set.intersection(*(set(recording.outputs) for recording in task.recordings))
    names = [name for name in system.outputs.names if name in measured]
    sensors = {component.name for component in system.source.coordinates.sensors}
    for joint in system.coordinates:
        columns = (joint.position_column, joint.velocity_column)
        own = [name for name in columns if name in names]
        if len(own) == len(columns):
            yield f"joint {joint.name}", [], own
        for name in own:
            yield name, [], [name]
    for name in names:
        if name in sensors:
            yield f"sensor {name}", [], [name]


# Beginnings of the descriptions of what a motion touches.
TOUCHES = ("contact ", "limit of ", "friction or limit of ")

# Largest number of samples of a motion along which the amplification is computed.
MAX_SAMPLES = 20_000

# Amplification over a segment above which shorter segments are recommended. A damped or a free
# motion stays far below it, because deviations do not grow exponentially there.
MAX_AMPLIFICATION = 1e3

# Amplification over a segment of the recommended length.
GOOD_AMPLIFICATION = 30.0

# Amplification above which rounding errors alone change the whole motion.
ROUNDING_AMPLIFICATION = 1e14

# Smallest number of samples of a recommended segment.
LEAST_SAMPLES = 2 * MIN_SAMPLES

# Digits of a recommended length.
LENGTH_DIGITS = 2


def sentence_about_instability(amplification: float, length: float, recommended: float) -> str:
    """Advice about a motion that is too unstable for the segments of a fit.

    Args:
        amplification: Common logarithm of the amplification of a small deviation.
        length: Time within which it grows so much [s].
        recommended: Length of segments over which deviations typically grow less than
            `GOOD_AMPLIFICATION` times [s].
    """
    rounding = ""
    if amplification > np.log10(ROUNDING_AMPLIFICATION):
        rounding = ", and rounding errors alone change it"
    return (
        f"the motion is unstable or chaotic: a small deviation grows 1e{amplification:.0f}-fold "
        f"within {length:.3g} s, so the residuals of one simulation have many local minima"
        f"{rounding}. State fit.segments = {recommended:g} in the experiment file: segments with "
        "free initial states, over which it typically grows less than "
        f"{GOOD_AMPLIFICATION:.0f}-fold"
    )


def touched_in(fit: FitResult) -> str:
    """Stops and contacts that act along the fitted motions, in words; empty without any."""
    problem, at = fit.problem, fit.solution.unknowns
    model, found = problem.system.plant.model(problem.theta(at)), dict[str, int]()
    if allows_dry_friction_only(model):
        return ""
    samples = 0
    for i in range(len(problem.recordings)):
        motion = problem.motion(at, i, max(MAX_SAMPLES - samples, 1))
        if motion is None:
            continue
        samples += motion.samples
        for _, data in forward_samples(model, motion, range(motion.samples)):
            for name in set(acting_constraints(model, data)):
                if name.startswith(TOUCHES):
                    found[name] = found.get(name, 0) + 1
    found_in = [f"{name} in {n} of {samples} samples" for name, n in found.items()]
    return listed(found_in) if found_in else ""


def unpredictable_motion(problem: FitProblem, at: UnknownValues) -> str:
    """Compare the amplification along the longest recording with the segments of a fit.

    Args:
        problem: Problem with the segments.
        at: The unknowns.

    Returns:
        Advice with the amplification and a better length; empty if the segments suit the motion,
        and with control laws, of whose memory a state shows nothing.
    """
    if problem.system.laws is not None:
        return ""
    longest = max(problem.segments, key=lambda segment: segment.samples)
    samples = min(longest.samples, MAX_SAMPLES)
    motion = problem.motion(at, longest.recording, longest.begin + samples)
    if motion is None:
        return ""

    rows = slice(longest.begin, longest.begin + samples + 1)
    motion = replace(
        motion,
        t=motion.t[rows],
        qpos=motion.qpos[rows],
        qvel=motion.qvel[rows],
        act=motion.act[rows],
        ctrl=motion.ctrl[longest.begin : longest.begin + samples],
    )
    plant = problem.system.plant
    try:
        A, _, _, _ = plant.derivatives.jacobians(problem.theta(at), motion)
    except SimulationDivergedError:
        return ""

    # Deviations are relative to the size of the motion.
    moves = plant.space.minus(motion.state, motion.state[:1])
    typical = amplifications(A, np.abs(moves).max(axis=0))
    if typical[-1] <= np.log10(MAX_AMPLIFICATION):
        return ""

    good = np.flatnonzero(typical <= np.log10(GOOD_AMPLIFICATION))
    samples = max(2 ** int(good[-1]) if len(good) else 1, LEAST_SAMPLES)
    return sentence_about_instability(
        float(typical[-1]),
        float(2 ** (len(typical) - 1) * plant.dt),
        float(f"{samples * plant.dt:.{LENGTH_DIGITS}g}"),
    )


def amplifications(A: Array, sizes: Array) -> Array:
    """Typical amplification of a deviation over windows of 1, 2, 4, ... samples.

    Args:
        A: (N, nx, nx) transition matrices.
        sizes: (nx,) magnitude of each component of the state, to which deviations are relative;
            components of size zero do not count.

    Returns:
        (n,) common logarithms of the spectral norms, averaged over all windows of a length; the
        last window is the longest power of two within N samples.
    """
    moving = np.flatnonzero(sizes > 0.0)
    if not len(moving):
        return np.zeros(1)
    scale = sizes[moving]
    products = A[:, moving][:, :, moving] * scale / scale[:, None]
    logarithms = np.zeros(len(products))

    found = []
    while True:
        # Products are normalised, because their norms may exceed the largest number.
        norms = np.linalg.norm(products, 2, axis=(1, 2))
        products = products / np.where(norms > 0.0, norms, 1.0)[:, None, None]
        with np.errstate(divide="ignore"):
            logarithms = logarithms + np.log10(norms)
        found.append(logarithms.mean())

        pairs = len(products) // 2
        if not pairs:
            return np.array(found)
        first, second = slice(0, 2 * pairs, 2), slice(1, 2 * pairs, 2)
        products = products[second] @ products[first]
        logarithms = logarithms[first] + logarithms[second]

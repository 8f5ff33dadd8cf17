"""Motions that no simulation follows, as the cause of a poor fit.

Unstable and chaotic motions amplify a deviation exponentially. The residuals of one simulation over
a long time then have many local minima, in which a fit ends. Shorter segments avoid that.
"""

from __future__ import annotations

from collections import Counter
from dataclasses import replace

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError, listed
from mjfim.identification.assessment.accuracy import FitResult
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.segments import MIN_SAMPLES
from mjfim.model.variants import allows_dry_friction_only
from mjfim.optimize.levenberg_marquardt import UnknownValues
from mjfim.plant.active_constraints import acting_constraints, forward_samples

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
    model, found = problem.system.plant.model(problem.theta(at)), Counter[str]()
    if allows_dry_friction_only(model):
        return ""
    samples = 0
    for i in range(len(problem.recordings)):
        motion = problem.motion(at, i, max(MAX_SAMPLES - samples, 1))
        if motion is None:
            continue
        samples += motion.samples
        for _, data in forward_samples(model, motion, range(motion.samples)):
            acting = set(acting_constraints(model, data))
            found.update(name for name in acting if name.startswith(TOUCHES))
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
        products, logarithms = products[: 2 * pairs], logarithms[: 2 * pairs]
        products = products[1::2] @ products[::2]
        logarithms = logarithms[::2] + logarithms[1::2]

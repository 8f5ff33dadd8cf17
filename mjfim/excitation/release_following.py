"""Local search for a release: a trust-region method without derivatives (COBYQA).

It keeps ranges and limits, and tolerates the kinks of the smallest eigenvalue. It goes on in slices
by repetition: what it evaluated before is known, so that it soon is where it was.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.excitation.release_evaluation import Release
from mjfim.experiment.task_tables import Descent

# First radius of the trust region relative to the ranges, and bounds of the last one.
FIRST_RADIUS = 0.05
LAST_RADII = (1e-6, 1e-2)

# Relative margin that the search keeps from the limits, so that its result is inside.
SAFETY = 1e-4


class _SliceOverError(Exception):
    """Ends a local search, whose method has no other way to end at once."""


@dataclass(frozen=True, kw_only=True, eq=False)
class Following:
    """A local search, as far as it came.

    Attributes:
        tried: All releases that it evaluated, in order; the start is not among them.
        has_ended: True where it ended by itself.
        converged: True where it found a minimum.
        is_lost: True where its worker was lost each time, so that it does not go on.
    """

    tried: tuple[Release, ...] = ()
    has_ended: bool = False
    converged: bool = False
    is_lost: bool = False


def follow(
    evaluate: Callable[[Array], Release],
    start: Release,
    descent: Descent,
    before: Following,
    is_over: Callable[[], bool],
) -> Following:
    """Follow a release to a minimum of its objective.

    Args:
        evaluate: Evaluates a release: (d,) shares.
        start: Where the search begins.
        descent: Its tolerance and largest number of evaluations.
        before: The search as far as it came before.
        is_over: Whether the slice ends; asked after each evaluation.

    Returns:
        The search as far as it came.
    """
    lowest, highest = LAST_RADII
    radius = float(np.clip(np.sqrt(descent.tolerance), lowest, highest))
    known = {release.shares.tobytes(): release for release in before.tried}
    tried = list(before.tried)

    def seen(shares: Array) -> Release:
        """Evaluate a release inside its ranges, and remember it."""
        inside = np.clip(shares, 0.0, 1.0)
        key = inside.tobytes()
        if key not in known:
            if len(tried) > len(before.tried) and is_over():
                raise _SliceOverError
            known[key] = evaluate(inside)
            tried.append(known[key])
        return known[key]

    constraints = []
    if start.margins:
        kinds = tuple(start.margins)
        constraints = [
            scipy.optimize.NonlinearConstraint(
                lambda x: _margins(seen(x), kinds) - SAFETY, 0.0, np.inf
            )
        ]
    try:
        found = scipy.optimize.minimize(
            lambda x: seen(x).objective,
            start.shares,
            method="COBYQA",
            bounds=[(0.0, 1.0)] * len(start.shares),
            constraints=constraints,
            options={
                "initial_tr_radius": FIRST_RADIUS,
                "final_tr_radius": radius,
                "maxfev": max(descent.max_iterations, 1),
            },
        )
    except _SliceOverError:
        return Following(tried=tuple(tried))
    return Following(tried=tuple(tried), has_ended=True, converged=bool(found.success))


def _margins(release: Release, kinds: tuple[str, ...]) -> Array:
    """(k,) relative margins of some kinds of limits; -1 where the simulation diverges."""
    return np.array([release.margins.get(kind, -1.0) for kind in kinds])

"""Shares of a control of a coarse level whose motion ends at its target on the stated plant."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.budget import StopToken
from mjfim.excitation.constraint_kinds import ConstraintValues
from mjfim.excitation.controls_within_limits import SHARE_RATIO, LimitedCost
from mjfim.excitation.end_correction import EndCorrection

# Shares that are tried first, and the largest number of corrections of each. The largest share is
# then found to a ratio.
SHARES = (1.0, 0.98, 0.94, 0.85, 0.72, 0.55, 0.35)
CORRECTIONS = 2


@dataclass(frozen=True, kw_only=True, eq=False)
class CorrectedShare:
    """A share of a control with a corrected end.

    Attributes:
        share: The share.
        control: (N, nu) control [u-unit].
    """

    share: float
    control: Array


class CorrectedShares:
    """Search for shares that keep all limits on the plant without clamps.

    Args:
        cost: Cost of controls that keep all limits on the stated plant.
        control: (N, nu) control [u-unit].
        stop: Token that ends the search early.
    """

    def __init__(self, cost: LimitedCost, control: Array, stop: StopToken) -> None:
        self._cost = cost
        self._control = control
        self._stop = stop

        # The change of the control hardly depends on its size, so that it is computed once.
        self._correction: EndCorrection | None = None
        self._is_linearised = False

    def largest(self) -> Iterator[CorrectedShare]:
        """Yield the largest share, then smaller ones for the case that it cannot be used."""
        outside = np.inf
        for share in SHARES:
            found = self._corrected(share)
            if found is None:
                outside = share
                continue

            # Bisect between this share and the next larger one that violates a limit.
            while np.isfinite(outside) and outside > SHARE_RATIO * found.share:
                middle = float(np.sqrt(found.share * outside))
                larger = self._corrected(middle)
                if larger is None:
                    outside = middle
                else:
                    found = larger
            yield found
            outside = found.share

    def _corrected(self, share: float) -> CorrectedShare | None:
        """A share with a corrected end; None where it violates a limit, or after a stop."""
        if self._stop.requested:
            return None

        centre = self._cost.level.task.centre
        control = np.asarray(centre + share * (self._control - centre))
        for corrections_left in reversed(range(1 + CORRECTIONS)):
            values = self._cost.values(control)
            if values is None:
                return None
            if self._cost.constraints.is_feasible(values):
                return CorrectedShare(share=share, control=control)
            if not corrections_left or not self._misses_end(values):
                return None

            correction = self._correction_along(values)
            if correction is None:
                return None
            control = correction.corrected(control, values)
        return None

    def _correction_along(self, values: ConstraintValues) -> EndCorrection | None:
        """The correction of all shares, linearised along the first motion that needs it."""
        if not self._is_linearised:
            self._correction = EndCorrection.along(self._cost, values)
            self._is_linearised = True
        return self._correction

    def _misses_end(self, values: ConstraintValues) -> bool:
        """Check whether a motion ends outside the tolerances of its target."""
        margins = self._cost.constraints.margins(values)
        return any(margin < 0.0 for kind, margin in margins.items() if kind.startswith("end_"))

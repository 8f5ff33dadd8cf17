"""Recognition of a descent that is held up because its steps are very short.

Where contacts open and close, or where dry friction changes its sign, the derivatives of the cost
hold within a tiny neighbourhood only. The descent then makes one short step after the other.
"""

from __future__ import annotations

import math
from collections import deque

# Step length, relative to the full step, up to which a step is short.
SHORT = 0.05

# Decades by which successive short steps together fall short of full ones when a descent is held
# up: four steps of a hundredth, or two of a millionth. One step counts this many decades at most,
# because the next direction may be better.
MOST_DECADES = 8.0
MOST_OF_ONE_STEP = 4.0

# A descent is held up as well when this number of its last steps are short.
WINDOW = 12
MOST_IN_WINDOW = 6

# Slope from which on short steps count, over the slope at which the descent has converged. Near an
# optimum steps may be short, where nothing holds the descent up.
STEEP = 100.0


class ShortSteps:
    """Observes how much shorter the steps of a descent are than full ones.

    Args:
        tolerance: Slope at which the descent has converged.
    """

    def __init__(self, tolerance: float) -> None:
        self._tolerance = tolerance
        self._stage: float | None = None
        self._decades = 0.0
        self._are_short: deque[bool] = deque(maxlen=WINDOW)

    def hold_up(self, gamma: float, stage: float, slope: float) -> bool:
        """Add a step.

        Args:
            gamma: Its length, relative to the full step.
            stage: Weight of the barrier; the first iterate of a stage was not reached by a step.
            slope: Slope after the step.

        Returns:
            True if the descent is held up.
        """
        if stage != self._stage:
            self._stage = stage
            return False

        is_short = gamma <= SHORT and slope > STEEP * self._tolerance
        self._are_short.append(is_short)
        missing = -math.log10(max(gamma, 10.0**-MOST_OF_ONE_STEP))
        self._decades = self._decades + missing if is_short else 0.0
        return self._decades >= MOST_DECADES or sum(self._are_short) >= MOST_IN_WINDOW

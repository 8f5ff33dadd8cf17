"""Robust design: the criterion phi is pooled over S samples of the uncertain parameters.

    mean    1/S sum_s phi_s
    worst   (1/S sum_s phi_s^q)^(1/q), a smooth maximum

The phi of D-optimality is a logarithm, so that its smooth maximum is

    worst   1/q log(1/S sum_s exp(q phi_s))
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
import scipy

from mjfim.arrays import Array

# Exponent q of the smooth maximum.
POOLING_EXPONENT = 20.0


@dataclass(frozen=True, kw_only=True, eq=False)
class ParameterSamples:
    """Parameter samples, and how the criterion is pooled over them.

    Attributes:
        thetas: (S, p) parameter values, the guess first [theta-unit].
        over: "mean" or "worst".
        logarithmic: True where phi is a logarithm, as for D-optimality.
    """

    thetas: Array
    over: Literal["mean", "worst"]
    logarithmic: bool = False

    def value(self, phi: Sequence[float]) -> float:
        """Pool the criterion over the samples.

        Args:
            phi: S values of the criterion.

        Returns:
            The pooled value; infinite where a value is not finite.
        """
        q = POOLING_EXPONENT
        values = np.asarray(phi, dtype=np.float64)
        if not np.isfinite(values).all():
            return np.inf

        if self.over == "mean":
            return float(values.mean())
        if self.logarithmic:
            return float((scipy.special.logsumexp(q * values) - np.log(len(values))) / q)

        # Divide by the largest value, so that powers neither overflow nor vanish.
        largest = values.max()
        return float(largest * np.mean((values / largest) ** q) ** (1.0 / q))

    def weights(self, phi: Sequence[float]) -> Array:
        """Differentiate the pooled criterion.

        Args:
            phi: S values of the criterion, all finite.

        Returns:
            (S,) derivative by each value.
        """
        q = POOLING_EXPONENT
        values = np.asarray(phi, dtype=np.float64)

        if self.over == "mean":
            return np.full(len(values), 1.0 / len(values))
        if self.logarithmic:
            return np.asarray(np.exp(q * values - scipy.special.logsumexp(q * values)))

        pooled = self.value(phi)
        return np.asarray((values / pooled) ** (q - 1.0) / len(values))

"""Robust design: the guess of the parameters is known to be wrong, so that the criterion phi is pooled over samples of them.

    mean    1/S sum_s phi_s
    worst   (1/S sum_s phi_s^q)^(1/q), a smooth maximum

The phi of D-optimality is a logarithm already; its smooth maximum is `log(1/S sum_s exp(q phi_s)) /
q`.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import logsumexp

from mjfim.arrays import Array

# Exponent q of the smooth maximum.
POOLING_EXPONENT = 20.0


@dataclass(frozen=True, kw_only=True, eq=False)
class ParameterSamples:
    """Parameter values, and how the criterion at them becomes one number.

    Attributes:
        thetas: (S, p) parameter values, the guess first [theta-unit].
        over: "mean" or "worst".
        logarithmic: phi is a logarithm, as that of D-optimality is.
    """

    thetas: Array
    over: Literal["mean", "worst"]
    logarithmic: bool = False

    def value(self, phi: Sequence[float]) -> float:
        """Pooled criterion.

        Args:
            phi: S values of the criterion.

        Returns:
            The pooled value; infinite where one of them is not finite.
        """
        q = POOLING_EXPONENT
        values = np.asarray(phi, dtype=np.float64)
        if not np.isfinite(values).all():
            return np.inf

        if self.over == "mean":
            return float(values.mean())
        if self.logarithmic:
            return float((logsumexp(q * values) - np.log(len(values))) / q)

        # Relative to the largest value: its power neither overflows nor vanishes.
        largest = values.max()
        return float(largest * np.mean((values / largest) ** q) ** (1.0 / q))

    def weights(self, phi: Sequence[float]) -> Array:
        """Derivative of the pooled criterion.

        Args:
            phi: S values of the criterion, all finite.

        Returns:
            (S,) derivative by each of them.
        """
        q = POOLING_EXPONENT
        values = np.asarray(phi, dtype=np.float64)

        if self.over == "mean":
            return np.full(len(values), 1.0 / len(values))
        if self.logarithmic:
            return np.asarray(np.exp(q * values - logsumexp(q * values)))

        pooled = self.value(phi)
        return np.asarray((values / pooled) ** (q - 1.0) / len(values))

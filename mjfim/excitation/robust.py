"""Robust design: the guess is wrong by assumption, so phi is pooled over samples of the parameters.

mean    1/S sum_s phi_s
worst   (1/S sum_s phi_s^q)^(1/q), a smooth maximum; for D-optimality, whose phi is a logarithm, log-mean-exp of q phi
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Literal

import numpy as np
from scipy.special import logsumexp

from mjfim.arrays import Array

POOLING_EXPONENT = 20.0


@dataclass(frozen=True, eq=False)
class ParameterSamples:
    """How phi at several parameter values becomes one number.

    thetas: (S, p), the guess first;  over: mean or worst;  logarithmic: True for D-optimality
    """

    thetas: Array
    over: Literal["mean", "worst"]
    logarithmic: bool = False

    def value(self, phi: Sequence[float]) -> float:
        """The pooled criterion; infinite where one of them is."""
        values = np.asarray(phi, dtype=np.float64)
        if not np.isfinite(values).all():
            return np.inf
        if self.over == "mean":
            return float(values.mean())
        if self.logarithmic:
            return float(
                (logsumexp(POOLING_EXPONENT * values) - np.log(len(values))) / POOLING_EXPONENT
            )
        top = values.max()
        return float(top * np.mean((values / top) ** POOLING_EXPONENT) ** (1.0 / POOLING_EXPONENT))

    def weights(self, phi: Sequence[float]) -> Array:
        """(S,) derivative of the pooled criterion by each phi."""
        values = np.asarray(phi, dtype=np.float64)
        if self.over == "mean":
            return np.full(len(values), 1.0 / len(values))
        if self.logarithmic:
            return np.asarray(
                np.exp(POOLING_EXPONENT * values - logsumexp(POOLING_EXPONENT * values))
            )
        pooled = self.value(phi)
        return np.asarray((values / pooled) ** (POOLING_EXPONENT - 1.0) / len(values))

"""Parameters whose effect follows from that of others, because combinations of them have none."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
import scipy

from mjfim.arrays import Array

# Smallest ratio of the last to the first pivot with which parameters are lumped.
LEAST_PIVOT_RATIO = 1e-3

# Entry of a direction, relative to its largest one, below which the entry is round-off.
ROUND_OFF = 1e-12

# Largest effect of the probe, relative to the effects that cancel in it, that counts as none. It is
# above the curvature of one-sided differences.
LARGEST_REMAINDER = 1e-4


@dataclass(frozen=True, kw_only=True, eq=False)
class LumpedParameters:
    """Parameters that are lumped into others.

    Along a direction n without effect, `psi n = 0`. With k such directions, the columns of k
    parameters follow from those of the p - k others, so that only these need rollouts.

    Attributes:
        base: (b,) indices of the parameters that are moved.
        lumped: (k,) indices of the others.
        coefficients: (b, k) psi of the lumped parameters is psi of the base ones times these.
        probe: (p,) a combination of the directions without effect, whose rollout shows whether they
            have none along a motion [theta-unit].
    """

    base: np.ndarray
    lumped: np.ndarray
    coefficients: Array
    probe: Array

    @staticmethod
    def of(directions: Array, size: Array) -> LumpedParameters | None:
        """Choose the lumped parameters, so that the coefficients are small.

        Args:
            directions: (p, k) directions without effect [theta-unit].
            size: (p,) magnitudes of the parameters [theta-unit].

        Returns:
            The choice; None without directions, or where they are nearly dependent.
        """
        k = directions.shape[1]
        if not k:
            return None

        # A parameter that takes part in a direction by round-off only does not take part in it.
        relative = directions / size[:, None]
        largest = np.abs(relative).max(axis=0)
        relative = np.where(np.abs(relative) > ROUND_OFF * largest, relative, 0.0)
        unit = relative / np.linalg.norm(relative, axis=0)
        _, triangle, pivots = scipy.linalg.qr(unit.T, mode="economic", pivoting=True)
        diagonal = np.abs(np.diag(triangle))
        if not diagonal[k - 1] > LEAST_PIVOT_RATIO * diagonal[0]:
            return None

        lumped = np.sort(pivots[:k])
        base = np.setdiff1d(np.arange(len(size)), lumped)
        by_size = -unit[base] @ np.linalg.inv(unit[lumped])
        share = np.random.default_rng(0).standard_normal(k)
        return LumpedParameters(
            base=base,
            lumped=lumped,
            coefficients=by_size * size[base][:, None] / size[lumped],
            probe=size * (unit @ share),
        )

    def expanded(self, of_base: Array) -> Array:
        """(..., p) derivatives by all parameters from those by the base ones: (..., b)."""
        count = len(self.base) + len(self.lumped)
        full = np.empty((*of_base.shape[:-1], count))
        full[..., self.base] = of_base
        full[..., self.lumped] = of_base @ self.coefficients
        return full

    def explains(self, derivatives: Array, along_probe: Array) -> bool:
        """Check whether the probe has no effect on a motion.

        Args:
            derivatives: (..., p) derivatives of states or outputs by all parameters, relative to
                the sizes of the states or outputs.
            along_probe: (...) derivatives along the probe.

        Returns:
            True where the effects of the parameters cancel along the probe.
        """
        lengths = np.linalg.norm(derivatives.reshape(-1, derivatives.shape[-1]), axis=0)
        parts = float(np.abs(self.probe) @ lengths)
        return bool(np.linalg.norm(along_probe) <= LARGEST_REMAINDER * parts)

"""Records of a Monte Carlo study."""

from __future__ import annotations

from dataclasses import dataclass

from mjfim.arrays import Array, freeze


@dataclass(frozen=True, eq=False, kw_only=True)
class TrialStatistics:
    """Monte-Carlo estimates along one trajectory, against theory.

    estimates: (trials, p), NaN rows for failed trials;  mean: (p,);  covariance, crlb: (p, p)
    efficiency: (p,) CRLB variance over observed variance (1 = the bound is reached)
    efficiency_interval: (p, 2) 95 % confidence interval of each efficiency (chi-square on the variance)
    """

    estimates: Array
    mean: Array
    covariance: Array
    crlb: Array
    efficiency: Array
    efficiency_interval: Array
    trials: int
    failed: int
    seconds: float = 0.0

    def __post_init__(self) -> None:
        freeze(self, "estimates", "mean", "covariance", "crlb", "efficiency", "efficiency_interval")


@dataclass(frozen=True, eq=False, kw_only=True)
class MonteCarloStudy:
    """Monte-Carlo studies of trajectories by name (`initial`, `final`).

    theta: (p,) the true values; information: (p, p) by the same names
    """

    parameters: tuple[str, ...]
    theta: Array
    measure_rate: float
    sets: dict[str, TrialStatistics]
    information: dict[str, Array]

    def __post_init__(self) -> None:
        freeze(self, "theta")

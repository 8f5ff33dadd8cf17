"""Records of a Monte Carlo study of the estimator."""

from __future__ import annotations

from typing import Any

from mjfim.arrays import Array
from mjfim.records.base import Record, ShownRecord, record
from mjfim.records.labels import Labels


@record
class TrialStatistics(Record):
    """Estimates from simulated recordings of one trajectory, and the Cramér-Rao bound.

    Attributes:
        estimates: (trials, p) estimated parameters; rows of NaN for failed trials.
        mean: (p,) mean of the estimates.
        covariance: (p, p) sample covariance of the estimates.
        crlb: (p, p) Cramér-Rao lower bound of the covariance.
        efficiency: (p,) ratio of the bound to the observed variance; 1 if the bound is reached.
        efficiency_interval: (p, 2) 95 % confidence interval of each efficiency, from the
            chi-squared distribution of the sample variance.
        trials: Number of trials.
        failed: Number of trials whose fit failed.
        seconds: Wall time [s].
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


@record
class MonteCarloStudy(ShownRecord):
    """Result of `mjfim.monte_carlo`: statistics of estimates along one or more trajectories.

    Attributes:
        parameters: Names of the p parameters.
        theta: (p,) true values.
        measure_rate: Rate of the measurements [Hz].
        sets: Statistics by name of the trajectory (`initial`, `final`).
        information: (p, p) Fisher information of each trajectory, with the keys of `sets`.
        labels: Names and units for figures and tables; None in records of earlier versions.
    """

    parameters: tuple[str, ...]
    theta: Array
    measure_rate: float
    sets: dict[str, TrialStatistics]
    information: dict[str, Array]
    labels: Labels | None = None

    file_stem = "montecarlo"
    made_by = "`mjfim montecarlo EXPERIMENT DESIGN.npz -o DIR`"

    def summary(self) -> dict[str, Any]:
        """Return the contents of montecarlo.json."""
        values: dict[str, Any] = {
            "parameters": list(self.parameters),
            "theta": self.theta,
            "measure_rate": self.measure_rate,
        }
        for name, trials in self.sets.items():
            values[name] = {
                "mean": trials.mean,
                "covariance": trials.covariance,
                "crlb": trials.crlb,
                "efficiency": trials.efficiency,
                "efficiency_interval": trials.efficiency_interval,
                "information": self.information[name],
                "trials": trials.trials,
                "failed": trials.failed,
                "seconds": trials.seconds,
            }
        return values

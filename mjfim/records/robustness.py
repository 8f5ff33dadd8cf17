"""Records of a robustness study, which plays a design on robots that differ from the model."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjfim.arrays import NORMAL_95, Array
from mjfim.errors import MAX_NOISE, MAX_WRONG, ExperimentError
from mjfim.records.base import Record, ShownRecord, record

# Probability with which the intervals and joint regions should hold the true values.
CONFIDENCE = 0.95


# Required fraction of robots whose interval contains the true value, for every parameter.
REQUIRED_COVERAGE = 0.90


# Default delay of the control of a simulated robot [s]; it is rounded up to whole timesteps.
LATENCY = 5e-3


# Smallest reserve, as a fraction of half a range; smaller values are round-off.
MIN_RESERVE = 1e-9


@record
class RobotConditions(Record):
    """Differences between the simulated robots and the model.

    Attributes:
        wrong: Relative error of the nominal value of every parameter; its sign is random.
        latency: Delay of the control [s].
        feedback: True if the controller adds the gains times the measured deviation.
        loudness: Ratio of the robot's noise to the stated noise.
        seed: Seed of the random numbers.
    """

    wrong: float = 0.2
    latency: float = LATENCY
    feedback: bool = False
    loudness: float = 1.0
    seed: int = 0

    def check(self) -> None:
        """Check that every number is in its range.

        Raises:
            ExperimentError: A number is not.
        """
        for name, value, most in (
            ("wrong", self.wrong, MAX_WRONG),
            ("noise", self.loudness, MAX_NOISE),
        ):
            if not 0.0 <= value <= most:
                raise ExperimentError(f"{name}: {value:g} is not a number from 0 to {most:g}")

        if not 0.0 <= self.latency < np.inf:
            raise ExperimentError(f"latency: {self.latency:g} is not a finite number of at least 0")


@record
class RobotRun(Record):
    """One simulated robot on which the design was played, and the estimate from its recording.

    Attributes:
        theta: (p,) true parameters [theta-unit].
        estimate: (p,) estimated parameters [theta-unit]; NaN if the robot could not be identified.
        covariance: (p, p) covariance of the estimate [theta-unit²].
        margins: (l,) smallest margin of each limit divided by half of its range; negative if the
            limit is exceeded.
        fit: Sum of squared whitened residuals divided by the degrees of freedom.
        misfit: True if the residuals contradict the model or the noise.
        restarted: True if the fit from the first initial guess was a misfit and others were tried.
        trouble: Reason why there is no estimate, or why it is in doubt; else empty.
    """

    theta: Array
    estimate: Array
    covariance: Array
    margins: Array
    fit: float
    misfit: bool
    restarted: bool = False
    trouble: str = ""

    @property
    def std(self) -> Array:
        """(p,) formal standard deviations of the estimate [theta-unit]."""
        return np.asarray(np.sqrt(np.diag(self.covariance)))

    def squared_distance(self, chosen: np.ndarray) -> float:
        """Squared Mahalanobis distance between true and estimated values of several parameters.

        It has a chi-squared distribution if the covariance is right.

        Args:
            chosen: Indices of the parameters.

        Returns:
            The squared distance.
        """
        error = (self.estimate - self.theta)[chosen]
        covariance = self.covariance[np.ix_(chosen, chosen)]
        return float(error @ np.linalg.solve(covariance, error))


@record
class AssessedLimit(Record):
    """A limit whose margin is evaluated on every robot.

    Attributes:
        kind: Kind of the limit: `position`, `velocity`, `acceleration`, `control`, `control_rate`,
            `force`, `joint_force` or `clearance`.
        name: Name of the joint or actuator; "nearest pair" for a clearance.
        lower: Lower bound [unit of the quantity].
        upper: Upper bound [unit of the quantity].
        scale: Half of the range, by which margins are divided [unit of the quantity]; the range
            is from `lower` to `upper`.
    """

    kind: str
    name: str
    lower: float
    upper: float
    scale: float


@record
class Robustness(ShownRecord):
    """Result of a robustness study with n robots, g of which could be identified.

    Attributes:
        conditions: How the robots differ from the model.
        names: Names of the p unknowns.
        units: Unit of each unknown.
        limits: The l limits.
        wrong: (p,) root mean square of the errors of the guess [theta-unit].
        z: (g, p) errors of the estimates in standard deviations.
        error: (g, p) errors of the estimates [theta-unit].
        std: (g, p) formal standard deviations [theta-unit]; NaN for unknowns that are identifiable
            only in combination with others.
        predicted: (p,) standard deviations predicted before any run [theta-unit].
        joint: Numbers of robots whose joint confidence region contains the true values: the region
            of the parameters that the experiment states, and the region of all unknowns.
        margins: (n, l) smallest margins divided by half of their ranges.
        planned: (l,) margins of the design on the model divided by half of their ranges.
        fit: Mean over robots of the sum of squared whitened residuals divided by the degrees of
            freedom.
        misfits: Number of misfits.
        restarted: Number of fits that needed another initial guess.
        troubles: Number of robots by the sentence that states their problem.
    """

    conditions: RobotConditions
    names: tuple[str, ...]
    units: tuple[str, ...]
    limits: tuple[AssessedLimit, ...]
    wrong: Array
    z: Array
    error: Array
    std: Array
    predicted: Array
    joint: tuple[int, int]
    margins: Array
    planned: Array
    fit: float
    misfits: int
    restarted: int
    troubles: dict[str, int]

    file_stem = "playback"
    made_by = "`mjfim robustness EXPERIMENT -o DIR`"
    in_json = (
        "ok",
        "conditions",
        "runs",
        "fit",
        "misfits",
        "restarted",
        "troubles",
        "all_kept",
    )
    json_names = {
        "restarted": "begun_again",
        "all_kept": "all_limits_kept",
    }

    @property
    def runs(self) -> int:
        """Number n of robots."""
        return len(self.margins)

    @property
    def identified(self) -> np.ndarray:
        """(p,) True if a parameter is identifiable alone, not only in combination with others."""
        return np.asarray(np.isfinite(self.std).all(axis=0)) & (len(self.std) > 0)

    @property
    def inside(self) -> np.ndarray:
        """(p,) number of robots whose interval contains the true value."""
        return np.asarray((np.abs(self.z) <= NORMAL_95).sum(axis=0))

    @property
    def observed(self) -> Array:
        """(p,) root mean square of the errors of the estimates [theta-unit]."""
        return _root_mean_square(self.error)

    @property
    def formal(self) -> Array:
        """(p,) root mean square of the formal standard deviations [theta-unit]."""
        return _root_mean_square(self.std)

    @property
    def kept(self) -> np.ndarray:
        """(n, l) True if a robot keeps a limit.

        A force at its limit is clamped by the simulation, which does not count as kept.
        """
        clamped = [limit.kind in ("force", "joint_force", "tendon_force") for limit in self.limits]
        return np.where(clamped, self.margins > 0.0, self.margins >= 0.0)

    @property
    def all_kept(self) -> int:
        """Number of robots that keep every limit."""
        return int(self.kept.all(axis=1).sum())

    @property
    def lost(self) -> Array:
        """(l,) distance by which the worst robot is closer to a limit than the design.

        It is divided by half of the limit's range.
        """
        worst = self.margins.min(axis=0)
        return np.asarray(np.maximum(self.planned - worst, 0.0))

    @property
    def covered(self) -> bool:
        """True if the intervals of all parameters contain the true values often enough."""
        inside = self.inside[self.identified]
        often = inside >= REQUIRED_COVERAGE * self.runs - 1e-9
        return bool(often.all()) and bool(self.identified.any())

    @property
    def ok(self) -> bool:
        """True if the intervals cover often enough and every robot keeps all limits."""
        return self.covered and self.all_kept == self.runs

    def reserve(self) -> dict[str, float]:
        """Reserve that a design needs so that all robots keep the limits, by kind of limit.

        Returns:
            Distance to the limit divided by half of its range, rounded up to 0.01; kinds that need
            no reserve are left out.
        """
        needed: dict[str, float] = {}
        for limit, share in zip(self.limits, self.lost.tolist(), strict=True):
            if share > MIN_RESERVE:
                needed[limit.kind] = max(needed.get(limit.kind, 0.0), share)

        return {kind: float(np.ceil(100.0 * share) / 100.0) for kind, share in needed.items()}

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        return {
            **super().summary(),
            "parameters": [self._parameter_summary(j) for j in range(len(self.names))],
            "joint": {"parameters": self.joint[0], "all": self.joint[1]},
            "limits": [self._limit_summary(i) for i in range(len(self.limits))],
            "reserve": self.reserve(),
        }

    def _parameter_summary(self, j: int) -> dict[str, Any]:
        """Return the entry of one unknown in playback.json."""
        return {
            "name": self.names[j],
            "unit": self.units[j],
            "wrong": self.wrong[j],
            "predicted": self.predicted[j],
            "stated": self.formal[j],
            "error": self.observed[j],
            "inside": int(self.inside[j]),
        }

    def _limit_summary(self, i: int) -> dict[str, Any]:
        """Return the entry of one limit in playback.json."""
        limit = self.limits[i]
        return {
            "kind": limit.kind,
            "name": limit.name,
            "range": [limit.lower, limit.upper],
            "planned": self.planned[i] * limit.scale,
            "worst": self.margins[:, i].min() * limit.scale,
            "kept": int(self.kept[:, i].sum()),
        }


def _root_mean_square(values: Array) -> Array:
    """Root mean square over the rows of (n, p) values: (p,), NaN where there are no rows."""
    if not len(values):
        return np.full(values.shape[1:], np.nan)
    return np.asarray(np.sqrt((values**2).mean(axis=0)))

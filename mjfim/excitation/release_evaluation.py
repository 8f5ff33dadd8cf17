"""Evaluation of releases: their motion, limits, information and cost."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.constraints import ConstraintSet, constraint_set_of
from mjfim.excitation.evaluation import UNSTABLE_GROWTH
from mjfim.excitation.levels import DescentLevel
from mjfim.excitation.objective import DIVERGED, DesignPoint
from mjfim.excitation.release_space import ReleaseSpace
from mjfim.optimize.lq import largest_amplification
from mjfim.plant.mixed_derivatives import CENTRAL_DIFFERENCES
from mjfim.plant.plant import Plant
from mjfim.records.design import IterateMotion
from mjfim.records.trajectory import Trajectory

# Name of the growth of a small disturbance among the margins.
GROWTH = "growth"

# Objective of a release that diverges, above that of any other.
WORST = 1e3

# Least cost whose logarithm is taken; it avoids the logarithm of zero.
TINY = 1e-300


@dataclass(frozen=True, kw_only=True, eq=False)
class Release:
    """One release, evaluated. It can be pickled, and is small.

    Attributes:
        shares: (d,) place in the ranges.
        cost: J; infinite where the simulation diverges.
        objective: Objective of a local search, which has no unit.
        criterion: Value of the criterion.
        min_eigenvalue: Smallest eigenvalue of the information.
        margins: Smallest relative margin of each kind of limit, and of the growth of a small
            disturbance; empty where it diverges.
        motion: Its motion; None where it diverges.
    """

    shares: Array
    cost: float = np.inf
    objective: float = WORST
    criterion: float = np.inf
    min_eigenvalue: float = 0.0
    margins: dict[str, float]
    motion: IterateMotion | None = None

    @property
    def diverges(self) -> bool:
        """True where the simulation diverges."""
        return self.motion is None

    @property
    def margin(self) -> float:
        """Smallest relative margin; -infinite where the simulation diverges."""
        return -np.inf if self.diverges else min(self.margins.values(), default=np.inf)

    @property
    def margins_of_limits(self) -> dict[str, float]:
        """Smallest relative margin of the limits of each kind."""
        return {kind: margin for kind, margin in self.margins.items() if kind != GROWTH}

    @property
    def rank(self) -> tuple[bool, float]:
        """Order of the releases: those within the limits first, then by cost or violation."""
        if self.margin >= 0.0:
            return False, self.cost
        return True, -self.margin


class ReleaseEvaluation:
    """Evaluates releases of a task.

    Args:
        stage: The task and its criterion.
        space: Ranges of the release.
        plant: Plant of the task, perhaps with other difference steps.
    """

    def __init__(self, stage: DescentLevel, space: ReleaseSpace, plant: Plant) -> None:
        self.stage = stage
        self.space = space
        self.plant = plant
        self._constraints: ConstraintSet | None = None
        if stage.task.is_limited:
            self._constraints = constraint_set_of(stage.task)

    def released(self, shares: Array) -> Plant:
        """Give the plant the initial state of a release.

        Args:
            shares: (d,) place in the ranges.
        """
        return self.plant.with_initial_state(self.space.state(shares))

    def release(self, shares: Array) -> Release:
        """Evaluate a release.

        Args:
            shares: (d,) place in the ranges.
        """
        point, margins = self._evaluated(shares)
        if point.trajectory is None or point.criterion is None:
            return Release(shares=shares, margins={})

        return Release(
            shares=shares,
            cost=point.cost,
            objective=self._objective(point),
            criterion=point.criterion.value,
            min_eigenvalue=float(point.criterion.eigenvalues[0]),
            margins=margins,
            motion=IterateMotion.of(point.trajectory),
        )

    def point(self, shares: Array) -> DesignPoint:
        """Evaluate the motion and the information of a release, with all derivatives.

        Args:
            shares: (d,) place in the ranges.
        """
        return self._evaluated(shares)[0]

    def _evaluated(self, shares: Array) -> tuple[DesignPoint, dict[str, float]]:
        """Simulate a release, with its limits, its information and its cost."""
        plant = self.released(shares)
        moved = self._simulated(plant)
        if moved is None:
            return DIVERGED, {}

        trajectory, margins = moved
        problem = replace(self.stage.problem, plant=plant)
        point = problem.point(trajectory, CENTRAL_DIFFERENCES)
        if point.trajectory is None:
            return DIVERGED, {}
        return point, {**margins, GROWTH: self._margin_of_growth(plant, trajectory)}

    def _objective(self, point: DesignPoint) -> float:
        """Objective of the local search, which has no unit."""
        if not np.isfinite(point.cost):
            return WORST

        # A logarithmic criterion may be negative; one nat per parameter is its size.
        if self.stage.problem.information.criterion == "D":
            return point.cost / self.stage.problem.size(point)
        return float(np.log(max(point.cost, TINY)))

    def _margin_of_growth(self, plant: Plant, trajectory: Trajectory) -> float:
        """Margin of the growth of a small disturbance; 0 where it grows `UNSTABLE_GROWTH`-fold.

        The criterion favours motions that are close to chaotic, which no feedback could steer.
        """
        task = self.stage.task
        try:
            A, _, _, _ = plant.derivatives.jacobians(task.theta, trajectory)
        except SimulationDivergedError:
            return -1.0

        growth = largest_amplification(A, task.sizes[: task.space.nx])
        least = np.finfo(float).tiny
        return float(1.0 - np.log(max(growth, least)) / np.log(UNSTABLE_GROWTH))

    def _simulated(self, plant: Plant) -> tuple[Trajectory, dict[str, float]] | None:
        """Motion of a plant from its initial state, with the relative margins of its limits."""
        task, constraints = self.stage.task, self._constraints
        if constraints is None:
            try:
                return plant.simulate(task.theta, task.control), {}
            except SimulationDivergedError:
                return None

        found = plant.observe(task.theta, task.control, constraints.observations)
        if found is None:
            return None
        trajectory, observed = found
        values = constraints.evaluate(trajectory, observed, slopes=False)
        return trajectory, constraints.relative_margins(values)

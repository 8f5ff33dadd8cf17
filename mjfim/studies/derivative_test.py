"""Derivatives checked on the user's own model: two difference steps, the recursion of psi, the slope along the manifold."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.objective import DesignPoint, DesignProblem
from mjfim.excitation.task import DesignTask
from mjfim.excitation.unconstrained import regulator_for
from mjfim.information.smoothness import roughness, visible_columns
from mjfim.optimize.directions import LBFGS
from mjfim.optimize.lq import LinearRecursion, TangentCurve
from mjfim.optimize.projection_operator import Expansion
from mjfim.plant.active_constraints import first_active_constraint
from mjfim.records.check import SelfTest
from mjfim.records.trajectory import Sensitivity, Trajectory


def self_test(task: DesignTask, problem: DesignProblem, point: DesignPoint) -> SelfTest:
    """Test the derivatives about a point of a problem that was computed with central differences."""
    trajectory = point.trajectory
    if trajectory is None or point.sensitivity is None:
        raise SimulationDivergedError("the trajectory diverges when the parameters move a little")
    found = SelfTest(
        roughness=roughness(
            task.plant,
            task.system.noise,
            task.system.model_at(task.theta),
            task.theta,
            trajectory,
            point.sensitivity,
        ),
        recursion=recursion_error(task, trajectory, point.sensitivity),
        slope=slope_error(task, problem, point),
    )
    if found.passed or found.roughness is not None:
        return found
    active = first_active_constraint(task.system.model_at(task.theta), trajectory)
    if active is None:
        return replace(
            found,
            likely_cause="the motion may be too unstable, or something switches (muscle activation)",
        )
    sample, causes = active
    where = f"sample {sample} (t = {trajectory.t[sample]:.4g} s)"
    return replace(
        found, likely_cause=f"something that switches acts from {where} on: {', '.join(causes)}"
    )


def recursion_error(task: DesignTask, trajectory: Trajectory, sensitivity: Sensitivity) -> float:
    """Largest difference between two ways to psi, relative to the largest entry of each parameter's psi."""
    try:
        line = task.plant.derivatives.linearize(task.theta, trajectory)
    except SimulationDivergedError:
        return np.inf
    psi = sensitivity.psi
    recursion = LinearRecursion(line.A)
    own = np.stack(
        [recursion.forward(psi[0, :, j], line.E[..., j]) for j in range(psi.shape[2])], axis=2
    )
    size = np.abs(psi).max(axis=(0, 1))
    moving = (size > 0.0) & visible_columns(
        task.parameters, task.system.noise.whiten(sensitivity.G)
    )
    if not moving.any():
        return 0.0
    return float((np.abs(own - psi).max(axis=(0, 1))[moving] / size[moving]).max())


def slope_error(task: DesignTask, problem: DesignProblem, point: DesignPoint) -> float:
    """Relative error of DJ.zeta along the first descent direction, against central differences through the projection."""
    if not np.isfinite(point.cost) or point.trajectory is None:
        return float("nan")
    expansion = problem.expand(point)
    K = regulator_for(task).gain(expansion)
    zeta = LBFGS(np.diag(task.control_weight) * task.dt)(expansion, K)
    size = task.plant.derivatives.difference_sizes(point.trajectory)
    relative = max(
        np.abs(zeta.z / size[: zeta.z.shape[1]]).max(),
        np.abs(zeta.v / size[zeta.z.shape[1] :]).max(),
    )
    if relative == 0.0:
        return 0.0
    unit = TangentCurve(z=zeta.z / relative, v=zeta.v / relative)
    return min(_slope_error(problem, point, expansion, unit, K, step) for step in (1e-3, 1e-4))


def _slope_error(
    problem: DesignProblem,
    point: DesignPoint,
    expansion: Expansion,
    zeta: TangentCurve,
    K: Array,
    step: float,
) -> float:
    ends = [problem.value(problem.project(point, zeta, sign * step, K)) for sign in (1.0, -1.0)]
    expected = expansion.slope(zeta)
    if not np.isfinite(ends).all():
        return np.inf
    return float(abs((ends[0] - ends[1]) / (2.0 * step) - expected) / max(abs(expected), 1e-300))

"""Tests of the derivatives on the user's model.

Three numbers are compared along one trajectory: dy/dtheta by two difference steps, psi by rollouts
against its linear recursion, and the slope of the cost against differences of the cost through the
projection operator.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from typing import Any

import numpy as np

from mjfim.errors import SimulationDivergedError, first_ones
from mjfim.excitation.objective import DesignPoint, DesignProblem
from mjfim.excitation.search.levels import regulator_for
from mjfim.excitation.task import DesignTask
from mjfim.information.smoothness import roughness, visible_columns
from mjfim.optimize.directions import LBFGS
from mjfim.optimize.lq import LinearRecursion, TangentCurve
from mjfim.plant.active_constraints import first_active_constraint
from mjfim.records.check import SelfTest
from mjfim.records.events import begin_stage
from mjfim.records.trajectory import Sensitivity, Trajectory

# Steps along the tested curve, in units of the plant's difference steps. The smaller error of the
# two counts.
SLOPE_STEPS = (1e-3, 1e-4)

# Smallest slope by which an error is divided; it prevents a division by zero.
LEAST_SLOPE = 1e-300


def self_test(
    task: DesignTask,
    problem: DesignProblem,
    point: DesignPoint,
    stop: Callable[[], bool] = lambda: False,
) -> SelfTest:
    """Test the derivatives about one trajectory.

    Args:
        task: Task whose model is tested.
        problem: Cost whose slope is tested.
        point: Trajectory with the cost there, computed with central differences.
        stop: Asked before each of the three tests; true leaves out the rest of them.

    Raises:
        SimulationDivergedError: The trajectory diverges when the parameters change a little.
    """
    trajectory = point.trajectory
    if trajectory is None or point.sensitivity is None:
        raise SimulationDivergedError("the trajectory diverges when the parameters change a little")

    model = task.system.model_at(task.theta)
    sensitivity = point.sensitivity

    def slope() -> float:
        """The error of the slope; infinite where a motion is too unstable for a direction."""
        try:
            return slope_error(task, problem, point)
        except np.linalg.LinAlgError:
            return np.inf

    tests: dict[str, tuple[str, Callable[[], Any]]] = {
        "roughness": (
            "two step sizes",
            lambda: roughness(
                task.plant, task.system.noise, model, task.theta, trajectory, sensitivity
            ),
        ),
        "recursion": ("recursion", lambda: recursion_error(task, trajectory, sensitivity)),
        "slope": ("slope", slope),
    }
    tested = SelfTest(roughness=None, recursion=np.nan, slope=np.nan, finished=False)
    for number, (key, (name, error)) in enumerate(tests.items()):
        if stop():
            return tested
        # A state does not show what control laws remember: there is no recursion and no slope.
        is_possible = task.plant.laws is None or key == "roughness"
        begin_stage(f"testing the derivatives: {name}", number, len(tests))
        found: dict[str, Any] = {key: error() if is_possible else 0.0}
        tested = replace(tested, **found)
    tested = replace(tested, finished=True)

    # The result of the roughness test names its cause. The likely cause of any other failure is the
    # first constraint that acts.
    if tested.passed or tested.roughness is not None:
        return tested
    active = first_active_constraint(model, trajectory)
    if active is None:
        cause = "the motion may be too unstable, or a component switches (muscle activation)"
        return replace(tested, likely_cause=cause)

    sample, causes = active
    cause = (
        f"constraints are active from sample {sample} (t = {trajectory.t[sample]:.4g} s): "
        f"{first_ones(causes)}"
    )
    return replace(tested, likely_cause=cause)


def recursion_error(task: DesignTask, trajectory: Trajectory, sensitivity: Sensitivity) -> float:
    """Compare psi by rollouts with psi by the recursion `psi_{k+1} = A_k psi_k + E_k`.

    Args:
        task: Task whose model is tested.
        trajectory: Trajectory of N samples.
        sensitivity: psi: (N+1, nx, p) [x-unit / theta-unit] and G: (N+1, ny, p) along it, by
            rollouts.

    Returns:
        Largest difference, relative to the largest entry of each parameter's psi; infinite where
        the motion diverges.
    """
    try:
        linear = task.plant.derivatives.linearize(task.theta, trajectory)
    except SimulationDivergedError:
        return np.inf

    psi = sensitivity.psi
    recursion = LinearRecursion(linear.A)
    columns = [recursion.forward(psi[0, :, j], linear.E[..., j]) for j in range(psi.shape[2])]
    expected = np.stack(columns, axis=2)

    # The psi of a parameter without measurable effect is round-off, which does not test the
    # recursion.
    size = np.abs(psi).max(axis=(0, 1))
    whitened = task.system.noise.whiten(sensitivity.G)
    visible = (size > 0.0) & visible_columns(task.parameters, whitened)
    if not visible.any():
        return 0.0

    error = np.abs(expected - psi).max(axis=(0, 1))
    return float((error[visible] / size[visible]).max())


def slope_error(task: DesignTask, problem: DesignProblem, point: DesignPoint) -> float:
    """Compare the slope `DJ . zeta` of the cost with differences of the cost.

    zeta is the first descent direction; the central differences are those of `J(P(xi + gamma
    zeta))`.

    Args:
        task: Task whose model is tested.
        problem: Cost whose slope is tested.
        point: Trajectory with the cost there.

    Returns:
        Relative error; NaN where the cost is infinite, infinite where a moved trajectory diverges.
        It is 0 for a model without actuators, whose cost has no slope along a control.
    """
    if not np.isfinite(point.cost) or point.trajectory is None:
        return float("nan")
    if not task.controls:
        return 0.0

    expansion = problem.expand(point)
    K = regulator_for(task).gain(expansion)
    # Without a weight on every control, the direction would divide by zero.
    weights, metric = task.control_weight, regulator_for(task).R
    if (weights > 0.0).all():
        metric = np.diag(weights) * task.dt
    zeta = LBFGS(metric)(expansion, K)

    # Scale the curve so that its largest entry is one difference step of the plant.
    sizes = task.plant.derivatives.difference_sizes(point.trajectory)
    nx = zeta.z.shape[1]
    largest = max(np.abs(zeta.z / sizes[:nx]).max(), np.abs(zeta.v / sizes[nx:]).max())
    if largest == 0.0:
        return 0.0

    unit = TangentCurve(z=zeta.z / largest, v=zeta.v / largest)
    expected = expansion.slope(unit)
    errors = []
    for step in SLOPE_STEPS:
        sides = [problem.value(problem.project(point, unit, s, K)) for s in (step, -step)]
        if np.isfinite(sides).all():
            measured = (sides[0] - sides[1]) / (2.0 * step)
            errors.append(abs(measured - expected) / max(abs(expected), LEAST_SLOPE))
    return float(min(errors, default=np.inf))

"""Duration of a design, estimated before it begins."""

from __future__ import annotations

from mjfim.arrays import Array
from mjfim.duration import estimated_seconds
from mjfim.errors import MjfimError
from mjfim.excitation.task import DesignTask
from mjfim.excitation.task_parts import stated_control
from mjfim.excitation.unconstrained import regulator_for
from mjfim.experiment.system import System
from mjfim.optimize.directions import LBFGS
from mjfim.plant.mixed_derivatives import FORWARD_DIFFERENCES

# Step length of the tried iteration; a short one does not let the simulation diverge.
SHORT_STEP = 1e-9


def iteration_seconds(system: System, negligible: float = 0.0) -> float | None:
    """Estimate the time of one iteration of a design, by iterations over a few samples.

    Args:
        system: The system, whose experiment states the horizon and the initial control.
        negligible: Duration that need not be known accurately [s].

    Returns:
        The time [s]; None where the first samples cannot be evaluated, or where the experiment is
        wrong, which the design itself says.
    """
    robust = system.experiment.robust
    factor = 1 if robust is None else robust.samples
    try:
        control = stated_control(system)
        return factor * estimated_seconds(
            lambda samples: _iterate(system, control[:samples]),
            len(control),
            negligible=negligible / factor,
        )
    except (MjfimError, ValueError):
        return None


def _iterate(system: System, control: Array) -> None:
    """Make one iteration of a design without limits, along a control: (n, nu)."""
    task = DesignTask.along(system, control)
    problem, regulator = task.problem, regulator_for(task)
    point = problem.point(task.initial, FORWARD_DIFFERENCES)

    expansion = problem.expand(point)
    gain = regulator.gain(expansion)
    direction = LBFGS(regulator.R)(expansion, gain)
    problem.project(point, direction, SHORT_STEP, gain)

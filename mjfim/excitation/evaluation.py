"""What a trajectory tells, and the words of warning about it."""

from __future__ import annotations

from collections.abc import Iterator

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.limits import unsupported_ranges
from mjfim.excitation.objective import DesignPoint
from mjfim.excitation.task import DesignTask
from mjfim.excitation.unconstrained import Stage, regulator_for
from mjfim.excitation.verification import SAME_STATE_TOLERANCE, Verification
from mjfim.experiment.schema import Experiment
from mjfim.optimize.lq import largest_amplification, regulator
from mjfim.plant.derivatives import CENTRAL_DIFFERENCES
from mjfim.records.check import Roughness
from mjfim.records.design import Evaluation
from mjfim.records.trajectory import Trajectory


def point_at_stated_rate(stage: Stage, control: Array) -> DesignPoint | None:
    """A coarse level's control at the stated rate; None where it diverges."""
    try:
        return stage.problem.point(stage.task.plant.simulate(stage.task.theta, control))
    except SimulationDivergedError:
        return None


def evaluate(stage: Stage, point: DesignPoint) -> Evaluation:
    """Everything that a trajectory tells, with the regulator about it."""
    task, information = stage.task, stage.problem.information
    if (
        point.trajectory is None
        or point.sensitivity is None
        or point.information is None
        or point.criterion is None
    ):
        raise SimulationDivergedError("the trajectory diverges")
    A, B, _, _ = task.plant.derivatives.jacobians(task.theta, point.trajectory)
    r = regulator_for(task)
    return Evaluation(
        trajectory=point.trajectory,
        gain=regulator(A, B, r.Q, r.R, r.terminal),
        sensitivity=point.sensitivity.psi,
        information=point.information,
        eigenvalues=point.criterion.eigenvalues,
        std=information.std(point.information),
        min_eigenvalue=information.accumulated_eigenvalue(point.sensitivity),
        criterion=point.criterion.value,
        cost=point.cost,
        growth=largest_amplification(A),
    )


UNSTABLE = 1e3


def design_warnings(
    final: Evaluation,
    found: Verification,
    task: DesignTask,
    clamped: tuple[str, ...],
    rough: Roughness | None,
) -> Iterator[str]:
    """What a user must know about a design before running it. found: its limits at every engine step"""
    if rough is not None:
        yield str(rough)
    if clamped:
        yield (
            f"forcerange clamps {', '.join(clamped)} along the design: its derivatives do not hold there, it may rest on "
            "information that the clamp feigns, and the descent may have stopped early; raise cost.control or start more gently"
        )
    if final.growth > UNSTABLE:
        yield (
            f"a small disturbance grows up to {final.growth:.1e}-fold along this trajectory when its control is played "
            "open loop; the predicted sigma assumes that there is none. Play it with the gains of design.npz, or raise "
            "cost.control"
        )
    for kind, margin in found.margins.items():
        if margin < 0.0:
            advice = "widen it, start more gently, or give the design more time"
            if kind in found.unenforced:
                advice = (
                    "they are checked, not enforced; raise cost.control or cost.tracking until they hold before running "
                    "this on hardware"
                )
            yield f"{kind} limits are exceeded by {-margin:.3g}: {advice}"
    yield from open_boundary_warnings(task)
    if found.deviation > SAME_STATE_TOLERANCE:
        yield (
            f"played on the untouched model, the design deviates by up to {found.deviation:.2g}: a clamp, stop or contact acts"
        )


def open_boundary_warnings(task: DesignTask) -> Iterator[str]:
    """What the limits and boundaries that an experiment states leave open."""
    e, model = task.experiment, task.system.model
    rates = (
        {limit.name for limit in task.limits if limit.kind == "control_rate"}
        if e.limits.enforce
        else set()
    )
    jumps = e.limits.bandwidth is None and not rates.issuperset(task.controls)
    if "rest" in (e.boundary.start, e.boundary.end) and jumps:
        yield (
            "the control may jump where the design begins and ends at rest: for a smooth start state limits.control_rate or "
            "limits.bandwidth"
        )
    if e.limits.enforce:
        unseen = unsupported_ranges(model)
        if unseen:
            yield f"the MJCF's ranges of {', '.join(unseen)} are no limits of the design: the simulation runs into them as it is"


def evaluate_trajectory(experiment: Experiment, trajectory: Trajectory) -> Evaluation:
    """Evaluate the information and the cost along the control of a given trajectory, at the experiment's theta."""
    return evaluate_task(DesignTask.resolve(experiment), trajectory)


def evaluate_task(task: DesignTask, trajectory: Trajectory) -> Evaluation:
    """Evaluate the control of a trajectory in a resolved task. See `evaluate_trajectory`."""
    point = task.problem.point(
        task.plant.simulate(task.theta, trajectory.ctrl), CENTRAL_DIFFERENCES
    )
    if point.trajectory is None or point.sensitivity is None:
        raise SimulationDivergedError("the trajectory diverges when the parameters move a little")
    stage = Stage(task, task.observer.identifiability(point.trajectory, point.sensitivity).basis)
    return evaluate(stage, stage.problem.reevaluated(point))

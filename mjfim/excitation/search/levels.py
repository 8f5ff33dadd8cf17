"""Levels of a descent: coarser or smoother plants on which the optimisation begins."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import cached_property, partial

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, SimulationDivergedError
from mjfim.excitation.limits.constraint_kinds import ConstraintValues
from mjfim.excitation.limits.constraints import ConstraintSet, constraint_set_of
from mjfim.excitation.limits.verification import verify
from mjfim.excitation.objective import DesignPoint, DesignProblem
from mjfim.excitation.task import DesignTask
from mjfim.optimize.projection_operator import Regulator
from mjfim.plant.plant import LumpedParameters
from mjfim.records.trajectory import Trajectory

# Smallest number of samples of a coarse level.
MIN_COARSE_SAMPLES = 50

# Factors by which the timestep of a coarse level may be longer, and those of its samples where no
# factor of the timestep divides their engine steps; the coarsest level first.
TIMESTEP_FACTORS = (5, 4, 3, 2)
SAMPLE_FACTORS = (8, 4, 2)

# Growth of a small deviation along the trajectory above which the projection uses feedback. It is
# measured in the best units of the state, see `amplification_in_best_units`.
FEEDBACK_THRESHOLD = 10.0

# Largest relative change of the initial cost that a coarse level may cause. It is large, because
# the design is optimised again on the stated level.
MAX_COARSE_CHANGE = 0.5


@dataclass(frozen=True, eq=False)
class DescentLevel:
    """One level of a descent: a task and the criterion that is minimised for it.

    Attributes:
        task: The task at the sample rate of the level.
        basis: (t, s) identifiable combinations of the parameters, or None where all are
            identifiable.
        power: Power of the smooth E-criterion; infinite for 1/lambda_min itself.
        first: The initial control, evaluated on the unmodified plant; None where it is not known.
    """

    task: DesignTask
    basis: Array | None
    power: float = np.inf
    first: DesignPoint | None = None

    @cached_property
    def problem(self) -> DesignProblem:
        """The cost on this level."""
        problem = self.task.problem
        information = replace(problem.information, basis=self.basis, power=self.power)
        has_long_samples = self.task.system.variant.sample_factor > 1
        return replace(
            problem,
            information=information,
            forward_differences_only=has_long_samples,
            lumped=self._lumped,
        )

    @cached_property
    def constraints(self) -> ConstraintSet:
        """The limits."""
        return constraint_set_of(self.task)

    def values(self, control: Array) -> ConstraintValues | None:
        """Limited quantities along a control: (N, nu); None where the simulation diverges."""
        return self.constraints.along(self.task.plant, self.task.theta, control)

    def nearly_keeps(self, control: Array) -> bool:
        """Check the limits on the plant of this level only, which is much quicker."""
        values = self.values(control)
        return values is not None and self.constraints.is_feasible(values)

    def keeps(self, control: Array) -> bool:
        """Check the limits on the unmodified model as well."""
        return self.keeps_along(self.values(control))

    def keeps_along(self, values: ConstraintValues | None) -> bool:
        """Check the limits along a motion, also on the unmodified model."""
        if values is None or not self.constraints.is_feasible(values):
            return False
        return verify(self.task, values.trajectory, briefly=True).is_feasible

    def point_along(self, values: ConstraintValues | None) -> DesignPoint | None:
        """Evaluate a motion, inside limits or not; None where it diverges."""
        if values is None:
            return None
        known = None if self.first is None else moved_alike(self.first, values.trajectory)
        point = self.problem.point(values.trajectory) if known is None else known
        return None if point.trajectory is None else point

    def inside(self, control: Array) -> DesignPoint | None:
        """Evaluate a control: (N, nu); None where it violates a limit."""
        values = self.values(control)
        return self.point_along(values) if self.keeps_along(values) else None

    @property
    def engine_steps(self) -> int:
        """Number of engine steps of one simulation."""
        return self.task.samples * self.task.system.grid.substeps

    @property
    def _lumped(self) -> LumpedParameters | None:
        """Parameters whose effect follows from that of others; None where all are identifiable."""
        if self.basis is None:
            return None

        parameters = self.task.parameters
        wanted = parameters.interest
        without_effect = np.linalg.qr(self.basis, mode="complete")[0][:, self.basis.shape[1] :]
        directions = np.zeros((len(parameters), without_effect.shape[1]))
        directions[wanted] = without_effect * parameters.scale[wanted][:, None]
        return LumpedParameters.of(directions, parameters.magnitude)


def require_coarse_factor(task: DesignTask) -> None:
    """Check before a design begins that the stated factor of a coarse level can be used.

    Args:
        task: The stated task.

    Raises:
        ExperimentError: The factor divides neither the engine steps of a sample nor the samples.
    """
    descent, samples = task.experiment.descent, task.samples
    substeps = task.system.grid.substeps
    factor = descent.coarse
    if factor == "auto" or descent.method != "lbfgs" or samples % factor == 0:
        return

    if substeps % factor:
        valid = [k for k in range(1, 17) if samples % k == 0 or substeps % k == 0]
        raise ExperimentError(
            f"{task.experiment.source}: descent.coarse: {factor} divides neither the {substeps} "
            f"engine steps of a sample nor the {samples} samples; valid for example: "
            f"{', '.join(map(str, valid))}"
        )


def easier_level(fine: DescentLevel, evaluated: DesignPoint | None) -> DescentLevel | None:
    """Make a coarser or smoother level on which a descent begins.

    Args:
        fine: The stated level; under hard limits, on the plant without clamps.
        evaluated: The initial control on the unmodified plant; None where it is not known.

    Returns:
        A level with a longer timestep or longer samples, and with smoothed friction where the model
        has dry friction; one with smoothed friction alone; None where neither is useful.
    """
    has_dry_friction = bool(fine.task.system.variant.smoothing_speeds)
    smooth = replace(fine, task=fine.task.smoothed()) if has_dry_friction else fine

    first = first_point(smooth, evaluated)
    if first is None:
        return None

    # Take the longest timestep with which the initial control costs nearly as much.
    for factor in _coarse_factors(smooth.task):
        coarse = _coarser(smooth, first, factor)
        if coarse is not None:
            return coarse

    return smooth if has_dry_friction else None


def _coarse_factors(task: DesignTask) -> tuple[int, ...]:
    """Possible factors of a coarse level, the largest first."""
    stated = task.experiment.descent.coarse
    substeps = task.system.grid.substeps

    if stated == "auto":
        dividing = tuple(factor for factor in TIMESTEP_FACTORS if substeps % factor == 0)
        return dividing or SAMPLE_FACTORS

    return () if stated == 1 else (stated,)


def _coarser(level: DescentLevel, first: DesignPoint, factor: int) -> DescentLevel | None:
    """Make a level that is coarser by a factor, where the model allows it.

    Args:
        level: The finer level.
        first: Its initial control, evaluated.
        factor: Factor of the timestep where it divides the engine steps of a sample, else of the
            sample period.

    Returns:
        The coarse level; None where samples cannot be divided, or where the initial cost differs
        too much.
    """
    task = level.task
    longer_timestep = task.system.grid.substeps % factor == 0

    if not (longer_timestep or _divides_samples(task, factor)):
        return None

    coarser = task.stretched if longer_timestep else task.coarser
    return similar_level(level, first, lambda: coarser(factor))


def first_point(level: DescentLevel, evaluated: DesignPoint | None = None) -> DesignPoint | None:
    """The initial control on a level; None where the simulation diverges.

    Args:
        level: The level.
        evaluated: The initial control on another plant, with the same criterion. It counts where
            both plants move in the same way. None where it is not known.
    """
    reference = level.task.reference
    if evaluated is not None and reference is not None:
        known = moved_alike(evaluated, reference)
        if known is not None:
            return known
    try:
        return level.problem.point(level.task.initial)
    except SimulationDivergedError:
        return None


def moved_alike(evaluated: DesignPoint, trajectory: Trajectory) -> DesignPoint | None:
    """A point of another plant with the same criterion, where both plants move in the same way.

    Args:
        evaluated: The point.
        trajectory: The motion of this plant.

    Returns:
        The point; None where the motions differ, and for a robust design, in which the plants may
        move differently at the further samples.
    """
    curve = evaluated.trajectory
    is_known = not evaluated.others and curve is not None and curve.moves_as(trajectory)
    return evaluated if is_known else None


def similar_level(
    fine: DescentLevel, first: DesignPoint, make: Callable[[], DesignTask]
) -> DescentLevel | None:
    """Make a coarse level, where the initial control costs nearly as much.

    Args:
        fine: The finer level.
        first: Its initial control, evaluated.
        make: Makes the task of the coarse level; it may raise ExperimentError.

    Returns:
        The level; None where the model does not allow it, where a motion diverges, or where the
        initial cost differs from that of the finer level by more than `MAX_COARSE_CHANGE`.
    """
    try:
        coarse = DescentLevel(make(), fine.basis)
    except ExperimentError:
        return None

    point = first_point(coarse)
    if point is None or not np.isfinite(first.cost):
        return None
    change = abs(point.cost - first.cost) / fine.task.problem.size(first)
    return coarse if change <= MAX_COARSE_CHANGE else None


def coarser_levels(fine: DescentLevel, evaluated: DesignPoint | None) -> tuple[DescentLevel, ...]:
    """Make several coarser levels where each sample is one engine step.

    With more engine steps in a sample, one level with a longer timestep is enough (`easier_level`).

    Args:
        fine: The stated level, on the plant without clamps.
        evaluated: The initial control on the unmodified plant; None where it is not known.

    Returns:
        The levels on which the initial control costs nearly as much, the coarsest first; none with
        a stated `descent.coarse`.
    """
    task = fine.task
    if task.experiment.descent.coarse != "auto" or task.system.grid.substeps > 1:
        return ()

    first = first_point(fine, evaluated)
    if first is None:
        return ()

    # Dry friction is smooth in the motion as well.
    stated = task.system.variant
    smooth = replace(stated, smoothed=bool(stated.smoothing_speeds))
    factors = [k for k in SAMPLE_FACTORS if _divides_samples(task, k)]
    variants = [replace(smooth, sample_factor=factor) for factor in factors]
    levels = [similar_level(fine, first, partial(task.with_variant, each)) for each in variants]
    return tuple(level for level in levels if level is not None)


def _divides_samples(task: DesignTask, factor: int) -> bool:
    """Whether a factor divides the horizon, and each part of it that is optimised alone."""
    parts = [task.samples // count for count in (1, *task.experiment.descent.repeats)]
    enough = task.samples >= MIN_COARSE_SAMPLES * factor
    return enough and all(samples % factor == 0 for samples in parts)


def regulator_for(task: DesignTask) -> Regulator:
    """Make the regulator of the projection operator.

    Args:
        task: The task.

    Returns:
        A regulator with unit weights on state and control in units of their sizes, and without
        feedback where deviations grow less than `FEEDBACK_THRESHOLD`.
    """
    nx = task.space.nx
    state_sizes, control_sizes = task.sizes[:nx], task.sizes[nx:]

    # The sum over samples is a mean over time, so that the weight of the last state has no unit.
    share = 1.0 / task.samples
    last = np.diag(state_sizes**-2.0)
    return Regulator(
        Q=last * share,
        R=np.diag(control_sizes**-2.0) * share,
        terminal=last,
        feedback_threshold=FEEDBACK_THRESHOLD,
        state_sizes=state_sizes,
    )

"""The set of inequality constraints of an experiment on its plant."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, replace
from functools import partial
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.excitation.limits.constraint_kinds import (
    ClearanceConstraint,
    Constraint,
    ConstraintValues,
    ControlConstraint,
    ControlRateConstraint,
    EndStateConstraint,
    ExpansionSums,
    SubstepConstraint,
)
from mjfim.excitation.limits.limits import (
    Limit,
    derivative_substeps_of,
    has_constant_forces,
    limit_title,
)
from mjfim.excitation.task import DesignTask
from mjfim.model.clearance import GeomDistances, find_geom_pairs
from mjfim.model.elements import is_rk4, model_length
from mjfim.model.limited_elements import (
    actuators_of_tendons,
    quaternion_address,
    quaternion_joints,
    tilt_weights,
    turn_weights,
)
from mjfim.optimize.cost_models import (
    BarrierExpansion,
    Bounds,
    curvature_factors,
)
from mjfim.optimize.lq import TangentCurve, Weights
from mjfim.plant.batch import SubstepObservations
from mjfim.plant.plant import Plant
from mjfim.records.trajectory import Trajectory

# Share of the distance of the initial and the final state from a limit that a reserve may take.
END_SHARE = 0.5

# Attribute of `SubstepObservations` to which each kind of limit belongs, in the order of the
# observed numbers. Angles of ball and free joints are turns as well.
SOURCES = {
    "position": "positions",
    "velocity": "velocities",
    "angular_velocity": "velocities",
    "acceleration": "accelerations",
    "tilt": "turns",
    "force": "actuator_forces",
    "joint_force": "joint_forces",
    "tendon_force": "tendon_forces",
    "tendon_length": "tendon_lengths",
}


def observed_numbers(
    model: Any, limits: tuple[Limit, ...]
) -> tuple[SubstepObservations, tuple[tuple[int, ...], ...]]:
    """Choose the numbers that have to be observed for some limits.

    Args:
        model: MjModel.
        limits: n limits on quantities within samples.

    Returns:
        The observations of a single engine step without further rows, and for each of the n limits
        the places of its numbers among them.
    """
    chosen: dict[str, list[Limit]] = {source: [] for source in SOURCES.values()}
    for limit in limits:
        chosen["turns" if limit.is_angle else SOURCES[limit.kind]].append(limit)
    places: dict[tuple[str, str], tuple[int, ...]] = {}
    begin = 0
    for limit in itertools.chain.from_iterable(chosen.values()):
        places[limit.kind, limit.name] = tuple(range(begin, begin + limit.count))
        begin += limit.count

    turns = [np.arange(x.index, x.index + 4) for x in chosen["turns"] for _ in range(x.count)]
    joints = {quaternion_address(model, joint): joint for joint in quaternion_joints(model)}
    pulling = actuators_of_tendons(model)
    weights = [
        (tilt_weights if limit.kind == "tilt" else turn_weights)(model, joints[limit.index])
        for limit in chosen["turns"]
    ]
    observations = SubstepObservations(
        positions=_addresses(chosen["positions"]),
        velocities=_addresses(chosen["velocities"]),
        accelerations=_addresses(chosen["accelerations"]),
        actuator_forces=_addresses(chosen["actuator_forces"]),
        joint_forces=_addresses(chosen["joint_forces"]),
        turns=np.array(turns, dtype=np.intp).reshape(-1, 4),
        turn_weights=np.concatenate([np.zeros((0, 4)), *weights]),
        tendon_forces=tuple(pulling[x.index] for x in chosen["tendon_forces"]),
        tendon_lengths=_addresses(chosen["tendon_lengths"]),
        derivative_substeps=(1,),
        timestep=float(model.opt.timestep),
    )
    return observations, tuple(places[limit.kind, limit.name] for limit in limits)


def _addresses(limits: Iterable[Limit]) -> np.ndarray:
    """Addresses of all numbers of some limits."""
    each = [limit.index + i for limit in limits for i in range(limit.count)]
    return np.array(each, dtype=np.intp)


# Distance beyond the stated clearance up to which distances are measured, relative to the length of
# the model; it is at least the clearance itself.
CLEARANCE_REACH = 0.1

# Kinds of limits on quantities within samples, in the order of the quantities.
SUBSTEP_KINDS = (
    "position",
    "tilt",
    "velocity",
    "angular_velocity",
    "acceleration",
    "force",
    "joint_force",
    "tendon_force",
    "tendon_length",
)

# Limits of forces that are computed at the beginning of an engine step and at its end.
FORCE_KINDS = ("force", "joint_force", "tendon_force")


@dataclass(frozen=True, kw_only=True, eq=False)
class ConstraintSet:
    """The inequality constraints of an experiment.

    Attributes:
        substeps: Ranges of quantities at the engine steps within samples.
        control: Ranges of the controls, infinite where nothing bounds them.
        rate: Ranges of the rates of the controls, or None.
        end: Tolerances of the final state, or None where it is free.
        clearance: Least distances between geoms, or None.
    """

    substeps: SubstepConstraint
    control: ControlConstraint
    rate: ControlRateConstraint | None = None
    end: EndStateConstraint | None = None
    clearance: ClearanceConstraint | None = None

    @property
    def observations(self) -> SubstepObservations:
        """The quantities that a simulation has to observe at its engine steps."""
        return self.substeps.observations

    @property
    def members(self) -> tuple[Constraint, ...]:
        """The kinds of constraints that the experiment has."""
        every = (
            self.substeps,
            self.control,
            self.rate,
            self.end,
            self.clearance,
        )
        return tuple(member for member in every if member is not None)

    def tightened(
        self, fractions: Mapping[str, float], room: Array | float = np.inf
    ) -> ConstraintSet:
        """Move the bounds inwards.

        Args:
            fractions: Distance by which bounds move, by kind, relative to half of each range; for
                the clearance, relative to the least distance.
            room: (n,) largest such distance of each quantity within samples.

        Returns:
            The tighter set; kinds that are not named keep their bounds.
        """
        return ConstraintSet(
            substeps=self.substeps.tightened(fractions, room),
            control=self.control.tightened(fractions),
            rate=None if self.rate is None else self.rate.tightened(fractions),
            end=None if self.end is None else self.end.tightened(fractions),
            clearance=None if self.clearance is None else self.clearance.tightened(fractions),
        )

    def along(self, plant: Plant, theta: Array, ctrl: Array) -> ConstraintValues | None:
        """The constrained quantities along a control, (N, nu); None where the motion diverges."""
        observed = plant.observe(theta, ctrl, self.observations)
        return None if observed is None else self.evaluate(*observed, slopes=False)

    def evaluate(self, trajectory: Trajectory, observed: Array, slopes: bool) -> ConstraintValues:
        """Collect the constrained quantities along a trajectory.

        Args:
            trajectory: The trajectory.
            observed: (N, rows, w) observations at every engine step, and further rows of forces.
            slopes: Compute the derivatives of distances as well.

        Returns:
            The quantities.
        """
        distances, by_state = None, None
        if self.clearance is not None:
            distances, by_state = self.clearance.distances(trajectory.qpos[1:], slopes)
        return ConstraintValues(
            trajectory=trajectory,
            observed=observed,
            distances=distances,
            distance_slopes=by_state,
        )

    def is_feasible(self, values: ConstraintValues, *, strictly: bool = False) -> bool:
        """Check whether all constraints hold.

        Args:
            values: The constrained quantities along a trajectory.
            strictly: A margin of zero counts as a violation.
        """
        margins = self.margins(values).values()
        return all(margin > 0.0 if strictly else margin >= 0.0 for margin in margins)

    def margins(self, values: ConstraintValues) -> dict[str, float]:
        """Smallest margin of each kind, negative outside [unit of the quantity]."""
        return self._smallest_margins(values, relative=False)

    def relative_margins(self, values: ConstraintValues) -> dict[str, float]:
        """Smallest margin of each kind, relative to half of the range or to the clearance."""
        return self._smallest_margins(values, relative=True)

    def _smallest_margins(self, values: ConstraintValues, *, relative: bool) -> dict[str, float]:
        """Smallest margin of each kind; kinds without any bound are left out."""
        smallest: dict[str, float] = {}
        for member in self.members:
            for kind, margins, scale in member.margins(values):
                each = margins / scale if relative else margins
                margin = float(each.min(initial=np.inf))
                if np.isfinite(margin):
                    smallest[kind] = min(margin, smallest.get(kind, margin))
        return smallest

    def value(self, values: ConstraintValues, delta: float) -> float:
        """Value of the barrier of all constraints.

        Args:
            values: The constrained quantities along a trajectory.
            delta: Relaxation of the barrier, a relative margin.
        """
        return float(sum(member.barrier(values, delta)[0] for member in self.members))

    def narrowing(
        self, values: ConstraintValues, delta: float, controls: Sequence[str]
    ) -> dict[str, float]:
        """Derivative of the barrier by the share of half of its range by which each limit narrows.

        Args:
            values: The constrained quantities along a trajectory.
            delta: Relaxation of the barrier, a relative margin.
            controls: Names of the nu controls.

        Returns:
            Derivatives by the `title` of each limit; tolerances of the end and clearances, which
            are no ranges of one quantity, are left out.
        """
        within = map(limit_title, self.substeps.kinds, self.substeps.names)
        found = dict(zip(within, self.substeps.narrowing(values, delta).tolist(), strict=True))
        for member in (self.control, self.rate):
            if member is not None:
                titles = [limit_title(member.kind, name) for name in controls]
                found |= zip(titles, member.narrowing(values, delta).tolist(), strict=True)
        return found

    def expand(
        self, values: ConstraintValues, observation_jacobian: Array, delta: float
    ) -> BarrierExpansion:
        """Gradient and Gauss-Newton Hessian of the barrier about a trajectory.

        Args:
            values: The constrained quantities, with the derivatives of distances.
            observation_jacobian: (N, S, w, nx+nu) derivatives of the w observations at S engine
                steps of every sample.
            delta: Relaxation of the barrier, a relative margin.

        Returns:
            The expansion.
        """
        values = replace(values, observation_jacobian=observation_jacobian)
        a, b, weights = self._sums(values, delta)

        step_scale = np.full(b.shape[1], np.inf)
        if self.rate is not None:
            step_scale = self.rate.bounds.scale * self.rate.dt

        return BarrierExpansion(
            a=a,
            b=b,
            weights=weights,
            observations=observation_jacobian / self.substeps.column_scale[:, None],
            control_scale=self.control.bounds.scale,
            control_step_scale=step_scale,
            curvature=partial(self._curvature_along, values, delta),
        )

    def _curvature_along(
        self,
        values: ConstraintValues,
        delta: float,
        step: TangentCurve,
        factors: Sequence[Array] | None,
    ) -> tuple[Weights, tuple[Array, ...], float]:
        """See `StepCurvature`."""
        found = []
        growth = 1.0
        for i, member in enumerate(self.members):
            slacks = member.slacks(values)
            old = np.ones(slacks.shape) if factors is None else factors[i]
            new = curvature_factors(slacks, member.slack_changes(values, step), old, delta)
            growth = max(growth, float((new / old).max(initial=1.0)))
            found.append(new)

        _, _, weights = self._sums(values, delta, found)
        return weights, tuple(found), growth

    def _sums(
        self, values: ConstraintValues, delta: float, factors: Sequence[Array] | None = None
    ) -> ExpansionSums:
        """Gradient and Gauss-Newton Hessian of the barrier.

        Args:
            values: The quantities along the trajectory, with their derivatives.
            delta: Relaxation of the barrier, a relative margin.
            factors: Factors of the curvature, by kind; default: 1.
        """
        N, nu = values.trajectory.ctrl.shape
        nx = values.jacobian.shape[-1] - nu
        weights = Weights(
            Q=np.zeros((N + 1, nx, nx)),
            S=np.zeros((N, nu, nx)),
            R=np.zeros((N, nu, nu)),
            W=np.zeros((N + 1, nu)),
        )
        sums = np.zeros((N + 1, nx)), np.zeros((N, nu)), weights
        for i, member in enumerate(self.members):
            each = None if factors is None else factors[i]
            member.add_expansion(values, delta, sums, each)
        return sums


def constraint_set_of(task: DesignTask, every: bool = False) -> ConstraintSet:
    """Resolve the limits and the boundary of a task, narrowed by the reserve of a design.

    Args:
        task: The task.
        every: Include limits that are checked but not enforced, and leave out the reserve.
            Otherwise only the boundary constrains a design where `limits.enforce` is false.

    Returns:
        The constraint set.

    Raises:
        ExperimentError: A state cannot be held, or no pair of geoms can be kept clear.
    """
    boundary, stated = task.experiment.boundary, task.experiment.limits
    includes_limits = every or stated.enforce
    limits = task.limits if includes_limits else ()

    nu = len(task.controls)
    control = _bounds_of_controls(limits, "control", nu)
    if control is None:
        free = np.full(nu, np.inf)
        control = Bounds.from_range(-free, free)

    # The scale of a control without a range is its largest initial deviation from rest, or its
    # natural size where the initial control rests.
    is_free = ~np.isfinite(control.lower) & ~np.isfinite(control.upper)
    sizes = np.abs(task.control - task.system.rest).max(axis=0)
    sizes = np.where(sizes > 0.0, sizes, task.plant.sizes.control)
    control = replace(control, scale=np.where(is_free, sizes, control.scale))

    # The holding controls are computed even without limits on rates, because a boundary that cannot
    # be kept is an error.
    before = task.initial_hold if boundary.start == "rest" else None
    after = task.final_hold if boundary.end == "rest" else None
    rate_bounds = _bounds_of_controls(limits, "control_rate", nu)
    rate = None
    if rate_bounds is not None:
        rate = ControlRateConstraint(
            bounds=rate_bounds,
            dt=task.dt / task.system.stated_grid.rows_per_sample,
            control_before=before,
            control_after=after,
            periodic=boundary.end == "periodic",
        )

    substeps = _substep_constraint(task, limits)
    end = None
    if boundary.end != "free":
        # Activations are free.
        nv, na = task.space.nv, task.space.na
        width = np.repeat([boundary.position, boundary.velocity, np.inf], (nv, nv, na))
        bounds = Bounds.from_range(-width, width)
        end = EndStateConstraint(space=task.space, bounds=bounds, target=task.target)

    clearance = None
    if stated.clearance is not None and includes_limits:
        length = model_length(task.system.model)
        reach = stated.clearance + max(CLEARANCE_REACH * length, stated.clearance)
        ignored = [frozenset(pair) for pair in stated.ignored]
        try:
            pairs = find_geom_pairs(task.system.model, ignored)
            distances = GeomDistances(task.system.model_at(task.theta), pairs, reach)
        except ExperimentError as error:
            raise ExperimentError(f"limits.{error}") from None
        clearance = ClearanceConstraint.of(distances, stated.clearance)

    found = ConstraintSet(
        substeps=substeps,
        control=ControlConstraint(bounds=control),
        rate=rate,
        end=end,
        clearance=clearance,
    )
    # What is checked are the limits themselves.
    if every or not stated.reserve or stated.reserve == "auto":
        return found
    ends = [task.plant.initial_state(task.theta)]
    if boundary.end == "rest":
        ends.append(task.target)
    held = np.array([quantities_at(task, substeps, state, task.system.rest) for state in ends])
    room = substeps.bounds.margin(held).min(axis=0) / substeps.bounds.scale
    return found.tightened(dict[str, float](stated.reserve.items()), END_SHARE * room)


def quantities_at(
    task: DesignTask, substeps: SubstepConstraint, state: Array, ctrl: Array
) -> Array:
    """The quantities that are limited within samples, at a state under a control.

    Args:
        task: The task.
        substeps: Its constraint within samples.
        state: (ns,) state.
        ctrl: (nu,) control [u-unit].

    Returns:
        (n,) quantities [unit of each kind]; accelerations are zero.
    """
    model = task.plant.model(task.theta)
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = task.space.split(state)
    data.ctrl[:] = ctrl
    mujoco.mj_forward(model, data)
    observed = substeps.observations.values(
        data.qpos, data.qvel, data.qvel, lambda name: np.asarray(getattr(data, name))
    )
    return substeps.quantities(observed)


def _substep_constraint(task: DesignTask, limits: tuple[Limit, ...]) -> SubstepConstraint:
    """Ranges of the quantities within samples, ordered by kind."""
    ordered = tuple(limit for kind in SUBSTEP_KINDS for limit in limits if limit.kind == kind)
    observed, columns = observed_numbers(task.system.model, ordered)

    # MuJoCo keeps the forces at the beginning of each engine step, and with RK4 those of its last
    # stage. The forces at the end of a sample under its control are those that the next sample
    # begins with where the control does not change. Lengths of tendons are like forces that change.
    kinds, substeps = {limit.kind for limit in ordered}, task.system.grid.substeps
    has_forces = not kinds.isdisjoint(FORCE_KINDS)
    force_rows = ()
    if "tendon_length" in kinds or (has_forces and not has_constant_forces(task.system.model)):
        begun = range(substeps) if is_rk4(task.system.model) else ()
        force_rows = (*begun, substeps - 1)
    observations = replace(
        observed,
        derivative_substeps=derivative_substeps_of(substeps),
        force_rows=force_rows,
        timestep=float(task.plant.simulator.model.opt.timestep),
    )

    # The norm of a magnitude is between minus its bound and its bound.
    upper = np.array([limit.upper for limit in ordered])
    lower = np.array([-each.upper if each.is_magnitude else each.lower for each in ordered])
    sizes = np.array([limit.size for limit in ordered])
    return SubstepConstraint(
        observations=observations,
        bounds=Bounds.from_range(lower, upper, sizes),
        kinds=tuple(limit.kind for limit in ordered),
        names=tuple(limit.name for limit in ordered),
        columns=columns,
        angles=tuple(limit.is_angle for limit in ordered),
    )


def _bounds_of_controls(limits: tuple[Limit, ...], kind: str, nu: int) -> Bounds | None:
    """Ranges of all nu controls for one kind of limit; None where no control has such a limit.

    The range of a control without such a limit is infinite.
    """
    rows = [limit for limit in limits if limit.kind == kind]
    if not rows:
        return None
    lower, upper, sizes = np.repeat([[-np.inf], [np.inf], [1.0]], nu, axis=1)
    for limit in rows:
        i = limit.index
        lower[i], upper[i], sizes[i] = limit.lower, limit.upper, limit.size
    return Bounds.from_range(lower, upper, sizes)

"""Rehearsal of a design: what its control does to the model and to robots that differ from it.

Each robot plays the exported control in plain MuJoCo. It stands at its own equilibrium before it
begins. Limits are checked at every engine step, and what nothing limits is measured.
"""

from __future__ import annotations

from collections import Counter
from collections.abc import Iterator, Sequence
from contextlib import suppress
from dataclasses import fields, replace
from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array, evenly_spread_indices, record, scaled_to_unit_diagonal
from mjfim.errors import ExperimentError
from mjfim.excitation.limits.constraints import SUBSTEP_KINDS, constraint_set_of
from mjfim.excitation.limits.limits import Limit
from mjfim.excitation.task import DesignTask
from mjfim.experiment.arguments import checked
from mjfim.experiment.given import check_fits
from mjfim.experiment.schema import ExperimentLike, experiment_of
from mjfim.experiment.system import labels_of_model
from mjfim.information.finite_steps import finite_steps
from mjfim.model.clearance import GeomDistances, find_geom_pairs
from mjfim.model.coordinates import TRANSLATION, joint_dofs, joint_names, split_unit
from mjfim.model.elements import model_length
from mjfim.model.floor import find_floor, moving_heights, pose_of
from mjfim.model.parameter_writer import ParameterWriter
from mjfim.model.units import ANGLE, LENGTH, joint_unit, per_second
from mjfim.parallel import one_blas_thread
from mjfim.plant.batch import BatchSimulator
from mjfim.plant.outputs import outputs_by_state
from mjfim.records.design import Design, Evaluation
from mjfim.records.rehearsal import (
    CLAMPED_KINDS,
    MAX_PATHS,
    REST_SHARE,
    Fan,
    FiniteSteps,
    LimitRange,
    Rehearsal,
)
from mjfim.records.trajectory import Trajectory

# Largest number of attempts to draw a robot whose bodies are physical.
MAX_DRAWS = 500

# Factor by which the errors of the parameters are reduced after as many unphysical draws as there
# are parameters.
DRAW_SHRINKAGE = 0.9

# Largest acceleration of a robot that counts as standing still, relative to the size of each
# coordinate over the square of the horizon.
MAX_REST_MOVE = 1e-4

# Largest number of steps of the search for an equilibrium.
MAX_REST_STEPS = 15

# Delay of the control under feedback where none is stated [s]; it is rounded up to timesteps.
LATENCY = 5e-3

# Number of instants of each robot at which heights, distances and contacts are measured, and at
# which its paths are kept.
INSTANTS, PATH_INSTANTS = 64, 400

# Quantiles of the robots between which a fan is drawn, largest number of fans, and margin over half
# of the range below which robots are close to a limit.
BAND, MAX_FANS, CLOSE = (0.05, 0.95), 6, 0.5

# Largest number of robots after the experiment, and of robots whose motions are kept; step between
# the instants of these motions.
MAX_AFTER, MAX_MOTIONS, MOTION_STEP = 30, 8, 2

# Largest number of values of the states that are simulated at once.
MAX_VALUES = 1 << 22

# Type of the constraints of joints at the ends of their ranges.
JOINT_AT_STOP = int(mujoco.mjtConstraint.mjCNSTR_LIMIT_JOINT)


@checked
def rehearse(
    experiment: ExperimentLike, design: Design, *, threads: int | None = None
) -> Rehearsal:
    """Play a design on simulated robots, and check its standard deviations by finite steps.

    The table `[rehearsal]` states the robots. Their parameters are drawn from the priors. Those
    without a prior are drawn within the stated share of their size and their bounds.

    Args:
        experiment: The experiment of the design.
        design: The design.
        threads: Threads for simulations; default: one per core.

    Returns:
        Margins, speeds, heights and contacts of all robots, and the standard deviations.

    Raises:
        ExperimentError: The experiment is faulty, or no physical robot can be drawn.
        RecordingError: The design does not fit the experiment.
    """
    experiment = experiment_of(experiment)
    if experiment.limits.reserve == "auto" and design.rehearsal is not None:
        experiment = experiment.replace(limits={"reserve": design.reserve})
    task = DesignTask.resolve(experiment, threads=threads)
    planned = design.trajectory
    check_fits("the design", planned, task.system)
    task = task.released_as(planned.state[0])
    return with_cures_tried(task, design.final, rehearse_task(task, design.final))


def rehearse_task(task: DesignTask, final: Evaluation) -> Rehearsal:
    """Rehearse the trajectory of an evaluation in a resolved task. See `rehearse`."""
    steps = steps_along(task, final.trajectory, final.information, final.std)
    return rehearsed(task, final.trajectory, final.gain, final.information, steps, final.growth)


def with_cures_tried(task: DesignTask, final: Evaluation, found: Rehearsal) -> Rehearsal:
    """A rehearsal with what makes a motion safe as it is: smaller errors, and feedback.

    Args:
        task: The task, released as the trajectory is.
        final: The evaluation of the trajectory.
        found: Its rehearsal.
    """
    # Where the model itself fails, another motion has to be designed.
    if found.is_safe or not found.robots or not found.inside[0] or found.passes_floor[0]:
        return found

    def is_safe_with(**changes: Any) -> bool:
        """Check whether robots are safe with other keys of `[rehearsal]`."""
        experiment = task.experiment.replace(rehearsal=changes)
        changed = replace(task, system=replace(task.system, experiment=experiment))
        return rehearsed(
            changed, final.trajectory, final.gain, None, found.steps, found.growth
        ).is_safe

    half, quarter, eighth = (found.wrong / 2**k for k in (1, 2, 3))
    safe_wrong = quarter if is_safe_with(wrong=quarter) else np.nan
    tried = half if np.isfinite(safe_wrong) else eighth
    safe_wrong = tried if is_safe_with(wrong=tried) else safe_wrong
    is_fed_back = False
    if task.controls and not found.feedback:
        # The gains may need what is not measured.
        with suppress(ExperimentError):
            is_fed_back = is_safe_with(feedback=True)
    return replace(found, safe_wrong=safe_wrong, safe_with_feedback=is_fed_back)


def steps_along(
    task: DesignTask, trajectory: Trajectory, information: Array, predicted: Array
) -> FiniteSteps:
    """Standard deviations along a trajectory of a task by finite steps. See `finite_steps`."""
    known = task.information
    found = finite_steps(
        task.plant,
        task.system.noise,
        task.theta,
        trajectory,
        information=known.under_white_noise(information),
        prior=known.under_white_noise(known.prior),
        predicted=predicted,
    )
    # Finite steps show what white noise would leave.
    return replace(found, std=found.std * known.inflation)


@one_blas_thread()
def rehearsed(
    task: DesignTask,
    trajectory: Trajectory,
    gain: Array,
    information: Array | None,
    steps: FiniteSteps,
    growth: float,
) -> Rehearsal:
    """Play a trajectory on robots.

    Args:
        task: The task, released as the trajectory is.
        trajectory: The trajectory, an open-loop simulation of the model.
        gain: (N, nu, nx) gains, which matter under feedback only.
        information: (p, p) Fisher information along it, with the prior; None without robots after
            the experiment.
        steps: Its standard deviations by finite steps.
        growth: Largest growth of a small deviation along it.
    """
    spec, player = task.experiment.rehearsal, _RobotPlayer(task, trajectory, gain)
    rng = np.random.default_rng(spec.seed)
    theta = np.array([task.theta, *(draw_robot(task, rng) for _ in range(spec.robots))])

    # The model comes first, because its motion is the plan of the feedback.
    steps_of_one = len(player.ctrl) * player.steps_per_row + player.late_steps
    values = task.space.nq + task.space.nv + 2 * len(player.limits) + 1
    most = max(MAX_VALUES // (steps_of_one * values), 1)
    blocks = [theta[:1], *(theta[i : i + most] for i in range(1, len(theta), most))]
    parts: list[_Played] = []
    for part in (part for block in blocks for part in player.play(block, rng)):
        has_paths = len(parts) <= MAX_PATHS
        parts.append(part if has_paths else replace(part, paths=None, qpos=None))
    measured: dict[str, Any] = {
        each.name: np.array([getattr(part, each.name) for part in parts])
        for each in fields(_Played)
        if each.name not in ("unbraked", "paths", "qpos")
    }
    # Robots that are plausible after the experiment.
    number = 0 if information is None else min(spec.robots, MAX_AFTER)
    later = np.array([draw_robot(task, rng, information) for _ in range(number)])
    after = [
        player.paths(motion)
        for i in range(0, number, most)
        for motion in player.motions(later[i : i + most], rng)
        if motion is not None
    ]
    reserve = task.experiment.limits.reserve
    return Rehearsal(
        parameters=task.parameters.names,
        wrong=spec.wrong,
        feedback=spec.feedback,
        latency=player.late_steps * player.timestep,
        theta=theta,
        limits=player.rehearsed_limits(),
        joints=tuple(group.name for group in player.groups),
        units=tuple(group.unit for group in player.groups),
        unlimited=tuple(group.name for group in player.groups if not group.is_limited),
        unplaced=tuple(group.name for group in player.groups if not group.is_placed),
        floor=player.floor,
        has_floor=player.has_floor,
        depth=player.depth,
        unbraked=dict(Counter(name for part in parts[1:] for name in part.unbraked)),
        steps=steps,
        growth=growth,
        kept_reserve=None if reserve == "auto" else dict[str, float](reserve.items()),
        end=task.experiment.boundary.end,
        fans=tuple(_fans(player, parts, after)),
        motion_times=player.t[::MOTION_STEP],
        motions=_motions_of(parts),
        **measured,
    )


def _fans(player: _RobotPlayer, parts: Sequence[_Played], after: Sequence[Array]) -> Iterator[Fan]:
    """Compare paths of the model and of robots: of each joint those closest to their limits.

    Args:
        player: The player.
        parts: The model and the robots, of which some have no paths.
        after: (q, n) paths of robots that are drawn after the experiment.
    """
    model, *robots = parts
    known = [each for each in robots if each.paths is not None] or [model]
    if model.paths is None:
        return
    paths = np.array([each.paths for each in known])
    margins = np.full(paths.shape[:2], np.inf)
    margins[:, : len(player.limited)] = [each.margins[player.limited] for each in known]

    # Far from all limits, the position of a joint says most. The first quantities of all joints
    # come before the second ones.
    least = margins.min(axis=0)
    is_other = [limit.kind != "position" for limit in player.shown]
    order = np.lexsort((least, (least >= CLOSE) * (1 + np.array(is_other)))).tolist()
    names = [player.shown[i].name for i in order]
    ranked = sorted(range(len(order)), key=lambda k: names[:k].count(names[k]))
    for i in (order[k] for k in ranked[:MAX_FANS]):
        worst = int(margins[:, i].argmin())
        yield Fan(
            limit=player.shown[i],
            t=player.t,
            model=model.paths[i],
            worst=np.where(np.isfinite(margins[worst, i]), paths[worst, i], np.nan),
            before=np.quantile(paths[:, i], BAND, axis=0),
            after=np.quantile([each[i] for each in after or [model.paths]], BAND, axis=0),
        )


def _motions_of(parts: Sequence[_Played]) -> dict[int, Array]:
    """Choose motions of robots to be drawn, from the one closest to its limits to the safest."""
    known = {i: each.qpos for i, each in enumerate(parts) if i and each.qpos is not None}
    order = sorted(known, key=lambda i: parts[i].margins.min(initial=np.inf))
    chosen = (order[k] for k in evenly_spread_indices(len(order), MAX_MOTIONS))
    return {i: known[i].astype(np.float64) for i in chosen}


def draw_robot(
    task: DesignTask, rng: np.random.Generator, information: Array | None = None
) -> Array:
    """Draw the (p,) parameters of a robot whose bodies are physical [theta-unit].

    Errors are reduced where the bodies would be unphysical.

    Args:
        task: The task.
        rng: The generator.
        information: (p, p) information of an experiment after which the robot is plausible, with
            the priors; None before any experiment.

    Raises:
        ExperimentError: No physical robot is found.
    """
    p, spec = task.parameters, task.experiment.rehearsal
    prior = np.array([q.prior or 0.0 for q in p.parameters])
    is_range = p.changes_model & (prior == 0.0)
    reach = np.where(is_range, spec.wrong * p.sizes(task.theta), 0.0)
    if information is not None:
        # The range counts as a prior with the variance of its uniform distribution.
        known = np.divide(3.0, reach**2, out=np.zeros(len(p)), where=reach > 0.0)
        scaled, scale = scaled_to_unit_diagonal(information + np.diag(known))
        values, vectors = np.linalg.eigh(scaled)
        root = vectors / np.sqrt(np.maximum(values, np.finfo(float).eps)) / scale[:, None]
        root[(prior == 0.0) & (reach == 0.0)] = 0.0
    for attempt in range(MAX_DRAWS):
        if information is None:
            by_prior = p.guess + prior * rng.standard_normal(len(p))
            within = task.theta + reach * rng.uniform(-1.0, 1.0, len(p))
            drawn = np.where(prior > 0.0, by_prior, within)
        else:
            drawn = task.theta + root @ rng.standard_normal(len(p))
        error = DRAW_SHRINKAGE ** (attempt // len(p)) * (drawn - task.theta)
        theta = np.clip(task.theta + error, p.lower, p.upper)
        if not ParameterWriter(p).unphysical_bodies(task.plant.source, theta):
            return np.asarray(theta)
    raise ExperimentError(
        f"{task.experiment.source}: rehearsal.wrong: errors of {spec.wrong:.0%} in the parameters "
        "lead to unphysical bodies; state a smaller error"
    )


@record
class _SpeedGroup:
    """A joint whose speed is measured: the norm of the velocities of some degrees of freedom."""

    name: str
    dofs: tuple[int, ...]
    unit: str
    is_limited: bool
    is_placed: bool


@record
class _Played:
    """Measurements of one robot; see `Rehearsal`.

    Attributes:
        paths: (q, n) quantities of the fans at n instants; None where the simulation diverges.
        qpos: (n, nq) positions at every `MOTION_STEP`-th of these instants, likewise.
    """

    margins: Array
    speed: Array
    acceleration: Array
    end_speed: Array
    travel: Array
    lowest: float = np.nan
    end_height: float = np.nan
    nearest: float = np.nan
    in_contact: float = np.nan
    at_stop: float = np.nan
    unbraked: tuple[str, ...] = ()
    paths: Array | None = None
    qpos: Array | None = None


@record
class _Motion:
    """A simulated robot.

    Attributes:
        model: Its model.
        states: (n+1, ns) states at every engine step.
        observed: (n, rows, w) observations at every engine step, with further rows of forces.
        applied: (n, nu) controls at every engine step [unit of the actuator].
        sent: (M, nu) controls that were sent [unit of the actuator].
        before: (nu,) control before the motion begins [unit of the actuator].
    """

    model: Any
    states: Array
    observed: Array | None
    applied: Array
    sent: Array
    before: Array


class _RobotPlayer:
    """A design, and what measures the robots that play it.

    Attributes:
        task: The task, released as the design is.
        ctrl: (M, nu) controls at the M rows of the controller [unit of the actuator].
        gain: (M, nu, nx) gains.
        steps_per_row: Number of engine steps per row.
        timestep: Timestep of the engine [s].
        late_steps: Number of engine steps by which the control is late; 0 without feedback, where
            a delay would only shift the motion.
        constraints: Constraints of the task.
        limits: The l limits that are checked.
        groups: Joints whose speeds are measured.
        floor, has_floor, depth: The floor; see `find_floor`.
        plan: (M+1, ns) states of the model at the rows; None before it was played.
        limited: Places of the limits that have paths; a force is clamped.
        shown: The q quantities that have paths: these limits, and positions without a limit.
        t: (n,) times of the paths [s].
    """

    def __init__(self, task: DesignTask, trajectory: Trajectory, gain: Array) -> None:
        self.task, spec = task, task.experiment.rehearsal
        self.timestep = float(task.system.model.opt.timestep)
        grid = task.system.stated_grid
        self.steps_per_row = grid.playback_steps
        rows = task.system.grid.substeps // self.steps_per_row
        self.ctrl = np.repeat(trajectory.ctrl, rows, axis=0)
        self.gain = np.repeat(gain, rows, axis=0)
        self.feedback = spec.feedback and bool(task.controls)
        stated = LATENCY if spec.latency is None else spec.latency
        self.late_steps = int(np.ceil(stated / self.timestep - 1e-6)) if self.feedback else 0
        self.plan: Array | None = None

        self.constraints = constraint_set_of(task, every=True)
        self.limits = (
            *(each for kind in SUBSTEP_KINDS for each in task.limits if each.kind == kind),
            *(each for each in task.limits if each.kind not in SUBSTEP_KINDS),
        )
        self._observations = self.constraints.observations.of_single_steps()
        model = task.system.model_at(task.theta)
        self.limited = [
            i
            for i, limit in enumerate(self.limits)
            if limit.kind in SUBSTEP_KINDS and limit.kind not in CLAMPED_KINDS
        ]
        placed = {limit.name for limit in self.limits if limit.kind == "position"}
        positions = [split_unit(label) for label in labels_of_model(model).positions]
        self._free = [dof for dof, (name, _) in enumerate(positions) if name not in placed]
        ranges = self.rehearsed_limits()
        free = LimitRange(kind="position", name="", lower=-np.inf, upper=np.inf)
        self.shown = [ranges[i] for i in self.limited]
        for name, unit in (positions[dof] for dof in self._free):
            self.shown.append(replace(free, name=name, unit=unit))
        # Turns of ball and free joints are counted from the start.
        self._origin = trajectory.state[0].copy()
        self._origin[task.space.scalar_q] = 0.0
        steps = len(self.ctrl) * self.steps_per_row
        self._rows = self.late_steps + evenly_spread_indices(steps, PATH_INSTANTS)
        self.t = trajectory.t[0] + (self._rows + 1 - self.late_steps) * self.timestep
        self._simulator = BatchSimulator(model, threads=task.plant.simulator.threads)
        # (nu,) control that holds the start; None where the motion begins without a rest.
        self.rest: Array | None = None
        if task.controls:
            with suppress(ExperimentError):
                self.rest = task.initial_hold
        space = task.space
        self.sensed = np.full(space.nq + space.nv + space.na, -1)
        for entry, output in outputs_by_state(task.system.model, task.system.outputs).items():
            self.sensed[entry] = output
        if self.feedback and (self.sensed < 0).all():
            raise ExperimentError(
                f"{task.experiment.source}: rehearsal.feedback: the gains need a measured position "
                "or velocity of a joint, and the experiment measures none"
            )

        self.groups = tuple(_speed_groups(task))
        stated_floor = -np.inf if spec.floor == "none" else spec.floor
        self.floor, self.has_floor, self.depth = find_floor(
            model, trajectory.state[0, : model.nq], stated_floor
        )
        ignored = [frozenset(pair) for pair in task.experiment.limits.ignored]
        self._distances: GeomDistances | None = None
        with suppress(ExperimentError):
            pairs = find_geom_pairs(model, ignored)
            self._distances = GeomDistances(model, pairs, float(model_length(model)))

    def rehearsed_limits(self) -> tuple[LimitRange, ...]:
        """The limits in the order of the margins."""
        found = [
            LimitRange(
                kind=limit.kind,
                name=limit.name,
                lower=limit.lower,
                upper=limit.upper,
                scale=limit.scale,
                unit=limit.unit,
            )
            for limit in self.limits
        ]
        nearest = self.constraints.clearance
        if nearest is not None:
            found.append(
                LimitRange(
                    kind="clearance",
                    name="nearest pair",
                    lower=nearest.least,
                    upper=np.inf,
                    scale=nearest.scale,
                    unit=LENGTH,
                )
            )
        return tuple(found)

    def play(self, theta: Array, rng: np.random.Generator) -> Iterator[_Played]:
        """Play the design on robots with the parameters (m, p), and measure each of them."""
        for motion in self.motions(theta, rng):
            if motion is None:
                unknown = np.full(len(self.groups), np.nan)
                yield _Played(
                    margins=np.full(len(self.rehearsed_limits()), -np.inf),
                    speed=unknown,
                    acceleration=unknown,
                    end_speed=unknown,
                    travel=unknown,
                )
            else:
                yield self._measured(motion)

    def motions(self, theta: Array, rng: np.random.Generator) -> Iterator[_Motion | None]:
        """Simulate robots with the parameters (m, p); None for a simulation that diverges."""
        task = self.task
        models = [task.system.model_at(row) for row in theta]
        starts = np.array([self._start(*each) for each in zip(models, theta, strict=True)])
        sent = np.broadcast_to(self._clipped(self.ctrl), (len(theta), *self.ctrl.shape))
        if self.feedback and self.plan is not None:
            noise = [task.system.noise.sample(len(self.ctrl) + 1, rng) for _ in models]
            sent = np.array(
                [self._fed_back(*each) for each in zip(models, starts, noise, strict=True)]
            )
        held = np.repeat(sent, self.steps_per_row, axis=1)
        before = np.array([self._before_start(start) for start in starts])
        late = np.repeat(before[:, None], self.late_steps, axis=1)
        applied = np.concatenate([late, held], axis=1)
        out = self._simulator.rollout(models, starts, applied, self._observations)
        if self.plan is None:
            self.plan = out.states[0, self.late_steps :: self.steps_per_row]

        for i, model in enumerate(models):
            if not out.finite[i]:
                yield None
                continue
            yield _Motion(
                model=model,
                states=out.states[i],
                observed=None if out.observed is None else out.observed[i],
                applied=applied[i],
                sent=sent[i],
                before=before[i],
            )

    def paths(self, motion: _Motion) -> Array:
        """(q, n) quantities that are shown of a motion, with the digits of a picture."""
        limited = np.zeros((len(self._rows), 0))
        if motion.observed is not None:
            found = self.constraints.substeps.quantities(motion.observed[self._rows, 0])
            limited = found[:, self.limited]
        moves = self.task.space.minus(motion.states[self._rows + 1], self._origin)
        return np.hstack([limited, moves[:, self._free]]).T.astype(np.float32)

    # ---- what is measured

    def _measured(self, motion: _Motion) -> _Played:
        """Measure the motion of one robot."""
        model, states, applied = motion.model, motion.states, motion.applied
        qpos, qvel, act = self.task.space.split(states)
        change = np.diff(qvel, axis=0) / self.timestep

        def largest(values: Array) -> Array:
            """(j,) largest norms of each group over the rows of (n, nv) values."""
            norms = [np.linalg.norm(values[:, group.dofs], axis=1) for group in self.groups]
            return np.array([norm.max(initial=0.0) for norm in norms])

        data = mujoco.MjData(model)
        rows = evenly_spread_indices(len(states), INSTANTS)
        poses, touches, stops = [], 0, 0
        for row in rows.tolist():
            data.qpos[:], data.qvel[:], data.act[:] = qpos[row], qvel[row], act[row]
            data.ctrl[:] = applied[min(row, len(applied) - 1)]
            mujoco.mj_forward(model, data)
            poses.append(pose_of(data))
            touches += bool(data.ncon and (data.contact.dist < 0.0).any())
            stops += bool(data.nefc and (data.efc_type == JOINT_AT_STOP).any())
        lowest = moving_heights(model, poses)
        # Above a floor that is assumed, the robot may come as low as it begins.
        floor = self.floor if self.has_floor else min(self.floor, float(lowest[0]))
        heights = lowest - (floor if np.isfinite(floor) else 0.0)
        nearest = np.nan
        if self._distances is not None:
            nearest = self._distances.nearest(qpos[rows])[0]
        return _Played(
            margins=self._margins(motion),
            speed=largest(qvel),
            acceleration=largest(change),
            end_speed=largest(qvel[-1:]),
            travel=largest(self.task.space.minus(states, states[0])),
            lowest=float(heights.min()),
            end_height=float(heights[-1]),
            nearest=nearest,
            in_contact=touches / len(rows),
            at_stop=stops / len(rows),
            unbraked=tuple(self._unbraked(model, data, qvel)),
            paths=self.paths(motion),
            qpos=qpos[self._rows[::MOTION_STEP] + 1].astype(np.float32),
        )

    def _unbraked(self, model: Any, data: Any, qvel: Array) -> Iterator[str]:
        """Joints that reach a limit after the end, however the controls brake them.

        Args:
            model: Model of the robot.
            data: Its MjData at the end.
            qvel: (n+1, nv) velocities at every engine step.
        """
        space, bounds = self.task.space, self.constraints.control.bounds
        dof_of = dict(zip(space.scalar_q.tolist(), space.scalar_v.tolist(), strict=True))
        is_bounded = np.isfinite(bounds.lower) & np.isfinite(bounds.upper)
        # Without a drive, and with one whose strength nothing states, there is no brake to try.
        if not len(is_bounded) or not is_bounded.all():
            return
        for limit in self.limits:
            if limit.kind != "position" or limit.count != 1 or limit.index not in dof_of:
                continue
            dof = dof_of[limit.index]
            is_slow = abs(qvel[-1, dof]) <= REST_SHARE * np.abs(qvel[:, dof]).max()
            is_inside = limit.lower <= data.qpos[limit.index] <= limit.upper
            if is_slow or not is_inside:
                continue
            if self._leaves(model, data, limit, dof):
                yield limit.name

    def _leaves(self, model: Any, end: Any, limit: Limit, dof: int) -> bool:
        """Whether a joint leaves its range after the end (MjData) before the controls stop it.

        The controls keep the values that brake it most at the end.
        """
        bounds = self.constraints.control.bounds
        direction = np.sign(end.qvel[dof])
        data = mujoco.MjData(model)

        def begin(ctrl: Array) -> float:
            """Play one step from the end of the motion; the speed that a control leaves."""
            mujoco.mj_copyData(data, model, end)
            data.ctrl[:] = ctrl
            # An acceleration may point the other way: strong damping acts within the step.
            mujoco.mj_step(model, data)
            return float(direction * data.qvel[dof])

        best = 0.5 * (bounds.lower + bounds.upper)
        for chosen in np.eye(len(best), dtype=bool):
            best = min(
                np.where(chosen, bounds.lower, best),
                np.where(chosen, bounds.upper, best),
                key=begin,
            )
        begin(best)
        for _ in range(len(self.ctrl) * self.steps_per_row):
            if not limit.lower <= data.qpos[limit.index] <= limit.upper:
                return True
            if data.qvel[dof] * direction <= 0.0:
                break
            mujoco.mj_step(model, data)
        return False

    def _margins(self, motion: _Motion) -> Array:
        """(l,) smallest margins of all limits over half of their ranges."""
        constraints, sent = self.constraints, motion.sent
        margins = []
        if motion.observed is not None:
            bounds = constraints.substeps.bounds
            quantities = constraints.substeps.quantities(motion.observed)
            inside = bounds.margin(quantities).min(axis=(0, 1), initial=np.inf) / bounds.scale
            margins = inside.tolist()

        # Rates from row to row, with the change from the control before the motion, and the change
        # to the control after its end.
        after = None if constraints.rate is None else constraints.rate.control_after
        after = sent[-1] if after is None or self.feedback else after
        changes = np.diff(sent, axis=0, prepend=motion.before[None], append=after[None])
        rates = changes / (self.steps_per_row * self.timestep)
        for limit in self.limits[len(margins) :]:
            values = (sent if limit.kind == "control" else rates)[:, limit.index]
            margin = np.minimum(values - limit.lower, limit.upper - values).min()
            margins.append(float(margin) / limit.scale)
        if constraints.clearance is not None:
            qpos = motion.states[:, : self.task.space.nq]
            nearest = constraints.clearance.distances.nearest(qpos)[0]
            margins.append((nearest - constraints.clearance.least) / constraints.clearance.scale)
        return np.array(margins)

    # ---- the start

    def _start(self, model: Any, theta: Array) -> Array:
        """(ns,) initial state of a robot: its equilibrium near the start, where it has one."""
        stated = self.task.plant.initial_state(theta)
        if self.rest is None:
            return stated
        space, sizes = self.task.space, self.task.plant.sizes
        data = mujoco.MjData(model)
        # Positions and activations may change by multiples of their sizes; velocities stay.
        directions = np.delete(np.diag(sizes.state), np.arange(space.nv, 2 * space.nv), axis=0)
        time = self.task.horizon
        rates = np.concatenate([sizes.position / time**2, sizes.activation / time])

        def relative_rates(move: Array) -> Array:
            """Accelerations and rates of the activations after a move, relative to their sizes."""
            state = space.plus(stated, move @ directions)
            data.qpos[:], data.qvel[:], data.act[:] = space.split(state)
            data.ctrl[:] = self._before_start(state)
            mujoco.mj_forward(model, data)
            return np.asarray(np.concatenate([data.qacc, data.act_dot]) / rates)

        still = np.zeros(len(directions))
        if np.abs(relative_rates(still)).max(initial=0.0) <= MAX_REST_MOVE:
            return stated
        # A robot on the ground rests at many places; the nearest one is meant.
        found = scipy.optimize.least_squares(
            lambda move: np.concatenate([relative_rates(move), MAX_REST_MOVE * move]),
            still,
            xtol=1e-12,
            ftol=1e-12,
            gtol=1e-12,
            max_nfev=MAX_REST_STEPS,
        )
        # Nobody balances a robot on an equilibrium that it leaves within the motion.
        growth = np.linalg.eigvals(found.jac[: space.nv, : space.nv]).real.max(initial=0.0)
        moves = np.abs(relative_rates(found.x)).max(initial=0.0)
        if growth < 1.0 and moves <= MAX_REST_MOVE:
            return space.plus(stated, found.x @ directions)
        return stated

    # ---- the controller, with or without feedback

    def _before_start(self, state: Array) -> Array:
        """(nu,) control before the motion in a state (ns,); with feedback the first gain acts."""
        if self.rest is None:
            return np.asarray(self.ctrl[0] if len(self.ctrl) else np.zeros(0))
        if not self.feedback or self.plan is None:
            return self.rest
        return np.asarray(self.rest + self.gain[0] @ self._deviation(state, 0))

    def _command(self, state: Array, row: int, noise: Array) -> Array:
        """(nu,) control that the controller sends at a row in a state: (ns,) [u-unit].

        It reads the measured entries with their noise: (ny,).
        """
        read = np.flatnonzero(self.sensed >= 0)
        measured = np.array(state)
        measured[read] += noise[self.sensed[read]]
        return self._clipped(self.ctrl[row] + self.gain[row] @ self._deviation(measured, row))

    def _fed_back(self, model: Any, start: Array, noise: Array) -> Array:
        """(M, nu) controls that the controller sends to a robot.

        Args:
            model: Model of the robot.
            start: (ns,) its initial state.
            noise: (M+1, ny) noise of the outputs that the controller reads [y-unit].
        """
        data = mujoco.MjData(model)
        data.qpos[:], data.qvel[:], data.act[:] = self.task.space.split(start)
        sent = np.zeros(self.ctrl.shape)
        before = self._before_start(start)
        for step in range(len(sent) * self.steps_per_row):
            row, phase = divmod(step, self.steps_per_row)
            if phase == 0:
                state = np.concatenate([data.qpos, data.qvel, data.act])
                sent[row] = self._command(state, row, noise[row])
            arrived = (step - self.late_steps) // self.steps_per_row
            data.ctrl[:] = before if arrived < 0 else sent[arrived]
            mujoco.mj_step(model, data)
        return sent

    def _clipped(self, control: Array) -> Array:
        """Controls in the ranges to which the controller clips [unit of the actuator]."""
        bounds = self.constraints.control.bounds
        return np.asarray(np.clip(control, bounds.lower, bounds.upper))

    def _deviation(self, state: Array, row: int) -> Array:
        """(nx,) planned minus measured state; zero for entries that are not measured."""
        assert self.plan is not None
        planned = self.plan[row]
        measured = np.where(self.sensed >= 0, state, planned)
        for q, _ in self.task.space.quaternions:
            measured[q : q + 4] /= np.linalg.norm(measured[q : q + 4])
        return self.task.space.minus(planned, measured)


def _speed_groups(task: DesignTask) -> Iterator[_SpeedGroup]:
    """The joints of a model but those of terms: a free joint has a speed and an angular speed."""
    model = task.system.model
    limited = {limit.kind: set[str]() for limit in task.limits}
    for limit in task.limits:
        # A limit may name a joint or one of its coordinates.
        limited[limit.kind] |= {limit.name, limit.name.rpartition(".")[0]}

    # Both sides of a position need a limit; an angle without a sign has one side.
    placed = {
        (limit.kind, limit.name)
        for limit in task.limits
        if np.isfinite(limit.upper) and (limit.is_magnitude or np.isfinite(limit.lower))
    }

    for joint, name in enumerate(joint_names(model)):
        if int(model.jnt_qposadr[joint]) in task.system.source.added:
            continue
        first, count = int(model.jnt_dofadr[joint]), joint_dofs(model, joint)
        kinds: tuple[str, ...] = ("velocity", "angular_velocity")
        is_placed = not placed.isdisjoint({("position", name), ("tilt", name)})
        groups = [(name, first, count, joint_unit(model, joint), kinds, is_placed)]
        if count == 6:
            is_boxed = placed.issuperset(("position", f"{name}.{part}") for part in TRANSLATION)
            groups = [
                (name, first, 3, LENGTH, kinds[:1], is_boxed),
                (f"{name} (rotation)", first + 3, 3, ANGLE, kinds[1:], is_placed),
            ]
        for title, begin, number, unit, own, is_own_placed in groups:
            yield _SpeedGroup(
                name=title,
                dofs=tuple(range(begin, begin + number)),
                unit=per_second(unit),
                is_limited=any(name in limited.get(kind, ()) for kind in own),
                is_placed=is_own_placed,
            )

"""Gross errors of a log, found by the equation of motion along the measured motion.

A control or a joint with another sign, unit or name and an encoder with another zero leave large
residuals of the equation of motion, at any parameters that the experiment allows. One such error
after the other is taken out of the log. It is named where the residuals become far smaller, and
small beside the forces. Friction and constant forces, which the model may lack, are free in every
fit, so that they are not taken for an error of the log. A delay is left to the tests after a fit,
which tell it from a lag of the actuators.
"""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace
from itertools import combinations
from typing import Any

import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import MjfimError, RecordingError, WrongLogError
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.inverse_dynamics.equations import MotionEquations
from mjfim.identification.inverse_dynamics.fit import try_fit_equations
from mjfim.identification.segments import measured_states
from mjfim.model.coordinates import ScalarJoint, actuator_names, scalar_joints
from mjfim.model.variants import RELAXED, Relaxation
from mjfim.optimize.condensed_least_squares import bounded_least_squares
from mjfim.recordings.section import ColumnSpec

# Number of the first rows whose motion is looked at.
MOST_ROWS = 4000

# A parameter without bounds lies within this factor of its guess, as the starts of a fit do, and
# within so many standard deviations of a prior.
UNSTATED_FACTOR = 10.0
PRIOR_SIGMAS = 3.0

# Residuals over forces above which an equation shows a gross error, and above which it may be an
# error of names or signs.
GROSS_SHARE = 0.07
SHARE_OF_NAMES = 0.2

# Share of the mean square of the residuals that is left without the error, at most: of one gross
# equation, of all with large residuals, and of others. Residuals of the first over forces, at most.
LEFT_SHARE = 0.1
LEFT_OF_LARGE = 0.25
MOST_RAISED = 1.5
EXPLAINED_SHARE = 0.4

# Smallest residuals over forces that count.
LEAST_SHARE = 1e-4

# Free forces of each joint, dry and viscous friction and a constant, and the number of rows for
# each unknown, at least.
FREE_FORCES = 3
ROWS_PER_UNKNOWN = 2.0

# Linearisations of a fit, steps of differences relative to sizes, and the largest distance of a
# number from where it begins, in its sizes.
LINEARISATIONS = 3
STEP = 1e-4
LARGEST_NUMBER = 10.0

# Number of errors that are fitted together with the parameters.
FITTED_ERRORS = 4

# Smallest deviation of a wrong factor of a control from 1, or of its size where the sign is wrong.
LEAST_FACTOR = 0.1

# Difference of mean logarithms of mean squares within which two errors explain a log equally well.
TIE = 0.3

# What comes before the lines that cure an error.
STATE = "State in [recording.columns]: "

# Relative rounding of times.
ROUNDING = 1e-9


def refuse_gross_error(
    system: System, recordings: tuple[AlignedRecording, ...], start: Array
) -> None:
    """Refuse a log which the model explains without one gross error, and not with it.

    The longest recording is looked at. Nothing is refused where the equation of motion cannot tell:
    where a degree of freedom was not measured, control laws compute the controls, or unknown forces
    of contacts act.

    Args:
        system: The system on the grid of the recordings.
        recordings: The recordings.
        start: (p,) parameters at which a fit would start [theta-unit].

    Raises:
        WrongLogError: The log has a gross error. The message has the lines that cure it.
    """
    longest = max(recordings, key=lambda each: float(each.t[-1]))
    if system.laws is not None or not longest.ctrl.any():
        return
    if len(longest.t) > MOST_ROWS:
        t = longest.t[:MOST_ROWS]
        samples = max(math.ceil(t[-1] / longest.dt * (1.0 - ROUNDING)), 1)
        longest = replace(longest, t=t, y=longest.y[:MOST_ROWS], ctrl=longest.ctrl[:samples])
    try:
        found = _Search.of(system, longest, start).found()
    except (MjfimError, np.linalg.LinAlgError):
        return
    if found:
        raise WrongLogError(f"{longest.name}: {found}")


@record
class _Change:
    """The n signals of a log without an error: controls, and then joints of one coordinate.

    Attributes:
        order: (n,) signals that have the names of these.
        factor: (n,) their factors.
        offset: (n,) constants that are added.
        words: The error in words.
        unknown: Attribute with unknown numbers; empty for none.
        where: (k,) its entries.
        sizes: (k,) natural sizes of the numbers.
    """

    order: np.ndarray
    factor: Array
    offset: Array
    words: str
    unknown: str
    where: np.ndarray
    sizes: Array

    def with_entries(self, name: str, entries: Any, values: Any) -> _Change:
        """The change with other values of some entries of an attribute."""
        array = np.array(getattr(self, name))
        array[entries] = values
        changed: dict[str, Any] = {name: array}
        return replace(self, **changed)


@record
class _Search:
    """Fits of the equations along changed logs.

    Attributes:
        system: The system.
        equations: The equations along the log.
        start: (p,) parameters where fits begin.
        bounds: (2, p) smallest and largest parameters that the experiment makes plausible.
        active: Indices of the parameters that may change.
    """

    system: System
    equations: MotionEquations
    start: Array
    bounds: Array
    active: np.ndarray

    @staticmethod
    def of(system: System, recording: AlignedRecording, start: Array) -> _Search:
        """The search. Raises RecordingError where the equations have too few rows."""
        parameters = system.parameters
        equations = MotionEquations.of(
            system, [recording], start, forces=(), laws=None, assumes_friction=True
        )
        held = np.isin(parameters.names, system.experiment.fit.hold)
        active = np.flatnonzero(parameters.changes_model & ~held)
        unknowns = len(active) + FREE_FORCES * system.space.nv
        if len(equations.places[0]) < ROWS_PER_UNKNOWN * unknowns:
            raise RecordingError(f"{recording.name}: too short for the equation of motion")

        # Bounds on both sides are stated; a single one may be that of physics.
        guess, size = parameters.guess, parameters.magnitude
        stated = np.array([parameters.lower, parameters.upper])
        about = np.sort([guess / UNSTATED_FACTOR, guess * UNSTATED_FACTOR], axis=0)
        about = np.where(guess == 0.0, [-size, size], about)
        prior = PRIOR_SIGMAS / np.maximum(parameters.prior_weight, np.finfo(float).tiny)
        about = np.clip(about, guess - prior, guess + prior)
        bounds = np.where(np.isfinite(stated).all(axis=0), stated, np.clip(about, *stated))
        return _Search(
            system=system,
            equations=equations,
            start=np.clip(start, *bounds),
            bounds=bounds,
            active=active,
        )

    def found(self) -> str:
        """The sentence about the error that explains the log; empty for none."""
        count = self.system.model.nu + len(self.joints)
        none = _Change(
            order=np.arange(count),
            factor=np.ones(count),
            offset=np.zeros(count),
            words="",
            unknown="offset",
            where=np.arange(0),
            sizes=np.zeros(0),
        )
        stated = self.fitted(none)[1]
        is_gross = stated > GROSS_SHARE**2
        if not is_gross.any():
            return ""
        changes = list(self._changes(none, names=bool(stated.max() > SHARE_OF_NAMES**2)))
        scores = [self.fitted(change, is_quick=True)[0] for change in changes]
        ranked = [(k, changes[k]) for k in np.argsort(scores)[:FITTED_ERRORS].tolist()]
        # Where the parameters leave the size of a factor open, its sign alone explains as much.
        ranked += [
            (-1, replace(none, words=each.words, factor=np.sign(each.factor)))
            for _, each in ranked
            if each.unknown == "factor"
        ]
        cures = []
        for k, tried in ranked:
            score, squares, change = self.fitted(tried)
            left = squares / stated
            cured = is_gross & (left <= LEFT_SHARE) & (squares <= EXPLAINED_SHARE**2)
            is_small = (squares <= SHARE_OF_NAMES**2) & (left <= MOST_RAISED)
            if cured.any() and (is_small | (left <= LEFT_OF_LARGE)).all():
                cures.append((round(score / TIE), k, change))
        if not cures:
            return ""
        _, _, change = min(cures, key=lambda each: each[:2])
        # Parameters that are far off make a good log look wrong.
        recording = self.equations.recorded[0].motion.recording
        other = try_fit_equations(self.system, [recording], self.start)
        if other is not None:
            elsewhere = replace(self, start=np.clip(other.theta, *self.bounds))
            if not (elsewhere.fitted(none)[1] > GROSS_SHARE**2).any():
                return ""
        cure = self._cure(change)
        return cure and f"{change.words}; without this error the model explains the motion. {cure}"

    # ---- fits

    def fitted(self, change: _Change, *, is_quick: bool = False) -> tuple[float, Array, _Change]:
        """Fit parameters, free forces and the numbers of a change; a quick fit keeps the first.

        Returns:
            The mean logarithm of the mean squares of the residuals over those of the forces, (E,)
            these mean squares of each equation, and the change with its numbers.
        """
        active = self.active[:0] if is_quick else self.active
        n, begin = len(active), getattr(change, change.unknown)[change.where]
        most = LARGEST_NUMBER * change.sizes
        z = np.concatenate([self.start[active], begin])
        about = begin + np.array([-most, most])
        low, high = np.concatenate([self.bounds[:, active], about], axis=1)
        steps = STEP * np.concatenate([self.system.parameters.magnitude[active], change.sizes])
        steps = np.where(high - z >= z - low, steps, -steps)
        friction = np.tile([0.0, 0.0, -np.inf], self.system.space.nv)
        unbounded = np.full(len(friction), np.inf)
        of_row = self.equations.places[1]

        def at(z: Array) -> tuple[_Change, Array, Array]:
            """The change, the rows and the slopes by the free forces at unknowns z."""
            theta = np.array(self.start)
            theta[active] = z[:n]
            changed = change.with_entries(change.unknown, change.where, z[n:])
            return changed, *self._rows(changed, theta)

        means = self.equations.mean_squares
        best = np.inf, np.full(len(self.equations.equations), np.inf), change
        for count in range(LINEARISATIONS):
            changed, rows, free = at(z)
            # A constant force is free, so that only changing ones count.
            mean = np.bincount(of_row, rows[1]) / np.maximum(np.bincount(of_row), 1)
            forces = np.sqrt(np.maximum(means(rows[1] - mean[of_row]), means(rows[2])))
            weights = 1.0 / np.maximum(forces, np.finfo(float).tiny)[of_row]
            residual, free = weights * (rows[0] - rows[1]), weights[:, None] * free
            if not np.isfinite(residual).all():
                break
            left = residual + free @ bounded_least_squares(free, -residual, friction, unbounded)
            squares = np.maximum(means(left), LEAST_SHARE**2)
            score = float(np.log(squares)[of_row].mean())
            if not score < best[0]:
                break
            best = score, squares, changed
            if not len(z) or count == LINEARISATIONS - 1:
                break
            moved = [at(z + move)[1] for move in np.diag(steps)]
            slopes = np.array([weights * (each[0] - each[1]) - residual for each in moved])
            # What overflows after a step has no slope.
            with np.errstate(invalid="ignore", over="ignore"):
                A = np.column_stack([np.nan_to_num(slopes.T / steps), free])
            lower, upper = np.append(low - z, friction), np.append(high - z, unbounded)
            z = z + bounded_least_squares(A, -residual, lower, upper)[: len(z)]
        return best

    def _rows(self, change: _Change, theta: Array) -> tuple[Array, Array]:
        """(3, R) rows along a changed log, and (R, f) slopes of the residuals by free forces."""
        (each,) = self.equations.recorded
        motion, nu = each.motion, self.system.model.nu
        ctrl = motion.recording.ctrl[:, change.order[:nu]] * change.factor[:nu]
        order, factor = change.order[nu:] - nu, change.factor[nu:]
        q, v = [joint.q for joint in self.joints], [joint.v for joint in self.joints]
        qpos, qvel, qacc = (np.array(x) for x in (motion.qpos, motion.qvel, motion.qacc))
        qpos[:, q] = qpos[:, q][:, order] * factor + change.offset[nu:]
        qvel[:, v] = qvel[:, v][:, order] * factor
        qacc[:, v] = qacc[:, v][:, order] * factor
        motion = replace(
            motion,
            recording=replace(motion.recording, ctrl=ctrl),
            qpos=qpos,
            qvel=qvel,
            qacc=qacc,
        )
        equations = replace(self.equations, recorded=(replace(each, motion=motion),))
        forces = np.array([equations.equation.directions(qvel), qvel, np.ones_like(qvel)])
        unit = np.eye(qvel.shape[1])
        free = [
            np.kron(unit[place], weights @ forces[:, :, place].T)
            for (_, _, place), (weights, _, _) in zip(
                equations.equations, each.windows, strict=True
            )
        ]
        return equations.rows(theta[None])[0], np.concatenate(free)

    # ---- errors

    @property
    def joints(self) -> tuple[ScalarJoint, ...]:
        """The joints among the signals."""
        return scalar_joints(self.system.model)

    def _changes(self, none: _Change, *, names: bool) -> Iterator[_Change]:
        """The errors that are tried, those of names and of signs of joints only if asked."""
        model, (each,) = self.system.model, self.equations.recorded
        nu, joints = model.nu, self.joints

        # Factors of all controls show their signs as well. They are found without the limits of the
        # actuators, which hide what a wrong control would do.
        moving = np.flatnonzero(each.motion.recording.ctrl.any(axis=0))
        unlimited = Relaxation(constraints=True, controls=True, actuators=tuple(range(nu)))
        system = self.system.with_variant(RELAXED, unlimited)
        search = replace(self, equations=replace(self.equations, system=system))
        words = "controls have another sign or unit"
        sizes = np.ones(len(moving))
        scaled = replace(none, words=words, unknown="factor", where=moving, sizes=sizes)
        found = search.fitted(scaled, is_quick=True)[2]
        yield replace(found, sizes=np.abs(found.factor[moving]))
        for k, joint in enumerate(joints, start=nu):
            size = np.ptp(each.motion.qpos[:, [joint.q]], axis=0)
            words = f"joint {joint.name} has another zero"
            yield replace(none, words=words, unknown="offset", where=np.array([k]), sizes=size)

        if not names:
            return
        names_of = [*actuator_names(model), *(joint.name for joint in joints)]
        kinds = ["control"] * nu + [f"joint {joint.unit}" for joint in joints]
        for k, joint in enumerate(joints, start=nu):
            change = none.with_entries("factor", k, -1.0)
            yield replace(change, words=f"joint {joint.name} has the wrong sign")
        for i, k in combinations(range(len(kinds)), 2):
            if kinds[i] == kinds[k]:
                words = f"{kinds[i].split()[0]}s {names_of[i]} and {names_of[k]} are swapped"
                yield replace(none.with_entries("order", [i, k], [k, i]), words=words)

    @property
    def _columns(self) -> list[list[str]]:
        """Columns of the log for each actuator, and then for each joint."""
        columns = [[f"ctrl:{name}"] for name in actuator_names(self.system.model)]
        found = measured_states(self.system, self.equations.recorded[0].motion.recording)
        for joint in self.joints:
            places = (joint.q, self.system.space.nq + joint.v)
            columns.append([self.system.outputs.names[found[x]] for x in places if x in found])
        return columns

    def _cure(self, change: _Change) -> str:
        """Lines for the experiment file; empty for a trifle."""
        columns = self._columns
        stated, lines = self.system.experiment.recording.sources, []
        for k, source in enumerate(change.order.tolist()):
            factor, offset = change.factor[k], change.offset[k]
            if abs(abs(factor) - 1.0) < LEAST_FACTOR:
                factor = np.sign(factor)
            if (source, factor, offset) == (k, 1.0, 0.0):
                continue
            for column, name in zip(columns[k], columns[source], strict=False):
                of = stated.get(name, ColumnSpec(column=name))
                lines.append(column_line(column, of, factor, offset))
                if offset:
                    break
        return f"{STATE}{'; '.join(lines)}" if lines else ""


def column_line(column: str, of: ColumnSpec, factor: float = 1.0, offset: float = 0.0) -> str:
    """Write a line of `[recording.columns]` that changes what a column of a log means.

    Args:
        column: Name of the signal.
        of: Where its values are until now.
        factor: Factor on the signal.
        offset: Constant that is added to it [unit of the signal].
    """
    zero = f", offset = {of.offset * factor + offset:.4g}" if offset else ""
    unit = f', unit = "{of.unit}"' if of.unit else ""
    entries = f'column = "{of.column}"{unit}, scale = {of.scale * factor:.4g}{zero}'
    return f'"{column}" = {{ {entries} }}'

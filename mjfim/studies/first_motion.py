"""The state and the motion with which a first experiment begins: a chirp, or a release."""

from __future__ import annotations

from collections.abc import Iterator
from copy import copy
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError, first_ones
from mjfim.model.coordinates import joint_dofs, tangent_components
from mjfim.model.elements import (
    control_sizes,
    is_rk4,
    position_sizes,
    translations,
    unique_names,
)
from mjfim.model.units import AT_JOINT, actuator_gear, commanded_joint, is_integrated
from mjfim.studies.first_candidates import require_keyframe, resting_keyframes, rounded

# Samples in one characteristic period of the motion.
SAMPLES_PER_PERIOD = 100

# Characteristic periods in the horizon.
PERIODS = 3.0

# Characteristic periods for which a stable state stays where it is.
LEAST_PERIODS = 1.5

# Largest ratio of the chosen to the wanted rate; within it a round number is preferred.
RATE_RANGE = 1.6

# Poles of the linearised model slower than this share of the fastest one stand still.
SLOWEST_POLE = 1e-6

# Largest exponent of the growth of a disturbance over the horizon.
LARGEST_GROWTH = 4.0

# Shortest horizon of an unstable state, in characteristic periods. Poles that are much faster than
# this belong to contacts.
SHORTEST = 0.2

# Difference step of the linearisation.
LINEARISATION_STEP = 1e-6

# Types of joints that turn.
HINGED = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_BALL)

# Engine steps in the characteristic period of a model that has neither gravity nor poles, and most
# steps in that of a slow pole: a body that drifts in a thin fluid would need hours.
STEPS_OF_FREE_MODEL = 1000


@record
class TimeScale:
    """Times of an experiment.

    Attributes:
        period: Characteristic period of the motion [s].
        rate: Rate of samples and controls [Hz].
        samples: Samples in the horizon.
        unstable: Whether the horizon is short because the initial state is unstable.
    """

    period: float
    rate: float
    samples: int
    unstable: bool

    @property
    def horizon(self) -> float:
        """Duration of the experiment [s]."""
        return self.samples / self.rate


def time_scale(model: Any, data: Any) -> TimeScale:
    """Choose rate and horizon for a model.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        data: Its data (`mujoco.MjData`) in the initial state, after `mj_forward`.
    """
    eigenvalues = _eigenvalues(model, data)
    period = _period(model, data, eigenvalues)
    rate = _rate(model.opt.timestep, SAMPLES_PER_PERIOD / period)

    # Without feedback, a motion about an unstable state stays near it for a short time only.
    growth = np.log(np.abs(eigenvalues).max(initial=1.0)) / model.opt.timestep
    longest = PERIODS * period
    unstable = growth * longest > LARGEST_GROWTH
    if unstable:
        longest = max(LARGEST_GROWTH / growth, SHORTEST * period)

    # The horizon has two significant digits, and is a whole number of samples.
    samples = max(round(rounded(longest) * rate), 2)
    return TimeScale(period=period, rate=rate, samples=samples, unstable=unstable)


def reach(model: Any, data: Any) -> float:
    """Length of the robot: largest distance from a joint to a centre of mass that it moves [m].

    Args:
        model: The compiled model.
        data: Its data in the initial state, after `mj_forward`.

    Returns:
        The length; for robots without hinges, the radius of gyration of the largest moving body or
        the model's extent.
    """
    largest = 0.0
    for joint in range(model.njnt):
        if mujoco.mjtJoint(model.jnt_type[joint]) in HINGED:
            arms = data.xipos[_moved(model, joint)] - data.xanchor[joint]
            largest = max(largest, float(np.linalg.norm(arms, axis=1).max()))
    if largest > 0.0:
        return largest

    moving = np.flatnonzero((model.body_dofnum > 0) & (model.body_mass > 0.0))
    radii = np.sqrt(1.5 * model.body_inertia[moving].mean(axis=1) / model.body_mass[moving])
    return float(radii.max(initial=0.0)) or float(model.stat.extent)


def _moved(model: Any, joint: int) -> Array:
    """(m,) numbers of the bodies with mass that a joint moves."""
    top = int(model.jnt_bodyid[joint])
    below = [top]
    for body in range(top + 1, model.nbody):
        if model.body_parentid[body] in below:
            below.append(body)
    return np.array([body for body in below if model.body_mass[body] > 0.0] or [top])


def pendulum_time(model: Any, data: Any) -> float | None:
    """Time of a pendulum of the robot's length, sqrt(length / gravity) [s]; None without gravity.

    Args:
        model: The compiled model.
        data: Its data in the initial state, after `mj_forward`.
    """
    if not has_gravity(model):
        return None
    return float(np.sqrt(reach(model, data) / np.linalg.norm(model.opt.gravity)))


def has_gravity(model: Any) -> bool:
    """Whether gravity acts.

    Args:
        model: The compiled model (`mujoco.MjModel`).
    """
    is_off = bool(model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_GRAVITY)
    return bool(model.opt.gravity.any()) and not is_off


def free_time(model: Any) -> float:
    """Time that stands for that of a motion which neither gravity nor a pole determines [s]."""
    return STEPS_OF_FREE_MODEL * float(model.opt.timestep)


def _period(model: Any, data: Any, eigenvalues: Array) -> float:
    """Characteristic period [s]: that of a pendulum of the robot's length, or of a slow pole."""
    time = pendulum_time(model, data)
    if time is not None:
        return 2.0 * np.pi * time

    # An eigenvalue of zero is infinitely fast; it says nothing about the motion.
    moving = eigenvalues[np.abs(eigenvalues) > np.finfo(float).eps]
    speeds = np.abs(np.log(moving.astype(complex))) / model.opt.timestep
    speeds = speeds[speeds > SLOWEST_POLE * speeds.max(initial=0.0)]
    if len(speeds):
        return min(2.0 * np.pi / float(speeds.min()), free_time(model))
    return free_time(model)


def _eigenvalues(model: Any, data: Any) -> Array:
    """(n,) eigenvalues of one engine step, linearised in the initial state."""
    nx = 2 * model.nv + model.na
    A = np.zeros((nx, nx))

    # MuJoCo does not linearise RK4; the time scale is the same with Euler's method.
    euler = copy(model)
    if is_rk4(euler):
        euler.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
    mujoco.mjd_transitionFD(euler, data, LINEARISATION_STEP, True, A, None, None, None)
    if not np.isfinite(A).all():
        return np.empty(0)
    return np.asarray(np.linalg.eigvals(A))


def _rate(timestep: float, wanted: float) -> float:
    """A rate [Hz] whose period is a whole number of timesteps [s], preferably a round number."""
    nearest = max(round(1.0 / (wanted * timestep)), 1)
    steps = range(int(np.ceil(nearest / RATE_RANGE)), int(nearest * RATE_RANGE) + 1)

    def preference(k: int) -> tuple[int, float]:
        """Number of digits of the rate, then its distance from the wanted one."""
        rate = 1.0 / (k * timestep)
        return len(f"{rate:.9g}".replace(".", "").strip("0")), abs(np.log(rate / wanted))

    return rounded(1.0 / (min(steps, key=preference) * timestep), 12)


# A state is held where the robot needs this many characteristic periods, sqrt(length / gravity), to
# move by its own length, or a joint by a radian.
HELD_PERIODS = 30.0

# Gauss-Newton steps towards the control that holds a state, and their relative difference step.
NEWTON_STEPS = 5
DIFFERENCE = 1e-4

# Controls below this share of their range are written as zero.
READABLE_SHARE = 1e-6

# Share of the range of a joint that the start keeps away from its ends, and where it begins instead
# of nearer ones: beside an end, the first motion of all joints would be small.
MARGIN = 0.05
MOVED_SHARE = 0.25

# Share of its range at which a control begins that can only pull or push, such as a muscle, where
# others balance it. At the end of its range it would have no room to move.
# The largest of these tensions in which the state is stable is taken, each half of the one before.
TENSION, TENSIONS = 0.25, 6

# End of the sentence about a start that was changed.
MOVED_INSIDE = ", with joints moved away from the ends of their ranges"

# Periods sqrt(length / gravity) for which a model settles, and the share of the velocity that is
# left after each of them.
SETTLING_PERIODS = 60.0
VELOCITY_LEFT = 1e-3

# Inertia of a locked joint, relative to its own.
LOCKING = 1e9

# Push of a state that is held but not stable, relative to the sizes of the positions, and the share
# of the velocity that is left after each period while it falls.
PUSH = 1e-2
FALLING_LEFT = 0.1


@record
class Start:
    """Initial state and resting control.

    Attributes:
        keyframe: Name of the keyframe, or None.
        near: Name of the keyframe that the state is or was moved away from; empty without one.
        qpos: (nq,) positions.
        act: (na,) activations.
        control: (nu,) control that holds the state, or that comes near to it.
        drift: Largest acceleration under the control, relative to that of a state that counts as
            held.
        reason: Sentence that says where the state comes from.
    """

    keyframe: str | None
    qpos: Array
    act: Array
    control: Array
    drift: float
    reason: str
    near: str = ""

    @property
    def held(self) -> bool:
        """Whether the control holds the state."""
        return self.drift <= 1.0


def choose_start(model: Any, keyframe: str | None = None) -> Start:
    """Choose a state at rest in which an experiment can begin.

    Named keyframes that a control holds come first, or the reference positions where there are
    none, then the state in which the model settles from there while its driven joints are locked,
    or by itself. A stable state comes before reference positions that are not: a pendulum begins
    hanging. Where nothing holds, the one that drifts least is taken: a robot with legs begins on
    its feet.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        keyframe: Keyframe that the user wants; None for the best start.

    Raises:
        ExperimentError: There is no such keyframe at rest.
    """
    if keyframe is not None:
        return _start_in_keyframe(model, model.key(require_keyframe(model, keyframe)).id)

    candidates = []
    for start in _candidates(model):
        candidates.append(start)
        if start.held and (start.near or _is_stable(model, start)):
            return start
    held = [start for start in candidates if start.held]
    return held[0] if held else min(candidates, key=lambda start: start.drift)


def falling_bodies(model: Any) -> list[str]:
    """Names of the free bodies that fall by their weight where nothing is below them.

    Args:
        model: The compiled model (`mujoco.MjModel`).
    """
    if not has_gravity(model):
        return []
    is_free = model.jnt_type == mujoco.mjtJoint.mjJNT_FREE
    names = unique_names(model, "body")
    return [names[body] for body in model.jnt_bodyid[is_free].tolist()]


def require_support(model: Any, path: Path) -> None:
    """Require something on which a free body can stand.

    Args:
        model: The compiled model (`mujoco.MjModel`), which no control holds.
        path: Its file, for the message.

    Raises:
        ExperimentError: Nothing that does not move can be touched.
    """
    fixed = model.body_weldid[model.geom_bodyid] == 0
    touchable = (model.geom_contype | model.geom_conaffinity) != 0
    falling = falling_bodies(model)
    if falling and not (fixed & touchable).any() and not model.npair:
        raise ExperimentError(
            f"{path}: nothing is below {first_ones(falling)}, which falls; give the file of the "
            'scene with the floor, or add <geom type="plane" size="0 0 1"/> to the <worldbody>'
        )


def _is_stable(model: Any, start: Start) -> bool:
    """Whether a state that a control holds stays there long enough after a small disturbance."""
    data = mujoco.MjData(model)
    _signed_acceleration(model, data, start.qpos, start.control)
    times = time_scale(model, data)
    return times.horizon >= LEAST_PERIODS * times.period


def _candidates(model: Any) -> Iterator[Start]:
    """Starts in the order of preference."""
    stated = [_start_in_keyframe(model, model.key(name).id) for name in resting_keyframes(model)]
    if not stated:
        reason = "the reference positions of the MJCF"
        # Tension gives muscles room to move, but too much of it makes a state unstable.
        shares = [*TENSION * SHRINKING ** np.arange(TENSIONS), 0.0]
        guesses = [_resting_control(model, each) for each in shares]
        different = {guess.tobytes(): guess for guess in guesses}.values()
        stated = [_start(model, model.qpos0, guess, reason) for guess in different]
    yield from stated

    first, driven = stated[0], driven_dofs(model)
    for locked, how in ((driven, "while its driven joints are locked"), ([], "by itself")):
        settled = _settled(model, first, locked)
        if settled is not None:
            reason = f"the state in which the model comes to rest {how}, from {first.reason}"
            # To move one joint of a closed chain would open it.
            yield _start(model, settled, first.control, reason, moves_inside=not model.neq)


def _start_in_keyframe(model: Any, number: int) -> Start:
    key = model.key(number)
    reason = f"the keyframe {key.name!r} of the MJCF"
    return _start(model, key.qpos, key.ctrl, reason, keyframe=key.name)


def _start(
    model: Any,
    qpos: Array,
    guess: Array,
    reason: str,
    *,
    keyframe: str | None = None,
    moves_inside: bool = True,
) -> Start:
    """A start with the control that holds it best.

    A joint that rests on the end of its range has no room to move, so it is moved away from there.
    """
    near, inside = keyframe or "", _inside_ranges(model, qpos) if moves_inside else qpos
    if not np.array_equal(inside, qpos):
        guess = guess + np.nan_to_num(_commands(model, inside) - _commands(model, qpos))
        qpos, keyframe, reason = inside, None, reason + MOVED_INSIDE
    data = mujoco.MjData(model)
    control = _holding_control(model, data, qpos, guess)
    drift = _drift(model, data, qpos, control)

    # The control of a keyframe is kept where it holds its state. Others have six significant
    # digits; those that hardly differ from zero are zero.
    _, _, width = _ranges(model, data, control)
    values = np.array([rounded(value, 6) for value in control])
    shown = np.where(np.abs(values) > READABLE_SHARE * width, values, 0.0)
    if keyframe is not None and (by_guess := _drift(model, data, qpos, guess)) <= 1.0:
        control = shown = np.array(guess)
        drift = by_guess
    return Start(
        keyframe=keyframe,
        qpos=np.array(qpos),
        act=_activations(model, data, control),
        control=shown,
        drift=drift,
        reason=reason,
        near=near,
    )


def _inside_ranges(model: Any, qpos: Array) -> Array:
    """(nq,) positions in which every limited joint keeps a distance from the ends of its range."""
    inside = np.array(qpos)
    for joint in range(model.njnt):
        if not model.jnt_limited[joint] or joint_dofs(model, joint) != 1:
            continue
        low, high = model.jnt_range[joint]
        q = model.jnt_qposadr[joint]
        if min(inside[q] - low, high - inside[q]) < MARGIN * (high - low):
            moved = MOVED_SHARE * (high - low)
            inside[q] = np.clip(inside[q], low + moved, high - moved)
    return inside


def _commands(model: Any, qpos: Array) -> Array:
    """(nu,) controls of position servos with their joints at qpos, (nq,); NaN for others."""
    control = np.full(model.nu, np.nan)
    for actuator in range(model.nactuator):
        joint = commanded_joint(model, actuator)
        if joint is not None:
            position = qpos[model.jnt_qposadr[joint]]
            control[model.actuator_ctrladr[actuator]] = actuator_gear(model, actuator) * position
    return control


def _resting_control(model: Any, share: float) -> Array:
    """(nu,) first guess of a holding control: zero, or inside a range with 0 at or beyond its end.

    The share of the range is the distance from this end.
    """
    control = np.zeros(model.nu)
    limited = model.actuator_ctrllimited.astype(bool)
    low, high = model.actuator_ctrlrange[limited].T
    room = share * (high - low)
    control[limited] = np.where(low * high < 0.0, 0.0, np.clip(0.0, low + room, high - room))

    # A position servo is commanded to where its joint is.
    commands = _commands(model, model.qpos0)
    return np.where(np.isnan(commands), control, commands)


def influence_of_controls(model: Any, start: Start) -> Array:
    """(nv, nu) derivatives of the accelerations by the controls, in the initial state."""
    data = mujoco.MjData(model)
    mujoco.mj_forward(model, data)
    _, high, width = _ranges(model, data, start.control)
    return _influence(model, data, start.qpos, start.control, high, width)


def _activations(model: Any, data: Any, control: Array) -> Array:
    """(na,) activations in which actuators with a state rest under a control."""
    act = np.zeros(model.na)
    for i in range(model.nactuator):
        first, count = model.actuator_actadr[i], model.actuator_actnum[i]
        if count == 0:
            continue
        if is_integrated(model, i):
            act[first : first + count] = data.actuator_length[model.actuator_outadr[i]]
        elif model.actuator_ctrlnum[i] in (1, count):
            controls = model.actuator_ctrladr[i]
            act[first : first + count] = control[controls : controls + count]
    return act


def _holding_control(model: Any, data: Any, qpos: Array, guess: Array) -> Array:
    """(nu,) control inside the ranges that makes the acceleration as small as possible."""
    control = np.array(guess, dtype=float)
    if model.nu == 0:
        return control

    _signed_acceleration(model, data, qpos, control)
    low, high, width = _ranges(model, data, control)
    control = np.clip(control, low, high)
    for _ in range(NEWTON_STEPS):
        base = _signed_acceleration(model, data, qpos, control)
        J = _influence(model, data, qpos, control, high, width)

        # Controls are scaled by their width, so that their units do not matter.
        room_low = np.minimum((low - control) / width, -np.finfo(float).tiny)
        room_high = np.maximum((high - control) / width, np.finfo(float).tiny)
        ends = (room_low, room_high)
        step = scipy.optimize.lsq_linear(J * width, -base, ends, method="bvls").x
        control = np.clip(control + step * width, low, high)
    return np.asarray(control)


def _ranges(model: Any, data: Any, control: Array) -> tuple[Array, Array, Array]:
    """(nu,) lower and upper ends of the controls, and widths to which steps are relative.

    The data are those of a simulation in the initial state.
    """
    low = np.full(model.nu, -np.inf)
    high = np.full(model.nu, np.inf)
    limited = model.actuator_ctrllimited.astype(bool)
    low[limited], high[limited] = model.actuator_ctrlrange[limited].T

    sizes = np.maximum(np.abs(control), control_sizes(model, _time(model, data)))
    return low, high, np.where(limited & np.isfinite(high - low), high - low, sizes)


def _influence(
    model: Any, data: Any, qpos: Array, control: Array, high: Array, width: Array
) -> Array:
    """(nv, nu) differences of the accelerations at rest, one control at a time."""
    base = _signed_acceleration(model, data, qpos, control)
    steps = DIFFERENCE * width
    steps = np.where(control + steps > high, -steps, steps)

    J = np.empty((model.nv, model.nu))
    for i in range(model.nu):
        moved = control.copy()
        moved[i] += steps[i]
        J[:, i] = (_signed_acceleration(model, data, qpos, moved) - base) / steps[i]
    return J


def _signed_acceleration(model: Any, data: Any, qpos: Array, control: Array) -> Array:
    """(nv,) acceleration at rest."""
    mujoco.mj_resetData(model, data)
    data.qpos[:] = qpos
    data.ctrl[:] = control
    if model.na:
        mujoco.mj_forward(model, data)
        data.act[:] = _activations(model, data, control)
    mujoco.mj_forward(model, data)
    return np.array(data.qacc)


def _drift(model: Any, data: Any, qpos: Array, control: Array) -> float:
    """Largest acceleration at rest, relative to that of a state that counts as held."""
    accelerations = np.abs(_signed_acceleration(model, data, qpos, control))
    patience = (HELD_PERIODS * _time(model, data)) ** 2
    relative = accelerations / np.where(translations(model), reach(model, data), 1.0) * patience
    return float(np.nan_to_num(relative, nan=np.inf).max(initial=0.0))


def _time(model: Any, data: Any) -> float:
    """Time of a pendulum of the robot's length, or of a model without gravity [s]."""
    return pendulum_time(model, data) or free_time(model)


def driven_dofs(model: Any) -> list[int]:
    """Degrees of freedom of the slides and hinges at which an actuator acts.

    Args:
        model: The compiled model (`mujoco.MjModel`).
    """
    joints = {
        int(model.actuator_trnid[i, 0])
        for i in range(model.nactuator)
        if mujoco.mjtTrn(model.actuator_trntype[i]) in AT_JOINT and model.actuator_ctrlnum[i]
    }
    return [model.jnt_dofadr[j] for j in sorted(joints) if joint_dofs(model, j) == 1]


def _settled(model: Any, start: Start, locked: list[int]) -> Array | None:
    """(nq,) positions in which the model comes to rest with a strong artificial damping.

    Slides and hinges whose degrees of freedom are locked keep their position. None where the
    simulation diverges, and where all degrees of freedom are locked.
    """
    if len(locked) == model.nv:
        return None
    # A joint with a large inertia stays where it is, and does not push the others.
    model = copy(model)
    model.dof_armature[locked] = LOCKING * model.dof_M0[locked]
    data = mujoco.MjData(model)
    _signed_acceleration(model, data, start.qpos, start.control)
    if start.held:
        # A pendulum that stands upright falls only if something pushes it.
        push = PUSH * position_sizes(model)
        push[locked] = 0.0
        mujoco.mj_integratePos(model, data.qpos, push, 1.0)
    time = _time(model, data)
    step = model.opt.timestep
    decay = (FALLING_LEFT if start.held else VELOCITY_LEFT) ** (step / time)

    for _ in range(int(SETTLING_PERIODS * time / step)):
        mujoco.mj_step(model, data)
        data.qvel *= decay
        data.qvel[locked] = 0.0
        if (
            not np.isfinite(data.qpos).all()
            or data.warning[mujoco.mjtWarning.mjWARN_BADQACC].number
        ):
            return None
    return np.array(data.qpos)


# Share of the range of a control that the first trial uses to each side of the resting control.
RANGE_SHARE = 0.5

# Angle that a free rotation moves in the first trial [rad], and share of the robot's length that a
# free translation moves.
ANGLE = 0.5
LENGTH_SHARE = 0.5

# Factor between successive trials, and their number.
SHRINKING = 0.5
TRIALS = 16


def first_amplitudes(
    model: Any, start: Start, influence: Array, length: float, period: float
) -> Array:
    """Amplitudes of the controls with which the search begins.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        start: Initial state and resting control.
        influence: (nv, nu) derivatives of the accelerations by the controls.
        length: Length of the robot [m].
        period: Characteristic period of its motion [s].

    Returns:
        (nu,) amplitudes: a share of the room within the control's range, or, without a range, what
        moves a joint by half a radian or by half of the robot's length. A control that rests at an
        end of its range gets 0.
    """
    distance = np.where(translations(model), LENGTH_SHARE * length, ANGLE)
    wanted = distance * (2.0 * np.pi / period) ** 2

    # A control that moves nothing in the start gets its natural size.
    amplitudes = control_sizes(model, period)
    for i in range(model.nu):
        if model.actuator_ctrllimited[i]:
            low, high = model.actuator_ctrlrange[i]
            room = min(start.control[i] - low, high - start.control[i])
            amplitudes[i] = RANGE_SHARE * max(room, 0.0)
        elif np.any(influence[:, i]):
            moved = np.abs(influence[:, i]) > 0.0
            amplitudes[i] = (wanted[moved] / np.abs(influence[moved, i])).min()

    for control, amplitude in _servo_amplitudes(model, distance):
        amplitudes[control] = amplitude
    return two_digits(amplitudes)


def _servo_amplitudes(model: Any, distance: Array) -> Iterator[tuple[int, float]]:
    """Controls without a range that a joint follows, with the amplitudes for its (nv,) distance."""
    for actuator in range(model.nactuator):
        control = model.actuator_ctrladr[actuator]
        joint = commanded_joint(model, actuator)
        if joint is not None and not model.actuator_ctrllimited[control]:
            gear = abs(actuator_gear(model, actuator))
            yield control, gear * distance[model.jnt_dofadr[joint]]


def two_digits(values: Array) -> Array:
    """Numbers with two significant digits."""
    return np.array([rounded(value) for value in values])


# Angle by which a hinge or ball joint without a range may be released to each side of the start
# [rad].
RELEASE_ANGLE = 2.5

# Share of the way from the start to the farther end of a range at which the first release is.
FIRST_SHARE = 0.4

# Largest number of coordinates that a design chooses; more of them need too many simulations.
MOST_COORDINATES = 4


# Positions, (nq,), from which a model is released, and ranges of the coordinates that a design
# chooses, by name.
ProposedRelease = tuple[Array, dict[str, tuple[float, float]]]


def propose_release(
    model: Any, start: Array, length: float, share: float = FIRST_SHARE
) -> ProposedRelease:
    """Propose a release away from the start, inside the ranges of the joints.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        start: (nq,) positions of an equilibrium.
        length: Length of the robot [m].
        share: Share of the way from the start to the farther end of each range.

    Returns:
        The release; it has no coordinates where no joint with a name slides or turns.
    """
    components = {c.address: c for c in tangent_components(model)[: model.nv]}
    move = np.zeros(model.nv)
    free: dict[str, tuple[float, float]] = {}

    for j in range(model.njnt):
        if model.jnt_type[j] == mujoco.mjtJoint.mjJNT_FREE:
            continue
        first = model.jnt_dofadr[j]
        for dof in range(first, first + joint_dofs(model, j)):
            component = components[dof]
            if not component.path or len(free) == MOST_COORDINATES:
                continue
            at, low, high = _range_of(model, j, start, length)
            farther = high if high - at >= at - low else low
            move[dof] = share * (farther - at)
            free[component.name] = (low, high)

    qpos = np.array(start, dtype=np.float64)
    mujoco.mj_integratePos(model, qpos, move, 1.0)
    # Slides and hinges have three significant digits.
    for j in range(model.njnt):
        if joint_dofs(model, j) == 1:
            address = model.jnt_qposadr[j]
            qpos[address] = rounded(qpos[address], 3)
    return qpos, free


def _range_of(model: Any, joint: int, start: Array, length: float) -> tuple[float, float, float]:
    """Place at the start, and lower and upper end of the releases of a joint.

    The rotations of a ball joint are relative to the start.
    """
    kind = model.jnt_type[joint]
    if kind == mujoco.mjtJoint.mjJNT_BALL:
        return 0.0, -RELEASE_ANGLE, RELEASE_ANGLE

    at = float(start[model.jnt_qposadr[joint]])
    if model.jnt_limited[joint]:
        low, high = (float(end) for end in model.jnt_range[joint])
        gap = MARGIN * (high - low)
        return at, rounded(low + gap, 3), rounded(high - gap, 3)

    slides = kind == mujoco.mjtJoint.mjJNT_SLIDE
    width = LENGTH_SHARE * length if slides else RELEASE_ANGLE
    return at, rounded(at - width, 3), rounded(at + width, 3)

"""The time scale of a model's motion, from which the rate and the horizon of an experiment follow.

All numbers here are shares of times and lengths of the model itself, so that a table-top pendulum
and an excavator get experiments of the same form.
"""

from __future__ import annotations

from copy import copy
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.model.elements import is_rk4

# Samples in one characteristic period of the motion.
SAMPLES_PER_PERIOD = 100

# Characteristic periods in the horizon.
PERIODS = 3.0

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
DIFFERENCE = 1e-6

# Engine steps in the characteristic period of a model that has neither gravity nor poles, and most
# steps in that of a slow pole: a body that drifts in a thin fluid would need hours.
STEPS_OF_FREE_MODEL = 1000


@dataclass(frozen=True, kw_only=True)
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
    rate = _rate(float(model.opt.timestep), SAMPLES_PER_PERIOD / period)

    # Without feedback, a motion about an unstable state stays near it for a short time only.
    growth = float(np.log(np.abs(eigenvalues).max(initial=1.0))) / float(model.opt.timestep)
    longest = PERIODS * period
    unstable = growth * longest > LARGEST_GROWTH
    if unstable:
        longest = max(LARGEST_GROWTH / growth, SHORTEST * period)

    # The horizon has two significant digits, and is a whole number of samples.
    wanted = float(f"{longest:.2g}")
    samples = max(round(wanted * rate), 2)
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
        hinged = model.jnt_type[joint] in (
            int(mujoco.mjtJoint.mjJNT_HINGE),
            int(mujoco.mjtJoint.mjJNT_BALL),
        )
        if hinged:
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
    found = []
    for body in range(top, model.nbody):
        above = body
        while above > top:
            above = int(model.body_parentid[above])
        if above == top and model.body_mass[body] > 0.0:
            found.append(body)
    return np.array(found or [top])


def pendulum_time(model: Any, data: Any) -> float | None:
    """Time of a pendulum of the robot's length, sqrt(length / gravity) [s]; None without gravity.

    Args:
        model: The compiled model.
        data: Its data in the initial state, after `mj_forward`.
    """
    gravity = float(np.linalg.norm(model.opt.gravity))
    is_off = bool(model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_GRAVITY))
    if gravity == 0.0 or is_off:
        return None
    return float(np.sqrt(reach(model, data) / gravity))


def free_time(model: Any) -> float:
    """Time that stands for that of a motion which neither gravity nor a pole determines [s]."""
    return STEPS_OF_FREE_MODEL * float(model.opt.timestep)


def _period(model: Any, data: Any, eigenvalues: Array) -> float:
    """Characteristic period [s]: that of a pendulum of the robot's length, or of a slow pole."""
    time = pendulum_time(model, data)
    if time is not None:
        return 2.0 * np.pi * time

    speeds = _pole_speeds(eigenvalues, float(model.opt.timestep))
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
        euler.opt.integrator = int(mujoco.mjtIntegrator.mjINT_EULER)
    mujoco.mjd_transitionFD(euler, data, DIFFERENCE, True, A, None, None, None)
    if not np.isfinite(A).all():
        return np.empty(0)
    return np.asarray(np.linalg.eigvals(A))


def _pole_speeds(eigenvalues: Array, timestep: float) -> Array:
    """(n,) magnitudes of the moving poles [1/s] from eigenvalues of one step of `timestep` s."""
    # An eigenvalue of zero is infinitely fast; it says nothing about the motion.
    moving = eigenvalues[np.abs(eigenvalues) > np.finfo(float).eps]
    speeds = np.abs(np.log(moving.astype(complex))) / timestep
    return np.asarray(speeds[speeds > SLOWEST_POLE * speeds.max(initial=0.0)])


def _rate(timestep: float, wanted: float) -> float:
    """A rate [Hz] whose period is a whole number of timesteps [s], preferably a round number."""
    nearest = max(round(1.0 / (wanted * timestep)), 1)
    first = int(np.ceil(nearest / RATE_RANGE))
    steps = range(first, int(nearest * RATE_RANGE) + 1)

    def preference(k: int) -> tuple[int, float]:
        """Number of digits of the rate, then its distance from the wanted one."""
        rate = 1.0 / (k * timestep)
        digits = len(f"{rate:.9g}".replace(".", "").strip("0"))
        return digits, abs(float(np.log(rate / wanted)))

    return float(f"{1.0 / (min(steps, key=preference) * timestep):.12g}")

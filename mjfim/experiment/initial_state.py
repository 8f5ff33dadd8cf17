"""The state in which an experiment starts, and the keyframes of a model."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, unknown
from mjfim.experiment.schema import by_name
from mjfim.experiment.signals import multisine
from mjfim.experiment.system_tables import Initial, Signal
from mjfim.model.coordinates import joint_dofs, joint_names
from mjfim.model.terms.extension import StateLayout

# Frequencies of successive actuators differ by this fraction of the first actuator's frequency.
FREQUENCY_SPREAD = 0.17

# Last frequency of a chirp over its first one, where the experiment file does not state it.
CHIRP_SPAN = 5.0


def generate(signal: Signal, t: Array, names: tuple[str, ...], rest: Array) -> Array:
    """Generate the control of all actuators.

    Every actuator has a different frequency, so that the movements differ. Sines and chirps begin
    at their offset, without a jump.

    Args:
        signal: Kind of signal, its amplitude, offset and frequencies.
        t: (N,) sample times [s].
        names: nu names of the actuators.
        rest: (nu,) offset that is used if the signal states none [control unit].

    Returns:
        (N, nu) control [control unit].

    Raises:
        ExperimentError: The amplitude or the offset names an unknown actuator.
    """
    amplitude = by_name("initial.control.amplitude", signal.amplitude, names, "actuator")

    offset = np.array(rest)
    if signal.offset is not None:
        offset = by_name("initial.control.offset", signal.offset, names, "actuator")

    return np.asarray(offset + amplitude * _shape(signal, t, len(names)))


def _shape(signal: Signal, t: Array, nu: int) -> Array:
    """(N, nu) waveform of each actuator with amplitude 1 and no offset; ones for a constant."""
    spread = 1.0 + FREQUENCY_SPREAD * np.arange(nu)

    if signal.kind == "sine":
        return np.asarray(np.sin(2 * np.pi * signal.frequency * t[:, None] * spread))

    if signal.kind == "chirp":
        first = signal.frequency
        last = signal.frequency_end or CHIRP_SPAN * first
        sweeps = [scipy.signal.chirp(t, first * s, t[-1], last * s, phi=-90.0) for s in spread]
        return np.stack(sweeps, axis=1)

    if signal.kind == "multisine":
        rng = np.random.default_rng(signal.seed)
        return multisine(t, nu, signal.frequency, signal.harmonics, rng)

    return np.ones((len(t), nu))


# A quaternion whose norm is below this number states no rotation.
NO_ROTATION = 1e-6


def keyframe(model: Any, key: str, name: str | None) -> Any:
    """Find a keyframe of a model by its name.

    Args:
        model: MjModel.
        key: Key of the experiment file that states the name, for the message.
        name: Name of the keyframe, or None.

    Returns:
        The keyframe; None without a name.

    Raises:
        ExperimentError: There is no keyframe of this name.
    """
    if name is None:
        return None

    kind = mujoco.mjtObj.mjOBJ_KEY
    names = [mujoco.mj_id2name(model, kind, i) or "" for i in range(model.nkey)]
    if name not in names:
        raise ExperimentError(f"{key}: {unknown('keyframe', name, [n for n in names if n])}")
    return model.key(name)


def initial_state(stated: Initial, model: Any, key: Any, layout: StateLayout | None) -> Array:
    """The state in which an experiment starts.

    It is that of a keyframe, the stated numbers, or the reference state of the model. Numbers may
    be stated for the MJCF alone: coordinates that physical terms add are then at rest.

    Args:
        stated: The table `[initial]` of the experiment.
        model: MjModel.
        key: The keyframe that the table names, or None.
        layout: Where the state of the MJCF is in that of the model; None without terms.

    Returns:
        (ns,) state (qpos, qvel, act) with unit quaternions.

    Raises:
        ExperimentError: Stated numbers have the wrong length, or a quaternion is zero.
    """
    if key is not None:
        qpos, qvel, act = np.array(key.qpos), np.array(key.qvel), np.array(key.act)
    else:
        # Without terms the MJCF has the whole state.
        own = layout or StateLayout(
            qpos=np.arange(model.nq), qvel=np.arange(model.nv), act=np.arange(model.na), model=model
        )
        qpos = np.array(model.qpos0)
        if stated.qpos is not None:
            qpos = _completed("qpos", stated.qpos, model.nq, len(own.qpos), own.positions)
        zeros = np.zeros(model.nv)
        qvel = _completed("qvel", stated.qvel or zeros, model.nv, len(own.qvel), own.velocities)

        def activations(numbers: Array) -> Array:
            """Activations of the model at the initial positions."""
            return own.activations(numbers, qpos, None)

        zeros = np.zeros(len(own.act))
        act = _completed("act", stated.act or zeros, model.na, len(own.act), activations)

    _require_rotations(model, qpos)
    mujoco.mj_normalizeQuat(model, qpos)
    return np.concatenate([qpos, qvel, act])


def _completed(
    name: str,
    numbers: Sequence[float] | Array,
    count: int,
    own_count: int,
    complete: Callable[[Array], Array],
) -> Array:
    """Numbers of the model; those of the MJCF alone are completed."""
    if len(numbers) == own_count:
        return complete(np.array(numbers, dtype=np.float64))
    if len(numbers) != count:
        raise ExperimentError(f"initial.{name}: {len(numbers)} numbers; this model needs {count}")
    return np.array(numbers, dtype=np.float64)


def _require_rotations(model: Any, qpos: Array) -> None:
    """Raise ExperimentError if a quaternion in qpos: (nq,) is zero."""
    for j, name in enumerate(joint_names(model)):
        if joint_dofs(model, j) == 1:
            continue

        # The quaternion of a free joint follows its position.
        is_free = int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_FREE)
        first = int(model.jnt_qposadr[j]) + (3 if is_free else 0)
        if not np.linalg.norm(qpos[first : first + 4]) > NO_ROTATION:
            raise ExperimentError(
                f"initial.qpos: the quaternion of joint {name!r} (numbers {first} to {first + 3}) "
                "is zero; the identity rotation is 1, 0, 0, 0"
            )

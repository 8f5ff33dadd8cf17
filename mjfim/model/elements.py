"""Elements of a compiled MuJoCo model by kind and name, and natural sizes of its coordinates.

Small numbers are relative to these sizes. A rotation has the size of one radian whatever the robot.
All other sizes follow from the lengths, masses and ranges of the model, so that they scale with its
units.
"""

from __future__ import annotations

from collections.abc import Collection
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.model.units import acts_at_joint

# MuJoCo's object type of every kind of element that has a name.
OBJECT_TYPES = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "pair": mujoco.mjtObj.mjOBJ_PAIR,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "sensor": mujoco.mjtObj.mjOBJ_SENSOR,
    "key": mujoco.mjtObj.mjOBJ_KEY,
}

# Field of MjModel that counts the elements of a kind, where it is not called `n<kind>`.
COUNT_FIELDS = {"joint": "njnt", "actuator": "nactuator"}

# Share of its size by which a slow coordinate moves in one sample. Slower motions count as rest.
LEAST_MOVE_PER_SAMPLE = 0.01

# Column of the stiffness of a bristle in the dynamics of a `dcmotor`.
BRISTLE_STIFFNESS_COLUMN = 5


def element_count(model: Any, kind: str) -> int:
    """Number of elements of a kind, with and without a name.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        kind: A key of `OBJECT_TYPES`.
    """
    return int(getattr(model, COUNT_FIELDS.get(kind, f"n{kind}")))


def names_of(model: Any, kind: str) -> list[str]:
    """Names of all elements of a kind that have one, in the order of the model.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        kind: A key of `OBJECT_TYPES`.
    """
    names = [element_name(model, kind, i) for i in range(element_count(model, kind))]
    return [name for name in names if name]


def unnamed_count(model: Any, kind: str) -> int:
    """Number of elements of a kind that have no name.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        kind: A key of `OBJECT_TYPES`.
    """
    return element_count(model, kind) - len(names_of(model, kind))


def unique_names(model: Any, kind: str) -> tuple[str, ...]:
    """Unique names of all elements of a kind.

    An element without a name is called `<kind><number>`; underscores are appended where another
    element has that name.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        kind: A key of `OBJECT_TYPES`.
    """
    names = [element_name(model, kind, i) for i in range(element_count(model, kind))]
    taken = set(names)

    for i, given in enumerate(names):
        if not given:
            name = f"{kind}{i}"
            while name in taken:
                name += "_"
            names[i] = name

    return tuple(names)


def free_name(stem: str, taken: Collection[str]) -> str:
    """Return a name that is not taken: the stem, or `stem_2` and so on."""
    name, number = stem, 2
    while name in taken:
        name, number = f"{stem}_{number}", number + 1
    return name


def geom_labels(model: Any) -> tuple[str, ...]:
    """Labels of all geoms: the name of a geom, or `<body> geom <number>` where it has none.

    Args:
        model: The compiled model (`mujoco.MjModel`).
    """
    bodies = unique_names(model, "body")
    return tuple(
        element_name(model, "geom", geom) or f"{bodies[body]} geom {geom}"
        for geom, body in enumerate(model.geom_bodyid.tolist())
    )


def identifier(model: Any, kind: str, name: str) -> int:
    """Number of the element of a kind that has a name.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        kind: A key of `OBJECT_TYPES`.
        name: Name of the element.

    Returns:
        The number; -1 where no element has the name.
    """
    return int(mujoco.mj_name2id(model, OBJECT_TYPES[kind], name))


def element_name(model: Any, kind: str, number: int) -> str:
    """Name of an element in the MJCF.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        kind: A key of `OBJECT_TYPES`.
        number: Number of the element.

    Returns:
        The name; empty where the element has none.
    """
    return mujoco.mj_id2name(model, OBJECT_TYPES[kind], number) or ""


def is_rk4(model: Any) -> bool:
    """Whether a model is integrated with RK4, which computes forces at four stages of a step.

    Args:
        model: The compiled model (`mujoco.MjModel`).
    """
    return bool(model.opt.integrator == mujoco.mjtIntegrator.mjINT_RK4)


def model_length(model: Any) -> float:
    """Length of the largest moving tree of a model [m].

    It is the largest sum of the offsets of bodies from the root of their tree to a centre of mass,
    and the radius of gyration about it. Places in the world and geoms without mass do not matter.

    Args:
        model: The compiled model (`mujoco.MjModel`).
    """
    from_root = np.zeros(model.nbody)
    longest = 0.0

    for body in range(1, model.nbody):
        if not model.body_weldid[body]:
            continue
        parent = model.body_parentid[body]
        if model.body_weldid[parent]:
            offset = np.linalg.norm(model.body_pos[body])
            from_root[body] = from_root[parent] + offset

        mass = model.body_mass[body]
        if mass > 0.0:
            gyration = np.sqrt(model.body_inertia[body].max() / mass)
            centre = np.linalg.norm(model.body_ipos[body])
            longest = max(longest, from_root[body] + centre + gyration)

    # MuJoCo's extent is the size of the geoms and sites, where nothing that moves has a mass.
    return longest or model.stat.extent


def translations(model: Any) -> np.ndarray:
    """(nv,) True for the degrees of freedom that are translations.

    Args:
        model: The compiled model (`mujoco.MjModel`).
    """
    found = np.zeros(model.nv, dtype=bool)
    for joint in range(model.njnt):
        first = model.jnt_dofadr[joint]
        kind = model.jnt_type[joint]
        if kind == mujoco.mjtJoint.mjJNT_SLIDE:
            found[first] = True
        elif kind == mujoco.mjtJoint.mjJNT_FREE:
            found[first : first + 3] = True
    return found


def position_sizes(model: Any) -> Array:
    """Natural size of each degree of freedom.

    Args:
        model: The compiled model (`mujoco.MjModel`).

    Returns:
        (nv,) sizes: the model's length for translations, 1 for rotations [m, rad].
    """
    return np.where(translations(model), model_length(model), 1.0)


def control_sizes(model: Any, time: float) -> Array:
    """Natural size of each control, where no trajectory shows it.

    It is the range of the control or of the force; else the control that moves the joint of a servo
    by its natural size, or accelerates the joint by its natural size in a natural time.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        time: Natural time of the motion [s].

    Returns:
        (nu,) positive sizes [u-unit].
    """
    sizes = np.ones(model.nu)
    for actuator in range(model.nactuator):
        control = model.actuator_ctrladr[actuator]
        count = model.actuator_ctrlnum[actuator]
        if count:
            sizes[control : control + count] = control_size(model, actuator, control, time)
    return sizes


def force_sizes(model: Any, time: float) -> Array:
    """Force that accelerates each degree of freedom by its natural size in a natural time, squared.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        time: Natural time of the motion [s].

    Returns:
        (nv,) forces [N or N m].
    """
    weight = np.asarray(model.dof_invweight0)
    inertia = 1.0 / np.where(weight > 0.0, weight, 1.0)
    return inertia * position_sizes(model) / time**2


def actuator_force_sizes(model: Any, time: float) -> Array:
    """Natural size of each force of an actuator.

    It is the range of the force, else the force that accelerates the joint by its natural size in a
    natural time, squared.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        time: Natural time of the motion [s].

    Returns:
        (nf,) positive sizes, by the address of the force [N or N m].
    """
    sizes = np.ones(len(model.actuator_acc0))
    for actuator in range(model.nactuator):
        first, count = model.actuator_outadr[actuator], model.actuator_outnum[actuator]
        sizes[first : first + count] = _actuator_force_size(model, actuator, time)
    return sizes


def bristle_actuators(model: Any) -> list[int]:
    """Numbers of the `dcmotor` actuators without control whose only activation is a bristle.

    Args:
        model: The compiled model (`mujoco.MjModel`).
    """
    has_bristle = model.actuator_dyntype == mujoco.mjtDyn.mjDYN_DCMOTOR
    has_bristle = has_bristle & (model.actuator_dynprm[:, BRISTLE_STIFFNESS_COLUMN] > 0.0)
    has_bristle &= (model.actuator_ctrlnum == 0) & (model.actuator_actnum == 1)
    return [int(actuator) for actuator in np.flatnonzero(has_bristle)]


def bristle_sizes(model: Any, time: float) -> dict[int, float]:
    """Natural deflections of the bristles of friction in `dcmotor` actuators without control.

    A bristle bends under a natural force, or by the way of one engine step before it slides.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        time: Natural time of the motion [s].

    Returns:
        The larger of both deflections, by its address in the activations [m or rad].
    """
    found = {}
    for actuator in bristle_actuators(model):
        stiffness = model.actuator_dynprm[actuator, BRISTLE_STIFFNESS_COLUMN]
        under_force = _actuator_force_size(model, actuator, time) / stiffness
        way = _transmission(model, actuator)[0] / time * model.opt.timestep
        found[int(model.actuator_actadr[actuator])] = max(under_force, way)
    return found


def control_size(model: Any, actuator: int, control: int, time: float) -> float:
    """Natural size of a control of one actuator, see `control_sizes`."""
    stated = _largest_finite(model.actuator_ctrlrange[control])
    if stated > 0.0:
        return stated

    gain = abs(model.actuator_gainprm[actuator, 0]) or 1.0
    bias = np.abs(model.actuator_biasprm[actuator])
    length, _ = _transmission(model, actuator)

    # A servo for positions or velocities.
    if bias[1] > 0.0:
        return float(length * bias[1] / gain)
    if bias[2] > 0.0:
        return float(length / time * bias[2] / gain)

    return _actuator_force_size(model, actuator, time) / gain


def _actuator_force_size(model: Any, actuator: int, time: float) -> float:
    """Natural size of the force of one actuator, see `actuator_force_sizes`."""
    stated = _largest_finite(model.actuator_forcerange[actuator])
    if stated > 0.0 and model.actuator_ctrlnum[actuator]:
        return stated

    length, acceleration = _transmission(model, actuator)
    return length / time**2 / (acceleration or 1.0)


def _largest_finite(bounds: Array) -> float:
    """Largest magnitude of the finite bounds; 0 without one."""
    return float(np.abs(bounds[np.isfinite(bounds)]).max(initial=0.0))


def _transmission(model: Any, actuator: int) -> tuple[float, float]:
    """Natural size of the length that an actuator acts on, and what accelerates it.

    Returns:
        The length [m or rad, times the gear], and the acceleration that a unit force of the
        actuator causes, 0 without any [1/s² per unit force].
    """
    output = model.actuator_outadr[actuator]
    if not acts_at_joint(model, actuator):
        return model_length(model), float(model.actuator_acc0[output])

    # MuJoCo's `acc0` is a norm over all joints, which mixes rotations with translations.
    gear = float(np.abs(model.actuator_gear[output]).max())
    dof = model.jnt_dofadr[model.actuator_trnid[actuator, 0]]
    length = (gear or 1.0) * float(position_sizes(model)[dof])
    return length, gear * float(model.dof_invweight0[dof])

"""Parameter values written into an MjSpec, for what only a compile can follow and for the identified MJCF."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.model.paths import INERTIAL_FIELDS, PATH, SERVO

INERTIAL = ("mass", "ipos", "inertia", *INERTIAL_FIELDS)


def write_element(spec: Any, compiled: Any, wanted: Any, path: str, value: float) -> None:
    """Write what a path names into an MjSpec that the caller owns.

    compiled: the model of the same spec; a body whose inertia came from geoms gets it spelled out before it is changed
    wanted: the model at the values, from which inertias and orientations are taken as a whole
    """
    match = PATH.match(path)
    if match is None:
        raise ValueError(f"parameter path {path!r} is not of the form kind/name:field[index]")
    kind, name, field, index = (
        match["kind"],
        match["name"],
        match["field"],
        int(match["index"] or 0),
    )
    if kind in ("initial", "output"):
        return
    element = spec.option if kind == "option" else getattr(spec, kind)(name)
    if field in ("pos", "rot") and element.frame is not None:
        leave_frame(element, getattr(compiled, kind)(name), path)
    if field in INERTIAL_FIELDS:
        spell_out_inertia(element, wanted)
    elif field == "rot":
        element.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        element.quat = getattr(wanted, kind)(name).quat
    elif field in SERVO and kind == "actuator":
        element.gainprm, element.biasprm = (
            wanted.actuator_gainprm[element.id],
            wanted.actuator_biasprm[element.id],
        )
    elif field == "springlength":  # one rest length may stand for both ends of the range
        element.springlength = wanted.tendon_lengthspring[element.id]
    else:
        if kind == "body" and field in INERTIAL and not element.explicitinertial:
            spell_out_inertia(element, compiled)
        if kind == "geom" and np.isfinite(element.fromto[0]):
            spell_out_geom(element, compiled)
        if (
            kind == "geom" and field == "pos" and element.meshname
        ):  # the compiler adds the mesh's own offset
            value += float(element.pos[index] - compiled.geom(name).pos[index])
        if (
            field == "springref"
            and element.type == mujoco.mjtJoint.mjJNT_HINGE
            and spec.compiler.degree
        ):
            value = float(np.rad2deg(value))
        _assign(element, field, index, value)


def _assign(element: Any, field: str, index: int, value: float) -> None:
    old = np.array(getattr(element, field), dtype=np.float64)
    if old.ndim:
        old[index] = value
        setattr(element, field, old)
    else:
        setattr(element, field, value)


def leave_frame(element: Any, found: Any, path: str) -> None:
    """Say an element's place in its body's coordinates instead of those of a `<frame>`. found: it in the compiled model."""
    if getattr(element, "meshname", ""):
        raise ExperimentError(
            f"{path!r}: a mesh inside a <frame> cannot be moved; take the geom out of the frame"
        )
    element.set_frame(element.parent.add_frame())
    element.pos, element.quat, element.alt.type = (
        found.pos,
        found.quat,
        mujoco.mjtOrientation.mjORIENTATION_QUAT,
    )


def spell_out_inertia(body: Any, compiled: Any) -> None:
    """Give a body of a spec the inertia that it has in a model."""
    found = compiled.body(body.id)
    body.mass, body.ipos, body.iquat, body.inertia = (
        float(found.mass[0]),
        found.ipos,
        found.iquat,
        found.inertia,
    )
    body.fullinertia, body.explicitinertial = np.full(6, np.nan), True


def spell_out_geom(geom: Any, compiled: Any) -> None:
    """Replace a geom's end points by the place and size that they compile to."""
    found = compiled.geom(geom.id)
    geom.fromto = np.full(6, np.nan)
    geom.pos, geom.quat, geom.size = found.pos, found.quat, found.size


def settle(spec: Any, compiled: Any) -> None:
    """Spell out what the compiler would resolve anew from the changed values: inertias, springs, servo gains, end points."""
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    spec.compiler.settotalmass = -1.0
    for body in spec.bodies[1:]:
        spell_out_inertia(body, compiled)
    for geom in spec.geoms:
        if np.isfinite(geom.fromto[0]):
            spell_out_geom(geom, compiled)
    for joint in spec.joints:
        if np.any(np.asarray(joint.springdamper) > 0):
            joint.springdamper = np.zeros(2)
            joint.stiffness = _first(joint.stiffness, float(compiled.jnt_stiffness[joint.id]))
            joint.damping = _first(
                joint.damping, float(compiled.dof_damping[compiled.jnt_dofadr[joint.id]])
            )
    for tendon in spec.tendons:
        tendon.springlength = compiled.tendon_lengthspring[tendon.id]
    for actuator in spec.actuators:
        actuator.biasprm = compiled.actuator_biasprm[actuator.id]
        actuator.gainprm = compiled.actuator_gainprm[actuator.id]


def _first(polynomial: Any, value: float) -> Array:
    changed = np.array(polynomial, dtype=np.float64)
    changed[0] = value
    return changed

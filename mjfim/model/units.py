"""Units of what parameter paths name."""

from __future__ import annotations

from typing import Any

import mujoco

from mjfim.model.inertia import INERTIA_PARAMETRISATIONS
from mjfim.model.paths import INERTIAL_FIELDS, OBJECTS, PATH

UNITS = {
    "mass": "kg",
    "pos": "m",
    "ipos": "m",
    "inertia": "kg m²",
    "size": "m",
    "gravity": "m/s²",
    "wind": "m/s",
    "density": "kg/m³",
    "viscosity": "Pa s",
    "rot": "rad",
    "delay": "s",
}


# per coordinate of a slide and of any other joint
JOINT_UNITS = {
    "damping": ("N s/m", "N m s/rad"),
    "frictionloss": ("N", "N m"),
    "armature": ("kg", "kg m²"),
    "stiffness": ("N/m", "N m/rad"),
    "springref": ("m", "rad"),
}


def unit_of(model: Any, path: str) -> str:
    """Unit of what a valid path names, empty where it depends on the model (gains, gears, tendons) or has none."""
    match = PATH.match(path)
    if match is None:
        return ""
    kind, field, name, index = (
        match["kind"],
        match["field"],
        match["name"] or "",
        int(match["index"] or 0),
    )
    if field in INERTIAL_FIELDS:
        chart, first, _ = INERTIAL_FIELDS[field]
        return INERTIA_PARAMETRISATIONS[chart].units[first + index]
    if kind == "initial":
        ident = mujoco.mj_name2id(model, OBJECTS["joint"], name)
        if field == "act" or ident < 0:
            return ""
        return _motion_unit(model, ident, index) + ("/s" if field == "qvel" else "")
    if kind != "joint":
        return UNITS.get(field, "")
    ident = mujoco.mj_name2id(model, OBJECTS["joint"], name)
    if ident < 0:
        return ""
    slide = int(model.jnt_type[ident]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
    return JOINT_UNITS[field][0 if slide else 1] if field in JOINT_UNITS else ""


def _motion_unit(model: Any, joint: int, index: int) -> str:
    kind = int(model.jnt_type[joint])
    linear = kind == int(mujoco.mjtJoint.mjJNT_SLIDE) or (
        kind == int(mujoco.mjtJoint.mjJNT_FREE) and index < 3
    )
    return "m" if linear else "rad"

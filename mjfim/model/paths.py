"""Parameter paths, `kind/name:field[index]` with MuJoCo's own field names, and the slots that they lead to."""

from __future__ import annotations

import re
from collections.abc import Collection, Sequence
from typing import Any

import mujoco
import numpy as np

from mjfim.errors import ExperimentError, unknown
from mjfim.model.targets import (
    InertiaField,
    InitialStateField,
    ModelField,
    OutputBiasField,
    OutputDelayField,
    RotationField,
    SpecField,
    TargetField,
)

PATH = re.compile(r"^(?P<kind>\w+)(?:/(?P<name>.+))?:(?P<field>\w+)(?:\[(?P<index>\d+)\])?$")
OBJECTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "joint": mujoco.mjtObj.mjOBJ_JOINT,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "sensor": mujoco.mjtObj.mjOBJ_SENSOR,
}


COUNTS = {"joint": "njnt", "actuator": "nactuator"}
# Path field -> array of MjModel. A joint's dof fields are written to each of its degrees of freedom.
FIELDS: dict[str, dict[str, str]] = {
    "body": {
        "mass": "body_mass",
        "pos": "body_pos",
        "ipos": "body_ipos",
        "inertia": "body_inertia",
        "gravcomp": "body_gravcomp",
    },
    "joint": {
        "damping": "dof_damping",
        "frictionloss": "dof_frictionloss",
        "armature": "dof_armature",
        "stiffness": "jnt_stiffness",
        "springref": "qpos_spring",
    },
    "actuator": {
        "gear": "actuator_gear",
        "gainprm": "actuator_gainprm",
        "biasprm": "actuator_biasprm",
        "dynprm": "actuator_dynprm",
    },
    "geom": {"friction": "geom_friction", "solref": "geom_solref"},
    "site": {"pos": "site_pos"},
    "tendon": {
        "stiffness": "tendon_stiffness",
        "damping": "tendon_damping",
        "frictionloss": "tendon_frictionloss",
        "armature": "tendon_armature",
        "springlength": "tendon_lengthspring",
    },
    "option": {
        "gravity": "gravity",
        "wind": "wind",
        "density": "density",
        "viscosity": "viscosity",
    },
}


# Path field -> (chart, first of its coordinates, how many)
INERTIAL_FIELDS = {
    "fullinertia": ("central", 4, 6),
    "firstmoment": ("barycentric", 1, 3),
    "origininertia": ("barycentric", 4, 6),
    "logcholesky": ("logcholesky", 0, 10),
}


COMPILED = {"geom": ("size", "pos", "mass", "density")}
SERVO = ("kp", "kv")
START_FIELDS = ("qpos", "qvel", "act")


def names_of(model: Any, kind: str) -> list[str]:
    """Names of all objects of a kind that have one."""
    count = getattr(model, COUNTS.get(kind, f"n{kind}"))
    names = (mujoco.mj_id2name(model, OBJECTS[kind], i) for i in range(count))
    return [n for n in names if n]


def fields_of(kind: str) -> list[str]:
    """Fields that a path of this kind may name."""
    extra = {
        "body": [*INERTIAL_FIELDS, "rot"],
        "site": ["rot"],
        "geom": list(COMPILED["geom"]),
        "actuator": list(SERVO),
        "initial": list(START_FIELDS),
        "output": ["bias", "delay"],
    }
    return [*FIELDS.get(kind, {}), *extra.get(kind, [])]


KINDS = (*FIELDS, "initial", "output")


def resolve(
    model: Any, path: str, outputs: Sequence[str] = (), decoration: Collection[str] = frozenset()
) -> TargetField:
    """What a path leads to. Raises ExperimentError listing the valid kinds, names, fields or indices.

    outputs: names of the measured columns, which `output/name:bias` may name
    decoration: geoms that neither collide nor give their body its inertia, and so need no compile
    """
    match = PATH.match(path)
    if match is None:
        raise ExperimentError(f"parameter path {path!r} is not of the form kind/name:field[index]")
    kind, name, field = match["kind"], match["name"] or "", match["field"]
    index = int(match["index"]) if match["index"] else 0
    if kind not in KINDS:
        raise ExperimentError(f"in parameter path {path!r}: {unknown('kind', kind, KINDS)}")
    if field not in fields_of(kind):
        raise ExperimentError(
            f"in parameter path {path!r}: {unknown(f'{kind} field', field, fields_of(kind))}"
        )
    if kind == "option":
        width = np.size(getattr(model.opt, FIELDS[kind][field]))
        return ModelField(
            FIELDS[kind][field], (_checked(path, index, width),), None, in_options=True
        )
    if kind == "output":
        return _output(path, name, field, outputs)
    if kind == "initial":
        return _initial(model, path, name, field, index)
    ident = mujoco.mj_name2id(model, OBJECTS[kind], name)
    if ident < 0:
        raise ExperimentError(
            f"in parameter path {path!r}: {unknown(kind, name, names_of(model, kind))}{_nameless(model, kind)}"
        )
    if field in INERTIAL_FIELDS:
        chart, first, width = INERTIAL_FIELDS[field]
        if not float(model.body_mass[ident]) > 0.0:
            raise ExperimentError(f"in parameter path {path!r}: body {name!r} has no mass")
        return InertiaField(ident, chart, first + _checked(path, index, width))
    if field == "rot":
        return RotationField(f"{kind}_quat", ident, _checked(path, index, 3))
    if field in COMPILED.get(kind, ()):
        index = _checked(path, index, 3 if field in ("size", "pos") else 1)
        if field == "size" and int(model.geom_dataid[ident]) >= 0:
            raise ExperimentError(
                f"in parameter path {path!r}: the size of a mesh or height field is not a number of the geom"
            )
        plain = field in ("size", "pos") and name in decoration
        return (
            ModelField(f"geom_{field}", (ident,), index)
            if plain
            else SpecField(kind, name, field, index)
        )
    if field in SERVO and kind == "actuator":
        return _servo(model, path, ident, field)
    return _plain(model, path, kind, field, ident, index)


def _nameless(model: Any, kind: str) -> str:
    """A hint where objects have no name."""
    nameless = int(getattr(model, COUNTS.get(kind, f"n{kind}"))) - len(names_of(model, kind))
    return f"; {nameless} more have no name: give them one in the MJCF" if nameless else ""


def _plain(model: Any, path: str, kind: str, field: str, ident: int, index: int) -> ModelField:
    array = FIELDS[kind][field]
    holder = getattr(model, array)
    column = _checked(path, index, holder.shape[1]) if holder.ndim == 2 else None
    if holder.ndim == 1:
        _checked(path, index, 1)
    if field == "springlength" and not path.endswith("]") and holder[ident, 0] == holder[ident, 1]:
        return ModelField(
            array, (ident,), 0, also=((array, ident, 1, 1.0),)
        )  # a rest length, not a range
    return ModelField(array, _rows(model, array, ident, path), column)


def _servo(model: Any, path: str, ident: int, field: str) -> ModelField:
    """Gain of a position or velocity servo together with its bias: kp moves gainprm[0] and biasprm[1], kv biasprm[2]."""
    gain, bias = float(model.actuator_gainprm[ident, 0]), model.actuator_biasprm[ident]
    kinds = (int(mujoco.mjtBias.mjBIAS_AFFINE), int(mujoco.mjtBias.mjBIAS_SO3))
    affine = int(model.actuator_biastype[ident]) in kinds
    if int(model.actuator_gaintype[ident]) == int(
        mujoco.mjtGain.mjGAIN_PID
    ):  # its own gain is the integral one
        return ModelField("actuator_biasprm", (ident,), {"kp": 1, "kv": 2}[field], factor=-1.0)
    if affine and field == "kp" and gain != 0.0 and bias[1] == -gain:
        return ModelField(
            "actuator_gainprm", (ident,), 0, also=(("actuator_biasprm", ident, 1, -1.0),)
        )
    if (
        affine and field == "kv" and gain != 0.0 and bias[1] == 0.0 and bias[2] == -gain
    ):  # a velocity servo
        return ModelField(
            "actuator_gainprm", (ident,), 0, also=(("actuator_biasprm", ident, 2, -1.0),)
        )
    if affine and field == "kv" and bias[1] == -gain:
        return ModelField("actuator_biasprm", (ident,), 2, factor=-1.0)
    raise ExperimentError(
        f"in parameter path {path!r}: the actuator is no {'position' if field == 'kp' else 'position or velocity'} servo; "
        "use gainprm[i] and biasprm[i]"
    )


def _output(path: str, name: str, field: str, outputs: Sequence[str]) -> TargetField:
    if field == "delay":
        if name:
            raise ExperimentError(
                f"in parameter path {path!r}: one delay lags all outputs; write 'output:delay'"
            )
        return OutputDelayField()
    if name not in outputs:
        raise ExperimentError(
            f"in parameter path {path!r}: {unknown('output', name, list(outputs))}"
        )
    return OutputBiasField(list(outputs).index(name))


def _initial(model: Any, path: str, name: str, field: str, index: int) -> TargetField:
    """Place of a start component in the tangent space (dq, dv, da)."""
    if field == "act":
        ident = mujoco.mj_name2id(model, OBJECTS["actuator"], name)
        count = int(model.actuator_actnum[ident]) if ident >= 0 else 0
        if count == 0:
            stateful = [
                n
                for n in names_of(model, "actuator")
                if model.actuator_actnum[model.actuator(n).id]
            ]
            raise ExperimentError(
                f"in parameter path {path!r}: {unknown('actuator with a state', name, stateful)}"
            )
        return InitialStateField(
            2 * model.nv + int(model.actuator_actadr[ident]) + _checked(path, index, count)
        )
    ident = mujoco.mj_name2id(model, OBJECTS["joint"], name)
    if ident < 0:
        raise ExperimentError(
            f"in parameter path {path!r}: {unknown('joint', name, names_of(model, 'joint'))}"
        )
    dof = int(model.jnt_dofadr[ident]) + _checked(path, index, joint_width(model, ident))
    return InitialStateField(dof + (model.nv if field == "qvel" else 0))


def joint_width(model: Any, joint: int) -> int:
    """Degrees of freedom of a joint."""
    return {int(mujoco.mjtJoint.mjJNT_FREE): 6, int(mujoco.mjtJoint.mjJNT_BALL): 3}.get(
        int(model.jnt_type[joint]), 1
    )


def _checked(path: str, index: int, width: int) -> int:
    if index >= width:
        raise ExperimentError(
            f"in parameter path {path!r}: index {index} is out of range; valid: 0 to {width - 1}"
        )
    return index


def _rows(model: Any, array: str, ident: int, path: str) -> tuple[int, ...]:
    if array.startswith("dof_"):
        first = int(model.jnt_dofadr[ident])
        return tuple(range(first, first + joint_width(model, ident)))
    if array == "qpos_spring":
        if int(model.jnt_type[ident]) < 2:
            raise ExperimentError(
                f"in parameter path {path!r}: springref exists on slide and hinge joints only"
            )
        return (int(model.jnt_qposadr[ident]),)
    if array == "actuator_gear":  # one row per force output
        first = int(model.actuator_outadr[ident])
        return tuple(range(first, first + int(model.actuator_outnum[ident])))
    return (ident,)

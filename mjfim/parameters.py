"""What can be identified: parameter paths, bounds, scale, prior, and the only writer into a model.

A path is `kind/name:field[index]` (or `option:field[index]`) with MuJoCo's own field names. Values are written into
private copies in place, followed by `mj_setConst`; tests hold the result against a recompile.
"""

from __future__ import annotations

import copy
import re
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Any

import mujoco
import numpy as np

from mjfim.errors import ExperimentError, unknown
from mjfim.quiet import quiet
from mjfim.trajectory import Array

PATH = re.compile(r"^(?P<kind>\w+)(?:/(?P<name>[^:]+))?:(?P<field>\w+)(?:\[(?P<index>\d+)\])?$")

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
    "body": {"mass": "body_mass", "pos": "body_pos", "ipos": "body_ipos", "inertia": "body_inertia"},
    "joint": {
        "damping": "dof_damping",
        "frictionloss": "dof_frictionloss",
        "armature": "dof_armature",
        "stiffness": "jnt_stiffness",
        "springref": "qpos_spring",
    },
    "actuator": {"gear": "actuator_gear", "gainprm": "actuator_gainprm", "biasprm": "actuator_biasprm"},
    "geom": {"friction": "geom_friction", "size": "geom_size", "pos": "geom_pos"},
    "site": {"pos": "site_pos"},
    "tendon": {"stiffness": "tendon_stiffness", "damping": "tendon_damping", "frictionloss": "tendon_frictionloss"},
    "option": {"gravity": "gravity"},
}
GEOMETRIC = {"pos", "ipos", "inertia", "mass"}


@dataclass(frozen=True)
class Target:
    """One number inside a model: it becomes `scale * theta_j + offset`."""

    path: str
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Parameter:
    """One unknown. Values in the raw unit of its targets.

    guess: where the design is made;  true: for simulated studies, or None;  bounds: (lower, upper)
    scale: the unit in which information about it is compared with the others;  prior: standard deviation, or None
    """

    name: str
    targets: tuple[Target, ...]
    guess: float
    true: float | None = None
    bounds: tuple[float, float] = (-np.inf, np.inf)
    scale: float = 1.0
    prior: float | None = None
    unit: str = ""


@dataclass(frozen=True)
class Slot:
    """A resolved target: rows of one MjModel array, and the column (None for one-dimensional arrays)."""

    array: str
    rows: tuple[int, ...]
    column: int | None
    in_options: bool = False

    def _holder(self, model: Any) -> Any:
        return getattr(model.opt if self.in_options else model, self.array)

    def read(self, model: Any) -> float:
        """Current value."""
        holder = self._holder(model)
        return float(holder[self.rows[0]] if self.column is None else holder[self.rows[0], self.column])

    def write(self, model: Any, value: float) -> None:
        """Set the value in place."""
        holder = self._holder(model)
        for row in self.rows:
            if self.column is None:
                holder[row] = value
            else:
                holder[row, self.column] = value


def names_of(model: Any, kind: str) -> list[str]:
    """Names of all objects of a kind that have one."""
    count = getattr(model, COUNTS.get(kind, f"n{kind}"))
    names = (mujoco.mj_id2name(model, OBJECTS[kind], i) for i in range(count))
    return [n for n in names if n]


def resolve(model: Any, path: str) -> Slot:
    """Slot of a path. Raises ExperimentError listing the valid kinds, names, fields or indices."""
    match = PATH.match(path)
    if match is None:
        raise ExperimentError(f"parameter path {path!r} is not of the form kind/name:field[index]")
    kind, name, field = match["kind"], match["name"], match["field"]
    index = int(match["index"]) if match["index"] else 0
    if kind not in FIELDS:
        raise ExperimentError(f"in parameter path {path!r}: {unknown('kind', kind, FIELDS)}")
    if field not in FIELDS[kind]:
        raise ExperimentError(f"in parameter path {path!r}: {unknown(f'{kind} field', field, FIELDS[kind])}")
    array = FIELDS[kind][field]
    if kind == "option":
        return Slot(array, (_checked(path, index, 3),), None, in_options=True)
    ident = mujoco.mj_name2id(model, OBJECTS[kind], name or "")
    if ident < 0:
        raise ExperimentError(f"in parameter path {path!r}: {unknown(kind, name or '', names_of(model, kind))}")
    holder = getattr(model, array)
    width = holder.shape[1] if holder.ndim == 2 else 1
    column = _checked(path, index, width) if holder.ndim == 2 else None
    if holder.ndim == 1:
        _checked(path, index, 1)
    return Slot(array, _rows(model, array, ident, path), column)


UNITS = {"mass": "kg", "pos": "m", "ipos": "m", "inertia": "kg m²", "size": "m", "gravity": "m/s²"}
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
    kind, field_name = match["kind"], match["field"]
    if kind != "joint":
        return UNITS.get(field_name, "")
    ident = mujoco.mj_name2id(model, OBJECTS["joint"], match["name"] or "")
    if ident < 0:
        return ""
    slide = int(model.jnt_type[ident]) == int(mujoco.mjtJoint.mjJNT_SLIDE)
    return JOINT_UNITS[field_name][0 if slide else 1] if field_name in JOINT_UNITS else ""


def _checked(path: str, index: int, width: int) -> int:
    if index >= width:
        raise ExperimentError(f"in parameter path {path!r}: index {index} is out of range; valid: 0 to {width - 1}")
    return index


def _rows(model: Any, array: str, ident: int, path: str) -> tuple[int, ...]:
    if array.startswith("dof_"):
        first = int(model.jnt_dofadr[ident])
        width = {0: 6, 1: 3}.get(int(model.jnt_type[ident]), 1)
        return tuple(range(first, first + width))
    if array == "qpos_spring":
        if int(model.jnt_type[ident]) < 2:
            raise ExperimentError(f"in parameter path {path!r}: springref exists on slide and hinge joints only")
        return (int(model.jnt_qposadr[ident]),)
    return (ident,)


def moved_bodies(parameters: Sequence[Parameter]) -> set[str]:
    """Names of bodies whose inertial frame a parameter may move (they must not be compiled as 'simple')."""
    matches = [PATH.match(t.path) for p in parameters for t in p.targets]
    return {m["name"] for m in matches if m and m["kind"] == "body" and m["field"] in GEOMETRIC and m["name"]}


@dataclass(frozen=True, eq=False)
class ParameterSet:
    """All parameters of an experiment, in the order of theta, resolved against a model."""

    parameters: tuple[Parameter, ...]
    slots: tuple[tuple[Slot, ...], ...]
    _cache: dict[str, Any] = field(default_factory=dict, repr=False)

    @staticmethod
    def build(parameters: Sequence[Parameter], model: Any) -> ParameterSet:
        """Resolve every target. Raises ExperimentError naming the parameter and the path."""
        slots: list[tuple[Slot, ...]] = []
        owner: dict[Slot, str] = {}
        for parameter in parameters:
            try:
                slots.append(tuple(resolve(model, t.path) for t in parameter.targets))
            except ExperimentError as error:
                raise ExperimentError(f"parameters.{parameter.name}: {error}") from None
            for target, slot in zip(parameter.targets, slots[-1], strict=True):
                if slot in owner:
                    taken = f"target {target.path!r} already belongs to parameters.{owner[slot]}"
                    raise ExperimentError(f"parameters.{parameter.name}: {taken}; one number takes one parameter")
                owner[slot] = parameter.name
        return ParameterSet(tuple(parameters), tuple(slots))

    def __len__(self) -> int:
        return len(self.parameters)

    def _column(self, pick: Callable[[Parameter], float]) -> Array:
        return np.array([pick(p) for p in self.parameters])

    @property
    def names(self) -> tuple[str, ...]:
        """p names."""
        return tuple(p.name for p in self.parameters)

    @property
    def guess(self) -> Array:
        """(p,) values at which the design is made."""
        return self._column(lambda p: p.guess)

    @property
    def true(self) -> Array:
        """(p,) true values, the guess where none is stated."""
        return self._column(lambda p: p.guess if p.true is None else p.true)

    @property
    def lower(self) -> Array:
        """(p,) lower bounds."""
        return self._column(lambda p: p.bounds[0])

    @property
    def upper(self) -> Array:
        """(p,) upper bounds."""
        return self._column(lambda p: p.bounds[1])

    @property
    def scale(self) -> Array:
        """(p,) units of comparison."""
        return self._column(lambda p: p.scale)

    @property
    def step(self) -> Array:
        """(p,) magnitude to which finite-difference steps are relative."""
        return np.where(self.guess != 0.0, np.abs(self.guess), self.scale)

    @property
    def prior_information(self) -> Array:
        """(p, p) information of the stated priors."""
        return np.diag(self._column(lambda p: 0.0 if p.prior is None else p.prior**-2))

    def write(self, model: Any, theta: Array) -> None:
        """Write theta: (p,) into a model that the caller owns, then recompute MuJoCo's derived constants."""
        for parameter, slots, value in zip(self.parameters, self.slots, theta, strict=True):
            for target, slot in zip(parameter.targets, slots, strict=True):
                slot.write(model, target.scale * float(value) + target.offset)
                if slot.array == "body_ipos":
                    model.body_sameframe[slot.rows[0]] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        with quiet():
            mujoco.mj_setConst(model, self._scratch(model))

    def _scratch(self, model: Any) -> Any:
        """Scratch data for `mj_setConst`, shared by all copies of one model."""
        if "data" not in self._cache:
            self._cache["data"] = mujoco.MjData(model)
        return self._cache["data"]

    def model(self, base: Any, theta: Array) -> Any:
        """A private copy of the base model with theta written into it."""
        own = copy.copy(base)
        self.write(own, theta)
        return own

"""The user's MJCF with other numbers in it: each parameter changes the attributes that say it, and nothing else."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ModelError
from mjfim.model.parameters import ParameterSet, Target
from mjfim.model.paths import OBJECTS, PATH
from mjfim.model.targets import InertiaField, ModelField, RotationField, SpecField, TargetField
from mjfim.output.mjcf.actuators import ARRAYS, wordings
from mjfim.output.mjcf.document import Sheet, close, digits
from mjfim.output.mjcf.inertials import weigh

WHOLE = {
    "pos": 3,
    "gravity": 3,
    "wind": 3,
}  # attributes that MuJoCo reads only with all of their numbers
MASS = ("mass", "ipos", "inertia")
LONG = {
    int(mujoco.mjtGeom.mjGEOM_CAPSULE): 1,
    int(mujoco.mjtGeom.mjGEOM_CYLINDER): 1,
}  # column of the half length, else 2


# What the compiler may derive from other numbers: kind -> field -> array
DERIVED = {
    "actuator": {"gainprm": "actuator_gainprm", "biasprm": "actuator_biasprm"},
    "joint": {"stiffness": "jnt_stiffness", "damping": "dof_damping"},
    "tendon": {"springlength": "tendon_lengthspring"},
}


APART = 1e-12  # relative: derived numbers farther apart than this are stated


class Retouch:
    """Changes to an MJCF that turn what it compiles to into a wanted model.

    spec, old: what the text says and compiles to. What the text cannot say raises ModelError, as a clause that says why.
    """

    def __init__(self, sheet: Sheet, spec: Any, old: Any, wanted: Any) -> None:
        self.sheet, self._spec, self._old, self._wanted = sheet, spec, old, wanted
        self._option: dict[str, str] = {}

    def write(self, parameters: ParameterSet, theta: Array) -> None:
        """Say theta: (p,), with which the wanted model was made. Called once."""
        weighed: dict[str, bool] = {}
        for parameter, slots, value in zip(
            parameters.parameters, parameters.fields, theta, strict=True
        ):
            if parameter.function is not None:
                raise ModelError(f"parameters.{parameter.name} is a Python function of the MjSpec")
            for target, slot in zip(parameter.targets, slots, strict=True):
                kind, name, field = _parts(target)
                if isinstance(slot, InertiaField) or (kind == "body" and field in MASS):
                    weighed[name] = weighed.get(name, False) or isinstance(slot, InertiaField)
                else:
                    self._target(
                        kind, name, field, slot, target.scale * float(value) + target.offset
                    )
        for name, charted in weighed.items():
            weigh(self.sheet, name, self._old, self._wanted, charted)
        if self._option:
            self.sheet.insert(0, "option", self._option)

    def settle(self, found: Any) -> list[str]:
        """State what the compiler derives anew from the changed numbers. found: what the text compiles to.

        Returns what was stated, `kind 'name'`.
        """
        self._old, stated = found, []
        for kind, fields in DERIVED.items():
            for field, array in fields.items():
                rows = (
                    found.jnt_dofadr
                    if array.startswith("dof_")
                    else range(len(getattr(found, array)))
                )
                for ident, row in enumerate(rows):
                    own, other = (
                        np.asarray(getattr(m, array)[int(row)]) for m in (found, self._wanted)
                    )
                    if np.allclose(own, other, rtol=APART, atol=0.0):
                        continue
                    name = mujoco.mj_id2name(found, OBJECTS[kind], ident)
                    if not name:
                        raise ModelError(
                            f"MuJoCo derives the {field} of a {kind} anew that has no name"
                        )
                    self._number(kind, name, field, ModelField(array, (int(row),), None))
                    stated.append(f"{kind} {name!r}")
        return list(dict.fromkeys(stated))

    def _target(self, kind: str, name: str, field: str, slot: TargetField, value: float) -> None:
        if isinstance(slot, SpecField) and field in (
            "mass",
            "density",
        ):  # the compiled model no longer has them
            old = float(getattr(self._spec.geom(name), field))
            if not close(np.array(old), np.array(value)):
                self.sheet.numbers(self.sheet.place("geom", name), field, old, value)
        elif kind == "geom" and field in ("pos", "size"):
            self._extent(name)
        elif isinstance(slot, RotationField):
            self._turn(kind, name)
        elif isinstance(slot, ModelField):
            self._number(kind, name, field, slot)

    def _number(self, kind: str, name: str, field: str, slot: ModelField) -> None:
        """A number that the MJCF has under the name of the path's field, or an actuator's gain."""
        if slot.array.removeprefix("actuator_") in ARRAYS:
            self._gain(name)
            return
        if slot.in_options:
            old, new = (
                np.atleast_1d(getattr(m.opt, slot.array)) for m in (self._old, self._wanted)
            )
        else:
            old, new = (
                np.atleast_1d(getattr(m, slot.array)[slot.rows[0]])
                for m in (self._old, self._wanted)
            )
        if close(old, new).all():
            return
        if kind == "option":
            self._state(field, old, new)
            return
        tag, whole = self.sheet.place(kind, name), WHOLE.get(field, 1)
        if field == "pos":
            self._refuse_elsewhere(tag, kind, name)
        elif field == "springref" and self._spec.compiler.degree:
            if self._spec.joint(name).type == mujoco.mjtJoint.mjJNT_HINGE:
                old, new = np.rad2deg(old), np.rad2deg(new)
        elif field == "springlength":  # one rest length stands for both ends of the range
            whole = 1 if new[0] == new[1] and len(self.sheet.typed(tag, field)) < 2 else 2
            old, new = old[:whole], new[:whole]
        self.sheet.numbers(tag, field, old, new, whole)

    def _state(self, field: str, old: Array, new: Array) -> None:
        """Write into the `<option>` that says a field last, else into the last one; one is made where there is none."""
        found = self.sheet.top("option")
        if found:
            tag = next(
                (i for i in reversed(found) if self.sheet.attribute(i, field) is not None),
                found[-1],
            )
            self.sheet.numbers(tag, field, old, new, WHOLE.get(field, 1))
        else:
            self._option[field] = digits(*new)

    def _gain(self, name: str) -> None:
        """What makes an actuator's force: gain, bias and dynamics, in the words of its element."""
        i = int(self._old.actuator(name).id)
        old, wanted = (
            np.concatenate([getattr(m, f"actuator_{a}")[i] for a in ARRAYS])
            for m in (self._old, self._wanted)
        )
        if close(old, wanted).all():
            return
        tag = self.sheet.place("actuator", name)
        element = self.sheet.tags[tag].name
        if element == "motor":  # its gain is 1; a <general> is a motor that may have another
            self.sheet.rename(tag, "general")
        for words in wordings(element, self._old, self._wanted, i):
            self.sheet.numbers(tag, words.attribute, words.old, words.new, words.whole)

    def _turn(self, kind: str, name: str) -> None:
        """Orientation of a body or site."""
        old, new = (getattr(m, kind)(name).quat for m in (self._old, self._wanted))
        if not close(old, new, 1.0).all():
            tag = self.sheet.place(kind, name)
            self._refuse_elsewhere(tag, kind, name)
            self.sheet.say(tag, "quat", digits(*new))

    def _extent(self, name: str) -> None:
        """Place and size of a geom, or the end points that give both."""
        old, new, stated = self._old.geom(name), self._wanted.geom(name), self._spec.geom(name)
        moved, radius = new.pos - old.pos, float(self._old.geom_rbound[old.id])
        stays = close(old.pos, new.pos, radius).all()
        if stays and close(old.size, new.size).all():
            return
        tag = self.sheet.place("geom", name)
        if not stays:
            self._refuse_elsewhere(tag, "geom", name)
        if not np.isfinite(stated.fromto[0]):
            self.sheet.numbers(tag, "size", old.size, new.size)
            place = (
                stated.pos + moved if stated.meshname else new.pos
            )  # the compiler adds the mesh's own offset
            self.sheet.numbers(
                tag, "pos", stated.pos if stated.meshname else old.pos, place, 3, radius
            )
            return
        along = LONG.get(int(stated.type), 2)
        ends = np.array(stated.fromto).reshape(2, 3)
        middle = ends.mean(axis=0)
        placed = middle + moved + (ends - middle) * (new.size[along] / old.size[along])
        self.sheet.numbers(tag, "size", old.size[:1], new.size[:1])
        self.sheet.numbers(tag, "fromto", ends.ravel(), placed.ravel(), 6, radius)

    def _refuse_elsewhere(self, tag: int, kind: str, name: str) -> None:
        """Raise where a place is not said in the coordinates of the body by `pos` and `quat`."""
        if self.sheet.tags[self.sheet.tags[tag].parent].name == "frame":
            raise ModelError(f"{kind} {name!r} stands in a <frame>")
        if kind == "site" and np.isfinite(self._spec.site(name).fromto[0]):
            raise ModelError(f"site {name!r} is given by its end points")


def _parts(target: Target) -> tuple[str, str, str]:
    """Kind, name and field of a path."""
    match = PATH.match(target.path)
    if match is None:
        raise ValueError(
            f"parameter path {target.path!r} is not of the form kind/name:field[index]"
        )
    return match["kind"], match["name"] or "", match["field"]

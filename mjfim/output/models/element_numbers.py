"""Numbers of the elements of an MJCF, which are stated where they differ from a wanted model."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import scipy
from lxml import etree

from mjfim.arrays import Array
from mjfim.errors import ModelError, listed
from mjfim.model.elements import element_count, element_name
from mjfim.model.inertia import body_inertia
from mjfim.model.paths import MODEL_ARRAYS, POLYNOMIAL_ARRAYS
from mjfim.output.models.model_xml import (
    ALTERNATIVES,
    ROUNDING,
    ModelXml,
    add_element,
    child,
    floats,
    nearly_equal,
    own_child,
    parent_of,
    same_inertia,
    set_numbers,
)

# By kind of element, the arrays of MjModel whose numbers its attributes state, and those of an
# <inertial>.
ARRAYS: dict[str, dict[str, str]] = {
    "geom": {"pos": "geom_pos", "quat": "geom_quat", "size": "geom_size", **MODEL_ARRAYS["geom"]},
    "pair": MODEL_ARRAYS["pair"],
    "body": {"pos": "body_pos", "quat": "body_quat", "gravcomp": "body_gravcomp"},
    "site": {"quat": "site_quat", **MODEL_ARRAYS["site"]},
    "joint": {"pos": "jnt_pos", "axis": "jnt_axis", **MODEL_ARRAYS["joint"]},
    "tendon": MODEL_ARRAYS["tendon"],
    "actuator": MODEL_ARRAYS["actuator"],
}
INERTIAL = {
    "pos": "body_ipos",
    "mass": "body_mass",
    "quat": "body_iquat",
    "diaginertia": "body_inertia",
}

# Fewest numbers of the attributes that MuJoCo takes as a whole only.
LEAST = {"pos": 3, "axis": 3, "quat": 4, "diaginertia": 3, "gravity": 3, "wind": 3}

# Numbers that determine the force of an actuator. By element and attribute, where each number of
# the attribute stands among them: array, column and sign. A <general> states the arrays.
FORCE = ("gainprm", "biasprm", "dynprm")
Places = tuple[tuple[str, int, float], ...]
KP: Places = (("gainprm", 0, 1.0), ("biasprm", 1, -1.0))
KV: Places = (("biasprm", 2, -1.0),)
LUGRE = (("dynprm", 5), ("dynprm", 6), ("biasprm", 3), ("biasprm", 4), ("biasprm", 5))
SHORTHANDS: dict[str, dict[str, tuple[Places, ...]]] = {
    "position": {"kp": (KP,), "kv": (KV,), "timeconst": ((("dynprm", 0, 1.0),),)},
    "intvelocity": {"kp": (KP,), "kv": (KV,)},
    "velocity": {"kv": ((("gainprm", 0, 1.0), ("biasprm", 2, -1.0)),)},
    "damper": {"kv": ((("gainprm", 2, -1.0),),)},
    "dcmotor": {
        "resistance": ((("gainprm", 0, 1.0),),),
        "motorconst": ((("gainprm", 1, 1.0),),),
        "lugre": tuple(((array, column, 1.0),) for array, column in LUGRE),
    },
}

# Kinds whose numbers are compared in each round: those of inertias may follow from geoms, and
# others from inertias.
ROUNDS = (("geom",), *(tuple(ARRAYS),) * 4)


def state_differences(
    xml: ModelXml, compiled: tuple[Any, Any], wanted: Any, *, names_needed: bool = True
) -> None:
    """State the numbers of all elements that differ from those of a wanted model.

    Args:
        xml: The text.
        compiled: Its MjSpec and MjModel.
        wanted: The wanted model.
        names_needed: Whether a difference of an element without a name is a fault.

    Raises:
        ModelError: The text cannot state a number. The message is a clause.
    """
    for kinds in ROUNDS:
        spec, found = compiled
        statement = _Statement(xml, spec, found, wanted)
        for kind in kinds:
            for i in range(element_count(found, kind)):
                if names_needed or element_name(found, kind, i):
                    statement.state(kind, i)
        if len(kinds) > 1:
            statement.state_options()
        if statement.is_changed:
            compiled = xml.compiled()


def differ_in_inertia(a: Any, b: Any, body: int, tolerance: float) -> bool:
    """Whether a body has different inertias in two models, by a share of its mass and size."""
    pairs = [(getattr(a, array)[body], getattr(b, array)[body]) for array in INERTIAL.values()]
    if all(np.array_equal(*pair) for pair in pairs):
        return False
    return not same_inertia(body_inertia(a, body), body_inertia(b, body), tolerance)


class _Statement:
    """States in a text those numbers of a wanted model that differ from its own.

    Attributes:
        is_changed: Whether the text has changed.
    """

    def __init__(self, xml: ModelXml, spec: Any, found: Any, wanted: Any) -> None:
        self.is_changed = False
        self._xml = xml
        self._spec = spec
        self._found = found
        self._wanted = wanted

    def state(self, kind: str, i: int) -> None:
        """State the numbers of the element of a kind with a number."""
        before, after = (_numbers(model, kind, i) for model in (self._found, self._wanted))
        differing = [name for name in before if not nearly_equal(before[name], after[name]).all()]
        is_moved = kind == "body" and differ_in_inertia(self._found, self._wanted, i, ROUNDING)
        if not differing and not is_moved:
            return

        name = element_name(self._found, kind, i)
        if not name:
            raise ModelError(f"a {kind} that has no name would state {listed(differing)}")
        self.is_changed = True
        element = self._xml.named(kind, name)
        if is_moved:
            self._state_inertial(element, i)
        if kind == "actuator" and element.tag != "general":
            self._state_force(element, before, after)
            differing = [each for each in differing if each not in FORCE]

        if kind == "geom" and "fromto" in element.attrib:
            differing = self._without_end_points(element, i, before, after) or differing
        for attribute in differing:
            self._set(element, attribute, before[attribute], after[attribute])

    def state_options(self) -> None:
        """State the options that differ, where the text states them last."""
        for field in MODEL_ARRAYS["option"]:
            before, after = (
                np.atleast_1d(getattr(model.opt, field)) for model in (self._found, self._wanted)
            )
            if not nearly_equal(before, after).all():
                self.is_changed = True
                options = self._xml.sections("option") or [child(self._xml.root, "option")]
                stating = [option for option in options if field in option.attrib]
                self._set([*options, *stating][-1], field, before, after)

    def _set(self, element: Any, attribute: str, before: Array, after: Array) -> None:
        """State numbers in the unit and the frame of an attribute."""
        least = LEAST.get(attribute, 1)
        if attribute == "springref" and self._spec.compiler.degree:
            kind = self._spec.joint(element.get("name")).type
            factor = np.rad2deg(1.0) if kind == mujoco.mjtJoint.mjJNT_HINGE else 1.0
            before, after = factor * before, factor * after
        elif attribute == "springlength":
            # One rest length sets both ends of the range.
            is_range = after[0] != after[1] or " " in element.get(attribute, "").strip()
            least = 2 if is_range else 1
            before, after = before[:least], after[:least]
        elif element.tag == "geom" and attribute == "pos" and element.get("mesh"):
            # The compiler adds the offset of a mesh to its position.
            stated = self._spec.geom(element.get("name")).pos
            before, after = stated, stated + (after - before)
        elif attribute in ("pos", "quat"):
            before, after = (_in_frames(element, attribute, each) for each in (before, after))
        set_numbers(element, attribute, before, after, least)

    def _without_end_points(
        self, element: Any, geom: int, before: dict[str, Array], after: dict[str, Array]
    ) -> list[str]:
        """Replace the end points of a geom whose place or length changes; what is to be stated."""
        is_radius = np.array_equal(before["size"][1:], after["size"][1:])
        if is_radius and nearly_equal(before["pos"], after["pos"]).all():
            return []
        del element.attrib["fromto"]
        after["quat"] = self._wanted.geom_quat[geom]
        before["pos"], before["quat"] = np.full(3, np.nan), np.full(4, np.nan)
        before["size"] = np.where(after["size"] > 0.0, np.nan, after["size"])
        return list(after)

    def _state_inertial(self, element: Any, body: int) -> None:
        """State the inertia of a body by its principal moments and axes, which sensors may read."""
        inertial = own_child(element, "inertial")
        if inertial is None:
            inertial = add_element(element, "inertial", first=True)
        has_axes = "diaginertia" in inertial.attrib
        for attribute, array in INERTIAL.items():
            before, after = (
                np.atleast_1d(getattr(model, array)[body]) for model in (self._found, self._wanted)
            )
            known = before if has_axes else np.full(len(after), np.nan)
            set_numbers(inertial, attribute, known, after, len(after))

    def _state_force(self, element: Any, before: dict[str, Array], after: dict[str, Array]) -> None:
        """State gain, bias and dynamics of an actuator by its attributes, or make it a <general>.

        MuJoCo prints every actuator as one, which then states the numbers in the next round.
        """
        changed = {
            (array, int(column))
            for array in FORCE
            for column in np.flatnonzero(~nearly_equal(before[array], after[array]))
        }
        for attribute, numbers in SHORTHANDS.get(element.tag, {}).items():
            places = {(array, column) for number in numbers for array, column, _ in number}
            values = [{s * after[array][i] for array, i, s in number} for number in numbers]
            if places & changed and all(len(each) == 1 for each in values):
                old = [s * before[array][i] for (array, i, s), *_ in numbers]
                new = [each.pop() for each in values]
                set_numbers(element, attribute, np.array(old), np.array(new), len(new))
                changed -= places
        if changed:
            printed = etree.fromstring(self._spec.to_xml().encode())
            (general,) = printed.xpath("//actuator/*[@name=$name]", name=element.get("name"))
            state_as_general(element, general, general)


def state_as_general(element: Any, printed: Any, before: Any) -> None:
    """State an actuator as a <general>, as MuJoCo prints it.

    Args:
        element: The actuator of the user's text.
        printed: The element that MuJoCo prints for it.
        before: The same before a change; the user's spelling of what has not changed stays.
    """
    own = {
        key: text
        for key, text in element.attrib.items()
        if key in printed.attrib and before.get(key) == printed.get(key)
    }
    element.tag = printed.tag
    element.attrib.clear()
    element.attrib.update({**printed.attrib, **own})


def _numbers(model: Any, kind: str, i: int) -> dict[str, Array]:
    """Numbers of an element by the attribute that states them."""
    found = {}
    for attribute, array in ARRAYS[kind].items():
        # A joint has the number of its first degree of freedom for all of them.
        row = i
        if array.startswith("dof_"):
            row = model.jnt_dofadr[i]
        elif array.startswith("qpos_"):
            row = model.jnt_qposadr[i]
        found[attribute] = np.atleast_1d(getattr(model, array)[row])
        if kind == "joint" and attribute in POLYNOMIAL_ARRAYS:
            higher = getattr(model, POLYNOMIAL_ARRAYS[attribute])[row]
            found[attribute] = np.append(found[attribute], higher)
    return found


def _in_frames(element: Any, attribute: str, numbers: Array) -> Array:
    """Express a position or an orientation in the body by the <frame>s around the element."""
    frames = []
    frame = parent_of(element)
    while frame.tag == "frame":
        frames.append(frame)
        frame = parent_of(frame)
    for each in reversed(frames):
        if set(ALTERNATIVES["quat"]) & set(each.attrib):
            raise ModelError(f"{element.tag} {element.get('name')!r} is inside a turned <frame>")
        back = scipy.spatial.transform.Rotation.from_quat(
            floats(each.get("quat", "1 0 0 0")), scalar_first=True
        ).inv()
        if attribute == "pos":
            numbers = back.apply(numbers - floats(each.get("pos", "0 0 0")))
        elif np.isfinite(numbers).all():
            turn = back * scipy.spatial.transform.Rotation.from_quat(numbers, scalar_first=True)
            numbers = turn.as_quat(scalar_first=True)
    return numbers

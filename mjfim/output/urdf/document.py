"""The text of a URDF, in which inertias of links and friction of joints are changed.

Each value changes only the attributes that state it, and other numbers keep their spelling.
"""

from __future__ import annotations

import os
from pathlib import Path

import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.errors import ModelError
from mjfim.model.inertia import (
    INERTIA_COLUMNS,
    INERTIA_ROWS,
    BodyInertia,
    from_barycentric,
    to_barycentric,
)
from mjfim.output.mjcf.document import all_digits, nearly_equal
from mjfim.output.mjcf.inertials import rounded_entries
from mjfim.output.mjcf.xml_edit import XmlText

# Attributes of <inertia>, in the order of the entries of an inertia matrix.
ENTRIES = ("ixx", "iyy", "izz", "ixy", "ixz", "iyz")

# Changes below this multiple of the size of a body are rounding.
MAGNITUDE_FACTOR = 10.0

# Smallest second moment over the largest one that is rounding.
MOMENT_ROUNDING = 1e-9


class UrdfDocument:
    """Text of a URDF with pending edits.

    Attributes:
        text: The text.
        links: Index of the tag of each `<link>` by its name.
        joints: Index of the tag of each `<joint>` by its name.
    """

    def __init__(self, contents: bytes) -> None:
        """Parse a URDF.

        Args:
            contents: The URDF in UTF-8.

        Raises:
            ModelError: The text is no well-formed XML, or no URDF. The message is a clause.
        """
        self.text = XmlText(contents)
        if self.text.tags[0].name != "robot":
            raise ModelError(f"the model is no URDF but <{self.text.tags[0].name}>")
        self.links = self._named("link")
        self.joints = self._named("joint")

    def inertia(self, link: str) -> BodyInertia | None:
        """Inertia that a link states, in the axes of the link.

        Args:
            link: Name of the link.

        Returns:
            The inertia without that of other links; None where the link states none.
        """
        inertial = self._child(self.links[link], "inertial")
        if inertial is None:
            return None
        R = self._rotation(inertial)
        matrix = np.zeros((3, 3))
        entries = self._entries(inertial)
        matrix[INERTIA_ROWS, INERTIA_COLUMNS] = entries
        matrix[INERTIA_COLUMNS, INERTIA_ROWS] = entries
        mass = self._numbers(self._child(inertial, "mass"), "value", np.zeros(1))
        com = self._numbers(self._child(inertial, "origin"), "xyz", np.zeros(3))
        return BodyInertia(mass=float(mass[0]), com=com, inertia=R @ matrix @ R.T)

    def change_inertia(self, link: str, before: BodyInertia, after: BodyInertia) -> None:
        """Change the inertia of a link, to which others may be fixed.

        The other links keep their inertias, so that the change of the whole is that of this link.

        Args:
            link: Name of the link.
            before: Inertia of the link and of all links that are merged with it.
            after: The wanted one.

        Raises:
            ModelError: The link cannot state it. The message is a clause.
        """
        own = self.inertia(link)
        if own is None:
            self._insert_inertial(link, after)
            return

        # A link with which no other one is merged gets exactly the wanted inertia.
        if _is_same(own, before):
            new = after
        else:
            change = to_barycentric(after) - to_barycentric(before)
            new = _physical(link, to_barycentric(own) + change)
        self._write_inertia(link, own, new)

    def change_friction(self, joint: str, damping: float, friction: float) -> None:
        """Change viscous and dry friction of a joint.

        Args:
            joint: Name of the joint.
            damping: Viscous friction [N m s/rad or N s/m].
            friction: Dry friction [N m or N].
        """
        tag = self.joints[joint]
        dynamics = self._child(tag, "dynamics")
        wanted = {"damping": damping, "friction": friction}
        if dynamics is None:
            stated = {name: all_digits(value) for name, value in wanted.items() if value != 0.0}
            self.text.insert_child(tag, "dynamics", stated)
            return
        for name, value in wanted.items():
            old = self._numbers(dynamics, name, np.zeros(1))
            if not nearly_equal(old, np.array([value])).all():
                self.text.set(dynamics, name, all_digits(value))

    def relocate(self, source: Path, target: Path, *, needs_meshes: bool) -> None:
        """Let a URDF of one folder find its meshes from another folder.

        MuJoCo looks for a mesh in the folder that the extension `<mujoco>` states, or else in that
        of the URDF. With `strippath`, which names such as `package://arm/link.stl` need, it leaves
        out the folders of the name.

        Args:
            source: Folder from which the URDF finds them now.
            target: Folder of the new file.
            needs_meshes: Whether MuJoCo reads meshes.
        """
        meshes = [i for i, tag in enumerate(self.text.tags) if tag.name == "mesh"]
        if source == target or not meshes:
            return

        extension = self._child(0, "mujoco")
        compiler = None if extension is None else self._child(extension, "compiler")
        stated = None if compiler is None else self.text.attribute(compiler, "meshdir")
        strips = compiler is not None and self.text.attribute(compiler, "strippath") == "true"

        # Names are relative to the URDF, for all programs alike, unless MuJoCo needs a folder.
        if stated is None and not strips:
            for tag in meshes:
                name = self.text.attribute(tag, "filename") or ""
                if (source / name).is_file():
                    self.text.set(tag, "filename", _relocated(name, source, target))
        elif stated is not None or needs_meshes:
            self._state_mesh_folder(_relocated(stated or "", source, target), extension, compiler)

    def _state_mesh_folder(self, folder: str, extension: int | None, compiler: int | None) -> None:
        """State the folder in which MuJoCo looks for meshes.

        Args:
            folder: The folder.
            extension: Index of `<mujoco>`, or None.
            compiler: Index of its `<compiler>`, or None.
        """
        if compiler is not None:
            self.text.set(compiler, "meshdir", folder)
        elif extension is not None:
            self.text.insert_child(extension, "compiler", {"meshdir": folder})
        else:
            self.text.insert_parent(0, "mujoco", [("compiler", {"meshdir": folder})])

    def edited(self) -> bytes:
        """The text with all edits."""
        return self.text.edited()

    # ---- parts of the text

    def _named(self, element: str) -> dict[str, int]:
        """Indices of the children of the root with the name of an element, by their `name`."""
        return {
            tag.attributes["name"]: i
            for i, tag in enumerate(self.text.tags)
            if tag.name == element and tag.parent == 0 and "name" in tag.attributes
        }

    def _child(self, parent: int, name: str) -> int | None:
        """Index of the first child with a name; None if there is none."""
        for i, tag in enumerate(self.text.tags):
            if tag.parent == parent and tag.name == name:
                return i
        return None

    def _numbers(self, tag: int | None, attribute: str, default: Array) -> Array:
        """Numbers of an attribute, or the default of the URDF."""
        value = None if tag is None else self.text.attribute(tag, attribute)
        return default if value is None else np.array([float(number) for number in value.split()])

    def _entries(self, inertial: int) -> Array:
        """(6,) entries of the inertia matrix as stated, in the axes of the inertial frame."""
        tag = self._child(inertial, "inertia")
        zero = np.zeros(1)
        return np.array([self._numbers(tag, name, zero)[0] for name in ENTRIES])

    def _rotation(self, inertial: int) -> Array:
        """(3, 3) rotation from the axes of the inertial frame to those of the link."""
        angles = self._numbers(self._child(inertial, "origin"), "rpy", np.zeros(3))
        rotation = scipy.spatial.transform.Rotation.from_euler("xyz", angles)
        return np.asarray(rotation.as_matrix(), dtype=np.float64)

    # ---- inertias

    def _write_inertia(self, link: str, old: BodyInertia, new: BodyInertia) -> None:
        """Write an inertia in the axes in which the link states its present one."""
        inertial = self._child(self.links[link], "inertial")
        assert inertial is not None
        radius = MAGNITUDE_FACTOR * old.gyration_radius if old.mass > 0.0 else 0.0
        trace = MAGNITUDE_FACTOR * float(np.trace(old.inertia))

        if not nearly_equal(np.array(old.mass), np.array(new.mass)):
            self._set(inertial, "mass", "value", all_digits(new.mass))
        self._write_com(inertial, old.com, new.com, radius)

        R = self._rotation(inertial)
        entries = rounded_entries(R.T @ new.inertia @ R)
        stated = self._entries(inertial)
        for name, before, after in zip(ENTRIES, stated, entries, strict=True):
            if not nearly_equal(np.array(before), np.array(after), trace):
                self._set(inertial, "inertia", name, all_digits(after))

    def _write_com(self, inertial: int, old: Array, new: Array, radius: float) -> None:
        """Write the centre of mass; coordinates that do not change keep their spelling."""
        is_same = nearly_equal(old, new, radius)
        if is_same.all():
            return

        origin = self._child(inertial, "origin")
        value = None if origin is None else self.text.attribute(origin, "xyz")
        written = (value or "0 0 0").split()
        numbers = [
            written[i] if is_same[i] else all_digits(float(coordinate))
            for i, coordinate in enumerate(new)
        ]
        self._set(inertial, "origin", "xyz", " ".join(numbers))

    def _set(self, parent: int, element: str, attribute: str, value: str) -> None:
        """Set an attribute of a child, which is added if it is missing."""
        tag = self._child(parent, element)
        if tag is None:
            self.text.insert_child(parent, element, {attribute: value})
        else:
            self.text.set(tag, attribute, value)

    def _insert_inertial(self, link: str, inertia: BodyInertia) -> None:
        """Give a link an inertia that came from its geometry before."""
        entries = rounded_entries(inertia.inertia)
        written = {name: all_digits(value) for name, value in zip(ENTRIES, entries, strict=True)}
        children = [
            ("origin", {"xyz": all_digits(*inertia.com)}),
            ("mass", {"value": all_digits(inertia.mass)}),
            ("inertia", written),
        ]
        self.text.insert_parent(self.links[link], "inertial", children)


def _is_same(a: BodyInertia, b: BodyInertia) -> bool:
    """Whether two inertias differ only by the rounding of MuJoCo's compiler."""
    radius = max(a.gyration_radius, b.gyration_radius) if min(a.mass, b.mass) > 0.0 else 0.0
    trace = float(np.trace(b.inertia))
    return (
        abs(a.mass - b.mass) <= MOMENT_ROUNDING * max(a.mass, b.mass)
        and bool((np.abs(a.com - b.com) <= MOMENT_ROUNDING * radius).all())
        and bool((np.abs(a.inertia - b.inertia) <= MOMENT_ROUNDING * trace).all())
    )


def _physical(link: str, values: Array) -> BodyInertia:
    """Inertia with barycentric coordinates: (10,).

    Raises ModelError if what remains for a link is no inertia of a body.
    """
    if values[0] > 0.0:
        inertia = from_barycentric(values)
        moments = np.linalg.eigvalsh(inertia.second_moments)
        if moments[0] >= -MOMENT_ROUNDING * abs(moments[2]):
            return inertia
    raise ModelError(
        f"the links that are fixed to link {link!r} have more mass or inertia than was identified "
        "for all of them together"
    )


def _relocated(name: str, source: Path, target: Path) -> str:
    """Name, relative to `target`, of a file that is named relative to `source`."""
    if Path(name).is_absolute():
        return name
    return Path(os.path.relpath(source / name, target)).as_posix()

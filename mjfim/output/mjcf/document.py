"""An MJCF text under change: where its named elements stand, and numbers written into their attributes by all digits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ModelError
from mjfim.output.mjcf.xml_edit import Markup, Tag

SAME = 1e-14  # relative: numbers nearer than this are one
TREE = {"body": "body", "joint": "joint", "freejoint": "joint", "geom": "geom", "site": "site"}
SECTIONS = ("actuator", "tendon")
ORIENTATIONS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")
# Setting one takes the others out: they say the same, and MuJoCo would refuse or prefer them.
INSTEAD = {
    "quat": ORIENTATIONS[1:],
    "fullinertia": ("diaginertia", *ORIENTATIONS),
    "diaginertia": ("fullinertia",),
    "kv": ("dampratio",),
    "area": ("diameter",),
    "stiffness": ("springdamper",),
    "damping": ("springdamper",),
}


class Sheet(Markup):
    """The text of an MJCF. Raises ModelError, as a clause that says why, where the text is none."""

    def __init__(self, text: bytes) -> None:
        super().__init__(text)
        if self.tags[0].name != "mujoco":
            raise ModelError(f"the model is no MJCF but <{self.tags[0].name}>")
        self._places = dict(_named(self.tags))

    def place(self, kind: str, name: str) -> int:
        """Index of the tag of a named element. Raises ModelError where it stands elsewhere or is generated."""
        if (kind, name) not in self._places:
            raise ModelError(
                f"{kind} {name!r} does not stand in the MJCF itself (<include>, <attach>, <replicate> or the like makes it)"
            )
        return self._places[kind, name]

    def top(self, name: str) -> list[int]:
        """Indices of the tags of a name right inside `<mujoco>`."""
        return [i for i, tag in enumerate(self.tags) if tag.name == name and tag.parent == 0]

    def typed(self, tag: int, attribute: str) -> list[str]:
        """The numbers of an attribute as they stand; none where it is absent."""
        return (self.attribute(tag, attribute) or "").split()

    def say(self, tag: int, attribute: str, value: str) -> None:
        """Set an attribute, and take out those that say the same in other words."""
        others = [
            other for other in INSTEAD.get(attribute, ()) if self.attribute(tag, other) is not None
        ]
        for other in others:
            self.set(tag, other, None)
        if others and attribute not in self.tags[tag].attributes:
            self.replace(tag, others[0], attribute, value)
        else:
            self.set(tag, attribute, value)

    def numbers(
        self,
        tag: int,
        attribute: str,
        old: Array | float,
        new: Array | float,
        whole: int = 1,
        size: float = 0.0,
    ) -> None:
        """Write those of an attribute's numbers that differ between old and new: (n,); others stay as typed.

        whole: how many must stand;  size: magnitude that differences are compared with, besides the number's own
        """
        before, after = np.atleast_1d(old), np.atleast_1d(new)
        changed = set(np.flatnonzero(~close(before, after, size)).tolist())
        if not changed:
            return
        typed = self.typed(tag, attribute)
        count = max(len(typed), whole, *(i + 1 for i in changed))
        keeps = [i < len(typed) and i not in changed for i in range(count)]
        self.say(
            tag,
            attribute,
            " ".join(typed[i] if keeps[i] else digits(after[i]) for i in range(count)),
        )


def close(a: Array, b: Array, size: float = 0.0) -> np.ndarray:
    """True where two numbers are one but for rounding; never for nan. size: magnitude that differences are compared with."""
    return np.asarray(np.abs(a - b) <= SAME * np.maximum(np.maximum(np.abs(a), np.abs(b)), size))


def digits(*values: float) -> str:
    """Numbers by as many digits as give them back exactly."""
    return " ".join(repr(float(value) + 0.0) for value in values)  # no -0.0


def _named(tags: Sequence[Tag]) -> Iterator[tuple[tuple[str, str], int]]:
    """((kind, name), index of the tag) of the elements that stand for themselves: not copied, not generated."""
    inside: set[int] = set()  # tags of the tree of bodies
    for i, tag in enumerate(tags):
        if tag.parent < 0:
            continue
        top = tags[tag.parent]
        kind = top.name if top.name in SECTIONS and top.parent == 0 else None
        if tag.parent in inside:
            kind = TREE.get(tag.name)
        if (tag.name == "worldbody" and tag.parent == 0) or (
            tag.parent in inside and tag.name in ("body", "frame")
        ):
            inside.add(i)
        if kind is not None and "name" in tag.attributes:
            yield (kind, tag.attributes["name"]), i

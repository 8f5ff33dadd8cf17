"""An MJCF text in which numbers of named elements are changed and written with all digits."""

from __future__ import annotations

from collections.abc import Iterator, Sequence

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ModelError
from mjfim.output.mjcf.xml_edit import Tag, XmlText

# Relative difference below which two numbers differ only by rounding.
RELATIVE_TOLERANCE = 1e-14

# Kind of object that an element inside <worldbody> defines.
TREE_KINDS = {
    "body": "body",
    "joint": "joint",
    "freejoint": "joint",
    "geom": "geom",
    "site": "site",
}

# Sections of the MJCF whose children all define objects of the section's name.
SECTIONS = ("actuator", "tendon")

# Attributes that state an orientation.
ORIENTATIONS = ("quat", "axisangle", "euler", "xyaxes", "zaxis")

# Attributes that state the same quantity as another one, which MuJoCo would refuse or prefer beside
# it.
ALTERNATIVES = {
    "quat": ORIENTATIONS[1:],
    "fullinertia": ("diaginertia", *ORIENTATIONS),
    "diaginertia": ("fullinertia",),
    "kv": ("dampratio",),
    "area": ("diameter",),
    "stiffness": ("springdamper",),
    "damping": ("springdamper",),
}


class MjcfDocument(XmlText):
    """MJCF text with pending edits of its numbers."""

    def __init__(self, text: bytes) -> None:
        """Parse an MJCF.

        Args:
            text: The MJCF in UTF-8.

        Raises:
            ModelError: The text is no well-formed XML or no MJCF. The message is a clause, without
                the name of the file.
        """
        super().__init__(text)
        if self.tags[0].name != "mujoco":
            raise ModelError(f"the model is no MJCF but <{self.tags[0].name}>")
        self._elements = dict(_named_elements(self.tags))

    def element(self, kind: str, name: str) -> int:
        """Find a named element.

        Args:
            kind: Kind of object: body, joint, geom, site, actuator or tendon.
            name: Name of the object.

        Returns:
            Index of its start tag.

        Raises:
            ModelError: The element is in another file, or MuJoCo generates it.
        """
        if (kind, name) not in self._elements:
            raise ModelError(
                f"{kind} {name!r} is not in the MJCF file itself (it comes from <include>, "
                "<attach>, <replicate> or the like)"
            )
        return self._elements[kind, name]

    def top_level(self, name: str) -> list[int]:
        """Find all elements of a name directly inside `<mujoco>`.

        Args:
            name: Name of the elements.

        Returns:
            Indices of their start tags, in the order of the text.
        """
        return [i for i, tag in enumerate(self.tags) if tag.name == name and tag.parent == 0]

    def written_numbers(self, tag: int, attribute: str) -> list[str]:
        """Return the numbers of an attribute in the spelling of the text.

        Args:
            tag: Index of the tag.
            attribute: Name of the attribute.

        Returns:
            The numbers, none if there is no such attribute.
        """
        return (self.attribute(tag, attribute) or "").split()

    def set_exclusively(self, tag: int, attribute: str, value: str) -> None:
        """Set an attribute, and remove all attributes that state the same quantity.

        Args:
            tag: Index of the tag.
            attribute: Name of the attribute.
            value: The new value.
        """
        others = [
            other
            for other in ALTERNATIVES.get(attribute, ())
            if self.attribute(tag, other) is not None
        ]
        for other in others:
            self.set(tag, other, None)

        # A new attribute takes the place of the one that it replaces.
        if others and attribute not in self.tags[tag].attributes:
            self.replace_attribute(tag, others[0], attribute, value)
        else:
            self.set(tag, attribute, value)

    def set_numbers(
        self,
        tag: int,
        attribute: str,
        old: Array | float,
        new: Array | float,
        *,
        min_count: int = 1,
        magnitude: float = 0.0,
    ) -> None:
        """Write those numbers of an attribute that differ between two models.

        The other numbers of the attribute keep their spelling.

        Args:
            tag: Index of the tag.
            attribute: Name of the attribute.
            old: (n,) numbers of the compiled text.
            new: (n,) wanted numbers.
            min_count: Fewest numbers that MuJoCo accepts for this attribute.
            magnitude: Typical size, relative to which a difference counts as rounding.
        """
        before, after = np.atleast_1d(old), np.atleast_1d(new)
        changed = set(np.flatnonzero(~nearly_equal(before, after, magnitude)).tolist())
        if not changed:
            return

        written = self.written_numbers(tag, attribute)
        count = max(len(written), min_count, *(i + 1 for i in changed))
        numbers = [
            written[i] if i < len(written) and i not in changed else all_digits(after[i])
            for i in range(count)
        ]
        self.set_exclusively(tag, attribute, " ".join(numbers))


def nearly_equal(a: Array, b: Array, magnitude: float = 0.0) -> np.ndarray:
    """Compare numbers up to rounding.

    Args:
        a: (n,) numbers.
        b: (n,) numbers.
        magnitude: Typical size, relative to which a difference counts as rounding if it exceeds the
            numbers.

    Returns:
        (n,) True where two numbers differ only by rounding; never where one is NaN.
    """
    size = np.maximum(np.maximum(np.abs(a), np.abs(b)), magnitude)
    return np.asarray(np.abs(a - b) <= RELATIVE_TOLERANCE * size)


def all_digits(*values: float) -> str:
    """Write numbers with all digits, so that reading them returns exactly these numbers.

    Args:
        values: The numbers.

    Returns:
        The numbers with blanks between them.
    """
    # Adding zero turns -0.0 into 0.0.
    return " ".join(repr(float(value) + 0.0) for value in values)


def _named_elements(tags: Sequence[Tag]) -> Iterator[tuple[tuple[str, str], int]]:
    """Yield (kind, name) and the tag of every element that defines exactly one object.

    Elements that MuJoCo copies or generates are left out.
    """
    tree: set[int] = set()

    for i, tag in enumerate(tags):
        if tag.parent < 0:
            continue

        parent = tags[tag.parent]
        in_tree = tag.parent in tree
        if (tag.name == "worldbody" and tag.parent == 0) or (
            in_tree and tag.name in ("body", "frame")
        ):
            tree.add(i)

        kind = parent.name if parent.name in SECTIONS and parent.parent == 0 else None
        if in_tree:
            kind = TREE_KINDS.get(tag.name)
        if kind is not None and "name" in tag.attributes:
            yield (kind, tag.attributes["name"]), i

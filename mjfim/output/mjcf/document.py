"""The MJCF texts of a model, in which numbers of named elements are written with all digits.

The tags of the main file and of the files that it includes form one tree, as in MuJoCo: the content
of an included file stands in the place of its `<include>`.
"""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, replace
from pathlib import Path
from types import MappingProxyType

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ModelError
from mjfim.model.included_files import included_file
from mjfim.output.mjcf.xml_edit import NewTag, Tag, XmlText

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

# Kind of object that an element inside <contact> defines.
CONTACT_KINDS = {"pair": "pair"}

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


# Index of the main file among the files of a model.
MAIN = 0


@dataclass(frozen=True, kw_only=True, eq=False)
class SourceFile:
    """One file of a model.

    Attributes:
        path: The file.
        text: Its text with pending edits.
        include: Index of the `<include>` that names it; -1 for the main file.
        is_beside: The name is relative to the folder of the including file, because it means no
            file in that of the main file.
    """

    path: Path
    text: XmlText
    include: int = -1
    is_beside: bool = False


class MjcfDocument:
    """Texts of a model with pending edits of their numbers.

    Attributes:
        files: The files of the model, the main file first, then in the order of the `<include>`s.
        tags: All start tags in the order in which MuJoCo reads them. The root of the main file is
            the first; elements of an included file have the parent of its `<include>`.
    """

    def __init__(
        self,
        text: bytes,
        path: Path | None = None,
        included: Mapping[Path, bytes] = MappingProxyType({}),
    ) -> None:
        """Parse an MJCF, and the files that it includes.

        Args:
            text: The MJCF in UTF-8.
            path: Its file. Without it, the included files are not read.
            included: Texts of included files that are not as on the disk, by their paths.

        Raises:
            ModelError: A text is no well-formed XML, or the main file is no MJCF. The message is a
                clause, without the name of the file.
        """
        self._included = included
        self.files: list[SourceFile] = []
        self.tags: list[Tag] = []
        self._places: list[tuple[XmlText, int]] = []
        self._add(SourceFile(path=path or Path(), text=XmlText(text)), follows=path is not None)

        if self.tags[0].name != "mujoco":
            raise ModelError(f"the model is no MJCF but <{self.tags[0].name}>")
        self._elements = dict(_named_elements(self.tags))

    def _add(self, file: SourceFile, *, follows: bool) -> None:
        """Add the tags of a file, and where wanted those of the files that it includes."""
        self.files.append(file)
        places: dict[int, int] = {-1: -1}

        for i, tag in enumerate(file.text.tags):
            parent = places[tag.parent]
            if tag.parent == 0 and file.include >= 0:
                parent = self.tags[file.include].parent

            places[i] = len(self.tags)
            self.tags.append(replace(tag, parent=parent))
            self._places.append((file.text, i))
            if follows and tag.name == "include" and "file" in tag.attributes:
                self._include(places[i], file.path)

    def _include(self, include: int, including: Path) -> None:
        """Add the file that an `<include>` of another file names."""
        main, name = self.files[MAIN].path, self.tags[include].attributes["file"]
        found = included_file(main, including, name)

        # MuJoCo refuses a file that is included twice.
        known = {file.path.resolve() for file in self.files}
        if found is None or found.resolve() in known:
            return
        is_beside = not (main.parent / name).is_file()
        content = self._included.get(found)
        text = XmlText(found.read_bytes() if content is None else content)
        file = SourceFile(path=found, text=text, include=include, is_beside=is_beside)
        self._add(file, follows=True)

    def edited(self) -> MjcfDocument:
        """Parse the texts with all edits so far, which may then be edited further."""
        included = {file.path: file.text.edited() for file in self.files[1:]}
        document = MjcfDocument(self.files[MAIN].text.edited(), self.files[MAIN].path, included)
        for before, after in zip(self.files, document.files, strict=True):
            after.text.is_changed = before.text.is_edited
        return document

    def tags_of(self, file: SourceFile) -> list[int]:
        """Indices of the start tags of one file.

        Args:
            file: The file.
        """
        return [i for i, (text, _) in enumerate(self._places) if text is file.text]

    def attribute(self, tag: int, name: str) -> str | None:
        """Return the value of an attribute after the edits so far.

        Args:
            tag: Index of the tag.
            name: Name of the attribute.

        Returns:
            The value, None if there is no such attribute.
        """
        text, own = self._places[tag]
        return text.attribute(own, name)

    def set(self, tag: int, name: str, value: str | None) -> None:
        """Change, add or remove an attribute. See `XmlText.set`.

        Args:
            tag: Index of the tag.
            name: Name of the attribute.
            value: The new value; None removes the attribute.
        """
        text, own = self._places[tag]
        text.set(own, name, value)

    def rename_element(self, tag: int, name: str) -> None:
        """Change the name of an element.

        Args:
            tag: Index of the tag.
            name: The new name.
        """
        text, own = self._places[tag]
        text.rename_element(own, name)

    def insert_child(self, parent: int, name: str, attributes: dict[str, str]) -> None:
        """Add an empty element as the first child of another one. See `XmlText.insert_child`.

        Args:
            parent: Index of the tag of the enclosing element.
            name: Name of the new element.
            attributes: Values by name of the attribute.
        """
        text, own = self._places[parent]
        text.insert_child(own, name, attributes)

    def insert_comment(self, parent: int, comment: str) -> None:
        """Add a comment before the first child of an element. See `XmlText.insert_comment`.

        Args:
            parent: Index of the tag of the element.
            comment: The comment; two hyphens in a row are separated.
        """
        text, own = self._places[parent]
        text.insert_comment(own, comment.replace("--", "- -"))

    def append_child(self, parent: int, element: NewTag, comment: str = "") -> None:
        """Add an element as the last child of another one. See `XmlText.append_child`.

        Args:
            parent: Index of the tag of the enclosing element.
            element: The new element.
            comment: Comment above it; empty for none.
        """
        text, own = self._places[parent]
        text.append_child(own, element, comment)

    def element(self, kind: str, name: str) -> int:
        """Find a named element.

        Args:
            kind: Kind of object: body, joint, geom, site, actuator or tendon.
            name: Name of the object.

        Returns:
            Index of its start tag.

        Raises:
            ModelError: MuJoCo generates the element, or copies it from another place.
        """
        if (kind, name) not in self._elements:
            raise ModelError(
                f"{kind} {name!r} is not in the MJCF file itself or the files that it includes (it "
                "comes from <attach>, <replicate> or the like)"
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

    def is_in_main_file(self, tag: int) -> bool:
        """Whether an element stands in the main file and not in an included one.

        Args:
            tag: Index of the tag.
        """
        return self._places[tag][0] is self.files[MAIN].text

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
            text, own = self._places[tag]
            text.replace_attribute(own, others[0], attribute, value)
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
        elif parent.name == "contact" and parent.parent == 0:
            kind = CONTACT_KINDS.get(tag.name)
        if kind is not None and "name" in tag.attributes:
            yield (kind, tag.attributes["name"]), i

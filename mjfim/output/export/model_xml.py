"""The XML of a model, in which numbers are changed: an MJCF with all that it includes, or a URDF.

Comments, the order of elements and attributes, and the spelling of other numbers stay.
"""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Mapping, Sequence
from copy import deepcopy
from dataclasses import dataclass
from pathlib import Path
from types import MappingProxyType
from typing import Any

import mujoco
import numpy as np
from lxml import etree
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.errors import ModelError
from mjfim.files import replacing
from mjfim.model.given import ROUNDING
from mjfim.model.loading import refused
from mjfim.model.model_files import included_file

# Where the element that defines an object stands; other objects are elements of <worldbody>.
PLACES = {
    "joint": "//worldbody//*[self::joint or self::freejoint]",
    "actuator": "/mujoco//actuator/*",
    "tendon": "/mujoco//tendon/*",
    "pair": "/mujoco//contact//pair",
}

# Attributes that state the same quantity as another one, which replaces them.
ALTERNATIVES = {
    "quat": ("axisangle", "euler", "xyaxes", "zaxis"),
    "diaginertia": ("fullinertia",),
    "kv": ("dampratio",),
    "stiffness": ("springdamper",),
    "damping": ("springdamper",),
}

# Attributes of <compiler> that name a folder, and elements whose files are in one of these folders.
FOLDERS = ("meshdir", "texturedir", "assetdir")
ASSETS = ("mesh", "hfield", "skin", "flexcomp", "texture")

# What some editors of Windows put before a text in UTF-8.
BYTE_ORDER_MARK = "\ufeff".encode()

# No assets in the memory.
NOTHING: Mapping[str, bytes] = MappingProxyType({})

# An element, an attribute of it that names a file or a folder, and the name as the user wrote it.
Reference = tuple[Any, str, str]


@dataclass(eq=False, kw_only=True)
class SourceFile:
    """One file of a model.

    Attributes:
        path: The file.
        root: Its main element. While it is edited, the content of an included file is in its
            `<include>`.
        before: Its text before the edits.
        references: The relative names of other files and folders in it.
        is_declared: Whether it begins with an XML declaration.
        include: The `<include>` that names it; None for the main file.
    """

    path: Path
    root: Any
    before: bytes
    references: list[Reference]
    is_declared: bool
    include: Any = None

    def text(self) -> bytes:
        """Its text with the edits."""
        return _text(self.root, self.is_declared)


class ModelXml:
    """The XML of a model as one tree, in the order in which MuJoCo reads it.

    Inside the tree, files and folders have absolute paths.

    Attributes:
        root: The main element: `mujoco` or `robot`.
    """

    def __init__(
        self,
        path: Path,
        read: Callable[[Path], bytes] = Path.read_bytes,
        held: Mapping[str, bytes] = NOTHING,
    ) -> None:
        """Read a model.

        Args:
            path: The main file.
            read: Gives the bytes of a file.
            held: Assets that are in the memory only, by their names in the main file.

        Raises:
            ModelError: The text is no XML. The message is a clause.
        """
        main = _source_file(path.resolve(), read)
        self._read, self._held = read, held
        self.root = main.root
        self._main = main
        self._included: list[SourceFile] = []
        self._include(main)
        for file in (main, *self._included):
            self._make_absolute(file)

    # ---- elements

    def named(self, kind: str, name: str) -> Any:
        """The element that defines an object.

        Args:
            kind: Kind of the object: body, joint, geom, site, actuator, tendon or pair.
            name: Its name.

        Raises:
            ModelError: MuJoCo generates the element, or copies it from another place. The message
                is a clause.
        """
        place = PLACES.get(kind, f"//worldbody//{kind}")
        found = self.root.xpath(f"{place}[@name=$name]", name=name)
        if not found:
            raise ModelError(
                f"{kind} {name!r} is not in the MJCF file itself or the files that it includes (it "
                "comes from <attach>, <replicate> or the like)"
            )
        return found[0]

    def sections(self, tag: str) -> list[Any]:
        """All elements of a name directly inside the main element."""
        return [each for each in self.root.iter(tag) if parent_of(each) is self.root]

    def attach(self, files: Mapping[Path, Path]) -> None:
        """Attach other files in place of some models, by the resolved paths of the present ones."""
        for element in self.root.iter("model"):
            new = files.get(Path(element.get("file", "")).resolve())
            if new is not None:
                element.set("file", str(new.resolve()))

    # ---- the edited model

    def compiled(self) -> tuple[Any, Any]:
        """The MjSpec of the model as it is now, and its MjModel.

        Raises:
            ModelError: MuJoCo does not load it. The message is a clause.
        """
        root = deepcopy(self.root)
        for include in root.xpath("//include[*]"):
            parent = include.getparent()
            place = parent.index(include)
            parent[place : place + 1] = list(include)

        text = etree.tostring(root, encoding="unicode")
        with refused("MuJoCo does not load the text with the identified values"):
            spec = mujoco.MjSpec.from_string(text, assets=dict(self._held))
            return spec, spec.compile()

    def save(self, path: Path, check: Callable[[Path], None]) -> None:
        """Write the model for the folder of a new file; afterwards it cannot be edited.

        Included files that change, and assets of the memory, are written first beside the main one.

        Args:
            path: The new main file.
            check: Called with the complete model under a temporary name; a ModelError keeps it from
                being written.
        """
        folder = path.resolve().parent
        assets = {tag: self._asset_folder(tag) or folder for tag in ASSETS}
        copies = []
        for file, name in reversed(list(zip(self._included, self.copies(path), strict=True))):
            file.root.extend(list(file.include))
            paths = [element.get(attribute) for element, attribute, _ in file.references]
            _make_relative(file, paths, assets, [folder, file.path.parent])
            if file.text() == file.before:
                continue

            _make_relative(file, paths, assets, [folder])
            file.include.set("file", str(folder / name))
            with replacing(folder / name) as temporary:
                temporary.write_bytes(file.text())
            copies.append(folder / name)

        for element, attribute, name in self._main.references:
            if name in self._held:
                element.set(attribute, held_name(path, name))
                with replacing(folder / held_name(path, name)) as temporary:
                    temporary.write_bytes(self._held[name])
        paths = [element.get(attribute) for element, attribute, _ in self._main.references]
        _make_relative(self._main, paths, assets, [folder])
        try:
            with replacing(path) as temporary:
                temporary.write_bytes(self._main.text())
                check(temporary)
        except ModelError:
            for copy in copies:
                copy.unlink()
            raise

    def copies(self, path: Path) -> list[str]:
        """Names that copies of the included files have beside a new main file, after both files.

        Args:
            path: The new main file.
        """
        folder = path.resolve().parent
        files = (self._main, *self._included)
        taken = {path.name, *(file.path.name for file in files if file.path.parent == folder)}
        names: list[str] = []
        for file in self._included:
            stem = f"{path.stem}_{file.path.stem.removeprefix(f'{path.stem}_')}"
            numbered = (f"{stem}_{k}{file.path.suffix}" for k in itertools.count(2))
            candidates = itertools.chain([f"{stem}{file.path.suffix}"], numbered)
            names.append(next(name for name in candidates if name not in {*taken, *names}))
        return names

    # ---- names of files

    def _include(self, file: SourceFile) -> None:
        """Read the files that a file includes, and put their content into the `<include>`s."""
        for element, _, name in file.references:
            if element.tag != "include":
                continue
            place = included_file(self._main.path, file.path, name)
            known = {each.path for each in (self._main, *self._included)}
            if place is None or place.resolve() in known:
                continue

            included = _source_file(place.resolve(), self._read)
            included.include = element
            self._included.append(included)
            self._include(included)
            element.extend(list(included.root))

    def _asset_folder(self, tag: str) -> Path | None:
        """Stated folder of the files of an element; None for that of the main file."""
        own = "texturedir" if tag == "texture" else "meshdir"
        stated = ""
        for compiler in self.root.iter("compiler"):
            stated = compiler.get("assetdir", stated)
            stated = compiler.get(own, stated)
        return self._main.path.parent / stated if stated else None

    def _make_absolute(self, file: SourceFile) -> None:
        """Replace the names of existing files and folders by absolute paths."""
        home, own = self._main.path.parent, file.path.parent
        for element, attribute, name in file.references:
            if name in self._held:
                continue
            places = [home, own]
            if element.tag in ASSETS:
                folder = self._asset_folder(element.tag) or home
                places = [folder, own / os.path.relpath(folder, home), own]
            found = [place / name for place in places if (place / name).exists()]
            if found:
                element.set(attribute, os.path.normpath(found[0]))
            elif element.tag in ASSETS and self._asset_folder(element.tag) is None:
                self._state_asset_folder()

    def _state_asset_folder(self) -> None:
        """State the folder of assets that MuJoCo finds by the last part of their names."""
        parent = self.root
        if parent.tag == "robot":
            parent = child(parent, "mujoco")
        compiler = child(parent, "compiler")
        compiler.set("assetdir", str(self._main.path.parent))
        self._main.references.append((compiler, "assetdir", ""))


def held_name(path: Path, name: str) -> str:
    """Name that an asset of the memory has beside a new main file."""
    return f"{path.stem}_{Path(name).name}"


# ---- elements


def parent_of(element: Any) -> Any:
    """The element in which another one stands for MuJoCo, to which an `<include>` is nothing."""
    parent = element.getparent()
    while parent is not None and parent.tag == "include":
        parent = parent.getparent()
    return parent


def own_child(parent: Any, tag: str) -> Any:
    """The first child of a name, also of an included file; None where there is none."""
    return next((each for each in parent.iter(tag) if parent_of(each) is parent), None)


def child(parent: Any, tag: str) -> Any:
    """The first child of a name, which is added as the first one where it is missing."""
    found = own_child(parent, tag)
    return add_element(parent, tag, first=True) if found is None else found


def add_element(
    parent: Any,
    tag: str,
    attributes: Mapping[str, str] | None = None,
    *,
    first: bool = False,
    comment: str = "",
) -> Any:
    """Add an element as the last or the first child, indented as the other children.

    Args:
        parent: The element that gets it.
        tag: Its name.
        attributes: Its attributes.
        first: Whether it becomes the first child instead of the last one.
        comment: Comment above it; empty for none.
    """
    if comment:
        add_comment(parent, comment, first=first)
    added = etree.Element(tag, dict(attributes or {}))
    _insert(parent, added, first=first)
    return added


def add_comment(parent: Any, comment: str, *, first: bool = False) -> None:
    """Add a comment as the last or the first child, without what XML does not allow in it."""
    allowed = "".join(each if each.isprintable() or each == "\n" else " " for each in comment)
    added = etree.Comment(f" {allowed.replace('--', '- -')} ")
    _insert(parent, added, first=first)


def _insert(parent: Any, added: Any, *, first: bool) -> None:
    """Add a node as the first or the last child, on a line of its own where others are."""
    tail, place = parent.text, 0 if first else len(parent)
    if place > 0:
        tail, parent[-1].tail = parent[-1].tail, parent.text
    parent.insert(place, added)
    added.tail = tail


def set_numbers(element: Any, attribute: str, before: Array, after: Array, least: int = 1) -> None:
    """State with all digits those numbers of an attribute that differ between two models.

    The others keep their spelling. Attributes that state the same quantity are removed.

    Args:
        element: The element.
        attribute: Its attribute.
        before: (n,) numbers to which the element compiles.
        after: (n,) wanted numbers.
        least: Fewest numbers that MuJoCo takes for the attribute.
    """
    changes = np.flatnonzero(~nearly_equal(before, after)).tolist()
    if not changes:
        return

    words = element.get(attribute, "").split()
    count = max(len(words), least, changes[-1] + 1)
    numbers = [
        words[i] if i < len(words) and i not in changes else all_digits(after[i])
        for i in range(count)
    ]
    for other in ALTERNATIVES.get(attribute, ()):
        element.attrib.pop(other, None)
    element.set(attribute, " ".join(numbers))


def nearly_equal(a: Array, b: Array) -> NDArray[np.bool_]:
    """(n,) whether two numbers differ by rounding only, beside the largest of all numbers."""
    size = max(np.abs(a).max(initial=0.0), np.abs(b).max(initial=0.0))
    return np.asarray(np.abs(a - b) <= ROUNDING * size)


def all_digits(*values: float) -> str:
    """Numbers such that reading them gives exactly these numbers; whole ones without a point."""
    # Adding zero turns -0.0 into 0.0.
    return " ".join(repr(float(value) + 0.0).removesuffix(".0") for value in values)


def floats(text: str) -> Array:
    """(n,) numbers of an attribute."""
    return np.array([float(word) for word in text.split()])


# ---- files


def _source_file(path: Path, read: Callable[[Path], bytes]) -> SourceFile:
    content = read(path)
    parser = etree.XMLParser(resolve_entities=False, no_network=True)
    try:
        root = etree.fromstring(content, parser)
    except etree.XMLSyntaxError as error:
        raise ModelError(f"the text is not well-formed XML ({error})") from None

    references = [
        (element, attribute, name)
        for element in root.iter("*")
        for attribute, name in element.attrib.items()
        if _is_reference(element.tag, attribute) and not os.path.isabs(name)
    ]
    is_declared = content.lstrip(BYTE_ORDER_MARK).startswith(b"<?xml")
    before = _text(root, is_declared)
    return SourceFile(
        path=path, root=root, before=before, references=references, is_declared=is_declared
    )


def _is_reference(tag: str, attribute: str) -> bool:
    """Whether an attribute names another file or a folder."""
    if tag == "compiler":
        return attribute in FOLDERS
    if tag in ASSETS:
        return attribute.startswith("file")
    return tag in ("include", "model") and attribute == "file"


def _make_relative(
    file: SourceFile, paths: Sequence[str], assets: Mapping[str, Path], places: Sequence[Path]
) -> None:
    """Write names relative to the first place, or to the folder of assets.

    The user's names stay where they lead to the same file from there or from another place.
    """
    for (element, attribute, name), absolute in zip(file.references, paths, strict=True):
        if not os.path.isabs(absolute):
            continue
        first, *others = places
        bases = [assets.get(element.tag, first), *others]
        keeps = any(os.path.normpath(base / name) == absolute for base in bases)
        relative = Path(os.path.relpath(absolute, bases[0])).as_posix()
        element.set(attribute, name if keeps else relative)


def _text(root: Any, is_declared: bool) -> bytes:
    """The text of a file, with the comments around its main element."""
    before = reversed(list(root.itersiblings(preceding=True)))
    nodes = [*before, root, *root.itersiblings()]
    lines = [etree.tostring(node, encoding="utf-8", with_tail=False) for node in nodes]
    declaration = [b'<?xml version="1.0" encoding="utf-8"?>'] if is_declared else []
    return b"\n".join([*declaration, *lines, b""])

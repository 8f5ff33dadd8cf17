"""Estimate of the size of a model from its files, before MuJoCo compiles it.

A short file can expand to a model that fills the memory: by nested replications, models that are
attached many times, large grids of elements, height fields, textures, packed images, meshes or a
large arena.
"""

from __future__ import annotations

import math
import re
import struct
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from pathlib import Path

from mjfim.errors import ModelError
from mjfim.model.included_files import read_elements, read_with_included_files
from mjfim.model.model_files import FOLDERS

# Factors of the letters with which MuJoCo states the size of the arena.
MEMORY_UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40, "P": 2**50, "E": 2**60}

# Attributes of an element that state how many elements it makes; two or three numbers are
# multiplied.
COUNTED = {"replicate": "count", "composite": "count", "flexcomp": "count"}

# Attributes whose product is the number of values of an asset.
GRIDS = {"hfield": ("nrow", "ncol"), "texture": ("width", "height")}

# Attributes of a texture that name images: one, or one for each side of a cube.
IMAGES = ("file", "fileright", "fileleft", "fileup", "filedown", "filefront", "fileback")

# First bytes of a PNG image; the width and the height in pixels begin at byte 16.
PNG_SIGNATURE = b"\x89PNG\r\n\x1a\n"
PNG_HEADER = 24


@dataclass(frozen=True, kw_only=True)
class ModelSize:
    """Size of a model, or the largest size that is accepted.

    Attributes:
        elements: Number of elements after replication and attachment.
        values: Number of values of height fields and of textures that MuJoCo generates.
        pixels: Number of pixels of all images, unpacked.
        mesh_bytes: Size of all files of meshes and skins [bytes].
        arena: Size of the arena, the memory of one simulation for contacts [bytes].
    """

    elements: float = 0.0
    values: float = 0.0
    pixels: float = 0.0
    mesh_bytes: float = 0.0
    arena: float = 0.0

    def plus(self, other: ModelSize, times: float) -> ModelSize:
        """Size with another model attached `times` times; all share the larger arena."""
        return ModelSize(
            elements=self.elements + times * other.elements,
            values=self.values + times * other.values,
            pixels=self.pixels + times * other.pixels,
            mesh_bytes=self.mesh_bytes + times * other.mesh_bytes,
            arena=max(self.arena, other.arena),
        )


# Name of each part of a size, for messages.
PARTS = {
    "elements": "elements",
    "values": "values of height fields and textures",
    "pixels": "pixels of images",
    "mesh_bytes": "bytes of mesh files",
    "arena": "bytes of arena (size.memory)",
}

# Largest size of a model. While MuJoCo compiles a model, a pixel takes up to 9 bytes, and a byte of
# a mesh file up to 40.
LARGEST = ModelSize(
    elements=2e5,
    values=5e7,
    pixels=2.5e8,
    mesh_bytes=2.5e8,
    arena=2.0**31,
)


def check_expanded_size(path: Path, largest: ModelSize = LARGEST) -> None:
    """Refuse a model that would fill the memory when MuJoCo compiles it.

    Args:
        path: The MJCF file. A file that is not readable XML is left to MuJoCo.
        largest: The largest size that is accepted.

    Raises:
        ModelError: A part of the model is too large, or a model attaches itself.
    """
    size = _Sizes(path).of(path)
    for part in fields(ModelSize):
        count, bound = getattr(size, part.name), getattr(largest, part.name)
        if count > bound:
            raise ModelError(
                f"{path}: the model expands to {count:.3g} {PARTS[part.name]}, which would fill "
                f"the memory; at most {bound:.3g} are possible"
            )


class _Sizes:
    """Sizes of a model and of the models that it attaches, each of which is read once.

    Args:
        main: File of the model, for messages.
    """

    def __init__(self, main: Path) -> None:
        """Start without any model."""
        self._main = main
        self._known: dict[Path, ModelSize] = {}
        self._open: list[Path] = []

    def of(self, path: Path) -> ModelSize:
        """Size of the model in a file, with all models that it attaches.

        Raises:
            ModelError: The model attaches itself.
        """
        file = path.resolve()
        if file in self._known:
            return self._known[file]
        if file in self._open:
            raise ModelError(
                f"{self._main}: the model {path} names itself in <asset><model>; "
                "remove this element"
            )

        # A model that is named but not attached is read by MuJoCo all the same, once.
        self._open.append(file)
        parts = _Parts(path)
        size = parts.size
        for name, other in parts.models():
            size = size.plus(self.of(other), max(parts.attached.get(name, 0.0), 1.0))

        self._open.pop()
        self._known[file] = size
        return size


class _Parts:
    """Parts of a model in an MJCF file and in the files that it includes.

    Attributes:
        size: Size without the models that it attaches.
        attached: How often a model is attached, by its name in this file.
    """

    def __init__(self, path: Path) -> None:
        """Read a model.

        Args:
            path: The MJCF file.
        """
        self.size = ModelSize()
        self.attached: dict[str, float] = {}
        self._path = path
        self._models: list[dict[str, str]] = []
        self._images: set[str] = set()
        self._meshes: set[str] = set()
        self._folders = {""}

        # The folders of assets may be stated after the assets.
        read_with_included_files(path, 1.0, self._add)
        self.size = self.size.plus(self._size_of_assets(), 1.0)

    def models(self) -> list[tuple[str, Path]]:
        """Name and file of each model that can be attached, as far as the file exists."""
        found = []
        for attributes in self._models:
            file = self._path.parent / attributes["file"]
            if file.is_file():
                found.append((attributes.get("name") or _model_name(file), file))
        return found

    def _add(self, path: Path, factor: float) -> list[tuple[str, float]]:
        """Add the elements of one file.

        Args:
            path: The file.
            factor: Number of times that the file is replicated.

        Returns:
            The files that it includes, each with the number of times that it is replicated.
        """
        factors = [factor]
        included: list[tuple[str, float]] = []

        def start(tag: str, attributes: dict[str, str]) -> None:
            """Count an element, and multiply the elements inside it."""
            repeated = factors[-1] * _product(attributes.get(COUNTED.get(tag, ""), "1"))
            factors.append(repeated)
            self.size = self.size.plus(_size_of_element(tag, attributes), 1.0)
            self.size = replace(self.size, elements=self.size.elements + repeated)

            self._add_names(tag, attributes, repeated)
            if tag == "include" and "file" in attributes:
                included.append((attributes["file"], repeated))

        def end(tag: str) -> None:
            """Return to the number of repetitions outside an element."""
            factors.pop()

        return included if read_elements(path, start, end) else []

    def _add_names(self, tag: str, attributes: Mapping[str, str], repeated: float) -> None:
        """Keep the names of other models and of the files of assets."""
        if tag == "attach":
            name = attributes.get("model", "")
            self.attached[name] = self.attached.get(name, 0.0) + repeated
        if tag == "model" and "file" in attributes:
            self._models.append(dict(attributes))
        if tag == "compiler":
            self._folders.update(attributes[key] for key in FOLDERS if key in attributes)

        if tag in ("texture", "hfield"):
            self._images.update(attributes[key] for key in IMAGES if key in attributes)
        if tag in ("mesh", "skin", "flexcomp") and "file" in attributes:
            self._meshes.add(attributes["file"])

    def _size_of_assets(self) -> ModelSize:
        """Size of the images and meshes in files."""
        images = [_pixels(file) for file in map(self._found, self._images) if file]
        meshes = [file.stat().st_size for file in map(self._found, self._meshes) if file]
        return ModelSize(pixels=sum(images), mesh_bytes=float(sum(meshes)))

    def _found(self, name: str) -> Path | None:
        """The file of an asset in one of the stated folders; None if it does not exist."""
        for folder in sorted(self._folders, reverse=True):
            file = self._path.parent / folder / name
            if file.is_file():
                return file
        return None


def _size_of_element(tag: str, attributes: Mapping[str, str]) -> ModelSize:
    """Values of an asset, or size of the arena, that an element states."""
    if tag in GRIDS:
        return ModelSize(values=math.prod(_product(attributes.get(key, "0")) for key in GRIDS[tag]))
    if tag == "size":
        return ModelSize(arena=_arena(attributes.get("memory", "")))
    return ModelSize()


def _model_name(path: Path) -> str:
    """Name that a model gives itself, by which it can be attached."""
    names: list[str] = []

    def start(tag: str, attributes: dict[str, str]) -> None:
        """Keep the name of the root element."""
        if tag == "mujoco":
            names.append(attributes.get("model", ""))

    read_elements(path, start)
    return names[0] if names else ""


def _pixels(path: Path) -> float:
    """Number of pixels of an image; of formats without packing, its size in bytes."""
    try:
        with path.open("rb") as file:
            header = file.read(PNG_HEADER)
        if header.startswith(PNG_SIGNATURE) and len(header) == PNG_HEADER:
            width, height = struct.unpack(">II", header[16:])
            return float(width) * float(height)
        return float(path.stat().st_size)
    except OSError:
        return 0.0


def _product(text: str) -> float:
    """Return the product of the numbers in an attribute; 1 for what is not a positive number."""
    product = 1.0
    for word in text.split():
        try:
            number = float(word)
        except ValueError:
            number = 1.0
        if number > 1.0:
            product *= number
    return product


def _arena(text: str) -> float:
    """Return the size of the arena that an attribute states [bytes]; 0 for one without a size."""
    found = re.fullmatch(r"\s*(\d+)\s*([KMGTPE]?)\s*", text, re.IGNORECASE)
    return float(found[1]) * MEMORY_UNITS[found[2].upper()] if found else 0.0

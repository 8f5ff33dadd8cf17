"""Estimate of the size of a model from its file, before MuJoCo compiles it.

A short file can expand to a model that fills the memory: by nested replications, large grids of
elements, height fields, textures or a large arena.
"""

from __future__ import annotations

import math
import re
from collections.abc import Mapping
from pathlib import Path
from xml.parsers import expat

from mjfim.errors import ModelError
from mjfim.model.included_files import read_with_included_files

# Largest number of elements of a model after replication.
MAX_ELEMENTS = 200_000

# Largest number of values of all height fields and textures of a model.
MAX_VALUES = 50_000_000

# Largest size of the arena of a model, the memory of one simulation for contacts [bytes].
MAX_ARENA = 2**31

# Factors of the letters with which MuJoCo states the size of the arena.
MEMORY_UNITS = {"": 1, "K": 2**10, "M": 2**20, "G": 2**30, "T": 2**40, "P": 2**50, "E": 2**60}

# Attributes of an element that state how many elements it makes; two or three numbers are
# multiplied.
COUNTED = {"replicate": "count", "composite": "count", "flexcomp": "count"}

# Attributes whose product is the number of values of an asset.
GRIDS = {"hfield": ("nrow", "ncol"), "texture": ("width", "height")}


def check_expanded_size(path: Path) -> None:
    """Refuse a model that would fill the memory when MuJoCo compiles it.

    Args:
        path: The MJCF file. A file that is not readable XML is left to MuJoCo.

    Raises:
        ModelError: The model has too many elements or values, or a too large arena.
    """
    size = _Size()
    read_with_included_files(path, 1.0, size.add)
    size.require_within_bounds(path)


class _Size:
    """Size of a model, which grows with every file that is read.

    Attributes:
        elements: Number of elements after replication.
        values: Number of values of height fields and textures.
        arena: Size of the arena [bytes].
    """

    def __init__(self) -> None:
        """Start without any file."""
        self.elements = 0.0
        self.values = 0.0
        self.arena = 0.0

    def add(self, path: Path, factor: float) -> list[tuple[str, float]]:
        """Add the elements of one file.

        Args:
            path: The file.
            factor: Number of times that the file is replicated.

        Returns:
            The files that it includes, each with the number of times that it is replicated.
        """
        factors = [factor]
        included: list[tuple[str, float]] = []
        parser = expat.ParserCreate()

        def start(tag: str, attributes: dict[str, str]) -> None:
            """Count an element, and multiply the elements inside it."""
            repeated = factors[-1] * _product(attributes.get(COUNTED.get(tag, ""), "1"))
            self.elements += repeated
            factors.append(repeated)
            self._add_memory(tag, attributes)

            if tag == "include" and "file" in attributes:
                included.append((attributes["file"], repeated))

        def end(tag: str) -> None:
            """Return to the number of repetitions outside an element."""
            factors.pop()

        parser.StartElementHandler = start
        parser.EndElementHandler = end
        try:
            parser.Parse(path.read_bytes(), True)
        except (expat.ExpatError, OSError):
            return []
        return included

    def _add_memory(self, tag: str, attributes: Mapping[str, str]) -> None:
        """Add the values of an asset and the size of the arena."""
        if tag in GRIDS:
            self.values += math.prod(_product(attributes.get(key, "0")) for key in GRIDS[tag])
        if tag == "size":
            self.arena = max(self.arena, _arena(attributes.get("memory", "")))

    def require_within_bounds(self, path: Path) -> None:
        """Raise ModelError if the model of a file is too large."""
        for count, largest, what in (
            (self.elements, MAX_ELEMENTS, "elements"),
            (self.values, MAX_VALUES, "values of height fields and textures"),
            (self.arena, MAX_ARENA, "bytes of arena (size.memory)"),
        ):
            if count > largest:
                raise ModelError(
                    f"{path}: the model expands to {count:.3g} {what}, which would fill the "
                    f"memory; at most {largest:.3g} are possible"
                )


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

"""Checks that refuse numbers of a model that are not finite.

MuJoCo takes NaN in a file for a number that is not stated, or computes with it.
"""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping
from pathlib import Path
from typing import Any
from xml.parsers import expat

import mujoco
import numpy as np

from mjfim.errors import ModelError
from mjfim.model.included_files import read_with_included_files

# NaN as MuJoCo reads it.
NAN = re.compile(r"[+-]?nan(\(\w*\))?", re.IGNORECASE)

# Elements that name another file of the model.
FILE_ELEMENTS = ("include", "model")

# Attributes that hold no numbers, or numbers that MuJoCo does not use.
OTHER_ATTRIBUTES = ("name", "class", "childclass", "file", "content", "data", "user")

# Ends of the names of arrays that MuJoCo computes from other arrays of the model.
COMPUTED = ("0", "aabb", "rbound")

# Kinds of elements by the beginning of the name of an array of MjModel.
ELEMENTS = {
    "body": mujoco.mjtObj.mjOBJ_BODY,
    "jnt": mujoco.mjtObj.mjOBJ_JOINT,
    "dof": mujoco.mjtObj.mjOBJ_JOINT,
    "geom": mujoco.mjtObj.mjOBJ_GEOM,
    "site": mujoco.mjtObj.mjOBJ_SITE,
    "tendon": mujoco.mjtObj.mjOBJ_TENDON,
    "eq": mujoco.mjtObj.mjOBJ_EQUALITY,
    "actuator": mujoco.mjtObj.mjOBJ_ACTUATOR,
    "sensor": mujoco.mjtObj.mjOBJ_SENSOR,
    "key": mujoco.mjtObj.mjOBJ_KEY,
}


def check_file_numbers(path: Path) -> None:
    """Refuse NaN in an MJCF file and in the files that it includes.

    MuJoCo ignores some of them, such as the mass of a geom, and loads the model.

    Args:
        path: The MJCF file. A file that is not readable XML is left to MuJoCo.

    Raises:
        ModelError: A number is NaN; the message names file, line, element and attribute.
    """
    scan = _Scan()
    read_with_included_files(path, None, scan.read)

    # The reference to an element that is called "nan" is no number.
    for value, message in scan.suspects:
        if value not in scan.names:
            raise ModelError(f"{message}; every number of a model must be finite")


class _Scan:
    """Search for NaN in the attributes of MJCF files.

    Attributes:
        names: Names of all elements and classes.
        suspects: Values that look like NaN, each with a message.
    """

    def __init__(self) -> None:
        """Start without any file."""
        self.names: set[str] = set()
        self.suspects: list[tuple[str, str]] = []

    def read(self, path: Path, context: None = None) -> list[tuple[str, None]]:
        """Search one file.

        Args:
            path: The file.
            context: Nothing: all files are searched alike.

        Returns:
            The files that it names.
        """
        # Almost all files contain neither a NaN nor another file, and need not be parsed.
        text = path.read_bytes()
        if not re.search(rb"nan|<include|<model", text, re.IGNORECASE):
            return []

        files: list[tuple[str, None]] = []
        parser = expat.ParserCreate()

        def start(tag: str, attributes: dict[str, str]) -> None:
            """Keep the names, the files and the suspects of an element."""
            self.names.update(attributes[key] for key in ("name", "class") if key in attributes)
            if tag in FILE_ELEMENTS and "file" in attributes:
                files.append((attributes["file"], None))

            label = f"{tag} {attributes['name']!r}" if "name" in attributes else f"<{tag}>"
            for key, value in _not_a_number(attributes):
                place = f"{path}: line {parser.CurrentLineNumber}"
                self.suspects.append((value, f"{place}: the {key} of {label} is {value!r}"))

        parser.StartElementHandler = start
        try:
            parser.Parse(text, True)
        except expat.ExpatError:
            # MuJoCo describes the fault.
            return []
        return files


def _not_a_number(attributes: Mapping[str, str]) -> Iterator[tuple[str, str]]:
    """Attributes with a NaN among their numbers, and their values."""
    for key, value in attributes.items():
        has_nan = any(NAN.fullmatch(word) for word in value.split())
        if has_nan and key not in OTHER_ATTRIBUTES:
            yield key, value


def check_compiled_numbers(model: Any, path: Path) -> None:
    """Refuse a compiled model with a number that is not finite; ranges may be infinite.

    Args:
        model: The compiled model (MjModel).
        path: The file that it was read from, for the message.

    Raises:
        ModelError: A number is not finite; the message names file, element and array.
    """
    # Arrays that MuJoCo computes from the stated numbers come last.
    for name in sorted(dir(model), key=lambda array: array.endswith(COMPUTED)):
        prefix = name.split("_")[0]
        if prefix not in ELEMENTS:
            continue

        values = np.asarray(getattr(model, name))
        if values.dtype.kind != "f":
            continue

        fault = np.isnan(values) if name.endswith("range") else ~np.isfinite(values)
        if fault.any():
            row = int(np.argwhere(fault)[0][0])
            value = float(values[fault][0])
            raise ModelError(
                f"{path}: {name} of {_element(model, prefix, row)} is {value:g} in the compiled "
                "model; every number of a model must be finite"
            )


def _element(model: Any, prefix: str, row: int) -> str:
    """Kind and name of the element to which a row of an array belongs."""
    if prefix == "dof":
        row = int(model.dof_jntid[row])
    kind = ELEMENTS[prefix].name.removeprefix("mjOBJ_").lower()
    name = mujoco.mj_id2name(model, int(ELEMENTS[prefix]), row)
    return f"{kind} {name!r}" if name else f"{kind} number {row}"

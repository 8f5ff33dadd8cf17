"""List of the files that a model needs: the MJCF or URDF file, what it includes, and its assets."""

from __future__ import annotations

import os
from pathlib import Path

from mjfim.model.included_files import read_elements, read_with_included_files

# Attributes of <compiler> that state the folder of meshes or images.
FOLDERS = ("assetdir", "meshdir", "texturedir")

# Beginning of the attributes that name files: `file`, `fileright` and so on, and `filename` of a
# URDF.
FILE_ATTRIBUTE = "file"

# Elements whose file is a model of its own, with folders of its own.
MODEL_ELEMENT = "model"

# Separates the kind of a URI from its path, as in package://meshes/arm.stl.
URI_SEPARATOR = "://"


def files_of_model(path: Path) -> tuple[Path, ...]:
    """List the files of a model.

    A name is looked for in every folder in which MuJoCo may look for it, and all files that are
    found there are listed. So the list may hold a file too many, but lacks none.

    Args:
        path: The MJCF or URDF file.

    Returns:
        The file itself, then the files that it includes, models that it attaches, and assets. Only
        existing files are listed.
    """
    found = dict.fromkeys([path])
    mains = [path]

    # The list of models grows while it is read.
    for main in mains:
        names = _FileNames(main)
        for file in names.files():
            found.setdefault(Path(os.path.normpath(file)))
        mains += [model for model in names.models() if model not in mains]
    return tuple(found)


class _FileNames:
    """Names of files in an MJCF file and in the files that it includes.

    Args:
        main: The file of the model.
    """

    def __init__(self, main: Path) -> None:
        self._places = {main.parent}
        self._folders = {Path()}
        self._names: dict[str, None] = {}
        self._models: dict[str, None] = {}
        read_with_included_files(main, None, self._read)

    def files(self) -> list[Path]:
        """Existing files with the names, in all folders in which they may be."""
        return [file for name in self._names for file in self._found(name)]

    def models(self) -> list[Path]:
        """Existing files of models that are attached."""
        return [Path(os.path.normpath(file)) for name in self._models for file in self._found(name)]

    def _found(self, name: str) -> list[Path]:
        """Existing files with a name: as it is stated, and without its folders."""
        path = Path(name.split(URI_SEPARATOR)[-1])
        candidates = [
            place / folder / stated
            for place in sorted(self._places)
            for folder in sorted(self._folders)
            for stated in dict.fromkeys((path, Path(path.name)))
        ]
        return [file for file in candidates if file.is_file()]

    def _read(self, path: Path, context: None) -> list[tuple[str, None]]:
        """Read the names in one file; returns the files that it includes."""
        included: list[tuple[str, None]] = []
        self._places.add(path.parent)

        def start(tag: str, attributes: dict[str, str]) -> None:
            """Keep the names of files and folders of an element."""
            named = [value for key, value in attributes.items() if key.startswith(FILE_ATTRIBUTE)]
            self._names.update(dict.fromkeys(named))
            if tag == "include":
                included.extend((name, None) for name in named)
            if tag == MODEL_ELEMENT:
                self._models.update(dict.fromkeys(named))
            if tag == "compiler":
                self._folders.update(Path(attributes[key]) for key in FOLDERS if key in attributes)

        return included if read_elements(path, start) else []

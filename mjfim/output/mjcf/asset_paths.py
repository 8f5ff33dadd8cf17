"""Asset folders and included files of an MJCF that is written to another folder."""

from __future__ import annotations

import os
from collections.abc import Iterable
from pathlib import Path
from typing import Any

from mjfim.output.mjcf.document import MjcfDocument

# Folders that <compiler> may state for one type of asset; `assetdir` is used for both.
TYPED_FOLDERS = ("meshdir", "texturedir")


def relocate_assets(document: MjcfDocument, spec: Any, source: Path, target: Path) -> None:
    """Change asset folders and `<include>`s so that a text of one folder loads from another one.

    Folders from which the model reads no file are not changed.

    Args:
        document: The text.
        spec: MjSpec of the text.
        source: Folder from which the text loads now.
        target: Folder from which it has to load.
    """
    if source == target:
        return

    for i, tag in enumerate(document.tags):
        if tag.name == "include" and "file" in tag.attributes:
            document.set(i, "file", _relocated(tag.attributes["file"], source, target))

    used = _used_folders(document, spec)
    compilers = document.top_level("compiler")
    stated = set()
    for i in compilers:
        for folder in used:
            value = document.attribute(i, folder)
            if value is not None:
                document.set(i, folder, _relocated(value, source, target))
                stated.add(folder)

    # Without a stated folder MuJoCo looks for the files beside the text.
    missing = [folder for folder in TYPED_FOLDERS if folder in used and folder not in stated]
    if "assetdir" in stated or not missing:
        return
    folder = _relocated("", source, target)
    if compilers:
        document.set(compilers[-1], "assetdir", folder)
    else:
        document.insert_child(0, "compiler", {"assetdir": folder})


def _used_folders(document: MjcfDocument, spec: Any) -> list[str]:
    """Return the attributes of <compiler> that name a folder from which the model reads files."""
    parts = [element.file for element in (*spec.meshes, *spec.hfields, *spec.skins)]
    parts += [tag.attributes.get("file", "") for tag in document.tags if tag.name == "flexcomp"]

    pictures = []
    for texture in spec.textures:
        pictures += [texture.file, *texture.cubefiles]

    files = {"meshdir": parts, "texturedir": pictures}
    used = [folder for folder in TYPED_FOLDERS if _any_relative(files[folder])]
    return [*used, "assetdir"] if used else []


def _any_relative(files: Iterable[str]) -> bool:
    """Return whether some file is named relative to a folder."""
    return any(file and not Path(file).is_absolute() for file in files)


def _relocated(name: str, source: Path, target: Path) -> str:
    """Return the name, relative to `target`, of a file that is named relative to `source`."""
    if Path(name).is_absolute():
        return name
    return Path(os.path.relpath(source / name, target)).as_posix()

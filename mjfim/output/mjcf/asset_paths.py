"""Asset folders and included files of an MJCF that is written to another folder.

MuJoCo looks for an asset or an included file relative to the folder of the main file, and if there
is none, relative to that of the file that names it.
"""

from __future__ import annotations

import os
from collections.abc import Iterable, Mapping, Sequence
from pathlib import Path
from typing import Any

from mjfim.output.mjcf.document import MjcfDocument, SourceFile

# Folders that <compiler> may state for one type of asset; `assetdir` is used for both.
TYPED_FOLDERS = ("meshdir", "texturedir")

# Elements that name files in these folders, by attributes whose names begin with `file`.
ASSETS = ("mesh", "texture", "hfield", "skin", "flexcomp")


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

    beside = {file.include for file in document.files if file.is_beside}
    for i, tag in enumerate(document.tags):
        if tag.name == "include" and "file" in tag.attributes and i not in beside:
            document.set(i, "file", _relocated(tag.attributes["file"], source, target))
    for file in document.files[1:]:
        _name_assets(document, file, spec, source)

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


def attach_files(
    document: MjcfDocument, source: Path, target: Path, files: Mapping[Path, Path]
) -> None:
    """Let a text attach other files in place of some models, and find the others from its folder.

    Args:
        document: The text.
        source: Folder from which the text loads now.
        target: Folder from which it has to load.
        files: New files by the resolved paths of the present ones.
    """
    for i, tag in enumerate(document.tags):
        name = tag.attributes.get("file", "")
        if tag.name != "model" or not name:
            continue
        new = files.get((source / name).resolve())
        if new is not None:
            document.set(i, "file", Path(os.path.relpath(new.resolve(), target)).as_posix())
        elif source != target and (source / name).is_file():
            document.set(i, "file", _relocated(name, source, target))


def point_to_copies(
    document: MjcfDocument, names: Sequence[str], spec: Any, source: Path, target: Path
) -> list[int]:
    """Let a main file in one folder include the changed files, which are written beside it.

    Args:
        document: The texts.
        names: Name of the copy of each file, in the order of the document.
        spec: MjSpec of the text.
        source: Folder of the user's main file.
        target: Folder of the new main file.

    Returns:
        Indices of the changed files without the main file, the innermost first.
    """
    # A file that includes a changed one changes, too. Included files follow the including ones.
    changed = []
    for i in reversed(range(1, len(document.files))):
        file = document.files[i]
        if file.text.is_edited:
            document.set(file.include, "file", names[i])
            changed.append(i)

    # What an original finds in its own folder, the copy has to find from another one.
    for i in changed:
        own = document.tags_of(document.files[i])
        _name_assets(document, document.files[i], spec, source)
        for other in document.files:
            if other.include in own and other.is_beside and not other.text.is_edited:
                name = Path(os.path.relpath(other.path, target)).as_posix()
                document.set(other.include, "file", name)
    return changed


def _name_assets(document: MjcfDocument, file: SourceFile, spec: Any, source: Path) -> None:
    """Name the assets that an included file finds in its own folder relative to the main file."""
    own = file.path.parent
    for i in document.tags_of(file):
        tag = document.tags[i]
        if tag.name not in ASSETS:
            continue

        folder = source / (spec.texturedir if tag.name == "texture" else spec.meshdir)
        # The folder of the file is relative to the assets' where the main path was relative.
        others = (folder / os.path.relpath(own, source), own)
        for attribute, name in tag.attributes.items():
            is_file = attribute.startswith("file") and not Path(name).is_absolute()
            if not is_file or (folder / name).is_file():
                continue
            found = next((other / name for other in others if (other / name).is_file()), None)
            if found is not None:
                document.set(i, attribute, Path(os.path.relpath(found, folder)).as_posix())


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

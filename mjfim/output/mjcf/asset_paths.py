"""An MJCF that moves to another folder: the places at which it finds its files are said from there."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

from mjfim.output.mjcf.document import Sheet


def repoint(sheet: Sheet, spec: Any, source: Path, target: Path) -> None:
    """Change asset folders and `<include>`s of a text from folder `source` so that it loads from folder `target`.

    spec: what the text says; folders are left alone where it reads no file from them
    """
    if source == target:
        return
    for i, tag in enumerate(sheet.tags):
        if tag.name == "include" and "file" in tag.attributes:
            sheet.set(i, "file", _from(target, source, tag.attributes["file"]))
    parts = [element.file for element in (*spec.meshes, *spec.hfields, *spec.skins)]
    parts += [tag.attributes.get("file", "") for tag in sheet.tags if tag.name == "flexcomp"]
    pictures = [file for texture in spec.textures for file in (texture.file, *texture.cubefiles)]
    read = {"meshdir": _beside(parts), "texturedir": _beside(pictures)}
    read["assetdir"] = any(read.values())
    compilers, said = sheet.top("compiler"), set()
    for i in compilers:
        for folder in read:
            value = sheet.attribute(i, folder)
            if value is not None and read[folder]:
                sheet.set(i, folder, _from(target, source, value))
                said.add(folder)
    if "assetdir" in said or not any(
        read[folder] and folder not in said for folder in ("meshdir", "texturedir")
    ):
        return
    if compilers:
        sheet.set(compilers[-1], "assetdir", _from(target, source, ""))
    else:
        sheet.insert(0, "compiler", {"assetdir": _from(target, source, "")})


def _beside(files: list[str]) -> bool:
    """True where some file is named relative to a folder."""
    return any(file and not Path(file).is_absolute() for file in files)


def _from(target: Path, source: Path, name: str) -> str:
    """A file or folder that is named from `source`, named from `target`."""
    return (
        name
        if Path(name).is_absolute()
        else Path(os.path.relpath(source / name, target)).as_posix()
    )

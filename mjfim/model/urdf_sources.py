"""URDF files from which a model comes: the model itself, or what an MJCF attaches."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from xml.etree import ElementTree

from mjfim.model.included_files import (
    included_file,
    read_elements,
    read_with_included_files,
)


@dataclass(frozen=True, kw_only=True)
class UrdfSource:
    """A URDF whose links and joints are bodies and joints of a model.

    Attributes:
        path: The URDF.
        prefixes: What the names of its links and joints begin with in the model, once for each
            time that it is attached.
    """

    path: Path
    prefixes: tuple[str, ...]


def is_urdf(path: Path) -> bool:
    """Whether a model file is a URDF.

    Args:
        path: The file.
    """
    try:
        for _, element in ElementTree.iterparse(path, events=("start",)):
            return bool(element.tag == "robot")
    except (OSError, ElementTree.ParseError):
        return False
    return False


def urdf_sources(path: Path) -> tuple[UrdfSource, ...]:
    """Find the URDFs from which a model comes.

    Args:
        path: The model file. A URDF is its own source; an MJCF may attach several ones.

    Returns:
        The URDFs in the order in which the MJCF names them; none for other models.
    """
    if is_urdf(path):
        return (UrdfSource(path=path, prefixes=("",)),)

    attached = _Attached(path)
    found: dict[Path, list[str]] = {}
    for name, prefix in attached.attachments:
        file = attached.files.get(name)
        if file is not None and is_urdf(file):
            found.setdefault(file, []).append(prefix)
    return tuple(UrdfSource(path=file, prefixes=tuple(each)) for file, each in found.items())


class _Attached:
    """Models that an MJCF attaches.

    Attributes:
        files: Files of the models by their names in the MJCF.
        attachments: Name of the model and prefix of each `<attach>`.
    """

    def __init__(self, main: Path) -> None:
        """Read an MJCF and the files that it includes."""
        self.files: dict[str, Path] = {}
        self.attachments: list[tuple[str, str]] = []
        self._main = main
        read_with_included_files(main, None, self._read)

    def _read(self, path: Path, context: None) -> list[tuple[str, None]]:
        """Read the models of one file; return the files that it includes."""
        included: list[tuple[str, None]] = []

        def start(tag: str, attributes: dict[str, str]) -> None:
            """Keep what an element says about models."""
            if tag == "include" and "file" in attributes:
                included.append((attributes["file"], None))
            elif tag == "model" and "file" in attributes:
                file = included_file(self._main, path, attributes["file"])
                if file is not None:
                    self.files.update((name, file) for name in _names_of(attributes, file))
            elif tag == "attach" and "model" in attributes:
                self.attachments.append((attributes["model"], attributes.get("prefix", "")))

        return included if read_elements(path, start) else []


def _names_of(attributes: dict[str, str], file: Path) -> Iterator[str]:
    """Yield the name of a model in an MJCF; without a stated one, that in its file."""
    if "name" in attributes:
        yield attributes["name"]
        return
    try:
        yield ElementTree.parse(file).getroot().get("name", "")
    except (OSError, ElementTree.ParseError):
        return

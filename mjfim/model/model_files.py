"""The files of a model: its MJCF or URDF, what it includes and attaches, and its assets."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Container, Iterable, Iterator, Mapping
from dataclasses import field
from graphlib import CycleError, TopologicalSorter
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

from mjfim.arrays import record
from mjfim.errors import ExperimentError, ModelError
from mjfim.parallel.shared_value import SharedValue

# Attributes of <compiler> that state the folder of meshes or images.
FOLDERS = ("assetdir", "meshdir", "texturedir")

# Beginning of the attributes that name files: `file`, `fileright` and so on, and `filename` of a
# URDF.
FILE_ATTRIBUTE = "file"

# Separates the kind of a URI from its path, as in package://meshes/arm.stl.
URI_SEPARATOR = "://"

# Beginning of the URIs of ROS, and of the names of custom texts of an MJCF that state the folder of
# a package.
PACKAGE = "package://"


def included_file(main: Path, including: Path, name: str) -> Path | None:
    """Find the file that an `<include>` names.

    Args:
        main: The main file of the model.
        including: The file that contains the `<include>`.
        name: The name that it states.

    Returns:
        The file, beside the main file or beside the including one; None where there is none.
    """
    places = (main.parent / name, including.parent / name)
    return next((place for place in places if place.is_file()), None)


def elements_of(main: Path) -> Iterator[tuple[Path, Any]]:
    """Yield all XML elements of a model file and of the files that it includes, with their file.

    Files that are no XML have no elements. A file that is included several times is read once.
    """
    waiting = [main]
    known = {main.resolve()}
    # The list grows while it is read.
    for path in waiting:
        root = _root(path)
        for element in () if root is None else root.iter():
            yield path, element
            if element.tag == "include" and "file" in element.attrib:
                other = included_file(main, path, element.attrib["file"])
                if other is not None and other.resolve() not in known:
                    known.add(other.resolve())
                    waiting.append(other)


def files_of_model(path: Path) -> tuple[Path, ...]:
    """List the files of a model.

    Args:
        path: The MJCF or URDF file.

    Returns:
        Existing files that MuJoCo may read for the model, the model first. Where a name fits
        several files, all of them are listed.

    Raises:
        ModelError: A file is a pipe or a device, or a model attaches itself.
    """
    found = dict.fromkeys([path])
    mains = [path]
    attached: dict[Path, set[Path]] = {}
    # The list of models grows while it is read.
    for main in mains:
        places, folders = {main.parent}, {Path()}
        packages: dict[str, str] = {}
        names: dict[str, bool] = {}
        for file, element in elements_of(main):
            places.add(file.parent)
            for key, value in element.attrib.items():
                if key.startswith(FILE_ATTRIBUTE):
                    names[value] = names.get(value, False) or element.tag == "model"
                elif element.tag == "compiler" and key in FOLDERS:
                    folders.add(Path(value))
            if element.tag == "text" and element.get("name", "").startswith(PACKAGE):
                packages[element.attrib["name"].removeprefix(PACKAGE)] = element.get("data", "")
        for name, is_model in names.items():
            in_package = package_file(name, main, packages) if name.startswith(PACKAGE) else None
            files = _existing(name, places, folders) if in_package is None else [in_package]
            found.update(dict.fromkeys(files))
            mains += [file for file in files if is_model and file not in mains]
            if is_model and (main.parent / name).is_file():
                attached.setdefault(main.resolve(), set()).add((main.parent / name).resolve())
    try:
        TopologicalSorter(attached).prepare()
    except CycleError as error:
        circle = ", ".join(file.name for file in error.args[1])
        raise ModelError(f"{path}: a model attaches itself ({circle})") from None
    return tuple(found)


def package_file(
    name: str, main: Path, packages: Mapping[str, str], held: Container[str] = ()
) -> Path | None:
    """The file that a URI of ROS names, as in package://robot/meshes/arm.stl.

    Args:
        name: The URI.
        main: The model file.
        packages: Folders of packages by name; others are looked for in ROS_PACKAGE_PATH and in the
            folders above the model.
        held: Paths of files that are not on the disk.

    Returns:
        The first place where the package has the file; None where there is none.
    """
    package, _, inside = name.removeprefix(PACKAGE).partition("/")
    roots = [
        Path(each) for each in os.environ.get("ROS_PACKAGE_PATH", "").split(os.pathsep) if each
    ]
    roots += Path(os.path.abspath(main)).parents
    places = [root if root.name == package else root / package for root in roots]
    if package in packages:
        places.insert(0, Path(packages[package]))
    files = [place / inside for place in places]
    return next((file for file in files if file.as_posix() in held or is_present(file)), None)


def is_present(file: Path) -> bool:
    """Whether there is a regular file.

    Raises:
        ModelError: There is something of which reading may never end.
    """
    is_regular = os.path.isfile(file)
    if os.path.exists(file) and not (is_regular or os.path.isdir(file)):
        raise ModelError(f"{file}: a pipe or a device; a model is read from regular files only")
    return is_regular


def is_urdf(path: Path) -> bool:
    """Whether a model file is a URDF."""
    root = _root(path)
    return root is not None and root.tag == "robot"


def urdf_sources(path: Path) -> dict[Path, tuple[str, ...]]:
    """Find the URDFs whose links and joints are bodies and joints of a model.

    Args:
        path: The model file.

    Returns:
        The model itself where it is a URDF; otherwise those that an MJCF attaches. Each has what
        stands before the names of its links and joints in the model, once for each time that it is
        attached.
    """
    if is_urdf(path):
        return {path: ("",)}

    files: dict[str, Path] = {}
    attachments = []
    for including, element in elements_of(path):
        if element.tag == "model" and "file" in element.attrib:
            included = included_file(path, including, element.attrib["file"])
            if included is not None and (root := _root(included)) is not None:
                # Without a stated name, a model has the one in its file.
                files[element.get("name", root.get("name", ""))] = included
        elif element.tag == "attach" and "model" in element.attrib:
            attachments.append((element.attrib["model"], element.get("prefix", "")))

    found: dict[Path, tuple[str, ...]] = {}
    for name, prefix in attachments:
        file = files.get(name)
        if file is not None and is_urdf(file):
            found[file] = (*found.get(file, ()), prefix)
    return found


def _root(path: Path) -> Any:
    """The main element of an XML file; None where it is none."""
    try:
        return ElementTree.parse(path).getroot()
    except (OSError, ElementTree.ParseError):
        return None


def _existing(name: str, places: set[Path], folders: set[Path]) -> list[Path]:
    """Existing files with a name: as it is stated, and without its folders."""
    path = Path(name.split(URI_SEPARATOR)[-1])
    candidates = [
        place / folder / stated
        for place in sorted(places)
        for folder in sorted(folders)
        for stated in dict.fromkeys((path, Path(path.name)))
    ]
    return [Path(os.path.normpath(file)) for file in candidates if is_present(file)]


@record
class PackedFiles:
    """Files by their paths, as bytes. They can be pickled.

    Attributes:
        digest: Hash of all paths and contents; equal for equal files only.
        held: Bytes of each file by its path, with slashes; or a reference to them, under which they
            are pickled as their hash.
    """

    digest: str
    held: Mapping[str, bytes] | SharedValue[Mapping[str, bytes]] = field(repr=False, compare=False)

    @classmethod
    def of(cls, contents: Mapping[Path, bytes]) -> PackedFiles:
        """Pack files.

        Args:
            contents: Bytes of each file by its path.
        """
        named = {name_of(path): content for path, content in contents.items()}
        ordered = dict(sorted(named.items()))

        # The length of each part tells where it ends, so that other files have another hash.
        hashed = hashlib.sha256()
        for name, content in ordered.items():
            for part in (name.encode(), content):
                hashed.update(len(part).to_bytes(8, "big"))
                hashed.update(part)
        return cls(digest=hashed.hexdigest(), held=ordered)

    @classmethod
    def read(cls, paths: Iterable[Path], packed: PackedFiles) -> PackedFiles:
        """Pack files from the disk.

        Args:
            paths: The files.
            packed: Files that are packed already, which are not read again.

        Raises:
            ExperimentError: A file cannot be read.
        """
        contents = {}
        for path in paths:
            kept = packed.content(path)
            contents[path] = _read(path) if kept is None else kept
        return cls.of(contents)

    @property
    def contents(self) -> Mapping[str, bytes]:
        """Bytes of each file by its path, with slashes.

        Raises:
            AbsentValueError: This process has received the hash only.
        """
        return self.held.value if isinstance(self.held, SharedValue) else self.held

    def shared(self) -> PackedFiles:
        """Return these files for tasks, each of which is sent with their hash alone."""
        if isinstance(self.held, SharedValue):
            return self
        size = sum(map(len, self.held.values()))
        return PackedFiles(digest=self.digest, held=SharedValue.of(self.digest, self.held, size))

    def with_model(self, path: Path) -> PackedFiles:
        """Return these files with those of a model, which are read if it is not among them.

        Raises:
            ModelError: There is no such model file.
            ExperimentError: A file cannot be read.
        """
        if self.content(path) is not None:
            return self
        if not is_present(path):
            raise ModelError(
                f"model: {path}: no such model file; state the path of an MJCF or URDF, which "
                "begins in the folder of the experiment file"
            )
        return PackedFiles.read([*map(Path, self.contents), *files_of_model(path)], self)

    def content(self, path: Path) -> bytes | None:
        """Return the bytes of a file; None if it is not among the packed files."""
        return self.contents.get(name_of(path))


def changed_files(contents: Mapping[Path, bytes]) -> list[Path]:
    """Return the files that are not on the disk with these contents."""
    return [x for x, held in contents.items() if not x.is_file() or x.read_bytes() != held]


def name_of(path: Path) -> str:
    """Return the normalised path of a file with slashes."""
    return Path(os.path.normpath(path)).as_posix()


def _read(path: Path) -> bytes:
    """Return the content of a file."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise ExperimentError(f"{path}: cannot read the file: {error.strerror}") from None

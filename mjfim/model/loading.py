"""Load and compile MJCF models."""

from __future__ import annotations

import multiprocessing
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from functools import cached_property
from pathlib import Path
from threading import Lock, RLock
from types import MappingProxyType
from typing import Any
from weakref import WeakValueDictionary

import mujoco

from mjfim.errors import ModelError, ModelWarning
from mjfim.model.coordinates import ModelCoordinates
from mjfim.model.model_files import (
    PACKAGE,
    PackedFiles,
    changed_files,
    files_of_model,
    is_present,
    name_of,
    package_file,
)
from mjfim.model.terms.term import StateLayout, Term, extended_spec
from mjfim.parallel.shared_value import Kept

# No folders of ROS packages.
NO_PACKAGES: Mapping[str, str] = MappingProxyType({})


def load_spec(path: Path, files: Any = None, packages: Mapping[str, str] = NO_PACKAGES) -> Any:
    """MjSpec of an MJCF or URDF file. What MuJoCo warns of is told once.

    Args:
        path: The file.
        files: Virtual file system (`mujoco.MjVfs`) that holds it; None for the disk.
        packages: Folders of ROS packages by name, besides those that the file states.

    Raises:
        ModelError: The file is absent or no model, or MuJoCo cannot read it.
    """
    if files is None and not is_present(path):
        raise ModelError(f"{path}: no such model file")
    if path.suffix.lower() == ".toml":
        raise ModelError(
            f"{path}: an experiment file, but a model (MJCF or URDF) is needed, such as the one "
            "that this file states"
        )
    name = str(path) if files is None else path.as_posix()
    if files is None:
        files_of_model(path)  # refuses pipes and circles before MuJoCo follows them without end
    try:
        with collected_warnings(of_reader=True) as found:
            spec = mujoco.MjSpec.from_file(name, vfs=files)
    except ValueError as error:
        raise ModelError(f"{path}: MuJoCo cannot read the model: {str(error).strip()}") from None

    # MuJoCo takes NaN for a number that is not stated, or computes with it.
    if any("NaN" in warning for warning in found):
        raise ModelError(f"{path}: the model contains NaN; every number must be finite")
    tell_once(path, (f"MuJoCo warns: {text}" for text in found))
    resolve_packages(spec, path, files, packages)
    return spec


def resolve_packages(
    spec: Any, path: Path, files: Any = None, packages: Mapping[str, str] = NO_PACKAGES
) -> None:
    """Find the meshes that a URDF states as files of ROS packages, in place.

    Geoms whose mesh is not found are left out, and a warning says so.

    Args:
        spec: The spec (`mujoco.MjSpec`), which may state the folders of packages as custom texts.
        path: The file that it was read from.
        files: Virtual file system (`mujoco.MjVfs`) that holds the meshes; None for the disk.
        packages: Folders of ROS packages by name, besides those that the spec states.
    """
    stated = {text.name: text.data for text in spec.texts if text.name.startswith(PACKAGE)}
    packages = {name.removeprefix(PACKAGE): each for name, each in stated.items()} | dict(packages)
    absent: dict[str, list[str]] = {}
    for mesh in spec.meshes:
        if not mesh.file.startswith(PACKAGE):
            continue
        found = package_file(mesh.file, path, packages, () if files is None else files)
        if found is None:
            absent.setdefault(mesh.file.split("/")[2], []).append(mesh.name)
        else:
            mesh.file = found.as_posix()
    names = {name for each in absent.values() for name in each}
    left_out = [geom for geom in spec.geoms if geom.meshname in names]
    left_out += [mesh for mesh in spec.meshes if mesh.name in names]
    for element in left_out:
        spec.delete(element)
    for package, meshes in absent.items():
        message = (
            f"meshes of the package {package!r} are not found and left out ({len(meshes)}); masses "
            f"and inertias of links do not change. State its folder: `mjfim init URDF --package "
            f"{package}=DIR`, or in ROS_PACKAGE_PATH"
        )
        tell_once(path, [message])


def compile_spec(spec: Any, path: Path, *, tells: bool = False, files: Any = None) -> Any:
    """MjModel of a spec.

    Args:
        spec: The spec (`mujoco.MjSpec`).
        path: The file that it was read from, for the message.
        tells: Whether MuJoCo's warnings are told; those about an edited copy are not.
        files: Virtual file system (`mujoco.MjVfs`) with the assets; None for the disk.

    Raises:
        ModelError: MuJoCo cannot compile the spec; the message is MuJoCo's.
    """
    try:
        with collected_warnings() as found:
            model = spec.compile(files)
    except (ValueError, mujoco.FatalError) as error:
        told = str(error).removeprefix("Error: ").strip()
        raise ModelError(f"{path}: MuJoCo cannot compile the model: {told}") from None

    if tells:
        tell_once(path, (f"MuJoCo warns: {text}" for text in found))
    return model


# Largest number of compiled models of edited specs that a source keeps; a search revisits few
# parameter values.
MAX_EDITED_MODELS = 512


class ModelSource:
    """An MJCF file that is parsed only once.

    It is compiled once more for each set of bodies whose inertia may change, where MuJoCo treats
    one of them as "simple". All variants of a plant are copies of these compiled models with other
    settings.

    Attributes:
        path: The MJCF file.
        spec: The parsed model with its terms (MjSpec), never changed.
        model: The compiled model with its terms (MjModel), never changed.
        terms: The physical terms by which the file is extended, by name.
        layout: Where the state of the file is in that of the model; None without terms.
    """

    def __init__(self, path: Path, spec: Any = None, files: Any = None) -> None:
        """Parse and compile a file.

        Args:
            path: The MJCF file; relative paths inside are relative to its folder.
            spec: The parsed model, where there is one already.
            files: Virtual file system (`mujoco.MjVfs`) with the file, what it includes, and its
                assets; None for the disk.

        Raises:
            ModelError: The file is absent, MuJoCo cannot read or compile it, or a number is not
                finite.
        """
        self.path = path
        self.spec = load_spec(path, files) if spec is None else spec
        self.model = compile_spec(self.spec, path, tells=True, files=files)
        self.terms: dict[str, Term] = {}
        self.layout: StateLayout | None = None
        self.files = files

        # The model without terms where this one has some, and its extensions that are in use. An
        # extension refers to the stated model, which must not refer to it in turn.
        self._stated: ModelSource | None = None
        # Copies of this model with custom numbers are kept as well.
        self._derived: WeakValueDictionary[tuple[Any, ...], ModelSource] = WeakValueDictionary()

        # Several threads of a worker process may use the same model. The edit of a spec may ask for
        # another compiled model.
        self._lock = RLock()
        self._edited: dict[tuple[frozenset[str] | None, bytes], Any] = {}

    @property
    def stated(self) -> ModelSource:
        """The model of the file, without terms."""
        return self if self._stated is None else self._stated

    def extended(self, terms: Sequence[Term]) -> ModelSource:
        """The model of the file with physical terms, compiled once as long as it is in use.

        Args:
            terms: The terms, resolved against `stated.model`.

        Returns:
            The extended model; `stated` without terms.

        Raises:
            ModelError: MuJoCo cannot compile the extended model.
        """
        stated, key = self.stated, tuple(terms)
        if not key:
            return stated

        with stated._lock:
            found = stated._derived.get(key)
            if found is None:
                path, files = stated.path, stated.files
                spec, layout = extended_spec(
                    stated.spec,
                    stated.model,
                    key,
                    lambda edited: compile_spec(edited, path, files=files),
                )
                found = ModelSource(path, spec, files)
                found.terms = {term.name: term for term in key}
                found.layout = layout
                found._stated = stated
                stated._derived[key] = found
            return found

    def with_elements(self, key: tuple[Any, ...], add: Callable[[Any], object]) -> ModelSource:
        """This model with elements that are no terms, compiled once while in use.

        Args:
            key: Identifies the elements.
            add: Adds them to an MjSpec, and may change it.

        Returns:
            The model; it has the terms of this one, and the same model of the file.
        """
        with self._lock:
            found = self._derived.get(key)
            if found is None:
                spec = self.spec.copy()
                add(spec)
                found = ModelSource(self.path, spec, self.files)
                found.terms, found.layout = self.terms, self.layout
                found._stated = self.stated
                self._derived[key] = found
            return found

    @cached_property
    def contents(self) -> dict[Path, bytes]:
        """Bytes of the model's files by their paths, as they were loaded."""
        return {file: file.read_bytes() for file in files_of_model(self.path)}

    def read(self, path: Path) -> bytes:
        """Return the bytes of a file of the model, as it was loaded."""
        contents = {file.resolve(): each for file, each in self.stated.contents.items()}
        return contents.get(path.resolve()) or path.read_bytes()

    @cached_property
    def added(self) -> frozenset[int]:
        """Addresses in the state (qpos, qvel) that physical terms have added."""
        return frozenset() if self.layout is None else self.layout.added

    @cached_property
    def held_joints(self) -> frozenset[str]:
        """Joints that physical terms have added and that contacts hold."""
        return frozenset(joint for term in self.terms.values() for joint in term.held_joints)

    @cached_property
    def coordinates(self) -> ModelCoordinates:
        """The coordinates of the model by name."""
        return ModelCoordinates.of(self.model, self.added)

    @cached_property
    def decoration(self) -> frozenset[str]:
        """Names of geoms whose place and size can be changed without a compile."""
        return decoration(self.spec, self.model)

    def compiled(self, moved_bodies: frozenset[str] | None) -> Any:
        """The compiled model in which the inertia of some bodies may be written.

        Args:
            moved_bodies: Bodies that MuJoCo must not treat as "simple", because parameters change
                their inertial frame; None for all bodies.

        Returns:
            MjModel that callers copy and never change.
        """
        # Where MuJoCo treats none of them as simple, another compile would give the same model. A
        # body without a number was merged with its parent.
        model = self.model
        simple = {model.body(i).name: model.body_simple[i] for i in range(1, model.nbody)}
        moved = simple if moved_bodies is None else moved_bodies
        if not any(simple.get(name, True) for name in moved):
            return self.model
        return self.edited(moved_bodies, b"", lambda spec: None)

    def edited(
        self, moved_bodies: frozenset[str] | None, key: bytes, edit: Callable[[Any], None]
    ) -> Any:
        """The compiled model of an edited copy of the spec, kept under a key.

        Args:
            moved_bodies: As for `compiled`.
            key: Identifies the edit; for a known key the kept model is returned.
            edit: Changes an MjSpec in place.

        Returns:
            MjModel that callers copy and never change.

        Raises:
            ModelError: The edited spec does not compile.
        """
        place = (moved_bodies, key)
        with self._lock:
            if place not in self._edited:
                if len(self._edited) >= MAX_EDITED_MODELS:
                    self._edited.clear()
                spec = self.spec.copy()
                for body in spec.bodies[1:]:
                    if moved_bodies is None or body.name in moved_bodies:
                        body.simple = 0
                edit(spec)
                self._edited[place] = compile_spec(spec, self.path, files=self.files)
            return self._edited[place]


def decoration(spec: Any, model: Any) -> frozenset[str]:
    """Names of geoms that neither collide nor contribute to the inertia of their body.

    Their size and position can be changed without a compile.
    """
    forced = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    return frozenset(
        geom.name
        for geom in spec.geoms
        if geom.name
        and geom.name not in paired
        and not (model.geom_contype[geom.id] or model.geom_conaffinity[geom.id])
        and not geom.fluid_ellipsoid
        and (geom.mass == 0.0 or (geom.parent.explicitinertial and not forced))
        and not geom.meshname
    )


# Guards the settings of MuJoCo's log, which all threads share.
_lock = Lock()

# Parts of warnings about nothing that concerns a user: attached models keep the names of their
# elements, and what a later version of MuJoCo will not read still holds in the present one.
MEANINGLESS = ("Attaching a spec with an empty prefix", "is deprecated and will be removed")

# Warnings that were told, each with its file.
_told: set[tuple[Path, str]] = set()

# One entry for each block that is open in any thread: the settings before the first of them.
_open_blocks: list[Any] = []


@contextmanager
def silence_mujoco_log() -> Iterator[None]:
    """Suppress MuJoCo's messages inside the block.

    The previous settings are restored when the last open block of all threads ends.

    Yields:
        Nothing.
    """
    with _lock:
        current = mujoco.MjLogConfig.get()
        _open_blocks.append(_open_blocks[0] if _open_blocks else current)

        silent = mujoco.MjLogConfig.get()
        silent.logto_console = False
        silent.logto_file = False
        mujoco.MjLogConfig.set(silent)

    try:
        yield
    finally:
        with _lock:
            before = _open_blocks.pop()
            if not _open_blocks:
                mujoco.MjLogConfig.set(before)


@contextmanager
def collected_warnings(*, of_reader: bool = False) -> Iterator[list[str]]:
    """Collect the warnings of MuJoCo's reader or compiler instead of showing them.

    Args:
        of_reader: Whether the block reads a file. The reader warns by a callback, the compiler
            through Python. The callback is left alone for a compile, which may use threads.

    Yields:
        The warnings with a meaning for the user, complete when the block has ended.
    """
    found: list[str] = []
    before = mujoco.get_mju_user_warning()
    with silence_mujoco_log(), warnings.catch_warnings(record=True) as recorded:
        warnings.simplefilter("always")
        if of_reader:
            mujoco.set_mju_user_warning(found.append)
        try:
            yield found
        finally:
            if of_reader:
                mujoco.set_mju_user_warning(before)

    found += [str(each.message) for each in recorded]
    found[:] = [text for text in found if not any(part in text for part in MEANINGLESS)]


@contextmanager
def refused(fault: str) -> Iterator[None]:
    """Raise ModelError with a fault and MuJoCo's reason where it refuses a model; no warnings."""
    try:
        with collected_warnings():
            yield
    except (ValueError, mujoco.FatalError) as error:
        raise ModelError(f"{fault} ({' '.join(str(error).split())})") from None


def tell_once(path: Path, messages: Iterable[str]) -> None:
    """Warn about a model file, unless it was told before.

    Worker processes read the files again and stay silent.

    Args:
        path: The file.
        messages: The warnings.
    """
    if multiprocessing.parent_process() is not None:
        return

    for message in messages:
        text = " ".join(message.split())
        if (path, text) not in _told:
            _told.add((path, text))
            warnings.warn(f"{path}: {text}", ModelWarning, stacklevel=3)


# Number of packed models that a process keeps ready for use. A worker seldom serves more studies
# than these in turn, and each model takes the memory of its meshes several times.
KEPT_MODELS = 4


def packed_model(files: PackedFiles, path: Path) -> ModelSource:
    """Return the model of a packed file.

    It is parsed and compiled once in each process, as long as it is among the latest models.

    Args:
        files: Files with the model, what it includes, and its assets.
        path: The MJCF or URDF file.

    Returns:
        The model, which all callers share.

    Raises:
        ModelError: MuJoCo cannot read or compile the model.
    """
    # A second thread that asks for the same model waits until the first one has compiled it.
    key = files.digest, name_of(path)

    def load() -> ModelSource:
        """Parse the model, from the disk where it is the same there; compile the packed files."""
        contents = {Path(name): content for name, content in files.contents.items()}
        system = mujoco.MjVfs()
        for name, content in files.contents.items():
            system[name] = content
        spec = load_spec(path, system if changed_files(contents) else None)
        source = ModelSource(path, spec=spec, files=system)
        source.contents = contents
        return source

    with _packed_lock:
        return _models.get(key, load)


# The latest packed models of this process, by the hash of their files and their name.
_models = Kept[ModelSource](KEPT_MODELS)
_packed_lock = Lock()

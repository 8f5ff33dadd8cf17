"""Load and compile MJCF models."""

from __future__ import annotations

import os
import threading
from collections.abc import Callable, Sequence
from functools import cached_property
from pathlib import Path
from typing import Any
from weakref import WeakValueDictionary

import mujoco

from mjfim.errors import ModelError
from mjfim.model.coordinates import ModelCoordinates
from mjfim.model.model_files import files_of_model
from mjfim.model.mujoco_log import collected_warnings, tell_once
from mjfim.model.terms.extension import StateLayout, extended_spec
from mjfim.model.terms.term import Term


def load_spec(path: Path) -> Any:
    """MjSpec of an MJCF or URDF file. What MuJoCo warns of is told once.

    Args:
        path: The file.

    Raises:
        ModelError: The file is absent or no model, or MuJoCo cannot read it.
    """
    if not path.is_file():
        raise ModelError(f"{path}: no such model file")
    if path.suffix.lower() == ".toml":
        raise ModelError(
            f"{path}: an experiment file, but a model (MJCF or URDF) is needed, such as the one "
            "that this file states"
        )
    return _parsed_spec(path, _engine_path(path), None)


def load_packed_spec(path: Path, files: Any) -> Any:
    """MjSpec of an MJCF or URDF file that is not on the disk.

    Args:
        path: The file.
        files: Virtual file system (`mujoco.MjVfs`) that holds it.

    Raises:
        ModelError: MuJoCo cannot read it.
    """
    return _parsed_spec(path, path.as_posix(), files)


def _parsed_spec(path: Path, name: str, files: Any) -> Any:
    """MjSpec of a file by its name for MuJoCo, on the disk or in a virtual file system."""
    try:
        with collected_warnings(of_reader=True) as found:
            spec = mujoco.MjSpec.from_file(name, vfs=files)
    except ValueError as error:
        raise ModelError(f"{path}: MuJoCo cannot read the model: {str(error).strip()}") from None

    # MuJoCo takes NaN for a number that is not stated, or computes with it.
    if any("NaN" in warning for warning in found):
        raise ModelError(f"{path}: the model contains NaN; every number must be finite")
    tell_once(path, found)
    return spec


def _engine_path(path: Path) -> str:
    """Return a path as MuJoCo needs it, in UTF-8 whatever the locale is.

    Raises ModelError if the path is not UTF-8, or if it has a backslash that is no separator.
    """
    if os.sep == "/" and "\\" in str(path):
        raise ModelError(
            f"{path}: MuJoCo takes a backslash for the separator of folders; rename the file or "
            "its folders"
        )
    try:
        return os.fsencode(path).decode("utf-8")
    except UnicodeDecodeError:
        raise ModelError(
            f"{path}: MuJoCo reads only files whose path is UTF-8; rename the file or its folders"
        ) from None


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
        raise ModelError(f"{path}: MuJoCo cannot compile the model: {str(error).strip()}") from None

    if tells:
        tell_once(path, found)
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
        self.spec = self._loaded(path, files) if spec is None else spec
        self.model = compile_spec(self.spec, path, tells=True, files=files)
        self.terms: dict[str, Term] = {}
        self.layout: StateLayout | None = None
        self._files = files

        # The model without terms where this one has some, and its extensions that are in use. An
        # extension refers to the stated model, which must not refer to it in turn.
        self._stated: ModelSource | None = None
        self._extended: WeakValueDictionary[tuple[Term, ...], ModelSource] = WeakValueDictionary()

        # Copies of this model with custom numbers that are in use.
        self._numbered: WeakValueDictionary[
            tuple[tuple[str, tuple[float, ...]], ...], ModelSource
        ] = WeakValueDictionary()

        # Several threads of a worker process may use the same model. The edit of a spec may ask for
        # another compiled model.
        self._lock = threading.RLock()
        self._compiled: dict[frozenset[str] | None, Any] = {}
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
            found = stated._extended.get(key)
            if found is None:
                found = stated._with_terms(key)
                stated._extended[key] = found
            return found

    def _with_terms(self, terms: tuple[Term, ...]) -> ModelSource:
        """This model with physical terms."""
        spec, layout = extended_spec(
            self.spec,
            self.model,
            terms,
            lambda edited: compile_spec(edited, self.path, files=self._files),
        )
        source = ModelSource(self.path, spec, self._files)
        source.terms = {term.name: term for term in terms}
        source.layout = layout
        source._stated = self
        return source

    @staticmethod
    def _loaded(path: Path, files: Any) -> Any:
        """The parsed model from the disk, or from a virtual file system."""
        return load_spec(path) if files is None else load_packed_spec(path, files)

    def with_numbers(self, numbers: tuple[tuple[str, tuple[float, ...]], ...]) -> ModelSource:
        """This model with custom numbers, compiled once as long as it is in use.

        Args:
            numbers: Names of `numeric` elements of MJCF, each with its numbers; MuJoCo ignores
                them.

        Returns:
            The model; it has the terms of this one, and the same model of the file.
        """
        with self._lock:
            found = self._numbered.get(numbers)
            if found is None:
                spec = self.spec.copy()
                for name, data in numbers:
                    spec.add_numeric(name=name, size=len(data), data=list(data))
                found = ModelSource(self.path, spec, self._files)
                found.terms, found.layout = self.terms, self.layout
                found._stated = self.stated
                self._numbered[numbers] = found
            return found

    @cached_property
    def contents(self) -> dict[Path, bytes]:
        """Bytes of the model's files by their paths, for processes that do not have them."""
        return {file: file.read_bytes() for file in files_of_model(self.path)}

    @cached_property
    def coordinates(self) -> ModelCoordinates:
        """The coordinates of the model by name."""
        added = () if self.layout is None else self.layout.added
        return ModelCoordinates.of(self.model, added)

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
        if not self._has_simple(moved_bodies):
            return self.model

        with self._lock:
            if moved_bodies not in self._compiled:
                spec = self._editable_spec(moved_bodies)
                self._compiled[moved_bodies] = compile_spec(spec, self.path, files=self._files)
            return self._compiled[moved_bodies]

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
                spec = self._editable_spec(moved_bodies)
                edit(spec)
                self._edited[place] = compile_spec(spec, self.path, files=self._files)
            return self._edited[place]

    def _has_simple(self, moved_bodies: frozenset[str] | None) -> bool:
        """Whether the user's compiled model treats a moved body as "simple".

        If it does not, another compile would give the same model.
        """
        simple = self.model.body_simple
        if moved_bodies is None:
            return bool(simple[1:].any())
        kind = mujoco.mjtObj.mjOBJ_BODY
        numbers = [mujoco.mj_name2id(self.model, kind, name) for name in sorted(moved_bodies)]

        # A body without a number was merged with its parent.
        return any(number < 0 or simple[number] for number in numbers)

    def _editable_spec(self, moved_bodies: frozenset[str] | None) -> Any:
        """A copy of the spec in which the moved bodies are not compiled as "simple"."""
        spec = self.spec.copy()
        for body in spec.bodies[1:]:
            if moved_bodies is None or body.name in moved_bodies:
                body.simple = 0
        return spec


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

"""Models from packed files: parsed and compiled once in a process, from memory."""

from __future__ import annotations

import threading
from collections import OrderedDict
from pathlib import Path
from typing import Any

import mujoco

from mjfim.model.loading import ModelSource
from mjfim.model.packed_files import PackedFiles, name_of

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
    return _models.get(files, path)


class _KeptModels:
    """The latest packed models of this process, by the hash of their files."""

    def __init__(self) -> None:
        """Start without any model."""
        self._lock = threading.Lock()
        self._models: OrderedDict[tuple[str, str], ModelSource] = OrderedDict()

    def get(self, files: PackedFiles, path: Path) -> ModelSource:
        """Return the model of a file, and forget the one that was not used for the longest time."""
        key = (files.digest, name_of(path))

        # A second thread that asks for the same model waits until the first one has compiled it.
        with self._lock:
            if key not in self._models:
                self._models[key] = ModelSource(path, files=_file_system(files))
            self._models.move_to_end(key)
            while len(self._models) > KEPT_MODELS:
                self._models.popitem(last=False)
            return self._models[key]


def _file_system(files: PackedFiles) -> Any:
    """Return packed files as a virtual file system of MuJoCo (MjVfs)."""
    system = mujoco.MjVfs()
    for name, content in files.contents.items():
        system[name] = content
    return system


_models = _KeptModels()

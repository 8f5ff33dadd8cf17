"""Models from packed files: parsed and compiled once in a process, from memory."""

from __future__ import annotations

import threading
from pathlib import Path
from typing import Any

import mujoco

from mjfim.model.loading import ModelSource
from mjfim.model.packed_files import PackedFiles, name_of
from mjfim.parallel.kept import Kept

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
    with _lock:
        return _models.get(key, lambda: ModelSource(path, files=_file_system(files)))


def _file_system(files: PackedFiles) -> Any:
    """Return packed files as a virtual file system of MuJoCo (MjVfs)."""
    system = mujoco.MjVfs()
    for name, content in files.contents.items():
        system[name] = content
    return system


# The latest packed models of this process, by the hash of their files and their name.
_models = Kept[ModelSource](KEPT_MODELS)
_lock = threading.Lock()

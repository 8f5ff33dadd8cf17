"""Files: atomic writing under a temporary name, JSON for people, and archives without pickles."""

from __future__ import annotations

import json
import math
import os
import tempfile
import time
import zipfile
import zlib
from collections.abc import Callable, Iterator, Mapping
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

from mjfim.errors import RecordingError

# The command line starts without NumPy, which takes longer to import than all else.
if TYPE_CHECKING:
    import numpy as np

# Permissions of a new file, from which the umask of the process removes some.
DEFAULT_PERMISSIONS = 0o666

# Begin of the names of temporary files, and the age from which on such a file was left by a process
# that was killed [s].
PREFIX = ".mjfim-"
LEFT_OVER_SECONDS = 3600.0

# Temporary files that this process is writing, and folders in which it has looked for left-over
# ones.
_open_files: set[Path] = set()
_tidied_folders: set[Path] = set()


class Guard(Protocol):
    """A rule that decides which existing files may be replaced or removed."""

    def before_replacing(self, temporary: Path, target: Path) -> None:
        """Raise an error if a file may not be replaced.

        Args:
            temporary: The complete new file.
            target: Its final name.
        """

    def may_remove(self, file: Path) -> bool:
        """Say whether a file may be removed.

        Args:
            file: A file that exists.
        """


# The rule that holds now. Without one, every file may be replaced and none removed.
_guard: ContextVar[Guard | None] = ContextVar("guard", default=None)

# What is called with every file that was written, or None.
_observer: ContextVar[Callable[[Path], None] | None] = ContextVar("observer", default=None)


@contextmanager
def observed_by(observer: Callable[[Path], None]) -> Iterator[None]:
    """Call a function with every file that is written in the context.

    Args:
        observer: The function; it gets the final name of the file.
    """
    token = _observer.set(observer)
    try:
        yield
    finally:
        _observer.reset(token)


@contextmanager
def guarded_by(guard: Guard) -> Iterator[None]:
    """Ask a rule before files are replaced or removed in the context.

    Args:
        guard: The rule.
    """
    token = _guard.set(guard)
    try:
        yield
    finally:
        _guard.reset(token)


def remove_earlier_result(file: Path) -> None:
    """Remove a file of an earlier run, if a rule permits it.

    Args:
        file: A file that exists.
    """
    guard = _guard.get()
    if guard is not None and guard.may_remove(file):
        file.unlink()


@contextmanager
def replacing(path: str | Path) -> Iterator[Path]:
    """Write a file under a temporary name and rename it at the end.

    The file appears under its name if the block succeeds. If the block fails, the temporary file is
    removed and an existing file remains unchanged. Missing parent folders are created. Temporary
    files that a killed process left in the folder are removed.

    Args:
        path: Name of the final file.

    Yields:
        Temporary path in the folder of the final file, with an equal suffix.

    Raises:
        OSError: The file cannot be written; the error names the final file.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)

    _remove_left_over_files(path.parent.resolve())

    prefix = f"{PREFIX}{os.getpid()}-"
    handle, name = tempfile.mkstemp(prefix=prefix, suffix=path.suffix, dir=path.parent)
    temporary = Path(name)
    _open_files.add(temporary)
    os.close(handle)

    # mkstemp creates files that only their owner may read; results get the usual permissions.
    os.chmod(name, DEFAULT_PERMISSIONS & ~_umask())

    try:
        yield temporary
        guard = _guard.get()
        if guard is not None:
            guard.before_replacing(temporary, path)
        os.replace(temporary, path)
        observer = _observer.get()
        if observer is not None:
            observer(path)
    except OSError as error:
        # The error of a full disk names no file, other errors name the temporary one.
        if error.errno is not None and error.filename in (None, name):
            error.filename = str(path)
        raise
    finally:
        temporary.unlink(missing_ok=True)
        _open_files.discard(temporary)


def remove_temporary_files() -> None:
    """Remove the temporary files of this process, which has to end at once."""
    for temporary in list(_open_files):
        temporary.unlink(missing_ok=True)


def _remove_left_over_files(folder: Path) -> None:
    """Remove temporary files of processes that have ended long ago, once per folder."""
    if folder not in _tidied_folders:
        _tidied_folders.add(folder)
        for left_over in folder.glob(f"{PREFIX}*-*"):
            with suppress(OSError):
                if time.time() - left_over.stat().st_mtime > LEFT_OVER_SECONDS:
                    left_over.unlink()


def _umask() -> int:
    """Umask of the process, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask


# ---- JSON for people


def relative_name(path: Path, folder: Path) -> str:
    """Path of a file or folder relative to a folder; on another drive, the absolute path."""
    try:
        return Path(os.path.relpath(path.resolve(), folder.resolve())).as_posix()
    except ValueError:
        return path.resolve().as_posix()


def as_json(values: Mapping[str, Any]) -> str:
    """Render values as readable JSON; numbers that are not finite become null."""
    return json.dumps(_plain(values), indent=2, allow_nan=False) + "\n"


def write_json(path: Path, values: Mapping[str, Any]) -> None:
    """Write values as a JSON file; an incomplete file never remains."""
    with replacing(path) as temporary:
        temporary.write_text(as_json(values), encoding="utf-8")


def read_json(path: Path) -> dict[str, Any]:
    """Read a JSON file that holds an object.

    Raises:
        RecordingError: There is no such file, or it holds something else.
    """
    try:
        values = json.loads(path.read_text(encoding="utf-8"))
    except OSError as error:
        raise RecordingError(f"{path}: cannot read: {error.strerror}") from None
    except RecursionError:
        raise RecordingError(f"{path}: not a JSON file (nested too deeply)") from None
    except ValueError:
        raise RecordingError(f"{path}: not a JSON file") from None

    if not isinstance(values, dict):
        raise RecordingError(f"{path}: not a JSON object")
    return values


def _plain(value: Any) -> Any:
    """Replace arrays and NumPy scalars by lists and numbers, and non-finite numbers by None."""
    if isinstance(value, Mapping):
        return {str(key): _plain(entry) for key, entry in value.items()}
    if isinstance(value, (list, tuple)):
        return [_plain(entry) for entry in value]
    if hasattr(value, "tolist"):
        return _plain(value.tolist())
    if isinstance(value, float) and not math.isfinite(value):
        return None
    return value


# ---- archives of arrays

# Size of all arrays of a file above which they are not compressed [bytes].
MAX_COMPRESSED_BYTES = 64 * 2**20

# Errors that zipfile and NumPy raise for a damaged archive.
DAMAGED_ARCHIVE = (
    ValueError,
    OSError,
    EOFError,
    KeyError,
    NotImplementedError,
    RuntimeError,
    MemoryError,
    zipfile.BadZipFile,
    zlib.error,
)


def read_arrays(path: Path, kind: str) -> dict[str, np.ndarray]:
    """Read all arrays of an npz file; pickled objects are refused.

    Args:
        path: The file.
        kind: Kind of file for messages, such as "design".

    Raises:
        RecordingError: There is no such file, or it is damaged, larger than the memory, or of
            another kind.
    """
    import numpy as np

    if not path.is_file():
        raise RecordingError(f"{path}: no such {kind} file")

    try:
        with zipfile.ZipFile(path), np.load(path, allow_pickle=False) as loaded:
            arrays = dict(loaded)
        for name, value in arrays.items():
            if not isinstance(value, np.ndarray):
                raise ValueError(f"{name} is no array")
            # Records share arrays that nobody can change.
            value.setflags(write=False)
        return arrays
    except DAMAGED_ARCHIVE as error:
        raise RecordingError(
            f"{path}: not a {kind} archive (npz of named arrays without pickles, as numpy.savez "
            f"writes it), or damaged: {error}"
        ) from None


def write_arrays(path: Path, arrays: Mapping[str, np.ndarray]) -> None:
    """Write arrays as an npz file; an incomplete file never remains."""
    import numpy as np

    with replacing(path) as temporary, temporary.open("wb") as stream:
        size = sum(array.nbytes for array in arrays.values())
        save = np.savez if size > MAX_COMPRESSED_BYTES else np.savez_compressed
        save(stream, allow_pickle=False, **arrays)

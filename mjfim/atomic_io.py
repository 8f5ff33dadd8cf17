"""Atomic writing of files: each is written under a temporary name in its folder, then renamed."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from pathlib import Path
from typing import Protocol

# Permissions of a new file, from which the umask of the process removes some.
DEFAULT_PERMISSIONS = 0o666


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
    removed and an existing file remains unchanged. Missing parent folders are created.

    Args:
        path: Name of the final file.

    Yields:
        Temporary path in the folder of the final file, with an equal suffix.
    """
    path = Path(path)
    path.parent.mkdir(parents=True, exist_ok=True)

    handle, name = tempfile.mkstemp(prefix=f".{path.stem}-", suffix=path.suffix, dir=path.parent)
    os.close(handle)

    # mkstemp creates files that only their owner may read; results get the usual permissions.
    os.chmod(name, DEFAULT_PERMISSIONS & ~_umask())

    temporary = Path(name)
    try:
        yield temporary
        guard = _guard.get()
        if guard is not None:
            guard.before_replacing(temporary, path)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _umask() -> int:
    """Umask of the process, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask

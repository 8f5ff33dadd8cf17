"""Atomic writing of files: each is written under a temporary name in its folder, then renamed."""

from __future__ import annotations

import os
import tempfile
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path

# Permissions of a new file, from which the umask of the process removes some.
DEFAULT_PERMISSIONS = 0o666


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
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)


def _umask() -> int:
    """Umask of the process, which can only be read by setting it."""
    mask = os.umask(0)
    os.umask(mask)
    return mask

"""Files as bytes, which can be sent to a process that has none of these files."""

from __future__ import annotations

import hashlib
import os
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field
from pathlib import Path

from mjfim.errors import ExperimentError
from mjfim.parallel.shared_value import SharedValue


@dataclass(frozen=True, kw_only=True)
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

    def content(self, path: Path) -> bytes | None:
        """Return the bytes of a file; None if it is not among the packed files."""
        return self.contents.get(name_of(path))


def name_of(path: Path) -> str:
    """Return the normalised path of a file with slashes."""
    return Path(os.path.normpath(path)).as_posix()


def _read(path: Path) -> bytes:
    """Return the content of a file."""
    try:
        return path.read_bytes()
    except OSError as error:
        raise ExperimentError(f"{path}: cannot read the file: {error.strerror}") from None

"""The file from which a recording was read, so that a worker can read it itself."""

from __future__ import annotations

import hashlib
from dataclasses import dataclass
from functools import cached_property, lru_cache
from pathlib import Path
from weakref import WeakKeyDictionary

from mjfim.errors import RecordingError
from mjfim.recordings.channels import Channels
from mjfim.recordings.spec import RecordingSpec
from mjfim.records.trajectory import Recording

# Number of files whose hashes a process remembers.
KNOWN_HASHES = 10_000


@dataclass(frozen=True, kw_only=True)
class FileState:
    """A file as it was at some time.

    Attributes:
        path: Absolute path of the file.
        size: Its size [bytes].
        modified: Time of its last change [ns].
    """

    path: Path
    size: int
    modified: int

    @classmethod
    def of(cls, path: Path) -> FileState | None:
        """The state of a file now; None where there is no such file.

        Args:
            path: The file.
        """
        try:
            absolute = path.absolute()
            status = absolute.stat()
            if not absolute.is_file():
                return None
        except OSError:
            return None
        return cls(path=absolute, size=status.st_size, modified=status.st_mtime_ns)


@dataclass(frozen=True, kw_only=True, eq=False)
class LogFile:
    """The file of a recording, and how it was read.

    Attributes:
        state: The file as it was when it was read.
        spec: The `[recording]` table with which it was read.
        signals: Names of the signals that were looked for.
    """

    state: FileState
    spec: RecordingSpec
    signals: tuple[tuple[str, ...], ...]

    def is_read_by(self, channels: Channels) -> bool:
        """Whether reading the file with some channels gives the same recording.

        Args:
            channels: The channels.
        """
        return self.spec == channels.spec and self.signals == _signals(channels)

    @cached_property
    def content(self) -> FileContent | None:
        """The file by its contents; None where it cannot be read any more.

        Raises:
            RecordingError: The file has changed since it was read.
        """
        self.require_unchanged()
        try:
            content = FileContent(path=self.state.path, sha256=_hash_of(self.state))
        except OSError:
            return None

        # Something may have written to it while it was read for the hash.
        self.require_unchanged()
        return content

    def require_unchanged(self) -> None:
        """Raise RecordingError if the file has changed since it was read, and exists still."""
        now = FileState.of(self.state.path)
        if now is not None and now != self.state:
            raise RecordingError(
                f"{self.state.path}: the file has changed since it was read, so that workers would "
                "fit other data than this process; start again when nothing writes to it any more"
            )


@dataclass(frozen=True, kw_only=True)
class FileContent:
    """A file that a worker may find at the same path. It can be pickled.

    Attributes:
        path: Absolute path of the file.
        sha256: Hash of its contents.
    """

    path: Path
    sha256: str

    @property
    def is_here(self) -> bool:
        """True where this process finds the file with these contents."""
        state = FileState.of(self.path)
        if state is None:
            return False
        try:
            return _hash_of(state) == self.sha256
        except OSError:
            return False


# Files of the recordings that this process has read.
_files: WeakKeyDictionary[Recording, LogFile] = WeakKeyDictionary()


def remember_file(recording: Recording, before: FileState | None, channels: Channels) -> None:
    """Remember from which file a recording was read, unless the file changed meanwhile.

    Args:
        recording: The recording.
        before: The file before it was read; None for a log that is no single file.
        channels: How it was read.
    """
    if before is not None and before == FileState.of(before.path):
        _files[recording] = LogFile(state=before, spec=channels.spec, signals=_signals(channels))


def file_of(recording: Recording) -> LogFile | None:
    """The file from which this process has read a recording; None for another one.

    Args:
        recording: The recording.
    """
    return _files.get(recording)


def _signals(channels: Channels) -> tuple[tuple[str, ...], ...]:
    """Names of all signals that a recording may hold."""
    return channels.control_columns, channels.outputs, tuple(channels.measurable)


@lru_cache(maxsize=KNOWN_HASHES)
def _hash_of(state: FileState) -> str:
    """SHA-256 of the contents of a file in a state. Raises OSError if it cannot be read."""
    with state.path.open("rb") as stream:
        return hashlib.file_digest(stream, "sha256").hexdigest()

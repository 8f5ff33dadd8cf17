"""Which files of a folder mjfim wrote, and which of them a run may replace or remove.

A folder with results holds a manifest, `.mjfim.json`. It lists the size and the SHA-256 sum of each
file that a verb of the command line wrote there. A file that is not listed, or has other contents,
belongs to the user.
"""

from __future__ import annotations

import hashlib
import json
import os
from collections.abc import Iterable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

from mjfim.errors import OutputError, RecordingError
from mjfim.files import guarded_by, read_json, replacing
from mjfim.output.file_lock import FileLock

# Name of the manifest, and of the locks of a manifest and of a folder.
MANIFEST = ".mjfim.json"
MANIFEST_LOCK = ".mjfim.json.lock"
FOLDER_LOCK = ".mjfim.lock"

# Version of the manifest's format.
FORMAT = 1

# Longest time to wait for another process that writes the same manifest [s]. Writing takes
# milliseconds; if it does not end, the files count as the user's, which is the safe side.
MANIFEST_PATIENCE = 10.0

# Largest number of files that a message lists.
LISTED_FILES = 5


class Origin(Enum):
    """Who wrote a file."""

    WRITTEN_HERE = "written by mjfim and unchanged since"
    CHANGED = "changed since mjfim wrote it"
    UNKNOWN = "not known to be written by mjfim"


@dataclass(frozen=True, kw_only=True)
class Fingerprint:
    """Size and check sum of the contents of a file.

    Attributes:
        size: Number of bytes.
        sha256: SHA-256 sum, in hexadecimal digits.
    """

    size: int
    sha256: str

    @classmethod
    def of(cls, file: Path) -> Fingerprint:
        """Read the fingerprint of a file.

        Args:
            file: The file.
        """
        with file.open("rb") as stream:
            digest = hashlib.file_digest(stream, "sha256")
            return cls(size=stream.tell(), sha256=digest.hexdigest())


class Manifest:
    """The files that mjfim wrote into one folder.

    A file can have two fingerprints. The new one is entered before the file is replaced, so that a
    process that is killed in between leaves no file that is not listed.

    Attributes:
        folder: The folder.
    """

    def __init__(self, folder: Path) -> None:
        """Describe the manifest of a folder, which need not exist.

        Args:
            folder: The folder.
        """
        self.folder = folder

    def origins(self, files: Sequence[Path]) -> list[Origin]:
        """Say who wrote some files of the folder.

        Args:
            files: Files that exist.
        """
        entries = self._read()
        return [_origin(file, entries.get(file.name)) for file in files]

    def enter(self, name: str, contents: Path) -> None:
        """Enter a file that is about to be written.

        Args:
            name: Name of the file in the folder.
            contents: File with its contents, under another name.
        """
        lock = FileLock(self.folder / MANIFEST_LOCK)
        lock.acquire(MANIFEST_PATIENCE)
        try:
            files = self._read()

            # The file under this name, which is replaced next, stays known until then.
            present = self.folder / name
            kept = [Fingerprint.of(present)] if present.is_file() else []
            kept = [entry for entry in kept if entry in files.get(name, [])]

            new = Fingerprint.of(contents)
            files[name] = [*(entry for entry in kept if entry != new), new]
            self._write(files)
        finally:
            lock.release()

    def _read(self) -> dict[str, list[Fingerprint]]:
        """Return the fingerprints by name of the file; nothing if there is no usable manifest."""
        try:
            files = read_json(self.folder / MANIFEST)["files"]
            return {
                str(name): [
                    Fingerprint(size=int(entry["size"]), sha256=str(entry["sha256"]))
                    for entry in entries
                ]
                for name, entries in files.items()
            }
        except (RecordingError, LookupError, TypeError, ValueError, AttributeError):
            return {}

    def _write(self, files: dict[str, list[Fingerprint]]) -> None:
        """Write the fingerprints by name of the file."""
        table: dict[str, Any] = {
            name: [{"size": entry.size, "sha256": entry.sha256} for entry in entries]
            for name, entries in sorted(files.items())
        }

        # Readable JSON would take most of the time in a folder with many files.
        with replacing(self.folder / MANIFEST) as temporary:
            temporary.write_text(json.dumps({"format": FORMAT, "files": table}), encoding="utf-8")


class OutputGuard:
    """The rule for files that exist: which of them one run may replace or remove.

    A file is replaced if the manifest of its folder says that mjfim wrote it and its contents have
    not changed since. Other files are replaced on request only, inputs of the run never.
    """

    def __init__(self, inputs: Sequence[Path], *, force: bool) -> None:
        """State what the run reads, and what the user permits.

        Args:
            inputs: Files that the run reads.
            force: True if the user permits to replace files that mjfim did not write.
        """
        self._inputs = tuple(inputs)
        self._force = force

    def check(self, files: Iterable[Path]) -> None:
        """Check before the work that all files of the run may be written.

        Args:
            files: Files that the run is going to write.

        Raises:
            OutputError: One of them is an input or a folder, or belongs to the user.
        """
        existing = [file for file in files if os.path.lexists(file)]
        for file in existing:
            self._refuse_input(file)
            if file.exists() and not file.is_file():
                raise OutputError(f"{file}: is not a file; a result of this name cannot be written")

        if self._force:
            return

        refused: dict[Origin, list[Path]] = {Origin.UNKNOWN: [], Origin.CHANGED: []}
        for file, origin in zip(existing, _origins(existing), strict=True):
            if origin is not Origin.WRITTEN_HERE:
                refused[origin].append(file)
        if any(refused.values()):
            raise OutputError(_refusal(refused[Origin.UNKNOWN], refused[Origin.CHANGED]))

    def before_replacing(self, temporary: Path, target: Path) -> None:
        """Check a file again when it is written, and enter it in the manifest.

        Args:
            temporary: The complete new file.
            target: Its final name.

        Raises:
            OutputError: The existing file may not be replaced.
        """
        if target.name == MANIFEST:
            return

        self.check([target])
        Manifest(target.parent).enter(target.name, temporary)

    def may_remove(self, file: Path) -> bool:
        """Say whether a result of an earlier run may be removed.

        Args:
            file: A file that exists.
        """
        is_input = any(_is_same(file, source) for source in self._inputs)
        return not is_input and _origins([file]) == [Origin.WRITTEN_HERE]

    def _refuse_input(self, file: Path) -> None:
        """Raise OutputError if a file is an input of the run."""
        for source in self._inputs:
            if _is_same(file, source):
                raise OutputError(
                    f"{file}: this result would replace {source}, which is an input of the same "
                    "run; choose another place for the result (--force does not replace inputs)"
                )


@contextmanager
def claimed(folder: Path, guard: OutputGuard, *, exclusive: bool) -> Iterator[None]:
    """Guard all files that are written in the context, and keep other runs out of a folder.

    A folder that does not exist is created, and is removed at the end if nothing was written.

    Args:
        folder: Folder for the results.
        guard: The rule for files that exist.
        exclusive: Whether other runs are kept out; False for single files, which mix with nothing.

    Raises:
        OutputError: The folder cannot be created, or another process writes into it.
    """
    if not exclusive:
        with guarded_by(guard):
            yield
        return

    new = [place for place in (folder, *folder.parents) if not place.exists()]
    try:
        folder.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise OutputError(
            f"{folder}: this folder cannot be created: {error.strerror}; choose another one with -o"
        ) from None
    lock = FileLock(folder / FOLDER_LOCK)
    if not lock.acquire():
        raise OutputError(
            f"{folder}: another run of mjfim writes into this folder ({lock.holder()}); wait for "
            "its end, or choose another folder with -o"
        )

    try:
        with guarded_by(guard):
            yield
    finally:
        lock.release()
        _remove_empty(new)


def _remove_empty(folders: Sequence[Path]) -> None:
    """Remove folders that are still empty; the innermost comes first."""
    for place in folders:
        try:
            place.rmdir()
        except OSError:
            return


def _origins(files: Sequence[Path]) -> list[Origin]:
    """Say who wrote some files, after the manifests of their folders."""
    of_folder: dict[Path, list[Path]] = {}
    for file in files:
        if file.is_file():
            of_folder.setdefault(file.parent, []).append(file)

    found: dict[Path, Origin] = {}
    for folder, members in of_folder.items():
        found.update(zip(members, Manifest(folder).origins(members), strict=True))
    return [found.get(file, Origin.UNKNOWN) for file in files]


def _origin(file: Path, known: Sequence[Fingerprint] | None) -> Origin:
    """Say who wrote a file, by the fingerprints that a manifest lists for it."""
    if known is None:
        return Origin.UNKNOWN
    return Origin.WRITTEN_HERE if Fingerprint.of(file) in known else Origin.CHANGED


def _is_same(file: Path, other: Path) -> bool:
    """Whether two paths lead to one file, also by links or in another spelling."""
    try:
        return file.samefile(other)
    except OSError:
        return False


def _refusal(unknown: Sequence[Path], changed: Sequence[Path]) -> str:
    """Say which files are not replaced, why, and what the user can do."""
    parts = []
    if unknown:
        parts.append(
            f"{_listed(unknown)}: not listed in {MANIFEST} beside it as written by mjfim (your "
            "own, or from an older version)"
        )
    if changed:
        parts.append(f"{_listed(changed)}: changed after mjfim wrote it")
    return f"{'; '.join(parts)}; choose another place for the result, or replace with --force"


def _listed(files: Sequence[Path]) -> str:
    """List the files of a message; after the first one, names alone, and not too many."""
    names = [str(files[0]), *(file.name for file in files[1:LISTED_FILES])]
    more = len(files) - len(names)
    return ", ".join(names) + (f" and {more} more" if more > 0 else "")

"""Which files of a folder mjfim wrote, which of them a run may replace, and who writes there now.

A folder with results holds a manifest, `.mjfim.json`. It lists the size and the SHA-256 sum of each
file that a verb of the command line wrote there. A file that is not listed, or has other contents,
belongs to the user. Files that cannot be drawn are left out.
"""

from __future__ import annotations

import hashlib
import json
import os
import sys
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from datetime import datetime
from pathlib import Path
from typing import Any

from mjfim.errors import MjfimError, OutputError, RecordingError, UndrawnWarning
from mjfim.files import guarded_by, read_json, replacing
from mjfim.parallel.budget import run_optional

# Name of the manifest, and of the locks of a manifest and of a folder.
MANIFEST = ".mjfim.json"
MANIFEST_LOCK = ".mjfim.json.lock"
FOLDER_LOCK = ".mjfim.lock"

# Version of the manifest's format.
FORMAT = 1

# Longest time to wait for another process that writes the same manifest, and the time between two
# trials [s]. Writing takes milliseconds; if it does not end, the files count as the user's, which
# is the safe side.
PATIENCE, INTERVAL = 10.0, 0.01

# Largest number of files that a message lists.
LISTED_FILES = 5

# Sizes and check sums of files by their names. A file can have two: the new one is entered before
# the file is replaced, so that a process that is killed in between leaves no unknown file.
Entries = dict[str, list[dict[str, Any]]]


def fingerprint(file: Path) -> dict[str, Any]:
    """Size [bytes] and SHA-256 sum of a file, as the manifest states them."""
    with file.open("rb") as stream:
        digest = hashlib.file_digest(stream, "sha256")
        return {"size": stream.tell(), "sha256": digest.hexdigest()}


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
        unknown = []
        changed = []
        manifests = {}
        for file in files:
            if not os.path.lexists(file):
                continue
            source = self._input(file)
            if source is not None:
                raise OutputError(
                    f"{file}: this result would replace {source}, which is an input of the same "
                    "run; choose another place for the result (--force does not replace inputs)"
                )
            if file.exists() and not file.is_file():
                raise OutputError(f"{file}: is not a file; a result of this name cannot be written")

            if file.parent not in manifests:
                manifests[file.parent] = _entries(file.parent)
            entries = manifests[file.parent]
            if file.name not in entries or not file.exists():
                unknown.append(file)
            elif fingerprint(file) not in entries[file.name]:
                changed.append(file)
        if (unknown or changed) and not self._force:
            raise OutputError(_refusal(unknown, changed))

    def before_replacing(self, temporary: Path, target: Path) -> None:
        """Check a file again when it is written, and enter it in the manifest.

        Args:
            temporary: The complete new file.
            target: Its final name.

        Raises:
            OutputError: The existing file may not be replaced.
        """
        if target.name != MANIFEST:
            self.check([target])
            _enter(target, fingerprint(temporary))

    def may_remove(self, file: Path) -> bool:
        """Say whether a result of an earlier run may be removed.

        Args:
            file: A file that exists.
        """
        known = _entries(file.parent).get(file.name, [])
        return self._input(file) is None and fingerprint(file) in known

    def _input(self, file: Path) -> Path | None:
        """The input of the run that a file is, also by links or in another spelling."""
        for source in self._inputs:
            with suppress(OSError):
                if file.samefile(source):
                    return source
        return None


def _entries(folder: Path) -> Entries:
    """Entries of the manifest of a folder; none where there is no usable one."""
    with suppress(RecordingError, LookupError, TypeError, AttributeError):
        files = read_json(folder / MANIFEST)["files"]
        return {name: list(entries) for name, entries in files.items()}
    return {}


def _enter(file: Path, new: dict[str, Any]) -> None:
    """Enter the contents of a file that is about to be replaced, and keep the present ones."""
    with locked(file.parent / MANIFEST_LOCK, PATIENCE):
        entries = _entries(file.parent)
        present = fingerprint(file) if file.is_file() else {}
        kept = [entry for entry in entries.get(file.name, []) if entry == present != new]
        entries[file.name] = [*kept, new]

        # Readable JSON would take most of the time in a folder with many files.
        text = json.dumps({"format": FORMAT, "files": dict(sorted(entries.items()))})
        with replacing(file.parent / MANIFEST) as temporary:
            temporary.write_text(text, encoding="utf-8")


def _refusal(unknown: Sequence[Path], changed: Sequence[Path]) -> str:
    """Say which files are not replaced, why, and what the user can do."""
    reasons = (
        (
            unknown,
            f"not listed in {MANIFEST} beside it as written by mjfim (your own, or from an older "
            "version)",
        ),
        (changed, "changed after mjfim wrote it"),
    )
    parts = []
    for files, reason in reasons:
        names = [*map(str, files[:1]), *(file.name for file in files[1:LISTED_FILES])]
        more = f" and {len(files) - len(names)} more" if len(files) > len(names) else ""
        parts += [f"{', '.join(names)}{more}: {reason}"] if files else []
    cure = "choose another place for the result, or replace with --force (Python: force=True)"
    return f"{'; '.join(parts)}; {cure}"


def require_writable(folder: Path) -> None:
    """Check before the work, not after it, that results can be written to a folder.

    Args:
        folder: The folder; it need not exist yet.

    Raises:
        RecordingError: It is a file, or writing is not permitted.
    """
    existing = next(p for p in (folder, *folder.absolute().parents) if p.exists())
    if not existing.is_dir():
        raise RecordingError(f"{existing}: is a file; -o needs a folder")
    if not os.access(existing, os.W_OK):
        raise RecordingError(f"{existing}: no permission to write here")


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
    try:
        with locked(folder / FOLDER_LOCK) as is_mine:
            if not is_mine:
                raise OutputError(
                    f"{folder}: another run of mjfim writes into this folder "
                    f"({holder(folder / FOLDER_LOCK)}); wait for its end, or choose another folder "
                    "with -o"
                )
            with guarded_by(guard):
                yield
    finally:
        with suppress(OSError):
            for place in new:
                place.rmdir()


@contextmanager
def locked(path: Path, patience: float = 0.0) -> Iterator[bool]:
    """Lock a file for this process, and remove it at the end.

    The operating system holds the lock. If the process is killed, the file remains and the next
    process takes it over. The file says which process holds it since when.

    Args:
        path: The file.
        patience: Time to wait while another process holds it [s].

    Yields:
        Whether this process holds the lock.
    """
    end = time.monotonic() + patience
    handle = _lock(path)
    while handle is None and time.monotonic() < end:
        time.sleep(INTERVAL)
        handle = _lock(path)
    try:
        yield handle is not None
    finally:
        if handle is not None:
            with suppress(OSError):  # an open file stays on Windows
                path.unlink()
            os.close(handle)


def holder(path: Path) -> str:
    """Describe the process that holds the lock on a file, if the file can be read."""
    try:
        process, started = path.read_text(encoding="utf-8").split(maxsplit=1)
        return f"process {int(process)}, since {started}"
    except (OSError, ValueError):
        return "another process"


def _lock(path: Path) -> int | None:
    """Open and lock a file; None if another process holds the lock."""
    handle = os.open(path, os.O_RDWR | os.O_CREAT, 0o666)

    # The last holder may have removed the file after it was opened here. Then a third process could
    # make a new file and lock that one.
    with suppress(FileNotFoundError):
        if _is_lockable(handle) and os.path.samestat(os.fstat(handle), path.stat()):
            started = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
            os.ftruncate(handle, 0)
            os.write(handle, f"{os.getpid()} {started}".encode())
            return handle
    os.close(handle)
    return None


if sys.platform == "win32":
    import msvcrt

    def _is_lockable(handle: int) -> bool:
        """Lock an open file unless another process holds the lock."""
        with suppress(OSError):
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
            return True
        return False

else:
    import fcntl

    def _is_lockable(handle: int) -> bool:
        """Lock an open file unless another process holds the lock."""
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            pass  # this file system has no locks; a run without a lock is better than none
        return True


def write_optional(name: str, write: Callable[[], object]) -> None:
    """Write a file that may be missing: it is left out when the user presses Ctrl-C twice.

    A fault of the program while it is drawn is a warning, which the command line shows as one
    sentence. Tests make an error of it, and `python -W error -m mjfim` shows where the fault is.

    Args:
        name: Name of the file.
        write: Draws and writes it.

    Raises:
        MjfimError: The file may not be written.
        OSError: The file cannot be written.
    """

    def guarded() -> None:
        try:
            write()
        except (MjfimError, OSError):
            raise
        except Exception as error:
            fault = ": ".join(part for part in (type(error).__name__, str(error)) if part)
            message = (
                f"could not draw {name}, because of a fault in mjfim ({fault}); the result "
                "stands, and its data are written (python -W error -m mjfim shows the place of "
                "the fault)"
            )
            warnings.warn(message, UndrawnWarning, stacklevel=2)

    run_optional(guarded)

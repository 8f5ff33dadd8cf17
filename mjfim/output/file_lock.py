"""A lock that one process holds on a file, and that ends with the process.

The operating system holds the lock. If the process is killed, its file remains and the next process
takes it over.
"""

from __future__ import annotations

import json
import os
import sys
import time
from contextlib import suppress
from datetime import datetime
from pathlib import Path

# Period at which a waiting process tries again [s].
RETRY_INTERVAL = 0.01

if sys.platform == "win32":
    import msvcrt

    # Windows locks ranges of bytes, and nobody else can read them. This byte is behind the text.
    LOCKED_BYTE = 1 << 20

    def _try_lock(handle: int) -> bool:
        """Lock an open file unless another process holds the lock."""
        os.lseek(handle, LOCKED_BYTE, os.SEEK_SET)
        try:
            msvcrt.locking(handle, msvcrt.LK_NBLCK, 1)
        except OSError:
            return False
        return True

else:
    import fcntl

    def _try_lock(handle: int) -> bool:
        """Lock an open file unless another process holds the lock."""
        try:
            fcntl.flock(handle, fcntl.LOCK_EX | fcntl.LOCK_NB)
        except BlockingIOError:
            return False
        except OSError:
            # This file system has no locks; a run without a lock is better than none.
            return True
        return True


class FileLock:
    """A lock on a file, which holds the number of the process and the time of the lock.

    Attributes:
        path: The file; its folder must exist.
    """

    def __init__(self, path: Path) -> None:
        """Describe a lock, without taking it.

        Args:
            path: The file; it need not exist.
        """
        self.path = path
        self._handle: int | None = None

    def acquire(self, patience: float = 0.0) -> bool:
        """Take the lock.

        Args:
            patience: Time to wait while another process holds it [s].

        Returns:
            Whether this process holds the lock now.
        """
        end = time.monotonic() + patience
        while not self._try_once():
            if time.monotonic() >= end:
                return False
            time.sleep(RETRY_INTERVAL)
        return True

    def holder(self) -> str:
        """Describe the process that holds the lock, such as `process 17, since 2026-01-31 12:00`.

        Returns:
            The description; without its details if the process has just ended.
        """
        try:
            values = json.loads(self.path.read_text(encoding="utf-8"))
            return f"process {int(values['pid'])}, since {values['started']}"
        except (OSError, ValueError, LookupError, TypeError):
            return "another process"

    def release(self) -> None:
        """Give the lock back, and remove its file."""
        if self._handle is None:
            return

        # Windows does not remove a file that is open. There the file remains, without a lock, if
        # another process opens it at this moment.
        if sys.platform == "win32":
            os.close(self._handle)
        with suppress(OSError):
            self.path.unlink()
        if sys.platform != "win32":
            os.close(self._handle)
        self._handle = None

    def _try_once(self) -> bool:
        """Open and lock the file; return False if another process holds the lock."""
        handle = os.open(self.path, os.O_RDWR | os.O_CREAT, 0o666)
        if not _try_lock(handle):
            os.close(handle)
            return False

        # The last holder may have removed the file after it was opened here. Then a third process
        # could make a new file and lock that one.
        if not self._is_current(handle):
            os.close(handle)
            return False

        started = datetime.now().astimezone().isoformat(sep=" ", timespec="seconds")
        text = json.dumps({"pid": os.getpid(), "started": started})
        os.ftruncate(handle, 0)
        os.lseek(handle, 0, os.SEEK_SET)
        os.write(handle, text.encode())
        self._handle = handle
        return True

    def _is_current(self, handle: int) -> bool:
        """Whether an open file is the one that stands under the name of the lock."""
        try:
            return os.path.samestat(os.fstat(handle), self.path.stat())
        except FileNotFoundError:
            return False

"""Suppression of MuJoCo's warnings on the console and in log files.

It is used where mjfim reports a problem by a return value.
"""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

import mujoco

# Guards the settings of MuJoCo's log, which all threads share.
_lock = Lock()

# One entry for each block that is open in any thread: the settings before the first of them.
_open_blocks: list[Any] = []


@contextmanager
def silence_mujoco_log() -> Iterator[None]:
    """Suppress MuJoCo's messages inside the block.

    The previous settings are restored when the last open block of all threads ends.

    Yields:
        Nothing.
    """
    with _lock:
        current = mujoco.MjLogConfig.get()
        _open_blocks.append(_open_blocks[0] if _open_blocks else current)

        silent = mujoco.MjLogConfig.get()
        silent.logto_console = False
        silent.logto_file = False
        mujoco.MjLogConfig.set(silent)

    try:
        yield
    finally:
        with _lock:
            before = _open_blocks.pop()
            if not _open_blocks:
                mujoco.MjLogConfig.set(before)

"""MuJoCo's own warnings, kept off the console and out of log files where mjfim reports trouble by value."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from threading import Lock
from typing import Any

import mujoco

_lock = Lock()
_blocks: list[
    Any
] = []  # settings from before, one per block that is open in any thread; those of the first count


@contextmanager
def silence_mujoco_log() -> Iterator[None]:
    """No MuJoCo message inside the block; the settings from before it come back after it, after the last one of threads."""
    with _lock:
        before, config = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
        config.logto_console = config.logto_file = False
        _blocks.append(before if not _blocks else _blocks[0])
        mujoco.MjLogConfig.set(config)
    try:
        yield
    finally:
        with _lock:
            before = _blocks.pop()
            if not _blocks:
                mujoco.MjLogConfig.set(before)

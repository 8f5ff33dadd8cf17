"""MuJoCo's warnings: kept from the console and from log files, collected, told once.

They are suppressed where mjfim reports a problem by a return value.
"""

from __future__ import annotations

import multiprocessing
import warnings
from collections.abc import Iterable, Iterator
from contextlib import contextmanager
from pathlib import Path
from threading import Lock
from typing import Any

import mujoco

from mjfim.errors import ModelWarning

# Guards the settings of MuJoCo's log, which all threads share.
_lock = Lock()

# Parts of warnings about nothing that concerns a user: attached models keep the names of their
# elements, and what a later version of MuJoCo will not read still holds in the present one.
MEANINGLESS = ("Attaching a spec with an empty prefix", "is deprecated and will be removed")

# Warnings that were told, each with its file.
_told: set[tuple[Path, str]] = set()

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


@contextmanager
def collected_warnings(*, of_reader: bool = False) -> Iterator[list[str]]:
    """Collect the warnings of MuJoCo's reader or compiler instead of showing them.

    Args:
        of_reader: Whether the block reads a file. The reader warns by a callback, the compiler
            through Python. The callback is left alone for a compile, which may use threads.

    Yields:
        The warnings with a meaning for the user, complete when the block has ended.
    """
    found: list[str] = []
    before = mujoco.get_mju_user_warning()
    with silence_mujoco_log(), warnings.catch_warnings(record=True) as recorded:
        warnings.simplefilter("always")
        if of_reader:
            mujoco.set_mju_user_warning(found.append)
        try:
            yield found
        finally:
            if of_reader:
                mujoco.set_mju_user_warning(before)

    found += [str(each.message) for each in recorded]
    found[:] = [text for text in found if not any(part in text for part in MEANINGLESS)]


def tell_once(path: Path, messages: Iterable[str]) -> None:
    """Warn about what MuJoCo says about a file, unless it was told before.

    Worker processes read the files again and stay silent.

    Args:
        path: The file.
        messages: MuJoCo's warnings.
    """
    if multiprocessing.parent_process() is not None:
        return

    for message in messages:
        text = " ".join(message.split())
        if (path, text) not in _told:
            _told.add((path, text))
            warnings.warn(f"{path}: MuJoCo warns: {text}", ModelWarning, stacklevel=3)

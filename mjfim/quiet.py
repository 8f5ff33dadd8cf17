"""MuJoCo's own warnings, kept off the console and out of log files where mjfim reports trouble by value."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager

import mujoco


@contextmanager
def quiet() -> Iterator[None]:
    """No MuJoCo message inside the block; the settings from before it come back after it."""
    before, config = mujoco.MjLogConfig.get(), mujoco.MjLogConfig.get()
    config.logto_console = config.logto_file = False
    mujoco.MjLogConfig.set(config)
    try:
        yield
    finally:
        mujoco.MjLogConfig.set(before)

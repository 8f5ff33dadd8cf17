"""Pictures that another process draws, while this one computes and writes other files.

Matplotlib takes longer to import than a short design takes, and it draws in one thread. The other
process only draws. This one writes the files, so that interruptions and files of the user are
treated as everywhere else.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mjfim.output.picture_format import PictureFormat
    from mjfim.parallel import Pool
    from mjfim.records.base import ShownRecord

# Messages for developers, which a user does not see.
_log = logging.getLogger(__name__)

# Fewest processors with which another process saves time.
FEWEST_CORES = 2

# Errors of a computer that cannot start another process, as without shared semaphores or memory.
NO_PROCESS = (ImportError, MemoryError, OSError, RuntimeError)

# The process that draws now; None where this process draws itself.
_process: ContextVar[Pool | None] = ContextVar("drawing", default=None)


@contextmanager
def drawing_elsewhere() -> Iterator[None]:
    """Let another process draw the pictures that are begun in the context, if it saves time.

    It ends with the process that has started it, whatever happens to that one.
    """
    from mjfim.parallel import Pool, cores

    pool = None
    if cores() >= FEWEST_CORES:
        with suppress(*NO_PROCESS):
            pool = Pool(1)
    token = _process.set(pool)
    try:
        if pool is not None:
            with suppress(*NO_PROCESS):
                pool.submit(_import_what_draws)
        yield
    finally:
        _process.reset(token)
        if pool is not None:
            pool.end_running(wait=True)


def begin_pictures(
    record: ShownRecord, picture_format: PictureFormat
) -> Callable[[], dict[str, bytes]]:
    """Begin to draw the pictures of a record.

    Args:
        record: The record; it is copied to the other process.
        picture_format: Format of the pictures.

    Returns:
        A function that waits for the contents of the files, by the names of the pictures. They are
        none where this process has to draw, and then says what keeps a picture from being drawn.
    """
    pool, future = _process.get(), None
    # The data of the result are written after this, whatever happens to the other process.
    if pool is not None:
        with suppress(*NO_PROCESS):
            future = pool.submit(_contents, record, picture_format)

    def contents() -> dict[str, bytes]:
        """Wait for the pictures."""
        if future is None:
            return {}
        fault = future.exception()
        if fault is None:
            return future.result()
        _log.info("the process that draws has failed, so this one draws: %r", fault)
        return {}

    return contents


# ---- in the other process


def _import_what_draws() -> None:
    """Import all modules that draw pictures, before there is anything to draw."""
    from mjfim.output.plots import draw, pictures  # noqa: F401


def _contents(record: ShownRecord, picture_format: PictureFormat) -> dict[str, bytes]:
    """Draw all pictures of a record."""
    from mjfim.output.plots.draw import content
    from mjfim.output.plots.pictures import pictures_of

    return {name: content(draw(), picture_format) for name, draw in pictures_of(record).items()}

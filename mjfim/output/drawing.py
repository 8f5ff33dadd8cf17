"""Pictures that another process draws, while this one computes and writes other files.

Matplotlib takes longer to import than a short design takes, and it draws in one thread. The other
process only draws. This one writes the files, so that interruptions and files of the user are
treated as everywhere else.
"""

from __future__ import annotations

import logging
from collections.abc import Iterator
from concurrent.futures import Future
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from typing import TYPE_CHECKING

if TYPE_CHECKING:
    from mjfim.output.picture_format import PictureFormat
    from mjfim.records.base import ShownRecord

# Messages for developers, which a user does not see.
_log = logging.getLogger(__name__)

# Fewest processors with which another process saves time.
FEWEST_CORES = 2

# Errors of a computer that cannot start another process, as without shared semaphores or memory.
NO_PROCESS = (ImportError, MemoryError, OSError, RuntimeError)


class DrawingProcess:
    """A process that has imported what draws, and draws the pictures of one record after the other.

    It ends with the process that has started it, whatever happens to that one.
    """

    def __init__(self) -> None:
        from mjfim.parallel import Pool

        self._pool = Pool(1)
        try:
            self._pool.submit(_import_what_draws)
        except NO_PROCESS:
            self._pool.end_running()
            raise

        self._begun: tuple[ShownRecord, Future[dict[str, bytes]]] | None = None

    def begin(self, record: ShownRecord, picture_format: PictureFormat) -> None:
        """Begin to draw all pictures of a record.

        Args:
            record: The record; it is copied to the process.
            picture_format: Format of the pictures.
        """
        self._begun = record, self._pool.submit(_contents, record, picture_format)

    def contents(self, record: ShownRecord) -> dict[str, bytes]:
        """Wait for the pictures of a record.

        Args:
            record: The record.

        Returns:
            The contents of the files by the names of the pictures; empty where drawing was not
            begun, where a picture could not be drawn, where the record could not be sent to the
            process, and where the process was ended from outside.
        """
        if self._begun is None or self._begun[0] is not record:
            return {}

        future = self._begun[1]
        fault = future.exception()
        if fault is None:
            return future.result()

        # This process draws the pictures again, and says what keeps one of them from being drawn.
        _log.info("the process that draws has failed, so this one draws: %r", fault)
        return {}

    def end(self) -> None:
        """End the process at once."""
        self._pool.end_running(wait=True)


# The process that draws now; None where this process draws itself.
_process: ContextVar[DrawingProcess | None] = ContextVar("drawing", default=None)


@contextmanager
def drawing_elsewhere() -> Iterator[None]:
    """Let another process draw the pictures that are begun in the context.

    This has no effect on a computer with a single processor, or that cannot start another process.
    """
    process = _started()
    if process is None:
        yield
        return

    token = _process.set(process)
    try:
        yield
    finally:
        _process.reset(token)
        process.end()


def _started() -> DrawingProcess | None:
    """Start the process; None where it saves no time, or cannot be started."""
    from mjfim.parallel import cores

    if cores() < FEWEST_CORES:
        return None
    try:
        return DrawingProcess()
    except NO_PROCESS:
        return None


def begin_pictures(record: ShownRecord, picture_format: PictureFormat) -> None:
    """Begin to draw the pictures of a record, if another process draws.

    Args:
        record: The record.
        picture_format: Format of the pictures.
    """
    process = _process.get()
    if process is None:
        return

    # The data of the result are written after this. Whatever happens to the other process, they
    # must be, and this one draws the pictures then.
    with suppress(*NO_PROCESS):
        process.begin(record, picture_format)


def picture_contents(record: ShownRecord) -> dict[str, bytes]:
    """Wait for the pictures of a record that were begun.

    Args:
        record: The record.

    Returns:
        The contents of the files by the names of the pictures; empty where this process has to draw
        them, which also shows why one of them cannot be drawn.
    """
    process = _process.get()
    return {} if process is None else process.contents(record)


# ---- in the other process


def _import_what_draws() -> None:
    """Import all modules that draw pictures, before there is anything to draw."""
    from mjfim.output.plots import draw, pictures  # noqa: F401


def _contents(record: ShownRecord, picture_format: PictureFormat) -> dict[str, bytes]:
    """Draw all pictures of a record.

    A fault is raised, so that the program that waits for the pictures knows its reason.
    """
    from mjfim.output.plots.draw import content
    from mjfim.output.plots.pictures import pictures_of

    return {name: content(make(), picture_format) for name, make in pictures_of(record).items()}

"""Pictures that another process draws, while this one computes and writes other files.

Matplotlib takes longer to import than a short design takes, and it draws in one thread. The other
process only draws. This one writes the files, so that interruptions and files of the user are
treated as everywhere else.
"""

from __future__ import annotations

import logging
import warnings
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from contextvars import ContextVar
from enum import StrEnum
from typing import TYPE_CHECKING

from mjfim.errors import MjfimError, UndrawnWarning
from mjfim.parallel.budget import run_optional

if TYPE_CHECKING:
    from mjfim.parallel import Pool
    from mjfim.records.base import ShownRecord


class PictureFormat(StrEnum):
    """Format of pictures; the value is also the ending of their files."""

    PNG = "png"
    SVG = "svg"
    PDF = "pdf"

    def file_of(self, picture: str) -> str:
        """Return the name of a picture's file.

        Args:
            picture: Name of the picture, without an ending.
        """
        return f"{picture}.{self.value}"

    def files(self, names: Iterable[str]) -> tuple[str, ...]:
        """Return the names of files, where all pictures have this format.

        Args:
            names: Names of files; those of pictures end in .png.
        """
        return tuple(
            name.removesuffix("png") + self.value if name.endswith(".png") else name
            for name in names
        )


def write_guarded(name: str, write: Callable[[], object]) -> None:
    """Write a file; a fault of the program while it is drawn is a warning.

    The command line shows the warning as one sentence. Tests make an error of it, and
    `python -W error -m mjfim` shows where the fault is.

    Args:
        name: Name of the file.
        write: Draws and writes it.

    Raises:
        MjfimError: The file may not be written.
        OSError: The file cannot be written.
    """
    try:
        write()
    except (MjfimError, OSError):
        raise
    except Exception as error:
        fault = ": ".join(part for part in (type(error).__name__, str(error)) if part)
        message = (
            f"could not draw {name}, because of a fault in mjfim ({fault}); the result stands, and "
            "its data are written (python -W error -m mjfim shows the place of the fault)"
        )
        warnings.warn(message, UndrawnWarning, stacklevel=2)


def write_optional(name: str, write: Callable[[], object]) -> None:
    """Write a file as `write_guarded` does, and leave it out when the user presses Ctrl-C twice.

    Args:
        name: Name of the file.
        write: Draws and writes it.
    """
    run_optional(lambda: write_guarded(name, write))


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

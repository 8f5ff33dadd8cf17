"""Files without which a result is complete: tables, reports, pictures, Rerun files and videos.

They are written after the data. A fault of the program while one of them is drawn costs this file
alone, and never the result.
"""

from __future__ import annotations

import warnings
from collections.abc import Callable

from mjfim.errors import MjfimError, UndrawnWarning
from mjfim.parallel.budget import run_optional


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

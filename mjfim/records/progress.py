"""Progress of long work, which a notebook shows where the caller does not ask for it.

Verbs are below the room that draws. They import the display by its name, and only in a notebook.
"""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from importlib import import_module
from typing import TypeVar

# What is called with the name of the work that begins, its number and the number of all such works;
# or None.
_observer: ContextVar[Callable[[str, int, int], None] | None] = ContextVar(
    "stage_observer", default=None
)

# Module that shows progress in a notebook.
NOTEBOOK_PROGRESS = "mjfim.output.notebook_progress"

# Event that a callback takes.
AnyEvent = TypeVar("AnyEvent")

# True inside a verb whose progress is shown; the verbs that it calls show none.
_is_shown: ContextVar[bool] = ContextVar("is_shown", default=False)


def begin_stage(name: str, index: int = 0, count: int = 0) -> None:
    """Tell the display of progress, if there is one, which work begins.

    Args:
        name: The work, in words.
        index: Its number among works of the same kind, from 0.
        count: Number of these works; 0 if it is not known.
    """
    observer = _observer.get()
    if observer is not None:
        observer(name, index, count)


@contextmanager
def stages_observed_by(observer: Callable[[str, int, int], None]) -> Iterator[None]:
    """Call a function with the name of every work that begins in the context.

    Args:
        observer: The function; see `begin_stage` for its arguments.
    """
    token = _observer.set(observer)
    try:
        yield
    finally:
        _observer.reset(token)


def in_notebook() -> bool:
    """Return whether this program is the kernel of a notebook."""
    ipython = sys.modules.get("IPython")
    if ipython is None or "ipykernel" not in sys.modules:
        return False
    return getattr(ipython.get_ipython(), "kernel", None) is not None


@contextmanager
def shown_progress(
    description: str, callback: Callable[[AnyEvent], None] | None, progress: bool
) -> Iterator[Callable[[AnyEvent], None] | None]:
    """Show the progress of a verb in a notebook, unless the caller does something else with it.

    Args:
        description: What the verb does, until the first event.
        callback: Function of the caller that takes the events, or None.
        progress: False where the caller wants no display.

    Yields:
        The function that takes the events: that of the caller, the display, or None.
    """
    if callback is not None or not progress or _is_shown.get() or not in_notebook():
        yield callback
        return

    token = _is_shown.set(True)
    try:
        with import_module(NOTEBOOK_PROGRESS).progress(description) as display:
            yield display
    finally:
        _is_shown.reset(token)

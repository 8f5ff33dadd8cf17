"""A bar of progress in a notebook.

It needs no widgets, so that it also works where only the display of HTML is installed.
"""

from __future__ import annotations

import time
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape

from IPython.display import display

from mjfim.output.progress_text import ProgressLine, progress_line
from mjfim.records.events import Event

# Shortest time between two updates of the display [s].
UPDATE_SECONDS = 0.2


class NotebookProgress:
    """A bar with a line of text, which is updated by events."""

    def __init__(self, description: str) -> None:
        """Show the bar.

        Args:
            description: What is done, until the first event.
        """
        self._description = description
        self._line = ProgressLine(text=description)
        self._begun = self._shown = time.monotonic()
        self._handle = display(self._running(), raw=True, display_id=True)

    def __call__(self, event: Event) -> None:
        """Show an event, unless the last one was shown a moment ago.

        Args:
            event: The event.
        """
        self._line = progress_line(event)

        now = time.monotonic()
        if now - self._shown >= UPDATE_SECONDS:
            self._shown = now
            self._handle.update(self._running(), raw=True)

    def end(self, *, failed: bool) -> None:
        """Replace the bar by the last line and the time that the work took.

        Args:
            failed: True if an exception ends the work.
        """
        seconds = f"{self._seconds():.1f} s"
        text = f"{self._text()} ({f'ended by an error after {seconds}' if failed else seconds})"
        html = f'<div style="opacity: 0.7">{escape(text)}</div>'
        self._handle.update({"text/html": html, "text/plain": text}, raw=True)

    def _running(self) -> dict[str, str]:
        """Return the bar, and a text for displays without HTML."""
        state = ""
        if self._line.count is not None:
            state = f' max="{self._line.count}" value="{self._line.done:.3f}"'

        text = f"{self._text()} ({self._seconds():.0f} s)"
        html = f"<div><progress{state}></progress> {escape(text)}</div>"
        return {"text/html": html, "text/plain": text}

    def _text(self) -> str:
        """Return what is done, with the description before the line of the last event."""
        line = self._line.text
        return line if line == self._description else f"{self._description}: {line}"

    def _seconds(self) -> float:
        """Return the time since the work began [s]."""
        return time.monotonic() - self._begun


@contextmanager
def progress(description: str) -> Iterator[NotebookProgress]:
    """Show the progress of long work while the context lasts.

    Args:
        description: What is done, until the first event.

    Yields:
        The display, which is called with every event.
    """
    shown = NotebookProgress(description)
    try:
        yield shown
    except BaseException:
        shown.end(failed=True)
        raise
    shown.end(failed=False)

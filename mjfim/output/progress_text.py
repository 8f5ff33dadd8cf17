"""Progress of long work: its events in one line of text, and a bar in notebooks.

The bar needs no widgets, so that it also works where only the display of HTML is installed.
"""

from __future__ import annotations

import math
import time
from collections.abc import Iterator
from contextlib import contextmanager
from html import escape

from mjfim.output.page import shown_word
from mjfim.records.events import DesignEvent, Event, FitEvent

# What is done, in one line; then the number of finished parts and of all, None where not known.
ProgressLine = tuple[str, float | None, int | None]


def progress_line(event: Event) -> ProgressLine:
    """Describe an event in one line.

    Args:
        event: The event.
    """
    if isinstance(event, DesignEvent):
        return design_text(event), None, None
    if isinstance(event, FitEvent):
        iteration = f"{event.phase}: iteration {event.iteration}"
        text = f"{iteration}, cost {event.cost:.6g}, step {event.step:.2g} σ"
        return text, None, None
    if event.count is None:
        return event.message, None, None

    text = f"{event.index + 1}/{event.count} {shown_word(event.part)}  {event.message}".rstrip()
    return text, event.index + event.share, event.count


def design_text(event: DesignEvent) -> str:
    """Describe an iterate of a design.

    Args:
        event: The event.
    """
    row = event.row
    text = f"iteration {row.iteration:3d}  J {row.cost:.6g}  λ_min {row.min_eigenvalue:.5g}"
    if math.isinf(row.cost):
        text = f"iteration {row.iteration:3d}  outside the limits"

    # The search for a release has no slope.
    return text if math.isnan(row.slope) else f"{text}  slope {row.slope:.1e}"


def design_stage(event: DesignEvent) -> str:
    """Name the stage of a design; J of two stages cannot be compared.

    Args:
        event: The event.
    """
    row = event.row
    at_rate = f"at {row.rate:.4g} Hz"
    if not row.mu:
        return f"searching {at_rate}"
    if math.isinf(row.mu):
        return f"steering into the limits {at_rate}"
    return f"searching inside the limits {at_rate}, barrier {row.mu:.1g}"


# Shortest time between two updates of the display [s].
UPDATE_SECONDS = 0.2


class NotebookProgress:
    """A bar with a line of text, which is updated by events."""

    def __init__(self, description: str) -> None:
        """Show the bar.

        Args:
            description: What is done, until the first event.
        """
        from IPython.display import display  # slow, and only notebooks have it

        self._description = description
        self._line: ProgressLine = (description, None, None)
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
        _, done, count = self._line
        if count is not None:
            state = f' max="{count}" value="{done:.3f}"'

        text = f"{self._text()} ({self._seconds():.0f} s)"
        html = f"<div><progress{state}></progress> {escape(text)}</div>"
        return {"text/html": html, "text/plain": text}

    def _text(self) -> str:
        """Return what is done, with the description before the line of the last event."""
        line, _, _ = self._line
        return line if line == self._description else f"{self._description}: {line}"

    def _seconds(self) -> float:
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

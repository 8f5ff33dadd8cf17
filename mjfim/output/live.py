"""Progress of long work: a line of text, a bar in notebooks, and a Rerun viewer.

The bar needs no widgets, so that it also works where only the display of HTML is installed. A
viewer that is missing, or that is closed, never changes the work: one sentence says so. The command
line imports this module at its start, so that it imports nothing slow.
"""

from __future__ import annotations

import math
import os
import re
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from html import escape
from typing import TYPE_CHECKING, Any
from urllib.parse import urlsplit

from mjfim.errors import ExperimentError, MjfimError
from mjfim.output.page import shown_word
from mjfim.records.events import DesignEvent, Event, FitEvent

if TYPE_CHECKING:
    from mjfim.experiment.system import System
    from mjfim.output.rerun.live import LiveShow
    from mjfim.records.events import Callback

# Address of a viewer that is told nothing else, and the word for the viewer of this computer, which
# may be opened.
LOCAL_HOST = "127.0.0.1"
DEFAULT_ADDRESS = f"{LOCAL_HOST}:9876"
HERE = "here"

# Form of an address: a host with a port, or a URL of Rerun.
ADDRESS = re.compile(r"rerun(\+https?)?://\S+|[\w.-]+:\d{1,5}")

# Time to wait for an answer of a viewer that should be there, for a new viewer, and between two
# looks for it [s].
ANSWER_SECONDS, START_SECONDS, LOOK_SECONDS = 2.0, 20.0, 0.2


# ---- words and bars

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


# ---- a viewer of Rerun


class NoViewerError(MjfimError):
    """There is no viewer, for a reason that the message states; the work goes on without it."""


@contextmanager
def live_system(
    system: System, address: str | None = None, *, say: Callable[[str], object] | None = None
) -> Iterator[Callback]:
    """Show how a search for a resolved system proceeds. See `mjfim.live`."""
    tell = say or (lambda sentence: sys.stderr.write(f"mjfim: {sentence}\n"))
    viewer = None
    try:
        viewer = _connected(url_of(address or DEFAULT_ADDRESS), system, may_open=address is None)
    except NoViewerError as reason:
        tell(f"there is no live view: {reason}")

    def watched(action: Callable[[LiveShow], object]) -> None:
        """Do something with the viewer; the search never fails with it."""
        nonlocal viewer
        if viewer is not None:
            try:
                action(viewer)
            except Exception as error:
                viewer = None
                tell(f"the live view ended: {error}")

    try:
        yield lambda event: watched(lambda show: show(event))
    finally:
        watched(lambda show: show.end())


def url_of(address: str) -> str:
    """Return the URL of a viewer.

    Args:
        address: A host with a port, or a URL of Rerun.

    Raises:
        ExperimentError: The address has another form.
    """
    if not ADDRESS.fullmatch(address):
        raise ExperimentError(
            f"--live {address}: an address is HOST:PORT, such as {DEFAULT_ADDRESS}, or a URL that "
            "begins with rerun+http://"
        )
    return address if "://" in address else f"rerun+http://{address}/proxy"


def _connected(url: str, system: System, *, may_open: bool) -> LiveShow:
    """Connect to a viewer, which is opened if it is missing and that is permitted.

    Raises NoViewerError where there is none.
    """
    if not _is_listening(url):
        if not may_open:
            raise NoViewerError(f"nothing listens at {url}; start a viewer there with `rerun`")
        if not has_display():
            raise NoViewerError(
                "this computer has no display; start a viewer on another one with `rerun`, and "
                "state its address, such as --live HOST:9876"
            )
        _open_viewer(url)

    # This imports Rerun, which takes a while.
    from mjfim.output.rerun.live import LiveShow

    return LiveShow.connected(url, system.model_at(system.theta))


def has_display() -> bool:
    """Return whether a window can be opened, as far as this can be seen beforehand."""
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def start_viewer(*words: str, **streams: Any) -> subprocess.Popen[bytes]:
    """Start a Rerun viewer that only this computer reaches, and that sends no usage statistics.

    Args:
        *words: Its further words.
        **streams: Its standard streams, as for `subprocess.Popen`.
    """
    # With -P, Python does not look for the viewer in the current folder.
    command = [sys.executable, "-P", "-m", "rerun", "--bind", LOCAL_HOST, *words]
    # The variable is the viewer's own way to send and store no statistics, whatever its settings.
    return subprocess.Popen(
        command, env={**os.environ, "CI": "1"}, start_new_session=True, **streams
    )


def _open_viewer(url: str) -> None:
    """Open a viewer, and wait until it listens; it stays open after the program has ended."""
    nowhere = subprocess.DEVNULL
    words = ("--port", str(urlsplit(url).port), "--hide-welcome-screen")
    viewer = start_viewer(*words, stdin=nowhere, stdout=nowhere, stderr=nowhere)

    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline:
        code = viewer.poll()
        if code is not None:
            raise NoViewerError(f"the viewer ended with code {code}; it needs a display")
        if _is_listening(url):
            return
        time.sleep(LOOK_SECONDS)
    viewer.kill()
    raise NoViewerError(f"the viewer did not answer within {START_SECONDS:.0f} s")


def _is_listening(url: str) -> bool:
    """Whether something listens at the host and the port of a URL."""
    parts = urlsplit(url)
    try:
        place = (parts.hostname or LOCAL_HOST, parts.port or urlsplit(f"//{DEFAULT_ADDRESS}").port)
        with socket.create_connection(place, timeout=ANSWER_SECONDS):
            return True
    except (OSError, ValueError):
        return False

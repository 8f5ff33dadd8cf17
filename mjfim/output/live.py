"""A search that is watched in a Rerun viewer while it runs.

A viewer that is missing, or that is closed, never changes the search: one sentence says so.
"""

from __future__ import annotations

import os
import socket
import subprocess
import sys
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING
from urllib.parse import urlsplit

from mjfim.errors import MjfimError
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.output.live_address import DEFAULT_ADDRESS, DEFAULT_PORT, url_of
from mjfim.records.events import Callback, Event

if TYPE_CHECKING:
    from mjfim.output.rerun.live import LiveShow

# Time to wait for an answer of a viewer that should be there, and for a new viewer [s].
ANSWER_SECONDS, START_SECONDS = 2.0, 20.0


class NoViewerError(MjfimError):
    """There is no viewer, for a reason that the message states; the work goes on without it."""


@contextmanager
def live(
    experiment: Experiment,
    address: str | None = None,
    *,
    say: Callable[[str], None] | None = None,
) -> Iterator[Callback]:
    """Show in a Rerun viewer how a search proceeds; a context around the verb.

    What it yields is the `callback` of `design`, `identify`, `monte_carlo` and the other verbs:

        with mjfim.live(experiment) as show:
            design = mjfim.design(experiment, callback=show)

    The viewer shows the cost and the smallest eigenvalue of the information over the iterates, and
    the motion of the best one so far: the robot, and its positions and controls over time. The
    result is the same with and without it. Where there is no viewer, one sentence says so, and the
    work goes on.

    Args:
        experiment: The experiment, whose model is shown.
        address: Where a viewer listens, `HOST:PORT` or a URL `rerun+http://HOST:PORT/proxy`.
            Default: the viewer of this computer, which is opened if there is none.
        say: Takes the sentence; default: it is printed to stderr.

    Yields:
        The function that takes the events.

    Raises:
        ExperimentError: The address has another form.
    """
    with live_system(System.resolve(experiment), address, say=say) as show:
        yield show


@contextmanager
def live_system(
    system: System, address: str | None = None, *, say: Callable[[str], None] | None = None
) -> Iterator[Callback]:
    """Show how a search for a resolved system proceeds. See `live`.

    Args:
        system: The system.
        address: Where a viewer listens; default: the viewer of this computer.
        say: Takes the sentence about a viewer that is missing or has ended.

    Yields:
        The function that takes the events.
    """
    tell = _print if say is None else say
    where = address or DEFAULT_ADDRESS
    url = url_of(where)
    try:
        _require_viewer(url, may_open=address is None)
        show = _connected(url, system)
    except NoViewerError as reason:
        tell(f"there is no live view: {reason}")
        yield _show_nothing
        return

    watched = _Watched(show, tell)
    try:
        yield watched
    finally:
        watched.end()


class _Watched:
    """Passes events on to a viewer until it fails; the search never fails with it."""

    def __init__(self, show: LiveShow, tell: Callable[[str], None]) -> None:
        self._show: LiveShow | None = show
        self._tell = tell

    def __call__(self, event: Event) -> None:
        """Show an event."""
        if self._show is not None:
            self._try(self._show, event)

    def end(self) -> None:
        """Show the last event, and close the connection."""
        if self._show is not None:
            self._try(self._show, None)

    def _try(self, show: LiveShow, event: Event | None) -> None:
        """Show an event, or the end; a failure ends the view."""
        try:
            if event is None:
                show.end()
            else:
                show(event)
        except Exception as error:
            self._show = None
            self._tell(f"the live view ended: {error}")


def _show_nothing(event: Event) -> None:
    """Take an event where there is no viewer."""


def _print(sentence: str) -> None:
    """Show a sentence to the user of a script."""
    sys.stderr.write(f"mjfim: {sentence}\n")


def _connected(url: str, system: System) -> LiveShow:
    """Connect to a viewer. This imports Rerun, which takes a while."""
    from mjfim.output.rerun.live import LiveShow

    return LiveShow.connected(url, system.model_at(system.theta))


# ---- the viewer


def _require_viewer(url: str, *, may_open: bool) -> None:
    """Make sure that a viewer listens; open one if that is permitted.

    Raises:
        NoViewerError: There is none.
    """
    if _is_listening(url):
        return
    if not may_open:
        raise NoViewerError(f"nothing listens at {url}; start a viewer there with `rerun`")
    if not has_display():
        raise NoViewerError(
            "this computer has no display; start a viewer on another one with `rerun`, and state "
            "its address, such as --live HOST:9876"
        )
    _open_viewer(url)


def has_display() -> bool:
    """Return whether a window can be opened, as far as this can be seen beforehand."""
    if not sys.platform.startswith("linux"):
        return True
    return bool(os.environ.get("DISPLAY") or os.environ.get("WAYLAND_DISPLAY"))


def _open_viewer(url: str) -> None:
    """Open a viewer, and wait until it listens; it stays open after the program has ended."""
    # With -P, Python does not look for the viewer in the current folder.
    port = str(urlsplit(url).port)
    command = [sys.executable, "-P", "-m", "rerun", "--port", port, "--hide-welcome-screen"]
    viewer = subprocess.Popen(
        command,
        stdin=subprocess.DEVNULL,
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        start_new_session=True,
    )

    deadline = time.monotonic() + START_SECONDS
    while time.monotonic() < deadline:
        code = viewer.poll()
        if code is not None:
            raise NoViewerError(f"the viewer ended with code {code}; it needs a display")
        if _is_listening(url):
            return
        time.sleep(0.2)

    viewer.kill()
    raise NoViewerError(f"the viewer did not answer within {START_SECONDS:.0f} s")


def _is_listening(url: str) -> bool:
    """Whether something listens at the host and the port of a URL."""
    parts = urlsplit(url)
    try:
        place = (parts.hostname or "127.0.0.1", parts.port or DEFAULT_PORT)
        with socket.create_connection(place, timeout=ANSWER_SECONDS):
            return True
    except (OSError, ValueError):
        return False

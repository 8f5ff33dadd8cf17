"""Reaction of a program to Ctrl-C and SIGTERM, so that no result is lost.

The first press asks the computation to return its best result so far, which is then written. A
second press leaves out what is not necessary, such as figures. These are also left out
`FINISH_SECONDS` after the first press, which hurries no computation. Before there is anything to
keep, the first press ends the program.
"""

from __future__ import annotations

import _thread
import os
import signal
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path
from queue import Empty, SimpleQueue
from types import FrameType, TracebackType
from typing import Any, Protocol

from mjfim.errors import InterruptedByUserError, UnfinishedError
from mjfim.files import remove_temporary_files

# Time after the first press at which files are left out that are not necessary [s]. Computations
# usually end within about 5 s. What is drawn then may take much longer on a busy computer, and can
# be drawn later.
FINISH_SECONDS = 6.0

# Time after the second press of the user at which the process ends in any case [s].
LAST_SECONDS = 5.0

# Time after which an error is raised once more that came during a callback or an import [s].
AGAIN_SECONDS = 0.05

# Time for which the end of the context waits for the thread that announces presses [s].
WATCHER_SECONDS = 1.0

# Exit code of an interrupted program.
INTERRUPTED_CODE = 1

# Begin of the file names of the code by which Python imports modules.
IMPORT_MACHINERY = "<frozen importlib._bootstrap"

# Signals that interrupt a program.
SIGNALS = (signal.SIGINT, signal.SIGTERM)

# What the user reads where there is nothing to keep, after the first press, and before a process is
# ended from outside its loops.
NOTHING_SENTENCE = "interrupted before there was a result; nothing was written"
FIRST_SENTENCE = "interrupted; finishing with the best so far; press again to stop at once"
LAST_SENTENCE = "interrupted; stopped at once; each file that was written is complete"


class Request(Protocol):
    """Something that can be asked to stop, such as a `mjfim.budget.StopToken`."""

    def request(self) -> None:
        """Ask the computation to return its best result so far."""


class Interruption:
    """Handler of Ctrl-C and SIGTERM while a program runs; a context manager.

    Python delivers signals to the main thread only; in another thread the context has no effect. A
    process that ignores Ctrl-C, such as a worker, continues to ignore it.

    Attributes:
        presses: Number of presses of the user so far.
        folder: Folder that holds results already, or None.
        incomplete: True after results were left out.
    """

    def __init__(self, announce: Callable[[str], None]) -> None:
        """Prepare the handler.

        Args:
            announce: Shows a sentence to the user; called from another thread.
        """
        self.presses = 0
        self.folder: Path | None = None
        self.incomplete = False

        self._announce = announce
        self._requests: list[Request] = []
        self._has_result = False
        self._has_work_to_finish = False
        self._is_optional = False

        # Whether the time for files that may be left out is over, and whether the signal that says
        # so is still to come.
        self._is_time_over = False
        self._is_own_press_expected = False
        self._before: dict[int, Any] = {}

        # An error that is raised later, because the press came during a callback or an import, and
        # whether the signal that raises it is still to come.
        self._postponed: type[BaseException] | None = None
        self._again: threading.Timer | None = None
        self._is_again_expected = False

        # Whether an error of this handler has ended something.
        self._has_left = False
        self._hook_before = sys.unraisablehook

        self._watcher: threading.Thread | None = None

        # A queue of this kind may be used in a signal handler; None ends the thread that watches.
        self._pressed: SimpleQueue[int | None] = SimpleQueue()

    def __enter__(self) -> Interruption:
        """Handle the signals from here on."""
        is_main_thread = threading.current_thread() is threading.main_thread()
        if not is_main_thread or not callable(signal.getsignal(signal.SIGINT)):
            return self

        global _current
        _current = self
        self._before = {number: signal.getsignal(number) for number in SIGNALS}
        self._watcher = threading.Thread(target=self._watch, name="mjfim-interruption", daemon=True)
        self._watcher.start()
        for number in SIGNALS:
            signal.signal(number, self)
        self._hook_before, sys.unraisablehook = sys.unraisablehook, self._on_unraisable
        return self

    def __exit__(
        self,
        kind: type[BaseException] | None,
        error: BaseException | None,
        traceback: TracebackType | None,
    ) -> None:
        """Restore the handlers of before.

        Raises:
            InterruptedByUserError: A press came during an import, and the work has ended without a
                result that is kept.
        """
        global _current
        if not self._before:
            return

        # From here on, no press follows by itself: the handlers of before would receive it.
        _current = None
        if self._again is not None:
            self._again.cancel()

        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)
        sys.unraisablehook = self._hook_before
        self._pressed.put(None)

        # What the other thread still says belongs to this context, and not to what follows.
        if self._watcher is not None:
            self._watcher.join(timeout=WATCHER_SECONDS)

        # Short work may end before an error comes that was postponed.
        if kind is None:
            self._end_if_postponed()

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """React to a press.

        Raises:
            InterruptedByUserError: There is nothing to keep yet.
            UnfinishedError: The second press, or the end of the time, while something is written
                that may be left out.
        """
        # This handler has sent the signal itself; two of its signals may arrive as one. After the
        # time for files that may be left out, computations go on.
        if self._is_again_expected or self._is_own_press_expected:
            error, self._postponed = self._postponed, None
            if error is None and self._is_own_press_expected:
                error = UnfinishedError
            self._is_again_expected = self._is_own_press_expected = False
            if error is InterruptedByUserError or (error is not None and self._is_optional):
                self._leave(error, frame)
            return
        self.presses += 1

        # The thread that announces the first press must not see what this function changes later.
        if self.presses == 1:
            self._has_work_to_finish = bool(self._requests) or self._has_result
        self._pressed.put(self.presses)

        for request in self._requests:
            request.request()

        # The error ends the program; a further press must not disturb that.
        if not self._requests and not self._has_result:
            self._has_result = True
            self._leave(InterruptedByUserError, frame)
        elif self._is_optional and self.hurried:
            self._leave(UnfinishedError, frame)

    @property
    def hurried(self) -> bool:
        """True after the second press of the user."""
        return self.presses > 1

    def keep(self, folder: Path | None = None) -> None:
        """Say that there is a result, so that no press ends the program before it is written.

        Args:
            folder: Folder that receives it, or None.

        Raises:
            InterruptedByUserError: A press came during an import, and the program goes on.
        """
        self._end_if_postponed()
        self._has_result = True
        self.folder = folder or self.folder

    @contextmanager
    def computing(self, request: Request) -> Iterator[None]:
        """Pass presses on to a computation; afterwards, there is a result to keep.

        Args:
            request: Asks the computation to stop; after an earlier press, it is asked at once.

        Raises:
            InterruptedByUserError: A press came during an import, and the program goes on.
        """
        self._end_if_postponed()
        self._requests.append(request)
        if self.presses:
            request.request()
        try:
            yield
            self._has_result = True
        finally:
            self._requests.remove(request)

    def run_optional(self, write: Callable[[], object]) -> None:
        """Call a function, and leave it at the second press, or when the time is over.

        Args:
            write: Writes something that may be left out.
        """
        self._is_optional = True
        try:
            if self.hurried or self._is_time_over:
                raise UnfinishedError
            write()
        except UnfinishedError:
            self.incomplete = True
        finally:
            self._is_optional = False

    def _leave(self, error: type[BaseException], frame: FrameType | None) -> None:
        """Raise an error of this handler, or have it raised after the import that is running.

        An import that ends halfway would leave modules behind that cannot be imported again.

        Args:
            error: The error.
            frame: What the main thread is running, or None.

        Raises:
            InterruptedByUserError: It is the error.
            UnfinishedError: It is the error.
        """
        if _is_importing(frame):
            self._raise_later(error)
            return
        self._has_left = True
        raise error

    def _on_unraisable(self, dropped: sys.UnraisableHookArgs) -> None:
        """Raise an error of this handler once more where Python cannot pass it on.

        A press may come while a callback of Python's memory management runs, such as after an
        import. Python then shows the error in place of raising it, and the work would go on.

        Args:
            dropped: The error that is not passed on.
        """
        # A file that was opened in the moment of the press is closed by Python itself.
        if self._has_left and issubclass(dropped.exc_type, ResourceWarning):
            return

        if dropped.exc_type in (InterruptedByUserError, UnfinishedError):
            self._raise_later(dropped.exc_type)
        else:
            self._hook_before(dropped)

    def _raise_later(self, error: type[BaseException]) -> None:
        """Raise an error in the main thread a little later."""
        self._postponed = error
        if self._again is not None:
            self._again.cancel()

        # The callback, or the import, may have ended when the other thread sends the signal.
        self._again = threading.Timer(AGAIN_SECONDS, self._press_again)
        self._again.daemon = True
        self._again.start()

    def _end_if_postponed(self) -> None:
        """End a program that goes on after an import in which the press came.

        A short computation would end before the signal that raises the error.

        Raises:
            InterruptedByUserError: It was postponed.
        """
        if self._postponed is InterruptedByUserError:
            self._postponed = None
            raise InterruptedByUserError

    def _press_again(self) -> None:
        """Send the signal by which an error is raised that was postponed."""
        if self._postponed is None:
            return
        self._is_again_expected = True
        self._press_by_itself()

    def _press_by_itself(self) -> None:
        """Send a signal to the main thread, unless the program has left this context."""
        if _current is self:
            _send_to_main_thread()

    def _watch(self) -> None:
        """Announce the first press, end what may be left out, and end the process at last."""
        if self._pressed.get() is None:
            return
        if self._has_work_to_finish:
            self._announce(FIRST_SENTENCE)

        # Without a second press of the user, results are finished for a limited time.
        try:
            pressed = self._pressed.get(timeout=FINISH_SECONDS)
        except Empty:
            self._is_time_over = True
            self._is_own_press_expected = True
            self._press_by_itself()
            pressed = self._pressed.get()
        if pressed is None:
            return

        # The user wants an end; work that does not return in time is given up.
        try:
            while self._pressed.get(timeout=LAST_SECONDS) is not None:
                continue
        except Empty:
            self._announce(LAST_SENTENCE)
            remove_temporary_files()
            os._exit(INTERRUPTED_CODE)


def _is_importing(frame: FrameType | None) -> bool:
    """Return whether a module is being imported.

    Args:
        frame: What a thread is running, or None.
    """
    while frame is not None:
        if frame.f_code.co_filename.startswith(IMPORT_MACHINERY):
            return True
        frame = frame.f_back
    return False


def _send_to_main_thread() -> None:
    """Send SIGINT to the main thread, also while it waits, such as for another process."""
    if hasattr(signal, "pthread_kill"):
        main_thread = threading.main_thread().ident
        assert main_thread is not None
        signal.pthread_kill(main_thread, signal.SIGINT)
    else:
        _thread.interrupt_main(signal.SIGINT)


# The handler in force. Signals concern the whole process, and so does the handler.
_current: Interruption | None = None


def current_interruption() -> Interruption | None:
    """Return the handler in force; None where the program has none, or in another thread."""
    is_main_thread = threading.current_thread() is threading.main_thread()
    return _current if is_main_thread else None


def hurried() -> bool:
    """Return whether the user has pressed Ctrl-C twice."""
    return _current is not None and _current.hurried


def run_optional(write: Callable[[], object]) -> None:
    """Call a function, and leave it when the user presses twice, or some time after one press.

    Args:
        write: Writes something that may be left out, such as figures.
    """
    interruption = current_interruption()
    if interruption is None:
        write()
    else:
        interruption.run_optional(write)

"""Budget of a computation, the token that asks it to stop, and what Ctrl-C and signals do.

Long computations check `budget.exhausted` in their loops and return their best result so far; no
exception is raised to stop them. `stop_on_interrupt`, which the verbs use, turns Ctrl-C into a
request of a token.

On the command line, an `Interruption` is in force. The first press asks the computation to return
its best result so far, which is then written. A second press leaves out what is not necessary, such
as figures; so are those that are not begun `FINISH_SECONDS` after the first press. Before there is
anything to keep, the first press ends the program.
"""

from __future__ import annotations

import math
import os
import signal
import threading
import time
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager, nullcontext
from contextvars import ContextVar
from enum import Enum
from pathlib import Path
from queue import Empty, SimpleQueue
from types import FrameType
from typing import Any

from mjfim.errors import InterruptedByUserError, UnfinishedError
from mjfim.files import remove_temporary_files

# Longest time that a budget may take to another process [s]. More is a difference of the clocks.
LONGEST_WAY = 60.0

# Time after the first press at which no file is begun that is not necessary [s]. Computations
# usually end within about 5 s. What is drawn then may take much longer on a busy computer, and can
# be drawn later.
FINISH_SECONDS = 6.0

# Time after the second press of the user at which the process ends in any case, and after the first
# one where there is nothing to keep and an import or code in C has not ended [s].
LAST_SECONDS = 5.0

# Exit code of an interrupted program.
INTERRUPTED_CODE = 1

# Begin of the file names of the code by which Python imports modules.
IMPORT_MACHINERY = "<frozen importlib._bootstrap"

# Signals that interrupt a program. Windows has no SIGHUP, which comes when a terminal is closed.
SIGNALS = (signal.SIGINT, signal.SIGTERM, *[signal.SIGHUP] * hasattr(signal, "SIGHUP"))


def heard_signals() -> list[signal.Signals]:
    """Return the signals to which this program reacts: those that it does not ignore, and SIGTERM.

    A shell lets its background jobs ignore SIGINT, and `nohup` lets a program ignore SIGHUP.
    """
    ignored = {each for each in SIGNALS if signal.getsignal(each) is signal.SIG_IGN}
    return [each for each in SIGNALS if each not in ignored - {signal.SIGTERM}]


# What the user reads where there is nothing to keep, after the first press, and before a process is
# ended from outside its loops.
NOTHING_SENTENCE = "interrupted before there was a result; nothing was written"
FIRST_SENTENCE = "interrupted; finishing with the best so far; press again to stop at once"
LAST_SENTENCE = "interrupted; stopped at once; each file that was written is complete"


class StopReason(Enum):
    """Reason why a computation ended early; the value is a sentence for the user."""

    REQUESTED = "interrupted by the user"
    SECONDS = "the time is used up"


class StopToken:
    """A request to stop, which all computations that share the token check.

    The request may come from another thread, from a signal handler or from a callback.

    Args:
        also: Function that returns True if there is a request from elsewhere, such as from a
            parent process.
    """

    def __init__(self, also: Callable[[], bool] | None = None) -> None:
        self._is_requested = False
        self._also = also

    def request(self) -> None:
        """Ask all computations that share this token to return their best result so far."""
        self._is_requested = True

    @property
    def requested(self) -> bool:
        """True after a request to stop."""
        return self._is_requested or (self._also is not None and self._also())


_clock: ContextVar[Callable[[], float]] = ContextVar("mjfim_clock", default=time.monotonic)


@contextmanager
def measured_by(clock: Callable[[], float]) -> Iterator[None]:
    """Let budgets that are made inside the context measure time by another clock.

    With `time.process_time`, work gets the same number of processor seconds on a busy machine as on
    an idle one. This is meant for benchmarks in one process.

    Args:
        clock: Returns the time from any fixed moment [s].
    """
    restore = _clock.set(clock)
    try:
        yield
    finally:
        _clock.reset(restore)


class Budget:
    """Time that a computation may use; it checks the budget in its loops.

    Args:
        seconds: Time from the creation of the budget [s]; infinite without a limit.
        stop: Token that ends the computation early.
    """

    def __init__(self, *, seconds: float = math.inf, stop: StopToken | None = None) -> None:
        self.stop = StopToken() if stop is None else stop
        self._now = _clock.get()
        self.begun = self._now()
        self.deadline = self.begun + seconds

    @property
    def seconds_left(self) -> float:
        """Remaining time [s], never negative; infinite without a limit."""
        return max(self.deadline - self._now(), 0.0)

    @property
    def seconds_used(self) -> float:
        """Time since the budget was made [s]."""
        return self._now() - self.begun

    @property
    def used(self) -> float:
        """Used fraction of the time; 1 or more if it is used up, 0 without a limit."""
        total = self.deadline - self.begun
        return self.seconds_used / total if total > 0.0 else 1.0

    @property
    def exhausted(self) -> StopReason | None:
        """Reason to stop the computation; None while it may continue."""
        if self.stop.requested:
            return StopReason.REQUESTED
        return StopReason.SECONDS if self._now() >= self.deadline else None

    def share(self, fraction: float = 1.0) -> Budget:
        """Make a budget for a part of the computation; both budgets share one token.

        Args:
            fraction: Fraction of the remaining time.

        Returns:
            A budget that begins to count now.
        """
        return Budget(seconds=fraction * self.seconds_left, stop=self.stop)

    def with_stop(self, stop: StopToken) -> Budget:
        """Make a copy with another token.

        Args:
            stop: The other token.

        Returns:
            A budget with equal limits and equal use so far.
        """
        # `copy.copy` would restore the clock of another process.
        other = object.__new__(type(self))
        other.__dict__.update(self.__dict__)
        other.stop = stop
        return other

    def __getstate__(self) -> dict[str, Any]:
        """State for another process, in which the stop token and the clock differ."""
        state = dict(self.__dict__)
        state["stop"] = None
        state["moment"] = time.time(), state.pop("_now")()
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore in another process; `stop` is a new token, which the worker replaces."""
        wall, then = state.pop("moment")
        self.__dict__.update(state)
        self._now = time.monotonic

        # The clocks of two computers may differ, but the way between them takes a moment only.
        on_the_way = min(max(time.time() - wall, 0.0), LONGEST_WAY)
        shift = (self._now() - then) - on_the_way
        self.begun += shift
        self.deadline += shift
        self.stop = StopToken()


class Interruption:
    """Handler of Ctrl-C, SIGTERM and SIGHUP while a program runs; a context manager.

    Python delivers signals to the main thread only; in another thread the context has no effect.

    Args:
        announce: Shows a sentence to the user; called from another thread.

    Attributes:
        presses: Number of presses of the user so far.
        folder: Folder that holds results already, or None.
        incomplete: True after results were left out.
    """

    def __init__(self, announce: Callable[[str], None]) -> None:
        self.presses = 0
        self.folder: Path | None = None
        self.incomplete = False
        self._announce = announce
        self._requests: list[StopToken] = []
        self._has_result = False
        self._is_optional = False
        self._is_postponed = False
        self._first_press = math.inf
        self._before: dict[int, Any] = {}

        # Whether there is work to finish, from the handler. It may use a queue of this kind.
        self._answered: SimpleQueue[bool] = SimpleQueue()
        self._watcher = threading.Thread(target=self._watch, daemon=True)

    def __enter__(self) -> Interruption:
        """Handle the signals from here on."""
        global _current
        if threading.current_thread() is threading.main_thread():
            from socket import socketpair  # takes a while to import

            # Python calls handlers when code in C returns, and the compile of a model may take
            # minutes. The thread that watches is told of every signal at once.
            self._signals, self._sender = socketpair()
            self._sender.setblocking(False)
            signal.set_wakeup_fd(self._sender.fileno(), warn_on_full_buffer=False)
            _current = self
            self._watcher.start()
            self._before = {number: signal.signal(number, self) for number in heard_signals()}
        return self

    def __exit__(self, kind: type[BaseException] | None, *_: object) -> None:
        """Restore the handlers of before; InterruptedByUserError after a press in an import."""
        global _current
        if not self._before:
            return
        _current = None
        for number, handler in self._before.items():
            signal.signal(number, signal.SIG_DFL if handler is None else handler)

        # What the other thread still says belongs to this context, and not to what follows.
        signal.set_wakeup_fd(-1)
        self._answered.put(False)
        self._sender.close()
        self._watcher.join(timeout=1.0)
        if kind is None:
            self._end_if_postponed()

    def __call__(self, number: int, frame: FrameType | None) -> None:
        """React to a press: ask computations to stop, or raise where none runs.

        Raises:
            InterruptedByUserError: There is nothing to keep.
            UnfinishedError: What is being written may be left out, and the user presses again.
        """
        # A terminal that is closed may send its signal twice, which is no press of a user.
        if self.presses and number not in SIGNALS[:2]:
            return
        self.presses += 1
        self._first_press = min(self._first_press, time.monotonic())
        for request in self._requests:
            request.request()

        # An import that ends halfway would leave modules behind that cannot be imported again.
        has_work = bool(self._requests) or self._has_result
        if not has_work and _is_importing(frame):
            self._is_postponed = True
            return
        self._answered.put(has_work)
        if has_work:
            if self._is_optional and self.hurried and not _is_importing(frame):
                raise UnfinishedError
        else:
            # The error ends the program; a further press must not disturb that.
            self._has_result = True
            raise InterruptedByUserError

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
    def computing(self, request: StopToken) -> Iterator[None]:
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
        """Call a function, but not some time after a press, and leave it at the second press.

        Args:
            write: Writes something that may be left out.
        """
        self._is_optional = True
        try:
            if self.hurried or time.monotonic() - self._first_press > FINISH_SECONDS:
                raise UnfinishedError
            write()
        except UnfinishedError:
            self.incomplete = True
        finally:
            self._is_optional = False

    def _end_if_postponed(self) -> None:
        """End a program that goes on after an import in which the press came."""
        if self._is_postponed:
            self._is_postponed = False
            self._answered.put(False)
            raise InterruptedByUserError

    def _watch(self) -> None:
        """Announce the first press, and end the process where a press has no effect in time."""
        if not self._has_come(SIGNALS):
            return
        try:
            has_work = self._answered.get(timeout=LAST_SECONDS)
        except Empty:
            has_work = bool(self._requests) or self._has_result
            if not has_work:
                self._end(NOTHING_SENTENCE)
        if has_work:
            self._announce(FIRST_SENTENCE)
        if not self._has_come(SIGNALS[:2]):
            return

        # The user wants an end; work that does not return in time is given up.
        self._signals.settimeout(LAST_SECONDS)
        try:
            while self._has_come(SIGNALS):
                continue
        except TimeoutError:
            self._end(LAST_SENTENCE)

    def _has_come(self, numbers: Sequence[int]) -> bool:
        """Wait for one of some signals; False at the end of the context."""
        while number := self._signals.recv(1):
            if number[0] in numbers:
                return True
        self._signals.close()
        return False

    def _end(self, sentence: str) -> None:
        """End the process at once."""
        self._announce(sentence)
        remove_temporary_files()
        os._exit(INTERRUPTED_CODE)


def _is_importing(frame: FrameType | None) -> bool:
    """Whether a module is being imported."""
    while frame is not None:
        if frame.f_code.co_filename.startswith(IMPORT_MACHINERY):
            return True
        frame = frame.f_back
    return False


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


_active: ContextVar[StopToken | None] = ContextVar("mjfim_stop_token", default=None)


@contextmanager
def stop_on_interrupt(stop: StopToken | None = None) -> Iterator[StopToken]:
    """Turn the first Ctrl-C inside the context into a request to stop.

    A second Ctrl-C raises KeyboardInterrupt as usual, except on the command line, which has a
    handler of its own (`Interruption`). Nested contexts share the token of the outermost one.
    Outside the main thread, to which Python delivers no signals, the token is only yielded.

    Args:
        stop: Token to set; default: that of the surrounding context, or a new one.

    Yields:
        The token that the computation has to check.
    """
    outer = _active.get()
    token = stop or outer or StopToken()
    restore = _active.set(token)
    try:
        with nullcontext() if token is outer else _requested_by_interrupt(token, outer):
            yield token
    finally:
        _active.reset(restore)


@contextmanager
def _requested_by_interrupt(token: StopToken, outer: StopToken | None) -> Iterator[None]:
    """Request a token, and that of the surrounding context, at Ctrl-C."""
    interruption = current_interruption()
    if interruption is not None:
        with interruption.computing(token):
            yield
        return

    # A process that ignores Ctrl-C, such as a worker, continues to ignore it.
    in_main_thread = threading.current_thread() is threading.main_thread()
    previous = signal.getsignal(signal.SIGINT)
    if not in_main_thread or not callable(previous):
        yield
        return

    def request(number: int, frame: FrameType | None) -> None:
        """Set this token and the one of the surrounding context; a second call interrupts."""
        if token.requested:
            signal.default_int_handler(number, frame)
        token.request()
        if outer is not None:
            outer.request()

    signal.signal(signal.SIGINT, request)
    try:
        yield
    finally:
        signal.signal(signal.SIGINT, previous)

"""Budget of time, engine steps and iterations for long work, and a token that asks it to stop.

Long work asks `budget.exhausted` in its loops and returns the best result so far; nothing is raised
to stop it. Ctrl-C becomes a token at the edge, in the verbs and the command line, by
`stop_on_interrupt`.
"""

from __future__ import annotations

import copy
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from enum import Enum
from types import FrameType
from typing import Any

import numpy as np


class StopReason(Enum):
    """Reason for which work ended early. The value is the sentence that a user reads."""

    REQUESTED = "interrupted by the user"
    SECONDS = "the time is used up"
    STEPS = "the engine steps are used up"
    ITERATIONS = "the iterations are used up"


class StopToken:
    """A request to stop, set once and seen by all work that shares the token.

    A token may be set from another thread, from a signal handler or from a callback.

    Args:
        also: Function that returns True where work has to stop as well, for example at the request
            of a parent process.
    """

    def __init__(self, also: Callable[[], bool] | None = None) -> None:
        self._event = threading.Event()
        self._also = also

    def request(self) -> None:
        """Ask all work that shares this token to return the best result so far."""
        self._event.set()

    @property
    def requested(self) -> bool:
        """True after a request to stop."""
        return self._event.is_set() or (self._also is not None and self._also())


class Budget:
    """Time, engine steps and iterations that work may use; asked in its loops.

    Args:
        seconds: Time from the creation of the budget [s]; infinite without a limit.
        steps: Engine steps; None without a limit.
        iterations: Iterations; None without a limit.
        stop: Token that ends the work early.
    """

    def __init__(
        self,
        *,
        seconds: float = np.inf,
        steps: float | None = None,
        iterations: int | None = None,
        stop: StopToken | None = None,
    ) -> None:
        self.stop = StopToken() if stop is None else stop
        self.begun = time.monotonic()
        self.deadline = self.begun + seconds
        self.max_steps = np.inf if steps is None else float(steps)
        self.max_iterations = np.inf if iterations is None else float(iterations)
        self.steps = 0.0
        self.iterations = 0

    def spend(self, *, steps: float = 0.0, iterations: int = 0) -> None:
        """Count what was used since the last call."""
        self.steps += steps
        self.iterations += iterations

    @property
    def seconds_left(self) -> float:
        """Remaining time [s], never negative; infinite without a limit."""
        return max(self.deadline - time.monotonic(), 0.0)

    @property
    def iterations_left(self) -> float:
        """Iterations that are left, never negative; infinite without a limit."""
        return max(self.max_iterations - self.iterations, 0)

    @property
    def seconds_used(self) -> float:
        """Time since the budget was made [s]."""
        return time.monotonic() - self.begun

    @property
    def used(self) -> float:
        """Share of the tightest limit that is used, at least 0; 1 or more when the budget is exhausted."""
        shares = [self.steps / self.max_steps, self.iterations / self.max_iterations]
        total = self.deadline - self.begun
        if np.isfinite(total):
            shares.append(self.seconds_used / total if total > 0.0 else 1.0)

        return max(shares)

    @property
    def exhausted(self) -> StopReason | None:
        """Reason to stop the work, or None while it may continue."""
        if self.stop.requested:
            return StopReason.REQUESTED
        if time.monotonic() >= self.deadline:
            return StopReason.SECONDS
        if self.steps >= self.max_steps:
            return StopReason.STEPS
        if self.iterations >= self.max_iterations:
            return StopReason.ITERATIONS

        return None

    def share(self, fraction: float = 1.0, *, iterations: int | None = None) -> Budget:
        """A budget for a part of the work, with the same token.

        Args:
            fraction: Share of the remaining time and of the remaining engine steps.
            iterations: Iterations of the part; None without a limit.

        Returns:
            A budget that begins to count now.
        """
        steps_left = max(self.max_steps - self.steps, 0.0)
        return Budget(
            seconds=fraction * self.seconds_left,
            steps=fraction * steps_left if np.isfinite(steps_left) else None,
            iterations=iterations,
            stop=self.stop,
        )

    def with_stop(self, stop: StopToken) -> Budget:
        """Make a copy that asks another token.

        Args:
            stop: The other token.

        Returns:
            A budget with the same limits, of which as much is used.
        """
        other = copy.copy(self)
        other.stop = stop
        return other

    def __getstate__(self) -> dict[str, Any]:
        """State for another process, which has another stop token and whose monotonic clock may differ."""
        state = dict(self.__dict__)
        state["stop"] = None
        state["moment"] = time.time(), time.monotonic()
        return state

    def __setstate__(self, state: dict[str, Any]) -> None:
        """Restore in another process; `stop` is a new token, which the worker replaces."""
        wall, monotonic = state.pop("moment")
        self.__dict__.update(state)
        shift = (time.monotonic() - monotonic) - (time.time() - wall)
        self.begun += shift
        self.deadline += shift
        self.stop = StopToken()


_active: ContextVar[StopToken | None] = ContextVar("mjfim_stop_token", default=None)


@contextmanager
def stop_on_interrupt(stop: StopToken | None = None) -> Iterator[StopToken]:
    """Turn the first Ctrl-C inside the context into a request to stop; a second one interrupts as usual.

    Nested contexts share the token of the outermost one. Outside the main thread, where Python
    delivers no signals, the token is only yielded.

    Args:
        stop: Token to set; default: that of the surrounding context, or a new one.

    Yields:
        The token that the work has to check.
    """
    outer = _active.get()
    token = stop or outer or StopToken()
    handled = threading.current_thread() is threading.main_thread() and (
        outer is None or token is not outer
    )
    previous = signal.getsignal(signal.SIGINT) if handled else None

    # A process that ignores Ctrl-C, such as a worker, keeps ignoring it.
    handled = handled and callable(previous)

    def request(number: int, frame: FrameType | None) -> None:
        """Set the token; ask the surrounding context as well, and interrupt where the token is set already."""
        if token.requested:
            signal.default_int_handler(number, frame)
        token.request()
        if outer is not None:
            outer.request()

    restore = _active.set(token)
    if handled:
        signal.signal(signal.SIGINT, request)
    try:
        yield token
    finally:
        _active.reset(restore)
        if handled:
            signal.signal(signal.SIGINT, previous)

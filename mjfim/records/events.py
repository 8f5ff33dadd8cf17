"""Events by which long work reports its progress, by calling `callback(event)`."""

from __future__ import annotations

import sys
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from contextvars import ContextVar
from dataclasses import dataclass
from importlib import import_module
from typing import TYPE_CHECKING, TypeVar

if TYPE_CHECKING:
    from mjfim.records.design import HistoryRow


@dataclass(frozen=True, kw_only=True)
class DesignEvent:
    """One iterate of a design.

    Attributes:
        start: Name of the initial control from which the iterate comes.
        row: The iterate.
    """

    start: str
    row: HistoryRow


@dataclass(frozen=True, kw_only=True)
class FitEvent:
    """One iterate of an estimation.

    Attributes:
        phase: Data to which the model is fitted: "all data", or a part of the search for an initial
            guess.
        iteration: Number of the iterate in this phase.
        cost: Half of the sum of squared whitened residuals; in a phase "noise estimated" with the
            loss "linear", minus the logarithm of the likelihood, without a constant.
        step: Length of the last step [standard deviations].
    """

    phase: str
    iteration: int
    cost: float
    step: float


@dataclass(frozen=True, kw_only=True)
class StudyEvent:
    """Progress of a study that consists of several parts.

    Attributes:
        study: Name of the study, such as "compare", "monte_carlo" or "campaign".
        part: Name of the part that is running.
        index: Number of the part, from 0.
        count: Number of parts; None if it is not known beforehand.
        share: Completed share of this part, 0 to 1.
        message: One line about the results so far; may be empty.
        result: Result of a complete part, such as the `Round` of a campaign; None while the part
            is running.
    """

    study: str
    part: str
    index: int
    count: int | None
    share: float
    message: str = ""
    result: object = None


Event = DesignEvent | FitEvent | StudyEvent


Callback = Callable[[Event], None]


DesignCallback = Callable[[DesignEvent], None]


# What is called with the name of the work that begins, its number and the number of all such works;
# or None.
_observer: ContextVar[Callable[[str, int, int], None] | None] = ContextVar(
    "stage_observer", default=None
)


# Module that shows progress in a notebook.
NOTEBOOK_PROGRESS = "mjfim.output.live"


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

"""Errors that misuse causes; each message names the place, the fault and what would be right."""

from __future__ import annotations

import itertools
from collections.abc import Iterable, Sequence
from difflib import get_close_matches

# Longest text of the user that a message repeats as it is, and how much it shows of a longer one
# [characters].
REPEATED_TEXT = 60
SHOWN_TEXT = 40

# Longest list of names in a message [characters].
LISTED_TEXT = 240

# Largest numbers that a user may ask for, in an experiment file or on the command line. Larger ones
# are mistyped: the work would not end, would only use memory, or would mean nothing. They stand
# here, so that the help of the command line states them without importing a room.
MAX_THREADS = 1024

# Repeated work of a design.
MAX_STARTS = 10_000
MAX_ITERATIONS = 1_000_000
MAX_REPLICATES = 100_000
MAX_SAMPLES = 10_000
MAX_ROBOTS = 100_000

# Largest relative error of a guess. Robots beyond it have nothing in common with the model, and
# their numbers overflow in the end.
MAX_WRONG = 10.0


class MjfimError(Exception):
    """Base class of all errors that mjfim raises for misuse; the command line exits with code 2."""


class ExperimentError(MjfimError):
    """The experiment has an unknown key or name, or a value that is not valid."""


class ModelError(MjfimError):
    """MuJoCo cannot load or compile the model, or mjfim cannot use it."""


class ModelWarning(UserWarning):
    """MuJoCo loads the model, but leaves out or changes something that the file states."""


class RecordingWarning(UserWarning):
    """A log is read, but without some of its rows."""


class UndrawnWarning(UserWarning):
    """A fault of the program kept a picture or a page from being drawn; the result stands."""


class RecordingError(MjfimError):
    """A recording, a control table or a design archive cannot be used."""


class NoVideoError(MjfimError):
    """There is no video, for a reason that its message states; the work goes on without it."""


class OutputError(MjfimError):
    """A result cannot be written where the user wants it without the loss of other files."""


class WrongLogError(RecordingError):
    """A log has a gross error, such as a control with the wrong sign; the message has the cure."""


class UnidentifiableError(MjfimError):
    """A trajectory gives no information about a combination of parameters."""


class SimulationDivergedError(MjfimError):
    """A rollout failed: MuJoCo reported a numerical warning, or a state is not finite."""


class NoResultError(MjfimError):
    """The computation was asked to stop before it had a result."""


class InterruptedByUserError(BaseException):
    """The user wants the program to end, which has no result yet.

    Like `KeyboardInterrupt`, this may come at any moment, and is no `Exception`: code that handles
    errors of its own work must not take it for one of them.
    """


class UnfinishedError(BaseException):
    """The user wants the program to end; results that may be left out are not written.

    It is no `Exception`; see `InterruptedByUserError`.
    """


def unknown(kind: str, name: str, valid: Iterable[str]) -> str:
    """Describe the use of a name that does not exist.

    Args:
        kind: Kind of object that was named, such as "actuator".
        name: The unknown name.
        valid: All names that exist.

    Returns:
        A sentence that proposes the most similar name and lists all valid ones.
    """
    names = sorted(str(v) for v in valid)
    near = closest(str(name), names)
    hint = f" (did you mean {near!r}?)" if near else ""
    return f"unknown {kind} {shortened(repr(name))}{hint}; valid: {listed(names)}"


def closest(name: str, valid: Sequence[str]) -> str | None:
    """Find the name that is most similar to a given one.

    Args:
        name: The given name.
        valid: The names among which one is searched.

    Returns:
        The most similar name; None if none is similar.
    """
    # A comparison with a very long name takes minutes, and such a name is no misspelling.
    if len(name) > REPEATED_TEXT:
        return None
    return next(iter(get_close_matches(name, valid, n=1)), None)


def shortened(text: str) -> str:
    """Return a text of the user for a message: its beginning and its length if it is very long.

    Args:
        text: The text.
    """
    if len(text) <= REPEATED_TEXT:
        return text
    return f"{text[:SHOWN_TEXT]} (the beginning of {len(text)} characters)"


def in_words(value: object) -> str:
    """Describe a wrong argument for a message: a short value itself, else its type.

    Args:
        value: The argument.
    """
    is_short = value is None or isinstance(value, (str, int, float))
    return shortened(repr(value)) if is_short else f"an object of type {type(value).__name__}"


def listed(names: Sequence[str]) -> str:
    """List names for a message; of a long list the beginning and the number of the others.

    Args:
        names: The names.

    Returns:
        The names with commas between them; `none` if there are none.
    """
    return first_ones([shortened(name) for name in names])


def first_ones(phrases: Sequence[str], separator: str = ", ", longest: int = LISTED_TEXT) -> str:
    """List phrases for a message; of a long list the beginning and the number of the others.

    Args:
        phrases: The phrases, each of which is shown as it is or not at all.
        separator: Text between two phrases.
        longest: Length from which on phrases are only counted [characters].

    Returns:
        The phrases, at least the first one; `none` if there are none.
    """
    if not phrases:
        return "none"

    lengths = itertools.accumulate(len(phrase) + len(separator) for phrase in phrases)
    count = max(1, sum(length <= longest for length in lengths))
    further = len(phrases) - count
    return separator.join(phrases[:count]) + (f" and {further} more" if further else "")

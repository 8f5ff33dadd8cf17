"""Errors that misuse causes. Each message names the place, the fault and what would be right."""

from __future__ import annotations

import functools
import inspect
from collections.abc import Callable, Iterable, Mapping
from difflib import get_close_matches
from typing import TYPE_CHECKING, Any, ClassVar, ParamSpec, TypeVar

Arguments = ParamSpec("Arguments")
Result = TypeVar("Result")

# Arguments of the public functions that were renamed, each with its new name and what to pass now.
RENAMED_ARGUMENTS = {
    "monitor": ("callback", "which is called with one event"),
    "tell": ("callback", "which is called with one event"),
    "progress": ("callback", "which is called with one event"),
    "report": ("callback", "which is called with one event"),
    "start": ("initial_control", "an (N, nu) array"),
}


class MjfimError(Exception):
    """Base class of every error that mjfim raises for misuse; the command line turns it into exit code 2."""


class ExperimentError(MjfimError):
    """The experiment file, or its Python equivalent, asks for something impossible or unknown."""


class ModelError(MjfimError):
    """MuJoCo does not load or compile the model, or the model lacks what the experiment names."""


class RecordingError(MjfimError):
    """A recording, a control table or a design archive cannot be used."""


class UnidentifiableError(MjfimError):
    """The initial trajectory carries no information about some direction of the parameters."""


class SimulationDivergedError(MjfimError):
    """MuJoCo reported a numerical warning, or a state is not finite, along a rollout that must not fail."""


class NoResultError(MjfimError):
    """The work was asked to stop before there was a result."""


def unknown(kind: str, name: str, valid: Iterable[str]) -> str:
    """Sentence for a name that does not exist.

    Args:
        kind: Kind of thing that was named, e.g. "actuator".
        name: The unknown name.
        valid: All names that exist.

    Returns:
        A sentence that proposes the most similar name and lists all valid ones.
    """
    names = sorted(str(v) for v in valid)

    near = get_close_matches(str(name), names, n=1)
    hint = f" (did you mean {near[0]!r}?)" if near else ""
    listing = ", ".join(names) if names else "none"
    return f"unknown {kind} {name!r}{hint}; valid: {listing}"


def explain_renamed_arguments(function: Callable[Arguments, Result]) -> Callable[Arguments, Result]:
    """Decorate a public function so that an argument under its old name is an error that names the new one.

    Args:
        function: The function.

    Returns:
        The function with the check.
    """
    known = inspect.signature(function).parameters

    @functools.wraps(function)
    def checked(*args: Arguments.args, **kwargs: Arguments.kwargs) -> Result:
        for old, (new, meaning) in RENAMED_ARGUMENTS.items():
            if old in kwargs and old not in known and new in known:
                raise TypeError(
                    f"{function.__name__}() has no argument {old!r} any more: use {new!r}, "
                    f"{meaning}"
                )
        return function(*args, **kwargs)

    return checked


class RenamedFields:
    """Base of records whose fields were renamed: an old name is an error that names the new one.

    Attributes:
        renamed_fields: Names of fields in earlier versions, each with its new name.
    """

    renamed_fields: ClassVar[Mapping[str, str]] = {}

    # A type checker must not take this for a promise that every attribute exists.
    if not TYPE_CHECKING:

        def __getattr__(self, name: str) -> Any:
            """Raise AttributeError; called only where there is no attribute of this name."""
            record = type(self).__name__
            if name in type(self).renamed_fields:
                new = type(self).renamed_fields[name]
                raise AttributeError(f"{record}.{name} is called {record}.{new} now")

            raise AttributeError(f"{record!r} object has no attribute {name!r}")

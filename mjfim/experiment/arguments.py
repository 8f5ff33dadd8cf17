"""Arguments of public functions, which are compared with their annotations at each call."""

from __future__ import annotations

import inspect
import re
from collections.abc import Callable, Mapping, Sequence
from functools import cache, wraps
from numbers import Integral, Real
from pathlib import Path
from types import NoneType, UnionType
from typing import Any, Literal, ParamSpec, TypeVar, Union, get_args, get_origin, get_type_hints

import numpy as np

from mjfim.errors import ExperimentError, OutputError, in_words

P = ParamSpec("P")
R = TypeVar("R")

# Kinds whose names in Python say less than words.
WORDS: dict[Any, str] = {
    int: "whole number from 0",
    float: "number",
    np.ndarray: "array of numbers",
    NoneType: "None",
}

# Modules in the text of an annotation.
MODULES = re.compile(r"[\w.]+\.(?=\w)")


def checked(function: Callable[P, R]) -> Callable[P, R]:
    """Let a function refuse arguments whose kind its annotations do not allow.

    A number is no NaN, and a whole number is 0 or larger, because it counts or seeds. Lists serve
    where tuples do, and numbers and arrays of NumPy where numbers and lists do.

    Raises:
        ExperimentError: The message names the function, the argument, and what would be right.
        OutputError: A file of the user cannot be opened.
    """
    signature = inspect.signature(function)
    variable = (inspect.Parameter.VAR_KEYWORD, inspect.Parameter.VAR_POSITIONAL)
    hints = cache(lambda: get_type_hints(function))

    @wraps(function)
    def call(*args: P.args, **kwargs: P.kwargs) -> R:
        """Check the arguments, and call the function."""
        try:
            given = signature.bind(*args, **kwargs).arguments
        except TypeError as error:
            raise ExperimentError(f"{function.__qualname__}: {error}") from None
        for name, value in given.items():
            hint = hints().get(name, Any)
            if signature.parameters[name].kind not in variable and not _fits(value, hint):
                raise ExperimentError(
                    f"{function.__qualname__}: {name}: needs {_kind(hint)}; not {in_words(value)}"
                )
        try:
            return function(*args, **kwargs)
        except OSError as error:
            place = error.filename or function.__name__
            raise OutputError(f"{place}: {error.strerror or error}") from None

    return call


def _kind(hint: Any) -> str:
    """The kinds of values that an annotation allows, in words."""
    kind, parts = get_origin(hint) or hint, get_args(hint)
    if kind in (Union, UnionType):
        return " | ".join(map(_kind, parts))
    if kind is Literal:
        return " | ".join(map(repr, parts))
    return WORDS.get(kind) or MODULES.sub("", inspect.formatannotation(hint))


def is_numeric(value: Any) -> bool:
    """Whether a value is an array of numbers, or lists of numbers."""
    if not isinstance(value, (list, tuple, np.ndarray)):
        return False
    try:
        return np.asarray(value).dtype.kind in "fiub"
    except ValueError:
        return False


def _is_number(value: Any) -> bool:
    """Whether a value is a number and no truth value; NaN is none."""
    return not isinstance(value, bool) and isinstance(value, Real) and bool(value == value)


# Further tests of values of a type.
TESTS: dict[Any, Callable[[Any], bool]] = {
    Any: lambda _: True,
    int: lambda value: isinstance(value, Integral) and _is_number(value) and int(value) >= 0,
    float: _is_number,
    str: lambda value: isinstance(value, str) and "\0" not in value,
    Path: lambda value: isinstance(value, Path) and "\0" not in str(value),
    Callable: callable,
    np.ndarray: lambda value: is_numeric(value) and np.isfinite(np.asarray(value)).all(),
}


def _fits(value: Any, hint: Any) -> bool:
    """Whether a value is of the kind of an annotation."""
    kind, parts = get_origin(hint) or hint, get_args(hint)
    if kind in TESTS:
        return TESTS[kind](value)
    if kind in (Union, UnionType):
        return any(_fits(value, part) for part in parts)
    if kind is Literal:
        return isinstance(value, str) and value in parts
    if kind is tuple and Ellipsis not in parts:
        is_whole = isinstance(value, (list, tuple)) and len(value) == len(parts)
        return is_whole and all(map(_fits, value, parts))
    if kind in (Sequence, tuple):
        return isinstance(value, (list, tuple)) and all(_fits(each, parts[0]) for each in value)
    if kind is Mapping:
        is_table = isinstance(value, Mapping)
        return is_table and all(_fits(k, parts[0]) and _fits(v, parts[1]) for k, v in value.items())
    return isinstance(value, kind)

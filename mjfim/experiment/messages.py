"""Validation errors of pydantic as one line per fault: file, key, what is wrong and what would be right."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from mjfim.errors import unknown

# Endings of pydantic's names for faults that say that a value has the wrong type or is none of the
# stated words.
WRONG_TYPE = ("_type", "literal_error")


def explain(
    error: ValidationError, source: str, table: type[BaseModel], hidden: Sequence[str] = ()
) -> str:
    """Explain every fault of an experiment by the keys that the user wrote.

    Args:
        error: Faults that pydantic found.
        source: Name of the file, first on every line.
        table: The model that was validated.
        hidden: Keys that are never suggested, because a file cannot state them.

    Returns:
        One line per fault.
    """
    faults_by_key: dict[str, list[Any]] = {}

    for fault in error.errors(include_url=False):
        keys, _ = _walk(table, fault["loc"])
        faults_by_key.setdefault(".".join(keys), []).append(fault)

    # A fault inside a table is repeated for the table itself; the innermost one is the most
    # specific.
    innermost = [
        key
        for key in faults_by_key
        if not any(other.startswith(f"{key}.") for other in faults_by_key)
    ]

    return "\n".join(
        f"{source}: {key or 'experiment'}: {_sentence(faults_by_key[key], table, hidden)}"
        for key in innermost
    )


def valid_keys(table: Any, hidden: Sequence[str] = ()) -> list[str]:
    """Keys that a table of the experiment file may have, in the order of their definition."""
    if not (isinstance(table, type) and issubclass(table, BaseModel)):
        return []

    return [
        key for key, field in table.model_fields.items() if not field.exclude and key not in hidden
    ]


def _sentence(faults: list[Any], table: type[BaseModel], hidden: Sequence[str]) -> str:
    """Say what is wrong with one key, for which every branch of a union has reported a fault."""
    # A branch whose type fits but whose value does not is the one that the user meant.
    fault = next((f for f in faults if not f["type"].endswith(WRONG_TYPE)), faults[0])

    if fault["type"] == "extra_forbidden":
        keys, _ = _walk(table, fault["loc"])
        _, parent = _walk(table, fault["loc"][:-1])

        # A key of an earlier version is answered with its present name.
        present = getattr(parent, "renamed_keys", {}).get(keys[-1])
        if present is not None:
            return f"this key is called {present!r} now"

        return unknown("key", keys[-1], valid_keys(parent, hidden))

    if fault["type"] == "missing":
        return "this key is required"

    # Where no branch has the right type, all of them are offered; else only the faults of the
    # chosen kind.
    only_types = fault["type"].endswith(WRONG_TYPE)
    shown_faults = [f for f in faults if only_types or f["type"] == fault["type"]]
    first, *others = dict.fromkeys(_message(f) for f in shown_faults)
    alternatives = [first, *(message.removeprefix("should be ") for message in others)]

    given = fault.get("input")
    shown = f" (got {given!r})" if isinstance(given, (str, int, float, bool)) else ""

    return " or ".join(alternatives) + shown


def _message(fault: Mapping[str, Any]) -> str:
    """The sentence of pydantic about one fault, in the words of the experiment file."""
    kind = fault["type"]

    if kind in ("dict_type", "model_type"):
        return "should be a table"
    if kind == "tuple_type":
        return "should be a list"
    if kind in ("bool_type", "bool_parsing"):
        return "should be true or false"
    if kind == "too_short":
        return f"needs {fault['ctx']['min_length']} or more entries"

    message: str = fault["msg"]
    return (
        message.removeprefix("Value error, ")
        .replace("Input should be a valid ", "should be a ")
        .replace("Input should", "should")
    )


def _walk(table: type[BaseModel], location: Sequence[str | int]) -> tuple[list[str], Any]:
    """Follow a location of pydantic through the types.

    pydantic names the branch of a union inside a location, which the user never wrote: these parts
    are left out.

    Returns:
        The user's keys, and the type at the end of the location.
    """
    keys: list[str] = []
    at: Any = table

    for part in location:
        branches = _branches(at)
        if len(branches) > 1:
            at = _chosen(branches, str(part))
            continue

        keys.append(str(part))
        at = _member(branches[0], part)

    branches = _branches(at)
    return keys, branches[0] if len(branches) == 1 else at


def _branches(annotation: Any) -> list[Any]:
    """Alternatives of a type, None left out; the type itself where it is no union."""
    if get_origin(annotation) is Annotated:
        return _branches(get_args(annotation)[0])
    if get_origin(annotation) not in (Union, UnionType):
        return [annotation]

    return [
        branch
        for part in get_args(annotation)
        if part is not type(None)
        for branch in _branches(part)
    ]


def _chosen(branches: list[Any], tag: str) -> Any:
    """Find the branch of a union by the name that pydantic gives it; None where there is none.

    pydantic writes `Table` for a table, `function-after[_check(), Table]` for a table with a
    validator, and `dict[...]` or `tuple[...]` for a container.
    """
    for branch in branches:
        container = get_origin(branch) or branch
        name = getattr(container, "__name__", "")

        if tag == name or tag.startswith(f"{name}[") or tag.endswith(f", {name}]"):
            return branch

    return None


def _member(annotation: Any, key: str | int) -> Any:
    """The type behind a key of a table, a name of a dictionary or an index of a tuple; None where there is none."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        field = annotation.model_fields.get(str(key))
        return None if field is None else field.annotation

    members = get_args(annotation)
    if get_origin(annotation) is dict:
        return members[1]
    if get_origin(annotation) is tuple and isinstance(key, int):
        return (
            members[0] if members[-1] is Ellipsis else members[key] if key < len(members) else None
        )

    return None

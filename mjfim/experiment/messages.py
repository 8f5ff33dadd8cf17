"""Validation errors of pydantic in the words of the experiment file.

Each fault becomes one line with the file, the key, what is wrong and what would be right.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from types import UnionType
from typing import Annotated, Any, Union, get_args, get_origin

from pydantic import BaseModel, ValidationError

from mjfim.errors import shortened, unknown

# pydantic's names of faults end so if a value has the wrong type or is none of the allowed words.
WRONG_TYPE = ("_type", "literal_error")

# Length of a message after which further faults are only counted [characters].
LONG_MESSAGE = 400


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
        One line per fault; of many faults the first ones and the number of the others.
    """
    faults_by_key: dict[str, list[Any]] = {}

    for fault in error.errors(include_url=False):
        keys, _ = _walk(table, fault["loc"])
        faults_by_key.setdefault(".".join(keys), []).append(fault)

    # pydantic repeats a fault inside a table for the table itself. Only the innermost key, which
    # is the most specific one, is reported.
    outer = {key[:i] for key in faults_by_key for i, letter in enumerate(key) if letter == "."}
    innermost = [key for key in faults_by_key if key not in outer]

    lines: list[str] = []
    for key in innermost:
        length = sum(len(line) for line in lines)
        if lines and length > LONG_MESSAGE:
            lines.append(f"{source}: and {len(innermost) - len(lines)} further faults")
            break

        place = shortened(key) if key else "experiment"
        lines.append(f"{source}: {place}: {_sentence(faults_by_key[key], table, hidden)}")
    return "\n".join(lines)


def valid_keys(table: Any, hidden: Sequence[str] = ()) -> list[str]:
    """Keys that a table of the experiment file may have, in the order of their definition."""
    if not (isinstance(table, type) and issubclass(table, BaseModel)):
        return []

    return [
        key for key, field in table.model_fields.items() if not field.exclude and key not in hidden
    ]


def _sentence(faults: list[Any], table: type[BaseModel], hidden: Sequence[str]) -> str:
    """Say what is wrong with one key.

    faults: the faults that the branches of a union have reported for this key.
    """
    # The user meant a branch whose type fits, even if the value is not valid there.
    fault = next((f for f in faults if not f["type"].endswith(WRONG_TYPE)), faults[0])

    if fault["type"] == "extra_forbidden":
        keys, _ = _walk(table, fault["loc"])
        _, parent = _walk(table, fault["loc"][:-1])
        return unknown("key", keys[-1], valid_keys(parent, hidden))

    if fault["type"] == "missing":
        return "this key is required" + _meaning_of(table, fault["loc"])

    # If the value has the right type for no branch, all branches are suggested; otherwise only
    # faults of the chosen kind are shown.
    only_types = fault["type"].endswith(WRONG_TYPE)
    shown_faults = [f for f in faults if only_types or f["type"] == fault["type"]]
    first, *others = dict.fromkeys(_message(f, table) for f in shown_faults)
    alternatives = [first, *(message.removeprefix("should be ") for message in others)]

    given = fault.get("input")
    shown = f" (got {shortened(repr(given))})" if isinstance(given, (str, int, float, bool)) else ""

    return " or ".join(alternatives) + shown


def _message(fault: Mapping[str, Any], table: type[BaseModel]) -> str:
    """Message of pydantic about one fault, in the words of the experiment file.

    table: the model that was validated.
    """
    kind = fault["type"]

    if kind in ("dict_type", "model_type"):
        return "should be a table" + _example_of(table, fault["loc"])
    if kind == "tuple_type":
        return "should be a list"
    if kind in ("bool_type", "bool_parsing"):
        return "should be true or false"
    if kind == "too_short":
        return f"needs {fault['ctx']['min_length']} or more entries"

    message: str = fault["msg"]
    return (
        message.removeprefix("Value error, ")
        .replace("Input should be a valid integer", "should be an integer")
        .replace("Input should be a valid ", "should be a ")
        .replace("Input should", "should")
    )


def _example_of(table: type[BaseModel], location: Sequence[str | int]) -> str:
    """Example of a key's value that ends a message; empty where its table has none."""
    _, parent = _walk(table, location[:-1])
    fields = getattr(parent, "model_fields", {})
    field = fields.get(str(location[-1]))
    if field is None or not field.examples:
        return ""

    entries = [f"{name} = {value}" for name, value in field.examples[0].items()]
    return f" by name, for example {{ {', '.join(entries)} }}"


def _meaning_of(table: type[BaseModel], location: Sequence[str | int]) -> str:
    """First sentence about a key, which ends a message; empty where its table has none."""
    _, parent = _walk(table, location[:-1])
    field = getattr(parent, "model_fields", {}).get(str(location[-1]))
    if field is None or not field.description:
        return ""

    sentence = field.description.split(". ")[0].removesuffix(".")
    return f": {sentence[0].lower()}{sentence[1:]}"


def _walk(table: type[BaseModel], location: Sequence[str | int]) -> tuple[list[str], Any]:
    """Follow a location of pydantic through the types of the tables.

    A location of pydantic also holds the names of the branches of unions. These parts are left
    out, because the user did not write them.

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
    """Alternatives of a union without None; a list of the type itself if it is not a union."""
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
    """Find the branch of a union by the name that pydantic gives it; None if there is none.

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
    """Type of one entry of a table, dictionary or tuple, by its key or index; None if unknown."""
    if isinstance(annotation, type) and issubclass(annotation, BaseModel):
        field = annotation.model_fields.get(str(key))
        return None if field is None else field.annotation

    members = get_args(annotation)
    if get_origin(annotation) is dict:
        return members[1]
    if get_origin(annotation) is tuple and isinstance(key, int):
        if members[-1] is Ellipsis:
            return members[0]
        if key < len(members):
            return members[key]

    return None

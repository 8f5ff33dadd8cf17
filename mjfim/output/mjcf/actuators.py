"""Attributes of MJCF's actuator elements.

Each attribute sets some of the numbers of an actuator's gain, bias and dynamics.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ModelError
from mjfim.output.mjcf.document import nearly_equal

# Arrays that determine an actuator's force; `actuator_<name>` in MjModel.
ARRAYS = ("gainprm", "biasprm", "dynprm")

# Array, column and factor of a number that an attribute sets: array[column] = factor * value.
Entry = tuple[str, int, float]

# Entries that the gains and the time constant of the servo elements set.
KP: tuple[Entry, ...] = (("gainprm", 0, 1.0), ("biasprm", 1, -1.0))
KV: tuple[Entry, ...] = (("biasprm", 2, -1.0),)
TIME_CONSTANT: tuple[Entry, ...] = (("dynprm", 0, 1.0),)


def _muscle(column: int) -> tuple[Entry, ...]:
    """Return the entries that a muscle parameter sets: in the active and in the passive force."""
    return (("gainprm", column, 1.0), ("biasprm", column, 1.0))


# By element and attribute, for each number of the attribute, the entries that it sets. `general`
# sets the arrays directly.
SHORTCUTS: dict[str, dict[str, tuple[tuple[Entry, ...], ...]]] = {
    "position": {"kp": (KP,), "kv": (KV,), "timeconst": (TIME_CONSTANT,)},
    "intvelocity": {"kp": (KP,), "kv": (KV,)},
    "velocity": {"kv": ((("gainprm", 0, 1.0), ("biasprm", 2, -1.0)),)},
    "pid": {"ki": ((("gainprm", 0, 1.0),),), "kp": ((("biasprm", 1, -1.0),),), "kv": (KV,)},
    "damper": {"kv": ((("gainprm", 2, -1.0),),)},
    "cylinder": {
        "timeconst": (TIME_CONSTANT,),
        "area": ((("gainprm", 0, 1.0),),),
        "bias": tuple((("biasprm", i, 1.0),) for i in range(3)),
    },
    "dcmotor": {
        "resistance": ((("gainprm", 0, 1.0),),),
        "motorconst": ((("gainprm", 1, 1.0),),),
        "cogging": tuple((("biasprm", i, 1.0),) for i in range(3)),
        "lugre": (
            *((("dynprm", i, 1.0),) for i in (5, 6)),
            *((("biasprm", i, 1.0),) for i in (3, 4, 5)),
        ),
    },
    "adhesion": {"gain": ((("gainprm", 0, 1.0),),)},
    "muscle": {
        "timeconst": tuple((("dynprm", i, 1.0),) for i in range(2)),
        "tausmooth": ((("dynprm", 2, 1.0),),),
        "range": (_muscle(0), _muscle(1)),
        **{
            n: (_muscle(i),)
            for i, n in enumerate(("force", "scale", "lmin", "lmax", "vmax", "fpmax", "fvmax"), 2)
        },
    },
}


@dataclass(frozen=True, kw_only=True, eq=False)
class AttributeChange:
    """Change of the numbers of one attribute.

    Attributes:
        attribute: Name of the attribute.
        old: (n,) numbers of the compiled text.
        new: (n,) wanted numbers.
        min_count: Fewest numbers that MuJoCo accepts for this attribute.
    """

    attribute: str
    old: Array
    new: Array
    min_count: int = 1


def attribute_changes(element: str, old: Any, wanted: Any, actuator: int) -> list[AttributeChange]:
    """Express how an actuator differs between two models by attributes of its element.

    Args:
        element: Name of the MJCF element, such as `position`.
        old: Model that the text compiles to.
        wanted: Model that the changed text has to compile to.
        actuator: Index of the actuator.

    Returns:
        Changes of the attributes that differ.

    Raises:
        ModelError: No attribute of the element sets one of the numbers alone. The message is a
            clause.
    """
    before = {name: np.array(getattr(old, f"actuator_{name}")[actuator]) for name in ARRAYS}
    after = {name: np.array(getattr(wanted, f"actuator_{name}")[actuator]) for name in ARRAYS}

    # A motor becomes a <general>, whose attributes are the arrays.
    if element in ("general", "motor"):
        return [
            AttributeChange(attribute=name, old=before[name], new=after[name]) for name in ARRAYS
        ]

    changed = {
        (name, int(column))
        for name in ARRAYS
        for column in np.flatnonzero(~nearly_equal(before[name], after[name]))
    }

    changes = []
    for attribute, numbers in SHORTCUTS.get(element, {}).items():
        entries = {(name, column) for number in numbers for name, column, _ in number}
        if not entries & changed or not _is_consistent(numbers, after):
            continue

        changed -= entries
        old_values, new_values = _values(numbers, before), _values(numbers, after)
        changes.append(
            AttributeChange(
                attribute=attribute, old=old_values, new=new_values, min_count=len(numbers)
            )
        )

    if changed:
        name, column = min(changed)
        raise ModelError(f"<{element}> has no attribute that sets {name}[{column}] alone")
    return changes


def _is_consistent(numbers: tuple[tuple[Entry, ...], ...], arrays: Mapping[str, Array]) -> bool:
    """Return whether all entries that one number sets agree on its value."""
    for number in numbers:
        values = {factor * arrays[name][column] for name, column, factor in number}
        if len(values) > 1:
            return False
    return True


def _values(numbers: tuple[tuple[Entry, ...], ...], arrays: Mapping[str, Array]) -> Array:
    """Return the (n,) numbers of an attribute, each read from its first entry."""
    values = []
    for number in numbers:
        name, column, factor = number[0]
        values.append(factor * arrays[name][column])
    return np.array(values)

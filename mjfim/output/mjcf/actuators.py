"""MJCF's actuator elements: which attribute says which numbers of an actuator's gain, bias and dynamics."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ModelError
from mjfim.output.mjcf.document import close

ARRAYS = ("gainprm", "biasprm", "dynprm")
Place = tuple[str, int, float]  # array, column, factor
KP: tuple[Place, ...] = (("gainprm", 0, 1.0), ("biasprm", 1, -1.0))
KV: tuple[Place, ...] = (("biasprm", 2, -1.0),)
LAG: tuple[Place, ...] = (("dynprm", 0, 1.0),)


def _muscle(column: int) -> tuple[Place, ...]:
    return (
        ("gainprm", column, 1.0),
        ("biasprm", column, 1.0),
    )  # the passive force has its own copy


# Element -> attribute -> for each number of it, the places that it fills. `general` says everything itself.
SHORTCUTS: dict[str, dict[str, tuple[tuple[Place, ...], ...]]] = {
    "position": {"kp": (KP,), "kv": (KV,), "timeconst": (LAG,)},
    "intvelocity": {"kp": (KP,), "kv": (KV,)},
    "velocity": {"kv": ((("gainprm", 0, 1.0), ("biasprm", 2, -1.0)),)},
    "pid": {"ki": ((("gainprm", 0, 1.0),),), "kp": ((("biasprm", 1, -1.0),),), "kv": (KV,)},
    "damper": {"kv": ((("gainprm", 2, -1.0),),)},
    "cylinder": {
        "timeconst": (LAG,),
        "area": ((("gainprm", 0, 1.0),),),
        "bias": tuple((("biasprm", i, 1.0),) for i in range(3)),
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


@dataclass(frozen=True, eq=False)
class Wording:
    """An attribute and its numbers: as they are and as they shall be. whole: how many must stand."""

    attribute: str
    old: Array
    new: Array
    whole: int = 1


def wordings(element: str, old: Any, wanted: Any, actuator: int) -> list[Wording]:
    """Attributes of an actuator element that differ between two models. Raises ModelError where it cannot say the change."""
    before = {a: np.array(getattr(old, f"actuator_{a}")[actuator]) for a in ARRAYS}
    after = {a: np.array(getattr(wanted, f"actuator_{a}")[actuator]) for a in ARRAYS}
    if element in ("general", "motor"):
        return [Wording(a, before[a], after[a]) for a in ARRAYS]
    changed = {(a, int(i)) for a in ARRAYS for i in np.flatnonzero(~close(before[a], after[a]))}
    found = []
    for attribute, numbers in SHORTCUTS.get(element, {}).items():
        places = {(array, column) for number in numbers for array, column, _ in number}
        if not places & changed:
            continue
        if any(
            len({factor * after[array][column] for array, column, factor in number}) > 1
            for number in numbers
        ):
            continue
        changed -= places
        first = [number[0] for number in numbers]
        old, new = (
            np.array([factor * m[array][i] for array, i, factor in first]) for m in (before, after)
        )
        found.append(Wording(attribute, old, new, len(first)))
    if changed:
        array, column = sorted(changed)[0]
        raise ModelError(f"<{element}> has no attribute that says {array}[{column}] alone")
    return found

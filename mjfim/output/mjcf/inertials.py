"""A body's `<inertial>` rewritten: by the numbers that it has, by its matrix, or as a new element beside its geoms."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from mjfim.arrays import Array
from mjfim.model.inertia import INERTIA_COLUMNS, INERTIA_ROWS
from mjfim.model.targets import inertial
from mjfim.output.mjcf.document import ORIENTATIONS, Sheet, close, digits

SLIGHT = 1e-13  # of a body's size or trace of inertia: what is below is rounding of the charts
DIGITS = 15  # significant decimal digits of a matrix that was rotated, counted from its trace; the next one is rounding
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def weigh(sheet: Sheet, name: str, old: Any, wanted: Any, charted: bool) -> None:
    """Give a named body the inertia that it has in the wanted model. old: what the text compiles to.

    charted: its matrix is varied as a whole, so that its principal axes may turn
    """
    b = int(old.body(name).id)
    before, after = inertial(old, b), inertial(wanted, b)
    trace, radius = (
        10.0 * float(np.trace(before.inertia)),
        10.0 * before.radius if before.mass > 0.0 else 0.0,
    )
    turned = not close(before.inertia, after.inertia, trace).all()
    moved = not close(before.com, after.com, radius).all()
    if not turned and not moved and close(np.array(before.mass), np.array(after.mass)):
        return
    body = sheet.place("body", name)
    own = next(
        (i for i, tag in enumerate(sheet.tags) if tag.name == "inertial" and tag.parent == body),
        None,
    )
    if own is None:
        matrix = (
            _matrix(after.inertia) if charted and not _watched(old, b) else _principal(wanted, b)
        )
        sheet.insert(
            body, "inertial", {"pos": digits(*after.com), "mass": digits(after.mass), **matrix}
        )
        return
    sheet.numbers(own, "mass", before.mass, after.mass)
    sheet.numbers(own, "pos", before.com, after.com, 3, radius)
    if turned:
        _turn(sheet, own, b, old, wanted, charted)


def _turn(sheet: Sheet, own: int, b: int, old: Any, wanted: Any, charted: bool) -> None:
    """Write the matrix of an `<inertial>`: in the axes that it has where it is diagonal there."""
    R = Rotation.from_quat(old.body_iquat[b], scalar_first=True).as_matrix()
    before, after = inertial(old, b).inertia, inertial(wanted, b).inertia
    inside, size = R.T @ after @ R, 10.0 * float(np.trace(before))
    products = np.abs(inside[INERTIA_ROWS[3:], INERTIA_COLUMNS[3:]]).max()
    full = sheet.attribute(own, "fullinertia") is not None
    if (charted and _watched(old, b)) or (full and not charted):
        words = _principal(wanted, b)
        if any(sheet.attribute(own, turned) is not None for turned in ORIENTATIONS):
            words["quat"] = digits(*wanted.body_iquat[b])
        for attribute, value in words.items():
            sheet.say(own, attribute, value)
    elif not charted:
        sheet.numbers(own, "diaginertia", old.body_inertia[b], wanted.body_inertia[b], 3)
    elif not full and products <= SLIGHT * np.trace(after):
        sheet.numbers(own, "diaginertia", old.body_inertia[b], np.diag(inside), 3, size)
    else:
        sheet.numbers(
            own, "fullinertia", before[INERTIA_ROWS, INERTIA_COLUMNS], _rounded(after), 6, size
        )


def _matrix(inertia: Array) -> dict[str, str]:
    return {"fullinertia": digits(*_rounded(inertia))}


def _rounded(inertia: Array) -> Array:
    """(6,) entries of `fullinertia` without the rounding errors of the rotation out of the principal axes.

    These errors are about 1e-16 of the trace and depend on the processor's linear algebra kernel, so that 0.013 would be
    written as 0.01299999999999999 on some machines.
    """
    entries = inertia[INERTIA_ROWS, INERTIA_COLUMNS]
    trace = float(np.trace(inertia))
    if trace <= 0.0:  # a body without inertia has nothing to round
        return np.asarray(entries)

    decimals = DIGITS - 1 - int(np.floor(np.log10(trace)))
    return np.array([round(float(entry), decimals) for entry in entries])


def _principal(model: Any, b: int) -> dict[str, str]:
    """Moments and axes as they are in a model."""
    quat = (
        {}
        if close(model.body_iquat[b], IDENTITY, 1.0).all()
        else {"quat": digits(*model.body_iquat[b])}
    )
    return {**quat, "diaginertia": digits(*model.body_inertia[b])}


def _watched(model: Any, b: int) -> bool:
    """True where a sensor reads the axes of the body's inertia, so that they must be those of the model, not only the matrix."""
    body = int(mujoco.mjtObj.mjOBJ_BODY)
    of = (model.sensor_objtype == body) & (model.sensor_objid == b)
    to = (model.sensor_reftype == body) & (model.sensor_refid == b)
    return bool((of | to).any())

"""Changes of a body's `<inertial>` element.

Single numbers or the whole matrix are changed. A body whose mass came from its geoms gets a new
element.
"""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.model.inertia import INERTIA_COLUMNS, INERTIA_ROWS, body_inertia
from mjfim.output.mjcf.document import (
    ORIENTATIONS,
    MjcfDocument,
    all_digits,
    nearly_equal,
)

# Products of inertia below this share of the trace are rounding errors of the parametrisation.
PRODUCT_TOLERANCE = 1e-13

# Significant decimal digits of a matrix that was rotated, counted from its trace; the next digit is
# rounding.
DIGITS = 15

# Changes of inertia and centre of mass are rounding relative to this multiple of the trace and of
# the body's radius.
MAGNITUDE_FACTOR = 10.0

# Quaternion of the body's axes.
IDENTITY = np.array([1.0, 0.0, 0.0, 0.0])


def write_inertial(
    document: MjcfDocument, name: str, old: Any, wanted: Any, *, as_matrix: bool
) -> None:
    """Give a body the inertia that it has in the wanted model.

    Args:
        document: The text.
        name: Name of the body.
        old: Model that the text compiles to.
        wanted: Model that the edited text has to compile to.
        as_matrix: Whether the parameters vary the matrix as a whole, so that its principal axes may
            turn.

    Raises:
        ModelError: The body is not in the text.
    """
    body = int(old.body(name).id)
    before, after = body_inertia(old, body), body_inertia(wanted, body)
    trace = MAGNITUDE_FACTOR * float(np.trace(before.inertia))
    radius = MAGNITUDE_FACTOR * before.gyration_radius if before.mass > 0.0 else 0.0

    same_inertia = nearly_equal(before.inertia, after.inertia, trace).all()
    same_com = nearly_equal(before.com, after.com, radius).all()
    if same_inertia and same_com and nearly_equal(np.array(before.mass), np.array(after.mass)):
        return

    parent = document.element("body", name)
    tag = _child(document, parent, "inertial")

    # A body whose inertia came from its geoms gets an element that replaces them.
    if tag is None:
        free_axes = as_matrix and not _axes_are_measured(old, body)
        inertia = _full_inertia(after.inertia) if free_axes else _principal_inertia(wanted, body)
        attributes = {"pos": all_digits(*after.com), "mass": all_digits(after.mass), **inertia}
        document.insert_child(parent, "inertial", attributes)
        return

    document.set_numbers(tag, "mass", before.mass, after.mass)
    document.set_numbers(tag, "pos", before.com, after.com, min_count=3, magnitude=radius)
    if not same_inertia:
        _write_inertia(document, tag, old, wanted, body=body, as_matrix=as_matrix)


def _child(document: MjcfDocument, parent: int, name: str) -> int | None:
    """Return the tag of the first child of a name, None if there is none."""
    return next(
        (i for i, tag in enumerate(document.tags) if tag.name == name and tag.parent == parent),
        None,
    )


def _write_inertia(
    document: MjcfDocument, tag: int, old: Any, wanted: Any, *, body: int, as_matrix: bool
) -> None:
    """Write the inertia matrix of an `<inertial>`, in its present form if that can express it."""
    before, after = body_inertia(old, body).inertia, body_inertia(wanted, body).inertia
    magnitude = MAGNITUDE_FACTOR * float(np.trace(before))
    is_full = document.attribute(tag, "fullinertia") is not None

    # The model's principal axes are written where they matter, or where only the moments are
    # parameters.
    if (as_matrix and _axes_are_measured(old, body)) or (is_full and not as_matrix):
        _write_principal(document, tag, wanted, body)
        return
    if not as_matrix:
        moments = old.body_inertia[body], wanted.body_inertia[body]
        document.set_numbers(tag, "diaginertia", *moments, min_count=3)
        return

    # A matrix that is still diagonal in the present axes keeps them.
    R = scipy.spatial.transform.Rotation.from_quat(
        old.body_iquat[body], scalar_first=True
    ).as_matrix()
    in_old_axes = R.T @ after @ R
    products = np.abs(in_old_axes[INERTIA_ROWS[3:], INERTIA_COLUMNS[3:]]).max()

    if not is_full and products <= PRODUCT_TOLERANCE * np.trace(after):
        attribute, numbers = "diaginertia", (old.body_inertia[body], np.diag(in_old_axes))
    else:
        entries = before[INERTIA_ROWS, INERTIA_COLUMNS]
        attribute, numbers = "fullinertia", (entries, rounded_entries(after))
    document.set_numbers(tag, attribute, *numbers, min_count=len(numbers[0]), magnitude=magnitude)


def _write_principal(document: MjcfDocument, tag: int, wanted: Any, body: int) -> None:
    """Write the principal moments and axes of the wanted model."""
    attributes = _principal_inertia(wanted, body)

    # An orientation that the text states is replaced even where the new one is the default.
    if any(document.attribute(tag, name) is not None for name in ORIENTATIONS):
        attributes["quat"] = all_digits(*wanted.body_iquat[body])

    for attribute, value in attributes.items():
        document.set_exclusively(tag, attribute, value)


def _full_inertia(inertia: Array) -> dict[str, str]:
    """Return the attributes that state a (3, 3) matrix in the axes of the body."""
    return {"fullinertia": all_digits(*rounded_entries(inertia))}


def _principal_inertia(model: Any, body: int) -> dict[str, str]:
    """Return the attributes that state the principal moments and axes of a body."""
    quat = model.body_iquat[body]
    moments = {"diaginertia": all_digits(*model.body_inertia[body])}
    if nearly_equal(quat, IDENTITY, 1.0).all():
        return moments
    return {"quat": all_digits(*quat), **moments}


def rounded_entries(inertia: Array) -> Array:
    """Return the entries of an inertia matrix without the rounding errors of a rotation.

    The matrix was rotated out of its principal axes.

    These errors are about 1e-16 of the trace and depend on the processor's linear algebra kernel,
    so that 0.013 would be written as 0.01299999999999999 on some machines.

    Args:
        inertia: (3, 3) matrix [kg m²].

    Returns:
        (6,) entries xx yy zz xy xz yz.
    """
    entries = inertia[INERTIA_ROWS, INERTIA_COLUMNS]
    trace = float(np.trace(inertia))

    # A body without inertia has nothing to round.
    if trace <= 0.0:
        return np.asarray(entries)

    decimals = DIGITS - 1 - int(np.floor(np.log10(trace)))
    return np.array([round(float(entry), decimals) for entry in entries])


def _axes_are_measured(model: Any, body: int) -> bool:
    """Return whether a sensor reads a body's principal axes, which matter then."""
    kind = int(mujoco.mjtObj.mjOBJ_BODY)
    is_object = (model.sensor_objtype == kind) & (model.sensor_objid == body)
    is_reference = (model.sensor_reftype == kind) & (model.sensor_refid == body)
    return bool((is_object | is_reference).any())

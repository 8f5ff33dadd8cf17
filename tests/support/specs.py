"""Parameter values written into an MjSpec, with which models written in place are compared."""

from __future__ import annotations

from typing import Any

import mujoco
import numpy as np

from mjfim.errors import ExperimentError
from mjfim.model.parameters import ParameterSet
from mjfim.model.paths import INERTIAL_FIELDS, SERVO_FIELDS, ParameterPath, resolve
from tests.support.numerics import Array


def write_spec(
    spec: Any, compiled: Any, wanted: Any, parameters: ParameterSet, theta: Array
) -> None:
    """Write values into a spec; `compiled` is its model before, `wanted` that at the values."""
    for parameter, value in zip(parameters.parameters, theta, strict=True):
        if parameter.function is not None:
            parameter.function(spec, float(value))
        for target in parameter.targets:
            written = target.scale * float(value) + target.offset
            for path in target.plain_paths:
                if target.term is not None:
                    written = resolve(wanted, path).read(wanted)
                write_element(spec, compiled, wanted, path, written)


def arrays_of(model: Any) -> dict[str, Array]:
    """Copies of all arrays of a model and of its options."""
    found = {
        f"{holder}.{name}": getattr(value, name)
        for holder, value in (("model", model), ("opt", model.opt))
        for name in dir(value)
        if not name.startswith("_")
    }
    return {name: np.array(v) for name, v in found.items() if isinstance(v, np.ndarray)}


# Fields of a body that need its inertia to be stated in the spec.
INERTIA_FIELDS = ("mass", "ipos", "inertia", *INERTIAL_FIELDS)


def write_element(spec: Any, compiled: Any, wanted: Any, text: str, value: float) -> None:
    """Write the number that a path names into an MjSpec, in place.

    Args:
        spec: The spec (`mujoco.MjSpec`), a private copy of the caller.
        compiled: The model of this spec. Where the inertia of a body comes from geoms, it is stated
            explicitly before it is changed.
        wanted: The model at the values, from which inertias and orientations are taken as a whole.
        text: The parameter path. Paths of control laws, of the initial state and of the
            measurement write nothing.
        value: The value of the number.

    Raises:
        ExperimentError: The element cannot be moved in the spec.
    """
    path = ParameterPath.parse(text)
    if path.kind in ("controller", "initial", "output"):
        return

    element = spec.option if path.kind == "option" else getattr(spec, path.kind)(path.name)
    if path.field in ("pos", "rot") and element.frame is not None:
        if getattr(element, "meshname", ""):
            raise ExperimentError(
                f"{text!r}: a mesh inside a <frame> cannot be moved; take the geom out of the frame"
            )
        # The pose is stated in the coordinates of the body instead of those of the `<frame>`.
        found = getattr(compiled, path.kind)(path.name)
        element.set_frame(element.parent.add_frame())
        element.pos, element.quat = found.pos, found.quat
        element.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT

    if path.field in INERTIAL_FIELDS:
        state_inertia(element, wanted)
    elif path.field == "rot":
        element.alt.type = mujoco.mjtOrientation.mjORIENTATION_QUAT
        element.quat = getattr(wanted, path.kind)(path.name).quat
    elif path.kind == "actuator" and path.field in SERVO_FIELDS:
        element.gainprm = wanted.actuator_gainprm[element.id]
        element.biasprm = wanted.actuator_biasprm[element.id]
    elif path.field == "springlength":
        # One rest length may set both ends of the range.
        element.springlength = wanted.tendon_lengthspring[element.id]
    else:
        _write_number(spec, compiled, element, path, value)


def _write_number(
    spec: Any, compiled: Any, element: Any, path: ParameterPath, value: float
) -> None:
    """Write a number that the spec holds under the name of the path's field."""
    if path.kind == "body" and path.field in INERTIA_FIELDS and not element.explicitinertial:
        state_inertia(element, compiled)

    if path.kind == "geom" and np.isfinite(element.fromto[0]):
        # Its end points are replaced by the place and size that they compile to.
        found = compiled.geom(element.id)
        element.fromto = np.full(6, np.nan)
        element.pos, element.quat, element.size = found.pos, found.quat, found.size

    # The compiler adds the offset of a mesh to the position.
    if path.kind == "geom" and path.field == "pos" and element.meshname:
        index = path.component
        value += float(element.pos[index] - compiled.geom(path.name).pos[index])

    in_degrees = spec.compiler.degree and path.field == "springref"
    if in_degrees and element.type == mujoco.mjtJoint.mjJNT_HINGE:
        value = float(np.rad2deg(value))

    # A scalar, or one entry of an array.
    old = np.array(getattr(element, path.field), dtype=np.float64)
    if old.ndim:
        old[path.component] = value
    setattr(element, path.field, old if old.ndim else value)


def state_inertia(body: Any, compiled: Any) -> None:
    """State in a body of a spec the inertia that it has in a model."""
    found = compiled.body(body.id)
    body.mass = float(found.mass[0])
    body.ipos = found.ipos
    body.iquat = found.iquat
    body.inertia = found.inertia
    body.fullinertia = np.full(6, np.nan)
    body.explicitinertial = True

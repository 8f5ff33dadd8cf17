"""The user's URDF with identified values.

A URDF holds masses, centres of mass and inertias of links, and viscous and dry friction of joints.
It is written only if MuJoCo reads these values from it, and everything else as before.
"""

from __future__ import annotations

from collections.abc import Sequence
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ModelError, first_ones
from mjfim.experiment.system import System
from mjfim.model.elements import identifier
from mjfim.model.given import ROUNDING, same_inertia
from mjfim.model.inertia import (
    INERTIA_COLUMNS,
    INERTIA_ENTRIES,
    INERTIA_ROWS,
    BodyInertia,
    body_inertia,
    from_barycentric,
    to_barycentric,
)
from mjfim.model.loading import refused
from mjfim.model.model_files import urdf_sources
from mjfim.model.parameters import Parameter
from mjfim.model.paths import INERTIAL_FIELDS, ParameterPath
from mjfim.model.targets import (
    InitialStateField,
    OutputBiasField,
    OutputDelayField,
    OutputScaleField,
)
from mjfim.output.export.model_xml import (
    ModelXml,
    child,
    floats,
    nearly_equal,
    own_child,
    set_numbers,
)

# Fields of a body that its <inertial> states, and of a joint that its <dynamics> states.
HELD_FIELDS = {
    "body": ("mass", "ipos", "inertia", *INERTIAL_FIELDS),
    "joint": ("damping", "frictionloss"),
}

# Fields of the measurement and of single recordings, which no model states.
NOT_OF_ROBOT = (InitialStateField, OutputBiasField, OutputScaleField, OutputDelayField)

# Arrays of MjModel that have to be as in the user's URDF.
UNCHANGED = (
    *("body_parentid", "body_pos", "body_quat", "qpos0", "dof_armature"),
    *("jnt_type", "jnt_pos", "jnt_axis", "jnt_range", "jnt_limited", "jnt_actfrcrange"),
    *("jnt_stiffness", "geom_type", "geom_size", "geom_pos", "geom_quat"),
    *("geom_contype", "geom_conaffinity"),
)

# Relative difference of an inertia that is the rounding of MuJoCo's compiler.
TOLERANCE = 1e-9

# Attributes of <inertia>, in the order of the entries of a matrix.
ENTRIES = tuple("i" + "xyz"[row] + "xyz"[column] for row, column in INERTIA_ENTRIES)


def urdf_files(path: Path, model: Path) -> tuple[str, ...]:
    """Names of the URDFs that are written for a model; none where none came in.

    Args:
        path: The new MJCF. Names of several URDFs hold those of the user's files.
        model: The user's model.
    """
    sources = urdf_sources(model)
    if len(sources) == 1:
        return (f"{path.stem}.urdf",)
    return tuple(f"{path.stem}_{source.stem}.urdf" for source in sources)


def write_identified_urdfs(
    path: Path, system: System, theta: Array
) -> tuple[dict[Path, Path], list[str]]:
    """Write the URDFs from which a model comes, with parameter values.

    Args:
        path: The new MJCF, beside which they are written.
        system: The experiment with its model.
        theta: (p,) parameter values.

    Returns:
        The new files by the resolved paths of the user's; and sentences about URDFs that could not
        be written, and about values that they cannot hold.
    """
    sources = urdf_sources(system.model_path)
    if not sources:
        return {}, []

    wanted = system.model_at(theta, at_keyframe=False)
    files = {}
    remarks = []
    names = urdf_files(path, system.model_path)
    for name, (source, prefixes) in zip(names, sources.items(), strict=True):
        try:
            _write(path.with_name(name), source, _only_prefix(source, prefixes), system, wanted)
        except ModelError as error:
            remarks.append(f"{name}: not written: {error}")
        else:
            files[source.resolve()] = path.with_name(name)

    missing = [each.name for each in system.parameters.parameters if not _is_held(each)]
    if missing and files:
        written = first_ones([file.name for file in files.values()])
        remarks.append(
            f"{written}: a URDF cannot hold {first_ones(missing)}; {path.name} has all values"
        )
    return files, remarks


def _is_held(parameter: Parameter) -> bool:
    """Whether a URDF can state what a parameter determines in the robot."""
    paths = [
        ParameterPath.parse(target.path)
        for target in parameter.targets
        if not isinstance(target.field, NOT_OF_ROBOT)
    ]
    return parameter.function is None and all(
        path.field in HELD_FIELDS.get(path.kind, ()) and (path.kind == "body" or not path.component)
        for path in paths
    )


def _only_prefix(source: Path, prefixes: Sequence[str]) -> str:
    """The prefix of the names of a URDF that is attached once; ModelError for others."""
    if len(prefixes) > 1:
        raise ModelError(
            f"{source.name} is attached {len(prefixes)} times, and one URDF has one set of values"
        )
    return prefixes[0]


def _write(path: Path, source: Path, prefix: str, system: System, wanted: Any) -> None:
    """Write one URDF; raise ModelError, with a clause, where it cannot have the values."""
    xml, old = ModelXml(source, system.source.read), system.model
    stated = _loaded(source, "MuJoCo does not load the URDF alone", system.source.files)
    inertias = {}
    for link in xml.root.iterchildren("link"):
        name = link.get("name")
        body = identifier(old, "body", prefix + name)
        if body >= 1:
            own = body_inertia(stated, identifier(stated, "body", name))
            inertias[name] = _changed(name, own, *(body_inertia(m, body) for m in (old, wanted)))
            if inertias[name] is not own:
                _state_inertia(link, own, inertias[name])

    frictions = {}
    for joint in xml.root.iterchildren("joint"):
        friction = _friction(wanted, prefix + joint.get("name"))
        if friction is not None:
            frictions[joint.get("name")] = friction
            _state_friction(joint, friction)
    xml.save(path, lambda written: _check(written, stated, inertias, frictions))


def _check(
    path: Path, stated: Any, inertias: dict[str, BodyInertia], frictions: dict[str, Array]
) -> None:
    """Raise ModelError unless a URDF has these values, and all else as the stated model."""
    found = _loaded(path, "MuJoCo does not load it with the identified values")
    for array in UNCHANGED:
        before, after = (np.asarray(getattr(model, array)) for model in (stated, found))
        if before.shape != after.shape or not np.allclose(before, after, ROUNDING, ROUNDING):
            raise ModelError(f"with the identified values it has another {array}")
    for link, inertia in inertias.items():
        body = identifier(found, "body", link)
        if not same_inertia(body_inertia(found, body), inertia, TOLERANCE):
            raise ModelError(f"MuJoCo reads another inertia of link {link!r} from it")
    for joint, friction in frictions.items():
        read = _friction(found, joint)
        if read is None or not nearly_equal(read, friction).all():
            raise ModelError(f"MuJoCo reads another friction of joint {joint!r} from it")


def _loaded(path: Path, fault: str, files: Any = None) -> Any:
    """MjModel of a URDF in which every link is a body of its own, also where it is fixed."""
    with refused(fault):
        spec = mujoco.MjSpec.from_file(path.as_posix(), vfs=files)
        spec.compiler.fusestatic = False
        return spec.compile(files)


def _changed(link: str, own: BodyInertia, before: BodyInertia, after: BodyInertia) -> BodyInertia:
    """Inertia of a link to which others may be fixed, whose inertias stay.

    Args:
        link: Name of the link.
        own: Its inertia.
        before: Inertia of the link and of those that are fixed to it.
        after: The wanted one.
    """
    if same_inertia(before, after):
        return own
    if same_inertia(own, before, TOLERANCE):
        return after
    values = to_barycentric(own) + to_barycentric(after) - to_barycentric(before)
    if values[0] > 0.0:
        inertia = from_barycentric(values)
        moments = np.linalg.eigvalsh(inertia.second_moments)
        if moments[0] >= -TOLERANCE * abs(moments[2]):
            return inertia
    raise ModelError(
        f"the links that are fixed to link {link!r} have more mass or inertia than was identified "
        "for all of them together"
    )


def _state_inertia(link: Any, own: BodyInertia, new: BodyInertia) -> None:
    """State another inertia of a link; one with another matrix in the axes of the link."""
    is_new = own_child(link, "inertial") is None
    inertial = child(link, "inertial")
    mass, origin, inertia = (child(inertial, tag) for tag in ("mass", "origin", "inertia"))
    _state(mass, "value", new.mass)
    _state(origin, "xyz", *new.com)

    rounding = ROUNDING * float(np.trace(new.inertia))
    if is_new or not np.allclose(own.inertia, new.inertia, 0.0, rounding):
        origin.attrib.pop("rpy", None)
        for name, entry in zip(ENTRIES, new.inertia[INERTIA_ROWS, INERTIA_COLUMNS], strict=True):
            _state(inertia, name, entry)


def _state_friction(joint: Any, friction: Array) -> None:
    """State viscous and dry friction of a joint, which are 0 where it states none."""
    if friction.any() or own_child(joint, "dynamics") is not None:
        dynamics = child(joint, "dynamics")
        for name, value in zip(("damping", "friction"), friction, strict=True):
            if value != 0.0 or name in dynamics.attrib:
                _state(dynamics, name, value)


def _state(element: Any, attribute: str, *values: float) -> None:
    """State numbers of an attribute; those that it states already keep their spelling."""
    stated = floats(element.get(attribute, ""))
    before = stated if len(stated) == len(values) else np.full(len(values), np.nan)
    set_numbers(element, attribute, before, np.array(values), len(values))


def _friction(model: Any, joint: str) -> Array | None:
    """(2,) viscous and dry friction of a joint; None where there is no such joint."""
    number = identifier(model, "joint", joint)
    if number < 0:
        return None
    row = int(model.jnt_dofadr[number])
    return np.array([model.dof_damping[row], model.dof_frictionloss[row]])

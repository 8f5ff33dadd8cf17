"""The user's URDF with identified values.

A URDF holds masses, centres of mass and inertias of links, and viscous and dry friction of joints.
It is written only if MuJoCo reads these values from it, and everything else as before.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array
from mjfim.errors import ModelError, first_ones
from mjfim.experiment.system import System
from mjfim.files import replacing
from mjfim.model.inertia import BodyInertia, body_inertia, from_barycentric, to_barycentric
from mjfim.model.loading import load_written_model
from mjfim.model.parameters import Parameter, Target
from mjfim.model.paths import INERTIAL_FIELDS, ParameterPath
from mjfim.model.targets import InertiaField, InitialStateField, OutputBiasField, OutputDelayField
from mjfim.model.urdf_sources import UrdfSource, urdf_sources
from mjfim.output.mjcf.document import nearly_equal
from mjfim.output.mjcf.write import WrittenUrdfs
from mjfim.output.urdf.document import UrdfDocument

# Fields of a body that its <inertial> states, and fields of a joint that its <dynamics> states.
BODY_FIELDS = ("mass", "ipos", "inertia", *INERTIAL_FIELDS)
JOINT_FIELDS = ("damping", "frictionloss")

# Fields of the measurement and of single recordings, which no model states.
NOT_OF_ROBOT = (InitialStateField, OutputBiasField, OutputDelayField)

# Arrays of MjModel that have to be as in the user's URDF; the values of the others are written, or
# follow from them.
UNCHANGED = (
    "body_parentid",
    "body_pos",
    "body_quat",
    "jnt_type",
    "jnt_pos",
    "jnt_axis",
    "jnt_range",
    "jnt_limited",
    "jnt_actfrcrange",
    "jnt_stiffness",
    "dof_armature",
    "qpos0",
    "geom_type",
    "geom_size",
    "geom_pos",
    "geom_quat",
    "geom_contype",
    "geom_conaffinity",
)

# Difference of an inertia over its trace, or of another number over its size, that is rounding.
ROUNDING = 1e-9


def urdf_files(model: Path, stem: str) -> tuple[str, ...]:
    """Names of the URDFs that are written for a model; none where none came in.

    Args:
        model: The user's model.
        stem: Name of the files without the ending; of several URDFs, their names follow it.
    """
    sources = urdf_sources(model)
    if len(sources) == 1:
        return (f"{stem}.urdf",)
    return tuple(f"{stem}_{source.path.stem}.urdf" for source in sources)


def write_identified_urdfs(folder: Path, stem: str, system: System, theta: Array) -> WrittenUrdfs:
    """Write the URDFs from which a model comes, with parameter values.

    Args:
        folder: Folder of the new files.
        stem: Name of the files without the ending; of several URDFs, their names follow it.
        system: The experiment with its model.
        theta: (p,) parameter values.

    Returns:
        The files, and what they hold; nothing where no URDF came in.
    """
    sources = urdf_sources(system.model_path)
    if not sources:
        return WrittenUrdfs()

    wanted = system.model_at(theta, at_keyframe=False)
    files: dict[Path, Path] = {}
    remarks = []
    names = urdf_files(system.model_path, stem)
    for name, source in zip(names, sources, strict=True):
        try:
            _write(folder / name, source, system.model, wanted)
            files[source.path.resolve()] = folder / name
        except ModelError as error:
            remarks.append(f"{name}: not written: {error}")

    # What a URDF could hold that was not written is not held either.
    written = tuple(source for source in sources if source.path.resolve() in files)
    held = _held(system, written)
    missing = [p.name for p in system.parameters.parameters if _targets(p) and p.name not in held]
    if missing and files:
        remarks.append(
            f"{first_ones(names)}: a URDF cannot hold {first_ones(missing)}; {stem}.xml has all "
            "values"
        )
    return WrittenUrdfs(files=files, held=held, remarks=tuple(remarks))


def _write(path: Path, source: UrdfSource, old: Any, wanted: Any) -> None:
    """Write one URDF.

    Raises ModelError, with a clause that gives the reason, where the URDF cannot be written.
    """
    if len(source.prefixes) > 1:
        raise ModelError(
            f"{source.path.name} is attached {len(source.prefixes)} times, and one URDF has one "
            "set of values"
        )

    (prefix,) = source.prefixes
    document = UrdfDocument(source.path.read_bytes())
    _change_links(document, prefix, old, wanted)
    _change_joints(document, prefix, old, wanted)

    # MuJoCo merges links that are fixed to each other, so that the user's URDF may have other
    # bodies than a model that attaches it.
    stated = _loaded(source.path, "MuJoCo does not load the URDF alone")
    folder, target = source.path.resolve().parent, path.resolve().parent
    document.relocate(folder, target, needs_meshes=stated.nmesh > 0)

    with replacing(path) as temporary:
        temporary.write_bytes(document.edited())
        found = _loaded(temporary, "MuJoCo does not load it with the identified values")
        _require_equal(found, stated, wanted, prefix)


def _loaded(path: Path, fault: str) -> Any:
    """MjModel of a URDF; raise ModelError with the fault and MuJoCo's reason where it has none."""
    try:
        return load_written_model(path)
    except (ValueError, mujoco.FatalError) as error:
        raise ModelError(f"{fault} ({' '.join(str(error).split())})") from None


def _change_links(document: UrdfDocument, prefix: str, old: Any, wanted: Any) -> None:
    """Write the inertias of all links that differ between two models."""
    for link in document.links:
        body = _number(old, mujoco.mjtObj.mjOBJ_BODY, prefix + link)
        if body < 1:
            continue
        before, after = body_inertia(old, body), body_inertia(wanted, body)
        if not _is_equal_inertia(before, after, 0.0):
            document.change_inertia(link, before, after)


def _change_joints(document: UrdfDocument, prefix: str, old: Any, wanted: Any) -> None:
    """Write the friction of all joints that differs between two models."""
    for joint in document.joints:
        before, after = (_friction(model, prefix + joint) for model in (old, wanted))
        if before is not None and after is not None and not nearly_equal(before, after).all():
            document.change_friction(joint, float(after[0]), float(after[1]))


def _friction(model: Any, joint: str) -> Array | None:
    """(2,) viscous and dry friction of a joint; None where there is no such joint."""
    number = _number(model, mujoco.mjtObj.mjOBJ_JOINT, joint)
    if number < 0:
        return None
    row = int(model.jnt_dofadr[number])
    return np.array([model.dof_damping[row], model.dof_frictionloss[row]])


def _number(model: Any, kind: Any, name: str) -> int:
    """Number of an object; negative where there is none."""
    return int(mujoco.mj_name2id(model, kind, name))


# ---- comparison of the written URDF with the identified model


def _require_equal(found: Any, stated: Any, wanted: Any, prefix: str) -> None:
    """Raise ModelError unless a written URDF has the identified values, and all others as before.

    Args:
        found: Model that MuJoCo compiles from the written URDF.
        stated: Model that MuJoCo compiles from the user's URDF.
        wanted: The identified model, whose names begin with the prefix.
        prefix: The prefix.
    """
    for name in UNCHANGED:
        before, after = (
            np.asarray(getattr(model, name), dtype=np.float64) for model in (stated, found)
        )
        if before.shape != after.shape or not nearly_equal(before, after).all():
            raise ModelError(f"with the identified values it has another {name}")

    for body in range(1, found.nbody):
        name = str(mujoco.mj_id2name(found, mujoco.mjtObj.mjOBJ_BODY, body))
        identified = _number(wanted, mujoco.mjtObj.mjOBJ_BODY, prefix + name)
        if identified < 1 or not wanted.body_weldid[identified]:
            continue
        if not _is_equal_inertia(
            body_inertia(found, body), _merged_inertia(wanted, identified), ROUNDING
        ):
            raise ModelError(f"MuJoCo reads another inertia of link {name!r} from it")

    for joint in range(found.njnt):
        name = str(mujoco.mj_id2name(found, mujoco.mjtObj.mjOBJ_JOINT, joint))
        friction = _friction(wanted, prefix + name)
        own = _friction(found, name)
        if friction is not None and own is not None and not nearly_equal(own, friction).all():
            raise ModelError(f"MuJoCo reads another friction of joint {name!r} from it")


def _is_equal_inertia(a: BodyInertia, b: BodyInertia, tolerance: float) -> bool:
    """Whether two inertias are equal up to rounding: a share of the size of the body."""
    if not nearly_equal(np.array(a.mass), np.array(b.mass)) and abs(a.mass - b.mass) > (
        tolerance * b.mass
    ):
        return False
    if b.mass <= 0.0:
        return True
    radius, trace = b.gyration_radius, float(np.trace(b.inertia))
    limit = max(tolerance, np.finfo(float).eps)
    return bool(
        (np.abs(a.com - b.com) <= limit * radius).all()
        and (np.abs(a.inertia - b.inertia) <= limit * trace).all()
    )


def _merged_inertia(model: Any, body: int) -> BodyInertia:
    """Inertia of a body and of all bodies that are fixed to it, in the axes of this body."""
    total = np.zeros(10)
    for other in range(1, model.nbody):
        if model.body_weldid[other] != model.body_weldid[body]:
            continue
        pose = _pose(model, other, body)
        if pose is None:
            continue
        own = body_inertia(model, other)
        rotation, position = pose
        if own.mass <= 0.0:
            continue
        turned = BodyInertia(
            mass=own.mass,
            com=rotation @ own.com + position,
            inertia=rotation @ own.inertia @ rotation.T,
        )
        total += to_barycentric(turned)
    return from_barycentric(total) if total[0] > 0.0 else body_inertia(model, body)


def _pose(model: Any, body: int, root: int) -> tuple[Array, Array] | None:
    """(3, 3) axes and (3,) place of a body in a body to which it is fixed; None elsewhere."""
    rotation, position = np.eye(3), np.zeros(3)
    while body != root:
        if body == 0:
            return None
        local = scipy.spatial.transform.Rotation.from_quat(
            model.body_quat[body], scalar_first=True
        ).as_matrix()
        rotation, position = local @ rotation, local @ position + model.body_pos[body]
        body = int(model.body_parentid[body])
    return rotation, position


# ---- values that a URDF holds


def _held(system: System, sources: tuple[UrdfSource, ...]) -> frozenset[str]:
    """Names of the parameters of the robot whose values the URDFs hold."""
    links, joints = set(), set()
    for source in sources:
        document = UrdfDocument(source.path.read_bytes())
        for prefix in source.prefixes:
            links |= {prefix + link for link in document.links}
            joints |= {prefix + joint for joint in document.joints}

    return frozenset(
        parameter.name
        for parameter in system.parameters.parameters
        if parameter.function is None
        and _targets(parameter)
        and all(_is_held(target, links, joints) for target in _targets(parameter))
    )


def _targets(parameter: Parameter) -> list[Target]:
    """Targets of a parameter that belong to the robot."""
    return [target for target in parameter.targets if not isinstance(target.field, NOT_OF_ROBOT)]


def _is_held(target: Target, links: set[str], joints: set[str]) -> bool:
    """Whether a URDF states the number of a target."""
    path = ParameterPath.parse(target.path)
    if path.kind == "body":
        is_inertial = isinstance(target.field, InertiaField) or path.field in BODY_FIELDS
        return is_inertial and path.name in links
    is_linear = path.component in (None, 0)
    return path.kind == "joint" and path.field in JOINT_FIELDS and is_linear and path.name in joints

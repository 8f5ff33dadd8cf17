"""The user's MJCF with identified values.

The model to which the text compiles is compared with the identified one, and every element whose
numbers differ states those of the identified one. A file is written only if it compiles to this.
"""

from __future__ import annotations

from copy import deepcopy
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from lxml import etree

from mjfim.arrays import Array
from mjfim.errors import ModelError, first_ones, listed
from mjfim.experiment.system import System
from mjfim.model.control_laws import remove_numbers
from mjfim.model.loading import ModelSource, compile_spec
from mjfim.model.parameters import ParameterSet
from mjfim.model.paths import MODEL_ARRAYS
from mjfim.model.targets import OutputBiasField, OutputDelayField, OutputScaleField, SpecField
from mjfim.output.models.element_numbers import (
    differ_in_inertia,
    state_as_general,
    state_differences,
)
from mjfim.output.models.model_xml import (
    ModelXml,
    add_comment,
    add_element,
    all_digits,
    loading,
)
from mjfim.output.models.urdf import urdf_files, write_identified_urdfs

# Elements with a name that a term may add or change.
NAMED = (
    "//worldbody//*[@name] | /mujoco/*[self::actuator or self::tendon or self::contact]/*[@name]"
)

# Prefixes of the arrays that determine the motion, and of those among them that only speed it up,
# follow from others, or are compared as matrices.
COMPARED = (
    *("body_", "jnt_", "dof_", "qpos", "actuator_", "tendon_", "pair_friction", "pair_solref"),
    *("site_pos", "site_quat", "geom_pos", "geom_quat", "geom_size", "geom_friction"),
    "geom_solref",
)
NOT_COMPARED = (
    *("body_bvh", "body_simple", "body_sameframe", "body_margin", "body_inertia", "body_iquat"),
    *("body_invweight0", "dof_simplenum"),
)

# Relative difference below which numbers count as equal: of the number itself, and of the largest
# one of its array. MuJoCo prints six digits.
TOLERANCE, ROUNDING = 1e-9, 1e-12
PRINTED_TOLERANCE = 1e-4

# Errors of sensors, which no element can state.
OF_SENSORS = (OutputBiasField, OutputScaleField, OutputDelayField)

# Longest list of actuators in a remark [characters].
REMARK_TEXT = 120


def write_identified(path: Path, system: System, theta: Array) -> list[str]:
    """Write the user's model with parameter values, as MJCF, and as URDF where one came in.

    Included files that change are written beside the main file. Where the text cannot express the
    values, MuJoCo prints the model, without comments.

    Args:
        path: MJCF file that is written; its folder may differ from that of the model. A URDF has
            its name with another ending.
        system: The experiment with its model.
        theta: (p,) parameter values.

    Returns:
        Sentences about everything that a user would not expect.

    Raises:
        ModelError: No MJCF expresses the values.
    """
    wanted = system.model_at(theta, at_keyframe=False)
    urdfs, remarks = write_identified_urdfs(path, system, theta)
    try:
        xml = _edited(system, theta, wanted, urdfs)
        _save(xml, path, wanted, TOLERANCE)
    except ModelError as error:
        try:
            _save(_printed(system, theta, wanted), path, wanted, PRINTED_TOLERANCE)
        except ModelError as reason:
            raise ModelError(f"{path}: not written: {reason}") from None
        remarks.append(
            f"{path.name}: it is printed by MuJoCo, without comments and, where elements have no "
            f"name, with six digits: {error}"
        )
    if system.laws is not None:
        names = first_ones([law.actuator for law in system.laws.laws], longest=REMARK_TEXT)
        remarks.append(
            f"{path.name}: it holds the model without the control laws of {names}, because MJCF "
            "has no laws with a rate; estimate.json holds their numbers"
        )
    return remarks


def identified_files(path: Path, model: Path) -> tuple[str, ...]:
    """Names of all files that `write_identified` may write beside the main file.

    Args:
        path: The new main file.
        model: The user's model.
    """
    try:
        copies = ModelXml(model).copies(path)
    except (ModelError, OSError):
        copies = []
    return (*copies, *urdf_files(path, model))


def same_dynamics(a: Any, b: Any, tolerance: float = TOLERANCE) -> bool:
    """Whether everything that determines the motion agrees in two MjModels."""
    return not _differences(a, b, tolerance)


def _edited(system: System, theta: Array, wanted: Any, urdfs: dict[Path, Path]) -> ModelXml:
    """The user's text with the values."""
    source = system.source
    xml = ModelXml(system.model_path)
    if xml.root.tag != "mujoco":
        raise ModelError(f"the model is no MJCF but <{xml.root.tag}>")
    if source.terms:
        _add_terms(xml, source)
        _extend_keyframes(xml, source)

    xml.attach(urdfs)
    is_changed = _state_others(xml, system.parameters, theta) or urdfs
    compiled = xml.compiled() if is_changed else (source.spec, source.model)
    state_differences(xml, compiled, wanted)
    return xml


def _printed(system: System, theta: Array, wanted: Any) -> ModelXml:
    """The model as MuJoCo prints it, with all digits of the numbers of elements with names."""
    spec = system.source.spec.copy()
    remove_numbers(spec)
    for parameter, value in zip(system.parameters.parameters, theta, strict=True):
        if parameter.function is not None:
            parameter.function(spec, float(value))

    # Inertias that are stated have to count.
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    spec.compiler.settotalmass = -1.0
    compile_spec(spec, system.model_path)
    xml = ModelXml(system.model_path, spec.to_xml().encode())
    state_differences(xml, xml.compiled(), wanted, names_needed=False)
    return xml


def _save(xml: ModelXml, path: Path, wanted: Any, tolerance: float) -> None:
    """Write a text if it compiles to the wanted model."""

    def check(written: Path) -> None:
        """Raise ModelError if the file gives another model."""
        with loading("MuJoCo does not load the text"):
            found = mujoco.MjModel.from_xml_path(str(written))
        different = _differences(found, wanted, tolerance)
        if different:
            raise ModelError(
                f"with the identified values the text compiles to a different {listed(different)}"
            )

    xml.save(path, check)


def _differences(a: Any, b: Any, tolerance: float) -> list[str]:
    """The arrays that determine the motion and differ between two models."""
    names = [n for n in dir(a) if n.startswith(COMPARED) and not n.startswith(NOT_COMPARED)]
    pairs = {name: (getattr(a, name), getattr(b, name)) for name in names}
    pairs |= {n: (getattr(a.opt, n), getattr(b.opt, n)) for n in MODEL_ARRAYS["option"]}
    found = [name for name, (x, y) in pairs.items() if not _is_equal(x, y, tolerance)]

    # Principal axes may be named in any order.
    is_same = a.nbody == b.nbody and not any(
        differ_in_inertia(a, b, i, tolerance) for i in range(a.nbody)
    )
    return found if is_same else [*found, "body_inertia"]


def _is_equal(x: Any, y: Any, tolerance: float) -> bool:
    """Whether two arrays have the same shape and nearly the same numbers, in any unit."""
    x, y = np.asarray(x), np.asarray(y)
    if np.array_equal(x, y):
        return True
    if x.shape != y.shape:
        return False
    largest = float(np.abs(y[np.isfinite(y)]).max(initial=0.0))
    rounding = largest * max(ROUNDING, tolerance * tolerance)
    return bool(np.isclose(x, y, rtol=tolerance, atol=rounding).all())


def _state_others(xml: ModelXml, parameters: ParameterSet, theta: Array) -> bool:
    """State what MjModel does not keep: masses of geoms, and errors of sensors in a comment.

    Returns whether the model may have changed.
    """
    has_masses = False
    errors = []
    for parameter, value in zip(parameters.parameters, theta, strict=True):
        for target in parameter.targets:
            field, number = target.field, target.scale * float(value) + target.offset
            if isinstance(field, SpecField) and field.field in ("mass", "density"):
                xml.named(field.kind, field.name).set(field.field, all_digits(number))
                has_masses = True
            elif isinstance(field, OF_SENSORS) and number != 0.0:
                unit = parameter.unit if target.scale == 1.0 else ""
                errors.append(f"{target.path} = {all_digits(number)} {unit}".rstrip())
    if errors:
        add_comment(xml.root, f"not part of an MJCF: {', '.join(errors)}", first=True)
    return has_masses


# ---- physical terms


def _add_terms(xml: ModelXml, source: ModelSource) -> None:
    """Add what MuJoCo prints for the model with its terms and not for the stated one."""
    stated, extended = (
        etree.fromstring(each.spec.to_xml().encode()) for each in (source.stated, source)
    )
    known = {_key(element): element for element in stated.xpath(NAMED)}
    for element in extended.xpath(NAMED):
        key, parent = _key(element), element.getparent()
        if key not in known:
            comment = next(
                (
                    f"{t.kind} {t.name!r}"
                    for t in source.terms.values()
                    if key[1].startswith(t.name)
                ),
                "",
            )
            if parent.tag != "body":
                # Elements of a section keep their order, so that the new one is in the last one.
                sections = xml.sections(parent.tag)
                place = sections[-1] if sections else add_element(xml.root, parent.tag)
            elif _key(parent) in known:
                place = xml.named("body", parent.get("name"))
            else:
                continue
            added = add_element(place, element.tag, dict(element.attrib), comment=comment)
            added.extend(deepcopy(list(element)))
        elif element.tag == "general" and dict(element.attrib) != dict(known[key].attrib):
            state_as_general(xml.named("actuator", key[1]), element, known[key])

    kept = {name for flag in extended.iter("flag") for name in flag.attrib}
    for flag in xml.root.iter("flag"):
        for name in {name for each in stated.iter("flag") for name in each.attrib} - kept:
            flag.attrib.pop(name, None)


def _key(element: Any) -> tuple[str, str]:
    """Kind and name of an element that MuJoCo prints."""
    return element.tag, element.get("name", "")


def _extend_keyframes(xml: ModelXml, source: ModelSource) -> None:
    """State the keyframes for the state of the model with its terms."""
    stated, model = source.stated.model, source.model
    keys = list(xml.root.iter("key"))
    if len(keys) != model.nkey:
        return
    for i, key in enumerate(keys):
        for attribute, count in {"qpos": "nq", "qvel": "nv", "act": "na"}.items():
            is_extended = getattr(stated, count) != getattr(model, count)
            numbers = getattr(model, f"key_{attribute}")[i]
            if is_extended and (attribute in key.attrib or (attribute == "act" and numbers.any())):
                key.set(attribute, all_digits(*numbers))

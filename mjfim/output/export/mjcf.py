"""The user's MJCF with identified values.

The model to which the text compiles is compared with the identified one, and every element whose
numbers differ states those of the identified one. A file is written only if it compiles to this.
"""

from __future__ import annotations

import os
from collections.abc import Callable, Mapping
from copy import deepcopy
from dataclasses import replace
from datetime import date
from pathlib import Path
from typing import Any, TypeVar

import mujoco
import numpy as np
import scipy
from lxml import etree

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, ModelError, OutputError, first_ones, listed
from mjfim.experiment.packing import input_files
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System, laws_in_loop
from mjfim.model.control_laws import is_law_number
from mjfim.model.elements import element_count, element_name
from mjfim.model.given import (
    ROUNDING,
    TOLERANCE,
    differ_in_inertia,
    differences,
    exact_numbers,
    same_inertias,
)
from mjfim.model.loading import ModelSource, compile_spec, refused
from mjfim.model.model_files import changed_files, elements_of
from mjfim.model.parameters import ParameterSet
from mjfim.model.paths import MODEL_ARRAYS, POLYNOMIAL_ARRAYS
from mjfim.model.targets import OutputBiasField, OutputDelayField, OutputScaleField, SpecField
from mjfim.output.export.model_xml import (
    ALTERNATIVES,
    ModelXml,
    add_comment,
    add_element,
    all_digits,
    child,
    floats,
    held_name,
    nearly_equal,
    own_child,
    parent_of,
    set_numbers,
)
from mjfim.output.export.urdf import urdf_files, write_identified_urdfs
from mjfim.output.manifest import OutputGuard, claimed
from mjfim.parallel.workers import own_versions
from mjfim.records.estimate import Estimate

T = TypeVar("T")

# By kind of element, the arrays of MjModel whose numbers its attributes state, and those of an
# <inertial>.
ARRAYS: dict[str, dict[str, str]] = {
    "geom": {"pos": "geom_pos", "quat": "geom_quat", "size": "geom_size", **MODEL_ARRAYS["geom"]},
    "pair": MODEL_ARRAYS["pair"],
    "body": {"pos": "body_pos", "quat": "body_quat", "gravcomp": "body_gravcomp"},
    "site": {"quat": "site_quat", **MODEL_ARRAYS["site"]},
    "joint": {"pos": "jnt_pos", "axis": "jnt_axis", **MODEL_ARRAYS["joint"]},
    "tendon": MODEL_ARRAYS["tendon"],
    "actuator": {"forcerange": "actuator_forcerange", **MODEL_ARRAYS["actuator"]},
}
INERTIAL = {
    "pos": "body_ipos",
    "mass": "body_mass",
    "quat": "body_iquat",
    "diaginertia": "body_inertia",
}

# Fewest numbers of the attributes that MuJoCo takes as a whole only.
LEAST = {"pos": 3, "axis": 3, "quat": 4, "diaginertia": 3}

# Numbers that determine the force of an actuator. By element and attribute, where each number of
# the attribute stands among them: array, column and sign. A <general> states the arrays.
FORCE = ("gainprm", "biasprm", "dynprm")
Places = tuple[tuple[str, int, float], ...]
KP: Places = (("gainprm", 0, 1.0), ("biasprm", 1, -1.0))
KV: Places = (("biasprm", 2, -1.0),)
LUGRE = (("dynprm", 5), ("dynprm", 6), ("biasprm", 3), ("biasprm", 4), ("biasprm", 5))
SHORTHANDS: dict[str, dict[str, tuple[Places, ...]]] = {
    "position": {"kp": (KP,), "kv": (KV,), "timeconst": ((("dynprm", 0, 1.0),),)},
    "intvelocity": {"kp": (KP,), "kv": (KV,)},
    "velocity": {"kv": ((("gainprm", 0, 1.0), ("biasprm", 2, -1.0)),)},
    "damper": {"kv": ((("gainprm", 2, -1.0),),)},
    "dcmotor": {
        "resistance": ((("gainprm", 0, 1.0),),),
        "motorconst": ((("gainprm", 1, 1.0),),),
        "lugre": tuple(((array, column, 1.0),) for array, column in LUGRE),
    },
}

# Kinds whose numbers are compared in each round: those of inertias may follow from geoms, and
# others from inertias.
ROUNDS = (("geom",), *(tuple(ARRAYS),) * 4)


def state_differences(xml: ModelXml, compiled: tuple[Any, Any], wanted: Any) -> None:
    """State the numbers of all elements that differ from those of a wanted model.

    Args:
        xml: The text.
        compiled: Its MjSpec and MjModel.
        wanted: The wanted model.

    Raises:
        ModelError: The text cannot state a number. The message is a clause.
    """
    for kinds in ROUNDS:
        spec, found = compiled
        statement = _Statement(xml, spec, found, wanted)
        for kind in kinds:
            for i in range(element_count(found, kind)):
                statement.state(kind, i)
        if len(kinds) > 1:
            statement.state_options()
        if statement.is_changed:
            compiled = xml.compiled()


def _differing(before: Mapping[str, Array], after: Mapping[str, Array]) -> list[str]:
    """The attributes whose numbers differ."""
    return [name for name in before if not nearly_equal(before[name], after[name]).all()]


class _Statement:
    """States in a text those numbers of a wanted model that differ from its own.

    Attributes:
        is_changed: Whether the text has changed.
    """

    def __init__(self, xml: ModelXml, spec: Any, found: Any, wanted: Any) -> None:
        self.is_changed = False
        self._xml = xml
        self._spec = spec
        self._found = found
        self._wanted = wanted
        self._models = (found, wanted)

    def state(self, kind: str, i: int) -> None:
        """State the numbers of the element of a kind with a number."""
        before, after = (_numbers(model, kind, i) for model in self._models)
        differing = _differing(before, after)
        is_moved = kind == "body" and differ_in_inertia(*self._models, i, ROUNDING)
        if not differing and not is_moved:
            return

        name = element_name(self._found, kind, i)
        if not name:
            raise ModelError(f"a {kind} that has no name would state {listed(differing)}")
        self.is_changed = True
        element = self._xml.named(kind, name)
        if is_moved:
            self._state_inertial(element, i)
        if kind == "actuator" and element.tag != "general":
            self._state_force(element, before, after)
            differing = [each for each in differing if each not in FORCE]

        if kind == "geom" and "fromto" in element.attrib:
            differing = self._without_end_points(element, i, before, after) or differing
        for attribute in differing:
            self._set(element, attribute, before[attribute], after[attribute])

    def state_options(self) -> None:
        """State the options that differ, as whole vectors, where the text states them last."""
        for field in MODEL_ARRAYS["option"]:
            before, after = (np.atleast_1d(getattr(model.opt, field)) for model in self._models)
            if not nearly_equal(before, after).all():
                self.is_changed = True
                options = self._xml.sections("option") or [child(self._xml.root, "option")]
                stating = [option for option in options if field in option.attrib]
                set_numbers([*options, *stating][-1], field, before, after, len(after))

    def _set(self, element: Any, attribute: str, before: Array, after: Array) -> None:
        """State numbers in the unit and the frame of an attribute."""
        least = LEAST.get(attribute, 1)
        name = element.get("name")
        if attribute == "springref" and self._spec.compiler.degree:
            if self._spec.joint(name).type == mujoco.mjtJoint.mjJNT_HINGE:
                before, after = np.rad2deg(before), np.rad2deg(after)
        elif attribute == "springlength":
            # One rest length sets both ends of the range.
            is_range = after[0] != after[1] or " " in element.get(attribute, "").strip()
            least = 2 if is_range else 1
            before, after = before[:least], after[:least]
        elif attribute == "pos" and element.get("mesh"):
            # The compiler adds the offset of a mesh to the position of its geom.
            stated = self._spec.geom(name).pos
            after = stated + (after - before)
            before = stated
        elif attribute in ("pos", "quat"):
            before, after = (_in_frames(element, attribute, each) for each in (before, after))
        set_numbers(element, attribute, before, after, least)

    def _without_end_points(
        self, element: Any, geom: int, before: dict[str, Array], after: dict[str, Array]
    ) -> list[str]:
        """Replace the end points of a geom whose place or length changes; what is to be stated."""
        is_radius = np.array_equal(before["size"][1:], after["size"][1:])
        if is_radius and nearly_equal(before["pos"], after["pos"]).all():
            return []
        del element.attrib["fromto"]
        after["quat"] = self._wanted.geom_quat[geom]
        before["pos"], before["quat"] = np.full(3, np.nan), np.full(4, np.nan)
        before["size"] = np.where(after["size"] > 0.0, np.nan, after["size"])
        return list(after)

    def _state_inertial(self, element: Any, body: int) -> None:
        """State the inertia of a body by its principal moments and axes, which sensors may read."""
        inertial = own_child(element, "inertial")
        if inertial is None:
            inertial = add_element(element, "inertial", first=True)
        has_axes = "diaginertia" in inertial.attrib
        for attribute, array in INERTIAL.items():
            before, after = (np.atleast_1d(getattr(model, array)[body]) for model in self._models)
            known = before if has_axes else np.full(len(after), np.nan)
            set_numbers(inertial, attribute, known, after, len(after))

    def _state_force(self, element: Any, before: dict[str, Array], after: dict[str, Array]) -> None:
        """State gain, bias and dynamics of an actuator by its attributes, or make it a <general>.

        MuJoCo prints every actuator as one, which then states the numbers in the next round.
        """
        changed = {
            (array, int(column))
            for array in FORCE
            for column in np.flatnonzero(~nearly_equal(before[array], after[array]))
        }
        for attribute, numbers in SHORTHANDS.get(element.tag, {}).items():
            places = {(array, column) for number in numbers for array, column, _ in number}
            values = [{s * after[array][i] for array, i, s in number} for number in numbers]
            if places & changed and all(len(each) == 1 for each in values):
                old = [s * before[array][i] for (array, i, s), *_ in numbers]
                new = [each.pop() for each in values]
                set_numbers(element, attribute, np.array(old), np.array(new), len(new))
                changed -= places
        if changed:
            printed = etree.fromstring(self._spec.to_xml().encode())
            (general,) = printed.xpath("//actuator/*[@name=$name]", name=element.get("name"))
            state_as_general(element, general, general)


def state_as_general(element: Any, printed: Any, before: Any) -> None:
    """State an actuator as a <general>, as MuJoCo prints it.

    Args:
        element: The actuator of the user's text.
        printed: The element that MuJoCo prints for it.
        before: The same before a change; the user's spelling of what has not changed stays.
    """
    own = {
        key: text
        for key, text in element.attrib.items()
        if key in printed.attrib and before.get(key) == printed.get(key)
    }
    element.tag = printed.tag
    element.attrib.clear()
    element.attrib.update({**printed.attrib, **own})


def _numbers(model: Any, kind: str, i: int) -> dict[str, Array]:
    """Numbers of an element by the attribute that states them."""
    found = {}
    for attribute, array in ARRAYS[kind].items():
        # A joint has the number of its first degree of freedom for all of them.
        row = i
        if array.startswith("dof_"):
            row = model.jnt_dofadr[i]
        elif array.startswith("qpos_"):
            row = model.jnt_qposadr[i]
        found[attribute] = np.atleast_1d(getattr(model, array)[row])
        if kind == "joint" and attribute in POLYNOMIAL_ARRAYS:
            higher = getattr(model, POLYNOMIAL_ARRAYS[attribute])[row]
            found[attribute] = np.append(found[attribute], higher)
    return found


def _in_frames(element: Any, attribute: str, numbers: Array) -> Array:
    """Express a position or an orientation in the body by the <frame>s around the element."""
    frames = []
    frame = parent_of(element)
    while frame.tag == "frame":
        frames.append(frame)
        frame = parent_of(frame)
    for each in reversed(frames):
        if set(ALTERNATIVES["quat"]) & set(each.attrib):
            raise ModelError(f"{element.tag} {element.get('name')!r} is inside a turned <frame>")
        back = scipy.spatial.transform.Rotation.from_quat(
            floats(each.get("quat", "1 0 0 0")), scalar_first=True
        ).inv()
        if attribute == "pos":
            numbers = back.apply(numbers - floats(each.get("pos", "0 0 0")))
        elif np.isfinite(numbers).all():
            turn = back * scipy.spatial.transform.Rotation.from_quat(numbers, scalar_first=True)
            numbers = turn.as_quat(scalar_first=True)
    return numbers


# Elements with a name that a term may add or change.
NAMED = (
    "//worldbody//*[@name] | /mujoco/*[self::actuator or self::tendon or self::contact]/*[@name]"
)

# Errors of sensors, which no element can state.
OF_SENSORS = (OutputBiasField, OutputScaleField, OutputDelayField)

# Longest list of actuators in a remark [characters].
REMARK_TEXT = 120


def save_identified(estimate: Estimate, path: str | Path, *, force: bool) -> list[str]:
    """Write the identified model of an estimate. See `Estimate.save_model`."""
    if not isinstance(path, str | Path) or Path(path).suffix != ".xml":
        raise OutputError(f"{path!r}: save_model writes an MJCF; name a file that ends in .xml")
    path, system = Path(path), _system_of(estimate)
    guard = OutputGuard(input_files(system.experiment), force=force)
    names = identified_files(path, system.model_path)
    names += tuple(held_name(path, name) for name in _held(system))
    guard.check([path, *(path.with_name(name) for name in names)])
    with claimed(path.parent, guard, exclusive=False):
        return write_identified(path, system, estimate.theta, estimate)


def identified_spec(estimate: Estimate) -> Any:
    """The identified MjSpec of an estimate. See `Estimate.spec`."""
    system, wanted = _expressible(_system_of(estimate), estimate.theta)

    def compiled(xml: ModelXml) -> Any:
        """The MjSpec of a text."""
        spec, model = xml.compiled()
        _require_equal(model, wanted)
        return spec

    return _expressed(system, estimate.theta, wanted, {}, compiled)[0]


def _system_of(estimate: Estimate) -> System:
    """The experiment of an estimate, resolved against its model."""
    experiment = estimate.experiment
    if isinstance(experiment, Path):
        experiment = Experiment.from_file(experiment)
    if experiment is None:
        raise ExperimentError(
            "this estimate does not know its experiment: load it from the folder of `mjfim "
            "identify`, or state it: dataclasses.replace(estimate, experiment=experiment)"
        )
    system = System.resolve(experiment)
    if system.parameters.names != estimate.parameters:
        raise ExperimentError(
            f"{experiment.source}: has the parameters {listed(system.parameters.names)}, but the "
            f"estimate has {listed(estimate.parameters)}; after --select, state "
            "dataclasses.replace(estimate, experiment=mjfim.selected_experiment(experiment, "
            "estimate.selection))"
        )
    return system


def _held(system: System) -> dict[str, bytes]:
    """Assets of a model that are in the memory only, by their names in its main file."""
    main = system.model_path
    return {
        Path(os.path.relpath(file, main.parent)).as_posix(): content
        for file, content in system.source.stated.contents.items()
        if not file.is_file() and file != main
    }


def _expressible(system: System, theta: Array) -> tuple[System, Any]:
    """A system without what is no part of an MJCF, and its model at parameters.

    It has no floor that only the experiment states, and no laws. Servos have the gains of the laws
    that took their place, and their largest forces where the MJCF limits them.
    """
    if system.experiment.limits.floor is not None:
        stated = system.experiment.replace(limits={"floor": None})
        system = System.resolve(stated, source=system.source.stated)
    source = system.source.stated.extended(tuple(system.source.terms.values()))
    parameters = tuple(
        replace(each, targets=tuple(t for t in each.targets if not is_law_number(t.field)))
        for each in system.parameters.parameters
    )
    own = replace(system.parameters, parameters=parameters)
    bare = replace(system, source=source, parameters=own)
    wanted = bare.model_at(theta, at_keyframe=False)
    motors = system.plant.model(theta)
    for law in laws_in_loop(system, theta, {}):
        if law.replaces_servo:
            gain = motors.actuator(law.actuator).gainprm[0]
            kp, kd = (gain * law.numbers.get(name, 0.0) for name in ("kp", "kd"))
            servo = wanted.actuator(law.actuator)
            servo.gainprm[0], servo.biasprm[1:3] = kp, (-kp, -kd)
            ends = [gain * law.numbers.get(f"saturation[{i}]", np.inf) for i in (0, 1)]
            if wanted.actuator_forcelimited[servo.id] and np.isfinite(ends).all():
                servo.forcerange[:] = ends
    return bare, wanted


def write_identified(
    path: Path, system: System, theta: Array, estimate: Estimate | None = None
) -> list[str]:
    """Write the user's model with parameter values, as MJCF, and as URDF where one came in.

    Included files that change are written beside the main file. Where the text cannot express the
    values, MuJoCo prints the model, without comments.

    Args:
        path: MJCF file that is written; its folder may differ from that of the model. A URDF has
            its name with another ending.
        system: The experiment with its model.
        theta: (p,) parameter values.
        estimate: The estimate whose data and accuracy the first comment states; None for no such
            comment.

    Returns:
        Sentences about everything that a user would not expect.

    Raises:
        ModelError: No MJCF expresses the values.
    """
    system, wanted = _expressible(system, theta)
    urdfs, remarks = write_identified_urdfs(path, system, theta)
    files = [system.model_path, *(file for file, _ in elements_of(system.model_path))]
    texts = {file.resolve() for file in files}
    contents = {file: each for file, each in system.source.stated.contents.items() if file.exists()}
    changed = [file for file in changed_files(contents) if file.resolve() not in texts]
    if changed:
        remarks.append(
            f"{first_ones([file.name for file in changed])} changed while this ran; {path.name} "
            "reads what is there now, but the parameters belong to what was loaded"
        )

    def save(xml: ModelXml) -> None:
        """Write a text if it compiles to the wanted model."""
        if estimate is not None:
            add_comment(xml.root, provenance(estimate), first=True)

        def check(written: Path) -> None:
            """Raise ModelError if the file gives another model."""
            with refused("MuJoCo does not load the text"):
                found = mujoco.MjModel.from_xml_path(str(written))
            _require_equal(found, wanted)

        xml.save(path, check)

    try:
        _, fault = _expressed(system, theta, wanted, urdfs, save)
    except ModelError as reason:
        why = "; ".join([str(reason), *remarks])
        raise ModelError(f"{path}: not written: {why}") from None
    if fault:
        remarks.append(f"{path.name}: it is printed by MuJoCo, without comments: {fault}")
    if system.laws is not None:
        names = first_ones([law.actuator for law in system.laws.laws], longest=REMARK_TEXT)
        remarks.append(
            f"{path.name}: it holds the model without the control laws of {names}, because MJCF "
            "has no laws with a rate; estimate.json holds their numbers. A servo whose place a law "
            "took has its kp and kd, and both ends of its saturation where the MJCF has a "
            "forcerange, but not its latency"
        )
    return remarks


def provenance(estimate: Estimate) -> str:
    """State in lines from which data values come, when, by which version, and how accurate."""
    values = [
        f"{' '.join(dict.fromkeys([each.name, *each.targets]))} = {each}, σ {each.std:.3g}"
        for each in estimate.each()
    ]
    data = [f"{each.name} ({len(each.t)} rows)" for each in estimate.recordings]
    version, engine = own_versions()
    lines = [
        f"Identified with mjfim {version} and MuJoCo {engine}, written on {date.today()}.",
        f"Data: {listed(data)}.",
        "Values with their 95 % intervals, and their honest standard deviations:",
        *values,
        f"Verdict: {estimate.verdict.level}. {estimate.verdict.sentence}",
    ]
    return "\n     ".join(lines)


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


def _edited(system: System, theta: Array, wanted: Any, urdfs: dict[Path, Path]) -> ModelXml:
    """The user's text with the values."""
    source = system.source
    xml = ModelXml(system.model_path, source.read, _held(system))
    if xml.root.tag != "mujoco":
        raise ModelError(f"the model is no MJCF but <{xml.root.tag}>")
    if source.terms:
        _add_terms(xml, source)
        _extend_keyframes(xml, source)

    xml.attach(urdfs)
    is_changed = _state_others(xml, system.parameters, theta) or bool(urdfs)
    if not same_inertias(source.model, wanted, TOLERANCE):
        # Inertias that are stated have to count.
        for compiler in xml.root.iter("compiler"):
            if compiler.get("inertiafromgeom") == "true":
                compiler.set("inertiafromgeom", "auto")
                is_changed = True
    compiled = xml.compiled() if is_changed else (source.spec, source.model)
    state_differences(xml, compiled, wanted)
    return xml


def _printed(system: System, theta: Array, wanted: Any) -> ModelXml:
    """The model as MuJoCo prints it."""
    spec = system.source.spec.copy()
    for parameter, value in zip(system.parameters.parameters, theta, strict=True):
        if parameter.function is not None:
            parameter.function(spec, float(value))

    # Inertias that are stated have to count.
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    spec.compiler.settotalmass = -1.0
    compile_spec(spec, system.model_path, files=system.source.files)
    spec.assets = held = _held(system)
    with refused("MuJoCo does not print it"), exact_numbers():
        text = spec.to_xml().encode()
    xml = ModelXml(system.model_path, lambda _: text, held)
    state_differences(xml, xml.compiled(), wanted)
    return xml


def _expressed(
    system: System,
    theta: Array,
    wanted: Any,
    urdfs: dict[Path, Path],
    use: Callable[[ModelXml], T],
) -> tuple[T, str]:
    """Use the user's text with the values; where it cannot have them, that which MuJoCo prints.

    Returns:
        What `use` returns; and the reason why the text is printed, empty where it is the user's.
    """
    try:
        return use(_edited(system, theta, wanted, urdfs)), ""
    except ModelError as error:
        return use(_printed(system, theta, wanted)), str(error)


def _require_equal(found: Any, wanted: Any) -> None:
    """Raise ModelError if two models differ."""
    different = differences(found, wanted, TOLERANCE)
    if different:
        raise ModelError(
            f"with the identified values the text compiles to a different {listed(different)}"
        )


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
                xml.named("geom", field.name).set(field.field, all_digits(number))
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

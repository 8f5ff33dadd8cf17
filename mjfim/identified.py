"""The user's MJCF with identified values in it. A compile must give the model that was identified, or it is refused."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.errors import ModelError
from mjfim.files import replacing
from mjfim.models import compile_spec
from mjfim.parameters import PATH, ParameterSet
from mjfim.setup import Setup
from mjfim.trajectory import Array

COMPARED = (
    "body_",
    "jnt_",
    "dof_",
    "qpos",
    "actuator_",
    "tendon_",
    "site_pos",
    "geom_pos",
    "geom_size",
    "geom_friction",
)
NOT_DYNAMICS = ("body_bvh", "body_simple", "body_sameframe", "body_margin", "dof_simplenum")


def write_identified(path: Path, setup: Setup, theta: Array) -> None:
    """Write the MJCF at theta: (p,). Asset folders are re-pointed so that it loads from `path`.

    MuJoCo prints six significant digits; the full ones are in estimate.json. Raises ModelError where MJCF cannot say it.
    """
    wanted = setup.model_at(theta)
    for settled in (False, True):
        spec = setup.spec.copy()
        if settled:
            settle(spec, setup.model)
        try:
            write_spec(spec, setup.model, setup.parameters, theta)
            compiled = compile_spec(spec, setup.model_path)
        except ValueError as error:
            if settled:
                raise ModelError(f"{path}: MuJoCo refuses the identified values: {error}") from None
            continue
        if same_dynamics(compiled, wanted):
            _save(path, spec, setup.model_path)
            return
    raise ModelError(
        f"{path}: not written: compiling the identified values anew gives another model than the identified one"
    )


def _save(path: Path, spec: Any, model_path: Path) -> None:
    source, target = model_path.resolve().parent, path.resolve().parent
    for folder in ("meshdir", "texturedir"):
        setattr(spec, folder, os.path.relpath(source / getattr(spec, folder), target))
    spec.modelfiledir = str(target)
    with replacing(path) as temporary:
        temporary.write_text(spec.to_xml(), encoding="utf-8")
        mujoco.MjModel.from_xml_path(str(temporary))


def same_dynamics(a: Any, b: Any) -> bool:
    """True where two models agree in everything that moves them."""
    names = [n for n in dir(a) if n.startswith(COMPARED) and not n.startswith(NOT_DYNAMICS)]
    pairs = [(np.asarray(getattr(a, n)), np.asarray(getattr(b, n))) for n in names]
    pairs.append((a.opt.gravity, b.opt.gravity))
    return all(x.shape == y.shape and np.allclose(x, y, rtol=1e-9, atol=1e-12) for x, y in pairs)


def write_spec(spec: Any, compiled: Any, parameters: ParameterSet, theta: Array) -> None:
    """Write theta: (p,) into an MjSpec that the caller owns.

    compiled: the model of the same spec; bodies whose inertia came from geoms get it spelled out before it is changed.
    """
    for parameter, value in zip(parameters.parameters, theta, strict=True):
        for target in parameter.targets:
            _write_element(spec, compiled, target.path, target.scale * float(value) + target.offset)


def _write_element(spec: Any, compiled: Any, path: str, value: float) -> None:
    match = PATH.match(path)
    if match is None:
        raise ValueError(f"parameter path {path!r} is not of the form kind/name:field[index]")
    kind, name, field, index = match["kind"], match["name"], match["field"], int(match["index"] or 0)
    element = spec.option if kind == "option" else getattr(spec, kind)(name)
    if kind == "body" and field in ("mass", "ipos", "inertia") and not element.explicitinertial:
        _spell_out_inertia(element, compiled)
    if field == "springref" and element.type == mujoco.mjtJoint.mjJNT_HINGE and spec.compiler.degree:
        value = float(np.rad2deg(value))
    old = np.array(getattr(element, field), dtype=np.float64)
    if old.ndim:
        old[index] = value
        setattr(element, field, old)
    else:
        setattr(element, field, value)


def _spell_out_inertia(body: Any, compiled: Any) -> None:
    found = compiled.body(body.id)
    body.mass, body.ipos, body.iquat, body.inertia = float(found.mass[0]), found.ipos, found.iquat, found.inertia
    body.fullinertia, body.explicitinertial = np.full(6, np.nan), True


def settle(spec: Any, compiled: Any) -> None:
    """Spell out what the compiler would resolve anew from the changed values: inertias, springs, servo gains, end points."""
    spec.compiler.inertiafromgeom = mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_AUTO
    spec.compiler.settotalmass = -1.0
    for body in spec.bodies[1:]:
        _spell_out_inertia(body, compiled)
    for geom in spec.geoms:
        if np.isfinite(geom.fromto[0]):
            found = compiled.geom(geom.id)
            geom.fromto = np.full(6, np.nan)
            geom.pos, geom.quat, geom.size = found.pos, found.quat, found.size
    for joint in spec.joints:
        if np.any(np.asarray(joint.springdamper) > 0):
            joint.springdamper = np.zeros(2)
            joint.stiffness = _first(joint.stiffness, float(compiled.jnt_stiffness[joint.id]))
            joint.damping = _first(joint.damping, float(compiled.dof_damping[compiled.jnt_dofadr[joint.id]]))
    for tendon in spec.tendons:
        tendon.springlength = compiled.tendon_lengthspring[tendon.id]
    for actuator in spec.actuators:
        actuator.biasprm = compiled.actuator_biasprm[actuator.id]
        actuator.gainprm = compiled.actuator_gainprm[actuator.id]


def _first(polynomial: Any, value: float) -> Array:
    changed = np.array(polynomial, dtype=np.float64)
    changed[0] = value
    return changed

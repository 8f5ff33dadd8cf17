"""The user's MJCF with identified values in it. A compile must give the model that was identified, or it is refused."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.errors import ModelError
from mjfim.files import replacing
from mjfim.mjcf import settle, write_element
from mjfim.models import compile_spec
from mjfim.parameters import ParameterSet
from mjfim.paths import FIELDS
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
    "site_quat",
    "geom_pos",
    "geom_quat",
    "geom_size",
    "geom_friction",
    "geom_solref",
)
NOT_DYNAMICS = ("body_bvh", "body_simple", "body_sameframe", "body_margin", "dof_simplenum")


def write_identified(path: Path, setup: Setup, theta: Array) -> None:
    """Write the MJCF at theta: (p,). Asset folders are re-pointed so that it loads from `path`.

    MuJoCo prints six significant digits; the full ones are in estimate.json. Raises ModelError where MJCF cannot say it.
    """
    wanted = setup.model_at(theta, placed=False)
    for settled in (False, True):
        spec = setup.spec.copy()
        if settled:
            settle(spec, setup.model)
        try:
            write_spec(spec, setup.model, wanted, setup.parameters, theta)
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
    pairs += [(np.asarray(getattr(a.opt, n)), np.asarray(getattr(b.opt, n))) for n in FIELDS["option"]]
    return all(x.shape == y.shape and np.allclose(x, y, rtol=1e-9, atol=1e-12) for x, y in pairs)


def write_spec(spec: Any, compiled: Any, wanted: Any, parameters: ParameterSet, theta: Array) -> None:
    """Write theta: (p,) into an MjSpec that the caller owns. compiled, wanted: its model as it is and at theta."""
    for parameter, value in zip(parameters.parameters, theta, strict=True):
        if parameter.function is not None:
            parameter.function(spec, float(value))
        for target in parameter.targets:
            write_element(spec, compiled, wanted, target.path, target.scale * float(value) + target.offset)

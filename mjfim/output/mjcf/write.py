"""The user's MJCF with identified values in it. A compile must give the model that was identified, or it is refused."""

from __future__ import annotations

import os
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from mjfim.arrays import Array
from mjfim.atomic_io import replacing
from mjfim.errors import ModelError
from mjfim.experiment.system import Setup
from mjfim.model.loading import compile_spec, unconstrained
from mjfim.model.parameters import ParameterSet
from mjfim.model.paths import FIELDS
from mjfim.model.spec_writer import settle, write_element
from mjfim.output.mjcf.asset_paths import repoint
from mjfim.output.mjcf.document import Sheet
from mjfim.output.mjcf.edits import Retouch

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


NOT_DYNAMICS = (
    "body_bvh",
    "body_simple",
    "body_sameframe",
    "body_margin",
    "body_inertia",
    "body_iquat",
    "dof_simplenum",
)


def write_identified(path: Path, setup: Setup, theta: Array) -> str | None:
    """Write the user's MJCF at theta: (p,): the text with other numbers in it, by all digits. It loads from `path`.

    Returns a sentence where more changes than the identified values: what the compiler would derive anew is stated, or, where
    the text cannot say theta, MuJoCo prints the model (six significant digits). Raises ModelError where MJCF cannot say it.
    """
    wanted = setup.model_at(theta, placed=False)
    said = []
    try:
        stated = _retouch(path, setup, theta, wanted)
        if stated:
            said.append(
                f"it also states what MuJoCo would derive anew from the identified values: {', '.join(stated)}"
            )
    except ModelError as error:
        _print(path, setup, theta, wanted)
        said.append(f"it is MuJoCo's own printing, six significant digits and no comments: {error}")
    found = mujoco.MjModel.from_xml_path(str(path))
    otherwise = _weighed_otherwise(found, wanted, alike=False)
    if otherwise and not unconstrained(found):
        said.append(
            f"its contacts and other constraints of {', '.join(map(repr, otherwise))} are a little softer or harder than in "
            "the fit, where MuJoCo could not treat these bodies as 'simple' (body_invweight0)"
        )
    return f"{path.name}: {'; '.join(said)}" if said else None


def _retouch(path: Path, setup: Setup, theta: Array, wanted: Any) -> list[str]:
    """Write the text, changed; returns what had to be stated besides theta. Raises ModelError with a clause that says why not."""
    source = setup.model_path.resolve()
    sheet = Sheet(source.read_bytes())
    repoint(sheet, setup.spec, source.parent, path.resolve().parent)
    work = Retouch(sheet, setup.spec, setup.model, wanted)
    work.write(setup.parameters, theta)
    stated: list[str] = []
    with replacing(path) as temporary:
        found = _written(temporary, sheet)
        if not same_dynamics(found, wanted):
            stated = work.settle(found)
            found = _written(temporary, sheet)
        unequal = _differences(found, wanted)
        if unequal:
            raise ModelError(
                f"with the identified values the text compiles to another {', '.join(unequal)}"
            )
    return stated


def _written(path: Path, sheet: Sheet) -> Any:
    path.write_bytes(sheet.edited())
    try:
        return mujoco.MjModel.from_xml_path(str(path))
    except (ValueError, mujoco.FatalError) as error:
        said = " ".join(str(error).split())
        raise ModelError(
            f"MuJoCo does not load the text with the identified values ({said})"
        ) from None


def _print(path: Path, setup: Setup, theta: Array, wanted: Any) -> None:
    """Write MuJoCo's printing. Raises ModelError where its compile is another model than the wanted one."""
    for settled in (False, True):
        spec = setup.spec.copy()
        if settled:
            settle(spec, setup.model)
        try:
            write_spec(spec, setup.model, wanted, setup.parameters, theta)
            compiled = compile_spec(spec, setup.model_path)
        except (ValueError, ModelError) as error:
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
    return not _differences(a, b)


def _differences(a: Any, b: Any) -> list[str]:
    """Names of what moves two models and differs. Inertias are compared as matrices, whose axes may be named in any order."""
    names = [n for n in dir(a) if n.startswith(COMPARED) and not n.startswith(NOT_DYNAMICS)]
    pairs = {n: (np.asarray(getattr(a, n)), np.asarray(getattr(b, n))) for n in names}
    pairs |= {
        n: (np.asarray(getattr(a.opt, n)), np.asarray(getattr(b.opt, n))) for n in FIELDS["option"]
    }
    found = [
        n
        for n, (x, y) in pairs.items()
        if x.shape != y.shape or not np.allclose(x, y, rtol=1e-9, atol=1e-12)
    ]
    if found == ["body_invweight0"] and not _weighed_otherwise(a, b, alike=True):
        found = []
    traces = np.sum(b.body_inertia, axis=1)[:, None, None]
    unequal = a.nbody != b.nbody or bool(
        (np.abs(_matrices(a) - _matrices(b)) > 1e-9 * traces).any()
    )
    return [*found, "body_inertia"] if unequal else found


def _weighed_otherwise(a: Any, b: Any, alike: bool) -> list[str]:
    """Names of bodies of another body_invweight0, by which MuJoCo softens constraints.

    alike: of bodies that are 'simple' in both models or in neither, else in one of them, where MuJoCo averages it otherwise;
    in a fit the bodies that a parameter moves are never 'simple'
    """
    far = ~np.isclose(a.body_invweight0, b.body_invweight0, rtol=1e-9, atol=1e-12).all(axis=1)
    rows = far & (((a.body_simple > 0) == (b.body_simple > 0)) == alike)
    return [
        mujoco.mj_id2name(a, mujoco.mjtObj.mjOBJ_BODY, int(i)) or f"body{i}"
        for i in np.flatnonzero(rows)
    ]


def _matrices(model: Any) -> Array:
    """(nbody, 3, 3) inertias in the axes of their bodies."""
    R = Rotation.from_quat(model.body_iquat, scalar_first=True).as_matrix()
    return np.asarray(np.einsum("bij,bj,bkj->bik", R, model.body_inertia, R))


def write_spec(
    spec: Any, compiled: Any, wanted: Any, parameters: ParameterSet, theta: Array
) -> None:
    """Write theta: (p,) into an MjSpec that the caller owns. compiled, wanted: its model as it is and at theta."""
    for parameter, value in zip(parameters.parameters, theta, strict=True):
        if parameter.function is not None:
            parameter.function(spec, float(value))
        for target in parameter.targets:
            write_element(
                spec, compiled, wanted, target.path, target.scale * float(value) + target.offset
            )

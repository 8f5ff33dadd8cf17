"""Load and compile MJCF models."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.errors import ModelError
from mjfim.model.smooth_friction import has_dry_friction


def load_spec(path: Path) -> Any:
    """MjSpec of an MJCF (or URDF) file. Raises ModelError with MuJoCo's message."""
    if not path.is_file():
        raise ModelError(f"{path}: no such model file")
    try:
        return mujoco.MjSpec.from_file(str(path))
    except ValueError as error:
        raise ModelError(f"{path}: MuJoCo cannot read the model: {str(error).strip()}") from None


def compile_spec(spec: Any, path: Path) -> Any:
    """MjModel of a spec. Raises ModelError with MuJoCo's message."""
    try:
        return spec.compile()
    except (ValueError, mujoco.FatalError) as error:
        raise ModelError(f"{path}: MuJoCo cannot compile the model: {str(error).strip()}") from None


def decoration(spec: Any, model: Any) -> frozenset[str]:
    """Names of geoms that neither collide nor give their body its inertia: their size and place move nothing else."""
    forced = spec.compiler.inertiafromgeom == mujoco.mjtInertiaFromGeom.mjINERTIAFROMGEOM_TRUE
    paired = {name for pair in spec.pairs for name in (pair.geomname1, pair.geomname2)}
    return frozenset(
        geom.name
        for geom in spec.geoms
        if geom.name
        and geom.name not in paired
        and not (model.geom_contype[geom.id] or model.geom_conaffinity[geom.id])
        and not geom.fluid_ellipsoid
        and (geom.mass == 0.0 or (geom.parent.explicitinertial and not forced))
        and not geom.meshname
    )


def unconstrained(model: Any) -> bool:
    """True where no constraint can ever be active, so that switching the solver off changes nothing."""
    no_contact = bool(model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT)) or (
        model.npair == 0 and not (np.any(model.geom_contype) and np.any(model.geom_conaffinity))
    )
    limited = model.jnt_limited.any() or model.tendon_limited.any()
    return bool(
        no_contact
        and model.neq == 0
        and model.nflex == 0
        and not limited
        and not has_dry_friction(model)
    )

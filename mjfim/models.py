"""MJCF models as the package sees them: loading, names, and the private copy that is stepped."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.dry import is_dry, soften
from mjfim.errors import ExperimentError, ModelError
from mjfim.trajectory import Array

KEPT = 512  # compiled variants
SOLVER_TOLERANCE = 1e-14
# MjData of another layout would be written past its end
LAYOUT = (
    "nq",
    "nv",
    "na",
    "nu",
    "nbody",
    "nsensordata",
    "ngeom",
    "nsite",
    "ncam",
    "nlight",
    "njnt",
    "ntendon",
    "nwrap",
    "neq",
    "nmocap",
    "nM",
    "nC",
    "nJmom",
    "nbvh",
    "nflex",
    "nskin",
)


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


@dataclass(frozen=True)
class Coordinate:
    """A scalar joint: its name, unit and place. joint: id;  q: qpos address;  v: dof address."""

    name: str
    unit: str
    joint: int
    q: int
    v: int


def coordinates(model: Any) -> tuple[Coordinate, ...]:
    """All slide and hinge joints, in order."""
    found, names = [], joint_names(model)
    for j in range(model.njnt):
        if int(model.jnt_type[j]) in (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE)):
            unit = "m" if int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_SLIDE) else "rad"
            found.append(Coordinate(names[j], unit, j, int(model.jnt_qposadr[j]), int(model.jnt_dofadr[j])))
    return tuple(found)


def joint_names(model: Any) -> tuple[str, ...]:
    """njnt names; unnamed joints are called by their number."""
    return _names(model, mujoco.mjtObj.mjOBJ_JOINT, model.njnt, "joint")


def actuator_names(model: Any) -> tuple[str, ...]:
    """nactuator names; unnamed actuators are called by their number."""
    return _names(model, mujoco.mjtObj.mjOBJ_ACTUATOR, model.nactuator, "actuator")


def _names(model: Any, kind: Any, count: int, fallback: str) -> tuple[str, ...]:
    """Names of all objects of a kind, no two alike: a number that another one is called by gets underscores."""
    given = [mujoco.mj_id2name(model, kind, i) for i in range(count)]
    taken = {name for name in given if name}
    for i in range(count):
        if not given[i]:
            name = f"{fallback}{i}"
            while name in taken:
                name += "_"
            given[i] = name
    return tuple(given)


def control_names(model: Any) -> tuple[str, ...]:
    """nu names; an actuator with several controls gets one name per control."""
    names: list[str] = []
    for i, name in enumerate(actuator_names(model)):
        count = int(model.actuator_ctrlnum[i])
        names += [name] if count == 1 else [f"{name}[{c}]" for c in range(count)]
    return tuple(names)


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


@dataclass(frozen=True, eq=False)
class Mocap:
    """Where a keyframe puts mocap bodies, written over the places at which they compile: MjData starts from there.

    MuJoCo derives constants of equalities and tendons from the compiled places, so these must stand there meanwhile.
    bodies: (n,) ids;  compiled, start: (n, 7) position [m] and quaternion (w, x, y, z)
    """

    bodies: np.ndarray
    compiled: Array
    start: Array

    @staticmethod
    def of(model: Any, key: Any) -> Mocap | None:
        """Of the mocap bodies that a keyframe (`model.key(name)` or None) puts elsewhere; None where there are none."""
        if key is None or model.nmocap == 0:
            return None
        bodies = np.flatnonzero(model.body_mocapid >= 0)
        order = model.body_mocapid[bodies]
        places = np.concatenate([model.body_pos[bodies], model.body_quat[bodies]], axis=1)
        start = np.concatenate([key.mpos.reshape(-1, 3)[order], key.mquat.reshape(-1, 4)[order]], axis=1)
        moved = (places != start).any(axis=1)
        return Mocap(bodies[moved], places[moved], start[moved]) if moved.any() else None

    def put(self, model: Any, places: Array) -> None:
        """Write places: (n, 7) into a model in place."""
        model.body_pos[self.bodies], model.body_quat[self.bodies] = places[:, :3], places[:, 3:]


@dataclass(frozen=True)
class Lifted:
    """What hides derivatives and is changed in a private copy: clamps and stops that a design keeps away from, dry friction.

    joints: whose ranges;  forces: joints whose actuator force;  actuators: whose force;  controls: whether all control ranges
    contacts: whether all contacts;  soft: speeds below which dry friction is viscous, empty: as it is (see `dry`)
    """

    joints: tuple[int, ...] = ()
    forces: tuple[int, ...] = ()
    actuators: tuple[int, ...] = ()
    controls: bool = False
    contacts: bool = False
    soft: tuple[float, ...] = ()

    def out_of(self, model: Any) -> None:
        """Change a model that the caller owns, in place."""
        model.jnt_limited[list(self.joints)] = 0
        model.jnt_actfrclimited[list(self.forces)] = 0
        model.actuator_forcelimited[list(self.actuators)] = 0
        if self.controls:
            model.actuator_ctrllimited[:] = 0
        if self.contacts:
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONTACT)


class Source:
    """Where the private copies of a model come from: work that cannot matter is off, bodies that move inside are not 'simple'.

    moved: bodies whose inertial frame parameters change, None: any of them may;  sensors: whether sensor data is wanted
    friction: whether a parameter is a frictionloss (the constraint solver must then stay on)
    coarsen: how many times longer than stated the timestep is;  mocap: where mocap bodies start, None: as compiled
    lifted: without the clamps and stops of limits that a design holds anyway
    """

    def __init__(
        self,
        spec: Any,
        path: Path,
        moved: Collection[str] | None,
        sensors: bool,
        friction: bool,
        coarsen: int = 1,
        mocap: Mocap | None = None,
        lifted: Lifted | None = None,
    ) -> None:
        self._spec, self._path, self._lifted = spec.copy(), path, lifted
        for body in self._spec.bodies[1:]:
            if moved is None or body.name in moved:
                body.simple = 0
        self._sensors, self._friction, self._coarsen = sensors, friction, coarsen
        self._mocap = mocap
        self.model = self._compile(self._spec)
        self._edited: dict[bytes, Any] = {}

    def edited(self, key: bytes, edit: Callable[[Any], None]) -> Any:
        """The model of an edited spec, kept under a key. Raises ModelError where it no longer compiles or fits.

        Raises ExperimentError where the timestep changes: rate and samples rest on it.
        """
        if key not in self._edited:
            if len(self._edited) > KEPT:
                self._edited.clear()
            own = self._spec.copy()
            edit(own)
            model = self._compile(own)
            for size in LAYOUT:
                if getattr(model, size) != getattr(self.model, size):
                    raise ModelError(
                        f"{self._path}: a parameter changes {size} of the model from {getattr(self.model, size)} to "
                        f"{getattr(model, size)}; it may change numbers only"
                    )
            stated, found = float(self.model.opt.timestep), float(model.opt.timestep)
            if found != stated:
                raise ExperimentError(
                    f"parameters: a function changes option.timestep of {self._path} from {stated / self._coarsen:g} s to "
                    f"{found / self._coarsen:g} s; rate and samples rest on it: state the timestep in the MJCF"
                )
            self._edited[key] = model
        return self._edited[key]

    @property
    def soft(self) -> tuple[float, ...]:
        """Speeds below which its dry friction is viscous; empty where it is as it is."""
        return () if self._lifted is None else self._lifted.soft

    def settle(self, model: Any) -> Any:
        """A model of this source after parameters were written into it: what rests on them is written anew, in place."""
        if self.soft:
            soften(model, self.soft)
        return model

    def _compile(self, spec: Any) -> Any:
        model = compile_spec(spec, self._path)
        if self._lifted is not None:
            self._lifted.out_of(model)
        if not self._sensors:
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_SENSOR)
        if not self._friction and unconstrained(model):
            model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        model.opt.timestep *= self._coarsen
        # differences of steps see what the constraint solver leaves undone, and where it starts from
        model.opt.tolerance = min(model.opt.tolerance, SOLVER_TOLERANCE)
        model.opt.disableflags |= int(mujoco.mjtDisableBit.mjDSBL_WARMSTART)
        if self._mocap is not None:
            self._mocap.put(model, self._mocap.start)
        return self.settle(model)


def unconstrained(model: Any) -> bool:
    """True where no constraint can ever be active, so that switching the solver off changes nothing."""
    no_contact = bool(model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONTACT)) or (
        model.npair == 0 and not (np.any(model.geom_contype) and np.any(model.geom_conaffinity))
    )
    limited = model.jnt_limited.any() or model.tendon_limited.any()
    return bool(no_contact and model.neq == 0 and model.nflex == 0 and not limited and not is_dry(model))

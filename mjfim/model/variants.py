"""How the plant of a level of the descent differs from the user's: quicker to step, or smoother."""

from __future__ import annotations

from collections.abc import Callable, Collection
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, ModelError
from mjfim.model.loading import compile_spec, unconstrained
from mjfim.model.smooth_friction import smooth_dry_friction


@dataclass(frozen=True)
class Level:
    """A level.

    coarsen: 1, or how many times longer than stated timestep and sample period are
    stretch: 1, or how many times longer the timestep alone is, and the engine steps of a sample fewer
    lifted: without the clamps and stops that hard limits keep a design away from
    soft: speeds of every degree of freedom and tendon at which dry friction turns viscous where derivatives are taken, empty
        where it is as it is;  softened: so it is in the motion as well
    """

    coarsen: int = 1
    stretch: int = 1
    lifted: bool = False
    soft: tuple[float, ...] = ()
    softened: bool = False


STATED, FREE = Level(), Level(lifted=True)


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
        start = np.concatenate(
            [key.mpos.reshape(-1, 3)[order], key.mquat.reshape(-1, 4)[order]], axis=1
        )
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
            smooth_dry_friction(model, self.soft)
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

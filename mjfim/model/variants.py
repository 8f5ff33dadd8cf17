"""Variants of the user's model: copies of one compiled model that are quicker or smoother."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import KW_ONLY, dataclass, field, replace
from functools import cached_property
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError, ModelError
from mjfim.model.elements import is_rk4
from mjfim.model.loading import MAX_EDITED_MODELS, ModelSource, silence_mujoco_log

# Tolerance of the constraint solver in private copies. With a larger one, the error of the solver
# would appear in differences between steps.
SOLVER_TOLERANCE = 1e-14

# Fields of MjModel that determine the layout of MjData. A model with other sizes would write beyond
# the end of the arrays.
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


@record
class ModelVariant:
    """Differences between the plant of a search and the user's model.

    Attributes:
        sample_factor: Factor by which timestep and sample period are longer than stated.
        timestep_factor: Factor by which the timestep alone is longer; a sample has correspondingly
            fewer engine steps.
        relaxed: True where clamps, stops and contacts are removed; hard limits keep a design away
            from them.
        smoothing_speeds: Speed of every degree of freedom, then of every tendon, below which dry
            friction is viscous where derivatives are taken [rad/s or m/s]; empty for the friction
            of the engine.
        smoothed: Dry friction is viscous below these speeds in the motion as well, not only in its
            derivatives.
    """

    sample_factor: int = 1
    timestep_factor: int = 1
    relaxed: bool = False
    smoothing_speeds: tuple[float, ...] = ()
    smoothed: bool = False

    @property
    def is_coarse(self) -> bool:
        """Whether motions differ from those of the stated level."""
        return self.sample_factor > 1 or self.timestep_factor > 1 or self.smoothed

    def differs_in_time_only(self, other: ModelVariant) -> bool:
        """Whether another variant is equal but for its timestep and sample period."""
        samples, timestep = self.sample_factor, self.timestep_factor
        return self == replace(other, sample_factor=samples, timestep_factor=timestep)


# The model as the user states it.
STATED = ModelVariant()

# The model without clamps, stops and contacts, as far as a relaxation states.
RELAXED = ModelVariant(relaxed=True)


@dataclass(frozen=True, eq=False)
class MocapPlacement:
    """Poses of mocap bodies that a keyframe states.

    MjData takes its initial poses from the model, so the keyframe's poses overwrite the compiled
    ones. MuJoCo derives constants of equalities and tendons from the compiled poses, which must be
    in the model while it does so.

    Attributes:
        bodies: (n,) ids of the bodies.
        compiled: (n, 7) position [m] and quaternion (w, x, y, z) as compiled.
        start: (n, 7) position [m] and quaternion (w, x, y, z) of the keyframe.
    """

    bodies: np.ndarray
    compiled: Array
    start: Array

    @staticmethod
    def of(model: Any, key: Any) -> MocapPlacement:
        """Poses of the mocap bodies that a keyframe moves.

        Args:
            model: The compiled model (`mujoco.MjModel`).
            key: The keyframe, `model.key(name)`, or None.
        """
        if key is None or model.nmocap == 0:
            return AS_COMPILED

        bodies = np.flatnonzero(model.body_mocapid >= 0)
        order = model.body_mocapid[bodies]
        places = np.concatenate([model.body_pos[bodies], model.body_quat[bodies]], axis=1)
        start = np.concatenate(
            [key.mpos.reshape(-1, 3)[order], key.mquat.reshape(-1, 4)[order]], axis=1
        )
        moved = (places != start).any(axis=1)
        return MocapPlacement(bodies[moved], places[moved], start[moved])

    def put(self, model: Any, places: Array) -> None:
        """Write places: (n, 7) into a model in place."""
        model.body_pos[self.bodies] = places[:, :3]
        model.body_quat[self.bodies] = places[:, 3:]

    def derive_constants(self, model: Any, data: Any) -> None:
        """Let MuJoCo compute its derived constants anew, from the compiled poses."""
        self.put(model, self.compiled)
        with silence_mujoco_log():
            mujoco.mj_setConst(model, data)
        self.put(model, self.start)


# All mocap bodies where the compiled model has them.
AS_COMPILED = MocapPlacement(np.zeros(0, np.intp), np.zeros((0, 7)), np.zeros((0, 7)))


@record
class Relaxation:
    """Clamps, stops and dry friction that are changed in a private copy of the model.

    They are changed because they hide derivatives.

    Attributes:
        joints: Ids of joints whose range is removed.
        joint_forces: Ids of joints whose limit of actuator force is removed.
        actuators: Ids of actuators whose force range is removed.
        tendons: Ids of tendons whose range of lengths is removed.
        tendon_forces: Ids of tendons whose limit of actuator force is removed.
        controls: Whether all control ranges are removed.
        contacts: Whether all contacts are removed.
        constraints: Whether all constraints are removed, dry friction among them, and the forces of
            any step are those at its beginning: steps of RK4 have a single stage, and states with
            too large accelerations are not reset.
        smoothing_speeds: Speeds below which dry friction is viscous [m/s or rad/s]; empty for the
            friction of the engine.
    """

    joints: tuple[int, ...] = ()
    joint_forces: tuple[int, ...] = ()
    actuators: tuple[int, ...] = ()
    tendons: tuple[int, ...] = ()
    tendon_forces: tuple[int, ...] = ()
    controls: bool = False
    contacts: bool = False
    constraints: bool = False
    smoothing_speeds: tuple[float, ...] = ()

    def apply(self, model: Any) -> None:
        """Change a model that the caller owns, in place."""
        for is_limited, freed in (
            (model.jnt_limited, self.joints),
            (model.jnt_actfrclimited, self.joint_forces),
            (model.actuator_forcelimited, self.actuators),
            (model.tendon_limited, self.tendons),
            (model.tendon_actfrclimited, self.tendon_forces),
        ):
            is_limited[list(freed)] = 0
        if self.controls:
            model.actuator_ctrllimited[:] = 0
        if self.contacts:
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONTACT
        if self.constraints:
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
            model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_AUTORESET
            if is_rk4(model):
                model.opt.integrator = mujoco.mjtIntegrator.mjINT_EULER
                model.opt.disableflags |= mujoco.mjtDisableBit.mjDSBL_EULERDAMP


@dataclass(frozen=True, eq=False)
class PlantModel:
    """The compiled model that a plant steps: a copy of the user's model with other settings.

    Attributes:
        source: The user's model.
        moved_bodies: Bodies whose inertial frame parameters change, None where any of them may.
        sensors: Whether sensor data is wanted; MuJoCo skips the computation otherwise.
        friction: Whether a parameter is a frictionloss, so that the constraint solver must stay on.
        timestep_factor: Factor by which the timestep is longer than stated.
        mocap: Initial poses of mocap bodies.
        relaxation: Clamps, stops and friction that are changed in the copy.
    """

    source: ModelSource
    _: KW_ONLY
    moved_bodies: frozenset[str] | None
    sensors: bool
    friction: bool
    timestep_factor: int = 1
    mocap: MocapPlacement = AS_COMPILED
    relaxation: Relaxation = field(default_factory=Relaxation)

    @cached_property
    def model(self) -> Any:
        """The compiled copy (MjModel)."""
        return self._adapted(self.source.compiled(self.moved_bodies))

    @cached_property
    def _edited(self) -> dict[bytes, Any]:
        """The latest models of edited specs."""
        return {}

    @property
    def smoothing_speeds(self) -> tuple[float, ...]:
        """Speeds below which its dry friction is viscous; empty for the friction of the engine."""
        return self.relaxation.smoothing_speeds

    def edited(self, key: bytes, edit: Callable[[Any], None]) -> Any:
        """The model of an edited spec, kept under a key.

        Args:
            key: Identifies the edit; for a known key the kept model is returned.
            edit: Changes an MjSpec in place.

        Raises:
            ModelError: It no longer compiles, or its sizes change.
            ExperimentError: The timestep changes, which determines the samples.
        """
        if key not in self._edited:
            if len(self._edited) >= MAX_EDITED_MODELS:
                self._edited.clear()
            compiled = self.source.edited(self.moved_bodies, key, edit)
            self._require_layout(compiled)
            self._edited[key] = self._adapted(compiled)
        return self._edited[key]

    def refresh(self, model: Any) -> Any:
        """Write again the settings that depend on the parameters of a model.

        Args:
            model: A copy of this model into which parameters were written; changed in place.

        Returns:
            The changed model.
        """
        if self.smoothing_speeds:
            smooth_dry_friction(model, self.smoothing_speeds)
        return model

    def _require_layout(self, compiled: Any) -> None:
        """Raise where an edited model has other sizes or another timestep than the user's."""
        path, stated = self.source.path, self.source.compiled(self.moved_bodies)

        for size in LAYOUT:
            if getattr(compiled, size) != getattr(stated, size):
                raise ModelError(
                    f"{path}: a parameter changes {size} of the model from {getattr(stated, size)} "
                    f"to {getattr(compiled, size)}; it may change numbers only"
                )

        if compiled.opt.timestep != stated.opt.timestep:
            raise ExperimentError(
                f"parameters: a function changes option.timestep of {path} from "
                f"{stated.opt.timestep:g} s to {compiled.opt.timestep:g} s; it determines the "
                "samples: state the timestep in the MJCF"
            )

    def _adapted(self, compiled: Any) -> Any:
        """A copy of a compiled model with the settings of this variant."""
        model = copy.copy(compiled)
        options = model.opt

        self.relaxation.apply(model)

        # Work that cannot matter is switched off.
        if not self.sensors:
            options.disableflags |= mujoco.mjtDisableBit.mjDSBL_SENSOR
        if not self.friction and unconstrained(model):
            options.disableflags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
        # On one kinematic tree there are no islands to find. Where bodies may sleep, MuJoCo needs
        # the islands for other purposes.
        if model.ntree == 1 and not options.enableflags & mujoco.mjtEnableBit.mjENBL_SLEEP:
            options.disableflags |= mujoco.mjtDisableBit.mjDSBL_ISLAND

        # The single row of a test bench with one joint, whose dry friction may be a parameter, is
        # solved exactly by one pass of projected Gauss-Seidel. With it a step of such a model takes
        # a third less time than with Newton's method. MuJoCo does not solve for it with IPC.
        has_pass = options.iterations > 0
        has_pass &= not options.enableflags & mujoco.mjtEnableBit.mjENBL_IPC
        if has_pass and allows_dry_friction_only(model) and model.nv + model.ntendon == 1:
            options.solver = mujoco.mjtSolver.mjSOL_PGS

        options.timestep *= self.timestep_factor

        # Differences between steps must depend neither on the initial guess of the solver nor on
        # its remaining error.
        options.tolerance = min(options.tolerance, SOLVER_TOLERANCE)
        options.disableflags |= mujoco.mjtDisableBit.mjDSBL_WARMSTART

        self.mocap.put(model, self.mocap.start)
        return self.refresh(model)


def unconstrained(model: Any) -> bool:
    """Whether no constraint can ever be active, so that the solver can be switched off."""
    return allows_dry_friction_only(model) and not has_dry_friction(model)


def allows_dry_friction_only(model: Any) -> bool:
    """Whether dry friction of joints and tendons is the only constraint that can be active."""
    no_contact = bool(model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_CONTACT) or (
        model.npair == 0 and not (np.any(model.geom_contype) and np.any(model.geom_conaffinity))
    )
    limited = model.jnt_limited.any() or model.tendon_limited.any()
    return bool(no_contact and model.neq == 0 and model.nflex == 0 and not limited)


# Smoothing speed s of a degree of freedom, divided by its fastest speed.
SMOOTHING_SPEED_FRACTION = 0.02

# Impedance of the smoothed friction constraint. It is so low that the force depends on velocities
# and not on accelerations.
SMOOTHED_IMPEDANCE = 1e-3

# Smallest impedance that MuJoCo uses.
MIN_IMPEDANCE = 1e-4

# Smallest damping of a friction constraint for which a sticking speed is computed, relative to one
# per timestep.
MIN_DAMPING = 1e-12


def has_dry_friction(model: Any) -> bool:
    """Whether any joint or tendon has dry friction."""
    return bool(model.dof_frictionloss.any() or model.tendon_frictionloss.any())


def smoothing_speeds_of(model: Any, fastest: Array) -> tuple[float, ...]:
    """Smoothing speeds s of every degree of freedom, then of every tendon [m/s or rad/s].

    No smoothing speed is below the speed at which the engine's friction sticks.

    Args:
        model: The model (`mujoco.MjModel`).
        fastest: (nv,) fastest speeds of the degrees of freedom [m/s or rad/s].
    """
    step = model.opt.timestep
    sticking = []
    for loss, weight, solimp, reference in _friction_arrays(model):
        # Below such a speed, friction brakes with less than its full force: the constraint asks for
        # a deceleration of damping times speed, and its force cannot exceed the friction loss. In
        # MuJoCo's standard form the first number of `solref` is positive and is a time constant.
        # Otherwise the second number is the damping itself.
        impedance = np.maximum(solimp[:, 1], MIN_IMPEDANCE)
        standard = reference[:, 0] > 0.0
        time_constant = np.where(standard, impedance * reference[:, 0], 1.0)
        damping = np.where(standard, 2.0 / time_constant, -reference[:, 1] / impedance)
        sticking.append(loss * weight / np.maximum(damping, MIN_DAMPING / step))
    proportional = np.concatenate([SMOOTHING_SPEED_FRACTION * fastest, np.zeros(model.ntendon)])
    return tuple(np.maximum(np.concatenate(sticking), proportional).tolist())


def smooth_dry_friction(model: Any, speeds: tuple[float, ...]) -> None:
    """Replace the dry friction of a model by smoothed friction, in place.

    Args:
        model: The model (`mujoco.MjModel`), a private copy of the caller.
        speeds: Smoothing speeds of every degree of freedom, then of every tendon; 0 keeps the
            engine's friction.
    """
    remaining = np.asarray(speeds)
    for loss, weight, impedance, reference in _friction_arrays(model):
        s, remaining = remaining[: len(loss)], remaining[len(loss) :]
        smoothed = (loss > 0.0) & (s > 0.0)

        # A steeper law would be unstable with this timestep.
        s = np.maximum(s, loss * weight * model.opt.timestep)

        resistance = (1.0 - SMOOTHED_IMPEDANCE) / SMOOTHED_IMPEDANCE * weight
        damping = SMOOTHED_IMPEDANCE * (loss * resistance)[smoothed] / s[smoothed]
        impedance[smoothed] = (SMOOTHED_IMPEDANCE, SMOOTHED_IMPEDANCE, 1e-3, 0.5, 2.0)
        reference[smoothed, 0] = -1.0
        reference[smoothed, 1] = -damping


def _friction_arrays(model: Any) -> list[tuple[Array, Array, Array, Array]]:
    """Views of the friction constraints of the degrees of freedom, and of the tendons.

    They are friction losses (n,) [N or N m], inverse inertias at the constraint (n,), `solimp`
    (n, 5) and `solref` (n, 2).
    """
    joints = (model.dof_frictionloss, model.dof_invweight0, model.dof_solimp, model.dof_solref)
    tendons = (
        model.tendon_frictionloss,
        model.tendon_invweight0,
        model.tendon_solimp_fri,
        model.tendon_solref_fri,
    )
    return [joints, tendons]

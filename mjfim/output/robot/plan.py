"""A design as a robot needs it: rows at the rate of the controller, and what the controls drive."""

from __future__ import annotations

from dataclasses import dataclass
from enum import Enum
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.excitation.limits import limits_of
from mjfim.experiment.system import System
from mjfim.model.coordinates import ScalarJoint, actuator_names
from mjfim.model.servos import (
    AFFINE,
    AT_JOINT,
    Servo,
    actuator_gear,
    is_integrated,
    servo_kind,
)
from mjfim.output.archive import check_fits
from mjfim.output.playback import reference_columns, simulate_playback
from mjfim.records.design import Design
from mjfim.records.trajectory import Playback


class DriveKind(Enum):
    """Meaning of the control of an actuator."""

    FORCE = "force or torque"
    POSITION = "position of a servo"
    VELOCITY = "velocity of a servo"
    OTHER = "none of these"


# What the controls of servos mean.
KINDS_OF_SERVOS: dict[Servo | None, DriveKind] = {
    "position": DriveKind.POSITION,
    "velocity": DriveKind.VELOCITY,
    None: DriveKind.OTHER,
}


@dataclass(frozen=True, kw_only=True)
class Drive:
    """One control, and what it drives.

    Attributes:
        name: Name of the control.
        kind: What the control means.
        joint: The slide or hinge joint on which its actuator acts; None where it acts on something
            else, or on several joints.
        gear: Ratio of the actuator's coordinate to that of the joint.
        holds_position: Whether the actuator holds a position while the control stays.
        lower: Smallest control [unit of the actuator]; -inf without a limit.
        upper: Largest control [unit of the actuator]; inf without a limit.
    """

    name: str
    kind: DriveKind
    joint: ScalarJoint | None
    gear: float
    holds_position: bool
    lower: float
    upper: float


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotPlan:
    """A design with everything that the programs of a robot need.

    Attributes:
        name: Name of the experiment.
        system: The experiment.
        playback: The M rows of control and the final state, as in design.csv.
        reference: (M+1,) columns of reference.csv by name.
        drives: The nu controls.
    """

    name: str
    system: System
    playback: Playback
    reference: dict[str, Array]
    drives: tuple[Drive, ...]

    @classmethod
    def of(cls, design: Design, system: System, file: Path | None = None) -> RobotPlan:
        """Simulate a design at the rate of the controller.

        Args:
            design: The design.
            system: The experiment for which it was made.
            file: File of the design, for messages.

        Raises:
            RecordingError: The design was made for another model or another rate.
            SimulationDivergedError: The simulation diverges.
        """
        source = Path(system.experiment.source)
        check_fits(file or Path("the design"), design.trajectory, system)
        playback = simulate_playback(system, design.trajectory, design.final.gain)
        return cls(
            name=source.stem,
            system=system,
            playback=playback,
            reference=reference_columns(playback, system),
            drives=drives_of(system),
        )

    @property
    def held_control(self) -> Array:
        """(M+1, nu) control of each row; the last row continues the last control."""
        ctrl = self.playback.ctrl
        return np.concatenate([ctrl, ctrl[-1:]])

    def column(self, name: str) -> Array:
        """(M+1,) a column of reference.csv, for example `qpos:<joint>` or `force:<joint>`."""
        return self.reference[name]


def drives_of(system: System) -> tuple[Drive, ...]:
    """Find what the controls of an experiment drive, and their limits.

    Args:
        system: The experiment.

    Returns:
        The nu controls, in the order of the model.
    """
    model = system.model
    period = system.dt
    limits = limits_of(model, system.controls, system.experiment.limits, period)
    ranges = {each.name: (each.lower, each.upper) for each in limits if each.kind == "control"}
    joints = {joint.joint: joint for joint in system.coordinates}

    drives: list[Drive] = []
    for i in range(len(actuator_names(model))):
        count = int(model.actuator_ctrlnum[i])
        for _ in range(count):
            name = system.controls[len(drives)]
            lower, upper = ranges.get(name, (-np.inf, np.inf))
            joint = joints.get(_joint_number(model, i)) if count == 1 else None
            drives.append(
                Drive(
                    name=name,
                    kind=_kind(model, i) if count == 1 else DriveKind.OTHER,
                    joint=joint,
                    gear=actuator_gear(model, i),
                    holds_position=_holds_position(model, i),
                    lower=float(lower),
                    upper=float(upper),
                )
            )
    return tuple(drives)


def _joint_number(model: Any, actuator: int) -> int:
    """Number of the joint on which an actuator acts; -1 where it acts on something else."""
    at_joint = mujoco.mjtTrn(int(model.actuator_trntype[actuator])) in AT_JOINT
    return int(model.actuator_trnid[actuator, 0]) if at_joint else -1


def _holds_position(model: Any, actuator: int) -> bool:
    """Whether an actuator pulls its coordinate to a place that its control states."""
    is_affine = mujoco.mjtBias(int(model.actuator_biastype[actuator])) in AFFINE
    pulls = is_affine and float(model.actuator_biasprm[actuator, 1]) < 0.0
    return pulls and not is_integrated(model, actuator)


def _kind(model: Any, actuator: int) -> DriveKind:
    """Meaning of the control of an actuator that has one control."""
    has_fixed_gain = int(model.actuator_gaintype[actuator]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    has_gain = float(model.actuator_gainprm[actuator, 0]) != 0.0
    if not has_fixed_gain or not has_gain or is_integrated(model, actuator):
        return DriveKind.OTHER

    if int(model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_NONE):
        return DriveKind.FORCE

    # A servo with a constant force beside does not rest at its command.
    has_constant = float(model.actuator_biasprm[actuator, 0]) != 0.0
    return DriveKind.OTHER if has_constant else KINDS_OF_SERVOS[servo_kind(model, actuator)]

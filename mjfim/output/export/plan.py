"""A design as a robot needs it: rows at the rate of the controller, and what the controls drive."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.excitation.limits.limits import limits_of
from mjfim.experiment.system import System
from mjfim.model.coordinates import ScalarJoint
from mjfim.model.units import AFFINE, AT_JOINT, actuator_gear, is_integrated, servo_kind
from mjfim.output.archive import check_fits, reference_columns, simulate_playback
from mjfim.records.design import Design
from mjfim.records.trajectory import Playback

# What a control means; that of a servo is a position or a velocity.
Meaning = Literal["force", "position", "velocity", "other"]


@dataclass(frozen=True, kw_only=True)
class Drive:
    """One control, and what it drives.

    Attributes:
        name: Name of the control.
        meaning: What the control means.
        joint: The slide or hinge joint on which its actuator acts; None where it acts on something
            else, or on several joints.
        gear: Ratio of the actuator's coordinate to that of the joint.
        holds_position: Whether the actuator holds a position while the control stays.
        lower: Smallest control [unit of the actuator]; -inf without a limit.
        upper: Largest control [unit of the actuator]; inf without a limit.
    """

    name: str
    meaning: Meaning
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
        drives: The nu controls, in the order of the model.
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
        check_fits(file or Path("the design"), design.trajectory, system)
        playback = simulate_playback(system, design.trajectory, design.final.gain)
        return cls(
            name=Path(system.experiment.source).stem,
            system=system,
            playback=playback,
            reference=reference_columns(playback, system),
            drives=_drives(system),
        )

    @property
    def held_control(self) -> Array:
        """(M+1, nu) control of each row; the last row continues the last control."""
        ctrl = self.playback.ctrl
        return np.concatenate([ctrl, ctrl[-1:]])

    def columns(self, field: str, joints: list[str]) -> Array:
        """(M+1, n) columns of reference.csv of one field, such as `qpos`, for some joints."""
        rows = len(self.playback.t)
        return np.reshape([self.reference[f"{field}:{joint}"] for joint in joints], (-1, rows)).T


def _drives(system: System) -> tuple[Drive, ...]:
    """Find what the controls of an experiment drive, and their limits."""
    model = system.model
    limits = limits_of(model, system.controls, system.experiment.limits, system.dt)
    ranges = {each.name: (each.lower, each.upper) for each in limits if each.kind == "control"}
    joints = {joint.joint: joint for joint in system.coordinates}
    actuators = np.repeat(np.arange(model.nactuator), model.actuator_ctrlnum)

    drives = []
    for name, i in zip(system.controls, actuators.tolist(), strict=True):
        is_single = int(model.actuator_ctrlnum[i]) == 1
        at_joint = mujoco.mjtTrn(int(model.actuator_trntype[i])) in AT_JOINT
        lower, upper = ranges.get(name, (-np.inf, np.inf))
        drives.append(
            Drive(
                name=name,
                meaning=_meaning(model, i) if is_single else "other",
                joint=joints.get(int(model.actuator_trnid[i, 0]))
                if is_single and at_joint
                else None,
                gear=actuator_gear(model, i),
                holds_position=_holds_position(model, i),
                lower=float(lower),
                upper=float(upper),
            )
        )
    return tuple(drives)


def _holds_position(model: Any, actuator: int) -> bool:
    """Whether an actuator pulls its coordinate to a place that its control states."""
    is_affine = mujoco.mjtBias(int(model.actuator_biastype[actuator])) in AFFINE
    pulls = is_affine and float(model.actuator_biasprm[actuator, 1]) < 0.0
    return pulls and not is_integrated(model, actuator)


def _meaning(model: Any, actuator: int) -> Meaning:
    """Meaning of the control of an actuator that has one control."""
    has_fixed_gain = int(model.actuator_gaintype[actuator]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    has_gain = float(model.actuator_gainprm[actuator, 0]) != 0.0
    if not has_fixed_gain or not has_gain or is_integrated(model, actuator):
        return "other"
    if int(model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_NONE):
        return "force"

    # A servo with a constant force beside does not rest at its command.
    has_constant = float(model.actuator_biasprm[actuator, 0]) != 0.0
    return "other" if has_constant else servo_kind(model, actuator) or "other"

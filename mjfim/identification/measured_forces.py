"""Forces of actuators that are measured: outputs of sensors of actuators and of joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace

import mujoco
import numpy as np

from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.model.control_laws import ControlLaw
from mjfim.model.coordinates import actuator_names
from mjfim.model.elements import element_name
from mjfim.model.servos import acts_at_joint

# Sensors of forces of single actuators, and of all actuators on a joint.
ACTUATOR_FORCE = int(mujoco.mjtSensor.mjSENS_ACTUATORFRC)
JOINT_FORCE = int(mujoco.mjtSensor.mjSENS_JOINTACTFRC)

# Numbers of a control law that give it a memory, with their values without one.
WITHOUT_MEMORY = {"slew": np.inf, "time_constant": 0.0, "velocity_time_constant": 0.0}


@dataclass(frozen=True, kw_only=True)
class MeasuredForce:
    """A measured force of actuators.

    Attributes:
        output: Index of the output.
        actuator: Address of the force of a single actuator; -1 for the force on a joint.
        dof: Degree of freedom on which all actuators act together; -1 for a single actuator.
        name: Name of the actuator or joint.
        has_known_control: Whether the controls of its actuators follow from a recording. Those of a
            control law with a memory, or before the dynamics of an actuator, do not.
    """

    output: int
    actuator: int
    dof: int
    name: str
    has_known_control: bool = True

    @property
    def is_of_joint(self) -> bool:
        """True for the force of all actuators on a joint."""
        return self.dof >= 0

    def contains(self, model: mujoco.MjModel, actuator: int) -> bool:
        """Return whether it contains all of the force of an actuator.

        Args:
            model: The model.
            actuator: Index of the actuator.
        """
        if not self.is_of_joint:
            return self.actuator == int(model.actuator_outadr[actuator])
        if not acts_at_joint(model, actuator):
            return False
        return self.dof == int(model.jnt_dofadr[model.actuator_trnid[actuator, 0]])

    def may_contain(self, model: mujoco.MjModel, actuator: int) -> bool:
        """Return whether it may contain some of the force of an actuator, such as by a tendon.

        Args:
            model: The model.
            actuator: Index of the actuator.
        """
        by_other_means = self.is_of_joint and not acts_at_joint(model, actuator)
        return by_other_means or self.contains(model, actuator)


def measured_forces(
    system: System, recordings: Sequence[AlignedRecording]
) -> tuple[MeasuredForce, ...]:
    """Forces of actuators that are measured in a recording.

    Those on joints come last: they take precedence over those of the joint's actuators.

    Args:
        system: The system.
        recordings: Its recordings.
    """
    model = system.model
    known = np.any([recording.measured.any(axis=0) for recording in recordings], axis=0)
    by_address = {
        output.sensor: i
        for i, output in enumerate(system.outputs.outputs)
        if output.sensor is not None and known[i]
    }
    found = []
    for sensor in range(model.nsensor):
        output = by_address.get(int(model.sensor_adr[sensor]))
        kind, element = int(model.sensor_type[sensor]), int(model.sensor_objid[sensor])
        if output is None:
            continue
        if kind == JOINT_FORCE:
            dof = int(model.jnt_dofadr[element])
            name = element_name(model, "joint", element)
            found.append(MeasuredForce(output=output, actuator=-1, dof=dof, name=name))
        elif kind == ACTUATOR_FORCE:
            address = int(model.actuator_outadr[element])
            name = element_name(model, "actuator", element)
            found.append(MeasuredForce(output=output, actuator=address, dof=-1, name=name))
    hidden = [
        actuator
        for actuator, law in laws_of_actuators(system).items()
        if model.actuator_actnum[actuator] or _has_memory(system, law)
    ]
    return tuple(
        replace(force, has_known_control=not any(force.may_contain(model, i) for i in hidden))
        for force in sorted(found, key=lambda force: force.is_of_joint)
    )


def laws_of_actuators(system: System) -> dict[int, ControlLaw]:
    """Control laws by the index of the actuator whose control they compute.

    Args:
        system: The system.
    """
    laws = () if system.laws is None else system.laws.laws
    names = actuator_names(system.model)
    return {names.index(law.actuator): law for law in laws}


def _has_memory(system: System, law: ControlLaw) -> bool:
    """Whether a control depends on more than the reference and the state at one time."""
    if law.integrates or law.differences or law.reference_differences:
        return True
    numbers = law.numbers(system.model)
    unknown = {t.path for p in system.parameters.parameters for t in p.targets}
    return any(
        numbers[field] != without or f"controller/{law.actuator}:{field}" in unknown
        for field, without in WITHOUT_MEMORY.items()
    )

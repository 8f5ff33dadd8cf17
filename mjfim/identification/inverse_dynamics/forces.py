"""Forces of actuators that are measured, by sensors of actuators and of joints."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco

from mjfim.errors import ExperimentError
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.inverse_dynamics.motion import FEWEST_READINGS
from mjfim.model.coordinates import actuator_names
from mjfim.model.elements import element_name
from mjfim.model.units import acts_at_joint

# Sensors of forces of single actuators, and of all actuators on a joint.
ACTUATOR_FORCE = int(mujoco.mjtSensor.mjSENS_ACTUATORFRC)
JOINT_FORCE = int(mujoco.mjtSensor.mjSENS_JOINTACTFRC)


@dataclass(frozen=True, kw_only=True)
class MeasuredForce:
    """A measured force of actuators.

    Attributes:
        output: Index of the output.
        actuator: Address of the force of a single actuator; -1 for all on a joint.
        dof: Degree of freedom of the joint; -1 for a single actuator.
        name: Name of the actuator or joint.
        is_modelled: Whether the log shows the controls that the model needs for it.
    """

    output: int
    actuator: int
    dof: int
    name: str
    is_modelled: bool

    @property
    def is_of_joint(self) -> bool:
        """True for the force of all actuators on a joint."""
        return self.dof >= 0


def measured_forces(
    system: System, recordings: Sequence[AlignedRecording]
) -> tuple[MeasuredForce, ...]:
    """Forces of actuators that are measured in a recording, those of joints last.

    Raises:
        ExperimentError: The control of an actuator is computed by a control law, and a recording
            does not hold its force.
    """
    model = system.model
    names = actuator_names(model)
    laws = () if system.laws is None else system.laws.laws
    controlled = [names.index(law.actuator) for law in laws]
    by_address = {output.sensor: i for i, output in enumerate(system.outputs.outputs)}
    found = []
    for sensor in range(model.nsensor):
        output = by_address.get(int(model.sensor_adr[sensor]))
        kind, element = int(model.sensor_type[sensor]), int(model.sensor_objid[sensor])
        if output is None or kind not in (JOINT_FORCE, ACTUATOR_FORCE):
            continue
        if not any(recording.measured[:, output].any() for recording in recordings):
            continue
        of_joint = kind == JOINT_FORCE
        found.append(
            MeasuredForce(
                output=output,
                actuator=-1 if of_joint else int(model.actuator_outadr[element]),
                dof=int(model.jnt_dofadr[element]) if of_joint else -1,
                name=element_name(model, "joint" if of_joint else "actuator", element),
                is_modelled=not controlled if of_joint else element not in controlled,
            )
        )
    for law, actuator in zip(laws, controlled, strict=True):
        outputs = [force.output for force in found if _contains(model, force, actuator)]
        for recording in recordings:
            if recording.measured[:, outputs].sum() < FEWEST_READINGS:
                raise ExperimentError(
                    f"{system.experiment.source}: controllers.{law.actuator}: the equation of "
                    f"motion needs the control of {law.actuator}, which this law computes, or its "
                    f"measured force, which {recording.name} does not hold; add a sensor "
                    "`actuatorfrc` or `jointactuatorfrc` to the model and its column to the log, "
                    'or remove fit.start = "inverse_dynamics"'
                )
    return tuple(sorted(found, key=lambda force: force.is_of_joint))


def _contains(model: mujoco.MjModel, force: MeasuredForce, actuator: int) -> bool:
    """Whether a measured force contains all of the force of an actuator."""
    if not force.is_of_joint:
        return force.actuator == int(model.actuator_outadr[actuator])
    at_joint = acts_at_joint(model, actuator)
    return at_joint and force.dof == int(model.jnt_dofadr[model.actuator_trnid[actuator, 0]])

"""Controls of a model that recordings show, where control laws compute the others.

The equation of motion needs the force of every actuator. It follows from the control that a log
holds, or it was measured; of a control that a law computes, a log holds only the reference.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mjfim.errors import ExperimentError
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.measured_forces import MeasuredForce, actuators_of_laws
from mjfim.model.elements import element_name


def with_known_controls(system: System, recording: AlignedRecording) -> AlignedRecording:
    """A recording with the controls of the model in place of what control laws read.

    Args:
        system: The system.
        recording: Its recording.

    Returns:
        The recording, whose controls are zero where a law computes them.
    """
    if system.laws is None:
        return recording
    inputs, controls = system.laws.direct
    ctrl = np.zeros((len(recording.ctrl), system.model.nu))
    ctrl[:, controls] = recording.ctrl[:, inputs]
    return replace(recording, ctrl=ctrl)


def require_known_forces(
    system: System, recordings: Sequence[AlignedRecording], forces: Sequence[MeasuredForce]
) -> None:
    """Require the measured force of every actuator whose control a law computes.

    Args:
        system: The system.
        recordings: Its recordings.
        forces: Forces of actuators that are measured in a recording.

    Raises:
        ExperimentError: A recording holds no force of such an actuator.
    """
    for actuator in actuators_of_laws(system):
        outputs = [force.output for force in forces if force.contains(system.model, actuator)]
        name = element_name(system.model, "actuator", actuator)
        for recording in recordings:
            if not recording.measured[:, outputs].any():
                raise ExperimentError(
                    f"{system.experiment.source}: controllers.{name}: the equation of motion needs "
                    f"the control of {name}, which this law computes, or its measured force, which "
                    f"{recording.name} does not hold; add a sensor `actuatorfrc` to the model and "
                    'its column to the log, or remove fit.start = "inverse_dynamics"'
                )

"""Controls of a model along a measured motion, also those that control laws have computed.

The equation of motion needs the force of every actuator. It follows from the control that a log
holds, or it was measured; of a control that a law computes, a log holds only the reference. Such a
law is evaluated along the measured motion, without its memory, which is enough to start a fit: its
gains follow from the measured force. The force itself is never taken from a law.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.measured_forces import MeasuredForce, actuators_of_laws
from mjfim.identification.measured_motion import MeasuredMotion
from mjfim.model.control_laws import NUMBERS, ControlLaw, ControlLaws
from mjfim.model.elements import element_name
from mjfim.plant.law_commands import ON

# Numbers of a law that the equation of motion may determine; its times and limits keep their start.
GAINS = ("kp", "kd")


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


def held_controls(recording: AlignedRecording, laws: ControlLaws | None, nu: int) -> Array:
    """(N, nu) controls that a recording holds, zero where a law computes them.

    Args:
        recording: The recording.
        laws: The laws; None without any.
        nu: Number of controls.
    """
    if laws is None:
        return recording.ctrl
    inputs, controls = laws.direct
    found = np.zeros((len(recording.ctrl), nu))
    found[:, controls] = recording.ctrl[:, inputs]
    return found


def controls_along(
    motion: MeasuredMotion, model: Any, laws: ControlLaws | None, delay: float
) -> Array:
    """(n, nu) mean controls over the times of the points of a motion.

    Args:
        motion: The motion.
        model: A model with the numbers of the laws.
        laws: The laws; None without any.
        delay: Time by which the readings lag [s].
    """
    recorded = motion.control(delay)
    if laws is None:
        return recorded
    inputs, controls = laws.direct
    found = np.zeros((len(motion.t), model.nu))
    found[:, controls] = recorded[:, inputs]
    for law in laws.laws:
        found[:, law.control] = _control_of(law, motion, model, delay)
    return found


def _control_of(law: ControlLaw, motion: MeasuredMotion, model: Any, delay: float) -> Array:
    """(n,) control that a law computes from a log and a measured motion, without its memory."""
    values = model.numeric_data[law.first : law.first + len(NUMBERS)].tolist()
    numbers = dict(zip(NUMBERS, values, strict=True))
    commands = motion.control(delay + numbers["latency"])

    def column(quantity: Any, otherwise: float) -> Array:
        """(n,) column of the log, or a constant where the law reads none."""
        place = law.columns.get(quantity)
        return np.full(len(motion.t), otherwise) if place is None else commands[:, place]

    # The control is held until the next evaluation, so that the state is older by half a period.
    lag = numbers["feedback_latency"] + 0.5 * law.tick * float(model.opt.timestep)
    q, v = (
        np.interp(motion.t - lag, motion.t, values)
        for values in (motion.qpos[:, law.q], motion.qvel[:, law.v])
    )
    reference = column("reference", 0.0)
    wanted = column("reference_velocity", 0.0)
    if law.reference_differences:
        wanted = np.gradient(reference, motion.step)
    error = numbers["kp"] * (reference - q) + numbers["kd"] * (wanted - v)
    control = column("gain", 1.0) * error + column("feedforward", 0.0)
    control = np.clip(control, numbers["saturation_low"], numbers["saturation_high"])
    return np.where(column("enable", 1.0) < ON, 0.0, control)

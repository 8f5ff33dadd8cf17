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
from mjfim.identification.measured_forces import MeasuredForce, laws_of_actuators
from mjfim.identification.measured_motion import FEWEST_READINGS, MeasuredMotion
from mjfim.model.control_laws import ControlLaw, ControlLaws, Quantity
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
    for actuator, law in laws_of_actuators(system).items():
        outputs = [force.output for force in forces if force.contains(system.model, actuator)]
        for recording in recordings:
            if recording.measured[:, outputs].sum() < FEWEST_READINGS:
                raise ExperimentError(
                    f"{system.experiment.source}: controllers.{law.actuator}: the equation of "
                    f"motion needs the control of {law.actuator}, which this law computes, or its "
                    f"measured force, which {recording.name} does not hold; add a sensor "
                    "`actuatorfrc` or `jointactuatorfrc` to the model and its column to the log, "
                    'or remove fit.start = "inverse_dynamics"'
                )


def held_controls(recording: AlignedRecording, laws: ControlLaws | None, nu: int) -> Array:
    """(N, nu) controls that a recording holds, zero where a law computes them.

    Args:
        recording: The recording.
        laws: The laws; None without any.
        nu: Number of controls.
    """
    return recording.ctrl if laws is None else _stated(recording.ctrl, laws, nu)


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
    inputs = motion.control(delay)
    if laws is None:
        return inputs
    found = _stated(inputs, laws, model.nu)
    for law in laws.laws:
        found[:, law.control] = _control_of(law, motion, model, laws.held, delay)
    return found


def _stated(inputs: Array, laws: ControlLaws, nu: int) -> Array:
    """(n, nu) controls that are inputs themselves, zero for those of laws; inputs: (n, w)."""
    columns, controls = laws.direct
    found = np.zeros((len(inputs), nu))
    found[:, controls] = inputs[:, columns]
    return found


def _control_of(
    law: ControlLaw, motion: MeasuredMotion, model: Any, held: np.ndarray, delay: float
) -> Array:
    """(n,) control that a law computes from a log and a measured motion, without its memory."""
    numbers = law.numbers(model)

    # A control is held until the next evaluation, and is older on average.
    age = 0.5 * (law.tick - 1) * float(model.opt.timestep)

    def column(quantity: Quantity, otherwise: float, latency: float = 0.0) -> Array:
        """(n,) column of the log, or a constant where the law reads none."""
        place = law.columns.get(quantity)
        if place is None:
            return np.full(len(motion.t), otherwise)
        if held[place]:
            return motion.held(place, delay + latency)

        # Points of a continuous signal, at the begin of each sample.
        recording = motion.recording
        samples = recording.dt * np.arange(len(recording.ctrl))
        times = motion.t + motion.lag - delay - latency - age
        return np.interp(times, samples, recording.ctrl[:, place])

    past = motion.t - numbers["feedback_latency"] - age
    q, v = (
        np.interp(past, motion.t, state) for state in (motion.qpos[:, law.q], motion.qvel[:, law.v])
    )
    late = numbers["latency"]
    position = column("reference", 0.0, late) - q
    velocity = column("reference_velocity", 0.0, late) - v
    control = column("gain", 1.0) * (numbers["kp"] * position + numbers["kd"] * velocity)
    limit = numbers["integral_limit"]
    control += np.clip(numbers["integral"], -limit, limit) + column("feedforward", 0.0, late)
    control = np.clip(control, numbers["saturation_low"], numbers["saturation_high"])
    return np.where(column("enable", 1.0) < ON, 0.0, control)

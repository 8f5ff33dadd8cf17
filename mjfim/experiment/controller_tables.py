"""Table `[controllers]` of the experiment file: the laws with which drivers compute controls."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from mjfim.recordings.quantities import WithUnit
from mjfim.recordings.section import (
    Boolean,
    Bound,
    Finite,
    Hertz,
    NonNegative,
    Positive,
    Section,
)

# A time that may be zero.
Delay = Annotated[NonNegative, WithUnit("s")]


class ControllerSpec(Section):
    """Law with which the driver of an actuator computes its control from a log and from the joint.

    The law is evaluated at its own rate, and its control is held in between. The control is
    `kp (reference - position) + kd (reference velocity - velocity) + integral + feed-forward`,
    clipped to its range, in the unit of the actuator, which is called u here. Unknown numbers are
    parameters, with the target `controller/<actuator>:kp` for example.
    """

    kind: Literal["torque", "voltage", "current"] | None = Field(
        default=None,
        description=(
            "What the control is, for the units of the gains: a force or torque, a voltage or a "
            "current. The actuator of the MJCF turns it into a force. Default: what the actuator "
            "shows, else no unit."
        ),
    )
    joint: str | None = Field(
        default=None,
        description=(
            "Slide or hinge joint whose position the law controls. Default: the joint on which the "
            "actuator acts."
        ),
    )
    kp: NonNegative = Field(default=0.0, description="Gain of the position [u/rad or u/m].")
    kd: NonNegative = Field(default=0.0, description="Gain of the velocity [u s/rad or u s/m].")
    ki: NonNegative = Field(default=0.0, description="Gain of the integral [u/(rad s) or u/(m s)].")
    integral: Finite = Field(
        default=0.0,
        description=(
            "Integral at the begin of a recording [u]. Segments that begin later add the errors "
            "that the log shows since then."
        ),
    )
    integral_limit: Positive | None = Field(
        default=None, description="Largest magnitude of the integral [u]. Default: no limit."
    )
    reference_velocity: Literal["none", "column", "difference"] = Field(
        default="none",
        description=(
            "Velocity that the joint should have. none: 0, so that kd brakes. column: the column "
            "`reference_velocity:<actuator>` of the log. difference: the change of the reference "
            "from one evaluation to the next."
        ),
    )
    feedforward: Boolean = Field(
        default=False,
        description="true: the column `feedforward:<actuator>` of the log is added [u].",
    )
    gain: Boolean = Field(
        default=False,
        description=(
            "true: the column `gain:<actuator>` of the log multiplies kp, kd and ki, as where they "
            "differ between logs."
        ),
    )
    enable: Boolean = Field(
        default=False,
        description=(
            "true: the column `enable:<actuator>` of the log is 1 where the law is on. Where it is "
            "0, the control and the integral are 0."
        ),
    )
    rate: Hertz | None = Field(
        default=None,
        description=(
            "Rate at which the law is evaluated [Hz]; it divides the rate of the engine. Default: "
            "`rate` of the experiment."
        ),
    )
    interpolation: Literal["held", "linear"] = Field(
        default="held",
        description=(
            "What the log holds between two rows. held: the commands of the last row. linear: "
            "commands on a straight line to the next row."
        ),
    )
    saturation: tuple[Bound, Bound] | None = Field(
        default=None,
        description="Range of the control [u]. Default: the ctrlrange of the actuator.",
    )
    slew: Positive | None = Field(
        default=None, description="Largest change of the control per second [u/s]. Default: any."
    )
    latency: Delay = Field(
        default=0.0,
        description=(
            "Time from a row of the log to the effect of its reference, reference velocity and "
            "feed-forward [s]."
        ),
    )
    time_constant: Delay = Field(
        default=0.0,
        description=(
            "Time constant of the filter of first order through which the driver takes the "
            "reference and its velocity [s]."
        ),
    )
    feedback_latency: Delay = Field(
        default=0.0,
        description="Time from a measurement of the joint to the effect of the control [s].",
    )
    velocity: Literal["model", "difference"] = Field(
        default="model",
        description=(
            "Velocity of the joint that the law uses. model: its velocity. difference: the change "
            "of the position from one evaluation to the next."
        ),
    )
    velocity_time_constant: Delay = Field(
        default=0.0,
        description="Time constant of the filter of first order for the velocity [s].",
    )

    @model_validator(mode="after")
    def _consistent(self) -> ControllerSpec:
        """Refuse an inverted range, and a law that computes nothing."""
        if self.saturation is not None and not self.saturation[0] < self.saturation[1]:
            raise ValueError(f"saturation {list(self.saturation)} needs lower < upper")

        stated = {"kp", "kd", "ki", "feedforward"} & self.model_fields_set
        if not stated:
            raise ValueError(
                "the law computes nothing; state kp, kd, ki or feedforward = true, and a guess "
                "where a gain is unknown"
            )
        return self

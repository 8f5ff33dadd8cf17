"""Further results of an estimate: a fit to the equation of motion, and an unknown payload."""

from __future__ import annotations

from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.records.base import Record, ShownRecord, no_array, record
from mjfim.records.check import join_names


@record
class EquationFit(Record):
    """How well the fitted model explains one equation.

    Attributes:
        name: Degree of freedom, or `law of` an actuator whose force was measured.
        unit: Unit of its force, N or N m; may be empty.
        residual: Root mean square of the residuals [unit].
        size: Root mean square of the force of the actuators, or of that of the inertias where it is
            larger [unit].
        rows: Number of averages that were used.
        cutoff: Frequency up to which the equation was used, the inverse of the length of the
            windows [Hz].
        sigma: Standard deviation by which its residuals were divided; outliers hardly change it
            [unit].
        correlation: Integrated autocorrelation time of its residuals [rows].
        t: (n,) times of the averages of the recording that is drawn [s].
        measured: (n,) force of the actuators, measured or by the model from the control [unit].
        explained: (n,) force that the measured motion needs by the fitted model [unit].
    """

    name: str
    unit: str
    residual: float
    size: float
    rows: int
    cutoff: float
    sigma: float
    correlation: float
    t: Array
    measured: Array
    explained: Array

    in_json = (
        "name",
        "unit",
        "residual",
        "size",
        "share",
        "rows",
        "cutoff",
        "sigma",
        "correlation",
    )

    @property
    def share(self) -> float:
        """Residuals over the forces; NaN without any force."""
        return self.residual / self.size if self.size > 0.0 else float("nan")


@record
class InverseDynamicsFit(ShownRecord):
    """Result of `mjfim.inverse_dynamics`: parameters fitted to the equation of motion.

    Attributes:
        parameters: Names of the p parameters.
        units: Units of the parameters.
        theta: (p,) estimate; parameters that the equation does not contain keep their start
            [theta-unit].
        std: (p,) standard deviations [theta-unit]. They allow for the autocorrelation of the
            residuals, but are formal: they do not contain the bias by noise in the velocities and
            accelerations or by a wrong model. Infinite for parameters that only priors hold.
        covariance: (p, p) covariance with all priors.
        start: (p,) parameters at which the fit began [theta-unit].
        equations: The equations of the degrees of freedom, and the laws of actuators.
        determined: Number of combinations of parameters that the recordings determine.
        undetermined: Names of the parameters that the recordings do not determine alone.
        absent: Names of the parameters that the equation of motion does not contain.
        condition: Condition number of the determined part of the regressor with columns of unit
            length.
        iterations: Number of linearisations.
        success: True where the last step changed nothing.
        status: How the fit ended, in words.
        recording: Name of the recording that is drawn.
        seconds: Wall time [s].
        steps: MuJoCo steps taken.
    """

    parameters: tuple[str, ...]
    units: tuple[str, ...]
    theta: Array
    std: Array
    covariance: Array
    start: Array
    equations: tuple[EquationFit, ...]
    determined: int
    undetermined: tuple[str, ...] = ()
    absent: tuple[str, ...] = ()
    condition: float = 1.0
    iterations: int = 0
    success: bool = True
    status: str = ""
    recording: str = ""
    seconds: float = 0.0
    steps: int = 0
    sizes: Array = no_array()

    file_stem = "inverse_dynamics"
    made_by = "`InverseDynamicsFit.save`"
    in_json = (
        "parameters",
        "units",
        "theta",
        "std",
        "covariance",
        "start",
        "equations",
        "determined",
        "undetermined",
        "absent",
        "condition",
        "iterations",
        "success",
        "status",
        "recording",
        "seconds",
        "steps",
    )

    @property
    def degrees_of_freedom(self) -> tuple[EquationFit, ...]:
        """Equations of the degrees of freedom, without the laws of actuators."""
        return tuple(each for each in self.equations if not each.name.startswith("law of "))


# Axes of the frame of a body.
AXES = ("x", "y", "z")


# Largest number of decimal places that are shown; smaller numbers have an exponent.
MOST_PLACES = 5


@record
class PayloadEstimate(Record):
    """Mass, centre of mass and rotational inertia of a payload. Intervals are those of 95 %.

    Attributes:
        body: Name of the body that carries it.
        mass: Its mass [kg].
        mass_interval: (2,) interval of the mass [kg].
        centre: (3,) centre of mass in the frame of the body [m].
        centre_interval: (3, 2) its intervals [m].
        undetermined: Axes along which the recordings do not determine the centre of mass.
        inertia: Rotational inertia about its centre of mass, equal about all axes [kg m²].
        inertia_interval: (2,) its interval [kg m²].
        edge: Edge of the uniform cube whose inertia is assumed, because the recordings do not
            determine it [m]; None where they do.
        known: Parameters of the robot whose earlier estimate, with its uncertainty, is prior
            knowledge.
        held: Parameters of the robot that are held, so that their errors are in no interval.
        source: Words for where the earlier estimate is from; empty without one.
    """

    body: str
    mass: float
    mass_interval: Array
    centre: Array
    centre_interval: Array
    undetermined: tuple[str, ...]
    inertia: float
    inertia_interval: Array
    edge: float | None
    known: tuple[str, ...] = ()
    held: tuple[str, ...] = ()
    source: str = ""

    in_json = (
        "body",
        "is_seen",
        "mass",
        "mass_interval",
        "centre",
        "centre_interval",
        "undetermined",
        "inertia",
        "inertia_interval",
        "edge",
        "known",
        "held",
        "source",
    )

    @property
    def is_seen(self) -> bool:
        """Whether the recordings show that there is a payload."""
        return bool(np.isfinite(self.mass_interval).all() and self.mass_interval[0] > 0.0)

    def __str__(self) -> str:
        """The payload in one sentence."""
        if not self.is_seen:
            limit = f"{float(self.mass_interval[1]):.3g} kg"
            return f"The recordings show no payload at {self.body} (its mass is below {limit})"

        mass = _with_half_width(self.mass, self.mass_interval)
        places = [
            f"{axis} not determined"
            if axis in self.undetermined
            else f"{axis} = {_with_half_width(value, interval)} m"
            for axis, value, interval in zip(AXES, self.centre, self.centre_interval, strict=True)
        ]
        return (
            f"The payload at {self.body} has a mass of {mass} kg and its centre of mass at "
            f"{', '.join(places)} in the frame of {self.body}"
        )

    @property
    def sentences(self) -> tuple[str, ...]:
        """Sentences about the inertia, and about what is taken as known."""
        found = []
        if self.is_seen and self.edge is None:
            inertia = _with_half_width(self.inertia, self.inertia_interval)
            found.append(
                "The recordings determine the rotational inertia about the centre of mass, taken "
                f"as equal about all axes: {inertia} kg m²."
            )
        elif self.is_seen:
            found.append(
                "The recordings do not determine the rotational inertia. Assumed is that of a "
                f"uniform cube with an edge of {self.edge:.2g} m, give or take as much, about a "
                f"fitted value of {self.inertia:.2g} kg m²; --size states the edge."
            )
        if self.known:
            found.append(
                f"The robot's {join_names(list(self.known))} are known from {self.source}; the "
                "intervals of the payload contain their uncertainty."
            )
        if self.held:
            verb = "is" if len(self.held) == 1 else "are"
            found.append(
                f"The robot's {join_names(list(self.held))} {verb} held, so that the intervals of "
                "the payload do not contain their errors; --from or --without give their "
                "uncertainty."
            )
        return tuple(found)

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        return {
            **super().summary(),
            "words": f"{self}.",
            "inertia_is_assumed": self.edge is not None,
        }


def _with_half_width(value: float, interval: Array) -> str:
    """A value with the longer half of its interval, both to the digits of the latter."""
    half_width = np.max(np.abs(interval - value))
    if not np.isfinite(half_width) or half_width <= 0.0:
        return f"{value:.4g}"

    # Two digits of the half width, and the value to the same place.
    places = 1 - int(np.floor(np.log10(half_width)))
    if 0 <= places <= MOST_PLACES:
        return f"{value:.{places}f} ± {half_width:.{places}f}"
    return f"{value:.3g} ± {half_width:.2g}"

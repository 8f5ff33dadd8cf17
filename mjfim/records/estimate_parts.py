"""Further results of an estimate: a fit to the equation of motion, and an unknown payload."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from mjfim.arrays import Array, record
from mjfim.records.base import ParameterResult, ParameterValue, Record, listed_values, no_array
from mjfim.records.check import join_names


@record
class EquationFit(Record):
    """Agreement of the fitted model with one equation.

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
        force: Root mean square of the force of the actuators [unit].
    """

    name: str
    unit: str
    residual: float
    size: float
    rows: int
    cutoff: float
    sigma: float
    correlation: float
    force: float

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


# Share of the points that count as slow.
SLOW_SHARE = 0.25

# Largest number of medians of one direction of motion, and fewest of a line.
MOST_MEDIANS, FEWEST_OF_LINE = 25, 3


@record
class ResidualForce(Record):
    """Force of a joint along measured motions that the model does not explain, at n points.

    It is the force of the actuators, measured or by the model from the control, less the one that
    the measured motion needs. Dry friction that the model lacks is a step at speed zero.

    Attributes:
        joint: Name of the joint.
        unit: Unit of its force, N or N m.
        position: (n,) positions [m or rad].
        speed: (n,) velocities [m/s or rad/s].
        force: (n,) residual forces [unit].
        sigma: Standard deviation of the residual forces by noise of the measurements [unit].
        size: Root mean square of the force of the actuators [unit].
    """

    joint: str
    unit: str
    position: Array
    speed: Array
    force: Array
    sigma: float
    size: float

    in_json = ("joint", "unit", "rms", "friction", "sigma", "size")

    @property
    def rms(self) -> float:
        """Root mean square of the residual forces [unit]."""
        return float(np.sqrt(np.mean(self.force**2)))

    @property
    def share(self) -> float:
        """Residual forces over the forces of the actuators; infinite without any force."""
        return self.rms / self.size if self.size > 0.0 else float("inf")

    @property
    def noise_ratio(self) -> float:
        """Root mean square over the standard deviation by noise; infinite without noise."""
        return self.rms / self.sigma if self.sigma > 0.0 else float("inf")

    @property
    def friction(self) -> tuple[float, float]:
        """Friction that the model lacks, or has too much of, by the medians over the speed.

        The slowest points are left out: noise hides their direction.

        Returns:
            Half of the step between the directions [unit], and the slope [unit per m/s or rad/s];
            NaN where too few points move in both directions.
        """
        slow = np.quantile(np.abs(self.speed), SLOW_SHARE)
        both = [self.medians(self.speed, sign * self.speed > slow) for sign in (1.0, -1.0)]
        if min(len(speed) for speed, _ in both) < FEWEST_OF_LINE:
            return float("nan"), float("nan")
        speed, force = np.concatenate(both, axis=1)
        columns = np.column_stack([np.ones(len(speed)), np.sign(speed), speed])
        _, step, slope = np.linalg.lstsq(columns, force, rcond=None)[0].tolist()
        return step, slope

    def medians(self, along: Array, is_counted: np.ndarray) -> tuple[Array, Array]:
        """Medians of the residual forces in intervals with equally many points.

        There are about as many intervals as points in each of them.

        Args:
            along: (n,) quantity along which the points are ordered, such as `speed`.
            is_counted: (n,) True for the points that count, such as those of one direction.

        Returns:
            (k,) medians of the quantity, and (k,) those of the residual forces [unit].
        """
        points = np.flatnonzero(is_counted)
        points = points[np.argsort(along[points], kind="stable")]
        count = min(int(np.sqrt(len(points))), MOST_MEDIANS)
        parts = np.array_split(points, count) if count else []
        return (
            np.array([np.median(along[part]) for part in parts]),
            np.array([np.median(self.force[part]) for part in parts]),
        )


@record
class InverseDynamicsFit(ParameterResult):
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
        converged: True where the last step changed nothing.
        status: How the fit ended, in words.
        residual_forces: What the fitted model does not explain at each joint; none for a fit that
            was the start of another one.
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
    converged: bool = True
    status: str = ""
    residual_forces: tuple[ResidualForce, ...] = ()
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
        "converged",
        "status",
        "residual_forces",
        "seconds",
        "steps",
    )
    json_names = {"converged": "success"}

    def each(self) -> Iterator[ParameterValue]:
        """Estimates with the formal σ, and the values at which the fit began."""
        return listed_values(self.parameters, self.units, self.theta, self.std, start=self.start)

    @property
    def degrees_of_freedom(self) -> tuple[EquationFit, ...]:
        """Equations of the degrees of freedom, without the laws of actuators."""
        return tuple(each for each in self.equations if not each.name.startswith("law of "))


# Share of the information of the recordings that counts as most of it.
MOST = 0.9


@record
class InformationInTime(Record):
    """The seconds of the recordings that decide each of q parameters, by B blocks of rows.

    Information about a parameter counts with all other unknowns unknown. That of all blocks and of
    the priors adds to 1/σ².

    Attributes:
        parameters: Names of the q parameters.
        recording: (B,) index of the recording of each block.
        times: (B, 2) begin and end of each block [s].
        shares: (B, q) share of each block in 1/σ², from 0 to 1.
        pulls: (B, q) distance by which the residuals of each block draw the estimate [σ].
        scatter: Size of the residuals over that of the noise, at least 1.
    """

    parameters: tuple[str, ...]
    recording: Array
    times: Array
    shares: Array
    pulls: Array
    scatter: float

    in_json = ("parameters", "prior", "seconds_of_most")

    @property
    def prior(self) -> Array:
        """(q,) share of the priors in 1/σ², from 0 to 1."""
        return np.asarray(np.clip(1.0 - self.shares.sum(axis=0), 0.0, 1.0))

    @property
    def seconds_of_most(self) -> Array:
        """(q,) shortest time that holds 90 % of the information of the recordings [s]."""
        duration = np.diff(self.times, axis=1)
        order = np.argsort(-self.shares / duration, axis=0, kind="stable")
        gathered = np.cumsum(np.take_along_axis(self.shares, order, axis=0), axis=0)
        time = np.cumsum(duration[order, 0], axis=0)
        return np.array(
            [
                np.interp(MOST * sum_[-1], sum_, t)
                for sum_, t in zip(gathered.T, time.T, strict=True)
            ]
        )

    def on_grid(self, recording: int, edges: Array) -> tuple[Array, Array]:
        """Shares and pulls in intervals of a recording; what a block holds is spread evenly in it.

        Args:
            recording: Index of the recording.
            edges: (m+1,) ascending ends of the intervals [s].

        Returns:
            (m, q) shares, from 0 to 1, and (m, q) pulls [σ].
        """
        own = self.recording == recording
        found = np.zeros((2, len(edges) - 1, len(self.parameters)))
        for (begin, end), *of_block in zip(
            self.times[own], self.shares[own], self.pulls[own], strict=True
        ):
            part = np.diff(np.clip(edges, begin, end)) / (end - begin)
            found += part[:, None] * np.array(of_block)[:, None]
        return found[0], found[1]


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

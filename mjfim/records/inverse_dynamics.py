"""Record of a fit to the equation of motion (inverse dynamics)."""

from __future__ import annotations

from mjfim.arrays import Array
from mjfim.records.base import Record, ShownRecord, no_array, record


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

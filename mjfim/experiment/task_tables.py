"""Tables of the experiment file about the task: how an experiment is designed, and how parameters are fitted."""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from mjfim.recordings.spec import Finite, Positive, Range, Section

NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]


class Cost(Section):
    """The cost that a design minimises: the criterion of the information, and weights on control and deviation (eq. 3)."""

    criterion: Literal["E", "A", "D", "c"] = Field(
        default="E",
        description=(
            "E: largest variance of any combination of parameters. A: sum of the variances. D: "
            "volume of the confidence ellipsoid. c: variance of a stated combination or subset."
        ),
    )
    combination: dict[str, Finite] | None = Field(
        default=None,
        description=(
            "For criterion c: coefficients by parameter name; the variance of this sum is "
            "minimised."
        ),
    )
    subset: tuple[str, ...] | None = Field(
        default=None,
        description=(
            "For criterion c: names of the parameters whose variances, in units of their scales, "
            "are summed."
        ),
    )
    information: Positive = Field(
        default=1.0, description="Weight of the criterion, Q_p of the paper."
    )
    control: NonNegative | dict[str, NonNegative] = Field(
        default=1e-3,
        description=(
            "Weight of the squared control, R_tau of the paper, one number or a table by actuator "
            "name. 0 is allowed where a hard limit bounds the control."
        ),
    )
    control_about: Finite | dict[str, Finite] | None = Field(
        default=None,
        description=(
            "Control that costs nothing [actuator unit], one number or a table by actuator name. "
            "Default: the control of the initial keyframe, 0 without a keyframe."
        ),
    )
    tracking: dict[str, NonNegative] = Field(
        default_factory=dict,
        description=(
            "Weight of the squared deviation of a position [m or rad] from the initial "
            "trajectory, by joint name, Q_tau of the paper. Default: 0."
        ),
    )
    tracking_velocity: dict[str, NonNegative] = Field(
        default_factory=dict,
        description=(
            "Weight of the squared deviation of a velocity [m/s or rad/s] from the initial "
            "trajectory, by joint name. Default: 0."
        ),
    )
    linearize_at: Literal["guess", "true"] = Field(
        default="guess",
        description=(
            "Parameter values at which the design is made. `true` is for studies on simulated "
            "robots."
        ),
    )

    @model_validator(mode="after")
    def _contrast(self) -> Cost:
        given = (self.combination is not None) + (self.subset is not None)

        if given != (self.criterion == "c"):
            raise ValueError(
                'criterion = "c" takes exactly one of combination and subset, no other criterion takes one'
            )
        if self.combination is not None and not any(self.combination.values()):
            raise ValueError("combination has no coefficient other than 0")

        return self


class Robust(Section):
    """Design for a guess that is wrong: the criterion is pooled over samples of the parameters.

    Samples come from the priors (normal distribution), else from the bounds (uniform distribution).
    """

    over: Literal["mean", "worst"] = Field(
        default="mean", description="Pool by the mean of the criterion or by its worst value."
    )
    samples: int = Field(
        default=6, ge=2, description="Number of parameter samples, the guess included."
    )
    seed: int = Field(default=0, ge=0, description="Seed of the samples.")


class Descent(Section):
    """Method, tolerance and initial controls with which the cost is minimised."""

    method: Literal["lbfgs", "metric"] = Field(
        default="lbfgs",
        description=(
            "Direction of descent: limited-memory BFGS on the trajectory manifold, or the paper's "
            "metric descent."
        ),
    )
    tolerance: Positive = Field(
        default=1e-7,
        description="The descent has converged where its slope is at most this number times the cost.",
    )
    max_iterations: int = Field(
        default=200, ge=0, description="Largest number of iterations from one initial control."
    )
    seconds: Positive | None = Field(
        default=None,
        description="Time after which the best design found is returned [s]. Default: no limit.",
    )
    psi_weight: NonNegative = Field(
        default=0.0,
        description='Weight of the sensitivities in the metric; only with `method = "metric"`.',
    )
    starts: int = Field(
        default=1,
        ge=1,
        description=(
            "Number of initial controls: the stated one, then random multisines. The best result "
            "is kept."
        ),
    )
    previous: tuple[str, ...] = Field(
        default=(),
        description=(
            "Files design.csv of earlier designs that are initial controls as well, repeated "
            "where they are shorter."
        ),
    )
    fourier: tuple[Positive, ...] = Field(
        default=(),
        description=(
            "Base frequencies [Hz] of Fourier series that are initial controls as well; each is "
            "optimised first."
        ),
    )
    repeats: tuple[Annotated[int, Field(ge=2)], ...] = Field(
        default=(),
        description=(
            "Under hard limits: initial controls that are designs of the horizon divided by this "
            "number, played as many times. Quick for long horizons."
        ),
    )
    coarse: Annotated[int, Field(ge=1)] | Literal["auto"] = Field(
        default="auto",
        description=(
            "Factor by which the time step is longer in the first iterations, where they are "
            "cheap. 1: never. auto: the largest factor that the model tolerates."
        ),
    )
    seed: int = Field(default=0, ge=0, description="Seed of the random initial controls.")

    @model_validator(mode="after")
    def _metric(self) -> Descent:
        if self.psi_weight and self.method != "metric":
            raise ValueError('psi_weight belongs to method = "metric"')
        return self


class Limits(Section):
    """Hard limits, which a design keeps at every engine step.

    The ranges of the MJCF (joint range, ctrlrange, forcerange) always belong to them; where the
    file states a limit too, both hold. A number means the range from minus this number to this
    number, for all names where no table is given.
    """

    position: dict[str, Range] = Field(
        default_factory=dict, description="Range of a joint position by joint name [m or rad]."
    )
    velocity: Positive | dict[str, Positive | Range] = Field(
        default_factory=dict, description="Limit of the joint velocities [m/s or rad/s]."
    )
    acceleration: Positive | dict[str, Positive | Range] = Field(
        default_factory=dict, description="Limit of the joint accelerations [m/s² or rad/s²]."
    )
    control: dict[str, Range] = Field(
        default_factory=dict, description="Range of a control by actuator name [actuator unit]."
    )
    control_rate: Positive | dict[str, Positive | Range] = Field(
        default_factory=dict,
        description="Limit of the change of the controls [actuator unit per s].",
    )
    force: Positive | dict[str, Positive | Range] = Field(
        default_factory=dict, description="Limit of the actuator forces [N or N m]."
    )
    clearance: Positive | None = Field(
        default=None,
        description=(
            "Least distance of the robot to itself and to its surroundings [m], by MuJoCo's geom "
            "distances. Default: distances are not limited."
        ),
    )
    ignored: tuple[tuple[str, str], ...] = Field(
        default=(), description="Pairs of bodies that may come closer than `clearance`."
    )
    bandwidth: Positive | None = Field(
        default=None,
        description=(
            "Bandwidth of the control [Hz]: it becomes a cubic spline with a knot every 1 / (2 "
            "bandwidth) s. Default: the control is free at every sample."
        ),
    )
    enforce: bool = Field(
        default=True, description="false: limits do not bind the design, they are only reported."
    )


class Boundary(Section):
    """State in which a design begins and ends."""

    start: Literal["given", "rest"] = Field(
        default="given",
        description=(
            "rest: the control begins at the value that holds the initial state, without a jump. "
            "given: it may begin anywhere."
        ),
    )
    end: Literal["free", "rest", "periodic"] = Field(
        default="free",
        description=(
            "rest: the design ends at a standstill. periodic: it ends in the initial state, ready "
            "to be repeated. free: it may end anywhere."
        ),
    )
    keyframe: str | None = Field(
        default=None,
        description='Keyframe in which a design with `end = "rest"` comes to rest. Default: the initial state.',
    )
    position: Positive = Field(
        default=1e-2, description="Largest deviation of the final positions [m or rad]."
    )
    velocity: Positive = Field(
        default=2e-2, description="Largest deviation of the final velocities [m/s or rad/s]."
    )

    @model_validator(mode="after")
    def _somewhere(self) -> Boundary:
        if self.keyframe is not None and self.end != "rest":
            raise ValueError(
                'keyframe needs end = "rest"; it is the state in which such a design ends'
            )
        return self


class FitSpec(Section):
    """Segments, loss, noise and initial guesses with which parameters are fitted to recordings."""

    segments: Positive | None = Field(
        default=None,
        description=(
            "Recordings are cut into segments of this length [s], each with an unknown initial "
            "state (multiple shooting). Default: one segment per recording."
        ),
    )
    start: Literal["stated", "measured"] = Field(
        default="stated",
        description=(
            "Initial state of a recording. stated: as `initial` says, with the deviations of "
            "`nuisance.initial`. measured: read from the log, then free."
        ),
    )
    loss: Literal["linear", "huber", "soft_l1", "cauchy"] = Field(
        default="linear",
        description=(
            "Loss of a whitened residual, as in scipy.optimize.least_squares; all but linear "
            "tolerate outliers."
        ),
    )
    loss_scale: Positive = Field(
        default=3.0,
        description="Size from which a robust loss treats a residual as an outlier [sigma].",
    )
    noise: Literal["stated", "estimated"] = Field(
        default="stated",
        description=(
            "stated: standard deviations of the `noise` table. estimated: they are estimated from "
            "the residuals by iterated reweighting."
        ),
    )
    starts: int = Field(
        default=1,
        ge=1,
        description=(
            "Number of initial guesses: the stated one, then random ones within bounds and "
            "priors. The best fit is kept."
        ),
    )
    seed: int = Field(
        default=0, ge=0, description="Seed of the random initial guesses and of the bootstrap."
    )
    max_iterations: int = Field(
        default=60, ge=1, description="Largest number of iterations of the search."
    )
    blocks: Positive | None = Field(
        default=None,
        description=(
            "Length of the blocks of the bootstrap and the sandwich covariance [s]; residuals "
            "further apart count as independent. Default: from the autocorrelation of the "
            "residuals."
        ),
    )
    bootstrap: int = Field(
        default=1000, ge=0, description="Number of bootstrap replicates. 0: no bootstrap."
    )

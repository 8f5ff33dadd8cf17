"""Tables of the experiment file about the task.

They state how an experiment is designed and how parameters are fitted.
"""

from __future__ import annotations

from typing import Annotated, Literal

from pydantic import Field, model_validator

from mjfim.errors import (
    MAX_ITERATIONS,
    MAX_REPLICATES,
    MAX_ROBOTS,
    MAX_SAMPLES,
    MAX_STARTS,
    MAX_WRONG,
)
from mjfim.experiment.system_tables import NumberOrTable
from mjfim.recordings.section import (
    Boolean,
    Finite,
    FiniteWithUnit,
    Height,
    Hertz,
    Integer,
    Metres,
    NonNegative,
    Positive,
    PositiveWithUnit,
    RangeWithUnit,
    Seconds,
    Section,
)

# A part of something, below the whole.
Share = Annotated[Finite, Field(ge=0, lt=1)]

# Kinds of limits. They stand in `model.limited_elements`, too, which imports MuJoCo: a wrong key is
# said before that.
LimitKind = Literal[
    "position",
    "tilt",
    "velocity",
    "angular_velocity",
    "acceleration",
    "control",
    "control_rate",
    "force",
    "joint_force",
    "tendon_force",
    "tendon_length",
    "clearance",
]

# One size for all names, or a size or range by name.
SizeOrRanges = PositiveWithUnit | dict[str, PositiveWithUnit | RangeWithUnit]

# Ranges of the three coordinates of a place.
Box = tuple[RangeWithUnit, RangeWithUnit, RangeWithUnit]


class Cost(Section):
    """The cost that a design minimises (eq. 3).

    It is the criterion of the information plus weighted squares of the control and of the
    deviation from the initial trajectory.
    """

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
    control_about: NumberOrTable | None = Field(
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
            "Parameter values for which the design is made. `true` is for studies on simulated "
            "robots."
        ),
    )

    @model_validator(mode="after")
    def _combination_or_subset(self) -> Cost:
        """Refuse a combination or subset that does not fit the criterion."""
        given = (self.combination is not None) + (self.subset is not None)

        if given != (self.criterion == "c"):
            raise ValueError(
                'criterion = "c" needs exactly one of combination and subset; other criteria allow '
                "neither"
            )
        if self.combination is not None and not any(self.combination.values()):
            raise ValueError("combination has no coefficient other than 0")

        return self


class Robust(Section):
    """Design that allows for an inaccurate guess.

    The criterion is evaluated at samples of the parameters and pooled. Samples are drawn from the
    priors (normal distribution), or without a prior from the bounds (uniform distribution).
    """

    over: Literal["mean", "worst"] = Field(
        default="mean",
        description="mean: the mean of the criterion over the samples. worst: its worst value.",
    )
    samples: Integer = Field(
        default=6,
        ge=2,
        le=MAX_SAMPLES,
        description="Number of parameter samples, including the guess.",
    )
    seed: Integer = Field(default=0, ge=0, description="Seed of the samples.")


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
        description=(
            "The descent has converged when its slope is at most this number times the cost."
        ),
    )
    max_iterations: Integer = Field(
        default=200,
        ge=0,
        le=MAX_ITERATIONS,
        description="Largest number of iterations from one initial control.",
    )
    seconds: Seconds | None = Field(
        default=None,
        description=(
            "Time after which the best design found is returned [s]. Default: 120 s for the "
            "command `mjfim design`; no limit in Python and for the other verbs."
        ),
    )
    psi_weight: NonNegative = Field(
        default=0.0,
        description=(
            'Weight of the sensitivities in the metric. It applies to `method = "metric"` only.'
        ),
    )
    starts: Integer = Field(
        default=1,
        ge=1,
        le=MAX_STARTS,
        description=(
            "Number of initial controls: the stated one, and random multisines for the others. The "
            "best result is kept."
        ),
    )
    previous: tuple[str, ...] = Field(
        default=(),
        description=(
            "Files design.csv of earlier designs that serve as further initial controls. A shorter "
            "design is repeated."
        ),
    )
    fourier: tuple[Hertz, ...] = Field(
        default=(),
        description=(
            "Base frequencies [Hz] of Fourier series that serve as further initial controls. The "
            "coefficients of each series are optimised first."
        ),
    )
    repeats: tuple[Annotated[Integer, Field(ge=2)], ...] = Field(
        default=(),
        description=(
            "Further initial controls under hard limits: for each number n, a design for the n-th "
            "part of the horizon, repeated n times. This is quick for long horizons."
        ),
    )
    coarse: Annotated[Integer, Field(ge=1)] | Literal["auto"] = Field(
        default="auto",
        description=(
            "Factor by which the time step is longer in the first iterations, which makes them "
            "cheap. 1: the time step is never longer. auto: a factor that hardly changes the cost "
            "of the initial control."
        ),
    )
    seed: Integer = Field(default=0, ge=0, description="Seed of the random initial controls.")

    @model_validator(mode="after")
    def _method_with_metric(self) -> Descent:
        """Refuse a weight of the metric for a method that has none."""
        if self.psi_weight and self.method != "metric":
            raise ValueError('psi_weight can only be given together with method = "metric"')
        return self


class Limits(Section):
    """Hard limits, which a design respects at every engine step.

    The ranges of the MJCF (joint range, ctrlrange, forcerange, actuatorfrcrange, ranges of tendons)
    are always part of them; if the file states a limit too, both hold. A number means the range
    from minus this number to this number, or the largest size of a vector or of an angle. A number
    instead of a table holds for all names.
    """

    position: dict[str, RangeWithUnit | Box] = Field(
        default_factory=dict,
        description=(
            "Range of a joint position by joint name [m or rad]. A free joint has three ranges, "
            "`[[lower, upper], [lower, upper], [lower, upper]]` of x, y and z, or one range by "
            'coordinate, `"base.z" = [0.2, 2.0]`. For a ball joint it is the angle of its '
            "rotation from the reference position, `[0, upper]`."
        ),
        examples=[{"hinge": [-1.0, 1.0]}],
    )
    tilt: SizeOrRanges = Field(
        default_factory=dict,
        description=(
            "Largest tilt of the free and ball joints [rad]: the angle between the upward "
            "direction (against gravity) and the direction in the body that is upward in the "
            "reference position `qpos0` of the model. For a ball joint it is measured in its "
            "parent. A rotation about the upward direction is free."
        ),
    )
    velocity: SizeOrRanges = Field(
        default_factory=dict,
        description=(
            "Limit of the joint velocities [m/s or rad/s]. For a free joint it is the linear "
            "speed of its body, for a ball joint the angular speed. The velocity along one axis "
            'of the world has the name of the coordinate, `"base.z" = [-0.5, 1.0]`.'
        ),
    )
    angular_velocity: SizeOrRanges = Field(
        default_factory=dict,
        description=(
            "Largest angular speed of the free and ball joints [rad/s]. The angular velocity "
            'about one axis of the body has the name of the coordinate, `"base.rz" = 1.0`.'
        ),
    )
    acceleration: SizeOrRanges = Field(
        default_factory=dict,
        description=(
            "Limit of the joint accelerations [m/s² or rad/s²]: the change of the velocity over "
            "each engine step, divided by the timestep. For free and ball joints it is the size of "
            "the change of the vector, as for `velocity`."
        ),
    )
    control: dict[str, RangeWithUnit] = Field(
        default_factory=dict,
        description="Range of a control by actuator name [actuator unit].",
        examples=[{"motor": [-5.0, 5.0]}],
    )
    control_rate: SizeOrRanges = Field(
        default_factory=dict,
        description=(
            "Limit of the change of the controls from one row of design.csv to the next, over the "
            "period of the rows [actuator unit per s]. Each sample is held, so a `playback_rate` "
            "of k times `rate` divides the allowed change from sample to sample by k."
        ),
    )
    force: SizeOrRanges = Field(
        default_factory=dict,
        description=(
            "Limit of the actuator forces [N or N m], at the beginning and at the end of each "
            "engine step, as MuJoCo's force sensors read them. For an actuator with several forces "
            "it is their norm; one of them has the name `actuator[i]`."
        ),
    )
    joint_force: SizeOrRanges = Field(
        default_factory=dict,
        description=(
            "Limit of the sum of all actuator forces on a joint [N or N m], as the MJCF's "
            "actuatorfrcrange of joints."
        ),
    )
    tendon_force: SizeOrRanges = Field(
        default_factory=dict,
        description=(
            "Limit of the sum of all actuator forces on a tendon [N or N m], as the MJCF's "
            "actuatorfrcrange of tendons."
        ),
    )
    tendon_length: dict[str, RangeWithUnit] = Field(
        default_factory=dict,
        description="Range of the length of a tendon by tendon name [m or rad].",
    )
    clearance: Metres | None = Field(
        default=None,
        description=(
            "Smallest allowed distance of the robot to itself and to its surroundings [m], "
            "measured by MuJoCo's geom distances. Default: distances are not limited."
        ),
    )
    floor: Height | None = Field(
        default=None,
        description=(
            "Height of a plane from which every geom of the robot keeps `clearance` [m], also "
            "those that do not collide: a floor or a table that the MJCF does not have."
        ),
    )
    ignored: tuple[tuple[str, str], ...] = Field(
        default=(), description="Pairs of bodies that may come closer than `clearance`."
    )
    reserve: Literal["auto"] | dict[LimitKind, Share] = Field(
        default_factory=dict,
        description=(
            "Distance that a design keeps from the limits of a kind, over half of each range, by "
            "the name of the kind; for `clearance`, over the smallest distance. Robots that differ "
            "from the model may use it. The initial and the final state always keep half of their "
            'own distance. "auto": as much as the robots of the rehearsal need. Default: none.'
        ),
        examples=["auto", {"position": 0.3}],
    )
    bandwidth: Hertz | None = Field(
        default=None,
        description=(
            "Bandwidth of the control [Hz]: it becomes a cubic spline with a knot every 1 / (2 "
            "bandwidth) s. Default: the control is free at every sample."
        ),
    )
    enforce: Boolean = Field(
        default=True,
        description=(
            "true: the design respects the limits. false: it ignores them, and the report says "
            "which ones are violated."
        ),
    )

    @model_validator(mode="after")
    def _distances_with_clearance(self) -> Limits:
        """Refuse pairs and a floor where distances are not limited."""
        for key, is_stated in (("ignored", bool(self.ignored)), ("floor", self.floor is not None)):
            if is_stated and self.clearance is None:
                raise ValueError(
                    f"{key} can only be given together with clearance: without it distances are "
                    "not limited"
                )
        return self


class Boundary(Section):
    """States in which a design begins and ends."""

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
        description=(
            'Keyframe in which a design with `end = "rest"` comes to rest. Default: the initial '
            "state."
        ),
    )
    position: PositiveWithUnit = Field(
        default=1e-2, description="Largest deviation of the final positions [m or rad]."
    )
    velocity: PositiveWithUnit = Field(
        default=2e-2, description="Largest deviation of the final velocities [m/s or rad/s]."
    )

    @model_validator(mode="after")
    def _keyframe_of_rest(self) -> Boundary:
        """Refuse a keyframe for a design that does not end at rest."""
        if self.keyframe is not None and self.end != "rest":
            raise ValueError(
                'keyframe needs end = "rest": it is the state in which such a design ends'
            )
        return self


class RehearsalSpec(Section):
    """Simulated robots on which a design is rehearsed before a person plays it."""

    robots: Integer = Field(
        default=60,
        ge=0,
        le=MAX_ROBOTS,
        description="Number of robots. 0: the design is played on the model alone.",
    )
    wrong: NonNegative = Field(
        default=0.2,
        le=MAX_WRONG,
        description=(
            "Largest error of a parameter without a prior, relative to its size. Errors stay "
            "within the bounds. Parameters with a prior are drawn from it."
        ),
    )
    feedback: Boolean = Field(
        default=False,
        description=(
            "true: the controller adds the gains times the measured deviation, with the noise of "
            "the measurements."
        ),
    )
    latency: Annotated[Finite, Field(ge=0)] | None = Field(
        default=None,
        description=(
            "Delay of the control under feedback [s], rounded up to timesteps. Default: 0.005."
        ),
    )
    floor: FiniteWithUnit | Literal["none"] | None = Field(
        default=None,
        description=(
            "Height in the world below which no part of the robot may come [m]. Default: the floor "
            "of the model, else the lower end of the base above which an arm begins, else 0 for a "
            "free body and for a robot that hangs and begins above 0. The lowest point of the "
            'start counts if it is lower than these. "none": there is no floor.'
        ),
    )
    seed: Integer = Field(default=0, ge=0, description="Seed of the robots.")


class FitSpec(Section):
    """Segments, loss, noise and initial guesses with which parameters are fitted to recordings."""

    segments: Seconds | Literal["whole"] | None = Field(
        default=None,
        description=(
            "Recordings are cut into segments of this length [s], each with an unknown initial "
            'state (multiple shooting). "whole": one segment per recording. Default: one segment '
            "per recording where the model explains the recordings, and otherwise the length whose "
            "fit predicts left-out data best."
        ),
    )
    seconds: Seconds | None = Field(
        default=None,
        description=(
            "Total length of the fitted segments [s], which are spread over the recordings. It "
            "needs a length in `segments`. Default: all segments."
        ),
    )
    hold: tuple[str, ...] = Field(
        default=(),
        description=(
            "Names of parameters that keep their guess, because the recordings hardly determine "
            "them."
        ),
    )
    start: Literal["stated", "measured", "inverse_dynamics"] = Field(
        default="stated",
        description=(
            "Initial state of a recording. stated: the state of `initial` plus the deviations of "
            "`nuisance.initial`. measured: read from the log, then estimated freely. "
            "inverse_dynamics: as measured, and the parameters start from a fit to the equation of "
            "motion, which needs a measured position or velocity of every degree of freedom."
        ),
    )
    loss: Literal["linear", "huber", "soft_l1", "cauchy"] = Field(
        default="linear",
        description=(
            "Loss of a whitened residual, as in scipy.optimize.least_squares. All losses except "
            "linear tolerate outliers."
        ),
    )
    loss_scale: Positive = Field(
        default=3.0,
        description="Size above which a robust loss treats a residual as an outlier [sigma].",
    )
    noise: Literal["stated", "estimated"] = Field(
        default="stated",
        description=(
            "stated: standard deviations of the `noise` table. estimated: standard deviations that "
            "are estimated from the residuals by iterated reweighting."
        ),
    )
    starts: Integer = Field(
        default=1,
        ge=1,
        le=MAX_STARTS,
        description=(
            "Number of initial guesses: the stated one, and for the others random values within "
            "bounds and priors. The best fit is kept."
        ),
    )
    seed: Integer = Field(
        default=0, ge=0, description="Seed of the random initial guesses and of the bootstrap."
    )
    max_iterations: Integer = Field(
        default=60,
        ge=1,
        le=MAX_ITERATIONS,
        description="Largest number of iterations from one initial guess.",
    )
    blocks: Seconds | None = Field(
        default=None,
        description=(
            "Length of the blocks of the bootstrap and the sandwich covariance [s]; residuals "
            "further apart count as independent. Default: a length that follows from the "
            "autocorrelation of the residuals."
        ),
    )
    bootstrap: Integer = Field(
        default=1000,
        ge=0,
        le=MAX_REPLICATES,
        description="Number of bootstrap replicates. 0: no bootstrap.",
    )

    @model_validator(mode="after")
    def _segments_of_seconds(self) -> FitSpec:
        """Refuse a total length of segments that have no length."""
        if self.seconds is not None and self.segment_length is None:
            raise ValueError("seconds needs a length of the segments: state segments, such as 1.0")
        return self

    @property
    def segment_length(self) -> float | None:
        """Stated length of the segments [s]; None for one segment per recording."""
        return None if self.segments == "whole" else self.segments

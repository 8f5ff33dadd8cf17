"""Tables of the experiment file about the system.

They state the control laws, the initial state and control, the physical terms, the unknown
parameters, the noise of the measurements and the nuisances. `task_tables` has the other tables.
"""

from __future__ import annotations

from collections.abc import Callable
from typing import Annotated, Any, Literal

from pydantic import Field, SkipValidation, model_validator
from pydantic.json_schema import SkipJsonSchema

from mjfim.recordings.quantities import WithUnit
from mjfim.recordings.section import (
    Boolean,
    Bound,
    Finite,
    FiniteWithUnit,
    Hertz,
    Integer,
    NonNegative,
    Positive,
    PositiveWithUnit,
    RangeWithUnit,
    Seconds,
    Section,
)

# A time that may be zero.
Delay = Annotated[NonNegative, WithUnit("s")]

# One number for all names, or numbers by name.
NumberOrTable = FiniteWithUnit | dict[str, FiniteWithUnit]

# Rows of a matrix.
Matrix = tuple[tuple[Finite, ...], ...]

# Kinds of physical terms, those of `mjfim.model.terms.library`.
TermKind = Literal[
    "stribeck",
    "lugre",
    "asymmetric_friction",
    "load_dependent_friction",
    "back_emf",
    "actuator_lag",
    "joint_elasticity",
    "backlash",
    "tilt",
    "payload",
]

# Largest number of harmonics of a multisine.
MAX_HARMONICS = 10_000

# Standard deviation of a nuisance before the experiment; True where nothing is known about it.
PriorOrUnknown = PositiveWithUnit | Literal[True]
PriorsByName = PriorOrUnknown | dict[str, PriorOrUnknown]


class ControllerSpec(Section):
    """Law with which the driver of an actuator computes its control from a log and from the joint.

    The law is evaluated at its own rate, and its control is held in between. The control is
    `kp (reference - position) + kd (reference velocity - velocity) + integral + feed-forward`. It
    is clipped to its range and has the unit of the actuator, which is called u here. Unknown
    numbers are parameters, with the target `controller/<actuator>:kp` for example.

    A law that states `kp` takes the place of a `<position>` servo without gear at its joint: the
    actuator is a motor then, without the ranges of the servo. Other laws compute the control of
    the servo.
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
        description=(
            "Range of the control [u]. Default: the ctrlrange of the actuator, or the forcerange "
            "of the servo whose place the law takes."
        ),
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
    acceleration: Positive | None = Field(
        default=None,
        description=(
            "Largest acceleration of the motion profile from one reference to the next, as smart "
            "servos compute it [rad/s² or m/s²]. Default: no profile."
        ),
    )
    jump: Positive | None = Field(
        default=None,
        description=(
            "Change of the reference from one evaluation to the next above which it passes without "
            "the profile [rad or m]. Default: the profile takes all changes."
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
        if self.jump is not None and self.acceleration is None:
            raise ValueError("jump needs acceleration; without a profile, all changes pass at once")

        stated = {"kp", "kd", "ki", "feedforward"} & self.model_fields_set
        if not stated:
            raise ValueError(
                "the law computes nothing; state kp, kd, ki or feedforward = true, and a guess "
                "where a gain is unknown"
            )
        return self


class Signal(Section):
    """A generated control signal.

    Frequencies of successive actuators differ by 17 % of the first actuator's frequency, so that
    the movements differ. Sines and chirps begin at the offset.
    """

    kind: Literal["constant", "sine", "chirp", "multisine"] = Field(
        description=(
            "Waveform. A chirp sweeps its frequency linearly; a multisine is a sum of harmonics "
            "with random phases."
        )
    )
    amplitude: NumberOrTable = Field(
        default=1.0,
        description=(
            "Amplitude [actuator unit], one number for all actuators or a table by actuator name."
        ),
    )
    offset: NumberOrTable | None = Field(
        default=None,
        description=(
            "Constant that is added [actuator unit], one number or a table by actuator name. "
            "Default: the control of the initial keyframe, 0 without a keyframe."
        ),
    )
    frequency: Hertz = Field(
        default=0.5,
        description=(
            "Frequency of a sine, first frequency of a chirp, base frequency of a multisine [Hz]."
        ),
    )
    frequency_end: Hertz | None = Field(
        default=None,
        description="Last frequency of a chirp [Hz]. Default: five times `frequency`.",
    )
    harmonics: Integer = Field(
        default=5, ge=1, le=MAX_HARMONICS, description="Number of harmonics of a multisine."
    )
    seed: Integer = Field(
        default=0, ge=0, description="Seed of the random phases and weights of a multisine."
    )
    fade: Seconds | None = Field(
        default=None,
        description=(
            "Time at the end over which the signal fades to its offset [s], for a design that ends "
            "at rest. Default: it does not fade."
        ),
    )


class Initial(Section):
    """Initial state of the experiment, and the control from which a design starts."""

    keyframe: str | None = Field(
        default=None,
        description=(
            "Name of a keyframe of the MJCF that gives the initial state and the resting control. "
            "It excludes `qpos`, `qvel` and `act`."
        ),
    )
    qpos: tuple[FiniteWithUnit, ...] | None = Field(
        default=None,
        description=(
            "Initial positions, nq numbers [m, rad, quaternions as w x y z]. Default: the model's "
            "reference positions."
        ),
    )
    qvel: tuple[FiniteWithUnit, ...] | None = Field(
        default=None, description="Initial velocities, nv numbers [m/s or rad/s]. Default: 0."
    )
    act: tuple[Finite, ...] | None = Field(
        default=None, description="Initial actuator activations, na numbers. Default: 0."
    )
    free: dict[str, RangeWithUnit] = Field(
        default_factory=dict,
        description=(
            "Ranges within which `design` chooses the release, the initial state of a motion that "
            "no control drives, by coordinate: `qpos:<joint>` and `qvel:<joint>`, with the parts "
            "`.x .y .z .rx .ry .rz` of ball and free joints [m, rad, m/s or rad/s]. Rotations "
            "`.rx .ry .rz` are relative to the stated initial state. The stated control is "
            "played unchanged. Recordings begin wherever they were released: the initial state is "
            "then estimated from each of them, or, with `nuisance.initial`, these coordinates are "
            "read from its first rows. Default: the initial state is fixed."
        ),
    )
    control: str | Signal | None = Field(
        default=None,
        description=(
            "Control from which a design starts: a table file with the column `t` [s] and one "
            "column per actuator, or a generated signal. Identification does not need it."
        ),
    )

    @model_validator(mode="after")
    def _one_source(self) -> Initial:
        """Refuse a keyframe together with stated numbers."""
        if self.keyframe is not None and (self.qpos or self.qvel or self.act):
            raise ValueError("give either keyframe or qpos/qvel/act, not both")
        return self


class TermSpec(Section):
    """A physical term that is added to the model when it is loaded, see the library of terms."""

    kind: TermKind = Field(description="Kind of the term, a name of the library of terms.")
    joint: str | None = Field(default=None, description="Name of the joint on which it acts.")
    actuator: str | None = Field(
        default=None, description="Name of the actuator whose action it changes."
    )
    body: str | None = Field(default=None, description="Name of the body to which it is fixed.")
    encoder: Literal["motor", "link"] = Field(
        default="motor",
        description=(
            "Side of an elastic joint or of one with backlash on which its sensors are: with "
            "`motor`, the joint of the model is the motor, with `link` it is the link."
        ),
    )
    values: dict[str, FiniteWithUnit] = Field(
        default_factory=dict,
        description=(
            "Values of its fields where no parameter sets them [unit of the field]. A parameter "
            "names a field by the path `term/<name>:<field>`, and its guess defaults to this "
            "value. Default: no effect, or the smallest one that the model can show."
        ),
    )


class TargetSpec(Section):
    """One number inside the model, which is set to `scale * parameter + offset`."""

    path: str = Field(
        description=(
            "Parameter path, `kind/name:field[index]` with MuJoCo's field names, for example "
            "`body/bob:pos[2]`."
        )
    )
    scale: Finite = Field(
        default=1.0, description="Factor by which the parameter is multiplied; it must not be 0."
    )
    offset: FiniteWithUnit = Field(
        default=0.0, description="Constant that is added [unit of the number inside the model]."
    )

    @model_validator(mode="after")
    def _has_an_effect(self) -> TargetSpec:
        """Refuse a target that the parameter would not change."""
        if self.scale == 0.0:
            raise ValueError("scale is 0, so the parameter would not change this target")
        return self


class ParameterSpec(Section):
    """One unknown parameter, or with `inertial` the ten inertial parameters of one body."""

    target: str | None = Field(
        default=None,
        description=(
            "Path of the number inside the model that this parameter sets, for example "
            "`joint/hinge:damping`."
        ),
    )
    targets: tuple[TargetSpec, ...] = Field(
        default=(),
        description=(
            "Several numbers inside the model that this one parameter sets, each by its scale and "
            "offset."
        ),
    )
    function: SkipJsonSchema[SkipValidation[Callable[[Any, float], None]] | None] = Field(
        default=None,
        description=(
            "Function `f(spec, value)` that edits an MjSpec. It can be given in Python only, and "
            "it needs a `guess`."
        ),
    )
    inertial: str | None = Field(
        default=None,
        description=(
            "Name of a body whose mass, centre of mass and inertia are all unknown. It gives ten "
            "parameters, named `<this name>.<coordinate>`."
        ),
    )
    coordinates: Literal["logcholesky", "barycentric"] | None = Field(
        default=None,
        description=(
            "Coordinates of `inertial`: log-Cholesky, in which every value is physical, or "
            "barycentric, in which the dynamics are linear. Default: `logcholesky`."
        ),
    )
    guess: FiniteWithUnit | None = Field(
        default=None,
        description=(
            "Value for which the design is made and from which the fit starts [parameter unit]. "
            "Default: the value in the model."
        ),
    )
    true: FiniteWithUnit | None = Field(
        default=None,
        description=(
            "Value that `simulate` and `montecarlo` use as the true one [parameter unit]. Default: "
            "the guess."
        ),
    )
    bounds: RangeWithUnit | None = Field(
        default=None,
        description=(
            "Lower and upper bound of the estimate [parameter unit]. Default: what physics allows: "
            "damping, friction, armature and stiffness are at least 0, and inertias are physical. "
            "State a negative lower bound to allow negative values."
        ),
    )
    scale: PositiveWithUnit | Literal["guess"] | None = Field(
        default=None,
        description=(
            "Unit in which the criterion measures the error: a number [parameter unit], or "
            '"guess" for the size of the guess. 1.0 means absolute errors, as in the paper. '
            "Default: the guess or the natural size of the quantity, whichever is larger."
        ),
    )
    prior: PositiveWithUnit | None = Field(
        default=None,
        description=(
            "Standard deviation with which the guess is known before the experiment [parameter "
            "unit; for `inertial` relative to the natural size of each coordinate]. Default: no "
            "prior knowledge."
        ),
    )
    cad_prior: PositiveWithUnit | Literal[False] | None = Field(
        default=None,
        description=(
            "How well the inertia of the model, for example from CAD, is known for `inertial`: "
            "standard deviation of the logarithm of the pseudo-inertia relative to it. With 1, "
            "mass and second moments are right within a factor of e or so; this holds only what "
            "the recordings hardly determine. false: no prior knowledge. Default: 1 without "
            "`prior`, false with it. Only fits use it; `design` and `check` count what motions "
            "show, without it."
        ),
    )
    unit: str = Field(
        default="",
        description=(
            "Unit that is shown in tables and figures. Default: the unit of the first target."
        ),
    )
    nuisance: Boolean = Field(
        default=False,
        description=(
            "The parameter is unknown and is fitted, but the design does not optimise its accuracy."
        ),
    )
    per_recording: Boolean = Field(
        default=False,
        description=(
            "Each recording has a separate value of this parameter. It needs `nuisance = true`."
        ),
    )
    wanted: PositiveWithUnit | None = Field(
        default=None,
        description=(
            "Target for the standard deviation [parameter unit], which `check`, `design "
            "--shortest`, campaigns and pictures use."
        ),
    )
    published: FiniteWithUnit | None = Field(
        default=None,
        description=(
            "Value of a data sheet or of a publication [parameter unit]. Estimates are compared "
            "with it in pictures and tables; nothing is computed from it."
        ),
    )

    @model_validator(mode="after")
    def _consistent(self) -> ParameterSpec:
        """Refuse keys that contradict each other."""
        sources = (
            self.target is not None,
            bool(self.targets),
            self.function is not None,
            self.inertial is not None,
        )
        if sum(sources) != 1:
            raise ValueError(
                "give exactly one of target, targets and inertial (in Python also function)"
            )
        if self.function is not None and (not callable(self.function) or self.guess is None):
            raise ValueError("function must be callable, f(spec, value), and needs a guess")
        self._require_keys_of_inertial()

        if self.per_recording and not self.nuisance:
            raise ValueError(
                "per_recording needs nuisance = true: other parameters have one value in all "
                "recordings"
            )
        if self.bounds is not None and not self.bounds[0] < self.bounds[1]:
            low, high = self.bounds
            raise ValueError(f"bounds are inverted: [{low}, {high}] needs lower < upper")

        return self

    def _require_keys_of_inertial(self) -> None:
        """Raise ValueError for keys that contradict `inertial`, or that need it."""
        if self.inertial is None:
            if self.coordinates is not None:
                raise ValueError("coordinates can only be given together with inertial")
            if self.cad_prior is not None:
                raise ValueError("cad_prior can only be given together with inertial")
            return

        single = [
            key
            for key in ("guess", "true", "bounds", "wanted", "published")
            if getattr(self, key) is not None
        ]
        if self.unit:
            single.append("unit")
        if self.scale not in (None, "guess"):
            single.append("scale")

        if single:
            raise ValueError(
                f"inertial defines ten parameters; {', '.join(single)} would fit only one"
            )

    @property
    def all_targets(self) -> tuple[TargetSpec, ...]:
        """Targets of the parameter, whether the file says `target` or `targets`."""
        if self.targets:
            return self.targets
        if self.target is None:
            return ()
        return (TargetSpec(path=self.target),)


class NoiseSpec(Section):
    """Noise of one output, or of the components of one sensor."""

    sigma: PositiveWithUnit | tuple[PositiveWithUnit, ...] | None = Field(
        default=None,
        description=(
            "Standard deviation [output unit], one number or one per component. It excludes "
            "`covariance`."
        ),
    )
    covariance: Matrix | None = Field(
        default=None,
        description=(
            "Covariance matrix of the components [output unit squared], as a list of rows. It "
            "excludes `sigma`."
        ),
    )
    rate: Hertz | None = Field(
        default=None,
        description=(
            "Rate at which this output is measured [Hz]; it divides `rate`. Default: "
            "`measure_rate`."
        ),
    )

    @model_validator(mode="after")
    def _one_kind(self) -> NoiseSpec:
        """Refuse both sigma and covariance, and neither."""
        if (self.sigma is None) == (self.covariance is None):
            raise ValueError("give exactly one of sigma and covariance")
        return self


class Correlated(Section):
    """Covariance of several outputs whose noise is correlated.

    It replaces the standard deviations of these outputs.
    """

    outputs: Annotated[tuple[str, ...], Field(min_length=2)] = Field(
        description="Names of the outputs, in the order of the matrix."
    )
    covariance: Matrix = Field(
        description="Covariance matrix [product of the output units], as a list of rows."
    )


class Nuisance(Section):
    """Unknowns that affect the measurements but whose values are not of interest.

    They are zero in the model. Each key states the standard deviation of the unknown before the
    experiment, or `true` if nothing is known about it.
    """

    initial: PriorsByName | None = Field(
        default=None,
        description=(
            "Deviation of the initial state [m, rad, m/s or rad/s]: one value for all of qpos and "
            "qvel, or a table by coordinate, `qpos:<joint>` and `qvel:<joint>`, with the parts "
            "`.x .y .z .rx .ry .rz` of ball and free joints. Default: the initial state is known."
        ),
    )
    bias: PriorsByName | None = Field(
        default=None,
        description=(
            "Constant bias of the outputs [output unit]: one value for all of them or a table by "
            "output. Default: none."
        ),
    )
    delay: Seconds | Literal[True] | None = Field(
        default=None, description="Delay of all outputs [s]. Default: none."
    )
    friction: PriorsByName | None = Field(
        default=None,
        description=(
            "Dry friction of the joints that no parameter sets [N or N m]: one value for all slide "
            "and hinge joints or a table by joint. A design then reveals the parameters by motions "
            "whose effect dry friction cannot imitate. Default: none."
        ),
    )
    armature: PriorsByName | None = Field(
        default=None,
        description=(
            "Armature of the joints that no parameter sets [kg or kg m²], likewise. Where a gear "
            "has backlash, the motor does not feel the inertia of the link at each reversal. "
            "Default: none."
        ),
    )
    per_recording: Boolean = Field(
        default=False,
        description=(
            "Each recording has a separate bias and a separate delay. The initial states of "
            "recordings are always separate."
        ),
    )

"""What the user states about an experiment, in TOML or in Python, by the same names. Checked here, resolved in `setup`."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Annotated, Any, Literal

import numpy as np
from pydantic import Field, SkipValidation, ValidationError, model_validator

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, unknown
from mjfim.experiment.messages import explain, valid_keys
from mjfim.recordings.spec import Finite, Positive, Range, RecordingSpec, Section

NonNegative = Annotated[float, Field(ge=0, allow_inf_nan=False, strict=True)]
Unknown = Positive | Literal[True]
ONLY_IN_PYTHON = ("function",)  # keys of parameters that a file cannot state


class Signal(Section):
    """A generated initial control. Amplitudes and offsets in the actuator's unit, one number or one per actuator by name.

    offset: default: the keyframe's control, else 0
    Sines and chirps begin at the offset, so what only integrates drifts to one side; a small offset holds against it.
    """

    kind: Literal["constant", "sine", "chirp", "multisine"]
    amplitude: Finite | dict[str, Finite] = 1.0
    offset: Finite | dict[str, Finite] | None = None
    frequency: Positive = 0.5
    frequency_end: Positive | None = None
    harmonics: Annotated[int, Field(ge=1)] = 5
    seed: Annotated[int, Field(ge=0)] = 0


class Initial(Section):
    """Where the experiment starts: a keyframe or qpos/qvel/act, and the control from which the design starts."""

    keyframe: str | None = None
    qpos: tuple[Finite, ...] | None = None
    qvel: tuple[Finite, ...] | None = None
    act: tuple[Finite, ...] | None = None
    control: str | Signal | None = None

    @model_validator(mode="after")
    def _one_source(self) -> Initial:
        if self.keyframe is not None and (self.qpos or self.qvel or self.act):
            raise ValueError("give either keyframe or qpos/qvel/act, not both")
        return self


class TargetSpec(Section):
    """One number inside the model, `scale * theta + offset`."""

    path: str
    scale: Finite = 1.0
    offset: Finite = 0.0

    @model_validator(mode="after")
    def _moves(self) -> TargetSpec:
        if self.scale == 0.0:
            raise ValueError("a target with scale 0 never changes")
        return self


class ParameterSpec(Section):
    """One unknown parameter, or with `inertial` the ten of a body's inertia.

    target, targets: what it drives;  function: `f(spec, value)` that edits an MjSpec instead (in Python only)
    inertial: name of a body, whose ten coordinates become parameters `<this name>.<coordinate>`
    coordinates: of an inertial, logcholesky (default, always physical) or barycentric (the dynamics are linear in them)
    nuisance: unknown, but the design need not find it out;  wanted: standard deviation aimed at, in the parameter's unit
    per_recording: a nuisance of which every recording has its own value
    """

    target: str | None = None
    targets: tuple[TargetSpec, ...] = ()
    function: SkipValidation[Callable[[Any, float], None]] | None = None
    inertial: str | None = None
    coordinates: Literal["logcholesky", "barycentric"] | None = None
    guess: Finite | None = None
    true: Finite | None = None
    bounds: Range | None = None
    scale: Positive | Literal["guess"] | None = None
    prior: Positive | None = None
    unit: str = ""
    nuisance: bool = False
    per_recording: bool = False
    wanted: Positive | None = None

    @model_validator(mode="after")
    def _consistent(self) -> ParameterSpec:
        sources = (
            self.target is not None,
            bool(self.targets),
            self.function is not None,
            self.inertial is not None,
        )
        if sum(sources) != 1:
            raise ValueError(
                "give exactly one of target and targets, or inertial (in Python also function)"
            )
        if self.function is not None and (not callable(self.function) or self.guess is None):
            raise ValueError("function must be callable, f(spec, value), and needs a guess")
        if self.inertial is not None:
            one = [
                key
                for key in ("guess", "true", "bounds", "wanted")
                if getattr(self, key) is not None
            ]
            one += [
                key for key in ("unit", "scale") if getattr(self, key) not in ("", None, "guess")
            ]
            if one:
                raise ValueError(
                    f"inertial stands for ten parameters; {', '.join(one)} would fit only one"
                )
        elif self.coordinates is not None:
            raise ValueError("coordinates belongs to inertial")
        if self.per_recording and not self.nuisance:
            raise ValueError(
                "per_recording needs nuisance = true: what is wanted is common to all recordings"
            )
        if self.bounds is not None:
            low, high = self.bounds
            if not low < high:
                raise ValueError(f"bounds are inverted: [{low}, {high}] needs lower < upper")
            for key, value in (("guess", self.guess), ("true", self.true)):
                if value is not None and not low <= value <= high:
                    raise ValueError(f"{key} {value} is outside bounds [{low}, {high}]")
        return self

    @property
    def all_targets(self) -> tuple[TargetSpec, ...]:
        """The targets, however they were written."""
        return self.targets or (() if self.target is None else (TargetSpec(path=self.target),))


Matrix = tuple[tuple[Finite, ...], ...]


class NoiseSpec(Section):
    """Noise of one output or of a sensor's components: 1 sigma (one number or one per component) or a full covariance.

    rate: [Hz] at which it is measured, divides the experiment's rate; default: measure_rate
    """

    sigma: Positive | tuple[Positive, ...] | None = None
    covariance: Matrix | None = None
    rate: Positive | None = None

    @model_validator(mode="after")
    def _one(self) -> NoiseSpec:
        if (self.sigma is None) == (self.covariance is None):
            raise ValueError("give exactly one of sigma and covariance")
        return self


class Correlated(Section):
    """Full covariance of several outputs that are measured together; it replaces their sigma."""

    outputs: Annotated[tuple[str, ...], Field(min_length=2)]
    covariance: Matrix


class Nuisance(Section):
    """Unknowns that every experiment has and nobody asks for. Values: prior standard deviation, or true where unknown.

    initial: deviation of the start, of all of qpos and qvel or by `qpos:<joint>`, `qvel:<joint>`
    bias: constant bias, of all outputs or by name;  delay: [s] by which all outputs lag
    per_recording: every recording has its own bias and delay, as it has its own start
    """

    initial: Unknown | dict[str, Unknown] | None = None
    bias: Unknown | dict[str, Unknown] | None = None
    delay: Unknown | None = None
    per_recording: bool = False


class Robust(Section):
    """Design for a wrong guess: pool the criterion over samples of the parameters (priors, else bounds)."""

    over: Literal["mean", "worst"] = "mean"
    samples: Annotated[int, Field(ge=2)] = 6
    seed: Annotated[int, Field(ge=0)] = 0


class Cost(Section):
    """Weights of eq. 3 and where it is evaluated.

    control: R_tau, 0 where hard limits bound the control;  tracking, tracking_velocity: Q_tau by joint name
    control_about: control that costs nothing, one number or by actuator; default: the keyframe's control, else 0
    combination: for criterion c, coefficients by parameter: the variance of their sum is minimised
    subset: for criterion c, parameters whose relative variances (in units of their scales) are summed
    """

    criterion: Literal["E", "A", "D", "c"] = "E"
    combination: dict[str, Finite] | None = None
    subset: tuple[str, ...] | None = None
    information: Positive = 1.0
    control: NonNegative | dict[str, NonNegative] = 1e-3
    control_about: Finite | dict[str, Finite] | None = None
    tracking: dict[str, NonNegative] = Field(default_factory=dict)
    tracking_velocity: dict[str, NonNegative] = Field(default_factory=dict)
    linearize_at: Literal["guess", "true"] = "guess"

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


class Descent(Section):
    """How the cost is minimised. tolerance: stop at `|DJ.zeta| <= tolerance * J`; psi_weight: metric weight on psi.

    seconds: stop after that long, with the best so far

    starts: 1 = from the initial control only; more adds random multisines, the best result is kept
    previous: design.csv files to start from as well, repeated where they are shorter
    fourier: [Hz] base frequencies of Fourier series to start from as well, each optimised first
    repeats: under hard limits, begin also with designs of the horizon divided by these, played as many times
    coarse: descend first at a sample period that many times longer, where it is cheap; 1 = never; auto = 4 where the model
    allows it
    """

    method: Literal["lbfgs", "metric"] = "lbfgs"
    tolerance: Positive = 1e-7
    max_iterations: Annotated[int, Field(ge=0)] = 200
    seconds: Positive | None = None
    psi_weight: NonNegative = 0.0
    starts: Annotated[int, Field(ge=1)] = 1
    previous: tuple[str, ...] = ()
    fourier: tuple[Positive, ...] = ()
    repeats: tuple[Annotated[int, Field(ge=2)], ...] = ()
    coarse: Annotated[int, Field(ge=1)] | Literal["auto"] = "auto"
    seed: Annotated[int, Field(ge=0)] = 0

    @model_validator(mode="after")
    def _metric(self) -> Descent:
        if self.psi_weight and self.method != "metric":
            raise ValueError('psi_weight belongs to method = "metric"')
        return self


class Limits(Section):
    """Hard limits by joint or actuator name; one number stands for all names. Default: the MJCF's ranges.

    position, velocity, acceleration: of joints [m or rad, per s, per s²];  control, control_rate: of actuators [unit, unit/s]
    force: of actuators [N or N m];  where the MJCF has a range too, both hold
    clearance: [m] least distance to itself and to the world;  ignored: pairs of bodies that may come closer
    bandwidth: [Hz] of the control, then a cubic spline with a knot every 1/(2 bandwidth) s
    enforce: false: check and report only
    """

    position: dict[str, Range] = Field(default_factory=dict)
    velocity: Positive | dict[str, Positive | Range] = Field(default_factory=dict)
    acceleration: Positive | dict[str, Positive | Range] = Field(default_factory=dict)
    control: dict[str, Range] = Field(default_factory=dict)
    control_rate: Positive | dict[str, Positive | Range] = Field(default_factory=dict)
    force: Positive | dict[str, Positive | Range] = Field(default_factory=dict)
    clearance: Positive | None = None
    ignored: tuple[tuple[str, str], ...] = ()
    bandwidth: Positive | None = None
    enforce: bool = True


class Boundary(Section):
    """How a design begins and ends.

    start: rest: the control begins at what holds the start, without a jolt;  given: anything
    end: rest: at a standstill, at the start or at a keyframe;  periodic: at the start's state, ready to be repeated;  free
    position, velocity: [m or rad, m/s or rad/s] how exactly the end is met
    """

    start: Literal["given", "rest"] = "given"
    end: Literal["free", "rest", "periodic"] = "free"
    keyframe: str | None = None
    position: Positive = 1e-2
    velocity: Positive = 2e-2

    @model_validator(mode="after")
    def _somewhere(self) -> Boundary:
        if self.keyframe is not None and self.end != "rest":
            raise ValueError('keyframe says where a design with end = "rest" comes to rest')
        return self


class FitSpec(Section):
    """How parameters are estimated from recordings.

    segments: [s] recordings are cut into pieces of that length, each with its own unknown start; default: uncut
    start: stated: recordings start as `initial` says (and `nuisance.initial` doubts);  measured: at what the log shows, free
    loss: of a whitened residual, as in scipy.optimize.least_squares;  loss_scale: sigmas at which outliers begin
    noise: stated: the sigmas of the noise table;  estimated: found by iterated reweighting, from those
    starts: 1 = from the guess only; more adds random ones within bounds and priors, the best fit is kept
    blocks: [s] longest time over which residuals may hang together; default: from their autocorrelation
    bootstrap: replicates of the block bootstrap, 0 = none
    """

    segments: Positive | None = None
    start: Literal["stated", "measured"] = "stated"
    loss: Literal["linear", "huber", "soft_l1", "cauchy"] = "linear"
    loss_scale: Positive = 3.0
    noise: Literal["stated", "estimated"] = "stated"
    starts: Annotated[int, Field(ge=1)] = 1
    seed: Annotated[int, Field(ge=0)] = 0
    max_iterations: Annotated[int, Field(ge=1)] = 60
    blocks: Positive | None = None
    bootstrap: Annotated[int, Field(ge=0)] = 1000


class Experiment(Section):
    """An experiment. Relative paths inside are relative to `directory`, the folder of the experiment file.

    earlier: design.json or estimate.json files of experiments whose information adds to this one's
    playback_rate: [Hz] of the rows of design.csv, the controller's; a multiple of rate; default: rate
    """

    model: str
    rate: Positive
    measure_rate: Positive | None = None
    playback_rate: Positive | None = None
    horizon: Positive | None = None
    initial: Initial = Initial()
    parameters: Annotated[dict[str, ParameterSpec], Field(min_length=1)]
    noise: dict[str, Positive | NoiseSpec] = Field(default_factory=dict)
    correlated: tuple[Correlated, ...] = ()
    nuisance: Nuisance = Nuisance()
    earlier: tuple[str, ...] = ()
    cost: Cost = Cost()
    robust: Robust | None = None
    descent: Descent = Descent()
    limits: Limits = Limits()
    boundary: Boundary = Boundary()
    recording: RecordingSpec = RecordingSpec()
    fit: FitSpec = FitSpec()
    directory: Path = Field(default=Path("."), exclude=True)
    source: str = Field(default="experiment", exclude=True)

    def __init__(self, **values: Any) -> None:
        try:
            super().__init__(**values)
        except ValidationError as error:
            source = str(values.get("source", "experiment"))
            raise ExperimentError(explain(error, source, Experiment, ONLY_IN_PYTHON)) from None

    @staticmethod
    def from_file(path: str | Path) -> Experiment:
        """Read a TOML experiment file. Raises ExperimentError naming the file and the key."""
        path = Path(path)
        try:
            values = tomllib.loads(path.read_text(encoding="utf-8"))
        except OSError as error:
            raise ExperimentError(
                f"{path}: cannot read the experiment file: {error.strerror}"
            ) from None
        except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
            raise ExperimentError(f"{path}: not valid TOML: {error}") from None
        for reserved in ("directory", "source"):
            if reserved in values:
                raise ExperimentError(f"{path}: {unknown('key', reserved, valid_keys(Experiment))}")
        tables = values.get("parameters")
        for name, table in (tables if isinstance(tables, dict) else {}).items():
            if isinstance(table, dict) and "function" in table:
                raise ExperimentError(
                    f"{path}: parameters.{name}.function: a function is given in Python, not in a file"
                )
        return Experiment(**values, directory=path.parent, source=str(path))

    def replace(self, **tables: Any) -> Experiment:
        """A checked copy with changes; tables merge into the old ones, one level deep: `e.replace(cost={"control": 1e-2})`.

        `parameters` merges parameter by parameter; none can be taken out.
        """
        values = self.model_dump(exclude_unset=True)
        for key, value in tables.items():
            old = values.get(key)
            if key == "parameters":
                values[key] = {
                    **values[key],
                    **{n: {**values[key].get(n, {}), **t} for n, t in value.items()},
                }
            else:
                values[key] = (
                    {**old, **value}
                    if isinstance(old, dict) and isinstance(value, Mapping)
                    else value
                )
        return Experiment(**{"directory": self.directory, "source": self.source, **values})


def by_name(
    key: str, value: float | Mapping[str, float], names: tuple[str, ...], kind: str
) -> Array:
    """(n,) from one number for all names or a table by name, 0 where it is silent. Raises ExperimentError."""
    if not isinstance(value, Mapping):
        return np.full(len(names), float(value))
    for name in value:
        if name not in names:
            raise ExperimentError(f"{key}: {unknown(kind, name, names)}")
    return np.array([float(value.get(name, 0.0)) for name in names])

"""Time grid, measured outputs with their noise, and control laws of an experiment."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import replace
from typing import Any

import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError, listed, unknown
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system_tables import ControllerSpec, Correlated, NoiseSpec
from mjfim.model.control_laws import (
    KINDS,
    NUMBERS,
    ControlLaw,
    ControlLaws,
    InputColumn,
    Quantity,
    first_number,
    unit_of_control,
    with_laws,
)
from mjfim.model.coordinates import (
    ModelCoordinates,
    ScalarJoint,
    actuator_names,
    unknown_coordinate,
)
from mjfim.model.loading import ModelSource
from mjfim.model.units import acts_at_joint, actuator_gear, commanded_joint, per_second
from mjfim.model.variants import ModelVariant
from mjfim.plant.outputs import Noise, Output, Outputs
from mjfim.plant.state_space import StateSpace

# Largest number of engine steps of a sample, so that a mistyped rate or timestep does not exhaust
# the memory.
MAX_SUBSTEPS = 100_000

# A ratio of two rates counts as a whole number within this relative tolerance.
RATE_TOLERANCE = 1e-6


@record
class TimeGrid:
    """Division of the time into samples, measurements and engine steps.

    Attributes:
        dt: Sample period [s].
        substeps: Engine steps per sample.
        stride: Samples from one measurement to the next.
        playback_steps: Engine steps per row of design.csv, on the stated grid.
    """

    dt: float
    substeps: int
    stride: int
    playback_steps: int

    @staticmethod
    def stated(experiment: Experiment, timestep: float) -> TimeGrid:
        """The grid that an experiment states, with the timestep of its model [s].

        Raises:
            ExperimentError: A rate does not divide the other one, or is not a whole number of
                timesteps.
        """
        rate = experiment.rate
        per_sample = 1.0 / (rate * timestep)
        substeps = whole_number(per_sample)
        if substeps is None:
            raise ExperimentError(
                f"rate: at {rate:g} Hz, a sample is not a whole number of timesteps ({timestep:g} "
                f"s); write one of {rates_near(per_sample, timestep)} Hz. A log keeps "
                "its own rate, whatever `rate` is"
            )
        if substeps > MAX_SUBSTEPS:
            raise ExperimentError(
                f"rate: at {rate:g} Hz, a sample is {substeps:g} timesteps ({timestep:g} s); at "
                f"most {MAX_SUBSTEPS:g} are possible, that is {1.0 / (MAX_SUBSTEPS * timestep):g} "
                "Hz or more"
            )

        return TimeGrid(
            dt=substeps * timestep,
            substeps=substeps,
            stride=_stride("measure_rate", rate, experiment.measure_rate or rate),
            playback_steps=substeps // _rows_per_sample(rate, experiment.playback_rate, substeps),
        )

    @property
    def rows_per_sample(self) -> int:
        """Rows of design.csv in one sample, on the stated grid."""
        return self.substeps // self.playback_steps

    def with_variant(self, variant: ModelVariant) -> TimeGrid:
        """This grid with longer samples or a longer timestep; longer samples are all measured."""
        if self.substeps % variant.timestep_factor:
            raise ValueError(
                f"{self.substeps} engine steps per sample do not divide by "
                f"{variant.timestep_factor}"
            )
        return replace(
            self,
            dt=self.dt * variant.sample_factor,
            substeps=self.substeps // variant.timestep_factor,
            stride=self.stride if variant.sample_factor == 1 else 1,
        )


def _rows_per_sample(rate: float, playback_rate: float | None, substeps: int) -> int:
    """Rows of design.csv in one sample of some engine steps."""
    rows = 1 if playback_rate is None else whole_number(playback_rate / rate)
    if rows is None or substeps % rows:
        numbers = range(1, substeps + 1)
        valid = ", ".join(written_rate(k * rate) for k in numbers if not substeps % k)
        raise ExperimentError(
            f"playback_rate: {playback_rate:g} Hz is not a multiple of rate ({rate:g} Hz) that "
            f"divides the engine's rate ({substeps * rate:g} Hz); valid: {valid}"
        )
    return rows


def noise_strides(experiment: Experiment) -> dict[str, int]:
    """Samples from one measurement to the next for the keys of the table `noise` that state a rate.

    Raises:
        ExperimentError: A rate does not divide `rate`, or gives no measurement.
    """
    horizon = experiment.horizon
    strides: dict[str, int] = {}
    for name, spec in experiment.noise.items():
        if not isinstance(spec, NoiseSpec) or spec.rate is None:
            continue
        key = f"noise.{name}.rate"
        strides[name] = _stride(key, experiment.rate, spec.rate)
        if horizon is not None and spec.rate * horizon < 1.0 - RATE_TOLERANCE:
            raise ExperimentError(
                f"{key}: {spec.rate:g} Hz gives no measurement within the horizon ({horizon:g} s)"
            )
    return strides


def whole_number(ratio: float) -> int | None:
    """A ratio of rates that is a whole number within the tolerance, or None."""
    n = round(ratio)
    return n if n >= 1 and abs(ratio - n) <= RATE_TOLERANCE * n else None


def rates_near(steps: float, timestep: float) -> str:
    """Rates [Hz] whose periods are whole numbers of timesteps [s] near a wanted one, in words.

    Those with few digits come first.
    """
    near = max(round(steps), 1)
    rates = [written_rate(1.0 / (k * timestep)) for k in (near + 1, near, near - 1) if k]
    return ", ".join(sorted(rates, key=len))


def parts_of(rate: float) -> str:
    """Some rates that divide another one [Hz], for a message."""
    return ", ".join(written_rate(rate / k) for k in (1, 2, 4, 5, 10))


def written_rate(rate: float) -> str:
    """A rate [Hz] with so many digits that it is within the tolerance when it is read again."""
    return f"{rate:.9g}"


def _stride(key: str, rate: float, measure_rate: float) -> int:
    """Samples from one measurement to the next."""
    stride = whole_number(rate / measure_rate)
    if stride is None:
        raise ExperimentError(
            f"{key}: {measure_rate:g} Hz does not divide rate {rate:g} Hz; valid: {parts_of(rate)}"
        )
    return stride


# A covariance is not positive definite if its smallest eigenvalue is below this fraction of its
# largest entry.
DEFINITENESS = 1e-12


def resolve_outputs(
    experiment: Experiment,
    coordinates: ModelCoordinates,
    space: StateSpace,
    *,
    stride: int,
    stride_of_key: Mapping[str, int],
) -> tuple[Outputs, Noise]:
    """Resolve the measured outputs and their noise.

    Args:
        experiment: The experiment.
        coordinates: Coordinates and sensors of the model.
        space: Layout of the state.
        stride: Samples from one measurement to the next.
        stride_of_key: The same for keys of the table `noise` with a rate of their own.

    Returns:
        The outputs in the order of the columns, and their noise.

    Raises:
        ExperimentError: A key names no output, or a covariance is not valid.
    """
    columns_of_key = columns_of_keys(coordinates)
    stated = dict(experiment.noise) or _noise_of_mjcf(
        coordinates, required=not experiment.correlated
    )
    for key in stated:
        if key not in columns_of_key:
            raise ExperimentError(
                f"noise: {unknown_coordinate('sensor', key, list(columns_of_key))}"
            )

    components = [*coordinates.state, *coordinates.sensors]
    columns = [component.name for component in components]
    covariance = np.zeros((len(columns), len(columns)))
    strides = np.full(len(columns), stride)
    measured: set[int] = set()
    # Keys that cover fewer outputs are entered last, so that they take precedence over keys that
    # cover more outputs.
    for key in sorted(stated, key=lambda k: -len(columns_of_key[k])):
        rows = [columns.index(name) for name in columns_of_key[key]]
        if not rows:
            raise ExperimentError(
                "noise.state: the model has no joint to measure; name sensors instead"
            )
        covariance[rows] = 0.0
        covariance[:, rows] = 0.0
        factors = [components[i].sigma_factor for i in rows]
        covariance[np.ix_(rows, rows)] = _key_covariance(
            f"noise.{key}", stated[key], np.array(factors)
        )
        strides[rows] = stride_of_key.get(key, stride)
        measured.update(rows)

    for block in experiment.correlated:
        rows = _correlated_columns(block, columns, covariance, strides)
        covariance[np.ix_(rows, rows)] = _checked_covariance(
            "correlated.covariance", block.covariance, len(rows)
        )
        measured.update(rows)

    kept = sorted(measured)
    noise = Noise(covariance=covariance[np.ix_(kept, kept)], strides=strides[kept])

    outputs = tuple(
        Output(
            name=columns[i],
            sigma=float(np.sqrt(covariance[i, i])),
            unit=components[i].unit,
            **{"state" if i < len(coordinates.state) else "sensor": components[i].address},
        )
        for i in kept
    )
    return Outputs(outputs=outputs, space=space), noise


def _correlated_columns(
    block: Correlated, columns: list[str], covariance: Array, strides: np.ndarray
) -> list[int]:
    """Numbers of the columns of one table `correlated`, which must have no other correlations."""
    for name in block.outputs:
        if name not in columns:
            raise ExperimentError(
                f"correlated.outputs: {unknown_coordinate('output', name, columns)}"
            )
    rows = [columns.index(name) for name in block.outputs]
    others = np.setdiff1d(np.arange(len(columns)), rows)
    fault = ""
    if len(set(rows)) < len(rows):
        fault = "an output is listed twice"
    elif len(set(strides[rows].tolist())) > 1:
        fault = "these outputs are measured at different rates"
    elif np.any(covariance[rows][:, others]):
        fault = "one of them is already correlated with an output that is not listed"
    if fault:
        raise ExperimentError(f"correlated.outputs: {fault}: {listed(block.outputs)}")
    return rows


def columns_of_keys(coordinates: ModelCoordinates) -> dict[str, list[str]]:
    """Columns for which each key of the table `noise` is valid."""
    stated = [component.name for component in coordinates.state if not component.is_added]
    found: dict[str, list[str]] = {"state": stated}
    for component in coordinates.state:
        found[component.name] = [component.name]
        for group in component.groups:
            found.setdefault(group, []).append(component.name)

    # Where a sensor has the name of a key of the state, the key means the state.
    columns_of_sensor: dict[str, list[str]] = {}
    for number in coordinates.sensors:
        columns_of_sensor.setdefault(number.groups[0], []).append(number.name)
    return found | {k: columns for k, columns in columns_of_sensor.items() if k not in found}


def _noise_of_mjcf(coordinates: ModelCoordinates, *, required: bool) -> dict[str, Any]:
    """Standard deviations of the sensors whose `noise` the MJCF states.

    They are used if the experiment states no noise. Raises ExperimentError if `required` and the
    MJCF states none either.
    """
    stated = {each.groups[0]: each.sigma for each in coordinates.sensors if each.sigma > 0}
    if required and not stated:
        valid = listed(["state", *coordinates.measurable])
        raise ExperimentError(
            "noise: no output is measured; state `state` or outputs by name here, or `noise` of "
            f"sensors in the MJCF; valid: {valid}"
        )
    return stated


def _key_covariance(key: str, stated: float | NoiseSpec, sigma_factors: Array) -> Array:
    """(n, n) covariance of the n columns of one key."""
    n = len(sigma_factors)
    spec = stated if isinstance(stated, NoiseSpec) else NoiseSpec(sigma=stated)
    if spec.covariance is not None:
        if (sigma_factors != 1.0).any():
            raise ExperimentError(f"{key}: an orientation takes one sigma [rad] and no covariance")
        return _checked_covariance(f"{key}.covariance", spec.covariance, n)

    sigma = np.asarray(spec.sigma, dtype=np.float64)
    if sigma.ndim and len(sigma) != n:
        raise ExperimentError(
            f"{key}.sigma: {len(sigma)} numbers; expected one, or one for each of {n} components"
        )
    return np.diag((sigma * sigma_factors) ** 2)


def _checked_covariance(key: str, rows: tuple[tuple[float, ...], ...], n: int) -> Array:
    """(n, n) stated covariance.

    Raises ExperimentError unless it is symmetric and positive definite.
    """
    if len(rows) != n or any(len(row) != n for row in rows):
        raise ExperimentError(f"{key}: expected {n} rows of {n} numbers, one per output")

    matrix = np.array(rows, dtype=np.float64)
    if not np.allclose(matrix, matrix.T, rtol=1e-9, atol=0.0):
        raise ExperimentError(f"{key}: not symmetric")
    if not np.linalg.eigvalsh(matrix)[0] > DEFINITENESS * np.abs(matrix).max():
        raise ExperimentError(
            f"{key}: not positive definite; variances must exceed what the correlations imply"
        )
    return matrix


# Numbers of a law that give it an integral if they are parameters.
INTEGRAL_NUMBERS = ("ki", "integral")


def resolve_controllers(
    experiment: Experiment, source: ModelSource
) -> tuple[ModelSource, ControlLaws | None]:
    """Resolve the table `[controllers]`.

    Args:
        experiment: The experiment.
        source: Its model, with the terms of the experiment.

    Returns:
        The model with the numbers of the laws, and the laws; the model itself and None where the
        experiment states no law.

    Raises:
        ExperimentError: A law does not fit the model; the message names its key.
    """
    stated = experiment.controllers
    if not stated:
        return source, None

    joints = {name: _joint(source, name, spec) for name, spec in stated.items()}
    numbers = {
        name: _numbers(source.model, name, spec, joints[name]) for name, spec in stated.items()
    }
    source = with_laws(source, numbers)
    inputs: list[InputColumn] = []
    laws: list[ControlLaw] = []
    for control, actuator in enumerate(source.coordinates.controls):
        if actuator not in stated:
            inputs.append((f"ctrl:{actuator}", "", control))
            continue

        spec, joint = stated[actuator], joints[actuator]
        read = dict(_columns(source.model, actuator, spec, joint))
        columns = {quantity: len(inputs) + i for i, quantity in enumerate(read)}
        inputs += read.values()
        laws.append(
            ControlLaw(
                actuator=actuator,
                control=control,
                joint=joint.name,
                q=joint.q,
                v=joint.v,
                first=first_number(source.model, actuator),
                tick=_tick(experiment, actuator, spec, source.model.opt.timestep),
                columns=columns,
                interpolated=spec.interpolation == "linear",
                differences=spec.velocity == "difference",
                reference_differences=spec.reference_velocity == "difference",
                integrates=_integrates(experiment, actuator, spec),
                replaces_servo=bool(numbers[actuator]["servo"]),
            )
        )
    return source, ControlLaws(laws=tuple(laws), inputs=tuple(inputs))


def _joint(source: ModelSource, actuator: str, spec: ControllerSpec) -> ScalarJoint:
    """The joint whose position a law controls."""
    # A term may have moved the actuator from its joint to a tendon.
    stated = source.stated
    model = stated.model
    key = f"controllers.{actuator}"
    names = actuator_names(model)
    if actuator not in names:
        raise ExperimentError(f"controllers: {unknown('actuator', actuator, names)}")

    number = names.index(actuator)
    if model.actuator_ctrlnum[number] != 1:
        raise ExperimentError(
            f"{key}: the actuator has {model.actuator_ctrlnum[number]} controls, and a law "
            "computes one; its own gains in the MJCF are its law"
        )

    joints = {joint.name: joint for joint in source.coordinates.scalar_joints}
    if spec.joint is not None:
        if spec.joint not in joints:
            raise ExperimentError(
                f"{key}.joint: {unknown('slide or hinge joint', spec.joint, joints)}"
            )
        return joints[spec.joint]

    driven = [
        joints[joint.name]
        for joint in stated.coordinates.scalar_joints
        if acts_at_joint(model, number) and joint.joint == model.actuator_trnid[number, 0]
    ]
    if not driven:
        raise ExperimentError(
            f"{key}: the actuator acts on no slide or hinge joint; state the joint whose position "
            f"the law controls: {key}.joint = {next(iter(joints), '<joint>')!r}"
        )
    return driven[0]


def _numbers(
    model: Any, actuator: str, spec: ControllerSpec, joint: ScalarJoint
) -> dict[str, float]:
    """Numbers of a law by their names among the custom numbers of a model."""
    number = actuator_names(model).index(actuator)
    has_gain = "kp" in spec.model_fields_set
    is_servo = has_gain and commanded_joint(model, number) == joint.joint
    is_servo &= actuator_gear(model, number) == 1.0
    # The control of a servo is no force.
    limited, ranges, place = model.actuator_forcelimited, model.actuator_forcerange, number
    if not is_servo:
        place = int(model.actuator_ctrladr[number])
        limited, ranges = model.actuator_ctrllimited, model.actuator_ctrlrange
    low, high = -np.inf, np.inf
    if spec.saturation is not None:
        low, high = spec.saturation
    elif limited[place]:
        low, high = ranges[place].tolist()

    stated = {name: getattr(spec, name) for name in NUMBERS if not name.startswith("saturation_")}
    return {
        **{name: np.inf if number is None else number for name, number in stated.items()},
        "joint": float(joint.joint),
        "kind": float(KINDS.index(spec.kind)),
        "servo": float(is_servo),
        "saturation_low": low,
        "saturation_high": high,
    }


def _columns(
    model: Any, actuator: str, spec: ControllerSpec, joint: ScalarJoint
) -> Iterator[tuple[Quantity, InputColumn]]:
    """Columns of the log that a law reads, by quantity."""
    number = actuator_names(model).index(actuator)
    control = unit_of_control(model, number, joint.unit, spec.kind)
    wanted: dict[Quantity, tuple[bool, str]] = {
        "reference": (True, joint.unit),
        "reference_velocity": (spec.reference_velocity == "column", per_second(joint.unit)),
        "feedforward": (spec.feedforward, control),
        "gain": (spec.gain, ""),
        "enable": (spec.enable, ""),
    }
    for quantity, (is_read, unit) in wanted.items():
        if is_read:
            yield quantity, (f"{quantity}:{actuator}", unit, None)


def _tick(experiment: Experiment, actuator: str, spec: ControllerSpec, timestep: float) -> int:
    """Engine steps from one evaluation of a law to the next.

    Raises ExperimentError if this is not a whole number.
    """
    rate = spec.rate or experiment.rate
    ticks = whole_number(1.0 / (rate * timestep))
    if ticks is None:
        raise ExperimentError(
            f"controllers.{actuator}.rate: {rate:g} Hz does not divide the rate of the engine "
            f"({1.0 / timestep:g} Hz, timestep {timestep:g} s of the MJCF); valid for example: "
            f"{parts_of(1.0 / timestep)} Hz"
        )
    return ticks


def _integrates(experiment: Experiment, actuator: str, spec: ControllerSpec) -> bool:
    """Whether a law may have an integral, by its gain or because its gain is a parameter."""
    paths = {f"controller/{actuator}:{name}" for name in INTEGRAL_NUMBERS}
    targets = [target.path for p in experiment.parameters.values() for target in p.all_targets]
    return spec.ki > 0.0 or not paths.isdisjoint(targets)

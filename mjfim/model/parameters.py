"""Unknown parameters of an experiment: guesses, bounds, scales, priors and targets.

Bounds that physics sets to parameters hold in every fit unless others are stated.
"""

from __future__ import annotations

from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import numpy as np
import scipy

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError
from mjfim.model.control_laws import FIELDS as LAW_FIELDS
from mjfim.model.elements import element_name
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS, body_inertia
from mjfim.model.paths import INERTIAL_FIELDS, ParameterPath
from mjfim.model.targets import (
    InertiaField,
    InitialStateField,
    ModelField,
    OutputBiasField,
    OutputDelayField,
    OutputScaleField,
    OutsideField,
    RotationField,
    SpecField,
    TargetField,
    TermField,
)
from mjfim.model.terms.term import Term, TermQuantity
from mjfim.model.variants import AS_COMPILED, MocapPlacement

# Fields of a body that change its inertial frame, so that the body must not be compiled as
# "simple". Mass and principal inertias are not among them: a body stays simple whatever they are,
# and MuJoCo gives a body that only slides another constraint weight if it is not simple.
FRAME_FIELDS = {"pos", "ipos", "rot", *INERTIAL_FIELDS}

# Parametrisation of a body's inertia -> arrays of MjModel that may be varied together with it.
ARRAYS_BESIDE_INERTIA = {
    "central": {"body_mass", "body_ipos"},
    "barycentric": {"body_mass"},
    "logcholesky": set[str](),
}

# Arrays of MjModel that hold the inertia of a body.
INERTIAL_ARRAYS = ("body_mass", "body_ipos", "body_inertia")

# A function that edits an MjSpec in place at the value of one parameter.
SpecEdit = Callable[[Any, float], None]

# Fields that cannot be negative, by kind of element. Bodies are not among them: their masses and
# inertias are kept physical together, see `ParameterWriter.unphysical_bodies`.
NOT_NEGATIVE = {
    "joint": ("damping", "frictionloss", "armature", "stiffness"),
    "tendon": ("damping", "frictionloss", "armature", "stiffness"),
    "geom": ("mass", "density", "size", "friction"),
    "pair": ("friction",),
    "option": ("density", "viscosity"),
    "controller": tuple(name for name in LAW_FIELDS if name not in ("saturation", "integral")),
}

# Largest deviation of a sample from the centre of its prior [standard deviations].
MAX_DEVIATION = 2.5

# Number of times that the distance of a sample from the guess is halved until its bodies are
# physical; then it is set to zero.
MAX_HALVINGS = 20

# A sample of the prior of a scalar is at least this share of the scalar's value, so that it does
# not change its sign.
MIN_SHARE_OF_VALUE = 0.05


@record
class Target:
    """One number inside a model, which becomes `scale * theta_j + offset`.

    Attributes:
        path: Parameter path of the number.
        field: The field that the path leads to.
        scale: Factor of the parameter.
        offset: Constant that is added [unit of the number].
        term: Field of a physical term that the path names; None for other paths.
    """

    path: str
    field: TargetField
    scale: float = 1.0
    offset: float = 0.0
    term: TermQuantity | None = None

    @property
    def plain_paths(self) -> tuple[str, ...]:
        """Paths of the numbers of the model; those of a physical term are in its elements."""
        if self.term is None:
            return (self.path,)
        return tuple(path for path, _ in self.term.numbers)


@record
class Parameter:
    """One unknown. Values are in the unit of its targets.

    Attributes:
        name: Name, unique in the experiment.
        targets: Numbers that it determines.
        guess: Value at which the design is made.
        true: Value for simulated studies, or None.
        bounds: Smallest and largest value.
        scale: Unit in which its information is compared with that of other parameters.
        prior: Standard deviation of the prior, or None.
        unit: Its unit; empty where it has none.
        size: Order of magnitude, to which the steps of finite differences are relative. With 0,
            the magnitude of the guess is taken, or the scale where the guess is 0.
        function: Edits an MjSpec in place, `function(spec, theta_j)`, instead of targets.
        nuisance: Whether it is unknown but of no interest, so that the design spends no effort on
            it.
        wanted: Standard deviation aimed at, or None.
        published: Value with which estimates are compared, or None.
        group: Name of the group with which it was declared; empty for a single parameter.
        per_recording: Whether every recording has a separate value.
        cad_prior: For a coordinate of a body's inertia, the standard deviation of the logarithm of
            the pseudo-inertia relative to the model's; None where the model is no prior knowledge.
    """

    name: str
    targets: tuple[Target, ...]
    guess: float
    true: float | None = None
    bounds: tuple[float, float] = (-np.inf, np.inf)
    scale: float = 1.0
    prior: float | None = None
    unit: str = ""
    size: float = 0.0
    function: SpecEdit | None = None
    nuisance: bool = False
    wanted: float | None = None
    published: float | None = None
    group: str = ""
    per_recording: bool = False
    cad_prior: float | None = None


def targets_of(parameters: Iterable[Parameter]) -> Iterator[tuple[Parameter, Target]]:
    """Every target with its parameter."""
    for parameter in parameters:
        for target in parameter.targets:
            yield parameter, target


def moved_bodies(parameters: Sequence[Parameter]) -> frozenset[str]:
    """Names of bodies whose inertial frame a parameter may move.

    These bodies must not be compiled as "simple".
    """
    paths = [
        ParameterPath.parse(text)
        for _, target in targets_of(parameters)
        for text in target.plain_paths
    ]
    return frozenset(
        path.name
        for path in paths
        if path.kind == "body" and path.field in FRAME_FIELDS and path.name
    )


@dataclass(frozen=True, eq=False)
class ParameterSet:
    """All p parameters of an experiment, in the order of theta, resolved against a model.

    Attributes:
        parameters: The parameters.
        nominal: Values in the model of quantities that are written as a whole: (10,) coordinates of
            an inertia by (parametrisation, body), (4,) quaternions by (array, row).
        mocap: Where mocap bodies start.
        whole_terms: Physical terms of the model that are written as a whole.
        earlier_rows: (l, p) rows R of what an earlier estimate knows: `|R (theta - guess)|^2` are
            squared standard deviations; None where there is no such knowledge.
    """

    parameters: tuple[Parameter, ...]
    nominal: dict[tuple[str, int], Array] = field(default_factory=dict)
    mocap: MocapPlacement = AS_COMPILED
    whole_terms: tuple[Term, ...] = ()
    earlier_rows: Array | None = None

    @staticmethod
    def build(
        parameters: Sequence[Parameter],
        model: Any,
        mocap: MocapPlacement = AS_COMPILED,
        terms: Iterable[Term] = (),
    ) -> ParameterSet:
        """Check that parameters can be varied together, and read their nominal values.

        Args:
            parameters: The parameters, in the order of theta.
            model: The compiled model (`mujoco.MjModel`).
            mocap: Where mocap bodies start.
            terms: Physical terms by which the model is extended.

        Raises:
            ExperimentError: Two parameters contradict each other, or a keyframe contradicts one;
                the message names them.
        """
        compatible = _in_one_parametrisation(parameters)
        _require_one_owner(compatible)
        _require_movable(compatible, model, mocap)
        whole = tuple(term for term in terms if term.is_written_as_a_whole)
        return ParameterSet(compatible, _nominal_values(compatible, model), mocap, whole)

    def __len__(self) -> int:
        return len(self.parameters)

    @cached_property
    def workspace(self) -> list[Any]:
        """The MjData of the models that are written; empty until it is needed."""
        return []

    @property
    def names(self) -> tuple[str, ...]:
        """The p names."""
        return tuple(p.name for p in self.parameters)

    @property
    def guess(self) -> Array:
        """(p,) values at which the design is made."""
        return self._values(lambda p: p.guess)

    @property
    def true(self) -> Array:
        """(p,) true values; the guess where none is stated."""
        return self._values(lambda p: p.guess if p.true is None else p.true)

    @property
    def lower(self) -> Array:
        """(p,) lower bounds."""
        return self._values(lambda p: p.bounds[0])

    @property
    def upper(self) -> Array:
        """(p,) upper bounds."""
        return self._values(lambda p: p.bounds[1])

    @property
    def scale(self) -> Array:
        """(p,) units in which information is compared."""
        return self._values(lambda p: p.scale)

    @cached_property
    def magnitude(self) -> Array:
        """(p,) magnitudes to which finite-difference steps are relative."""
        return self._values(lambda p: p.size or abs(p.guess) or p.scale)

    @property
    def wanted(self) -> Array:
        """(p,) standard deviations aimed at, infinite where none is stated [theta-unit]."""
        return self._values(lambda p: np.inf if p.nuisance or p.wanted is None else p.wanted)

    @property
    def published(self) -> Array:
        """(p,) values with which estimates are compared, NaN where none is stated [theta-unit]."""
        return self._values(lambda p: np.nan if p.published is None else p.published)

    def sizes(self, theta: Array) -> Array:
        """(p,) sizes with which standard deviations are compared, all positive [theta-unit].

        The size of a single number is its magnitude. An entry of a vector or tensor has the
        magnitude of the whole, because the entry itself may be zero.

        Args:
            theta: (p,) values.
        """
        pairs = zip(self.parameters, theta, self.magnitude, strict=True)
        return np.array(
            [
                abs(value) if p.size == abs(p.guess) and value != 0.0 else magnitude
                for p, value, magnitude in pairs
            ]
        )

    @property
    def prior_information(self) -> Array:
        """(p, p) information of the stated priors and of an earlier estimate [1/theta^2]."""
        return self.prior_rows.T @ self.prior_rows

    @property
    def prior_rows(self) -> Array:
        """(l, p) rows R of all prior knowledge, whose residuals are `R (theta - guess)`."""
        weight = self.prior_weight
        stated = np.diag(weight)[weight > 0.0]
        if self.earlier_rows is None:
            return stated
        return np.concatenate([stated, self.earlier_rows])

    @property
    def prior_weight(self) -> Array:
        """(p,) inverse standard deviations of the stated priors; 0 without one [1/theta-unit]."""
        return self._values(lambda p: 0.0 if p.prior is None else 1.0 / p.prior)

    @property
    def interest(self) -> np.ndarray:
        """Indices of the parameters of interest, which are no nuisance."""
        nuisance = np.array([p.nuisance for p in self.parameters], dtype=bool)
        return np.flatnonzero(~nuisance)

    def initial_state_derivative(self, nx: int) -> Array:
        """(nx, p) derivative of the initial state, in the tangent space."""
        return self._derivative(InitialStateField, nx)

    def bias_derivative(self, ny: int) -> Array:
        """(ny, p) derivative of every output by constant biases."""
        return self._derivative(OutputBiasField, ny)

    def scale_derivative(self, ny: int) -> Array:
        """(ny, p) derivative of the relative scale error of every output."""
        return self._derivative(OutputScaleField, ny)

    @cached_property
    def delay_derivative(self) -> Array:
        """(p,) derivative of the time by which outputs lag [s / theta-unit]."""
        return np.asarray(self._derivative(OutputDelayField, 1)[0])

    def _derivative(self, kind: type[OutsideField], rows: int) -> Array:
        """(rows, p) derivative of what fields outside the model stand for."""
        matrix = np.zeros((rows, len(self)))
        for j, target in self.targets():
            if isinstance(target.field, kind):
                matrix[target.field.row, j] += target.scale
        return matrix

    @cached_property
    def outside_model(self) -> np.ndarray:
        """(p,) True where a parameter concerns the initial state or the measurement."""
        return self._has_field(OutsideField)

    @cached_property
    def initial_deviations(self) -> np.ndarray:
        """(p,) True for nuisance deviations of the initial state."""
        nuisance = np.array([p.nuisance for p in self.parameters], dtype=bool)
        return np.asarray(nuisance & self._has_field(InitialStateField))

    @cached_property
    def recording_specific(self) -> np.ndarray:
        """(p,) True where every experiment and recording has a separate value.

        Deviations of the initial state always have one.
        """
        stated = np.array([p.per_recording for p in self.parameters], dtype=bool)
        return np.asarray(self.initial_deviations | stated)

    @cached_property
    def changes_model(self) -> np.ndarray:
        """(p,) True where a parameter changes the model."""
        inside = (ModelField, InertiaField, RotationField, SpecField, TermField)
        return np.asarray(self._is_function | self._has_field(inside))

    @cached_property
    def changes_motion(self) -> np.ndarray:
        """(p,) True where a parameter changes the motion, by the model or the initial state."""
        return np.asarray(self.changes_model | self._has_field(InitialStateField))

    @cached_property
    def needs_compile(self) -> np.ndarray:
        """(p,) True where a change needs a compile."""
        return np.asarray(self._is_function | self._has_field(SpecField))

    @cached_property
    def moved_bodies(self) -> frozenset[str] | None:
        """Bodies whose inertial frame parameters move; None where a parameter may move any."""
        return None if self.needs_compile.any() else moved_bodies(self.parameters)

    @property
    def changes_friction(self) -> bool:
        """True where a parameter may change dry friction, even one that is nominally zero."""
        paths = [target.path for _, target in self.targets()]
        return bool(self._is_function.any()) or any("frictionloss" in path for path in paths)

    @property
    def _is_function(self) -> np.ndarray:
        """(p,) True where a parameter has a function of the MjSpec instead of targets."""
        return np.array([p.function is not None for p in self.parameters], dtype=bool)

    def _values(self, pick: Callable[[Parameter], float]) -> Array:
        """(p,) values of one attribute of all parameters."""
        return np.array([pick(p) for p in self.parameters])

    def _has_field(self, kinds: type | tuple[type, ...]) -> np.ndarray:
        """(p,) True where a parameter has a field of one of these kinds."""
        found = np.zeros(len(self), dtype=bool)
        for j, target in self.targets():
            found[j] |= isinstance(target.field, kinds)
        return found

    def targets(self) -> Iterator[tuple[int, Target]]:
        """Every target with the index of its parameter."""
        for j, parameter in enumerate(self.parameters):
            for target in parameter.targets:
                yield j, target


def _parameter_error(parameter: Parameter, fault: str) -> ExperimentError:
    """Exception that names a parameter and says what is wrong with it."""
    return ExperimentError(f"parameters.{parameter.name}: {fault}")


def _in_one_parametrisation(parameters: Sequence[Parameter]) -> tuple[Parameter, ...]:
    """The parameters with one parametrisation for the inertia of every body.

    `mass` beside first moments becomes the mass of the barycentric parametrisation.

    Raises:
        ExperimentError: Parametrisations of one body are mixed.
    """
    # Parametrisations, and inertial arrays of MjModel, that are varied for each body.
    varied: dict[int, set[str]] = {}
    for _, target in targets_of(parameters):
        body, coordinates = _inertia_of(target.field)
        varied.setdefault(body, set()).add(coordinates)

    for parameter, target in targets_of(parameters):
        _require_compatible(parameter, varied[_inertia_of(target.field)[0]])

    def converted(target: Target) -> Target:
        """The target; its field is the barycentric mass where first moments are varied."""
        body, coordinates = _inertia_of(target.field)
        if coordinates == "body_mass" and "barycentric" in varied[body]:
            return replace(target, field=InertiaField(body, "barycentric", 0))
        return target

    return tuple(
        replace(parameter, targets=tuple(converted(target) for target in parameter.targets))
        for parameter in parameters
    )


def _inertia_of(target_field: TargetField) -> tuple[int, str]:
    """The body whose inertia a field varies, and its parametrisation or array; -1 for none."""
    if isinstance(target_field, InertiaField):
        return target_field.body, target_field.parametrisation
    if isinstance(target_field, ModelField) and target_field.array in INERTIAL_ARRAYS:
        return target_field.rows[0], target_field.array
    return -1, ""


def _require_compatible(parameter: Parameter, varied: set[str]) -> None:
    """Raise unless the parameters of one body's inertia can be varied together.

    Args:
        parameter: Parameter of the body, for the message.
        varied: Parametrisations and arrays of MjModel in which its inertia is varied.
    """
    parametrisations = varied & INERTIA_PARAMETRISATIONS.keys()
    fits = [varied <= {each, *ARRAYS_BESIDE_INERTIA[each]} for each in parametrisations]
    if not fits or any(fits):
        return

    mixed = sorted(name.removeprefix("body_") for name in varied)
    raise _parameter_error(
        parameter,
        f"the inertia of one body is varied in several coordinates at once ({', '.join(mixed)}); "
        "valid together: mass, ipos and inertia; mass, ipos and fullinertia; mass, firstmoment "
        "and origininertia; logcholesky alone",
    )


def _require_one_owner(parameters: Sequence[Parameter]) -> None:
    """Raise where two targets write one number."""
    owners: dict[object, str] = {}
    for parameter, target in targets_of(parameters):
        # A field that is written as a whole counts as one number.
        numbers = getattr(target.field, "numbers", {target.field})
        other = next((owners[number] for number in numbers if number in owners), None)
        if other is not None:
            raise _parameter_error(
                parameter,
                f"target {target.path!r} already belongs to parameters.{other}; two parameters "
                "cannot set one number",
            )

        owners |= dict.fromkeys(numbers, parameter.name)


def _require_movable(parameters: Sequence[Parameter], model: Any, mocap: MocapPlacement) -> None:
    """Raise where a parameter moves a mocap body whose pose a keyframe states."""
    for parameter, target in targets_of(parameters):
        if isinstance(target.field, RotationField):
            array, row = target.field.whole
        elif isinstance(target.field, ModelField):
            array, row = target.field.array, target.field.rows[0]
        else:
            continue

        if array in ("body_pos", "body_quat") and row in mocap.bodies:
            name = element_name(model, "body", row)
            raise _parameter_error(
                parameter,
                f"the keyframe states the pose of mocap body {name!r}; remove its mpos and mquat "
                "from the keyframe, or the parameter from the experiment",
            )


def _nominal_values(parameters: Sequence[Parameter], model: Any) -> dict[tuple[str, int], Array]:
    """Values of inertias and orientations in the model, as in `ParameterSet.nominal`."""
    nominal: dict[tuple[str, int], Array] = {}
    for parameter, target in targets_of(parameters):
        place = target.field
        if isinstance(place, InertiaField):
            try:
                place.read(model)
            except ExperimentError as error:
                raise _parameter_error(parameter, str(error)) from None
            parametrisation = INERTIA_PARAMETRISATIONS[place.parametrisation]
            inertia = body_inertia(model, place.body)
            nominal[place.whole] = parametrisation.coordinates(inertia)
        elif isinstance(place, RotationField):
            nominal[place.whole] = np.array(getattr(model, place.array)[place.row])
    return nominal


def physical_bounds(targets: Iterable[Target]) -> tuple[float, float]:
    """Range of a parameter in which all of its targets are physical.

    Args:
        targets: Numbers inside the model that the parameter sets, each to `scale * parameter +
            offset`.

    Returns:
        Lower and upper bound [parameter unit]; infinite where physics sets none.
    """
    low, high = -np.inf, np.inf
    for target in targets:
        # Values of the parameter at which the target is at its bounds; 0.0 makes no -0.0 of them.
        ends = sorted((bound - target.offset) / target.scale + 0.0 for bound in _bounds_of(target))
        low, high = max(low, ends[0]), min(high, ends[1])
    return low, high


def _bounds_of(target: Target) -> tuple[float, float]:
    """Smallest and largest physical value of a target [unit of the number]."""
    if target.term is not None:
        return target.term.bounds

    path = ParameterPath.parse(target.path)
    if path.field not in NOT_NEGATIVE.get(path.kind, ()):
        return -np.inf, np.inf

    # A coefficient of higher order may be negative while the whole force brakes: dry friction that
    # decreases with the speed has one.
    if path.kind == "joint" and path.component > 0:
        return -np.inf, np.inf
    return 0.0, np.inf


def sample_parameters(
    parameters: ParameterSet,
    theta: Array,
    count: int,
    seed: int,
    unphysical: Callable[[Array], Sequence[int]] | None = None,
    key: str = "robust",
) -> Array:
    """Sample the parameters from their priors or bounds.

    The first sample is theta; the others form a Latin hypercube over normal priors or, without a
    prior, uniformly over the bounds. Samples of a prior stay within the bounds and within 2.5
    standard deviations, and do not change the sign of a scalar (a mass, a damping). Parameters with
    neither prior nor bounds, and those outside the model, stay at theta. Where bodies of a sample
    are unphysical, the distance of the parameters that determine them from theta is halved until
    they are physical.

    Args:
        parameters: The parameters.
        theta: (p,) values about which priors are centred.
        count: Number of samples, theta included.
        seed: Seed of the random numbers.
        unphysical: Gives for a sample (p,) the indices of the parameters that determine unphysical
            bodies; None for no check.
        key: What of the experiment asks for samples, for messages.

    Returns:
        (count, p) samples.

    Raises:
        ExperimentError: No parameter has a prior or bounds.
    """
    free = [
        j
        for j, parameter in enumerate(parameters.parameters)
        if (parameter.prior is not None or np.isfinite(parameter.bounds).all())
        and not parameters.outside_model[j]
    ]
    if not free:
        raise ExperimentError(
            f"{key}: no parameter has a prior or bounds to sample from; state `prior` or `bounds`"
        )

    samples = np.tile(theta, (count, 1))
    if count > 1:
        generator = np.random.default_rng(seed)
        quantiles = scipy.stats.qmc.LatinHypercube(len(free), rng=generator).random(count - 1)
        for column, j in enumerate(free):
            parameter = parameters.parameters[j]
            samples[1:, j] = _values(parameter, float(theta[j]), quantiles[:, column])

    if unphysical is not None:
        for sample in samples[1:]:
            make_physical(sample, theta, unphysical)
    return samples


def _values(parameter: Parameter, value: float, quantiles: Array) -> Array:
    """Values of a parameter (n,) at quantiles (n,) of its distribution about a value."""
    low, high = parameter.bounds
    if parameter.prior is None:
        return low + (high - low) * quantiles

    # A parameter whose magnitude is that of its guess is a scalar, which keeps its sign.
    is_scalar = parameter.size == abs(parameter.guess)
    if is_scalar and value > 0.0:
        low = max(low, MIN_SHARE_OF_VALUE * value)
    elif is_scalar and value < 0.0:
        high = min(high, MIN_SHARE_OF_VALUE * value)

    deviations = np.clip(scipy.special.ndtri(quantiles), -MAX_DEVIATION, MAX_DEVIATION)
    return np.asarray(np.clip(value + parameter.prior * deviations, low, high))


def make_physical(
    sample: Array, theta: Array, unphysical: Callable[[Array], Sequence[int]]
) -> None:
    """Move a sample in place towards theta until its bodies are physical.

    Args:
        sample: (p,) parameters, which are changed.
        theta: (p,) parameters of physical bodies.
        unphysical: Gives for a sample the indices of the parameters that determine unphysical
            bodies.
    """
    for _ in range(MAX_HALVINGS):
        columns = list(unphysical(sample))
        if not columns:
            return
        sample[columns] = 0.5 * (sample[columns] + theta[columns])

    while columns := list(unphysical(sample)):
        # A sample at theta cannot be moved any closer.
        if np.array_equal(sample[columns], theta[columns]):
            return
        sample[columns] = theta[columns]

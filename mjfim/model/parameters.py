"""What can be identified: guess, bounds, scale, prior of each unknown, and the only writer into a model.

Values go into private copies in place, followed by `mj_setConst`; what only a compile can follow (sizes of geoms, functions
of an MjSpec) is compiled anew. Tests hold one against the other.
"""

from __future__ import annotations

import copy
from collections.abc import Callable, Collection, Sequence
from dataclasses import dataclass
from dataclasses import field as record_field
from functools import cached_property
from typing import Any

import mujoco
import numpy as np
from scipy.spatial.transform import Rotation

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS
from mjfim.model.mujoco_log import silence_mujoco_log
from mjfim.model.paths import INERTIAL_FIELDS, PATH, resolve
from mjfim.model.spec_writer import write_element
from mjfim.model.targets import (
    InertiaField,
    InitialStateField,
    ModelField,
    OutputBiasField,
    OutputDelayField,
    RotationField,
    SpecField,
    TargetField,
    inertial,
)
from mjfim.model.variants import Mocap, Source

INERTIAL = {"pos", "ipos", "inertia", "mass", "rot", *INERTIAL_FIELDS}
Function = Callable[[Any, float], None]
ROUNDED = 1e-6  # relative: by how much moments of a plate or rod, typed with few digits, may miss what a body can have
OUTSIDE = (InitialStateField, OutputBiasField, OutputDelayField)  # of the model


@dataclass(frozen=True)
class Target:
    """One number inside a model: it becomes `scale * theta_j + offset`."""

    path: str
    scale: float = 1.0
    offset: float = 0.0


@dataclass(frozen=True)
class Parameter:
    """One unknown. Values in the raw unit of its targets.

    guess: where the design is made;  true: for simulated studies, or None;  bounds: (lower, upper)
    scale: the unit in which information about it is compared with the others;  prior: standard deviation, or None
    size: its own order of magnitude, to which difference steps are relative; 0 = the guess's, else the scale
    function: edits an MjSpec in place, `function(spec, theta_j)`, instead of targets
    nuisance: unknown but not wanted: the design does not spend effort on it;  wanted: standard deviation aimed at, or None
    group: name of the group that it was declared with, or empty;  per_recording: every recording has its own value
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
    function: Function | None = None
    nuisance: bool = False
    wanted: float | None = None
    group: str = ""
    per_recording: bool = False


def moved_bodies(parameters: Sequence[Parameter]) -> set[str]:
    """Names of bodies whose inertial frame a parameter may move (they must not be compiled as 'simple')."""
    matches = [PATH.match(t.path) for p in parameters for t in p.targets]
    return {
        m["name"]
        for m in matches
        if m and m["kind"] == "body" and m["field"] in INERTIAL and m["name"]
    }


@dataclass(frozen=True, eq=False)
class ParameterSet:
    """All parameters of an experiment, in the order of theta, resolved against a model.

    nominal: (10,) coordinates of every inertia that is written in a chart, by (body, chart), and quaternions by (array, row)
    mocap: where mocap bodies start, None: as compiled
    """

    parameters: tuple[Parameter, ...]
    fields: tuple[tuple[TargetField, ...], ...]
    nominal: dict[tuple[str, int], Array] = record_field(default_factory=dict)
    mocap: Mocap | None = None
    _cache: dict[str, Any] = record_field(default_factory=dict, repr=False)

    @staticmethod
    def build(
        parameters: Sequence[Parameter],
        model: Any,
        outputs: Sequence[str] = (),
        decoration: Collection[str] = frozenset(),
        mocap: Mocap | None = None,
    ) -> ParameterSet:
        """Resolve every target (`paths.resolve`). Raises ExperimentError naming the parameter and the path."""
        fields: list[tuple[TargetField, ...]] = []
        for parameter in parameters:
            try:
                fields.append(
                    tuple(resolve(model, t.path, outputs, decoration) for t in parameter.targets)
                )
            except ExperimentError as error:
                raise ExperimentError(f"parameters.{parameter.name}: {error}") from None
        fields = _in_charts(parameters, fields)
        owner: dict[TargetField, str] = {}
        written: dict[tuple[str, int, int], str] = {}
        for parameter, row in zip(parameters, fields, strict=True):
            for target, field in zip(parameter.targets, row, strict=True):
                numbers = field.numbers if isinstance(field, ModelField) else set()
                other = owner.get(field) or next(
                    (written[n] for n in numbers if n in written), None
                )
                if other is not None:
                    taken = f"target {target.path!r} already belongs to parameters.{other}"
                    raise ExperimentError(
                        f"parameters.{parameter.name}: {taken}; one number takes one parameter"
                    )
                _movable(model, parameter, field, mocap)
                owner[field] = parameter.name
                written |= dict.fromkeys(numbers, parameter.name)
        nominal: dict[tuple[str, int], Array] = {}
        for field, name in owner.items():
            if isinstance(field, InertiaField):
                try:
                    field.read(model)
                except ExperimentError as error:
                    raise ExperimentError(f"parameters.{name}: {error}") from None
                nominal[field.chart, field.body] = INERTIA_PARAMETRISATIONS[field.chart].of(
                    inertial(model, field.body)
                )
            elif isinstance(field, RotationField):
                nominal[field.array, field.row] = np.array(getattr(model, field.array)[field.row])
        return ParameterSet(tuple(parameters), tuple(fields), nominal, mocap)

    def __len__(self) -> int:
        return len(self.parameters)

    def _column(self, pick: Callable[[Parameter], float]) -> Array:
        return np.array([pick(p) for p in self.parameters])

    @property
    def names(self) -> tuple[str, ...]:
        """p names."""
        return tuple(p.name for p in self.parameters)

    @property
    def guess(self) -> Array:
        """(p,) values at which the design is made."""
        return self._column(lambda p: p.guess)

    @property
    def true(self) -> Array:
        """(p,) true values, the guess where none is stated."""
        return self._column(lambda p: p.guess if p.true is None else p.true)

    @property
    def lower(self) -> Array:
        """(p,) lower bounds."""
        return self._column(lambda p: p.bounds[0])

    @property
    def upper(self) -> Array:
        """(p,) upper bounds."""
        return self._column(lambda p: p.bounds[1])

    @property
    def scale(self) -> Array:
        """(p,) units of comparison."""
        return self._column(lambda p: p.scale)

    @cached_property
    def magnitude(self) -> Array:
        """(p,) magnitude to which finite-difference steps are relative."""
        return self._column(lambda p: p.size or abs(p.guess) or p.scale)

    @property
    def prior_information(self) -> Array:
        """(p, p) information of the stated priors."""
        return np.diag(self._column(lambda p: 0.0 if p.prior is None else p.prior**-2))

    @property
    def interest(self) -> np.ndarray:
        """Indices of the parameters that are wanted, i.e. no nuisance."""
        return np.array([j for j, p in enumerate(self.parameters) if not p.nuisance], dtype=np.intp)

    def _linear(self, rows: int, pick: Callable[[TargetField], int | None]) -> Array:
        """(rows, p) matrix of targets that act linearly outside the model."""
        matrix = np.zeros((rows, len(self)))
        for j, (parameter, fields) in enumerate(zip(self.parameters, self.fields, strict=True)):
            for target, field in zip(parameter.targets, fields, strict=True):
                row = pick(field)
                if row is not None:
                    matrix[row, j] += target.scale
        return matrix

    def initial_state_derivative(self, nx: int) -> Array:
        """(nx, p) derivative of the initial state."""
        return self._linear(
            nx, lambda field: field.tangent if isinstance(field, InitialStateField) else None
        )

    def bias_derivative(self, ny: int) -> Array:
        """(ny, p) derivative of every output by constant biases."""
        return self._linear(
            ny, lambda field: field.output if isinstance(field, OutputBiasField) else None
        )

    @cached_property
    def delay_derivative(self) -> Array:
        """(p,) derivative of the time by which outputs lag."""
        return np.asarray(
            self._linear(1, lambda field: 0 if isinstance(field, OutputDelayField) else None)[0]
        )

    def _any(self, kind: Callable[[TargetField], bool]) -> np.ndarray:
        """(p,) True where a parameter has a field of a kind."""
        return np.array(
            [any(kind(field) for field in fields) for fields in self.fields], dtype=bool
        )

    @property
    def _functions(self) -> np.ndarray:
        """(p,) True where a function of the MjSpec stands for targets."""
        return np.array([p.function is not None for p in self.parameters], dtype=bool)

    @cached_property
    def outside_model(self) -> np.ndarray:
        """(p,) True where a parameter concerns the start or the measurement."""
        return self._any(lambda field: isinstance(field, OUTSIDE))

    @cached_property
    def initial_deviations(self) -> np.ndarray:
        """(p,) True for nuisance deviations of the start."""
        nuisance = np.array([p.nuisance for p in self.parameters], dtype=bool)
        return np.asarray(nuisance & self._any(lambda field: isinstance(field, InitialStateField)))

    @cached_property
    def recording_specific(self) -> np.ndarray:
        """(p,) True for deviations of the start and what else every experiment and recording has its own value of."""
        return np.asarray(
            self.initial_deviations
            | np.array([p.per_recording for p in self.parameters], dtype=bool)
        )

    @cached_property
    def changes_model(self) -> np.ndarray:
        """(p,) True where a parameter changes the model."""
        return np.asarray(self._functions | self._any(lambda field: not isinstance(field, OUTSIDE)))

    @cached_property
    def changes_motion(self) -> np.ndarray:
        """(p,) True where a parameter changes the motion: through the model or the start."""
        return np.asarray(
            self.changes_model | self._any(lambda field: isinstance(field, InitialStateField))
        )

    @cached_property
    def needs_compile(self) -> np.ndarray:
        """(p,) True where a change needs a compile."""
        return np.asarray(self._functions | self._any(lambda field: isinstance(field, SpecField)))

    def write(self, model: Any, theta: Array) -> None:
        """Write theta: (p,) into a model that the caller owns, in place, then recompute MuJoCo's derived constants.

        What needs a compile is not written here; see `model`.
        """
        if self.mocap is not None:
            self.mocap.put(model, self.mocap.compiled)
        whole = self._write_numbers(model, theta)
        for (kind, row), values in whole.items():
            if kind in INERTIA_PARAMETRISATIONS:
                _write_inertia(model, row, kind, values)
            else:
                turned = Rotation.from_quat(
                    self.nominal[kind, row], scalar_first=True
                ) * Rotation.from_rotvec(values)
                getattr(model, kind)[row] = turned.as_quat(scalar_first=True)
                if kind == "site_quat":
                    model.site_sameframe[row] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE
        with silence_mujoco_log():
            mujoco.mj_setConst(model, self._scratch(model))
        if self.mocap is not None:
            self.mocap.put(model, self.mocap.start)

    def _write_numbers(self, model: Any, theta: Array) -> dict[tuple[str, int], Array]:
        """Write what is a number of its own; returns coordinates of inertias and orientations, by (chart or array, row)."""
        whole: dict[tuple[str, int], Array] = {}
        for parameter, fields, value in zip(self.parameters, self.fields, theta, strict=True):
            for target, field in zip(parameter.targets, fields, strict=True):
                number = target.scale * float(value) + target.offset
                if isinstance(field, ModelField):
                    field.write(model, number)
                elif isinstance(field, InertiaField):
                    key = (field.chart, field.body)
                    whole.setdefault(key, np.array(self.nominal[key]))[field.component] = number
                elif isinstance(field, RotationField):
                    whole.setdefault((field.array, field.row), np.zeros(3))[field.component] = (
                        number
                    )
        return whole

    def unphysical_bodies(
        self, base: Source | Any, theta: Array
    ) -> list[tuple[tuple[int, ...], str]]:
        """Bodies whose inertia at theta: (p,) none can have: indices of the parameters that make it, and the fault in words.

        Raises ModelError where MuJoCo refuses to compile the values.
        """
        makers: dict[int, list[int]] = {}
        for j, fields in enumerate(self.fields):
            for field in fields:
                if isinstance(field, InertiaField):
                    makers.setdefault(field.body, []).append(j)
                elif isinstance(field, ModelField) and field.array in ("body_mass", "body_inertia"):
                    makers.setdefault(field.rows[0], []).append(j)
        own = copy.copy(self.base(base, theta))
        charted = {
            row: (kind, v)
            for (kind, row), v in self._write_numbers(own, theta).items()
            if kind in INERTIA_PARAMETRISATIONS
        }
        found = []
        for body, columns in makers.items():
            fault = _fault(own, body, *charted.get(body, ("", None)))
            if fault:
                name = mujoco.mj_id2name(own, mujoco.mjtObj.mjOBJ_BODY, body)
                found.append((tuple(dict.fromkeys(columns)), f"body {name!r} has {fault}"))
        return found

    def _scratch(self, model: Any) -> Any:
        """Scratch data for `mj_setConst`, shared by all copies of one model."""
        if "data" not in self._cache:
            self._cache["data"] = mujoco.MjData(model)
        return self._cache["data"]

    def model(self, base: Source | Any, theta: Array) -> Any:
        """A private copy of the base model with theta written into it.

        base: a `Source`, or an MjModel where nothing needs a compile. Raises ExperimentError where a function of the MjSpec
        changes the layout of the state.
        """
        own = copy.copy(self.base(base, theta))
        self.write(own, theta)
        return base.settle(own) if isinstance(base, Source) else own

    def base(self, source: Source | Any, theta: Array) -> Any:
        """The model into which theta is written in place: compiled anew where theta needs it, then kept."""
        if not isinstance(source, Source):
            return source
        if not self.needs_compile.any():
            return source.model
        return source.edited(
            np.asarray(theta)[self.needs_compile].tobytes(),
            lambda spec: self._edit(spec, source, theta),
        )

    def _edit(self, spec: Any, source: Source, theta: Array) -> None:
        for j in np.flatnonzero(self.needs_compile):
            parameter = self.parameters[j]
            if parameter.function is not None:
                try:
                    parameter.function(spec, float(theta[j]))
                except Exception as error:
                    raise ExperimentError(
                        f"parameters.{parameter.name}: its function failed: {error}"
                    ) from error
            for target, field in zip(parameter.targets, self.fields[j], strict=True):
                if isinstance(field, SpecField):
                    number = target.scale * float(theta[j]) + target.offset
                    write_element(spec, source.model, source.model, target.path, number)


def _fault(model: Any, body: int, chart: str, values: Array | None) -> str:
    """What is wrong with a body's inertia, or nothing. values: (10,) in a chart, None where the model holds all of it.

    A body that is fixed to others with mass may itself have none.
    """
    mass, moments, missing = float(model.body_mass[body]), np.sort(model.body_inertia[body]), 0.0
    others = model.body_weldid == model.body_weldid[body]
    others[body] = False
    least = (
        0.0 if model.body_weldid[body] == 0 or model.body_mass[others].any() else mujoco.mjMINVAL
    )
    if values is not None:
        mass = float(values[0]) if chart == "barycentric" else mass
        least = mujoco.mjMINVAL if chart == "barycentric" else least
        if chart == "logcholesky":
            return ""
    if not mass >= least:
        return f"mass {mass:g} kg; it must be > 0"
    if values is not None:
        moments = np.linalg.eigvalsh(INERTIA_PARAMETRISATIONS[chart].back(values).inertia)
        missing = float(moments[2] - moments[0] - moments[1])
    if moments[0] >= least and missing <= ROUNDED * moments[2]:
        return ""
    listed = ", ".join(f"{m:.4g}" for m in moments)
    wanted = "all must be > 0"
    if moments[0] >= least:
        wanted = "the smaller two must add up to the largest at least (its pseudo-inertia is not positive semidefinite)"
    return f"principal moments of inertia {listed} kg m²; {wanted}"


def _movable(model: Any, parameter: Parameter, field: TargetField, mocap: Mocap | None) -> None:
    """Raise where a keyframe says where the mocap body is that a parameter moves."""
    if isinstance(field, RotationField):
        array, row = field.array, field.row
    elif isinstance(field, ModelField):
        array, row = field.array, field.rows[0]
    else:
        return
    if mocap is not None and array in ("body_pos", "body_quat") and row in mocap.bodies:
        name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, row)
        raise ExperimentError(
            f"parameters.{parameter.name}: the keyframe says where mocap body {name!r} is; take its mpos and mquat out of the "
            "keyframe, or the parameter out of the experiment"
        )


def _write_inertia(model: Any, body: int, chart: str, values: Array) -> None:
    """Set what the chart covers: the central one leaves mass and centre of mass to their own fields."""
    new = INERTIA_PARAMETRISATIONS[chart].back(values)
    moments, quaternion = new.axes()
    model.body_inertia[body], model.body_iquat[body] = moments, quaternion
    if chart != "central":
        model.body_mass[body], model.body_ipos[body] = new.mass, new.com
    model.body_sameframe[body] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE


def _in_charts(
    parameters: Sequence[Parameter], fields: list[tuple[TargetField, ...]]
) -> list[tuple[TargetField, ...]]:
    """Give every body one chart: `mass` beside first moments is the barycentric mass. Raises where charts would mix."""
    charts: dict[int, set[str]] = {}
    plain: dict[int, set[str]] = {}
    for row in fields:
        for field in row:
            if isinstance(field, InertiaField):
                charts.setdefault(field.body, set()).add(field.chart)
            elif isinstance(field, ModelField) and field.array in (
                "body_mass",
                "body_ipos",
                "body_inertia",
            ):
                plain.setdefault(field.rows[0], set()).add(field.array)
    allowed = {
        "central": {"body_mass", "body_ipos"},
        "barycentric": {"body_mass"},
        "logcholesky": set[str](),
    }

    def settled(parameter: Parameter, field: TargetField) -> TargetField:
        """The field in the chart of its body."""
        body = (
            field.rows[0]
            if isinstance(field, ModelField) and field.array.startswith("body_")
            else None
        )
        body = field.body if isinstance(field, InertiaField) else body
        own = charts.get(-1 if body is None else body, set())
        if body is None or not own:
            return field
        chart = next(iter(own))
        if len(own) > 1 or plain.get(body, set()) - allowed[chart]:
            mixed = sorted({*own, *(a.removeprefix("body_") for a in plain.get(body, set()))})
            raise ExperimentError(
                f"parameters.{parameter.name}: the inertia of one body is varied in several coordinates at once "
                f"({', '.join(mixed)}); valid together: mass, ipos and inertia; mass, ipos and fullinertia; mass, firstmoment "
                "and origininertia; logcholesky alone"
            )
        if isinstance(field, ModelField) and field.array == "body_mass" and chart == "barycentric":
            return InertiaField(body, "barycentric", 0)
        return field

    return [tuple(settled(p, s) for s in row) for p, row in zip(parameters, fields, strict=True)]

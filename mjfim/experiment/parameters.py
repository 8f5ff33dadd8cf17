"""The unknown parameters of an experiment, resolved from its tables `parameters` and `nuisance`."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from mjfim.errors import ExperimentError, unknown
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system_tables import ParameterSpec, TargetSpec
from mjfim.model.coordinates import output_label, split_unit, unknown_coordinate
from mjfim.model.elements import (
    LEAST_MOVE_PER_SAMPLE,
    force_sizes,
    identifier,
    names_of,
    position_sizes,
)
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS, body_inertia
from mjfim.model.loading import ModelSource
from mjfim.model.parameters import Parameter, ParameterSet, Target, physical_bounds
from mjfim.model.paths import ParameterPath, resolve, term_quantity, unit_of
from mjfim.model.targets import InertiaField, OutputBiasField, OutputDelayField
from mjfim.model.variants import MocapPlacement
from mjfim.plant.outputs import Outputs

# Beginning of the name of a nuisance parameter that changes the initial state.
INITIAL_STATE_PREFIX = "initial "

# Standard deviation of the logarithm of a pseudo-inertia relative to that of the model, where none
# is stated. It is weak: mass and second moments within a factor of e or so.
CAD_PRIOR = 1.0

# Guess of a dry friction or an armature that the model lacks, over the natural force and inertia of
# the joint. It is small, so that the motion hardly changes, and above 0, so that differences see
# both sides of it.
SMALL_SHARE = 0.01

# Fields of a body that hold the ten barycentric coordinates of its inertia, in their order.
BARYCENTRIC_FIELDS = (
    "mass",
    *(f"firstmoment[{i}]" for i in range(3)),
    *(f"origininertia[{i}]" for i in range(6)),
)

# Fields of a body that hold the ten log-Cholesky coordinates of its inertia, in their order.
LOGCHOLESKY_FIELDS = tuple(f"logcholesky[{i}]" for i in range(10))


def resolve_parameters(
    experiment: Experiment, source: ModelSource, mocap: MocapPlacement, outputs: Outputs
) -> ParameterSet:
    """Resolve all parameters in the order of theta.

    Those of the table `parameters` come first, then those of the table `nuisance`.

    Args:
        experiment: The experiment.
        source: Its model.
        mocap: Where mocap bodies start.
        outputs: The measured outputs.

    Returns:
        The p parameters.

    Raises:
        ExperimentError: A parameter cannot be resolved; the message names its key.
    """
    period = 1.0 / experiment.rate
    nuisance = dict(_nuisance(experiment, source, outputs.names, period))
    resolved: list[Parameter] = []
    for name, spec in (*experiment.parameters.items(), *nuisance.items()):
        if spec.inertial is None:
            resolved.append(_single_parameter(name, spec, source, outputs, period))
        else:
            resolved += _inertia_parameters(name, spec, source.model)

    names = [parameter.name for parameter in resolved]
    duplicate = next((name for name in names if names.count(name) > 1), None)
    if duplicate is not None:
        raise ExperimentError(f"parameters.{duplicate}: duplicate parameter name; rename one")
    if all(parameter.nuisance for parameter in resolved):
        raise ExperimentError(
            "parameters: all are nuisance parameters; at least one must be of interest"
        )
    return ParameterSet.build(resolved, source.model, mocap, source.terms.values())


def _single_parameter(
    name: str, spec: ParameterSpec, source: ModelSource, outputs: Outputs, period: float
) -> Parameter:
    """A parameter with targets or a function. period: sample period of the experiment [s]."""
    guess, unit, magnitude = spec.guess, spec.unit, 0.0
    try:
        # The first target gives the unit and the natural size, and the guess where none is stated.
        targets = tuple(_target(stated, source, outputs.names) for stated in spec.all_targets)
        for target in targets[:1]:
            if guess is None:
                guess = (target.field.read(source.model) - target.offset) / target.scale
            magnitude = _magnitude(target, source.model, outputs, period) / abs(target.scale)
            # A parameter whose factor is not 1 may have another unit than its target.
            if not unit and target.scale == 1.0:
                unit = unit_of(source.model, target.path, source.terms)
    except ExperimentError as error:
        raise ExperimentError(f"parameters.{name}: {error}") from None
    if guess is None:
        raise ExperimentError(f"parameters.{name}.guess: a function needs a guess")

    bounds = spec.bounds or physical_bounds(targets)
    _require_inside(name, spec, guess, bounds)

    magnitude = max(abs(guess), magnitude)
    scale = spec.scale if isinstance(spec.scale, float) else magnitude
    if spec.scale == "guess":
        scale = abs(guess)
    if scale == 0.0:
        raise ExperimentError(
            f"parameters.{name}.scale: the guess (or the value in the model) is 0; state another "
            "guess, or a scale in the parameter's unit"
        )
    return Parameter(
        name=name,
        targets=targets,
        guess=guess,
        true=spec.true,
        bounds=bounds,
        scale=scale,
        prior=spec.prior,
        unit=unit,
        size=magnitude,
        function=spec.function,
        nuisance=spec.nuisance,
        wanted=spec.wanted,
        published=spec.published,
        per_recording=spec.per_recording,
    )


def _magnitude(target: Target, model: Any, outputs: Outputs, period: float) -> float:
    """Natural size of a target, with which its changes are compared [unit of the target].

    The size of a bias is the standard deviation of the noise, that of a delay the sample period.
    """
    field = target.field
    if target.term is not None:
        return target.term.size
    if isinstance(field, OutputBiasField):
        return outputs.outputs[field.row].sigma
    return period if isinstance(field, OutputDelayField) else field.magnitude(model)


def _require_inside(
    name: str, spec: ParameterSpec, guess: float, bounds: tuple[float, float]
) -> None:
    """Refuse a guess or a true value outside the bounds, stated ones or those of physics."""
    for key, value in (("guess", guess), ("true", spec.true)):
        if value is None or bounds[0] <= value <= bounds[1]:
            continue
        if spec.bounds is None:
            is_sign = 0.0 in bounds and np.isinf(bounds).any()
            fault = "negative" if is_sign else f"leave its range {list(bounds)}"
            raise ExperimentError(
                f"parameters.{name}.{key}: {value:g} makes {spec.all_targets[0].path} {fault}, "
                "which is not physical; state another value, or `bounds` that contain it"
            )
        place = " in the model" if getattr(spec, key) is None else ""
        raise ExperimentError(
            f"parameters.{name}.{key}: the value {value:g}{place} is outside bounds {list(bounds)}"
        )


def _target(stated: TargetSpec, source: ModelSource, outputs: Sequence[str]) -> Target:
    """A number that a parameter sets."""
    path = ParameterPath.parse(stated.path)
    return Target(
        path=stated.path,
        field=resolve(source.model, stated.path, outputs, source.decoration, source.terms),
        scale=stated.scale,
        offset=stated.offset,
        term=term_quantity(path, source.terms) if path.kind == "term" else None,
    )


def _inertia_parameters(name: str, spec: ParameterSpec, model: Any) -> Iterator[Parameter]:
    """The ten coordinates of a body's inertia.

    The stated prior is relative to the natural size of each coordinate.
    """
    key = f"parameters.{name}.inertial"
    kind = spec.coordinates or "logcholesky"
    parametrisation = INERTIA_PARAMETRISATIONS[kind]
    body_name = spec.inertial or ""
    body = identifier(model, "body", body_name)
    if body < 0:
        raise ExperimentError(f"{key}: {unknown('body', body_name, names_of(model, 'body'))}")
    if not model.body_mass[body] > 0.0:
        raise ExperimentError(f"{key}: body {body_name!r} has no mass")
    inertia = body_inertia(model, body)
    try:
        values = parametrisation.coordinates(inertia)
    except ValueError as error:
        raise ExperimentError(
            f'{key}: body {body_name!r}: {error}; use coordinates = "barycentric"'
        ) from None
    magnitudes = parametrisation.magnitudes(inertia)
    # The inertia of the model is knowledge where the file states no other.
    cad_prior = spec.cad_prior
    if cad_prior is None and spec.prior is None:
        cad_prior = CAD_PRIOR
    fields = BARYCENTRIC_FIELDS if kind == "barycentric" else LOGCHOLESKY_FIELDS

    numbers = zip(parametrisation.names, values.tolist(), magnitudes.tolist(), strict=True)
    for i, (coordinate, value, magnitude) in enumerate(numbers):
        scale = abs(value) if spec.scale == "guess" else magnitude
        if scale == 0.0:
            raise ExperimentError(
                f'parameters.{name}.scale: {coordinate} is 0; leave out scale = "guess"'
            )

        yield Parameter(
            name=f"{name}.{coordinate}",
            targets=(
                Target(path=f"body/{body_name}:{fields[i]}", field=InertiaField(body, kind, i)),
            ),
            guess=value,
            scale=scale,
            prior=None if spec.prior is None else spec.prior * magnitude,
            unit=parametrisation.units[i],
            size=magnitude,
            nuisance=spec.nuisance,
            group=name,
            per_recording=spec.per_recording,
            cad_prior=float(cad_prior) if cad_prior else None,
        )


def _nuisance(
    experiment: Experiment, source: ModelSource, outputs: Sequence[str], period: float
) -> Iterator[tuple[str, ParameterSpec]]:
    """Names and tables of the parameters that the table `nuisance` stands for.

    period: Sample period of the experiment [s].
    """
    stated, coordinates = experiment.nuisance, source.coordinates
    # A contact holds its joint, so that no deviation of it stays.
    held = source.held_joints
    paths = {
        c.name: c.path
        for c in coordinates.deviations
        if c.path and c.name.partition(":")[2] not in held
    }
    units = {c.name: c.unit for c in coordinates.deviations}
    unnamed = coordinates.unnamed_joints
    if unnamed and stated.initial is not None and not isinstance(stated.initial, Mapping):
        raise ExperimentError(
            f"nuisance.initial: {unnamed} joints have no name; name them in the MJCF, or state "
            "deviations by coordinate"
        )
    for name, prior in _priors_by_name("nuisance.initial", stated.initial, list(paths)):
        yield (
            f"{INITIAL_STATE_PREFIX}{name}",
            _deviation(paths[name], prior, units[name], per_recording=False),
        )
    for name, prior in _priors_by_name("nuisance.bias", stated.bias, outputs):
        unit = split_unit(output_label(source.model, name))[1]
        yield (
            f"bias {name}",
            _deviation(f"output/{name}:bias", prior, unit, per_recording=stated.per_recording),
        )
    if stated.delay is not None:
        yield (
            "delay",
            _deviation("output:delay", stated.delay, "s", per_recording=stated.per_recording),
        )
    # What a parameter sets is no nuisance.
    targets = [each for spec in experiment.parameters.values() for each in spec.all_targets]
    known = {_number(target.path) for target in targets}
    time = period / LEAST_MOVE_PER_SAMPLE
    forces = force_sizes(source.model, time)
    inertias = forces * time**2 / position_sizes(source.model)
    for key, words, field, sizes in (
        ("friction", "dry friction", "frictionloss", forces),
        ("armature", "armature", "armature", inertias),
    ):
        values = getattr(source.model, f"dof_{field}")
        paths = {joint.name: f"joint/{joint.name}:{field}" for joint in coordinates.scalar_joints}
        places = {
            j.name: j.v for j in coordinates.scalar_joints if _number(paths[j.name]) not in known
        }
        for name, prior in _priors_by_name(f"nuisance.{key}", getattr(stated, key), list(places)):
            place = places[name]
            yield (
                f"{words} {name}",
                ParameterSpec(
                    target=paths[name],
                    guess=float(values[place] or SMALL_SHARE * sizes[place]),
                    prior=None if prior is True else float(prior),
                    nuisance=True,
                ),
            )


def _number(text: str) -> tuple[str, str, str, int]:
    """Kind and name of the element, field and component of a path; nothing of a malformed one."""
    try:
        path = ParameterPath.parse(text)
    except ExperimentError:
        return "", "", "", 0
    return path.kind, path.name, path.field, path.component


def _deviation(path: str, prior: Any, unit: str, *, per_recording: bool) -> ParameterSpec:
    """A nuisance parameter, which is zero in the model and may have any sign."""
    return ParameterSpec(
        target=path,
        guess=0.0,
        bounds=(-np.inf, np.inf),
        prior=None if prior is True else float(prior),
        unit=unit,
        nuisance=True,
        per_recording=per_recording,
    )


def _priors_by_name(key: str, stated: Any, names: Sequence[str]) -> Iterator[tuple[str, Any]]:
    """Yield (name, prior) from one value for all names, or from a table by name."""
    if stated is None:
        return
    table = stated if isinstance(stated, Mapping) else dict.fromkeys(names, stated)
    for name, prior in table.items():
        if name not in names:
            raise ExperimentError(f"{key}: {unknown_coordinate('name', name, list(names))}")
        yield name, prior

"""What is unknown: the experiment's `parameters` and `nuisance` tables resolved into `Parameter`s."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import mujoco
import numpy as np

from mjfim.errors import ExperimentError, unknown
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system_tables import ParameterSpec
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS
from mjfim.model.parameters import Parameter, Target
from mjfim.model.paths import OBJECTS, joint_width, names_of, resolve
from mjfim.model.targets import inertial
from mjfim.model.units import unit_of

INITIAL_STATE_PREFIX = "initial "  # how names of the nuisance table's deviations of the start begin
BARYCENTRIC = (
    "mass",
    *(f"firstmoment[{i}]" for i in range(3)),
    *(f"origininertia[{i}]" for i in range(6)),
)


def resolve_parameters(
    experiment: Experiment, model: Any, outputs: Sequence[str]
) -> list[Parameter]:
    """All parameters in the order of theta: those of the file, then the nuisance table's.

    outputs: names of the measured columns. Raises ExperimentError naming the key.
    """
    built: list[Parameter] = []
    for name, spec in experiment.parameters.items():
        built += (
            _inertial(name, spec, model)
            if spec.inertial is not None
            else [_single(name, spec, model, outputs)]
        )
    built += _nuisance(experiment, model, outputs)
    names = [p.name for p in built]
    twice = next((n for n in names if names.count(n) > 1), None)
    if twice is not None:
        raise ExperimentError(
            f"parameters.{twice}: two parameters have this name; call one of them otherwise"
        )
    if all(p.nuisance for p in built):
        raise ExperimentError(
            "parameters: all are nuisance; a design needs at least one that is wanted"
        )
    return built


def _single(name: str, spec: ParameterSpec, model: Any, outputs: Sequence[str]) -> Parameter:
    targets = tuple(Target(t.path, t.scale, t.offset) for t in spec.all_targets)
    guess, size, unit = spec.guess, 0.0, spec.unit
    if targets:
        head = targets[0]
        try:
            slot = resolve(model, head.path, outputs)
            guess = (slot.read(model) - head.offset) / head.scale if guess is None else guess
            size = slot.size(model) / abs(head.scale)
        except ExperimentError as error:
            raise ExperimentError(f"parameters.{name}: {error}") from None
        unit = unit or (unit_of(model, head.path) if head.scale == 1.0 else "")
    if guess is None:
        raise ExperimentError(f"parameters.{name}.guess: a function needs one")
    bounds = spec.bounds or (-np.inf, np.inf)
    if not bounds[0] <= guess <= bounds[1]:
        raise ExperimentError(
            f"parameters.{name}.guess: the model's own value {guess:g} is outside bounds {list(bounds)}"
        )
    size = max(abs(guess), size)
    scale = (
        spec.scale
        if isinstance(spec.scale, float)
        else abs(guess)
        if spec.scale == "guess"
        else size
    )
    if scale == 0.0:
        raise ExperimentError(
            f"parameters.{name}.scale: the model's own value or guess is 0: state a guess, or a scale in the parameter's unit"
        )
    return Parameter(
        name,
        targets,
        guess,
        spec.true,
        bounds,
        scale,
        spec.prior,
        unit,
        size,
        spec.function,
        spec.nuisance,
        spec.wanted,
        per_recording=spec.per_recording,
    )


def _inertial(name: str, spec: ParameterSpec, model: Any) -> Iterator[Parameter]:
    """The ten coordinates of a body's inertia. prior: relative to the natural size of each."""
    body = mujoco.mj_name2id(model, OBJECTS["body"], spec.inertial or "")
    if body < 0:
        raise ExperimentError(
            f"parameters.{name}.inertial: {unknown('body', spec.inertial or '', names_of(model, 'body'))}"
        )
    if not float(model.body_mass[body]) > 0.0:
        raise ExperimentError(f"parameters.{name}.inertial: body {spec.inertial!r} has no mass")
    coordinates = spec.coordinates or "logcholesky"
    chart, now = INERTIA_PARAMETRISATIONS[coordinates], inertial(model, body)
    try:
        values, sizes = chart.of(now), chart.size(now)
    except ValueError as error:
        raise ExperimentError(
            f'parameters.{name}.inertial: body {spec.inertial!r}: {error}; use coordinates = "barycentric"'
        ) from None
    fields = (
        BARYCENTRIC if coordinates == "barycentric" else [f"logcholesky[{i}]" for i in range(10)]
    )
    for coordinate, path, unit, value, size in zip(
        chart.names, fields, chart.units, values, sizes, strict=True
    ):
        scale = abs(float(value)) if spec.scale == "guess" else float(size)
        if scale == 0.0:
            raise ExperimentError(
                f'parameters.{name}.scale: {coordinate} is 0; leave scale = "guess" out'
            )
        yield Parameter(
            f"{name}.{coordinate}",
            (Target(f"body/{spec.inertial}:{path}"),),
            float(value),
            scale=scale,
            prior=None if spec.prior is None else spec.prior * float(size),
            unit=unit,
            size=float(size),
            nuisance=spec.nuisance,
            group=name,
            per_recording=spec.per_recording,
        )


def _nuisance(experiment: Experiment, model: Any, outputs: Sequence[str]) -> Iterator[Parameter]:
    stated = experiment.nuisance
    starts = dict(_starts(model))
    nameless = model.njnt - len(names_of(model, "joint"))
    if nameless and stated.initial is not None and not isinstance(stated.initial, Mapping):
        raise ExperimentError(
            f"nuisance.initial: {nameless} joints have no name: give them one in the MJCF, or state deviations by name"
        )
    for label, prior in _by_name("nuisance.initial", stated.initial, list(starts)):
        yield _unwanted(
            f"{INITIAL_STATE_PREFIX}{label}",
            starts[label],
            prior,
            unit_of(model, starts[label]),
            1.0,
        )
    for label, prior in _by_name("nuisance.bias", stated.bias, outputs):
        yield _unwanted(
            f"bias {label}", f"output/{label}:bias", prior, "", 1.0, stated.per_recording
        )
    if stated.delay is not None:
        yield _unwanted("delay", "output:delay", stated.delay, "s", 0.01, stated.per_recording)


def _starts(model: Any) -> Iterator[tuple[str, str]]:
    """State components by label and path; `[i]` where a joint has several degrees of freedom."""
    for field in ("qpos", "qvel"):
        for joint in names_of(model, "joint"):
            width = joint_width(model, mujoco.mj_name2id(model, OBJECTS["joint"], joint))
            for i in range(width):
                index = "" if width == 1 else f"[{i}]"
                yield f"{field}:{joint}{index}", f"initial/{joint}:{field}{index}"


def _by_name(key: str, stated: Any, names: Sequence[str]) -> Iterator[tuple[str, Any]]:
    """(name, prior) of one value for all names or of a table by name."""
    if stated is None:
        return
    table = stated if isinstance(stated, Mapping) else dict.fromkeys(names, stated)
    for name, prior in table.items():
        if name not in names:
            raise ExperimentError(f"{key}: {unknown('name', name, list(names))}")
        yield name, prior


def _unwanted(
    name: str, path: str, prior: Any, unit: str, size: float, per_recording: bool = False
) -> Parameter:
    known = None if prior is True else float(prior)
    return Parameter(
        name,
        (Target(path),),
        0.0,
        scale=size,
        prior=known,
        unit=unit,
        size=size,
        nuisance=True,
        per_recording=per_recording,
    )

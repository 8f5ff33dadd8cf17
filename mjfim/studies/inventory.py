"""What an experiment file can name in a model (`list`), and what a file states (`validate`)."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import suppress
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.errors import ExperimentError, listed
from mjfim.excitation.limits.limits import Limit, limits_of, limits_of_model, unsupported_ranges
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.experiment.stated_units import probable_degrees
from mjfim.experiment.system import System, laws_in_loop
from mjfim.model.elements import identifier, names_of, unique_names, unnamed_count
from mjfim.model.given import packed
from mjfim.model.loading import ModelSource
from mjfim.model.paths import NAMED_KINDS, paths_of, unit_of
from mjfim.model.terms.library import KINDS
from mjfim.model.terms.term import Term, TermTable
from mjfim.model.units import control_unit, sensor_unit
from mjfim.records.inventory import (
    Inventory,
    ListedActuator,
    ListedKeyframe,
    ListedOutput,
    ListedParameter,
    ListedTerm,
    StatedExperiment,
)
from mjfim.records.rehearsal import LimitRange

# Name of a term that no model has, and timesteps of a sample, for terms that are only listed.
FREE_NAME = "?"
SAMPLE_STEPS = 10

# What an actuator acts on, by MuJoCo's type of transmission, with the kind of the element.
TRANSMISSIONS = {
    mujoco.mjtTrn.mjTRN_JOINT: "joint",
    mujoco.mjtTrn.mjTRN_JOINTINPARENT: "joint",
    mujoco.mjtTrn.mjTRN_SLIDERCRANK: "site",
    mujoco.mjtTrn.mjTRN_TENDON: "tendon",
    mujoco.mjtTrn.mjTRN_SITE: "site",
    mujoco.mjtTrn.mjTRN_BODY: "body",
}


def list_model(path: str | Path) -> Inventory:
    """List what an experiment file can name in a model.

    Args:
        path: MJCF or URDF file, or a name of robot_descriptions.

    Raises:
        ModelError: The model cannot be read.
    """
    source = ModelSource(Path(packed(path, Path())[0]))
    model = source.model

    return Inventory(
        model=str(path),
        parameters=tuple(_parameters(source)),
        outputs=tuple(_outputs(source)),
        actuators=tuple(_actuators(source)),
        keyframes=tuple(
            ListedKeyframe(
                name=model.key(i).name,
                qpos=tuple(model.key_qpos[i].tolist()),
                qvel=tuple(model.key_qvel[i].tolist()),
                ctrl=tuple(model.key_ctrl[i].tolist()),
            )
            for i in range(model.nkey)
        ),
        limits=tuple(map(_listed, limits_of_model(model))),
        terms=tuple(_terms(model)),
        remarks=tuple(_remarks(model)),
    )


def _parameters(source: ModelSource) -> Iterator[ListedParameter]:
    """Paths of all numbers that a parameter can set."""
    model = source.model
    for path, value in paths_of(model, source.decoration):
        yield path, value, unit_of(model, path)

    for component in source.coordinates.deviations:
        if component.path:
            yield component.path, 0.0, component.unit


def _outputs(source: ModelSource) -> Iterator[ListedOutput]:
    """Positions, velocities and sensors."""
    model, coordinates = source.model, source.coordinates
    for component in coordinates.state:
        yield ListedOutput(name=component.name, source="state", unit=component.unit, noise=0.0)

    for number in coordinates.sensors:
        sensor = identifier(model, "sensor", number.groups[0])
        kind = mujoco.mjtSensor(model.sensor_type[sensor])
        yield ListedOutput(
            name=number.name,
            source=kind.name.removeprefix("mjSENS_").lower(),
            unit=sensor_unit(model, sensor),
            noise=number.sigma,
        )


def _actuators(source: ModelSource) -> Iterator[ListedActuator]:
    """All actuators, by the names of their controls."""
    model = source.model
    counts = np.asarray(model.actuator_ctrlnum, dtype=int)
    numbers = np.repeat(np.arange(len(counts)), counts).tolist()
    names = {kind: unique_names(model, kind) for kind in set(TRANSMISSIONS.values())}
    for control, i in zip(source.coordinates.controls, numbers, strict=True):
        kind = TRANSMISSIONS.get(mujoco.mjtTrn(model.actuator_trntype[i]), "")
        drives = f"{kind} {names[kind][model.actuator_trnid[i, 0]]}" if kind else ""
        yield control, drives, control_unit(model, i)


def _listed(limit: Limit) -> LimitRange:
    """A limit for the user."""
    return LimitRange(
        kind=limit.kind,
        name=limit.name,
        lower=limit.lower,
        upper=limit.upper,
        unit=limit.unit,
    )


def _terms(model: Any) -> Iterator[ListedTerm]:
    """Kinds of terms that the model can have, with the elements on which they can act."""
    period = SAMPLE_STEPS * model.opt.timestep
    for name, kind in KINDS.items():
        key = kind.acts_on
        elements: dict[str, tuple[tuple[str, str], ...]] = {"the base": ()}
        if key:
            elements = {f"{key} {each}": ((key, each),) for each in names_of(model, key)}

        possible: dict[str, Term] = {}
        for words, element in elements.items():
            with suppress(ExperimentError):
                possible[words] = kind.of(TermTable(name=FREE_NAME, element=element), model, period)
        if not possible:
            continue

        # Units differ between slides and hinges.
        fields = tuple(
            f"{field} [{quantity.unit}]" if quantity.unit else field
            for field, quantity in next(iter(possible.values())).quantities
        )
        yield ListedTerm(
            kind=name, description=kind.description, elements=tuple(possible), fields=fields
        )


def _remarks(model: Any) -> Iterator[str]:
    """Sentences about elements without a name, and about ranges that a design does not keep."""
    for kind in NAMED_KINDS:
        unnamed = unnamed_count(model, kind)
        if unnamed > 0:
            yield f"{unnamed} of kind {kind} have no name, so that no path leads to them"

    ranges = unsupported_ranges(model)
    if ranges:
        yield f"ranges of the MJCF that a design does not keep: {listed(ranges)}"


def stated_experiment(experiment: Experiment) -> StatedExperiment:
    """Check an experiment against its model, and say what it states.

    Args:
        experiment: The experiment.

    Raises:
        ExperimentError: A name, a file or a number in the experiment is wrong; the message names
            the key.
        ModelError: The model cannot be used.
    """
    system = System.resolve(experiment)

    missing = ["horizon"] if experiment.horizon is None else []
    if experiment.initial.control is None and system.controls:
        missing.append("initial.control")

    # A file for recordings alone needs no task of a design.
    if missing or system.laws is not None:
        limits = limits_of(
            system.model, system.controls, experiment.limits, system.dt, system.source.added
        )
    else:
        limits = DesignTask.of(system).limits

    parameters = system.parameters
    outputs = system.outputs.outputs
    return StatedExperiment(
        source=experiment.source,
        model=str(system.model_path),
        rate=experiment.rate,
        horizon=experiment.horizon,
        parameters=parameters.names,
        units=system.units,
        guess=parameters.guess,
        bounds=np.column_stack([parameters.lower, parameters.upper]),
        nuisance=tuple(each.name for each in parameters.parameters if each.nuisance),
        sigma={output.name: output.sigma for output in outputs},
        output_units={output.name: output.unit for output in outputs},
        controls=system.controls,
        limits=tuple(map(_listed, limits)),
        controllers=laws_in_loop(system, parameters.guess, {}),
        missing=tuple(missing),
        warnings=probable_degrees(experiment, system.source),
    )

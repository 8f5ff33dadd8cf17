"""The control laws that an experiment states, resolved against its model."""

from __future__ import annotations

from collections.abc import Iterator
from typing import Any

import numpy as np

from mjfim.errors import ExperimentError, unknown
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system_tables import ControllerSpec
from mjfim.experiment.time_grid import parts_of, whole_number
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
from mjfim.model.coordinates import ScalarJoint, actuator_names
from mjfim.model.loading import ModelSource
from mjfim.model.units import acts_at_joint, per_second

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
            inputs.append(InputColumn(name=f"ctrl:{actuator}", control=control))
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
            )
        )
    return source, ControlLaws(laws=tuple(laws), inputs=tuple(inputs))


def _joint(source: ModelSource, actuator: str, spec: ControllerSpec) -> ScalarJoint:
    """The joint whose position a law controls."""
    model = source.model
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
        joint
        for joint in joints.values()
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
    control = int(model.actuator_ctrladr[actuator_names(model).index(actuator)])
    low, high = -np.inf, np.inf
    if spec.saturation is not None:
        low, high = spec.saturation
    elif model.actuator_ctrllimited[control]:
        low, high = model.actuator_ctrlrange[control].tolist()

    stated = {name: getattr(spec, name) for name in NUMBERS if not name.startswith("saturation_")}
    return {
        **{name: np.inf if number is None else number for name, number in stated.items()},
        "joint": float(joint.joint),
        "kind": float(KINDS.index(spec.kind)),
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
            yield quantity, InputColumn(name=f"{quantity}:{actuator}", unit=unit)


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

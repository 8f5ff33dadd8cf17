"""Labels of axes and panels from a model and an experiment."""

from __future__ import annotations

from dataclasses import replace

import mujoco

from mjfim.experiment.system import System
from mjfim.model.coordinates import (
    control_labels,
    dof_names,
    output_label,
    state_components,
    tangent_components,
)
from mjfim.model.units import per_second
from mjfim.records.trajectory import Labels


def labels_of_model(model: mujoco.MjModel) -> Labels:
    """Make labels of the joints and actuators of a model.

    Args:
        model: The model.
    """
    state = state_components(model)[: model.nq]
    tangent = tangent_components(model)[: model.nv]
    names = dof_names(model)

    return Labels(
        qpos=tuple(f"{c.name.removeprefix('qpos:')} [{c.unit or '1'}]" for c in state),
        positions=tuple(f"{name} [{c.unit}]" for name, c in zip(names, tangent, strict=True)),
        velocities=tuple(
            f"{name} velocity [{per_second(c.unit)}]"
            for name, c in zip(names, tangent, strict=True)
        ),
        controls=control_labels(model),
    )


def labels_of_system(system: System) -> Labels:
    """Make labels of a system's model, parameters and outputs.

    Args:
        system: The system.
    """
    base = labels_of_model(system.model)
    outputs = {name: output_label(system.model, name) for name in system.outputs.names}
    return replace(
        base,
        parameters=system.parameters.names,
        parameter_units=system.units,
        outputs=outputs,
    )

"""Names with units for axes and panels, such as `slide [m]`, made from a model and an experiment."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field

import mujoco

from mjfim.errors import MjfimError
from mjfim.experiment.system import System
from mjfim.model.coordinates import (
    control_labels,
    output_label,
    state_components,
    tangent_components,
)
from mjfim.model.units import per_second


@dataclass(frozen=True)
class Labels:
    """What each column is called, unit included.

    qpos: nq, one per coordinate;  positions, velocities: nv, one per degree of freedom;  controls: nu
    parameters: p names without unit;  parameter_units: p units, empty where dimensionless
    outputs: `name [unit]` by output column (`qpos:<joint>`, sensor name);  missing ones show the column name
    """

    qpos: tuple[str, ...]
    positions: tuple[str, ...]
    velocities: tuple[str, ...]
    controls: tuple[str, ...]
    parameters: tuple[str, ...] = ()
    parameter_units: tuple[str, ...] = ()
    outputs: Mapping[str, str] = field(default_factory=dict)

    def __post_init__(self) -> None:
        names, units = len(self.parameters), len(self.parameter_units)
        if names != units:
            raise MjfimError(
                f"labels name {names} parameters but {units} units; give one unit (or '') per parameter"
            )

    @classmethod
    def of_model(cls, model: mujoco.MjModel) -> Labels:
        """Names of joints and actuators; rotations of ball and free joints are rotation vectors."""
        state = state_components(model)[: model.nq]
        tangent = tangent_components(model)[: model.nv]
        names = [component.name.removeprefix("qpos:") for component in tangent]

        return cls(
            qpos=tuple(f"{c.name.removeprefix('qpos:')} [{c.unit or '1'}]" for c in state),
            positions=tuple(f"{name} [{c.unit}]" for name, c in zip(names, tangent, strict=True)),
            velocities=tuple(
                f"{name} velocity [{per_second(c.unit)}]"
                for name, c in zip(names, tangent, strict=True)
            ),
            controls=control_labels(model),
        )

    @classmethod
    def of_system(cls, system: System) -> Labels:
        """Names of an experiment: its model's, its parameters' and its outputs'."""
        base = cls.of_model(system.model)
        outputs = {name: output_label(system.model, name) for name in system.outputs.names}
        return cls(
            base.qpos,
            base.positions,
            base.velocities,
            base.controls,
            system.parameters.names,
            system.units,
            outputs,
        )

    def parameter(self, j: int) -> str:
        """`name [unit]` of parameter j."""
        return f"{self.parameters[j]} [{self.parameter_units[j] or 'model unit'}]"

    def output(self, column: str) -> str:
        """`name [unit]` of an output column."""
        return self.outputs.get(column, f"{column} [model unit]")

    def check(self, **sizes: int) -> None:
        """Raise unless each named field has the given length."""
        for name, size in sizes.items():
            have = len(getattr(self, name))
            if have != size:
                raise MjfimError(
                    f"labels.{name} has {have} entries, the data has {size}; give exactly {size}"
                )

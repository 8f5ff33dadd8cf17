"""What a parameter path leads to: a number inside a model, of the start, or of the measurement.

A number of an MjModel array (`ModelField`), a coordinate of a body's inertia (`InertiaField`), of an orientation
(`RotationField`), something that only a compile can follow (`SpecField`), the initial state (`InitialStateField`) or the
measurement itself (`OutputBiasField`, `OutputDelayField`).
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, ClassVar

import mujoco
import numpy as np

from mjfim.errors import ExperimentError
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS, Inertial

SAME_FRAME = {
    "body_ipos": "body_sameframe",
    "site_pos": "site_sameframe",
    "geom_pos": "geom_sameframe",
}


@dataclass(frozen=True)
class ModelField:
    """One number of an MjModel array: its rows, and the column (None for one-dimensional arrays).

    factor: the number is `factor * value`
    also: further (array, row, column, factor) that follow it, as the bias of a servo follows its gain
    """

    array: str
    rows: tuple[int, ...]
    column: int | None
    in_options: bool = False
    factor: float = 1.0
    also: tuple[tuple[str, int, int, float], ...] = ()

    @property
    def numbers(self) -> set[tuple[str, int, int]]:
        """(array, row, column) of all that it writes."""
        return {(self.array, row, self.column or 0) for row in self.rows} | {
            entry[:3] for entry in self.also
        }

    def _holder(self, model: Any) -> Any:
        return getattr(model.opt if self.in_options else model, self.array)

    def read(self, model: Any) -> float:
        """Current value."""
        holder = self._holder(model)
        if np.ndim(holder) == 0:
            return float(holder)
        number = holder[self.rows[0]] if self.column is None else holder[self.rows[0], self.column]
        return float(number) / self.factor

    def size(self, model: Any) -> float:
        """Magnitude that a change is compared with; 0 where only the value itself can tell."""
        if self.array == "body_ipos" and float(model.body_mass[self.rows[0]]) > 0.0:
            return inertial(model, self.rows[0]).radius
        return 0.0

    def write(self, model: Any, value: float) -> None:
        """Set the value in place."""
        holder = self._holder(model)
        if np.ndim(holder) == 0:
            setattr(model.opt, self.array, value)
            return
        for row in self.rows:
            if self.column is None:
                holder[row] = self.factor * value
            else:
                holder[row, self.column] = self.factor * value
        for array, row, column, factor in self.also:
            getattr(model, array)[row, column] = factor * value
        same = SAME_FRAME.get(self.array)
        if same is not None:  # else MuJoCo would go on using the frame of the body itself
            getattr(model, same)[self.rows[0]] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE


@dataclass(frozen=True)
class InertiaField:
    """One coordinate of a body's inertia in a chart. Written together with its sisters (`ParameterSet.write`)."""

    body: int
    chart: str
    component: int

    def read(self, model: Any) -> float:
        """Current value. Raises ExperimentError where the chart does not cover the body."""
        try:
            return float(
                INERTIA_PARAMETRISATIONS[self.chart].of(inertial(model, self.body))[self.component]
            )
        except ValueError as error:
            name = mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, self.body)
            raise ExperimentError(
                f"body {name!r} has no {self.chart} coordinates: {error}"
            ) from None

    def size(self, model: Any) -> float:
        """Magnitude that a change is compared with."""
        return float(
            INERTIA_PARAMETRISATIONS[self.chart].size(inertial(model, self.body))[self.component]
        )


class FromOrigin:
    """What is counted from the model as it is: its value there is zero. natural: magnitude that a change is compared with."""

    natural: ClassVar[float]

    def read(self, model: Any) -> float:
        """Zero."""
        return 0.0

    def size(self, model: Any) -> float:
        """Magnitude that a change is compared with."""
        return self.natural


@dataclass(frozen=True)
class RotationField(FromOrigin):
    """One component of a rotation vector [rad] by which a body or site is turned from its compiled orientation."""

    natural: ClassVar[float] = 1.0
    array: str
    row: int
    component: int


@dataclass(frozen=True)
class SpecField:
    """A number of the MJCF from which the compiler derives others: it must compile anew."""

    kind: str
    name: str
    field: str
    index: int

    def read(self, model: Any) -> float:
        """Current value. Raises ExperimentError where the compiled model no longer holds it."""
        geom = model.geom(self.name)
        if self.field in ("size", "pos"):
            return float(getattr(geom, self.field)[self.index])
        raise ExperimentError(
            f"the {self.field} of geom {self.name!r} is not in the compiled model: state `guess`"
        )

    def size(self, model: Any) -> float:
        """The geom's bounding radius for positions."""
        return float(model.geom_rbound[model.geom(self.name).id]) if self.field == "pos" else 0.0


@dataclass(frozen=True)
class InitialStateField(FromOrigin):
    """Deviation of one component of the initial state, by its place in the tangent space."""

    natural: ClassVar[float] = 1.0
    tangent: int


@dataclass(frozen=True)
class OutputBiasField(FromOrigin):
    """Constant bias of one measured output."""

    natural: ClassVar[float] = 1.0
    output: int


@dataclass(frozen=True)
class OutputDelayField(FromOrigin):
    """Time by which all outputs lag [s]."""

    natural: ClassVar[float] = 0.01


TargetField = (
    ModelField
    | InertiaField
    | RotationField
    | SpecField
    | InitialStateField
    | OutputBiasField
    | OutputDelayField
)


def inertial(model: Any, body: int) -> Inertial:
    """A body's inertia in a model."""
    return Inertial.principal(
        model.body_mass[body],
        model.body_ipos[body],
        model.body_inertia[body],
        model.body_iquat[body],
    )

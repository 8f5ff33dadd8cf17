"""Fields that a parameter writes.

A field is a number inside a model, of the initial state, or of the measurement:

- `ModelField`: a number of an MjModel array;
- `InertiaField`: one of the ten inertial parameters of a body;
- `RotationField`: a component of the orientation of a body or site;
- `SpecField`: a number of the MJCF from which the compiler derives others;
- `TermField`: a field of a physical term on which several numbers depend;
- `InitialStateField`: a deviation of the initial state;
- `OutputBiasField`, `OutputScaleField`, `OutputDelayField`: the measurement itself.

Each field has `read(model)`, its value in a model, and `magnitude(model)`, the order of magnitude
with which a change of it is compared.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import record
from mjfim.errors import ExperimentError
from mjfim.model.elements import LEAST_MOVE_PER_SAMPLE, element_name, position_sizes
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS, body_inertia
from mjfim.model.terms.term import Term

# Array of MjModel -> array that says whether the frame of the element coincides with that of its
# body. MuJoCo skips the position of such elements, so the flag is cleared when the position is
# written.
SAME_FRAME_FLAGS = {
    "body_ipos": "body_sameframe",
    "site_pos": "site_sameframe",
    "geom_pos": "geom_sameframe",
}


@record
class ModelField:
    """One number of an MjModel array.

    Attributes:
        array: Name of the array, a field of MjModel or of its options.
        rows: Rows that all take the number. Scalar options ignore them.
        column: Column of the number; None for arrays with one dimension.
        in_options: Whether the array belongs to `model.opt`.
        factor: The array holds this factor times the value.
        size: Size with which a change is compared; 0 where only the value shows it. None where the
            array decides.
        followers: Further numbers (array, row, column, factor) that are written with it, as the
            bias of a servo follows its gain.
    """

    array: str
    rows: tuple[int, ...]
    column: int | None = None
    in_options: bool = False
    factor: float = 1.0
    size: float | None = None
    followers: tuple[tuple[str, int, int, float], ...] = ()

    @property
    def numbers(self) -> set[tuple[str, int, int]]:
        """(array, row, column) of all numbers that it writes."""
        numbers = {(self.array, row, self.column or 0) for row in self.rows}
        for array, row, column, _ in self.followers:
            numbers.add((array, row, column))
        return numbers

    def read(self, model: Any) -> float:
        """Value in a model."""
        holder = self._holder(model)
        if np.ndim(holder) == 0:
            return float(holder)

        row = holder[self.rows[0]]
        number = row if self.column is None else row[self.column]
        return float(number) / self.factor

    def magnitude(self, model: Any) -> float:
        """Size with which a change is compared; 0 where the value is compared.

        It is the radius of gyration [m] for a centre of mass, and the bounding radius [m] for the
        position of a geom.
        """
        if self.size is not None:
            return self.size
        row = self.rows[0]
        if self.array == "body_ipos" and model.body_mass[row] > 0.0:
            return body_inertia(model, row).gyration_radius
        if self.array == "geom_pos":
            return float(model.geom_rbound[row])
        return 0.0

    def write(self, model: Any, value: float) -> None:
        """Set the value in a model that the caller owns, in place."""
        holder = self._holder(model)
        if np.ndim(holder) == 0:
            setattr(model.opt, self.array, value)
            return

        for row in self.rows:
            if self.column is None:
                holder[row] = self.factor * value
            else:
                holder[row, self.column] = self.factor * value
        for array, row, column, factor in self.followers:
            holder = getattr(model, array)
            holder.reshape(len(holder), -1)[row, column] = factor * value

        flag = SAME_FRAME_FLAGS.get(self.array)
        if flag is not None:
            getattr(model, flag)[self.rows[0]] = mujoco.mjtSameFrame.mjSAMEFRAME_NONE

    def _holder(self, model: Any) -> Any:
        """The array, or the scalar option."""
        return getattr(model.opt if self.in_options else model, self.array)


@dataclass(frozen=True)
class InertiaField:
    """One of the ten inertial parameters of a body.

    `ParameterWriter.write` writes all inertial parameters of a body that are varied at once.

    Attributes:
        body: Number of the body.
        parametrisation: Key of `INERTIA_PARAMETRISATIONS`.
        component: Place among the ten coordinates of the parametrisation.
    """

    body: int
    parametrisation: str
    component: int

    @property
    def whole(self) -> tuple[str, int]:
        """(parametrisation, body): what is written as a whole."""
        return self.parametrisation, self.body

    def read(self, model: Any) -> float:
        """Value in a model.

        Raises:
            ExperimentError: The parametrisation cannot express the body's inertia.
        """
        parametrisation = INERTIA_PARAMETRISATIONS[self.parametrisation]
        try:
            values = parametrisation.coordinates(body_inertia(model, self.body))
        except ValueError as error:
            name = element_name(model, "body", self.body)
            raise ExperimentError(
                f"body {name!r} has no {self.parametrisation} coordinates: {error}"
            ) from None
        return float(values[self.component])

    def magnitude(self, model: Any) -> float:
        """Natural magnitude of the component, from the body's mass and radius of gyration."""
        parametrisation = INERTIA_PARAMETRISATIONS[self.parametrisation]
        return float(parametrisation.magnitudes(body_inertia(model, self.body))[self.component])


class DeviationField:
    """A difference from the stated model, so that its value there is zero."""

    def read(self, model: Any) -> float:
        """Zero."""
        return 0.0

    def magnitude(self, model: Any) -> float:
        """Size with which a change is compared, in the unit of the number."""
        return 1.0


@dataclass(frozen=True)
class RotationField(DeviationField):
    """One component of the rotation [rad] of a body or site from its compiled orientation.

    Attributes:
        array: Array of quaternions in MjModel.
        row: Row of the body or site.
        component: Component of the rotation vector: 0, 1 or 2.
    """

    array: str
    row: int
    component: int

    @property
    def whole(self) -> tuple[str, int]:
        """(array, row): what is written as a whole."""
        return self.array, self.row


@dataclass(frozen=True)
class SpecField:
    """A number of a geom in the MJCF from which the compiler derives others.

    A change of such a number needs a compile.

    Attributes:
        name: Name of the geom.
        field: Field of the geom in MjSpec.
        index: Place in the field.
    """

    name: str
    field: str
    index: int

    def read(self, model: Any) -> float:
        """Value in a model.

        Raises:
            ExperimentError: The compiled model does not hold it.
        """
        if self.field in ("size", "pos"):
            return float(getattr(model.geom(self.name), self.field)[self.index])
        raise ExperimentError(
            f"the {self.field} of geom {self.name!r} is not in the compiled model: state `guess`"
        )

    def magnitude(self, model: Any) -> float:
        """Bounding radius of the geom [m] for positions; 0 where the value is the magnitude."""
        return float(model.geom_rbound[model.geom(self.name).id]) if self.field == "pos" else 0.0


@dataclass(frozen=True)
class TermField:
    """A field of a physical term, which is written together with its other fields.

    Attributes:
        term: The term.
        field: Name of the field.
    """

    term: Term
    field: str

    def read(self, model: Any) -> float:
        """Value where no parameter sets it; the model is not asked, which holds other numbers."""
        return self.term.value(self.field)

    def magnitude(self, model: Any) -> float:
        """Natural size of the field."""
        return self.term.quantity(self.field).size


@dataclass(frozen=True)
class OutsideField(DeviationField):
    """A number outside the model, of the initial state or of the measurement.

    Attributes:
        row: Place of what it changes, in the tangent space (dq, dv, da) or among the measured
            outputs.
    """

    row: int = 0


class InitialStateField(OutsideField):
    """Deviation of one component of the initial state."""

    def magnitude(self, model: Any) -> float:
        """Natural size of the component: 1 rad, the length of the model, or such a size per time.

        The time is that of many engine steps. Activations have the magnitude 1.
        """
        sizes = position_sizes(model)
        speeds = LEAST_MOVE_PER_SAMPLE * sizes / model.opt.timestep
        both = np.concatenate([sizes, speeds])
        return float(both[self.row]) if self.row < len(both) else 1.0


class OutputBiasField(OutsideField):
    """Constant bias of one measured output."""


class OutputScaleField(OutsideField):
    """Relative error s of the scale of one measured output, which reads (1 + s) times its value."""


class OutputDelayField(OutsideField):
    """Time by which all outputs lag [s]."""


TargetField = (
    ModelField
    | InertiaField
    | RotationField
    | SpecField
    | TermField
    | InitialStateField
    | OutputBiasField
    | OutputScaleField
    | OutputDelayField
)

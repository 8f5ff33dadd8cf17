"""Records of trajectories: their states and controls, derivatives, labels and measurements.

The plant computes them, and designs, fits and figures use them.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import field, replace
from typing import Any

import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import MjfimError, RecordingError
from mjfim.records.base import Record, SavedRecord, no_array

# Bounds of a parameter without any.
NO_BOUNDS = (-np.inf, np.inf)


def with_unit(name: str, unit: str) -> str:
    """Return the label of a quantity: its name, with the unit if it is not empty."""
    return f"{name} [{unit}]" if unit else name


@record
class Labels(Record):
    """Labels of the columns of figures and tables, `<name> [<unit>]` unless stated otherwise.

    Attributes:
        qpos: nq labels of the numbers of qpos.
        positions: nv labels of the positions by degree of freedom; rotations of ball and free
            joints are rotation vectors.
        velocities: nv labels of the velocities by degree of freedom.
        controls: nu labels of the controls.
        parameters: p names of the parameters, without unit.
        parameter_units: p units of the parameters; empty where a parameter has none.
        outputs: Labels of some measured columns by their names; others are in the model's unit.
        wanted: (p,) stated standard deviations to reach, infinite without one [theta-unit].
        published: (p,) values with which estimates are compared, NaN without one [theta-unit].
        bounds: (p, 2) lower and upper bounds [theta-unit].
        targets: The paths that each parameter sets in the model.
    """

    qpos: tuple[str, ...]
    positions: tuple[str, ...]
    velocities: tuple[str, ...]
    controls: tuple[str, ...]
    parameters: tuple[str, ...] = ()
    parameter_units: tuple[str, ...] = ()
    outputs: dict[str, str] = field(default_factory=dict)
    wanted: Array = no_array()
    published: Array = no_array()
    bounds: Array = no_array(0, 2)
    targets: tuple[tuple[str, ...], ...] = ()

    def __post_init__(self) -> None:
        names, units = len(self.parameters), len(self.parameter_units)
        if names != units:
            raise MjfimError(
                f"labels name {names} parameters but {units} units; give one unit (or '') per "
                "parameter"
            )
        for name, missing in (("wanted", np.inf), ("published", np.nan), ("bounds", NO_BOUNDS)):
            if len(getattr(self, name)) != names:
                shape = (names, *np.shape(missing))
                object.__setattr__(self, name, np.broadcast_to(missing, shape))
        super().__post_init__()

    def parameter(self, j: int) -> str:
        """Return the label of parameter j."""
        return with_unit(self.parameters[j], self.parameter_units[j])

    def output(self, column: str) -> str:
        """Return the label of a measured column."""
        return self.outputs.get(column, f"{column} [model unit]")


@record
class Trajectory(SavedRecord):
    """A feasible curve (x, u) of the plant: `x_{k+1} = F(x_k, u_k, theta)`.

    Attributes:
        t: (N+1,) times [s].
        qpos: (N+1, nq) positions [m or rad; unit quaternions for ball and free joints].
        qvel: (N+1, nv) velocities [m/s or rad/s].
        act: (N+1, na) activations [unit of the actuator].
        ctrl: (N, nu) controls, held over each sample [unit of the actuator].
    """

    t: Array
    qpos: Array
    qvel: Array
    act: Array
    ctrl: Array

    file_stem = "trajectory"
    made_by = "Trajectory.save"
    in_json = (
        "samples",
        "dt",
    )

    @property
    def samples(self) -> int:
        """Number of control samples, N."""
        return len(self.ctrl)

    @property
    def dt(self) -> float:
        """Sample period [s]."""
        return float(self.t[-1] - self.t[0]) / self.samples

    @property
    def state(self) -> Array:
        """(N+1, nq+nv+na) positions, velocities and activations side by side."""
        return np.concatenate([self.qpos, self.qvel, self.act], axis=1)

    def moves_as(self, other: Trajectory) -> bool:
        """Whether times, controls and states of another trajectory are exactly the same."""
        names = ("t", "ctrl", "state")
        return all(np.array_equal(getattr(self, name), getattr(other, name)) for name in names)

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        return {
            **super().summary(),
            "nq": self.qpos.shape[1],
            "nv": self.qvel.shape[1],
            "na": self.act.shape[1],
            "nu": self.ctrl.shape[1],
        }


@record
class Linearization(Record):
    """First derivatives along a trajectory, in the tangent space of the state.

    Attributes:
        A: (N, nx, nx) F_x [x-unit / x-unit].
        B: (N, nx, nu) F_u [x-unit / u-unit].
        E: (N, nx, p) F_theta [x-unit / theta-unit].
        C: (N+1, ny, nx) h_x [y-unit / x-unit].
        D: (N+1, ny, nu) h_u [y-unit / u-unit].
        H: (N+1, ny, p) h_theta [y-unit / theta-unit].
    """

    A: Array
    B: Array
    E: Array
    C: Array
    D: Array
    H: Array


@record
class Sensitivity(Record):
    """First derivatives of a trajectory with respect to the parameters, at fixed control.

    Attributes:
        psi: (N+1, nx, p) dx/dtheta [x-unit / theta-unit]; zero at the initial state.
        G: (N+1, ny, p) dy/dtheta [y-unit / theta-unit], `G_k = C_k psi_k + H_k`.
        is_lumped: True where some columns were computed from those of the other parameters.
    """

    psi: Array
    G: Array
    is_lumped: bool = False

    def of_parameters(self, chosen: Sequence[int]) -> Sensitivity:
        """The derivatives with respect to parameters with these indices, in this order."""
        return Sensitivity(psi=self.psi[:, :, chosen], G=self.G[:, :, chosen])


@record
class Recording(SavedRecord):
    """Measured or simulated outputs under a known control, at the times of the log.

    Attributes:
        t: (M,) increasing times [s]; the intervals may differ.
        ctrl: (M-1, nu) controls, held from each row to the next [unit of the actuator].
        y: (M, ny) measured outputs in the order of `outputs` [unit of the output]; NaN where an
            output was not measured.
        outputs: Names of the ny outputs: `qpos:<joint>`, `qvel:<joint>` or the name of a sensor.
        name: Name of the recording in messages, usually its file.
    """

    t: Array
    ctrl: Array
    y: Array
    outputs: tuple[str, ...]
    name: str = "recording"

    file_stem = "recording"
    made_by = "Recording.save"
    in_json = (
        "name",
        "outputs",
    )

    def __post_init__(self) -> None:
        for name in ("t", "y"):
            if np.asarray(getattr(self, name)).dtype == np.bool_:
                raise RecordingError(
                    f"{self.name}: {name!r} holds truth values (True and False), which are no "
                    "measurement; give an array of numbers"
                )
        super().__post_init__()

    def first_rows(self, count: int) -> Recording:
        """The first `count` rows, which are 2 or more; a shorter recording is unchanged."""
        if len(self.t) <= count:
            return self
        return replace(self, t=self.t[:count], ctrl=self.ctrl[: count - 1], y=self.y[:count])

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        return {
            **super().summary(),
            "rows": len(self.t),
            "nu": self.ctrl.shape[1],
        }

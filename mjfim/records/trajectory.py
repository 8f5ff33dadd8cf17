"""Records of a trajectory, its linearisation, and its sensitivity to the parameters.

The letters are those of the paper: `x` state, `u` control, `theta` parameters, `psi` sensitivity
dx/dtheta, `I` Fisher information. The sizes are N samples; nq, nv, na and nu as in MuJoCo;
`nx = 2 nv + na` for the tangent space; ny outputs; p parameters. Arrays are read-only.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any, ClassVar

import numpy as np

from mjfim.arrays import Array, freeze
from mjfim.records.serialization import SavedRecord


@dataclass(frozen=True, eq=False, kw_only=True, repr=False)
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

    file_stem: ClassVar[str] = "trajectory"
    made_by: ClassVar[str] = "Trajectory.save"

    def __post_init__(self) -> None:
        freeze(self, "t", "qpos", "qvel", "act", "ctrl")

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
        """Whether another trajectory is the same to the last digit.

        Args:
            other: The other trajectory.
        """
        same_times = np.array_equal(self.t, other.t)
        same_control = same_times and np.array_equal(self.ctrl, other.ctrl)
        return same_control and np.array_equal(self.state, other.state)

    def summary(self) -> dict[str, Any]:
        """Return the contents of trajectory.json."""
        return {
            "samples": self.samples,
            "dt": self.dt,
            "nq": self.qpos.shape[1],
            "nv": self.qvel.shape[1],
            "na": self.act.shape[1],
            "nu": self.ctrl.shape[1],
        }


@dataclass(frozen=True, eq=False, kw_only=True)
class Linearization:
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

    def __post_init__(self) -> None:
        freeze(self, "A", "B", "E", "C", "D", "H")


@dataclass(frozen=True, eq=False, kw_only=True)
class Sensitivity:
    """First derivatives of a trajectory with respect to the parameters, at fixed control.

    Attributes:
        psi: (N+1, nx, p) dx/dtheta [x-unit / theta-unit]; zero at the initial state.
        G: (N+1, ny, p) dy/dtheta [y-unit / theta-unit], `G_k = C_k psi_k + H_k`.
        is_lumped: True where some columns were computed from those of the other parameters.
    """

    psi: Array
    G: Array
    is_lumped: bool = False

    def __post_init__(self) -> None:
        freeze(self, "psi", "G")

    def of_parameters(self, chosen: Sequence[int]) -> Sensitivity:
        """The derivatives with respect to some of the parameters.

        Args:
            chosen: Indices of the parameters, in their new order.
        """
        return Sensitivity(psi=self.psi[:, :, chosen], G=self.G[:, :, chosen])

"""Records that travel through the package. Arrays are read-only; shapes and units stand in each docstring.

Letters are the paper's: `x` state, `u` control, `theta` parameters, `psi` sensitivity dx/dtheta, `I` Fisher
information. Sizes: N samples, nq/nv/na MuJoCo's, `nx = 2 nv + na` (tangent space), nu controls, ny outputs, p parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array, freeze


@dataclass(frozen=True, eq=False, kw_only=True)
class Trajectory:
    """A feasible curve (x, u) of the plant: `x_{k+1} = F(x_k, u_k, theta)`.

    t: (N+1,) [s]
    qpos: (N+1, nq) [m or rad, unit quaternions for ball and free joints]
    qvel: (N+1, nv) [m/s or rad/s]
    act: (N+1, na) [actuator's own unit]
    ctrl: (N, nu) [actuator's own unit], held over each sample
    """

    t: Array
    qpos: Array
    qvel: Array
    act: Array
    ctrl: Array

    def __post_init__(self) -> None:
        freeze(self, "t", "qpos", "qvel", "act", "ctrl")

    @property
    def samples(self) -> int:
        """N, the number of control samples."""
        return len(self.ctrl)

    @property
    def dt(self) -> float:
        """Sample period [s]."""
        return float(self.t[-1] - self.t[0]) / self.samples

    @property
    def state(self) -> Array:
        """(N+1, nq+nv+na): qpos, qvel and act side by side."""
        return np.concatenate([self.qpos, self.qvel, self.act], axis=1)


@dataclass(frozen=True, eq=False, kw_only=True)
class Linearization:
    """First derivatives along a trajectory, in the tangent space of the state.

    A: (N, nx, nx) F_x;  B: (N, nx, nu) F_u [x-unit / u-unit];  E: (N, nx, p) F_theta [x-unit / theta-unit]
    C: (N+1, ny, nx) h_x;  D: (N+1, ny, nu) h_u;  H: (N+1, ny, p) h_theta
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
    """What the parameters do to a trajectory at fixed control.

    psi: (N+1, nx, p) dx/dtheta [x-unit / theta-unit], zero at the start
    G: (N+1, ny, p) dy/dtheta [y-unit / theta-unit], `G_k = C_k psi_k + H_k`
    """

    psi: Array
    G: Array

    def __post_init__(self) -> None:
        freeze(self, "psi", "G")

"""The extended system of the paper: states (x, psi), with the linearisation of its section IV-E.3.

    z' = A z + B v,   zeta_j' = (D_x DF[psi_j, e_j]) (z, v) + A zeta_j        for each parameter j

`n_x (1 + p)` states; meant for small systems, where a metric may weigh psi.
"""

from __future__ import annotations

import numpy as np

from mjfim.plant import Bilinear
from mjfim.pronto import Expansion
from mjfim.trajectory import Array


def extend(full: Bilinear, a: Array, b: Array, a_psi: Array) -> Expansion:
    """Expansion over (x, psi_1, ..., psi_p).

    full: bilinear along the unit directions of theta;  a: (N+1, nx);  b: (N, nu);  a_psi: (N+1, nx, p)
    """
    N, nx, nu = full.B.shape
    p = a_psi.shape[2]
    A = np.zeros((N, nx * (1 + p), nx * (1 + p)))
    B = np.zeros((N, nx * (1 + p), nu))
    A[:, :nx, :nx], B[:, :nx] = full.A, full.B
    for j in range(p):
        block = slice(nx * (1 + j), nx * (2 + j))
        mixed = np.swapaxes(full.F_mixed[j], 1, 2)
        A[:, block, block] = full.A
        A[:, block, :nx] = mixed[:, :, :nx]
        B[:, block] = mixed[:, :, nx:]
    stacked = np.swapaxes(a_psi, 1, 2).reshape(N + 1, nx * p)
    return Expansion(A, B, np.concatenate([a, stacked], axis=1), np.array(b))

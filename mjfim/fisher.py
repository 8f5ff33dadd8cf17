"""Fisher information of the measured samples, its optimality criteria, and the gradient by one adjoint sweep.

    I = I_prior + sum_k G_k' Sigma^-1 G_k        (measured samples)
    phi = Q_p / lambda_min(S I S / f_m)          E-optimality; S = diag(scale), f_m the measurement rate

With `M = dphi/dI = sum_r m_r w_r w_r'` the variation of phi is `sum_k tr V_k' dG_k`, `V_k = 2 Sigma^-1 G_k M`. psi is
eliminated by the adjoint `Lambda_k = A_k' Lambda_{k+1} + C_k' V_k = sum_r l^r_k w_r'`; what is left is the derivative of
`l' DF[psi w, w] + v' Dh[psi w, w]` by (x, u): r directions, not p.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from mjfim.errors import UnidentifiableError
from mjfim.lq import Recursion
from mjfim.plant import Bilinear
from mjfim.trajectory import Array, Sensitivity

SINGULAR = 1e-12
# A direction known worse than this many times the parameters' own size is told as not excited at all.
BLIND = 1e4


@dataclass(frozen=True, eq=False)
class Criterion:
    """Value of phi and its derivative `M = sum_r weights_r directions_r directions_r'`.

    weights: (r,);  directions: (r, p);  eigenvalues: (p,) ascending
    """

    value: float
    weights: Array
    directions: Array
    eigenvalues: Array


def e_optimality(information: Array) -> Criterion:
    """`1 / lambda_min`, by Nelson's formula. information: (p, p)."""
    values, vectors = np.linalg.eigh(information)
    if not values[0] > SINGULAR * values[-1]:
        return Criterion(np.inf, np.zeros(1), vectors[:, :1].T, values)
    return Criterion(float(1.0 / values[0]), np.array([-(values[0] ** -2)]), vectors[:, :1].T, values)


def a_optimality(information: Array) -> Criterion:
    """`trace I^-1`."""
    values, vectors = np.linalg.eigh(information)
    if not values[0] > SINGULAR * values[-1]:
        return Criterion(np.inf, np.zeros(len(values)), vectors.T, values)
    return Criterion(float(np.sum(1.0 / values)), -(values**-2), vectors.T, values)


def d_optimality(information: Array) -> Criterion:
    """`-log det I`."""
    values, vectors = np.linalg.eigh(information)
    if not values[0] > SINGULAR * values[-1]:
        return Criterion(np.inf, np.zeros(len(values)), vectors.T, values)
    return Criterion(float(-np.sum(np.log(values))), -1.0 / values, vectors.T, values)


CRITERIA: dict[str, Callable[[Array], Criterion]] = {"E": e_optimality, "A": a_optimality, "D": d_optimality}


def standard_deviations(information: Array) -> Array:
    """(p,) Cramer-Rao standard deviations; infinite where the information is singular."""
    scale = np.sqrt(np.maximum(np.diag(information), np.finfo(float).tiny))
    values, vectors = np.linalg.eigh(information / np.outer(scale, scale))
    if values[0] <= 1e-14 * values[-1]:
        return np.full(len(scale), np.inf)
    return np.asarray(np.sqrt(np.sum(vectors**2 / values, axis=1)) / scale)


@dataclass(frozen=True, eq=False)
class Information:
    """Turns sensitivities into Fisher information and the criterion into its gradient.

    sigma: (ny,) noise;  stride: every stride-th sample is measured (k = 0, the known start, is not)
    measure_rate: [Hz];  scale: (p,);  prior: (p, p);  weight: Q_p
    """

    sigma: Array
    stride: int
    measure_rate: float
    scale: Array
    prior: Array
    criterion: str = "E"
    weight: float = 1.0

    def measured(self, N: int) -> Array:
        """(N+1,) 1 where a sample is measured, else 0."""
        mask = np.zeros(N + 1)
        mask[self.stride :: self.stride] = 1.0
        return mask

    def matrix(self, sensitivity: Sensitivity) -> Array:
        """(p, p) sum over the measured samples, prior included [1 / (theta_i theta_j unit)]."""
        G = sensitivity.G[self.stride :: self.stride] / self.sigma[:, None]
        flat = G.reshape(-1, G.shape[-1])
        return np.asarray(flat.T @ flat + self.prior)

    def accumulated(self, sensitivity: Sensitivity) -> Array:
        """(N+1,) smallest eigenvalue of the scaled information per second, accumulated up to each sample."""
        N = len(sensitivity.G) - 1
        G = sensitivity.G / self.sigma[:, None] * self.scale
        blocks = np.einsum("kyi,kyj->kij", G, G) * self.measured(N)[:, None, None]
        total = np.cumsum(blocks, axis=0) + self.prior * np.outer(self.scale, self.scale)
        return np.asarray(np.maximum(np.linalg.eigvalsh(total / self.measure_rate)[:, 0], 0.0))

    def scaled(self, information: Array) -> Array:
        """`S I S / f_m`, what the cost sees."""
        return np.asarray(information * np.outer(self.scale, self.scale) / self.measure_rate)

    def evaluate(self, information: Array) -> Criterion:
        """Criterion of an information matrix, times Q_p; directions w are in raw parameter units."""
        raw = CRITERIA[self.criterion](self.scaled(information))
        return Criterion(
            self.weight * raw.value, self.weight * raw.weights, raw.directions * self.scale, raw.eigenvalues
        )

    def require_identifiable(self, information: Array, names: tuple[str, ...], size: Array) -> None:
        """Raise UnidentifiableError naming the direction of theta that the trajectory cannot see.

        size: (p,) magnitudes of the parameters
        """
        values, vectors = np.linalg.eigh(information * np.outer(size, size))
        if values[0] > max(SINGULAR * values[-1], BLIND**-2):
            return
        direction = vectors[:, 0] * size
        direction = direction / np.abs(direction).max()
        terms = [f"{value:+.3g} {name}" for name, value in zip(names, direction, strict=True) if abs(value) > 1e-3]
        smallest = max(float(np.linalg.eigvalsh(self.scaled(information))[0]), 0.0)
        blind = values <= max(SINGULAR * values[-1], BLIND**-2)
        others = f", nor along any other of {', '.join(names)}" if blind.all() and len(names) > 1 else ""
        raise UnidentifiableError(
            f"the start excites nothing along the parameter direction {' '.join(terms)}{others} "
            f"(lambda_min = {smallest:.3g}); start from a control "
            "that moves those parameters' joints, and check that the targets matter"
        )

    def _rays(self, criterion: Criterion, sensitivity: Sensitivity) -> Array:
        """v: (r, N+1, ny) with `V_k = sum_r v^r_k w_r'`, zero where nothing is measured."""
        mask = self.measured(len(sensitivity.G) - 1)[:, None]
        scale = 2.0 * criterion.weights / self.measure_rate
        Gw = np.einsum("kyp,rp->rky", sensitivity.G, criterion.directions)
        return np.asarray(scale[:, None, None] * Gw / self.sigma**2 * mask)

    def gradient(self, criterion: Criterion, sensitivity: Sensitivity, bilinear: Bilinear) -> tuple[Array, Array]:
        """(a, b): derivative of phi by x_k (N+1, nx) and u_k (N, nu), psi eliminated by the adjoint."""
        nx = bilinear.A.shape[1]
        recursion = Recursion(bilinear.A)
        total = np.zeros((len(bilinear.A) + 1, nx + bilinear.B.shape[2]))
        for r, v in enumerate(self._rays(criterion, sensitivity)):
            costate = recursion.adjoint(np.einsum("kyx,ky->kx", bilinear.C, v))
            total[:-1] += np.einsum("kzx,kx->kz", bilinear.F_mixed[r], costate[1:])
            if bilinear.h_mixed is not None:
                total += np.einsum("kzy,ky->kz", bilinear.h_mixed[r], v)
        total[-2, nx:] += total[-1, nx:]  # the last control is held for the outputs of the last sample
        return total[:, :nx], total[:-1, nx:]

    def partials(self, criterion: Criterion, sensitivity: Sensitivity, full: Bilinear) -> tuple[Array, Array, Array]:
        """Derivatives of phi with psi kept as a state: by psi (N+1, nx, p), by x (N+1, nx), by u (N, nu).

        full: bilinear along the unit directions of theta.
        """
        V = np.einsum("rky,rp->kyp", self._rays(criterion, sensitivity), criterion.directions)
        nx = full.A.shape[1]
        direct = np.zeros((len(V), nx + full.B.shape[2]))
        if full.h_mixed is not None:
            direct = np.einsum("pkzy,kyp->kz", full.h_mixed, V)
            direct[-2, nx:] += direct[-1, nx:]
        return np.einsum("kyx,kyp->kxp", full.C, V), direct[:, :nx], direct[:-1, nx:]

"""Fisher information of the measured samples, what of it the criterion sees, and the gradient by one adjoint sweep.

    I   = I_prior + sum_k G_k' Sigma^-1 G_k            (measured samples)
    I~  = S I S / f_m                                  S = diag(scale), f_m the measurement rate
    R   = T' (I~_tt - I~_tn I~_nn^+ I~_nt) T           t wanted, n nuisance parameters, T the identifiable combinations
    phi = Q_p / lambda_min(R)                          E-optimality

With `P = T' [1, -I~_tn I~_nn^+]`, `dR = P dI~ P'`, so a derivative `sum_r m_r w_r w_r'` by R is one by I~ with directions P'w.
The variation of phi is then `sum_k tr V_k' dG_k`, `V_k = 2 Sigma^-1 G_k M`. psi is
eliminated by the adjoint `Lambda_k = A_k' Lambda_{k+1} + C_k' V_k = sum_r l^r_k w_r'`; what is left is the derivative of
`l' DF[psi w, w] + v' Dh[psi w, w]` by (x, u): r directions, not p.
"""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from mjfim.arrays import Array, scaled_to_unit_diagonal
from mjfim.information.criteria import (
    CRITERIA,
    NEGLIGIBLE,
    SINGULAR,
    Criterion,
    c_optimality,
    smooth_e_optimality,
)
from mjfim.information.marginal import standard_deviations
from mjfim.optimize.eigenvalue_model import EigenvalueModel, divided_log_differences
from mjfim.optimize.lq import LinearRecursion
from mjfim.plant.derivatives import Bilinear
from mjfim.plant.noise import Noise
from mjfim.records.trajectory import Sensitivity

ESTIMABLE = 1e-6  # squared share of a parameter outside the identifiable combinations that still counts as round-off


@dataclass(frozen=True, eq=False)
class FisherInformation:
    """Turns sensitivities into Fisher information and the criterion into its gradient.

    noise: of the outputs;  measure_rate: [Hz];  scale: (p,);  prior: (p, p);  weight: Q_p
    interest: indices of the t wanted parameters (None: all); the others are nuisance, removed by the Schur complement
    basis: (t, s) orthonormal, the identifiable combinations of the scaled wanted parameters (None: all of them)
    contrast: (t, c) combinations of the scaled wanted parameters whose variance criterion "c" sums
    power: of the smooth E-criterion, infinite for 1/lambda_min itself
    faint: weight of an eigenvector in it, over the largest, below which its share of the gradient is left out
    told: (p,) information of the stated priors, by which a combination is known that nothing shows (None: the diagonal of prior)
    """

    noise: Noise
    measure_rate: float
    scale: Array
    prior: Array
    criterion: str = "E"
    weight: float = 1.0
    interest: np.ndarray | None = None
    basis: Array | None = None
    contrast: Array | None = None
    power: float = np.inf
    faint: float = NEGLIGIBLE
    told: Array | None = None

    def matrix(self, sensitivity: Sensitivity) -> Array:
        """(p, p) sum over the measured samples, prior included [1 / (theta_i theta_j unit)]."""
        flat = self.noise.whitened_rows(sensitivity.G)
        return np.asarray(flat.T @ flat + self.prior)

    def accumulated(self, sensitivity: Sensitivity) -> Array:
        """(N+1,) smallest eigenvalue of what the criterion sees, accumulated up to each sample."""
        G = (
            self.noise.whiten(sensitivity.G)
            * self.noise.measured(len(sensitivity.G) - 1)[..., None]
        )
        total = np.cumsum(np.swapaxes(G, 1, 2) @ G, axis=0) + self.prior
        return np.asarray(np.maximum(np.linalg.eigvalsh(self.reduced(total)[0])[:, 0], 0.0))

    def scaled(self, information: Array) -> Array:
        """`S I S / f_m`."""
        return np.asarray(information * np.outer(self.scale, self.scale) / self.measure_rate)

    def reduced(self, information: Array) -> tuple[Array, Array]:
        """R: (..., s, s), what the criterion sees of information (..., p, p), and P: (..., s, p) with `dR = P dI~ P'`."""
        scaled = self.scaled(information)
        p = scaled.shape[-1]
        t = np.arange(p) if self.interest is None else self.interest
        n = np.setdiff1d(np.arange(p), t)
        P = np.array(np.broadcast_to(np.eye(p)[t], (*scaled.shape[:-2], len(t), p)))
        if len(n):
            known = np.linalg.pinv(scaled[..., n[:, None], n], rcond=1e-13, hermitian=True)
            P[..., n] = -scaled[..., t[:, None], n] @ known
        if self.basis is not None:
            P = self.basis.T @ P
        R = P @ scaled @ np.swapaxes(P, -1, -2)
        return 0.5 * (R + np.swapaxes(R, -1, -2)), P

    def evaluate(self, information: Array) -> Criterion:
        """Criterion of an information matrix, times Q_p; directions w are in raw parameter units."""
        R, P = self.reduced(information)
        if not len(R):
            return Criterion(np.inf, np.zeros(0), np.zeros((0, len(information))), np.zeros(0))
        raw = self._criterion(R)
        directions = raw.directions @ P * self.scale
        return replace(
            raw,
            value=self.weight * raw.value,
            weights=self.weight * raw.weights,
            directions=directions,
        )

    def _criterion(self, R: Array) -> Criterion:
        if self.criterion == "E" and np.isfinite(self.power):
            return smooth_e_optimality(R, self.power, self.faint)
        if self.criterion == "c":
            if self.contrast is None:
                raise ValueError("criterion c needs a contrast")
            return c_optimality(
                R, self.contrast if self.basis is None else self.basis.T @ self.contrast
            )
        return CRITERIA[self.criterion](R)

    def covariance(self, information: Array) -> Array:
        """(t, t) Cramer-Rao covariance of the wanted parameters; NaN where one is no identifiable combination by itself."""
        covariance, basis = self._visible(information)
        alone = 1.0 - np.sum(basis**2, axis=1) < ESTIMABLE
        return np.where(np.outer(alone, alone), covariance, np.nan)

    def spread(self, information: Array, combinations: Array) -> Array:
        """(c,) Cramer-Rao standard deviations of identifiable combinations of the wanted parameters, (c, t)."""
        covariance, _ = self._visible(information)
        return np.asarray(np.sqrt(np.einsum("ci,ij,cj->c", combinations, covariance, combinations)))

    def _visible(self, information: Array) -> tuple[Array, Array]:
        """(t, t) covariance within the identifiable combinations, zero across, and their basis in scaled units."""
        t = np.arange(len(information)) if self.interest is None else self.interest
        basis = np.eye(len(t)) if self.basis is None else self._with_prior(self.basis, t)
        if not basis.shape[1]:
            return np.full((len(t), len(t)), np.nan), basis
        R, _ = replace(self, basis=basis).reduced(information)
        scaled, size = scaled_to_unit_diagonal(R)
        values, vectors = np.linalg.eigh(scaled)
        if values[0] <= SINGULAR * values[-1]:
            return np.full((len(t), len(t)), np.nan), basis
        known = basis @ (vectors / size[:, None])
        covariance = (
            (known / values) @ known.T * np.outer(self.scale[t], self.scale[t]) / self.measure_rate
        )
        return covariance, basis

    def std(self, information: Array) -> Array:
        """(p,) Cramer-Rao standard deviations; infinite for parameters that are no identifiable combination by themselves."""
        if self.basis is None:
            return standard_deviations(information)
        std = np.full(len(information), np.inf)
        t = np.arange(len(information)) if self.interest is None else self.interest
        std[t] = np.nan_to_num(np.sqrt(np.diag(self.covariance(information))), nan=np.inf)
        return std

    def _with_prior(self, basis: Array, t: np.ndarray) -> Array:
        """The identifiable combinations and those that stated priors tell."""
        stated = np.diag(self.prior) if self.told is None else self.told
        if not stated[t].any():
            return basis
        rest = np.linalg.qr(basis, mode="complete")[0][:, basis.shape[1] :]
        told, vectors = np.linalg.eigh(rest.T @ self.scaled(np.diag(stated))[np.ix_(t, t)] @ rest)
        return np.concatenate(
            [basis, rest @ vectors[:, told > ESTIMABLE * told.max(initial=0.0)]], axis=1
        )

    def visible(self, information: Array) -> Array:
        """(p, p) information without the round-off along invisible directions."""
        if self.basis is None:
            return information
        p = len(information)
        t = np.arange(p) if self.interest is None else self.interest
        projector = np.eye(p)
        projector[np.ix_(t, t)] = self.basis @ self.basis.T
        both = projector / self.scale[:, None] * self.scale
        return np.asarray(both @ information @ both.T)

    def estimable(self, combinations: Array) -> np.ndarray:
        """(c,) True where a combination of the scaled wanted parameters, (t, c), is identifiable or told by priors."""
        t = np.arange(len(self.scale)) if self.interest is None else self.interest
        if self.basis is None:
            return np.ones(combinations.shape[1], dtype=bool)
        unit = combinations / np.linalg.norm(combinations, axis=0)
        inside = np.sum((self._with_prior(self.basis, t).T @ unit) ** 2, axis=0)
        return np.asarray(1.0 - inside < ESTIMABLE)

    def _rays(self, criterion: Criterion, sensitivity: Sensitivity) -> Array:
        """v: (r, N+1, ny) with `V_k = sum_r v^r_k w_r'`, zero where nothing is measured."""
        mask = self.noise.measured(len(sensitivity.G) - 1)
        scale = 2.0 * criterion.weights / self.measure_rate
        Gw = np.einsum("kyp,rp->rky", sensitivity.G, criterion.directions)
        if self.noise.correlated:
            return np.asarray(scale[:, None, None] * ((Gw * mask) @ self.noise.precision))
        return np.asarray(scale[:, None, None] * Gw / self.noise.sigma**2 * mask)

    def gradient(
        self, criterion: Criterion, sensitivity: Sensitivity, bilinear: Bilinear
    ) -> tuple[Array, Array]:
        """(a, b): derivative of phi by x_k (N+1, nx) and u_k (N, nu), psi eliminated by the adjoint."""
        nx, rays = bilinear.A.shape[1], self._rays(criterion, sensitivity)
        backs = self._back(rays, bilinear)
        shares = (self._through(backs, r, r, criterion, bilinear) for r in range(len(rays)))
        total = np.sum(list(shares), axis=0)
        return total[:, :nx], total[:-1, nx:]

    def spectral(
        self, criterion: Criterion, sensitivity: Sensitivity, bilinear: Bilinear, cost: float
    ) -> EigenvalueModel:
        """Model of log J about a point of the smooth E-criterion, from the very derivatives that its gradient takes.

        With `V = 2 Sigma^-1 G w_i` the change of `w_i' I w_j` is half of what V_i makes of dG w_j and V_j of dG w_i.
        """
        rays = self._rays(criterion, sensitivity) / criterion.weights[:, None, None]
        backs, nx, r = self._back(rays, bilinear), bilinear.A.shape[1], len(rays)
        values = criterion.eigenvalues[:r]
        turn = divided_log_differences(values)
        rows = []
        for i in range(r):
            for j in range(i, r):
                both = self._through(backs, i, j, criterion, bilinear)
                if i != j:
                    both = (both + self._through(backs, j, i, criterion, bilinear)) / np.sqrt(2.0)
                rows.append(turn[i, j] * both)
        slopes = np.stack(rows)
        return EigenvalueModel(
            eigenvalues=values,
            power=criterion.power,
            weight=criterion.value / cost,
            a=slopes[..., :nx],
            b=slopes[:, :-1, nx:],
        )

    def _back(self, rays: Array, bilinear: Bilinear) -> list[tuple[Array, Array, Array]]:
        """Each ray, as the outputs themselves see it, and its costate."""
        recursion, backs = LinearRecursion(bilinear.A), []
        for v in rays:
            own = v if bilinear.output_delay is None else bilinear.output_delay.apply_transposed(v)
            backs.append((v, own, recursion.adjoint(np.einsum("kyx,ky->kx", bilinear.C, own))))
        return backs

    def _through(
        self,
        backs: list[tuple[Array, Array, Array]],
        ray: int,
        direction: int,
        criterion: Criterion,
        bilinear: Bilinear,
    ) -> Array:
        """(N+1, nx+nu) derivative of `sum_k v_k' dG_k w` by (x_k, u_k) for a ray v and a direction w."""
        nx, (v, own, costate) = bilinear.A.shape[1], backs[ray]
        share = np.zeros((len(v), nx + bilinear.B.shape[2]))
        share[:-1] = np.einsum("kzx,kx->kz", bilinear.F_mixed[direction], costate[1:])
        if bilinear.h_mixed is not None:
            share += np.einsum("kzy,ky->kz", bilinear.h_mixed[direction], own)
        if bilinear.output_delay is not None and bilinear.delay_derivative is not None:
            share += _delayed(
                bilinear, v * float(bilinear.delay_derivative @ criterion.directions[direction])
            )
        share[-2, nx:] += share[
            -1, nx:
        ]  # the last control is held for the outputs of the last sample
        return share

    def partials(
        self, criterion: Criterion, sensitivity: Sensitivity, full: Bilinear
    ) -> tuple[Array, Array, Array]:
        """Derivatives of phi with psi kept as a state: by psi (N+1, nx, p), by x (N+1, nx), by u (N, nu).

        full: bilinear along the unit directions of theta.
        """
        V = np.einsum("rky,rp->kyp", self._rays(criterion, sensitivity), criterion.directions)
        nx = full.A.shape[1]
        own = V if full.output_delay is None else full.output_delay.apply_transposed(V)
        direct = np.zeros((len(V), nx + full.B.shape[2]))
        if full.h_mixed is not None:
            direct = np.einsum("pkzy,kyp->kz", full.h_mixed, own)
        if full.output_delay is not None and full.delay_derivative is not None:
            direct += _delayed(full, V @ full.delay_derivative)
        direct[-2, nx:] += direct[-1, nx:]
        return np.einsum("kyx,kyp->kxp", full.C, own), direct[:, :nx], direct[:-1, nx:]


def _delayed(bilinear: Bilinear, v: Array) -> Array:
    """Derivative by (x, u): (N+1, nx+nu) of `sum_k v_k' dy_k/d(delay)`, linear in the outputs themselves."""
    if bilinear.output_delay is None:
        raise ValueError("nothing delays the outputs")
    e = bilinear.output_delay.derivative_transposed(v)
    return np.concatenate(
        [np.einsum("kyx,ky->kx", bilinear.C, e), np.einsum("kyu,ky->ku", bilinear.D, e)], axis=1
    )

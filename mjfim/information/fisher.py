"""Fisher information of the measured samples, the part that a criterion uses, and its derivatives.

    I   = I_prior + sum_k G_k' Sigma^-1 G_k            over the measured samples k
    I~  = S I S / f_m                                  S = diag(scale), f_m the measurement rate
    R   = T' (I~_tt - I~_tn I~_nn^+ I~_nt) T           t wanted parameters, n nuisance parameters,
                                                       T the identifiable combinations
    phi = Q_p / lambda_min(R)                          for E-optimality

With `P = T' [1, -I~_tn I~_nn^+]`, `dR = P dI~ P'`. A derivative `sum_r m_r w_r w_r'` with respect
to R is therefore a derivative with respect to I~ with the directions P'w.

The variation of phi along a trajectory is `sum_k tr V_k' dG_k` with

    V_k = 2 Sigma^-1 G_k M,    M = dphi/dI = sum_r m_r w_r w_r'.

The adjoint `Lambda_k = A_k' Lambda_{k+1} + C_k' V_k = sum_r l^r_k w_r'` eliminates psi. The
derivative of `l' DF[psi w, w] + v' Dh[psi w, w]` with respect to (x, u) remains, which needs only
the r directions w instead of all p parameters.
"""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property

import numpy as np

from mjfim.arrays import Array, evenly_spread_indices, record, scaled_to_unit_diagonal
from mjfim.information.criteria import (
    CRITERIA,
    NEGLIGIBLE_WEIGHT,
    PSEUDO_INVERSE_CUTOFF,
    Criterion,
    c_optimality,
    inverse_root,
    smooth_e_optimality,
    standard_deviations,
)
from mjfim.optimize.cost_models import EigenvalueModel, divided_log_differences
from mjfim.optimize.lq import LinearRecursion
from mjfim.plant.mixed_derivatives import Bilinear
from mjfim.plant.outputs import Noise
from mjfim.records.trajectory import Sensitivity

# A unit vector lies within the identifiable combinations if the squared length of its part outside
# is below this number.
ROUND_OFF_SHARE = 1e-6

# Largest number of samples at which accumulated standard deviations are computed.
MAX_TIMES = 400


# One of the r terms v^r w_r' of V: (N+1, ny) weights v of the measured outputs, (N+1, ny)
# equivalent weights of the outputs before the delay, and the (N+1, nx) costate l.
_Ray = tuple[Array, Array, Array]


def _adjoint_rays(weights: Array, bilinear: Bilinear) -> list[_Ray]:
    """Rays for the (r, N+1, ny) weights of the outputs."""
    recursion = LinearRecursion(bilinear.A)
    delay = bilinear.output_delay

    rays = []
    for v in weights:
        outputs = v if delay is None else delay.apply_transposed(v)
        costate = recursion.adjoint(np.einsum("kyx,ky->kx", bilinear.C, outputs))
        rays.append((v, outputs, costate))
    return rays


def _term(ray: _Ray, direction: int, criterion: Criterion, bilinear: Bilinear) -> Array:
    """(N+1, nx+nu) derivative of `sum_k v_k' dG_k w` with respect to (x_k, u_k).

    Args:
        ray: The ray, with the weights v.
        direction: Index of the direction w.
        criterion: The criterion with its r directions.
        bilinear: Derivatives of the plant along these directions.
    """
    measured, outputs, costate = ray
    term = np.zeros((len(measured), bilinear.A.shape[1] + bilinear.B.shape[2]))
    term[:-1] = np.einsum("kzx,kx->kz", bilinear.F_mixed[direction], costate[1:])

    if bilinear.h_mixed is not None:
        term += np.einsum("kzy,ky->kz", bilinear.h_mixed[direction], outputs)
    if bilinear.output_delay is not None and bilinear.delay_derivative is not None:
        rate = float(bilinear.delay_derivative @ criterion.directions[direction])
        term += _delay_term(bilinear, measured * rate)
    return _with_held_control(term, bilinear)


def _with_held_control(term: Array, bilinear: Bilinear) -> Array:
    """(N+1, nx+nu) derivatives in which the last control gets the derivative of the last outputs.

    The last control is held for the outputs of the last sample.
    """
    nx = bilinear.A.shape[1]
    term[-2, nx:] += term[-1, nx:]
    return term


def _by_state_and_control(total: Array, bilinear: Bilinear) -> tuple[Array, Array]:
    """(N+1, nx) and (N, nu) parts of (N+1, nx+nu) derivatives."""
    nx = bilinear.A.shape[1]
    return total[:, :nx], total[:-1, nx:]


def _delay_term(bilinear: Bilinear, v: Array) -> Array:
    """(N+1, nx+nu) derivative of `sum_k v_k' dy_k/d(delay)` with respect to (x_k, u_k).

    v: (N+1, ny) weights of the measured outputs.
    """
    assert bilinear.output_delay is not None
    e = bilinear.output_delay.derivative_transposed(v)
    by_state = np.einsum("kyx,ky->kx", bilinear.C, e)
    by_control = np.einsum("kyu,ky->ku", bilinear.D, e)
    return np.concatenate([by_state, by_control], axis=1)


@record
class FisherInformation:
    """Computes the Fisher information of sensitivities, its criterion and the gradient.

    Attributes:
        noise: Noise of the outputs.
        measure_rate: f_m, rate of the measurements [Hz].
        scale: (p,) scales of the parameters [theta-unit].
        prior: (p, p) prior information [1 / (theta_i theta_j unit)].
        criterion: A name of `CRITERIA`, or "c".
        weight: Q_p, factor of the criterion.
        interest: Indices of the t wanted parameters, None for all; the others are removed by the
            Schur complement.
        basis: (t, s) orthonormal identifiable combinations of the scaled wanted parameters, None
            for all.
        contrast: (t, c) combinations of the scaled wanted parameters whose variances criterion "c"
            sums.
        power: Exponent q of the smooth E-criterion, infinite for 1/lambda_min.
        negligible_weight: Eigenvectors whose weight in the smooth criterion is below this fraction
            of the largest weight are left out of the gradient.
        stated_prior: (p,) information of the stated priors, which may determine a combination that
            no measurement determines; None for the diagonal of `prior`.
        inflation: (p,) factors by which residuals that are no white noise widen the standard
            deviations of an experiment, but not those of stated priors. They do not change the
            criterion.
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
    negligible_weight: float = NEGLIGIBLE_WEIGHT
    stated_prior: Array | None = None
    inflation: Array | float = 1.0

    @property
    def wanted(self) -> np.ndarray:
        """(t,) indices of the wanted parameters."""
        return np.arange(len(self.scale)) if self.interest is None else self.interest

    @cached_property
    def _nuisance(self) -> np.ndarray:
        """Indices of the parameters that are not wanted."""
        return np.setdiff1d(np.arange(len(self.scale)), self.wanted)

    # The information and the part that the criterion uses

    def matrix(self, sensitivity: Sensitivity) -> Array:
        """Information of a trajectory.

        Args:
            sensitivity: Sensitivities of the outputs to the parameters.

        Returns:
            (p, p) sum over the measured samples and the prior [1 / (theta_i theta_j unit)].
        """
        flat = self.noise.whitened_rows(sensitivity.G)
        return flat.T @ flat + self.prior

    def accumulated_std(self, sensitivity: Sensitivity) -> Array:
        """Standard deviations from the prior and the measurements up to each sample.

        Of a long trajectory, `MAX_TIMES` evenly spread samples are computed. Others have the larger
        value of the one before.

        Args:
            sensitivity: Sensitivities of the outputs to the parameters.

        Returns:
            (N+1, p) standard deviations [theta-unit]; see `std`.
        """
        count, _, p = sensitivity.G.shape
        measured = self.noise.measured(count - 1)
        G = self.noise.whiten(sensitivity.G) * measured[..., None]

        ends = evenly_spread_indices(count, MAX_TIMES)
        parts = [part.reshape(-1, p) for part in np.split(G, ends[:-1] + 1)]
        total = np.cumsum([part.T @ part for part in parts], axis=0) + self.prior
        return self.std(total)[np.searchsorted(ends, np.arange(count), side="right") - 1]

    def scaled(self, information: Array) -> Array:
        """I~ = S I S / f_m of information I: (..., p, p)."""
        return information * np.outer(self.scale, self.scale) / self.measure_rate

    def reduced(self, information: Array) -> tuple[Array, Array]:
        """Reduce an information matrix to the part that the criterion uses.

        Args:
            information: (..., p, p) information [1 / (theta_i theta_j unit)].

        Returns:
            R: (..., s, s) and P: (..., s, p) with `dR = P dI~ P'`.
        """
        scaled = self.scaled(information)
        p = scaled.shape[-1]
        t = self.wanted
        n = self._nuisance

        P = np.array(np.broadcast_to(np.eye(p)[t], (*scaled.shape[:-2], len(t), p)))
        if len(n):
            among_nuisance = scaled[..., n[:, None], n]
            inverse = np.linalg.pinv(among_nuisance, rcond=PSEUDO_INVERSE_CUTOFF, hermitian=True)
            P[..., n] = -scaled[..., t[:, None], n] @ inverse
        if self.basis is not None:
            P = self.basis.T @ P

        R = P @ scaled @ np.swapaxes(P, -1, -2)
        symmetric = 0.5 * (R + np.swapaxes(R, -1, -2))
        return symmetric, P

    # The criterion and its derivatives

    def evaluate(self, information: Array) -> Criterion:
        """Evaluate the criterion of an information matrix (p, p), including the weight Q_p.

        The directions w of its derivative are in the units of the parameters.
        """
        R, P = self.reduced(information)
        if not len(R):
            p = len(information)
            return Criterion(
                value=np.inf,
                weights=np.zeros(0),
                directions=np.zeros((0, p)),
                eigenvalues=np.zeros(0),
            )

        reduced = self._criterion_of(R)
        return replace(
            reduced,
            value=self.weight * reduced.value,
            weights=self.weight * reduced.weights,
            directions=reduced.directions @ P * self.scale,
        )

    def _criterion_of(self, R: Array) -> Criterion:
        """The criterion of R: (s, s), without its weight."""
        if self.criterion == "E" and np.isfinite(self.power):
            return smooth_e_optimality(R, self.power, self.negligible_weight)
        if self.criterion != "c":
            return CRITERIA[self.criterion](R)

        if self.contrast is None:
            raise ValueError("criterion c needs a contrast")
        contrast = self.contrast if self.basis is None else self.basis.T @ self.contrast
        return c_optimality(R, contrast)

    def gradient(
        self, criterion: Criterion, sensitivity: Sensitivity, bilinear: Bilinear
    ) -> tuple[Array, Array]:
        """Gradient of the criterion; psi is eliminated by the adjoint.

        Args:
            criterion: The criterion with its r directions.
            sensitivity: Sensitivities of the outputs to the parameters.
            bilinear: Derivatives of the plant along these directions.

        Returns:
            (N+1, nx) derivative by the state and (N, nu) derivative by the control.
        """
        rays = _adjoint_rays(self._output_weights(criterion, sensitivity), bilinear)
        terms = [_term(ray, r, criterion, bilinear) for r, ray in enumerate(rays)]
        return _by_state_and_control(np.sum(terms, axis=0), bilinear)

    def eigenvalue_model(
        self, criterion: Criterion, sensitivity: Sensitivity, bilinear: Bilinear, cost: float
    ) -> EigenvalueModel:
        """Model of log J about a point of the smooth E-criterion.

        It needs the derivatives that the gradient needs, too. With `V = 2 Sigma^-1 G w_i`, the
        change of `w_i' I w_j` is half of the sum of two terms: the ray of w_i along w_j, and the
        ray of w_j along w_i.

        Args:
            criterion: The criterion with its r directions.
            sensitivity: Sensitivities of the outputs to the parameters.
            bilinear: Derivatives of the plant along these directions.
            cost: J.

        Returns:
            The model of the r smallest eigenvalues.
        """
        weights = self._output_weights(criterion, sensitivity)
        rays = _adjoint_rays(weights / criterion.weights[:, None, None], bilinear)
        r, nx = len(rays), bilinear.A.shape[1]
        eigenvalues = criterion.eigenvalues[:r]
        rotation = divided_log_differences(eigenvalues)

        rows = []
        for i in range(r):
            for j in range(i, r):
                change = _term(rays[i], j, criterion, bilinear)
                if i != j:
                    change = (change + _term(rays[j], i, criterion, bilinear)) / np.sqrt(2.0)
                rows.append(rotation[i, j] * change)

        slopes = np.stack(rows)
        return EigenvalueModel(
            eigenvalues=eigenvalues,
            power=criterion.power,
            weight=criterion.value / cost,
            a=slopes[..., :nx],
            b=slopes[:, :-1, nx:],
        )

    def partial_derivatives(
        self, criterion: Criterion, sensitivity: Sensitivity, full: Bilinear
    ) -> tuple[Array, Array, Array]:
        """Derivatives of the criterion if psi is a part of the state.

        Args:
            criterion: The criterion with its r directions.
            sensitivity: Sensitivities of the outputs to the parameters.
            full: Derivatives of the plant along the unit directions of theta.

        Returns:
            (N+1, nx, p) derivative by psi, (N+1, nx) by the state and (N, nu) by the control.
        """
        weights = self._output_weights(criterion, sensitivity)
        V = np.einsum("rky,rp->kyp", weights, criterion.directions)
        outputs = V if full.output_delay is None else full.output_delay.apply_transposed(V)

        direct = np.zeros((len(V), full.A.shape[1] + full.B.shape[2]))
        if full.h_mixed is not None:
            direct = np.einsum("pkzy,kyp->kz", full.h_mixed, outputs)
        if full.output_delay is not None and full.delay_derivative is not None:
            direct += _delay_term(full, V @ full.delay_derivative)

        by_psi = np.einsum("kyx,kyp->kxp", full.C, outputs)
        return by_psi, *_by_state_and_control(_with_held_control(direct, full), full)

    def _output_weights(self, criterion: Criterion, sensitivity: Sensitivity) -> Array:
        """(r, N+1, ny) weights v of the outputs, with `V_k = sum_r v^r_k w_r'`.

        They are zero where nothing is measured.
        """
        noise = self.noise
        measured = noise.measured(len(sensitivity.G) - 1)
        scale = (2.0 * criterion.weights / self.measure_rate)[:, None, None]
        Gw = np.einsum("kyp,rp->rky", sensitivity.G, criterion.directions)

        if noise.correlated:
            return np.asarray(scale * ((Gw * measured) @ noise.precision))
        return np.asarray(scale * Gw / noise.sigma**2 * measured)

    # Standard deviations

    def under_white_noise(self, information: Array) -> Array:
        """Information of which white noise leaves standard deviations too small by the inflation.

        It lets stated priors count by more, because they are not inflated.

        Args:
            information: (..., p, p) information, stated priors included [1/theta-unit²].

        Returns:
            (..., p, p) information [1 / (theta_i theta_j unit)].
        """
        if self.stated_prior is None:
            return information
        return information + np.diag((self.inflation**2 - 1.0) * self.stated_prior)

    def std(self, information: Array) -> Array:
        """Standard deviations of the parameters: those of Cramer and Rao, widened.

        Args:
            information: (..., p, p) information [1 / (theta_i theta_j unit)].

        Returns:
            (..., p) standard deviations [theta-unit], infinite for a parameter that is not an
            identifiable combination by itself.
        """
        if self.basis is None:
            return self.inflation * standard_deviations(self.under_white_noise(information))

        std = np.full(information.shape[:-1], np.inf)
        variances = np.diagonal(self.covariance(information), axis1=-2, axis2=-1)
        std[..., self.wanted] = np.nan_to_num(np.sqrt(variances), nan=np.inf)
        return std

    def covariance(self, information: Array) -> Array:
        """Covariance of the wanted parameters, with the standard deviations of `std`.

        Args:
            information: (..., p, p) information [1 / (theta_i theta_j unit)].

        Returns:
            (..., t, t) covariance [theta_i theta_j unit], NaN for a parameter that is not an
            identifiable combination by itself.
        """
        covariance, basis = self._identifiable_covariance(information)
        alone = 1.0 - np.sum(basis**2, axis=1) < ROUND_OFF_SHARE
        return np.where(np.outer(alone, alone), covariance, np.nan)

    def combination_std(self, information: Array, combinations: Array) -> Array:
        """Standard deviations of identifiable combinations, by the same covariance.

        Args:
            information: (p, p) information [1 / (theta_i theta_j unit)].
            combinations: (c, t) combinations of the wanted parameters.

        Returns:
            (c,) standard deviations [unit of each combination].
        """
        covariance, _ = self._identifiable_covariance(information)
        variances = np.einsum("ci,ij,cj->c", combinations, covariance, combinations)
        return np.asarray(np.sqrt(variances))

    def _identifiable_covariance(self, information: Array) -> tuple[Array, Array]:
        """(..., t, t) covariance within identifiable combinations, and their basis in scaled units.

        The covariance is zero along directions outside the combinations, and NaN if the reduced
        information is singular.
        """
        t = self.wanted
        basis = np.eye(len(t)) if self.basis is None else self._basis_with_prior(self.basis)
        if not basis.shape[1]:
            return np.full((*information.shape[:-2], len(t), len(t)), np.nan), basis

        R, _ = replace(self, basis=basis).reduced(self.under_white_noise(information))
        unit, size = scaled_to_unit_diagonal(R)
        root = inverse_root(unit) / size[..., None] / np.sqrt(self.measure_rate)
        axes = self.scale[t][:, None] * (basis @ root)
        axes = axes * np.broadcast_to(self.inflation, len(self.scale))[t, None]
        return axes @ np.swapaxes(axes, -1, -2), basis

    # Identifiable combinations

    def is_estimable(self, combinations: Array) -> np.ndarray:
        """Find the combinations of parameters that the measurements or the priors determine.

        Args:
            combinations: (t, c) combinations of the scaled wanted parameters.

        Returns:
            (c,) True if a combination is identifiable or known from priors.
        """
        if self.basis is None:
            return np.ones(combinations.shape[1], dtype=bool)

        unit = combinations / np.linalg.norm(combinations, axis=0)
        inside = np.sum((self._basis_with_prior(self.basis).T @ unit) ** 2, axis=0)
        return np.asarray(1.0 - inside < ROUND_OFF_SHARE)

    def without_round_off(self, information: Array) -> Array:
        """(p, p) information without the round-off along directions that are not identifiable."""
        if self.basis is None:
            return information

        t = self.wanted
        projector = np.eye(len(information))
        projector[np.ix_(t, t)] = self.basis @ self.basis.T
        unscaled = projector / self.scale[:, None] * self.scale
        return unscaled @ information @ unscaled.T

    def _basis_with_prior(self, basis: Array) -> Array:
        """(t, s') identifiable combinations and those that only the stated priors determine."""
        t = self.wanted
        stated = np.diag(self.prior) if self.stated_prior is None else self.stated_prior
        if not stated[t].any():
            return basis

        # Within the null space, the eigenvectors of the prior information that are not round-off.
        null = np.linalg.qr(basis, mode="complete")[0][:, basis.shape[1] :]
        prior = self.scaled(np.diag(stated))[np.ix_(t, t)]
        values, vectors = np.linalg.eigh(null.T @ prior @ null)
        known = values > ROUND_OFF_SHARE * values.max(initial=0.0)
        return np.concatenate([basis, null @ vectors[:, known]], axis=1)

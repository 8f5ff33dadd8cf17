"""Derivatives of a criterion of the Fisher information along a trajectory, by one adjoint sweep.

The variation of phi is `sum_k tr V_k' dG_k` with

    V_k = 2 Sigma^-1 G_k M,    M = dphi/dI = sum_r m_r w_r w_r'.

The adjoint `Lambda_k = A_k' Lambda_{k+1} + C_k' V_k = sum_r l^r_k w_r'` eliminates psi. The
derivative of `l' DF[psi w, w] + v' Dh[psi w, w]` with respect to (x, u) remains, which needs only
the r directions w instead of all p parameters.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.information.criteria import Criterion
from mjfim.optimize.eigenvalue_model import EigenvalueModel, divided_log_differences
from mjfim.optimize.lq import LinearRecursion
from mjfim.plant.mixed_derivatives import Bilinear
from mjfim.plant.outputs import Noise
from mjfim.records.trajectory import Sensitivity


@dataclass(frozen=True, kw_only=True, eq=False)
class _AdjointRay:
    """One of the r terms v^r w_r' of V, and its costate.

    Attributes:
        measured: (N+1, ny) weights v of the measured outputs.
        outputs: (N+1, ny) equivalent weights of the outputs before the delay.
        costate: (N+1, nx) costate l of the adjoint recursion.
    """

    measured: Array
    outputs: Array
    costate: Array


def output_weights(
    noise: Noise, measure_rate: float, criterion: Criterion, sensitivity: Sensitivity
) -> Array:
    """Weights v of the outputs, with `V_k = sum_r v^r_k w_r'`.

    Args:
        noise: Noise of the outputs.
        measure_rate: Rate of the measurements [Hz].
        criterion: The criterion with its r directions.
        sensitivity: Sensitivities of the outputs to the parameters.

    Returns:
        (r, N+1, ny) weights, zero where nothing is measured.
    """
    measured = noise.measured(len(sensitivity.G) - 1)
    scale = (2.0 * criterion.weights / measure_rate)[:, None, None]
    Gw = np.einsum("kyp,rp->rky", sensitivity.G, criterion.directions)

    if noise.correlated:
        return np.asarray(scale * ((Gw * measured) @ noise.precision))
    return np.asarray(scale * Gw / noise.sigma**2 * measured)


def criterion_gradient(
    weights: Array, criterion: Criterion, bilinear: Bilinear
) -> tuple[Array, Array]:
    """Gradient of the criterion; psi is eliminated by the adjoint.

    Args:
        weights: (r, N+1, ny) weights of the outputs, by `output_weights`.
        criterion: The criterion with its r directions.
        bilinear: Derivatives of the plant along these directions.

    Returns:
        (N+1, nx) derivative by the state and (N, nu) derivative by the control.
    """
    rays = _adjoint_rays(weights, bilinear)
    terms = [_term(ray, r, criterion, bilinear) for r, ray in enumerate(rays)]
    return _by_state_and_control(np.sum(terms, axis=0), bilinear)


def eigenvalue_model(
    weights: Array, criterion: Criterion, bilinear: Bilinear, cost: float
) -> EigenvalueModel:
    """Model of log J about a point of the smooth E-criterion.

    It needs the derivatives that the gradient needs, too. With `V = 2 Sigma^-1 G w_i`, the change
    of `w_i' I w_j` is half of the sum of two terms: the ray of w_i along w_j, and the ray of w_j
    along w_i.

    Args:
        weights: (r, N+1, ny) weights of the outputs, by `output_weights`.
        criterion: The smooth E-criterion with its r directions.
        bilinear: Derivatives of the plant along these directions.
        cost: J.

    Returns:
        The model of the r smallest eigenvalues.
    """
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
    weights: Array, criterion: Criterion, full: Bilinear
) -> tuple[Array, Array, Array]:
    """Derivatives of the criterion if psi is a part of the state.

    Args:
        weights: (r, N+1, ny) weights of the outputs, by `output_weights`.
        criterion: The criterion with its r directions.
        full: Derivatives of the plant along the unit directions of theta.

    Returns:
        (N+1, nx, p) derivative by psi, (N+1, nx) by the state and (N, nu) by the control.
    """
    V = np.einsum("rky,rp->kyp", weights, criterion.directions)
    outputs = V if full.output_delay is None else full.output_delay.apply_transposed(V)

    direct = np.zeros((len(V), full.A.shape[1] + full.B.shape[2]))
    if full.h_mixed is not None:
        direct = np.einsum("pkzy,kyp->kz", full.h_mixed, outputs)
    if full.output_delay is not None and full.delay_derivative is not None:
        direct += _delay_term(full, V @ full.delay_derivative)

    by_psi = np.einsum("kyx,kyp->kxp", full.C, outputs)
    return by_psi, *_by_state_and_control(_with_held_control(direct, full), full)


def _adjoint_rays(weights: Array, bilinear: Bilinear) -> list[_AdjointRay]:
    """Rays for the (r, N+1, ny) weights of the outputs."""
    recursion = LinearRecursion(bilinear.A)
    delay = bilinear.output_delay

    rays = []
    for v in weights:
        outputs = v if delay is None else delay.apply_transposed(v)
        costate = recursion.adjoint(np.einsum("kyx,ky->kx", bilinear.C, outputs))
        rays.append(_AdjointRay(measured=v, outputs=outputs, costate=costate))
    return rays


def _term(ray: _AdjointRay, direction: int, criterion: Criterion, bilinear: Bilinear) -> Array:
    """(N+1, nx+nu) derivative of `sum_k v_k' dG_k w` with respect to (x_k, u_k).

    Args:
        ray: The ray, with the weights v.
        direction: Index of the direction w.
        criterion: The criterion with its r directions.
        bilinear: Derivatives of the plant along these directions.
    """
    term = np.zeros((len(ray.measured), bilinear.A.shape[1] + bilinear.B.shape[2]))
    term[:-1] = np.einsum("kzx,kx->kz", bilinear.F_mixed[direction], ray.costate[1:])

    if bilinear.h_mixed is not None:
        term += np.einsum("kzy,ky->kz", bilinear.h_mixed[direction], ray.outputs)
    if bilinear.output_delay is not None and bilinear.delay_derivative is not None:
        rate = float(bilinear.delay_derivative @ criterion.directions[direction])
        term += _delay_term(bilinear, ray.measured * rate)
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
    if bilinear.output_delay is None:
        raise ValueError("the outputs have no delay")

    e = bilinear.output_delay.derivative_transposed(v)
    by_state = np.einsum("kyx,ky->kx", bilinear.C, e)
    by_control = np.einsum("kyu,ky->ku", bilinear.D, e)
    return np.concatenate([by_state, by_control], axis=1)

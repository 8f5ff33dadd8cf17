"""Random linear-quadratic problems."""

from __future__ import annotations

import numpy as np

from mjfim.optimize.lq import Weights


def random_system(
    rng: np.random.Generator, N: int, nx: int, nu: int
) -> tuple[np.ndarray, np.ndarray]:
    """Return a time-varying, mildly unstable pair A (N, nx, nx), B (N, nx, nu)."""
    A = np.eye(nx) + 0.2 * rng.normal(size=(N, nx, nx))
    B = rng.normal(size=(N, nx, nu))
    return A, B


def positive(rng: np.random.Generator, n: int) -> np.ndarray:
    """Return a random symmetric positive definite weight (n, n) that is not diagonal."""
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.5 * np.eye(n)


def random_weights(rng: np.random.Generator, N: int, nx: int, nu: int, steps: bool) -> Weights:
    """Return positive definite weights that vary over time and couple state and control.

    Args:
        rng: Source of random numbers.
        N: Number of samples.
        nx: Number of states.
        nu: Number of controls.
        steps: Whether changes of the control between samples carry weights as well.
    """
    both = [positive(rng, nx + nu) for _ in range(N)]
    Q = np.array([*(form[:nx, :nx] for form in both), positive(rng, nx)])
    S = np.array([form[nx:, :nx] for form in both])
    R = np.array([form[nx:, nx:] for form in both])
    W = rng.uniform(0.0, 5.0, (N + 1, nu)) * steps
    return Weights(Q=Q, S=S, R=R, W=W)

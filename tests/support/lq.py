"""Random linear-quadratic problems."""

from __future__ import annotations

import numpy as np

from mjfim.optimize.lq import Weights


def random_system(
    rng: np.random.Generator, N: int, nx: int, nu: int
) -> tuple[np.ndarray, np.ndarray]:
    """A time-varying, mildly unstable pair A (N, nx, nx), B (N, nx, nu)."""
    return np.eye(nx) + 0.2 * rng.normal(size=(N, nx, nx)), rng.normal(size=(N, nx, nu))


def positive(rng: np.random.Generator, n: int) -> np.ndarray:
    """A random symmetric positive definite weight that is not diagonal."""
    root = rng.normal(size=(n, n))
    return root @ root.T + 0.5 * np.eye(n)


def random_weights(rng: np.random.Generator, N: int, nx: int, nu: int, steps: bool) -> Weights:
    """Positive definite weights that vary over time and couple state and control.

    Args:
        steps: Whether changes of the control between samples carry weights as well.
    """
    both = [positive(rng, nx + nu) for _ in range(N)]
    Q = np.array([*(form[:nx, :nx] for form in both), positive(rng, nx)])
    S, R = np.array([form[nx:, :nx] for form in both]), np.array([form[nx:, nx:] for form in both])
    return Weights(Q=Q, S=S, R=R, W=rng.uniform(0.0, 5.0, (N + 1, nu)) * steps)

"""Names of the baselines, which the command line shows without importing them."""

from __future__ import annotations

# Titles of the baselines by their keys, in the order in which a comparison runs them.
TITLES = {
    "chirp": "chirp",
    "multisine": "multisine (Schroeder)",
    "steps": "random steps",
    "fourier5": "Fourier 5",
    "fourier5-D": "Fourier 5, on D",
    "fourier15": "Fourier 15",
    "splines": "B-splines",
    "splines-D": "B-splines, on D",
    "fourier5-mjfim": "Fourier 5, mjfim's optimiser",
    "fourier15-mjfim": "Fourier 15, mjfim's optimiser",
}

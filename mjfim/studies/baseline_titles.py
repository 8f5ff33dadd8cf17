"""Names of the baselines, which the command line shows without importing them."""

from __future__ import annotations

# Titles of the baselines by their keys, in the order in which a comparison runs them.
TITLES = {
    "chirp": "chirp",
    "multisine": "multisine (Schroeder)",
    "steps": "random steps",
    "fourier5": "Fourier 5",
    "fourier15": "Fourier 15",
    "splines": "B-splines",
}

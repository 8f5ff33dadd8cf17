"""A first experiment for a model: rates, start, excitation, noise and parameters that suit it."""

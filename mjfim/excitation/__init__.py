"""Optimal design of excitation trajectories, with and without limits."""

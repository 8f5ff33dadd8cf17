"""Numerical range: extreme masses, integrators, timesteps, horizons, judged by plain MuJoCo."""

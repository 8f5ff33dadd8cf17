"""Fit of parameters to the equation of motion along measured motions (inverse dynamics)."""

from mjfim.identification.inverse_dynamics.equations import residual_forces
from mjfim.identification.inverse_dynamics.fit import (
    fit_equations,
    inverse_dynamics,
    try_fit_equations,
)
from mjfim.identification.inverse_dynamics.gross_errors import refuse_gross_error

__all__ = [
    "fit_equations",
    "inverse_dynamics",
    "refuse_gross_error",
    "residual_forces",
    "try_fit_equations",
]

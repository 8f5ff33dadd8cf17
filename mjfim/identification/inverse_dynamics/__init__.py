"""Fit of parameters to the equation of motion along measured motions (inverse dynamics)."""

from mjfim.identification.inverse_dynamics.fit import (
    fit_equations,
    inverse_dynamics,
    try_fit_equations,
)
from mjfim.identification.inverse_dynamics.gross_errors import refuse_gross_error
from mjfim.identification.inverse_dynamics.residual_forces import residual_forces

__all__ = [
    "fit_equations",
    "inverse_dynamics",
    "refuse_gross_error",
    "residual_forces",
    "try_fit_equations",
]

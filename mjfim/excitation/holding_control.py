"""The control that holds a state, found by Gauss-Newton steps on one sample of the plant."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.experiment.system import System
from mjfim.model.coordinates import joint_names

# Number of Gauss-Newton steps; one is enough where forces are linear in the control.
NEWTON_STEPS = 4

# Difference step of the control, relative to its size.
RELATIVE_DIFFERENCE = 1e-4

# Share of the horizon in which a held state may not reach the velocity that `[boundary]` tolerates.
HOLDING_SHARE = 0.025


def holding_control(system: System, state: Array, guess: Array, *, key: str, place: str) -> Array:
    """Find the control that holds a state within the tolerance of the experiment's `[boundary]`.

    Args:
        system: The system; the plant is taken at its theta.
        state: (ns,) state to hold.
        guess: (nu,) control from which the search starts.
        key: Key of the experiment file that requires it, for the error message.
        place: Name of the state, for the error message.

    Returns:
        (nu,) control.

    Raises:
        ExperimentError: No control holds the state.
    """
    control = least_drift_control(system, state, guess)

    drift = _drift(system, state, control[None])[0]
    _require_held(system, state, drift, key, place)
    return control


def least_drift_control(system: System, state: Array, guess: Array) -> Array:
    """Find the control under which a state changes least over one sample.

    It holds the state where any control does.

    Args:
        system: The system; the plant is taken at its theta.
        state: (ns,) state.
        guess: (nu,) control from which the search starts.

    Returns:
        (nu,) control, which may violate limits.
    """
    control = np.array(guess)
    sizes = np.maximum(np.abs(control), system.plant.sizes.control)
    steps = RELATIVE_DIFFERENCE * sizes
    state_sizes = system.plant.sizes.state

    for _ in range(NEWTON_STEPS):
        # The drift under the control, and under one control for each component that is moved.
        rows = _drift(system, state, np.vstack([control, control + np.diag(steps)]))
        B = (rows[1:] - rows[0]).T / RELATIVE_DIFFERENCE / state_sizes[:, None]
        if not np.isfinite(B).all():
            break

        # The Gauss-Newton step makes the linearised drift as small as possible, relative to the
        # sizes of states and controls.
        control = control - sizes * np.linalg.lstsq(B, rows[0] / state_sizes)[0]

    return control


def _drift(system: System, state: Array, controls: Array) -> Array:
    """(m, nx) change of a state over a sample under each of (m, nu) controls."""
    plant = system.plant
    states = np.broadcast_to(state, (len(controls), len(state)))
    stepped = plant.simulator.step([plant.model(system.theta)], states, controls)
    return np.asarray(system.space.minus(stepped.states, state))


def _require_held(system: System, state: Array, drift: Array, key: str, place: str) -> None:
    """Require that a state is at rest and does not accelerate under a control.

    Args:
        system: The system.
        state: (ns,) state.
        drift: (nx,) change of the state over one sample under the control.
        key: Key of the experiment file, for the error message.
        place: Name of the state, for the error message.

    Raises:
        ExperimentError: A joint moves or accelerates.
    """
    nv = system.space.nv
    acceleration = np.abs(drift[nv : 2 * nv]) / system.dt
    speed = np.abs(system.space.split(state)[1])

    moves = bool(speed.any())
    worst = int(np.argmax(speed if moves else acceleration))
    tolerated = system.experiment.boundary.velocity
    holding_time = HOLDING_SHARE * float(system.experiment.horizon or 0.0)
    if acceleration[worst] * holding_time <= tolerated and not moves:
        return

    model = system.model
    name = joint_names(model)[int(model.dof_jntid[worst])]
    fault = f"still accelerates by {acceleration[worst]:.3g} per s²"
    if not np.isfinite(drift).all():
        fault = "diverges within one sample"
    if moves:
        fault = f"moves at {speed[worst]:.3g} per s"
    raise ExperimentError(
        f"{key}: no control holds {place}: joint {name!r} {fault}; begin and end where the model "
        'can stand still (qvel = 0, an equilibrium), or state start = "given", end = "free"'
    )

"""The control that holds a state, found by Gauss-Newton steps on one sample of the plant."""

from __future__ import annotations

import copy
from typing import Any, NamedTuple

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.experiment.system import System
from mjfim.model.coordinates import joint_names
from mjfim.model.variants import Relaxation
from mjfim.plant.batch import BatchSimulator

# Number of Gauss-Newton steps over one engine step, and then over one sample; one is enough where
# the drift is linear in the control.
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
        ExperimentError: No control holds the state, at the stated timestep.
    """
    control = least_drift_control(system, state, guess)

    stated = system.plant.model(system.theta)
    drift = _Drift(system, system.plant.simulator, stated, state).under(control[None])[0]

    # Contacts are softer with a longer timestep. Where the search takes one, the stated timestep
    # decides whether the state is held.
    if system.variant.timestep_factor == 1 and system.variant.sample_factor == 1:
        _require_held(system, state, drift, key, place)
    return control


def least_drift_control(system: System, state: Array, guess: Array) -> Array:
    """Find the control under which a state changes least over one sample.

    It holds the state where any control does. Clamps of controls and forces are lifted, because the
    drift does not depend on a control whose force is clamped: that of a stiff servo far from the
    state, for example.

    Args:
        system: The system; the plant is taken at its theta.
        state: (ns,) state.
        guess: (nu,) control from which the search starts.

    Returns:
        (nu,) control, which may violate limits.
    """
    model = _without_clamps(system.plant.model(system.theta))
    sample = system.plant.simulator

    # Over one engine step, the drift is linear in most controls, however far the guess is from
    # the control that is sought. Over a sample, it shows the effect of all of them.
    control = guess
    for simulator in (sample.with_substeps(1), sample):
        control = _settled(_Drift(system, simulator, model, state), control)
    return control


def _settled(drift: _Drift, guess: Array) -> Array:
    """Gauss-Newton steps towards the control, (nu,), under which a state changes least."""
    natural = drift.system.plant.sizes
    control = np.array(guess)
    sizes = np.maximum(np.abs(control), natural.control)
    steps = RELATIVE_DIFFERENCE * sizes

    for _ in range(NEWTON_STEPS):
        # The drift under the control, and under one control for each component that is moved.
        rows = drift.under(np.vstack([control, control + np.diag(steps)]))
        B = (rows[1:] - rows[0]).T / RELATIVE_DIFFERENCE / natural.state[:, None]
        if not np.isfinite(B).all():
            break

        # The Gauss-Newton step makes the linearised drift as small as possible, relative to the
        # sizes of states and controls.
        control = control - sizes * np.linalg.lstsq(B, rows[0] / natural.state)[0]

    return control


class _Drift(NamedTuple):
    """Change of a state over one sample.

    Attributes:
        system: The system.
        simulator: Simulates the sample.
        model: The compiled model.
        state: (ns,) state before the sample.
    """

    system: System
    simulator: BatchSimulator
    model: Any
    state: Array

    def under(self, controls: Array) -> Array:
        """(m, nx) change of the state under each of (m, nu) controls."""
        states = np.broadcast_to(self.state, (len(controls), len(self.state)))
        after, _, _ = self.simulator.step([self.model], states, controls)
        return np.asarray(self.system.space.minus(after, self.state))


def _without_clamps(model: Any) -> Any:
    """A copy of a model whose controls and forces are not clamped."""
    unclamped = copy.copy(model)
    clamps = Relaxation(
        joint_forces=tuple(range(model.njnt)),
        actuators=tuple(range(model.nactuator)),
        controls=True,
    )
    clamps.apply(unclamped)
    return unclamped


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

"""Controls of an experiment: the stated one, and the one that holds a state."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, shortened
from mjfim.experiment.initial import generate
from mjfim.experiment.packing import opened
from mjfim.experiment.schema import Experiment
from mjfim.experiment.system import System
from mjfim.experiment.system_tables import Signal
from mjfim.model.coordinates import joint_names
from mjfim.model.variants import Relaxation
from mjfim.plant.batch import BatchSimulator
from mjfim.recordings.delimited import read_control

# Largest number of samples of a design, so that a mistyped horizon does not fill the memory.
MAX_SAMPLES = 10_000_000

# Relative deviation of the number of samples from a whole number that is round-off.
SAMPLE_COUNT_TOLERANCE = 1e-6

# Number of Gauss-Newton steps over one engine step, and then over one sample; one is enough where
# the drift is linear in the control.
NEWTON_STEPS = 4

# Difference step of the control, relative to its size.
RELATIVE_DIFFERENCE = 1e-4

# Share of the horizon in which a held state may not reach the velocity that `[boundary]` tolerates.
HOLDING_SHARE = 0.025


def require_design_keys(system: System, work: str = "design") -> None:
    """Check that the experiment states the keys that only a design needs.

    Args:
        system: The system. A model without actuators needs no control.
        work: Name of the work that needs them, for the message.

    Raises:
        ExperimentError: `horizon` or `initial.control` is missing, or control laws are stated.
    """
    experiment = system.experiment
    if system.laws is not None:
        raise ExperimentError(
            f"{experiment.source}: controllers: {work} needs a control without a law, because "
            "derivatives of single samples do not show what a law remembers; [controllers] serves "
            "`identify`, `simulate` and `check RECORDING`. State a servo in the MJCF, such as "
            '<position kp="..." kv="...">, and an experiment file without [controllers]'
        )
    require_horizon_and_control(system, work)


def require_horizon_and_control(system: System, work: str) -> None:
    """Check that the experiment states the duration and the control of a motion.

    Args:
        system: The system. A model without actuators needs no control.
        work: Name of the work that needs them, for the message.

    Raises:
        ExperimentError: `horizon` or `initial.control` is missing.
    """
    experiment = system.experiment
    if experiment.horizon is None:
        raise ExperimentError(
            f"{experiment.source}: {work} needs `horizon`, the duration of the experiment [s], for "
            "example horizon = 4.0"
        )
    if experiment.initial.control is None and system.controls:
        raise ExperimentError(
            f"{experiment.source}: {work} needs `initial.control`, the control from which it "
            f"starts, for example {_control_example(system)}; `mjfim init "
            f"{experiment.model}` writes a whole file with amplitudes that suit the model"
        )


def _control_example(system: System) -> str:
    """Initial control that a message proposes.

    It varies about the control of the keyframe, which is the default offset, where one is stated.
    """
    text = 'control = { kind = "multisine", amplitude = 1.0 }'
    initial, model = system.experiment.initial, system.model
    names = [model.key(i).name for i in range(model.nkey) if model.key(i).name]
    stated = initial.keyframe
    if stated is None:
        is_free = names and initial.qpos is None
        offer = f", about the control of a keyframe with keyframe = {names[0]!r}" if is_free else ""
        return f"{text} in [initial]{offer}"
    return (
        f"{text} in [initial], about the control of the keyframe {shortened(repr(stated))}, or "
        'control = { kind = "constant", amplitude = 0.0 }, which holds it'
    )


def require_controls(system: System, work: str) -> None:
    """Check that controls are designed, for work that compares or continues them.

    Args:
        system: The system.
        work: Name of the work, for the message.

    Raises:
        ExperimentError: The model has no actuators, or `initial.free` is stated.
    """
    if system.controls and not system.experiment.initial.free:
        return

    reason = "the model has no actuators"
    if system.controls:
        reason = "initial.free lets the design choose the initial state instead"
    raise ExperimentError(
        f"{system.experiment.source}: {work} is for designs of a control, and {reason}; use "
        "`mjfim design`"
    )


def sample_count(experiment: Experiment, stride: int) -> int:
    """Number of samples in the horizon.

    Args:
        experiment: The experiment.
        stride: Samples from one measurement to the next.

    Raises:
        ExperimentError: The horizon is not a whole number of samples, is too long, or ends before
            the first measurement.
    """
    horizon = float(experiment.horizon or 0.0)
    period = 1.0 / experiment.rate
    exact = horizon * experiment.rate
    count = round(exact)

    if count < 2 or abs(exact - count) > SAMPLE_COUNT_TOLERANCE * count:
        near = f"{max(count, 2) * period:g} s, {(max(count, 2) + 1) * period:g} s"
        raise ExperimentError(
            f"horizon: {horizon:g} s is not a whole number (>= 2) of samples of {period:g} s; "
            f"valid for example: {near}"
        )
    if count > MAX_SAMPLES:
        raise ExperimentError(f"horizon: {count:g} samples are too many; at most {MAX_SAMPLES:g}")
    if stride > count:
        raise ExperimentError(
            f"measure_rate: {experiment.measure_rate:g} Hz measures nothing within {horizon:g} s"
        )
    return count


def stated_control(system: System) -> Array:
    """Initial control that the experiment states: a generated signal, or a table in a file.

    Args:
        system: The system.

    Returns:
        (N, nu) control over the stated horizon, at the stated sample rate [u-unit]; without
        actuators it has no columns.

    Raises:
        ExperimentError: The horizon, the signal or the file cannot be used.
    """
    experiment, grid = system.experiment, system.stated_grid
    source = experiment.initial.control
    count = sample_count(experiment, grid.stride)
    t = np.arange(count, dtype=np.float64) * grid.dt

    # A model without actuators moves by itself; its control has no columns.
    if not system.controls:
        if source is not None:
            raise ExperimentError(
                "initial.control: the model has no actuators; remove this key, and the motion "
                "follows from the initial state alone"
            )
        return np.zeros((count, 0))

    if isinstance(source, Signal):
        return generate(source, t, system.controls, system.rest)
    with opened(experiment, str(source)) as file:
        return read_control(file, t, grid.dt, system.controls)


def stated_inputs(system: System) -> Array:
    """Inputs of control laws over the stated horizon.

    A table holds a column for each input. A generated signal is the reference of actuators with a
    law, about the initial position of their joints, and the control of the others; the velocity of
    the reference is its slope, there is no feed-forward, and all laws are on.

    Args:
        system: The system, with control laws.

    Returns:
        (N, w) inputs [unit of the input].

    Raises:
        ExperimentError: The horizon, the signal or the file cannot be used.
    """
    experiment, laws = system.experiment, system.laws
    assert laws is not None
    dt = system.stated_grid.dt
    t = np.arange(sample_count(experiment, system.stated_grid.stride), dtype=np.float64) * dt

    source = experiment.initial.control
    if not isinstance(source, Signal):
        names = tuple(name.removeprefix("ctrl:") for name in laws.columns)
        with opened(experiment, str(source)) as file:
            return read_control(file, t, dt, names)

    rest = np.array(system.rest)
    for law in laws.laws:
        rest[law.control] = system.nominal_initial_state[law.q]
    signal = generate(source, t, system.controls, rest)
    inputs = np.zeros((len(signal), len(laws.inputs)))
    places, controls = laws.direct
    inputs[:, places] = signal[:, controls]

    for law in laws.laws:
        reference = signal[:, law.control]
        values = {
            "reference": reference,
            "reference_velocity": np.gradient(reference, dt),
            "gain": np.ones(len(signal)),
            "enable": np.ones(len(signal)),
        }
        for quantity, column in law.columns.items():
            inputs[:, column] = values.get(quantity, 0.0)
    return inputs


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

    # Contacts are softer with a longer timestep. Where the search takes one, the stated timestep
    # decides whether the state is held.
    if system.variant.timestep_factor == 1 and system.variant.sample_factor == 1:
        stated = system.plant.model(system.theta)
        drift = _drift(system, system.plant.simulator, stated, state, control[None])[0]
        _require_held(system, state, drift, key, place)
    return control


def _without_clamps(model: Any) -> Any:
    """A copy of a model (MjModel) without clamps of controls and forces."""
    model = copy.copy(model)
    clamps = Relaxation(
        joint_forces=tuple(range(model.njnt)),
        actuators=tuple(range(model.nactuator)),
        controls=True,
    )
    clamps.apply(model)
    return model


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
    sample, natural = system.plant.simulator, system.plant.sizes
    control = np.array(guess)

    # Over one engine step, the drift is linear in most controls, however far the guess is from
    # the control that is sought. Over a sample, it shows the effect of all of them.
    for simulator in (sample.with_substeps(1), sample):
        sizes = np.maximum(np.abs(control), natural.control)
        moves = np.vstack([np.zeros_like(control), np.diag(RELATIVE_DIFFERENCE * sizes)])
        for _ in range(NEWTON_STEPS):
            # The drift under the control, and under one control for each component that is moved.
            rows = _drift(system, simulator, model, state, control + moves)
            B = (rows[1:] - rows[0]).T / RELATIVE_DIFFERENCE / natural.state[:, None]
            if not np.isfinite(B).all():
                break

            # The Gauss-Newton step makes the linearised drift as small as possible, relative to
            # the sizes of states and controls.
            control = control - sizes * np.linalg.lstsq(B, rows[0] / natural.state)[0]
    return control


def _drift(
    system: System, simulator: BatchSimulator, model: Any, state: Array, controls: Array
) -> Array:
    """(m, nx) change of a state, (ns,), over one sample under each of (m, nu) controls."""
    states = np.broadcast_to(state, (len(controls), len(state)))
    after, _, _ = simulator.step([model], states, controls)
    return np.asarray(system.space.minus(after, state))


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

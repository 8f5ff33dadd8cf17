"""Memory that a design or a check along a trajectory needs, estimated before it begins."""

from __future__ import annotations

from mjfim.excitation.limits import derivative_substeps_of, limits_of
from mjfim.experiment.system import System
from mjfim.memory import NUMBER_BYTES, require_memory
from mjfim.optimize.directions import LBFGS

# Factor from the counted numbers to the peak: short-lived copies, and what the allocator keeps.
PEAK_FACTOR = 1.45

# Memory that does not depend on the number of samples [bytes].
FIXED_BYTES = 2**24

# Moves of every coordinate of (x, u): forward and backward, at both sides of a direction.
MOVES = 4

# Trajectories with their sensitivities that a search holds at the same time.
HELD_POINTS = 3


def require_memory_for_design(system: System, samples: int, available: float | None = None) -> None:
    """Refuse a horizon whose arrays do not fit into memory.

    Args:
        system: The system.
        samples: Number of samples of the horizon.
        available: Memory that is there [bytes]; None for that of this machine.

    Raises:
        ExperimentError: The memory is too small.
    """
    experiment = system.experiment
    require_memory(
        design_bytes(system, samples) / NUMBER_BYTES,
        f"horizon: {experiment.horizon:g} s at {experiment.rate:g} Hz",
        available=available,
    )


def design_bytes(system: System, samples: int) -> float:
    """Estimate the peak of the memory of a design or of a check, besides that of the libraries.

    Args:
        system: The system, whose experiment states the design.
        samples: Number of samples of the horizon.

    Returns:
        The memory [bytes].
    """
    numbers = max(_rollouts(system), _moved_samples(system), _engine_steps(system))
    numbers += _held(system)
    return FIXED_BYTES + PEAK_FACTOR * NUMBER_BYTES * numbers * samples


def _rollouts(system: System) -> int:
    """Numbers per sample of the rollouts with moved parameters."""
    sensors = _sensors(system)
    state = 1 + system.nominal_initial_state.size
    at_engine_steps = state + len(system.controls) + sensors
    at_samples = state + sensors + 2 * (system.space.nx + len(system.outputs))

    rollouts = 2 * len(system.parameters) + 1
    return rollouts * (system.grid.substeps * at_engine_steps + at_samples)


def _moved_samples(system: System) -> int:
    """Numbers per sample of the steps from moved states and controls."""
    state, nu = system.nominal_initial_state.size, len(system.controls)
    moves = MOVES * (system.space.nx + nu)

    # The numbers of a step itself, and its rows in the batch of rollouts.
    of_step = 5 * state + 2 * nu + 2 * _sensors(system) + _observed(system)
    in_batch = 2 * (1 + state + system.space.nv + nu)
    return moves * (of_step + in_batch)


def _engine_steps(system: System) -> int:
    """Numbers per sample of derivatives in closed form, which are kept at every engine step.

    Those of a motion, of the motion beside it and of the one before stand in memory together with
    the parts from which the last one is put together.
    """
    nx, nv = system.space.nx, system.space.nv
    return 4 * system.grid.substeps * (nv * (nx + len(system.controls)) + nx)


def _held(system: System) -> int:
    """Numbers per sample of the results that an iteration holds."""
    nx, nu, p = system.space.nx, len(system.controls), len(system.parameters)
    ny, coordinates = len(system.outputs), nx + nu
    sensitivity = p * (nx + ny)
    linearization = sensitivity + (nx + ny) * coordinates

    # The E-criterion has one direction, others have one for each parameter.
    is_smooth = _observed(system) or system.experiment.cost.criterion != "E"
    directions = p if is_smooth else 1
    mixed = directions * coordinates * 2 * (nx + _sensors(system))

    barrier = 2 * coordinates * _observed(system) + (2 * coordinates**2 if is_smooth else 0)
    pairs = 2 * LBFGS.memory * nu
    points = HELD_POINTS * (sensitivity + 2 * system.nominal_initial_state.size + nu)
    return linearization + mixed + barrier + pairs + points


def _sensors(system: System) -> int:
    """Numbers of sensor data per sample; 0 where no sensor is an output."""
    return int(system.model.nsensordata) if system.outputs.needs_sensors else 0


def _observed(system: System) -> int:
    """Numbers per sample that a barrier observes, at all its engine steps; 0 without limits."""
    stated = system.experiment.limits
    if not stated.enforce:
        return 0
    limits = limits_of(system.model, system.controls, stated, system.grid.dt)
    observed = [limit for limit in limits if limit.kind not in ("control", "control_rate")]
    return sum(limit.count for limit in observed) * len(
        derivative_substeps_of(system.grid.substeps)
    )

"""Segments and private unknowns that the table `[fit]` of an experiment states."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording
from mjfim.identification.known_activations import KnownActivations
from mjfim.identification.segments import (
    Segment,
    cut_into_segments,
    free_release,
    whole_recordings,
)
from mjfim.model.parameters import ParameterSet

# Largest increase of a delay during the search, in prior standard deviations of its parameters, or
# in their scales where there is no prior.
MAX_DELAY_GROWTH = 5.0

# Largest increase of a delay without a prior, relative to the duration of the shortest recording;
# five samples of a fast log would be too short.
MAX_DELAY_SHARE = 0.025


def has_free_starts(system: System) -> bool:
    """Whether the initial states of segments are free, and begin at measured values.

    Args:
        system: System with the table `[fit]`.
    """
    settings = system.experiment.fit
    is_measured = settings.start != "stated" or settings.segment_length is not None
    return is_measured or free_release(system)


def segments_of_fit(
    system: System, recordings: Sequence[AlignedRecording], free_starts: bool
) -> tuple[tuple[Segment, ...], Array]:
    """Divide recordings into the segments that the settings of a fit state.

    Args:
        system: System with the table `[fit]`.
        recordings: The recordings.
        free_starts: Whether the initial states of segments come from the measured values.

    Returns:
        The segments, and (nx, n) directions in which their private unknowns move the initial state.

    Raises:
        ExperimentError: A parameter moves the initial state, which is measured.
        RecordingError: The segments are too short.
    """
    parameters = system.parameters
    if free_starts:
        _require_measured_starts(system)
        length = system.experiment.fit.segment_length
        duration = min(float(recording.t[-1]) for recording in recordings)
        delay = _max_delay(parameters, duration)
        segments = cut_into_segments(system, recordings, length, delay)
        return segments, _free_directions(system)

    by_theta = parameters.initial_state_derivative(system.space.nx)
    directions = by_theta[:, parameters.initial_deviations]
    return whole_recordings(system, recordings), directions


def _free_directions(system: System) -> Array:
    """(nx, n) directions of a free initial state: all but the activations of physical terms."""
    space = system.space
    known = [2 * space.nv + address for address in KnownActivations.of(system).addresses]
    return np.delete(np.eye(space.nx), known, axis=1)


def _require_measured_starts(system: System) -> None:
    """Raise ExperimentError where a parameter moves the initial state, which is measured."""
    parameters = system.parameters
    moves_start = parameters.initial_state_derivative(system.space.nx).any(axis=0)
    if moves_start.any():
        name = parameters.names[int(np.argmax(moves_start))]
        raise ExperimentError(
            f"{system.experiment.source}: {name}: the initial state is free where fit.segments or "
            f'fit.start = "{_stated_start(system)}" is stated; remove nuisance.initial and '
            "parameters of the initial state, or remove the settings of the fit"
        )


def _stated_start(system: System) -> str:
    """The value of fit.start for a message, an example of those with a free initial state."""
    start = system.experiment.fit.start
    return "measured" if start == "stated" else start


def _max_delay(parameters: ParameterSet, duration: float) -> float:
    """Largest delay of the outputs that the search may try [s].

    Args:
        parameters: The parameters.
        duration: Duration of the shortest recording [s].
    """
    per_parameter = parameters.delay_derivative
    if not per_parameter.any():
        return 0.0

    growth = MAX_DELAY_GROWTH * np.array([p.prior or p.scale for p in parameters.parameters])
    has_prior = np.array([p.prior is not None for p in parameters.parameters])
    grows = ~has_prior & (per_parameter != 0.0)
    share = MAX_DELAY_SHARE * duration / np.abs(per_parameter[grows])
    growth[grows] = np.maximum(growth[grows], share)

    latest = np.minimum(parameters.guess + growth, parameters.upper)
    return max(float(per_parameter @ latest), 0.0)

"""Segments of recordings for multiple shooting, and the initial state of each segment.

A simulation over a whole recording amplifies unmodelled effects, for example chaos, slip or a push.
Segments of a few time constants, each with a separate initial state, avoid that. The state may jump
from one segment to the next.

Activations of physical terms at the begin of a segment are no unknowns. The lag of an actuator
follows from the recorded control, and the bristle of a friction from the measured velocity. What
remains of their error dies out within a few samples and acts like a small kick, which the free
initial velocity contains.
"""

from __future__ import annotations

from collections.abc import Collection, Iterator, Sequence
from dataclasses import dataclass, replace
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError, RecordingError, listed
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import EDGE_TOLERANCE, AlignedRecording, align
from mjfim.model.elements import BRISTLE_STIFFNESS_COLUMN, bristle_actuators
from mjfim.model.parameters import ParameterSet
from mjfim.model.terms.term import FILTERS
from mjfim.model.units import actuator_gear
from mjfim.plant.outputs import outputs_by_state
from mjfim.records.trajectory import Recording

# Columns of the friction of a `dcmotor` in its bias: Coulomb, static, Stribeck speed.
FRICTION_COLUMNS = slice(3, 6)


def bristles_of(model: Any) -> Iterator[tuple[int, int, int]]:
    """Bristles of the passive devices of a model at slides and hinges.

    Args:
        model: The compiled model (`mujoco.MjModel`).

    Yields:
        Number of the device among the actuators, address of its deflection among the activations,
        and degree of freedom of its joint.
    """
    scalar = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
    for actuator in bristle_actuators(model):
        joint = int(model.actuator_trnid[actuator, 0])
        at_joint = int(model.actuator_trntype[actuator]) == int(mujoco.mjtTrn.mjTRN_JOINT)
        if at_joint and int(model.jnt_type[joint]) in scalar:
            yield actuator, int(model.actuator_actadr[actuator]), int(model.jnt_dofadr[joint])


def bristle_deflection(model: Any, actuator: int, speed: Array, direction: Array) -> Array:
    """(n,) deflections of a bristle in steady sliding.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        actuator: Number of its device among the actuators.
        speed: (n,) speeds of the device.
        direction: (n,) the signs of the speeds, or numbers between -1 and 1 near rest.
    """
    stiffness = model.actuator_dynprm[actuator, BRISTLE_STIFFNESS_COLUMN]
    coulomb, static, stribeck = model.actuator_biasprm[actuator, FRICTION_COLUMNS]
    ratio = speed / max(stribeck, mujoco.mjMINVAL)
    force = coulomb + (static - coulomb) * np.exp(-(ratio**2))
    return np.asarray(direction * force / stiffness)


@dataclass(frozen=True, kw_only=True, eq=False)
class KnownActivations:
    """Activations that physical terms have added to a model.

    Attributes:
        model: The model at the guess (`mujoco.MjModel`).
        actuators: Actuators with such an activation, and its address among the activations.
        columns: Columns of a recording that hold controls, by the address of the control.
    """

    model: Any
    actuators: tuple[tuple[int, int], ...]
    columns: dict[int, int]

    @staticmethod
    def of(system: System) -> KnownActivations:
        """Activations of the terms of a system."""
        layout = system.source.layout
        if layout is None:
            return KnownActivations(model=system.model, actuators=(), columns={})

        model = system.plant.model(system.parameters.guess)
        columns = {i: i for i in range(model.nu)}
        if system.laws is not None:
            inputs, controls = system.laws.direct
            columns = dict(zip(controls.tolist(), inputs.tolist(), strict=True))

        # No recording shows the control that a law computes, so that its lag is an unknown.
        is_shown = ~np.isin(model.actuator_dyntype, FILTERS)
        is_shown |= np.isin(model.actuator_ctrladr, list(columns))
        is_added = (model.actuator_actnum > 0) & ~np.isin(model.actuator_actadr, layout.act)
        found = tuple(
            (actuator, int(model.actuator_actadr[actuator]))
            for actuator in np.flatnonzero(is_added & is_shown).tolist()
        )
        return KnownActivations(model=model, actuators=found, columns=columns)

    @property
    def addresses(self) -> list[int]:
        """Their addresses among the activations."""
        return [address for _, address in self.actuators]

    def at(self, recording: AlignedRecording, begins: np.ndarray, qvel: Array) -> Array:
        """The activations at some samples of a recording.

        Args:
            recording: The recording.
            begins: (n,) samples.
            qvel: (n, nv) velocities at these samples [m/s or rad/s].

        Returns:
            (n, k) activations in the order of `addresses`.
        """
        columns = [
            self._filtered(actuator, recording, begins)
            if int(self.model.actuator_dyntype[actuator]) in FILTERS
            else self._bent(actuator, qvel)
            for actuator, _ in self.actuators
        ]
        return np.column_stack([np.zeros((len(begins), 0)), *columns])

    def _filtered(self, actuator: int, recording: AlignedRecording, begins: np.ndarray) -> Array:
        """(n,) controls after the lag of an actuator, which is at rest at the first row."""
        control = int(self.model.actuator_ctrladr[actuator])
        u = recording.ctrl[:, self.columns[control]]
        if self.model.actuator_ctrllimited[control]:
            u = np.clip(u, *self.model.actuator_ctrlrange[control])

        # a_{k+1} = a_k + s (u_k - a_k), with a_0 = u_0.
        time_constant = max(float(self.model.actuator_dynprm[actuator, 0]), mujoco.mjMINVAL)
        share = -np.expm1(-recording.dt / time_constant)
        bands = np.array([np.ones(len(u) + 1), np.full(len(u) + 1, share - 1.0)])
        filtered = scipy.linalg.solve_banded((1, 0), bands, np.append(u[:1], share * u))
        return np.asarray(filtered[begins])

    def _bent(self, actuator: int, qvel: Array) -> Array:
        """(n,) deflections of a bristle in steady sliding at velocities qvel: (n, nv)."""
        dof = next(dof for each, _, dof in bristles_of(self.model) if each == actuator)
        speed = actuator_gear(self.model, actuator) * qvel[:, dof]
        return bristle_deflection(self.model, actuator, speed, np.sign(speed))


# Number of measured rows before and after a time to which a polynomial is fitted, to find the state
# at that time.
ROWS_PER_SIDE = 12

# Smallest number of samples of a segment.
MIN_SAMPLES = 4

# Largest ratio of the lengths of segments that are simulated in one batch.
MAX_LENGTH_RATIO = 1.1

# Largest increase of a delay during the search, in prior standard deviations of its parameters, or
# in their scales where there is no prior.
MAX_DELAY_GROWTH = 5.0

# Largest increase of a delay without a prior, relative to the duration of the shortest recording;
# five samples of a fast log would be too short.
MAX_DELAY_SHARE = 0.025

# Number of rows whose scatter shows the noise, number of rows at the begin whose mean is compared
# with the stated initial state, and standard deviations of a clear difference.
ROWS_OF_NOISE = 25
ROWS_AT_BEGIN = 4
CLEAR_SIGMAS = 5.0

# Standard deviation of normal noise over its median absolute value.
SIGMA_PER_MEDIAN = 1.4826

# Share of their uncertainty by which parameters are moved for differences.
SMALL_MOVE = 1e-3

# Multiples of the golden ratio, modulo 1, spread evenly without a period.
GOLDEN_RATIO = 0.6180339887498949


@record
class Segment:
    """Consecutive samples of one recording that are simulated from a separate initial state.

    Attributes:
        recording: Index of the recording.
        begin: Sample of the recording at which the simulation begins.
        samples: Number of samples.
        rows: Rows of the recording that are compared with this segment.
        start: (ns,) state at the begin, from which the search starts.
    """

    recording: int
    begin: int
    samples: int
    rows: slice
    start: Array

    def first_part(
        self, recording: AlignedRecording, share: float, most: int | None = None
    ) -> Segment:
        """The first rows of this segment, and the samples that they need.

        Args:
            recording: Its recording.
            share: Share of the rows.
            most: Largest number of rows; None for any.
        """
        count = self.rows.stop - self.rows.start
        wanted = max(int(np.ceil(share * count)), min(count, MIN_SAMPLES))
        last = self.rows.start + (wanted if most is None else min(wanted, most))
        if last == self.rows.stop:
            return self
        end = recording.t[last - 1] / recording.dt
        samples = int(np.ceil(end - EDGE_TOLERANCE)) - self.begin
        return replace(
            self,
            samples=min(max(samples, MIN_SAMPLES), self.samples),
            rows=slice(self.rows.start, last),
        )


def has_free_starts(system: System) -> bool:
    """Whether the initial states of segments are free, and begin at measured values."""
    settings = system.experiment.fit
    is_measured = settings.start != "stated" or settings.segment_length is not None
    # Recordings may begin at releases that only they show, where nothing else moves the start.
    moves = system.plant.initial_state_derivative.any()
    return is_measured or (bool(system.experiment.initial.free) and not moves)


# A sentence about a recording whose first rows contradict the stated initial state, and by output
# what they show beyond this state [unit of the output].
OtherBegin = tuple[str, dict[str, float]]


def begins_elsewhere(system: System, recordings: Sequence[Recording]) -> tuple[OtherBegin, ...]:
    """Recordings whose first rows contradict the stated initial state.

    They may differ by the noise, stated or seen, and by what uncertain parameters explain.

    Args:
        system: The system.
        recordings: Recordings in SI units.

    Raises:
        RecordingError: A recording cannot be used.
    """
    if has_free_starts(system) or system.experiment.initial.free:
        return ()
    parameters, model, outputs = system.parameters, system.model, system.outputs.outputs
    # What accelerations and forces are at first depends on the control.
    stages = np.repeat(model.sensor_needstage, model.sensor_dim)
    late = int(mujoco.mjtStage.mjSTAGE_ACC)
    is_known = [o.sensor is None or stages[o.sensor] < late for o in outputs]
    sizes = np.array([p.prior or p.scale for p in parameters.parameters])
    moved = np.concatenate([np.zeros((1, len(sizes))), SMALL_MOVE * np.diag(sizes)])
    found = []
    for recording in recordings:
        aligned = align(system, recording.first_rows(ROWS_OF_NOISE))
        rough = np.nan_to_num(np.diff(aligned.y, n=2, axis=0)) / np.sqrt(6.0)
        scatter = SIGMA_PER_MEDIAN * np.median(np.abs(rough), axis=0)
        sigma = np.maximum(scatter, system.noise.sigma)

        # The mean over the first rows, as far as the model hardly moves.
        samples = np.rint(aligned.t[:ROWS_AT_BEGIN] / aligned.dt).astype(int)
        y, is_finite = system.plant.measure(
            parameters.guess + moved, aligned.ctrl[: max(samples[-1], 1)]
        )
        y = y[:, samples]
        is_still = np.minimum.accumulate(np.abs(y[0] - y[0, 0]) <= sigma) & is_known
        counted = is_still & aligned.measured[: len(samples)]
        count = np.maximum(counted.sum(axis=0), 1)
        difference = np.where(counted, aligned.y[: len(samples)] - y[0], 0.0).sum(axis=0) / count
        by_theta = np.where(counted & is_finite[1:, None, None], y[1:] - y[0], 0.0).sum(axis=1)
        by_theta = np.linalg.norm(by_theta / count / SMALL_MOVE, axis=0)
        limit = CLEAR_SIGMAS * np.hypot(sigma / np.sqrt(count), by_theta)
        other = np.flatnonzero(np.abs(difference) > limit).tolist()
        words = [
            f"{outputs[j].name.partition(':')[2] or outputs[j].name} {difference[j]:+.2g} "
            f"{outputs[j].unit}".rstrip()
            for j in other
        ]
        if other:
            by = {outputs[j].name: float(difference[j]) for j in other}
            sentence = (
                f"{Path(recording.name).name} does not begin where [initial] says "
                f"({listed(words)}): its initial state was estimated from its first rows"
            )
            found.append((sentence, by))
    return tuple(found)


def stated_segments(
    system: System, recordings: Sequence[AlignedRecording]
) -> tuple[tuple[Segment, ...], Array]:
    """Divide recordings into the segments that the table `[fit]` states.

    Returns:
        The segments, and (nx, n) directions in which their private unknowns move the initial state.

    Raises:
        ExperimentError: A parameter moves the initial state, which is measured.
        RecordingError: The segments are too short.
    """
    parameters = system.parameters
    by_theta = system.plant.initial_state_derivative
    if not has_free_starts(system):
        return whole_recordings(system, recordings), by_theta[:, parameters.initial_deviations]

    fit = system.experiment.fit
    moves_start = by_theta.any(axis=0)
    if moves_start.any():
        name = parameters.names[int(np.argmax(moves_start))]
        stated = "measured" if fit.start == "stated" else fit.start
        raise ExperimentError(
            f"{system.experiment.source}: {name}: the initial state is free where fit.segments or "
            f'fit.start = "{stated}" is stated; remove nuisance.initial and '
            "parameters of the initial state, or remove the settings of the fit"
        )
    return free_segments(system, recordings, fit.segment_length)


def free_segments(
    system: System, recordings: Sequence[AlignedRecording], length: float | None
) -> tuple[tuple[Segment, ...], Array]:
    """Cut recordings into segments with free initial states.

    Args:
        system: The system.
        recordings: The recordings.
        length: About the length of a segment [s]; None for whole recordings.

    Returns:
        The segments, and (nx, n) `free_directions`.

    Raises:
        RecordingError: The segments are too short.
    """
    duration = min(float(recording.t[-1]) for recording in recordings)
    lead = _max_delay(system.parameters, duration)
    return cut_into_segments(system, recordings, length, lead), free_directions(system)


def free_directions(system: System) -> Array:
    """(nx, n) directions of a free initial state: all but the activations of physical terms."""
    known = [2 * system.space.nv + address for address in KnownActivations.of(system).addresses]
    return np.delete(np.eye(system.space.nx), known, axis=1)


def whole_recordings(system: System, recordings: Sequence[AlignedRecording]) -> tuple[Segment, ...]:
    """One segment for every recording, which begins at the stated or recorded initial state.

    Args:
        system: System that was recorded.
        recordings: The recordings.

    Returns:
        The segments.
    """
    return tuple(
        Segment(
            recording=i,
            begin=0,
            samples=len(recording.ctrl),
            rows=slice(0, len(recording.t)),
            start=recorded_release(system, recording),
        )
        for i, recording in enumerate(recordings)
    )


def recorded_release(system: System, recording: AlignedRecording) -> Array:
    """(ns,) nominal initial state of a recording.

    Coordinates of `initial.free` are measured at its begin; the others are stated.
    """
    space, nominal = system.space, system.plant.nominal_initial_state
    names = system.experiment.initial.free
    if not names:
        return nominal

    measured = measured_initial_states(system, recording, np.zeros(1, dtype=np.intp))[0]
    chosen = [c.address for c in system.source.coordinates.deviations if c.name in names]
    move = np.zeros(space.nx)
    move[chosen] = space.minus(measured, nominal)[chosen]
    return space.plus(nominal, move)


def cut_into_segments(
    system: System, recordings: Sequence[AlignedRecording], length: float | None, lead: float
) -> tuple[Segment, ...]:
    """Cut recordings into segments, each with an initial state from the measured values.

    Args:
        system: System that was recorded.
        recordings: The recordings.
        length: Length of a segment [s]; None: one segment per recording.
        lead: Time by which a segment is simulated before its first row, the largest delay of the
            outputs [s].

    Returns:
        The segments. There is none where a recording has no rows.

    Raises:
        RecordingError: The length is too short.
    """
    segments: list[Segment] = []
    ticks = system.plant.tick_samples
    for i, recording in enumerate(recordings):
        N = len(recording.ctrl)
        bounds = np.array([0, N])
        if length is not None:
            count = max(round(N * recording.dt / length), 1)
            if N // count < MIN_SAMPLES:
                raise RecordingError(
                    f"{recording.name}: fit.segments = {length:g} s is too short; "
                    f"a segment needs at least {MIN_SAMPLES} samples of {recording.dt:g} s"
                )
            bounds = np.linspace(0, N, count + 1).astype(int)

        # Segments begin at evaluations of all control laws. Those that are shorter than the time
        # between two evaluations go into their neighbours.
        if ticks > 1:
            at_ticks = np.unique(np.rint(bounds[:-1] / ticks).astype(int) * ticks)
            kept = (at_ticks == 0) | (at_ticks <= N - MIN_SAMPLES)
            bounds = np.append(at_ticks[kept], N)

        # The simulation of a segment begins earlier than its rows by the delay of the outputs.
        lead_samples = ticks * int(np.ceil(lead / (ticks * recording.dt) - 1e-9))
        begins = np.maximum(bounds[:-1] - lead_samples, 0)
        starts = measured_initial_states(system, recording, begins)

        # Rows on a bound belong to the segment that begins there.
        times = bounds * recording.dt - EDGE_TOLERANCE * recording.dt
        row_bounds = np.searchsorted(recording.t, times)
        row_bounds[-1] = len(recording.t)

        rows = [slice(*each) for each in pairwise(row_bounds.tolist())]
        places = zip(rows, begins.tolist(), bounds[1:].tolist(), starts, strict=True)
        segments += [
            Segment(recording=i, begin=begin, samples=end - begin, rows=own, start=start)
            for own, begin, end, start in places
            if own.stop > own.start
        ]
    return tuple(segments)


def _max_delay(parameters: ParameterSet, duration: float) -> float:
    """Largest delay of the outputs that the search may try [s].

    Args:
        parameters: The parameters.
        duration: Duration of the shortest recording [s].
    """
    per_parameter = parameters.delay_derivative
    growth = MAX_DELAY_GROWTH * np.array([p.prior or p.scale for p in parameters.parameters])
    has_prior = np.array([p.prior is not None for p in parameters.parameters])
    grows = ~has_prior & (per_parameter != 0.0)
    share = MAX_DELAY_SHARE * duration / np.abs(per_parameter[grows])
    growth[grows] = np.maximum(growth[grows], share)

    latest = np.minimum(parameters.guess + growth, parameters.upper)
    return max(float(per_parameter @ latest), 0.0)


def spread_over_data(count: int, wanted: int) -> np.ndarray:
    """Indices of some segments: one of each of equal stretches of the data, the first one included.

    Recordings that repeat in turn, such as one of each joint, are not met in step.
    """
    stretch = np.arange(wanted)
    place = stretch * GOLDEN_RATIO % 1.0 if wanted < count else 0.0
    return np.unique(((stretch + place) * (count / wanted)).astype(np.intp))


def measured_initial_states(
    system: System, recording: AlignedRecording, begins: np.ndarray
) -> Array:
    """States at some samples according to the measured values.

    Positions and velocities come from a polynomial fit to the rows nearby: a line for measured
    velocities, a parabola for positions. Activations of physical terms follow from the control and
    the velocity. Other components that were not measured are those of the model at the guess.

    Args:
        system: System that was recorded.
        recording: The recording.
        begins: (n,) samples of the recording.

    Returns:
        (n, ns) states.
    """
    space = system.space
    known = KnownActivations.of(system)
    output_of = measured_states(system, recording)

    quaternion_components = {a for q, _ in space.quaternions for a in range(q, q + 4)}
    velocity_addresses = (space.nq + space.scalar_v).tolist()
    velocity_of = dict(zip(space.scalar_q.tolist(), velocity_addresses, strict=True))
    first = space.nq + space.nv
    found = {*output_of, *(velocity_of[q] for q in output_of if q in velocity_of)}
    found |= {first + address for address in known.addresses}
    states = _nominal_states(system, recording, begins, found)

    for k, begin in enumerate(begins):
        t0 = begin * recording.dt

        # Measured positions, and velocities as their slopes.
        for q in range(space.nq):
            if q in output_of and q not in quaternion_components:
                value, slope = _local_fit(recording, output_of[q], t0, degree=2)
                states[k, q] = value
                states[k, velocity_of[q]] = slope

        # Measured velocities replace the slopes of positions.
        for v in range(space.nq, space.nq + space.nv):
            if v in output_of:
                states[k, v], _ = _local_fit(recording, output_of[v], t0, degree=1)

        # Quaternions cannot be averaged componentwise; the nearest one is taken.
        for q, _ in space.quaternions:
            columns = [output_of[a] for a in range(q, q + 4) if a in output_of]
            if len(columns) == 4:
                # Components of one quaternion are measured together.
                row_after = int(np.searchsorted(recording.t, t0))
                rows = recording.measured_rows_near(columns[0], row_after, 1)
                row = rows[np.argmin(np.abs(recording.t[rows] - t0))]
                nearest = recording.y[row, columns]
                states[k, q : q + 4] = nearest / np.linalg.norm(nearest)

    _, qvel, act = space.split(states)
    act[:, known.addresses] = known.at(recording, begins, qvel)
    return states


def _local_fit(
    recording: AlignedRecording, column: int, t0: float, degree: int
) -> tuple[float, float]:
    """Value and slope of an output at time t0 [s], from a polynomial fit to nearby values."""
    row_after = int(np.searchsorted(recording.t, t0))
    rows = recording.measured_rows_near(column, row_after, ROWS_PER_SIDE)

    times = recording.t[rows] - t0
    y = recording.y[rows, column]
    if len(rows) <= degree:
        return float(y.mean()), 0.0

    # Times are scaled to [-1, 1], so that the fit is well conditioned.
    unit = float(np.abs(times).max()) or 1.0
    coefficients = np.polynomial.polynomial.polyfit(times / unit, y, degree)
    return float(coefficients[0]), float(coefficients[1] / unit)


def _nominal_states(
    system: System, recording: AlignedRecording, begins: np.ndarray, found: Collection[int]
) -> Array:
    """(n, ns) states of the model at the guess, simulated from the stated initial state.

    Components at the addresses `found` are replaced later. Where the model diverges, all of them
    are the initial state.
    """
    start = system.plant.initial_state(system.parameters.guess)
    states = np.tile(start, (len(begins), 1))

    # No simulation is needed where the whole state is found, or where all segments begin at the
    # first sample.
    if set(range(len(start))) <= {*found} or not begins.any():
        return states

    model = system.plant.model(system.parameters.guess)
    ctrl = recording.ctrl[None, : int(begins.max())]
    simulated = system.plant.simulator.rollout([model], start[None], ctrl)
    return np.array(simulated.states[0][begins]) if simulated.finite[0] else states


def measured_states(system: System, recording: AlignedRecording) -> dict[int, int]:
    """Output that measures each component of the state, by the address of the component.

    Outputs without any value in the recording are left out.

    Args:
        system: System that was recorded.
        recording: The recording.
    """
    outputs = outputs_by_state(system.model, system.outputs)
    has_values = np.asarray(recording.measured.any(axis=0))
    return {state: output for state, output in outputs.items() if has_values[output]}


def batches(segments: Sequence[Segment], max_samples: int) -> Iterator[list[int]]:
    """Group segments of similar length for simulation in one batch.

    Args:
        segments: The segments.
        max_samples: Largest number of samples of a batch; a longer segment is a batch of one.

    Yields:
        Indices of the segments of a batch.
    """
    order = sorted(range(len(segments)), key=lambda i: segments[i].samples)
    batch: list[int] = []
    for i in order:
        # Shorter segments are simulated as long as the longest one of their batch.
        samples = segments[i].samples
        if batch and (
            samples > MAX_LENGTH_RATIO * segments[batch[0]].samples
            or (len(batch) + 1) * samples > max_samples
        ):
            yield batch
            batch = []
        batch.append(i)

    if batch:
        yield batch

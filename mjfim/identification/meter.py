"""A live meter: the accuracy of the parameters from the rows of a recording so far.

At the guess, every row adds to the information, with the initial states marginalised as in a fit.
Rows are simulated once: what is kept is one triangle of rows, and the states of the simulation.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, RecordingError, SimulationDivergedError
from mjfim.experiment.arguments import checked
from mjfim.experiment.schema import ExperimentLike
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import (
    EDGE_TOLERANCE,
    GRID_TOLERANCE,
    MIN_ROWS,
    AlignedRecording,
    resample_control,
)
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.search import FitTask
from mjfim.identification.segment_simulation import ONE_SIDED_STEP_FACTOR
from mjfim.identification.segments import (
    MIN_SAMPLES,
    ROWS_OF_NOISE,
    ROWS_PER_SIDE,
    KnownActivations,
    measured_initial_states,
)
from mjfim.information.fisher import MAX_TIMES, FisherInformation
from mjfim.information.null_space import find_null_space
from mjfim.optimize.condensed_least_squares import Condensed, triangle
from mjfim.parallel import one_blas_thread
from mjfim.plant.plant import MAX_NUMBERS_AT_ONCE, Curves
from mjfim.records.trajectory import Recording
from mjfim.records.worth import DEFAULT_RELATIVE_STD, Watch

# Number of rows before the present one that are kept. Initial states of segments follow from them.
KEPT_ROWS = 10 * ROWS_PER_SIDE

# Longest gap of the rows over which the last control is held, relative to what is a gap in a file.
LONGEST_GAP = 10.0

# Number of samples of a segment that has no end.
WHOLE = 2**53


class Meter:
    """Accuracy of the parameters of an experiment from the rows of a stream so far.

    The standard deviations are formal ones at the guess: the best case. They are those that
    `mjfim.check` predicts for a recording of the same rows. With `segments` in the table `[fit]`,
    the simulation begins again at a measured state after this time; otherwise it continues from
    the begin of the stream.

    Args:
        experiment: The experiment, without control laws.
        threads: Threads of MuJoCo; None for all cores.

    Raises:
        ExperimentError: The experiment has control laws, or a name or number in it is wrong.

    Attributes:
        system: The system. Its `inputs` and `outputs.names` are the order of the columns.
    """

    @checked
    def __init__(self, experiment: ExperimentLike, *, threads: int | None = None) -> None:
        system = self.system = System.resolve(experiment, threads=threads)
        if system.laws is not None:
            raise ExperimentError(
                f"{system.experiment.source}: controllers: a stream is watched without "
                "control laws; record it, and check the recording with `mjfim check`"
            )
        p = system.parameters
        is_held = np.isin(p.names, system.experiment.fit.hold)
        self._asked = np.setdiff1d(p.interest, np.flatnonzero(is_held))
        self._sizes = p.sizes(p.guess)
        self._wanted = p.wanted if self._is_stated else DEFAULT_RELATIVE_STD * self._sizes

        # Rows that are still needed, with times since the first one.
        self._kept: list[tuple[float, Array, Array]] = []
        self._origin = 0.0
        self._latest = -np.inf
        self._rows = 0
        self._simulation: _Simulation | None = None
        self._warnings: tuple[str, ...] = ()

        # Results over time.
        self._reached = np.full(len(p), np.inf)
        self._times = [0.0]
        self._history = [self._reached]
        self._spacing = 0.0

    @property
    def _is_stated(self) -> bool:
        """Whether the experiment states standard deviations that it aims at."""
        return bool(np.isfinite(self.system.parameters.wanted).any())

    def add(
        self, t: float, ctrl: Sequence[float] | Array, measured: Sequence[float] | Array
    ) -> None:
        """Add a row, which is simulated when a result is asked for.

        Args:
            t: Its time [s].
            ctrl: (nu,) controls from the row on, in the order of `system.inputs` [u-unit].
            measured: (ny,) measured values in the order of `system.outputs`, NaN where there is
                none [y-unit].

        Raises:
            RecordingError: The row has a wrong number of values, a time that does not increase or
                comes after a long gap, or a control without a value. It is not used then.
        """
        u, y = np.array(ctrl, dtype=np.float64), np.array(measured, dtype=np.float64)
        inputs, outputs = self.system.inputs, self.system.outputs.names
        if (u.shape, y.shape) != ((len(inputs),), (len(outputs),)):
            raise RecordingError(
                f"{u.size} controls and {y.size} outputs; expected {len(inputs)} and {len(outputs)}"
            )
        if not t > self._latest:
            raise RecordingError(f"time {t:.9g} s after {self._latest:.9g} s; it must increase")
        step = (self._latest - self._origin) / max(self._rows - 1, 1)
        longest = LONGEST_GAP * max(self.system.experiment.recording.gap, step)
        if self._rows > 1 and t - self._latest > longest:
            raise RecordingError(
                f"a gap of {t - self._latest:.3g} s; the control is not held longer than "
                f"{longest:.3g} s: raise recording.gap"
            )
        if not np.isfinite(u).all():
            raise RecordingError(f"{inputs[int(np.argmin(np.isfinite(u)))]!r} has no value")
        self._origin = self._origin if self._rows else t
        self._latest = t
        self._rows += 1
        self._kept.append((t - self._origin, u, y))

    @property
    def std(self) -> Array:
        """(p,) formal standard deviations from all rows so far [theta-unit], see `Watch`."""
        return self.read().std

    @one_blas_thread()
    def _simulate_kept(self, ended: bool) -> None:
        """Simulate the kept rows, and drop those that are needed no more."""
        if self._simulation is None:
            self._begin(ended)
        if self._simulation is not None:
            t, ctrl, y = map(np.array, zip(*self._kept, strict=True))
            self._simulation.advance(t, ctrl, y, ended=ended)
            self._note(self._simulation.time, self._simulation.std)
            del self._kept[: max(self._simulation.first_row(t) - KEPT_ROWS, 0)]

    def read(self, *, ended: bool = False) -> Watch:
        """Simulate the rows that were added, and return what is known.

        The last rows wait for those after them: one row, and some rows at the begin of a segment.

        Args:
            ended: Whether the stream has ended, so that no row waits.

        Raises:
            RecordingError: The stream has ended with too few rows, or without a measured value.
            SimulationDivergedError: The model at the guess diverges.
        """
        if ended and self._rows < MIN_ROWS:
            raise RecordingError(
                f"the stream has too few rows ({self._rows}), not {MIN_ROWS} or more"
            )
        self._simulate_kept(ended)
        asked, names = self._asked, self.system.parameters.names
        return Watch(
            parameters=tuple(names[j] for j in asked.tolist()),
            units=tuple(self.system.units[j] for j in asked.tolist()),
            sizes=self._sizes[asked],
            wanted=self._wanted[asked],
            is_stated=self._is_stated,
            t=np.array(self._times),
            std_over_time=np.array(self._history)[:, asked],
            reached=self._reached[asked],
            rows=self._rows,
            warnings=self._warnings,
        )

    def _begin(self, ended: bool) -> None:
        """Begin to simulate, once there are enough rows for the initial state."""
        shown = [k for k, (_, _, y) in enumerate(self._kept) if np.isfinite(y).any() and k]
        if len(shown) < ROWS_OF_NOISE and not ended:
            return
        rows = self._kept[: shown[:ROWS_OF_NOISE][-1] + 1] if shown else self._kept
        t, ctrl, y = map(np.array, zip(*rows, strict=True))
        names = self.system.outputs.names
        first = Recording(t=t, ctrl=ctrl[:-1], y=y, outputs=names, name="stream")
        task = FitTask.of(self.system, [first])
        self._warnings = tuple(sentence for sentence, _ in task.elsewhere)
        self._simulation = _Simulation(task.problem())

    def _note(self, now: float, std: Array) -> None:
        """Add standard deviations: (p,) to the results over time, of which few are kept."""
        is_new = np.isinf(self._reached) & (std <= self._wanted)
        self._reached = np.where(is_new, now, self._reached)
        if now <= self._times[-1]:
            return
        # The newest result takes the place of one that is too near to those before it.
        if len(self._times) > 1 and self._times[-1] - self._times[-2] < self._spacing:
            self._times.pop()
            self._history.pop()
        self._times.append(now)
        self._history.append(std)
        if len(self._times) > 2 * MAX_TIMES:
            self._times, self._history = self._times[::2], self._history[::2]
            self._spacing = now / MAX_TIMES


class _Simulation:
    """Simulation of a stream at the guess, from segment to segment.

    Args:
        fit: The problem of the first rows.
    """

    def __init__(self, fit: FitProblem) -> None:
        self._fit = replace(fit, segments=fit.segments[:1])
        self._guess = self._fit.begin(fit.parameters.guess)
        self._dt = fit.system.dt
        length = fit.system.experiment.fit.segment_length
        self._length = WHOLE if length is None else round(length / self._dt)
        delay = float(fit.parameters.delay_derivative @ fit.parameters.guess)
        self._lead = max(int(np.ceil(delay / self._dt - EDGE_TOLERANCE)), 0)

        self._known = np.zeros((0, fit.column_count + 1))
        self._end = 0
        self._begin_segment(self._fit.initial_state(self._guess, 0))

    @property
    def time(self) -> float:
        """Time up to which rows count [s]."""
        return (self._first + self._curves.samples) * self._dt

    def first_row(self, t: Array) -> int:
        """Number of the first row, of times t: (M,) [s], that is still needed."""
        return int(np.searchsorted(t, self.time - (1 + self._lead) * self._dt))

    def _begin_segment(self, start: Array) -> None:
        """Begin the segment after the present one in a state: (ns,)."""
        fit = self._fit
        self._bound = self._end
        self._end = self._bound + self._length
        self._first = max(self._bound - self._lead, 0)
        m = fit.private_count + fit.column_count + 1
        self._triangle = np.zeros((m, m))
        self._curves = Curves(
            fit.system.plant.derivatives,
            fit.parameters.guess,
            start[None],
            start_directions=fit.start_directions,
            # Differences to one side take half the time.
            central=False,
            step=fit.difference_step * ONE_SIDED_STEP_FACTOR,
            wanted=fit.estimated,
        )

    def advance(self, t: Array, ctrl: Array, y: Array, *, ended: bool) -> None:
        """Simulate up to the last row, whose sample waits for a further row.

        Args:
            t: (M,) times of the rows that are kept [s].
            ctrl: (M, nu) controls [u-unit].
            y: (M, ny) measured values [y-unit].
            ended: Whether there are no further rows.

        Raises:
            SimulationDivergedError: The model at the guess diverges.
        """
        # Time stamps that nearly lie on the grid are moved onto it.
        sample = np.rint(t / self._dt)
        near = np.abs(t - sample * self._dt) <= GRID_TOLERANCE * self._dt
        recording = AlignedRecording(
            name="stream",
            t=np.where(near, sample * self._dt, t),
            y=y,
            ctrl=ctrl,
            dt=self._dt,
            on_grid=bool(near.all()),
        )
        last = int(np.ceil(t[-1] / self._dt - GRID_TOLERANCE))
        while True:
            # The end of the stream belongs to the present segment where it is too short for one.
            is_final = ended and last < self._end + MIN_SAMPLES
            self._end = last if is_final else self._end
            edges = (np.array([self._bound, self._end + is_final]) - EDGE_TOLERANCE) * self._dt
            rows = slice(*np.searchsorted(recording.t, edges).tolist())
            self._simulate(recording, rows, min(self._end, last - (not ended)))
            is_open = self._first + self._curves.samples < self._end
            if is_final or is_open or (len(t) - rows.stop < ROWS_PER_SIDE and not ended):
                return
            self._known = triangle(np.concatenate([self._known, self._reduced()]))
            self._begin_segment(self._measured_state(recording))

    def _simulate(self, recording: AlignedRecording, rows: slice, stop: int) -> None:
        """Simulate up to a sample, and count those of some rows that are met on the way."""
        fit, curves, dt = self._fit, self._curves, self._dt
        samples = self._end - self._first
        segment = replace(fit.segments[0], begin=self._first, samples=samples, rows=rows)
        mask = np.array(recording.measured)
        # What a stated initial state shows is no information.
        mask[recording.t == 0.0] &= fit.free_starts
        fit = replace(fit, recordings=(recording,), segments=(segment,), masks=(mask,))
        most = max(MAX_NUMBERS_AT_ONCE // curves.numbers_per_sample, 1)
        while (now := self._first + curves.samples) < stop:
            # The control of the row before the first sample is held until the row after it.
            before = int(np.searchsorted(recording.t, now * dt, side="right")) - 1
            since = np.maximum(recording.t[before:] - now * dt, 0.0)
            held = resample_control(since, recording.ctrl[before:-1], dt)
            first = curves.samples
            response = curves.advance(held[None, : min(most, stop - now)])
            if response is None:
                raise SimulationDivergedError(
                    f"the model at the guess diverges {self.time:.3g} s after the first row; with "
                    "segments = SECONDS in [fit], the simulation begins again at measured states"
                )
            curve = [None if each is None else each[0] for each in response]
            for found in fit.rows_of_segment(fit.parameters.guess, 0, first, *curve):
                _, r, J = fit.linearised(found)
                self._triangle = triangle(np.vstack([self._triangle, np.column_stack([J, r])]))

    def _measured_state(self, recording: AlignedRecording) -> Array:
        """(ns,) state at the end of the present segment; components without an output go on."""
        system, begin = self._fit.system, max(self._end - self._lead, 0)
        since = replace(recording, t=recording.t - begin * self._dt)
        now = self._curves.states[0]
        from_now = replace(system, plant=system.plant.with_initial_state(now))
        state = measured_initial_states(from_now, since, np.zeros(1, dtype=np.intp))[0]
        known = system.space.nq + system.space.nv + np.array(KnownActivations.of(system).addresses)
        state[known.astype(np.intp)] = now[known.astype(np.intp)]
        return np.asarray(state)

    def _reduced(self) -> Array:
        """(k, c+1) rows of the common unknowns from the present segment."""
        return Condensed(
            blocks=self._triangle[None],
            segment_of_block=np.zeros(1, dtype=np.intp),
            private_rows=self._fit.private_rows(self._guess),
            common_rows=self._fit.common_rows(self._guess),
        ).reduced_rows()

    @property
    def std(self) -> Array:
        """(p,) standard deviations, infinite for parameters that are not determined alone."""
        p, columns = self._fit.parameters, self._fit.parameter_of_column
        J = np.vstack([self._known, self._reduced(), self._fit.common_rows(self._guess)])[:, :-1]
        scale, none = p.scale[columns], np.zeros((len(columns), len(columns)))
        # The error of the differences is not known, so that the largest one is taken.
        null = find_null_space(J, J, p.magnitude[columns], scale, np.arange(len(columns)), none)
        information = FisherInformation(
            noise=self._fit.noise,
            measure_rate=1.0,
            scale=scale,
            prior=none,
            basis=null.basis if null.count else None,
        )
        std = np.full(len(p), np.inf)
        std[columns] = information.std(J.T @ J)
        return std

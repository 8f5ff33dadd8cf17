"""The task of an identification: a system, its recordings, and the settings of the fit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from itertools import combinations
from typing import Literal, get_args

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, RecordingError, listed, unknown
from mjfim.experiment.system import System
from mjfim.experiment.task_tables import FitSpec
from mjfim.identification.fit_problem import FitProblem
from mjfim.records.trajectory import Recording

# Method of the search. `least_squares` is Levenberg-Marquardt inside the bounds; `newton` is the
# paper's Newton-Raphson iteration without bounds.
Method = Literal["least_squares", "newton"]

# Largest difference of two clocks that count as the same [mean sample periods]. Copies of a log in
# other formats have rounded times.
CLOCK_TOLERANCE = 0.01


@dataclass(frozen=True, kw_only=True, eq=False)
class FitTask:
    """Everything that an identification needs.

    It contains no horizon, no cost and no initial control, which only a design needs.

    Attributes:
        system: Model, parameters, outputs, noise and plant.
        recordings: Recordings to which the parameters are fitted.
        held_out: Recordings that are predicted, not fitted.
        method: Method of the search.
        start: (p,) parameters at which the search starts, inside the bounds if the method has any
            [theta-unit].
        settings: The table `[fit]` of the experiment.
    """

    system: System
    recordings: tuple[Recording, ...]
    held_out: tuple[Recording, ...]
    method: Method
    start: Array
    settings: FitSpec

    @classmethod
    def of(
        cls,
        system: System,
        recordings: Sequence[Recording],
        *,
        method: Method = "least_squares",
        start: Array | None = None,
        held_out: Sequence[Recording] = (),
    ) -> FitTask:
        """The task of fitting the parameters of a resolved system.

        Args:
            system: Model, parameters, outputs and noise.
            recordings: Recordings to which the parameters are fitted.
            method: Method of the search.
            start: (p,) parameters at which the search starts; default: the guess.
            held_out: Recordings that are predicted, not fitted.

        Returns:
            The task.

        Raises:
            ExperimentError: Something is wrong in the arguments; the message names it.
            RecordingError: Two recordings hold the same data.
        """
        if method not in get_args(Method):
            raise ExperimentError(unknown("method", method, get_args(Method)))

        settings = system.experiment.fit
        if settings.noise == "estimated" and system.noise.correlated:
            raise ExperimentError(
                f'{system.experiment.source}: fit.noise = "estimated" assumes uncorrelated '
                "outputs; remove `correlated`"
            )

        _require_held(system, settings.hold)
        refuse_same_data(recordings, held_out)
        return cls(
            system=system,
            recordings=tuple(recordings),
            held_out=tuple(held_out),
            method=method,
            start=_start(system, method, start),
            settings=settings,
        )

    @property
    def noise_is_stated(self) -> bool:
        """True for the noise of the experiment; False where it is estimated from the residuals."""
        return self.settings.noise == "stated"

    def problem(self) -> FitProblem:
        """The least-squares problem of the recordings.

        Raises:
            RecordingError: There is no recording, or one cannot be used.
        """
        problem = FitProblem.of(self.system, self.recordings)
        return problem.unbounded() if self.method == "newton" else problem

    def held_out_problem(self) -> FitProblem | None:
        """The least-squares problem of the held-out recordings; None without any.

        Raises:
            RecordingError: A recording cannot be used.
        """
        return FitProblem.of(self.system, self.held_out) if self.held_out else None


def with_length(task: FitTask, length: float | Literal["whole"] | None) -> FitTask:
    """The task of fitting segments of a length.

    Args:
        task: The task.
        length: The length [s], or "whole"; None for a length that the fit chooses.
    """
    system = task.system
    settings = task.settings.model_copy(update={"segments": length})
    experiment = system.experiment.model_copy(update={"fit": settings})
    return replace(task, system=replace(system, experiment=experiment), settings=settings)


def refuse_same_data(fitted: Sequence[Recording], held_out: Sequence[Recording]) -> None:
    """Raise RecordingError where a recording occurs twice, whatever its name is."""
    for (i, one), (j, other) in combinations(enumerate([*fitted, *held_out]), 2):
        if not _same_data(one, other):
            continue
        consequence = "it would count twice; give it once"
        if i < len(fitted) <= j:
            consequence = "a fitted recording says nothing about predictions; hold out another one"
        fault = f"{other.name} holds the same data as {one.name}"
        if one.name == other.name:
            fault = f"{one.name} is given twice"
        raise RecordingError(f"{fault}: {consequence}")


def _same_data(one: Recording, other: Recording) -> bool:
    """Whether two recordings have equal values at the same times since their begin."""
    if one.outputs != other.outputs or len(one.t) != len(other.t) or not len(one.t):
        return False
    # The first rows show most differences without a look at all others.
    for rows in (slice(0, 1), slice(None)):
        if not np.array_equal(one.y[rows], other.y[rows], equal_nan=True):
            return False
    if not np.array_equal(one.ctrl, other.ctrl, equal_nan=True):
        return False
    difference = (one.t - one.t[0]) - (other.t - other.t[0])
    period = (one.t[-1] - one.t[0]) / len(one.t)
    return bool(np.abs(difference).max() <= CLOCK_TOLERANCE * period)


def _require_held(system: System, names: Sequence[str]) -> None:
    """Raise ExperimentError where a parameter that is to be held cannot be.

    A parameter with a value for each recording, or a deviation of the initial state, is not held.
    """
    parameters = system.parameters
    source = system.experiment.source
    for name in names:
        if name not in parameters.names:
            raise ExperimentError(
                f"{source}: fit.hold: {unknown('parameter', name, parameters.names)}"
            )
        if parameters.recording_specific[parameters.names.index(name)]:
            raise ExperimentError(
                f"{source}: fit.hold: {name} differs from recording to recording; remove it from "
                "the table of nuisance parameters instead"
            )

    if len(set(names)) == len(parameters):
        raise ExperimentError(f"{source}: fit.hold: all parameters are held; leave one out")


def _start(system: System, method: Method, start: Array | None) -> Array:
    """(p,) parameters at which the search starts; the guess where none are given."""
    parameters = system.parameters
    theta = parameters.guess if start is None else np.asarray(start, dtype=np.float64)
    if theta.shape != parameters.guess.shape:
        names = listed(parameters.names)
        raise ExperimentError(f"start: {theta.shape} numbers; expected one per parameter: {names}")

    if method == "least_squares":
        theta = np.clip(theta, parameters.lower, parameters.upper)
    return theta

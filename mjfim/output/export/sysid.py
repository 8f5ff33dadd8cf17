"""An experiment and its recordings in the types of `mujoco.sysid`, MuJoCo's own toolbox for fits.

sysid gives the sensor values of a step the time after the step, although they belong to the state
before it, and divides residuals by the norm of each measured signal, whatever its noise. Here the
outputs are signals of their own, sensors are read at their time, and residuals are whitened by the
stated noise.
"""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from functools import partial
from typing import Any

import numpy as np
from mujoco import sysid
from scipy.interpolate import CubicSpline

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, MjfimError
from mjfim.excitation.evaluation import motion_of
from mjfim.experiment.arguments import checked
from mjfim.experiment.given import RecordingsLike, TrajectoryLike, recordings_of
from mjfim.experiment.schema import ExperimentLike
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import align
from mjfim.model.loading import silence_mujoco_log
from mjfim.records.trajectory import Recording

# Distance from the guess to a bound that is not stated, in sizes of the parameter; sysid takes
# finite bounds only.
UNSTATED_BOUND = 1e3

# Largest distance of a time from an engine step at which it counts as on that step [engine steps].
ON_STEP = 1e-6


@dataclass(frozen=True, eq=False, kw_only=True)
class SysidProblem:
    """A fit in the form that `sysid.optimize(parameters, residual)` takes.

    Attributes:
        sequences: `ModelSequences` of the recordings.
        parameters: `ParameterDict` at the guess.
        build_model: Gives the MjModel at a `ParameterDict`, as `build_model` of sysid.
        residual: Residuals whitened by the stated noise.
    """

    sequences: Any
    parameters: Any
    build_model: Callable[[Any, Any], Any]
    residual: Callable[..., Any]


@checked
def export_sysid(experiment: ExperimentLike, recordings: RecordingsLike) -> SysidProblem:
    """State the fit of recordings for `mujoco.sysid`.

    sysid takes no priors, robust losses or estimated noise. A bound that is not stated is 1000
    sizes of the parameter from its guess.

        problem = mjfim.export_sysid(experiment, [recording])
        fit, result = mujoco.sysid.optimize(problem.parameters, problem.residual)

    Args:
        experiment: The experiment.
        recordings: Its recordings.

    Raises:
        MjfimError: sysid cannot express the problem, or is not installed.
    """
    system = System.resolve(experiment)
    return sysid_problem(system, recordings_of(system, recordings))


@checked
def sysid_control(experiment: ExperimentLike, design: TrajectoryLike) -> Any:
    """Control of a design as a `TimeSeries` of mujoco.sysid, one row for each engine step.

    Args:
        experiment: The experiment of the design, or the path of its file.
        design: The design, or a trajectory.

    Raises:
        MjfimError: sysid is not installed.
    """
    require_sysid()
    system = System.resolve(experiment)
    return _control(system, motion_of(system, design, "sysid_control").ctrl)


def require_sysid() -> None:
    """Raise MjfimError where mujoco.sysid is not installed."""
    if not hasattr(sysid, "ModelSequences"):
        raise MjfimError("mujoco.sysid is not installed; pip install 'mjfim[sysid]'")


def sysid_problem(system: System, recordings: Sequence[Recording]) -> SysidProblem:
    """State the fit of recordings of a resolved experiment. See `export_sysid`."""
    require_sysid()
    _check_expressible(system)
    sequences = _sequences(system, recordings)

    def build_model(parameters: Any, _: Any) -> Any:
        return system.model_at(np.array(parameters.as_vector()))

    return SysidProblem(
        sequences=sequences,
        parameters=_parameters(system),
        build_model=build_model,
        residual=sysid.build_residual_fn(
            models_sequences=[sequences],
            build_model=build_model,
            modify_residual=partial(_whitened, system),
            resample_true=False,
        ),
    )


def _sequences(system: System, recordings: Sequence[Recording]) -> Any:
    """The recordings and the start of the motion, as sysid takes them."""
    mapping = {
        name: (sysid.SignalType.CustomObs, np.array([i]))
        for i, name in enumerate(system.outputs.names)
    }
    aligned = [align(system, recording) for recording in recordings]
    qpos, qvel, act = system.space.split(system.plant.initial_state(system.parameters.guess))
    start = sysid.create_initial_state(system.model, qpos, qvel, act)

    # sysid warns, because it expects the sensors of the model.
    with silenced():
        return sysid.ModelSequences(
            system.model_path.stem,
            system.source.spec.copy(),
            [recording.name for recording in aligned],
            [start] * len(aligned),
            [_control(system, recording.ctrl) for recording in aligned],
            [sysid.TimeSeries(np.array(each.t), each.y, mapping) for each in aligned],
            allow_missing_sensors=True,
        )


@contextmanager
def silenced() -> Iterator[None]:
    """Suppress messages of MuJoCo and sysid inside the block."""
    logger = logging.getLogger("absl")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with silence_mujoco_log():
            yield
    finally:
        logger.setLevel(before)


def _control(system: System, ctrl: Array) -> Any:
    """The control at every engine step as a TimeSeries, held over each sample."""
    steps = np.repeat(ctrl, system.grid.substeps, axis=0)

    # sysid drops the last row. One more row makes it step past the end, so that the sensors at the
    # end are evaluated.
    held = np.concatenate([steps, steps[-1:], steps[-1:]])
    t = np.arange(len(held)) * float(system.model.opt.timestep)
    return sysid.TimeSeries(t, held, sysid.TimeSeries.compute_all_control_mapping(system.model))


def _parameters(system: System) -> Any:
    """The parameters at the guess; the model at their values is that of mjfim."""
    p = system.parameters
    lower = np.where(np.isfinite(p.lower), p.lower, p.guess - UNSTATED_BOUND * p.magnitude)
    upper = np.where(np.isfinite(p.upper), p.upper, p.guess + UNSTATED_BOUND * p.magnitude)
    found = sysid.ParameterDict()
    for j, name in enumerate(p.names):
        found.add(sysid.Parameter(name, p.guess[j], lower[j], upper[j]))
    return found


def _check_expressible(system: System) -> None:
    """Raise ExperimentError if sysid cannot state this problem."""
    experiment, parameters = system.experiment, system.parameters
    fault = ""
    if system.laws is not None:
        fault = (
            "controllers: sysid applies the control of a log; remove the laws, and use a log that "
            "holds the controls"
        )
    elif parameters.outside_model.any():
        name = parameters.names[int(np.argmax(parameters.outside_model))]
        fault = (
            f"{name}: sysid fits numbers of the model only; remove initial states, biases and "
            "delays from the unknowns"
        )
    elif experiment.fit.segment_length is not None or experiment.fit.start != "stated":
        fault = (
            "fit: sysid simulates from the stated initial state only; remove `segments` and `start`"
        )
    if fault:
        raise ExperimentError(f"{experiment.source}: {fault}")


def _whitened(
    system: System,
    _: Any,
    predicted: Any,
    measured: Any,
    model: Any,
    __: bool,
    state: Array,
    **___: Any,
) -> tuple[Array, Any, Any]:
    """Residuals after time 0 in units of their noise, and both TimeSeries, as sysid asks for them.

    Row 0 of the sensors belongs to the time 0, that of the state (with the time in its first
    column) is after the first engine step.
    """
    after_start = measured.times > 0.0
    t, y = measured.times[after_start], measured.data[after_start]
    steps = t / float(model.opt.timestep)
    found = np.empty_like(y)
    for i, output in enumerate(system.outputs.outputs):
        if output.sensor is not None:
            found[:, i] = _at_rows(predicted.data[:, output.sensor], steps)
        else:
            found[:, i] = _at_rows(state[:, 1 + (output.state or 0)], steps - 1)

    present = np.isfinite(y)
    residual = np.where(present, y - found, 0.0)
    pair = [sysid.TimeSeries(t, each, measured.signal_mapping) for each in (found, y)]
    return system.noise.whiten_present(residual, present), *pair


def _at_rows(values: Array, rows: Array) -> Array:
    """(M,) values (n,) at rows, between which a cubic spline is taken."""
    nearest = np.rint(rows)
    if np.abs(rows - nearest).max() <= ON_STEP:
        return np.asarray(values[nearest.astype(int)])
    return np.asarray(CubicSpline(np.arange(len(values)), values)(rows))

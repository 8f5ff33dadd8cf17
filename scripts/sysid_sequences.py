"""An experiment and its recordings in the types of `mujoco.sysid`; see export_sysid.py."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from mujoco import sysid
from sysid_signals import Compared, Layout

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, MjfimError, ModelError
from mjfim.excitation.task import DesignTask
from mjfim.identification.aligned_recording import AlignedRecording, align
from mjfim.model.mujoco_log import silence_mujoco_log
from mjfim.model.paths import INERTIAL_FIELDS, SERVO_FIELDS, ParameterPath
from mjfim.model.spec_writer import state_derived_values
from mjfim.output.mjcf.write import same_dynamics, write_spec
from mjfim.records.recording import Recording

REACH = 1e3  # sizes of a parameter from its guess to a bound that is not stated; sysid wants finite ones
PROBE = 1e-2  # sizes by which parameters are moved to see whether a compile follows
WHOLE = {
    *INERTIAL_FIELDS,
    *SERVO_FIELDS,
    "rot",
    "springlength",
}  # fields that are written as a whole, as a model has them


def require_extra() -> None:
    """Raise MjfimError where mujoco.sysid lacks what it needs: it imports all the same, but is empty."""
    if not hasattr(sysid, "ModelSequences"):
        raise MjfimError("mujoco.sysid is not installed; pip install 'mjfim[sysid]'")


@contextmanager
def hushed() -> Iterator[None]:
    """No messages of MuJoCo and sysid inside the block."""
    logger = logging.getLogger("absl")
    before = logger.level
    logger.setLevel(logging.ERROR)
    try:
        with silence_mujoco_log():
            yield
    finally:
        logger.setLevel(before)


@dataclass(frozen=True, eq=False)
class Exported:
    """What `sysid.optimize` and `sysid.default_report` take.

    sequences: a ModelSequences;  parameters: a ParameterDict at the guess;  layout: of its TimeSeries
    notes: sentences about what of the experiment sysid does not get
    """

    task: DesignTask
    sequences: Any
    parameters: Any
    layout: Layout
    notes: tuple[str, ...] = ()

    def residual(self, weighted: bool) -> Callable[..., Any]:
        """Residual function. weighted: by the stated noise, priors at the end; else as sysid does, without priors"""
        h, noise = (
            float(self.task.system.model.opt.timestep),
            self.task.system.noise if weighted else None,
        )
        of: Callable[..., Any] = sysid.build_residual_fn
        data = of(
            models_sequences=[self.sequences],
            build_model=build,
            modify_residual=Compared(self.layout, h, noise),
            resample_true=False,
        )
        p = self.task.parameters
        weight = np.sqrt(np.diag(p.prior_information))

        def whole(x: Array, parameters: Any, **options: Any) -> tuple[list[Array], Any, Any]:
            residuals, predicted, measured = data(x, parameters, **options)
            priors = (weight * (p.guess - x.T)).T[
                weight > 0.0
            ]  # x: (p,), or (p, k) for differences
            return [*residuals, priors], predicted, measured

        return whole if weighted and weight.any() else data


def build(parameters: Any, spec: Any) -> Any:
    """A model of the spec, which stays as it is, with the parameters written into it."""
    return sysid.apply_param_modifiers(parameters, spec.copy())


def export(task: DesignTask, recordings: Sequence[Recording]) -> Exported:
    """An experiment and its recordings. Raises MjfimError for what sysid cannot express."""
    require_extra()
    _require_alike(task)
    parameters, layout, spec = parameters_of(task), Layout.of(task), task.system.source.spec.copy()
    _require_followed(task, parameters, spec)
    tracks = [align(task.system, recording) for recording in recordings]
    nq, nv = task.system.model.nq, task.system.model.nv
    start = task.plant.initial_state(task.parameters.guess)
    state = sysid.create_initial_state(
        task.system.model, start[:nq], start[nq : nq + nv], start[nq + nv :]
    )
    with hushed():  # it counts state signals among sensors
        sequences = sysid.ModelSequences(
            task.system.model_path.stem,
            spec,
            [track.name for track in tracks],
            [state] * len(tracks),
            [control_of(task, track) for track in tracks],
            [layout.series(track.t, track.y) for track in tracks],
            allow_missing_sensors=True,
        )
    return Exported(task, sequences, parameters, layout, _notes(task))


def control_of(task: DesignTask, track: AlignedRecording) -> Any:
    """TimeSeries of the control at every engine step, held over each sample.

    sysid drops the last row; another one makes it step past the end, so that sensors there are seen.
    """
    steps = np.repeat(track.ctrl, task.system.grid.substeps, axis=0)
    held = np.concatenate([steps, steps[-1:], steps[-1:]])
    t = np.arange(len(held)) * float(task.system.model.opt.timestep)
    return sysid.TimeSeries(
        t, held, sysid.TimeSeries.compute_all_control_mapping(task.system.model)
    )


def parameters_of(task: DesignTask) -> Any:
    """ParameterDict at the guess. What belongs together is written as a whole, so the last modifier writes for all."""
    p, theta = task.parameters, np.array(task.parameters.guess)
    paths = [ParameterPath.parse(target.path) for q in p.parameters for target in q.targets]
    whole = any(path.field in WHOLE for path in paths)

    def modifier(j: int) -> Callable[[Any, Any], None]:
        def write(spec: Any, parameter: Any) -> None:
            theta[j] = float(parameter.value[0])
            if j == len(p) - 1:
                write_spec(
                    spec,
                    task.system.model,
                    task.system.model_at(theta) if whole else task.system.model,
                    p,
                    theta,
                )

        return write

    lower = np.where(np.isfinite(p.lower), p.lower, p.guess - REACH * p.magnitude)
    upper = np.where(np.isfinite(p.upper), p.upper, p.guess + REACH * p.magnitude)
    found = sysid.ParameterDict()
    for j, name in enumerate(p.names):
        found.add(sysid.Parameter(name, p.guess[j], lower[j], upper[j], modifier=modifier(j)))
    return found


def _require_alike(task: DesignTask) -> None:
    """Raise ExperimentError where sysid could not fit the same problem."""
    e, p = task.experiment, task.parameters
    if p.outside_model.any():
        name = p.names[int(np.argmax(p.outside_model))]
        raise ExperimentError(
            f"{e.source}: {name}: sysid fits numbers of the model only; take starts, biases, delays out"
        )
    if e.fit.segments is not None or e.fit.start != "stated":
        raise ExperimentError(
            f"{e.source}: fit: sysid takes every start as stated; take segments and start out"
        )


def _require_followed(task: DesignTask, parameters: Any, spec: Any) -> None:
    """Make sure that the compile of moved parameters is the model that mjfim simulates. Raises ModelError."""
    p, moved = task.parameters, parameters.copy()
    theta = np.clip(p.guess + PROBE * p.magnitude, p.lower, p.upper)
    moved.update_from_vector(theta)
    for settled in (False, True):
        if settled:
            state_derived_values(spec, task.system.model)
        try:
            if same_dynamics(build(moved, spec), task.system.model_at(theta)):
                return
        except ValueError as error:
            if settled:
                raise ModelError(
                    f"{task.system.model_path}: MuJoCo refuses the parameters a little off: {error}"
                ) from None
    raise ModelError(
        f"{task.system.model_path}: a compile with other parameters gives another model than mjfim simulates"
    )


def _notes(task: DesignTask) -> tuple[str, ...]:
    fit, p = task.experiment.fit, task.parameters
    told = [q.name for q in p.parameters if q.prior is not None]
    unbounded = [
        n
        for n, low, high in zip(p.names, p.lower, p.upper, strict=True)
        if not np.isfinite(high - low)
    ]
    said = [f"sysid as is gets no priors: {', '.join(told)}"] if told else []
    if unbounded:
        said.append(
            f"sysid wants bounds: {', '.join(unbounded)} within {REACH:g} sizes of the guess"
        )
    if fit.loss != "linear":
        said.append(f"sysid minimises squares, mjfim the loss {fit.loss!r}")
    if fit.noise != "stated":
        said.append("sysid is weighted by the stated noise, mjfim by the noise that it estimates")
    return tuple(said)

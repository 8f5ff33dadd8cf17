"""An experiment and its recordings in the types of `mujoco.sysid`."""

from __future__ import annotations

import logging
from collections.abc import Callable, Iterator, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from typing import Any

import numpy as np
from mujoco import sysid

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, MjfimError, ModelError
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording, align
from mjfim.model.mujoco_log import silence_mujoco_log
from mjfim.model.paths import INERTIAL_FIELDS, SERVO_FIELDS, ParameterPath
from mjfim.model.spec_writer import state_derived_values
from mjfim.output.mjcf.write import same_dynamics, write_spec
from mjfim.output.sysid.signals import SignalLayout, WhitenedComparison
from mjfim.records.recording import Recording

# Distance from the guess to a bound that is not stated, in sizes of the parameter; sysid takes
# finite bounds only.
UNSTATED_BOUND = 1e3

# Change of the parameters that shows whether a compiled model follows them, in sizes of each
# parameter.
PROBE_STEP = 1e-2

# Fields that are written as a whole from a compiled model, because several parameters change them
# together.
FIELDS_WRITTEN_WHOLE = {*INERTIAL_FIELDS, *SERVO_FIELDS, "rot", "springlength"}


def require_extra() -> None:
    """Check that mujoco.sysid has its requirements; without them it can be imported, but is empty.

    Raises:
        MjfimError: They are not installed.
    """
    if not hasattr(sysid, "ModelSequences"):
        raise MjfimError("mujoco.sysid is not installed; pip install 'mjfim[sysid]'")


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


@dataclass(frozen=True, eq=False)
class Exported:
    """An experiment in the form that `sysid.optimize` and `sysid.default_report` take.

    Attributes:
        system: The experiment.
        sequences: `ModelSequences` of the recordings.
        parameters: `ParameterDict` at the guess.
        layout: Columns of its TimeSeries.
        notes: Sentences about settings of the experiment that sysid does not take.
    """

    system: System
    sequences: Any
    parameters: Any
    layout: SignalLayout
    notes: tuple[str, ...] = ()

    def residual(self, weighted: bool) -> Callable[..., Any]:
        """Return the residual function of sysid.

        Args:
            weighted: True for residuals that are whitened by the stated noise, followed by those of
                the priors; False for the residuals of sysid, without priors.
        """
        h, noise = (
            float(self.system.model.opt.timestep),
            self.system.noise if weighted else None,
        )
        of: Callable[..., Any] = sysid.build_residual_fn
        data = of(
            models_sequences=[self.sequences],
            build_model=build,
            modify_residual=WhitenedComparison(self.layout, h, noise),
            resample_true=False,
        )
        p = self.system.parameters
        weight = np.sqrt(np.diag(p.prior_information))

        def whole(x: Array, parameters: Any, **options: Any) -> tuple[list[Array], Any, Any]:
            residuals, predicted, measured = data(x, parameters, **options)
            priors = (weight * (p.guess - x.T)).T[
                weight > 0.0
            ]  # x: (p,), or (p, k) for differences
            return [*residuals, priors], predicted, measured

        return whole if weighted and weight.any() else data


def build(parameters: Any, spec: Any) -> Any:
    """Return a copy of the spec with the parameters written into it.

    Args:
        parameters: `ParameterDict`.
        spec: Spec of the model; it is not changed.
    """
    return sysid.apply_param_modifiers(parameters, spec.copy())


def export(system: System, recordings: Sequence[Recording]) -> Exported:
    """Return an experiment and its recordings in the types of sysid.

    Args:
        system: The experiment.
        recordings: Its recordings.

    Raises:
        MjfimError: sysid cannot express the problem, or is not installed.
    """
    require_extra()
    _require_alike(system)
    parameters, layout, spec = (
        parameters_of(system),
        SignalLayout.of(system),
        system.source.spec.copy(),
    )
    _require_followed(system, parameters, spec)
    tracks = [align(system, recording) for recording in recordings]
    nq, nv = system.model.nq, system.model.nv
    start = system.plant.initial_state(system.parameters.guess)
    state = sysid.create_initial_state(
        system.model, start[:nq], start[nq : nq + nv], start[nq + nv :]
    )
    with silenced():  # it counts state signals among sensors
        sequences = sysid.ModelSequences(
            system.model_path.stem,
            spec,
            [track.name for track in tracks],
            [state] * len(tracks),
            [control_of(system, track) for track in tracks],
            [layout.series(track.t, track.y) for track in tracks],
            allow_missing_sensors=True,
        )
    return Exported(system, sequences, parameters, layout, _notes(system))


def control_of(system: System, track: AlignedRecording) -> Any:
    """Return the control at every engine step as a TimeSeries, held over each sample.

    sysid drops the last row; one more row makes it step past the end, so that the sensors there are
    evaluated.

    Args:
        system: The experiment.
        track: The recording on the grid of the experiment.
    """
    steps = np.repeat(track.ctrl, system.grid.substeps, axis=0)
    held = np.concatenate([steps, steps[-1:], steps[-1:]])
    t = np.arange(len(held)) * float(system.model.opt.timestep)
    return sysid.TimeSeries(t, held, sysid.TimeSeries.compute_all_control_mapping(system.model))


def parameters_of(system: System) -> Any:
    """Return a `ParameterDict` at the guess. The modifier of the last parameter writes all of them.

    Args:
        system: The experiment.
    """
    p, theta = system.parameters, np.array(system.parameters.guess)
    paths = [ParameterPath.parse(target.path) for q in p.parameters for target in q.targets]
    whole = any(path.field in FIELDS_WRITTEN_WHOLE for path in paths)

    def modifier(j: int) -> Callable[[Any, Any], None]:
        def write(spec: Any, parameter: Any) -> None:
            theta[j] = float(parameter.value[0])
            if j == len(p) - 1:
                write_spec(
                    spec,
                    system.model,
                    system.model_at(theta) if whole else system.model,
                    p,
                    theta,
                )

        return write

    lower = np.where(np.isfinite(p.lower), p.lower, p.guess - UNSTATED_BOUND * p.magnitude)
    upper = np.where(np.isfinite(p.upper), p.upper, p.guess + UNSTATED_BOUND * p.magnitude)
    found = sysid.ParameterDict()
    for j, name in enumerate(p.names):
        found.add(sysid.Parameter(name, p.guess[j], lower[j], upper[j], modifier=modifier(j)))
    return found


def _require_alike(system: System) -> None:
    """Raise ExperimentError where sysid could not fit the same problem."""
    e, p = system.experiment, system.parameters
    if p.outside_model.any():
        name = p.names[int(np.argmax(p.outside_model))]
        raise ExperimentError(
            f"{e.source}: {name}: sysid fits numbers of the model only; take starts, biases, "
            "delays out"
        )
    if e.fit.segments is not None or e.fit.start != "stated":
        raise ExperimentError(
            f"{e.source}: fit: sysid takes every start as stated; take segments and start out"
        )


def _require_followed(system: System, parameters: Any, spec: Any) -> None:
    """Make sure that the compile of moved parameters is the model that mjfim simulates.

    Raises ModelError.
    """
    p, moved = system.parameters, parameters.copy()
    theta = np.clip(p.guess + PROBE_STEP * p.magnitude, p.lower, p.upper)
    moved.update_from_vector(theta)
    for settled in (False, True):
        if settled:
            state_derived_values(spec, system.model)
        try:
            if same_dynamics(build(moved, spec), system.model_at(theta)):
                return
        except ValueError as error:
            if settled:
                raise ModelError(
                    f"{system.model_path}: MuJoCo refuses the parameters a little off: {error}"
                ) from None
    raise ModelError(
        f"{system.model_path}: a compile with other parameters gives another model than mjfim "
        "simulates"
    )


def _notes(system: System) -> tuple[str, ...]:
    """Sentences about settings of the experiment that sysid does not take."""
    fit, p = system.experiment.fit, system.parameters
    with_prior = [q.name for q in p.parameters if q.prior is not None]
    unbounded = [
        n
        for n, low, high in zip(p.names, p.lower, p.upper, strict=True)
        if not np.isfinite(high - low)
    ]
    notes = [f"sysid without weights gets no priors: {', '.join(with_prior)}"] if with_prior else []
    if unbounded:
        notes.append(
            f"sysid wants bounds: {', '.join(unbounded)} within {UNSTATED_BOUND:g} sizes of the "
            "guess"
        )
    if fit.loss != "linear":
        notes.append(f"sysid minimises squares, mjfim the loss {fit.loss!r}")
    if fit.noise != "stated":
        notes.append("sysid is weighted by the stated noise, mjfim by the noise that it estimates")
    return tuple(notes)

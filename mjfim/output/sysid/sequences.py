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
from mjfim.errors import ExperimentError, MjfimError, ModelError, listed
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import AlignedRecording, align
from mjfim.identification.cad_prior import CadPrior
from mjfim.model.mujoco_log import silence_mujoco_log
from mjfim.model.paths import INERTIAL_FIELDS, SERVO_FIELDS, ParameterPath
from mjfim.model.spec_writer import state_derived_values
from mjfim.output.mjcf.write import same_dynamics, write_spec
from mjfim.output.sysid.signals import SignalLayout, WhitenedComparison
from mjfim.records.trajectory import Recording

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


@dataclass(frozen=True, eq=False, kw_only=True)
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
        comparison = WhitenedComparison(
            layout=self.layout,
            timestep=float(self.system.model.opt.timestep),
            noise=self.system.noise if weighted else None,
        )
        residual_of_data: Callable[..., Any] = sysid.build_residual_fn(
            models_sequences=[self.sequences],
            build_model=build,
            modify_residual=comparison,
            resample_true=False,
        )

        guess = self.system.parameters.guess
        prior_weights = np.sqrt(np.diag(self.system.parameters.prior_information))
        has_prior = prior_weights > 0.0
        from_model = CadPrior.of(self.system.parameters)
        if not weighted or not (has_prior.any() or from_model.bodies):
            return residual_of_data

        def residual_with_priors(
            theta: Array, parameters: Any, **options: Any
        ) -> tuple[list[Array], Any, Any]:
            """Return the residuals of the data and those of the priors, and both TimeSeries."""
            residuals, predicted, measured = residual_of_data(theta, parameters, **options)

            # theta is (p,), or (p, k) where sysid computes finite differences.
            of_priors = (prior_weights * (guess - theta.T)).T[has_prior]
            distances = [-from_model.rows(each)[:, -1] for each in np.atleast_2d(theta.T)]
            of_model = np.array(distances).T.reshape(-1, *theta.shape[1:])
            return [*residuals, of_priors, of_model], predicted, measured

        return residual_with_priors


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
    _check_expressible(system)

    parameters = parameters_of(system)
    layout = SignalLayout.of(system)
    spec = system.source.spec.copy()
    _check_parameters_take_effect(system, parameters, spec)

    aligned = [align(system, recording) for recording in recordings]
    controls = [control_of(system, recording) for recording in aligned]
    outputs = [layout.series(recording.t, recording.y) for recording in aligned]

    # sysid logs a warning, because it counts state signals among the sensors.
    with silenced():
        sequences = sysid.ModelSequences(
            system.model_path.stem,
            spec,
            [recording.name for recording in aligned],
            [_initial_state(system)] * len(aligned),
            controls,
            outputs,
            allow_missing_sensors=True,
        )
    return Exported(
        system=system,
        sequences=sequences,
        parameters=parameters,
        layout=layout,
        notes=_notes(system),
    )


def _initial_state(system: System) -> Any:
    """Return the stated initial state, at the guess, in the form of sysid."""
    state = system.plant.initial_state(system.parameters.guess)
    qpos, qvel, act = system.space.split(state)
    return sysid.create_initial_state(system.model, qpos, qvel, act)


def control_of(system: System, recording: AlignedRecording) -> Any:
    """Return the control at every engine step as a TimeSeries, held over each sample.

    Args:
        system: The experiment.
        recording: The recording on the time grid of the experiment.
    """
    steps = np.repeat(recording.ctrl, system.grid.substeps, axis=0)

    # sysid drops the last row. One more row makes it step past the end, so that the sensors at the
    # end are evaluated.
    held = np.concatenate([steps, steps[-1:], steps[-1:]])
    t = np.arange(len(held)) * float(system.model.opt.timestep)
    return sysid.TimeSeries(t, held, sysid.TimeSeries.compute_all_control_mapping(system.model))


def parameters_of(system: System) -> Any:
    """Return a `ParameterDict` at the guess. The modifier of the last parameter writes all of them.

    Args:
        system: The experiment.
    """
    p = system.parameters
    theta = np.array(p.guess)
    modifiers = [_modifier(system, theta, j) for j in range(len(p))]

    lower = np.where(np.isfinite(p.lower), p.lower, p.guess - UNSTATED_BOUND * p.magnitude)
    upper = np.where(np.isfinite(p.upper), p.upper, p.guess + UNSTATED_BOUND * p.magnitude)
    found = sysid.ParameterDict()
    for j, name in enumerate(p.names):
        parameter = sysid.Parameter(name, p.guess[j], lower[j], upper[j], modifier=modifiers[j])
        found.add(parameter)
    return found


def _modifier(system: System, theta: Array, j: int) -> Callable[[Any, Any], None]:
    """Return the function with which sysid writes parameter j into a spec.

    Args:
        system: The experiment.
        theta: (p,) values that all modifiers share [theta-unit]; each one changes its entry.
        j: Number of the parameter.
    """
    parameters = system.parameters
    targets = [target for parameter in parameters.parameters for target in parameter.targets]
    paths = [ParameterPath.parse(target.path) for target in targets]
    needs_compiled = any(path.field in FIELDS_WRITTEN_WHOLE for path in paths)

    def write(spec: Any, parameter: Any) -> None:
        """Keep the value of parameter j; after the last parameter, write all values."""
        theta[j] = float(parameter.value[0])
        if j == len(parameters) - 1:
            wanted = system.model_at(theta) if needs_compiled else system.model
            write_spec(spec, system.model, wanted, parameters, theta)

    return write


def _check_expressible(system: System) -> None:
    """Check that sysid can state this problem; raise ExperimentError if it cannot."""
    experiment, parameters = system.experiment, system.parameters
    if system.laws is not None:
        raise ExperimentError(
            f"{experiment.source}: controllers: sysid applies the control of a log; remove the "
            "laws, and use a log that holds the controls"
        )
    if parameters.outside_model.any():
        name = parameters.names[int(np.argmax(parameters.outside_model))]
        raise ExperimentError(
            f"{experiment.source}: {name}: sysid fits numbers of the model only; remove initial "
            "states, biases and delays from the unknowns"
        )

    if experiment.fit.segment_length is not None or experiment.fit.start != "stated":
        raise ExperimentError(
            f"{experiment.source}: fit: sysid simulates from the stated initial state only; remove "
            "`segments` and `start`"
        )


def _check_parameters_take_effect(system: System, parameters: Any, spec: Any) -> None:
    """Check that a spec with other parameter values compiles to the model that mjfim simulates.

    Numbers that the compiler derives are stated in the spec if this is necessary. Raises ModelError
    if it does not help.
    """
    p = system.parameters
    theta = np.clip(p.guess + PROBE_STEP * p.magnitude, p.lower, p.upper)
    changed = parameters.copy()
    changed.update_from_vector(theta)

    for states_derived in (False, True):
        if states_derived:
            state_derived_values(spec, system.model)
        try:
            if same_dynamics(build(changed, spec), system.model_at(theta)):
                return
        except ValueError as error:
            if states_derived:
                raise ModelError(
                    f"{system.model_path}: MuJoCo refuses parameter values near the guess: {error}"
                ) from None

    raise ModelError(
        f"{system.model_path}: with other parameter values the MJCF compiles to a different model "
        "from the one that mjfim simulates"
    )


def _notes(system: System) -> tuple[str, ...]:
    """Return sentences about settings of the experiment that sysid does not take."""
    fit, p = system.experiment.fit, system.parameters
    notes = []

    with_prior = [parameter.name for parameter in p.parameters if parameter.prior is not None]
    if with_prior:
        notes.append(f"the unweighted fit by sysid ignores the priors of {listed(with_prior)}")

    is_bounded = np.isfinite(p.upper - p.lower)
    unbounded = [name for name, bounded in zip(p.names, is_bounded, strict=True) if not bounded]
    if unbounded:
        notes.append(
            f"sysid needs finite bounds: {listed(unbounded)} may differ from the guess by "
            f"{UNSTATED_BOUND:g} parameter sizes"
        )

    if fit.loss != "linear":
        notes.append(f"sysid minimises squared residuals, mjfim the loss {fit.loss!r}")
    if fit.noise != "stated":
        notes.append("sysid is weighted by the stated noise, mjfim by the noise that it estimates")
    return tuple(notes)

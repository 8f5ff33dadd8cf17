"""The system that an experiment is about: model, parameters, outputs, noise, time grid and plant.

A system has no horizon, no cost and no control; these belong to the tasks in `excitation.task` and
`identification.task`. Every name in the experiment is checked here against the model.
"""

from __future__ import annotations

from dataclasses import dataclass, replace
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, ModelError, SimulationDivergedError, unknown
from mjfim.experiment.outputs import RATE_TOLERANCE, measurement_stride, resolve_outputs
from mjfim.experiment.parameters import resolve_parameters
from mjfim.experiment.schema import Experiment
from mjfim.model.coordinates import (
    ScalarJoint,
    control_names,
    joint_dofs,
    joint_names,
    measurable_columns,
    scalar_joints,
)
from mjfim.model.loading import ModelSource, decoration
from mjfim.model.parameters import ParameterSet, moved_bodies
from mjfim.model.variants import STATED, MocapPlacement, ModelVariant, PlantModel, Relaxation
from mjfim.plant.batch import state_space
from mjfim.plant.noise import Noise
from mjfim.plant.outputs import Outputs
from mjfim.plant.plant import Plant
from mjfim.plant.state_space import StateSpace
from mjfim.recordings.channels import Channels
from mjfim.records.trajectory import Trajectory

# A quaternion whose norm is below this number states no rotation.
NO_ROTATION = 1e-6


@dataclass(frozen=True, kw_only=True)
class TimeGrid:
    """Division of the time into samples, measurements and engine steps.

    Attributes:
        dt: Sample period, for which a control is held [s].
        substeps: Engine steps of a sample.
        stride: Samples from one measurement to the next.
        playback_steps: Engine steps of the stated model from one row of design.csv to the next.
    """

    dt: float
    substeps: int
    stride: int
    playback_steps: int

    @staticmethod
    def stated(experiment: Experiment, timestep: float) -> TimeGrid:
        """The grid that an experiment states.

        Args:
            experiment: The experiment.
            timestep: Timestep of the user's model [s].

        Raises:
            ExperimentError: The rates are not multiples of each other as required.
        """
        substeps = _substeps(experiment, timestep)
        return TimeGrid(
            dt=substeps * timestep,
            substeps=substeps,
            stride=measurement_stride(experiment),
            playback_steps=_playback_steps(experiment, substeps),
        )

    def with_variant(self, variant: ModelVariant) -> TimeGrid:
        """This grid with longer samples or a longer timestep; longer samples are all measured."""
        if self.substeps % variant.timestep_factor:
            raise ValueError(
                f"{self.substeps} engine steps per sample do not divide by "
                f"{variant.timestep_factor}"
            )

        return replace(
            self,
            dt=self.dt * variant.sample_factor,
            substeps=self.substeps // variant.timestep_factor,
            stride=self.stride if variant.sample_factor == 1 else 1,
        )


@dataclass(frozen=True, kw_only=True, eq=False)
class System:
    """A model with unknown parameters, measured outputs, noise, and the plant that simulates it.

    Attributes:
        experiment: The experiment as the user states it.
        source: The user's model, parsed once.
        stated_grid: The time grid that the experiment states.
        parameters: The p unknown parameters.
        outputs: The ny measured outputs.
        stated_noise: Noise of the outputs on the stated grid.
        nominal_initial_state: (ns,) nominal initial state.
        mocap: Poses of the mocap bodies in the initial keyframe; None: those of the model.
        variant: How the plant differs from the user's model.
        plant: The plant, which simulates the system at any theta.
    """

    experiment: Experiment
    source: ModelSource
    stated_grid: TimeGrid
    parameters: ParameterSet
    outputs: Outputs
    stated_noise: Noise
    nominal_initial_state: Array
    mocap: MocapPlacement | None
    variant: ModelVariant
    plant: Plant

    @classmethod
    def resolve(
        cls,
        experiment: Experiment,
        *,
        threads: int | None = None,
        source: ModelSource | None = None,
    ) -> System:
        """Resolve an experiment against its model.

        Args:
            experiment: The experiment as the user states it.
            threads: Threads for the engine; default: one per core.
            source: The model of the experiment, if it is parsed already.

        Raises:
            ExperimentError: A name, a file or a number in the experiment is wrong; the message
                names the key.
            ModelError: The model cannot be used.
        """
        try:
            if source is None:
                source = ModelSource(experiment.directory / experiment.model)
            return cls._resolved(experiment, threads, source)
        except ExperimentError as error:
            raise ExperimentError(f"{experiment.source}: {error}") from None

    @classmethod
    def _resolved(cls, experiment: Experiment, threads: int | None, source: ModelSource) -> System:
        """Resolve an experiment; error messages do not name the experiment file yet."""
        model = source.model
        _require_supported(source)

        # The time grid comes first, because it gives the period of the measurements.
        grid = TimeGrid.stated(experiment, float(model.opt.timestep))
        outputs, noise = resolve_outputs(experiment, model, state_space(model), grid.stride)

        mocap = MocapPlacement.of(
            model, keyframe(model, "initial.keyframe", experiment.initial.keyframe)
        )
        parameters = ParameterSet.build(
            resolve_parameters(experiment, model, outputs.names),
            model,
            outputs.names,
            decoration(source.spec, model),
            mocap,
        )
        initial_state = _initial_state(experiment, model)

        private = _plant_model(source, parameters, outputs, mocap, STATED, None)
        _require_bodies(parameters, private)
        plant = Plant(
            source=private,
            parameters=parameters,
            outputs=outputs,
            nominal_initial_state=initial_state,
            substeps=grid.substeps,
            threads=threads,
        )

        return cls(
            experiment=experiment,
            source=source,
            stated_grid=grid,
            parameters=parameters,
            outputs=outputs,
            stated_noise=noise,
            nominal_initial_state=initial_state,
            mocap=mocap,
            variant=STATED,
            plant=plant,
        )

    def with_variant(self, variant: ModelVariant, relaxation: Relaxation | None = None) -> System:
        """This system on another plant; parameters, outputs and the parsed model are shared.

        Args:
            variant: How the plant differs from the user's model.
            relaxation: Clamps and joint stops that a relaxed variant leaves out.

        Returns:
            A system whose plant is not calibrated yet.
        """
        relaxation = relaxation if variant.relaxed else None
        grid = self.stated_grid.with_variant(variant)

        def plant(speeds: tuple[float, ...], smooth: Plant | None) -> Plant:
            """A plant whose dry friction is viscous below these speeds."""
            plant_relaxation = relaxation
            if speeds:
                plant_relaxation = replace(relaxation or Relaxation(), smoothing_speeds=speeds)
            model = _plant_model(
                self.source, self.parameters, self.outputs, self.mocap, variant, plant_relaxation
            )
            return Plant(
                source=model,
                parameters=self.parameters,
                outputs=self.outputs,
                nominal_initial_state=self.nominal_initial_state,
                substeps=grid.substeps,
                threads=self.threads,
                smooth=smooth,
            )

        # If friction is smoothed for derivatives only, they are computed on a second plant.
        speeds = variant.smoothing_speeds
        if variant.smoothed or not speeds:
            return replace(self, variant=variant, plant=plant(speeds, None))
        return replace(self, variant=variant, plant=plant((), plant(speeds, None)))

    def calibrated(self, theta: Array, ctrl: Array) -> System:
        """This system with difference steps that suit the trajectory of a control.

        Args:
            theta: (p,) parameter values.
            ctrl: (N, nu) control.

        Returns:
            The calibrated system; this system unchanged if the trajectory diverges.
        """
        try:
            return self.calibrated_along(theta, self.plant.simulate(theta, ctrl))
        except SimulationDivergedError:
            return self

    def calibrated_along(self, theta: Array, trajectory: Trajectory) -> System:
        """This system with difference steps that suit a trajectory.

        Args:
            theta: (p,) parameter values [theta-unit].
            trajectory: A trajectory of the plant at theta.

        Returns:
            The calibrated system.
        """
        return replace(self, plant=self.plant.calibrated(theta, trajectory))

    @cached_property
    def grid(self) -> TimeGrid:
        """The time grid of the plant."""
        return self.stated_grid.with_variant(self.variant)

    @cached_property
    def noise(self) -> Noise:
        """Noise of the outputs on the grid of the plant."""
        if self.variant.sample_factor == 1:
            return self.stated_noise
        return self.stated_noise.at_every_sample(self.stated_grid.stride)

    @cached_property
    def controls(self) -> tuple[str, ...]:
        """Names of the nu controls."""
        return control_names(self.model)

    @cached_property
    def coordinates(self) -> tuple[ScalarJoint, ...]:
        """All slide and hinge joints."""
        return scalar_joints(self.model)

    @property
    def model(self) -> Any:
        """The user's compiled model (MjModel), untouched by parameters."""
        return self.source.model

    @property
    def model_path(self) -> Path:
        """The MJCF file."""
        return self.source.path

    @property
    def dt(self) -> float:
        """Sample period [s]."""
        return self.grid.dt

    @property
    def measure_rate(self) -> float:
        """Rate of the measurements [Hz]."""
        return 1.0 / (self.grid.stride * self.grid.dt)

    @property
    def space(self) -> StateSpace:
        """Layout of the state."""
        return self.plant.space

    @property
    def threads(self) -> int:
        """Threads for the engine."""
        return self.plant.simulator.threads

    @property
    def theta(self) -> Array:
        """(p,) parameter values at which designs and checks linearise."""
        at_true = self.experiment.cost.linearize_at == "true"
        return self.parameters.true if at_true else self.parameters.guess

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the p parameters; empty text if none is stated."""
        return tuple(parameter.unit for parameter in self.parameters.parameters)

    @property
    def measurable(self) -> tuple[str, ...]:
        """Columns that a recording may hold: state components and sensors."""
        return measurable_columns(self.model)

    @property
    def channels(self) -> Channels:
        """Signals that a log of this experiment may hold, and how to read them."""
        return Channels(
            model=self.model,
            controls=self.controls,
            outputs=self.outputs.names,
            sigma=self.noise.sigma,
            spec=self.experiment.recording,
            source=self.experiment.source,
        )

    @property
    def rest(self) -> Array:
        """(nu,) control of the initial keyframe, zero without one."""
        key = keyframe(self.model, "initial.keyframe", self.experiment.initial.keyframe)
        return np.zeros(len(self.controls)) if key is None else np.array(key.ctrl)

    @cached_property
    def _whole_model(self) -> PlantModel:
        """The user's model with sensors and constraints on.

        Bodies whose inertia parameters change are not compiled as "simple" bodies.
        """
        return PlantModel(
            self.source,
            moved_bodies=_moved(self.parameters),
            sensors=True,
            friction=True,
            mocap=self.mocap,
        )

    def model_at(self, theta: Array, *, at_keyframe: bool = True) -> Any:
        """The user's model with parameters written into it.

        Args:
            theta: (p,) parameter values.
            at_keyframe: True: mocap bodies have the poses of the initial keyframe. False: they have
                the poses of the MJCF.

        Returns:
            A new MjModel, which the caller may change.
        """
        model = self.parameters.writer.model(self._whole_model, theta)
        if self.mocap is not None and not at_keyframe:
            self.mocap.put(model, self.mocap.compiled)
        return model

    def impossible(self, theta: Array) -> list[int]:
        """Indices of parameters whose values at theta: (p,) give a body an unphysical inertia."""
        try:
            faults = self.parameters.writer.unphysical_bodies(self.plant.source, theta)
        except ModelError:
            return np.flatnonzero(self.parameters.needs_compile).tolist()

        return sorted({column for columns, _ in faults for column in columns})


def keyframe(model: Any, key: str, name: str | None) -> Any:
    """Find a keyframe of a model by its name.

    Args:
        model: MjModel.
        key: Key of the experiment file that states the name, for the message.
        name: Name of the keyframe, or None.

    Returns:
        The keyframe; None without a name.

    Raises:
        ExperimentError: There is no keyframe of this name.
    """
    if name is None:
        return None

    kind = mujoco.mjtObj.mjOBJ_KEY
    names = [mujoco.mj_id2name(model, kind, i) or "" for i in range(model.nkey)]
    if name not in names:
        raise ExperimentError(f"{key}: {unknown('keyframe', name, [n for n in names if n])}")
    return model.key(name)


def _require_supported(source: ModelSource) -> None:
    """Raise ModelError for a model without actuators, or with a state that mjfim cannot read."""
    model = source.model
    if model.nu == 0:
        raise ModelError(
            f"{source.path}: the model has no actuator; an experiment needs at least one"
        )
    if model.nhistory or model.nplugin:
        feature = "delays or interval sensors" if model.nhistory else "engine plugins"
        raise ModelError(
            f"{source.path}: the model has {feature}, whose internal state mjfim cannot read; "
            "remove them from the model"
        )


def _substeps(experiment: Experiment, timestep: float) -> int:
    """Engine steps per sample.

    Raises ExperimentError if a sample is not a whole number of timesteps [s].
    """
    rate = experiment.rate
    ratio = 1.0 / (rate * timestep)
    n = round(ratio)

    if n < 1 or abs(ratio - n) > RATE_TOLERANCE * n:
        valid = ", ".join(f"{1.0 / (k * timestep):g}" for k in (1, 2, 4, 5, 10))
        raise ExperimentError(
            f"rate: at {rate:g} Hz, a sample is not a whole number of timesteps ({timestep:g} s); "
            f"valid for example: {valid} Hz"
        )
    return n


def _playback_steps(experiment: Experiment, substeps: int) -> int:
    """Engine steps per row of design.csv.

    Raises ExperimentError if a row is not a whole number of engine steps, or a sample not a whole
    number of rows.
    """
    rate = experiment.rate
    playback_rate = experiment.playback_rate
    if playback_rate is None:
        return substeps

    valid = [k for k in range(1, substeps + 1) if substeps % k == 0]
    ratio = playback_rate / rate
    rows = round(ratio)
    if rows not in valid or abs(ratio - rows) > RATE_TOLERANCE * rows:
        listed = ", ".join(f"{k * rate:g}" for k in valid)
        raise ExperimentError(
            f"playback_rate: {playback_rate:g} Hz is not a multiple of rate ({rate:g} Hz) that "
            f"divides the engine's rate ({substeps * rate:g} Hz); valid: {listed}"
        )
    return substeps // rows


def _initial_state(experiment: Experiment, model: Any) -> Array:
    """(ns,) state at which the experiment starts.

    It is that of a keyframe, the stated numbers, or the reference state of the model.
    """
    initial = experiment.initial
    key = keyframe(model, "initial.keyframe", initial.keyframe)

    parts = {"qpos": model.qpos0, "qvel": np.zeros(model.nv), "act": np.zeros(model.na)}
    if key is not None:
        parts = {"qpos": key.qpos, "qvel": key.qvel, "act": key.act}

    stated = {"qpos": initial.qpos, "qvel": initial.qvel, "act": initial.act}
    for name, numbers in stated.items():
        if numbers is None:
            continue
        if len(numbers) != len(parts[name]):
            raise ExperimentError(
                f"initial.{name}: {len(numbers)} numbers; this model needs {len(parts[name])}"
            )
        parts[name] = np.asarray(numbers, dtype=np.float64)

    qpos = np.array(parts["qpos"], dtype=np.float64)
    _require_rotations(model, qpos)
    mujoco.mj_normalizeQuat(model, qpos)
    return np.concatenate([qpos, parts["qvel"], parts["act"]])


def _require_rotations(model: Any, qpos: Array) -> None:
    """Raise ExperimentError if a quaternion in qpos: (nq,) is zero."""
    for j, name in enumerate(joint_names(model)):
        if joint_dofs(model, j) == 1:
            continue

        # The quaternion of a free joint follows its position.
        is_free = int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_FREE)
        first = int(model.jnt_qposadr[j]) + (3 if is_free else 0)
        if not np.linalg.norm(qpos[first : first + 4]) > NO_ROTATION:
            raise ExperimentError(
                f"initial.qpos: the quaternion of joint {name!r} (numbers {first} to {first + 3}) "
                "is zero; the identity rotation is 1, 0, 0, 0"
            )


def _moved(parameters: ParameterSet) -> set[str] | None:
    """Bodies whose inertial frame parameters change; None if a parameter may change any body."""
    return None if parameters.needs_compile.any() else moved_bodies(parameters.parameters)


def _plant_model(
    source: ModelSource,
    parameters: ParameterSet,
    outputs: Outputs,
    mocap: MocapPlacement | None,
    variant: ModelVariant,
    relaxation: Relaxation | None,
) -> PlantModel:
    """The compiled model that the plant of a variant simulates."""
    # A parameter that changes dry friction needs the constraint solver, even where the nominal
    # friction is zero.
    friction = any(
        parameter.function is not None
        or any("frictionloss" in target.path for target in parameter.targets)
        for parameter in parameters.parameters
    )
    return PlantModel(
        source,
        moved_bodies=_moved(parameters),
        sensors=outputs.needs_sensors,
        friction=friction,
        timestep_factor=variant.sample_factor * variant.timestep_factor,
        mocap=mocap,
        relaxation=relaxation,
    )


def _require_bodies(parameters: ParameterSet, model: PlantModel) -> None:
    """Raise ExperimentError if the guess or the true values give a body an unphysical inertia."""
    for key, theta in (("guess", parameters.guess), ("true", parameters.true)):
        for columns, fault in parameters.writer.unphysical_bodies(model, theta):
            involved = [parameters.parameters[j] for j in columns]
            keys = dict.fromkeys(
                f"parameters.{p.group}" if p.group else f"parameters.{p.name}.{key}"
                for p in involved
            )
            raise ExperimentError(f"{', '.join(keys)}: {fault}")

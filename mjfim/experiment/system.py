"""The system that an experiment is about: model, parameters, outputs, noise, time grid and plant.

A system has no horizon, no cost and no control; these belong to the tasks in `excitation.task` and
`identification.search`. Every name in the experiment is checked here against the model.

A system makes synthetic recordings. Worker processes make a system again from its order. Pictures
and records take the labels of its joints, controls, parameters and outputs.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import cached_property, partial
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from numpy.typing import ArrayLike

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError, ModelError, SimulationDivergedError, listed
from mjfim.experiment.initial import initial_state, keyframe
from mjfim.experiment.packing import for_workers, model_of
from mjfim.experiment.parameters import resolve_parameters
from mjfim.experiment.schema import Experiment, ExperimentLike, experiment_of
from mjfim.experiment.signals import TimeGrid, noise_strides, resolve_controllers, resolve_outputs
from mjfim.experiment.stated_units import require_units
from mjfim.model.clearance import with_floor
from mjfim.model.control_laws import FIELDS, ControlLaws, law_unit
from mjfim.model.coordinates import (
    ScalarJoint,
    control_labels,
    output_label,
    state_components,
    tangent_components,
)
from mjfim.model.loading import ModelSource
from mjfim.model.parameter_writer import MOMENT_ROUNDING, ParameterWriter
from mjfim.model.parameters import ParameterSet
from mjfim.model.terms.library import KINDS
from mjfim.model.terms.term import ELEMENT_KEYS, Term, TermTable
from mjfim.model.units import per_second
from mjfim.model.variants import STATED, MocapPlacement, ModelVariant, PlantModel, Relaxation
from mjfim.parallel import require_threads
from mjfim.plant.batch import state_space
from mjfim.plant.outputs import Noise, Outputs
from mjfim.plant.plant import Plant
from mjfim.plant.state_space import StateSpace
from mjfim.recordings.channels import Channels
from mjfim.records.estimate import ControlLawInLoop
from mjfim.records.trajectory import Labels, Recording, Trajectory


@record
class System:
    """A model with unknown parameters, measured outputs, noise, and the plant that simulates it.

    Attributes:
        experiment: The experiment as the user states it.
        source: The user's model, parsed once, with the terms of the experiment and the numbers of
            its control laws.
        laws: Control laws of the drivers; None where logs hold the controls themselves.
        stated_grid: The time grid that the experiment states.
        parameters: The p unknown parameters.
        outputs: The ny measured outputs.
        stated_noise: Noise of the outputs on the stated grid.
        nominal_initial_state: (ns,) nominal initial state.
        mocap: Poses of the mocap bodies in the initial keyframe.
        variant: How the plant differs from the user's model.
        plant: The plant, which simulates the system at any theta.
    """

    experiment: Experiment
    source: ModelSource
    laws: ControlLaws | None
    stated_grid: TimeGrid
    parameters: ParameterSet
    outputs: Outputs
    stated_noise: Noise
    nominal_initial_state: Array
    mocap: MocapPlacement
    variant: ModelVariant
    plant: Plant

    @classmethod
    def resolve(
        cls,
        experiment: ExperimentLike,
        *,
        threads: int | None = None,
        source: ModelSource | None = None,
    ) -> System:
        """Resolve an experiment against its model.

        Args:
            experiment: The experiment as the user states it, or the path of its file.
            threads: Threads for the engine; default: one per core.
            source: The model of the experiment, if it is parsed already, with or without its terms.

        Raises:
            ExperimentError: A name, a file or a number in the experiment is wrong; the message
                names the key.
            ModelError: The model cannot be used.
        """
        require_threads(threads)
        experiment = experiment_of(experiment)
        try:
            return cls._resolved(experiment, threads, source)
        except ExperimentError as error:
            raise ExperimentError(f"{experiment.source}: {error}") from None

    @classmethod
    def _resolved(
        cls, experiment: Experiment, threads: int | None, source: ModelSource | None
    ) -> System:
        """Resolve an experiment; error messages do not name the experiment file yet."""
        if source is None:
            source = model_of(experiment)
        _require_supported(source)
        source = source.extended(_terms_of(experiment, source.stated))
        source, laws = resolve_controllers(experiment, source)
        if experiment.limits.floor is not None:
            source = with_floor(source, experiment.limits.floor)
        require_units(experiment, source)
        model = source.model

        # What the experiment states, checked against the model. The time grid comes first, because
        # it gives the period of the measurements.
        grid = TimeGrid.stated(experiment, model.opt.timestep)
        strides = noise_strides(experiment)
        outputs, noise = resolve_outputs(
            experiment,
            source.coordinates,
            state_space(model),
            stride=grid.stride,
            stride_of_key=strides,
        )
        key = keyframe(model, "initial.keyframe", experiment.initial.keyframe)
        start = initial_state(experiment.initial, model, key, source.layout)
        mocap = MocapPlacement.of(model, key)
        parameters = resolve_parameters(experiment, source, mocap, outputs)

        # The plant that the parameters act on.
        private = PlantModel(
            source,
            moved_bodies=parameters.moved_bodies,
            sensors=outputs.needs_sensors,
            friction=parameters.changes_friction,
            mocap=mocap,
        )
        ParameterWriter(parameters).require_physical_bodies(private)
        plant = Plant(
            source=private,
            parameters=parameters,
            outputs=outputs,
            nominal_initial_state=start,
            substeps=grid.substeps,
            threads=threads,
            laws=laws,
        )

        return cls(
            experiment=experiment,
            source=source,
            laws=laws,
            stated_grid=grid,
            parameters=parameters,
            outputs=outputs,
            stated_noise=noise,
            nominal_initial_state=start,
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
        removed = (relaxation if variant.relaxed else None) or Relaxation()
        grid = self.stated_grid.with_variant(variant)

        def plant(speeds: tuple[float, ...], smooth: Plant | None) -> Plant:
            """A plant whose dry friction is viscous below these speeds.

            smooth: Plant that computes its derivatives; None where it computes them itself.
            """
            model = self._plant_model(
                sensors=self.outputs.needs_sensors,
                friction=self.parameters.changes_friction,
                timestep_factor=variant.sample_factor * variant.timestep_factor,
                relaxation=replace(removed, smoothing_speeds=speeds),
            )
            return Plant(
                source=model,
                parameters=self.parameters,
                outputs=self.outputs,
                nominal_initial_state=self.nominal_initial_state,
                substeps=grid.substeps,
                threads=self.threads,
                smooth=smooth,
                laws=self.laws,
            )

        # If friction is smoothed for derivatives only, they are computed on a second plant.
        speeds = variant.smoothing_speeds
        if variant.smoothed or not speeds:
            return replace(self, variant=variant, plant=plant(speeds, None))
        return replace(self, variant=variant, plant=plant((), plant(speeds, None)))

    def without_laws(self) -> System:
        """This system with the controls themselves as inputs; itself where it has no control laws.

        Returns:
            A system whose plant is not calibrated yet.
        """
        if self.laws is None:
            return self
        return replace(self, laws=None).with_variant(self.variant)

    def released(self, state: Array) -> System:
        """This system with another nominal initial state, which a design does not choose any more.

        Args:
            state: (ns,) initial state where no parameter moves it.
        """
        initial = self.experiment.initial.model_copy(update={"free": {}})
        return replace(
            self,
            experiment=self.experiment.model_copy(update={"initial": initial}),
            nominal_initial_state=np.array(state),
            plant=self.plant.with_initial_state(state),
        )

    def released_as(self, state: Array) -> System:
        """This system, released in the first state of a trajectory.

        Args:
            state: (ns,) first state of a trajectory, at the theta of the design.

        Returns:
            The released system; this system itself where the experiment fixes the initial state.
        """
        if not self.experiment.initial.free:
            return self
        moves = self.plant.initial_state_derivative @ self.theta
        return self.released(self.space.plus(state, -moves))

    def with_substeps(self, substeps: int) -> System:
        """This system, as the experiment states it, with samples of another length.

        Recordings whose rows lie between the samples are simulated on this shorter grid.

        Args:
            substeps: Engine steps of a sample, at most those that the experiment states.

        Returns:
            The system; plant models and counted engine steps are shared.
        """
        grid = replace(
            self.stated_grid,
            dt=substeps * self.model.opt.timestep,
            substeps=substeps,
            stride=max(self.stated_grid.stride * self.stated_grid.substeps // substeps, 1),
            playback_steps=substeps,
        )
        plant = self.plant.with_substeps(substeps)
        return replace(self, variant=STATED, stated_grid=grid, plant=plant)

    def calibrated(self, theta: Array, ctrl: Array, wanted: np.ndarray | None = None) -> System:
        """This system with difference steps that suit the trajectory of a control.

        Args:
            theta: (p,) parameter values.
            ctrl: (N, nu) control.
            wanted: (p,) True for the parameters whose steps are calibrated; None for all.

        Returns:
            The calibrated system; this system unchanged if the trajectory diverges.
        """
        try:
            return self.calibrated_along(theta, self.plant.simulate(theta, ctrl), wanted)
        except SimulationDivergedError:
            return self

    def calibrated_along(
        self, theta: Array, trajectory: Trajectory, wanted: np.ndarray | None = None
    ) -> System:
        """This system with difference steps that suit a trajectory.

        Args:
            theta: (p,) parameter values [theta-unit].
            trajectory: A trajectory of the plant at theta.
            wanted: (p,) True for the parameters whose steps are calibrated; None for all.

        Returns:
            The calibrated system.
        """
        return replace(self, plant=self.plant.calibrated(theta, trajectory, wanted))

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

    @property
    def controls(self) -> tuple[str, ...]:
        """Names of the nu controls."""
        return self.source.coordinates.controls

    @property
    def inputs(self) -> tuple[str, ...]:
        """Columns of a log that drive a simulation: controls, and references of control laws."""
        if self.laws is not None:
            return self.laws.columns
        return tuple(f"ctrl:{name}" for name in self.controls)

    @property
    def coordinates(self) -> tuple[ScalarJoint, ...]:
        """All slide and hinge joints but those that physical terms have added."""
        return self.source.coordinates.scalar_joints

    @property
    def model(self) -> Any:
        """The user's compiled model with its terms (MjModel), untouched by parameters."""
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

    def theta_of(self, key: str, given: ArrayLike | None) -> Array:
        """(p,) parameter values that a user gives; the guess where none are given.

        Raises:
            ExperimentError: They are not one number for each parameter; the message names the key.
        """
        theta = np.asarray(self.parameters.guess if given is None else given, dtype=np.float64)
        if theta.shape != self.parameters.guess.shape:
            names = listed(self.parameters.names)
            raise ExperimentError(
                f"{key}: {theta.shape} numbers; expected one per parameter: {names}"
            )
        return theta

    @property
    def units(self) -> tuple[str, ...]:
        """Units of the p parameters; empty text if none is stated."""
        return tuple(parameter.unit for parameter in self.parameters.parameters)

    @property
    def channels(self) -> Channels:
        """Signals that a log of this experiment may hold, and how to read them."""
        return Channels(
            model=self.model,
            controls=self.controls,
            laws=self.laws,
            outputs=self.outputs.names,
            sigma=self.noise.sigma,
            spec=self.experiment.recording,
            source=self.experiment.source,
        )

    @property
    def rest(self) -> Array:
        """(nu,) control of the initial keyframe, zero without one."""
        key = keyframe(self.model, "initial.keyframe", self.experiment.initial.keyframe)
        if key is None:
            return np.zeros(len(self.controls))
        return np.array(key.ctrl)

    def _plant_model(self, **options: Any) -> PlantModel:
        """A private copy of the user's model for these parameters."""
        moved = self.parameters.moved_bodies
        return PlantModel(self.source, moved_bodies=moved, mocap=self.mocap, **options)

    @cached_property
    def _whole_model(self) -> PlantModel:
        """A copy of the user's model in which sensors and constraints are never switched off."""
        return self._plant_model(sensors=True, friction=True)

    def model_at(self, theta: Array, *, at_keyframe: bool = True) -> Any:
        """The user's model with parameters written into it.

        Args:
            theta: (p,) parameter values.
            at_keyframe: True: mocap bodies have the poses of the initial keyframe. False: they have
                the poses of the MJCF.

        Returns:
            A new MjModel, which the caller may change.
        """
        model = ParameterWriter(self.parameters).model(self._whole_model, theta)
        if not at_keyframe:
            self.mocap.put(model, self.mocap.compiled)
        return model

    def model_with_stated_solver(self, theta: Array) -> Any:
        """The user's model with parameters and with the solver settings of the MJCF.

        Other models of this class solve for constraint forces with a small tolerance and without a
        warm start. Where a quicker solver finds the same forces, they use it.

        Args:
            theta: (p,) parameter values.

        Returns:
            A new MjModel, which the caller may change.
        """
        model = self.model_at(theta)
        model.opt.tolerance = self.model.opt.tolerance
        model.opt.solver = self.model.opt.solver

        flags = int(mujoco.mjtDisableBit.mjDSBL_WARMSTART | mujoco.mjtDisableBit.mjDSBL_ISLAND)
        stated = self.model.opt.disableflags & flags
        model.opt.disableflags = (model.opt.disableflags & ~flags) | stated
        return model

    def impossible(self, theta: Array) -> list[int]:
        """Indices of parameters whose values at theta: (p,) give a body an unphysical inertia.

        MuJoCo refuses every one, so that rounding counts against it.
        """
        writer = ParameterWriter(self.parameters)
        try:
            faults = writer.unphysical_bodies(self.plant.source, theta, -MOMENT_ROUNDING)
        except ModelError:
            return np.flatnonzero(self.parameters.needs_compile).tolist()

        return sorted({column for columns, _ in faults for column in columns})


def _require_supported(source: ModelSource) -> None:
    """Raise ModelError for a model that mjfim cannot use.

    Such a model has a timestep that is not positive, or a state that mjfim cannot read.
    """
    model = source.model
    timestep = model.opt.timestep

    # MuJoCo compiles a model with any timestep. The comparison is false for NaN.
    if not 0.0 < timestep < np.inf:
        raise ModelError(
            f"{source.path}: option.timestep is {timestep:g} s; it must be a positive number, for "
            "example 0.002"
        )
    if model.nhistory or model.nplugin:
        feature = "delays or interval sensors" if model.nhistory else "engine plugins"
        raise ModelError(
            f"{source.path}: the model has {feature}, whose internal state mjfim cannot read; "
            "remove them from the model"
        )


def _terms_of(experiment: Experiment, stated: ModelSource) -> tuple[Term, ...]:
    """Physical terms of an experiment, in their order in the file.

    Args:
        experiment: The experiment.
        stated: Its model without terms.

    Raises:
        ExperimentError: A table does not fit the model; the message names its key.
    """
    terms = []
    for name, spec in experiment.terms.items():
        elements = ((key, getattr(spec, key)) for key in ELEMENT_KEYS)
        table = TermTable(
            name=name,
            element=tuple((key, element) for key, element in elements if element is not None),
            encoder=spec.encoder,
            values=tuple((field, float(value)) for field, value in spec.values.items()),
        )
        try:
            terms.append(KINDS[spec.kind].of(table, stated.model, 1.0 / experiment.rate))
        except ExperimentError as error:
            raise ExperimentError(f"terms.{name}: {error}") from None
    return tuple(terms)


def simulate_system(
    system: System, trajectory: Trajectory, seed: int | np.random.Generator = 0
) -> Recording:
    """Simulate a recording of a resolved system. See `simulate`."""
    system = system.released_as(trajectory.state[0])
    rng = np.random.default_rng(seed)
    true = system.parameters.true
    outputs, finite = system.plant.measure(true[None], trajectory.ctrl)
    if not finite[0]:
        why = system.plant.why_diverged(true, trajectory.ctrl)
        raise SimulationDivergedError(
            f"the simulation diverges at the true parameters under this control: {why}"
        )

    noisy = outputs[0] + system.noise.sample(len(outputs[0]), rng)

    # All outputs are recorded at the first sample, afterwards each output at its rate.
    measured = system.noise.measured(trajectory.samples)
    measured[0] = 1.0
    noisy[measured == 0.0] = np.nan

    return Recording(
        t=np.arange(len(noisy), dtype=np.float64) * system.dt,
        ctrl=trajectory.ctrl,
        y=noisy,
        outputs=system.outputs.names,
        name="simulated",
    )


# What makes a system again in a worker process. It can be pickled.
SystemOrder = Callable[[], System]


def order_of(system: System, threads: int) -> SystemOrder:
    """Make the order with which a worker process makes a system again.

    Args:
        system: A system on the plant that the experiment states, or with other substeps.
        threads: Threads that each worker may use.
    """
    assert system.variant == STATED
    return partial(
        _ordered_system,
        for_workers(system.experiment, system.source),
        system.nominal_initial_state,
        system.grid.substeps,
        system.plant.step_factors,
        threads,
    )


def _ordered_system(
    experiment: Experiment,
    initial_state: Array,
    substeps: int,
    step_factors: Array | None,
    threads: int,
) -> System:
    """Make a system again; the model is parsed once in a process."""
    system = System.resolve(experiment, threads=threads)
    if substeps != system.grid.substeps:
        system = system.with_substeps(substeps)

    plant = system.plant.with_initial_state(initial_state)
    return replace(
        system,
        nominal_initial_state=initial_state,
        plant=plant.with_step_factors(step_factors),
    )


def labels_of_model(model: mujoco.MjModel) -> Labels:
    """Make labels of the joints and actuators of a model.

    Args:
        model: The model.
    """
    state = state_components(model)[: model.nq]
    tangent = tangent_components(model)[: model.nv]
    units = {c.name.removeprefix("qpos:"): c.unit for c in tangent}
    return Labels(
        qpos=tuple(f"{c.name.removeprefix('qpos:')} [{c.unit or '1'}]" for c in state),
        positions=tuple(f"{name} [{unit}]" for name, unit in units.items()),
        velocities=tuple(f"{name} velocity [{per_second(unit)}]" for name, unit in units.items()),
        controls=control_labels(model),
    )


def laws_in_loop(
    system: System, theta: Array, clipped: Mapping[str, float]
) -> tuple[ControlLawInLoop, ...]:
    """Describe the laws at some parameters.

    Args:
        system: The system.
        theta: (p,) parameters [theta-unit].
        clipped: Share of the samples at which the limits of a law clip its control, by actuator.

    Returns:
        The laws; none where logs hold the controls themselves.
    """
    if system.laws is None:
        return ()
    model = system.plant.model(theta)
    targets = [target for each in system.parameters.parameters for target in each.targets]
    paths = {target.path.partition("[")[0] for target in targets}
    found = []
    for law in system.laws.laws:
        values = law.numbers(model)
        numbers: dict[str, float] = {}
        units: dict[str, str] = {}
        for field, names in FIELDS.items():
            is_end = len(names) > 1
            for i, name in enumerate(names):
                key = f"{field}[{i}]" if is_end else field
                if np.isfinite(values[name]) and (is_end or values[name] != 0.0):
                    numbers[key] = values[name]
                    units[key] = law_unit(model, law.actuator, field)

        own = f"controller/{law.actuator}:"
        estimated = (key for key in numbers if own + key.partition("[")[0] in paths)
        found.append(
            ControlLawInLoop(
                actuator=law.actuator,
                joint=law.joint,
                rate=1.0 / (law.tick * float(model.opt.timestep)),
                columns=tuple(system.laws.columns[i] for i in law.columns.values()),
                numbers=numbers,
                units=units,
                estimated=tuple(estimated),
                clipped=clipped.get(law.actuator, 0.0),
                replaces_servo=law.replaces_servo,
            )
        )
    return tuple(found)


def labels_of_system(system: System) -> Labels:
    """Make labels of a system's model, parameters and outputs.

    Args:
        system: The system.
    """
    base = labels_of_model(system.model)
    outputs = {name: output_label(system.model, name) for name in system.outputs.names}
    return replace(
        base,
        parameters=system.parameters.names,
        parameter_units=system.units,
        outputs=outputs,
        wanted=system.parameters.wanted,
        published=system.parameters.published,
        bounds=np.column_stack([system.parameters.lower, system.parameters.upper]),
        targets=tuple(
            tuple(target.path for target in parameter.targets)
            for parameter in system.parameters.parameters
        ),
    )

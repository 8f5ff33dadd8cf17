"""The task of a design: a system, the initial control, the cost, the limits and the prior information."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, SimulationDivergedError, unknown
from mjfim.excitation.holding_control import holding_control
from mjfim.excitation.limits import Limit, limits_of
from mjfim.excitation.objective import DesignProblem, RunningCost
from mjfim.excitation.prior_information import information_of
from mjfim.excitation.robust import ParameterSamples
from mjfim.experiment.control_signal import generate
from mjfim.experiment.schema import Experiment, by_name
from mjfim.experiment.system import System, keyframe
from mjfim.experiment.system_tables import Signal
from mjfim.information.fisher import FisherInformation
from mjfim.information.identifiability import IdentifiabilityTest
from mjfim.model.coordinates import joint_dofs, joint_names
from mjfim.model.parameter_samples import sample_parameters
from mjfim.model.parameters import ParameterSet
from mjfim.model.smooth_friction import has_dry_friction, smoothing_speeds_of
from mjfim.model.variants import STATED, ModelVariant, Relaxation
from mjfim.plant.plant import Plant
from mjfim.plant.state_space import StateSpace
from mjfim.recordings.control_table import read_control
from mjfim.records.trajectory import Trajectory
from mjfim.signals import multisine

# Largest number of samples of a design, so that a mistyped horizon does not fill the memory.
MAX_SAMPLES = 10_000_000

# Harmonics of a random multisine.
RANDOM_HARMONICS = 10

# Amplitudes of random controls that look for identifiable parameters, relative to that of the initial control.
LEAST_PROBE_AMPLITUDE = 1.0
MOST_PROBE_AMPLITUDE = 2.0

# Relative deviation of the number of samples from a whole number that is round-off.
SAMPLE_COUNT_TOLERANCE = 1e-6

# Share of the horizon over which a random control rises from rest, and fades to it.
FADE_SHARE = 0.1


@dataclass(frozen=True, kw_only=True, eq=False)
class DesignTask:
    """Everything that the design of an excitation trajectory needs.

    Attributes:
        system: Model, parameters, outputs, noise and plant.
        control: (N, nu) initial control, held over each sample.
        reference: Trajectory of the initial control at theta; None where it diverges.
        limits: Ranges that the MJCF and the experiment state.
        tracking: (nx,) diagonal of Q_tau, the weight on deviations from the initial trajectory.
        control_weight: (nu,) diagonal of R_tau, the weight on the control.
        control_about: (nu,) control that costs nothing.
        contrast: (t, c) combinations of the scaled wanted parameters whose variances criterion "c" sums, or None.
        prior_information: (p, p) information of earlier experiments, without the priors of the parameters.
        added_information: (p, p) the part of it that the caller added to the experiment's `earlier` files, or None.
        samples_of_parameters: Parameter values over which a robust design pools its criterion, or None.
    """

    system: System
    control: Array
    reference: Trajectory | None
    limits: tuple[Limit, ...]
    tracking: Array
    control_weight: Array
    control_about: Array
    contrast: Array | None
    prior_information: Array
    added_information: Array | None
    samples_of_parameters: ParameterSamples | None

    @classmethod
    def resolve(
        cls,
        experiment: Experiment,
        *,
        threads: int | None = None,
        added_information: Array | None = None,
        variant: ModelVariant | None = None,
    ) -> DesignTask:
        """Resolve an experiment into the task of designing its control.

        Args:
            experiment: The experiment as the user states it.
            threads: Threads for the engine; default: one per core.
            added_information: (p, p) information of other experiments besides the stated `earlier` files.
            variant: How the plant differs from the user's model; default: it does not.

        Raises:
            ExperimentError: Something is wrong or missing in the experiment; the message names the key.
            ModelError: The model cannot be used.
        """
        _require_design_keys(experiment)
        system = System.resolve(experiment, threads=threads)
        task = cls.of(system, added_information=added_information)
        return task if variant is None else task.with_variant(variant)

    @classmethod
    def of(cls, system: System, *, added_information: Array | None = None) -> DesignTask:
        """Resolve the task that the experiment of a system states.

        Args:
            system: The system.
            added_information: (p, p) information of other experiments besides the stated `earlier` files.

        Raises:
            ExperimentError: Something is wrong or missing in the experiment; the message names the key.
        """
        experiment = system.experiment
        _require_design_keys(experiment)
        try:
            samples = _samples(experiment, system.grid.stride)
            t = np.arange(samples, dtype=np.float64) * system.dt
            return cls._made(system, _initial_control(system, t), added_information)
        except ExperimentError as error:
            raise ExperimentError(f"{experiment.source}: {error}") from None

    @classmethod
    def along(cls, system: System, control: Array) -> DesignTask:
        """A task whose initial control is given: for looking at information along it, without any stated horizon.

        Args:
            system: Model, parameters, outputs, noise and plant.
            control: (N, nu) control.
        """
        bare = system.experiment.model_copy(update={"robust": None})
        return cls._made(replace(system, experiment=bare), control, None, weighted=False)

    @classmethod
    def _made(
        cls, system: System, control: Array, added: Array | None, *, weighted: bool = True
    ) -> DesignTask:
        """Put a task together; `weighted`: with the stated weights and limits, which must bound every control."""
        experiment, names = system.experiment, system.controls
        limits = limits_of(system.model, system.coordinates, names, experiment.limits)

        weight = by_name("cost.control", experiment.cost.control, names, "actuator")
        if weighted:
            _require_bounded_controls(system, limits, weight)

        about = system.rest
        if experiment.cost.control_about is not None:
            about = by_name("cost.control_about", experiment.cost.control_about, names, "actuator")

        files = [experiment.directory / path for path in experiment.earlier]
        prior = information_of(files, system.parameters.names)
        if added is not None:
            prior = prior + added

        system, reference = _calibrated(system, control)
        return cls(
            system=system,
            control=control,
            reference=reference,
            limits=limits,
            tracking=_tracking_weights(system),
            control_weight=weight,
            control_about=about,
            contrast=_contrast(system),
            prior_information=prior,
            added_information=added,
            samples_of_parameters=_parameter_samples(system),
        )

    # Shortcuts to the parts of the system that nearly every step of a design needs.

    @property
    def experiment(self) -> Experiment:
        """The experiment as the user states it."""
        return self.system.experiment

    @property
    def plant(self) -> Plant:
        """The plant on which the design is made."""
        return self.system.plant

    @property
    def parameters(self) -> ParameterSet:
        """The p unknown parameters."""
        return self.system.parameters

    @property
    def theta(self) -> Array:
        """(p,) parameter values at which the design is made."""
        return self.system.theta

    @property
    def space(self) -> StateSpace:
        """Layout of the state."""
        return self.system.space

    @property
    def controls(self) -> tuple[str, ...]:
        """Names of the nu controls."""
        return self.system.controls

    @property
    def dt(self) -> float:
        """Sample period [s]."""
        return self.system.dt

    # Time

    @property
    def samples(self) -> int:
        """Number N of samples."""
        return len(self.control)

    @property
    def t(self) -> Array:
        """(N,) sample times [s]."""
        return np.arange(self.samples, dtype=np.float64) * self.dt

    @property
    def horizon(self) -> float:
        """Duration [s]."""
        return self.samples * self.dt

    @property
    def stated_times(self) -> Array:
        """(N * sample_factor,) sample times of the stated experiment [s]."""
        factor = self.system.variant.sample_factor
        return np.arange(self.samples * factor, dtype=np.float64) * (self.dt / factor)

    def averaged(self, control: Array) -> Array:
        """(N, nu) control on the samples of this task from (N * sample_factor, nu) on the stated ones."""
        factor = self.system.variant.sample_factor
        return np.asarray(control.reshape(self.samples, factor, -1).mean(axis=1))

    # Information and cost

    @property
    def prior(self) -> Array:
        """(p, p) prior information: earlier experiments and the priors of the parameters."""
        return self.parameters.prior_information + self.prior_information

    @property
    def information(self) -> FisherInformation:
        """Fisher information of the measured samples, and the criterion."""
        experiment, parameters = self.experiment, self.parameters
        measure_rate = self.system.measure_rate

        # Prior information is a sum over samples; the cost wants it per second, equal on every sample grid.
        per_sample = measure_rate / (experiment.measure_rate or experiment.rate)
        all_wanted = len(parameters.interest) == len(parameters)

        return FisherInformation(
            noise=self.system.noise,
            measure_rate=measure_rate,
            scale=parameters.scale,
            prior=self.prior * per_sample,
            criterion=experiment.cost.criterion,
            weight=experiment.cost.information,
            interest=None if all_wanted else parameters.interest,
            contrast=self.contrast,
            stated_prior=np.diag(parameters.prior_information),
        )

    @property
    def initial(self) -> Trajectory:
        """Trajectory of the initial control at theta, the reference x_d of the tracking term.

        Raises:
            SimulationDivergedError: The simulation diverges under the initial control.
        """
        if self.reference is None:
            return self.plant.simulate(self.theta, self.control)
        return self.reference

    @cached_property
    def problem(self) -> DesignProblem:
        """The cost, as Algorithm 1 of the paper minimises it."""
        running = RunningCost(
            space=self.space,
            dt=self.dt,
            desired_state=self.initial.state,
            Q=self.tracking,
            R=self.control_weight,
            desired_control=self.control_about,
        )
        return DesignProblem(
            plant=self.plant,
            theta=self.theta,
            information=self.information,
            running=running,
            parameter_samples=self.samples_of_parameters,
        )

    @property
    def identifiability_test(self) -> IdentifiabilityTest:
        """Finds the parameters that cannot be identified, along trajectories of this task."""
        return IdentifiabilityTest(
            plant=self.plant,
            parameters=self.parameters,
            noise=self.system.noise,
            theta=self.theta,
            earlier=self.prior_information,
            probes=self.probes,
        )

    # Beginning and end

    @property
    def is_limited(self) -> bool:
        """True where hard limits hold, or the design has to begin, end or move in a certain way."""
        limits = self.experiment.limits
        return self.is_shaped or (
            limits.enforce and (bool(self.limits) or limits.clearance is not None)
        )

    @property
    def is_shaped(self) -> bool:
        """True where the design has to begin, end or move in a certain way."""
        boundary = self.experiment.boundary
        return (
            boundary.start != "given"
            or boundary.end != "free"
            or self.experiment.limits.bandwidth is not None
        )

    @property
    def centre(self) -> Array:
        """(nu,) control about which controls vary: the one that holds the initial state, or the mean of the initial control."""
        if self.experiment.boundary.start == "rest":
            return self.initial_hold
        return np.asarray(self.control.mean(axis=0))

    @cached_property
    def initial_hold(self) -> Array:
        """(nu,) control that holds the initial state. Raises ExperimentError where none does."""
        start = self.plant.initial_state(self.theta)
        return holding_control(
            self.system, start, self.system.rest, key="boundary.start", place="the initial state"
        )

    @cached_property
    def target(self) -> Array:
        """(ns,) state at which the design ends, where the boundary asks for one."""
        start = self.plant.initial_state(self.theta)
        if self.experiment.boundary.end != "rest":
            return start

        key = keyframe(self.system.model, "boundary.keyframe", self.experiment.boundary.keyframe)
        state = start if key is None else np.concatenate([key.qpos, key.qvel, key.act])
        qpos, _, act = self.space.split(state)
        return np.concatenate([qpos, np.zeros(self.space.nv), act])

    @cached_property
    def final_hold(self) -> Array:
        """(nu,) control that holds the state at which the design comes to rest. Raises ExperimentError."""
        key = keyframe(self.system.model, "boundary.keyframe", self.experiment.boundary.keyframe)
        rest = self.system.rest if key is None else np.array(key.ctrl)
        return holding_control(
            self.system, self.target, rest, key="boundary.end", place="the final state"
        )

    # Random controls

    def random_control(self, rng: np.random.Generator, least: float, most: float) -> Array:
        """A random multisine about the mean of the initial control, within the ranges of the controls.

        It rises from rest and fades to it where the experiment begins and ends at rest.

        Args:
            rng: Source of random numbers.
            least: Least amplitude, relative to the initial control's.
            most: Largest amplitude, relative to the initial control's.

        Returns:
            (N, nu) control.
        """
        mean = self.control.mean(axis=0)
        peak = np.abs(self.control - mean).max(axis=0)
        peak = np.where(peak > 0.0, peak, 1.0)

        wave = multisine(self.t, len(self.controls), 1.0 / self.horizon, RANDOM_HARMONICS, rng)
        swing = peak * rng.uniform(least, most) * wave
        about = self.initial_hold if self.experiment.boundary.start == "rest" else mean
        control = about + self.fade(self.samples) * swing

        for limit in self.limits:
            if limit.kind == "control":
                column = control[:, limit.index]
                control[:, limit.index] = np.clip(column, limit.lower, limit.upper)
        return np.asarray(control)

    def fade(self, samples: int) -> Array:
        """(samples, 1) window that rises from 0 where the design starts at rest, and falls to 0 where it ends at rest."""
        boundary = self.experiment.boundary
        share = np.arange(samples)[:, None] / samples
        window = np.ones_like(share)
        if boundary.start == "rest":
            window = window * np.clip(share / FADE_SHARE, 0.0, 1.0)
        if boundary.end == "rest":
            window = window * np.clip((1.0 - share) / FADE_SHARE - 1.0, 0.0, 1.0)
        return np.asarray(window)

    def probes(self, count: int) -> Iterator[Trajectory]:
        """Simulate random controls.

        Args:
            count: Number of controls.

        Yields:
            Trajectories of controls up to twice as large as the initial one; those that diverge are left out.
        """
        rng = np.random.default_rng(self.experiment.descent.seed)
        for _ in range(count):
            control = self.random_control(rng, LEAST_PROBE_AMPLITUDE, MOST_PROBE_AMPLITUDE)
            try:
                yield self.plant.simulate(self.theta, control)
            except SimulationDivergedError:
                continue

    # Variants of the plant

    def with_variant(self, variant: ModelVariant) -> DesignTask:
        """This task on another plant.

        Args:
            variant: How the plant differs from the user's model.

        Returns:
            A task with the control averaged over longer samples, where the variant has these.
        """
        before = self.system.variant.sample_factor
        stated = np.repeat(self.control, before, axis=0) if before > 1 else self.control
        samples = len(stated) // variant.sample_factor
        kept = stated[: samples * variant.sample_factor]
        control = kept.reshape(samples, variant.sample_factor, -1).mean(axis=1)

        changed = self.system.with_variant(variant, self._relaxation())
        system, reference = _calibrated(changed, control)
        return replace(self, system=system, control=np.asarray(control), reference=reference)

    def restated(
        self, experiment: Experiment, *, added_information: Array | None = None
    ) -> DesignTask:
        """The task of another experiment on the same model, which is not parsed again."""
        system = System.resolve(experiment, threads=self.system.threads, source=self.system.source)
        return DesignTask.of(system, added_information=added_information)

    def with_horizon(self, horizon: float) -> DesignTask:
        """This task with another horizon [s], on the same variant of the plant."""
        experiment = self.experiment.replace(horizon=horizon)
        stated = replace(self.system.with_variant(STATED), experiment=experiment)
        task = DesignTask.of(stated, added_information=self.added_information)
        return task.with_variant(self.system.variant)

    def coarser(self, factor: int) -> DesignTask:
        """This task with a timestep and a sample period that are `factor` times longer."""
        return self.with_variant(replace(self.system.variant, sample_factor=factor))

    def relaxed(self) -> DesignTask:
        """This task on a plant without the clamps and stops that its hard limits keep a design away from."""
        variant = replace(
            self.system.variant, relaxed=True, smoothing_speeds=self._smoothing_speeds()
        )
        return self.with_variant(variant)

    def stretched(self, factor: int) -> DesignTask:
        """This task with a timestep that is `factor` times longer; the samples stay."""
        return self.with_variant(replace(self.system.variant, timestep_factor=factor))

    def smoothed(self) -> DesignTask:
        """This task with smoothed dry friction in the motion as well, not only in its derivatives."""
        return self.with_variant(replace(self.system.variant, smoothed=True))

    def _smoothing_speeds(self) -> tuple[float, ...]:
        """Speeds below which dry friction is smoothed for derivatives; empty where the model has none."""
        model = self.system.model_at(self.theta)
        if not has_dry_friction(model):
            return ()

        # A stated limit says how fast a joint may move; else the initial trajectory shows it.
        fastest = np.abs(self.initial.qvel).max(axis=0)
        for limit in self.limits:
            if limit.kind == "velocity":
                fastest[limit.index] = limit.scale
        return smoothing_speeds_of(model, fastest)

    def _relaxation(self) -> Relaxation | None:
        """Clamps, stops and contacts that the enforced limits keep a design away from."""
        stated = self.experiment.limits
        if not stated.enforce:
            return None

        named: dict[str, set[str]] = {"position": set(), "joint_force": set()}
        for limit in self.limits:
            if limit.kind in named:
                named[limit.kind].add(limit.name)
        forced = {limit.index for limit in self.limits if limit.kind == "force"}
        model, coordinates = self.system.model, self.system.coordinates

        return Relaxation(
            joints=tuple(c.joint for c in coordinates if c.name in named["position"]),
            joint_forces=tuple(c.joint for c in coordinates if c.name in named["joint_force"]),
            actuators=tuple(
                i for i in range(model.nactuator) if int(model.actuator_outadr[i]) in forced
            ),
            controls=True,
            contacts=stated.clearance is not None and not stated.ignored,
        )


def _calibrated(system: System, control: Array) -> tuple[System, Trajectory | None]:
    """The system with difference steps that suit the trajectory of a control, and the trajectory.

    A trajectory that diverges is None here; the step that needs it raises.
    """
    try:
        trajectory = system.plant.simulate(system.theta, control)
    except SimulationDivergedError:
        return system, None
    return system.calibrated_along(system.theta, trajectory), trajectory


def _require_design_keys(experiment: Experiment) -> None:
    """Raise ExperimentError where the experiment lacks a key that only a design needs."""
    if experiment.horizon is None:
        raise ExperimentError(
            f"{experiment.source}: design needs `horizon`, the duration of the experiment [s], for example horizon = 4.0"
        )
    if experiment.initial.control is None:
        raise ExperimentError(
            f"{experiment.source}: design needs `initial.control`, the control from which it starts, for example "
            'control = { kind = "multisine", amplitude = 1.0 }'
        )


def _samples(experiment: Experiment, stride: int) -> int:
    """Number of samples in the horizon. Raises ExperimentError where it is not a whole one, or nothing is measured."""
    horizon = float(experiment.horizon or 0.0)
    period = 1.0 / experiment.rate
    exact = horizon * experiment.rate
    count = round(exact)

    if count < 2 or abs(exact - count) > SAMPLE_COUNT_TOLERANCE * count:
        near = f"{max(count, 2) * period:g} s, {(max(count, 2) + 1) * period:g} s"
        raise ExperimentError(
            f"horizon: {horizon:g} s is not a whole number (>= 2) of samples of {period:g} s; "
            f"valid for example: {near}"
        )
    if count > MAX_SAMPLES:
        raise ExperimentError(f"horizon: {count:g} samples are too many; at most {MAX_SAMPLES:g}")
    if stride > count:
        raise ExperimentError(
            f"measure_rate: {experiment.measure_rate:g} Hz measures nothing within {horizon:g} s"
        )
    return count


def _initial_control(system: System, t: Array) -> Array:
    """(N, nu) control that the experiment states: a generated signal, or a table in a file."""
    experiment, source = system.experiment, system.experiment.initial.control
    if isinstance(source, Signal):
        return generate(source, t, system.controls, system.rest)
    return read_control(experiment.directory / str(source), t, system.dt, system.controls)


def _require_bounded_controls(system: System, limits: tuple[Limit, ...], weight: Array) -> None:
    """Raise ExperimentError where neither a weight nor an enforced range bounds a control."""
    enforced = system.experiment.limits.enforce
    bounded = {limit.name for limit in limits if limit.kind == "control"} if enforced else set()

    for name, value in zip(system.controls, weight.tolist(), strict=True):
        if value <= 0.0 and name not in bounded:
            raise ExperimentError(
                f"cost.control: actuator {name!r} has neither a weight nor a range; it needs a weight > 0, "
                f"or a hard limit: limits.control.{name} = [lower, upper]"
            )


def _tracking_weights(system: System) -> Array:
    """(nx,) diagonal of Q_tau: the weight of a joint holds for each of its degrees of freedom."""
    cost, model = system.experiment.cost, system.model
    names = joint_names(model)
    widths = [joint_dofs(model, j) for j in range(model.njnt)]

    position = by_name("cost.tracking", cost.tracking, names, "joint")
    velocity = by_name("cost.tracking_velocity", cost.tracking_velocity, names, "joint")
    return np.concatenate(
        [np.repeat(position, widths), np.repeat(velocity, widths), np.zeros(model.na)]
    )


def _contrast(system: System) -> Array | None:
    """(t, c) combinations of the scaled wanted parameters whose variances criterion "c" sums; None for other criteria."""
    cost, parameters = system.experiment.cost, system.parameters
    if cost.criterion != "c":
        return None

    wanted = tuple(parameters.names[j] for j in parameters.interest)
    scale = parameters.scale[parameters.interest]
    key = "combination" if cost.combination else "subset"
    chosen = tuple(cost.combination or cost.subset or ())

    for name in chosen:
        if name not in wanted:
            raise ExperimentError(f"cost.{key}: {unknown('wanted parameter', name, wanted)}")
    if not chosen:
        raise ExperimentError(f"cost.subset: it is empty; valid: {', '.join(wanted)}")

    # One combination of all parameters, or each chosen parameter in the unit of its scale.
    if cost.combination:
        coefficients = [cost.combination.get(name, 0.0) for name in wanted]
        return np.asarray((np.array(coefficients) * scale)[:, None])
    return np.asarray(np.eye(len(wanted))[:, [wanted.index(name) for name in chosen]])


def _parameter_samples(system: System) -> ParameterSamples | None:
    """Parameter values over which a robust design pools its criterion; None where `[robust]` is not stated."""
    experiment = system.experiment
    robust = experiment.robust
    if robust is None:
        return None
    if experiment.descent.psi_weight:
        raise ExperimentError(
            "robust: descent.psi_weight belongs to a design at one parameter value"
        )

    thetas = sample_parameters(
        system.parameters, system.theta, robust.samples, robust.seed, system.impossible
    )
    logarithmic = experiment.cost.criterion == "D"
    return ParameterSamples(thetas=thetas, over=robust.over, logarithmic=logarithmic)

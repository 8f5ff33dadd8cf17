"""The task of a design: system, initial control, cost, limits and prior information."""

from __future__ import annotations

from collections.abc import Iterator, Sequence
from contextlib import ExitStack
from dataclasses import replace
from functools import cached_property

import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError, SimulationDivergedError, listed, unknown
from mjfim.excitation.limits.limits import Limit, ReleaseSpace, limits_of, limits_of_model
from mjfim.excitation.objective import DesignProblem, ParameterSamples, RunningCost
from mjfim.excitation.prior_information import EarlierExperiments, known_from
from mjfim.experiment.controls import (
    holding_control,
    least_drift_control,
    require_design_keys,
    stated_control,
)
from mjfim.experiment.initial import keyframe, multisine, spline_basis
from mjfim.experiment.packing import named_file, opened
from mjfim.experiment.schema import Experiment, ExperimentLike, by_name
from mjfim.experiment.system import System
from mjfim.information.fisher import FisherInformation
from mjfim.information.identifiability import IdentifiabilityTest
from mjfim.model.coordinates import actuator_names, joint_dofs, joint_names
from mjfim.model.elements import unique_names
from mjfim.model.parameters import ParameterSet
from mjfim.model.variants import ModelVariant, Relaxation, has_dry_friction, smoothing_speeds_of
from mjfim.plant.plant import Plant
from mjfim.plant.state_space import StateSpace
from mjfim.records.trajectory import Trajectory

# Harmonics of a random multisine.
RANDOM_HARMONICS = 10

# Smallest and largest amplitude of the random controls that test which parameters are identifiable,
# relative to the amplitude of the initial control.
LEAST_PROBE_AMPLITUDE = 1.0
MOST_PROBE_AMPLITUDE = 2.0

# Share of the horizon over which a random control fades in from rest, and over which it fades out.
FADE_SHARE = 0.1

# Distance from the bounds of a control at which a centre lies at least, over half of its range.
RANGE_MARGIN = 0.05


@record
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
        contrast: (t, c) combinations of the scaled wanted parameters whose variances criterion "c"
            sums, or None.
        prior_information: (p, p) information of earlier experiments, without the priors of the
            parameters.
        added: What the caller added to the information of the experiment's `earlier` files, or
            None.
        inflation: (p,) factors by which residuals like those of earlier estimates widen standard
            deviations; empty where there is no earlier estimate.
        samples_of_parameters: Parameter values over which a robust design pools its criterion, or
            None.
        release: Ranges of the initial state within which the release is designed, or None where
            the control is.
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
    added: EarlierExperiments | None
    inflation: Array
    samples_of_parameters: ParameterSamples | None
    release: ReleaseSpace | None

    @classmethod
    def resolve(
        cls,
        experiment: ExperimentLike,
        *,
        threads: int | None = None,
        added: EarlierExperiments | None = None,
    ) -> DesignTask:
        """Resolve an experiment into the task of designing its control.

        Args:
            experiment: The experiment as the user states it.
            threads: Threads for the engine; default: one per core.
            added: What other experiments tell besides the stated `earlier` files.

        Raises:
            ExperimentError: Something is wrong or missing in the experiment; the message names the
                key.
            ModelError: The model cannot be used.
        """
        system = System.resolve(experiment, threads=threads)
        return cls.of(system, added=added)

    @classmethod
    def of(cls, system: System, *, added: EarlierExperiments | None = None) -> DesignTask:
        """Resolve the task that the experiment of a system states.

        Args:
            system: The system.
            added: What other experiments tell besides the stated `earlier` files.

        Raises:
            ExperimentError: Something is wrong or missing in the experiment; the message names the
                key.
        """
        require_design_keys(system)
        with named_file(system.experiment):
            return cls._made(system, stated_control(system), added)

    @classmethod
    def along(cls, system: System, control: Array) -> DesignTask:
        """Make a task whose initial control is given, to compute the information along it.

        The experiment needs no horizon, and nothing has to bound its controls.

        Args:
            system: Model, parameters, outputs, noise and plant.
            control: (N, nu) control.
        """
        bare = system.experiment.model_copy(update={"robust": None})
        return cls._made(replace(system, experiment=bare), control, None, weighted=False)

    @classmethod
    def _made(
        cls,
        system: System,
        control: Array,
        added: EarlierExperiments | None,
        *,
        weighted: bool = True,
    ) -> DesignTask:
        """Put a task together; `weighted`: weights or limits have to bound every control."""
        experiment, names = system.experiment, system.controls
        of_terms = system.source.added
        limits = limits_of(system.model, names, experiment.limits, system.grid.dt, of_terms)

        weight = by_name("cost.control", experiment.cost.control, names, "actuator")
        if weighted:
            _require_bounded_controls(system, limits, weight)

        about = system.rest
        if experiment.cost.control_about is not None:
            about = by_name("cost.control_about", experiment.cost.control_about, names, "actuator")

        # References of control laws cost nothing, because no design chooses them.
        if system.laws is not None:
            weight = about = np.zeros(len(system.inputs))

        with ExitStack() as stack:
            files = [stack.enter_context(opened(experiment, path)) for path in experiment.earlier]
            earlier = known_from(files, system.parameters.names)
        if added is not None:
            earlier = earlier.plus(added)

        # The noise with which the inflation was found; a fit may have estimated it.
        stated = system.stated_noise
        found = [
            earlier.sigma.get(output.name, own)
            for output, own in zip(system.outputs.outputs, stated.sigma, strict=True)
        ]
        factor = np.array(found) / stated.sigma
        noise = replace(stated, covariance=stated.covariance * np.outer(factor, factor))
        system, reference = _calibrated(replace(system, stated_noise=noise), control)
        return cls(
            system=system,
            control=control,
            reference=reference,
            limits=limits,
            tracking=_tracking_weights(system),
            control_weight=weight,
            control_about=about,
            contrast=_contrast(system),
            prior_information=earlier.information,
            added=added,
            inflation=earlier.inflation,
            samples_of_parameters=ParameterSamples.of(system),
            release=ReleaseSpace.of(system, limits),
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
        """Average a control over the samples of this task.

        Args:
            control: (N * sample_factor, nu) control at the stated sample rate [u-unit].

        Returns:
            (N, nu) control [u-unit].
        """
        factor = self.system.variant.sample_factor
        return np.asarray(control.reshape(self.samples, factor, control.shape[1]).mean(axis=1))

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

        # Prior information is a sum over samples; the cost wants it per second, equal on every
        # sample grid.
        per_sample = measure_rate / (experiment.measure_rate or experiment.rate)

        return FisherInformation(
            noise=self.system.noise,
            measure_rate=measure_rate,
            scale=parameters.scale,
            prior=self.prior * per_sample,
            criterion=experiment.cost.criterion,
            weight=experiment.cost.information,
            interest=parameters.interest,
            contrast=self.contrast,
            stated_prior=np.diag(parameters.prior_information),
            inflation=self.inflation if len(self.inflation) else 1.0,
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
    def sizes(self) -> Array:
        """(nx+nu,) sizes of state and control along the initial trajectory [x-unit, u-unit].

        They are the natural sizes of the model where it diverges, or hardly moves.
        """
        sizes = self.plant.sizes
        shown = self.reference
        if shown is None:
            start = np.tile(self.plant.initial_state(self.theta), (self.samples + 1, 1))
            shown = self.plant.trajectory(start, self.control)
        return sizes.along(shown, sizes.position / self.horizon)

    @cached_property
    def problem(self) -> DesignProblem:
        """The cost in the form that Algorithm 1 of the paper needs."""
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
        """Test for parameters that cannot be identified along trajectories of this task."""
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
        """True where the design has to keep hard limits, a boundary or a bandwidth."""
        limits = self.experiment.limits
        return self.is_shaped or (
            limits.enforce and (bool(self.limits) or limits.clearance is not None)
        )

    @property
    def is_shaped(self) -> bool:
        """True where the experiment states how the design begins or ends, or its bandwidth."""
        boundary, bandwidth = self.experiment.boundary, self.experiment.limits.bandwidth
        return (boundary.start, boundary.end, bandwidth) != ("given", "free", None)

    @property
    def centre(self) -> Array:
        """(nu,) control about which controls vary [u-unit].

        It holds the initial state where the design begins at rest; else it is the mean of the
        initial control.
        """
        if self.experiment.boundary.start == "rest":
            return self.initial_hold
        return np.asarray(self.control.mean(axis=0))

    @cached_property
    def centres(self) -> tuple[Array, ...]:
        """Controls, (nu,) each, towards which an infeasible control may be shrunk [u-unit].

        They are `centre`, the control under which the initial state changes least, and the control
        at rest; the latter two are moved inside the ranges of the controls.
        """
        start = self.plant.initial_state(self.theta)
        rest = self.system.rest
        found = [self.centre]

        for control in (least_drift_control(self.system, start, rest), rest):
            inside = self._inside_ranges(control, RANGE_MARGIN)
            is_new = not any(np.array_equal(inside, other) for other in found)
            if is_new and np.isfinite(inside).all():
                found.append(inside)

        return tuple(found)

    def _inside_ranges(self, control: Array, margin: float) -> Array:
        """A control, (..., nu), moved inside the ranges of the controls by a relative margin."""
        inside = np.array(control)
        for limit in self.limits:
            if limit.kind == "control":
                gap, each = margin * limit.scale, inside[..., limit.index]
                inside[..., limit.index] = np.clip(each, limit.lower + gap, limit.upper - gap)
        return inside

    @cached_property
    def initial_hold(self) -> Array:
        """(nu,) control that holds the initial state. Raises ExperimentError where none does."""
        start = self.plant.initial_state(self.theta)
        return holding_control(
            self.system, start, self.system.rest, key="boundary.start", place="the initial state"
        )

    @cached_property
    def target(self) -> Array:
        """(ns,) final state that the boundary requires; the initial state unless it is at rest."""
        state = self.plant.initial_state(self.theta)
        if self.experiment.boundary.end != "rest":
            return state

        key = keyframe(self.system.model, "boundary.keyframe", self.experiment.boundary.keyframe)
        if key is not None:
            state = np.concatenate([key.qpos, key.qvel, key.act])
        qpos, _, act = self.space.split(state)
        return np.concatenate([qpos, np.zeros(self.space.nv), act])

    @cached_property
    def final_hold(self) -> Array:
        """(nu,) control that holds the final state. Raises ExperimentError where none does."""
        key = keyframe(self.system.model, "boundary.keyframe", self.experiment.boundary.keyframe)
        rest = self.system.rest if key is None else np.array(key.ctrl)
        return holding_control(
            self.system, self.target, rest, key="boundary.end", place="the final state"
        )

    # Random controls

    def random_control(self, rng: np.random.Generator, least: float, most: float) -> Array:
        """Make a random multisine within the ranges of the controls.

        It varies about the mean of the initial control. Where the experiment begins at rest, it
        fades in about the control that holds the initial state; where the experiment ends at rest,
        it fades out.

        Args:
            rng: Source of random numbers.
            least: Smallest amplitude, relative to that of the initial control.
            most: Largest amplitude, relative to that of the initial control.

        Returns:
            (N, nu) control.
        """
        mean = self.control.mean(axis=0)
        peak = np.abs(self.control - mean).max(axis=0)
        peak = np.where(peak > 0.0, peak, self.plant.sizes.control)

        about = self.initial_hold if self.experiment.boundary.start == "rest" else mean
        window = self.fade(self.samples)

        wave = multisine(self.t, len(self.controls), 1.0 / self.horizon, RANDOM_HARMONICS, rng)
        return self._inside_ranges(about + window * (peak * rng.uniform(least, most) * wave), 0.0)

    def bandwidth_basis(self, t: Array) -> Array | None:
        """Make the splines of the bandwidth that the experiment states.

        Args:
            t: (N,) times [s].

        Returns:
            (N, M) splines whose sums are the allowed deviations of the control from its centre;
            None where the bandwidth is not limited.

        Raises:
            ExperimentError: The bandwidth is above half of the sample rate.
        """
        bandwidth, rate = self.experiment.limits.bandwidth, self.experiment.rate
        if bandwidth is None:
            return None

        highest = 0.5 * rate
        if bandwidth > highest:
            raise ExperimentError(
                f"limits.bandwidth: {bandwidth:g} Hz; a control at {rate:g} Hz has {highest:g} Hz "
                "at most"
            )
        return self.boundary_splines(t, bandwidth)

    def boundary_splines(self, t: Array, bandwidth: float) -> Array:
        """Make splines that begin and end as the experiment's `[boundary]` states.

        Args:
            t: (N,) times [s].
            bandwidth: Their bandwidth [Hz].

        Returns:
            (N, M) splines.
        """
        boundary = self.experiment.boundary
        is_periodic = boundary.end == "periodic"
        starts_at_rest = boundary.start == "rest"

        # A periodic control that starts at rest ends at rest too.
        return spline_basis(
            t,
            self.horizon,
            bandwidth,
            starts_at_rest,
            boundary.end == "rest" or (is_periodic and starts_at_rest),
            is_periodic and not starts_at_rest,
        )

    def fade(self, samples: int) -> Array:
        """(samples, 1) window between 0 and 1 that fades a control in and out.

        It rises from 0 where the design begins at rest, and falls to 0 where it ends at rest.
        """
        boundary = self.experiment.boundary
        share = np.arange(samples)[:, None] / samples
        window = np.ones_like(share)
        if boundary.start == "rest":
            window = window * np.clip(share / FADE_SHARE, 0.0, 1.0)
        if boundary.end == "rest":
            window = window * np.clip((1.0 - share) / FADE_SHARE - 1.0, 0.0, 1.0)
        return np.asarray(window)

    def probes(self, count: int) -> Iterator[Trajectory]:
        """Simulate random controls, or random releases where the release is designed.

        Args:
            count: Number of controls.

        Yields:
            Trajectories of controls up to twice as large as the initial one; those that diverge are
            left out.
        """
        rng = np.random.default_rng(self.experiment.descent.seed)
        for _ in range(count):
            plant, control = self.plant, self.control
            if self.release is None:
                control = self.random_control(rng, LEAST_PROBE_AMPLITUDE, MOST_PROBE_AMPLITUDE)
            else:
                shares = rng.uniform(size=len(self.release.names))
                plant = plant.with_initial_state(self.release.state(shares))
            try:
                yield plant.simulate(self.theta, control)
            except SimulationDivergedError:
                continue

    # Variants of the plant

    def released_as(self, state: Array) -> DesignTask:
        """This task, which begins in a state: (ns,), where the release is designed."""
        if self.release is None:
            return self
        system, reference = _calibrated(self.system.released_as(state), self.control)
        return replace(self, system=system, reference=reference, release=None)

    def with_variant(self, variant: ModelVariant) -> DesignTask:
        """This task on another plant.

        Args:
            variant: How the plant differs from the user's model.

        Returns:
            A task whose control is averaged over longer samples, where the variant has these.
        """
        stated = np.repeat(self.control, self.system.variant.sample_factor, axis=0)
        return self._along(stated, variant)

    def with_horizon(self, horizon: float, control: Array | None = None) -> DesignTask:
        """This task with another horizon, on the same variant of the plant.

        Args:
            horizon: The horizon [s].
            control: (n, nu) initial control at the stated sample rate; default: the stated one.
        """
        experiment = self.experiment.replace(horizon=horizon)
        task = replace(self, system=replace(self.system, experiment=experiment))
        with named_file(experiment):
            stated = stated_control(task.system) if control is None else control
            return task._along(stated, self.system.variant)

    def _along(self, control: Array, variant: ModelVariant) -> DesignTask:
        """This task on another plant, along a control: (n, nu) at the stated sample rate."""
        factor = variant.sample_factor
        samples = len(control) // factor
        averaged = control[: samples * factor].reshape(samples, factor, control.shape[1])
        averaged = averaged.mean(axis=1)

        changed = self.system.with_variant(variant, self._relaxation())
        system, reference = _calibrated(changed, averaged, known=self)
        return replace(self, system=system, control=averaged, reference=reference)

    def restated(
        self, experiment: Experiment, *, added: EarlierExperiments | None = None
    ) -> DesignTask:
        """The task of another experiment on this model, which is not parsed again."""
        system = System.resolve(experiment, threads=self.system.threads, source=self.system.source)
        return DesignTask.of(system, added=added)

    def coarser(self, factor: int) -> DesignTask:
        """This task with a timestep and a sample period that are `factor` times longer."""
        return self.with_variant(replace(self.system.variant, sample_factor=factor))

    def relaxed(self) -> DesignTask:
        """This task on a plant without the clamps and stops that hard limits make unreachable."""
        variant = replace(
            self.system.variant, relaxed=True, smoothing_speeds=self._smoothing_speeds()
        )
        return self.with_variant(variant)

    def stretched(self, factor: int) -> DesignTask:
        """This task with a timestep that is `factor` times longer; the samples stay."""
        return self.with_variant(replace(self.system.variant, timestep_factor=factor))

    def smoothed(self) -> DesignTask:
        """This task with smoothed dry friction in the motion, not only in its derivatives."""
        return self.with_variant(replace(self.system.variant, smoothed=True))

    def _smoothing_speeds(self) -> tuple[float, ...]:
        """Speeds below which dry friction is smoothed for derivatives; empty without friction."""
        model = self.system.model_at(self.theta)
        if not has_dry_friction(model):
            return ()

        # A stated limit says how fast a joint may move; else the initial trajectory shows it.
        fastest = np.abs(self.initial.qvel).max(axis=0)
        for limit in self.limits:
            if limit.kind == "velocity":
                fastest[limit.index : limit.index + limit.count] = limit.scale
        return smoothing_speeds_of(model, fastest)

    def _relaxation(self) -> Relaxation | None:
        """Clamps, stops and contacts that the enforced limits make unreachable for a design."""
        stated = self.experiment.limits
        if not stated.enforce:
            return None

        # A stop acts inside of a limit that the file states wider than the MJCF.
        model = self.system.model
        own = {(each.kind, each.name): each for each in limits_of_model(model)}
        inside = set()
        for limit in self.limits:
            key = limit.kind, limit.name
            stop = own.get(key, limit)
            if stop.lower <= limit.lower and limit.upper <= stop.upper:
                inside.add(key)

        def chosen(names: Sequence[str], kind: str) -> tuple[int, ...]:
            """Numbers of the elements that have a limit of a kind."""
            return tuple(i for i, name in enumerate(names) if (kind, name) in inside)

        tendons = unique_names(model, "tendon")
        return Relaxation(
            joints=chosen(joint_names(model), "position"),
            joint_forces=chosen(joint_names(model), "joint_force"),
            actuators=chosen(actuator_names(model), "force"),
            tendons=chosen(tendons, "tendon_length"),
            tendon_forces=chosen(tendons, "tendon_force"),
            controls=True,
            contacts=stated.clearance is not None and not stated.ignored,
        )


def _calibrated(
    system: System, control: Array, known: DesignTask | None = None
) -> tuple[System, Trajectory | None]:
    """The system with difference steps that suit the trajectory of a control, and the trajectory.

    A trajectory that diverges is None here; the step that needs it raises.

    Args:
        system: The system.
        control: (N, nu) control.
        known: A task on another plant. Its difference steps suit the same motion, also with longer
            timesteps or samples over the same horizon. None without one.
    """
    try:
        trajectory = system.plant.simulate(system.theta, control)
    except SimulationDivergedError:
        return system, None

    # Clamps and stops that do not act along the motion do not change it.
    factors = None if known is None else known.plant.step_factors
    reference = None if known is None else known.reference
    moves_alike = reference is not None and trajectory.moves_as(reference)
    is_rescaled = (
        known is not None
        and known.system.experiment.horizon == system.experiment.horizon
        and known.system.variant.differs_in_time_only(system.variant)
    )
    if factors is not None and (moves_alike or is_rescaled):
        return replace(system, plant=system.plant.with_step_factors(factors)), trajectory
    return system.calibrated_along(system.theta, trajectory), trajectory


def _require_bounded_controls(system: System, limits: tuple[Limit, ...], weight: Array) -> None:
    """Check that a weight or an enforced range bounds every control.

    Args:
        system: The system.
        limits: All limits.
        weight: (nu,) weights of the controls in the running cost.

    Raises:
        ExperimentError: Neither bounds a control.
    """
    enforced = system.experiment.limits.enforce
    bounded = {limit.name for limit in limits if limit.kind == "control"} if enforced else set()

    for name, value in zip(system.controls, weight.tolist(), strict=True):
        if value <= 0.0 and name not in bounded:
            raise ExperimentError(
                f"cost.control: actuator {name!r} has neither a weight nor a range; it needs a "
                f"weight > 0, or a hard limit: limits.control.{name} = [lower, upper]"
            )


def _tracking_weights(system: System) -> Array:
    """Weights on deviations from the initial trajectory.

    Args:
        system: The system.

    Returns:
        (nx,) diagonal of Q_tau; the weight of a joint holds for each of its degrees of freedom.

    Raises:
        ExperimentError: A table names an unknown joint.
    """
    cost, model = system.experiment.cost, system.model
    names = joint_names(model)
    widths = [joint_dofs(model, j) for j in range(model.njnt)]

    position = by_name("cost.tracking", cost.tracking, names, "joint")
    velocity = by_name("cost.tracking_velocity", cost.tracking_velocity, names, "joint")
    return np.concatenate(
        [np.repeat(position, widths), np.repeat(velocity, widths), np.zeros(model.na)]
    )


def _contrast(system: System) -> Array | None:
    """Combinations whose variances criterion "c" sums.

    Args:
        system: The system.

    Returns:
        (t, c) combinations of the scaled wanted parameters; None for other criteria.

    Raises:
        ExperimentError: A named parameter is not a wanted one, or no parameter is named.
    """
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
        raise ExperimentError(f"cost.subset: it names no parameter; valid: {listed(wanted)}")

    # One combination of all parameters, or each chosen parameter in the unit of its scale.
    if cost.combination:
        coefficients = [cost.combination.get(name, 0.0) for name in wanted]
        return np.asarray((np.array(coefficients) * scale)[:, None])
    return np.asarray(np.eye(len(wanted))[:, [wanted.index(name) for name in chosen]])

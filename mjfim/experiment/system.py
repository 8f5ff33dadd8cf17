"""An experiment resolved against its model: plant, start, initial control, outputs, cost. Every name is checked here."""

from __future__ import annotations

from dataclasses import replace
from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, ModelError, SimulationDivergedError, unknown
from mjfim.excitation.limits import limits_of
from mjfim.excitation.objective import DesignProblem, RunningCost
from mjfim.excitation.prior_information import information_of
from mjfim.excitation.robust import Pool
from mjfim.experiment.control_signal import generate
from mjfim.experiment.outputs import measurement_stride, resolve_outputs
from mjfim.experiment.parameters import resolve_parameters
from mjfim.experiment.schema import Experiment, by_name
from mjfim.experiment.system_tables import Signal
from mjfim.information.fisher import Information
from mjfim.model.coordinates import (
    control_names,
    joint_dofs,
    joint_names,
    measurable_columns,
    scalar_joints,
)
from mjfim.model.loading import compile_spec, decoration, load_spec
from mjfim.model.parameter_samples import sample_parameters
from mjfim.model.parameters import ParameterSet, moved_bodies
from mjfim.model.smooth_friction import has_dry_friction, smoothing_speeds_of
from mjfim.model.variants import STATED, Level, Lifted, Mocap, Source
from mjfim.plant.batch import state_space
from mjfim.plant.plant import Plant
from mjfim.plant.state_space import StateSpace
from mjfim.recordings.channels import Channels
from mjfim.recordings.control_table import read_control
from mjfim.records.trajectory import Trajectory

MAX_SAMPLES = 10_000_000
HOLDS = 4  # Gauss-Newton steps towards a control that holds a state; one does where forces are linear in it
HELD = (
    0.1  # [s] for which a control that holds a state has to keep it below the velocity of boundary
)
NO_ROTATION = 1e-6  # norm of a quaternion that says nothing


class Setup:
    """Everything an experiment needs to run. Building it checks all names, files and numbers.

    spec, model: the user's model, untouched by parameters;  plant: at any theta;  t: (N,) sample times [s]
    added: (p, p) information of other experiments, or None;  earlier: that and what the experiment's `earlier` files hold
    prior: (p, p) earlier information and that of the parameters' priors
    level: how the plant differs from the user's;  coarsen, stretch: its
    playback_steps: engine steps from one row of design.csv to the next
    """

    def __init__(
        self,
        experiment: Experiment,
        threads: int | None = None,
        added: Array | None = None,
        level: Level = STATED,
    ) -> None:
        self.experiment = experiment
        self.added = added
        self.level = level
        self.coarsen, self.stretch = level.coarsen, level.stretch
        try:
            self._build(threads, added)
        except ExperimentError as error:
            raise ExperimentError(f"{experiment.source}: {error}") from None

    def _build(self, threads: int | None, added: Array | None) -> None:
        e = self.experiment
        self.spec = load_spec(self.model_path)
        self.model = compile_spec(self.spec, self.model_path)
        if self.model.nu == 0:
            raise ModelError(
                f"{self.model_path}: the model has no actuator; a design needs at least one"
            )
        if self.model.nhistory or self.model.nplugin:
            what = "delays or interval sensors" if self.model.nhistory else "engine plugins"
            raise ModelError(
                f"{self.model_path}: {what} keep a state that mjfim does not see; take them out of the model"
            )
        self.coordinates = scalar_joints(self.model)
        self.controls = control_names(self.model)
        self.substeps = self._substeps()
        self.playback_steps = self._playback_steps()
        measured_every = measurement_stride(e)
        self.stride = measured_every if self.coarsen == 1 else 1
        self.samples = self._samples() // self.coarsen
        if self.stride > self.samples:
            raise ExperimentError(
                f"measure_rate: {e.measure_rate:g} Hz measures nothing within {e.horizon:g} s"
            )
        self.dt = self.substeps * float(self.model.opt.timestep) * self.coarsen
        if self.substeps % self.stretch:
            raise ValueError(
                f"{self.substeps} engine steps of a sample do not divide by {self.stretch}"
            )
        self.substeps //= self.stretch
        self.t = np.arange(self.samples, dtype=np.float64) * self.dt
        self.outputs, noise = resolve_outputs(
            e, self.model, state_space(self.model), measured_every
        )
        self.noise = noise if self.coarsen == 1 else noise.at_every_sample(measured_every)
        self._mocap = Mocap.of(self.model, self._keyframe())
        self.limits = limits_of(self.model, self.coordinates, self.controls, e.limits)
        self.parameters = ParameterSet.build(
            resolve_parameters(e, self.model, self.outputs.names),
            self.model,
            self.outputs.names,
            decoration(self.spec, self.model),
            self._mocap,
        )
        private = self._private(self.level.soft if self.level.softened else ())
        self._require_bodies(private)
        common: dict[str, Any] = {
            "parameters": self.parameters,
            "outputs": self.outputs,
            "nominal_initial_state": self._start(),
            "substeps": self.substeps,
            "threads": threads,
        }
        smooth = None
        if self.level.soft and not self.level.softened:
            smooth = Plant(source=self._private(self.level.soft), **common)
        self.plant = Plant(source=private, smooth=smooth, **common)
        self.tracking = self._weights()
        self.control_weight = by_name("cost.control", e.cost.control, self.controls, "actuator")
        bounded = (
            {limit.name for limit in self.limits if limit.kind == "control"}
            if e.limits.enforce
            else set()
        )
        for name, weight in zip(self.controls, self.control_weight.tolist(), strict=True):
            if weight <= 0.0 and name not in bounded:
                raise ExperimentError(
                    f"cost.control: actuator {name!r} has neither a weight nor a range; it needs a weight > 0, "
                    f"or a hard limit: limits.control.{name} = [lower, upper]"
                )
        self.control_about = self.rest
        if e.cost.control_about is not None:
            self.control_about = by_name(
                "cost.control_about", e.cost.control_about, self.controls, "actuator"
            )
        self.control = self._control()
        self.contrast = self._contrast()
        files = [e.directory / path for path in e.earlier]
        self.earlier = information_of(files, self.parameters.names)
        if added is not None:
            self.earlier = self.earlier + added
        self.prior = self.parameters.prior_information + self.earlier
        self.pool = self._pool()
        self._calibrate()

    @property
    def model_path(self) -> Path:
        """The MJCF file."""
        return self.experiment.directory / self.experiment.model

    @property
    def space(self) -> StateSpace:
        """Layout of the state."""
        return self.plant.space

    @property
    def theta(self) -> Array:
        """(p,) where the design is made."""
        return (
            self.parameters.true
            if self.experiment.cost.linearize_at == "true"
            else self.parameters.guess
        )

    @property
    def measure_rate(self) -> float:
        """[Hz]"""
        return 1.0 / (self.stride * self.dt)

    @property
    def units(self) -> tuple[str, ...]:
        """p units, empty where not stated."""
        return tuple(p.unit for p in self.parameters.parameters)

    @property
    def measurable(self) -> tuple[str, ...]:
        """Everything that a recording may hold column by column: state components and sensors."""
        return measurable_columns(self.model)

    @property
    def channels(self) -> Channels:
        """Signals that a log of this experiment can hold, and how to read them."""
        return Channels(
            model=self.model,
            controls=self.controls,
            outputs=self.outputs.names,
            sigma=self.noise.sigma,
            spec=self.experiment.recording,
            source=self.experiment.source,
        )

    def model_at(self, theta: Array, placed: bool = True) -> Any:
        """The user's model, everything on, with theta: (p,) written into it.

        placed: its mocap bodies where the keyframe has them, else where the MJCF has them
        """
        model = self.parameters.writer.model(self._whole, theta)
        if self._mocap is not None and not placed:
            self._mocap.put(model, self._mocap.compiled)
        return model

    @cached_property
    def _whole(self) -> Source:
        """The user's model, its moving bodies not compiled as 'simple'."""
        return self._source(sensors=True, friction=True, coarsen=1)

    @property
    def information(self) -> Information:
        """Fisher information of the measured samples and the criterion."""
        e, p = self.experiment, self.parameters
        return Information(
            self.noise,
            self.measure_rate,
            p.scale,
            self.prior
            * (
                self.measure_rate / (e.measure_rate or e.rate)
            ),  # the same per second on every level
            e.cost.criterion,
            e.cost.information,
            p.interest if len(p.interest) < len(p) else None,
            contrast=self.contrast,
            told=np.diag(p.prior_information),
        )

    @property
    def stated_times(self) -> Array:
        """(N * coarsen,) sample times of the experiment as stated [s]."""
        return np.arange(self.samples * self.coarsen, dtype=np.float64) * (self.dt / self.coarsen)

    @property
    def centre(self) -> Array:
        """(nu,) control about which controls swing: what holds the start where it is at rest, else the initial one's mean."""
        return (
            self.hold
            if self.experiment.boundary.start == "rest"
            else np.asarray(self.control.mean(axis=0))
        )

    @property
    def enforced(self) -> bool:
        """True where hard limits hold, or the design has to begin, end or move in a certain way."""
        e = self.experiment
        return self.shaped or (
            e.limits.enforce and (bool(self.limits) or e.limits.clearance is not None)
        )

    @property
    def shaped(self) -> bool:
        """True where the design has to begin, end or move in a certain way."""
        e = self.experiment
        return (
            e.boundary.start != "given"
            or e.boundary.end != "free"
            or e.limits.bandwidth is not None
        )

    @property
    def rest(self) -> Array:
        """(nu,) control of the initial keyframe, zero without one."""
        key = self._keyframe()
        return np.zeros(len(self.controls)) if key is None else np.array(key.ctrl)

    @cached_property
    def hold(self) -> Array:
        """(nu,) control that holds the start. Raises ExperimentError where none does."""
        return self._holding(
            self.plant.initial_state(self.theta), self.rest, "boundary.start", "the start"
        )

    @cached_property
    def target(self) -> Array:
        """(ns,) state at which the design ends, where it has to end somewhere."""
        key = self._key("boundary.keyframe", self.experiment.boundary.keyframe)
        start = self.plant.initial_state(self.theta)
        if self.experiment.boundary.end != "rest":
            return start
        qpos, _, act = self.space.split(
            start if key is None else np.concatenate([key.qpos, key.qvel, key.act])
        )
        return np.concatenate([qpos, np.zeros(self.space.nv), act])

    @cached_property
    def final_hold(self) -> Array:
        """(nu,) control that holds the state at which the design comes to rest. Raises ExperimentError where none does."""
        key = self._key("boundary.keyframe", self.experiment.boundary.keyframe)
        rest = self.rest if key is None else np.array(key.ctrl)
        return self._holding(self.target, rest, "boundary.end", "the end")

    def _holding(self, state: Array, guess: Array, key: str, where: str) -> Array:
        """Control that leaves a state as it is, to the experiment's tolerance; Gauss-Newton on a sample, from a guess."""
        plant, control = self.plant, np.array(guess)
        size = np.maximum(np.abs(control), 1.0)

        def drift(controls: Array) -> Array:
            held = np.broadcast_to(state, (len(controls), len(state)))
            return self.space.minus(
                plant.simulator.step([plant.model(self.theta)], held, controls).states, state
            )

        for _ in range(HOLDS):
            moves = np.concatenate([np.zeros((1, len(control))), 1e-4 * np.diag(size)])
            rows = drift(control + moves)
            B = (rows[1:] - rows[0]).T / (1e-4 * size)
            control = control - np.linalg.lstsq(B, rows[0])[0]
        left = drift(control[None])[0]
        nv = self.space.nv
        pushed, speed = np.abs(left[nv : 2 * nv]) / self.dt, np.abs(self.space.split(state)[1])
        worst = int(np.argmax(speed if speed.any() else pushed))
        if not pushed[worst] * HELD <= self.experiment.boundary.velocity or speed.any():
            name = joint_names(self.model)[int(self.model.dof_jntid[worst])]
            does = f"still accelerates by {pushed[worst]:.3g} per s²"
            if speed.any():
                does = f"moves at {speed[worst]:.3g} per s"
            raise ExperimentError(
                f"{key}: no control holds {where}: joint {name!r} {does}; begin and end "
                'where the model can stand still (qvel = 0, an equilibrium), or state start = "given", end = "free"'
            )
        return control

    @cached_property
    def initial(self) -> Trajectory:
        """Trajectory of the initial control at theta: the start, and x_d of the tracking term."""
        return self.plant.simulate(self.theta, self.control)

    @cached_property
    def problem(self) -> DesignProblem:
        """The cost as Algorithm 1 wants it."""
        running = RunningCost(
            self.space,
            self.dt,
            self.initial.state,
            self.tracking,
            self.control_weight,
            self.control_about,
        )
        return DesignProblem(self.plant, self.theta, self.information, running, pool=self.pool)

    def _substeps(self) -> int:
        timestep, rate = float(self.model.opt.timestep), self.experiment.rate
        ratio = 1.0 / (rate * timestep)
        n = round(ratio)
        if n < 1 or abs(ratio - n) > 1e-6 * n:
            valid = ", ".join(f"{1.0 / (k * timestep):g}" for k in (1, 2, 4, 5, 10))
            raise ExperimentError(
                f"rate: {rate:g} Hz is not an integer number of timesteps ({timestep:g} s) per sample; "
                f"valid for example: {valid} Hz"
            )
        return n

    def _playback_steps(self) -> int:
        """Raises ExperimentError where the controller's rate fits neither samples nor timesteps."""
        rate, wanted = self.experiment.rate, self.experiment.playback_rate
        if wanted is None:
            return self.substeps
        valid = [k for k in range(1, self.substeps + 1) if self.substeps % k == 0]
        rows = round(wanted / rate)
        if rows not in valid or abs(wanted / rate - rows) > 1e-6 * rows:
            listed = ", ".join(f"{k * rate:g}" for k in valid)
            raise ExperimentError(
                f"playback_rate: {wanted:g} Hz is not a multiple of rate ({rate:g} Hz) that divides the engine's rate "
                f"({self.substeps * rate:g} Hz); valid: {listed}"
            )
        return self.substeps // rows

    def _samples(self) -> int:
        exact = self.experiment.horizon * self.experiment.rate
        N = round(exact)
        if N < 2 or abs(exact - N) > 1e-6 * N:
            period = 1.0 / self.experiment.rate
            near = f"{max(N, 2) * period:g} s, {(max(N, 2) + 1) * period:g} s"
            raise ExperimentError(
                f"horizon: {self.experiment.horizon:g} s is not a whole number (>= 2) of samples of {period:g} s; "
                f"valid for example: {near}"
            )
        if N > MAX_SAMPLES:
            raise ExperimentError(f"horizon: {N:g} samples are too many; at most {MAX_SAMPLES:g}")
        return N

    def _source(
        self, sensors: bool, friction: bool, coarsen: int, lifted: Lifted | None = None
    ) -> Source:
        moved = (
            None
            if self.parameters.needs_compile.any()
            else moved_bodies(self.parameters.parameters)
        )
        return Source(
            self.spec, self.model_path, moved, sensors, friction, coarsen, self._mocap, lifted
        )

    def _private(self, soft: tuple[float, ...]) -> Source:
        """Of a plant with dry friction viscous below some speeds, empty: as it is."""
        friction = any(
            "frictionloss" in t.path for p in self.parameters.parameters for t in p.targets
        )
        anything = friction or any(p.function is not None for p in self.parameters.parameters)
        return self._source(
            self.outputs.needs_sensors, anything, self.coarsen * self.stretch, self._lifted(soft)
        )

    def _lifted(self, soft: tuple[float, ...]) -> Lifted | None:
        """What this level is without: whatever the limits of the experiment keep a design away from."""
        if not (self.level.lifted and self.experiment.limits.enforce):
            return Lifted(soft=soft) if soft else None
        named = {
            kind: {limit.name for limit in self.limits if limit.kind == kind}
            for kind in ("position", "joint_force")
        }
        forced = {limit.index for limit in self.limits if limit.kind == "force"}
        stated = self.experiment.limits
        return Lifted(
            tuple(c.joint for c in self.coordinates if c.name in named["position"]),
            tuple(c.joint for c in self.coordinates if c.name in named["joint_force"]),
            tuple(
                i
                for i in range(self.model.nactuator)
                if int(self.model.actuator_outadr[i]) in forced
            ),
            True,
            stated.clearance is not None and not stated.ignored,
            soft,
        )

    def _require_bodies(self, source: Source) -> None:
        """Raise where the guess or the true values make a body that cannot exist."""
        p = self.parameters
        for key, theta in (("guess", p.guess), ("true", p.true)):
            for columns, fault in p.writer.unphysical_bodies(source, theta):
                makers = dict.fromkeys(
                    p.parameters[j].group or f"{p.parameters[j].name}.{key}" for j in columns
                )
                raise ExperimentError(f"{', '.join(f'parameters.{m}' for m in makers)}: {fault}")

    def impossible(self, theta: Array) -> list[int]:
        """Indices of the parameters that make bodies which cannot exist at theta: (p,)."""
        try:
            return sorted(
                {
                    j
                    for columns, _ in self.parameters.writer.unphysical_bodies(
                        self.plant.source, theta
                    )
                    for j in columns
                }
            )
        except ModelError:
            return np.flatnonzero(self.parameters.needs_compile).tolist()

    def _keyframe(self) -> Any:
        """The initial keyframe, or None."""
        return self._key("initial.keyframe", self.experiment.initial.keyframe)

    def _key(self, where: str, name: str | None) -> Any:
        """A keyframe, or None without a name. Raises ExperimentError where there is none of that name."""
        model = self.model
        if name is None:
            return None
        names = [
            mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_KEY, i) or "" for i in range(model.nkey)
        ]
        if name not in names:
            raise ExperimentError(f"{where}: {unknown('keyframe', name, [n for n in names if n])}")
        return model.key(name)

    def _start(self) -> Array:
        initial, model, key = self.experiment.initial, self.model, self._keyframe()
        qpos, qvel, act = np.array(model.qpos0), np.zeros(model.nv), np.zeros(model.na)
        if key is not None:
            qpos, qvel, act = np.array(key.qpos), np.array(key.qvel), np.array(key.act)
        for key_name, given, default in (
            ("qpos", initial.qpos, qpos),
            ("qvel", initial.qvel, qvel),
            ("act", initial.act, act),
        ):
            if given is not None:
                if len(given) != len(default):
                    raise ExperimentError(
                        f"initial.{key_name}: {len(given)} numbers, the model has {len(default)}"
                    )
                default[:] = given
        for j, name in enumerate(joint_names(model)):
            q = int(model.jnt_qposadr[j]) + (
                3 if int(model.jnt_type[j]) == int(mujoco.mjtJoint.mjJNT_FREE) else 0
            )
            if joint_dofs(model, j) > 1 and not np.linalg.norm(qpos[q : q + 4]) > NO_ROTATION:
                raise ExperimentError(
                    f"initial.qpos: the quaternion of joint {name!r} (numbers {q} to {q + 3}) is zero; no rotation is 1, 0, 0, 0"
                )
        mujoco.mj_normalizeQuat(model, qpos)
        return np.concatenate([qpos, qvel, act])

    def _weights(self) -> Array:
        """(nx,) diagonal of Q_tau: a joint's weight holds for each of its degrees of freedom."""
        cost, names = self.experiment.cost, joint_names(self.model)
        widths = [joint_dofs(self.model, j) for j in range(self.model.njnt)]
        position = np.repeat(by_name("cost.tracking", cost.tracking, names, "joint"), widths)
        velocity = np.repeat(
            by_name("cost.tracking_velocity", cost.tracking_velocity, names, "joint"), widths
        )
        return np.concatenate([position, velocity, np.zeros(self.model.na)])

    def _contrast(self) -> Array | None:
        """(t, c) combinations of the scaled wanted parameters whose variance criterion "c" sums."""
        cost, p = self.experiment.cost, self.parameters
        if cost.criterion != "c":
            return None
        wanted = tuple(p.names[j] for j in p.interest)
        scale = p.scale[p.interest]
        key, chosen = (
            ("combination", cost.combination) if cost.combination else ("subset", cost.subset or ())
        )
        for name in chosen:
            if name not in wanted:
                raise ExperimentError(f"cost.{key}: {unknown('wanted parameter', name, wanted)}")
        if cost.combination:
            return np.asarray(
                [[cost.combination.get(n, 0.0) * s] for n, s in zip(wanted, scale, strict=True)]
            )
        if not chosen:
            raise ExperimentError(f"cost.subset: it is empty; valid: {', '.join(wanted)}")
        return np.asarray(np.eye(len(wanted))[:, [wanted.index(name) for name in chosen]])

    def _pool(self) -> Pool | None:
        robust = self.experiment.robust
        if robust is None:
            return None
        if self.experiment.descent.psi_weight:
            raise ExperimentError(
                "robust: descent.psi_weight belongs to a design at one parameter value"
            )
        thetas = sample_parameters(
            self.parameters, self.theta, robust.samples, robust.seed, self.impossible
        )
        return Pool(thetas, robust.over, self.experiment.cost.criterion == "D")

    def _calibrate(self) -> None:
        try:
            self.plant = self.plant.calibrated(self.theta, self.initial)
        except SimulationDivergedError:
            return  # whoever needs the initial trajectory will say so

    def _control(self) -> Array:
        source = self.experiment.initial.control
        t, dt = self.stated_times, self.dt / self.coarsen
        if isinstance(source, Signal):
            return self.averaged(generate(source, t, self.controls, self.rest))
        return self.averaged(read_control(self.experiment.directory / source, t, dt, self.controls))

    def averaged(self, control: Array) -> Array:
        """(N, nu) on this setup's grid from (N * coarsen, nu) on the stated one."""
        return np.asarray(control.reshape(self.samples, self.coarsen, -1).mean(axis=1))

    def coarser(self, factor: int) -> Setup:
        """The same experiment at a timestep and sample period that are `factor` times longer."""
        return self._at(coarsen=factor)

    def free(self) -> Setup:
        """The same experiment on a plant without the clamps and stops that hard limits keep a design away from."""
        return self._at(lifted=True, soft=self._slow())

    def stretched(self, factor: int) -> Setup:
        """The same experiment at a timestep that is `factor` times longer, its samples as they are."""
        return self._at(stretch=factor)

    def softened(self) -> Setup:
        """The same experiment with dry friction viscous at low speeds, where this one takes derivatives so."""
        return self._at(softened=True)

    def _slow(self) -> tuple[float, ...]:
        """Speeds at which dry friction turns viscous for derivatives; empty where there is none."""
        model = self.model_at(self.theta)
        if not has_dry_friction(model):
            return ()
        fastest = np.abs(self.initial.qvel).max(axis=0)
        for limit in self.limits:
            if limit.kind == "velocity":
                fastest[limit.index] = limit.scale
        return smoothing_speeds_of(model, fastest)

    def _at(self, **changes: Any) -> Setup:
        return Setup(
            self.experiment,
            self.plant.simulator.threads,
            self.added,
            replace(self.level, **changes),
        )

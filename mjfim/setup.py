"""An experiment resolved against its model: plant, start, initial control, outputs, cost. Every name is checked here."""

from __future__ import annotations

from functools import cached_property
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.errors import ExperimentError, ModelError, unknown
from mjfim.experiment import Experiment, Signal, by_name
from mjfim.fisher import Information
from mjfim.limits import limits_of
from mjfim.models import compile_spec, control_names, coordinates, load_spec, private_model
from mjfim.objective import DesignProblem, RunningCost
from mjfim.outputs import Output, OutputMap
from mjfim.parameters import Parameter, ParameterSet, Target, moved_bodies, names_of, resolve, unit_of
from mjfim.plant import Plant
from mjfim.signals import generate, read_control
from mjfim.tangent import StateSpace
from mjfim.trajectory import Array, Trajectory

MAX_SAMPLES = 10_000_000


class Setup:
    """Everything an experiment needs to run. Building it checks all names, files and numbers.

    spec, model: the user's model, untouched by parameters;  plant: at any theta;  t: (N,) sample times [s]
    coarsen: 1, or how many times longer timestep and sample period are than stated (coarse-to-fine descent)
    """

    def __init__(self, experiment: Experiment, threads: int | None = None, coarsen: int = 1) -> None:
        self.experiment = experiment
        self.coarsen = coarsen
        try:
            self._build(threads)
        except ExperimentError as error:
            raise ExperimentError(f"{experiment.source}: {error}") from None

    def _build(self, threads: int | None) -> None:
        e = self.experiment
        self.spec = load_spec(self.model_path)
        self.model = compile_spec(self.spec, self.model_path)
        if self.model.nu == 0:
            raise ModelError(f"{self.model_path}: the model has no actuator; a design needs at least one")
        if self.model.nhistory or self.model.nplugin:
            what = "delays or interval sensors" if self.model.nhistory else "engine plugins"
            raise ModelError(
                f"{self.model_path}: {what} keep a state that mjfim does not see; take them out of the model"
            )
        self.coordinates = coordinates(self.model)
        self.controls = control_names(self.model)
        self.substeps = self._substeps()
        self.stride = self._stride() if self.coarsen == 1 else 1
        self.samples = self._samples() // self.coarsen
        if self.stride > self.samples:
            raise ExperimentError(f"measure_rate: {e.measure_rate:g} Hz measures nothing within {e.horizon:g} s")
        self.dt = self.substeps * float(self.model.opt.timestep) * self.coarsen
        self.t = np.arange(self.samples, dtype=np.float64) * self.dt
        self.parameters = ParameterSet.build(self._parameters(), self.model)
        self.outputs = self._outputs()
        self.start = self._start()
        self.plant = Plant(self._private(), self.parameters, self.outputs, self.start, self.substeps, threads)
        self.tracking = self._weights()
        self.control_weight = by_name("cost.control", e.cost.control, self.controls, "actuator")
        if np.any(self.control_weight <= 0):
            missing = self.controls[int(np.argmin(self.control_weight))]
            raise ExperimentError(f"cost.control: actuator {missing!r} has no weight; every actuator needs one > 0")
        self.control = self._control()
        self.limits = limits_of(self.model, self.coordinates, self.controls, e.limits)

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
        return self.parameters.true if self.experiment.cost.linearize_at == "true" else self.parameters.guess

    @property
    def measure_rate(self) -> float:
        """[Hz]"""
        return 1.0 / (self.stride * self.dt)

    @property
    def units(self) -> tuple[str, ...]:
        """p units, empty where not stated."""
        return tuple(p.unit for p in self.parameters.parameters)

    def model_at(self, theta: Array) -> Any:
        """The user's model, everything on, with theta: (p,) written into it."""
        return self.parameters.model(self._whole, theta)

    @cached_property
    def _whole(self) -> Any:
        """The user's model, its moving bodies not compiled as 'simple'."""
        return private_model(self.spec, self.model_path, moved_bodies(self.parameters.parameters), True, True)

    @property
    def information(self) -> Information:
        """Fisher information of the measured samples and the criterion."""
        e, p = self.experiment, self.parameters
        return Information(
            self.outputs.sigma,
            self.stride,
            self.measure_rate,
            p.scale,
            p.prior_information
            * (self.measure_rate / (e.measure_rate or e.rate)),  # the same per second on every level
            e.cost.criterion,
            e.cost.information,
        )

    @cached_property
    def initial(self) -> Trajectory:
        """Trajectory of the initial control at theta: the start, and x_d of the tracking term."""
        return self.plant.simulate(self.theta, self.control)

    @cached_property
    def problem(self) -> DesignProblem:
        """The cost as Algorithm 1 wants it."""
        running = RunningCost(self.space, self.dt, self.initial.state, self.tracking, self.control_weight)
        return DesignProblem(self.plant, self.theta, self.information, running)

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

    def _stride(self) -> int:
        e = self.experiment
        ratio = e.rate / (e.measure_rate or e.rate)
        stride = round(ratio)
        if stride < 1 or abs(ratio - stride) > 1e-6 * stride:
            valid = ", ".join(f"{e.rate / k:g}" for k in (1, 2, 4, 5, 10))
            raise ExperimentError(
                f"measure_rate: {e.measure_rate:g} Hz does not divide rate {e.rate:g} Hz; valid: {valid}"
            )
        return stride

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

    def _parameters(self) -> list[Parameter]:
        built = []
        for name, p in self.experiment.parameters.items():
            targets = tuple(Target(t.path, t.scale, t.offset) for t in p.all_targets)
            guess = self._nominal(name, targets[0]) if p.guess is None else p.guess
            bounds = p.bounds or (-np.inf, np.inf)
            if not bounds[0] <= guess <= bounds[1]:
                raise ExperimentError(
                    f"parameters.{name}.guess: the model's own value {guess:g} is outside bounds {list(bounds)}"
                )
            scale = abs(guess) if p.scale == "guess" else p.scale
            if scale == 0.0:
                raise ExperimentError(f"parameters.{name}.scale: the guess is 0, state a scale in the parameter's unit")
            unit = p.unit or (unit_of(self.model, targets[0].path) if targets[0].scale == 1.0 else "")
            built.append(Parameter(name, targets, guess, p.true, bounds, scale, p.prior, unit))
        return built

    def _nominal(self, name: str, target: Target) -> float:
        try:
            value = resolve(self.model, target.path).read(self.model)
        except ExperimentError as error:
            raise ExperimentError(f"parameters.{name}: {error}") from None
        return (value - target.offset) / target.scale

    def _private(self) -> Any:
        parameters = self.parameters.parameters
        friction = any("frictionloss" in t.path for p in parameters for t in p.targets)
        moved, sensors = moved_bodies(parameters), self.outputs.needs_sensors
        model = private_model(self.spec, self.model_path, moved, sensors, friction)
        model.opt.timestep *= self.coarsen
        return model

    def _outputs(self) -> OutputMap:
        names = names_of(self.model, "sensor")
        width = {n: int(self.model.sensor(n).dim[0]) for n in names}
        valid = ["state", *self.measurable]
        stated = dict(self.experiment.noise)
        for key in stated:
            if key not in valid:
                raise ExperimentError(f"noise: {unknown('sensor', key, valid)}")
        if not stated:
            stated = {n: float(self.model.sensor(n).noise[0]) for n in names if self.model.sensor(n).noise[0] > 0}
            if not stated:
                raise ExperimentError(
                    "noise: nothing is measured: give `state`, or sensors by name, or `noise` in the MJCF; valid: "
                    + ", ".join(valid)
                )
        everything = stated.pop("state", None)
        components = self._state_outputs()
        chosen: list[Output] = []
        for name, (index, unit) in components.items():
            sigma = stated.get(name, everything)
            if sigma is not None:
                chosen.append(Output(name, float(sigma), unit, state=index))
        for name in names:
            if name in stated:
                adr = int(self.model.sensor(name).adr[0])
                for i in range(width[name]):
                    label = name if width[name] == 1 else f"{name}[{i}]"
                    chosen.append(Output(label, float(stated[name]), sensor=adr + i))
        if not chosen:
            raise ExperimentError("noise.state: the model has no scalar joint to measure; name sensors instead")
        addresses = {c.v: c.q for c in self.coordinates}
        nv, nq = self.model.nv, self.model.nq
        addresses.update({nv + c.v: nq + c.v for c in self.coordinates})
        return OutputMap.build(chosen, addresses)

    @property
    def measurable(self) -> tuple[str, ...]:
        """Everything that `noise` may name one by one: state components and sensors."""
        return (*self._state_outputs(), *names_of(self.model, "sensor"))

    def _state_outputs(self) -> dict[str, tuple[int, str]]:
        nv = self.model.nv
        positions = {f"qpos:{c.name}": (c.v, c.unit) for c in self.coordinates}
        return positions | {f"qvel:{c.name}": (nv + c.v, f"{c.unit}/s") for c in self.coordinates}

    def _start(self) -> Array:
        initial, model = self.experiment.initial, self.model
        qpos, qvel, act = np.array(model.qpos0), np.zeros(model.nv), np.zeros(model.na)
        if initial.keyframe is not None:
            names = [mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_KEY, i) or "" for i in range(model.nkey)]
            if initial.keyframe not in names:
                raise ExperimentError(
                    f"initial.keyframe: {unknown('keyframe', initial.keyframe, [n for n in names if n])}"
                )
            key = model.key(initial.keyframe)
            qpos, qvel, act = np.array(key.qpos), np.array(key.qvel), np.array(key.act)
        for key_name, given, default in (
            ("qpos", initial.qpos, qpos),
            ("qvel", initial.qvel, qvel),
            ("act", initial.act, act),
        ):
            if given is not None:
                if len(given) != len(default):
                    raise ExperimentError(f"initial.{key_name}: {len(given)} numbers, the model has {len(default)}")
                default[:] = given
        return np.concatenate([qpos, qvel, act])

    def _weights(self) -> Array:
        cost, names = self.experiment.cost, tuple(c.name for c in self.coordinates)
        dofs = np.array([c.v for c in self.coordinates], dtype=np.intp)
        Q, nv = np.zeros(self.space.nx), self.model.nv
        Q[dofs] = by_name("cost.tracking", cost.tracking, names, "joint")
        Q[nv + dofs] = by_name("cost.tracking_velocity", cost.tracking_velocity, names, "joint")
        return Q

    def _control(self) -> Array:
        source = self.experiment.initial.control
        dt = self.dt / self.coarsen
        t = np.arange(self.samples * self.coarsen, dtype=np.float64) * dt
        if isinstance(source, Signal):
            return self.averaged(generate(source, t, self.controls))
        return self.averaged(read_control(self.experiment.directory / source, t, dt, self.controls))

    def averaged(self, control: Array) -> Array:
        """(N, nu) on this setup's grid from (N * coarsen, nu) on the stated one."""
        return np.asarray(control.reshape(self.samples, self.coarsen, -1).mean(axis=1))

    def coarser(self, factor: int) -> Setup:
        """The same experiment at a timestep and sample period that are `factor` times longer."""
        return Setup(self.experiment, self.plant.engine.threads, factor)

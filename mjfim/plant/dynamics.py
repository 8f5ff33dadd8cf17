"""The plant in discrete time: `x_{k+1} = F(x_k, u_k, theta)` and `y_k = h(x_k, u_k, theta)`.

Differences of states are vectors of the tangent space, along which states are moved (`StateSpace`).
"""

from __future__ import annotations

import copy
import math
from collections import OrderedDict
from dataclasses import replace
from typing import Any, Self

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ModelError, SimulationDivergedError
from mjfim.model.control_laws import ControlLaws
from mjfim.model.loading import silence_mujoco_log
from mjfim.model.parameter_writer import ParameterWriter
from mjfim.model.parameters import ParameterSet
from mjfim.model.variants import PlantModel
from mjfim.optimize.lq import TangentCurve
from mjfim.plant.batch import MAX_CONTROL, BatchSimulator, SubstepObservations, state_space
from mjfim.plant.closed_form import ClosedFormMemory
from mjfim.plant.closed_loop import ClosedLoopSimulator, input_sizes
from mjfim.plant.outputs import Calibration, OutputDelay, Outputs
from mjfim.plant.state_space import StateSizes
from mjfim.records.trajectory import Trajectory

# Why a simulation with control laws diverges, as a clause of a message.
UNSTABLE_LOOP = (
    "the loop of the model and the control laws is unstable; smaller gains, a smaller latency or "
    "other signs may help"
)

# Largest number of compiled models at single parameter values that a plant keeps.
MAX_CACHED_MODELS = 64

# Copies that are kept besides those of the largest call. They take the values that differ from call
# to call, such as those along a direction.
SPARE_COPIES = 8

# Names of MuJoCo's warnings about numbers that are not finite or huge.
WARNINGS = ("BADQPOS", "BADQVEL", "BADQACC")

# Numbers by which the timestep is divided to find one with which the simulation does not diverge.
DIVISORS = (2, 4, 8, 16, 32)

# Advice where MuJoCo gives no warning or no smaller timestep helps.
NO_WARNING = "a smaller amplitude or timestep may help"

# Largest number of engine steps that one of these simulations takes.
MAX_STEPS = 200_000


class Dynamics:
    """A model, its parameters and its measured outputs as discrete-time dynamics.

    Attributes:
        source: PlantModel of the private model copies that are stepped.
        parameters: The p parameters theta.
        outputs: Output map h without errors and delay.
        simulator: Steps the model copies.
        sizes: Natural sizes of states and controls.
        space: Layout of the state and of its tangent space.
        nominal_initial_state: (ns,) initial state where no parameter moves it.
        initial_state_derivative: (nx, p) derivative of the initial state by theta [x-unit /
            theta-unit].
        calibration: Scale errors and biases of the outputs as functions of theta.
        laws: Control laws that compute controls from the inputs; None where the inputs are the
            controls. A state does not show what laws remember, so that plants with laws have
            derivatives of whole rollouts only.
        nu: Number of controls, or with laws of inputs.
        dt: Sample period [s].
        closed_form_memory: What derivatives in closed form keep from call to call.
    """

    def __init__(
        self,
        *,
        source: PlantModel,
        parameters: ParameterSet,
        outputs: Outputs,
        nominal_initial_state: Array,
        substeps: int,
        threads: int | None = None,
        smooth: Dynamics | None = None,
        laws: ControlLaws | None = None,
    ) -> None:
        """Build the plant.

        Args:
            source: PlantModel of the private model copies that are stepped.
            parameters: The parameters theta.
            outputs: The measured outputs.
            nominal_initial_state: (ns,) initial state where no parameter moves it.
            substeps: `mj_step` calls per sample.
            threads: Threads of the simulator; None takes all cores.
            smooth: Plant on which mixed second differences are taken, if the derivatives of this
                one jump; None for this one.
            laws: Control laws, whose numbers the model holds; None without any.
        """
        self.source = source
        self.parameters = parameters
        self.outputs = outputs
        self.laws = laws
        stepped: dict[str, Any] = {
            "substeps": substeps,
            "sensors": outputs.needs_sensors,
            "threads": threads,
        }
        self.simulator = (
            BatchSimulator(source.model, **stepped)
            if laws is None
            else ClosedLoopSimulator(source.model, laws, **stepped)
        )
        self.space = self.simulator.space
        # (nx,) 0 for coordinates that contacts hold, else 1. Differences along them would be those
        # of impacts. The rest of the state determines them within some engine steps.
        self.moves_freely = np.ones(self.space.nx)
        for joint in source.source.held_joints:
            dof = int(source.model.joint(joint).dofadr[0])
            self.moves_freely[[dof, self.space.nv + dof]] = 0.0
        self.nominal_initial_state = np.array(nominal_initial_state, dtype=np.float64)
        self.initial_state_derivative = parameters.initial_state_derivative(self.space.nx)
        self.calibration = Calibration(
            scale=parameters.scale_derivative(len(outputs)),
            bias=parameters.bias_derivative(len(outputs)),
        )
        self.nu = source.model.nu if laws is None else len(laws.inputs)
        self.dt = substeps * source.model.opt.timestep
        self.sizes = StateSizes.of(source.model, self.space, self.dt)
        if laws is not None:
            self.sizes = replace(self.sizes, control=input_sizes(laws, self.sizes))

        self._step_factors: Array | None = None
        self._smooth = smooth
        self._cached_models: dict[bytes, Any] = {}
        self._written_models = WrittenModels(source, parameters)
        self.closed_form_memory = ClosedFormMemory(self.simulator, parameters)

    @property
    def smooth(self) -> Dynamics:
        """The plant on which mixed second differences are taken.

        It is this plant, or one with smooth derivatives where those of this plant jump.
        """
        return self if self._smooth is None else self._smooth

    @property
    def engine_steps(self) -> int:
        """MuJoCo steps taken so far, those of the smooth plant included."""
        steps = self.simulator.steps
        if self._smooth is not None:
            steps += self._smooth.simulator.steps
        return steps

    @property
    def step_factors(self) -> Array | None:
        """(p,) factors of the parameters' difference steps; None before a calibration."""
        return self._step_factors

    def with_step_factors(self, factors: Array | None) -> Self:
        """A plant with the difference steps of a calibration; simulator and models are shared.

        Args:
            factors: (p,) factors of at least 1, or None for the steps without a calibration.
        """
        other = copy.copy(self)
        other._step_factors = factors
        return other

    def with_substeps(self, substeps: int) -> Self:
        """A plant with samples of another length; models and counted engine steps are shared.

        Args:
            substeps: `mj_step` calls per sample.

        Returns:
            The plant, whose difference steps are those of this one.
        """
        other = copy.copy(self)
        other.simulator = self.simulator.with_substeps(substeps)
        other.dt = substeps * self.source.model.opt.timestep
        if self._smooth is not None:
            other._smooth = self._smooth.with_substeps(substeps)
        return other

    def with_initial_state(self, state: Array) -> Self:
        """A plant with another nominal initial state; simulator and models are shared.

        Args:
            state: (ns,) initial state where no parameter moves it.
        """
        other = copy.copy(self)
        other.nominal_initial_state = np.array(state, dtype=np.float64)
        return other

    def initial_state(self, theta: Array) -> Array:
        """Initial states at parameter values.

        Args:
            theta: (..., p) parameters [theta-unit].

        Returns:
            (..., ns) initial states.
        """
        moves = np.asarray(theta) @ self.initial_state_derivative.T
        return self.space.plus(self.nominal_initial_state, moves)

    def output_delay(self, theta: Array, samples: int) -> OutputDelay | None:
        """Time delay of the outputs at theta as an operator on samples.

        Args:
            theta: (p,) parameters [theta-unit].
            samples: N+1 samples on which it acts.

        Returns:
            The operator, or None if no parameter is a delay.
        """
        if not self.parameters.delay_derivative.any():
            return None
        delay = float(self.parameters.delay_derivative @ theta)
        return OutputDelay.on_grid(samples, delay, self.dt)

    def model(self, theta: Array) -> Any:
        """Compiled model at one parameter value, kept for later calls.

        Args:
            theta: (p,) parameters [theta-unit].

        Returns:
            The model, which callers do not change.
        """
        key = np.asarray(theta, dtype=np.float64).tobytes()
        if key not in self._cached_models:
            if len(self._cached_models) > MAX_CACHED_MODELS:
                self._cached_models.clear()
            self._cached_models[key] = ParameterWriter(self.parameters).model(
                self.source, np.asarray(theta)
            )
        return self._cached_models[key]

    def models(self, theta: Array) -> list[Any]:
        """Models at many parameter values.

        A later call may overwrite the models.

        Args:
            theta: (m, p) parameters [theta-unit].

        Returns:
            m models.

        Raises:
            SimulationDivergedError: MuJoCo cannot compile one of them.
        """
        models, compiled = self.try_models(theta)
        if not compiled.all():
            raise SimulationDivergedError(
                "MuJoCo cannot compile the model when the parameters move a little"
            )
        return models

    def try_models(self, theta: Array) -> tuple[list[Any], np.ndarray]:
        """Models at many parameter values, of which some may be impossible to compile.

        A later call may overwrite the models.

        Args:
            theta: (m, p) parameters [theta-unit].

        Returns:
            m models, and (m,) True where the model could be compiled; elsewhere it is the nominal
            model.
        """
        compiled = np.ones(len(theta), dtype=bool)
        if not self.parameters.needs_compile.any():
            # The values are written into copies, which are kept: a design asks for the same values
            # at every iterate.
            return self._written_models.at(theta), compiled

        models = []
        for i, row in enumerate(theta):
            try:
                models.append(ParameterWriter(self.parameters).model(self.source, row))
            except ModelError:
                models.append(self.source.model)
                compiled[i] = False
        return models, compiled

    @property
    def tick_samples(self) -> int:
        """Samples after which the evaluations of all control laws repeat; 1 without laws."""
        if self.laws is None:
            return 1
        substeps = self.simulator.substeps
        return math.lcm(self.laws.period, substeps) // substeps

    def lead(self, theta: Array) -> int:
        """Number of samples before a curve whose inputs still have an effect on it.

        Args:
            theta: (p,) parameters [theta-unit].

        Returns:
            The number; 0 without control laws.
        """
        simulator = self.simulator
        if not isinstance(simulator, ClosedLoopSimulator):
            return 0
        return simulator.lead([self.model(theta)])

    def trajectory(self, states: Array, ctrl: Array) -> Trajectory:
        """Record of a simulated curve.

        Args:
            states: (N+1, ns) states.
            ctrl: (N, nu) controls; of the inputs of control laws, the columns of the log are kept.

        Returns:
            The trajectory; its time begins at zero.
        """
        qpos, qvel, act = self.space.split(states)
        t = np.arange(len(states), dtype=np.float64) * self.dt
        return Trajectory(t=t, qpos=qpos, qvel=qvel, act=act, ctrl=ctrl[:, : self.nu])

    def difference(self, new: Trajectory, old: Trajectory) -> TangentCurve:
        """Tangent curve (x_new - x_old, u_new - u_old) from one trajectory to another."""
        return TangentCurve(z=self.space.minus(new.state, old.state), v=new.ctrl - old.ctrl)

    def simulate(self, theta: Array, ctrl: Array) -> Trajectory:
        """Open-loop trajectory from the initial state.

        Args:
            theta: (p,) parameters [theta-unit].
            ctrl: (N, nu) controls, each held over its sample.

        Returns:
            The trajectory.

        Raises:
            SimulationDivergedError: The simulation diverges.
        """
        out = self.simulator.rollout(
            [self.model(theta)], self.initial_state(theta)[None], np.asarray(ctrl)[None]
        )
        if not out.finite[0]:
            raise SimulationDivergedError(
                f"the simulation diverges under this control: {self.why_diverged(theta, ctrl)}"
            )
        return self.trajectory(out.states[0], ctrl)

    def applied(self, theta: Array, trajectory: Trajectory) -> tuple[Trajectory, np.ndarray]:
        """The trajectory of control laws with the controls that they apply in place of inputs.

        Args:
            theta: (p,) parameters [theta-unit].
            trajectory: A trajectory from the begin of a recording, under inputs of the laws.

        Returns:
            The trajectory with (N, nu) controls at the begin of each sample, and (N, laws) True
            where the limits of a law have clipped its control.
        """
        out = self.simulator.rollout(
            [self.model(theta)], trajectory.state[:1], trajectory.ctrl[None]
        )
        if out.controls is None or out.is_clipped is None:
            return trajectory, np.zeros((len(trajectory.ctrl), 0), dtype=bool)
        return replace(trajectory, ctrl=out.controls[0]), out.is_clipped[0]

    def why_diverged(self, theta: Array, ctrl: Array) -> str:
        """Explain why an open-loop simulation from the initial state diverges.

        Args:
            theta: (p,) parameters [theta-unit].
            ctrl: (N, nu) controls.

        Returns:
            MuJoCo's warning and what may help, as a clause for a message.
        """
        if self.laws is not None:
            return UNSTABLE_LOOP
        start = self.initial_state(theta)
        return explain_divergence(
            self.model(theta), start, np.asarray(ctrl), self.simulator.substeps
        )

    def observe(
        self, theta: Array, ctrl: Array, observations: SubstepObservations
    ) -> tuple[Trajectory, Array] | None:
        """Open-loop trajectory from the initial state, observed at every engine step.

        Args:
            theta: (p,) parameters [theta-unit].
            ctrl: (N, nu) controls, each held over its sample.
            observations: The w observed quantities.

        Returns:
            The trajectory and (N, rows, w) observations, see `Rollouts`, or None if the simulation
            diverges.
        """
        out = self.simulator.rollout(
            [self.model(theta)],
            self.initial_state(theta)[None],
            np.asarray(ctrl)[None],
            observations,
        )
        if not out.finite[0] or out.observed is None:
            return None
        return self.trajectory(out.states[0], ctrl), out.observed[0]

    def measure(self, theta: Array, ctrl: Array) -> tuple[Array, np.ndarray]:
        """Outputs of many open-loop simulations under one control, with their errors and the delay.

        Args:
            theta: (m, p) parameters [theta-unit].
            ctrl: (N, nu) controls.

        Returns:
            (m, N+1, ny) outputs [y-unit], and (m,) True where the simulation did not diverge.
        """
        models, compiled = self.try_models(theta)
        held = np.broadcast_to(ctrl, (len(theta), *np.shape(ctrl)))
        out = self.simulator.rollout(models, self.initial_state(theta), held)

        h = self.outputs(out.states, out.sensors)
        y = np.empty_like(h)
        for i, row in enumerate(theta):
            y[i] = self.calibration.measured(h[i], row)
            delay = self.output_delay(row, y.shape[1])
            if delay is not None:
                y[i] = delay.apply(y[i])
        return y, out.finite & compiled

    def project(
        self, theta: Array, base: Trajectory, zeta: TangentCurve, gamma: float, K: Array
    ) -> Trajectory | None:
        """Projection operator `P(xi + gamma zeta)` about a trajectory xi.

        The plant is simulated in closed loop, with `u = mu + K (alpha - x)`.

        Args:
            theta: (p,) parameters [theta-unit].
            base: The trajectory xi.
            zeta: Tangent curve (z, v).
            gamma: Step length along zeta.
            K: (N, nu, nx) feedback gains [u-unit / x-unit]; all zero means open loop.

        Returns:
            The projected trajectory, or None if the simulation diverges.
        """
        mu = base.ctrl + gamma * zeta.v
        model = self.model(theta)
        if not K.any():
            out = self.simulator.rollout([model], base.state[:1], mu[None])
            return self.trajectory(out.states[0], mu) if out.finite[0] else None

        # A step that is much too long may overflow; the simulation then counts as diverged.
        with np.errstate(over="ignore", invalid="ignore"):
            alpha = self.space.plus(base.state, gamma * zeta.z)

        states, ctrl, finite = self.simulator.closed_loop(model, alpha, mu, K)
        return self.trajectory(states, ctrl) if finite else None


class WrittenModels:
    """Copies of a model, each with parameter values that were written into it.

    A design asks for the same values at every iterate. They are written once.

    One thread at a time may ask for models and simulate them, because a call overwrites models of
    earlier calls.

    Attributes:
        source: Model into which the parameters are written.
        parameters: The p parameters, of which none needs a compile.
    """

    def __init__(self, source: PlantModel, parameters: ParameterSet) -> None:
        """Begin without copies."""
        self.source = source
        self.parameters = parameters
        self._largest_call = 0

        # The copies by the bytes of their values, those that were asked for last at the end.
        self._copies: OrderedDict[bytes, Any] = OrderedDict()

    def at(self, theta: Array) -> list[Any]:
        """Models at many parameter values.

        A later call may overwrite them.

        Args:
            theta: (m, p) parameters [theta-unit].

        Returns:
            m models; equal rows share one.
        """
        rows = np.ascontiguousarray(theta, dtype=np.float64)
        keys = [row.tobytes() for row in rows]
        self._largest_call = max(self._largest_call, len(keys))

        # Copies of this call go to the end first, so that none of them is overwritten.
        for key in keys:
            if key in self._copies:
                self._copies.move_to_end(key)

        for key, row in zip(keys, rows, strict=True):
            if key not in self._copies:
                # A new copy, or the one that was not asked for the longest.
                if len(self._copies) < self._largest_call + SPARE_COPIES:
                    model = copy.copy(self.source.model)
                else:
                    model = self._copies.popitem(last=False)[1]
                ParameterWriter(self.parameters).write(model, row)
                self._copies[key] = self.source.refresh(model)

        return [self._copies[key] for key in keys]


def explain_divergence(model: Any, start: Array, ctrl: Array, substeps: int) -> str:
    """Explain why a simulation diverges, and say what may help.

    Args:
        model: The model.
        start: (ns,) initial state.
        ctrl: (N, nu) controls, each held over its sample.
        substeps: `mj_step` calls per sample.

    Returns:
        A clause for a message.
    """
    rejected = np.argwhere(~(np.abs(ctrl) <= MAX_CONTROL))
    if len(rejected):
        sample, actuator = rejected[0].tolist()
        return (
            f"the control of actuator {model.actuator(actuator).name or actuator} is "
            f"{ctrl[sample, actuator]:.3g}, and MuJoCo rejects controls above {MAX_CONTROL:.0e} "
            "(BADCTRL); a larger gear of the actuator needs smaller controls"
        )

    found = find_divergence(model, start, ctrl, substeps)
    if found is None:
        return NO_WARNING

    stable = _stable_timestep(model, start, ctrl, substeps)
    timestep = model.opt.timestep
    if stable is None:
        return f"{found}; {NO_WARNING}"
    return (
        f"{found}, because the timestep {timestep:g} s of the MJCF is too long for its integrator: "
        f"with {stable:g} s the simulation does not diverge"
    )


def find_divergence(model: Any, start: Array, ctrl: Array, substeps: int) -> str | None:
    """Step a simulation until MuJoCo warns.

    Args:
        model: The model.
        start: (ns,) initial state.
        ctrl: (N, nu) controls, each held over its sample.
        substeps: `mj_step` calls per sample.

    Returns:
        The first warning, its joint and time in words; None without one.
    """
    data = mujoco.MjData(model)
    data.qpos[:], data.qvel[:], data.act[:] = state_space(model).split(start)

    duration = substeps * model.opt.timestep
    for k, u in enumerate(ctrl):
        data.ctrl[:] = u
        with silence_mujoco_log():
            mujoco.mj_step(model, data, substeps)
        for name in WARNINGS:
            warning = data.warning[int(getattr(mujoco.mjtWarning, f"mjWARN_{name}"))]
            if warning.number:
                # An address in qpos (BADQPOS) or qvel belongs to a joint.
                addresses = model.jnt_qposadr if name == "BADQPOS" else model.jnt_dofadr
                joint = np.searchsorted(addresses, int(warning.lastinfo), side="right") - 1
                named = model.joint(int(joint)).name
                where = f" at joint {named}" if named else ""
                return f"MuJoCo warns {name}{where} at t = {(k + 1) * duration:.4g} s"
    return None


def _stable_timestep(model: Any, start: Array, ctrl: Array, substeps: int) -> float | None:
    """Longest of some smaller timesteps with which a simulation does not diverge [s].

    The arguments are those of `find_divergence`. None if there is no such timestep.
    """
    refined = copy.copy(model)
    for divisor in DIVISORS:
        if len(ctrl) * substeps * divisor > MAX_STEPS:
            return None

        timestep = float(model.opt.timestep) / divisor
        refined.opt.timestep = timestep
        if find_divergence(refined, start, ctrl, substeps * divisor) is None:
            return timestep
    return None

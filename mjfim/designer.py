"""`mjfim.design`: run Algorithm 1 on an experiment, from one start or several, and say what came of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator
from dataclasses import dataclass, replace

import numpy as np

from mjfim.directions import LBFGS, ExtendedMetricDescent, MetricDescent
from mjfim.errors import ExperimentError, SimulationDiverged
from mjfim.experiment import Experiment
from mjfim.fisher import standard_deviations
from mjfim.limits import margins, saturated
from mjfim.lq import growth, regulator
from mjfim.objective import DesignProblem, Point
from mjfim.plant import CENTRAL
from mjfim.pronto import Armijo, Direction, Iterate, Regulator, optimize
from mjfim.setup import Setup
from mjfim.signals import multisine
from mjfim.trajectory import Array, Design, Evaluation, HistoryRow, StartResult, Status, Trajectory

Monitor = Callable[[HistoryRow], None]


def design(
    experiment: Experiment | Setup,
    monitor: Monitor | None = None,
    start: Array | None = None,
    threads: int | None = None,
) -> Design:
    """Design the control that minimises eq. 3 of the paper.

    monitor: called with every iterate;  start: (N, nu) control to start from instead of the experiment's initial one.
    The initial control stays the reference x_d of the tracking term. Ctrl-C returns the best trajectory so far.
    Raises UnidentifiableError where the initial control excites nothing, ExperimentError for a faulty experiment.
    """
    setup = experiment if isinstance(experiment, Setup) else Setup(experiment, threads)
    clock, steps = time.perf_counter(), setup.plant.engine.steps
    problem = setup.problem
    first = problem.point(setup.initial, CENTRAL)
    if start is not None:
        start = np.asarray(start, dtype=np.float64)
        if start.shape != setup.control.shape:
            raise ExperimentError(f"start: shape {start.shape}, wanted (samples, actuators) = {setup.control.shape}")
    begin = first if start is None else problem.point(setup.plant.simulate(setup.theta, start), CENTRAL)
    if first.information is None or begin.information is None:
        raise SimulationDiverged("the simulation diverges when the parameters move a little along the initial control")
    setup.information.require_identifiable(begin.information, setup.parameters.names, setup.parameters.step)
    coarse = _coarse_level(setup, first)
    levels = (setup,) if coarse is None else (coarse, setup)

    def spent() -> int:
        return sum(level.plant.engine.steps for level in levels) - steps

    runs: list[Run] = []
    try:
        for name, control in _starts(setup, start):
            runs.append(Run(name))
            for row in _descend(levels, control, runs[-1]):
                told = replace(row, seconds=time.perf_counter() - clock, steps=spent())
                runs[-1].history += (told,)
                if monitor is not None:
                    monitor(told)
    except KeyboardInterrupt:
        for run in runs[-1:]:
            run.status = Status.INTERRUPTED
    return _conclude(setup, first, runs, time.perf_counter() - clock, spent())


@dataclass
class Run:
    """One start on its way. point: the last iterate at the stated sample rate;  control: (N, nu) the last of any level."""

    name: str
    point: Point | None = None
    control: Array | None = None
    status: Status = Status.STALLED
    slope: float = np.inf
    history: tuple[HistoryRow, ...] = ()

    @property
    def cost(self) -> float:
        """J reached."""
        return np.inf if self.point is None else self.point.cost


def _starts(setup: Setup, given: Array | None) -> Iterator[tuple[str, Array]]:
    """Controls to start from: the given or initial one, then random multisines of growing amplitude."""
    d = setup.experiment.descent
    yield ("initial control", setup.control) if given is None else ("given control", given)
    rng = np.random.default_rng(d.seed)
    peak = np.abs(setup.control).max(axis=0)
    for i in range(1, d.starts):
        wave = multisine(setup.t, len(setup.controls), 1.0 / setup.experiment.horizon, 10, rng)
        yield f"multisine {i} of {d.starts - 1}", peak * rng.uniform(1.0, 6.0) * wave


def direction_for(setup: Setup) -> tuple[Direction, DesignProblem]:
    """The descent direction that the experiment asks for, and the problem that feeds it."""
    d, dt, coarse = setup.experiment.descent, setup.dt, setup.coarsen > 1
    R, Q = np.diag(setup.control_weight) * dt, np.diag(setup.tracking) * dt
    if d.method == "lbfgs":
        return LBFGS(R), replace(setup.problem, draft=coarse)
    if d.psi_weight == 0.0:
        return MetricDescent(Q, R, Q), setup.problem
    nx, p = len(Q), len(setup.parameters)
    wide = np.diag(np.concatenate([np.diag(Q), np.full(nx * p, d.psi_weight * dt)]))
    return ExtendedMetricDescent(wide, R, wide), replace(setup.problem, extended=True)


CALM = 10.0


def regulator_for(setup: Setup) -> Regulator:
    """Unit weights on state and control along the trajectory; no feedback where the plant is calm without."""
    Q, R = np.eye(setup.space.nx) * setup.dt, np.eye(len(setup.controls)) * setup.dt
    return Regulator(Q, R, Q / setup.dt, calm=CALM)


def _coarse_level(setup: Setup, first: Point) -> Setup | None:
    """The coarse level, where the experiment wants it and the model bears it (the initial cost agrees within 5 %)."""
    d = setup.experiment.descent
    factor = 4 if d.coarse == "auto" else d.coarse
    if factor == 1 or d.method != "lbfgs" or setup.samples % factor or setup.samples < 50 * factor:
        return None
    coarse = setup.coarser(factor)
    try:
        cost = coarse.problem.point(coarse.initial).cost
    except SimulationDiverged:
        return None
    return coarse if abs(cost - first.cost) <= 0.05 * setup.problem.size(first) else None


COARSE_TOLERANCE = 1e-5


def _descend(levels: tuple[Setup, ...], control: Array, run: Run) -> Iterator[HistoryRow]:
    """Follow Algorithm 1 from one control through the levels, coarse to fine, keeping `run` up to date."""
    memory: Direction | None = None
    for level in levels:
        fine = level is levels[-1]
        d, factor = level.experiment.descent, level.coarsen
        direction, problem = direction_for(level)
        if isinstance(memory, LBFGS):
            direction = memory.refined(np.diag(level.control_weight) * level.dt, levels[0].coarsen)
        try:
            start = problem.point(level.plant.simulate(level.theta, level.averaged(control)))
        except SimulationDiverged:
            return
        if not np.isfinite(start.cost):
            return
        tolerance = d.tolerance if fine else max(d.tolerance, COARSE_TOLERANCE)
        done = run.history[-1].iteration + 1 if run.history else 0
        budget = max(d.max_iterations - done, 0)
        for iterate in optimize(problem, start, direction, regulator_for(level), Armijo(), tolerance, budget):
            trajectory = iterate.point.trajectory
            if trajectory is None:
                raise SimulationDiverged("an iterate of Algorithm 1 diverged")
            control = run.control = np.repeat(trajectory.ctrl, factor, axis=0)
            run.slope, run.status = iterate.slope, iterate.status or Status.INTERRUPTED
            if fine:
                run.point = iterate.point
            last = run.history[-1] if run.history else None
            if last is None or last.iteration != done + iterate.index or last.rate != 1.0 / level.dt:
                yield _row(iterate, done, 1.0 / level.dt)
        memory = direction


def _row(iterate: Iterate[Point], done: int, rate: float) -> HistoryRow:
    criterion = iterate.point.criterion
    value, smallest = (np.inf, 0.0) if criterion is None else (criterion.value, float(criterion.eigenvalues[0]))
    return HistoryRow(done + iterate.index, iterate.value, value, smallest, iterate.slope, iterate.gamma, 0.0, 0, rate)


def _conclude(setup: Setup, first: Point, runs: list[Run], seconds: float, steps: int) -> Design:
    if not runs:
        runs = [Run("initial control", status=Status.INTERRUPTED)]
    if runs[-1].point is None and runs[-1].control is not None:  # interrupted on the coarse level
        runs[-1].point = _fine_point(setup, runs[-1].control)
    best = min(runs, key=lambda run: run.cost)
    interrupted = any(run.status is Status.INTERRUPTED for run in runs)
    if best.point is None and not interrupted:
        raise SimulationDiverged("the simulation diverges from every start")
    final = evaluate(setup, first if best.point is None or best.cost > first.cost else best.point)
    limits = margins(setup.limits, final.trajectory)
    return Design(
        status=Status.INTERRUPTED if interrupted else best.status,
        parameters=setup.parameters.names,
        theta=setup.theta,
        initial=evaluate(setup, first),
        final=final,
        history=best.history,
        slope=best.slope,
        steps=steps,
        seconds=seconds,
        limits=limits,
        warnings=tuple(_warnings(final, limits, saturated(setup.model_at(setup.theta), final.trajectory))),
        found_by=best.name,
        starts=tuple(StartResult(r.name, r.cost, r.status, r.history[-1].iteration if r.history else 0) for r in runs),
    )


def _fine_point(setup: Setup, control: Array) -> Point | None:
    """A coarse level's control at the stated rate; None where it diverges."""
    try:
        return setup.problem.point(setup.plant.simulate(setup.theta, control))
    except SimulationDiverged:
        return None


def evaluate(setup: Setup, point: Point) -> Evaluation:
    """Everything that a trajectory tells, with the regulator about it."""
    if point.trajectory is None or point.sensitivity is None or point.information is None or point.criterion is None:
        raise SimulationDiverged("the trajectory diverges")
    A, B, _, _ = setup.plant.jacobians(setup.theta, point.trajectory)
    r = regulator_for(setup)
    return Evaluation(
        trajectory=point.trajectory,
        gain=regulator(A, B, r.Q, r.R, r.terminal),
        sensitivity=point.sensitivity.psi,
        information=point.information,
        eigenvalues=point.criterion.eigenvalues,
        std=standard_deviations(point.information),
        min_eigenvalue=setup.information.accumulated(point.sensitivity),
        criterion=point.criterion.value,
        cost=point.cost,
        growth=growth(A),
    )


UNSTABLE = 1e3


def _warnings(final: Evaluation, limits: dict[str, float], clamped: tuple[str, ...]) -> Iterator[str]:
    if clamped:
        yield (
            f"forcerange clamps {', '.join(clamped)} during the design: the derivatives do not hold there, and the descent "
            "may have stopped early; raise cost.control"
        )
    if final.growth > UNSTABLE:
        yield (
            f"a small disturbance grows up to {final.growth:.1e}-fold along this trajectory when its control is played "
            "open loop; the predicted sigma assumes that there is none. Play it with the gains of design.npz, or raise "
            "cost.control"
        )
    values = final.eigenvalues
    if len(values) > 1 and values[1] < 1.01 * values[0]:
        yield (
            "the two smallest eigenvalues lie within 1 %: lambda_min is not differentiable there and E-optimal descent "
            "may have stopped early"
        )
    for kind, margin in limits.items():
        if margin < 0.0:
            yield (
                f"{kind} limits are exceeded by {-margin:.3g}: they are checked, not enforced; raise cost.control or "
                "cost.tracking until they hold before running this on hardware"
            )


def evaluate_trajectory(experiment: Experiment | Setup, trajectory: Trajectory) -> Evaluation:
    """What a given trajectory's control tells about the parameters at the experiment's theta."""
    setup = experiment if isinstance(experiment, Setup) else Setup(experiment)
    point = setup.problem.point(setup.plant.simulate(setup.theta, trajectory.ctrl), CENTRAL)
    return evaluate(setup, point)

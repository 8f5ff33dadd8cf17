"""`mjfim.design`: run Algorithm 1 on an experiment, from one start or several, and say what came of it."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass, replace
from functools import cached_property

import numpy as np

from mjfim.directions import LBFGS, ExtendedMetricDescent, MetricDescent
from mjfim.earlier import shared
from mjfim.errors import ExperimentError, SimulationDiverged
from mjfim.experiment import Experiment
from mjfim.limits import margins, saturated
from mjfim.lq import growth, regulator
from mjfim.objective import DIVERGED, DesignProblem, Point
from mjfim.plant import CENTRAL
from mjfim.pronto import Armijo, Direction, Iterate, Regulator, optimize
from mjfim.roughness import Roughness, roughness
from mjfim.setup import Setup
from mjfim.signals import multisine
from mjfim.survey import Survey, require_designable, survey
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
    if first.information is None or begin.trajectory is None or begin.sensitivity is None:
        why = "when the parameters move a little along the initial control"
        if setup.pool is not None:
            why += ", or at a parameter sample of [robust]; bounds keep samples where the model makes sense"
        raise SimulationDiverged(f"the simulation diverges {why}")
    seen = survey(setup, begin.trajectory, begin.sensitivity)
    require_designable(setup, seen)
    stage = Stage(setup, seen.basis)
    first = stage.problem.judged(first)
    coarse = _coarse_level(setup, first, seen.basis)
    levels = (setup,) if coarse is None else (coarse, setup)

    def spent() -> int:
        return sum(level.plant.engine.steps for level in levels) - steps

    runs: list[Run] = []
    try:
        for name, control in _starts(setup, start):
            runs.append(Run(name))
            for row in _descend([Stage(level, seen.basis) for level in levels], control, runs[-1]):
                told = replace(row, seconds=time.perf_counter() - clock, steps=spent())
                runs[-1].history += (told,)
                if monitor is not None:
                    monitor(told)
    except KeyboardInterrupt:
        for run in runs[-1:]:
            run.status = Status.INTERRUPTED
    return _conclude(stage, seen, first, runs, time.perf_counter() - clock, spent())


@dataclass(frozen=True, eq=False)
class Stage:
    """A level of the descent: the experiment at one sample rate and the criterion as it is minimised there.

    basis: identifiable combinations, or None;  power: of the smooth E-criterion, infinite for 1/lambda_min itself
    """

    setup: Setup
    basis: Array | None
    power: float = np.inf

    @cached_property
    def problem(self) -> DesignProblem:
        """The cost."""
        problem = self.setup.problem
        information = replace(problem.information, basis=self.basis, power=self.power)
        return replace(problem, information=information, draft=self.setup.coarsen > 1)


@dataclass
class Run:
    """One start on its way. point: the last iterate at the stated sample rate;  control: (N, nu) the last of any level.

    rate: sample rate of the level that it is on [Hz]
    """

    name: str
    point: Point | None = None
    control: Array | None = None
    status: Status = Status.STALLED
    slope: float = np.inf
    history: tuple[HistoryRow, ...] = ()
    rate: float = 0.0

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


def direction_for(stage: Stage) -> tuple[Direction, DesignProblem]:
    """The descent direction that the experiment asks for, and the problem that feeds it."""
    setup = stage.setup
    d, dt = setup.experiment.descent, setup.dt
    R, Q = np.diag(setup.control_weight) * dt, np.diag(setup.tracking) * dt
    if d.method == "lbfgs":
        return LBFGS(R), stage.problem
    if d.psi_weight == 0.0:
        return MetricDescent(Q, R, Q), stage.problem
    nx, p = len(Q), len(setup.parameters)
    wide = np.diag(np.concatenate([np.diag(Q), np.full(nx * p, d.psi_weight * dt)]))
    return ExtendedMetricDescent(wide, R, wide), replace(stage.problem, extended=True)


CALM = 10.0


def regulator_for(setup: Setup) -> Regulator:
    """Unit weights on state and control along the trajectory; no feedback where the plant is calm without."""
    Q, R = np.eye(setup.space.nx) * setup.dt, np.eye(len(setup.controls)) * setup.dt
    return Regulator(Q, R, Q / setup.dt, calm=CALM)


def _coarse_level(setup: Setup, first: Point, basis: Array | None) -> Setup | None:
    """The coarse level, where the experiment wants it and the model bears it (the initial cost agrees within 5 %).

    Raises ExperimentError where a stated factor does not divide the samples.
    """
    d = setup.experiment.descent
    factor = 4 if d.coarse == "auto" else d.coarse
    if factor == 1 or d.method != "lbfgs":
        return None
    if d.coarse != "auto" and setup.samples % factor:
        valid = ", ".join(str(k) for k in range(1, 17) if setup.samples % k == 0)
        raise ExperimentError(
            f"descent.coarse: {factor} does not divide the {setup.samples} samples; valid for example: {valid}"
        )
    if setup.samples % factor or setup.samples < 50 * factor:
        return None
    coarse = setup.coarser(factor)
    try:
        cost = Stage(coarse, basis).problem.point(coarse.initial).cost
    except SimulationDiverged:
        return None
    return coarse if abs(cost - first.cost) <= 0.05 * setup.problem.size(first) else None


COARSE_TOLERANCE = 1e-5
MEETING = 1.02  # second over smallest eigenvalue at which E-optimality turns smooth
NEAR = 1.2  # the same for a descent that stalled
POWERS = (40.0, 160.0)
CLOSE = 1.01  # smooth over exact criterion that is good enough


def _descend(stages: Sequence[Stage], control: Array, run: Run) -> Iterator[HistoryRow]:
    """Follow Algorithm 1 from one control through the levels, coarse to fine, keeping `run` up to date.

    Where the smallest eigenvalues meet, E-optimality goes on with the smooth criterion, on this level and all finer ones.
    """
    power, memory, given = np.inf, None, control
    for level in stages:
        while True:
            stage = replace(level, power=power)
            pass_ = _Pass(stage, (control, given), run, memory)
            yield from pass_.rows()
            if pass_.failed:
                return
            control = pass_.control
            power, again = _sharper(stage, pass_)
            memory = None if again else pass_.direction
            if not again:
                break


def _sharper(stage: Stage, done: _Pass) -> tuple[float, bool]:
    """Power of the E-criterion from here on, and whether this level has to be done again with it."""
    values, power = done.eigenvalues, stage.power
    if stage.setup.experiment.cost.criterion != "E" or len(values) < 2:
        return power, False
    if np.isinf(power):
        meet = done.met or (done.run.status is Status.STALLED and values[1] < NEAR * values[0])
        return (POWERS[0], True) if meet else (power, False)
    gap = float(np.sum((values[0] / values) ** power) ** (1.0 / power))
    if gap > CLOSE and power < POWERS[-1] and stage.setup.coarsen == 1:
        return POWERS[-1], True
    return power, False


class _Pass:
    """One run of Algorithm 1 on one stage, from the better of some controls: a coarse level may lead astray.

    met: it was left because the smallest eigenvalues meet
    """

    def __init__(self, stage: Stage, controls: Sequence[Array], run: Run, memory: Direction | None) -> None:
        self.stage, self.controls, self.run = stage, controls, run
        self.control = controls[0]
        self.direction, self.problem = direction_for(stage)
        if isinstance(memory, LBFGS) and run.rate:
            setup = stage.setup
            factor = round(1.0 / (setup.dt * run.rate))
            self.direction = memory.refined(np.diag(setup.control_weight) * setup.dt, factor)
        self.met = self.failed = False
        self.eigenvalues = np.zeros(0)

    def rows(self) -> Iterator[HistoryRow]:
        """Every iterate as a row of the history."""
        level, run = self.stage.setup, self.run
        d, fine, rate = level.experiment.descent, level.coarsen == 1, 1.0 / level.dt
        start = self._start()
        if not np.isfinite(start.cost):
            self.failed = True
            return
        exact = Stage(level, self.stage.basis).problem
        tolerance = d.tolerance if fine else max(d.tolerance, COARSE_TOLERANCE)
        done = run.history[-1].iteration + 1 if run.history else 0
        budget = max((d.max_iterations if fine else d.max_iterations // 2) - done, 0)
        run.rate = rate
        for iterate in optimize(self.problem, start, self.direction, regulator_for(level), Armijo(), tolerance, budget):
            trajectory, criterion = iterate.point.trajectory, iterate.point.criterion
            if trajectory is None or criterion is None:
                raise SimulationDiverged("an iterate of Algorithm 1 diverged")
            self.control = run.control = np.repeat(trajectory.ctrl, level.coarsen, axis=0)
            self.eigenvalues = criterion.eigenvalues
            point = iterate.point if np.isinf(self.stage.power) else exact.judged(iterate.point)
            run.slope, run.status = iterate.slope, iterate.status or Status.INTERRUPTED
            if run.status is Status.CONVERGED and np.isfinite(self.stage.power):
                run.status = Status.SMOOTHED
            if fine and (run.point is None or point.cost <= run.point.cost):
                run.point = point
            last = run.history[-1] if run.history else None
            if last is None or last.iteration != done + iterate.index or last.rate != rate:
                yield _row(replace(iterate, point=point, value=point.cost), done, rate)
            if self._meets() and iterate.status is None and iterate.index > 0:
                self.met = True
                return

    def _start(self) -> Point:
        """The cheapest point of the controls; infinite where all diverge."""
        level, points = self.stage.setup, []
        for control in {id(c): c for c in self.controls}.values():
            try:
                points.append(self.problem.point(level.plant.simulate(level.theta, level.averaged(control))))
            except SimulationDiverged:
                continue
        return min(points, key=lambda point: point.cost, default=DIVERGED)

    def _meets(self) -> bool:
        """The smallest eigenvalues are about to cross while the exact E-criterion is descended."""
        values = self.eigenvalues
        wanted = self.stage.setup.experiment.cost.criterion == "E" and np.isinf(self.stage.power)
        return bool(wanted and len(values) > 1 and values[1] < MEETING * values[0])


def _row(iterate: Iterate[Point], done: int, rate: float) -> HistoryRow:
    criterion = iterate.point.criterion
    value, smallest = (np.inf, 0.0) if criterion is None else (criterion.value, float(criterion.eigenvalues[0]))
    return HistoryRow(done + iterate.index, iterate.value, value, smallest, iterate.slope, iterate.gamma, 0.0, 0, rate)


def _conclude(stage: Stage, seen: Survey, first: Point, runs: list[Run], seconds: float, steps: int) -> Design:
    setup = stage.setup
    if not runs:
        runs = [Run("initial control", status=Status.INTERRUPTED)]
    if runs[-1].point is None and runs[-1].control is not None:  # interrupted on the coarse level
        runs[-1].point = _fine_point(stage, runs[-1].control)
    best = min(runs, key=lambda run: run.cost)
    interrupted = any(run.status is Status.INTERRUPTED for run in runs)
    if best.point is None and not interrupted:
        raise SimulationDiverged("the simulation diverges from every start")
    chosen = first if best.point is None or best.cost > first.cost else best.point
    initial, final, information = evaluate(stage, first), evaluate(stage, chosen), stage.problem.information
    limits = margins(setup.limits, final.trajectory)
    clamped = saturated(setup.model_at(setup.theta), final.trajectory)
    rough = None if interrupted else roughness(setup, setup.theta, final.trajectory, chosen.sensitivity)
    status = Status.INTERRUPTED if interrupted else best.status
    if status.success and (rough is not None or clamped):
        status = Status.ROUGH
    return Design(
        status=status,
        parameters=setup.parameters.names,
        theta=setup.theta,
        initial=initial,
        final=final,
        history=best.history,
        slope=best.slope,
        steps=steps,
        seconds=seconds,
        limits=limits,
        warnings=tuple(_warnings(final, limits, clamped, rough)),
        found_by=best.name,
        starts=tuple(StartResult(r.name, r.cost, r.status, r.history[-1].iteration if r.history else 0) for r in runs),
        nuisance=tuple(p.name for p in setup.parameters.parameters if p.nuisance),
        combinations=tuple(str(group) for group in seen.groups_always),
        combined=seen.combined(
            information, setup.theta[setup.parameters.interest], initial.information, final.information
        ),
        prior=setup.prior,
        data=shared(
            information.visible(final.information - setup.prior),
            setup.parameters.prior_information,
            setup.parameters.private,
        ),
    )


def _fine_point(stage: Stage, control: Array) -> Point | None:
    """A coarse level's control at the stated rate; None where it diverges."""
    try:
        return stage.problem.point(stage.setup.plant.simulate(stage.setup.theta, control))
    except SimulationDiverged:
        return None


def evaluate(stage: Stage, point: Point) -> Evaluation:
    """Everything that a trajectory tells, with the regulator about it."""
    setup, information = stage.setup, stage.problem.information
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
        std=information.std(point.information),
        min_eigenvalue=information.accumulated(point.sensitivity),
        criterion=point.criterion.value,
        cost=point.cost,
        growth=growth(A),
    )


UNSTABLE = 1e3


def _warnings(
    final: Evaluation, limits: dict[str, float], clamped: tuple[str, ...], rough: Roughness | None
) -> Iterator[str]:
    if rough is not None:
        yield str(rough)
    if clamped:
        yield (
            f"forcerange clamps {', '.join(clamped)} along the design: its derivatives do not hold there, it may rest on "
            "information that the clamp feigns, and the descent may have stopped early; raise cost.control or start more gently"
        )
    if final.growth > UNSTABLE:
        yield (
            f"a small disturbance grows up to {final.growth:.1e}-fold along this trajectory when its control is played "
            "open loop; the predicted sigma assumes that there is none. Play it with the gains of design.npz, or raise "
            "cost.control"
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
    if point.trajectory is None or point.sensitivity is None:
        raise SimulationDiverged("the trajectory diverges when the parameters move a little")
    stage = Stage(setup, survey(setup, point.trajectory, point.sensitivity).basis)
    return evaluate(stage, stage.problem.judged(point))

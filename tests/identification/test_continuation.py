"""A fit over a whole recording that ends in a local minimum is restarted from short segments."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.budget import Budget, StopToken
from mjfim.experiment.system import System
from mjfim.identification import continuation
from mjfim.identification.continuation import WholeFit, continued_fit
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.fit_quality import fit_quality
from mjfim.identification.identify import identify_system
from mjfim.identification.residual_tests import RELEVANT_SIZE_RATIO, is_larger_than_noise
from mjfim.identification.searches import JUDGED_ROUGH_SHARE, FitSearch
from mjfim.identification.segment_fits import (
    MIN_ROWS,
    SegmentFits,
    problem_of_segments,
    segment_lengths,
)
from mjfim.identification.task import FitTask
from mjfim.information.null_space import NullSpace
from mjfim.optimize.levenberg_marquardt import SearchSettings, Solution, minimise
from mjfim.plant.noise import Noise
from mjfim.records.estimate import Estimate, Restart
from mjfim.records.events import FitEvent
from mjfim.records.trajectory import Recording

# A pendulum that swings about once per second, measured with an error of 0.01 rad.
PENDULUM = """<mujoco>
  <option timestep="0.02" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body name="arm">
      <inertial pos="0 0 -0.4" mass="0.5" diaginertia="0.004 0.004 0.0004"/>
      <joint name="hinge" axis="0 1 0" damping="0.002"/>
      <geom type="sphere" size="0.01" mass="0"/>
    </body>
  </worldbody>
  <sensor><jointpos name="angle" joint="hinge" noise="0.01"/></sensor>
</mujoco>
"""
COM = {"target": "body/arm:ipos[2]", "guess": -0.4, "true": -0.4}
DAMPING = {"target": "joint/hinge:damping", "guess": 0.002, "true": 0.002, "bounds": [0.0, 1.0]}
RATE = 50.0

# Mean square of whitened residuals that are just large enough for a misfit.
JUST_LARGER = 1.001 * RELEVANT_SIZE_RATIO**2

# Factors by which the start is wrong, of the centre of mass and of the damping.
START = (0.5, 0.5)


def pendulum(folder: Path, seconds: float, **tables: object) -> System:
    """The pendulum, released at 1.5 rad."""
    (folder / "pendulum.xml").write_text(PENDULUM, encoding="utf-8")
    stated = {"fit": {"bootstrap": 0}, "parameters": {"com": COM, "damping": DAMPING}, **tables}
    experiment = mjfim.Experiment(
        model="pendulum.xml",
        directory=folder,
        rate=RATE,
        horizon=seconds,
        initial={"qpos": [1.5]},
        **stated,
    )
    return System.resolve(experiment, threads=1)


def swings(system: System, seconds: float) -> Recording:
    """A log of many swings at the true parameters, with noise."""
    samples = round(seconds * RATE)
    ctrl = np.zeros((samples, 0))
    y = system.plant.measure(system.parameters.true[None], ctrl)[0][0]
    noise = system.noise.sigma * np.random.default_rng(0).standard_normal(y.shape)
    times = np.arange(samples + 1) / RATE
    return Recording(t=times, ctrl=ctrl, y=y + noise, outputs=system.outputs.names)


def is_found(system: System, estimate: Estimate) -> bool:
    """Whether the true parameters are found and nothing is doubted."""
    near = np.abs(estimate.theta - system.parameters.true) < 4.0 * estimate.std
    return bool(near.all() and estimate.success and not estimate.misfit)


@pytest.mark.slow
def test_a_wrong_start_finds_the_truth_over_many_swings(tmp_path: Path) -> None:
    system = pendulum(tmp_path, 12.0, fit={"bootstrap": 0, "max_iterations": 15})
    recording = swings(system, 12.0)
    phases: list[str] = []

    def note(event: FitEvent) -> None:
        """Keep the phases in their order."""
        if event.phase not in phases:
            phases.append(event.phase)

    start = system.parameters.true * START
    found = identify_system(system, [recording], start=start, callback=note)
    assert is_found(system, found)
    assert not found.missing_terms
    assert phases[0] == "all data" and phases[-1] == "again all data"
    assert phases[1].startswith("segments of")

    # The result says what happened.
    restart = found.restart
    assert restart is not None
    assert restart.cost < 1e-2 * restart.cost_before
    assert "fell from" in found.summary()["restart"]["words"]


def test_a_right_first_fit_is_not_repeated(tmp_path: Path) -> None:
    system = pendulum(tmp_path, 4.0)
    phases = set()
    found = identify_system(
        system, [swings(system, 4.0)], callback=lambda event: phases.add(event.phase)
    )
    assert is_found(system, found)
    assert found.restart is None and phases == {"all data"}


@pytest.mark.slow
@pytest.mark.parametrize("start", [(1.2, 1.3), (1.5, 2.0), (2.0, 0.5), (0.5, 0.5), (0.4, 3.0)])
def test_guesses_that_are_wrong_by_factors_find_the_truth(
    tmp_path: Path, start: tuple[float, float]
) -> None:
    system = pendulum(tmp_path, 30.0)
    recording = swings(system, 30.0)
    found = identify_system(system, [recording], start=system.parameters.true * start)
    assert is_found(system, found)


@pytest.mark.slow
def test_deviations_of_the_initial_state_and_biases_are_continued_too(tmp_path: Path) -> None:
    """Parameters of the initial state are no unknowns of segments, the others are."""
    nuisance = {"initial": {"qpos:hinge": 0.05}, "bias": 0.05, "per_recording": True}
    system = pendulum(tmp_path, 30.0, nuisance=nuisance)
    recording = swings(system, 30.0)
    other = Recording(
        t=recording.t, ctrl=recording.ctrl, y=recording.y + 0.03, outputs=recording.outputs
    )
    start = system.parameters.true.copy()
    start[:2] *= START
    found = identify_system(system, [recording, other], start=start)
    assert found.restart is not None and is_found(system, found)
    np.testing.assert_allclose(found.per_recording["bias angle"], [0.0, 0.03], atol=0.005)


@pytest.mark.slow
def test_a_wrong_model_keeps_the_lower_cost_of_all_fits(tmp_path: Path) -> None:
    """Dry friction that the model lacks is no local minimum: the first result stands."""
    system = pendulum(tmp_path, 12.0)
    text = PENDULUM.replace('damping="0.002"', 'damping="0.002" frictionloss="0.02"')
    (tmp_path / "robot").mkdir()
    robot = pendulum(tmp_path / "robot", 12.0)
    (tmp_path / "robot" / "pendulum.xml").write_text(text, encoding="utf-8")
    robot = System.resolve(robot.experiment, threads=1)

    found = identify_system(system, [swings(robot, 12.0)])
    assert found.misfit and found.restart is not None
    assert found.restart.cost <= found.restart.cost_before
    assert found.missing_terms[0].path == "joint/hinge:frictionloss"


@pytest.mark.slow
def test_a_request_to_stop_during_the_restart_keeps_the_best_result(tmp_path: Path) -> None:
    system = pendulum(tmp_path, 12.0)
    stop = StopToken()

    def press(event: FitEvent) -> None:
        """Ask to stop in the first fit over segments."""
        if event.phase.startswith("segments"):
            stop.request()

    start = system.parameters.true * START
    found = identify_system(system, [swings(system, 12.0)], start=start, callback=press, stop=stop)
    assert found.interrupted
    assert found.restart is not None and found.restart.cost <= found.restart.cost_before


def test_segments_share_the_recordings_of_the_whole_problem(tmp_path: Path) -> None:
    """Workers then receive them once."""
    system = pendulum(tmp_path, 4.0)
    task = FitTask.resolve(system.experiment, [swings(system, 4.0)], threads=1)
    problem = task.problem()
    part = problem_of_segments(problem, task, task.system, 1.0)
    assert part is not None
    assert len(part.segments) == 4
    assert all(a is b for a, b in zip(part.recordings, problem.recordings, strict=True))

    # The steps of the differences suit both, and are calibrated once. Another model has its own.
    assert part.system.plant is problem.system.plant
    assert part.system.experiment.fit.segments == 1.0
    other = problem_of_segments(problem, task, replace(task.system), 1.0)
    assert other is not None
    steps, calibrated = (each.system.plant.derivatives.parameter_scale for each in (part, other))
    assert other.system.plant is not problem.system.plant
    np.testing.assert_allclose(steps, calibrated, rtol=1e-12)


def test_segments_are_shares_of_the_recording_with_enough_rows(tmp_path: Path) -> None:
    system = pendulum(tmp_path, 12.0)
    problem = FitProblem.of(system, [swings(system, 12.0)])
    lengths = segment_lengths(problem.recordings)
    assert lengths[0] * RATE >= MIN_ROWS
    assert list(lengths) == sorted(set(lengths))
    assert lengths[-1] <= 6.0


class Descent:
    """A fit whose search was stopped at several points on its way to the minimum."""

    def __init__(self, folder: Path) -> None:
        system = pendulum(folder, 4.0)
        task = FitTask.resolve(system.experiment, [swings(system, 4.0)], threads=1)
        p = len(system.parameters)
        self.problem = task.problem()
        self.search = FitSearch(task=task, budget=Budget(), callback=None)
        self.null_space = NullSpace(
            directions=np.zeros((p, 0)), silent=(), basis=np.eye(p), smallest=1.0
        )
        begin = self.problem.begin(1.1 * system.parameters.true)
        self.solutions = []
        for count in (1, 2, 3):
            found = minimise(self.problem, begin, SearchSettings(max_iterations=count))
            assert found is not None
            self.solutions.append(found)

    def fit(self, place: int, restart: Restart | None = None, *, rough: bool = False) -> WholeFit:
        """The fit at one of the points."""
        solution = replace(self.solutions[place], rough=rough)
        quality = replace(fit_quality(self.problem, solution), unexplained=("angle",))
        return WholeFit(problem=self.problem, solution=solution, quality=quality, restart=restart)

    def restart(self, before: int, after: int, starts: int = 1) -> Restart:
        """A restart from the cost at one of the points to that at another one."""
        costs = [self.solutions[place].cost for place in (before, after)]
        return Restart(lengths=(1.0,), cost_before=costs[0], cost=costs[1], starts=starts)

    def continued(self) -> WholeFit:
        """What a restart makes of the first of these fits."""
        first = self.problem, self.solutions[0]
        return continued_fit(self.search, self.problem, first, self.null_space)


@pytest.mark.parametrize("is_first", [True, False])
def test_a_restart_says_the_cost_of_the_converged_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_first: bool
) -> None:
    descent = Descent(tmp_path)
    restart = descent.restart(1, 1) if is_first else descent.restart(0, 1)
    kept = descent.fit(1, restart, rough=True)
    monkeypatch.setattr(continuation, "_better_of_two", lambda *_: kept)

    found = descent.continued()
    assert found.restart is not None
    assert found.solution.cost < 0.9 * kept.solution.cost
    assert found.restart.cost == found.solution.cost

    # A first fit that stands has not become better by the restart.
    before = found.solution.cost if is_first else restart.cost_before
    assert found.restart.cost_before == before
    assert ("found nothing better" in str(found.restart)) == is_first


@pytest.mark.parametrize("is_better", [True, False])
def test_the_cost_before_spread_starts_is_that_of_the_compared_first_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, is_better: bool
) -> None:
    """The first fit may go on before it is compared with a repetition."""
    descent = Descent(tmp_path)
    kept = descent.fit(1, descent.restart(1, 1))
    other = descent.fit(2, descent.restart(1 if is_better else 2, 2, starts=32))
    fits = iter([kept, other])
    segments = SegmentFits(start=None, lengths=(1.0,))
    monkeypatch.setattr(continuation, "is_doubtful", lambda *_: True)
    monkeypatch.setattr(continuation, "start_from_segments", lambda *_, **__: segments)
    monkeypatch.setattr(continuation, "_with_restart", lambda *_: next(fits))

    restart = descent.continued().restart
    assert restart is not None
    assert restart.cost == descent.solutions[2].cost
    assert restart.cost_before == descent.solutions[1 if is_better else 2].cost
    assert restart.starts == (32 if is_better else 1)


def test_the_cost_of_a_fit_with_other_noise_is_compared_with_the_noise_of_the_first_fit(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    descent = Descent(tmp_path)
    noise = descent.problem.noise
    wider = descent.problem.with_noise(
        Noise(covariance=4.0 * noise.covariance, strides=noise.strides)
    )
    begun = replace(descent.fit(1, descent.restart(0, 1), rough=True), problem=wider)
    monkeypatch.setattr(continuation, "_better_of_two", lambda *_: begun)
    found = descent.continued()
    assert found.restart is not None
    assert found.restart.cost == pytest.approx(descent.problem.cost(found.solution.unknowns))
    assert found.restart.cost > 2.0 * found.solution.cost


@pytest.mark.parametrize(
    ("share", "went_on"),
    [
        pytest.param(1.1, [], id="a dearer fit does not matter"),
        pytest.param(0.9995, ["nearer", "converged"], id="hardly cheaper"),
        pytest.param(0.99, ["nearer"], id="a little cheaper"),
        pytest.param(0.9, [], id="clearly cheaper"),
    ],
)
def test_a_first_fit_goes_on_until_it_can_be_compared(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, share: float, went_on: list[str]
) -> None:
    """Its cost may still fall by 2 %, and where the search has gone on, by 0.1 %."""
    descent = Descent(tmp_path)
    first = descent.fit(1, rough=True)
    again = descent.fit(2)
    asked: list[str] = []

    def step(name: str) -> Callable[..., tuple[FitProblem, Solution]]:
        def go_on(problem: FitProblem, solution: Solution) -> tuple[FitProblem, Solution]:
            asked.append(name)
            return problem, solution

        return go_on

    search: Any = SimpleNamespace(nearer=step("nearer"), converged=step("converged"))
    monkeypatch.setattr(continuation, "_cost", lambda *_: share * first.solution.cost)
    continuation._as_near_as_needed(search, first, again)
    assert asked == went_on

    # A fit that has converged is as near as it can be.
    asked.clear()
    solution = replace(first.solution, rough=False)
    continuation._as_near_as_needed(search, replace(first, solution=solution), again)
    assert not asked


@pytest.mark.parametrize(
    ("chi2", "is_stated", "clearly"),
    [(2.0, True, True), (2.0, False, False), (1.0, True, False), (JUST_LARGER, True, False)],
)
def test_residuals_miss_the_data_clearly_if_they_do_so_also_at_the_minimum(
    tmp_path: Path, chi2: float, is_stated: bool, clearly: bool
) -> None:
    descent = Descent(tmp_path)
    fit = descent.fit(2)
    dof = 100_000
    quality = replace(fit.quality, chi2=chi2 * dof, dof=dof)
    task: Any = SimpleNamespace(noise_is_stated=is_stated)
    assert continuation._clearly_misses(task, replace(fit, quality=quality)) == clearly

    # The small excess is significant, but may vanish on the way to the minimum.
    assert is_larger_than_noise(JUST_LARGER * dof, dof)


def test_a_search_that_ended_near_the_minimum_goes_on_as_far_as_asked(tmp_path: Path) -> None:
    descent = Descent(tmp_path)
    begun = descent.solutions[0]
    search, problem = descent.search, descent.problem
    for go_on in (search.nearer, search.converged):
        assert go_on(problem, begun) == (problem, begun)

    rough = replace(begun, rough=True)
    near = search.nearer(problem, rough)[1]
    best = search.converged(problem, rough)[1]
    assert near.rough and not best.rough
    assert best.success and best.cost <= near.cost < begun.cost
    assert near.cost - best.cost < 2.0 * JUDGED_ROUGH_SHARE * near.cost

    # Iterations count together.
    assert near.iterations > begun.iterations
    assert search.converged(problem, near)[1].cost == pytest.approx(best.cost)

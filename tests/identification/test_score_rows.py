"""Rows of score tests: those of a linearisation by all parameters at once."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.arrays import Array
from mjfim.excitation.task import DesignTask
from mjfim.experiment.simulate import simulate_system
from mjfim.experiment.system import System
from mjfim.identification import score_rows, segment_simulation
from mjfim.identification.candidates import load_candidates_of
from mjfim.identification.extended_problems import extended_problem, extended_system
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.fit_workers import FitWorkers
from mjfim.identification.score_rows import ScoreRows
from mjfim.identification.task import FitTask
from mjfim.optimize.condensed_least_squares import Condensed
from mjfim.optimize.levenberg_marquardt import UnknownValues
from tests.support.executors import LosingThreads
from tests.support.paths import MODELS
from tests.support.terms import experiment_of, motor_torque, recorded

# Parameters of the extended model: friction of the cart, and a number that needs no simulation.
FURTHER: dict[str, Any] = {
    "slide_damping": {"target": "joint/slide:damping", "guess": 0.0, "scale": 0.1},
    "shift": {"target": "output/qpos:hinge:bias", "guess": 0.0, "scale": 0.1},
}

# Whole recordings, short segments with fewer values than columns, a robust loss, priors, stated
# initial states with unknown deviations, values of single recordings, and a held parameter.
CASES: dict[str, dict[str, Any]] = {
    "whole": {},
    "free starts": {"fit": {"start": "measured"}},
    "segments": {"fit": {"segments": 0.05, "start": "measured"}},
    "robust": {"fit": {"loss": "soft_l1", "loss_scale": 0.5}},
    "priors": {"parameters": {"m": {"prior": 0.3}, "c": {"prior": 0.1}}},
    "deviations": {"nuisance": {"initial": {"qpos:hinge": 0.05}}},
    "each recording": {"parameters": {"c": {"per_recording": True, "nuisance": True}}},
    "held": {"fit": {"hold": ["l"]}},
}


def recordings_of(experiment: mjfim.Experiment) -> list[mjfim.Recording]:
    """Three recordings that differ by their noise."""
    task = DesignTask.resolve(experiment, threads=1)
    return [simulate_system(task.system, task.initial, seed) for seed in range(3)]


def stated(case: str) -> tuple[FitProblem, list[mjfim.Recording]]:
    """The fit to short recordings of the cart-pendulum, and the recordings."""
    experiment = mjfim.Experiment.from_file(MODELS / "cart_pendulum.toml").replace(
        horizon=0.5, **CASES[case]
    )
    recordings = recordings_of(experiment)
    return FitTask.resolve(experiment, recordings, threads=1).problem(), recordings


def extended(
    problem: FitProblem,
    recordings: Sequence[mjfim.Recording],
    at: UnknownValues,
    further: dict[str, Any] = FURTHER,
) -> tuple[FitProblem, UnknownValues]:
    """The problem with further parameters, and its unknowns."""
    system = extended_system(problem.system, further, {})
    assert system is not None
    return extended_problem(problem, recordings, at, system, differentiated_by=list(further))


def rows_of(problem: FitProblem, at: UnknownValues) -> ScoreRows:
    """The rows of a problem that does not diverge."""
    rows = ScoreRows.of(problem, at)
    assert rows is not None
    return rows


def information(condensed: Condensed, columns: Sequence[int]) -> Array:
    """(c+1, c+1) products of the rows without private unknowns, columns in some order."""
    rows = np.concatenate([condensed.reduced_rows(), condensed.common_rows])
    rows = rows[:, [*columns, -1]]
    return np.asarray(rows.T @ rows)


def of_all_parameters(wider: FitProblem, begin: UnknownValues, further: Sequence[str]) -> Array:
    """Products of the rows of the extended problem, further parameters last."""
    # Here the steps of all differences have to be calibrated.
    plant = wider.system.plant
    longest = wider.recordings[0].ctrl
    system = wider.system.calibrated(wider.system.parameters.guess, longest)
    assert plant.step_factors is not None
    calibrated = replace(wider, simulation=replace(wider.simulation, system=system))

    condensed = calibrated.condense(begin)
    assert condensed is not None
    names = wider.system.parameters.names
    of_column = [names[i] for i in wider.layout.parameter_of_column]
    last = [of_column.index(name) for name in further]
    first = [column for column in range(len(of_column)) if column not in last]
    return information(condensed, [*first, *last])


def remaining(products: Array) -> float:
    """Information about the last parameter after the others are eliminated."""
    H = products[:-1, :-1]
    return float(1.0 / np.linalg.inv(H)[-1, -1])


def assert_same(found: Array, expected: Array, atol: float) -> None:
    """Compare products of columns, each of which is scaled to length 1."""
    scale = np.sqrt(np.outer(np.diag(expected), np.diag(expected)))
    np.testing.assert_allclose(found / scale, expected / scale, rtol=0.0, atol=atol)


@pytest.mark.parametrize("case", CASES)
def test_they_are_those_of_a_linearisation_by_all_parameters(case: str) -> None:
    problem, recordings = stated(case)
    at = problem.begin(0.9 * problem.system.parameters.guess)
    wider, begin = extended(problem, recordings, at)

    rows = rows_of(problem, at)
    condensed = rows.condensed_with(wider, begin, list(FURTHER))
    assert condensed is not None
    found = information(condensed, range(condensed.common_count))
    assert_same(found, of_all_parameters(wider, begin, list(FURTHER)), atol=1e-6)


@pytest.mark.parametrize("fit", [{"start": "measured"}, {"segments": 0.5}], ids=["whole", "cut"])
def test_initial_states_of_new_coordinates_are_eliminated(
    fit: dict[str, Any], tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Friction that grows with the torque adds a coordinate, whose initial state is unknown."""
    experiment = experiment_of(
        tmp_path,
        "tilt",
        fit=fit,
        terms={},
        parameters={
            "damping": {"target": "joint/pivot:damping", "guess": 0.02},
            "friction": {"target": "joint/pivot:frictionloss", "guess": 0.05},
        },
    )
    system = System.resolve(experiment)
    recordings = [recorded(system, motor_torque(1.0, 100.0, seed), seed) for seed in range(2)]
    problem = FitTask.of(system, recordings).problem()
    at = problem.begin(system.parameters.guess)

    (candidate,) = load_candidates_of(problem.system)
    assert candidate.added is not None
    number = candidate.tested[0]
    table = {"target": number.path, "guess": number.linearised_at, "scale": number.size}
    wide = extended_system(
        problem.system, {"load": table}, {candidate.added.name: candidate.added.table}
    )
    assert wide is not None
    wider, begin = extended_problem(problem, recordings, at, wide, differentiated_by=["load"])
    assert wider.simulation.private_count > problem.simulation.private_count

    rows = rows_of(problem, at)
    condensed = rows.condensed_with(wider, begin, ["load"])
    assert condensed is not None
    assert condensed.private_count == wider.simulation.private_count
    found = information(condensed, range(condensed.common_count))
    expected = of_all_parameters(wider, begin, ["load"])

    # The stated columns are those of the model without the small term, and dry friction is rough.
    assert_same(found[:-1, :-1], expected[:-1, :-1], atol=0.1)

    # What is left of the term's information is clearly less than with known initial states.
    monkeypatch.setattr(score_rows, "new_private_columns", lambda *_: [])
    at_rest = rows.condensed_with(wider, begin, ["load"])
    assert at_rest is not None
    left = remaining(found)
    assert left == pytest.approx(remaining(expected), rel=0.1)
    assert remaining(information(at_rest, range(at_rest.common_count))) > 1.1 * left


def test_residuals_are_those_without_a_small_term() -> None:
    problem, recordings = stated("whole")
    at = problem.begin(0.9 * problem.system.parameters.guess)
    rows = rows_of(problem, at)

    small = {"slide_damping": {"target": "joint/slide:damping", "guess": 1e-2, "scale": 0.1}}
    wider, begin = extended(problem, recordings, at, small)
    condensed = rows.condensed_with(wider, begin, list(small))
    stated_rows, extended_rows = problem.condense(at), wider.condense(begin)
    assert condensed is not None and stated_rows is not None and extended_rows is not None

    squares = [
        information(each, range(each.common_count))[-1, -1]
        for each in (condensed, stated_rows, extended_rows)
    ]
    assert squares[0] == pytest.approx(squares[1], rel=1e-12)
    assert abs(squares[2] / squares[1] - 1.0) > 1e-6


def test_the_stated_columns_are_simulated_once() -> None:
    problem, recordings = stated("whole")
    at = problem.begin(problem.system.parameters.guess)
    rows = rows_of(problem, at)
    wider, begin = extended(problem, recordings, at)

    plant = wider.system.plant
    before = plant.engine_steps
    assert rows.condensed_with(wider, begin, list(FURTHER)) is not None
    samples = sum(segment.samples for segment in problem.segments)

    # Two simulations for the friction, one at the unknowns, and none for the bias.
    assert plant.engine_steps - before == 3 * samples * plant.simulator.substeps


def test_workers_find_the_same_digits(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(segment_simulation, "MAX_NUMBERS_AT_ONCE", 2000)
    problem, recordings = stated("segments")
    at = problem.begin(problem.system.parameters.guess)
    wider, begin = extended(problem, recordings, at)

    def condensed(problem: FitProblem) -> Condensed:
        """The rows of a problem beside those of the extended one."""
        rows = rows_of(problem, at)
        found = rows.condensed_with(wider, begin, list(FURTHER))
        assert found is not None
        return found

    alone = condensed(problem)
    with LosingThreads() as threads:
        divided = condensed(problem.on_workers(FitWorkers(threads)))
    assert threads.submitted > 4
    assert np.array_equal(divided.blocks, alone.blocks)


def test_a_model_that_diverges_with_further_parameters_has_no_rows() -> None:
    problem, recordings = stated("whole")
    at = problem.begin(problem.system.parameters.guess)
    rows = rows_of(problem, at)
    wider, begin = extended(problem, recordings, at)

    theta = np.array(begin.theta)
    theta[wider.system.parameters.names.index("slide_damping")] = -1e9
    assert rows.condensed_with(wider, replace(begin, theta=theta), list(FURTHER)) is None


def test_a_problem_that_diverges_has_no_rows() -> None:
    problem, _ = stated("whole")
    assert ScoreRows.of(problem, problem.begin(np.array([1e-3, 1e-3, -1e6]))) is None

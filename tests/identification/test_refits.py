"""Searches near a similar fit begin with all that it has found."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mjfim.experiment.system import System
from mjfim.identification.assessment.report import FitResult, estimate_from
from mjfim.identification.assessment.term_tests import TermTests
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import fit_task, refit_task
from mjfim.identification.search import FitSearch, FitTask
from mjfim.optimize.levenberg_marquardt import Solution, UnknownValues, minimise
from mjfim.parallel.budget import Budget
from mjfim.records.events import FitEvent
from tests.support.cart_pendulum import cart_pendulum, fit_of
from tests.support.terms import experiment_of, motor_torque, recorded

# Zeros of the angle in two recordings [rad], which are 20 standard deviations of its noise apart.
BIASES = (0.5, -0.5)


KNOWN = {"damping": {"target": "joint/pivot:damping", "true": 0.01, "guess": 0.01}}


def test_values_of_single_recordings_and_the_cheaper_start_are_kept(
    fitted: FitResult, begins: list[UnknownValues]
) -> None:
    far = fitted.theta * 1.2
    events: list[FitEvent] = []
    for start, other, expected in (
        (fitted.theta, None, fitted.theta),
        (far, None, far),
        (far, fitted.theta, fitted.theta),
        (far, 1.5 * far, far),
    ):
        begins.clear()
        search = searched(replace(fitted.task, start=start), events)
        refit_task(search, fitted, other_start=other)
        assert_array_equal(begins[0].theta[:3], expected[:3])
        assert_array_equal(begins[0].per_recording, fitted.solution.unknowns.per_recording)

    # Without them, the second recording would begin 20 standard deviations away.
    assert events[0].cost == pytest.approx(fitted.solution.cost, rel=1e-3)
    assert np.ptp(begins[0].per_recording) == pytest.approx(1.0, abs=0.1)


@pytest.fixture(scope="module")
def fitted() -> FitResult:
    """A fit to two short recordings whose zeros of the angle differ."""
    experiment = cart_pendulum(
        horizon=1.0,
        fit={"bootstrap": 0, "segments": "whole"},
        nuisance={"bias": {"qpos:hinge": True}, "per_recording": True},
    )
    made = fit_of(experiment, 0, 1)
    shift = np.array(made.system.outputs.names) == "qpos:hinge"
    pairs = zip(made.recordings, BIASES, strict=True)
    logs = [replace(log, y=log.y + bias * shift) for log, bias in pairs]
    return fit_task(searched(FitTask.of(made.system, logs)))


def searched(task: FitTask, events: list[FitEvent] | None = None) -> FitSearch:
    """Searches of a task."""
    return FitSearch(task=task, budget=Budget(), callback=None if events is None else events.append)


@pytest.fixture
def begins(monkeypatch: pytest.MonkeyPatch) -> list[UnknownValues]:
    """Unknowns at which searches begin."""
    found: list[UnknownValues] = []

    def recorded(problem: FitProblem, start: UnknownValues, *others: Any) -> Solution | None:
        """Search as always."""
        found.append(start)
        return minimise(problem, start, *others)

    monkeypatch.setattr("mjfim.identification.search.minimise", recorded)
    return found


@pytest.mark.slow
def test_a_model_with_more_states_begins_at_its_own_initial_states(tmp_path: Path) -> None:
    """Backlash adds a joint, whose initial states a fit without it does not have."""
    segments = {"segments": 0.5, "start": "measured", "bootstrap": 0}
    gap = {"target": "term/extra:gap", "true": 0.06, "guess": 0.03}
    richer = experiment_of(tmp_path, "backlash", fit=segments, parameters={**KNOWN, "gap": gap})
    richer = System.resolve(richer)
    plain = experiment_of(tmp_path, "tilt", parameters=KNOWN, terms={}, fit=segments)
    plain = System.resolve(plain)
    recording = recorded(plain, motor_torque(2.0, 100.0), 0)
    fitted = fit_task(searched(FitTask.of(plain, [recording])))
    task = FitTask.of(richer, [recording])
    assert [each.private_count for each in (fitted.problem, task.problem())] == [2, 4]
    again = refit_task(searched(task), fitted, other_start=np.array([0.01, 0.01]))
    assert again.solution.unknowns.private.shape == (len(fitted.problem.segments), 4)
    assert np.isfinite(again.solution.cost)


def test_known_tests_of_terms_are_not_repeated(
    fitted: FitResult, monkeypatch: pytest.MonkeyPatch
) -> None:
    def fail(*args: object) -> TermTests:
        """Fail where terms are tested."""
        raise AssertionError("terms were tested again")

    monkeypatch.setattr("mjfim.identification.assessment.report.find_missing_terms", fail)
    assert estimate_from(fitted, Budget(), tests=TermTests()).missing_terms == ()
    with pytest.raises(AssertionError, match="again"):
        estimate_from(fitted, Budget())

"""Missing terms are found from the residuals of a model; a complete model has none."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import scipy

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System
from mjfim.identification.assessment import term_tests
from mjfim.identification.assessment.term_candidates import Candidate, Effect
from mjfim.identification.assessment.term_tests import TermTests, find_missing_terms
from mjfim.identification.identify import identify_system
from mjfim.identification.search import FitTask
from mjfim.records.trajectory import Recording
from tests.support.cart_pendulum import cart_pendulum, fit_of, logs_of
from tests.support.numerics import Array, Loop, require_found
from tests.support.terms import experiment_of, motor_torque, recorded, write_pendulum

CONTROL = {"kind": "multisine", "amplitude": 4.0, "frequency": 0.4, "harmonics": 6}
DAMPED = {"d": {"target": "joint/pivot:damping"}}


def stated(**tables: object) -> mjfim.Experiment:
    """The cart-pendulum under a multisine."""
    return cart_pendulum(initial={"control": CONTROL}, fit={"bootstrap": 0}, **tables)


def rubbing_pendulum(folder: Path) -> Recording:
    """A recording of the pendulum with dry friction; its model without it is in the folder."""
    system = System.resolve(experiment_of(folder, "stribeck"))
    recording = recorded(system, motor_torque(0.6, 100.0), 0)
    write_pendulum(folder)
    return recording


@pytest.mark.slow
def test_a_small_term_that_matters_is_found_in_much_data() -> None:
    """A constant force of 6 standard deviations is less than 2e-3 of the squares of this log."""
    task = DesignTask.resolve(stated(horizon=60.0))
    system, ctrl = task.system, task.initial.ctrl

    def tested(force: float, seed: int) -> TermTests:
        """Tests of a log in which a constant force acts that the control does not show."""
        log = replace(recorded(system, ctrl + force, seed), ctrl=ctrl)
        problem = FitTask.of(system, [log]).problem()
        return find_missing_terms(problem, problem.begin(system.parameters.true))

    def tilt(tests: TermTests) -> float:
        """Its deviation from zero, in standard deviations; 0 where it is not significant."""
        return max((t.sigmas for t in tests.terms if t.path == "option:gravity[0]"), default=0.0)

    force = 0.01
    large = tilt(tested(force, 0))
    found = tested(6.0 * force / large, 1)
    assert tilt(found) > 0.0
    assert max(term.share for term in found.terms) < 2.2e-3
    assert tested(0.0, 0).terms == ()
    assert "could move" in found.data.unseen_sentence


@pytest.mark.slow
def test_a_bias_and_a_delay_are_found() -> None:
    experiment = stated(horizon=2.0).replace(fit={"segments": "whole"})
    (clean,) = logs_of(experiment, 1)
    biased = mjfim.identify(experiment, [replace(clean, y=clean.y + 0.03 * np.eye(4)[3])])
    assert biased.missing_terms[0].path == "output/qvel:hinge:bias"
    assert biased.missing_terms[0].main.value == pytest.approx(0.03, rel=0.4)
    late = replace(clean, t=clean.t[2:] - clean.t[2], ctrl=clean.ctrl[2:], y=clean.y[:-2])
    lagging = mjfim.identify(experiment, [late])
    assert lagging.missing_terms[0].path == "output:delay"
    assert "or a lag of force" in lagging.causes[0]
    assert "which the log hardly tells apart" in lagging.causes[0]


def test_the_move_by_an_unseen_term_is_that_of_least_squares(
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """It is compared with a plain linear fit of the effect of the term."""
    task = DesignTask.resolve(stated(horizon=4.0), threads=1)
    system, theta, ctrl = task.system, task.system.parameters.guess, task.initial.ctrl
    tilt = "option:gravity[0]"
    candidates, _ = term_tests.candidates_of(system, np.ones(system.space.nv))
    chosen = [each for each in candidates if each.tested[0].path == tilt]
    monkeypatch.setattr(term_tests, "candidates_of", lambda *_: (chosen, []))
    monkeypatch.setattr(term_tests, "LEAST_SAID_MOVE", 0.0)

    added = {"tilt": {"target": tilt, "scale": 1.0}}
    extended = System.resolve(task.experiment.replace(parameters=added), threads=1)
    _, J = extended.plant.derivatives.predict(np.append(theta, 0.0), ctrl)
    rows = (J / extended.noise.sigma[:, None]).reshape(-1, len(theta) + 1)
    move, (squares,), *_ = np.linalg.lstsq(rows[:, :-1], rows[:, -1])
    missed = (-scipy.special.ndtri(0.5e-3) + scipy.special.ndtri(0.95)) / np.sqrt(squares)
    expected = dict(zip(system.parameters.names, np.abs(missed * move) / theta, strict=True))

    log = recorded(system, ctrl, theta=theta, share=1e-3)
    problem = FitTask.of(system, [log]).problem()
    data = find_missing_terms(problem, problem.begin(theta)).data
    assert data.unseen
    for name, (share, words) in data.unseen:
        assert words == "a tilt of the base along x"
        assert share == pytest.approx(expected[name], rel=1e-2)
        assert f"{name} by {100 * share:.2g} %" in data.unseen_sentence


def test_a_term_for_which_a_parameter_stands_moves_nothing() -> None:
    """A mass that is a parameter hides a payload at the same place."""
    task = fit_of(stated(horizon=4.0), 0)
    problem = task.problem()
    at = problem.begin(task.system.parameters.true)
    assert "payload" not in find_missing_terms(problem, at).data.unseen_sentence


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2])
def test_feedback_on_noisy_measurements_is_no_delay(seed: int) -> None:
    """The noise of a measurement moves the robot afterwards, which looked like a delay."""
    task = DesignTask.resolve(stated())
    system, plan = task.system, task.initial
    true = system.parameters.true
    loop = Loop(system.plant.model(true), system.grid.substeps)
    noise = system.noise.sample(len(plan.t), np.random.default_rng(seed))
    states, sent = [plan.state[0]], []
    for k, planned in enumerate(plan.ctrl):
        deviation = plan.state[k] - states[-1] - noise[k]
        sent.append(planned + 20.0 * (deviation[0] + deviation[2]))
        states.append(loop.F(states[-1], sent[-1]))
    y = np.array(states) + noise
    log = Recording(t=plan.t, ctrl=np.array(sent), y=y, outputs=system.outputs.names)

    found = identify_system(system, [log])
    assert not found.missing_terms
    require_found(found, true, 3.0)


def with_failing(path: str, monkeypatch: pytest.MonkeyPatch) -> None:
    """Test a further candidate, a strange spring, between the others."""
    number = Effect(path=path, unit="", value=-1e9, begin=-1e9, size=1.0)
    failing = Candidate(description="a strange spring", tested=(number,))
    usual = term_tests.candidates_of

    def extended(system: System, speeds: Array) -> tuple[list[Candidate], list[str]]:
        """The candidates, of which the third one fails."""
        found, impossible = usual(system, speeds)
        return [*found[:2], failing, *found[2:]], impossible

    monkeypatch.setattr(term_tests, "candidates_of", extended)


@pytest.mark.parametrize("path", ["joint/pivot:stiffness", "joint/pivot:nothing"])
def test_a_candidate_that_diverges_or_is_invalid_is_named_and_hides_no_other(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, path: str
) -> None:
    """Without it, the same terms are found."""
    stated = experiment_of(tmp_path, "tilt", terms={}, parameters=DAMPED)
    task = FitTask.of(System.resolve(stated, threads=1), [rubbing_pendulum(tmp_path)])
    problem = task.problem()
    at = problem.begin(task.start)
    usual = find_missing_terms(problem, at)
    assert not usual.data.untested
    assert "joint/pivot:frictionloss" in {term.path for term in usual.terms}

    with_failing(path, monkeypatch)
    found = find_missing_terms(problem, at)
    assert found.data.untested == ("a strange spring",)
    assert [term.path for term in found.terms] == [term.path for term in usual.terms]
    assert found.remark.endswith("cannot have it: a strange spring.")

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
from tests.support.cart_pendulum import cart_pendulum, logs_of
from tests.support.numerics import Array
from tests.support.paths import ROOT
from tests.support.terms import experiment_of, motor_torque, recorded, write_pendulum

CONTROL = {"kind": "multisine", "amplitude": 4.0, "frequency": 0.4, "harmonics": 6}
DAMPED = {"d": {"target": "joint/pivot:damping"}}


def stated(**tables: object) -> mjfim.Experiment:
    """The cart-pendulum under a multisine."""
    return cart_pendulum(initial={"control": CONTROL}, fit={"bootstrap": 0}, **tables)


def robot(folder: Path, old: str, new: str, **tables: object) -> Recording:
    """A recording of a robot whose model differs in one place."""
    text = (ROOT / "models" / "cart_pendulum.xml").read_text(encoding="utf-8")
    assert text.count(old) == 1
    (folder / "cart_pendulum.xml").write_text(text.replace(old, new), encoding="utf-8")
    other = mjfim.Experiment(
        **{**stated(**tables).model_dump(exclude_unset=True), "directory": folder}
    )
    return logs_of(other, 0)[0]


def rubbing_pendulum(folder: Path) -> Recording:
    """A recording of the pendulum with dry friction; its model without it is in the folder."""
    system = System.resolve(experiment_of(folder, "stribeck"))
    recording = recorded(system, motor_torque(0.6, 100.0), 0)
    write_pendulum(folder)
    return recording


@pytest.mark.parametrize(
    ("added", "path", "amount", "horizon"),
    [
        ('frictionloss="0.5"', "joint/slide:frictionloss", 0.5, 2.0),
        ('damping="0.6"', "joint/slide:damping", 0.6, 4.0),
        ('stiffness="2"', "joint/slide:stiffness", 2.0, 3.0),
        ('armature="0.5"', "joint/slide:armature", 0.5, 2.0),
    ],
)
@pytest.mark.slow
def test_the_missing_term_comes_first_and_in_about_its_size(
    tmp_path: Path, added: str, path: str, amount: float, horizon: float
) -> None:
    recording = robot(tmp_path, 'axis="1 0 0"/>', f'axis="1 0 0" {added}/>', horizon=horizon)
    found = mjfim.identify(stated(), [recording])
    assert found.misfit
    rank = [s.path for s in found.missing_terms].index(path)
    assert rank == 0 or path.endswith("armature")  # the bob's inertia does nearly the same
    first = found.missing_terms[rank]
    assert first.sigmas > 5.0
    assert amount / 2.0 < first.main.value < 2.0 * amount
    assert any(path in sentence for sentence in found.warnings)


@pytest.mark.slow
def test_a_small_term_that_matters_is_found_in_much_data() -> None:
    """A constant force of 6 standard deviations is less than 2e-3 of the squares of this log."""
    task = DesignTask.resolve(stated(horizon=60.0))
    system, true = task.system, task.system.parameters.true

    def tested(force: float, seed: int) -> TermTests:
        """Tests of a log in which a constant force acts that the control does not show."""
        outputs, _ = system.plant.measure(true[None], task.initial.ctrl + force)
        noise = system.noise.sample(len(outputs[0]), np.random.default_rng(seed))
        recording = Recording(
            t=system.dt * np.arange(len(noise)),
            ctrl=task.initial.ctrl,
            y=outputs[0] + noise,
            outputs=system.outputs.names,
        )
        fit = FitTask.of(system, [recording])
        problem = fit.problem()
        return find_missing_terms(problem, fit.recordings, problem.begin(true))

    def tilt(tests: TermTests) -> float:
        """Its deviation from zero, in standard deviations; 0 where it is not significant."""
        return max((t.sigmas for t in tests.terms if t.path == "option:gravity[0]"), default=0.0)

    force = 0.01
    large = tilt(tested(force, 0))
    found = [tested(6.0 * force / large, seed) for seed in range(2)]
    assert all(tilt(tests) > 0.0 for tests in found)
    assert max(term.share for tests in found for term in tests.terms) < 2.2e-3
    assert tested(0.0, 0).terms == ()
    assert found[0].data is not None
    assert "could move" in found[0].data.unseen_sentence


@pytest.mark.slow
def test_a_bias_and_a_delay_are_found() -> None:
    experiment = stated(horizon=2.0)
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
    """It is compared with differences of whole simulations and a plain linear fit."""
    task = DesignTask.resolve(stated(horizon=4.0), threads=1)
    system, theta = task.system, task.system.parameters.guess
    tilt, size = "option:gravity[0]", 1e-4 * 9.81
    candidates, _ = term_tests.candidates_of(system, np.ones(system.space.nv))
    chosen = [each for each in candidates if each.tested[0].path == tilt]
    monkeypatch.setattr(term_tests, "candidates_of", lambda *_: (chosen, []))
    monkeypatch.setattr(term_tests, "LEAST_SAID_MOVE", 0.0)

    extended = System.resolve(
        stated(horizon=4.0).replace(parameters={"tilt": {"target": tilt, "scale": size}}), threads=1
    )

    def outputs(values: Array) -> Array:
        """Readings in standard deviations, one after the other."""
        y, _ = extended.plant.measure(np.array(values)[None], task.initial.ctrl)
        return np.asarray(y[0] / extended.noise.sigma).ravel()

    at = np.append(theta, 0.0)
    steps = np.diag(np.append(1e-5 * theta, size))
    J = np.array([(outputs(at + step) - outputs(at - step)) / (2.0 * step.max()) for step in steps])
    own, of_tilt = J[:-1].T, J[-1]
    move, *_ = np.linalg.lstsq(own, of_tilt, rcond=None)
    left = np.linalg.norm(of_tilt - own @ move)
    missed = (-scipy.special.ndtri(0.5e-3) + scipy.special.ndtri(0.95)) / left
    expected = np.abs(missed * move) / theta

    exact = system.plant.measure(theta[None], task.initial.ctrl)[0][0]
    log = Recording(
        t=system.dt * np.arange(len(exact)),
        ctrl=task.initial.ctrl,
        y=exact + 1e-3 * system.noise.sample(len(exact), np.random.default_rng(0)),
        outputs=system.outputs.names,
    )
    problem = FitTask.of(system, [log]).problem()
    data = find_missing_terms(problem, [log], problem.begin(theta)).data
    assert data is not None and data.unseen
    for name, (share, words) in data.unseen:
        assert words == "a tilt of the base along x"
        index = system.parameters.names.index(name)
        assert share == pytest.approx(expected[index], rel=1e-2)
        assert f"{name} by {100 * share:.2g} %" in data.unseen_sentence


def test_a_term_for_which_a_parameter_stands_moves_nothing() -> None:
    """A mass that is a parameter hides a payload at the same place."""
    system = System.resolve(stated(horizon=4.0), threads=1)
    log = logs_of(stated(horizon=4.0), 0)[0]
    problem = FitTask.of(system, [log]).problem()
    data = find_missing_terms(problem, [log], problem.begin(system.parameters.true)).data
    assert data is not None
    assert "payload" not in data.unseen_sentence


def played_with_feedback(task: DesignTask, gain: float, seed: int) -> Recording:
    """A log of a controller whose gain acts on noisy measurements of the slide."""
    system, plan = task.system, task.initial
    rng = np.random.default_rng(seed)
    model = system.plant.model(system.parameters.true)
    state = np.array(plan.state[0])

    measured, sent = [], []
    for k, planned in enumerate(plan.ctrl):
        measured.append(state[:4] + system.noise.sigma * rng.standard_normal(4))
        deviation = plan.state[k][:4] - measured[-1]
        sent.append(planned + gain * (deviation[0] + deviation[2]))
        played = system.plant.simulator.rollout([model], state[None], sent[-1][None, None])
        state = np.array(played.states[0][1])
    measured.append(state[:4] + system.noise.sigma * rng.standard_normal(4))

    times = system.dt * np.arange(len(measured))
    names = system.outputs.names
    return Recording(t=times, ctrl=np.array(sent), y=np.array(measured), outputs=names)


@pytest.mark.slow
@pytest.mark.parametrize("seed", [0, 2])
def test_feedback_on_noisy_measurements_is_no_delay(seed: int) -> None:
    """The noise of a measurement moves the robot afterwards, which looked like a delay."""
    task = DesignTask.resolve(stated())
    found = identify_system(task.system, [played_with_feedback(task, gain=20.0, seed=seed)])
    assert not found.missing_terms
    assert not found.misfit
    assert (np.abs(found.theta - task.system.parameters.true) < 3.0 * found.std).all()


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
    usual = find_missing_terms(problem, task.recordings, at)
    assert usual.data is not None and not usual.data.untested
    assert "joint/pivot:frictionloss" in {term.path for term in usual.terms}

    with_failing(path, monkeypatch)
    found = find_missing_terms(problem, task.recordings, at)
    assert found.data is not None and found.data.untested == ("a strange spring",)
    assert [term.path for term in found.terms] == [term.path for term in usual.terms]
    assert found.remark.endswith("cannot have it: a strange spring.")

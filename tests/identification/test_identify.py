"""Least squares against theory and against a brute-force minimiser."""

from __future__ import annotations

import re
import signal
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal
from scipy.optimize import minimize
from scipy.stats import chi2

import mjfim
from mjfim.errors import ExperimentError, RecordingError
from mjfim.excitation.design import design_task
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import simulate_system
from mjfim.identification.assessment import report
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import identify, identify_system, least_squares
from mjfim.identification.search import NEWTON
from mjfim.optimize.levenberg_marquardt import SearchSettings
from mjfim.output.pages import page_of
from mjfim.records.events import FitEvent, stages_observed_by
from mjfim.records.trajectory import Recording
from mjfim.studies.campaign import identify_all
from tests.support.cart_pendulum import cart_pendulum, logs_of
from tests.support.numerics import make_task
from tests.support.terms import recorded


@pytest.fixture(scope="module")
def task() -> DesignTask:
    """The cart-pendulum for two seconds, with a design of few iterations."""
    return DesignTask.resolve(cart_pendulum(horizon=2.0, descent={"max_iterations": 10}))


@pytest.fixture(scope="module")
def design(task: DesignTask) -> mjfim.Design:
    return design_task(task)


@pytest.fixture(scope="module")
def recording(task: DesignTask, design: mjfim.Design) -> Recording:
    return simulate_system(task.system, design.trajectory, seed=3)


# A fit that compares no lengths of segments where the model does not explain the recording.
WHOLE = {"segments": "whole"}


@pytest.fixture(scope="module")
def estimate(task: DesignTask, recording: Recording) -> mjfim.Estimate:
    """The estimate from the recording."""
    return identify_system(task.system, [recording])


def test_both_methods_find_the_minimum_of_the_weighted_squares(
    task: DesignTask, recording: Recording
) -> None:
    fit = FitProblem.of(task.system, [recording])

    def cost(theta: np.ndarray) -> float:
        y, _ = task.plant.measure(theta[None], recording.ctrl)
        return float(np.sum(((y[0, 1:] - recording.y[1:]) / 0.05) ** 2))

    options = {"xatol": 1e-8, "fatol": 1e-10, "maxiter": 400}
    slow = minimize(cost, task.parameters.true, method="Nelder-Mead", options=options)
    newton = replace(fit, bounded=False)
    for problem, settings in ((fit, SearchSettings()), (newton, NEWTON)):
        solution = least_squares(problem, task.parameters.guess, settings)
        assert solution.success
        theta = solution.unknowns.theta
        assert cost(theta) <= slow.fun + 1e-5
        assert_allclose(theta, slow.x, atol=1e-5)


def test_newton_outside_the_bounds_is_no_success(recording: Recording) -> None:
    tight = cart_pendulum(parameters={"c": {"bounds": [1.2, 10.0], "true": 1.3}})
    y = np.where(np.arange(201)[:, None] % 7 == 3, np.nan, recording.y)[:, :3]
    part = replace(recording, y=y, outputs=recording.outputs[:3])
    estimate = identify(tight, [part], method="newton")
    assert not estimate.converged
    assert estimate.dof == np.isfinite(y[1:]).sum() - 3
    assert any("outside its bounds" in sentence for sentence in estimate.warnings)


def test_misuse_is_refused(task: DesignTask, recording: Recording) -> None:
    with pytest.raises(RecordingError, match="at least one"):
        identify_system(task.system, [])
    with pytest.raises(ExperimentError, match="least_squares"):
        identify(task.experiment, [recording], method="lm")  # type: ignore[arg-type]
    with pytest.raises(ExperimentError, match="m, l, c"):
        identify_system(task.system, [recording], start=np.ones(2))


def test_an_interrupted_search_keeps_the_best_result_so_far(
    task: DesignTask, recording: Recording
) -> None:
    """Ctrl-C is pressed in the second iteration."""
    costs: list[float] = []

    def show(event: FitEvent) -> None:
        costs.append(event.cost)
        if len(costs) == 2:
            signal.raise_signal(signal.SIGINT)

    found = identify_system(task.system, [recording], callback=show)
    assert found.interrupted and not found.converged
    assert found.status.startswith("interrupted")
    assert found.chi2 == pytest.approx(2.0 * min(costs), rel=1e-9)
    assert found.predictions == ()


def test_a_complete_model_has_the_cramer_rao_bound_and_no_misfit(
    design: mjfim.Design, estimate: mjfim.Estimate
) -> None:
    assert_allclose(estimate.std, design.final.std, rtol=0.05)
    assert_allclose(np.sqrt(np.diag(estimate.covariance)), estimate.std, rtol=1e-8)
    assert estimate.dof == 200 * 4 - 3
    assert estimate.restart is None and estimate.horizons is None
    assert 0.001 < chi2.sf(estimate.chi2, estimate.dof) < 0.999
    assert not estimate.misfit


@pytest.mark.parametrize("name", ["find_missing_terms", "predict_unfitted"])
def test_an_interruption_after_the_search_keeps_the_estimate(
    task: DesignTask,
    recording: Recording,
    estimate: mjfim.Estimate,
    name: str,
    monkeypatch: pytest.MonkeyPatch,
) -> None:
    """Ctrl-C is pressed during the test for missing terms, or during the predictions."""
    usual = getattr(report, name)

    def pressed(*arguments: Any, **settings: Any) -> Any:
        """Press Ctrl-C, and go on as always."""
        signal.raise_signal(signal.SIGINT)
        return usual(*arguments, **settings)

    monkeypatch.setattr(report, name, pressed)
    found = identify_system(task.system, [recording])
    assert estimate.predictions and not estimate.interrupted
    assert found.interrupted and found.predictions == ()
    assert_array_equal(found.theta, estimate.theta)
    assert any(sentence.startswith("interrupted after the search") for sentence in found.warnings)


def test_an_interrupted_round_of_a_campaign_is_not_kept(
    task: DesignTask, recording: Recording
) -> None:
    """Ctrl-C is pressed in the second iteration."""

    def interrupt(event: FitEvent) -> None:
        if event.iteration == 2:
            signal.raise_signal(signal.SIGINT)

    guess = task.parameters.guess
    assert identify_all(task, [recording], guess, callback=interrupt) is None


def test_an_interruption_between_starts_keeps_the_earlier_ones(
    task: DesignTask, recording: Recording, estimate: mjfim.Estimate
) -> None:
    """Results of earlier starts count; there is no search from a later start."""
    several = DesignTask.resolve(task.experiment.replace(fit={"starts": 6}))
    searched: list[int] = []

    def show(stage: str, number: int, count: int) -> None:
        """Press Ctrl-C after the second random start."""
        if stage == "searching from random starts":
            searched.append(number)
            if number == 2:
                signal.raise_signal(signal.SIGINT)

    with stages_observed_by(show):
        found = identify_system(several.system, [recording])
    assert found.interrupted
    assert searched == [1, 2]
    assert_allclose(found.theta, estimate.theta, rtol=1e-3)


@pytest.mark.slow
def test_a_robust_fit_tests_the_size_of_its_residuals(
    task: DesignTask, recording: Recording
) -> None:
    """The stated noise is no misfit; three times the noise is said."""
    robust = task.experiment.replace(fit={"loss": "soft_l1", "loss_scale": 1.0})
    right = identify(robust, [recording])
    assert right.chi2 / right.dof == pytest.approx(1.0, abs=0.15)
    assert not right.misfit
    assert not any("stated σ is too large" in sentence for sentence in right.warnings)
    truth = recorded(task.system, recording.ctrl, share=0.0).y
    loud = replace(recording, y=truth + 3.0 * (recording.y - truth))
    assert "times what you stated" in page_of(identify(robust, [loud])).verdict.sentence


@pytest.mark.slow
def test_a_parameter_that_the_logs_do_not_determine_is_named_with_the_reason() -> None:
    """Dry friction that the robot does not have, beside the viscous friction that it has."""
    path = "joint/hinge:frictionloss"
    rub = {"target": path, "guess": 0.02, "true": 0.0, "bounds": [0.0, 1.0]}
    stated = cart_pendulum(horizon=2.0, fit={"bootstrap": 0}, parameters={"rub": rub})
    estimate = identify(stated, logs_of(stated, 1))
    j = estimate.parameters.index("rub")
    low, high = estimate.interval[j]
    assert high - low > estimate.theta[j]
    (sentence,) = [text for text in estimate.warnings if "rub is not determined" in text]
    for words in (f"{low:.3g} to {high:.3g} N m", "at the guess", "at the estimate", "; it is"):
        assert words in sentence
    assert sentence not in estimate.details
    assert "rub (not determined)" in estimate.verdict.sentence


def _squared(spec: Any, value: float) -> None:
    """Damping of the slide as the square of a value."""
    spec.joint("slide").damping = [value**2, 0.0, 0.0]


@pytest.mark.slow
@pytest.mark.parametrize(("seed", "is_at_zero"), [(0, False), (2, True)])
def test_a_parameter_whose_effect_vanishes_at_the_estimate_is_named_and_no_other(
    seed: int, *, is_at_zero: bool
) -> None:
    """The derivative of the damping is proportional to the value, whose true value is 0."""
    parameters = {"root": {"function": _squared, "guess": 1.5, "true": 0.0, "bounds": [0.0, 2.0]}}
    parameters |= {
        n: {"guess": v, "prior": 1e-3} for n, v in zip("mlc", (2.0, 1.0, 1.0), strict=True)
    }
    stated = cart_pendulum(horizon=2.0, fit={"bootstrap": 0}, parameters=parameters)
    estimate = identify(stated, logs_of(stated, seed))
    lost = "much less at the estimate than at the guess"
    if is_at_zero:
        lost = "not identifiable separately: root"
        assert estimate.theta[-1] == 0.0 and np.isinf(estimate.std[-1])
    (sentence,) = [text for text in estimate.warnings if lost in text]
    assert "root" in sentence
    assert_allclose(estimate.std[:3], 1e-3, rtol=0.05)


@pytest.mark.slow
def test_a_misfit_is_the_reason_where_noise_alone_would_determine_a_parameter() -> None:
    """An error of the readings that is no white noise widens the interval twelvefold."""
    fit = {"segments": "whole", "bootstrap": 0}
    stated = cart_pendulum(horizon=1.2, noise={"state": 0.01}, fit=fit)
    (log,) = logs_of(stated, 0)
    y = np.array(log.y)
    y[:, 3] += 0.06 * np.sin(2.0 * np.pi * log.t / 0.3)
    estimate = identify(stated, [replace(log, y=y)])
    assert estimate.misfit
    c = estimate.parameters.index("c")
    assert estimate.std[c] < 0.1 * estimate.theta[c]
    (sentence,) = [text for text in estimate.warnings if "c is not determined" in text]
    assert "wider than white noise would" in sentence
    assert "smaller than the noise" not in sentence
    assert "Design an experiment" not in " ".join(page_of(estimate).next_steps)


def test_an_entry_of_a_vector_is_known_compared_with_the_whole_vector(tmp_path: Path) -> None:
    """A coordinate near zero is not sloppy, because a share of it would say nothing."""
    model = """<mujoco>
      <option timestep="0.01"/>
      <worldbody><body name="rod">
        <joint name="hinge" axis="0 1 0" damping="0.1"/>
        <inertial pos="0 0 -0.4" mass="1" diaginertia="1e-2 1e-2 1e-2"/>
      </body></worldbody>
      <actuator><motor name="motor" joint="hinge"/></actuator>
    </mujoco>"""
    task = make_task(
        model,
        tmp_path,
        horizon=1.0,
        parameters={"x": {"target": "body/rod:ipos[0]"}, "z": {"target": "body/rod:ipos[2]"}},
        noise={"qpos:hinge": 1e-3},
        fit={"bootstrap": 0},
    )
    estimate = identify_system(task.system, [simulate_system(task.system, task.initial, seed=1)])
    half_width = 0.5 * np.ptp(estimate.interval, axis=1)
    assert half_width[0] > 0.25 * abs(estimate.theta[0])
    assert half_width[0] < 0.05 * estimate.sizes[0]
    assert estimate.sizes[0] >= 0.4
    assert not estimate.sloppy
    assert not any("by these logs" in text or "known to" in text for text in estimate.warnings)
    assert re.search(r"every parameter is known to ± [\d.]+ % or better", estimate.verdict.sentence)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("parameters", "kept"),
    [({"m": {"bounds": [2.2, 3.0], "true": 2.4}}, 2.2), ({"m": {"prior": 1e-4}}, 2.5)],
    ids=["bound", "prior"],
)
def test_bounds_and_priors_keep_the_estimate(
    recording: Recording, parameters: dict[str, Any], kept: float
) -> None:
    estimate = identify(cart_pendulum(parameters=parameters, fit=WHOLE), [recording])
    assert estimate.theta[0] == pytest.approx(kept, abs=1e-3)
    is_bounded = "bounds" in parameters["m"]
    assert estimate.at_bound == (("m",) if is_bounded else ())
    assert is_bounded or estimate.std[0] < 1.01e-4


def stated(hold: tuple[str, ...]) -> mjfim.Experiment:
    """The cart-pendulum, one parameter of which is held at its true value."""
    fit = {"bootstrap": 0, "hold": hold}
    return cart_pendulum(horizon=1.0, parameters={"c": {"guess": 1.0}}, fit=fit)


@pytest.mark.slow
def test_a_held_parameter_keeps_its_guess_and_the_others_are_fitted() -> None:
    logs = logs_of(stated(()), 0)
    found = mjfim.identify(stated(("c",)), logs, threads=1)
    free = mjfim.identify(stated(()), logs, threads=1)
    assert found.converged
    assert found.held == ("c",)
    assert (found.theta[2], found.std[2], *found.interval[2]) == (1.0, 0.0, 1.0, 1.0)

    # What is known about one parameter makes the others more accurate, and does not bias them.
    assert (found.std[:2] < free.std[:2]).all()
    assert (np.abs(found.theta[:2] - [2.0, 1.0]) < 4.0 * found.std[:2]).all()

    assert "held" in page_of(found).tables[0].rows[2].cells


@pytest.mark.parametrize(
    ("hold", "message"),
    [
        (("d",), r"fit\.hold: unknown parameter 'd'"),
        (("m", "l", "c"), r"fit\.hold: all parameters are held"),
    ],
)
def test_what_cannot_be_held_is_refused(hold: tuple[str, ...], message: str) -> None:
    with pytest.raises(mjfim.MjfimError, match=message):
        mjfim.identify(stated(hold), logs_of(stated(()), 0), threads=1)

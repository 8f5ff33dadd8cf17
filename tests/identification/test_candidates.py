"""Terms that a model may lack: latencies of drivers, and terms that a model cannot have."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.experiment.system import System
from mjfim.identification.assessment.term_candidates import candidates_of
from mjfim.identification.assessment.term_tests import find_missing_terms
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import least_squares
from tests.support.closed_loop import arm_experiment
from tests.support.terms import recorded

LAW = {"kp": 40.0, "kd": 2.0, "rate": 500.0}
DAMPING = {"damping": {"target": "joint/elbow:damping", "true": 0.3, "guess": 0.5}}

FRICTION = """<mujoco><option integrator="{integrator}"/><worldbody><body name="cart">
  <joint name="slide" type="slide" axis="1 0 0" frictionloss="0.1"/><geom size="0.1"/>
  </body></worldbody><actuator><motor name="push" joint="slide"/></actuator></mujoco>"""

BRISTLE_SENTENCE = (
    "Stribeck friction of slide (with the integrator RK4, the bristle of 'stribeck' is unstable)"
)

SERVO_SENTENCE = (
    "friction that grows with the torque of push ('push' is no direct drive at a hinge with a name)"
)


def closed_loop(latency: float) -> mjfim.Experiment:
    """The two-joint arm under a law at either joint, of which that of the elbow is late."""
    laws = {"shoulder": LAW, "elbow": {**LAW, "latency": latency}}
    return arm_experiment(laws, parameters=DAMPING)


@pytest.mark.slow
def test_a_late_driver_is_the_first_missing_term() -> None:
    t = np.arange(600)[:, None] / 500.0
    references = 0.4 * np.sin(2.0 * np.pi * t * np.array([1.3, 2.1]) + np.array([0.0, 1.0]))
    log = mjfim.simulate(closed_loop(0.002), references, 1)

    problem = FitProblem.of(System.resolve(closed_loop(0.0)), [log])
    at = least_squares(problem, problem.system.parameters.guess).unknowns
    first = find_missing_terms(problem, [log], at).terms[0]

    assert first.path == "controller/elbow:latency"
    assert first.main.value == pytest.approx(0.002, rel=0.05)
    assert first.share > 0.99


def test_a_latency_that_is_a_parameter_is_no_missing_term() -> None:
    experiment = closed_loop(0.002)
    known = experiment.replace(parameters={"late": {"target": "controller/elbow:latency"}})
    before, after = (
        {each.tested[0].path for each in candidates_of(System.resolve(stated), np.ones(2))[0]}
        for stated in (experiment, known)
    )
    assert before - after == {"controller/elbow:latency"}
    assert {"controller/shoulder:latency", "controller/elbow:feedback_latency"} <= after


@pytest.mark.slow
@pytest.mark.parametrize("integrator", ["RK4", "implicitfast"])
def test_terms_that_a_model_cannot_have_are_named(integrator: str, tmp_path: Path) -> None:
    """The estimate says so where it does not explain the data."""
    path = tmp_path / "cart.xml"
    path.write_text(FRICTION.format(integrator=integrator), encoding="utf-8")
    experiment = mjfim.Experiment(
        model=str(path),
        rate=100.0,
        noise={"state": 1e-3},
        parameters={"friction": {"target": "joint/slide:frictionloss"}},
    )
    words = [BRISTLE_SENTENCE] * (integrator == "RK4") + [SERVO_SENTENCE]
    system = System.resolve(experiment)
    log = recorded(system, 2.0 * np.sin(0.1 * np.arange(300))[:, None])
    problem = FitProblem.of(system, [log])
    tests = find_missing_terms(problem, [log], problem.begin(system.parameters.guess))
    assert list(tests.data.impossible) == words
    assert words[0] in tests.remark
    assert words[0] in str(tests.data.summary()["impossible"])

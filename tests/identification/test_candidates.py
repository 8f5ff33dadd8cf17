"""Terms that a model may lack: payloads, latencies, and terms that it cannot have."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
from scipy.spatial.transform import Rotation

import mjfim
from mjfim.experiment.initial import multisine
from mjfim.experiment.system import System
from mjfim.identification.assessment.term_candidates import candidates_of
from mjfim.identification.assessment.term_tests import find_missing_terms
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.identify import least_squares
from tests.support.closed_loop import ARM, arm_experiment
from tests.support.numerics import require_found
from tests.support.terms import recorded

DAMPINGS: dict[str, Any] = {
    "d1": {"target": "joint/shoulder:damping", "guess": 0.6},
    "d2": {"target": "joint/elbow:damping", "guess": 0.2},
}
NOISE = {"qpos:shoulder": 1e-3, "qpos:elbow": 1e-3}

# A hand that is welded to a wrist with two hinges, whose frame is turned and whose base is free.
SPATIAL = """<mujoco><worldbody><body name="base"><freejoint/><geom size="0.1"/>
  <body name="fore" pos="0 0 0.3"><joint name="roll" axis="0 0 1"/><geom size="0.05"/>
    <body name="wrist" pos="0.2 0 0" euler="0 90 0"><joint name="pitch" axis="0 1 0"/>
      <inertial pos="0 0.01 0.05" mass="0.5" diaginertia="1e-3 1e-3 1e-3"/>
      <body name="hand" pos="0 0 0.1"><geom size="0.03" mass="0.1"/></body>
    </body>
  </body>
  <body name="other" pos="0 0 -0.3"><joint name="swing" axis="1 0 0"/>
    <geom size="0.05" pos="0 0 -0.2"/></body>
</body></worldbody></mujoco>"""

# A slide: its direction never changes, so that the place of a load has no effect.
SLIDE = """<mujoco><worldbody><body name="cart"><joint name="slide" type="slide" axis="1 0 0"/>
  <geom size="0.1"/></body></worldbody>
  <actuator><motor name="push" joint="slide"/></actuator></mujoco>"""


def planar_arm(**tables: Any) -> mjfim.Experiment:
    """The planar arm with two hinges."""
    stated: dict[str, Any] = {
        "model": str(ARM),
        "rate": 200.0,
        "initial": {"keyframe": "hanging"},
        "noise": NOISE,
        "parameters": DAMPINGS,
    }
    return mjfim.Experiment(**{**stated, **tables})


def payloads(experiment: mjfim.Experiment) -> list[tuple[str, str, list[float]]]:
    """Payloads that a model may lack: their words, and the axes and places that a fit finds."""
    system = System.resolve(experiment)
    found, _ = candidates_of(system, np.ones(system.space.nv))
    return [
        (
            each.description,
            "".join(number.path[-1] for number in each.further),
            [number.value for number in each.further],
        )
        for each in found
        if each.alone == "payload"
    ]


# Friction that grows with the torque of a motor is a contact with a ball.
WORM = {
    "terms": {"worm": {"kind": "load_dependent_friction", "actuator": "elbow"}},
    "parameters": {**DAMPINGS, "worm": {"target": "term/worm:coefficient", "guess": 0.05}},
}


def payloads_of(folder: Path, text: str, target: str) -> list[tuple[str, str, list[float]]]:
    """Payloads that a model may lack."""
    (folder / "robot.xml").write_text(text, encoding="utf-8")
    parameters = {"p": {"target": target, "scale": 1.0}}
    return payloads(
        planar_arm(
            model=str(folder / "robot.xml"),
            rate=100.0,
            noise={"state": 1e-3},
            parameters=parameters,
            initial={},
        )
    )


@pytest.mark.parametrize("tables", [{}, WORM], ids=["arm", "body of a term"])
def test_a_planar_robot_does_not_show_the_place_along_its_hinges(tables: dict[str, Any]) -> None:
    """Two places are tested at the last body: its centre of mass, and twice as far."""
    for (words, axes, places), z in zip(payloads(planar_arm(**tables)), (-0.15, -0.3), strict=True):
        assert (words, axes) == ("a payload at fore", "xz")
        assert places[1] == pytest.approx(z)


def test_a_planar_robot_whose_frame_is_turned_has_two_places_to_find(tmp_path: Path) -> None:
    """No axis of the last body is that of the hinges, along which the place has no effect."""
    text = """<mujoco><worldbody><body><joint name="a" axis="0 1 0"/><geom size="0.1"/>
      <body name="fore" pos="0 0 -0.3" euler="30 0 20"><joint name="b" axis="{axis}"/>
      <geom size="0.05" pos="0 0 -0.2"/></body></body></worldbody></mujoco>"""
    turned = Rotation.from_euler("XYZ", [30.0, 0.0, 20.0], degrees=True)
    axis = " ".join(map(str, turned.inv().apply([0.0, 1.0, 0.0])))
    found = payloads_of(tmp_path, text.format(axis=axis), "joint/b:damping")
    assert {len(axes) for _, axes, _ in found} == {2}


def test_payloads_are_tested_at_every_last_body(tmp_path: Path) -> None:
    """A welded hand is a part of the wrist, whose centre of mass contains it."""
    found = payloads_of(tmp_path, SPATIAL, "joint/pitch:damping")
    assert [each[:2] for each in found] == [
        *[("a payload at wrist", "xyz")] * 2,
        *[("a payload at other", "xyz")] * 2,
    ]
    assert found[0][2] == pytest.approx([0.0, 0.005 / 0.6, 0.035 / 0.6])


def test_a_slide_shows_the_mass_of_a_payload_alone(tmp_path: Path) -> None:
    assert [axes for _, axes, _ in payloads_of(tmp_path, SLIDE, "joint/slide:damping")] == [""]


@pytest.mark.parametrize(
    "tables",
    [
        {"terms": {"load": {"kind": "payload", "body": "fore"}}},
        {"parameters": {**DAMPINGS, "fore": {"inertial": "fore"}}},
    ],
)
def test_a_body_whose_inertia_is_unknown_needs_no_payload(tables: dict[str, Any]) -> None:
    assert not payloads(planar_arm(**tables))


@pytest.mark.slow
@pytest.mark.parametrize("mass", [0.5, 0.0])
def test_a_selection_finds_a_payload_and_its_place(mass: float) -> None:
    """Half a kilogram in a gripper; without it, no term is added."""
    values = {"mass": mass, "x": 0.04, "z": -0.27}
    true = {"d1": 0.8, "d2": 0.3}
    robot = planar_arm(
        terms={"load": {"kind": "payload", "body": "fore", "values": values}},
        parameters={name: {"guess": value, **DAMPINGS[name]} for name, value in true.items()},
    )
    system = System.resolve(robot)
    t = np.arange(400) / 200.0
    logs = []
    for seed in (1, 2):
        torque = multisine(t, 2, 0.4, 6, np.random.default_rng(seed)) * np.array([3.0, 1.2])
        logs.append(recorded(system, torque, seed, theta=np.array(list(true.values()))))

    found = mjfim.select_terms(planar_arm(), logs)
    if mass:
        true |= {f"fore_payload_{name}": value for name, value in values.items()}
    assert found.parameters == tuple(true)
    require_found(found, np.array(list(true.values())))


LAW: dict[str, Any] = {
    "kp": 40.0,
    "kd": 2.0,
    "rate": 500.0,
    "reference_velocity": "difference",
}
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


def closed_loop(**numbers: float) -> mjfim.Experiment:
    """The two-joint arm under a law at either joint, of which that of the elbow has own numbers."""
    laws = {"shoulder": LAW, "elbow": {**LAW, **numbers}}
    return arm_experiment(laws, parameters=DAMPING)


@pytest.mark.slow
@pytest.mark.parametrize(
    ("name", "change"), [("latency", 0.002), ("time_constant", 0.003), ("kp", 1.0), ("kd", 0.05)]
)
def test_numbers_of_a_driver_are_missing_terms(name: str, change: float) -> None:
    t = np.arange(600)[:, None] / 500.0
    references = 0.4 * np.sin(2.0 * np.pi * t * np.array([1.3, 2.1]) + np.array([0.0, 1.0]))
    references += 0.05 * np.sin(2.0 * np.pi * 14.0 * t)
    log = mjfim.simulate(closed_loop(**{name: LAW.get(name, 0.0) + change}), references, 1)

    problem = FitProblem.of(System.resolve(closed_loop()), [log])
    at = least_squares(problem, problem.system.parameters.guess).unknowns

    # A filter and a latency of the same delay explain the data about equally well.
    likely = {term.path: term for term in find_missing_terms(problem, at).likely}
    found = likely[f"controller/elbow:{name}"]
    assert found.main.value == pytest.approx(change, rel=0.3)
    assert found.share > 0.97


def test_a_latency_that_is_a_parameter_is_no_missing_term() -> None:
    experiment = closed_loop(latency=0.002)
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
    tests = find_missing_terms(problem, problem.begin(system.parameters.guess))
    assert list(tests.data.impossible) == words
    assert words[0] in tests.remark
    assert words[0] in str(tests.data.summary()["impossible"])

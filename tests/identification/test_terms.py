"""Identification of physical terms of the library from simulated logs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest
import scipy
from numpy.testing import assert_allclose

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System, simulate_system
from mjfim.identification.aligned_recording import align
from mjfim.identification.assessment import term_tests
from mjfim.identification.assessment.term_candidates import candidates_of
from mjfim.identification.assessment.term_tests import (
    equivalent_sigmas,
    find_missing_terms,
    with_names,
)
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.search import FitTask
from mjfim.identification.segments import KnownActivations
from mjfim.model.terms.library import KINDS
from mjfim.records.terms import Term, TermNumber
from mjfim.studies.selection import SIMILAR_SHARE
from tests.support.paths import MODELS
from tests.support.terms import (
    EXAMPLES,
    experiment_of,
    motor_torque,
    recorded,
    small_logs,
    solution_near,
    write_pendulum,
)

RATE = 100.0

# Starts of the search that are not those of the model, which has no effect of the term.
GUESSES: dict[str, dict[str, float]] = {
    "stribeck": {"excess": 0.02, "speed": 0.3},
    "lugre": {"coulomb": 0.02, "excess": 0.02, "speed": 0.3},
    "backlash": {"gap": 0.03},
    "payload": {"mass": 0.03, "z": -0.2},
}


def log_of(system: System, seed: int, duration: float = 2.0) -> Any:
    """A recording under slow sines."""
    return recorded(system, motor_torque(duration, RATE, seed), seed)


@pytest.mark.slow
@pytest.mark.parametrize("kind", KINDS)
def test_a_term_is_identified_from_a_log(tmp_path: Path, kind: str) -> None:
    parameters = {field: {"guess": value} for field, value in GUESSES.get(kind, {}).items()}
    experiment = experiment_of(tmp_path, kind, fit={"bootstrap": 0}).replace(parameters=parameters)
    system = System.resolve(experiment)
    found = mjfim.identify(experiment, [log_of(system, 1)])
    assert not found.misfit

    # The standard deviation is formal: it is compared at five of them.
    true, std = np.abs(system.parameters.true), found.std
    largest = np.minimum(5.0 * std + 1e-9, np.maximum(0.25 * true, 3.0 * std))
    assert (np.abs(found.theta - system.parameters.true) < largest).all()


@pytest.mark.parametrize("kind", ["stribeck", "actuator_lag"])
def test_activations_of_terms_are_no_unknowns_of_segments(tmp_path: Path, kind: str) -> None:
    """They follow from the control and the velocity, as the simulation has them."""
    experiment = experiment_of(tmp_path, kind, fit={"segments": 0.5}, noise={"angle": 1e-5})
    true = {field: {"guess": value} for field, value in EXAMPLES[kind][1].items()}
    system = System.resolve(experiment.replace(parameters=true))
    recording = log_of(system, 3, duration=3.0)
    problem = FitProblem.of(system, [recording])
    assert (problem.private_count, len(problem.segments)) == (2, 6)

    known = KnownActivations.of(system)
    assert known.addresses == [0]
    exact = system.plant.simulate(system.parameters.true, recording.ctrl)
    begins = np.array([0, 40, 130, 250])
    found = known.at(align(system, recording), begins, exact.qvel[begins])
    if kind == "actuator_lag":
        assert_allclose(found[0], recording.ctrl[0], atol=1e-4)
    tolerance = 1e-4 if kind == "actuator_lag" else 0.02 * np.abs(exact.act).max()
    assert_allclose(found[1:], exact.act[begins][1:], atol=tolerance)


# ---- models that lack a term

# Base parameters of the pendulum, which the term does not replace.
BASE = {
    "damping": {"target": "joint/pivot:damping"},
    "inertia": {"target": "body/rod:inertia[1]"},
    "friction": {"target": "joint/pivot:frictionloss"},
}

# Kind -> path of the main parameter of the candidate.
MISSED = {
    "stribeck": "term/pivot_stribeck:excess",
    "asymmetric_friction": "term/pivot_asymmetric_friction:offset",
    "actuator_lag": "term/motor_actuator_lag:time_constant",
    "load_dependent_friction": "term/motor_load_dependent_friction:coefficient",
    "joint_elasticity": "term/pivot_joint_elasticity:compliance",
    "backlash": "term/pivot_backlash:gap",
}


def without_term(folder: Path, kind: str) -> tuple[mjfim.Experiment, Any]:
    """An experiment without a term, and the system of a robot that has it."""
    robot = experiment_of(folder, kind)
    write_pendulum(folder, joint='frictionloss="0.02" armature="0.002"')
    tables = {**robot.model_dump(exclude_unset=True), "fit": {"bootstrap": 0}}
    stated = robot.restated({**tables, "terms": {}, "parameters": BASE})
    return stated, System.resolve(robot)


@pytest.mark.parametrize("kind", MISSED)
@pytest.mark.slow
def test_the_missing_term_of_the_library_is_among_the_first(tmp_path: Path, kind: str) -> None:
    stated, robot = without_term(tmp_path, kind)
    logs = small_logs(robot, 0, 1)
    system = System.resolve(stated)
    problem = FitProblem.of(system, logs)
    at = solution_near(problem, system.parameters.guess)
    found = find_missing_terms(problem, at).terms

    # Score tests are linear, so that a selection of terms compares fits with the first ones.
    compared = [t for t in found if t.sigmas**2 >= SIMILAR_SHARE * found[0].sigmas ** 2]
    first = next(term for term in compared if term.path == MISSED[kind])
    assert [table["kind"] for table in first.tables.values()] == [kind]
    assert first.source in KINDS[kind].sources


# One candidate of each kind for the cart-pendulum, by its target.
CURES = {
    "joint/slide:frictionloss": "slide_frictionloss",
    "joint/slide:damping": "slide_damping",
    "joint/slide:stiffness": "slide_stiffness",
    "joint/hinge:armature": "hinge_armature",
    "actuator/force:gainprm[0]": "force_gainprm_0",
    "option:gravity[0]": "option_gravity_0",
    "output/qpos:hinge:bias": "qpos_hinge_bias",
    "output/qvel:slide:scale": "qvel_slide_scale",
    "output:delay": "output_delay",
    "term/slide_asymmetric_friction:offset": "slide_asymmetric_friction_offset",
    "term/force_actuator_lag:time_constant": "force_actuator_lag_time_constant",
    "term/pendulum_payload:mass": "pendulum_payload_mass",
}


@pytest.mark.parametrize("path", CURES)
def test_the_lines_of_a_cure_are_valid_at_the_end_of_the_file(tmp_path: Path, path: str) -> None:
    """They are appended as they are printed, and a fit with them begins."""
    file = tmp_path / "cart.toml"
    text = (MODELS / "cart_pendulum.toml").read_text(encoding="utf-8")
    text = text.replace('"cart_pendulum.xml"', '"robot.xml"')
    file.write_text(text.replace('"cart_', f'"{MODELS}/cart_'), encoding="utf-8")
    model = (MODELS / "cart_pendulum.xml").read_text(encoding="utf-8")
    rail = 'axis="1 0 0"/>', 'axis="1 0 0" frictionloss="0.5"/>'
    (tmp_path / "robot.xml").write_text(model.replace(*rail), encoding="utf-8")
    experiment = mjfim.Experiment.from_file(file)
    system = System.resolve(experiment, threads=1)
    candidates, _ = candidates_of(system, np.ones(system.space.nv))
    candidate = next(each for each in candidates if each.tested[0].path == path)

    # The candidate as a test would name it, of its own size.
    numbers = tuple(
        TermNumber(path=each.path, value=each.size, unit=each.unit, scale=each.size, is_size=True)
        for each in candidate.tested
    )
    found = Term(
        description=candidate.description,
        numbers=(*numbers, *candidate.further),
        tables=candidate.tables,
    )
    term = with_names(found, system.parameters.names)
    with file.open("a", encoding="utf-8") as appended:
        appended.write(term.recipe)
    cured = mjfim.Experiment.from_file(file)
    added = {k: spec for k, spec in cured.parameters.items() if k not in experiment.parameters}
    assert set(added) == set(term.parameters)
    assert all(spec.scale for spec in added.values())

    log = simulate_system(system, DesignTask.of(system).initial, seed=0)
    task = FitTask.of(System.resolve(cured, threads=1), [log.first_rows(100)])
    problem = task.problem()
    information = problem.condense(problem.begin(task.start)).information()
    assert np.isfinite(information[:, task.system.parameters.names.index(CURES[path])]).all()


def test_a_term_with_several_numbers_has_one_test() -> None:
    """The probability of the chi-squared value is that of the normal variable."""
    for explained, count in ((3.0, 1), (9.0, 2), (30.0, 3), (1400.0, 3)):
        sigmas = equivalent_sigmas(explained, count)
        expected = scipy.stats.chi2.logsf(explained, count)
        assert scipy.special.log_ndtr(-sigmas) + np.log(2.0) == pytest.approx(expected, rel=1e-9)

    # The probability of these values is smaller than the smallest number.
    values = np.array([equivalent_sigmas(each, 6) for each in (1450.0, 1480.0, 1520.0, 1e6)])
    assert_allclose(np.diff(values[:3]), np.diff(np.sqrt([1450, 1480, 1520])), rtol=0.02)
    assert values[-1] == pytest.approx(1000.0, rel=1e-4)


@pytest.mark.slow
def test_many_candidates_are_tested_in_groups(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A delay is the last candidate; it was left out where others used all tested numbers."""
    stated, robot = without_term(tmp_path, "actuator_lag")
    logs = small_logs(robot, 0)
    problem = FitProblem.of(System.resolve(stated), logs)
    at = solution_near(problem, problem.system.parameters.guess)
    whole = find_missing_terms(problem, at).terms
    assert "output:delay" in {term.path for term in whole}

    monkeypatch.setattr(term_tests, "MAX_TESTED", 4)
    in_groups = find_missing_terms(problem, at).terms

    # The last one may be any of several terms with the same effect, here a gain or a payload.
    assert [term.path for term in in_groups[:-1]] == [term.path for term in whole[:-1]]
    for part, complete in zip(in_groups, whole, strict=True):
        assert part.sigmas == pytest.approx(complete.sigmas, rel=0.02)


def test_a_joint_without_a_name_has_no_terms(tmp_path: Path) -> None:
    """A path of the experiment file cannot name it."""
    path = tmp_path / "model.xml"
    path.write_text(
        '<mujoco><worldbody><body><joint axis="0 1 0"/><geom size="0.1" mass="1"/>'
        '<body pos="0 0 -0.3"><joint name="elbow" axis="0 1 0"/><geom size="0.1" mass="1"/></body>'
        '</body></worldbody><actuator><motor name="motor" joint="elbow"/></actuator></mujoco>',
        encoding="utf-8",
    )
    experiment = mjfim.Experiment(
        model=str(path),
        rate=50.0,
        noise={"state": 0.01},
        parameters={"damping": {"target": "joint/elbow:damping", "scale": 0.1}},
    )
    found, _ = candidates_of(System.resolve(experiment), np.ones(2))
    assert {candidate.joint for candidate in found if candidate.joint} == {"elbow"}

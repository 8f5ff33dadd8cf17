"""Identification of physical terms of the library from simulated logs."""

from __future__ import annotations

from pathlib import Path
from typing import Any

import numpy as np
import pytest

import mjfim
from mjfim.experiment.system import System
from mjfim.identification.aligned_recording import align
from mjfim.identification.fit_problem import FitProblem
from mjfim.identification.known_activations import KnownActivations
from mjfim.model.terms.library import KINDS
from tests.support.terms import EXAMPLES, experiment_of, motor_torque, recorded

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


@pytest.mark.parametrize("kind", KINDS)
def test_a_term_is_identified_from_a_log(tmp_path: Path, kind: str) -> None:
    guesses = GUESSES.get(kind, {})
    parameters = {field: {"guess": value} for field, value in guesses.items()}
    experiment = experiment_of(tmp_path, kind, fit={"bootstrap": 0}).replace(parameters=parameters)
    system = System.resolve(experiment)
    found = mjfim.identify(experiment, [log_of(system, 1)])
    assert not found.misfit

    # The standard deviation is formal: it is compared at five of them.
    error = np.abs(found.theta - system.parameters.true)
    assert (error < 5.0 * found.std + 1e-9).all()
    assert (error < np.maximum(0.25 * np.abs(system.parameters.true), 3.0 * found.std)).all()


@pytest.mark.parametrize("kind", ["stribeck", "actuator_lag"])
def test_activations_of_terms_are_no_unknowns_of_segments(tmp_path: Path, kind: str) -> None:
    """They follow from the control and the velocity, as the simulation has them."""
    experiment = experiment_of(tmp_path, kind, fit={"segments": 0.5}, noise={"angle": 1e-5})
    true = {field: {"guess": value} for field, value in EXAMPLES[kind][1].items()}
    system = System.resolve(experiment.replace(parameters=true))
    recording = log_of(system, 3, duration=3.0)
    problem = FitProblem.of(system, [recording])
    assert problem.simulation.private_count == 2
    assert len(problem.segments) == 6

    known = KnownActivations.of(system)
    assert known.addresses == [0]
    exact = system.plant.simulate(system.parameters.true, recording.ctrl)
    begins = np.array([0, 40, 130, 250])
    found = known.at(align(system, recording), begins, exact.qvel[begins])
    if kind == "actuator_lag":
        exact_act = np.array(exact.act[begins])
        exact_act[0] = recording.ctrl[0]
        np.testing.assert_allclose(found, exact_act, atol=1e-4)
    else:
        np.testing.assert_allclose(
            found[1:], exact.act[begins][1:], atol=0.02 * np.abs(exact.act).max()
        )


def test_a_log_with_wrong_scale_and_bias_gives_both(tmp_path: Path) -> None:
    experiment = experiment_of(
        tmp_path,
        "tilt",
        fit={"bootstrap": 0},
        parameters={
            "scale": {"target": "output/angle:scale", "true": 0.04},
            "bias": {"target": "output/angle:bias", "true": 0.05},
            "damping": {"target": "joint/pivot:damping", "guess": 0.02, "true": 0.01},
        },
    )
    system = System.resolve(experiment)
    found = mjfim.identify(experiment, [log_of(system, 4)])
    assert not found.misfit
    assert (np.abs(found.theta - system.parameters.true) < 5.0 * found.std).all()

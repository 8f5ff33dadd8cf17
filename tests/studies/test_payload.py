"""A payload on a known arm: true values inside intervals, its inertia, and wrong inputs."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mjfim
from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import System
from mjfim.identification.assessment.honest_covariance import honest_covariance
from mjfim.identification.linear_coordinates import cad_bodies, cad_information, columns_of
from mjfim.studies.payload import PayloadTask, RobotExperiment
from tests.identification.test_parameter_draws import estimated
from tests.support.made_records import bare_estimate

# Two hinges about different axes, so that gravity and inertia show every coordinate of a load.
ARM = """
<mujoco>
  <option timestep="0.005" integrator="implicitfast"/>
  <worldbody>
    <body name="stand"/>
    <body name="upper">
      <inertial pos="0 0 -0.15" mass="0.5" diaginertia="0.004 0.004 0.0005"/>
      <joint name="pitch" axis="0 1 0" damping="0.1"/>
      <body name="hand" pos="0 0 -0.3">
        <inertial pos="0 0 -0.1" mass="0.3" diaginertia="0.001 0.001 0.0002"/>
        <joint name="roll" axis="1 0 0" damping="0.05"/>
      </body>
    </body>
  </worldbody>
  <actuator>
    <motor name="pitch" joint="pitch"/>
    <motor name="roll" joint="roll"/>
  </actuator>
</mujoco>
"""

# True values of the robot and of its load.
ROBOT = {"pitch_damping": 0.12, "roll_damping": 0.045, "hand_mass": 0.31}
LOAD = {"mass": 0.2, "x": 0.03, "y": -0.02, "z": -0.12}
INERTIA = 2e-4


def experiment(home: Path, **load: float) -> mjfim.Experiment:
    """An arm with unknown dampings and an unknown mass of the hand, with a load or without.

    Args:
        home: Folder that receives the model.
        **load: Fields of the load.
    """
    (home / "arm.xml").write_text(ARM, encoding="utf-8")
    swing = {"kind": "multisine", "frequency": 0.5, "harmonics": 4}
    tables = {
        "model": "arm.xml",
        "rate": 50.0,
        "horizon": 3.0,
        "initial": {"control": {**swing, "amplitude": {"pitch": 1.2, "roll": 0.7}}},
        "parameters": {
            "pitch_damping": {"target": "joint/pitch:damping", "true": 0.12},
            "roll_damping": {"target": "joint/roll:damping", "true": 0.045},
            "hand_mass": {"target": "body/hand:mass", "true": 0.31},
        },
        "noise": {"qpos:pitch": 0.003, "qpos:roll": 0.003},
        "fit": {"segments": "whole"},
        "directory": home,
        "source": "arm.toml",
    }
    if load:
        tables["terms"] = {"load": {"kind": "payload", "body": "hand", "values": load}}
    return mjfim.Experiment(**tables)


def log(stated: mjfim.Experiment, seed: int) -> mjfim.Recording:
    """A recording of the initial control."""
    trajectory = DesignTask.resolve(stated).initial
    return mjfim.simulate(stated, trajectory, seed=seed)


def inside(found: mjfim.Estimate) -> Array:
    """Whether the true values of the load, in the order of `LOAD`, are inside the intervals."""
    intervals = np.array([found.payload.mass_interval, *found.payload.centre_interval])
    true = np.array(list(LOAD.values()))
    return (intervals[:, 0] <= true) & (true <= intervals[:, 1])


def test_an_earlier_estimate_is_prior_knowledge_with_its_covariance(tmp_path: Path) -> None:
    robot = experiment(tmp_path)
    system = System.resolve(robot)
    covariance = np.array([[4e-4, 1e-4, -4e-6], [1e-4, 9e-4, 6e-6], [-4e-6, 6e-6, 1e-6]])
    std, theta = np.sqrt(np.diag(covariance)), np.array([*ROBOT.values()])
    estimate = bare_estimate(ROBOT, theta, std, covariance=covariance)
    parameters = PayloadTask.of(robot, body="hand", robot=estimate).system().parameters
    index = [parameters.names.index(name) for name in ROBOT]
    information = parameters.prior_information[np.ix_(index, index)]
    expected = np.linalg.inv(honest_covariance(system.parameters, estimate))
    assert_allclose(information, expected, rtol=1e-8)
    assert_array_equal(parameters.guess[index], theta)

    # A parameter that the estimate does not determine is held.
    unknown = replace(estimate, std=np.array([np.inf, *std[1:]]))
    held = PayloadTask.of(robot, body="hand", robot=unknown).known_robot()
    assert held.held == ("pitch_damping",)
    assert held.known == ("roll_damping", "hand_mass")

    # An estimate of another robot, and bodies that cannot carry a load.
    other = replace(estimate, parameters=("pitch_damping", "roll_damping", "mass"))
    for options, message in (
        ({"body": "hand", "robot": other}, "lacks the robot's hand_mass of arm.toml"),
        ({"body": "stand"}, "^body: .*move"),
        ({}, "valid: upper, hand$"),
    ):
        with pytest.raises(ExperimentError, match=message):
            PayloadTask.of(robot, **options)


def test_a_payload_that_the_experiment_states_is_left_out_of_the_robot(tmp_path: Path) -> None:
    stated = experiment(tmp_path, **LOAD).replace(
        parameters={"load": {"target": "term/load:mass", "guess": 0.1}}, fit={"hold": ["load"]}
    )
    robot = RobotExperiment.of(stated)
    assert tuple(robot.shared) == tuple(ROBOT)
    assert robot.experiment.terms == {}
    assert robot.experiment.fit.hold == ()
    assert robot.carrier(None) == "hand"

    mixed = {"targets": [{"path": "term/load:mass"}, {"path": "body/upper:mass"}]}
    with pytest.raises(ExperimentError, match=r"parameters\.both: sets numbers of the payload"):
        RobotExperiment.of(stated.replace(parameters={"both": mixed}))


def test_a_prior_from_the_model_counts_once(tmp_path: Path) -> None:
    """The covariance of the earlier estimate contains it, with all correlations.

    Whole inertias of the robot become ten known parameters each.
    """
    values = experiment(tmp_path).model_dump(exclude_unset=True)
    values["parameters"] = {name: {"inertial": name} for name in ("upper", "hand")}
    values["parameters"]["damping"] = {"target": "joint/pitch:damping"}
    whole = experiment(tmp_path).restated(values)
    system = System.resolve(whole)
    parameters = system.parameters
    bodies = cad_bodies(parameters)
    assert len(bodies) == 2
    others = np.setdiff1d(np.arange(len(parameters)), columns_of(bodies))
    row = np.random.default_rng(1).standard_normal(len(parameters)) / parameters.magnitude
    data = np.outer(row, row)
    data[others, others] += 1e4 / parameters.magnitude[others] ** 2
    covariance = np.linalg.inv(data + cad_information(bodies, parameters.guess))
    estimate = estimated(system, covariance, data=data, honest_covariance=covariance)

    loaded = PayloadTask.of(whole, body="hand", robot=estimate).system()
    found = loaded.parameters
    index = [found.names.index(name) for name in parameters.names]
    prior = found.prior_information + cad_information(cad_bodies(found), found.guess)
    inverse = np.linalg.inv(covariance)
    size = np.sqrt(np.outer(np.diag(inverse), np.diag(inverse)))
    assert_allclose(prior[np.ix_(index, index)] / size, inverse / size, atol=1e-5)
    assert not cad_bodies(found)

    # The numbers of the link without the load mean the same in both models.
    theta, moved = np.array(found.guess), parameters.guess + 0.1 * parameters.magnitude
    theta[index] = moved
    link, expected = (
        each.body("upper") for each in (loaded.model_at(theta), system.model_at(moved))
    )
    assert_allclose(link.mass, expected.mass, rtol=1e-12)
    assert_allclose(link.inertia, expected.inertia, rtol=1e-9)


@pytest.mark.slow
def test_true_values_are_inside_the_intervals(tmp_path: Path) -> None:
    """Also that of an inertia which the recordings show."""
    robot, loaded = experiment(tmp_path), experiment(tmp_path, **LOAD, inertia=0.02)
    found = []
    for seed in range(3):
        robots = mjfim.identify(robot, [log(robot, seed)])
        estimate = mjfim.identify_payload(
            robot, [log(loaded, 100 + seed)], body="hand", robot=robots
        )
        payload = estimate.payload
        assert estimate.converged and payload.is_seen and payload.edge is None
        low, high = payload.inertia_interval
        found.append([*inside(estimate), low <= 0.02 <= high])
    # Of 15 true values, 4 or more are outside of 95 % intervals in 0.5 % of all cases.
    assert np.sum(found) >= 12
    assert (np.sum(found, axis=0) >= 2).all()


@pytest.mark.slow
def test_recordings_without_the_payload_take_the_place_of_an_estimate(tmp_path: Path) -> None:
    robot, loaded = experiment(tmp_path), experiment(tmp_path, **LOAD, inertia=INERTIA)
    reference, recording = log(robot, 1), log(loaded, 2)
    estimate = mjfim.identify_payload(robot, [recording], body="hand", without=[reference])
    earlier = mjfim.identify(robot, [reference])
    other = mjfim.identify_payload(robot, [recording], body="hand", robot=earlier)
    assert_allclose(estimate.theta, other.theta, rtol=1e-9)
    assert inside(estimate).all()

    # With a robot that is held at its guess, which is wrong, the load is not what it is.
    held = mjfim.identify_payload(robot, [recording], body="hand")
    assert held.payload.held == tuple(ROBOT)
    assert held.misfit

    # Where there is no load, none is found.
    nothing = mjfim.identify_payload(robot, [log(robot, 3)], body="hand", robot=earlier)
    assert not nothing.payload.is_seen
    assert "show no payload at hand" in str(nothing.payload)


@pytest.mark.slow
def test_terms_that_a_selection_has_added_are_taken_over(tmp_path: Path) -> None:
    robot, loaded = experiment(tmp_path), experiment(tmp_path, **LOAD, inertia=INERTIA)

    def with_dry_friction(stated: mjfim.Experiment, seed: int) -> mjfim.Recording:
        """A recording of an arm whose pitch has dry friction, which the model does not have."""
        rubbing = ARM.replace('name="pitch" axis', 'name="pitch" frictionloss="0.08" axis')
        (tmp_path / "arm.xml").write_text(rubbing, encoding="utf-8")
        recording = log(stated, seed)
        (tmp_path / "arm.xml").write_text(ARM, encoding="utf-8")
        return recording

    reference, recording = with_dry_friction(robot, 1), with_dry_friction(loaded, 2)
    selected = mjfim.select_terms(robot, [reference])
    estimate = mjfim.identify_payload(robot, [recording], body="hand", robot=selected)
    assert "pitch_frictionloss" in estimate.payload.known
    assert not estimate.misfit
    assert inside(estimate).all()

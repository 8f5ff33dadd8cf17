"""No result depends on units: experiments in other units of length, mass and time."""

from __future__ import annotations

import re
from collections.abc import Sequence
from itertools import islice
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose

from mjfim.excitation.design import design
from mjfim.excitation.evaluation import simulate
from mjfim.excitation.initial_controls import series_of
from mjfim.excitation.limits.constraints import constraint_set_of
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.identification.identify import identify
from mjfim.records.trajectory import Recording
from mjfim.studies.check import check
from tests.support.rescaling import Rescaled, Units, rescale

# Whole jobs: these tests run in `.ci/run` only.
pytestmark = pytest.mark.slow

CART = """
<mujoco model="cart_pendulum">
  <option timestep="0.01" integrator="implicitfast"><flag contact="disable"/></option>
  <worldbody>
    <body name="cart">
      <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
      <joint name="slide" type="slide" axis="1 0 0" damping="0.1"/>
      <body name="pendulum">
        <joint name="hinge" type="hinge" axis="0 -1 0" damping="0.4" armature="0.02"/>
        <body name="bob" pos="0 0 0.8">
          <inertial pos="0 0 0" mass="1.5" diaginertia="1e-3 1e-3 1e-3"/>
        </body>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="force" joint="slide"/></actuator>
  <keyframe><key name="hanging" qpos="0 3.141592653589793"/></keyframe>
</mujoco>
"""

EXPERIMENT = {
    "model": "cart.xml",
    "rate": 50.0,
    "horizon": 1.6,
    "initial": {
        "keyframe": "hanging",
        "control": {"kind": "sine", "amplitude": 2.0, "frequency": 0.8},
    },
    "parameters": {
        "m": {"target": "body/bob:mass", "guess": 1.3, "true": 1.5, "unit": "kg"},
        "l": {"target": "body/bob:pos[2]", "guess": 0.75, "true": 0.8, "unit": "m"},
        "c": {"target": "joint/hinge:damping", "guess": 0.5, "true": 0.4, "unit": "N m s/rad"},
        "d": {"target": "joint/slide:damping", "guess": 0.15, "true": 0.1, "unit": "N s/m"},
    },
    "noise": {"qpos:slide": 0.002, "qpos:hinge": 0.002, "qvel:hinge": 0.02},
    "cost": {"control": 1e-3},
    "descent": {"max_iterations": 3, "coarse": 1},
    "rehearsal": {"robots": 4},
}
LIMITS = {
    "position": {"slide": (-0.3, 0.5)},
    "velocity": {"hinge": 3.0},
    "control": {"force": (-5.0, 5.0)},
}


def stated(folder: Path, **tables: Any) -> Experiment:
    """The cart-pendulum in its own units."""
    folder.mkdir(parents=True, exist_ok=True)
    (folder / "cart.xml").write_text(CART)
    return Experiment(**{**EXPERIMENT, **tables}, directory=folder, source="cart")


# Powers of two, which change no digit of a number. No quantity of mechanics stays the same: its
# factor is 2 to the power of 9 (length) + 7 (mass) - 5 (time), or one over it.
SCALES = (
    Units(),
    Units(length=2.0**9, mass=2.0**7, time=2.0**-5),
    Units(length=2.0**-9, mass=2.0**-7, time=2.0**5),
)


def in_all_units(
    folder: Path, model: str = CART, scales: Sequence[Units] = SCALES, **tables: Any
) -> list[Rescaled]:
    """The cart-pendulum in its own units, and in others."""
    original = stated(folder / "original", **tables)
    (folder / "original" / "cart.xml").write_text(model)
    return [rescale(original, units, folder / str(i)) for i, units in enumerate(scales)]


def in_units(rescaled: Rescaled, found: Any) -> dict[str, Any]:
    """Numbers of a design in the units of the original experiment."""
    units = rescaled.units
    control = np.array(list(rescaled.controls.values()))
    coordinates = np.array([units.factor(unit) for unit in rescaled.coordinates.values()])
    state = np.array([*coordinates, *(coordinates / units.time)])

    return {
        "state": found.trajectory.state / state,
        "control": found.trajectory.ctrl / control,
        "gain": found.final.gain * state / control[:, None],
        "std": found.final.std / parameter_factors(rescaled),
        "cost": found.final.cost * units.time,
        "growth": found.final.growth,
        "status": found.status,
        "warnings": len(found.warnings),
        "iterations": found.iterations,
    }


def parameter_factors(rescaled: Rescaled) -> list[float]:
    """Factors of the units of the parameters."""
    return [rescaled.units.factor(p["unit"]) for p in EXPERIMENT["parameters"].values()]


# Limits with a single bound, also zero.
ONE_SIDED = {
    "position": {"slide": (-0.3, np.inf)},
    "velocity": {"hinge": (-np.inf, 3.0)},
    "acceleration": {"slide": (-8.0, np.inf)},
    "control": {"force": (-np.inf, 5.0)},
    "control_rate": {"force": (-60.0, np.inf)},
    "force": {"force": (-5.0, np.inf)},
}

# Tables of experiments whose designs take different paths.
DESIGNS = {
    "weights": {},
    "limits": {"limits": LIMITS, "cost": {"control": 0.0}},
    "single bounds": {"limits": ONE_SIDED},
}


@pytest.mark.parametrize("tables", DESIGNS)
def test_a_design_is_the_same_in_all_units(tmp_path, tables: str) -> None:
    own, *others = (
        in_units(each, design(each.experiment))
        for each in in_all_units(tmp_path, **DESIGNS[tables])
    )
    # Powers of two are exact; only linear algebra that mixes units may round differently.
    for found in others:
        assert_same(found, own, exact=("status", "warnings", "iterations"))


# A bob and walls of several shapes. MuJoCo searches for the distance of an ellipsoid with constants
# of its own.
WALLED = CART.replace(
    '<body name="bob" pos="0 0 0.8">',
    '<body name="bob" pos="0 0 0.8"><geom type="capsule" size="0.05 0.1" mass="0"/>',
).replace(
    "<worldbody>",
    """<worldbody>
    <geom type="box" pos="0.7 0 -0.8" size="0.1 0.2 0.1"/>
    <geom type="sphere" pos="-0.6 0 -0.8" size="0.1"/>
    <geom type="plane" pos="0 0 -1.2" size="5 5 0.1"/>""",
)


def test_distances_and_their_reach_are_the_same_in_all_units(tmp_path) -> None:
    motion = np.stack([np.linspace(-0.4, 0.4, 40), np.linspace(2.9, 3.4, 40)], axis=1)
    found = []
    for rescaled in in_all_units(tmp_path, WALLED, limits={"clearance": 0.02}):
        length = rescaled.units.length
        clearance = constraint_set_of(DesignTask.resolve(rescaled.experiment)).clearance
        distances, slope = clearance.distances(motion * [length, 1.0], slopes=True)
        lengths = np.array([clearance.distances.reach, clearance.least, clearance.scale])
        found.append((lengths / length, distances / length, slope / [1.0, length]))

    own, *others = found
    assert (own[1] < 0.0).any() and (own[1] == own[0][0]).any()
    for other in others:
        for value, expected in zip(other, own, strict=True):
            assert_allclose(value, expected, rtol=1e-12, atol=1e-12)


def test_a_clearance_of_nearly_nothing_has_finite_margins(tmp_path) -> None:
    original = stated(tmp_path, limits={"clearance": 1e-100})
    (tmp_path / "cart.xml").write_text(WALLED)
    clearance = constraint_set_of(DesignTask.resolve(original)).clearance
    assert clearance.scale > 1e-9


def test_the_control_of_least_drift_is_the_same_in_all_units(tmp_path) -> None:
    """A tilted pendulum falls under every control."""
    control = EXPERIMENT["initial"]["control"]
    own, *others = (
        np.array(DesignTask.resolve(each.experiment).centres) / each.controls["force"]
        for each in in_all_units(tmp_path, initial={"qpos": (0.0, 2.0), "control": control})
    )
    for found in others:
        assert_allclose(found, own, rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize("harmonics", [15, None])
def test_series_with_which_a_search_goes_on_are_the_same_in_all_units(
    tmp_path, harmonics: int | None
) -> None:
    """A stated time is filled with series; they know the horizon, and no second."""
    found = []
    for rescaled in in_all_units(tmp_path):
        task = DesignTask.resolve(rescaled.experiment)
        series = islice(series_of(task, np.random.default_rng(0), harmonics), 8)
        found.append([each.control / rescaled.controls["force"] for each in series])
    own, *others = found
    assert len(own) == 8
    for other in others:
        assert_allclose(other, own, rtol=1e-9, atol=1e-9)


NUISANCE = {"initial": {"qpos:slide": 0.01, "qvel:slide": True}, "bias": {"qpos:hinge": True}}

# Keys of experiments whose fits take different paths.
FITS = {
    "stated start": {"fit": {"bootstrap": 0}},
    "nuisance": {"nuisance": NUISANCE, "fit": {"segments": "whole", "bootstrap": 0}},
    "segments": {"fit": {"segments": 0.4, "bootstrap": 0}},
    "delay": {"fit": {"segments": 0.4, "bootstrap": 0}, "nuisance": {"delay": True}},
}


@pytest.fixture(scope="module")
def recording(tmp_path_factory) -> Recording:
    """What a robot measures whose slide has dry friction, which the model of the fits lacks."""
    folder = tmp_path_factory.mktemp("robot")
    robot = stated(folder, cost={"linearize_at": "true"})
    rubbing = CART.replace('damping="0.1"', 'damping="0.1" frictionloss="0.3"')
    (folder / "cart.xml").write_text(rubbing)
    return simulate(robot, DesignTask.resolve(robot).initial, seed=1)


def fit_in_units(rescaled: Rescaled, recording: Recording) -> dict[str, Any]:
    """Numbers of an estimate in the units of the original experiment, and its verdicts."""
    found = identify(rescaled.experiment, [rescaled.recording(recording)])
    factors = parameter_factors(rescaled)
    count = len(factors)
    terms = found.missing_terms
    return {
        "theta": found.theta[:count] / factors,
        "std": found.std[:count] / factors,
        "sandwich": found.std_sandwich[:count] / factors,
        "chi2": found.chi2,
        "term": [each.main.value / rescaled.units.factor(each.main.unit) for each in terms],
        "sigmas": [term.sigmas for term in terms],
        "status": found.status,
        "misfit": found.misfit,
        "terms": [term.description for term in terms],
        "warnings": len(found.warnings),
    }


@pytest.mark.parametrize("path", FITS)
def test_estimates_and_misfits_are_the_same_in_all_units(
    tmp_path, recording: Recording, path: str
) -> None:
    """Two paths are compared with large units, two with small ones."""
    scales = (SCALES[0], SCALES[1 + [*FITS].index(path) % 2])
    rescaled = in_all_units(tmp_path, scales=scales, **FITS[path])
    own, other = (fit_in_units(each, recording) for each in rescaled)
    assert own["misfit"]
    assert path != "stated start" or "dry friction of slide" in own["terms"]

    # MuJoCo solves for dry friction to a tolerance that depends on the acceleration's unit.
    exact = ("status", "misfit", "terms", "warnings")
    assert_same(other, own, exact=exact, rough=("term", "sigmas"))


def test_a_check_says_the_same_in_all_units(tmp_path) -> None:
    twin = {"cart": {"target": "body/cart:mass", "guess": 1.2, "true": 1.0, "unit": "kg"}}
    parameters = {**EXPERIMENT["parameters"], **twin}
    own, *others = (
        check(each.experiment) for each in in_all_units(tmp_path, parameters=parameters)
    )
    for found in others:
        assert without_quantities(found.findings) == without_quantities(own.findings)
        assert found.not_separable == own.not_separable
        assert_allclose(found.correlation, own.correlation, rtol=1e-6, atol=1e-6)
        assert found.self_test.recursion == pytest.approx(own.self_test.recursion, abs=1e-6)


def without_quantities(sentences: tuple[str, ...]) -> list[str]:
    """Sentences without times and standard deviations, which depend on units."""
    return [re.sub(r"\([\d,.e+]+ s\)|reach [\d.e+-]+", "", text) for text in sentences]


def assert_same(
    found: dict[str, Any],
    expected: dict[str, Any],
    exact: tuple[str, ...],
    rough: tuple[str, ...] = (),
) -> None:
    """Compare verdicts exactly, rough numbers to three digits, and the other numbers to nine."""
    for key, value in expected.items():
        if key in exact:
            assert found[key] == value
        else:
            rtol = 1e-3 if key in rough else 1e-9
            assert_allclose(found[key], value, rtol=rtol, atol=1e-9, err_msg=key)

"""Identifiable parameters along the initial control and along random ones, and experiments that are
refused.
"""

from __future__ import annotations

from contextlib import nullcontext
from pathlib import Path
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_array_equal

from mjfim.errors import SimulationDivergedError, UnidentifiableError
from mjfim.excitation.evaluation import require_designable
from mjfim.excitation.task import DesignTask
from mjfim.information.identifiability import (
    PROBES,
    Identifiability,
    require_visible,
)
from tests.support.numerics import (
    CART_PARAMETERS,
    PRODUCT,
    cart_task,
    make_task,
    sensitivity_of,
)

TWO = """
<mujoco model="two">
  <option timestep="0.01" integrator="implicitfast" gravity="0 0 0">
    <flag contact="disable"/>
  </option>
  <worldbody>
    <body name="left">
      <joint name="left" type="slide" axis="1 0 0" damping="0.3"/>
      <inertial pos="0 0 0" mass="1" diaginertia="0.01 0.01 0.01"/>
    </body>
    <body name="right">
      <joint name="right" type="slide" axis="1 0 0" damping="0.2"/>
      <inertial pos="0 0 0" mass="2" diaginertia="0.01 0.01 0.01"/>
    </body>
    <body name="post"><inertial pos="0 0 0.1" mass="3" diaginertia="0.1 0.1 0.1"/></body>
  </worldbody>
  <actuator>
    <motor name="left" joint="left" ctrlrange="-1 1" ctrllimited="true"/>
    <motor name="right" joint="right"/>
  </actuator>
</mujoco>
"""


def two_task(folder: Path, **tables: Any) -> DesignTask:
    """Two sliders, of which the initial control moves the left one only."""
    control = {"kind": "sine", "amplitude": {"left": 0.8, "right": 0.0}, "frequency": 1.0}
    masses = {name: {"target": f"body/{name}:mass"} for name in ("left", "right")}
    defaults = {"parameters": masses, "noise": {"state": 0.01}, "initial": {"control": control}}
    return make_task(TWO, folder, **{**defaults, **tables})


def look(task: DesignTask) -> Identifiability:
    """Identifiability along the initial control."""
    return task.identifiability_test.along(task.initial, sensitivity_of(task))


def test_an_experiment_that_shows_everything_needs_no_random_controls(
    tmp_path, monkeypatch
) -> None:
    def refused(*_: object) -> None:
        raise AssertionError("not needed")

    task = cart_task(tmp_path)
    curve, found = task.initial, sensitivity_of(task)
    monkeypatch.setattr(task.plant, "simulate", refused)
    seen = task.identifiability_test.along(curve, found)
    assert seen.basis is None
    assert (seen.along_trajectory.count, seen.along_all.count) == (0, 0)
    assert (seen.groups_along_trajectory, seen.groups_along_all) == ((), ())


def test_parameters_hidden_by_the_initial_control_are_told_from_those_that_no_control_shows(
    tmp_path,
) -> None:
    task = two_task(tmp_path)
    seen = look(task)
    assert (seen.along_trajectory.silent, seen.along_all.count) == ((1,), 0)
    assert seen.basis is None
    with pytest.raises(UnidentifiableError, match="initial control does not excite") as caught:
        require_designable(task, seen)
    assert "right" in str(caught.value)
    assert "left" not in str(caught.value)


def test_a_small_effect_that_adds_up_over_the_motion_counts(tmp_path) -> None:
    """A parameter is excited where the whole motion shows it, though hardly any single step."""
    drag = {"drag": {"target": "joint/left:damping"}}
    faint = {"kind": "sine", "amplitude": {"left": 5e-9, "right": 0.0}, "frequency": 0.5}
    task = two_task(tmp_path, parameters=drag, initial={"control": faint}, horizon=4.0)

    assert look(task).along_trajectory.count == 0


@pytest.mark.parametrize("angle", [0.0, np.pi], ids=["upright", "hanging, rounded"])
@pytest.mark.parametrize("count", [1, 3])
def test_at_rest_nothing_is_identifiable_and_along_random_controls_everything(
    count: int, angle: float, tmp_path
) -> None:
    rest = {"qpos": (0.0, angle), "control": {"kind": "constant", "amplitude": 0.0}}
    parameters = dict(list(CART_PARAMETERS.items())[-count:])
    task = cart_task(tmp_path, initial=rest, parameters=parameters)
    seen = look(task)
    assert seen.along_trajectory.basis.shape == (count, 0)
    assert seen.along_all.count == 0
    with pytest.raises(UnidentifiableError, match="the initial control does not excite"):
        require_designable(task, seen)


def test_a_combination_that_only_the_initial_control_hides_is_refused_with_advice(tmp_path) -> None:
    """A slider that coasts shows damping over mass alone; pushed, it shows both."""
    parameters = {"mass": {"target": "body/left:mass"}, "drag": {"target": "joint/left:damping"}}
    coasting = {"qvel": (1.0, 0.0), "control": {"kind": "constant", "amplitude": 0.0}}
    task = two_task(tmp_path, parameters=parameters, initial=coasting)
    seen = look(task)
    assert (seen.along_trajectory.count, seen.along_all.count) == (1, 0)
    (group,) = seen.groups_along_trajectory
    assert group.members == ("mass", "drag")
    # d(drag / mass) = 0 along (mass, drag) = (1, 0.3): what remains is drag - 0.3 mass, or mass -
    # drag / 0.3
    (found,) = group.combinations
    assert found["mass"] / found["drag"] == pytest.approx(-0.3, rel=1e-5)
    said = r"initial control does not excite: mass and drag only as .* multisine"
    with pytest.raises(UnidentifiableError, match=said):
        require_designable(task, seen)


@pytest.mark.parametrize("sigma", [0.05, 1e-7], ids=["coarse", "fine sensor"])
def test_a_wanted_parameter_confounded_with_a_nuisance_is_named(sigma: float, tmp_path) -> None:
    """The initial position of the cart and the bias of its position sensor change every measurement
    alike.
    """
    wanted = {"offset": {"target": "output/qpos:slide:bias"}}
    noise = {"qpos:slide": sigma, "qvel:slide": sigma}
    hidden, known = (
        cart_task(tmp_path, parameters=wanted, noise=noise, nuisance={"initial": {"qpos:slide": p}})
        for p in (True, 0.1)
    )
    with pytest.raises(UnidentifiableError, match=r"parameters\.offset changes nothing"):
        require_designable(hidden, look(hidden))
    require_designable(known, look(known))


def test_members_of_an_inertia_may_be_invisible_but_not_all_of_them(tmp_path) -> None:
    moving = two_task(tmp_path, parameters={"left": {"inertial": "left"}})
    seen = look(moving)
    require_designable(moving, seen)
    assert seen.basis.shape == (10, 1)  # a slider shows its mass, nothing else
    assert seen.groups_along_all[-1].combinations == ()
    welded = two_task(tmp_path, parameters={"post": {"inertial": "post"}})
    with pytest.raises(UnidentifiableError, match="no parameter has an effect"):
        require_designable(welded, look(welded))


def test_several_parameters_without_effect_are_all_named(tmp_path) -> None:
    dead = {
        "y": {"target": "body/bob:pos[1]", "guess": 0.1},
        "i": {"target": "body/cart:inertia[0]"},
    }
    task = cart_task(tmp_path, parameters={**CART_PARAMETERS, **dead})
    said = r"parameters\.y, parameters\.i change nothing .* remove them"
    with pytest.raises(UnidentifiableError, match=said):
        require_designable(task, look(task))


COLLISION = """
<mujoco model="collision">
  <option timestep="0.002" integrator="implicitfast" gravity="0 0 0"/>
  <worldbody>
    <geom name="wall" type="plane" size="5 5 0.1" solref="-40000 -100"/>
    <body name="ball">
      <joint name="z" type="slide" axis="0 0 1"/>
      <geom name="ball" type="sphere" size="0.1" mass="1" solref="-40000 -100"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="z"/></actuator>
</mujoco>
"""


def test_a_contact_shorter_than_a_sample_period_shows_its_stiffness(tmp_path) -> None:
    control = {"kind": "sine", "amplitude": 0.1, "frequency": 3.0}
    tables = {
        "parameters": {"k": {"target": "geom/ball:solref[0]"}, "m": {"target": "body/ball:mass"}},
        "noise": {"state": 0.01},
        "initial": {"qpos": (0.9,), "qvel": (-1.0,), "control": control},
    }
    for horizon in (3.3, 3.7, 5.0):  # wherever the looked-at samples fall
        task = make_task(COLLISION, tmp_path, horizon=horizon, **tables)
        assert np.sum(task.initial.qpos[:, 0] < 0.1) <= 2
        assert np.abs(sensitivity_of(task).G[..., 0]).max() * 40000.0 > 0.1
        assert look(task).along_trajectory.count == 0


def test_random_controls_stay_in_the_ranges_of_the_actuators_and_about_the_initial_one(
    tmp_path,
) -> None:
    control = {
        "kind": "sine",
        "amplitude": {"left": 0.8, "right": 3.0},
        "offset": {"left": 0.1, "right": 5.0},
        "frequency": 2.0,
    }
    made, again, other = (
        [probe.ctrl for probe in task.probes(PROBES)]
        for task in (
            two_task(tmp_path, initial={"control": control}, descent={"seed": seed})
            for seed in (1, 1, 2)
        )
    )
    assert len({c.tobytes() for c in made}) == len(made) == PROBES
    left, right = np.array(made).transpose(2, 0, 1)
    assert np.abs(left).max() == 1.0  # the range is reached, and kept
    assert np.abs(right.mean(axis=1) - 5.0).max() < 1.5
    assert (np.ptp(right, axis=1) > 3.0).all()

    # the seed decides them
    assert_array_equal(made, again)
    assert not np.array_equal(made, other)


def test_random_controls_that_diverge_are_left_out(tmp_path, monkeypatch) -> None:
    task = cart_task(tmp_path, parameters=PRODUCT)
    curve, found = task.initial, sensitivity_of(task)

    def diverges(*_: object) -> None:
        raise SimulationDivergedError("too fast")

    monkeypatch.setattr(task.plant, "simulate", diverges)
    seen = task.identifiability_test.along(curve, found)
    assert (seen.along_trajectory.count, seen.along_all.count) == (1, 1)


def test_data_must_show_every_parameter_even_nuisances_and_those_with_a_prior(tmp_path) -> None:
    sure = {**PRODUCT, "gear": {**PRODUCT["gear"], "nuisance": True, "prior": 1e-6}}
    for parameters, said in (
        (CART_PARAMETERS, nullcontext()),
        *((p, pytest.raises(UnidentifiableError, match="only as gear")) for p in (PRODUCT, sure)),
    ):
        task = cart_task(tmp_path, parameters=parameters)
        J = task.identifiability_test.rows(sensitivity_of(task))
        with said:
            require_visible(task.parameters, task.prior, J)

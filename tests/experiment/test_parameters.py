"""Unknown parameters: guesses, scales and units, inertias of bodies, the nuisance table, functions
of an MjSpec.
"""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from mjfim.errors import ExperimentError, MjfimError, ModelError
from mjfim.excitation.task import DesignTask
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS, body_inertia
from mjfim.model.parameters import Parameter
from tests.support.numerics import (
    CART_PARAMETERS,
    CART_PENDULUM,
    body_task,
    cart_task,
    filtered_task,
    make_task,
)

ARM = {"inertial": "arm"}
MASS = {"m": {"target": "body/arm:mass"}}


def named(task: DesignTask) -> dict[str, Parameter]:
    """Parameters by name."""
    return {p.name: p for p in task.parameters.parameters}


@pytest.mark.parametrize("coordinates", [None, "logcholesky", "barycentric"])
def test_the_inertia_of_a_body_is_ten_parameters(coordinates: str | None, tmp_path: Path) -> None:
    """Guess, size, unit of each from the body itself; at the guess the model is unchanged."""
    task = body_task(
        tmp_path,
        parameters={
            "arm": {**ARM, "coordinates": coordinates},
            "d": {"target": "joint/ball:damping"},
        },
    )
    chart = INERTIA_PARAMETRISATIONS[coordinates or "logcholesky"]
    body = task.system.model.body("arm").id
    assert task.parameters.names == (*(f"arm.{n}" for n in chart.names), "d")
    ten = task.parameters.parameters[:10]
    np.testing.assert_allclose(
        [p.guess for p in ten],
        chart.coordinates(body_inertia(task.system.model, body)),
        rtol=1e-12,
        atol=1e-15,
    )
    np.testing.assert_array_equal(
        [p.scale for p in ten], chart.magnitudes(body_inertia(task.system.model, body))
    )
    np.testing.assert_array_equal(
        task.parameters.magnitude[:10], chart.magnitudes(body_inertia(task.system.model, body))
    )
    assert tuple(p.unit for p in ten) == chart.units
    assert {p.group for p in ten} == {"arm"} and task.parameters.parameters[10].group == ""
    own = task.system.model_at(task.parameters.guess)
    for field in ("body_mass", "body_ipos", "dof_M0"):
        np.testing.assert_allclose(
            getattr(own, field), getattr(task.system.model, field), rtol=1e-9, atol=1e-12
        )
    np.testing.assert_allclose(
        body_inertia(own, body).inertia,
        body_inertia(task.system.model, body).inertia,
        rtol=1e-9,
        atol=1e-12,
    )


def test_priors_of_an_inertia_are_relative_to_the_magnitude_of_each(tmp_path: Path) -> None:
    """One number stands for ten units."""
    table = {
        "arm": {**ARM, "prior": 0.1, "coordinates": "barycentric", "nuisance": True},
        "d": {"target": "joint/ball:damping"},
    }
    parameters = named(body_task(tmp_path, parameters=table))
    for name in INERTIA_PARAMETRISATIONS["barycentric"].names:
        p = parameters[f"arm.{name}"]
        assert p.prior == pytest.approx(0.1 * p.scale)
        assert p.nuisance
    assert not parameters["d"].nuisance


def test_scale_guess_of_an_inertia_is_the_value_of_each_coordinate(tmp_path: Path) -> None:
    """A coordinate that is zero is refused."""
    hull = {"hull": {"inertial": "hull", "scale": "guess", "coordinates": "barycentric"}}
    task = body_task(tmp_path, parameters=hull)
    np.testing.assert_allclose(task.parameters.scale, np.abs(task.parameters.guess), rtol=1e-15)
    with pytest.raises(
        ExperimentError, match=r"parameters\.arm\.scale: my is 0; leave out scale = \"guess\""
    ):
        body_task(
            tmp_path, parameters={"arm": {**ARM, "scale": "guess", "coordinates": "barycentric"}}
        )


PLATE = CART_PENDULUM.format(integrator="RK4").replace(
    'mass="1.5" diaginertia="1e-3 1e-3 1e-3"', 'mass="1.5" diaginertia="{}"'
)


@pytest.mark.parametrize("moments", ["2e-3 1e-3 1e-3", "1e-9 1e-3 1e-3"])
def test_the_message_about_rods_and_plates_names_the_right_coordinates(
    moments: str, tmp_path: Path
) -> None:
    """Log-Cholesky is the default and cannot express them."""
    xml = PLATE.format(moments)
    if moments.startswith("2"):
        with pytest.raises(
            ExperimentError, match=r"bob\.inertial: body 'bob': .*a rod or a plate.*\"barycentric\""
        ):
            make_task(xml, tmp_path, parameters={"bob": {"inertial": "bob"}}, noise={"state": 0.1})
        table = {"s": {"target": "body/bob:logcholesky[4]"}}
        with pytest.raises(
            ExperimentError, match=r"parameters\.s: body 'bob' has no logcholesky coordinates"
        ):
            make_task(xml, tmp_path, parameters=table, noise={"state": 0.1})
    else:  # thin, but a body
        assert (
            len(
                make_task(
                    xml, tmp_path, parameters={"bob": {"inertial": "bob"}}, noise={"state": 0.1}
                ).theta
            )
            == 10
        )
    table = {"bob": {"inertial": "bob", "coordinates": "barycentric"}}
    assert len(make_task(xml, tmp_path, parameters=table, noise={"state": 0.1}).theta) == 10


WRONG: dict[str, tuple[dict[str, Any], str]] = {
    "no such body": (
        {"arm": {"inertial": "amr"}},
        r"parameters\.arm\.inertial: unknown body 'amr'.*'arm'.*hull",
    ),
    "body without mass": (
        {"arm": {"inertial": "world"}},
        r"parameters\.arm\.inertial: body 'world' has no mass",
    ),
    "guess for ten": (
        {"arm": {**ARM, "guess": 1.0}},
        r"parameters\.arm: .*ten parameters; guess would fit only one",
    ),
    "more for ten": (
        {
            "arm": {
                **ARM,
                "bounds": [0.0, 1.0],
                "wanted": 0.1,
                "published": 0.3,
                "unit": "kg",
                "scale": 2.0,
            }
        },
        r"parameters\.arm: .*bounds, wanted, published, unit, scale would fit only one",
    ),
    "coordinates": (
        {"arm": {**ARM, "coordinates": "central"}},
        r"parameters\.arm\.coordinates: .*'logcholesky' or 'bary",
    ),
    "coordinates of one": (
        {"m": {"target": "body/arm:mass", "coordinates": "barycentric"}},
        r"parameters\.m: coordinates can only be given together with inertial",
    ),
    "target and inertial": (
        {"m": {**ARM, "target": "body/arm:mass"}},
        r"parameters\.m: .*exactly one of target, targets and inertial",
    ),
    "inertial twice": (
        {"a": ARM, "b": ARM},
        r"parameters\.b\.alpha: target .* already belongs to parameters\.a\.alpha",
    ),
    "mass beside": (
        {"a": ARM, "m": {"target": "body/arm:mass"}},
        r"several coordinates at once \(logcholesky, mass\)",
    ),
    "clash with a coordinate": (
        {"arm": ARM, "arm.d1": {"target": "joint/ball:damping"}},
        r"parameters\.arm\.d1: duplicate parameter name",
    ),
    "function without a guess": (
        {"f": {"function": print}},
        r"parameters\.f: .*callable, f\(spec, value\), and needs a guess",
    ),
    "function that is none": (
        {"f": {"function": "print", "guess": 1.0}},
        r"parameters\.f: .*must be callable",
    ),
    "function and target": (
        {"f": {"function": print, "guess": 1.0, "target": "body/arm:mass"}},
        r"parameters\.f: .*exactly one of",
    ),
    "all nuisance": (
        {"m": {"target": "body/arm:mass", "nuisance": True}},
        r"parameters: all are nuisance",
    ),
    "no scale": (
        {"g": {"target": "body/arm:gravcomp"}},
        r"parameters\.g\.scale: .* is 0; state another guess, or a scale",
    ),
    "free joint without a part": (
        {"p": {"target": "initial/float:qpos"}},
        r"initial/float:qpos'.*valid: .*initial/float:qpos\.rx",
    ),
    "not in the model": (
        {"g": {"target": "output/acc:bias"}},
        r"parameters\.g: .*unknown output 'acc'.*valid: .*acc\[0\]",
    ),
    "wanted zero": (
        {"m": {"target": "body/arm:mass", "wanted": 0.0}},
        r"parameters\.m\.wanted: .*greater than 0",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_messages_about_wrong_parameters(name: str, tmp_path: Path) -> None:
    """They name the key, the fault and the valid values."""
    table, message = WRONG[name]
    with pytest.raises(ExperimentError, match=rf"experiment: .*{message}"):
        body_task(tmp_path, parameters=table)


# Distance from the hull to the arm, to its centre of mass, and its largest radius of gyration [m].
BODY_LENGTH = 0.15 + np.hypot(0.05, 0.25) + np.sqrt(0.012 / 0.4)


@pytest.mark.parametrize(
    ("path", "guess", "unit", "scale"),
    [
        ("joint/ball:damping", 0.05, "N m s/rad", 0.05),
        ("body/arm:mass", 0.4, "kg", 0.4),
        ("body/arm:rot[1]", 0.0, "rad", 1.0),
        ("initial/float:qpos.y", 0.0, "m", BODY_LENGTH),
        ("initial/float:qvel.y", 0.0, "m/s", BODY_LENGTH),
        ("initial/float:qpos.ry", 0.0, "rad", 1.0),
        ("initial/float:qvel.ry", 0.0, "rad/s", 1.0),
        ("initial/ball:qvel.rx", 0.0, "rad/s", 1.0),
        ("output/acc[1]:bias", 0.0, "", 0.1),
        ("output/acc[1]:scale", 0.0, "", 1.0),
        ("output:delay", 0.0, "s", 0.01),
        ("option:gravity[2]", -0.5, "m/s²", 0.5),
    ],
)
def test_guess_unit_and_scale_come_from_the_first_target(
    path: str, guess: float, unit: str, scale: float, tmp_path: Path
) -> None:
    parameters = named(body_task(tmp_path, parameters={"p": {"target": path}}))
    p = parameters["p"]
    assert (p.guess, p.unit, p.scale) == pytest.approx((guess, unit, scale))


def test_integers_are_valid_scales(tmp_path: Path) -> None:
    """TOML's 2 means 2.0."""
    assert body_task(
        tmp_path, parameters={"m": {"target": "body/arm:mass", "scale": 2}}
    ).parameters.scale.tolist() == [2.0]


# ---- nuisance table


def test_deviations_of_all_components_of_the_initial_state(tmp_path: Path) -> None:
    """One deviation for each degree of freedom in position and velocity, with the prior, as
    nuisance.
    """
    task = body_task(tmp_path, parameters=MASS, nuisance={"initial": 0.02})
    found = task.parameters.parameters
    assert len(found) == 1 + 9 + 9
    names = [f"initial qpos:float.{part}" for part in ("x", "y", "z", "rx", "ry", "rz")] + [
        f"initial qpos:ball.{part}" for part in ("rx", "ry", "rz")
    ]
    assert list(task.parameters.names[1:10]) == names
    assert list(task.parameters.names[10:]) == [n.replace("qpos", "qvel") for n in names]
    assert all(p.nuisance and p.prior == 0.02 and p.guess == 0.0 for p in found[1:])
    assert [p.unit for p in found[1:8]] == ["m", "m", "m", "rad", "rad", "rad", "rad"]
    assert task.parameters.interest.tolist() == [0]
    np.testing.assert_array_equal(task.parameters.initial_state_derivative(18)[:, 1:], np.eye(18))
    np.testing.assert_allclose(np.diag(task.parameters.prior_information)[1:], 2500.0)


@pytest.mark.parametrize(
    ("joint", "written", "right"),
    [
        ("float", "qpos[3]", "qpos.rx"),
        ("float", "qvel[0]", "qvel.x"),
        ("ball", "qpos[2]", "qpos.rz"),
    ],
)
def test_an_index_of_a_joint_is_refused_with_its_present_name(
    joint: str, written: str, right: str, tmp_path: Path
) -> None:
    """In the nuisance table, and in the paths of parameters."""
    quantity, right_quantity = (f"{w[:4]}:{joint}{w[4:]}" for w in (written, right))
    message = f"nuisance.initial: '{quantity}' is now written '{right_quantity}'"
    with pytest.raises(ExperimentError, match=re.escape(message)):
        body_task(tmp_path, parameters=MASS, nuisance={"initial": {quantity: 0.1}})

    path = f"initial/{joint}:{written}"
    message = f"parameter path '{path}': '{path}' is now written 'initial/{joint}:{right}'"
    with pytest.raises(ExperimentError, match=re.escape(f"parameters.p: in {message}")):
        body_task(tmp_path, parameters={"p": {"target": path}})


def test_a_deviation_of_an_orientation_is_a_rotation_vector(tmp_path: Path) -> None:
    """A quaternion's component is refused with the names of the rotation vector."""
    with pytest.raises(ExperimentError, match=r"rotation vector here; valid: qpos:ball\.rx, .*rz"):
        body_task(tmp_path, parameters=MASS, nuisance={"initial": {"qpos:ball.qw": 0.1}})


def test_deviations_and_biases_by_name(tmp_path: Path) -> None:
    """Only those that are named; `true` means no prior, a number is the standard deviation."""
    nuisance = {
        "initial": {"qpos:hinge": True, "qvel:slide": 0.1},
        "bias": {"qpos:slide": 0.3},
        "delay": 0.005,
    }
    parameters = named(cart_task(tmp_path, nuisance=nuisance))
    assert list(parameters) == [
        "m",
        "l",
        "c",
        "initial qpos:hinge",
        "initial qvel:slide",
        "bias qpos:slide",
        "delay",
    ]
    assert [p.prior for p in parameters.values()] == [None, None, None, None, 0.1, 0.3, 0.005]
    assert [p.unit for p in parameters.values()][3:] == ["rad", "m/s", "m", "s"]
    assert parameters["delay"].scale == 0.01


NUISANCE: dict[str, tuple[dict[str, Any], str]] = {
    "joint": (
        {"initial": {"qpos:hing": True}},
        r"nuisance\.initial: unknown name 'qpos:hing'.*'qpos:hinge'",
    ),
    "output": (
        {"bias": {"acc": True}},
        r"nuisance\.bias: unknown name 'acc'.*valid: qpos:hinge, qpos:slide",
    ),
    "false": ({"delay": False}, r"nuisance\.delay: "),
    "zero": ({"initial": 0.0}, r"nuisance\.initial: .*greater than 0"),
    "negative": ({"bias": {"qpos:slide": -1.0}}, r"nuisance\.bias\.qpos:slide: .*greater than 0"),
    "key": (
        {"delays": 0.1},
        r"nuisance\.delays: unknown key .*'delay'.*armature, bias, delay, friction, initial",
    ),
    "friction": ({"friction": {"rail": 0.1}}, r"nuisance\.friction: unknown name 'rail'.*slide"),
}


@pytest.mark.parametrize("name", NUISANCE)
def test_messages_about_a_wrong_nuisance_table(name: str, tmp_path: Path) -> None:
    """They name the key, the fault and the valid values."""
    nuisance, message = NUISANCE[name]
    with pytest.raises(ExperimentError, match=rf"experiment: {message}"):
        cart_task(tmp_path, nuisance=nuisance)


def test_a_nuisance_cannot_be_a_parameter_as_well(tmp_path: Path) -> None:
    """Neither its number nor its name may be used twice."""
    own = {**CART_PARAMETERS, "q": {"target": "initial/hinge:qpos"}}
    with pytest.raises(
        ExperimentError, match=r"initial qpos:hinge: target .* already belongs to parameters\.q"
    ):
        cart_task(tmp_path, parameters=own, nuisance={"initial": True})
    clash = {**CART_PARAMETERS, "delay": {"target": "joint/slide:damping"}}
    with pytest.raises(
        ExperimentError, match=r"parameters\.delay: duplicate parameter name; rename one"
    ):
        cart_task(tmp_path, parameters=clash, nuisance={"delay": True})
    with pytest.raises(ExperimentError, match=r"parameters: all are nuisance"):
        cart_task(
            tmp_path,
            parameters={"q": {"target": "body/bob:mass", "nuisance": True}},
            nuisance={"delay": True},
        )


def test_joints_without_a_name_are_refused_where_all_deviate(tmp_path: Path) -> None:
    """An initial state that is stated to be unknown must not be known in part."""
    xml = CART_PENDULUM.format(integrator="RK4").replace('joint name="hinge"', "joint").replace(
        '<jointpos name="angle" joint="hinge" noise="0.01"/>', ""
    ).replace('<jointvel name="rate" joint="hinge" noise="0.05"/>', "")  # fmt: skip
    table = {"m": {"target": "body/bob:mass"}}
    with pytest.raises(ExperimentError, match=r"nuisance\.initial: 1 joints have no name"):
        make_task(xml, tmp_path, parameters=table, noise={"state": 0.1}, nuisance={"initial": 0.1})
    task = make_task(
        xml,
        tmp_path,
        parameters=table,
        noise={"state": 0.1},
        nuisance={"initial": {"qpos:slide": 0.1}},
    )
    assert task.parameters.names == ("m", "initial qpos:slide")


def test_activations_of_the_initial_state_have_paths(tmp_path: Path) -> None:
    """The state of a filter, after positions and velocities."""
    task = filtered_task(tmp_path, parameters={"a": {"target": "initial/servo:act", "scale": 0.5}})
    assert task.parameters.initial_state_derivative(3).tolist() == [[0.0], [0.0], [1.0]]
    assert task.plant.initial_state(np.array([0.3]))[2] == pytest.approx(0.5)


# ---- functions of an MjSpec


def lengthen(spec: Any, value: float) -> None:
    """Both the bob's place and the mass of the cart follow one number."""
    spec.body("bob").pos = [0.0, 0.0, value]
    spec.body("cart").mass = 2.0 * value


def test_a_function_edits_the_spec(tmp_path: Path) -> None:
    """Against two equivalent targets, with the derivative."""
    targets = [{"path": "body/bob:pos[2]"}, {"path": "body/cart:mass", "scale": 2.0}]
    first = cart_task(tmp_path, parameters={"l": {"function": lengthen, "guess": 0.7, "unit": "m"}})
    second = cart_task(tmp_path, parameters={"l": {"targets": targets, "guess": 0.7}})
    assert first.parameters.needs_compile.tolist() == [
        True
    ] and second.parameters.needs_compile.tolist() == [False]
    np.testing.assert_allclose(first.initial.state, second.initial.state, rtol=0, atol=1e-12)
    found = [s.plant.derivatives.sensitivity(s.theta, s.initial).G for s in (first, second)]
    np.testing.assert_allclose(found[0], found[1], rtol=1e-7, atol=1e-7)
    assert np.abs(found[0]).max() > 0.1
    p = first.parameters.parameters[0]
    assert (p.unit, p.scale, p.targets) == ("m", 0.7, ())
    assert first.system.source.spec.body("bob").pos[2] == 0.8, (
        "the user's own spec must stay as it is"
    )


def test_functions_and_paths_work_together(tmp_path: Path) -> None:
    """Values that are written in place are written into the model that the function gave."""
    table = {"l": {"function": lengthen, "guess": 0.7}, "m": {"target": "body/bob:mass"}}
    task = cart_task(tmp_path, parameters=table)
    own = task.system.model_at(np.array([0.6, 2.5]))
    assert (
        own.body("bob").pos[2],
        own.body("cart").mass[0],
        own.body("bob").mass[0],
    ) == pytest.approx((0.6, 1.2, 2.5))
    assert task.system.model.body("bob").mass[0] == 1.5


def failing(spec: Any, value: float) -> None:
    """Edit a body that does not exist."""
    spec.body("bobb").mass = value


def negative(spec: Any, value: float) -> None:
    """Make a body unphysical."""
    spec.body("bob").mass = -value


def another_joint(spec: Any, value: float) -> None:
    """Add a degree of freedom."""
    spec.body("cart").add_joint()


def another_sensor(spec: Any, value: float) -> None:
    """Add a number to sensordata."""
    sensor = spec.add_sensor()
    sensor.type, sensor.objtype, sensor.objname = (
        mujoco.mjtSensor.mjSENS_JOINTPOS,
        mujoco.mjtObj.mjOBJ_JOINT,
        "hinge",
    )


def another_site(spec: Any, value: float) -> None:
    """Add an element that does not move but takes a place in MuJoCo's data."""
    spec.body("bob").add_site()


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (failing, ExperimentError, r"parameters\.f: its function failed: "),
        (negative, ModelError, r"MuJoCo cannot compile the model: .*mass"),
        (
            another_joint,
            ModelError,
            r"changes nq of the model from 2 to 3; it may change numbers only",
        ),
        (
            another_sensor,
            ModelError,
            r"changes nsensordata of the model from 6 to 7; it may change numbers only",
        ),
        (another_site, ModelError, r"changes nsite of the model.*; it may change numbers only"),
    ],
)
def test_messages_about_functions_that_fail(
    function: Any, error: type[MjfimError], message: str, tmp_path: Path
) -> None:
    """They name the parameter and the fault of its function."""
    with pytest.raises(error, match=message):
        cart_task(tmp_path, parameters={"f": {"function": function, "guess": 1.0}})


def test_a_function_whose_guess_is_zero_needs_a_scale(tmp_path: Path) -> None:
    """The model gives no magnitude for it."""
    with pytest.raises(ExperimentError, match=r"parameters\.f\.scale"):
        cart_task(tmp_path, parameters={"f": {"function": lengthen, "guess": 0.0}})

"""Unknown parameters: guesses, scales and units, inertias of bodies, the nuisance table, functions
of an MjSpec.
"""

from __future__ import annotations

import re
from contextlib import nullcontext
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.errors import ExperimentError, MjfimError, ModelError
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS, body_inertia
from tests.support.numerics import (
    CART_PENDULUM,
    FREE_BODY,
    body_task,
    cart_task,
    filtered_task,
    make_task,
    sensitivity_of,
)

ARM = {"inertial": "arm"}
MASS = {"m": {"target": "body/arm:mass"}}


@pytest.mark.parametrize("coordinates", [None, "logcholesky", "barycentric"])
def test_the_inertia_of_a_body_is_ten_parameters(coordinates: str | None, tmp_path: Path) -> None:
    """Guess, size, unit and prior of each come from the body itself."""
    arm = {**ARM, "coordinates": coordinates, "prior": 0.1, "nuisance": True}
    task = body_task(tmp_path, parameters={"arm": arm, "d": {"target": "joint/ball:damping"}})
    chart = INERTIA_PARAMETRISATIONS[coordinates or "logcholesky"]
    model = task.system.model
    inertia = body_inertia(model, model.body("arm").id)
    magnitudes = chart.magnitudes(inertia)
    assert task.parameters.names == (*(f"arm.{n}" for n in chart.names), "d")
    *ten, damping = task.parameters.parameters
    found = np.array([(p.guess, p.scale, p.prior) for p in ten]).T
    expected = [chart.coordinates(inertia), magnitudes, 0.1 * magnitudes]
    assert_allclose(found, expected, rtol=1e-12, atol=1e-15)
    assert_array_equal(task.parameters.magnitude[:10], magnitudes)
    assert tuple(p.unit for p in ten) == chart.units
    assert {(p.group, p.nuisance) for p in ten} == {("arm", True)}
    assert (damping.group, damping.nuisance) == ("", False)

    stated = {"hull": {"inertial": "hull", "scale": "guess", "coordinates": "barycentric"}}
    scaled = body_task(tmp_path, parameters=stated).parameters
    assert_allclose(scaled.scale, np.abs(scaled.guess), rtol=1e-15)


PLATE = CART_PENDULUM.format(integrator="RK4").replace(
    'mass="1.5" diaginertia="1e-3 1e-3 1e-3"', 'mass="1.5" diaginertia="{}"'
)


BOB: dict[str, Any] = {"inertial": "bob"}


@pytest.mark.parametrize(
    ("moments", "table", "said"),
    [
        ("2e-3 1e-3 1e-3", BOB, r"bob\.inertial: body 'bob': .*a rod or a plate.*\"barycentric\""),
        (
            "2e-3 1e-3 1e-3",
            {"target": "body/bob:logcholesky[4]"},
            r"parameters\.bob: body 'bob' has no logcholesky coordinates",
        ),
        ("2e-3 1e-3 1e-3", {**BOB, "coordinates": "barycentric"}, ""),
        ("1e-9 1e-3 1e-3", BOB, ""),  # thin, but a body
    ],
)
def test_rods_and_plates_have_barycentric_coordinates_only(
    moments: str, table: dict[str, Any], said: str, tmp_path: Path
) -> None:
    tables = {"parameters": {"bob": table}, "noise": {"state": 0.1}}
    refused = pytest.raises(ExperimentError, match=said) if said else nullcontext()
    with refused:
        assert len(make_task(PLATE.format(moments), tmp_path, **tables).theta) == 10


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
    "inertia with a coordinate that is 0": (
        {"arm": {**ARM, "scale": "guess", "coordinates": "barycentric"}},
        r"parameters\.arm\.scale: my is 0; leave out scale = \"guess\"",
    ),
    "function whose guess is 0": (
        {"f": {"function": print, "guess": 0.0}},
        r"parameters\.f\.scale",
    ),
    "wanted zero": (
        {"m": {"target": "body/arm:mass", "wanted": 0.0}},
        r"parameters\.m\.wanted: .*greater than 0",
    ),
}


@pytest.mark.parametrize("name", WRONG)
def test_messages_about_wrong_parameters(name: str, tmp_path: Path) -> None:
    table, message = WRONG[name]
    with pytest.raises(ExperimentError, match=rf"experiment: .*{message}"):
        body_task(tmp_path, parameters=table)


# Changed tables of the cart-pendulum, and the message.
NUISANCE: list[tuple[dict[str, Any], str]] = [
    *(
        ({"nuisance": table}, rf"experiment: nuisance\.{said}")
        for table, said in (
            ({"initial": {"qpos:hing": True}}, r"initial: unknown name 'qpos:hing'.*'qpos:hinge'"),
            (
                {"bias": {"acc": True}},
                r"bias: unknown name 'acc'.*valid: qpos:hinge, qpos:slide",
            ),
            ({"delay": False}, "delay: "),
            ({"initial": 0.0}, r"initial: .*greater than 0"),
            ({"bias": {"qpos:slide": -1.0}}, r"bias\.qpos:slide: .*greater than 0"),
            (
                {"delays": 0.1},
                r"delays: unknown key .*'delay'.*armature, bias, delay, friction, initial",
            ),
            ({"friction": {"rail": 0.1}}, r"friction: unknown name 'rail'.*slide"),
        )
    ),
    (
        {
            "parameters": {"q": {"target": "initial/hinge:qpos"}},
            "nuisance": {"initial": True},
        },
        r"initial qpos:hinge: target .* already belongs to parameters\.q",
    ),
    (
        {
            "parameters": {"delay": {"target": "joint/slide:damping"}},
            "nuisance": {"delay": True},
        },
        r"parameters\.delay: duplicate parameter name; rename one",
    ),
]


@pytest.mark.parametrize(("tables", "message"), NUISANCE)
def test_messages_about_a_wrong_nuisance_table(
    tables: dict[str, Any], message: str, tmp_path: Path
) -> None:
    with pytest.raises(ExperimentError, match=message):
        cart_task(tmp_path, **tables)


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
    (p,) = body_task(tmp_path, parameters={"p": {"target": path}}).parameters.parameters
    assert (p.guess, p.unit, p.scale) == pytest.approx((guess, unit, scale))
    stated = body_task(tmp_path, parameters={"p": {"target": path, "scale": 2}})
    assert stated.parameters.scale.tolist() == [2.0]


# ---- nuisance table


def test_deviations_of_all_components_of_the_initial_state(tmp_path: Path) -> None:
    task = body_task(tmp_path, parameters=MASS, nuisance={"initial": 0.02})
    parts = [*(f"float.{part}" for part in POSE), *(f"ball.{part}" for part in POSE[3:])]
    names = [f"initial {kind}:{part}" for kind in ("qpos", "qvel") for part in parts]
    assert task.parameters.names == ("m", *names)
    deviations = task.parameters.parameters[1:]
    assert {(p.nuisance, p.prior, p.guess) for p in deviations} == {(True, 0.02, 0.0)}
    assert [p.unit for p in deviations[:9]] == ["m"] * 3 + ["rad"] * 6
    assert task.parameters.interest.tolist() == [0]
    assert_array_equal(task.parameters.initial_state_derivative(18)[:, 1:], np.eye(18))


POSE = ("x", "y", "z", "rx", "ry", "rz")


def in_initial(name: str) -> dict[str, Any]:
    """Tables with a deviation of this name."""
    return {"parameters": MASS, "nuisance": {"initial": {name: 0.1}}}


@pytest.mark.parametrize(
    ("tables", "said"),
    [
        (
            in_initial("qpos:float[3]"),
            "nuisance.initial: 'qpos:float[3]' is now written 'qpos:float.rx'",
        ),
        (in_initial("qvel:float[0]"), "'qvel:float[0]' is now written 'qvel:float.x'"),
        (
            {"parameters": {"p": {"target": "initial/ball:qpos[2]"}}},
            "'initial/ball:qpos[2]' is now written 'initial/ball:qpos.rz'",
        ),
        (in_initial("qpos:ball.qw"), "rotation vector here; valid: qpos:ball.rx, qpos:ball.ry"),
    ],
)
def test_another_name_of_a_part_of_a_joint_is_refused_with_its_present_name(
    tables: dict[str, Any], said: str, tmp_path: Path
) -> None:
    """In the nuisance table, and in the paths of parameters."""
    with pytest.raises(ExperimentError, match=re.escape(said)):
        body_task(tmp_path, **tables)


def test_deviations_and_biases_by_name(tmp_path: Path) -> None:
    """Only those that are named; `true` means no prior, a number is the standard deviation."""
    nuisance = {
        "initial": {"qpos:hinge": True, "qvel:slide": 0.1},
        "bias": {"qpos:slide": 0.3},
        "delay": 0.005,
    }
    found = cart_task(tmp_path, nuisance=nuisance).parameters.parameters[3:]
    assert [(p.name, p.prior, p.unit) for p in found] == [
        ("initial qpos:hinge", None, "rad"),
        ("initial qvel:slide", 0.1, "m/s"),
        ("bias qpos:slide", 0.3, "m"),
        ("delay", 0.005, "s"),
    ]
    assert found[-1].scale == 0.01


def test_joints_without_a_name_are_refused_where_all_deviate(tmp_path: Path) -> None:
    """An initial state that is stated to be unknown must not be known in part."""
    xml = FREE_BODY.format(integrator="RK4").replace('name="float"', "")
    with pytest.raises(ExperimentError, match=r"nuisance\.initial: 1 joints have no name"):
        make_task(xml, tmp_path, parameters=MASS, nuisance={"initial": 0.1})
    task = make_task(xml, tmp_path, parameters=MASS, nuisance={"initial": {"qpos:ball.rx": 0.1}})
    assert task.parameters.names == ("m", "initial qpos:ball.rx")


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
    """Against two equivalent targets, beside a parameter that is written in place."""
    targets = [{"path": "body/bob:pos[2]"}, {"path": "body/cart:mass", "scale": 2.0}]
    first, second = (
        cart_task(
            tmp_path,
            parameters={
                "l": {"guess": 0.7, **table},
                "m": {"target": "body/bob:mass", "guess": 2.5},
            },
        )
        for table in ({"function": lengthen, "unit": "m"}, {"targets": targets})
    )
    assert [t.parameters.needs_compile.any() for t in (first, second)] == [True, False]
    assert_allclose(first.initial.state, second.initial.state, rtol=0, atol=1e-12)
    found, wanted = (sensitivity_of(task).G for task in (first, second))
    assert_allclose(found, wanted, rtol=1e-7, atol=1e-7)
    assert np.abs(wanted).max() > 0.1
    p = first.parameters.parameters[0]
    assert (p.unit, p.scale, p.targets) == ("m", 0.7, ())
    # The user's own spec stays as it is.
    assert first.system.source.spec.body("bob").pos[2] == 0.8


@pytest.mark.parametrize(
    ("function", "error", "message"),
    [
        (
            lambda spec, value: setattr(spec.body("bobb"), "mass", value),
            ExperimentError,
            r"parameters\.f: its function failed: ",
        ),
        (
            lambda spec, value: setattr(spec.body("bob"), "mass", -value),
            ModelError,
            r"MuJoCo cannot compile the model: .*mass",
        ),
        (
            lambda spec, value: spec.body("cart").add_joint(),
            ModelError,
            r"changes nq of the model from 2 to 3; it may change numbers only",
        ),
        (
            lambda spec, value: spec.add_sensor(
                type=mujoco.mjtSensor.mjSENS_JOINTPOS,
                objtype=mujoco.mjtObj.mjOBJ_JOINT,
                objname="hinge",
            ),
            ModelError,
            r"changes nsensordata of the model from 6 to 7; it may change numbers only",
        ),
        # An element that does not move but takes a place in MuJoCo's data.
        (
            lambda spec, value: spec.body("bob").add_site(),
            ModelError,
            r"changes nsite of the model.*; it may change numbers only",
        ),
    ],
)
def test_messages_about_functions_that_fail(
    function: Any, error: type[MjfimError], message: str, tmp_path: Path
) -> None:
    with pytest.raises(error, match=message):
        cart_task(tmp_path, parameters={"f": {"function": function, "guess": 1.0}})

"""Parameter paths, values written in place against compiled ones, and identified model files."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np
import pytest

from mjfim.errors import ExperimentError
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS, body_inertia
from mjfim.model.loading import ModelSource, decoration
from mjfim.model.parameter_writer import ParameterWriter
from mjfim.model.parameters import Parameter, ParameterSet, Target, moved_bodies
from mjfim.model.paths import KINDS, ParameterPath, fields_of, resolve
from mjfim.model.targets import ModelField, RotationField, SpecField
from mjfim.model.variants import PlantModel
from mjfim.output.export.mjcf import write_identified
from tests.support.numerics import make_task
from tests.support.specs import write_spec

# Two links with inertia from skewed geoms; a position servo; sensors that see sites and geoms.
ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option integrator="RK4"/>
  <worldbody>
    <body name="a">
      <joint name="j" type="hinge" axis="0 1 0" stiffness="2"/>
      <geom name="g" type="capsule" fromto="0 0 0 .3 .1 .5" size=".05" mass="1" contype="0"
        conaffinity="0"/>
      <site name="s"/>
      <body name="b" pos=".3 .1 .5">
        <joint name="k" type="hinge" axis="1 0 0"/>
        <geom name="h" type="box" pos=".1 0 .2" euler=".2 .3 .5" size=".1 .2 .3" mass="1"
          contype="0" conaffinity="0"/>
        <site name="t" pos=".1 .1 .1"/>
      </body>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="j"/><position name="p" joint="k" kp="10" kv="0.5"/></actuator>
  <sensor>
    <accelerometer site="s"/><accelerometer site="t"/>
    <framepos objtype="geom" objname="g"/><framepos objtype="geom" objname="h"/>
  </sensor>
</mujoco>
"""

# A box on a slide and a hinge, and one in free flight: bodies that MuJoCo would compile as
# 'simple'.
SIMPLE = """
<mujoco>
  <option integrator="RK4"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="slider">
      <joint name="x" type="slide" axis="1 0 0"/><joint name="h" type="hinge" axis="0 1 0"/>
      <geom name="box" type="box" size=".1 .2 .3" mass="1"/>
    </body>
    <body name="flyer" pos="0 0 .5">
      <freejoint name="f"/>
      <geom name="brick" type="box" size=".1 .2 .3" mass="1"/>
      <site name="nozzle"/>
    </body>
  </worldbody>
  <actuator>
    <motor name="m" joint="x"/><motor joint="h" gear=".1"/>
    <motor name="n" site="nozzle" gear="0 0 1 .1 0 0"/>
  </actuator>
  <sensor><accelerometer site="nozzle"/></sensor>
</mujoco>
"""

# Inertia is spelled out, so geoms only matter for contact: a sphere dropped onto a plane while
# sliding.
CONTACT = """
<mujoco>
  <worldbody>
    <geom name="floor" type="plane" size="1 1 .1" friction=".5"/>
    <body name="ball" pos="0 0 .12">
      <freejoint/>
      <inertial pos="0 0 0" mass="1" diaginertia=".01 .011 .012"/>
      <geom name="ball" type="sphere" size=".1" friction=".2"/>
    </body>
  </worldbody>
</mujoco>
"""

# A ball joint and a tendon with a stated rest length.
TENDON = """
<mujoco>
  <option integrator="RK4"/>
  <default><geom contype="0" conaffinity="0"/></default>
  <worldbody>
    <site name="anchor" pos=".5 0 .5"/>
    <body name="a">
      <joint name="j" type="ball" damping=".1"/>
      <geom name="g" type="capsule" fromto="0 0 0 0 0 .5" size=".05" mass="1"/>
      <site name="hook" pos=".1 0 .4"/>
    </body>
  </worldbody>
  <tendon>
    <spatial name="t" stiffness="20" damping="1" springlength=".3">
      <site site="anchor"/><site site="hook"/></spatial>
  </tendon>
  <actuator><motor name="m" tendon="t"/></actuator>
</mujoco>
"""

# All kinds of servos, a filter with its time constant, and air around the arm.
SERVOS = ARM.replace(
    "</actuator>",
    '<velocity name="v" joint="j" kv="2"/>'
    '<general name="f" joint="j" dyntype="filter" dynprm=".08" gainprm="3"/></actuator>',
).replace('integrator="RK4"', 'integrator="RK4" density="1.2" viscosity=".5"')

# Two slides that MuJoCo compiles as 'simple', coupled by a tendon.
COUPLED = """
<mujoco>
  <option integrator="RK4"/>
  <default><geom type="box" size=".1 .1 .1" mass="1" contype="0" conaffinity="0"/></default>
  <worldbody>
    <body name="a"><joint name="x" type="slide" axis="1 0 0"/><geom name="a"/></body>
    <body name="b" pos="0 1 0"><joint name="y" type="slide" axis="1 0 0"/><geom name="b"/></body>
  </worldbody>
  <tendon><fixed name="t"><joint joint="x" coef="1"/><joint joint="y" coef="-2"/></fixed></tendon>
  <actuator><motor joint="x" name="m"/></actuator>
</mujoco>
"""

# Spelled-out inertia and a geom that is drawn only: its size and place reach nothing but a sensor
# that looks at it.
DRAWN = """
<mujoco>
  <worldbody>
    <body name="link">
      <joint name="j" axis="0 1 0"/>
      <inertial pos=".1 0 .2" mass="1" fullinertia=".1 .12 .11 .01 .02 .01"/>
      <geom name="skin" type="box" size=".1 .2 .3" pos=".1 .2 .3" contype="0" conaffinity="0"/>
    </body>
  </worldbody>
  <actuator><motor name="m" joint="j"/></actuator>
  <sensor><framepos objtype="geom" objname="skin"/></sensor>
</mujoco>
"""

# model, path, new value, the derived constants of MjModel that must follow
PAIR = CONTACT.replace(
    "</worldbody>",
    '</worldbody><contact><pair name="rub" geom1="ball" geom2="floor"/></contact>',
)

EDITS = [
    (ARM, "body/a:mass", 2.0, ("body_subtreemass", "dof_M0", "body_invweight0")),
    (ARM, "body/b:mass", 2.0, ("body_subtreemass", "dof_M0", "actuator_acc0")),
    (ARM, "body/b:pos[2]", 0.7, ("dof_M0", "dof_invweight0")),
    (ARM, "body/a:ipos[0]", 0.4, ("dof_M0", "body_invweight0")),
    (ARM, "body/b:ipos[1]", 0.1, ("dof_M0", "geom_sameframe")),
    (ARM, "body/a:inertia[2]", 0.004, ("dof_M0", "body_invweight0")),
    (ARM, "body/b:inertia[1]", 0.04, ("dof_M0", "body_invweight0")),
    (ARM, "joint/j:damping", 0.5, ()),
    (ARM, "joint/j:damping[1]", 0.5, ()),
    (ARM, "joint/j:damping[2]", 0.5, ()),
    (ARM, "joint/j:frictionloss", 0.5, ()),
    (ARM, "joint/j:armature", 0.5, ("dof_M0", "dof_invweight0", "actuator_acc0")),
    (ARM, "joint/j:stiffness", 5.0, ()),
    (ARM, "joint/j:stiffness[1]", 5.0, ()),
    (ARM, "joint/j:stiffness[2]", 5.0, ()),
    (ARM, "joint/j:springref", 0.7, ()),
    (ARM, "actuator/m:gear", 2.0, ("actuator_acc0",)),
    (ARM, "actuator/p:gainprm", 5.0, ()),
    (ARM, "actuator/p:biasprm[1]", -5.0, ()),
    (ARM, "actuator/p:biasprm[2]", -1.5, ()),
    (ARM, "site/s:pos", 0.1, ("site_sameframe",)),
    (ARM, "site/t:pos[1]", 0.3, ()),
    (ARM, "option:gravity[0]", 1.0, ()),
    (ARM, "option:gravity[2]", -3.0, ()),
    (SIMPLE, "body/slider:mass", 2.0, ("dof_M0",)),
    (SIMPLE, "body/slider:ipos[0]", 0.1, ("dof_M0", "body_sameframe")),
    (SIMPLE, "body/slider:inertia[1]", 0.03, ("dof_M0",)),
    (SIMPLE, "body/flyer:mass", 2.0, ("dof_M0",)),
    (SIMPLE, "body/flyer:ipos[0]", 0.1, ("dof_M0", "body_sameframe")),
    (SIMPLE, "body/flyer:inertia[0]", 0.05, ("dof_M0",)),
    (SIMPLE, "site/nozzle:pos", 0.1, ("site_sameframe",)),
    (SIMPLE, "joint/f:damping", 0.5, ()),
    (SIMPLE, "joint/f:armature", 0.5, ("dof_M0",)),
    (ARM, "body/b:gravcomp", 0.5, ()),
    (SERVOS, "actuator/f:dynprm", 0.03, ()),
    (SERVOS, "actuator/p:kp", 7.0, ()),
    (SERVOS, "actuator/p:kv", 0.9, ()),
    (SERVOS, "actuator/v:kv", 0.9, ()),
    (SERVOS, "option:wind[1]", 3.0, ()),
    (SERVOS, "option:density", 5.0, ()),
    (ARM, "option:density", 5.0, ()),
    (SERVOS, "option:viscosity", 2.0, ()),
    (CONTACT, "geom/ball:solref[1]", 0.3, ()),
    (CONTACT, "geom/ball:friction", 0.9, ()),
    (CONTACT, "geom/floor:friction", 2.0, ()),
    (PAIR, "pair/rub:friction", 0.9, ()),
    (PAIR, "pair/rub:solref[1]", 0.3, ()),
    (DRAWN, "geom/skin:pos[1]", 0.5, ()),
    (TENDON, "tendon/t:stiffness", 40.0, ()),
    (TENDON, "tendon/t:damping", 3.0, ()),
    (TENDON, "tendon/t:frictionloss", 0.3, ()),
    (TENDON, "tendon/t:armature", 0.3, ("tendon_invweight0", "actuator_acc0")),
    (TENDON, "tendon/t:springlength", 0.5, ()),
    (TENDON, "tendon/t:springlength[1]", 0.5, ()),
    (TENDON, "site/hook:pos[2]", 0.3, ("tendon_length0", "tendon_invweight0", "actuator_acc0")),
    (TENDON, "joint/j:damping", 0.7, ()),
    (TENDON, "joint/j:stiffness", 2.0, ()),
]

# Geoms that collide or give their body its inertia: model, path, new value, what must follow. These
# are compiled anew.
COMPILES = [
    (CONTACT, "geom/ball:size", 0.15, ("geom_rbound", "geom_aabb")),
    (CONTACT, "geom/ball:pos[0]", 0.05, ("geom_sameframe",)),
    (CONTACT, "geom/floor:pos[2]", 0.05, ()),
    (ARM, "geom/h:size[1]", 0.25, ("body_inertia", "dof_M0")),
    (ARM, "geom/h:pos[0]", 0.2, ("body_ipos", "dof_M0")),
    (ARM, "geom/g:pos[2]", 0.4, ("body_ipos", "dof_M0")),
    (ARM, "geom/g:size[1]", 0.4, ("body_inertia", "dof_M0")),
    (ARM, "geom/h:mass", 2.5, ("body_mass", "body_inertia", "dof_M0")),
    (
        ARM.replace(' mass="1"', ""),
        "geom/h:density",
        500.0,
        ("body_mass", "body_inertia", "dof_M0"),
    ),
]

# Coordinates that are written together: an eigendecomposition or a product of quaternions lies
# between.
CHARTED = [
    *(f"body/{body}:fullinertia[{i}]" for body in "ab" for i in range(6)),
    *(f"body/{body}:firstmoment[{i}]" for body in "ab" for i in range(3)),
    *(f"body/{body}:origininertia[{i}]" for body in "ab" for i in range(6)),
    *(f"body/{body}:logcholesky[{i}]" for body in "ab" for i in range(10)),
    *(f"{thing}:rot[{i}]" for thing in ("body/a", "body/b", "site/s", "site/t") for i in range(3)),
]


def target_at(path: str, scale: float = 1.0, offset: float = 0.0) -> Target:
    """A target whose field is not resolved yet; `parameter_set` does it."""
    return Target(path=path, field=cast(Any, None), scale=scale, offset=offset)


def parameter_set(
    parameters: Sequence[Parameter],
    model: Any,
    outputs: Sequence[str] = (),
    decoration: Collection[str] = frozenset(),
) -> ParameterSet:
    """The parameters with the fields that their targets lead to in a model."""
    resolved = []
    for parameter in parameters:
        targets = tuple(
            replace(t, field=resolve(model, t.path, outputs, decoration)) for t in parameter.targets
        )
        resolved.append(replace(parameter, targets=targets))
    return ParameterSet.build(resolved, model)


def one(path: str, scale: float = 1.0, offset: float = 0.0) -> Parameter:
    """A parameter with one target."""
    return Parameter(name="theta", targets=(target_at(path, scale, offset),), guess=1.0)


def compiled(xml: str, parameters: list[Parameter]) -> tuple[Any, Any]:
    """Spec and model, compiled as in the package: moved bodies are not 'simple'."""
    spec = mujoco.MjSpec.from_string(xml)
    for name in moved_bodies(parameters):
        spec.body(name).simple = 0
    return spec, spec.compile()


def rollout(model: Any, steps: int = 300) -> np.ndarray:
    """States and sensors under a constant control, from a moving start."""
    data = mujoco.MjData(model)
    data.qvel[:] = 0.3 + 0.1 * np.arange(model.nv)
    data.ctrl[:] = 0.7
    rows = []
    for _ in range(steps):
        mujoco.mj_step(model, data)
        rows.append(np.concatenate([data.qpos, data.qvel, data.sensordata]))
    return np.array(rows)


def arrays(model: Any) -> dict[str, np.ndarray]:
    """Every array of a model, options included."""
    found = {n: getattr(model, n) for n in dir(model) if not n.startswith("_")}
    found |= {f"opt.{n}": getattr(model.opt, n) for n in dir(model.opt) if not n.startswith("_")}
    return {n: np.array(v) for n, v in found.items() if isinstance(v, np.ndarray)}


def both_ways(xml: str, path: str, value: float) -> tuple[Any, Any, Any]:
    """(base, written in place, recompiled) for one target."""
    parameters = [one(path)]
    spec, base = compiled(xml, parameters)
    resolved = parameter_set(parameters, base, decoration=decoration(spec, base))
    theta, other = np.array([value]), spec.copy()
    write_spec(other, base, ParameterWriter(resolved).model(base, theta), resolved, theta)
    return base, ParameterWriter(resolved).model(base, theta), other.compile()


def test_the_edits_cover_every_field_of_a_path() -> None:
    named = [
        ParameterPath.parse(path)
        for path in (*(e[1] for e in EDITS), *(e[1] for e in COMPILES), *CHARTED)
    ]
    covered = {(path.kind, path.field) for path in named}
    kinds_outside = ("controller", "initial", "output")
    outside = {(kind, f) for kind in kinds_outside for f in fields_of(kind)}
    assert covered == {(kind, field) for kind in KINDS for field in fields_of(kind)} - outside


@pytest.mark.parametrize(("xml", "path", "value", "derived"), EDITS, ids=[e[1] for e in EDITS])
def test_writing_in_place_equals_a_compile_bit_for_bit(
    xml: str, path: str, value: float, derived: tuple
) -> None:
    base, own, again = both_ways(xml, path, value)
    spec, fresh = compiled(xml, [])
    assert resolve(own, path, decoration=decoration(spec, fresh)).read(own) == value
    before, mine, theirs = arrays(base), arrays(own), arrays(again)
    for name in derived:
        assert not np.array_equal(before[name], theirs[name]), (
            f"{name} does not depend on {path}: a weak test"
        )
    unequal = [
        n
        for n in theirs
        if not np.array_equal(mine[n], theirs[n], equal_nan=mine[n].dtype.kind == "f")
    ]
    # a tendon that gains inertia ends the shortcut of 'simple' bodies, which MuJoCo then does not
    # take either
    assert unequal == (["body_simple"] if path == "tendon/t:armature" else [])
    moved = rollout(own)
    np.testing.assert_array_equal(moved, rollout(again))
    assert np.isfinite(moved).all()
    assert np.abs(moved - rollout(base)).max() > 1e-6, "the edit has no effect: a weak test"


def skew(v: np.ndarray) -> np.ndarray:
    """Matrix of the cross product with v."""
    return np.array([[0.0, -v[2], v[1]], [v[2], 0.0, -v[0]], [-v[1], v[0], 0.0]])


def written_by_hand(spec: Any, base: Any, path: str, change: float) -> None:
    """Edit of an MjSpec that changes one coordinate of an inertia, by its definition."""
    parsed = ParameterPath.parse(path)
    kind, name, field, i = parsed.kind, parsed.name, parsed.field, parsed.component
    element, found = getattr(spec, kind)(name), getattr(base, kind)(name)
    if field == "rot":
        turn, quat = np.zeros(4), np.zeros(4)
        mujoco.mju_axisAngle2Quat(turn, np.eye(3)[i], change)
        mujoco.mju_mulQuat(quat, np.array(found.quat), turn)
        element.quat = quat
        return
    R = np.zeros(9)
    mujoco.mju_quat2Mat(R, np.array(found.iquat))
    R = R.reshape(3, 3)
    m, c, I = float(found.mass[0]), np.array(found.ipos), R @ np.diag(found.inertia) @ R.T  # noqa: E741
    tensor = ((0, 0), (1, 1), (2, 2), (0, 1), (0, 2), (1, 2))
    D = np.zeros((3, 3))
    if "inertia" in field:
        D[tensor[i]] = D[tensor[i][::-1]] = change
        I = I + D  # noqa: E741 - moments about the centre and about the origin change alike while mass and centre stay
    elif field == "firstmoment":
        h = m * c + change * np.eye(3)[i]
        about = I - m * skew(c) @ skew(c)  # about the origin, which stays
        c = h / m
        I = about + m * skew(c) @ skew(c)  # noqa: E741
    else:
        J = 0.5 * np.trace(I) * np.eye(3) - I  # second moments about the centre, m U U'
        U = np.linalg.inv(np.linalg.cholesky(np.linalg.inv(J / m))).T
        if i == 0:
            m *= np.exp(2 * change)
        elif i < 4:
            U[i - 1, i - 1] *= np.exp(change)
        elif i < 7:
            U[((0, 1), (1, 2), (0, 2))[i - 4]] += change
        else:
            c = c + change * np.eye(3)[i - 7]
        J = m * U @ U.T
        I = np.trace(J) * np.eye(3) - J  # noqa: E741
    element.mass, element.ipos, element.explicitinertial = m, c, True
    element.fullinertia = [I[k] for k in tensor]


# A solid body: two boxes, so that no principal moments coincide; and one whose frames coincide
# where MuJoCo takes shortcuts.
SOLID = ARM.replace(
    'type="capsule" fromto="0 0 0 .3 .1 .5" size=".05"',
    'type="box" pos=".1 .05 .2" size=".1 .2 .3"',
)


@pytest.mark.parametrize(
    "xml", [SOLID, SOLID.replace(' pos=".1 .05 .2"', "")], ids=["skew", "aligned"]
)
@pytest.mark.parametrize("path", CHARTED)
def test_inertias_and_rotations_written_in_place_equal_a_compile(xml: str, path: str) -> None:
    parameters = [one(path)]
    spec, base = compiled(xml, parameters)
    resolved = parameter_set(parameters, base)
    field = resolved.parameters[0].targets[0].field
    value, change = (
        field.read(base),
        0.01 * field.magnitude(base) * (-1.0 if "firstmoment" in path else 1.0),
    )
    other = spec.copy()
    written_by_hand(other, base, path, change)
    own, again = ParameterWriter(resolved).model(base, np.array([value + change])), other.compile()
    written = (
        INERTIA_PARAMETRISATIONS[field.parametrisation].coordinates(body_inertia(own, field.body))[
            field.component
        ]
        if "rot" not in path
        else value + change
    )
    assert written == pytest.approx(value + change, rel=1e-9, abs=1e-12)
    for mine, theirs in zip(*(states_and_mass_matrix(m) for m in (own, again)), strict=True):
        np.testing.assert_allclose(mine, theirs, rtol=1e-10, atol=1e-10)
    before = ParameterWriter(resolved).model(base, np.array([value]))
    np.testing.assert_allclose(rollout(before, 50), rollout(base, 50), rtol=1e-10, atol=1e-10)
    # what of body a lies across its only hinge cannot be felt
    if not path.startswith(
        (
            "body/a:fullinertia",
            "body/a:origininertia",
            "body/a:logcholesky",
            "body/a:firstmoment[1]",
        )
    ):
        assert np.abs(rollout(own, 100) - rollout(base, 100)).max() > 1e-5, (
            "the edit has no effect: a weak test"
        )


def states_and_mass_matrix(model: Any) -> list[np.ndarray]:
    """Mass matrix, bias forces, mj_setConst's numbers and a short motion."""
    data, M = mujoco.MjData(model), np.zeros((model.nv, model.nv))
    data.qpos[:], data.qvel[:] = 0.3 - 0.1 * np.arange(model.nq), 0.5 + 0.2 * np.arange(model.nv)
    mujoco.mj_forward(model, data)
    mujoco.mj_fullM(model, data, M)
    bias = np.array(data.qfrc_bias)
    return [M, bias, model.dof_M0, model.dof_invweight0, model.body_subtreemass, rollout(model, 50)]


def test_inertia_of_a_tendon_couples_simple_bodies_as_a_compile_would() -> None:
    """MuJoCo's shortcut for 'simple' bodies must not hide it."""
    base, own, again = both_ways(COUPLED, "tendon/t:armature", 0.3)
    assert base.body_simple.tolist() != again.body_simple.tolist()
    for mine, theirs in zip(
        (states_and_mass_matrix(own)), states_and_mass_matrix(again), strict=True
    ):
        if (
            mine.ndim == 2
        ):  # mass matrix and motion; the weights of constraints follow a compile only
            np.testing.assert_array_equal(mine, theirs)
    assert np.abs(rollout(own, 50) - rollout(base, 50)).max() > 1e-3


@pytest.mark.parametrize(
    ("xml", "path", "value", "derived"), COMPILES, ids=[e[1] for e in COMPILES]
)
def test_geoms_that_change_the_dynamics_are_compiled_anew(
    xml: str, path: str, value: float, derived: tuple
) -> None:
    """It agrees with MuJoCo's compile of the edited element."""
    parameters = [one(path)]
    spec, base = compiled(xml, parameters)
    resolved = parameter_set(parameters, base, decoration=decoration(spec, base))
    assert isinstance(resolved.parameters[0].targets[0].field, SpecField)
    assert resolved.needs_compile.tolist() == resolved.changes_model.tolist() == [True]
    source = PlantModel(
        ModelSource(Path("model.xml"), spec),
        moved_bodies=frozenset(b.name for b in spec.bodies[1:]),
        sensors=True,
        friction=True,
    )
    before = arrays(source.model)
    own, theirs = ParameterWriter(resolved).model(source, np.array([value])), spec.copy()
    parsed = ParameterPath.parse(path)
    geom, field, i = theirs.geom(parsed.name), parsed.field, parsed.component
    if np.isfinite(geom.fromto[0]):  # the same capsule by middle, direction and half length
        middle, half = (
            0.5 * (geom.fromto[:3] + geom.fromto[3:]),
            0.5 * (geom.fromto[3:] - geom.fromto[:3]),
        )
        geom.size = [geom.size[0], float(np.linalg.norm(half)), 0.0]
        geom.pos, geom.fromto = middle, np.full(6, np.nan)
        geom.alt.type, geom.alt.zaxis = mujoco.mjtOrientation.mjORIENTATION_ZAXIS, half
    if field in ("size", "pos"):
        numbers = np.array(getattr(geom, field))
        numbers[i] = value
        setattr(geom, field, numbers)
    else:
        setattr(geom, field, value)
    for body in theirs.bodies[1:]:
        body.simple = 0
    again = theirs.compile()
    mine, wanted = arrays(own), arrays(again)
    for name in derived:
        assert not np.array_equal(before[name], wanted[name]), (
            f"{name} does not depend on {path}: a weak test"
        )
    # a direction by two points or by a vector rounds differently
    if np.isfinite(spec.geom(parsed.name).fromto[0]):  # and a capsule is round
        mine["geom_quat"], mine["body_iquat"] = wanted["geom_quat"], wanted["body_iquat"]
    unequal = [
        n
        for n in wanted
        if not np.allclose(mine[n], wanted[n], rtol=1e-12, atol=1e-14, equal_nan=True)
    ]
    assert unequal == []
    np.testing.assert_allclose(rollout(own, 100), rollout(again, 100), rtol=1e-9, atol=1e-9)
    assert np.abs(rollout(own) - rollout(base)).max() > 1e-6, "the edit has no effect: a weak test"
    for name, array in arrays(source.model).items():
        np.testing.assert_array_equal(array, before[name], err_msg=name)


def test_decoration_neither_collides_nor_has_mass() -> None:
    """A drawn geom is written in place; once it collides, or its body takes inertia from geoms, it
    is not.
    """
    for xml, drawn in (
        (DRAWN, True),
        (DRAWN.replace('contype="0" conaffinity="0"', 'contype="0" conaffinity="1"'), False),
        (DRAWN.replace("<mujoco>", '<mujoco><compiler inertiafromgeom="true"/>'), False),
        (
            DRAWN.replace(
                "<mujoco>", '<mujoco><contact><pair geom1="skin" geom2="ground"/></contact>'
            ).replace(
                "<worldbody>",
                '<worldbody><geom name="ground" type="plane" size="1 1 1" contype="0" '
                'conaffinity="0"/>',
            ),
            False,
        ),
    ):
        spec, base = compiled(xml, [])
        field = resolve(base, "geom/skin:size[2]", decoration=decoration(spec, base))
        assert isinstance(field, ModelField if drawn else SpecField)
        assert field.read(base) == 0.3
    spec, base = compiled(ARM, [])
    assert decoration(spec, base) == frozenset()
    spec, base = compiled(
        ARM.replace('mass="1"', 'mass="0"').replace(
            "<joint", '<inertial pos="0 0 .1" mass="1" diaginertia="1 1 1"/><joint'
        ),
        [],
    )
    assert decoration(spec, base) == {"g", "h"}


FRAMED = """
<mujoco>
  <option integrator="RK4"/>
  <worldbody>
    <frame pos="0 0 1" euler="0 0 90">
      <body name="a" pos=".1 .2 .3">
        <joint name="j" axis="0 1 0"/>
        <frame pos="0 .2 0" euler="0 0 90">
          <geom name="g" size=".1 .2 .3" pos=".3 0 0" euler="10 20 30" type="box" contype="0"
            conaffinity="0"/>
          <site name="s" pos=".1 0 .2" euler="0 30 0"/>
        </frame>
      </body>
    </frame>
  </worldbody>
  <actuator><motor joint="j" name="m"/></actuator>
  <sensor>
    <framepos objtype="site" objname="s"/><accelerometer site="s" name="acc" noise=".1"/>
  </sensor>
</mujoco>
"""


@pytest.mark.parametrize(
    "path", ["geom/g:pos[0]", "geom/g:size[1]", "site/s:pos[1]", "body/a:pos[0]", "site/s:rot[1]"]
)
def test_elements_inside_frames_are_placed_in_the_coordinates_of_their_body(
    path: str, tmp_path
) -> None:
    """`<frame>` is MJCF's way to write, not the compiled model's: at its own value the model stays
    the model.
    """
    table = {"theta": {"target": path}}
    task = make_task(FRAMED, tmp_path, rate=500.0, parameters=table, noise={"acc": 0.1})
    plain, same = (
        mujoco.MjModel.from_xml_string(FRAMED),
        task.system.model_at(task.parameters.guess),
    )
    np.testing.assert_allclose(rollout(same, 50), rollout(plain, 50), rtol=1e-10, atol=1e-10)
    moved = task.parameters.guess + 0.1
    own = task.system.model_at(moved)
    assert np.abs(rollout(own, 50) - rollout(plain, 50)).max() > 1e-3
    if ":pos" in path:  # the number that was named, in the compiled model
        found = getattr(own, path[: path.index("/")])(path[path.index("/") + 1 : path.index(":")])
        assert found.pos[int(path[-2])] == pytest.approx(moved[0], abs=1e-12)
    write_identified(tmp_path / "identified.xml", task.system, moved)
    again = mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml"))
    np.testing.assert_allclose(rollout(again, 50), rollout(own, 50), rtol=0, atol=1e-4)


TETRAHEDRON = "0 0 0 .2 0 0 0 .3 0 0 0 .4"
MESHED = ARM.replace(
    "<worldbody>", f'<asset><mesh name="tetra" vertex="{TETRAHEDRON}"/></asset><worldbody>'
).replace(
    'type="box" pos=".1 0 .2" euler=".2 .3 .5" size=".1 .2 .3"',
    'type="mesh" mesh="tetra" pos=".1 0 .2" euler=".2 .3 .5"',
)


def test_a_mesh_moves_from_its_compiled_place() -> None:
    """MuJoCo shifts a mesh to its centre; that offset must not be added twice.

    Its size is no number of the geom.
    """
    parameters = [one("geom/h:pos[2]")]
    spec, base = compiled(MESHED, parameters)
    source = PlantModel(
        ModelSource(Path("model.xml"), spec),
        moved_bodies=frozenset("ab"),
        sensors=True,
        friction=True,
    )
    resolved = parameter_set(parameters, base, decoration=decoration(spec, base))
    now = resolved.parameters[0].targets[0].field.read(base)
    assert abs(now - 0.2) > 0.01, "no offset: a weak test"
    np.testing.assert_allclose(
        ParameterWriter(resolved).model(source, np.array([now])).geom_pos,
        base.geom_pos,
        rtol=0,
        atol=1e-14,
    )
    own = ParameterWriter(resolved).model(source, np.array([now + 0.1]))
    np.testing.assert_allclose(
        own.geom("h").pos - base.geom("h").pos, [0.0, 0.0, 0.1], rtol=0, atol=1e-14
    )
    np.testing.assert_allclose(
        own.body("b").ipos - base.body("b").ipos, [0.0, 0.0, 0.1], rtol=0, atol=1e-14
    )
    with pytest.raises(ExperimentError, match="size of a mesh"):
        resolve(base, "geom/h:size")


@pytest.mark.parametrize(
    ("first", "second"), [("kp", "gainprm"), ("biasprm[1]", "kp"), ("kv", "biasprm[2]")]
)
def test_a_gain_by_two_names_is_one_number(first: str, second: str) -> None:
    _, base = compiled(ARM, [])
    with pytest.raises(ExperimentError, match=r"b: target .* already belongs to parameters\.a"):
        parameter_set(
            [
                Parameter(name=n, targets=(target_at(f"actuator/p:{field}"),), guess=1.0)
                for n, field in (("a", first), ("b", second))
            ],
            base,
        )


BALL = """
<mujoco>
  <worldbody><body name="b"><joint name="j" type="ball"/><geom type="box" size=".1 .2 .3" mass="1"/>
    <body pos="0 0 .5"><joint name="h" axis="0 1 0"/><geom size=".1" mass="1"/></body>
  </body></worldbody>
  <actuator>{}<motor name="m" joint="h" gear="1.5"/></actuator>
</mujoco>
"""


SERVO = ARM.replace('<position name="p" joint="k" kp="10" kv="0.5"/>', "{}")


@pytest.mark.parametrize(
    ("xml", "written", "path"),
    [
        (SERVO, '<position name="s" joint="k" kp="{}" kv="0.5"/>', "kp"),
        (SERVO, '<position name="s" joint="k" kp="10" kv="{}"/>', "kv"),
        (SERVO, '<velocity name="s" joint="k" kv="{}"/>', "kv"),
        (SERVO, '<intvelocity name="s" joint="k" kp="{}" actrange="-2 2"/>', "kp"),
        (BALL, '<orientation name="s" joint="j" kp="{}" kv="1"/>', "kp"),
        (BALL, '<orientation name="s" joint="j" kp="4" kv="{}"/>', "kv"),
        (BALL, '<pid name="s" joint="h" kp="{}" kv="1" ki="2"/>', "kp"),
        (BALL, '<pid name="s" joint="h" kp="4" kv="{}" ki="4"/>', "kv"),
    ],
)
def test_servo_gains_are_those_of_the_mjcf(xml: str, written: str, path: str) -> None:
    """Bit for bit what a compile of the other number gives; a PID controller's first gain is
    another one.
    """
    base, again = (
        mujoco.MjModel.from_xml_string(xml.format(written.format(gain))) for gain in ("2", "3.5")
    )
    resolved = parameter_set([one(f"actuator/s:{path}")], base)
    field = resolved.parameters[0].targets[0].field
    own = ParameterWriter(resolved).model(base, np.array([3.5]))
    assert (field.read(base), field.read(own)) == (2.0, 3.5)
    mine, theirs = arrays(own), arrays(again)
    assert [n for n in theirs if not np.array_equal(mine[n], theirs[n], equal_nan=True)] == []
    assert np.abs(rollout(own) - rollout(base)).max() > 1e-3


@pytest.mark.parametrize("thing", ["body/b", "site/t"])
def test_three_rotation_components_are_one_rotation_vector(thing: str) -> None:
    """In the element's own axes, from its compiled orientation: exp of the vector, not three turns
    one after the other.
    """
    xml = ARM.replace('pos=".3 .1 .5"', 'pos=".3 .1 .5" euler=".4 .1 -.2"').replace(
        'name="t" ', 'name="t" euler="1 0 .3" '
    )
    parameters = [
        Parameter(name=f"r{i}", targets=(target_at(f"{thing}:rot[{i}]"),), guess=0.0)
        for i in range(3)
    ]
    spec, base = compiled(xml, parameters)
    resolved, vector = parameter_set(parameters, base), np.array([0.5, -0.9, 0.7])
    kind, name = thing.split("/")
    turn, quat = np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, vector / np.linalg.norm(vector), float(np.linalg.norm(vector)))
    mujoco.mju_mulQuat(quat, np.array(getattr(base, kind)(name).quat), turn)
    own = ParameterWriter(resolved).model(base, vector)
    assert abs(getattr(own, kind)(name).quat @ quat) == pytest.approx(1.0, abs=1e-14)
    element = getattr(spec, kind)(name)
    element.alt.type, element.quat = mujoco.mjtOrientation.mjORIENTATION_QUAT, quat
    np.testing.assert_allclose(
        rollout(own, 100), rollout(spec.compile(), 100), rtol=1e-9, atol=1e-9
    )
    targets = [t for parameter in resolved.parameters for t in parameter.targets]
    assert all(isinstance(t.field, RotationField) for t in targets)
    again = ParameterWriter(resolved).model(base, np.zeros(3))  # nothing of the first value is left
    np.testing.assert_allclose(rollout(again, 100), rollout(base, 100), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    "fields",
    [
        ("inertia[0]", "fullinertia[1]"),
        ("fullinertia[0]", "origininertia[1]"),
        ("ipos[0]", "firstmoment[1]"),
        ("ipos[0]", "origininertia[1]"),
        ("mass", "logcholesky[3]"),
        ("inertia[2]", "logcholesky[3]"),
        ("firstmoment[0]", "logcholesky[3]"),
    ],
)
def test_mixed_parametrisations_of_one_body_are_refused(
    fields: tuple[str, str],
) -> None:
    """They are refused in either order; on two bodies they are allowed."""
    _, base = compiled(SOLID, [])
    for first, second in (fields, fields[::-1]):
        pair = [
            Parameter(name=n, targets=(target_at(f"body/a:{f}"),), guess=1.0)
            for n, f in (("p", first), ("q", second))
        ]
        with pytest.raises(
            ExperimentError,
            match=r"parameters\.[pq]: .*several coordinates at once .*valid together",
        ):
            parameter_set(pair, base)
    apart = [
        Parameter(name="p", targets=(target_at(f"body/a:{fields[0]}"),), guess=1.0),
        Parameter(name="q", targets=(target_at(f"body/b:{fields[1]}"),), guess=1.0),
    ]
    assert len(parameter_set(apart, base)) == 2


def test_mass_beside_first_moments_keeps_them() -> None:
    """The barycentric mass: m c and the inertia about the origin stay while the mass changes;
    alone, the centre stays.
    """
    _, base = compiled(SOLID, [one("body/a:mass")])
    before = INERTIA_PARAMETRISATIONS["barycentric"].coordinates(
        body_inertia(base, base.body("a").id)
    )
    parameters = [
        one("body/a:mass"),
        Parameter(name="h", targets=(target_at("body/a:firstmoment[2]"),), guess=1.0),
    ]
    own = ParameterWriter(parameter_set(parameters, base)).model(
        base, np.array([1.5, before[3] + 0.02])
    )
    after = INERTIA_PARAMETRISATIONS["barycentric"].coordinates(body_inertia(own, own.body("a").id))
    wanted = np.array(before)
    wanted[0], wanted[3] = 1.5, before[3] + 0.02
    np.testing.assert_allclose(after, wanted, rtol=1e-12, atol=1e-15)
    alone = ParameterWriter(parameter_set([one("body/a:mass")], base)).model(base, np.array([1.5]))
    np.testing.assert_array_equal(alone.body("a").ipos, base.body("a").ipos)


def test_measurement_and_initial_state_are_outside_the_model() -> None:
    """Linear maps of theta outside the model, by the scale of their targets."""
    paths = ["initial/k:qvel", "initial/j:qpos", "output/b:bias", "output:delay", "body/a:mass"]
    parameters = [
        Parameter(name=p, targets=(target_at(p, s),), guess=1.0)
        for p, s in zip(paths, (2.0, -1.0, 0.5, 3.0, 1.0), strict=True)
    ]
    _, base = compiled(ARM, [])
    resolved = parameter_set(parameters, base, outputs=("a", "b"))
    start = np.zeros((4, 5))
    start[3, 0], start[0, 1] = 2.0, -1.0
    np.testing.assert_array_equal(resolved.initial_state_derivative(4), start)
    np.testing.assert_array_equal(
        resolved.bias_derivative(2), [[0.0] * 5, [0.0, 0.0, 0.5, 0.0, 0.0]]
    )
    np.testing.assert_array_equal(resolved.delay_derivative, [0.0, 0.0, 0.0, 3.0, 0.0])
    assert resolved.changes_model.tolist() == [False] * 4 + [True]
    assert resolved.changes_motion.tolist() == [True, True, False, False, True]
    assert not resolved.needs_compile.any()
    own = ParameterWriter(resolved).model(
        base, np.array([9.0, 9.0, 9.0, 9.0, base.body("a").mass[0]])
    )
    np.testing.assert_array_equal(rollout(own, 20), rollout(base, 20))


# A ball that can only slide: MuJoCo gives such a body another constraint weight than others.
SLIDING_BALL = """
<mujoco>
  <option timestep="0.005"/>
  <worldbody>
    <geom name="floor" type="plane" size="5 5 .1" friction=".5"/>
    <body name="ball" pos="0 0 .2">
      <joint name="x" type="slide" axis="1 0 0" armature=".2"/>
      <joint name="z" type="slide" axis="0 0 1" armature=".3" range="-.11 .15" limited="true"/>
      <inertial pos="0 0 0" mass="2" diaginertia=".01 .011 .012"/>
      <geom name="ball" type="sphere" size=".1"/>
    </body>
  </worldbody>
  <actuator><motor name="push" joint="x"/></actuator>
</mujoco>
"""


def test_a_body_that_only_slides_touches_the_floor_as_in_the_users_model(tmp_path) -> None:
    """Parameters of its mass do not change the stiffness of contacts and limits."""
    target = {"mass": {"target": "body/ball:mass"}, "inertia": {"target": "body/ball:inertia[0]"}}
    task = make_task(SLIDING_BALL, tmp_path, rate=100.0, parameters=target, noise={"state": 0.1})
    plain = rollout(mujoco.MjModel.from_xml_string(SLIDING_BALL))

    for model in (task.system.model_at(task.theta), task.plant.model(task.theta)):
        np.testing.assert_allclose(rollout(model), plain, rtol=1e-7, atol=1e-7)


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("body/bb:mass", ["unknown body 'bb'", "valid: a, b, world"]),
        ("joint/q:damping", ["unknown joint 'q'", "valid: j, k"]),
        ("tendon/q:damping", ["unknown tendon 'q'", "valid: none"]),
        (
            "bodies/a:mass",
            [
                "unknown kind 'bodies'",
                "did you mean 'body'",
                "actuator, body, controller, geom, initial, joint, option, output, pair, site",
            ],
        ),
        (
            "body/a:weight",
            [
                "unknown body field 'weight'",
                "valid: firstmoment, fullinertia, gravcomp, inertia, ipos",
            ],
        ),
        (
            "joint/j:mass",
            ["unknown joint field 'mass'", "armature, damping, frictionloss, springref, stiffness"],
        ),
        ("body/world:fullinertia", ["body 'world' has no mass"]),
        ("body/a:rot[3]", ["index 3 is out of range", "valid: 0 to 2"]),
        ("actuator/m:kp", ["no position servo", "gainprm[i] and biasprm[i]"]),
        ("actuator/m:kv", ["no position or velocity servo"]),
        ("initial/q:qpos", ["unknown joint 'q'", "valid: j, k"]),
        ("initial/j:qpos.rx", ["has no parts", "write 'initial/j:qpos'"]),
        ("body/a:pos.x", ["has parts such as '.rx'", "write pos[index]"]),
        ("initial/j:qpos[1]", ["index 1 is out of range", "valid: 0 to 0"]),
        ("initial/p:act", ["unknown actuator with a state 'p'", "valid: none"]),
        ("output/y:bias", ["unknown output 'y'", "valid: none"]),
        ("output/y:delay", ["one delay lags all outputs", "output:delay"]),
        ("body/a:pos[-1]", ["not of the form kind/name:field[index]"]),
        ("", ["not of the form kind/name:field[index]"]),
    ],
)
def test_the_message_about_a_wrong_path_names_valid_values(path: str, said: list[str]) -> None:
    _, base = compiled(ARM, [])
    with pytest.raises(ExperimentError) as caught:
        resolve(base, path)
    message = str(caught.value)
    assert repr(path) in message
    for part in said:
        assert part in message


def test_difference_steps_and_priors_follow_guess_and_scale() -> None:
    _, base = compiled(ARM, [])
    large = Parameter(
        name="large", targets=(target_at("body/a:mass"),), guess=-3.0, scale=0.5, prior=0.1
    )
    zero = Parameter(
        name="zero",
        targets=(target_at("joint/j:damping"),),
        guess=0.0,
        scale=0.2,
        true=0.4,
        bounds=(0.0, 1.0),
    )
    resolved = parameter_set([large, zero], base)
    np.testing.assert_array_equal(resolved.magnitude, [3.0, 0.2])
    np.testing.assert_allclose(resolved.prior_information, np.diag([100.0, 0.0]), rtol=1e-14)
    np.testing.assert_array_equal(resolved.true, [-3.0, 0.4])
    assert (resolved.names, resolved.lower[0], resolved.upper[1]) == (
        ("large", "zero"),
        -np.inf,
        1.0,
    )


def in_arm(folder: Path, tables: dict) -> Any:
    """DesignTask of an experiment on ARM."""
    return make_task(ARM, folder, rate=500.0, horizon=0.1, parameters=tables, noise={"state": 0.1})


@pytest.mark.parametrize("key", ["guess", "true"])
@pytest.mark.parametrize(
    ("field", "value", "fault"),
    [
        ("mass", -1.0, r"mass -1 kg; it must be > 0"),
        ("mass", 0.0, r"mass 0 kg; it must be > 0"),
        ("inertia[1]", -0.1, r"principal moments of inertia -0\.1, .*; all must be > 0"),
        (
            "fullinertia[0]",
            50.0,
            r"principal moments of inertia .*, 50 kg m².*"
            r"pseudo-inertia is not positive semidefinite",
        ),
        ("firstmoment[0]", 50.0, r"principal moments of inertia -.*; all must be > 0"),
        ("origininertia[1]", 1e-6, r"principal moments of inertia -.*; all must be > 0"),
    ],
)
def test_unphysical_bodies_are_refused_before_a_simulation(
    field: str, value: float, fault: str, key: str, tmp_path: Path
) -> None:
    table = {"theta": {"target": f"body/a:{field}", "scale": 1.0, key: value}}
    with pytest.raises(ExperimentError, match=rf"parameters\.theta\.{key}: body 'a' has {fault}"):
        in_arm(tmp_path, table)


@pytest.mark.parametrize("field", ["origininertia[0]", "fullinertia[0]", "mass"])
def test_plates_and_fixed_loads_without_mass_are_physical(field: str, tmp_path: Path) -> None:
    """These are a plate with few digits, and a load without mass that is fixed to a link."""
    plate = '<inertial pos="0 0 0" mass="1" diaginertia="0.01 0.02 0.03"/>'
    load = (
        '<body name="load" pos="0 0 .1"><inertial pos="0 0 0" mass="0" diaginertia="0 0 0"/></body>'
    )
    xml = BALL.format("").replace('<geom type="box" size=".1 .2 .3" mass="1"/>', plate + load)
    path = "body/load:mass" if field == "mass" else f"body/b:{field}"
    table = {
        "theta": {"target": path, "guess": 0.0 if field == "mass" else 0.00999999999, "scale": 1.0}
    }
    make_task(xml, tmp_path, rate=100.0, horizon=0.1, parameters=table, noise={"state": 0.1})

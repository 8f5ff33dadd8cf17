"""Parameter paths, values written in place against compiled ones, and identified model files."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import replace
from pathlib import Path
from typing import Any, cast

import mujoco
import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

from mjfim.errors import ExperimentError
from mjfim.model.inertia import INERTIA_PARAMETRISATIONS, body_inertia
from mjfim.model.loading import ModelSource, decoration
from mjfim.model.parameter_writer import ParameterWriter
from mjfim.model.parameters import Parameter, ParameterSet, Target, moved_bodies
from mjfim.model.paths import KINDS, ParameterPath, fields_of, resolve
from mjfim.model.targets import ModelField, SpecField
from mjfim.model.variants import PlantModel
from mjfim.output.export.mjcf import write_identified
from tests.support.numerics import make_task
from tests.support.specs import arrays_of, write_spec

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

PAIR = CONTACT.replace(
    "</worldbody>",
    '</worldbody><contact><pair name="rub" geom1="ball" geom2="floor"/></contact>',
)

# Model -> path -> new value. A value written in place must give the model of a compile.
EDITS: dict[str, dict[str, float]] = {
    ARM: {
        "body/a:mass": 2.0,
        "body/b:mass": 2.0,
        "body/b:pos[2]": 0.7,
        "body/a:ipos[0]": 0.4,
        "body/b:ipos[1]": 0.1,
        "body/a:inertia[2]": 0.004,
        "body/b:inertia[1]": 0.04,
        "joint/j:damping": 0.5,
        "joint/j:damping[1]": 0.5,
        "joint/j:damping[2]": 0.5,
        "joint/j:frictionloss": 0.5,
        "joint/j:armature": 0.5,
        "joint/j:stiffness": 5.0,
        "joint/j:stiffness[1]": 5.0,
        "joint/j:stiffness[2]": 5.0,
        "joint/j:springref": 0.7,
        "actuator/m:gear": 2.0,
        "actuator/p:gainprm": 5.0,
        "actuator/p:biasprm[1]": -5.0,
        "actuator/p:biasprm[2]": -1.5,
        "site/s:pos": 0.1,
        "site/t:pos[1]": 0.3,
        "option:gravity[0]": 1.0,
        "option:gravity[2]": -3.0,
        "option:density": 5.0,
        "body/b:gravcomp": 0.5,
    },
    SIMPLE: {
        "body/slider:mass": 2.0,
        "body/slider:ipos[0]": 0.1,
        "body/slider:inertia[1]": 0.03,
        "body/flyer:mass": 2.0,
        "body/flyer:ipos[0]": 0.1,
        "body/flyer:inertia[0]": 0.05,
        "site/nozzle:pos": 0.1,
        "joint/f:damping": 0.5,
        "joint/f:armature": 0.5,
    },
    SERVOS: {
        "actuator/f:dynprm": 0.03,
        "actuator/p:kp": 7.0,
        "actuator/p:kv": 0.9,
        "actuator/v:kv": 0.9,
        "option:wind[1]": 3.0,
        "option:density": 5.0,
        "option:viscosity": 2.0,
    },
    CONTACT: {
        "geom/ball:solref[1]": 0.3,
        "geom/ball:friction": 0.9,
        "geom/floor:friction": 2.0,
    },
    PAIR: {"pair/rub:friction": 0.9, "pair/rub:solref[1]": 0.3},
    DRAWN: {"geom/skin:pos[1]": 0.5},
    TENDON: {
        "tendon/t:stiffness": 40.0,
        "tendon/t:damping": 3.0,
        "tendon/t:frictionloss": 0.3,
        "tendon/t:armature": 0.3,
        "tendon/t:springlength": 0.5,
        "tendon/t:springlength[1]": 0.5,
        "site/hook:pos[2]": 0.3,
        "joint/j:damping": 0.7,
        "joint/j:stiffness": 2.0,
    },
    COUPLED: {"tendon/t:armature": 0.3},
}

BALL = """
<mujoco>
  <worldbody><body name="b"><joint name="j" type="ball"/><geom type="box" size=".1 .2 .3" mass="1"/>
    <body pos="0 0 .5"><joint name="h" axis="0 1 0"/><geom size=".1" mass="1"/></body>
  </body></worldbody>
  <actuator>{}<motor name="m" joint="h" gear="1.5"/></actuator>
</mujoco>
"""
SERVO = ARM.replace('<position name="p" joint="k" kp="10" kv="0.5"/>', "{}")
CAPSULE = 'fromto="0 0 0 .3 .1 .5" size=".05"'
BOX = 'pos=".1 0 .2" euler=".2 .3 .5" size=".1 .2 .3"'

# Model, path, its text in the MJCF, and the text with the new value. Geoms that collide or give
# their body its inertia are compiled anew; gains of servos are written in place.
TEXTS: list[tuple[str, str, str, str, float]] = [
    (CONTACT, "geom/ball:size", 'size=".1"', 'size=".15"', 0.15),
    (CONTACT, "geom/ball:pos[0]", 'name="ball" type', 'name="ball" pos=".05 0 0" type', 0.05),
    (CONTACT, "geom/floor:pos[2]", 'size="1 1 .1"', 'size="1 1 .1" pos="0 0 .05"', 0.05),
    (ARM, "geom/h:size[1]", BOX, BOX.replace(".1 .2 .3", ".1 .25 .3"), 0.25),
    (ARM, "geom/h:pos[0]", BOX, BOX.replace(".1 0 .2", ".2 0 .2"), 0.2),
    # The same capsule by its middle, direction and half length.
    (
        ARM,
        "geom/g:pos[2]",
        CAPSULE,
        'pos=".15 .05 .4" zaxis=".3 .1 .5" size=".05 0.29580398915498085"',
        0.4,
    ),
    (ARM, "geom/g:size[1]", CAPSULE, 'pos=".15 .05 .25" zaxis=".3 .1 .5" size=".05 .4"', 0.4),
    (ARM, "geom/h:mass", f'{BOX} mass="1"', f'{BOX} mass="2.5"', 2.5),
    (ARM.replace(' mass="1"', ""), "geom/h:density", BOX, f'{BOX} density="500"', 500.0),
    *(
        (
            xml.format(servo.format("2")),
            f"actuator/s:{gain}",
            servo.format("2"),
            servo.format("3.5"),
            3.5,
        )
        for xml, gain, servo in (
            (SERVO, "kp", '<position name="s" joint="k" kp="{}" kv="0.5"/>'),
            (SERVO, "kv", '<position name="s" joint="k" kp="10" kv="{}"/>'),
            (SERVO, "kv", '<velocity name="s" joint="k" kv="{}"/>'),
            (SERVO, "kp", '<intvelocity name="s" joint="k" kp="{}" actrange="-2 2"/>'),
            (BALL, "kp", '<orientation name="s" joint="j" kp="{}" kv="1"/>'),
            (BALL, "kv", '<orientation name="s" joint="j" kp="4" kv="{}"/>'),
            # The first gain of a PID controller is another one.
            (BALL, "kp", '<pid name="s" joint="h" kp="{}" kv="1" ki="2"/>'),
            (BALL, "kv", '<pid name="s" joint="h" kp="4" kv="{}" ki="4"/>'),
        )
    ),
]

# Coordinates of inertias that are written together: field of a body -> parametrisation, place of
# the first coordinate, number.
INERTIAL = {
    "fullinertia": ("central", 4, 6),
    "firstmoment": ("barycentric", 1, 3),
    "origininertia": ("barycentric", 4, 6),
    "logcholesky": ("logcholesky", 0, 10),
}

# A solid body: two boxes, so that no principal moments coincide; and one whose frames coincide
# where MuJoCo takes shortcuts.
SOLID = ARM.replace(
    'type="capsule" fromto="0 0 0 .3 .1 .5" size=".05"',
    'type="box" pos=".1 .05 .2" size=".1 .2 .3"',
)


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


def plant_of(spec: Any) -> PlantModel:
    """A plant whose bodies may all be moved."""
    bodies = frozenset(body.name for body in spec.bodies[1:])
    source = ModelSource(Path("model.xml"), spec)
    return PlantModel(source, moved_bodies=bodies, sensors=True, friction=True)


def require_same_motion(own: Any, again: Any, base: Any, tolerance: float) -> None:
    """Two models move alike, and not as the base model does."""
    moved = rollout(own)
    assert_allclose(moved, rollout(again), rtol=tolerance, atol=tolerance)
    assert np.abs(moved - rollout(base)).max() > 1e-6, "the edit has no effect: a weak test"


def test_the_tables_cover_every_field_of_a_path() -> None:
    paths = [*(path for edits in EDITS.values() for path in edits), *(row[1] for row in TEXTS)]
    named = [ParameterPath.parse(path) for path in paths]
    covered = {(path.kind, path.field) for path in named}
    covered |= {("body", field) for field in (*INERTIAL, "rot")} | {("site", "rot")}
    outside = {(kind, f) for kind in ("controller", "initial", "output") for f in fields_of(kind)}
    assert covered == {(kind, field) for kind in KINDS for field in fields_of(kind)} - outside


@pytest.mark.parametrize(
    ("xml", "path", "value"),
    [(xml, path, value) for xml, edits in EDITS.items() for path, value in edits.items()],
)
def test_writing_in_place_equals_a_compile_bit_for_bit(xml: str, path: str, value: float) -> None:
    parameters, theta = [one(path)], np.array([value])
    spec, base = compiled(xml, parameters)
    resolved = parameter_set(parameters, base, decoration=decoration(spec, base))
    own = ParameterWriter(resolved).model(base, theta)
    write_spec(spec, base, own, resolved, theta)
    again = spec.compile()

    assert resolved.parameters[0].targets[0].field.read(own) == value
    mine, theirs = arrays_of(own), arrays_of(again)
    unequal = {n for n in theirs if not np.allclose(mine[n], theirs[n], 0.0, 0.0, equal_nan=True)}
    # A tendon that gains inertia ends the shortcut of "simple" bodies, which MuJoCo then does not
    # take either; the weights of constraints follow a compile only.
    simple = {"body_simple", "dof_simplenum", "body_invweight0", "dof_invweight0"}
    simple = {f"model.{name}" for name in simple}
    assert unequal <= (simple if path == "tendon/t:armature" else set())
    require_same_motion(own, again, base, 0.0)


@pytest.mark.parametrize("aligned", [False, True])
@pytest.mark.parametrize(
    "path", [f"{name}[{i}]" for name, (_, _, n) in INERTIAL.items() for i in range(n)]
)
def test_inertias_written_in_place_equal_a_compile(path: str, aligned: bool) -> None:
    xml = SOLID.replace(' pos=".1 .05 .2"', "") if aligned else SOLID
    parsed = ParameterPath.parse(f"body/b:{path}")
    kind, first, _ = INERTIAL[parsed.field]
    parametrisation, place = INERTIA_PARAMETRISATIONS[kind], first + parsed.component
    for name in "ab":
        parameters = [one(f"body/{name}:{path}")]
        spec, base = compiled(xml, parameters)
        writer = ParameterWriter(parameter_set(parameters, base))
        number = base.body(name).id
        values = parametrisation.coordinates(body_inertia(base, number))
        before = writer.model(base, values[[place]])
        assert_allclose(rollout(before), rollout(base), rtol=1e-10, atol=1e-10)

        values[place] += 0.01 * parametrisation.magnitudes(body_inertia(base, number))[place]
        own, wanted = writer.model(base, values[[place]]), parametrisation.inertia(values)
        element, tensor = spec.body(name), wanted.inertia
        element.mass, element.ipos, element.explicitinertial = wanted.mass, wanted.com, True
        element.fullinertia = [*np.diag(tensor), tensor[0, 1], tensor[0, 2], tensor[1, 2]]
        again = spec.compile()
        assert_allclose(body_inertia(own, number).inertia, tensor, rtol=1e-9, atol=1e-9)
        for array in ("dof_M0", "dof_invweight0", "body_subtreemass"):
            assert_allclose(getattr(own, array), getattr(again, array), rtol=1e-10)
        assert_allclose(rollout(own), rollout(again), rtol=1e-9, atol=1e-9)
        # What of body a lies across its only hinge cannot be felt.
        assert name == "a" or np.abs(rollout(own) - rollout(base)).max() > 1e-5


@pytest.mark.parametrize(("xml", "path", "old", "new", "value"), TEXTS)
def test_a_value_of_a_path_is_the_value_in_the_mjcf(
    xml: str, path: str, old: str, new: str, value: float
) -> None:
    spec, edited = (mujoco.MjSpec.from_string(text) for text in (xml, xml.replace(old, new)))
    source, base = plant_of(spec), spec.compile()
    before = arrays_of(source.model)
    resolved = parameter_set([one(path)], base, decoration=decoration(spec, base))
    assert resolved.needs_compile.tolist() == [path.startswith("geom")]
    own, again = ParameterWriter(resolved).model(source, np.array([value])), plant_of(edited).model

    mine, wanted = arrays_of(own), arrays_of(again)
    if old == CAPSULE:  # A capsule is round, so that its other two axes are arbitrary.
        for name in ("model.geom_quat", "model.body_iquat"):
            mine[name] = wanted[name]
    for name, array in wanted.items():
        assert_allclose(mine[name], array, rtol=1e-12, atol=1e-14, err_msg=name)
    require_same_motion(own, again, base, 1e-9)
    for name, array in arrays_of(source.model).items():
        assert_array_equal(array, before[name], err_msg=name)


@pytest.mark.parametrize(
    ("old", "new", "drawn"),
    [
        ("<mujoco>", "<mujoco>", True),
        ('conaffinity="0"', 'conaffinity="1"', False),
        ("<mujoco>", '<mujoco><compiler inertiafromgeom="true"/>', False),
        (
            "<worldbody>",
            '<contact><pair geom1="skin" geom2="ground"/></contact><worldbody>'
            '<geom name="ground" type="plane" size="1 1 1" contype="0" conaffinity="0"/>',
            False,
        ),
    ],
)
def test_a_geom_is_written_in_place_where_it_neither_collides_nor_has_mass(
    old: str, new: str, drawn: bool
) -> None:
    spec, base = compiled(DRAWN.replace(old, new), [])
    field = resolve(base, "geom/skin:size[2]", decoration=decoration(spec, base))
    assert isinstance(field, ModelField if drawn else SpecField)
    assert field.read(base) == 0.3


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
    path: str, tmp_path: Path
) -> None:
    """A `<frame>` is a way to write MJCF; the compiled model has none."""
    table = {"theta": {"target": path}}
    task = make_task(FRAMED, tmp_path, rate=500.0, parameters=table, noise={"acc": 0.1})
    plain, moved = mujoco.MjModel.from_xml_string(FRAMED), task.theta + 0.1
    same, own = task.system.model_at(task.theta), task.system.model_at(moved)
    write_identified(tmp_path / "identified.xml", task.system, moved)
    again = mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml"))
    assert_allclose(rollout(same, 50), rollout(plain, 50), rtol=1e-10, atol=1e-10)
    assert_allclose(rollout(again, 50), rollout(own, 50), rtol=0, atol=1e-4)
    assert np.abs(rollout(own, 50) - rollout(plain, 50)).max() > 1e-3
    parsed = ParameterPath.parse(path)
    if parsed.field == "pos":
        found = getattr(own, parsed.kind)(parsed.name).pos
        assert found[parsed.component] == pytest.approx(moved[0], abs=1e-12)


TETRAHEDRON = "0 0 0 .2 0 0 0 .3 0 0 0 .4"
MESHED = ARM.replace(
    "<worldbody>", f'<asset><mesh name="tetra" vertex="{TETRAHEDRON}"/></asset><worldbody>'
).replace(
    'type="box" pos=".1 0 .2" euler=".2 .3 .5" size=".1 .2 .3"',
    'type="mesh" mesh="tetra" pos=".1 0 .2" euler=".2 .3 .5"',
)


def test_a_mesh_moves_from_its_compiled_place() -> None:
    """MuJoCo shifts a mesh to its centre; that offset must not be added twice."""
    spec, base = compiled(MESHED, [])
    resolved = parameter_set([one("geom/h:pos[2]")], base, decoration=decoration(spec, base))
    now = resolved.parameters[0].targets[0].field.read(base)
    assert abs(now - 0.2) > 0.01, "no offset: a weak test"
    again = mujoco.MjModel.from_xml_string(MESHED.replace('pos=".1 0 .2"', 'pos=".1 0 .3"'))
    for value, wanted in ((now, base), (now + 0.1, again)):
        own = ParameterWriter(resolved).model(plant_of(spec), np.array([value]))
        assert_allclose(own.geom_pos, wanted.geom_pos, rtol=0, atol=1e-14)
        assert_allclose(own.body_ipos, wanted.body_ipos, rtol=0, atol=1e-14)
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


@pytest.mark.parametrize("thing", ["body/a", "body/b", "site/s", "site/t"])
def test_three_rotation_components_are_one_rotation_vector(thing: str) -> None:
    """The rotation is exp of the vector in the element's own axes, from its compiled orientation,
    not three turns one after the other.
    """
    xml = ARM.replace('pos=".3 .1 .5"', 'pos=".3 .1 .5" euler=".4 .1 -.2"').replace(
        'name="t" ', 'name="t" euler="1 0 .3" '
    )
    parameters = [replace(one(f"{thing}:rot[{i}]"), name=f"r{i}") for i in range(3)]
    spec, base = compiled(xml, parameters)
    writer, vector = ParameterWriter(parameter_set(parameters, base)), np.array([0.5, -0.9, 0.7])
    kind, name = thing.split("/")
    turn, quat = np.zeros(4), np.zeros(4)
    mujoco.mju_axisAngle2Quat(turn, vector / np.linalg.norm(vector), float(np.linalg.norm(vector)))
    mujoco.mju_mulQuat(quat, np.array(getattr(base, kind)(name).quat), turn)
    element = getattr(spec, kind)(name)
    element.alt.type, element.quat = mujoco.mjtOrientation.mjORIENTATION_QUAT, quat
    require_same_motion(writer.model(base, vector), spec.compile(), base, 1e-9)
    again = writer.model(base, np.zeros(3))  # Nothing of the first value is left.
    assert_allclose(rollout(again), rollout(base), rtol=1e-9, atol=1e-9)


@pytest.mark.parametrize(
    ("first", "second"),
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
def test_mixed_parametrisations_of_one_body_are_refused(first: str, second: str) -> None:
    _, base = compiled(SOLID, [])
    p, q = (replace(one(f"body/a:{f}"), name=f) for f in (first, second))
    for pair in ([p, q], [q, p]):
        with pytest.raises(ExperimentError, match=r"several coordinates at once .*valid together"):
            parameter_set(pair, base)
    assert len(parameter_set([p, one(f"body/b:{second}")], base)) == 2


def test_mass_beside_first_moments_keeps_them() -> None:
    """The barycentric mass: m c and the inertia about the origin stay while the mass changes;
    alone, the centre stays.
    """
    barycentric = INERTIA_PARAMETRISATIONS["barycentric"].coordinates
    mass = one("body/a:mass")
    _, base = compiled(SOLID, [mass])
    wanted = barycentric(body_inertia(base, base.body("a").id))
    wanted[[0, 3]] = 1.5, wanted[3] + 0.02
    both = parameter_set([mass, replace(one("body/a:firstmoment[2]"), name="h")], base)
    own = ParameterWriter(both).model(base, wanted[[0, 3]])
    after = barycentric(body_inertia(own, own.body("a").id))
    assert_allclose(after, wanted, rtol=1e-12, atol=1e-15)
    alone = ParameterWriter(parameter_set([mass], base)).model(base, np.array([1.5]))
    assert_array_equal(alone.body("a").ipos, base.body("a").ipos)


def test_measurement_and_initial_state_are_outside_the_model() -> None:
    """Linear maps of theta outside the model, by the scale of their targets."""
    scales = {"initial/k:qvel": 2.0, "initial/j:qpos": -1.0, "output/b:bias": 0.5}
    scales |= {"output:delay": 3.0, "body/a:mass": 1.0}
    parameters = [replace(one(path, scale), name=path) for path, scale in scales.items()]
    resolved = parameter_set(parameters, compiled(ARM, [])[1], outputs=("a", "b"))
    start, bias = resolved.initial_state_derivative(4), resolved.bias_derivative(2)
    assert (start[3, 0], start[0, 1], bias[1, 2]) == (2.0, -1.0, 0.5)
    assert (np.count_nonzero(start), np.count_nonzero(bias)) == (2, 1)
    assert_array_equal(resolved.delay_derivative, [0.0, 0.0, 0.0, 3.0, 0.0])
    assert resolved.changes_model.tolist() == [False] * 4 + [True]
    assert resolved.changes_motion.tolist() == [True, True, False, False, True]
    assert not resolved.needs_compile.any()


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
        assert_allclose(rollout(model), plain, rtol=1e-7, atol=1e-7)


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
        make_task(ARM, tmp_path, rate=500.0, parameters=table, noise={"state": 0.1})


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

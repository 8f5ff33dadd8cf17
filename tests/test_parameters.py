"""Parameter paths; writing in place against recompiling; what an identified model file then says."""

from __future__ import annotations

import copy
from typing import Any

import mujoco
import numpy as np
import pytest
from numerics import make_setup

from mjfim.errors import ExperimentError, MjfimError
from mjfim.identified import write_identified, write_spec
from mjfim.parameters import FIELDS, Parameter, ParameterSet, Target, moved_bodies, names_of, resolve

# Two links with inertia from skewed geoms; a position servo; sensors that see sites and geoms.
ARM = """
<mujoco>
  <compiler angle="radian"/>
  <option integrator="RK4"/>
  <worldbody>
    <body name="a">
      <joint name="j" type="hinge" axis="0 1 0" stiffness="2"/>
      <geom name="g" type="capsule" fromto="0 0 0 .3 .1 .5" size=".05" mass="1" contype="0" conaffinity="0"/>
      <site name="s"/>
      <body name="b" pos=".3 .1 .5">
        <joint name="k" type="hinge" axis="1 0 0"/>
        <geom name="h" type="box" pos=".1 0 .2" euler=".2 .3 .5" size=".1 .2 .3" mass="1" contype="0" conaffinity="0"/>
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

# A box on a slide and a hinge, and one in free flight: bodies that MuJoCo would compile as 'simple'.
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
    <motor name="m" joint="x"/><motor joint="h" gear=".1"/><motor name="n" site="nozzle" gear="0 0 1 .1 0 0"/>
  </actuator>
  <sensor><accelerometer site="nozzle"/></sensor>
</mujoco>
"""

# Inertia is spelled out, so geoms only matter for contact: a sphere dropped onto a plane while sliding.
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
    <spatial name="t" stiffness="20" damping="1" springlength=".3"><site site="anchor"/><site site="hook"/></spatial>
  </tendon>
  <actuator><motor name="m" tendon="t"/></actuator>
</mujoco>
"""

# model, path, new value, the derived constants of MjModel that must follow
EDITS = [
    (ARM, "body/a:mass", 2.0, ("body_subtreemass", "dof_M0", "body_invweight0")),
    (ARM, "body/b:mass", 2.0, ("body_subtreemass", "dof_M0", "actuator_acc0")),
    (ARM, "body/b:pos[2]", 0.7, ("dof_M0", "dof_invweight0")),
    (ARM, "body/a:ipos[0]", 0.4, ("dof_M0", "body_invweight0")),
    (ARM, "body/b:ipos[1]", 0.1, ("dof_M0", "geom_sameframe")),
    (ARM, "body/a:inertia[2]", 0.004, ("dof_M0", "body_invweight0")),
    (ARM, "body/b:inertia[1]", 0.04, ("dof_M0", "body_invweight0")),
    (ARM, "joint/j:damping", 0.5, ()),
    (ARM, "joint/j:frictionloss", 0.5, ()),
    (ARM, "joint/j:armature", 0.5, ("dof_M0", "dof_invweight0", "actuator_acc0")),
    (ARM, "joint/j:stiffness", 5.0, ()),
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
    (CONTACT, "geom/ball:size", 0.15, ("geom_rbound", "geom_aabb")),
    (CONTACT, "geom/ball:friction", 0.9, ()),
    (CONTACT, "geom/floor:friction", 2.0, ()),
    (CONTACT, "geom/ball:pos[0]", 0.05, ("geom_sameframe",)),
    (CONTACT, "geom/floor:pos[2]", 0.05, ()),
    (TENDON, "tendon/t:stiffness", 40.0, ()),
    (TENDON, "tendon/t:damping", 3.0, ()),
    (TENDON, "tendon/t:frictionloss", 0.3, ()),
    (TENDON, "site/hook:pos[2]", 0.3, ("tendon_length0", "tendon_invweight0", "actuator_acc0")),
    (TENDON, "joint/j:damping", 0.7, ()),
    (TENDON, "joint/j:stiffness", 2.0, ()),
]


def one(path: str, scale: float = 1.0, offset: float = 0.0) -> Parameter:
    """A parameter with one target."""
    return Parameter("theta", (Target(path, scale, offset),), guess=1.0)


def compiled(xml: str, parameters: list[Parameter]) -> tuple[Any, Any]:
    """(spec, model), compiled as the package does it: bodies that parameters move are not 'simple'."""
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
    resolved = ParameterSet.build(parameters, base)
    theta, other = np.array([value]), spec.copy()
    write_spec(other, base, resolved, theta)
    return base, resolved.model(base, theta), other.compile()


def test_the_edits_below_cover_every_field_that_can_be_named() -> None:
    covered = {(resolve(compiled(x, [])[1], p).array) for x, p, _, _ in EDITS}
    wanted = {array for kind in FIELDS.values() for array in kind.values()}
    assert covered == wanted


@pytest.mark.parametrize(("xml", "path", "value", "derived"), EDITS, ids=[e[1] for e in EDITS])
def test_writing_in_place_equals_a_recompile_bit_for_bit(xml: str, path: str, value: float, derived: tuple) -> None:
    base, own, again = both_ways(xml, path, value)
    assert resolve(own, path).read(own) == value
    before, mine, theirs = arrays(base), arrays(own), arrays(again)
    for name in derived:
        assert not np.array_equal(before[name], theirs[name]), f"{name} does not depend on {path}: a weak test"
    unequal = [n for n in theirs if not np.array_equal(mine[n], theirs[n], equal_nan=mine[n].dtype.kind == "f")]
    assert unequal == []
    moved = rollout(own)
    np.testing.assert_array_equal(moved, rollout(again))
    assert np.isfinite(moved).all()
    assert np.abs(moved - rollout(base)).max() > 1e-6, "the edit has no effect: a weak test"


def test_comparison_would_notice_a_write_without_mj_setConst() -> None:
    _, base = compiled(ARM, [one("body/b:mass")])
    own, slot = copy.copy(base), resolve(base, "body/b:mass")
    slot.write(own, 2.0)
    _, _, again = both_ways(ARM, "body/b:mass", 2.0)
    assert not np.array_equal(own.dof_M0, again.dof_M0)


def test_bodies_whose_inside_moves_are_found_so_that_they_are_not_compiled_as_simple() -> None:
    paths = [
        "body/a:pos",
        "body/b:ipos[1]",
        "body/c:inertia[2]",
        "body/d:mass",
        "geom/e:pos",
        "site/f:pos",
        "joint/g:damping",
    ]
    assert moved_bodies([one(p) for p in paths]) == {"a", "b", "c", "d"}


def test_setup_gives_a_model_at_theta_with_the_right_dynamics_for_simple_bodies(tmp_path) -> None:
    target = {"com": {"target": "body/flyer:ipos[0]", "guess": 0.1}}
    setup = make_setup(SIMPLE, tmp_path, rate=500.0, parameters=target, noise={"state": 0.1})
    _, _, again = both_ways(SIMPLE, "body/flyer:ipos[0]", 0.1)
    plain = mujoco.MjModel.from_xml_string(SIMPLE)
    assert np.abs(rollout(plain) - rollout(again)).max() > 1e-3
    np.testing.assert_array_equal(rollout(setup.plant.model(np.array([0.1])))[:, :17], rollout(again)[:, :17])
    np.testing.assert_array_equal(rollout(setup.model_at(np.array([0.1]))), rollout(again))


def test_several_targets_follow_one_parameter_by_scale_and_offset() -> None:
    targets = (Target("body/a:mass"), Target("body/b:mass", 2.0, 0.5), Target("joint/j:damping", -1.0, 3.0))
    parameters = [Parameter("m", targets, 1.0), one("option:gravity[1]")]
    spec, base = compiled(ARM, parameters)
    resolved = ParameterSet.build(parameters, base)
    own = resolved.model(base, np.array([1.25, -0.5]))
    assert (own.body("a").mass[0], own.body("b").mass[0], own.joint("j").damping[0]) == (1.25, 3.0, 1.75)
    assert own.opt.gravity[1] == -0.5
    other = spec.copy()
    write_spec(other, base, resolved, np.array([1.25, -0.5]))
    np.testing.assert_array_equal(rollout(own), rollout(other.compile()))


def test_one_number_takes_one_parameter() -> None:
    parameters = [one("body/a:mass"), one("body/a:mass")]
    _, base = compiled(ARM, [])
    with pytest.raises(ExperimentError, match=r"body/a:mass.*already belongs"):
        ParameterSet.build(parameters, base)


def test_spelling_out_inertia_from_geoms_changes_nothing_but_the_target() -> None:
    spec, base = compiled(ARM, [])
    assert not spec.body("b").explicitinertial
    resolved = ParameterSet.build([one("body/b:mass")], base)
    write_spec(spec, base, resolved, np.array([base.body("b").mass[0]]))
    assert spec.body("b").explicitinertial
    np.testing.assert_array_equal(rollout(spec.compile()), rollout(base))


def test_a_parameter_set_works_on_private_copies_and_leaves_the_base_model_alone() -> None:
    parameters = [one("body/b:ipos[1]"), one("body/b:mass")]
    _, base = compiled(ARM, parameters)
    before, resolved = arrays(base), ParameterSet.build(parameters, base)
    first = resolved.model(base, np.array([0.2, 3.0]))
    kept = arrays(first)
    second = resolved.model(base, np.array([0.3, 4.0]))
    assert second.body("b").mass[0] == 4.0
    for name, value in arrays(base).items():
        np.testing.assert_array_equal(value, before[name], err_msg=name)
    for name, value in arrays(first).items():
        np.testing.assert_array_equal(value, kept[name], err_msg=name)


def test_writing_twice_leaves_no_trace_of_the_first_value() -> None:
    parameters = [one("body/b:ipos[1]"), one("body/b:mass")]
    _, base = compiled(ARM, parameters)
    resolved = ParameterSet.build(parameters, base)
    own, fresh = resolved.model(base, np.array([0.4, 9.0])), resolved.model(base, np.array([0.1, 2.0]))
    resolved.write(own, np.array([0.1, 2.0]))
    for name, value in arrays(own).items():
        np.testing.assert_array_equal(value, arrays(fresh)[name], err_msg=name)


@pytest.mark.parametrize(("path", "rows"), [("joint/f:damping", range(2, 8)), ("joint/h:damping", [1])])
def test_joint_fields_reach_every_degree_of_freedom_of_the_joint_and_no_other(path: str, rows) -> None:
    _, base = compiled(SIMPLE, [])
    own = ParameterSet.build([one(path)], base).model(base, np.array([0.7]))
    assert list(np.flatnonzero(own.dof_damping)) == list(rows)


def test_an_index_left_out_means_zero() -> None:
    _, base = compiled(ARM, [])
    assert resolve(base, "body/b:pos") == resolve(base, "body/b:pos[0]") != resolve(base, "body/b:pos[1]")


def test_names_may_hold_slashes_and_spaces() -> None:
    _, base = compiled(ARM.replace('"b"', '"left arm/b"'), [])
    slot = resolve(base, "body/left arm/b:pos[2]")
    assert slot.read(base) == 0.5
    assert moved_bodies([one("body/left arm/b:pos[2]")]) == {"left arm/b"}


@pytest.mark.parametrize(
    ("path", "said"),
    [
        ("body/bb:mass", ["unknown body 'bb'", "valid: a, b, world"]),
        ("body/B:mass", ["unknown body 'B'", "valid: a, b, world"]),
        ("joint/q:damping", ["unknown joint 'q'", "valid: j, k"]),
        ("actuator/q:gear", ["unknown actuator 'q'", "valid: m, p"]),
        ("geom/q:size", ["unknown geom 'q'", "valid: g, h"]),
        ("site/q:pos", ["unknown site 'q'", "valid: s, t"]),
        ("tendon/q:damping", ["unknown tendon 'q'", "valid: none"]),
        ("body:mass", ["unknown body ''", "valid: a, b, world"]),
        ("bodies/a:mass", ["unknown kind 'bodies'", "did you mean 'body'", "actuator, body, geom, joint, option"]),
        ("body/a:weight", ["unknown body field 'weight'", "valid: inertia, ipos, mass, pos"]),
        ("joint/j:mass", ["unknown joint field 'mass'", "armature, damping, frictionloss, springref, stiffness"]),
        ("body/a:pos[3]", ["index 3 is out of range", "valid: 0 to 2"]),
        ("body/a:mass[1]", ["index 1 is out of range", "valid: 0 to 0"]),
        ("actuator/m:gear[6]", ["index 6 is out of range", "valid: 0 to 5"]),
        ("option:gravity[3]", ["index 3 is out of range", "valid: 0 to 2"]),
        ("body/a:pos[-1]", ["not of the form kind/name:field[index]"]),
        ("body/a.mass", ["not of the form kind/name:field[index]"]),
        ("", ["not of the form kind/name:field[index]"]),
    ],
)
def test_a_wrong_path_says_what_would_have_been_valid(path: str, said: list[str]) -> None:
    _, base = compiled(ARM, [])
    with pytest.raises(ExperimentError) as caught:
        ParameterSet.build([one(path)], base)
    message = str(caught.value)
    assert message.startswith("parameters.theta: ")
    assert repr(path) in message
    for part in said:
        assert part in message


def test_springref_of_a_ball_joint_is_refused() -> None:
    _, base = compiled(TENDON, [])
    with pytest.raises(ExperimentError, match="slide and hinge joints only"):
        resolve(base, "joint/j:springref")


def test_names_are_listed_without_the_unnamed() -> None:
    _, base = compiled(CONTACT, [])
    assert names_of(base, "body") == ["world", "ball"]
    assert names_of(base, "joint") == []
    assert names_of(base, "geom") == ["floor", "ball"]


def test_theta_of_the_wrong_length_is_refused() -> None:
    _, base = compiled(ARM, [])
    resolved = ParameterSet.build([one("body/a:mass")], base)
    with pytest.raises(ValueError, match=r"shorter|longer"):
        resolved.model(base, np.array([1.0, 2.0]))


def test_difference_steps_and_priors_follow_guess_and_scale() -> None:
    _, base = compiled(ARM, [])
    large = Parameter("large", (Target("body/a:mass"),), guess=-3.0, scale=0.5, prior=0.1)
    zero = Parameter("zero", (Target("joint/j:damping"),), guess=0.0, scale=0.2, true=0.4, bounds=(0.0, 1.0))
    resolved = ParameterSet.build([large, zero], base)
    np.testing.assert_array_equal(resolved.step, [3.0, 0.2])
    np.testing.assert_allclose(resolved.prior_information, np.diag([100.0, 0.0]), rtol=1e-14)
    np.testing.assert_array_equal(resolved.true, [-3.0, 0.4])
    assert (resolved.names, resolved.lower[0], resolved.upper[1]) == (("large", "zero"), -np.inf, 1.0)


HINGED = TENDON.replace('type="ball"', 'axis="0 1 0"').replace('springlength=".3"', "")
FULL = '<inertial pos=".1 0 .2" mass="1" fullinertia=".1 .12 .11 .01 .02 .01"/><site name="s"/>'

# Models whose compiler would resolve something anew, or undo the edit, when the identified values are compiled again.
AWKWARD = {
    "nothing awkward": (ARM, "body/b:mass", 2.0),
    "springref in degrees, which is the default of MJCF": (
        ARM.replace('angle="radian"', 'angle="degree"').replace("<joint", '<joint springref="20"'),
        "joint/j:springref",
        0.7,
    ),
    "damping ratio of a servo": (ARM.replace('kv="0.5"', 'dampratio="1"'), "body/b:mass", 2.0),
    "spring and damper by time constant": (ARM.replace('stiffness="2"', 'springdamper=".3 1"'), "body/a:mass", 2.0),
    "inertia always from geoms": (ARM.replace("<compiler ", '<compiler inertiafromgeom="true" '), "body/b:mass", 2.0),
    "size of a geom that also makes inertia": (ARM, "geom/h:size[1]", 0.25),
    "place of a geom that also makes inertia": (ARM, "geom/h:pos[2]", 0.25),
    "place of a geom given by its end points": (ARM, "geom/g:pos[2]", 0.3),
    "full inertia matrix": (ARM.replace('<site name="s"/>', FULL), "body/a:inertia[0]", 0.13),
    "rest length of a tendon left to the compiler": (HINGED, "site/hook:pos[2]", 0.3),
}


@pytest.mark.parametrize("case", AWKWARD)
def test_the_identified_model_file_has_the_identified_dynamics_or_is_refused(case: str, tmp_path) -> None:
    xml, path, value = AWKWARD[case]
    table = {"theta": {"target": path, "guess": value}}
    try:
        setup = make_setup(xml, tmp_path, rate=500.0, parameters=table, noise={"state": 0.1})
        write_identified(tmp_path / "identified.xml", setup, np.array([value]))
    except MjfimError:
        return  # refused with a message: also right
    own, again = setup.plant.model(np.array([value])), mujoco.MjModel.from_xml_path(str(tmp_path / "identified.xml"))
    states = own.nq + own.nv
    # MuJoCo writes seven digits into XML
    np.testing.assert_allclose(rollout(again, 100)[:, :states], rollout(own, 100)[:, :states], rtol=0, atol=1e-4)


def test_an_inertia_that_no_body_can_have_is_refused_by_a_message_of_ours(tmp_path) -> None:
    table = {"theta": {"target": "body/a:inertia[0]", "guess": 0.01}}
    setup = make_setup(ARM, tmp_path, rate=500.0, parameters=table, noise={"state": 0.1})
    with pytest.raises(MjfimError, match="inertia"):
        write_identified(tmp_path / "identified.xml", setup, np.array([5.0]))

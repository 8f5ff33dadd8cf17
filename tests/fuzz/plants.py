"""Random plants: chains of hinges and slides with random drives and ranges."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

Rng = np.random.Generator
Range = tuple[float, float]

TIMESTEPS = (0.001, 0.002, 0.005, 0.01)
INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast")


@dataclass(frozen=True, kw_only=True)
class Joint:
    """A joint and the body that it moves.

    Attributes:
        name: Its name.
        kind: "hinge" or "slide".
        reach: Size of the motion that fits it [m or rad].
        effort: Force that moves its load over the reach in about a second [N or N m].
        attributes: Its attributes in the MJCF.
        inertial: Attributes of the inertia of its body.
        length: Distance from its body to the next one [m].
    """

    name: str
    kind: str
    reach: float
    effort: float
    attributes: dict[str, str]
    inertial: dict[str, str]
    length: float


@dataclass(frozen=True, kw_only=True)
class Drive:
    """An actuator of one joint.

    Attributes:
        name: Its name.
        joint: The joint.
        tag: Tag of the MJCF.
        attributes: Its attributes in the MJCF.
        control: Size of a control that moves the joint by about its reach [actuator unit].
    """

    name: str
    joint: Joint
    tag: str
    attributes: dict[str, str]
    control: float


@dataclass(frozen=True, kw_only=True)
class Plant:
    """A random plant.

    Attributes:
        timestep: Timestep of the engine [s].
        integrator: Integrator of the engine.
        gravity: Gravity [m/s^2].
        joints: The joints, from the base to the tip.
        drives: The actuators.
        ranges: Ranges of the MJCF by kind and name.
    """

    timestep: float
    integrator: str
    gravity: float
    joints: tuple[Joint, ...]
    drives: tuple[Drive, ...]
    ranges: dict[tuple[str, str], Range]

    @property
    def xml(self) -> str:
        """The MJCF."""
        opened = "\n".join(_body(joint, i, self.joints) for i, joint in enumerate(self.joints))
        closed = "</body>" * len(self.joints)
        drives = "\n".join(
            f'    <{d.tag} name="{d.name}" joint="{d.joint.name}"{words_of(d.attributes)}/>'
            for d in self.drives
        )
        return (
            '<mujoco model="chain">\n  <compiler angle="radian" autolimits="true"/>\n'
            f'  <option timestep="{self.timestep}" integrator="{self.integrator}" '
            f'gravity="0 0 {-self.gravity:.17g}"/>\n'
            '  <default><geom contype="0" conaffinity="0" mass="0"/></default>\n'
            f"  <worldbody>\n{opened}\n    {closed}\n  </worldbody>\n"
            f"  <actuator>\n{drives}\n  </actuator>\n</mujoco>\n"
        )


def _body(joint: Joint, i: int, joints: tuple[Joint, ...]) -> str:
    """The opening lines of a body of the chain."""
    place = joints[i - 1].length if i else 0.0
    return (
        f'    <body name="link{i}" pos="{place:.17g} 0 0">\n'
        f"      <inertial{words_of(joint.inertial)}/>\n"
        f'      <joint name="{joint.name}"{words_of(joint.attributes)}/>\n'
        f'      <geom type="capsule" fromto="0 0 0 {joint.length:.17g} 0 0" '
        f'size="{0.1 * joint.length:.17g}"/>'
    )


def words_of(attributes: dict[str, str]) -> str:
    """Attributes as text, with a space before each."""
    return "".join(f' {name}="{value}"' for name, value in attributes.items())


def log_uniform(rng: Rng, low: float, high: float) -> float:
    """A positive random number, uniform in its logarithm."""
    return float(np.exp(rng.uniform(np.log(low), np.log(high))))


def about_zero(rng: Rng, size: float, least: float = 0.3) -> Range:
    """A random range that holds 0; its bounds are `least` to 1 times a size away from it."""
    low, high = size * rng.uniform(least, 1.0, 2)
    return -float(low), float(high)


def text_of(bounds: Range) -> str:
    """A range as the MJCF writes it, with all digits."""
    return f"{bounds[0]:.17g} {bounds[1]:.17g}"


def random_plant(rng: Rng) -> Plant:
    """Make a chain of one to three joints, of which at least one is driven."""
    count = int(rng.integers(1, 4))
    ranges: dict[tuple[str, str], Range] = {}
    masses = [log_uniform(rng, 0.05, 10.0) for _ in range(count)]
    lengths = [log_uniform(rng, 0.05, 1.0) for _ in range(count)]

    joints = []
    for i in range(count):
        load, arm = sum(masses[i:]), sum(lengths[i:])
        joints.append(_joint(rng, i, (masses[i], lengths[i]), (load, arm), ranges))

    driven = [joint for joint in joints if rng.random() < 0.75] or [joints[0]]
    return Plant(
        timestep=float(rng.choice(TIMESTEPS)),
        integrator=str(rng.choice(INTEGRATORS)),
        gravity=float(rng.choice([0.0, 0.0, 9.81, 1.6])),
        joints=tuple(joints),
        drives=tuple(_drive(rng, joint, ranges) for joint in driven),
        ranges=ranges,
    )


def _joint(
    rng: Rng,
    i: int,
    link: tuple[float, float],
    carried: tuple[float, float],
    ranges: dict[tuple[str, str], Range],
) -> Joint:
    """A joint for a link, given as its mass and length, that carries a load on an arm."""
    name, (mass, length), (load, arm) = f"joint{i}", link, carried
    kind = str(rng.choice(["hinge", "hinge", "slide"]))
    is_hinge = kind == "hinge"
    inertia = load * arm**2 if is_hinge else load
    reach = float(rng.uniform(0.3, 3.0)) if is_hinge else arm * float(rng.uniform(0.3, 1.0))

    axis = rng.normal(size=3) if rng.random() < 0.5 else np.eye(3)[rng.integers(3)]
    # 1 / s; a joint without damping is allowed.
    rate = rng.choice([0.0, 0.1, 1.0, 5.0])
    attributes = {
        "type": kind,
        "axis": " ".join(f"{number:.17g}" for number in axis),
        "damping": f"{inertia * rate:.17g}",
    }
    if rng.random() < 0.3:
        attributes["armature"] = f"{inertia * rng.uniform(0.01, 0.5):.17g}"
    if rng.random() < 0.3:
        attributes["stiffness"] = f"{inertia * rng.uniform(1.0, 50.0):.17g}"
    if rng.random() < 0.15:
        attributes["frictionloss"] = f"{inertia * rng.uniform(0.01, 0.3):.17g}"
    if rng.random() < 0.5:
        ranges["position", name] = about_zero(rng, reach)
        attributes["range"] = text_of(ranges["position", name])
    effort = 10.0 * inertia * reach
    if rng.random() < 0.2:
        ranges["joint_force", name] = about_zero(rng, effort)
        attributes["actuatorfrcrange"] = text_of(ranges["joint_force", name])

    thin = 0.02 * mass * length**2
    inertial = {
        "pos": f"{0.5 * length:.17g} 0 0",
        "mass": f"{mass:.17g}",
        "diaginertia": f"{thin:.17g} {4 * thin:.17g} {4 * thin:.17g}",
    }
    return Joint(
        name=name,
        kind=kind,
        reach=reach,
        effort=effort,
        attributes=attributes,
        inertial=inertial,
        length=length,
    )


def _drive(rng: Rng, joint: Joint, ranges: dict[tuple[str, str], Range]) -> Drive:
    """A motor, a position servo or a filtered motor for a joint."""
    name = f"drive_{joint.name}"
    tag = str(rng.choice(["motor", "motor", "position", "general"]))
    gear = float(rng.choice([1.0, -1.0, 20.0, 0.1]))
    attributes = {"gear": f"{gear:.17g}"}

    if tag == "position":
        control = joint.reach * abs(gear)
        kp = joint.effort / joint.reach * rng.uniform(1.0, 10.0) / gear**2
        attributes |= {"kp": f"{kp:.17g}", "kv": f"{0.2 * kp:.17g}"}
    elif tag == "general":
        gain = log_uniform(rng, 0.1, 10.0)
        control = joint.effort / abs(gear) / gain
        filtered = f"{rng.uniform(0.02, 0.2):.17g}"
        attributes |= {"dyntype": "filter", "dynprm": filtered, "gainprm": f"{gain:.17g}"}
    else:
        control = joint.effort / abs(gear)

    ranges["control", name] = about_zero(rng, control)
    attributes["ctrlrange"] = text_of(ranges["control", name])
    if rng.random() < 0.4:
        ranges["force", name] = about_zero(rng, joint.effort / abs(gear))
        attributes["forcerange"] = text_of(ranges["force", name])
    return Drive(name=name, joint=joint, tag=tag, attributes=attributes, control=control)

"""Random plants: chains of hinges and slides with random drives and ranges."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import numpy as np

Rng = np.random.Generator
Range = tuple[float, float]
Ranges = dict[tuple[str, str], Range]
Attributes = dict[str, Any]

TIMESTEPS = (0.001, 0.002, 0.005, 0.01)
INTEGRATORS = ("Euler", "RK4", "implicit", "implicitfast")

# Tags of the actuators of slides and hinges.
TAGS = ("motor", "motor", "position", "general")


@dataclass(frozen=True, kw_only=True)
class Joint:
    """A joint and the link that it moves.

    Attributes:
        name: Its name.
        kind: "hinge", "slide", "ball" or "free".
        reach: Size of the motion that fits it [m or rad].
        inertia: About what it accelerates [kg or kg m^2].
        mass: Mass of the link [kg].
        length: Distance from the link to the next one [m].
    """

    name: str
    kind: str
    reach: float
    inertia: float
    mass: float
    length: float

    @property
    def effort(self) -> float:
        """Force that moves the load over the reach in about a second [N or N m]."""
        return 10.0 * self.inertia * self.reach

    @property
    def is_scalar(self) -> bool:
        """True for a slide or a hinge."""
        return self.kind in ("hinge", "slide")


@dataclass(frozen=True, kw_only=True)
class Drive:
    """An actuator.

    Attributes:
        name: Its name.
        tag: Tag of the MJCF.
        element: Its element of the MJCF.
        control: Size of a control that moves the plant by about its reach [actuator unit].
        force: Size of its force at this control.
        is_held: False where it has a range that a design does not keep, and must mention.
    """

    name: str
    tag: str
    element: str
    control: float
    force: float
    is_held: bool


@dataclass(frozen=True, kw_only=True)
class Plant:
    """A random plant.

    Attributes:
        xml: The MJCF.
        timestep: Timestep of the engine [s].
        joints: The joints, from the base to the tip.
        drives: The actuators.
        targets: Paths of parameters that may be identified.
        ranges: Ranges of the MJCF that a design has to keep, by kind and name; the angle of a ball
            joint has a symmetric one.
        can_rest: True where it can stand still at the start.
        collides: True where geoms may collide.
        features: What is special about it, in words.
    """

    xml: str
    timestep: float
    joints: tuple[Joint, ...]
    drives: tuple[Drive, ...]
    targets: tuple[str, ...]
    ranges: Ranges
    can_rest: bool
    collides: bool = False
    features: tuple[str, ...]


def text_of(value: Any) -> str:
    """A value as the MJCF writes it, numbers with all digits."""
    if isinstance(value, str):
        return value
    return f"{value:.17g}" if np.isscalar(value) else " ".join(map(text_of, value))


def element(tag: str, inner: str | None = None, **attributes: Any) -> str:
    """An element of the MJCF; without inner text it is closed at once."""
    words = "".join(f' {name}="{text_of(value)}"' for name, value in attributes.items())
    return f"<{tag}{words}/>" if inner is None else f"<{tag}{words}>{inner}</{tag}>"


def log_uniform(rng: Rng, low: float, high: float) -> float:
    """A positive random number, uniform in its logarithm."""
    return np.exp(rng.uniform(np.log(low), np.log(high)))


def about_zero(rng: Rng, size: float, least: float = 0.3) -> Range:
    """A random range that holds 0; its bounds are `least` to 1 times a size away from it."""
    low, high = size * rng.uniform(least, 1.0, 2)
    return -float(low), float(high)


def random_plant(rng: Rng) -> Plant:
    """Make a chain of one to three joints, of which at least one is driven."""
    count = int(rng.integers(1, 4))
    masses = [log_uniform(rng, 0.05, 10.0) for _ in range(count)]
    lengths = [log_uniform(rng, 0.05, 1.0) for _ in range(count)]
    targets = [f"body/link{i}:mass" for i in range(count)]
    ranges: Ranges = {}
    joints: list[Joint] = []
    bodies = ""

    for i in range(count):
        load, arm = sum(masses[i:]), sum(lengths[i:])
        kind = str(rng.choice(["hinge", "hinge", "slide"]))
        is_hinge = kind == "hinge"
        joint = Joint(
            name=f"joint{i}",
            kind=kind,
            reach=rng.uniform(0.3, 3.0) if is_hinge else arm * rng.uniform(0.3, 1.0),
            inertia=load * arm**2 if is_hinge else load,
            mass=masses[i],
            length=lengths[i],
        )
        attributes = joint_attributes(rng, joint, ranges)
        if attributes["damping"]:
            targets.append(f"joint/{joint.name}:damping")
        thin = 0.02 * joint.mass * joint.length**2
        place = lengths[i - 1] if i else 0.0
        bodies += body_text(joint, attributes, place, (thin, 4 * thin), 0.1 * joint.length)
        joints.append(joint)

    driven = [joint for joint in joints if rng.random() < 0.75] or [joints[0]]
    timestep = rng.choice(TIMESTEPS)
    integrator = str(rng.choice(INTEGRATORS))
    gravity = rng.choice([0.0, 0.0, 9.81, 1.6])
    drives = [
        random_drive(rng, f"drive_{joint.name}", {"joint": joint.name}, joint, ranges)
        for joint in driven
    ]
    option = {"timestep": timestep, "integrator": integrator, "gravity": (0, 0, -gravity)}
    elements = "".join(drive.element for drive in drives)
    return Plant(
        xml=(
            '<mujoco model="chain">\n  <compiler angle="radian" autolimits="true"/>\n'
            f"{element('option', **option)}\n"
            f"  <worldbody>\n{bodies}{'</body>' * count}\n  </worldbody>\n"
            f"  <actuator>\n{elements}  </actuator>\n</mujoco>\n"
        ),
        timestep=timestep,
        joints=tuple(joints),
        drives=tuple(drives),
        targets=tuple(targets),
        ranges=ranges,
        # Joints that fall and have no drive cannot stand still.
        can_rest=gravity == 0.0 or len(drives) == count,
        features=(
            *(joint.kind for joint in joints),
            *(drive.tag for drive in drives),
            f"{integrator} {timestep:g} s; gravity {gravity:g}",
        ),
    )


def joint_attributes(rng: Rng, joint: Joint, ranges: Ranges) -> Attributes:
    """Random attributes of a slide or a hinge, whose ranges are added to those of the plant."""
    name, inertia = joint.name, joint.inertia
    axis = rng.normal(size=3) if rng.random() < 0.5 else np.eye(3)[rng.integers(3)]
    # 1 / s; a joint without damping is allowed.
    rate = rng.choice([0.0, 0.1, 1.0, 5.0])
    attributes = {"type": joint.kind, "axis": axis, "damping": inertia * rate}
    for key, chance, low, high in (
        ("armature", 0.3, 0.01, 0.5),
        ("stiffness", 0.3, 1.0, 50.0),
        ("frictionloss", 0.15, 0.01, 0.3),
    ):
        if rng.random() < chance:
            attributes[key] = inertia * rng.uniform(low, high)
    if rng.random() < 0.5:
        ranges["position", name] = about_zero(rng, joint.reach)
        attributes["range"] = ranges["position", name]
    if rng.random() < 0.2:
        ranges["joint_force", name] = about_zero(rng, joint.effort)
        attributes["actuatorfrcrange"] = ranges["joint_force", name]
    return attributes


def body_text(
    joint: Joint,
    attributes: Attributes,
    place: float,
    inertia: tuple[float, float],
    size: float,
    *,
    pose: str = "",
    is_solid: bool = False,
) -> str:
    """The opening lines of a body of a chain.

    Args:
        joint: Its joint.
        attributes: Attributes of the joint.
        place: Where it begins on the body before [m].
        inertia: About the link and across it [kg m^2].
        size: Radius of the link [m].
        pose: Further attributes of the body.
        is_solid: True where the link collides.
    """
    name = joint.name.replace("joint", "link")
    contact = {} if is_solid else {"contype": 0, "conaffinity": 0}
    across, end = inertia[1], (joint.length, 0, 0)
    link = {"name": name, "type": "capsule", "size": size, "mass": 0, **contact}
    return (
        f'    <body name="{name}" pos="{text_of((place, 0, 0))}"{pose}>\n'
        + element(
            "inertial",
            pos=(0.5 * joint.length, 0, 0),
            mass=joint.mass,
            diaginertia=(inertia[0], across, across),
        )
        + element("joint", name=joint.name, **attributes)
        + element("geom", **link, fromto=(1.3 * size, 0, 0, *end))
        + element("site", name=joint.name.replace("joint", "tip"), pos=end)
    )


def random_drive(
    rng: Rng,
    name: str,
    transmission: Attributes,
    joint: Joint,
    ranges: Ranges,
    *,
    tags: Sequence[str] = TAGS,
    gear: Sequence[float] = (),
    is_bounded: bool = True,
) -> Drive:
    """A random actuator, whose ranges are added to those of the plant.

    Args:
        rng: Random numbers.
        name: Its name.
        transmission: Attribute that says on what it acts.
        joint: A joint that moves about as it does.
        ranges: Ranges of the plant.
        tags: Tags from which one is chosen.
        gear: The gear; empty chooses a number.
        is_bounded: Whether its control has a range.
    """
    tag = str(rng.choice(tags))
    gear = gear or (rng.choice([1.0, -1.0, 20.0, 0.1]),)
    size = max(map(abs, gear))
    force = control = joint.effort / size
    attributes = {"gear": gear}

    if tag in ("position", "intvelocity"):
        control = joint.reach * size
        kp = joint.effort / joint.reach * rng.uniform(1.0, 10.0) / size**2
        attributes |= {"kp": kp, "kv": 0.2 * kp}
        if tag == "intvelocity":
            attributes["actrange"] = (-2.0 * control, 2.0 * control)
    elif tag == "general":
        gain = log_uniform(rng, 0.1, 10.0)
        control = force / gain
        filtered = rng.uniform(0.02, 0.2)
        attributes |= {"dyntype": "filter", "dynprm": filtered, "gainprm": gain}

    if is_bounded:
        ranges["control", name] = about_zero(rng, control)
        attributes["ctrlrange"] = ranges["control", name]
    if rng.random() < 0.4:
        ranges["force", name] = about_zero(rng, force)
        attributes["forcerange"] = ranges["force", name]
    return Drive(
        name=name,
        tag=tag,
        element=element(tag, name=name, **transmission, **attributes),
        control=control,
        force=force,
        is_held=tag != "intvelocity",
    )

"""Random mechanisms: what the chains of `plants` do not have.

A mechanism is a chain that may float, hang on a ball joint, collide with itself and a floor, have
tendons, several actuators per joint, a closed loop or coupled joints, and start in a keyframe.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from tests.fuzz.plants import (
    INTEGRATORS,
    TIMESTEPS,
    Range,
    Rng,
    about_zero,
    log_uniform,
    text_of,
    words_of,
)

# Kinds of the first joint, and of the others.
FIRST_KINDS = ("hinge", "hinge", "slide", "ball", "ball", "free", "free")
KINDS = ("hinge", "hinge", "hinge", "slide", "ball")

# Components of the force of an actuator on a joint.
COMPONENTS = {"hinge": 1, "slide": 1, "ball": 3, "free": 6}


@dataclass(frozen=True, kw_only=True)
class Link:
    """A link of a mechanism and the joint on which it moves.

    Attributes:
        name: Name of the joint.
        kind: "hinge", "slide", "ball" or "free".
        mass: Its mass [kg].
        length: Its length [m].
        load: Mass that the joint moves [kg].
        inertia: About what the joint accelerates [kg or kg m^2].
        reach: Size of the motion that fits the joint [m or rad].
    """

    name: str
    kind: str
    mass: float
    length: float
    load: float
    inertia: float
    reach: float

    @property
    def effort(self) -> float:
        """Force that moves the load over the reach in about a second [N or N m]."""
        return 10.0 * self.inertia * self.reach

    @property
    def is_scalar(self) -> bool:
        """True for a slide or a hinge."""
        return self.kind in ("hinge", "slide")


@dataclass(frozen=True, kw_only=True)
class Actuator:
    """An actuator of a mechanism.

    Attributes:
        name: Its name.
        element: Its element of the MJCF.
        control: Size of a control that moves the mechanism [actuator unit].
        force: Size of its force at this control.
    """

    name: str
    element: str
    control: float
    force: float


@dataclass(frozen=True, kw_only=True)
class Mechanism:
    """A random mechanism.

    Attributes:
        xml: The MJCF; it has the keyframe `start`.
        timestep: Timestep of the engine [s].
        links: Its links, from the base to the tip.
        actuators: Its actuators.
        targets: Paths of parameters that may be identified.
        ranges: Ranges of the MJCF that a design has to keep, by kind and name; the angle of a ball
            joint has a symmetric one.
        unheld: Names of elements with a range that a design does not keep, so that it must say so.
        collides: True where geoms may collide.
        can_rest: True where it stands still in the keyframe without a force.
        features: What is special about it, in words.
    """

    xml: str
    timestep: float
    links: tuple[Link, ...]
    actuators: tuple[Actuator, ...]
    targets: tuple[str, ...]
    ranges: dict[tuple[str, str], Range]
    unheld: tuple[str, ...]
    collides: bool
    can_rest: bool
    features: tuple[str, ...]


def random_mechanism(rng: Rng) -> Mechanism:
    """Make a mechanism of one to three links."""
    return _Builder(rng).mechanism()


class _Builder:
    """Puts a random mechanism together, one section of the MJCF after the other."""

    def __init__(self, rng: Rng) -> None:
        self.rng = rng
        self.ranges: dict[tuple[str, str], Range] = {}
        self.unheld: list[str] = []
        self.features: list[str] = []
        self.targets: list[str] = []
        self.actuators: list[Actuator] = []
        self.timestep = float(rng.choice(TIMESTEPS))
        self.gravity = float(rng.choice([0.0, 0.0, 9.81]))

        # A loop closes only where all hinges have parallel axes.
        self.is_loop = rng.random() < 0.12
        self.links = self._links()
        self.collides = not self.is_loop and rng.random() < 0.45
        self.can_rest = self.gravity == 0.0

        # Gravity compensation, which actuators provide where joints say so.
        self.is_compensated = self.gravity > 0.0 and self.chance(0.3)

    def chance(self, probability: float) -> bool:
        """True with a probability."""
        return bool(self.rng.random() < probability)

    def mechanism(self) -> Mechanism:
        """Put all sections together."""
        world = self._world()
        tendons = self._tendons()
        drives = self._drives(tendons)
        equality = self._equality()
        keyframe = self._keyframe()

        if self.chance(0.03):
            self.features.append("no actuator")
            self.actuators.clear()
            kept = ("position", "tendon_length")
            self.ranges = {k: r for k, r in self.ranges.items() if k[0] in kept}
            self.unheld.clear()
            drives = ""
        xml = (
            '<mujoco model="mechanism">\n  <compiler angle="radian" autolimits="true"/>\n'
            f"{self._option()}"
            f'  <worldbody>\n    <site name="anchor" pos="0 0.1 0.3"/>\n{world}\n  </worldbody>\n'
            f"  <tendon>\n{''.join(tendons.values())}  </tendon>\n"
            f"  <actuator>\n{drives}  </actuator>\n"
            f"  <equality>\n{equality}  </equality>\n"
            f"  <keyframe>\n{keyframe}  </keyframe>\n</mujoco>\n"
        )
        return Mechanism(
            xml=xml,
            timestep=self.timestep,
            links=self.links,
            actuators=tuple(self.actuators),
            targets=tuple(self.targets),
            ranges=self.ranges,
            unheld=tuple(self.unheld),
            collides=self.collides,
            can_rest=self.can_rest,
            features=tuple(self.features),
        )

    def _option(self) -> str:
        """Settings of the engine."""
        integrator = str(self.rng.choice(INTEGRATORS))
        cone = str(self.rng.choice(["pyramidal", "elliptic"]))
        gravity = f"gravity {self.gravity:g}{', compensated' * self.is_compensated}"
        self.features.append(f"{integrator} {self.timestep:g} s, {gravity}")
        return (
            f'  <option timestep="{self.timestep}" integrator="{integrator}" cone="{cone}" '
            f'gravity="0 0 {-self.gravity:.17g}"/>\n'
        )

    # Links

    def _links(self) -> tuple[Link, ...]:
        """Make the links."""
        rng = self.rng
        count = 3 if self.is_loop else int(rng.integers(1, 4))
        masses = [log_uniform(rng, 0.1, 3.0) for _ in range(count)]
        lengths = [log_uniform(rng, 0.1, 0.6) for _ in range(count)]
        return tuple(self._link(i, masses, lengths) for i in range(count))

    def _link(self, i: int, masses: Sequence[float], lengths: Sequence[float]) -> Link:
        """Make a link."""
        kind = str(self.rng.choice(KINDS if i else FIRST_KINDS))
        if self.is_loop:
            kind = "hinge"
        load, arm = sum(masses[i:]), sum(lengths[i:])
        is_turning = kind in ("hinge", "ball")
        return Link(
            name=f"joint{i}",
            kind=kind,
            mass=masses[i],
            length=lengths[i],
            load=load,
            inertia=load * arm**2 if is_turning else load,
            reach=float(self.rng.uniform(0.3, 2.0)) * (1.0 if is_turning else 0.5 * arm),
        )

    def _world(self) -> str:
        """The bodies and the floor."""
        text = "".join(self._body(i) for i in range(len(self.links)))
        # Parent and child do not collide, so that short chains need something else to come near.
        if self.collides and (self.chance(0.5) or len(self.links) < 3):
            drop = sum(link.length for link in self.links) * self.rng.uniform(0.1, 1.0)
            self.features.append("floor")
            text = (
                f'    <geom name="floor" type="plane" size="5 5 1" pos="0 0 {-drop:.17g}"/>\n'
                + text
            )
        if self.collides:
            self.features.append("links that collide")
        return text + "    </body>" * len(self.links)

    def _body(self, i: int) -> str:
        """The opening lines of a body."""
        rng, link = self.rng, self.links[i]
        name = f"link{i}"
        place = self.links[i - 1].length if i else 0.0
        turn = f' euler="0 {rng.uniform(0.4, 1.2):.17g} 0"' if self.is_loop else ""
        self.targets.append(f"body/{name}:mass")

        thin = 0.05 * link.mass * link.length**2
        solid = "" if self.collides else ' contype="0" conaffinity="0"'
        size = link.length * rng.uniform(0.05, 0.12)
        lifted = ' gravcomp="1"' if self.is_compensated else ""
        return (
            f'    <body name="{name}" pos="{place:.17g} 0 0"{turn}{lifted}>\n'
            f'      <inertial pos="{0.5 * link.length:.17g} 0 0" mass="{link.mass:.17g}" '
            f'diaginertia="{thin:.17g} {2 * thin:.17g} {2 * thin:.17g}"/>\n'
            f'      <joint name="{link.name}"{words_of(self._joint(i))}/>\n'
            f'      <geom name="{name}" type="capsule" size="{size:.17g}"{solid} '
            f'fromto="{1.3 * size:.17g} 0 0 {link.length:.17g} 0 0" mass="0"/>\n'
            f'      <site name="tip{i}" pos="{link.length:.17g} 0 0"/>\n'
        )

    def _joint(self, i: int) -> dict[str, str]:
        """Attributes of a joint."""
        rng, link = self.rng, self.links[i]
        attributes = {"type": link.kind}
        if link.is_scalar:
            axis = rng.normal(size=3) if self.chance(0.5) else np.eye(3)[rng.integers(3)]
            if self.is_loop:
                axis = np.array([0.0, 1.0, 0.0])
            attributes["axis"] = " ".join(f"{number:.17g}" for number in axis)
        if self.is_compensated and link.kind != "free" and self.chance(0.7):
            attributes["actuatorgravcomp"] = "true"
        rate = float(rng.choice([0.1, 1.0, 5.0]))
        attributes["damping"] = f"{link.inertia * rate:.17g}"
        if link.kind != "free":
            self.targets.append(f"joint/{link.name}:damping")

        if link.is_scalar and self.chance(0.4):
            self.ranges["position", link.name] = about_zero(rng, link.reach)
            attributes["range"] = text_of(self.ranges["position", link.name])
        if link.kind == "ball" and self.chance(0.25):
            largest = float(rng.uniform(0.5, 2.0))
            attributes["range"] = text_of((0.0, largest))
            self.ranges["position", link.name] = (-largest, largest)
        if link.is_scalar and self.chance(0.2):
            self.ranges["joint_force", link.name] = about_zero(rng, link.effort)
            attributes["actuatorfrcrange"] = text_of(self.ranges["joint_force", link.name])
        self.features.append(link.kind)
        return attributes

    # Tendons

    def _tendons(self) -> dict[str, str]:
        """Elements of the tendons by name."""
        scalar = [link for link in self.links if link.is_scalar]
        found = {}
        if scalar and self.chance(0.3):
            inner = "".join(
                f'<joint joint="{link.name}" coef="{self.rng.uniform(0.3, 1.0):.17g}"/>'
                for link in scalar[:2]
            )
            found["cord"] = self._tendon("cord", "fixed", inner, scalar[0])
        if self.chance(0.2):
            inner = f'<site site="anchor"/><site site="tip{len(self.links) - 1}"/>'
            found["rope"] = self._tendon("rope", "spatial", inner, self.links[0])
        return found

    def _tendon(self, name: str, kind: str, inner: str, link: Link) -> str:
        """The element of a tendon that moves about as a link does."""
        rng = self.rng
        attributes = {}
        if self.chance(0.3):
            attributes["stiffness"] = f"{link.inertia * rng.uniform(0.5, 10.0):.17g}"
        if self.chance(0.3):
            attributes["damping"] = f"{link.inertia * rng.uniform(0.1, 2.0):.17g}"
            self.targets.append(f"tendon/{name}:damping")
        if self.chance(0.15):
            attributes["frictionloss"] = f"{link.inertia * rng.uniform(0.01, 0.3):.17g}"
        if self.chance(0.35):
            low = -2.0 * link.reach if kind == "fixed" else 0.0
            self.ranges["tendon_length", name] = (low, 2.0 * link.reach)
            attributes["range"] = text_of(self.ranges["tendon_length", name])
        if self.chance(0.35):
            self.ranges["tendon_force", name] = about_zero(rng, link.effort)
            attributes["actuatorfrcrange"] = text_of(self.ranges["tendon_force", name])
        self.features.append(f"{kind} tendon ({', '.join(attributes)})")
        return f'    <{kind} name="{name}"{words_of(attributes)}>{inner}</{kind}>\n'

    # Actuators

    def _drives(self, tendons: dict[str, str]) -> str:
        """Elements of all actuators, at least one."""
        for i, link in enumerate(self.links):
            count = int(self.rng.choice([0, 1, 1, 1, 2]))
            if i == 0 and self.is_loop:
                count = 1
            for k in range(count * min(COMPONENTS[link.kind], 3)):
                self._drive(f"drive{i}_{k}", link, k)
        if not self.actuators:
            self._drive("drive", self.links[0], 0)

        first = self.links[0]
        for name in tendons:
            if self.chance(0.7):
                self._actuator(f"pull_{name}", "motor", f'tendon="{name}"', first.effort, (1.0,))
            else:
                self.ranges.pop(("tendon_force", name), None)
        if self.chance(0.15):
            self._at_site(len(self.links) - 1)
        return "".join(actuator.element for actuator in self.actuators)

    def _drive(self, name: str, link: Link, k: int) -> None:
        """Add an actuator on a joint; the k-th of this joint."""
        rng, width = self.rng, COMPONENTS[link.kind]
        gear = [0.0] * width
        gear[k % width] = float(rng.choice([1.0, -1.0, 5.0]))
        tag = "motor"
        if link.is_scalar:
            tag = str(rng.choice(["motor", "motor", "position", "intvelocity", "general"]))
        self._actuator(name, tag, f'joint="{link.name}"', link.effort, tuple(gear), link.reach)

    def _at_site(self, i: int) -> None:
        """Add a thruster at the tip of a link."""
        link = self.links[i]
        effort = 10.0 * link.load * link.length
        self._actuator("thruster", "motor", f'site="tip{i}"', effort, (0.0, 0.0, 1.0))

    def _actuator(
        self,
        name: str,
        tag: str,
        transmission: str,
        effort: float,
        gear: tuple[float, ...],
        reach: float = 1.0,
    ) -> None:
        """Add an actuator."""
        rng = self.rng
        size = max(abs(number) for number in gear)
        force = control = effort / size
        attributes = {"gear": " ".join(f"{number:.17g}" for number in gear)}

        kp = effort / reach * float(rng.uniform(1.0, 10.0)) / size**2
        if tag == "position":
            control = reach * size
            attributes |= {"kp": f"{kp:.17g}", "kv": f"{0.2 * kp:.17g}"}
        elif tag == "intvelocity":
            control = reach * size
            attributes |= {"kp": f"{kp:.17g}", "kv": f"{0.2 * kp:.17g}"}
            attributes["actrange"] = text_of((-2.0 * control, 2.0 * control))
            self.unheld.append(name)
        elif tag == "general":
            attributes |= {"dyntype": "filterexact", "dynprm": f"{rng.uniform(0.02, 0.2):.17g}"}

        if self.chance(0.8):
            self.ranges["control", name] = about_zero(rng, control)
            attributes["ctrlrange"] = text_of(self.ranges["control", name])
        if self.chance(0.3):
            self.ranges["force", name] = about_zero(rng, force)
            attributes["forcerange"] = text_of(self.ranges["force", name])
        element = f'    <{tag} name="{name}" {transmission}{words_of(attributes)}/>\n'
        self.features.append(tag)
        self.actuators.append(Actuator(name=name, element=element, control=control, force=force))

    # Constraints and start

    def _equality(self) -> str:
        """Elements of the equality constraints."""
        scalar = [link.name for link in self.links if link.is_scalar]
        stiff = f'solref="{3.0 * self.timestep:.17g} 1"'
        if self.is_loop:
            self.features.append("closed loop")
            return (
                f'    <connect body1="link2" anchor="{self.links[2].length:.17g} 0 0" {stiff}/>\n'
            )
        if len(scalar) > 1 and self.chance(0.2):
            self.features.append("coupled joints")
            ratio = self.rng.uniform(-1.5, 1.5)
            pair = f'joint1="{scalar[0]}" joint2="{scalar[1]}"'
            return f'    <joint {pair} polycoef="0 {ratio:.17g} 0 0 0" {stiff}/>\n'
        return ""

    def _keyframe(self) -> str:
        """The keyframe in which the mechanism starts."""
        moves = not self.is_loop and self.chance(0.5)
        numbers = [number for link in self.links for number in self._start(link, moves)]
        self.can_rest = self.can_rest and not moves
        self.features.append("moved start" if moves else "start at zero")
        return f'    <key name="start" qpos="{" ".join(f"{n:.17g}" for n in numbers)}"/>\n'

    def _start(self, link: Link, moves: bool) -> list[float]:
        """Position of a joint in the keyframe, its place in the chain where it is a free joint."""
        rng = self.rng
        size = 0.1 if moves else 0.0
        turn = np.array([1.0, *(size * rng.normal(size=3))])
        quaternion = (turn / np.linalg.norm(turn)).tolist()
        if link.kind == "free":
            return [*(size * rng.normal(size=3)).tolist(), *quaternion]
        if link.kind == "ball":
            return list(quaternion)
        low, high = self.ranges.get(("position", link.name), (-link.reach, link.reach))
        return [float(size * rng.uniform(low, high))]

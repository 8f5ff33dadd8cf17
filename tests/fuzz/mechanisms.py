"""Random mechanisms: what the chains of `plants` do not have.

A mechanism is a chain that may float, hang on a ball joint, collide with itself and a floor, have
tendons, several actuators per joint, a closed loop or coupled joints, and start in a keyframe.
"""

from __future__ import annotations

import numpy as np

from tests.fuzz.plants import (
    INTEGRATORS,
    TAGS,
    TIMESTEPS,
    Attributes,
    Joint,
    Rng,
    about_zero,
    body_text,
    element,
    joint_attributes,
    log_uniform,
    random_drive,
    text_of,
)

# Kinds of the first joint, and of the others.
FIRST_KINDS = ("hinge", "hinge", "slide", "ball", "ball", "free", "free")
KINDS = ("hinge", "hinge", "hinge", "slide", "ball")

# Components of the force of an actuator on a joint that is neither a slide nor a hinge.
COMPONENTS = {"ball": 3, "free": 6}


class Mechanism:
    """A random mechanism of one to three links with the keyframe `start`.

    It has the attributes of `Plant`, and is put together one section of the MJCF after the other.
    """

    def __init__(self, rng: Rng) -> None:
        self.rng = rng
        self.ranges, self.features, self.targets, self.drives = {}, [], [], []
        self.timestep = rng.choice(TIMESTEPS)
        self.gravity = float(rng.choice([0.0, 0.0, 9.81]))

        # A loop closes only where all hinges have parallel axes.
        self.is_loop = self.chance(0.12)
        self.joints = self._joints()
        self.collides = not self.is_loop and self.chance(0.45)
        self.can_rest = self.gravity == 0.0

        # Gravity compensation, which actuators provide where joints say so.
        self.is_compensated = self.gravity > 0.0 and self.chance(0.3)

        integrator, cone = (
            str(self.rng.choice(each)) for each in (INTEGRATORS, ("pyramidal", "elliptic"))
        )
        gravity = f"gravity {self.gravity:g}{', compensated' * self.is_compensated}"
        self.features.append(f"{integrator} {self.timestep:g} s, {gravity}")
        world = self._world()
        tendons = self._tendons()
        self._drive(tendons)
        equality = self._equality()
        keyframe = self._keyframe()

        if self.chance(0.03):
            self.features.append("no actuator")
            self.drives.clear()
            kept = ("position", "tendon_length")
            self.ranges = {k: r for k, r in self.ranges.items() if k[0] in kept}
        drives = "".join(drive.element for drive in self.drives)
        option = element(
            "option",
            timestep=self.timestep,
            integrator=integrator,
            cone=cone,
            gravity=(0, 0, -self.gravity),
        )
        self.xml = (
            '<mujoco model="mechanism">\n  <compiler angle="radian" autolimits="true"/>\n'
            f"{option}\n"
            f'  <worldbody>\n    <site name="anchor" pos="0 0.1 0.3"/>\n{world}\n'
            f"  </worldbody>\n  <tendon>{''.join(tendons.values())}</tendon>\n"
            f"  <actuator>{drives}</actuator>\n  <equality>{equality}</equality>\n"
            f"  <keyframe>{keyframe}</keyframe>\n</mujoco>\n"
        )

    def chance(self, probability: float) -> bool:
        """True with a probability."""
        return bool(self.rng.random() < probability)

    # Links

    def _joints(self) -> tuple[Joint, ...]:
        """Make the joints and their links."""
        rng = self.rng
        count = 3 if self.is_loop else int(rng.integers(1, 4))
        masses = [log_uniform(rng, 0.1, 3.0) for _ in range(count)]
        lengths = [log_uniform(rng, 0.1, 0.6) for _ in range(count)]
        found = []
        for i in range(count):
            kind = "hinge" if self.is_loop else str(rng.choice(KINDS if i else FIRST_KINDS))
            load, arm = sum(masses[i:]), sum(lengths[i:])
            is_turning = kind in ("hinge", "ball")
            joint = Joint(
                name=f"joint{i}",
                kind=kind,
                reach=rng.uniform(0.3, 2.0) * (1.0 if is_turning else 0.5 * arm),
                inertia=load * arm**2 if is_turning else load,
                mass=masses[i],
                length=lengths[i],
            )
            found.append(joint)
        return tuple(found)

    def _world(self) -> str:
        """The bodies and the floor."""
        text = "".join(map(self._body, range(len(self.joints))))
        # Parent and child do not collide, so that short chains need something else to come near.
        if self.collides and (self.chance(0.5) or len(self.joints) < 3):
            drop = sum(joint.length for joint in self.joints) * self.rng.uniform(0.1, 1.0)
            self.features.append("floor")
            text = (
                element("geom", name="floor", type="plane", size="5 5 1", pos=(0, 0, -drop)) + text
            )
        if self.collides:
            self.features.append("links that collide")
        return text + "    </body>" * len(self.joints)

    def _body(self, i: int) -> str:
        """The opening lines of a body."""
        rng, joint = self.rng, self.joints[i]
        self.targets.append(f"body/link{i}:mass")
        self.features.append(joint.kind)
        attributes = self._attributes(joint)
        pose = f' euler="0 {text_of(rng.uniform(0.4, 1.2))} 0"' if self.is_loop else ""
        pose += ' gravcomp="1"' if self.is_compensated else ""
        place = self.joints[i - 1].length if i else 0.0
        thin = 0.05 * joint.mass * joint.length**2
        size = joint.length * rng.uniform(0.05, 0.12)
        thicknesses = (thin, 2.0 * thin)
        return body_text(
            joint, attributes, place, thicknesses, size, pose=pose, is_solid=self.collides
        )

    def _attributes(self, joint: Joint) -> Attributes:
        rng = self.rng
        if joint.is_scalar:
            attributes = joint_attributes(rng, joint, self.ranges)
            if self.is_loop:
                attributes["axis"] = "0 1 0"
        else:
            rate = rng.choice([0.1, 1.0, 5.0])
            attributes = {"type": joint.kind, "damping": joint.inertia * rate}
        if joint.kind == "ball" and self.chance(0.25):
            largest = rng.uniform(0.5, 2.0)
            attributes["range"] = (0.0, largest)
            self.ranges["position", joint.name] = (-largest, largest)
        if self.is_compensated and joint.kind != "free" and self.chance(0.7):
            attributes["actuatorgravcomp"] = "true"
        if joint.kind != "free" and attributes["damping"]:
            self.targets.append(f"joint/{joint.name}:damping")
        return attributes

    # Tendons and actuators

    def _tendons(self) -> Attributes:
        """Elements of the tendons by name."""
        scalar = [joint for joint in self.joints if joint.is_scalar]
        found = {}
        if scalar and self.chance(0.3):
            inner = "".join(
                element("joint", joint=joint.name, coef=self.rng.uniform(0.3, 1.0))
                for joint in scalar[:2]
            )
            found["cord"] = self._tendon("cord", "fixed", inner, scalar[0])
        if self.chance(0.2):
            inner = f'<site site="anchor"/><site site="tip{len(self.joints) - 1}"/>'
            found["rope"] = self._tendon("rope", "spatial", inner, self.joints[0])
        return found

    def _tendon(self, name: str, kind: str, inner: str, joint: Joint) -> str:
        """The element of a tendon that moves about as a joint does."""
        rng = self.rng
        attributes = {}
        for key, chance, low, high in (
            ("stiffness", 0.3, 0.5, 10.0),
            ("damping", 0.3, 0.1, 2.0),
            ("frictionloss", 0.15, 0.01, 0.3),
        ):
            if self.chance(chance):
                attributes[key] = joint.inertia * rng.uniform(low, high)
        if "damping" in attributes:
            self.targets.append(f"tendon/{name}:damping")
        shortest = -2.0 * joint.reach if kind == "fixed" else 0.0
        for key, limit, bounds in (
            ("range", "tendon_length", (shortest, 2.0 * joint.reach)),
            ("actuatorfrcrange", "tendon_force", about_zero(rng, joint.effort)),
        ):
            if self.chance(0.35):
                self.ranges[limit, name] = bounds
                attributes[key] = bounds
        self.features.append(f"{kind} tendon ({', '.join(attributes)})")
        return element(kind, inner, name=name, **attributes)

    def _drive(self, tendons: dict[str, str]) -> None:
        """Make all actuators, at least one."""
        for i, joint in enumerate(self.joints):
            count = 1 if i == 0 and self.is_loop else int(self.rng.choice([0, 1, 1, 1, 2]))
            for k in range(count * min(COMPONENTS.get(joint.kind, 1), 3)):
                self._on_joint(f"drive{i}_{k}", joint, k)
        first = self.joints[0]
        if not self.drives:
            self._on_joint("drive", first, 0)

        for name in tendons:
            if self.chance(0.7):
                self._add(f"pull_{name}", {"tendon": name}, first, ("motor",), (1.0,))
            else:
                self.ranges.pop(("tendon_force", name), None)
        if self.chance(0.15):
            tip = len(self.joints) - 1
            push = (0.0, 0.0, 1.0)
            self._add("thruster", {"site": f"tip{tip}"}, self.joints[tip], ("motor",), push)

    def _on_joint(self, name: str, joint: Joint, k: int) -> None:
        """Add an actuator on a joint; the k-th of this joint."""
        gear = ()
        tags = (*TAGS, "intvelocity")
        if not joint.is_scalar:
            tags, width = ("motor",), COMPONENTS[joint.kind]
            size = self.rng.choice([1.0, -1.0, 5.0])
            gear = tuple(size if i == k % width else 0.0 for i in range(width))
        self._add(name, {"joint": joint.name}, joint, tags, gear)

    def _add(
        self,
        name: str,
        transmission: Attributes,
        joint: Joint,
        tags: tuple[str, ...],
        gear: tuple[float, ...],
    ) -> None:
        """Add an actuator."""
        is_bounded = self.chance(0.8)
        options = {"tags": tags, "gear": gear, "is_bounded": is_bounded}
        drive = random_drive(self.rng, name, transmission, joint, self.ranges, **options)  # type: ignore[arg-type]
        self.features.append(drive.tag)
        self.drives.append(drive)

    # Constraints and start

    def _equality(self) -> str:
        """Elements of the equality constraints."""
        scalar = [joint.name for joint in self.joints if joint.is_scalar]
        solref = (3.0 * self.timestep, 1)
        if self.is_loop:
            self.features.append("closed loop")
            tip = (self.joints[2].length, 0, 0)
            return element("connect", body1="link2", anchor=tip, solref=solref)
        if len(scalar) > 1 and self.chance(0.2):
            self.features.append("coupled joints")
            ratio = (0, self.rng.uniform(-1.5, 1.5), 0, 0, 0)
            pair = {"joint1": scalar[0], "joint2": scalar[1]}
            return element("joint", **pair, polycoef=ratio, solref=solref)
        return ""

    def _keyframe(self) -> str:
        """The keyframe in which the mechanism starts."""
        moves = not self.is_loop and self.chance(0.5)
        size = 0.1 if moves else 0.0
        numbers: list[float] = []
        for joint in self.joints:
            turn = np.array([1.0, *(size * self.rng.normal(size=3))])
            if joint.is_scalar:
                around = (-joint.reach, joint.reach)
                bounds = self.ranges.get(("position", joint.name), around)
                numbers.append(size * self.rng.uniform(*bounds))
                continue
            if joint.kind == "free":
                numbers += (size * self.rng.normal(size=3)).tolist()
            numbers += (turn / np.linalg.norm(turn)).tolist()
        self.can_rest = self.can_rest and not moves
        self.features.append("moved start" if moves else "start at zero")
        return element("key", name="start", qpos=numbers)

"""An MJCF beside a URDF that adds what a URDF lacks: actuators."""

from __future__ import annotations

from dataclasses import dataclass
from pathlib import Path
from typing import Any
from xml.etree import ElementTree

import mujoco

from mjfim.errors import ModelError
from mjfim.model.loading import load_spec

# Comment at the head of the MJCF.
COMMENT = (
    " The URDF with one motor for each joint; the range of a motor is the effort of its joint. "
)


@dataclass(frozen=True, kw_only=True)
class UrdfModel:
    """A URDF and the motors that it lacks.

    Attributes:
        name: Name of the robot.
        motors: One motor for each revolute or prismatic joint: its name, which is also that of the
            motor, and the lower and upper end of its force [N or N m], equal where the URDF states
            none.
        velocities: Velocity limits of the URDF by joint name [m/s or rad/s]. MJCF has none.
    """

    name: str
    motors: tuple[tuple[str, tuple[float, float]], ...]
    velocities: dict[str, float]

    def mjcf(self, file: str) -> str:
        """Text of an MJCF that attaches the URDF and adds the motors.

        Args:
            file: Path of the URDF, relative to the MJCF or absolute.
        """
        root = ElementTree.Element("mujoco", model=f"{self.name} with motors")
        root.append(ElementTree.Comment(COMMENT))
        asset = ElementTree.SubElement(root, "asset")
        ElementTree.SubElement(asset, "model", name="robot", file=file)
        world = ElementTree.SubElement(root, "worldbody")
        ElementTree.SubElement(world, "attach", model="robot", prefix="")

        actuators = ElementTree.SubElement(root, "actuator")
        for joint, (low, high) in self.motors:
            attributes = {"name": joint, "joint": joint}
            if low < high:
                attributes["ctrlrange"] = f"{low:.9g} {high:.9g}"
            ElementTree.SubElement(actuators, "motor", attributes)

        ElementTree.indent(root)
        return ElementTree.tostring(root, encoding="unicode") + "\n"


def read_urdf(path: Path) -> UrdfModel:
    """Read a URDF, and give each joint a motor.

    Args:
        path: The URDF.

    Raises:
        ModelError: The URDF cannot be read, or has no joint to drive.
    """
    spec = load_spec(path)
    driven = (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    motors = tuple(
        (joint.name, (float(joint.actfrcrange[0]), float(joint.actfrcrange[1])))
        for joint in spec.joints
        if joint.name and joint.type in driven
    )
    if not motors:
        raise ModelError(f"{path}: the URDF has no revolute or prismatic joint that a motor drives")

    return UrdfModel(name=spec.modelname, motors=motors, velocities=_velocities(path))


def _velocities(path: Path) -> dict[str, float]:
    """Velocity limits of a URDF by joint name."""
    found: dict[str, float] = {}
    for joint in ElementTree.parse(path).getroot().iter("joint"):
        limit: Any = joint.find("limit")
        text = None if limit is None else limit.get("velocity")
        name = joint.get("name")
        if text is None or name is None:
            continue
        value = float(text)
        if value > 0.0:
            found[name] = value
    return found

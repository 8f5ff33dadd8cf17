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
    """An MJCF around a URDF.

    Attributes:
        text: Contents of the MJCF.
        velocities: Velocity limits of the URDF by joint name [m/s or rad/s]. MJCF has none.
    """

    text: str
    velocities: dict[str, float]


def is_urdf(path: Path) -> bool:
    """Whether a model file is a URDF.

    Args:
        path: The file.
    """
    try:
        for _, element in ElementTree.iterparse(path, events=("start",)):
            return bool(element.tag == "robot")
    except (OSError, ElementTree.ParseError):
        return False
    return False


def with_motors(path: Path, file: str) -> UrdfModel:
    """Add motors to a URDF.

    Args:
        path: The URDF.
        file: Path of the URDF relative to the MJCF.

    Raises:
        ModelError: The URDF cannot be read, or has no joint to drive.
    """
    spec = load_spec(path)
    joints = [
        joint
        for joint in spec.joints
        if joint.name and joint.type in (mujoco.mjtJoint.mjJNT_HINGE, mujoco.mjtJoint.mjJNT_SLIDE)
    ]
    if not joints:
        raise ModelError(f"{path}: the URDF has no revolute or prismatic joint that a motor drives")

    root = ElementTree.Element("mujoco", model=f"{spec.modelname} with motors")
    root.append(ElementTree.Comment(COMMENT))
    asset = ElementTree.SubElement(root, "asset")
    ElementTree.SubElement(asset, "model", name="robot", file=file)
    world = ElementTree.SubElement(root, "worldbody")
    ElementTree.SubElement(world, "attach", model="robot", prefix="")

    actuators = ElementTree.SubElement(root, "actuator")
    for joint in joints:
        attributes = {"name": joint.name, "joint": joint.name}
        low, high = joint.actfrcrange
        if low < high:
            attributes["ctrlrange"] = f"{low:.9g} {high:.9g}"
        ElementTree.SubElement(actuators, "motor", attributes)

    ElementTree.indent(root)
    text = ElementTree.tostring(root, encoding="unicode") + "\n"
    return UrdfModel(text=text, velocities=_velocities(path))


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

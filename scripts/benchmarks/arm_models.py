"""Models of two industrial arms for the benchmark of closed-loop logs, and their true robots.

The Panda is the one of the MuJoCo Menagerie, beside the repository. The UR5e is made from the
Denavit-Hartenberg parameters, masses and centres of mass that its maker publishes; its links are
cylinders. Both have position servos, rotor inertias and sensors of the torques of their motors.
"""

from __future__ import annotations

import mujoco
import numpy as np

from mjfim.arrays import Array, record
from scripts.benchmarks.child import SHARED

# Period of the controller and of the engine [s].
TIMESTEP = 0.002


@record
class Arm:
    """An arm of the study.

    Attributes:
        name: Its name.
        xml: MJCF with servos, rotor inertias and sensors of torque.
        joints: Names of the joints.
        links: Names of the bodies whose inertia is unknown.
        home: (n,) joint angles about which it moves [rad].
        range: (n,) largest distances from them [rad].
        friction: (n,) typical dry friction [N m] and viscous friction [N m s/rad].
        sigma: (n,) standard deviations of the measured torques [N m].
    """

    name: str
    xml: str
    joints: tuple[str, ...]
    links: tuple[str, ...]
    home: Array
    range: Array
    friction: Array
    sigma: Array


def with_sensors(spec: mujoco.MjSpec) -> str:
    """MJCF of an arm with the engine's timestep and a sensor of the torque of each servo."""
    spec.option.timestep = TIMESTEP
    for actuator in spec.actuators:
        spec.add_sensor(
            name=f"torque_{actuator.target}",
            type=mujoco.mjtSensor.mjSENS_ACTUATORFRC,
            objtype=mujoco.mjtObj.mjOBJ_ACTUATOR,
            objname=actuator.name,
        )
    spec.compile()
    return str(spec.to_xml())


def panda() -> Arm | None:
    """The Franka Emika Panda without its hand; None where its model is absent."""
    path = SHARED / "models" / "menagerie_panda" / "panda_nohand_nomesh.xml"
    if not path.is_file():
        return None
    spec = mujoco.MjSpec.from_file(str(path))
    for number, joint in enumerate(spec.joints):
        joint.armature = 0.1 if number < 4 else 0.03
    model = spec.compile()
    low, high = model.jnt_range.T
    large = np.arange(7) < 4
    return Arm(
        name="Panda",
        xml=with_sensors(spec),
        joints=tuple(f"joint{i}" for i in range(1, 8)),
        links=tuple(f"link{i}" for i in range(1, 8)),
        home=0.5 * (low + high),
        range=0.3 * (high - low),
        friction=np.where(large, 1.2, 0.25),
        sigma=np.where(large, 0.3, 0.1),
    )


# Links of the UR5e by their joints: the Denavit-Hartenberg parameters a [m], d [m] and alpha [rad],
# mass [kg], centre of mass in the frame at the end of the link [m], radius of the cylinder that
# stands for it [m], rotor inertia [kg m^2], and gain of the servo [N m/rad].
UR_LINKS = {
    "shoulder_pan": (
        (0.0, 0.1625, np.pi / 2),
        (3.761, (0.0, -0.02561, 0.00193), 0.06, 0.6, 6000.0),
    ),
    "shoulder_lift": (
        (-0.425, 0.0, 0.0),
        (8.058, (0.2125, 0.0, 0.11336), 0.06, 0.6, 6000.0),
    ),
    "elbow": (
        (-0.3922, 0.0, 0.0),
        (2.846, (0.15, 0.0, 0.0265), 0.05, 0.6, 4000.0),
    ),
    "wrist_1": (
        (0.0, 0.1333, np.pi / 2),
        (1.37, (0.0, -0.0018, 0.01634), 0.045, 0.1, 800.0),
    ),
    "wrist_2": (
        (0.0, 0.0997, -np.pi / 2),
        (1.3, (0.0, 0.0018, 0.01634), 0.045, 0.1, 800.0),
    ),
    "wrist_3": (
        (0.0, 0.0996, 0.0),
        (0.365, (0.0, 0.0, -0.001159), 0.0375, 0.1, 800.0),
    ),
}


def ur5e() -> Arm:
    """An arm with the dimensions and masses of a UR5e."""
    spec = mujoco.MjSpec()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    parent = spec.worldbody
    place, turn = np.zeros(3), 0.0
    for joint, ((a, d, alpha), (mass, com, radius, armature, gain)) in UR_LINKS.items():
        body = parent.add_body(
            name=f"link_{joint}", pos=place, quat=[np.cos(turn / 2), np.sin(turn / 2), 0.0, 0.0]
        )
        body.add_joint(name=joint, axis=[0, 0, 1], armature=armature)

        # The frame of the link is at its end, turned about the direction of a.
        end = np.array([a, 0.0, d])
        turned = np.array(
            [[1, 0, 0], [0, np.cos(alpha), -np.sin(alpha)], [0, np.sin(alpha), np.cos(alpha)]]
        )
        body.explicitinertial = True
        body.mass = mass
        body.ipos = end + turned @ np.array(com)

        # A solid cylinder from the joint to the end.
        length = float(np.linalg.norm(end))
        along = end / length
        across = mass * (3.0 * radius**2 + length**2) / 12.0
        inertia = across * np.eye(3) + (0.5 * mass * radius**2 - across) * np.outer(along, along)
        body.fullinertia = inertia[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]
        parent, place, turn = body, end, alpha
        actuator = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        actuator.set_to_position(kp=gain, kv=gain / 20.0)

    large = np.arange(6) < 3
    return Arm(
        name="UR5e",
        xml=with_sensors(spec),
        joints=tuple(UR_LINKS),
        links=tuple(f"link_{joint}" for joint in UR_LINKS),
        home=np.array([0.0, -1.4, 1.2, -1.2, -1.3, 0.0]),
        range=np.array([1.5, 0.6, 0.9, 1.2, 1.2, 1.5]),
        friction=np.where(large, 6.0, 1.2),
        sigma=np.where(large, 0.6, 0.15),
    )

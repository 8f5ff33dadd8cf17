"""Models of two industrial arms for the benchmark of closed-loop logs, and their true robots.

The Panda is the one of the MuJoCo Menagerie, beside the repository. The UR5e is made from the
Denavit-Hartenberg parameters, masses and centres of mass that its maker publishes; its links are
cylinders. Both have position servos, rotor inertias and sensors of the torques of their motors.
"""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np

from mjfim.arrays import Array, record

# Folder of the models that others wrote, beside the repository.
MODELS = Path(__file__).resolve().parents[3] / "shared" / "models"

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
        gains: (n, 2) gains [N m/rad] and [N m s/rad] of the discrete laws of its drivers, whose
            motors take torques; None where the model has servos.
    """

    name: str
    xml: str
    joints: tuple[str, ...]
    links: tuple[str, ...]
    home: Array
    range: Array
    friction: Array
    sigma: Array
    gains: Array | None = None


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
    path = MODELS / "menagerie_panda" / "panda_nohand_nomesh.xml"
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


# Denavit-Hartenberg parameters of the UR5e: a [m], d [m] and alpha [rad].
UR_A = (0.0, -0.425, -0.3922, 0.0, 0.0, 0.0)
UR_D = (0.1625, 0.0, 0.0, 0.1333, 0.0997, 0.0996)
UR_ALPHA = (np.pi / 2, 0.0, 0.0, np.pi / 2, -np.pi / 2, 0.0)

# Masses of its links [kg], and their centres of mass in the frames at the ends of the links [m].
UR_MASS = (3.761, 8.058, 2.846, 1.37, 1.3, 0.365)
UR_COM = (
    (0.0, -0.02561, 0.00193),
    (0.2125, 0.0, 0.11336),
    (0.15, 0.0, 0.0265),
    (0.0, -0.0018, 0.01634),
    (0.0, 0.0018, 0.01634),
    (0.0, 0.0, -0.001159),
)

# Radii of the cylinders that stand for its links [m].
UR_RADIUS = (0.06, 0.06, 0.05, 0.045, 0.045, 0.0375)

# Its joints; rotor inertias [kg m^2], and gains [N m/rad] and [N m s/rad] of their servos.
UR_JOINTS = ("shoulder_pan", "shoulder_lift", "elbow", "wrist_1", "wrist_2", "wrist_3")
UR_ARMATURE = (0.6, 0.6, 0.6, 0.1, 0.1, 0.1)
UR_KP = (6000.0, 6000.0, 4000.0, 800.0, 800.0, 800.0)
UR_KV = (300.0, 300.0, 200.0, 40.0, 40.0, 40.0)


# Name of the arm with discrete laws.
LAWS = "UR5e, discrete laws"


def ur5e(*, has_laws: bool = False) -> Arm:
    """An arm with the dimensions and masses of a UR5e.

    Args:
        has_laws: Whether discrete laws move it in place of servos. These have half of the gains, so
            that they are stable at their rate.
    """
    spec = mujoco.MjSpec()
    spec.option.integrator = mujoco.mjtIntegrator.mjINT_IMPLICITFAST
    parent = spec.worldbody
    place, turn = np.zeros(3), 0.0
    for i, joint in enumerate(UR_JOINTS):
        a, d, alpha = UR_A[i], UR_D[i], UR_ALPHA[i]
        body = parent.add_body(
            name=f"link_{joint}", pos=place, quat=[np.cos(turn / 2), np.sin(turn / 2), 0.0, 0.0]
        )
        body.add_joint(name=joint, axis=[0, 0, 1], armature=UR_ARMATURE[i])

        # The frame of the link is at its end, turned about the direction of a.
        end = np.array([a, 0.0, d])
        turned = np.array(
            [[1, 0, 0], [0, np.cos(alpha), -np.sin(alpha)], [0, np.sin(alpha), np.cos(alpha)]]
        )
        body.explicitinertial = True
        body.mass = UR_MASS[i]
        body.ipos = end + turned @ np.array(UR_COM[i])
        body.fullinertia = _cylinder(UR_MASS[i], UR_RADIUS[i], end)
        parent, place, turn = body, end, alpha
        actuator = spec.add_actuator(name=joint, target=joint, trntype=mujoco.mjtTrn.mjTRN_JOINT)
        if has_laws:
            actuator.set_to_motor()
        else:
            actuator.set_to_position(kp=UR_KP[i], kv=UR_KV[i])

    large = np.arange(6) < 3
    return Arm(
        name=LAWS if has_laws else "UR5e",
        xml=with_sensors(spec),
        joints=UR_JOINTS,
        links=tuple(f"link_{joint}" for joint in UR_JOINTS),
        home=np.array([0.0, -1.4, 1.2, -1.2, -1.3, 0.0]),
        range=np.array([1.5, 0.6, 0.9, 1.2, 1.2, 1.5]),
        friction=np.where(large, 6.0, 1.2),
        sigma=np.where(large, 0.6, 0.15),
        gains=0.5 * np.array([UR_KP, UR_KV]).T if has_laws else None,
    )


def _cylinder(mass: float, radius: float, axis: Array) -> Array:
    """(6,) inertia of a solid cylinder about its centre of mass, in the order of MJCF [kg m^2]."""
    length = float(np.linalg.norm(axis))
    along = axis / length
    across = mass * (3.0 * radius**2 + length**2) / 12.0
    matrix = across * np.eye(3) + (0.5 * mass * radius**2 - across) * np.outer(along, along)
    return matrix[[0, 1, 2, 0, 0, 1], [0, 1, 2, 1, 2, 2]]

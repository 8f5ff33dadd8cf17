"""Two arms under hard limits, from rest to rest: their models, experiments and properties.

The models are made at run time, into FOLDER, from ../shared/models beside the repository. They have
the kinematics, inertias, servos and ranges of those files, and in addition

- a payload, rigid at the flange or at the fixed jaw, its centre of mass off every axis;
- damping, armature and dry friction of the joints where the MJCF has none (see `ARMS`);
- a floor, and capsules without mass in place of the links, which the mesh-free MJCF lacks. They
  serve for distance: pairs that always overlap are excluded from contact and listed under
  `limits.ignored`;
- servo gains as numbers, because a `dampratio` would change with the payload;
- the keyframe `home` (of the SO-ARM100 with the jaw open) with the control that holds it.

Numbers have the six digits that MuJoCo writes to XML. The integrator is that of the MJCF.

Each arm has two variants. The smooth one has no dry friction (that of the SO-ARM100 is taken out)
and p = 18 or 16 unknowns: damping and armature of every joint, mass and centre of mass of the
payload. The dry one has dry friction in every joint as further unknowns, p = 25 or 22.

"Worst relative sigma" is `1 / sqrt(lambda_min(S I S))` with the scales S of the parameters and the
information I of all samples. It is the standard deviation of the worst combination of unit length,
and at least as large as that of every single parameter. The scale of a parameter is its guess, and
0.05 m for the coordinates of the centre of mass.
"""

from __future__ import annotations

from pathlib import Path
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import record
from mjfim.experiment.initial import multisine
from mjfim.experiment.schema import Experiment
from scripts.benchmarks.child import SHARED, write_log

# Timestep of the engine [s].
TIMESTEP = 0.002

# Rates of control updates and of measurements [Hz].
RATE, MEASURED = 100.0, 50.0

# Standard deviations of encoders [rad] and of their filtered derivatives [rad/s].
NOISE = {"qpos": 1e-3, "qvel": 1e-2}

# Smallest allowed distance between bodies [m].
CLEARANCE = 0.02

# Scale of the coordinates of the payload's centre of mass [m].
CENTRE_SCALE = 0.05

# Time in which the starting motion grows and fades, and time at rest at its end [s].
RISE, REST = 0.5, 1.0

# Number of harmonics of the starting motion.
HARMONICS = 5

# Frequency of the first harmonic of the starting motion [Hz].
FUNDAMENTAL = 0.2

# Position in the frame of a body [m].
Point = tuple[float, float, float]

# A capsule in place of a link: body that carries it, ends of its axis (equal for a sphere), and
# radius [m].
Capsule = tuple[str, Point, Point, float]


@record
class Arm:
    """An arm, the additions to its MJCF, and its limits.

    Attributes:
        file: Path of the MJCF under ../shared/models.
        joints: Names of the joints; each has an actuator of this name.
        home: Joint positions of the keyframe `home` [rad].
        capsules: Capsules in place of the links.
        carrier: Name of the body that carries the payload.
        mass: Mass of the payload [kg].
        com: Its centre of mass in the frame of the carrier [m].
        inertia: Its principal moments of inertia [kg m²].
        radius: Radius of the sphere that stands for it [m].
        damping: Nominal damping of every joint [N m s/rad].
        armature: Nominal armature of every joint [kg m²].
        friction: Nominal dry friction of every joint [N m].
        overlapping: Pairs of bodies whose capsules always overlap.
        velocity: Limits of the joint velocities [rad/s], one for all or one for each joint.
        rate: Limits of the rate of the reference [rad/s], one for all or one for each joint.
        force: Limit of the actuator forces besides those of the MJCF [N m].
        amplitude: Amplitude of the starting motion [rad].
    """

    file: str
    joints: tuple[str, ...]
    home: tuple[float, ...]
    capsules: tuple[Capsule, ...]
    carrier: str
    mass: float
    com: Point
    inertia: Point
    radius: float
    damping: float
    armature: float
    friction: float
    overlapping: tuple[tuple[str, str], ...]
    velocity: float | dict[str, float]
    rate: float | dict[str, float]
    force: float | None
    amplitude: float


# Joints of the Panda.
PANDA = tuple(f"joint{i}" for i in range(1, 8))

# Velocity limits of the Panda [rad/s].
PANDA_SPEED = {name: 2.175 if i < 4 else 2.61 for i, name in enumerate(PANDA)}

# Joints of the SO-ARM100.
SO_ARM = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")

# The two arms; nominal values beyond the MJCF are those that are published for the robots.
ARMS = {
    # The capsules are the coarse self-collision model of franka_description; that of link1 is cut
    # off where that of link0 begins. The speeds are the limits there. Damping and armature are
    # those of Menagerie's actuated Panda, and forces are limited by the forcerange of the MJCF
    # (87 and 12 N m).
    "panda": Arm(
        file="menagerie_panda/panda_nohand_nomesh.xml",
        joints=PANDA,
        home=(0.0, 0.0, 0.0, -1.57079, 0.0, 1.57079, -0.7853),
        capsules=(
            ("link0", (-0.09, 0.0, 0.06), (0.01, 0.0, 0.06), 0.07),
            ("link1", (0.0, 0.0, -0.13), (0.0, 0.0, 0.0), 0.06),
            ("link2", (0.0, 0.0, -0.06), (0.0, 0.0, 0.06), 0.06),
            ("link3", (0.0, 0.0, -0.22), (0.0, 0.0, -0.07), 0.06),
            ("link4", (0.0, 0.0, -0.06), (0.0, 0.0, 0.06), 0.06),
            ("link5", (0.0, 0.0, -0.31), (0.0, 0.0, -0.21), 0.06),
            ("link5", (0.0, 0.08, -0.20), (0.0, 0.08, -0.06), 0.025),
            ("link6", (0.0, 0.0, -0.07), (0.0, 0.0, 0.01), 0.05),
            ("link7", (0.0, 0.0, -0.06), (0.0, 0.0, 0.08), 0.04),
            ("link7", (0.0389, 0.0389, 0.082), (0.046, 0.046, 0.082), 0.03),
        ),
        carrier="attachment",
        mass=1.0,
        com=(0.03, -0.02, 0.06),
        inertia=(1.2e-3, 1.0e-3, 0.8e-3),
        radius=0.05,
        damping=1.0,
        armature=0.1,
        friction=0.5,
        overlapping=(("link0", "link1"), ("link1", "link3")),
        velocity=PANDA_SPEED,
        rate=PANDA_SPEED,
        force=None,
        amplitude=0.2,
    ),
    # The capsules surround servos of 45 x 25 x 35 mm. Damping and force are published values of the
    # STS3215 at 12 V (4.8 rad/s without load), armature and friction those of the MJCF. Home is its
    # keyframe with the jaw open.
    "so_arm100": Arm(
        file="menagerie_so_arm100/so_arm100_nomesh.xml",
        joints=SO_ARM,
        home=(0.0, -1.57079, 1.57079, 1.57079, -1.57079, 0.5),
        capsules=(
            ("Base", (0.0, -0.045, 0.03), (0.0, 0.0, 0.03), 0.03),
            ("Rotation_Pitch", (0.0, 0.055, 0.0), (0.0, 0.1025, 0.0306), 0.03),
            ("Upper_Arm", (0.0, 0.0, 0.0), (0.0, 0.11257, 0.028), 0.03),
            ("Lower_Arm", (0.0, 0.0, 0.0), (0.0, 0.0052, 0.1349), 0.028),
            ("Wrist_Pitch_Roll", (0.0, 0.0, 0.0), (0.0, -0.05, 0.0), 0.025),
            ("Fixed_Jaw", (0.005, -0.035, 0.0), (0.012, -0.095, 0.0), 0.018),
            ("Moving_Jaw", (0.0, 0.0, 0.0), (-0.009, -0.075, 0.0), 0.012),
        ),
        carrier="Fixed_Jaw",
        mass=0.15,
        com=(0.035, -0.055, 0.015),
        inertia=(3.0e-5, 2.5e-5, 2.0e-5),
        radius=0.02,
        damping=0.6,
        armature=0.1,
        friction=0.1,
        overlapping=(("Base", "Rotation_Pitch"), ("Wrist_Pitch_Roll", "Moving_Jaw")),
        velocity=4.0,
        rate=6.0,
        force=2.94,
        amplitude=0.15,
    ),
}


def model_file(name: str, friction: bool, folder: Path) -> Path:
    """Write the MJCF of an arm into a folder.

    Args:
        name: Key of `ARMS`, from which the name of the file is made.
        friction: Whether the joints have dry friction.
        folder: Folder that receives the file.
    """
    arm = ARMS[name]
    source = SHARED / "models" / arm.file
    if not source.is_file():
        raise SystemExit(f"{source}: no such model; the arms are not part of this repository")

    # Gains that follow a damping ratio would change with the payload.
    spec = mujoco.MjSpec.from_file(str(source))
    model = spec.compile()
    for actuator in spec.actuators:
        actuator.biasprm[:] = model.actuator(actuator.name).biasprm
    spec.option.timestep = TIMESTEP

    for joint in spec.joints:
        joint.damping[0] = arm.damping
        joint.armature = arm.armature
        joint.frictionloss = arm.friction if friction else 0.0

    # Payload, floor and capsules replace all geoms of the MJCF.
    for geom in list(spec.geoms):
        spec.delete(geom)
    body = spec.body(arm.carrier).add_body(name="payload")
    body.explicitinertial = True
    body.mass, body.ipos, body.inertia = arm.mass, arm.com, arm.inertia
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 0.05])
    sphere = ("payload", arm.com, arm.com, arm.radius)
    for i, (carrier, start, end, radius) in enumerate((*arm.capsules, sphere)):
        geom = spec.body(carrier).add_geom(name=f"{carrier}_{i}", size=[radius, 0.0, 0.0], mass=0.0)
        if start == end:
            geom.type, geom.pos = mujoco.mjtGeom.mjGEOM_SPHERE, start
        else:
            geom.type = mujoco.mjtGeom.mjGEOM_CAPSULE
            geom.fromto = [*start, *end]

    # MuJoCo refuses a pair that is excluded twice.
    known = [{pair.bodyname1, pair.bodyname2} for pair in spec.excludes]
    for one, other in arm.overlapping:
        if {one, other} not in known:
            spec.add_exclude(bodyname1=one, bodyname2=other)

    # References at which the servos hold the pose against gravity.
    model = spec.compile()
    data = mujoco.MjData(model)
    data.qpos[:] = arm.home
    mujoco.mj_forward(model, data)
    joints = model.actuator_trnid[:, 0]
    deflection = data.qfrc_bias[model.jnt_dofadr[joints]] / model.actuator_gainprm[:, 0]
    key = spec.key("home")
    key.qpos = list(arm.home)
    key.ctrl = (data.qpos[model.jnt_qposadr[joints]] + deflection).tolist()

    folder.mkdir(parents=True, exist_ok=True)
    path = folder / f"{name}{'_dry' if friction else ''}.xml"
    path.write_text(spec.to_xml(), encoding="utf-8")
    return path


def experiment(name: str, horizon: float, friction: bool, folder: Path) -> Experiment:
    """Make the experiment of an arm, from rest to rest at home, under hard limits.

    Args:
        name: Key of `ARMS`.
        horizon: Duration [s].
        friction: Whether the joints have dry friction, which is then unknown.
        folder: Folder that receives the model and the starting control.

    Returns:
        The experiment.
    """
    arm = ARMS[name]
    path = model_file(name, friction, folder)

    hold = np.array(mujoco.MjModel.from_xml_path(str(path)).key("home").ctrl)
    # A small multisine about the hold, at rest at both ends.
    t = np.arange(round(horizon * RATE)) / RATE
    growth = np.clip(np.minimum(t, horizon - REST - t) / RISE, 0.0, 1.0)
    wave = multisine(t, len(hold), FUNDAMENTAL, HARMONICS, np.random.default_rng(0))
    start = hold + arm.amplitude * np.sin(0.5 * np.pi * growth)[:, None] ** 2 * wave
    control = folder / f"{path.stem}_{horizon:g}s.csv"
    write_log(control, ["t", *arm.joints], t, start, form="%.12g")

    parameters: dict[str, Any] = {
        f"{joint}_{field}": {"target": f"joint/{joint}:{field}"}
        for field in ("damping", "armature", *(["frictionloss"] if friction else []))
        for joint in arm.joints
    }
    parameters["payload_mass"] = {"target": "body/payload:mass"}
    for i, axis in enumerate("xyz"):
        table = {"target": f"body/payload:ipos[{i}]", "scale": CENTRE_SCALE}
        parameters[f"payload_{axis}"] = table

    return Experiment(
        model=path.name,
        directory=folder,
        source=path.stem,
        rate=RATE,
        measure_rate=MEASURED,
        horizon=horizon,
        initial={"keyframe": "home", "control": control.name},
        parameters=parameters,
        noise={f"{kind}:{each}": sigma for kind, sigma in NOISE.items() for each in arm.joints},
        cost={"criterion": "E", "control": 0.0},
        limits={
            "velocity": arm.velocity,
            "control_rate": arm.rate,
            "clearance": CLEARANCE,
            "ignored": arm.overlapping,
            **({} if arm.force is None else {"force": arm.force}),
        },
        boundary={"start": "rest", "end": "rest"},
    )

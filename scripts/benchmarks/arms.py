"""Two arms under hard limits, from rest to rest: their models, experiments and properties.

    python -m scripts.benchmarks arms FOLDER [--arms panda so_arm100] [--horizons 5 10]
    [--skip-check]

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

import argparse
import csv
import itertools
import time
from collections.abc import Iterator
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch
from rich.console import Console
from rich.table import Table

from mjfim.arrays import Array
from mjfim.excitation.task import DesignTask
from mjfim.experiment.schema import Experiment
from mjfim.parallel import cores
from mjfim.records.trajectory import Sensitivity
from mjfim.signals import multisine

# Folder of the models that others wrote, beside the repository.
MODELS = Path(__file__).resolve().parents[3] / "shared" / "models"

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

# Timestep that is the reference for all others [s].
FINE = 2.5e-4

# Largest distance that MuJoCo computes [m]; larger ones do not matter.
MAX_DISTANCE = 10.0

# Position in the frame of a body [m].
Point = tuple[float, float, float]


@dataclass(frozen=True)
class Capsule:
    """A capsule in place of a link.

    Attributes:
        body: Name of the body that carries the capsule.
        start: Start of the axis in the frame of the body [m].
        end: End of the axis in the frame of the body [m]; equal to the start for a sphere.
        radius: Radius [m].
    """

    body: str
    start: Point
    end: Point
    radius: float


@dataclass(frozen=True)
class Payload:
    """A body that is welded to another.

    Attributes:
        parent: Name of the body that carries the payload.
        mass: Mass [kg].
        com: Centre of mass in the frame of the parent [m].
        inertia: Principal moments of inertia [kg m²].
        radius: Radius of the sphere that stands for the payload [m].
    """

    parent: str
    mass: float
    com: Point
    inertia: Point
    radius: float


@dataclass(frozen=True)
class Arm:
    """An arm, the additions to its MJCF, and its limits.

    Attributes:
        file: Path of the MJCF under ../shared/models.
        joints: Names of the joints; each has an actuator of this name.
        home: Joint positions of the keyframe `home` [rad].
        capsules: Capsules in place of the links.
        payload: Payload at the last link.
        damping: Nominal damping of every joint [N m s/rad].
        armature: Nominal armature of every joint [kg m²].
        friction: Nominal dry friction of every joint [N m].
        timestep: Timestep of the engine [s].
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
    payload: Payload
    damping: float
    armature: float
    friction: float
    timestep: float
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
            Capsule("link0", (-0.09, 0.0, 0.06), (0.01, 0.0, 0.06), 0.07),
            Capsule("link1", (0.0, 0.0, -0.13), (0.0, 0.0, 0.0), 0.06),
            Capsule("link2", (0.0, 0.0, -0.06), (0.0, 0.0, 0.06), 0.06),
            Capsule("link3", (0.0, 0.0, -0.22), (0.0, 0.0, -0.07), 0.06),
            Capsule("link4", (0.0, 0.0, -0.06), (0.0, 0.0, 0.06), 0.06),
            Capsule("link5", (0.0, 0.0, -0.31), (0.0, 0.0, -0.21), 0.06),
            Capsule("link5", (0.0, 0.08, -0.20), (0.0, 0.08, -0.06), 0.025),
            Capsule("link6", (0.0, 0.0, -0.07), (0.0, 0.0, 0.01), 0.05),
            Capsule("link7", (0.0, 0.0, -0.06), (0.0, 0.0, 0.08), 0.04),
            Capsule("link7", (0.0389, 0.0389, 0.082), (0.046, 0.046, 0.082), 0.03),
        ),
        payload=Payload("attachment", 1.0, (0.03, -0.02, 0.06), (1.2e-3, 1.0e-3, 0.8e-3), 0.05),
        damping=1.0,
        armature=0.1,
        friction=0.5,
        timestep=0.002,
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
            Capsule("Base", (0.0, -0.045, 0.03), (0.0, 0.0, 0.03), 0.03),
            Capsule("Rotation_Pitch", (0.0, 0.055, 0.0), (0.0, 0.1025, 0.0306), 0.03),
            Capsule("Upper_Arm", (0.0, 0.0, 0.0), (0.0, 0.11257, 0.028), 0.03),
            Capsule("Lower_Arm", (0.0, 0.0, 0.0), (0.0, 0.0052, 0.1349), 0.028),
            Capsule("Wrist_Pitch_Roll", (0.0, 0.0, 0.0), (0.0, -0.05, 0.0), 0.025),
            Capsule("Fixed_Jaw", (0.005, -0.035, 0.0), (0.012, -0.095, 0.0), 0.018),
            Capsule("Moving_Jaw", (0.0, 0.0, 0.0), (-0.009, -0.075, 0.0), 0.012),
        ),
        payload=Payload("Fixed_Jaw", 0.15, (0.035, -0.055, 0.015), (3.0e-5, 2.5e-5, 2.0e-5), 0.02),
        damping=0.6,
        armature=0.1,
        friction=0.1,
        timestep=0.002,
        overlapping=(("Base", "Rotation_Pitch"), ("Wrist_Pitch_Roll", "Moving_Jaw")),
        velocity=4.0,
        rate=6.0,
        force=2.94,
        amplitude=0.15,
    ),
}


def model_file(
    arm: Arm, name: str, friction: bool, folder: Path, timestep: float | None = None
) -> Path:
    """Write the MJCF of an arm.

    Args:
        arm: The arm.
        name: Name of the arm, from which the name of the file is made.
        friction: Whether the joints have dry friction.
        folder: Folder that receives the file.
        timestep: Timestep of the engine [s]; that of the arm by default.

    Returns:
        Path of the file.
    """
    source = MODELS / arm.file
    if not source.is_file():
        raise SystemExit(f"{source}: no such model; the arms are not part of this repository")

    spec = mujoco.MjSpec.from_file(str(source))
    _state_gains(spec, spec.compile())
    spec.option.timestep = timestep or arm.timestep

    for joint in spec.joints:
        joint.damping[0] = arm.damping
        joint.armature = arm.armature
        joint.frictionloss = arm.friction if friction else 0.0

    _add_bodies(spec, arm)

    model = spec.compile()
    key = spec.key("home")
    key.qpos = list(arm.home)
    key.ctrl = holding(model, np.array(arm.home)).tolist()

    folder.mkdir(parents=True, exist_ok=True)
    variant = "_dry" if friction else ""
    step = f"_{1e3 * timestep:g}ms" if timestep else ""
    path = folder / f"{name}{variant}{step}.xml"
    path.write_text(spec.to_xml(), encoding="utf-8")
    return path


def _state_gains(spec: Any, model: Any) -> None:
    """Write the gains of the servos as they were compiled.

    Gains that follow a damping ratio would change with the payload.
    """
    for actuator in spec.actuators:
        actuator.biasprm[:] = model.actuator(actuator.name).biasprm


def _add_bodies(spec: Any, arm: Arm) -> None:
    """Add payload, floor and capsules; the capsules replace all geoms of the MJCF."""
    for geom in list(spec.geoms):
        spec.delete(geom)

    load = arm.payload
    body = spec.body(load.parent).add_body(name="payload")
    body.explicitinertial = True
    body.mass = load.mass
    body.ipos = load.com
    body.inertia = load.inertia

    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 0.05])

    sphere = Capsule("payload", load.com, load.com, load.radius)
    for i, capsule in enumerate((*arm.capsules, sphere)):
        geom = spec.body(capsule.body).add_geom(
            name=f"{capsule.body}_{i}", size=[capsule.radius, 0.0, 0.0], mass=0.0
        )
        if capsule.start == capsule.end:
            geom.type = mujoco.mjtGeom.mjGEOM_SPHERE
            geom.pos = capsule.start
        else:
            geom.type = mujoco.mjtGeom.mjGEOM_CAPSULE
            geom.fromto = [*capsule.start, *capsule.end]

    # MuJoCo refuses a pair that is excluded twice.
    known = {frozenset((pair.bodyname1, pair.bodyname2)) for pair in spec.excludes}
    for one, other in arm.overlapping:
        if frozenset((one, other)) not in known:
            spec.add_exclude(bodyname1=one, bodyname2=other)


def holding(model: Any, qpos: Array) -> Array:
    """Compute the references at which position servos hold a pose against gravity.

    Args:
        model: Model with one servo for each joint.
        qpos: (nq,) pose [rad].

    Returns:
        (nu,) references [rad].
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)

    joints = model.actuator_trnid[:, 0]
    load = data.qfrc_bias[model.jnt_dofadr[joints]]
    deflection = load / model.actuator_gainprm[:, 0]
    return np.asarray(qpos[model.jnt_qposadr[joints]] + deflection)


def start_control(hold: Array, horizon: float, amplitude: float) -> Array:
    """Compute a small multisine about the hold that is at rest at both ends.

    Args:
        hold: (nu,) control that holds the pose [rad].
        horizon: Duration [s].
        amplitude: Amplitude of every joint [rad].

    Returns:
        (N, nu) control [rad].
    """
    t = np.arange(round(horizon * RATE)) / RATE
    end = horizon - REST
    growth = np.clip(np.minimum(t, end - t) / RISE, 0.0, 1.0)
    window = np.sin(0.5 * np.pi * growth)[:, None] ** 2

    wave = multisine(t, len(hold), FUNDAMENTAL, HARMONICS, np.random.default_rng(0))
    return np.asarray(hold + amplitude * window * wave)


def parameters(arm: Arm, friction: bool) -> dict[str, dict[str, Any]]:
    """Return the tables of the unknowns: two or three for each joint and four of the payload."""
    fields = ["damping", "armature"]
    if friction:
        fields.append("frictionloss")

    found: dict[str, dict[str, Any]] = {}
    for field in fields:
        for joint in arm.joints:
            found[f"{joint}_{field}"] = {"target": f"joint/{joint}:{field}"}

    found["payload_mass"] = {"target": "body/payload:mass"}
    for i, axis in enumerate("xyz"):
        found[f"payload_{axis}"] = {"target": f"body/payload:ipos[{i}]", "scale": CENTRE_SCALE}
    return found


def experiment(
    name: str,
    horizon: float,
    friction: bool,
    model_folder: str | Path,
    timestep: float | None = None,
) -> Experiment:
    """Make the experiment of an arm, from rest to rest at home, under hard limits.

    Args:
        name: Key of `ARMS`.
        horizon: Duration [s].
        friction: Whether the joints have dry friction, which is then unknown.
        model_folder: Folder that receives the model and the starting control.
        timestep: Timestep of the engine [s]; that of the arm by default.

    Returns:
        The experiment.
    """
    arm = ARMS[name]
    folder = Path(model_folder)
    path = model_file(arm, name, friction, folder, timestep)

    hold = np.array(mujoco.MjModel.from_xml_path(str(path)).key("home").ctrl)
    control = folder / f"{path.stem}_{horizon:g}s.csv"
    write_control(control, arm.joints, start_control(hold, horizon, arm.amplitude))

    limits: dict[str, Any] = {
        "velocity": arm.velocity,
        "control_rate": arm.rate,
        "clearance": CLEARANCE,
        "ignored": arm.overlapping,
    }
    if arm.force is not None:
        limits["force"] = arm.force

    noise = {f"{kind}:{joint}": sigma for kind, sigma in NOISE.items() for joint in arm.joints}
    return Experiment(
        model=path.name,
        directory=folder,
        source=path.stem,
        rate=RATE,
        measure_rate=MEASURED,
        horizon=horizon,
        initial={"keyframe": "home", "control": control.name},
        parameters=parameters(arm, friction),
        noise=noise,
        cost={"criterion": "E", "control": 0.0},
        limits=limits,
        boundary={"start": "rest", "end": "rest"},
    )


def write_control(path: Path, names: tuple[str, ...], control: Array) -> None:
    """Write a table of times and controls as `initial.control` reads it.

    Args:
        path: File to write.
        names: Names of the actuators.
        control: (N, nu) control.
    """
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["t", *names])

        for k, row in enumerate(control):
            values = [f"{u:.12g}" for u in row]
            rows.writerow([f"{k / RATE:.4f}", *values])


def worst_relative_sigma(information: Array, scale: Array) -> float:
    """Compute the worst relative sigma, `1 / sqrt(lambda_min(S I S))`.

    Args:
        information: (p, p) information of all samples.
        scale: (p,) scales of the parameters.

    Returns:
        Standard deviation of the worst combination of unit length.
    """
    scaled = information * np.outer(scale, scale)
    return float(np.linalg.eigvalsh(scaled)[0] ** -0.5)


# ---- properties of the arms


@dataclass(frozen=True)
class Motion:
    """A simulated motion; positions, velocities and forces are those of every engine step.

    Attributes:
        qpos: (n+1, nv) positions [rad].
        qvel: (n+1, nv) velocities [rad/s].
        force: (n, nv) actuator forces [N m].
        distance: (N,) smallest distance between bodies at every sample [m].
        closest: Names of the two bodies that come closest.
    """

    qpos: Array
    qvel: Array
    force: Array
    distance: Array
    closest: tuple[str, str]


def pairs(model: Any) -> list[tuple[int, int]]:
    """Return the pairs of geoms that MuJoCo would let collide.

    Geoms of one body, of parent and child, and of excluded pairs of bodies do not collide.
    """
    excluded = set(model.exclude_signature.tolist())
    found = []

    for one, other in itertools.combinations(range(model.ngeom), 2):
        bodies = sorted((int(model.geom_bodyid[one]), int(model.geom_bodyid[other])))
        a, b = (int(model.body_weldid[body]) for body in bodies)
        parent_a = int(model.body_weldid[model.body_parentid[a]])
        parent_b = int(model.body_weldid[model.body_parentid[b]])

        parent_and_child = a != 0 and b != 0 and (parent_a == b or parent_b == a)
        is_excluded = (bodies[0] << 16) + bodies[1] in excluded
        if a != b and not parent_and_child and not is_excluded:
            found.append((one, other))

    return found


def clearance(
    model: Any, data: Any, candidates: list[tuple[int, int]]
) -> tuple[float, tuple[str, str]]:
    """Find the smallest distance between geoms at the pose of `data`.

    Args:
        model: The model.
        data: Its data, with positions of the geoms.
        candidates: Pairs of geoms.

    Returns:
        Distance [m] and the names of the two bodies.
    """
    segment = np.zeros(6)
    distances = []
    for one, other in candidates:
        distance = mujoco.mj_geomDistance(model, data, one, other, MAX_DISTANCE, segment)
        distances.append(distance)

    nearest = int(np.argmin(distances))
    bodies = [int(model.geom_bodyid[geom]) for geom in candidates[nearest]]
    one_name, other_name = (model.body(body).name for body in bodies)
    return float(distances[nearest]), (one_name, other_name)


def moved(model: Any, start: Array, control: Array, velocity: Array | None = None) -> Motion:
    """Simulate a control that is held over each sample.

    Args:
        model: The model.
        start: (nq,) initial positions [rad].
        control: (N, nu) control.
        velocity: (nv,) initial velocities [rad/s]; zero by default.

    Returns:
        The motion.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = start
    if velocity is not None:
        data.qvel[:] = velocity

    candidates = pairs(model)
    substeps = round(1.0 / (RATE * model.opt.timestep))
    qpos = [start.copy()]
    qvel = [data.qvel.copy()]
    force = []
    nearest = []

    for u in control:
        data.ctrl[:] = u
        for _ in range(substeps):
            mujoco.mj_step(model, data)
            qpos.append(data.qpos.copy())
            qvel.append(data.qvel.copy())
            force.append(data.actuator_force.copy())
        nearest.append(clearance(model, data, candidates))

    distance, names = zip(*nearest, strict=True)
    return Motion(
        qpos=np.array(qpos),
        qvel=np.array(qvel),
        force=np.array(force),
        distance=np.array(distance),
        closest=names[int(np.argmin(distance))],
    )


def margins(e: Experiment, model: Any, control: Array, motion: Motion) -> dict[str, float]:
    """Compute the smallest distance to each kind of limit.

    Args:
        e: The experiment.
        model: Its model.
        control: (N, nu) control.
        motion: Motion under this control.

    Returns:
        For each kind of limit, the distance as a share of half the range; for the clearance, as a
        share of the limit.
    """
    stated = e.limits.force if isinstance(e.limits.force, float) else np.inf
    force = np.minimum(model.actuator_forcerange[:, 1], stated)
    velocity = _each(e.limits.velocity)
    rate = _each(e.limits.control_rate)
    position = model.jnt_range
    ranges = model.actuator_ctrlrange
    slopes = np.diff(control, axis=0) * RATE

    return {
        "position": _margin(motion.qpos, position[:, 0], position[:, 1]),
        "control": _margin(control, ranges[:, 0], ranges[:, 1]),
        "force": _margin(motion.force, -force, force),
        "velocity": _margin(motion.qvel, -velocity, velocity),
        "control rate": _margin(slopes, -rate, rate),
        "clearance": float(motion.distance.min() / CLEARANCE - 1.0),
    }


def _each(limit: Any) -> Array:
    """Return symmetric limits in the order of the joints, or one number that holds for all."""
    values = list(limit.values()) if isinstance(limit, dict) else [limit]
    return np.array(values)


def _margin(values: Array, low: Array, high: Array) -> float:
    """Return the smallest distance of values (n, m) to their limits, per half range."""
    distance = np.minimum(values - low, high - values)
    return float((distance / (0.5 * (high - low))).min())


def lifted(model: Any) -> Any:
    """Take ranges, clamps and contacts out of a model, in place, as a design simulates it.

    Without dry friction the solver of constraints is off as well.
    """
    model.jnt_limited[:] = 0
    model.actuator_forcelimited[:] = 0
    model.actuator_ctrllimited[:] = 0

    flags = mujoco.mjtDisableBit.mjDSBL_CONTACT | mujoco.mjtDisableBit.mjDSBL_SENSOR
    if not model.dof_frictionloss.any():
        flags |= mujoco.mjtDisableBit.mjDSBL_CONSTRAINT
    model.opt.disableflags |= int(flags)
    return model


def step_seconds(
    model: Any, start: Array, control: Array, simulations: int = 128, repeats: int = 3
) -> float:
    """Measure the wall time of one engine step in a batch on all cores.

    Args:
        model: The model.
        start: (nq,) initial positions [rad].
        control: (N, nu) control, of which the first 100 samples are simulated.
        simulations: Number of simulations in the batch.
        repeats: Number of measurements, of which the fastest counts.

    Returns:
        Seconds per step of one simulation.
    """
    batch = Batch(model, simulations, cores())
    substeps = round(1.0 / (RATE * model.opt.timestep))
    held = np.repeat(control[:100], substeps, axis=0)
    shape = (simulations, 100 * substeps, control.shape[1])
    controls = np.ascontiguousarray(np.broadcast_to(held, shape))

    best = np.inf
    for _ in range(repeats):
        batch.bind("qpos")[:] = start
        batch.bind("qvel")[:] = 0.0
        clock = time.perf_counter()
        batch.rollout(controls.shape[1], controls)
        best = min(best, time.perf_counter() - clock)

    return float(best / (simulations * controls.shape[1]))


def settling(
    model: Any, start: Array, hold: Array, speed: Array, e: Experiment
) -> tuple[float, float]:
    """Simulate the hold from full speed of all joints for two seconds.

    Args:
        model: The model.
        start: (nq,) initial positions [rad].
        hold: (nu,) control that holds the pose.
        speed: (nv,) initial velocities [rad/s].
        e: The experiment with the tolerances of its boundary.

    Returns:
        Time until the tolerances hold for good [s], and the largest error of the positions at the
        end [rad].
    """
    control = np.tile(hold, (round(2.0 * RATE), 1))
    motion = moved(model, start, control, speed)
    error = np.abs(motion.qpos - start).max(axis=1)
    velocity = np.abs(motion.qvel).max(axis=1)

    outside = (error > e.boundary.position) | (velocity > e.boundary.velocity)
    rows = np.flatnonzero(outside)
    seconds = float((rows[-1] + 1) * model.opt.timestep) if len(rows) else 0.0
    return seconds, float(error[-1])


def prepared(e: Experiment) -> tuple[Any, Array, Array, Array]:
    """Read the files of an experiment.

    Returns:
        The model, the start (nq,), the hold (nu,) and the starting control (N, nu).
    """
    model = mujoco.MjModel.from_xml_path(str(e.directory / e.model))
    key = model.key("home")
    table = np.loadtxt(e.directory / str(e.initial.control), delimiter=",", skiprows=1)
    return model, np.array(key.qpos), np.array(key.ctrl), table[:, 1:]


def described(e: Experiment) -> Iterator[tuple[str, str]]:
    """Describe an experiment before its design.

    Yields:
        Name and value of a property.
    """
    model, start, hold, control = prepared(e)
    horizon = float(e.horizon or 0.0)
    candidates = pairs(model)
    yield "parameters, samples", f"{len(e.parameters)}, {round(horizon * RATE)}"
    yield "pairs of geoms looked at", f"{len(candidates)}"

    data = mujoco.MjData(model)
    data.qpos[:] = start
    mujoco.mj_forward(model, data)
    distance, bodies = clearance(model, data, candidates)
    yield "clearance at home", f"{100 * distance:.1f} cm ({bodies[0]}, {bodies[1]})"
    yield "hold minus home, largest", f"{np.abs(hold - start).max():.4f} rad"

    yield from _described_engine(e, start, control)

    speed = np.broadcast_to(_each(e.limits.velocity), model.nv)
    seconds, error = settling(model, start, hold, speed, e)
    yield "from full speed to rest within", f"{seconds:.2f} s; after 2 s {1e3 * error:.2g} mrad off"

    motion = moved(model, start, control)
    error = np.abs(motion.qpos[-1] - start).max()
    velocity = np.abs(motion.qvel[-1]).max()
    yield "the start ends", f"{1e3 * error:.2g} mrad off, {1e3 * velocity:.2g} mrad/s"

    shares = [f"{kind} {value:.0%}" for kind, value in margins(e, model, control, motion).items()]
    yield "margins of the start", ", ".join(shares)


def _described_engine(e: Experiment, start: Array, control: Array) -> Iterator[tuple[str, str]]:
    """Yield the time of an engine step and of one simulation as names and values."""
    light = lifted(mujoco.MjModel.from_xml_path(str(e.directory / e.model)))
    seconds = step_seconds(light, start, control)
    timestep = light.opt.timestep
    steps = round(float(e.horizon or 0.0) / timestep)

    without_constraints = int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
    solver = "off" if light.opt.disableflags & without_constraints else "on (dry friction)"

    speed = f"{1e6 * seconds:.2f} µs on {cores()} cores"
    yield "engine step, timestep", f"{speed}, {1e3 * timestep:g} ms"
    yield "one rollout; constraints", f"{1e3 * seconds * steps:.1f} ms; {solver}"


def identifiable(e: Experiment) -> Iterator[tuple[str, str]]:
    """Describe the information along the starting motion, as `mjfim check` finds it.

    Yields:
        Name and value of a property.
    """
    task = DesignTask.resolve(e)
    sensitivity = task.plant.derivatives.sensitivity(task.theta, task.initial)
    if sensitivity is None:
        raise SystemExit(
            f"{e.source}: the starting motion diverges when the parameters move a little"
        )

    names = task.parameters.names
    scale = task.parameters.scale
    information = task.information.matrix(sensitivity)
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    smallest = ", ".join(f"{value:.3g}" for value in values[:4])
    yield "worst relative sigma", f"{worst_relative_sigma(information, scale):.3g}"
    yield "smallest eigenvalues", f"{smallest}; largest {values[-1]:.2g}"

    for j in range(2):
        largest = np.argsort(-np.abs(vectors[:, j]))[:3]
        terms = [f"{vectors[i, j]:+.2f} {names[i]}" for i in largest]
        yield f"weakest combination {j + 1}", " ".join(terms)

    relative = task.information.std(information) / scale
    order = np.argsort(-relative)
    sorted_sigmas = [f"{names[i]} {relative[i]:.2g}" for i in order]
    yield "worst parameters, sigma / scale", ", ".join(sorted_sigmas[:3])
    yield "best", ", ".join(sorted_sigmas[-2:])

    found = task.identifiability_test.along(task.initial, sensitivity)
    always = [str(group) for group in found.groups_along_all]
    along_this = [str(group) for group in found.groups_along_trajectory]
    yield "never identifiable", "; ".join(always) or "none"
    yield "not along this motion", "; ".join(along_this) or "none"


def timesteps(name: str, friction: bool, horizon: float, folder: Path) -> Table:
    """Compare motions and information at several timesteps with those at a fine one.

    Args:
        name: Key of `ARMS`.
        friction: Whether the joints have dry friction.
        horizon: Duration [s].
        folder: Folder for models and starting controls.

    Returns:
        Table with one row for each timestep.
    """
    variant = ", dry" if friction else ""
    title = f"{name}{variant}: timesteps against {1e3 * FINE:g} ms, {horizon:g} s"
    headings = (
        "timestep",
        "largest error of qpos",
        "of qvel",
        "worst relative sigma",
        "µs per second of motion",
    )
    table = Table(title=title, title_justify="left")
    for heading in headings:
        table.add_column(heading, justify="right")

    reference: tuple[Array, Array] | None = None
    for step in (FINE, 0.001, 0.002, 0.004, 0.005):
        e = experiment(name, horizon, friction, folder / "timesteps", step)
        task = DesignTask.resolve(e)
        sensitivity = task.plant.derivatives.sensitivity(task.theta, task.initial)
        sigma = np.nan if sensitivity is None else _sigma(task, sensitivity)

        # The first timestep is the fine one.
        q, v = task.initial.qpos, task.initial.qvel
        reference = (q, v) if reference is None else reference
        error_q = np.abs(q - reference[0]).max()
        error_v = np.abs(v - reference[1]).max()

        _, start, _, control = prepared(e)
        light = lifted(mujoco.MjModel.from_xml_path(str(e.directory / e.model)))
        cost = 1e6 * step_seconds(light, start, control, 32, 2) / step
        table.add_row(
            f"{1e3 * step:g} ms",
            f"{error_q:.1e} rad",
            f"{error_v:.1e} rad/s",
            f"{sigma:.4g}",
            f"{cost:.0f}",
        )

    return table


def _sigma(task: DesignTask, sensitivity: Sensitivity) -> float:
    """Return the worst relative sigma along a trajectory."""
    return worst_relative_sigma(task.information.matrix(sensitivity), task.parameters.scale)


def main() -> None:
    """Describe the arms in tables on standard output."""
    parser = argparse.ArgumentParser(
        description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter
    )
    parser.add_argument("folder", type=Path, help="where models and starting controls are written")
    parser.add_argument("--arms", nargs="+", choices=list(ARMS), default=list(ARMS))
    parser.add_argument("--horizons", nargs="+", type=float, default=[5.0, 10.0])
    parser.add_argument(
        "--skip-check", action="store_true", help="leave out what can be identified"
    )
    parser.add_argument("--timesteps", action="store_true", help="compare timesteps as well")
    args = parser.parse_args()
    console = Console(highlight=False, width=150)

    for name, friction in itertools.product(args.arms, (False, True)):
        columns = []
        for horizon in args.horizons:
            e = experiment(name, horizon, friction, args.folder)
            found = dict(described(e))
            if not args.skip_check:
                found |= dict(identifiable(e))
            columns.append(found)

        variant = "dry" if friction else "smooth"
        table = Table(title=f"{name}, {variant}", title_justify="left")
        table.add_column("")
        for horizon in args.horizons:
            table.add_column(f"{horizon:g} s")
        for row in columns[0]:
            table.add_row(row, *(column[row] for column in columns))
        console.print(table)

        if args.timesteps:
            console.print(timesteps(name, friction, args.horizons[0], args.folder))

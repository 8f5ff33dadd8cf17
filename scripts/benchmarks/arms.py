"""Two arms under hard limits, rest to rest: their models, their experiments, and what these are
like before any design.

    python -m scripts.benchmarks arms FOLDER [--arms panda so_arm100] [--horizons 5 10]
    [--skip-check]

The models are made at run time, into FOLDER, from ../shared/models beside the repository: the same
kinematics, inertias, servos and ranges, and in addition

- a payload, rigid at the flange or at the fixed jaw, its centre of mass off every axis;
- damping, armature and dry friction of the joints where the MJCF has none (see `ARMS`);
- a floor, and capsules without mass that stand for the links, which the mesh-free MJCF lack. They
  serve for distance: pairs that always overlap are excluded from contact and listed under
  `limits.ignored`;
- servo gains as numbers: `dampratio` would follow the payload;
- the keyframe `home` (of the SO-ARM100 with the jaw open) with the control that holds it.

Numbers have the six digits that MuJoCo writes to XML. Timestep and integrator are the MJCF's.

Each arm comes smooth (no dry friction, that of the SO-ARM100's MJCF taken out; p = 18 and 16:
damping and armature of every joint, mass and centre of mass of the payload) and dry (frictionloss
of every joint in the model and unknown, p = 25 and 22).

"Worst relative sigma" is `1 / sqrt(lambda_min(S I S))`, S the parameters' scales, I the sum over
all samples: the standard deviation of the worst combination of unit length, at least as large as
that of every single parameter. A scale is the parameter's guess, but 0.05 m for the coordinates of
the centre of mass.
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

MODELS = Path(__file__).resolve().parents[3] / "shared" / "models"
RATE, MEASURED = 100.0, 50.0  # [Hz] control updates, measurements
NOISE = {"qpos": 1e-3, "qvel": 1e-2}  # [rad, rad/s] encoders and their filtered derivative, 1 sigma
CLEARANCE = 0.02  # [m]
CENTRE_SCALE = 0.05  # [m] unit of the coordinates of the payload's centre of mass
RISE, REST = 0.5, 1.0  # [s] in which the starting motion swells and dies, and stillness at its end
HARMONICS = 5
PITCH = 0.2  # [Hz] of the starting motion's first harmonic
FINE = 2.5e-4  # [s] timestep that others are compared with
FAR = 10.0  # [m] distances beyond do not matter

Point = tuple[float, float, float]


@dataclass(frozen=True)
class Capsule:
    """What stands for a link. start, end: of its axis in the body's frame [m], equal for a sphere;
    radius: [m]
    """

    body: str
    start: Point
    end: Point
    radius: float


@dataclass(frozen=True)
class Payload:
    """A body welded to `parent`. mass: [kg];  com: [m] in the parent's frame;  inertia: principal
    [kg m²];  radius: [m]
    """

    parent: str
    mass: float
    com: Point
    inertia: Point
    radius: float


@dataclass(frozen=True)
class Arm:
    """An arm, what is added to its MJCF, and its limits.

    file: under ../shared/models;  joints: names, each with an actuator of the same name
    home: [rad];  damping: [N m s/rad], armature: [kg m²], friction: [N m] of every joint, nominal
    timestep: [s];  overlapping: pairs of bodies whose capsules always overlap
    velocity: [rad/s], force: [N m] beside the MJCF's, rate: [rad/s] of the reference, per joint or
    for all amplitude: [rad] of the starting motion
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


PANDA = tuple(f"joint{i}" for i in range(1, 8))
PANDA_SPEED = {name: 2.175 if i < 4 else 2.61 for i, name in enumerate(PANDA)}
SO_ARM = ("Rotation", "Pitch", "Elbow", "Wrist_Pitch", "Wrist_Roll", "Jaw")
ARMS = {
    # capsules: franka_description's coarse self-collision model, link1's cut off where link0's
    # begins; speeds: its limits; damping and armature: those of Menagerie's own actuated Panda;
    # forces: the MJCF's forcerange (87 and 12 N m)
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
    # capsules: about servos of 45 x 25 x 35 mm; damping and force: what is published of the STS3215
    # at 12 V (4.8 rad/s idle); armature and friction: the MJCF's; home: its keyframe with the jaw
    # open
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
    """Write the arm's MJCF into the folder and return its path. timestep: [s], default: the arm's."""
    source = MODELS / arm.file
    if not source.is_file():
        raise SystemExit(f"{source}: no such model; the arms are not part of this repository")
    spec = mujoco.MjSpec.from_file(str(source))
    _state_gains(spec, spec.compile())
    spec.option.timestep = timestep or arm.timestep
    for joint in spec.joints:
        joint.damping[0], joint.armature = arm.damping, arm.armature
        joint.frictionloss = arm.friction if friction else 0.0
    _embody(spec, arm)
    model, key = spec.compile(), spec.key("home")
    key.qpos = list(arm.home)
    key.ctrl = holding(model, np.array(arm.home)).tolist()
    folder.mkdir(parents=True, exist_ok=True)
    step = f"_{1e3 * timestep:g}ms" if timestep else ""
    path = folder / f"{name}{'_dry' if friction else ''}{step}.xml"
    path.write_text(spec.to_xml(), encoding="utf-8")
    return path


def _state_gains(spec: Any, model: Any) -> None:
    """Write the servos' gains as they were compiled: those that follow a damping ratio would change
    with the payload.
    """
    for actuator in spec.actuators:
        actuator.biasprm[:] = model.actuator(actuator.name).biasprm


def _embody(spec: Any, arm: Arm) -> None:
    """Payload, floor and capsules.

    Boxes that the MJCF has on its jaws make way for the jaws' capsules.
    """
    for geom in list(spec.geoms):
        spec.delete(geom)
    load = arm.payload
    body = spec.body(load.parent).add_body(name="payload")
    body.explicitinertial, body.mass, body.ipos, body.inertia = (
        True,
        load.mass,
        load.com,
        load.inertia,
    )
    spec.worldbody.add_geom(name="floor", type=mujoco.mjtGeom.mjGEOM_PLANE, size=[0.0, 0.0, 0.05])
    sphere = Capsule("payload", load.com, load.com, load.radius)
    for i, c in enumerate((*arm.capsules, sphere)):
        geom = spec.body(c.body).add_geom(name=f"{c.body}_{i}", size=[c.radius, 0.0, 0.0], mass=0.0)
        if c.start == c.end:
            geom.type, geom.pos = mujoco.mjtGeom.mjGEOM_SPHERE, c.start
        else:
            geom.type, geom.fromto = mujoco.mjtGeom.mjGEOM_CAPSULE, [*c.start, *c.end]
    known = {frozenset((e.bodyname1, e.bodyname2)) for e in spec.excludes}
    for one, other in arm.overlapping:
        if frozenset((one, other)) not in known:
            spec.add_exclude(bodyname1=one, bodyname2=other)


def holding(model: Any, qpos: Array) -> Array:
    """(nu,) references at which position servos, one per joint, hold qpos: (nq,) [rad] against
    gravity.
    """
    data = mujoco.MjData(model)
    data.qpos[:] = qpos
    mujoco.mj_forward(model, data)
    joints = model.actuator_trnid[:, 0]
    load = data.qfrc_bias[model.jnt_dofadr[joints]]
    return np.asarray(qpos[model.jnt_qposadr[joints]] + load / model.actuator_gainprm[:, 0])


def start_control(hold: Array, horizon: float, amplitude: float) -> Array:
    """(N, nu) a small multisine about the hold: (nu,), that swells from it and dies back to it, so
    that it rests at both ends.

    horizon: [s];  amplitude: [rad] of every joint
    """
    t = np.arange(round(horizon * RATE)) / RATE
    end = horizon - REST
    swell = np.clip(np.minimum(t, end - t) / RISE, 0.0, 1.0)
    wave = multisine(t, len(hold), PITCH, HARMONICS, np.random.default_rng(0))
    window = np.sin(0.5 * np.pi * swell)[:, None] ** 2
    return np.asarray(hold + amplitude * window * wave)


def parameters(arm: Arm, friction: bool) -> dict[str, dict[str, Any]]:
    """Unknowns, relative to their guesses: 2 or 3 per joint, 4 of the payload."""
    fields = ("damping", "armature", *(("frictionloss",) if friction else ()))
    found: dict[str, dict[str, Any]] = {
        f"{joint}_{field}": {"target": f"joint/{joint}:{field}"}
        for field in fields
        for joint in arm.joints
    }
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
    """An arm's experiment, rest to rest from home, designed under hard limits; its model and start
    are written beside.

    name: of `ARMS`;  horizon: [s];  friction: dry friction in the model, and unknown;  timestep:
    [s], default: the arm's
    """
    arm, folder = ARMS[name], Path(model_folder)
    path = model_file(arm, name, friction, folder, timestep)
    hold = np.array(mujoco.MjModel.from_xml_path(str(path)).key("home").ctrl)
    control = folder / f"{path.stem}_{horizon:g}s.csv"
    write_control(control, arm.joints, start_control(hold, horizon, arm.amplitude))
    limits: dict[str, Any] = {
        "velocity": arm.velocity,
        "control_rate": arm.rate,
        "clearance": CLEARANCE,
    }
    if arm.force is not None:
        limits["force"] = arm.force
    return Experiment(
        model=path.name,
        directory=folder,
        source=path.stem,
        rate=RATE,
        measure_rate=MEASURED,
        horizon=horizon,
        initial={"keyframe": "home", "control": control.name},
        parameters=parameters(arm, friction),
        noise={f"{kind}:{joint}": sigma for kind, sigma in NOISE.items() for joint in arm.joints},
        cost={"criterion": "E", "control": 0.0},
        limits={**limits, "ignored": arm.overlapping},
        boundary={"start": "rest", "end": "rest"},
    )


def write_control(path: Path, names: tuple[str, ...], control: Array) -> None:
    """A table of t [s] and control: (N, nu), as `initial.control` reads it."""
    with path.open("w", newline="", encoding="utf-8") as file:
        rows = csv.writer(file)
        rows.writerow(["t", *names])
        rows.writerows(
            [f"{k / RATE:.4f}", *(f"{u:.12g}" for u in row)] for k, row in enumerate(control)
        )


def worst_relative_sigma(information: Array, scale: Array) -> float:
    """`1 / sqrt(lambda_min(S I S))` of the information (p, p) that all samples hold together;
    scale: (p,).
    """
    return float(np.linalg.eigvalsh(information * np.outer(scale, scale))[0] ** -0.5)


# what the arms are like
# -----------------------------------------------------------------------------------------------


@dataclass(frozen=True)
class Motion:
    """A simulated motion: qpos, qvel: (n+1, nv), force: (n, nv) [rad, rad/s, N m] at every engine
    step.

    distance: (N,) least at every sample [m];  closest: names of the two bodies that come closest
    """

    qpos: Array
    qvel: Array
    force: Array
    distance: Array
    closest: tuple[str, str]


def pairs(model: Any) -> list[tuple[int, int]]:
    """Pairs of geoms that MuJoCo would let collide: not of one body, not of parent and child, not
    excluded.
    """
    excluded = set(model.exclude_signature.tolist())
    found = []
    for one, other in itertools.combinations(range(model.ngeom), 2):
        bodies = sorted((int(model.geom_bodyid[one]), int(model.geom_bodyid[other])))
        a, b = (int(model.body_weldid[i]) for i in bodies)
        up_a, up_b = (int(model.body_weldid[model.body_parentid[i]]) for i in (a, b))
        kin = a == b or (a != 0 and b != 0 and (up_a == b or up_b == a))
        if not kin and (bodies[0] << 16) + bodies[1] not in excluded:
            found.append((one, other))
    return found


def clearance(model: Any, data: Any, among: list[tuple[int, int]]) -> tuple[float, tuple[str, str]]:
    """Least distance [m] of pairs of geoms at the pose in data, and whose."""
    segment = np.zeros(6)
    found = [mujoco.mj_geomDistance(model, data, one, other, FAR, segment) for one, other in among]
    nearest = among[int(np.argmin(found))]
    one, other = (model.body(int(model.geom_bodyid[g])).name for g in nearest)
    return float(min(found)), (one, other)


def moved(model: Any, start: Array, control: Array, velocity: Array | None = None) -> Motion:
    """Simulate control: (N, nu), held over samples, from start: (nq,) [rad], at rest or at a
    velocity: (nv,) [rad/s].
    """
    data, among = mujoco.MjData(model), pairs(model)
    data.qpos[:] = start
    if velocity is not None:
        data.qvel[:] = velocity
    substeps = round(1.0 / (RATE * model.opt.timestep))
    qpos, qvel, force, near = [start.copy()], [data.qvel.copy()], [], []
    for u in control:
        data.ctrl[:] = u
        for _ in range(substeps):
            mujoco.mj_step(model, data)
            qpos.append(data.qpos.copy())
            qvel.append(data.qvel.copy())
            force.append(data.actuator_force.copy())
        near.append(clearance(model, data, among))
    distance, names = zip(*near, strict=True)
    closest = names[int(np.argmin(distance))]
    return Motion(np.array(qpos), np.array(qvel), np.array(force), np.array(distance), closest)


def margins(e: Experiment, model: Any, control: Array, motion: Motion) -> dict[str, float]:
    """Least distance to each kind of limit as a share of the range's half (of the limit itself for
    the clearance).
    """
    position = model.jnt_range[:, 0], model.jnt_range[:, 1]
    stated = e.limits.force if isinstance(e.limits.force, float) else np.inf
    limits = {"velocity": _each(e.limits.velocity), "control rate": _each(e.limits.control_rate)}
    worst = {
        "position": _inside(motion.qpos, *position),
        "control": _inside(control, model.actuator_ctrlrange[:, 0], model.actuator_ctrlrange[:, 1]),
        "force": _inside(
            motion.force,
            *(s * np.minimum(model.actuator_forcerange[:, 1], stated) for s in (-1.0, 1.0)),
        ),
        "velocity": _inside(motion.qvel, -limits["velocity"], limits["velocity"]),
        "control rate": _inside(
            np.diff(control, axis=0) * RATE, -limits["control rate"], limits["control rate"]
        ),
    }
    return {**worst, "clearance": float(motion.distance.min() / CLEARANCE - 1.0)}


def _each(limit: Any) -> Array:
    """Symmetric limits in the order of the joints, one number where it holds for all."""
    return np.array(list(limit.values()) if isinstance(limit, dict) else [limit])


def _inside(data: Array, low: Array, high: Array) -> float:
    return float((np.minimum(data - low, high - data) / (0.5 * (high - low))).min())


def lifted(model: Any) -> Any:
    """In place: without ranges, clamps and contacts, as a design steps it; without constraints
    where no joint is dry.
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
    """Wall seconds per `mj_step` in a batch on all cores, at the best of some repeats."""
    batch = Batch(model, simulations, cores())
    substeps = round(1.0 / (RATE * model.opt.timestep))
    held = np.ascontiguousarray(
        np.broadcast_to(
            np.repeat(control[:100], substeps, axis=0),
            (simulations, 100 * substeps, control.shape[1]),
        )
    )
    best = np.inf
    for _ in range(repeats):
        batch.bind("qpos")[:], batch.bind("qvel")[:] = start, 0.0
        clock = time.perf_counter()
        batch.rollout(held.shape[1], held)
        best = min(best, time.perf_counter() - clock)
    return float(best / (simulations * held.shape[1]))


def settling(
    model: Any, start: Array, hold: Array, speed: Array, e: Experiment
) -> tuple[float, float]:
    """Seconds until the boundary's tolerances hold for good when the hold meets all joints at full
    speed, and the error left.

    speed: (nv,) [rad/s];  the error: largest of the positions [rad], 2 s later
    """
    motion = moved(model, start, np.tile(hold, (round(2.0 * RATE), 1)), speed)
    error, velocity = np.abs(motion.qpos - start).max(axis=1), np.abs(motion.qvel).max(axis=1)
    outside = np.flatnonzero((error > e.boundary.position) | (velocity > e.boundary.velocity))
    return float((outside[-1] + 1) * model.opt.timestep) if len(outside) else 0.0, float(error[-1])


def prepared(e: Experiment) -> tuple[Any, Array, Array, Array]:
    """The model as it is, start: (nq,), hold: (nu,) and the starting control: (N, nu) of an
    experiment.
    """
    model = mujoco.MjModel.from_xml_path(str(e.directory / e.model))
    key = model.key("home")
    control = np.loadtxt(e.directory / str(e.initial.control), delimiter=",", skiprows=1)[:, 1:]
    return model, np.array(key.qpos), np.array(key.ctrl), control


def described(e: Experiment) -> Iterator[tuple[str, str]]:
    """What an experiment is like, as (what, how much)."""
    model, start, hold, control = prepared(e)
    data = mujoco.MjData(model)
    data.qpos[:] = start
    mujoco.mj_forward(model, data)
    near, whose = clearance(model, data, pairs(model))
    speed = np.broadcast_to(_each(e.limits.velocity), model.nv)
    settled, left = settling(model, start, hold, speed, e)
    motion = moved(model, start, control)
    inside = margins(e, model, control, motion)
    light = lifted(mujoco.MjModel.from_xml_path(str(e.directory / e.model)))
    seconds = step_seconds(light, start, control)
    solver = (
        "off"
        if light.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_CONSTRAINT)
        else "on (dry friction)"
    )
    steps = round(float(e.horizon or 0.0) / model.opt.timestep)
    yield "parameters, samples", f"{len(e.parameters)}, {round(float(e.horizon or 0.0) * RATE)}"
    yield "pairs of geoms looked at", f"{len(pairs(model))}"
    yield "clearance at home", f"{100 * near:.1f} cm ({whose[0]}, {whose[1]})"
    yield "hold minus home, largest", f"{np.abs(hold - start).max():.4f} rad"
    yield (
        "engine step, timestep",
        f"{1e6 * seconds:.2f} µs on {cores()} cores, {1e3 * model.opt.timestep:g} ms",
    )
    yield "one rollout; constraints", f"{1e3 * seconds * steps:.1f} ms; {solver}"
    yield "from full speed to rest within", f"{settled:.2f} s; after 2 s {1e3 * left:.2g} mrad off"
    last = np.abs(motion.qpos[-1] - start).max(), np.abs(motion.qvel[-1]).max()
    yield "the start ends", f"{1e3 * last[0]:.2g} mrad off, {1e3 * last[1]:.2g} mrad/s"
    yield "margins of the start", ", ".join(f"{kind} {value:.0%}" for kind, value in inside.items())


def identifiable(e: Experiment) -> Iterator[tuple[str, str]]:
    """What can be identified along the starting motion, and what no motion shows, as `mjfim check`
    finds it.
    """
    task = DesignTask.resolve(e)
    told = task.plant.derivatives.sensitivity(task.theta, task.initial)
    if told is None:
        raise SystemExit(
            f"{e.source}: the starting motion diverges when the parameters move a little"
        )
    names, scale, information = (
        task.parameters.names,
        task.parameters.scale,
        task.information.matrix(told),
    )
    values, vectors = np.linalg.eigh(information * np.outer(scale, scale))
    yield "worst relative sigma", f"{worst_relative_sigma(information, scale):.3g}"
    yield (
        "smallest eigenvalues",
        ", ".join(f"{v:.3g}" for v in values[:4]) + f"; largest {values[-1]:.2g}",
    )
    for j in range(2):
        largest = np.argsort(-np.abs(vectors[:, j]))[:3]
        yield (
            f"weakest combination {j + 1}",
            " ".join(f"{vectors[i, j]:+.2f} {names[i]}" for i in largest),
        )
    relative = task.information.std(information) / scale
    order = np.argsort(-relative)
    yield (
        "worst parameters, sigma / scale",
        ", ".join(f"{names[i]} {relative[i]:.2g}" for i in order[:3]),
    )
    yield "best", ", ".join(f"{names[i]} {relative[i]:.2g}" for i in order[-2:])
    seen = task.identifiability_test.along(task.initial, told)
    yield "never identifiable", "; ".join(str(group) for group in seen.groups_along_all) or "none"
    yield (
        "not along this motion",
        "; ".join(str(group) for group in seen.groups_along_trajectory) or "none",
    )


def timesteps(name: str, friction: bool, horizon: float, folder: Path) -> Table:
    """How far motions and information at other timesteps are from those at a fine one."""
    title = (
        f"{name}{', dry' if friction else ''}: timesteps against {1e3 * FINE:g} ms, {horizon:g} s"
    )
    table = Table(title=title, title_justify="left")
    for heading in (
        "timestep",
        "largest error of qpos",
        "of qvel",
        "worst relative sigma",
        "µs per second of motion",
    ):
        table.add_column(heading, justify="right")
    reference: tuple[Array, Array] | None = None
    for step in (FINE, 0.001, 0.002, 0.004, 0.005):
        e = experiment(name, horizon, friction, folder / "timesteps", step)
        task = DesignTask.resolve(e)
        sensitivity = task.plant.derivatives.sensitivity(task.theta, task.initial)
        sigma = np.nan if sensitivity is None else _sigma(task, sensitivity)
        q, v = task.initial.qpos, task.initial.qvel
        reference = (q, v) if reference is None else reference
        _, start, _, control = prepared(e)
        light = lifted(mujoco.MjModel.from_xml_path(str(e.directory / e.model)))
        cost = 1e6 * step_seconds(light, start, control, 32, 2) / step
        off = (np.abs(q - reference[0]).max(), np.abs(v - reference[1]).max())
        table.add_row(
            f"{1e3 * step:g} ms",
            f"{off[0]:.1e} rad",
            f"{off[1]:.1e} rad/s",
            f"{sigma:.4g}",
            f"{cost:.0f}",
        )
    return table


def _sigma(task: DesignTask, sensitivity: Sensitivity) -> float:
    return worst_relative_sigma(task.information.matrix(sensitivity), task.parameters.scale)


def main() -> None:
    """Describe the arms and print."""
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
        rows = [
            dict(described(e)) | ({} if args.skip_check else dict(identifiable(e)))
            for e in (experiment(name, horizon, friction, args.folder) for horizon in args.horizons)
        ]
        table = Table(title=f"{name}, {'dry' if friction else 'smooth'}", title_justify="left")
        for heading in ("", *(f"{horizon:g} s" for horizon in args.horizons)):
            table.add_column(heading)
        for what in rows[0]:
            table.add_row(what, *(row[what] for row in rows))
        console.print(table)
        if args.timesteps:
            console.print(timesteps(name, friction, args.horizons[0], args.folder))

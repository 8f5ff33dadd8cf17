"""Play design.csv in plain MuJoCo, and compare every engine step with the limits.

Nothing of the package is used here: the judge of a design must not share its mistakes.

An acceleration is the change of the velocity over an engine step, divided by the timestep. A force
is whatever MuJoCo shows: what force sensors read after a step, what the fields of MjData hold
then, and what sensors read after `mj_forward` at the state after the step.
"""

from __future__ import annotations

import copy
import csv
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path

import mujoco
import numpy as np

Range = tuple[float, float]

# Excess beyond a limit that rounding explains, as a fraction of half of the range. The feedback
# adds the rounding of the planned states, which unstable plants make larger.
ROUNDING = 1e-9
ROUNDING_WITH_FEEDBACK = 1e-6


# Name of the clearance, of which there is only one: its range is from it to twice of it.
NEAREST = "nearest pair"

# Parts of the position and of the velocity of a ball joint and of a free joint.
TURN = (".rx", ".ry", ".rz")
PLACE = (".x", ".y", ".z")
QUATERNION = (".qw", ".qx", ".qy", ".qz")
PARTS = {
    int(mujoco.mjtJoint.mjJNT_BALL): (QUATERNION, TURN),
    int(mujoco.mjtJoint.mjJNT_FREE): ((*PLACE, *QUATERNION), (*PLACE, *TURN)),
}


def model_with_force_sensors(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a model with sensors of forces and lengths; nothing else changes.

    The sensors show the forces of the actuators, the forces on the slides and hinges, the forces on
    the tendons and the lengths of the tendons, each in the order of the model.
    """
    kinds, objects = mujoco.mjtSensor, mujoco.mjtObj
    for actuator in spec.actuators:
        sensor = spec.add_sensor(type=kinds.mjSENS_ACTUATORFRC, objtype=objects.mjOBJ_ACTUATOR)
        sensor.objname = actuator.name
    scalar = (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE)
    for joint in (joint for joint in spec.joints if joint.type in scalar):
        sensor = spec.add_sensor(type=kinds.mjSENS_JOINTACTFRC, objtype=objects.mjOBJ_JOINT)
        sensor.objname = joint.name
    for kind in (kinds.mjSENS_TENDONACTFRC, kinds.mjSENS_TENDONPOS):
        for tendon in spec.tendons:
            sensor = spec.add_sensor(type=kind, objtype=objects.mjOBJ_TENDON)
            sensor.objname = tendon.name
    return spec.compile()


@dataclass(kw_only=True)
class Excess:
    """Largest excess beyond each limit.

    Attributes:
        ranges: Range by kind and name of every limit.
        found: Largest excess by kind and name, as a fraction of half of the range.
    """

    ranges: dict[tuple[str, str], Range]
    found: dict[tuple[str, str], float] = field(default_factory=dict)

    def see(self, kind: str, name: str, value: float) -> None:
        """Compare a value with its limit, if it has one; NaN is outside of every limit."""
        if (kind, name) not in self.ranges:
            return
        low, high = self.ranges[kind, name]
        excess = max(low - value, value - high) / (0.5 * (high - low))
        worst = self.found.get((kind, name), -np.inf)
        self.found[kind, name] = np.inf if np.isnan(excess) else max(worst, excess)

    def sentences(self, tolerance: float) -> list[str]:
        """Describe every limit that is violated by more than a tolerance."""
        return [
            f"{kind} of {name} is {excess:.3g} half ranges beyond {self.ranges[kind, name]}"
            for (kind, name), excess in self.found.items()
            if excess > tolerance
        ]


def read_rows(path: Path) -> list[dict[str, float]]:
    """Read the rows of design.csv or reference.csv; an empty field is NaN."""
    with path.open(newline="", encoding="utf-8") as stream:
        rows = csv.DictReader(stream)
        return [{name: float(text or "nan") for name, text in row.items()} for row in rows]


def play(
    model: mujoco.MjModel,
    rows: list[dict[str, float]],
    ranges: dict[tuple[str, str], Range],
    period: float,
    feedback: bool = False,
    *,
    ignored: tuple[tuple[str, str], ...] = (),
) -> Excess:
    """Play the rows from the state of the first one, and observe every engine step.

    Args:
        model: The model of `model_with_force_sensors`.
        rows: Rows of design.csv.
        ranges: Range by kind and name of every limit; the kinds "end_position" and "end_velocity"
            are deviations of the final state from the initial one, and "clearance" is the smallest
            distance of two geoms.
        period: Time from row to row, over which the rate of a control is taken [s].
        feedback: True adds the gains times the deviation from the planned state.
        ignored: Pairs of bodies whose distance does not matter.

    Returns:
        The largest excess beyond every limit.
    """
    excess = Excess(ranges=ranges)
    data, after = mujoco.MjData(model), mujoco.MjData(model)
    layout = Layout.of(model)
    least = ranges.get(("clearance", NEAREST))
    proximity = None if least is None else Proximity(model, 2.0 * least[0], ignored)
    start = layout.planned(rows[0])
    data.qpos[:], data.qvel[:], data.act[:] = start
    before: np.ndarray | None = None

    for row, following in pairwise(rows):
        ctrl = np.array([row[f"ctrl:{name}"] for name in layout.drives])
        if feedback:
            ctrl += layout.gain(row) @ layout.deviation(layout.planned(row), data)
        for i, name in enumerate(layout.drives):
            excess.see("control", name, float(ctrl[i]))
            if before is not None:
                excess.see("control_rate", name, float((ctrl[i] - before[i]) / period))
        before = ctrl

        data.ctrl[:] = ctrl
        for _ in range(round((following["t"] - row["t"]) / model.opt.timestep)):
            _step((data, after), layout, excess)
            if proximity is not None:
                excess.see("clearance", NEAREST, proximity(data.qpos))

    moved = -layout.deviation(start, data)
    for i, name in enumerate(layout.freedoms):
        excess.see("end_position", name, float(moved[i]))
        excess.see("end_velocity", name, float(moved[model.nv + i]))
    return excess


def read_reference(rows: list[dict[str, float]], ranges: dict[tuple[str, str], Range]) -> Excess:
    """Compare every value of reference.csv with its limit.

    Args:
        rows: Rows of reference.csv.
        ranges: Range by kind and name of every limit.

    Returns:
        The largest excess beyond every limit.
    """
    excess = Excess(ranges=ranges)
    kinds = {
        "qpos": "position",
        "qvel": "velocity",
        "qacc": "acceleration",
        "force": "joint_force",
    }
    for row in rows:
        for column, value in row.items():
            field_name, _, joint = column.partition(":")
            excess.see(kinds.get(field_name, ""), joint, value)
    return excess


@dataclass(frozen=True, kw_only=True)
class TurningJoint:
    """A ball joint or a free joint; the ranges of its speeds and angles are symmetric about 0.

    Attributes:
        name: Its name.
        is_free: True for a free joint.
        q: Its address in qpos.
        v: Its address in qvel.
        body: Number of the body that it moves.
        reference: (3, 3) orientation of the body in its parent, in the reference position.
        up: (3,) direction in the body that is upward there, against gravity.
    """

    name: str
    is_free: bool
    q: int
    v: int
    body: int
    reference: np.ndarray
    up: np.ndarray

    @classmethod
    def of(cls, model: mujoco.MjModel, joint: int) -> TurningJoint:
        """The joint with a number."""
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        body = int(model.jnt_bodyid[joint])
        upward = -model.opt.gravity if model.opt.gravity.any() else np.array([0.0, 0.0, 1.0])
        return cls(
            name=model.joint(joint).name,
            is_free=int(model.jnt_type[joint]) == int(mujoco.mjtJoint.mjJNT_FREE),
            q=int(model.jnt_qposadr[joint]),
            v=int(model.jnt_dofadr[joint]),
            body=body,
            reference=_in_parent(model, data, body),
            up=data.xmat[body].reshape(3, 3).T @ (upward / np.linalg.norm(upward)),
        )

    def see(self, data: mujoco.MjData, acceleration: np.ndarray, excess: Excess) -> None:
        """Compare its motion with its limits, after `mj_kinematics`.

        Args:
            data: The simulation.
            acceleration: (nv,) accelerations.
            excess: The limits.
        """
        name = self.name
        moved, changed = data.qvel[self.v : self.v + 3], acceleration[self.v : self.v + 3]
        excess.see("velocity", name, float(np.linalg.norm(moved)))
        excess.see("acceleration", name, float(np.linalg.norm(changed)))

        turned = self.reference.T @ _in_parent(data.model, data, self.body)
        excess.see("tilt", name, _angle_between(turned @ self.up, self.up))
        spin = moved
        if self.is_free:
            spin = data.qvel[self.v + 3 : self.v + 6]
            for i, part in enumerate(PLACE):
                excess.see("position", f"{name}{part}", float(data.qpos[self.q + i]))
                excess.see("velocity", f"{name}{part}", float(moved[i]))
                excess.see("acceleration", f"{name}{part}", float(changed[i]))
        else:
            # The antisymmetric part of a rotation has the norm of its sine, the trace its cosine.
            sine = np.linalg.norm(turned - turned.T) / np.sqrt(8.0)
            angle = np.arctan2(sine, 0.5 * (np.trace(turned) - 1.0))
            excess.see("position", name, float(angle))
        excess.see("angular_velocity", name, float(np.linalg.norm(spin)))
        for i, part in enumerate(TURN):
            excess.see("angular_velocity", f"{name}{part}", float(spin[i]))


def _in_parent(model: mujoco.MjModel, data: mujoco.MjData, body: int) -> np.ndarray:
    """(3, 3) orientation of a body in its parent."""
    parent = data.xmat[model.body_parentid[body]].reshape(3, 3)
    return parent.T @ data.xmat[body].reshape(3, 3)


def _angle_between(a: np.ndarray, b: np.ndarray) -> float:
    """Angle between two unit vectors [rad]."""
    return float(2.0 * np.arctan2(np.linalg.norm(a - b), np.linalg.norm(a + b)))


@dataclass(frozen=True, kw_only=True)
class Layout:
    """Names of the columns of design.csv, and where MuJoCo keeps them.

    Attributes:
        model: The model.
        drives: Names of the controls.
        scalar: Names of the slides and hinges, with their numbers.
        turning: The ball and free joints.
        tendons: Names of the tendons.
        freedoms: Names of the degrees of freedom.
        columns: Columns of qpos, of qvel and of act.
    """

    model: mujoco.MjModel
    drives: list[str]
    scalar: list[tuple[str, int]]
    turning: list[TurningJoint]
    tendons: list[str]
    freedoms: list[str]
    columns: tuple[list[str], list[str], list[str]]

    @classmethod
    def of(cls, model: mujoco.MjModel) -> Layout:
        """The layout of a model."""
        joints = [(model.joint(i).name, i) for i in range(model.njnt)]
        drives = [model.actuator(i).name for i in range(model.nu)]
        filtered = [name for name in drives if model.actuator(name).actadr[0] >= 0]
        positions, freedoms = [], []
        for name, i in joints:
            position, velocity = PARTS.get(int(model.jnt_type[i]), (("",), ("",)))
            positions += [f"qpos:{name}{part}" for part in position]
            freedoms += [f"{name}{part}" for part in velocity]
        return cls(
            model=model,
            drives=drives,
            scalar=[(name, i) for name, i in joints if int(model.jnt_type[i]) not in PARTS],
            turning=[
                TurningJoint.of(model, i) for _, i in joints if int(model.jnt_type[i]) in PARTS
            ],
            tendons=[model.tendon(i).name for i in range(model.ntendon)],
            freedoms=freedoms,
            columns=(
                positions,
                [f"qvel:{name}" for name in freedoms],
                [f"act:{name}" for name in filtered],
            ),
        )

    def planned(self, row: dict[str, float]) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Position, velocity and activation of a row."""
        qpos, qvel, act = (np.array([row[name] for name in part]) for part in self.columns)
        return qpos, qvel, act

    def deviation(
        self, planned: tuple[np.ndarray, np.ndarray, np.ndarray], data: mujoco.MjData
    ) -> np.ndarray:
        """(2 nv + na,) planned state minus the state of a simulation; rotations as vectors."""
        qpos, qvel, act = planned
        moved = np.zeros(self.model.nv)
        mujoco.mj_differentiatePos(self.model, moved, 1.0, data.qpos, qpos)
        return np.concatenate([moved, qvel - data.qvel, act - data.act])

    def gain(self, row: dict[str, float]) -> np.ndarray:
        """(nu, 2 nv + na) gains of a row."""
        names = [f"qpos:{name}" for name in self.freedoms] + [*self.columns[1], *self.columns[2]]
        return np.array([[row[f"gain:{drive}:{name}"] for name in names] for drive in self.drives])


def _step(
    simulations: tuple[mujoco.MjData, mujoco.MjData],
    layout: Layout,
    excess: Excess,
) -> None:
    """Do one engine step of the first simulation, and compare what it shows with the limits.

    The second simulation shows the forces at the state after the step, with the control of the
    step.
    """
    data, after = simulations
    model = data.model
    velocity = data.qvel.copy()
    mujoco.mj_step(model, data)
    acceleration = (data.qvel - velocity) / model.opt.timestep

    for name, i in layout.scalar:
        q, v = model.jnt_qposadr[i], model.jnt_dofadr[i]
        excess.see("position", name, float(data.qpos[q]))
        excess.see("velocity", name, float(data.qvel[v]))
        excess.see("acceleration", name, float(acceleration[v]))
    if layout.turning:
        mujoco.mj_kinematics(model, data)
    for joint in layout.turning:
        joint.see(data, acceleration, excess)

    after.qpos[:], after.qvel[:], after.act[:] = data.qpos, data.qvel, data.act
    after.ctrl[:] = data.ctrl
    mujoco.mj_forward(model, after)

    dofs = [int(model.jnt_dofadr[i]) for _, i in layout.scalar]
    pulled = np.zeros(model.ntendon)
    for i in np.flatnonzero(model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_TENDON)):
        pulled[model.actuator_trnid[i, 0]] += data.actuator_force[i]
    fields = np.concatenate(
        [data.actuator_force, data.qfrc_actuator[dofs], pulled, data.ten_length]
    )
    limited = [("force", name) for name in layout.drives]
    limited += [("joint_force", name) for name, _ in layout.scalar]
    limited += [("tendon_force", name) for name in layout.tendons]
    limited += [("tendon_length", name) for name in layout.tendons]
    for shown in (fields, data.sensordata, after.sensordata):
        for (kind, name), value in zip(limited, shown.tolist(), strict=True):
            excess.see(kind, name, value)


class Proximity:
    """Smallest distance between the geoms that MuJoCo lets collide.

    Contacts are found by MuJoCo itself: in a copy of the model in which they begin at a larger
    distance.
    """

    def __init__(
        self, model: mujoco.MjModel, reach: float, ignored: tuple[tuple[str, str], ...]
    ) -> None:
        """Prepare the copy.

        Args:
            model: The model.
            reach: Distance below which geoms are seen [m].
            ignored: Pairs of bodies whose distance does not matter.
        """
        self._model = copy.copy(model)
        self._model.geom_margin[:] = self._model.body_margin[:] = reach
        self._model.geom_gap[:] = 0.0
        self._model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
        self._data = mujoco.MjData(self._model)
        self._reach = reach
        self._ignored = [{model.body(name).id for name in pair} for pair in ignored]

    def __call__(self, qpos: np.ndarray) -> float:
        """Smallest distance at a position [m], the reach where nothing is nearer."""
        self._data.qpos[:] = qpos
        mujoco.mj_fwdPosition(self._model, self._data)
        contacts = self._data.contact
        bodies = self._model.geom_bodyid[contacts.geom]
        counted = [set(pair) not in self._ignored for pair in bodies.tolist()]
        return float(contacts.dist[counted].min(initial=self._reach))

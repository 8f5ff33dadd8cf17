"""The judge of limits: it plays design.csv in plain MuJoCo, and compares every engine step.

Nothing of the package is used here: the judge of a design must not share its mistakes.

An acceleration is the change of the velocity over an engine step, divided by the timestep. A force
is whatever MuJoCo shows: what the fields of MjData hold after `mj_step`, and after `mj_forward` at
the states before and after the step.
"""

from __future__ import annotations

import copy
import csv
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from itertools import pairwise
from pathlib import Path
from typing import Any

import mujoco
import numpy as np

Ranges = dict[tuple[str, str], tuple[float, float]]
Row = dict[str, float]
State = tuple[np.ndarray, np.ndarray, np.ndarray]
Pairs = tuple[tuple[str, str], ...]

# Excess beyond a limit that rounding explains, as a fraction of half of the range. The feedback
# adds the rounding of the planned states, which unstable plants make larger.
ROUNDING = 1e-9
ROUNDING_WITH_FEEDBACK = 1e-6


# Kinds that are compared at the states before and after each engine step, too.
KINDS_OF_STATES = {"force", "joint_force", "tendon_force", "tendon_length"}

# Keys of a table `limits` that are no ranges of named quantities.
NO_RANGES = {"bandwidth", "clearance", "enforce", "floor", "ignored", "reserve"}

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


@dataclass(kw_only=True)
class Excess:
    """Largest excess beyond each limit.

    Attributes:
        ranges: Range by kind and name of every limit.
        found: Largest excess by kind and name, as a fraction of half of the range.
    """

    ranges: Ranges
    found: dict[tuple[str, str], float] = field(default_factory=dict)

    def see(self, kind: str, name: str, value: float) -> None:
        """Compare a value with its limit, if it has one; NaN is outside of every limit."""
        if (kind, name) not in self.ranges:
            return
        low, high = self.ranges[kind, name]
        excess = max(low - value, value - high) / (0.5 * (high - low))
        worst = self.found.get((kind, name), -np.inf)
        self.found[kind, name] = np.inf if np.isnan(excess) else max(worst, excess)

    def see_all(self, kind: str, names: list[str], values: np.ndarray) -> None:
        """Compare a value of each name with its limit."""
        for name, value in zip(names, values.tolist(), strict=True):
            self.see(kind, name, value)

    def sentences(self, tolerance: float) -> list[str]:
        """Describe every limit that is violated by more than a tolerance."""
        return [
            f"{kind} of {name} is {excess:.3g} half ranges beyond {self.ranges[kind, name]}"
            for (kind, name), excess in self.found.items()
            if excess > tolerance
        ]


def stated_ranges(limits: Mapping[str, Any], joints: Sequence[str]) -> Ranges:
    """Range by kind and name of the limits that a table `limits` states.

    One number holds for all joints. The three ranges of a free joint have the names of its
    coordinates.
    """
    ranges: Ranges = {}
    for kind, value in limits.items():
        if kind in NO_RANGES:
            continue
        by_name = value if isinstance(value, dict) else dict.fromkeys(joints, value)
        for name, bounds in by_name.items():
            is_box = np.ndim(bounds) == 2
            parts = zip(PLACE, bounds, strict=True) if is_box else [("", bounds)]
            for part, ends in parts:
                low, high = (-ends, ends) if np.isscalar(ends) else ends
                ranges[kind, f"{name}{part}"] = (low, high)
    return ranges


def read_rows(path: Path) -> list[Row]:
    """Read the rows of design.csv or reference.csv; an empty field is NaN."""
    with path.open(newline="", encoding="utf-8") as stream:
        rows = csv.DictReader(stream)
        return [{name: float(text or "nan") for name, text in row.items()} for row in rows]


def play(
    model: mujoco.MjModel,
    rows: list[Row],
    ranges: Ranges,
    period: float,
    feedback: bool = False,
    *,
    ignored: Pairs = (),
) -> Excess:
    """Play the rows from the state of the first one, and observe every engine step.

    Args:
        model: The model.
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
    excess, layout = Excess(ranges=ranges), Layout(model)
    data, still = mujoco.MjData(model), mujoco.MjData(model)
    least = ranges.get(("clearance", NEAREST))
    distance = None if least is None else proximity(model, 2.0 * least[0], ignored)
    start = layout.planned(rows[0])
    data.qpos[:], data.qvel[:], data.act[:] = start
    before: np.ndarray | None = None
    sees_states = not KINDS_OF_STATES.isdisjoint(kind for kind, _ in ranges)

    def look_at_state() -> None:
        """Compare the forces at the present state with the limits."""
        if not sees_states:
            return
        still.qpos[:], still.qvel[:], still.act[:] = data.qpos, data.qvel, data.act
        still.ctrl[:] = data.ctrl
        mujoco.mj_forward(model, still)
        layout.see_forces(still, excess)

    for row, following in pairwise(rows):
        ctrl = np.array([row[f"ctrl:{name}"] for name in layout.drives])
        if feedback:
            ctrl += layout.gain(row) @ layout.deviation(layout.planned(row), data)
        excess.see_all("control", layout.drives, ctrl)
        if before is not None:
            excess.see_all("control_rate", layout.drives, (ctrl - before) / period)
        before = ctrl

        data.ctrl[:] = ctrl
        look_at_state()
        for _ in range(round((following["t"] - row["t"]) / model.opt.timestep)):
            velocity = data.qvel.copy()
            mujoco.mj_step(model, data)
            layout.see_forces(data, excess)
            layout.see_motion(data, (data.qvel - velocity) / model.opt.timestep, excess)
            look_at_state()
            if distance is not None:
                excess.see("clearance", NEAREST, distance(data.qpos))

    moved = -layout.deviation(start, data)
    excess.see_all("end_position", layout.freedoms, moved[: model.nv])
    excess.see_all("end_velocity", layout.freedoms, moved[model.nv : 2 * model.nv])
    return excess


def read_reference(rows: list[Row], ranges: Ranges) -> Excess:
    """The largest excess of the values of reference.csv beyond every limit."""
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


class Layout:
    """Names of the columns of design.csv, and where MuJoCo keeps them.

    An element without a name is called by its number.

    Attributes:
        joints: Names of the joints.
        tendons: Names of the tendons.
        actuators: Names of the actuators.
        drives: Names of the controls, of which an actuator may have several.
        freedoms: Names of the degrees of freedom.
        columns: Columns of qpos, of qvel and of act.
    """

    def __init__(self, model: mujoco.MjModel) -> None:
        """The layout of a model."""
        self.model = model
        self.actuators, self.tendons, self.joints = (
            [element(i).name or str(i) for i in range(count)]
            for element, count in (
                (model.actuator, model.nactuator),
                (model.tendon, model.ntendon),
                (model.joint, model.njnt),
            )
        )
        self.drives = [
            f"{name}[{k}]" if count > 1 else name
            for name, count in zip(self.actuators, model.actuator_ctrlnum, strict=True)
            for k in range(count)
        ]
        joints = [(name, model.joint(i)) for i, name in enumerate(self.joints)]
        self.turning = [each for each in joints if int(each[1].type[0]) in PARTS]
        self.scalar = [each for each in joints if int(each[1].type[0]) not in PARTS]
        positions, self.freedoms = [], []
        for name, joint in joints:
            position, velocity = PARTS.get(int(joint.type[0]), (("",), ("",)))
            positions += [f"qpos:{name}{part}" for part in position]
            self.freedoms += [f"{name}{part}" for part in velocity]
        self.columns = (
            positions,
            [f"qvel:{name}" for name in self.freedoms],
            [
                f"act:{name}"
                for name, first in zip(self.actuators, model.actuator_actadr, strict=True)
                if first >= 0
            ],
        )

        # The reference position, and the direction that is upward, against gravity.
        self.reference = mujoco.MjData(model)
        mujoco.mj_kinematics(model, self.reference)
        upward = -model.opt.gravity if model.opt.gravity.any() else np.array([0.0, 0.0, 1.0])
        self.upward = upward / np.linalg.norm(upward)

    def planned(self, row: Row) -> State:
        """Position, velocity and activation of a row."""
        qpos, qvel, act = (np.array([row[name] for name in part]) for part in self.columns)
        return qpos, qvel, act

    def deviation(self, planned: State, data: mujoco.MjData) -> np.ndarray:
        """(2 nv + na,) planned state minus the state of a simulation; rotations as vectors."""
        qpos, qvel, act = planned
        moved = np.zeros(self.model.nv)
        mujoco.mj_differentiatePos(self.model, moved, 1.0, data.qpos, qpos)
        return np.concatenate([moved, qvel - data.qvel, act - data.act])

    def gain(self, row: Row) -> np.ndarray:
        """(nu, 2 nv + na) gains of a row."""
        names = [f"qpos:{name}" for name in self.freedoms] + [*self.columns[1], *self.columns[2]]
        return np.array([[row[f"gain:{drive}:{name}"] for name in names] for drive in self.drives])

    def see_forces(self, data: mujoco.MjData, excess: Excess) -> None:
        """Compare the forces and the lengths of tendons with their limits."""
        pulled = np.zeros(self.model.ntendon)
        for i, name in enumerate(self.actuators):
            if self.model.actuator_outnum[i] != 1:
                continue
            force = data.actuator_force[self.model.actuator_outadr[i]]
            excess.see("force", name, force)
            if self.model.actuator_trntype[i] == int(mujoco.mjtTrn.mjTRN_TENDON):
                pulled[self.model.actuator_trnid[i, 0]] += force
        for name, joint in self.scalar:
            excess.see("joint_force", name, data.qfrc_actuator[joint.dofadr[0]])
        excess.see_all("tendon_force", self.tendons, pulled)
        excess.see_all("tendon_length", self.tendons, data.ten_length)

    def see_motion(self, data: mujoco.MjData, acceleration: np.ndarray, excess: Excess) -> None:
        """Compare the motion of all joints with its limits."""
        for name, joint in self.scalar:
            q, v = int(joint.qposadr[0]), int(joint.dofadr[0])
            excess.see("position", name, data.qpos[q])
            excess.see("velocity", name, data.qvel[v])
            excess.see("acceleration", name, acceleration[v])
        if self.turning:
            mujoco.mj_kinematics(self.model, data)
        for name, joint in self.turning:
            self._see_turning(name, joint, data, acceleration, excess)

    def _see_turning(
        self, name: str, joint: Any, data: mujoco.MjData, acceleration: np.ndarray, excess: Excess
    ) -> None:
        """Compare the motion of a ball joint or a free joint with its limits, which for speeds and
        angles are symmetric about 0.
        """
        q, v = int(joint.qposadr[0]), int(joint.dofadr[0])
        moved, changed = data.qvel[v : v + 3], acceleration[v : v + 3]
        excess.see("velocity", name, np.linalg.norm(moved))
        excess.see("acceleration", name, np.linalg.norm(changed))

        body = int(joint.bodyid[0])
        turned = self._in_parent(self.reference, body).T @ self._in_parent(data, body)
        up = self.reference.xmat[body].reshape(3, 3).T @ self.upward
        tilted = turned @ up
        # The angle between two unit vectors.
        tilt = 2.0 * np.arctan2(np.linalg.norm(tilted - up), np.linalg.norm(tilted + up))
        excess.see("tilt", name, float(tilt))
        spin = moved
        if int(joint.type[0]) == int(mujoco.mjtJoint.mjJNT_FREE):
            spin = data.qvel[v + 3 : v + 6]
            places = [f"{name}{part}" for part in PLACE]
            excess.see_all("position", places, data.qpos[q : q + 3])
            excess.see_all("velocity", places, moved)
            excess.see_all("acceleration", places, changed)
        else:
            # The antisymmetric part of a rotation has the norm of its sine, the trace its cosine.
            sine = np.linalg.norm(turned - turned.T) / np.sqrt(8.0)
            angle = np.arctan2(sine, 0.5 * (np.trace(turned) - 1.0))
            excess.see("position", name, float(angle))
        excess.see("angular_velocity", name, np.linalg.norm(spin))
        excess.see_all("angular_velocity", [f"{name}{part}" for part in TURN], spin)

    def _in_parent(self, data: mujoco.MjData, body: int) -> np.ndarray:
        """(3, 3) orientation of a body in its parent."""
        parent = data.xmat[self.model.body_parentid[body]].reshape(3, 3)
        return parent.T @ data.xmat[body].reshape(3, 3)


def proximity(model: mujoco.MjModel, reach: float, ignored: Pairs) -> Callable[[np.ndarray], float]:
    """Smallest distance between the geoms that MuJoCo lets collide, as a function of the position.

    Contacts are found by MuJoCo itself: in a copy of the model in which they begin at a larger
    distance.

    Args:
        model: The model.
        reach: Distance below which geoms are seen, which is returned where nothing is nearer [m].
        ignored: Pairs of bodies whose distance does not matter.
    """
    model = copy.copy(model)
    model.geom_margin[:] = model.body_margin[:] = reach
    model.geom_gap[:] = 0.0
    model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_CONTACT)
    data = mujoco.MjData(model)
    pairs = [{model.body(name).id for name in pair} for pair in ignored]

    def distance(qpos: np.ndarray) -> float:
        """Smallest distance at a position [m]."""
        data.qpos[:] = qpos
        mujoco.mj_fwdPosition(model, data)
        bodies = model.geom_bodyid[data.contact.geom]
        counted = [set(pair) not in pairs for pair in bodies.tolist()]
        return data.contact.dist[counted].min(initial=reach)

    return distance

"""Play design.csv in plain MuJoCo, and compare every engine step with the limits.

Nothing of the package is used here: the judge of a design must not share its mistakes.

An acceleration is the change of the velocity over an engine step, divided by the timestep. A force
is whatever MuJoCo shows: what force sensors read after a step, what the fields of MjData hold
then, and what sensors read after `mj_forward` at the state after the step.
"""

from __future__ import annotations

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


def model_with_force_sensors(spec: mujoco.MjSpec) -> mujoco.MjModel:
    """Compile a model with a force sensor for each actuator and each joint; nothing else changes.

    The sensors of the actuators come first, in the order of the actuators; then those of the
    joints.
    """
    kinds, objects = mujoco.mjtSensor, mujoco.mjtObj
    for actuator in spec.actuators:
        sensor = spec.add_sensor(type=kinds.mjSENS_ACTUATORFRC, objtype=objects.mjOBJ_ACTUATOR)
        sensor.objname = actuator.name
    for joint in spec.joints:
        sensor = spec.add_sensor(type=kinds.mjSENS_JOINTACTFRC, objtype=objects.mjOBJ_JOINT)
        sensor.objname = joint.name
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
) -> Excess:
    """Play the rows from the state of the first one, and observe every engine step.

    Args:
        model: The model of `model_with_force_sensors`; all joints are hinges or slides.
        rows: Rows of design.csv.
        ranges: Range by kind and name of every limit; the kinds "end_position" and "end_velocity"
            are deviations of the final state from the initial one.
        period: Time from row to row, over which the rate of a control is taken [s].
        feedback: True adds the gains times the deviation from the planned state.

    Returns:
        The largest excess beyond every limit.
    """
    excess = Excess(ranges=ranges)
    data, after = mujoco.MjData(model), mujoco.MjData(model)
    joints = [model.joint(i).name for i in range(model.njnt)]
    drives = [model.actuator(i).name for i in range(model.nu)]
    filtered = [drives[i] for i in range(model.nu) if model.actuator(i).actadr[0] >= 0]
    columns = [f"qpos:{j}" for j in joints] + [f"qvel:{j}" for j in joints]
    columns += [f"act:{name}" for name in filtered]
    controls = [f"ctrl:{name}" for name in drives]

    first = np.array([rows[0][name] for name in columns])
    data.qpos[:], data.qvel[:], data.act[:] = np.split(first, [model.nq, model.nq + model.nv])
    before: np.ndarray | None = None

    for row, following in pairwise(rows):
        ctrl = np.array([row[name] for name in controls])
        if feedback:
            ctrl += _feedback(
                row, drives, columns, np.concatenate([data.qpos, data.qvel, data.act])
            )
        for i, name in enumerate(drives):
            excess.see("control", name, float(ctrl[i]))
            if before is not None:
                excess.see("control_rate", name, float((ctrl[i] - before[i]) / period))
        before = ctrl

        data.ctrl[:] = ctrl
        for _ in range(round((following["t"] - row["t"]) / model.opt.timestep)):
            _step((data, after), joints, drives, excess)

    for i, name in enumerate(joints):
        excess.see("end_position", name, float(data.qpos[i] - first[i]))
        excess.see("end_velocity", name, float(data.qvel[i] - first[model.nq + i]))
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


def _step(
    simulations: tuple[mujoco.MjData, mujoco.MjData],
    joints: list[str],
    drives: list[str],
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

    for i, name in enumerate(joints):
        excess.see("position", name, float(data.qpos[i]))
        excess.see("velocity", name, float(data.qvel[i]))
        excess.see("acceleration", name, float(acceleration[i]))

    after.qpos[:], after.qvel[:], after.act[:] = data.qpos, data.qvel, data.act
    after.ctrl[:] = data.ctrl
    mujoco.mj_forward(model, after)

    fields = np.concatenate([data.actuator_force, data.qfrc_actuator])
    limited = [("force", name) for name in drives] + [("joint_force", name) for name in joints]
    for shown in (fields, data.sensordata, after.sensordata):
        for (kind, name), value in zip(limited, shown.tolist(), strict=True):
            excess.see(kind, name, value)


def _feedback(
    row: dict[str, float], drives: list[str], columns: list[str], measured: np.ndarray
) -> np.ndarray:
    """(nu,) gains of a row times the deviation from its planned state."""
    gain = np.array([[row[f"gain:{drive}:{name}"] for name in columns] for drive in drives])
    planned = np.array([row[name] for name in columns])
    return gain @ (planned - measured)

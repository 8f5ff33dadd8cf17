"""A design as a joint trajectory of ROS 2, which a trajectory controller plays.

The points are the rows of `reference.csv`. For joints with a motor they hold the planned motion and
the force that belongs to it. For joints with a position servo, the command of the servo is the
control of the design, so the positions are these commands, and there are no velocities.
"""

from __future__ import annotations

import json
from collections.abc import Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Literal, get_args

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError
from mjfim.files import replacing
from mjfim.output.robot.options import chosen
from mjfim.output.robot.plan import Drive, DriveKind, RobotPlan

# What the positions of a trajectory are: the planned motion, or the commands of position servos.
Positions = Literal["motion", "command"]

# Nanoseconds per second.
NANOSECONDS = 1_000_000_000

# Significant digits of the numbers in a YAML file.
DIGITS = 12

# Final speed that counts as rest, relative to the largest speed of the joint.
REST = 1e-6

# Topic on which a trajectory controller of ros2_control listens.
TRAJECTORY_TOPIC = "/joint_trajectory_controller/joint_trajectory"

# Type of the message.
TRAJECTORY_TYPE = "trajectory_msgs/msg/JointTrajectory"


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTrajectory:
    """The contents of a message `trajectory_msgs/JointTrajectory`.

    Attributes:
        joints: Names of the n joints.
        nanoseconds: (M+1,) times from the start [ns].
        positions: (M+1, n) positions [m or rad].
        velocities: (M+1, n) velocities [m/s or rad/s], or None.
        accelerations: (M+1, n) accelerations [m/s² or rad/s²], or None.
        effort: (M+1, n) forces of the motors [N or N m], or None.
        content: What the positions are.
    """

    joints: tuple[str, ...]
    nanoseconds: tuple[int, ...]
    positions: Array
    velocities: Array | None
    accelerations: Array | None
    effort: Array | None
    content: Positions

    def fields(self) -> dict[str, Array]:
        """The fields of a point that are not empty, (M+1, n) by name."""
        fields = {
            "positions": self.positions,
            "velocities": self.velocities,
            "accelerations": self.accelerations,
            "effort": self.effort,
        }
        return {name: values for name, values in fields.items() if values is not None}


def joint_trajectory(plan: RobotPlan, positions: str | None = None) -> JointTrajectory:
    """Make a joint trajectory of a design.

    Args:
        plan: The design.
        positions: `motion` for the planned motion, `command` for the commands of position servos;
            default: the commands where every driven joint has a position servo.

    Returns:
        The trajectory of all joints on which an actuator acts.

    Raises:
        ExperimentError: No actuator acts on a joint, or there are no position servos whose commands
            are wanted.
    """
    by_joint = _drives_by_joint(plan)
    are_servos = all(_is_servo(drives) for drives in by_joint.values())
    content = _content(positions, are_servos)
    joints = tuple(by_joint)
    nanoseconds = tuple(round(t * NANOSECONDS) for t in plan.playback.t.tolist())

    if content == "command":
        servos = [drives[0] for drives in by_joint.values()]
        return JointTrajectory(
            joints=joints,
            nanoseconds=nanoseconds,
            positions=np.column_stack([_command(plan, servo) for servo in servos]),
            velocities=None,
            accelerations=None,
            effort=None,
            content="command",
        )

    are_motors = all(_are_motors(drives) for drives in by_joint.values())
    return JointTrajectory(
        joints=joints,
        nanoseconds=nanoseconds,
        positions=_columns(plan, "qpos", joints),
        velocities=_columns(plan, "qvel", joints),
        accelerations=_columns(plan, "qacc", joints),
        effort=_columns(plan, "force", joints) if are_motors else None,
        content="motion",
    )


def trajectory_remarks(trajectory: JointTrajectory) -> list[str]:
    """Sentences that the user of a trajectory needs."""
    remarks = []
    if trajectory.content == "command":
        remarks.append(
            "the positions are the commands of the position servos, which are the control of the "
            "design (--positions motion: the planned motion instead)"
        )
    elif trajectory.effort is None:
        remarks.append(
            "effort is left out, because not every joint has motors only: what servos apply "
            "depends on the motion"
        )

    speeds = trajectory.velocities
    if speeds is not None:
        largest = np.abs(speeds).max(axis=0)
        moving = np.abs(speeds[-1]) > REST * largest
        names = [name for name, moves in zip(trajectory.joints, moving, strict=True) if moves]
        if names:
            remarks.append(
                f"the motion of {', '.join(names)} does not end at rest; controllers of "
                "ros2_control accept it with allow_nonzero_velocity_at_trajectory_end: true, and "
                'a design with [boundary] end = "rest" ends at rest'
            )
    return remarks


def write_trajectory_yaml(path: Path, trajectory: JointTrajectory, name: str) -> None:
    """Write a trajectory as YAML, as `ros2 topic pub` and `ros2 action send_goal` read it.

    The message is one value in braces, so that a shell can put it into a goal:
    `"{trajectory: $(cat FILE)}"`.

    Args:
        path: File to write.
        trajectory: The trajectory.
        name: Name of the experiment, for the comment.
    """
    with replacing(path) as temporary:
        temporary.write_text("\n".join(_yaml_lines(trajectory, name)) + "\n", encoding="utf-8")


def _yaml_lines(trajectory: JointTrajectory, name: str) -> Iterator[str]:
    """Lines of the YAML file, one for each point."""
    content = {
        "motion": "positions are the planned motion",
        "command": "positions are the commands of the position servos",
    }
    title = json.dumps(name)
    yield f"# {TRAJECTORY_TYPE} of the design {title} by mjfim; {content[trajectory.content]}."
    yield "# Bring the robot to the first point before, and record the joint states and commands."
    yield '{header: {stamp: {sec: 0, nanosec: 0}, frame_id: ""},'
    yield f" joint_names: {json.dumps(list(trajectory.joints))},"
    yield " points: ["

    fields = trajectory.fields()
    for k, nanoseconds in enumerate(trajectory.nanoseconds):
        parts = [f"{key}: [{_numbers(values[k])}]" for key, values in fields.items()]
        sec, nanosec = divmod(nanoseconds, NANOSECONDS)
        parts.append(f"time_from_start: {{sec: {sec}, nanosec: {nanosec}}}")
        end = "," if k + 1 < len(trajectory.nanoseconds) else ""
        yield f"  {{{', '.join(parts)}}}{end}"

    yield " ]}"


def _numbers(values: Array) -> str:
    """Numbers with commas between them, which every version of YAML reads as floats."""
    return ", ".join(yaml_number(value) for value in values.tolist())


def yaml_number(value: float) -> str:
    """Write a float for YAML 1.1, where `1e-05` without a decimal point is a text."""
    digits, _, exponent = f"{value:.{DIGITS}g}".partition("e")
    point = "" if "." in digits else ".0"
    return f"{digits}{point}e{exponent}" if exponent else f"{digits}{point}"


def _drives_by_joint(plan: RobotPlan) -> dict[str, list[Drive]]:
    """The controls that act on each joint, in the order of the joints."""
    found: dict[str, list[Drive]] = {}
    for joint in plan.system.coordinates:
        drives = [drive for drive in plan.drives if drive.joint == joint]
        if drives:
            found[joint.name] = drives

    if not found:
        raise ExperimentError(
            "a joint trajectory describes slides and hinges on which actuators act, and the model "
            "has none; export it --to player, which sends the controls"
        )
    return found


def _content(positions: str | None, are_servos: bool) -> Positions:
    """Choose the kind of positions in the trajectory; ExperimentError for an unknown kind."""
    if positions is None:
        return "command" if are_servos else "motion"

    kinds: tuple[Positions, ...] = get_args(Positions)
    content = chosen("--positions", "kind", positions, kinds)
    if content == "command" and not are_servos:
        raise ExperimentError(
            "--positions command: not every driven joint has one position servo, whose control is "
            "a position; leave the option out, or state motion"
        )
    return content


def _is_servo(drives: Sequence[Drive]) -> bool:
    """Whether a joint is driven by one position servo."""
    kinds = [drive.kind for drive in drives]
    return kinds == [DriveKind.POSITION] and drives[0].gear != 0.0


def _are_motors(drives: Sequence[Drive]) -> bool:
    """Whether a joint is driven by motors alone, whose force follows from the control."""
    return all(drive.kind == DriveKind.FORCE for drive in drives)


def _command(plan: RobotPlan, servo: Drive) -> Array:
    """(M+1,) commands of a position servo, as positions of its joint [m or rad]."""
    index = plan.drives.index(servo)
    return np.asarray(plan.held_control[:, index] / servo.gear)


def _columns(plan: RobotPlan, field: str, joints: Sequence[str]) -> Array:
    """(M+1, n) columns of reference.csv of one field, for some joints."""
    return np.column_stack([plan.column(f"{field}:{joint}") for joint in joints])

"""A design as a robot needs it, and as files of ROS 2 and of LeRobot.

The plan has rows at the rate of the controller, and what the controls drive.

The points of a joint trajectory are the rows of `reference.csv`. For joints with a motor they hold
the planned motion and the force that belongs to it. For joints with a position servo, the command
of the servo is the control of the design, so the positions are these commands, and there are no
velocities.

`ros2 bag play` of a bag publishes the trajectory on the topic of a trajectory controller. The
planned states and controls are on topics of mjfim, which no robot listens to; `identify` reads them
as a recording without noise.

A LeRobot dataset of format v3.0 has one episode, whose frames are the rows of `design.csv`.
`action` holds the controls, `observation.state` the planned positions and velocities; the last
frame continues the last control. The files are those that LeRobot 0.4 writes, with the names that
its robots use: `<motor>.pos` for the command of a servo.
"""

from __future__ import annotations

import json
import shutil
import tempfile
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any, Literal

import mujoco
import numpy as np
import pyarrow as pa
import pyarrow.parquet

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError
from mjfim.excitation.limits.limits import limits_of
from mjfim.experiment.given import check_fits
from mjfim.experiment.system import System
from mjfim.files import remove_earlier_result, replacing, write_json
from mjfim.model.coordinates import ScalarJoint, state_components
from mjfim.model.units import AFFINE, AT_JOINT, actuator_gear, is_integrated, servo_kind
from mjfim.output.archive import reference_columns, simulate_playback
from mjfim.recordings.formats import CONTROL_TOPIC, JOINT_STATE, module_of_extra
from mjfim.records.design import Design
from mjfim.records.trajectory import Trajectory

# What a control means; that of a servo is a position or a velocity.
Meaning = Literal["force", "position", "velocity", "other"]


@record
class Drive:
    """One control, and what it drives.

    Attributes:
        name: Name of the control.
        meaning: What the control means.
        joint: The slide or hinge joint on which its actuator acts; None where it acts on something
            else, or on several joints.
        gear: Ratio of the actuator's coordinate to that of the joint.
        holds_position: Whether the actuator holds a position while the control stays.
        lower: Smallest control [unit of the actuator]; -inf without a limit.
        upper: Largest control [unit of the actuator]; inf without a limit.
    """

    name: str
    meaning: Meaning
    joint: ScalarJoint | None
    gear: float
    holds_position: bool
    lower: float
    upper: float


@dataclass(frozen=True, kw_only=True, eq=False)
class RobotPlan:
    """A design with everything that the programs of a robot need.

    Attributes:
        name: Name of the experiment.
        system: The experiment.
        playback: The M rows of control and the final state, as in design.csv.
        gain: (M, nu, nx) their feedback gains [control unit / state unit].
        reference: (M+1,) columns of reference.csv by name.
        drives: The nu controls, in the order of the model.
    """

    name: str
    system: System
    playback: Trajectory
    gain: Array
    reference: dict[str, Array]
    drives: tuple[Drive, ...]

    @classmethod
    def of(cls, design: Design, system: System, file: Path | None = None) -> RobotPlan:
        """Simulate a design at the rate of the controller.

        Args:
            design: The design.
            system: The experiment for which it was made.
            file: File of the design, for messages.

        Raises:
            RecordingError: The design was made for another model or another rate.
            SimulationDivergedError: The simulation diverges.
        """
        check_fits(file or "the design", design.trajectory, system)
        playback, gain = simulate_playback(system, design.trajectory, design.final.gain)
        return cls(
            name=Path(system.experiment.source).stem,
            system=system,
            playback=playback,
            gain=gain,
            reference=reference_columns(playback, system),
            drives=_drives(system),
        )

    @property
    def held_control(self) -> Array:
        """(M+1, nu) control of each row; the last row continues the last control."""
        ctrl = self.playback.ctrl
        return np.concatenate([ctrl, ctrl[-1:]])

    def columns(self, field: str, joints: list[str]) -> Array:
        """(M+1, n) columns of reference.csv of one field, such as `qpos`, for some joints."""
        rows = len(self.playback.t)
        return np.reshape([self.reference[f"{field}:{joint}"] for joint in joints], (-1, rows)).T


def _drives(system: System) -> tuple[Drive, ...]:
    """Find what the controls of an experiment drive, and their limits."""
    model = system.model
    limits = limits_of(model, system.controls, system.experiment.limits, system.dt)
    ranges = {each.name: (each.lower, each.upper) for each in limits if each.kind == "control"}
    joints = {joint.joint: joint for joint in system.coordinates}
    actuators = np.repeat(np.arange(model.nactuator), model.actuator_ctrlnum)

    drives = []
    for name, i in zip(system.controls, actuators.tolist(), strict=True):
        is_single = int(model.actuator_ctrlnum[i]) == 1
        at_joint = mujoco.mjtTrn(int(model.actuator_trntype[i])) in AT_JOINT
        is_affine = mujoco.mjtBias(int(model.actuator_biastype[i])) in AFFINE
        pulls = is_affine and float(model.actuator_biasprm[i, 1]) < 0.0
        lower, upper = ranges.get(name, (-np.inf, np.inf))
        drives.append(
            Drive(
                name=name,
                meaning=_meaning(model, i) if is_single else "other",
                joint=joints.get(int(model.actuator_trnid[i, 0]))
                if is_single and at_joint
                else None,
                gear=actuator_gear(model, i),
                holds_position=pulls and not is_integrated(model, i),
                lower=float(lower),
                upper=float(upper),
            )
        )
    return tuple(drives)


def _meaning(model: Any, actuator: int) -> Meaning:
    """Meaning of the control of an actuator that has one control."""
    has_fixed_gain = int(model.actuator_gaintype[actuator]) == int(mujoco.mjtGain.mjGAIN_FIXED)
    has_gain = float(model.actuator_gainprm[actuator, 0]) != 0.0
    if not has_fixed_gain or not has_gain or is_integrated(model, actuator):
        return "other"
    if int(model.actuator_biastype[actuator]) == int(mujoco.mjtBias.mjBIAS_NONE):
        return "force"

    # A servo with a constant force beside does not rest at its command.
    has_constant = float(model.actuator_biasprm[actuator, 0]) != 0.0
    return "other" if has_constant else servo_kind(model, actuator) or "other"


# Files of a dataset with one episode, relative to its folder.
INFO_FILE = "meta/info.json"
STATS_FILE = "meta/stats.json"
TASKS_FILE = "meta/tasks.parquet"
EPISODES_FILE = "meta/episodes/chunk-000/file-000.parquet"
DATA_FILE = "data/chunk-000/file-000.parquet"
DATASET_FILES = (DATA_FILE, EPISODES_FILE, TASKS_FILE, STATS_FILE, INFO_FILE)

# Endings of names by what the control of a motor or the component of a state means.
CONTROL_ENDINGS = {"position": ".pos", "velocity": ".vel", "force": ".effort", "other": ""}
STATE_ENDINGS = {"qpos": ".pos", "qvel": ".vel"}

# Quantiles of the statistics, by their names.
QUANTILES = {"q01": 0.01, "q10": 0.10, "q50": 0.50, "q90": 0.90, "q99": 0.99}

# Index of the table of tasks, which pandas restores from this description.
TASK_INDEX = "__index_level_0__"
PANDAS: dict[str, Any] = {
    "index_columns": [TASK_INDEX],
    "column_indexes": [],
    "columns": [
        {
            "name": "task_index",
            "field_name": "task_index",
            "pandas_type": "int64",
            "numpy_type": "int64",
            "metadata": None,
        },
        {
            "name": None,
            "field_name": TASK_INDEX,
            "pandas_type": "unicode",
            "numpy_type": "object",
            "metadata": None,
        },
    ],
    "pandas_version": "2.0.0",
}

# Largest relative deviation of the rate from a whole number of frames per second.
RATE_TOLERANCE = 1e-6


def write_lerobot_dataset(folder: Path, plan: RobotPlan, unit: str = "rad") -> None:
    """Write a design as a LeRobot dataset.

    Args:
        folder: Folder of the dataset.
        plan: The design.
        unit: Unit of angles, `rad` or `deg`; angular velocities follow.

    Raises:
        ExperimentError: The rate of the rows is not a whole number of frames per second.
    """
    rate = 1.0 / plan.playback.dt
    fps, rows = round(rate), len(plan.playback.t)
    if fps < 1 or abs(rate - fps) > RATE_TOLERANCE * rate:
        raise ExperimentError(
            f"a LeRobot dataset has a whole number of frames per second, but the design has "
            f"{rate:.6g} rows per second; state another rate or playback_rate"
        )

    factor = 180.0 / np.pi if unit == "deg" else 1.0
    named = {"action": _actions(plan, factor), "observation.state": _states(plan, factor)}
    index = np.arange(rows)
    defaults: dict[str, np.ndarray] = {
        "timestamp": (index / fps).astype(np.float32),
        "frame_index": index,
        "episode_index": np.zeros_like(index),
        "index": index,
        "task_index": np.zeros_like(index),
    }
    columns = {name: values.astype(np.float32) for name, (_, values) in named.items()} | defaults
    stats = {name: _statistics(values) for name, values in columns.items()}
    task = f"mjfim design {plan.name}"
    tasks = {"task_index": [0], TASK_INDEX: [task]}
    _write_parquet(folder / DATA_FILE, {name: _column(each) for name, each in columns.items()})
    episode: dict[str, Any] = {
        "episode_index": [0],
        "tasks": [[task]],
        "length": [rows],
        "data/chunk_index": [0],
        "data/file_index": [0],
        "dataset_from_index": [0],
        "dataset_to_index": [rows],
        "meta/episodes/chunk_index": [0],
        "meta/episodes/file_index": [0],
    }
    for name, numbers in stats.items():
        episode |= {f"stats/{name}/{key}": [value] for key, value in numbers.items()}
    _write_parquet(folder / EPISODES_FILE, episode)
    _write_parquet(folder / TASKS_FILE, tasks, {b"pandas": json.dumps(PANDAS).encode()})
    write_json(folder / STATS_FILE, stats)

    features: dict[str, Any] = {
        key: {"dtype": "float32", "shape": [len(names)], "names": names}
        for key, (names, _) in named.items()
    }
    for key, values in defaults.items():
        features[key] = {"dtype": values.dtype.name, "shape": [1], "names": None}
    info = {
        "codebase_version": "v3.0",
        "robot_type": plan.name,
        "total_episodes": 1,
        "total_frames": rows,
        "total_tasks": 1,
        "chunks_size": 1000,
        "data_files_size_in_mb": 100,
        "video_files_size_in_mb": 200,
        "fps": fps,
        "splits": {"train": "0:1"},
        "data_path": "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet",
        "video_path": None,
        "features": features,
    }
    write_json(folder / INFO_FILE, info)


def _actions(plan: RobotPlan, factor: float) -> tuple[list[str], Array]:
    """Names and (M+1, nu) values of the controls; factor converts angles."""
    names = [f"{drive.name}{CONTROL_ENDINGS[drive.meaning]}" for drive in plan.drives]
    are_angles = [
        drive.meaning in ("position", "velocity")
        and drive.joint is not None
        and drive.joint.unit == "rad"
        for drive in plan.drives
    ]
    return names, plan.held_control * np.where(are_angles, factor, 1.0)


def _states(plan: RobotPlan, factor: float) -> tuple[list[str], Array]:
    """Names and (M+1, nq+nv) values of positions and velocities; factor converts angles."""
    names, columns = [], []
    for component in state_components(plan.system.model):
        field, _, name = component.name.partition(":")
        scale = factor if component.unit in ("rad", "rad/s") else 1.0
        names.append(f"{name}{STATE_ENDINGS[field]}")
        columns.append(scale * plan.playback.state[:, component.address])
    return names, np.column_stack(columns)


def _column(values: np.ndarray) -> Any:
    """A column of numbers, or of lists of equal length if each frame has several numbers."""
    width = values.shape[1] if values.ndim > 1 else 1
    numbers = pa.array(values.ravel())
    return numbers if width == 1 else pa.FixedSizeListArray.from_arrays(numbers, width)


def _statistics(values: np.ndarray) -> dict[str, list[float]]:
    """Statistics of a column, each a list with one number for each component."""
    rows = values.reshape(len(values), -1)
    found = {
        "min": rows.min(axis=0).tolist(),
        "max": rows.max(axis=0).tolist(),
        "mean": rows.mean(axis=0, dtype=np.float64).tolist(),
        "std": rows.std(axis=0, dtype=np.float64).tolist(),
        "count": [len(rows)],
    }
    for name, share in QUANTILES.items():
        found[name] = np.quantile(rows.astype(np.float64), share, axis=0).tolist()
    return found


def _write_parquet(
    path: Path, columns: Mapping[str, Any], metadata: Mapping[bytes, bytes] | None = None
) -> None:
    table = pa.table(dict(columns)).replace_schema_metadata(metadata)
    with replacing(path) as temporary:
        pyarrow.parquet.write_table(table, temporary)


# What the positions of a trajectory are: the planned motion, or the commands of position servos.
CONTENT = {
    "motion": "positions are the planned motion",
    "command": "positions are the commands of the position servos",
}
POSITIONS = tuple(CONTENT)

# Ending of the file inside a bag, by its format; and a version of bags that all supported versions
# of ROS 2 read.
ENDINGS = {"mcap": ".mcap", "sqlite3": ".db3"}
BAG_VERSION = 9

# Topic on which a trajectory controller of ros2_control listens, and that of the planned joint
# states; that of a robot is not used, because `ros2 bag play` publishes.
TRAJECTORY_TOPIC = "/joint_trajectory_controller/joint_trajectory"
PLANNED_TOPIC = "/mjfim/planned_joint_states"
TRAJECTORY_TYPE = "trajectory_msgs/msg/JointTrajectory"

# Nanoseconds per second, and the time stamp of the start of a bag: 0 would mean no stamp.
NANOSECONDS = 1_000_000_000
START = NANOSECONDS

# Significant digits of the numbers in a YAML file.
DIGITS = 12

# Final speed that counts as rest, relative to the largest speed of the joint.
REST = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class JointTrajectory:
    """The contents of a message `trajectory_msgs/JointTrajectory`.

    Attributes:
        joints: Names of the n joints.
        nanoseconds: (M+1,) times from the start [ns].
        fields: (M+1, n) values of the fields that a point has, by name.
        content: What the positions are, one of `POSITIONS`.
    """

    joints: list[str]
    nanoseconds: list[int]
    fields: dict[str, Array]
    content: str

    def remarks(self) -> list[str]:
        """Sentences that the user of a trajectory needs."""
        if self.content == "command":
            return [
                "the positions are the commands of the position servos, which are the control of "
                "the design (--positions motion: the planned motion instead)"
            ]
        remarks = []
        if "effort" not in self.fields:
            remarks.append(
                "effort is left out, because not every joint has motors only: what servos apply "
                "depends on the motion"
            )
        speeds = np.abs(self.fields["velocities"])
        moves = speeds[-1] > REST * speeds.max(axis=0)
        names = [name for name, is_moving in zip(self.joints, moves, strict=True) if is_moving]
        if names:
            remarks.append(
                f"the motion of {', '.join(names)} does not end at rest; controllers of "
                "ros2_control accept it with allow_nonzero_velocity_at_trajectory_end: true, and "
                'a design with [boundary] end = "rest" ends at rest'
            )
        return remarks


def joint_trajectory(plan: RobotPlan, positions: str | None = None) -> JointTrajectory:
    """Make a joint trajectory of a design, with all joints on which an actuator acts.

    Args:
        plan: The design.
        positions: `motion` for the planned motion, `command` for the commands of position servos;
            default: the commands where every driven joint has a position servo.

    Raises:
        ExperimentError: No actuator acts on a joint, or there are no position servos whose commands
            are wanted.
    """
    drives = {
        joint.name: [drive for drive in plan.drives if drive.joint == joint]
        for joint in plan.system.coordinates
    }
    drives = {name: found for name, found in drives.items() if found}
    if not drives:
        raise ExperimentError(
            "a joint trajectory describes slides and hinges on which actuators act, and the model "
            "has none; export it --to player, which sends the controls"
        )
    meanings = [[drive.meaning for drive in found] for found in drives.values()]
    are_servos = all(
        each == ["position"] and found[0].gear != 0.0
        for each, found in zip(meanings, drives.values(), strict=True)
    )
    content = positions or ("command" if are_servos else "motion")
    if content == "command" and not are_servos:
        raise ExperimentError(
            "--positions command: not every driven joint has one position servo, whose control is "
            "a position; leave the option out, or state motion"
        )

    joints = list(drives)
    if content == "command":
        servos = [found[0] for found in drives.values()]
        numbers = [plan.drives.index(servo) for servo in servos]
        gears = np.array([servo.gear for servo in servos])
        fields = {"positions": plan.held_control[:, numbers] / gears}
    else:
        columns = {"positions": "qpos", "velocities": "qvel", "accelerations": "qacc"}
        if all(set(each) == {"force"} for each in meanings):
            columns["effort"] = "force"
        fields = {name: plan.columns(column, joints) for name, column in columns.items()}
    return JointTrajectory(
        joints=joints,
        nanoseconds=[round(t * NANOSECONDS) for t in plan.playback.t.tolist()],
        fields=fields,
        content=content,
    )


def write_trajectory_yaml(path: Path, trajectory: JointTrajectory, name: str) -> None:
    """Write a trajectory as YAML, as `ros2 topic pub` and `ros2 action send_goal` read it.

    The message is one value in braces, so that a shell can put it into a goal:
    `"{trajectory: $(cat FILE)}"`.

    Args:
        path: File to write.
        trajectory: The trajectory.
        name: Name of the experiment, for the comment.
    """
    points = []
    for k, nanoseconds in enumerate(trajectory.nanoseconds):
        parts = [
            f"{key}: [{', '.join(map(yaml_number, values[k].tolist()))}]"
            for key, values in trajectory.fields.items()
        ]
        sec, nanosec = divmod(nanoseconds, NANOSECONDS)
        parts.append(f"time_from_start: {{sec: {sec}, nanosec: {nanosec}}}")
        points.append(f"  {{{', '.join(parts)}}}")

    content = CONTENT[trajectory.content]
    lines = [
        f"# {TRAJECTORY_TYPE} of the design {yaml_text(name)} by mjfim; {content}.",
        "# Bring the robot to the first point before, and record the joint states and commands.",
        '{header: {stamp: {sec: 0, nanosec: 0}, frame_id: ""},',
        f" joint_names: [{', '.join(map(yaml_text, trajectory.joints))}],",
        " points: [",
        ",\n".join(points),
        " ]}",
    ]
    with replacing(path) as temporary:
        temporary.write_text("\n".join(lines) + "\n", encoding="utf-8")


def yaml_text(value: str) -> str:
    """Write a text for YAML, which has Python's escapes, and no pairs of surrogates as JSON has."""
    escaped = value.encode("unicode_escape").decode().replace('"', '\\"')
    return f'"{escaped}"'


def yaml_number(value: float) -> str:
    """Write a float for YAML 1.1, where `1e-05` without a decimal point is a text."""
    digits, exponent, rest = f"{value:.{DIGITS}g}".partition("e")
    return f"{digits}{'' if '.' in digits else '.0'}{exponent}{rest}"


# ---- bags


def bag_files(folder: Path) -> tuple[str, ...]:
    """List the files that a bag may have.

    Args:
        folder: Folder of the bag, whose name is also that of the file in it.
    """
    name = folder.absolute().name
    return ("metadata.yaml", *(f"{name}{ending}" for ending in ENDINGS.values()))


def write_bag(folder: Path, plan: RobotPlan, trajectory: JointTrajectory, storage: str) -> None:
    """Write a design as a ROS 2 bag.

    Args:
        folder: Folder of the bag.
        plan: The design.
        trajectory: Its joint trajectory.
        storage: Format of the file in the bag.

    Raises:
        RecordingError: The library rosbags is not installed.
    """
    rosbag2 = module_of_extra(folder, "rosbags.rosbag2")
    typesys = module_of_extra(folder, "rosbags.typesys")
    store = typesys.get_typestore(typesys.Stores.ROS2_HUMBLE)
    plugin = getattr(rosbag2.StoragePlugin, storage.upper())
    name = folder.absolute().name

    # The library writes a folder that does not exist yet; its files are then put in their places.
    with tempfile.TemporaryDirectory() as scratch:
        written = Path(scratch) / name
        with rosbag2.Writer(written, version=BAG_VERSION, storage_plugin=plugin) as bag:
            topics = {
                topic: bag.add_connection(topic, kind, typestore=store)
                for topic, kind in TOPICS.items()
            }
            for topic, stamp, message in _messages(store.types, plan, trajectory):
                bag.write(topics[topic], stamp, store.serialize_cdr(message, TOPICS[topic]))

        # The data first, which the metadata describe.
        _copy_files(written, folder, (f"{name}{ENDINGS[storage]}", "metadata.yaml"))


def _copy_files(written: Path, folder: Path, files: Sequence[str]) -> None:
    """Copy the files of a bag into its folder, and remove data in another format."""
    for file in files:
        with replacing(folder / file) as temporary:
            shutil.copyfile(written / file, temporary)
    for file in {*bag_files(folder)} - {*files}:
        if (folder / file).is_file():
            remove_earlier_result(folder / file)


# Topics of a bag, with the types of their messages.
TOPICS = {
    TRAJECTORY_TOPIC: TRAJECTORY_TYPE,
    PLANNED_TOPIC: JOINT_STATE,
    CONTROL_TOPIC: JOINT_STATE,
}


def _messages(
    types: Any, plan: RobotPlan, trajectory: JointTrajectory
) -> Iterator[tuple[str, int, Any]]:
    """The messages of a bag: topic, time stamp [ns] and contents."""
    nothing = np.zeros(0)

    def header(stamp: int) -> Any:
        """A header with a time stamp [ns]; one of 0 lets a trajectory begin at once."""
        sec, nanosec = divmod(stamp, NANOSECONDS)
        time = types["builtin_interfaces/msg/Time"](sec=sec, nanosec=nanosec)
        return types["std_msgs/msg/Header"](stamp=time, frame_id="")

    points = []
    for k, nanoseconds in enumerate(trajectory.nanoseconds):
        sec, nanosec = divmod(nanoseconds, NANOSECONDS)
        names = ("positions", "velocities", "accelerations", "effort")
        row = {
            each: trajectory.fields[each][k] if each in trajectory.fields else nothing
            for each in names
        }
        duration = types["builtin_interfaces/msg/Duration"](sec=sec, nanosec=nanosec)
        point = types["trajectory_msgs/msg/JointTrajectoryPoint"]
        points.append(point(**row, time_from_start=duration))
    message = types[TRAJECTORY_TYPE](header(0), trajectory.joints, points)
    yield TRAJECTORY_TOPIC, START, message

    joints = [joint.name for joint in plan.system.coordinates]
    planned = [plan.columns(field, joints) for field in ("qpos", "qvel", "force")]
    controls = [drive.name for drive in plan.drives]
    state = types[JOINT_STATE]
    for k, t in enumerate(plan.playback.t.tolist()):
        stamp = START + round(t * NANOSECONDS)
        rows = [np.ascontiguousarray(values[k]) for values in planned]
        yield PLANNED_TOPIC, stamp, state(header(stamp), joints, *rows)
        sent = state(header(stamp), controls, nothing, nothing, plan.held_control[k])
        yield CONTROL_TOPIC, stamp, sent

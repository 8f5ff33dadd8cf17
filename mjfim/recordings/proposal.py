"""A table `[recording]` for the log of another program, guessed from names, order and ranges."""

from __future__ import annotations

import json
import re
from collections import defaultdict
from collections.abc import Collection, Iterator, Mapping, Sequence
from contextlib import suppress
from functools import partial
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import RecordingError
from mjfim.model.coordinates import joint_names, scalar_joints
from mjfim.model.elements import identifier
from mjfim.model.units import commanded_joint
from mjfim.recordings.channels import Channels
from mjfim.recordings.checks import doubtful_angles, likely_unit
from mjfim.recordings.formats import SECONDS, Table

# Words in the names of columns that say what a column holds. The first kind counts.
WORDS = {
    "reference": "goal target des desired ref reference setpoint",
    "command": "cmd command commanded commands action ctrl control controls con u",
    "velocity": "vel velocity velocities speed speeds omega qd dq qvel qdot",
    "effort": "effort efforts torque torques tau load current moment force",
    "position": "pos position positions q qpos angle angles theta encoder",
    "time": "t time times timestamp stamp clock sec secs seconds",
}
KINDS = {kind: set(words.split()) for kind, words in WORDS.items()}

OF_FORCES = KINDS["effort"]

# How TOML writes a text.
_quoted = partial(json.dumps, ensure_ascii=False)

# What sensors of joints measure.
QUANTITIES = {mujoco.mjtSensor.mjSENS_JOINTPOS: "qpos", mujoco.mjtSensor.mjSENS_JOINTVEL: "qvel"}

# Words of columns that are measured, in contrast to filtered ones.
MEASURED = {"meas", "measured", "actual", "present", "raw"}


def proposed_recording(table: Table, channels: Channels) -> str:
    """Propose a table `[recording]` for a log.

    Args:
        table: Columns of the log.
        channels: The signals of the experiment.

    Returns:
        The table as TOML. Comments say what was guessed, and which signal has no column.
        Columns with mjfim's names are left out.
    """
    model, joints = channels.model, scalar_joints(channels.model)
    time, t, lines = log_time(table)
    columns = {name: _words(table, name) for name in table.names if _is_numeric(table, name)}
    columns.pop(time, None)

    # A motor takes a force, which a log may hold as it was measured. A name without a kind may be
    # that of a joint or of an actuator.
    is_motor = (model.actuator_biastype == mujoco.mjtBias.mjBIAS_NONE).all()
    of_controls = (
        ("command", "", "effort", "reference") if is_motor else ("reference", "command", "")
    )
    controls = {name: name.partition(":")[2] for name in channels.control_columns}
    found: dict[str, tuple[str, str]] = {}
    for kinds, targets, preferred in (
        (("velocity",), {joint.velocity_column: joint.name for joint in joints}, MEASURED),
        (("position", ""), {joint.position_column: joint.name for joint in joints}, MEASURED),
        (of_controls, controls, OF_FORCES if is_motor else KINDS["position"]),
    ):
        taken = {column for column, _ in found.values()}
        for kind in kinds:
            of_kind = {n: w for n, w in columns.items() if n not in taken and _kind(w) == kind}
            matches = _matches(of_kind, targets, preferred, may_be_ordered=bool(kind))
            if matches:
                found |= matches
                break
    found |= {name: (name, "by name") for name in channels.outputs if name in columns}

    # Columns that have mjfim's names need no line.
    units, sensors = _units(table, channels, found, t), sensors_of_joints(channels)
    usual = {name for name, (column, _) in found.items() if column == name and name not in units}
    if not usual.issuperset(name for name in found if name not in controls):
        usual &= set(controls)
    for name in dict.fromkeys((*controls, *found)):
        column, why = found.get(name, ("", "no column found: name it, or 0.0 for a motor off"))
        words = set(columns.get(column, ()))
        if is_motor and name in controls and _kind(words) == "reference" and not words & OF_FORCES:
            column, why = "", f"{column} may be a reference: state [controllers]"
        if column and name not in controls and np.ptp(table.column(column)) == 0.0:
            column, why = "", f"{column} never changes"
        signal = sensors.get(name, name)
        if name in usual and signal == name:
            continue
        key, value = _quoted(signal), _quoted(column)
        if name in units:
            value = f'{{ column = {value}, unit = "{units[name]}" }}'
            why += "; unit by range"
        lines.append(f"{key} = {value}  # {why}" if column else f"# {key} = 0.0  # {why}")
    return "\n".join(lines)


def sensors_of_joints(channels: Channels) -> dict[str, str]:
    """Sensors that are measured in place of the coordinates of joints, by the joints' columns."""
    model, found = channels.model, {}
    for name in channels.outputs:
        i = identifier(model, "sensor", name)
        quantity = QUANTITIES.get(mujoco.mjtSensor(model.sensor_type[i])) if i >= 0 else None
        column = f"{quantity}:{joint_names(model)[model.sensor_objid[i]]}" if quantity else name
        if column not in channels.outputs:
            found[column] = name
    return found


def log_time(table: Table) -> tuple[str, Array, list[str]]:
    """Column of the time stamps, the times [s], and the first lines of the table."""
    for name in table.names:
        if KINDS["time"].isdisjoint(_words(table, name)):
            continue
        with suppress(RecordingError):
            t, lines = table.seconds(name, None), [f"time = {_quoted(name)}"]
            steps = np.diff(t)
            if (steps > 0.0).any() and _is_numeric(table, name) and not table.unit(name):
                unit = likely_unit(float(np.log(np.median(steps[steps > 0.0]))))
                lines += [f'time_unit = "{unit}"  # by the steps'] if unit != "s" else []
                t = SECONDS[unit] * t
            return name, t, ["[recording]", *lines, "", "[recording.columns]"]
    return "", np.zeros(0), ['[recording]\n# time = "..."  # none found\n\n[recording.columns]']


def _matches(
    columns: Mapping[str, Sequence[str]],
    targets: Mapping[str, str],
    preferred: Collection[str],
    *,
    may_be_ordered: bool,
) -> dict[str, tuple[str, str]]:
    """Column of each target, by words or by order, in the group of columns that has most of them.

    Args:
        columns: Words of the columns of one kind, by name.
        targets: Names of joints or actuators, by the names of their columns in a recording.
        preferred: Words of the group that is taken where several have equally many.
        may_be_ordered: Whether the order may tell of columns without a name.
    """
    elements = {target: set(_split(name)) for target, name in targets.items()}
    common = set.intersection(*elements.values()) if len(elements) > 1 else set()
    elements = {target: words - common for target, words in elements.items()}
    own = set().union(*elements.values())

    # Columns that differ in numbers and in names of elements alone form a group; so do all columns
    # that have names alone.
    groups: dict[tuple[str, ...], list[str]] = defaultdict(list)
    for name, words in columns.items():
        others = (word for word in words if word not in own and not word.isdigit())
        groups[tuple(others) if may_be_ordered else ()].append(name)
    found: list[tuple[int, bool, dict[str, tuple[str, str]]]] = []
    for stem, group in groups.items():
        named = {
            target: (name, "by name")
            for target, words in elements.items()
            for name in reversed(group)
            if words and words <= set(columns[name])
        }
        # Numbers are names only if none is missing: some programs begin at 0.
        if len(named) < len(elements) and all(map(str.isdigit, own)):
            named = {}
        if not named and may_be_ordered and len(group) == len(elements):
            group.sort(key=lambda name: [int(w) for w in columns[name] if w.isdigit()])
            named = {
                target: (name, "by order") for target, name in zip(elements, group, strict=True)
            }
        found.append((len(named), not set(preferred).isdisjoint(stem), named))
    return max(found, key=lambda each: each[:2], default=(0, False, {}))[2]


def references(channels: Channels) -> Iterator[tuple[str, str]]:
    """Columns of the references of laws and servos, each with the column of its joint."""
    if channels.laws is not None:
        for law in channels.laws.laws:
            yield channels.control_columns[law.columns["reference"]], f"qpos:{law.joint}"
    for i, name in enumerate(channels.controls):
        joint = commanded_joint(channels.model, i)
        if joint is not None and f"ctrl:{name}" in channels.control_columns:
            yield f"ctrl:{name}", f"qpos:{joint_names(channels.model)[joint]}"


def _units(
    table: Table, channels: Channels, found: Mapping[str, tuple[str, str]], t: Array
) -> dict[str, str]:
    """Units of the columns that are in degrees by the ranges of the joints."""
    values = {name: table.column(column) for name, (column, _) in found.items()}
    units: dict[str, str] = {}
    # Positions that are converted show velocities that are not.
    for _ in range(2 if len(t) else 0):
        for name, _ in list(doubtful_angles(channels.model, t, values)):
            units[name] = "deg/s" if name.startswith("qvel:") else "deg"
            values[name] = np.radians(values[name])
    # The references of a servo have the unit of its joint.
    units |= {name: units[at] for name, at in references(channels) if name in found and at in units}
    return {name: unit for name, unit in units.items() if not table.unit(found[name][0])}


def _is_numeric(table: Table, name: str) -> bool:
    """Whether a column holds a number."""
    with suppress(RecordingError):
        return bool(np.isfinite(table.measurement(name)).any())
    return False


def _words(table: Table, name: str) -> list[str]:
    """Words of the name of a column, and of the joint that `rostopic echo -p` names beside it."""
    label = re.sub(r"(?:position|velocity|effort)(\d+)$", r"name\1", name)
    texts: Any = table.contents.get(label, ()) if label != name else ()
    return _split(f"{name} {texts[0] if len(texts) else ''}")


def _split(name: str) -> list[str]:
    """Words and numbers of a name in small letters."""
    return [word.lower() for word in re.findall(r"[A-Z]*[a-z]+|[A-Z]+|\d+", name)]


def _kind(words: Collection[str]) -> str:
    """What a column holds, by the words of its name; empty if they do not say it."""
    return next((kind for kind, known in KINDS.items() if not known.isdisjoint(words)), "")

"""Names and units of the coordinates of a model.

No other module makes names of columns and of components.

A coordinate of a slide or hinge joint is called `qpos:<joint>` and `qvel:<joint>`. Ball and free
joints have parts, `qpos:<joint>.<part>`:

- columns of the state hold the orientation as a quaternion: `x y z qw qx qy qz`;
- deviations from a state (gains, deviations of the initial state, velocities) hold a rotation
  vector: `x y z rx ry rz`.

Activations are called `act:<actuator>`. Components of sensors have MuJoCo's indices, `gyro[0]`.
"""

from __future__ import annotations

import re
from collections.abc import Collection, Iterator, Sequence
from dataclasses import replace
from typing import Any

import mujoco

from mjfim.arrays import record
from mjfim.errors import unknown
from mjfim.model.elements import (
    element_name,
    identifier,
    names_of,
    unique_names,
    unnamed_count,
)
from mjfim.model.units import (
    PART_UNITS,
    control_units,
    joint_unit,
    per_second,
    sensor_unit,
)

# Parts of the translation of a free joint.
TRANSLATION = ("x", "y", "z")

# Parts of the orientation of a ball or free joint in a state: a unit quaternion.
QUATERNION = ("qw", "qx", "qy", "qz")

# Parts of a deviation of the orientation and of the angular velocity: a rotation vector, in the
# frame of the body.
ROTATION_VECTOR = ("rx", "ry", "rz")

# Standard deviation of a component of a quaternion, divided by that of the orientation [1/rad].
# With 1/2, the four components hold exactly the information of a rotation vector that has the
# stated standard deviation.
QUATERNION_SIGMA_FACTOR = 0.5

# A coordinate written with an index, as in `qpos:base[3]` or `initial/base:qpos[3]`.
INDEXED_NAME = re.compile(r"^(?P<joint>.+)\[(?P<index>\d+)\]$")

# A coordinate written with a part, as in `qpos:base.qw`.
NAME_WITH_PART = re.compile(r"^(?P<joint>.+)\.(?P<part>\w+)$")


@record
class ScalarJoint:
    """A joint with one degree of freedom.

    Attributes:
        name: Name of the joint.
        unit: Unit of its coordinate, m or rad.
        joint: Number of the joint.
        q: Address of its coordinate in qpos.
        v: Address of its velocity in qvel.
    """

    name: str
    unit: str
    joint: int
    q: int
    v: int

    @property
    def position_column(self) -> str:
        """Column of its coordinate."""
        return f"qpos:{self.name}"

    @property
    def velocity_column(self) -> str:
        """Column of its velocity."""
        return f"qvel:{self.name}"


@record
class Component:
    """One number of a state, of a deviation of it, or of a sensor with a name.

    Attributes:
        name: Column of the number: `qpos:<joint>`, `qvel:<joint>`, these with a part, `act:<name>`,
            or the name of a sensor, with `[i]` where it has several numbers.
        address: Its place in the state vector (qpos, qvel, act), in the tangent space (dq, dv, da),
            or in the sensor data.
        unit: Its unit; empty for components of quaternions, activations and sensors.
        groups: Names of the groups of columns that it belongs to, for example `qpos:base.rot` and
            `qpos:base`, or the sensor.
        path: Parameter path of a deviation of the initial state, `initial/<joint>:qpos`; empty
            where the joint or actuator has no name in the MJCF.
        sigma_factor: Its standard deviation over the stated one of a group; 1/2 for components of
            quaternions.
        sigma: Standard deviation of the noise of a sensor that the MJCF states, 0 where it states
            none [unit of the sensor].
        is_added: Whether it belongs to a joint that a physical term has added, which is measured
            only where it is named.
    """

    name: str
    address: int
    unit: str = ""
    groups: tuple[str, ...] = ()
    path: str = ""
    sigma_factor: float = 1.0
    sigma: float = 0.0
    is_added: bool = False


@record
class ModelCoordinates:
    """All coordinates of a model by name, looked up once.

    Attributes:
        controls: Names of the nu controls.
        scalar_joints: All slide and hinge joints but those that physical terms have added.
        unnamed_joints: Number of joints without a name in the MJCF.
        state: The nq + nv numbers of the state that can be measured.
        sensors: The numbers of all sensors with a name.
        deviations: The 2 nv numbers of a deviation of positions and velocities.
    """

    controls: tuple[str, ...]
    scalar_joints: tuple[ScalarJoint, ...]
    unnamed_joints: int
    state: tuple[Component, ...]
    sensors: tuple[Component, ...]
    deviations: tuple[Component, ...]

    @classmethod
    def of(cls, model: Any, added: Collection[int] = ()) -> ModelCoordinates:
        """Look up the coordinates of a compiled model.

        Args:
            model: The compiled model (`mujoco.MjModel`).
            added: Addresses in the state (qpos, qvel) that physical terms have added.
        """
        components = state_components(model)
        return cls(
            controls=control_names(model),
            scalar_joints=tuple(each for each in scalar_joints(model) if each.q not in added),
            unnamed_joints=unnamed_count(model, "joint"),
            state=tuple(replace(each, is_added=each.address in added) for each in components),
            sensors=sensor_components(model),
            deviations=tangent_components(model)[: 2 * model.nv],
        )

    @property
    def measurable(self) -> tuple[str, ...]:
        """Columns that a recording may hold: components of the state, then sensors."""
        state = [component.name for component in self.state]
        return (*state, *(component.name for component in self.sensors))


def joint_names(model: Any) -> tuple[str, ...]:
    """Names of the njnt joints; an unnamed joint is called by its number."""
    return unique_names(model, "joint")


def actuator_names(model: Any) -> tuple[str, ...]:
    """Names of the actuators; an unnamed actuator is called by its number."""
    return unique_names(model, "actuator")


def control_names(model: Any) -> tuple[str, ...]:
    """Names of the nu controls; an actuator with several controls names them `<actuator>[<i>]`."""
    counts = zip(actuator_names(model), model.actuator_ctrlnum, strict=True)
    return tuple(control for name, count in counts for control in _indexed(name, count))


def control_labels(model: Any) -> tuple[str, ...]:
    """Labels of the nu controls for the axes of figures.

    A label ends with the unit where the model determines it, else with `(control)`.
    """
    units = control_units(model)
    return tuple(
        f"{name} [{unit}]" if unit else f"{name} (control)"
        for name, unit in zip(control_names(model), units, strict=True)
    )


def scalar_joints(model: Any) -> tuple[ScalarJoint, ...]:
    """All slide and hinge joints, in the order of the model."""
    return tuple(
        ScalarJoint(
            name=name,
            unit=joint_unit(model, j),
            joint=j,
            q=int(model.jnt_qposadr[j]),
            v=int(model.jnt_dofadr[j]),
        )
        for j, name in enumerate(joint_names(model))
        if joint_dofs(model, j) == 1
    )


def joint_dofs(model: Any, joint: int) -> int:
    """Number of degrees of freedom of a joint: 6 (free), 3 (ball) or 1."""
    return max(len(tangent_parts(model, joint)), 1)


def tangent_parts(model: Any, joint: int) -> tuple[str, ...]:
    """Parts of a deviation of a joint, in the order of its degrees of freedom.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        joint: Number of the joint.

    Returns:
        The parts; none for slide and hinge joints.
    """
    kind = model.jnt_type[joint]
    if kind == mujoco.mjtJoint.mjJNT_FREE:
        return (*TRANSLATION, *ROTATION_VECTOR)
    if kind == mujoco.mjtJoint.mjJNT_BALL:
        return ROTATION_VECTOR
    return ()


def _joint_numbers(
    model: Any, *, with_quaternions: bool
) -> Iterator[tuple[str, int, str, str, str]]:
    """The numbers of all joints in a state or a deviation: all of qpos, then all of qvel.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        with_quaternions: True for the orientations of a state, False for those of a deviation.

    Yields:
        `qpos` or `qvel`, the joint, its name, the part or no text, and the unit.
    """
    for field in ("qpos", "qvel"):
        for j, name in enumerate(joint_names(model)):
            parts = tangent_parts(model, j)
            if parts and field == "qpos" and with_quaternions:
                parts = (*(part for part in parts if part in TRANSLATION), *QUATERNION)
            for part in parts or ("",):
                unit = PART_UNITS[part] if part else joint_unit(model, j)
                yield field, j, name, part, unit if field == "qpos" else per_second(unit)


def state_components(model: Any) -> tuple[Component, ...]:
    """The nq + nv numbers of the state without activations: all of qpos, then all of qvel."""
    return tuple(
        Component(
            name=f"{field}:{name}.{part}" if part else f"{field}:{name}",
            groups=(
                (f"{field}:{name}.{'pos' if part in TRANSLATION else 'rot'}", f"{field}:{name}")
                if part
                else ()
            ),
            address=address,
            unit=unit,
            sigma_factor=QUATERNION_SIGMA_FACTOR if part in QUATERNION else 1.0,
        )
        for address, (field, _, name, part, unit) in enumerate(
            _joint_numbers(model, with_quaternions=True)
        )
    )


def tangent_components(model: Any) -> tuple[Component, ...]:
    """The nx = 2 nv + na numbers of a deviation of the state, in the order (dq, dv, da)."""
    found = []
    numbers = _joint_numbers(model, with_quaternions=False)
    for address, (field, j, name, part, unit) in enumerate(numbers):
        suffix = f".{part}" if part else ""
        is_named = element_name(model, "joint", j) != ""
        component = Component(
            name=f"{field}:{name}{suffix}",
            path=f"initial/{name}:{field}{suffix}" if is_named else "",
            address=address,
            unit=unit,
        )
        found.append(component)
    return (*found, *_activation_components(model))


def _activation_components(model: Any) -> tuple[Component, ...]:
    """The na activations by their address: `act:<actuator>`, with `[i]` if there are several."""
    found: list[Component] = []
    for i, name in enumerate(actuator_names(model)):
        first = 2 * model.nv + int(model.actuator_actadr[i])
        count = model.actuator_actnum[i]
        named = element_name(model, "actuator", i) != ""
        columns = _indexed(f"act:{name}", count)
        paths = _indexed(f"initial/{name}:act", count)
        found += [
            Component(name=column, path=path if named else "", address=first + k)
            for k, (column, path) in enumerate(zip(columns, paths, strict=True))
        ]
    return tuple(sorted(found, key=lambda component: component.address))


def dof_names(model: Any) -> tuple[str, ...]:
    """Names of the nv degrees of freedom: `<joint>`, of ball and free joints `<joint>.<part>`."""
    components = tangent_components(model)[: model.nv]
    return tuple(component.name.removeprefix("qpos:") for component in components)


def state_names(model: Any) -> tuple[str, ...]:
    """Columns of the state (qpos, qvel, act): nq + nv + na names."""
    joints = [component.name for component in state_components(model)]
    return (*joints, *(component.name for component in _activation_components(model)))


def tangent_names(model: Any) -> tuple[str, ...]:
    """Names of the nx components of a deviation of the state."""
    return tuple(component.name for component in tangent_components(model))


def gain_names(model: Any, controls: Sequence[str]) -> tuple[str, ...]:
    """Columns of the gain K: (nu, nx), row by row.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        controls: nu names of the controls.

    Returns:
        nu * nx names `gain:<control>:<component of the deviation>`.
    """
    deviations = tangent_names(model)
    return tuple(f"gain:{control}:{each}" for control in controls for each in deviations)


def sensor_columns(model: Any, sensor: str) -> list[str]:
    """Columns of a named sensor: its name, with `[i]` where it has several components.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        sensor: Name of the sensor.
    """
    width = int(model.sensor(sensor).dim[0])
    return _indexed(sensor, width)


def sensor_components(model: Any) -> tuple[Component, ...]:
    """The numbers of all sensors that have a name, in the order of the model."""
    found: list[Component] = []
    for name in names_of(model, "sensor"):
        sensor = model.sensor(name)
        first, sigma = int(sensor.adr[0]), float(sensor.noise[0])
        found += [
            Component(name=column, groups=(name,), address=first + i, sigma=sigma)
            for i, column in enumerate(sensor_columns(model, name))
        ]
    return tuple(found)


def measurable_columns(model: Any) -> tuple[str, ...]:
    """Columns that a recording may hold: components of the state, then sensors."""
    return ModelCoordinates.of(model).measurable


def output_label(model: Any, output: str) -> str:
    """Label `<column> [<unit>]` of a measured column.

    Args:
        model: The compiled model (`mujoco.MjModel`).
        output: The column.

    Returns:
        The label; the column alone where no unit is known.
    """
    units = {component.name: component.unit for component in state_components(model)}
    unit = units.get(output, "")

    sensor = identifier(model, "sensor", output.partition("[")[0])
    if output not in units and sensor >= 0:
        unit = sensor_unit(model, sensor)

    return f"{output} [{unit}]" if unit else output


def split_unit(label: str) -> tuple[str, str]:
    """Name and unit of a label `<name> [<unit>]`; the unit is empty where the label has none."""
    plain, _, unit = label.partition(" [")
    return plain, unit.rstrip("]")


def unknown_coordinate(kind: str, name: str, valid: Sequence[str]) -> str:
    """Message about a coordinate that does not exist, with the right spelling where it is known.

    Args:
        kind: Kind of thing that was looked for, for the message.
        name: The name that does not exist.
        valid: All valid names, those of one joint in the order of its degrees of freedom.
    """
    indexed = INDEXED_NAME.match(name)
    if indexed:
        right = _names_with_parts(indexed["joint"], valid)
        index = int(indexed["index"])
        if index < len(right):
            return f"{name!r} is now written {right[index]!r}"

    with_part = NAME_WITH_PART.match(name)
    if with_part and with_part["part"] in (*QUATERNION, *ROTATION_VECTOR):
        right = _names_with_parts(with_part["joint"], valid)
        orientation = [n for n in right if n.rpartition(".")[2] not in TRANSLATION]
        if orientation:
            wanted = "rotation vector" if with_part["part"] in QUATERNION else "quaternion"
            return f"{name!r}: the orientation is a {wanted} here; valid: {', '.join(orientation)}"

    return unknown(kind, name, valid)


def _names_with_parts(joint_column: str, valid: Sequence[str]) -> list[str]:
    """All valid names that consist of the column of a joint, such as `qpos:base`, and a part."""
    return [
        name
        for name in valid
        if name.startswith(f"{joint_column}.") and name[len(joint_column) + 1 :] in PART_UNITS
    ]


def _indexed(name: str, count: int) -> list[str]:
    """Names of the components of an element: `<name>` of a single one, else `<name>[<i>]`."""
    return [name] if count == 1 else [f"{name}[{i}]" for i in range(count)]

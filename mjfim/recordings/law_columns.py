"""Columns of a log that control laws read in place of controls."""

from __future__ import annotations

from collections.abc import Collection, Iterable, Mapping
from pathlib import Path

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, RecordingError
from mjfim.model.units import ANGLE
from mjfim.recordings.angle_units import DEGREES, MIN_CORRELATION, TOLERANCE
from mjfim.recordings.channels import Channels
from mjfim.recordings.spec import LAW_PREFIXES


def units_of_inputs(channels: Channels) -> dict[str, str]:
    """Units of the columns that control laws read, where they are angles, lengths or their rates.

    Args:
        channels: The signals of the experiment.
    """
    if channels.laws is None:
        return {}
    known = ("rad", "rad/s", "m", "m/s")
    return {c.name: c.unit for c in channels.laws.inputs if c.unit in known}


def require_law(where: str | Path, name: str, channels: Channels) -> None:
    """Explain the column of a control law that the experiment does not have as it is named.

    Args:
        where: File and table, for the message.
        name: Name of a column that no signal of the experiment has.
        channels: The signals of the experiment.

    Raises:
        ExperimentError: The column needs another table `[controllers]`.
    """
    quantity, _, actuator = name.partition(":")
    laws = () if channels.laws is None else tuple(law.actuator for law in channels.laws.laws)

    if quantity == "ctrl" and actuator in laws:
        raise ExperimentError(
            f"{where}: {name!r}: [controllers.{actuator}] computes this control; remove the column "
            "or the table. A torque or current that was measured is an output: measure a sensor, "
            "such as <actuatorfrc>, and state its name"
        )
    if f"{quantity}:" not in LAW_PREFIXES or actuator not in channels.controls:
        return
    if actuator not in laws:
        raise ExperimentError(
            f"{where}: {name!r}: the experiment file states no law for this actuator, so that its "
            f"control is read from 'ctrl:{actuator}'; state the law in [controllers.{actuator}]"
        )
    key = f"{quantity} = true"
    if quantity == "reference_velocity":
        key = 'reference_velocity = "column"'
    raise ExperimentError(
        f"{where}: {name!r}: the law of this actuator does not read it; state {key} in "
        f"[controllers.{actuator}]"
    )


def require_one_source(where: str | Path, names: Iterable[str], channels: Channels) -> None:
    """Refuse a log that holds the control of an actuator and the reference of its law.

    Args:
        where: The log, for the message.
        names: Columns of the log.
        channels: The signals of the experiment, with control laws.

    Raises:
        RecordingError: The log holds both under the names that mjfim gives them.
    """
    assert channels.laws is not None
    found = set(names)
    for law in channels.laws.laws:
        control, reference = f"ctrl:{law.actuator}", f"reference:{law.actuator}"
        if control in found and reference in found and not _is_named(control, channels):
            raise RecordingError(
                f"{where}: it holds {control!r} and {reference!r}, and "
                f"[controllers.{law.actuator}] computes the control from the reference; remove one "
                "of the columns, or give the measured control the name of a sensor"
            )


def _is_named(column: str, channels: Channels) -> bool:
    """Whether the experiment file names a column of the log as the source of an output."""
    return any(
        source.column == column
        for name, source in channels.spec.sources.items()
        if name not in channels.control_columns
    )


def check_references(
    where: Path, channels: Channels, columns: Mapping[str, Array], stated: Collection[str]
) -> None:
    """Refuse references of hinges that are probably in degrees, beside positions in radians.

    Args:
        where: The log, for the message.
        channels: The signals of the experiment.
        columns: (M,) values by name of the recording's column, NaN where empty.
        stated: Names of the columns whose unit the experiment file states; they are not checked.

    Raises:
        RecordingError: A reference moves as many times farther than the joint as a radian has
            degrees.
    """
    laws = channels.laws
    if laws is None:
        return

    for law in laws.laws:
        column = laws.inputs[law.columns["reference"]]
        position = columns.get(f"qpos:{law.joint}")
        if position is None or column.unit != ANGLE or column.name in stated:
            continue

        both = np.isfinite(position) & np.isfinite(columns[column.name])
        q, r = (each[both] - each[both].mean() for each in (position, columns[column.name]))
        square, product = float(q @ q), float(q @ r)
        if product <= MIN_CORRELATION * np.sqrt(square * float(r @ r)):
            continue
        if abs(product / square / DEGREES - 1.0) < TOLERANCE:
            raise RecordingError(
                f"{where}: {column.name!r} moves {product / square:.3g} times as far as "
                f"'qpos:{law.joint}'; it is probably in deg: state unit = \"deg\" for it in "
                '[recording.columns], or unit = "rad" if it is not'
            )

"""Labels with which the results of verbs are shown."""

from __future__ import annotations

from mjfim.records.design import Design
from mjfim.records.estimate import Estimate
from mjfim.records.labels import Labels
from mjfim.records.monte_carlo import MonteCarloStudy


def complete_labels(record: Design | Estimate | MonteCarloStudy) -> Labels:
    """Return the labels of a record; numbers in place of names where the record has no labels.

    Records of earlier versions have none.

    Args:
        record: The record.
    """
    if record.labels is not None:
        return record.labels

    units = ("",) * len(record.parameters)
    if isinstance(record, Estimate):
        units = record.units
    if not isinstance(record, Design):
        return Labels(
            qpos=(),
            positions=(),
            velocities=(),
            controls=(),
            parameters=record.parameters,
            parameter_units=units,
        )

    trajectory = record.trajectory
    velocities = trajectory.qvel.shape[1]
    return Labels(
        qpos=_numbered("qpos", trajectory.qpos.shape[1]),
        positions=_numbered("position", velocities),
        velocities=_numbered("velocity", velocities),
        controls=_numbered("control", trajectory.ctrl.shape[1]),
        parameters=record.parameters,
        parameter_units=units,
    )


def _numbered(quantity: str, count: int) -> tuple[str, ...]:
    """Return labels with a number in place of a name."""
    return tuple(f"{quantity} {i} [model unit]" for i in range(count))

"""Plots of the positions, velocities and controls of trajectories in Rerun."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass

import mujoco
import rerun.blueprint as rrb

from mjfim.arrays import Array
from mjfim.model.coordinates import control_names, dof_names
from mjfim.output import vocabulary
from mjfim.output.rerun.iterates import IterateCurves
from mjfim.output.rerun.limits import LimitsByName, limits_in_order
from mjfim.output.rerun.panels import dof_positions, grid_tabs
from mjfim.output.rerun.series import Curve, Range, SeriesPlot, views_of
from mjfim.output.rerun.shapes import RobotStyle
from mjfim.records.labels import Labels
from mjfim.records.trajectory import Trajectory

# Groups of plots and the kinds of the limits that belong to them.
GROUPS = {"positions": "position", "velocities": "velocity", "controls": "control"}


@dataclass(frozen=True, kw_only=True)
class ShownTrajectory:
    """A trajectory that is drawn.

    Attributes:
        name: Its name, in entities and legends.
        trajectory: The trajectory.
        style: Style in which it is drawn.
    """

    name: str
    trajectory: Trajectory
    style: RobotStyle


@dataclass(frozen=True, kw_only=True, eq=False)
class StatePlots:
    """Plots of the states and controls of several trajectories.

    Attributes:
        groups: Plots by group: "positions", "velocities" and "controls".
    """

    groups: Mapping[str, Sequence[SeriesPlot]]

    @property
    def plots(self) -> Iterator[SeriesPlot]:
        """All plots."""
        for plots in self.groups.values():
            yield from plots

    def titles_and_limits(self, group: str) -> list[tuple[str, Range]]:
        """Return title and limits of each plot of a group.

        Args:
            group: The group.
        """
        return [(plot.title, plot.limits) for plot in self.groups[group]]

    def tabs(self) -> list[rrb.Container]:
        """Return the tabs of all groups."""
        tabs: list[rrb.Container] = []
        for name, plots in self.groups.items():
            tabs += grid_tabs(name, views_of(plots))
        return tabs


def state_plots(
    model: mujoco.MjModel,
    labels: Labels,
    trajectories: Sequence[ShownTrajectory],
    limits: LimitsByName,
    iterates: IterateCurves | None = None,
) -> StatePlots:
    """Make the plots of trajectories.

    Args:
        model: The model.
        labels: Labels of the model's columns.
        trajectories: The trajectories.
        limits: Limits of the plotted quantities.
        iterates: Iterates of a search, whose lowest and highest values are drawn on the timeline
            `iteration`; None without any.
    """
    positions = [dof_positions(model, shown.trajectory.qpos) for shown in trajectories]
    names = {"positions": dof_names(model), "controls": control_names(model)}
    titles = {
        "positions": labels.positions,
        "velocities": labels.velocities,
        "controls": labels.controls,
    }
    groups = {}
    for group, kind in GROUPS.items():
        bounds = limits_in_order(limits, kind, names.get(group, names["positions"]))
        plots = []
        for column, (title, limit) in enumerate(zip(titles[group], bounds, strict=True)):
            curves = [
                _curve(shown, group, position, column)
                for shown, position in zip(trajectories, positions, strict=True)
            ]
            if iterates is not None:
                curves.append(_extremes(iterates, group, column))
            plots.append(SeriesPlot(parts=(group, title), title=title, curves=curves, limits=limit))
        groups[group] = plots
    return StatePlots(groups=groups)


def _curve(shown: ShownTrajectory, group: str, positions: Array, column: int) -> Curve:
    """One column of a trajectory over time."""
    trajectory, colour = shown.trajectory, shown.style.accent
    if group == "controls":
        t, values = trajectory.t[:-1], trajectory.ctrl[:, column]
        return Curve(name=shown.name, t=t, values=values, colour=colour, look="steps")

    values = positions[:, column] if group == "positions" else trajectory.qvel[:, column]
    return Curve(name=shown.name, t=trajectory.t, values=values, colour=colour)


def _extremes(iterates: IterateCurves, group: str, column: int) -> Curve:
    """Lowest and highest value of one column of each iterate."""
    if group == "controls":
        values = iterates.controls
    else:
        values = iterates.positions if group == "positions" else iterates.velocities
    return iterates.extremes(values[:, :, column], vocabulary.DESIGNED.rgb)

"""Positions and controls over time of the iterate that a live view shows."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mjfim.arrays import Array
from mjfim.experiment.labels import labels_of_model
from mjfim.model.coordinates import control_names, dof_names
from mjfim.output.rerun.limits import limits_in_order, limits_of_model
from mjfim.output.rerun.panels import dof_positions, grid_tabs, plot_size
from mjfim.output.rerun.scene import entity_path
from mjfim.output.rerun.series import Range, range_with_limits
from mjfim.output.rerun.strips import StripPlot
from mjfim.records.design import IterateMotion

# A plot reaches to the limits if its range is then at most this many times as large.
LARGEST_ZOOM = 3.0

# Groups of curves, which are the names of their tabs, and the kinds of their limits.
GROUPS = {"positions": "position", "controls": "control"}


class LiveCurves:
    """Plots of the positions and the controls of a motion, whose axes grow with what they show."""

    def __init__(self, model: mujoco.MjModel, colour: tuple[int, int, int]) -> None:
        """Prepare the plots.

        Args:
            model: The model.
            colour: Colour of the curves (0..255).
        """
        self._model = model
        self._colour = colour

        labels, limits = labels_of_model(model), limits_of_model(model)
        titles = {"positions": labels.positions, "controls": labels.controls}
        names = {"positions": dof_names(model), "controls": control_names(model)}
        self._limits = {
            group: limits_in_order(limits, kind, names[group]) for group, kind in GROUPS.items()
        }
        self._plots = {group: _empty_plots(group, titles[group]) for group in GROUPS}

        # Lowest and highest value that each plot has shown.
        self._seen = {
            group: [(np.inf, -np.inf)] * len(plots) for group, plots in self._plots.items()
        }

    def tabs(self) -> list[rrb.Container]:
        """Return a tab for each group that has plots."""
        tabs: list[rrb.Container] = []
        for group, plots in self._plots.items():
            tabs += grid_tabs(group, [plot.view() for plot in plots])
        return tabs

    def log(self, rec: rr.RecordingStream, motion: IterateMotion) -> None:
        """Log the curves of a motion and their axes, at the time that is set.

        Args:
            rec: The connection.
            motion: The motion.
        """
        t = np.asarray(motion.t, dtype=np.float64)
        values = {
            "positions": dof_positions(self._model, np.asarray(motion.qpos, dtype=np.float64)),
            "controls": np.asarray(motion.ctrl, dtype=np.float64),
        }
        for group, plots in self._plots.items():
            for column, plot in enumerate(plots):
                self._log_curve(rec, group, column, plot, t, values[group][:, column])

    def _log_curve(
        self,
        rec: rr.RecordingStream,
        group: str,
        column: int,
        plot: StripPlot,
        t: Array,
        values: Array,
    ) -> None:
        """Log one curve with its axes, which hold everything that was shown before."""
        seen, limits = self._seen[group][column], self._limits[group][column]
        low, high = min(seen[0], float(values.min())), max(seen[1], float(values.max()))
        self._seen[group][column] = (low, high)

        y: Range = range_with_limits(low, high, limits, LARGEST_ZOOM)
        shown = replace(plot, x=(0.0, float(t[-1]) or 1.0), y=y)
        shown.log_axes(rec, limits, static=False)
        curve = shown.curve(t, values, self._colour)
        rec.log(entity_path((*plot.parts, "iterate")), curve, strict=True)


def _empty_plots(group: str, titles: tuple[str, ...]) -> list[StripPlot]:
    """Plots of a group before anything is shown in them."""
    return [
        StripPlot(
            parts=(group, title),
            title=f"{title} over time [s]",
            x=(0.0, 1.0),
            y=(-1.0, 1.0),
            size=plot_size(len(titles), k),
        )
        for k, title in enumerate(titles)
    ]

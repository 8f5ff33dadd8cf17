"""Panels of a Rerun recording that show signals: what is logged for each, and the view that draws it.

Series are on the timeline `sim_time`. The optimiser's history is on `iteration` and, as static bars, on both.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.model.coordinates import split_unit
from mjfim.output.labels import Labels
from mjfim.output.rerun.scene import Route, entity, time_column
from mjfim.output.rerun.shapes import Look
from mjfim.records.design import Design, HistoryRow


def dof_positions(model: mujoco.MjModel, qpos: Array) -> Array:
    """(N+1, nv) positions per degree of freedom [m or rad]; quaternions become rotation vectors. qpos: (N+1, nq)."""
    out = np.empty((len(qpos), model.nv))
    for kind, q, v in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        joint, shift = mujoco.mjtJoint(int(kind)), 0
        if joint in (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE):
            out[:, v] = qpos[:, q]
            continue
        if joint == mujoco.mjtJoint.mjJNT_FREE:
            out[:, v : v + 3], shift = qpos[:, q : q + 3], 3
        for row, quaternion in zip(out, qpos[:, q + shift : q + shift + 4], strict=True):
            mujoco.mju_quat2Vel(row[v + shift : v + shift + 3], quaternion, 1.0)
    return out


# Series over simulated time


def log_line(
    rec: rr.RecordingStream, path: Route, t: Array, values: Array, name: str, look: Look
) -> None:
    """One curve on `sim_time`. t, values: (n,); rows without a finite value are left out."""
    rec.log(
        entity(path),
        rr.SeriesLines(colors=[look.accent], names=[name], widths=[2.0]),
        static=True,
        strict=True,
    )
    _send(rec, path, t, values)


def log_steps(
    rec: rr.RecordingStream, path: Route, t: Array, values: Array, name: str, look: Look
) -> None:
    """A value held from each sample to the next. t, values: (n,)."""
    hold = rr.components.InterpolationMode.StepAfter
    style = rr.SeriesLines(
        colors=[look.accent], names=[name], widths=[2.0], interpolation_mode=hold
    )
    rec.log(entity(path), style, static=True, strict=True)
    _send(rec, path, t, values)


def log_dots(
    rec: rr.RecordingStream, path: Route, t: Array, values: Array, name: str, look: Look
) -> None:
    """Measured samples as dots. t, values: (n,)."""
    style = rr.SeriesPoints(colors=[look.accent], names=[name], marker_sizes=[1.5])
    rec.log(entity(path), style, static=True, strict=True)
    _send(rec, path, t, values)


def _send(rec: rr.RecordingStream, path: Route, t: Array, values: Array) -> None:
    """The finite rows of a series. t, values: (n,)."""
    finite = np.isfinite(values)
    if finite.any():
        columns = rr.Scalars.columns(scalars=values[finite])
        rec.send_columns(entity(path), [time_column(t[finite])], columns, strict=True)


def series_view(path: Route, title: str, legend: bool = True) -> rrb.TimeSeriesView:
    """All curves under a path; one legend for several small plots is enough."""
    corner = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend)
    return rrb.TimeSeriesView(origin=entity(path), name=title, plot_legend=corner)


def series_views(path: Route, titles: Sequence[str], legend: bool = False) -> list[rrb.View]:
    """One view per title, of the curves under `path / title`; the legend, if any, in the first."""
    return [series_view((*path, title), title, legend and k == 0) for k, title in enumerate(titles)]


@dataclass(frozen=True)
class Block:
    """A part of the layout and the height it wants, in rows of small plots."""

    content: rrb.View | rrb.Container
    rows: int = 1


def grid(name: str, views: Sequence[rrb.View], columns: int = 3, page: int = 9) -> list[Block]:
    """Views in one grid, or in tabs of `page` views each where there are more; empty for no views."""
    pages = [views[k : k + page] for k in range(0, len(views), page)]
    titles = [f"{name} {k + 1}" for k in range(len(pages))] if len(pages) > 1 else [name]
    columns = min(columns, len(views))
    grids = [
        rrb.Grid(*part, grid_columns=columns, name=title)
        for part, title in zip(pages, titles, strict=False)
    ]
    if not grids:
        return []
    rows = -(-len(pages[0]) // columns)
    return [Block(grids[0] if len(grids) == 1 else rrb.Tabs(*grids, active_tab=0, name=name), rows)]


def stack(blocks: Sequence[Block], name: str | None = None) -> rrb.Vertical:
    """Blocks above each other, each as high as it wants."""
    return rrb.Vertical(
        *(b.content for b in blocks), row_shares=[b.rows for b in blocks], name=name
    )


# Phase plots of the sensitivity


MAX_PHASES = 9


def shown_parameters(design: Design) -> list[int]:
    """Wanted parameters that move something; of many, those of the largest relative standard deviation."""
    moving = [
        j
        for j in design.wanted
        if any(e.sensitivity[..., j].any() for e in (design.initial, design.final))
    ]
    size = np.where(design.theta == 0.0, 1.0, np.abs(design.theta))
    known = np.where(np.isfinite(design.final.std), design.final.std, 0.0) / size
    return sorted(sorted(moving, key=lambda j: -known[j])[:MAX_PHASES])


@dataclass(frozen=True)
class Phase:
    """One phase plot: what parameter `index` does to degree of freedom `dof`, both trajectories on one scale.

    scale: (2,) largest |psi| of position and velocity [x-unit / theta-unit]
    """

    index: int
    dof: int
    parameter: str
    scale: Array

    @classmethod
    def most_sensitive(cls, design: Design, index: int, nv: int) -> Phase:
        """The degree of freedom on whose position the parameter has most influence in the designed trajectory."""
        psi = np.abs(design.final.sensitivity[:, :, index])
        dof = int(np.argmax(psi[:, :nv].max(axis=0)))
        both = np.concatenate(
            [
                np.abs(e.sensitivity[:, [dof, nv + dof], index])
                for e in (design.initial, design.final)
            ]
        )
        scale = both.max(axis=0)
        return cls(index, dof, design.parameters[index], np.where(scale > 0.0, scale, 1.0))

    @property
    def route(self) -> Route:
        """Entity under which the plot is logged."""
        return ("phase", self.parameter)

    def curve(self, sensitivity: Array, nv: int) -> Array:
        """(N+1, 2) points in the plot's frame (x right in -1.5..1.5, y down in -1..1). sensitivity: (N+1, nx, p)."""
        psi = sensitivity[:, [self.dof, nv + self.dof], self.index]
        return np.asarray(psi / self.scale * (1.5, -1.0))

    def log_axes(self, rec: rr.RecordingStream, names: Labels) -> None:
        """Axes through zero, with the value at each positive end, per unit of the parameter."""
        units = [
            split_unit(name)[1] for name in (names.positions[self.dof], names.velocities[self.dof])
        ]
        ends = np.array([[1.65, 0.0], [0.0, -1.1]])
        lines, grey = [[-ends[0], ends[0]], [-ends[1], ends[1]]], [150, 150, 150]
        style = rr.LineStrips2D(lines, colors=[grey] * 2, radii=rr.Radius.ui_points(0.5))
        rec.log(entity((*self.route, "axes")), style, static=True, strict=True)
        labels = [
            f"{1.1 * value:.2g} {unit}" for value, unit in zip(self.scale, units, strict=True)
        ]
        marks = rr.Points2D(
            ends * (0.8, 1.0),
            labels=labels,
            colors=[grey] * 2,
            radii=rr.Radius.ui_points(1.0),
            show_labels=True,
        )
        rec.log(entity((*self.route, "ends")), marks, static=True, strict=True)

    def log_curve(
        self, rec: rr.RecordingStream, t: Array, points: Array, name: str, look: Look
    ) -> None:
        """The whole curve, and a dot that moves along it with `sim_time`. points: (N+1, 2)."""
        line = rr.LineStrips2D([points], colors=[look.accent], radii=rr.Radius.ui_points(1.0))
        rec.log(entity((*self.route, name)), line, static=True, strict=True)
        path = entity((*self.route, name, "now"))
        style = rr.Points2D.from_fields(colors=[look.accent], radii=rr.Radius.ui_points(3.5))
        rec.log(path, style, static=True, strict=True)
        rec.send_columns(path, [time_column(t)], rr.Points2D.columns(positions=points), strict=True)

    def view(self, names: Labels) -> rrb.Spatial2DView:
        """The plot, titled with what stands on each axis."""
        title = f"ψ of {self.parameter}: {split_unit(names.positions[self.dof])[0]} →  velocity ↑"
        bounds = rrb.VisualBounds2D(x_range=[-1.9, 1.9], y_range=[-1.3, 1.3])
        return rrb.Spatial2DView(origin=entity(self.route), name=title, visual_bounds=bounds)


# History of an optimisation


def history_series(history: Sequence[HistoryRow]) -> dict[str, tuple[NDArray[np.int64], Array]]:
    """Title -> (iterations, values); log10 where every value is positive, rows without a value left out."""
    columns: dict[str, Callable[[HistoryRow], float]] = {
        "cost": lambda row: row.cost,
        "λ_min": lambda row: row.min_eigenvalue,
        "slope": lambda row: abs(row.slope),
    }
    out = {}
    iterations = np.array([row.iteration for row in history], dtype=np.int64)
    for title, column in columns.items():
        values = np.array([column(row) for row in history], dtype=np.float64)
        finite = np.isfinite(values) & ((values != 0.0) if title != "cost" else True)
        n, values = iterations[finite], values[finite]
        logarithmic = len(values) > 0 and bool(np.all(values > 0.0))
        out[f"log10 {title}" if logarithmic else title] = (
            n,
            np.log10(values) if logarithmic else values,
        )
    steps = np.array([row.gamma for row in history], dtype=np.float64)
    out["step length"] = iterations[np.isfinite(steps)], steps[np.isfinite(steps)]
    return out


def log_history(
    rec: rr.RecordingStream, history: Sequence[HistoryRow], looks: Sequence[Look]
) -> None:
    """Every series on `iteration`, and as static bars over the iteration number."""
    for (title, (n, values)), look in zip(history_series(history).items(), looks, strict=False):
        path = ("history", title)
        style = rr.SeriesLines(colors=[look.accent], names=[title], widths=[2.0])
        rec.log(entity(path), style, static=True, strict=True)
        if len(n):
            columns = rr.Scalars.columns(scalars=values)
            rec.send_columns(
                entity(path), [rr.TimeColumn("iteration", sequence=n)], columns, strict=True
            )
            bars = rr.BarChart(values, abscissa=n, color=look.accent)
            rec.log(entity(("bars", title)), bars, static=True, strict=True)


def history_bars(history: Sequence[HistoryRow]) -> rrb.Tabs:
    """Bars of each series by iteration, the same on every timeline."""
    hidden = rrb.PlotLegend(visible=False)
    bars = [
        rrb.BarChartView(
            origin=entity(("bars", title)), name=f"{title} by iteration", plot_legend=hidden
        )
        for title, (n, _) in history_series(history).items()
        if len(n)
    ]
    return rrb.Tabs(*bars, active_tab=0, name="optimiser")


def history_lines(history: Sequence[HistoryRow]) -> list[rrb.View]:
    """Each series as a line; they show on the timeline `iteration` only."""
    filled = [title for title, (n, _) in history_series(history).items() if len(n)]
    return [series_view(("history", title), title, legend=False) for title in filled]

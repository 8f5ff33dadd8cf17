"""Panels of signals over simulated time: their logged series, views and layout."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import mujoco
import numpy as np
import rerun as rr
import rerun.blueprint as rrb

from mjfim.arrays import Array
from mjfim.output.rerun.scene import EntityParts, entity_path, time_column
from mjfim.output.rerun.shapes import RobotStyle

# Width of curves, and size of dots [points].
LINE_WIDTH, DOT_SIZE = 2.0, 1.5


def dof_positions(model: mujoco.MjModel, qpos: Array) -> Array:
    """Return positions by degree of freedom; quaternions become rotation vectors.

    Args:
        model: The model.
        qpos: (N+1, nq) positions.

    Returns:
        (N+1, nv) positions [m or rad].
    """
    positions = np.empty((len(qpos), model.nv))
    for kind, q, v in zip(model.jnt_type, model.jnt_qposadr, model.jnt_dofadr, strict=True):
        joint = mujoco.mjtJoint(int(kind))
        if joint in (mujoco.mjtJoint.mjJNT_SLIDE, mujoco.mjtJoint.mjJNT_HINGE):
            positions[:, v] = qpos[:, q]
        elif joint == mujoco.mjtJoint.mjJNT_FREE:
            positions[:, v : v + 3] = qpos[:, q : q + 3]
            positions[:, v + 3 : v + 6] = _rotation_vectors(qpos[:, q + 3 : q + 7])
        else:
            positions[:, v : v + 3] = _rotation_vectors(qpos[:, q : q + 4])
    return positions


def _rotation_vectors(quaternions: Array) -> Array:
    """Return (n, 3) rotation vectors [rad] of quaternions (n, 4), wxyz."""
    vectors = np.empty((len(quaternions), 3))
    for vector, quaternion in zip(vectors, quaternions, strict=True):
        mujoco.mju_quat2Vel(vector, quaternion, 1.0)
    return vectors


# ---- series over simulated time


def log_line(
    rec: rr.RecordingStream,
    parts: EntityParts,
    t: Array,
    values: Array,
    *,
    name: str,
    style: RobotStyle,
) -> None:
    """Log a curve on `sim_time`.

    Args:
        rec: The recording.
        parts: Entity of the curve.
        t: (n,) times [s].
        values: (n,) values; those that are not finite are left out.
        name: Name in the legend.
        style: Style with the colour.
    """
    line = rr.SeriesLines(colors=[style.accent], names=[name], widths=[LINE_WIDTH])
    _log_series(rec, parts, line, t, values)


def log_steps(
    rec: rr.RecordingStream,
    parts: EntityParts,
    t: Array,
    values: Array,
    *,
    name: str,
    style: RobotStyle,
) -> None:
    """Log a value that is held from each sample to the next.

    Args:
        rec: The recording.
        parts: Entity of the curve.
        t: (n,) times [s].
        values: (n,) values; those that are not finite are left out.
        name: Name in the legend.
        style: Style with the colour.
    """
    line = rr.SeriesLines(
        colors=[style.accent],
        names=[name],
        widths=[LINE_WIDTH],
        interpolation_mode=rr.components.InterpolationMode.StepAfter,
    )
    _log_series(rec, parts, line, t, values)


def log_dots(
    rec: rr.RecordingStream,
    parts: EntityParts,
    t: Array,
    values: Array,
    *,
    name: str,
    style: RobotStyle,
) -> None:
    """Log measured samples as dots.

    Args:
        rec: The recording.
        parts: Entity of the dots.
        t: (n,) times [s].
        values: (n,) values; those that are not finite are left out.
        name: Name in the legend.
        style: Style with the colour.
    """
    dots = rr.SeriesPoints(colors=[style.accent], names=[name], marker_sizes=[DOT_SIZE])
    _log_series(rec, parts, dots, t, values)


def _log_series(
    rec: rr.RecordingStream,
    parts: EntityParts,
    appearance: rr.SeriesLines | rr.SeriesPoints,
    t: Array,
    values: Array,
) -> None:
    """Log the appearance of a series and its finite values, if there are any. t, values: (n,)."""
    finite = np.isfinite(values)
    if not finite.any():
        return

    columns = rr.Scalars.columns(scalars=values[finite])
    rec.log(entity_path(parts), appearance, static=True, strict=True)
    rec.send_columns(entity_path(parts), [time_column(t[finite])], columns, strict=True)


def series_view(parts: EntityParts, title: str, *, legend: bool = True) -> rrb.TimeSeriesView:
    """Return a view of all curves under an entity.

    Args:
        parts: The entity.
        title: Title of the view.
        legend: False to hide the legend.
    """
    corner = rrb.PlotLegend(rrb.Corner2D.LeftTop, visible=legend)
    return rrb.TimeSeriesView(origin=entity_path(parts), name=title, plot_legend=corner)


def series_views(
    parts: EntityParts, titles: Sequence[str], *, legend: bool = False
) -> list[rrb.View]:
    """Return a view per title, of the curves under the entity with that name.

    Args:
        parts: Entity above those of the titles.
        titles: The titles.
        legend: True for a legend in the first view.
    """
    views: list[rrb.View] = []
    for k, title in enumerate(titles):
        views.append(series_view((*parts, title), title, legend=legend and k == 0))
    return views


# ---- layout


@dataclass(frozen=True, kw_only=True)
class LayoutPart:
    """A part of the layout.

    Attributes:
        content: The view or container.
        rows: Height relative to other parts, in rows of small plots.
    """

    content: rrb.View | rrb.Container
    rows: int = 1


def grid_parts(
    name: str, views: Sequence[rrb.View], *, columns: int = 3, per_page: int = 9
) -> list[LayoutPart]:
    """Arrange views in a grid, or in several tabs of one grid each.

    Args:
        name: Name of the grid.
        views: The views.
        columns: Largest number of columns.
        per_page: Largest number of views in a grid.

    Returns:
        A list with one part; an empty one without views.
    """
    if not views:
        return []

    columns = min(columns, len(views))
    pages = [views[k : k + per_page] for k in range(0, len(views), per_page)]
    rows = -(-len(pages[0]) // columns)
    if len(pages) == 1:
        return [LayoutPart(content=rrb.Grid(*views, grid_columns=columns, name=name), rows=rows)]

    grids = [
        rrb.Grid(*page, grid_columns=columns, name=f"{name} {k}")
        for k, page in enumerate(pages, start=1)
    ]
    return [LayoutPart(content=rrb.Tabs(*grids, active_tab=0, name=name), rows=rows)]


def stack_parts(parts: Sequence[LayoutPart], name: str | None = None) -> rrb.Vertical:
    """Arrange parts above each other, with heights by their rows.

    Args:
        parts: The parts.
        name: Name of the stack.
    """
    contents = [part.content for part in parts]
    return rrb.Vertical(*contents, row_shares=[part.rows for part in parts], name=name)

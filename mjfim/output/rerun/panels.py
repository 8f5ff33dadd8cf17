"""Groups of panels, and positions as they are plotted."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import rerun.blueprint as rrb

from mjfim.arrays import Array

# Largest number of plots on one page of a tab: at 1280 x 800 pixels each one is higher than 150
# pixels, so that its axis has at least two numbers.
PLOTS_PER_PAGE = 6

# Largest number of plots that are above each other rather than in two columns.
MAX_SINGLE_COLUMN = 3

# Width and height of a tab with signals in a window of 1280 x 800 pixels, height of the names of
# its pages, and height of the title of a plot [points].
TAB_WIDTH, TAB_HEIGHT, PAGES_HEIGHT, TITLE_HEIGHT = 767.0, 706.0, 28.0, 30.0

# Width of a tab beside its name, and of one character of the name [points].
TAB_ROOM, CHARACTER_WIDTH = 34.0, 6.2


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


# ---- layout


def grid_tabs(name: str, views: Sequence[rrb.View]) -> list[rrb.Container]:
    """Arrange views in two columns, on as many pages as they need.

    Args:
        name: Name of the group, which is that of its tab.
        views: The views.

    Returns:
        The tab, whose pages are tabs in it; none without views.
    """
    count = len(views)
    pages = [[views[k] for k in page] for page in pages_of(count)]
    if not pages:
        return []
    if len(pages) == 1:
        return [rrb.Grid(*views, grid_columns=_columns(count), name=name)]

    grids = [
        rrb.Grid(*shown, grid_columns=_columns(len(shown)), name=_name_of_page(page, count))
        for page, shown in zip(pages_of(count), pages, strict=True)
    ]
    return [rrb.Tabs(*grids, name=name, active_tab=0)]


def pages_of(count: int) -> list[range]:
    """Return the numbers of the plots on each page of a group, from 0.

    Args:
        count: Number of plots of the group.
    """
    if not count:
        return []
    pages = np.array_split(np.arange(count), _page_count(count))
    return [range(int(page[0]), int(page[-1]) + 1) for page in pages]


def _name_of_page(page: range, count: int) -> str:
    """Name of a page of several: the plots that it holds."""
    return f"{page.start + 1} to {page.stop} of {count}"


def fit_in_a_row(names: Sequence[str]) -> bool:
    """Return whether the names of tabs fit beside each other in a window of 1280 x 800 pixels.

    Args:
        names: The names.
    """
    characters = sum(len(name) for name in names)
    return TAB_ROOM * len(names) + CHARACTER_WIDTH * characters <= TAB_WIDTH


def plot_size(count: int, number: int = 0) -> tuple[float, float]:
    """Return width and height of a plot in a window of 1280 x 800 pixels [points].

    Args:
        count: Number of plots of its group, at least 1.
        number: Number of the plot, from 0; pages may differ by one plot.
    """
    pages = pages_of(count)
    shown = next(len(page) for page in pages if number in page)
    columns = _columns(shown)
    return TAB_WIDTH / columns, row_height(-(-shown // columns), len(pages))


def row_height(rows: int, pages: int) -> float:
    """Return the height of a plot below its title in a window of 1280 x 800 pixels [points].

    Args:
        rows: Number of plots above each other.
        pages: Number of pages of the group.
    """
    height = TAB_HEIGHT - (PAGES_HEIGHT if pages > 1 else 0.0)
    return height / rows - TITLE_HEIGHT


def _page_count(count: int) -> int:
    """Number of pages that the plots of a group need."""
    return max(-(-count // PLOTS_PER_PAGE), 1)


def _columns(count: int) -> int:
    """Number of columns in which the plots of a page are arranged."""
    return 1 if count <= MAX_SINGLE_COLUMN else 2

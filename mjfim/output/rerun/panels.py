"""Groups of panels, and positions as they are plotted."""

from __future__ import annotations

from collections.abc import Sequence

import mujoco
import numpy as np
import rerun.blueprint as rrb

from mjfim.arrays import Array

# Largest number of plots in one tab: at 1280 x 800 pixels each one is higher than 150 pixels.
PLOTS_PER_TAB = 8

# Largest number of plots that are above each other rather than in two columns.
MAX_SINGLE_COLUMN = 3

# Width and height of a tab with signals in a window of 1280 x 800 pixels, and height of the title
# of a plot [points].
TAB_WIDTH, TAB_HEIGHT, TITLE_HEIGHT = 767.0, 706.0, 30.0


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


def grid_tabs(name: str, views: Sequence[rrb.View]) -> list[rrb.Grid]:
    """Arrange views in two columns, in as many tabs as they need.

    Args:
        name: Name of the group; the tabs of a large group are numbered.
        views: The views.

    Returns:
        A grid for each tab; none without views.
    """
    pages = np.array_split(np.arange(len(views)), _page_count(len(views)))
    tabs = []
    for number, page in enumerate(pages, start=1):
        label = name if len(pages) == 1 else f"{name} {number}"
        shown = [views[k] for k in page.tolist()]
        tabs.append(rrb.Grid(*shown, grid_columns=_columns(len(shown)), name=label))
    return tabs if len(views) else []


def plot_size(count: int) -> tuple[float, float]:
    """Return width and height of a plot in a window of 1280 x 800 pixels [points].

    Args:
        count: Number of plots of its group.
    """
    shown = -(-count // _page_count(count))
    columns = _columns(shown)
    rows = max(-(-shown // columns), 1)
    return TAB_WIDTH / columns, TAB_HEIGHT / rows - TITLE_HEIGHT


def _page_count(count: int) -> int:
    """Number of tabs that the plots of a group need."""
    return max(-(-count // PLOTS_PER_TAB), 1)


def _columns(count: int) -> int:
    """Number of columns in which the plots of a tab are arranged."""
    return 1 if count <= MAX_SINGLE_COLUMN else 2

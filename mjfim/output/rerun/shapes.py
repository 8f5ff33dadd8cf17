"""Geoms of a MuJoCo model as Rerun archetypes, and the colours of robots."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np
import rerun as rr
from numpy.typing import NDArray

GeomType = mujoco.mjtGeom

# Surfaces are drawn filled, not as wire frames.
SOLID = rr.components.FillMode.Solid

# Colour (0..1) of a geom that sets none; MuJoCo then takes the colour of its material.
DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)

# Weights of red, green and blue in the brightness of a colour.
BRIGHTNESS_WEIGHTS = (0.30, 0.59, 0.11)

# Share of the accent colour in geoms that no joint moves; the rest of their colour is grey.
FIXED_ACCENT_SHARE = 0.1

# Largest group of geoms that MuJoCo's viewer shows by default.
LAST_SHOWN_GROUP = 2

# Radius of the sticks of a stick figure, as a share of the model's extent.
STICK_RADIUS = 0.02

# Squares along each side of a ground plane.
BOARD_SQUARES = 12

# Brightness of every second square of a ground plane.
DARK_SQUARE = 0.8


@dataclass(frozen=True, kw_only=True)
class RobotStyle:
    """Style in which one robot and its curves are drawn.

    Attributes:
        accent: Accent colour (0..255).
        accent_share: Share of the accent colour in the moving geoms; the rest is grey of equal
            brightness.
        opacity: Opacity of the moving geoms (0..1).
    """

    accent: tuple[int, int, int]
    accent_share: float = 0.9
    opacity: float = 1.0

    def geom_colour(self, rgba: Iterable[float], moving: bool) -> list[int]:
        """Return the colour (0..255, with opacity) in which a geom is drawn.

        Args:
            rgba: Colour of the geom in the model (0..1).
            moving: False for a geom that no joint moves; it is grey and opaque.
        """
        model_rgba = np.fromiter(rgba, dtype=np.float64)
        grey = np.full(3, 255.0 * float(model_rgba[:3] @ BRIGHTNESS_WEIGHTS))
        share = self.accent_share if moving else FIXED_ACCENT_SHARE
        opacity = self.opacity if moving else 1.0

        colour = share * np.array(self.accent) + (1.0 - share) * grey
        alpha = 255.0 * model_rgba[3] * opacity
        return [round(float(channel)) for channel in (*colour, alpha)]


# ---- geoms of a body


def drawn_geoms(model: mujoco.MjModel, body: int) -> list[int]:
    """Return the geoms that MuJoCo's viewer shows.

    If a body has geoms of hidden groups only, these are returned.

    Args:
        model: The model.
        body: Number of the body.
    """
    first = int(model.body_geomadr[body])
    geoms = range(first, first + int(model.body_geomnum[body]))
    visible = [geom for geom in geoms if geom_rgba(model, geom)[3] > 0.0]
    shown = [geom for geom in visible if model.geom_group[geom] <= LAST_SHOWN_GROUP]
    return shown or visible


def geom_rgba(model: mujoco.MjModel, geom: int) -> tuple[float, ...]:
    """Return the colour (0..1) of a geom, as MuJoCo's renderer chooses it.

    The colour of the material counts unless the geom sets one.

    Args:
        model: The model.
        geom: Number of the geom.
    """
    rgba = tuple(float(channel) for channel in model.geom_rgba[geom])
    material = int(model.geom_matid[geom])
    if material >= 0 and np.allclose(rgba, DEFAULT_RGBA):
        return tuple(float(channel) for channel in model.mat_rgba[material])
    return rgba


def geom_shape(model: mujoco.MjModel, geom: int, rgba: list[int]) -> rr.AsComponents | None:
    """Return the archetype of a geom in its own frame.

    Args:
        model: The model.
        geom: Number of the geom.
        rgba: Colour (0..255).

    Returns:
        The archetype; None for types without a surface.
    """
    kind = GeomType(int(model.geom_type[geom]))
    # Half sizes [m]; a radius and a half length for round types.
    a, b, c = (float(size) for size in model.geom_size[geom])
    match kind:
        case GeomType.mjGEOM_SPHERE:
            return rr.Ellipsoids3D(half_sizes=[[a, a, a]], colors=[rgba], fill_mode=SOLID)
        case GeomType.mjGEOM_ELLIPSOID:
            return rr.Ellipsoids3D(half_sizes=[[a, b, c]], colors=[rgba], fill_mode=SOLID)
        case GeomType.mjGEOM_BOX:
            return rr.Boxes3D(half_sizes=[[a, b, c]], colors=[rgba], fill_mode=SOLID)
        case GeomType.mjGEOM_CYLINDER:
            return rr.Cylinders3D(lengths=[2 * b], radii=[a], colors=[rgba], fill_mode=SOLID)
        case GeomType.mjGEOM_CAPSULE:
            return _capsule(b, a, rgba)
        case GeomType.mjGEOM_PLANE:
            return _ground_plane(model, a, b, rgba)
        case GeomType.mjGEOM_HFIELD:
            return _height_field(model, int(model.geom_dataid[geom]), rgba)
        case GeomType.mjGEOM_MESH | GeomType.mjGEOM_SDF:
            return _mesh(model, int(model.geom_dataid[geom]), rgba)
    return None


def stick_figure(model: mujoco.MjModel, body: int, rgba: list[int]) -> tuple[rr.AsComponents, ...]:
    """Return shapes for a body without geoms: a ball, and sticks to its children.

    Args:
        model: The model.
        body: Number of the body.
        rgba: Colour (0..255).
    """
    radius = STICK_RADIUS * float(model.stat.extent)
    ball = rr.Ellipsoids3D(half_sizes=[[1.5 * radius] * 3], colors=[rgba], fill_mode=SOLID)

    children = np.flatnonzero(model.body_parentid == body)
    ends = [model.body_pos[child] for child in children]
    ends = [end for end in ends if np.any(end != 0.0)]
    if not ends:
        return (ball,)

    # Capsules run along z: each is turned towards its end. MuJoCo writes quaternions as wxyz, Rerun
    # as xyzw.
    wxyz = np.empty((len(ends), 4))
    for quaternion, end in zip(wxyz, ends, strict=True):
        mujoco.mju_quatZ2Vec(quaternion, end / np.linalg.norm(end))
    sticks = rr.Capsules3D(
        lengths=np.linalg.norm(ends, axis=1),
        radii=[radius] * len(ends),
        quaternions=np.roll(wxyz, -1, axis=1),
        colors=[rgba] * len(ends),
        fill_mode=SOLID,
    )
    return ball, sticks


# ---- single types


def _capsule(half_length: float, radius: float, rgba: list[int]) -> rr.Capsules3D:
    """Return a capsule along z, centred on its frame. half_length, radius: [m]."""
    # A capsule of Rerun begins at the origin of its frame.
    return rr.Capsules3D(
        lengths=[2 * half_length],
        radii=[radius],
        translations=[np.array([0.0, 0.0, -half_length])],
        colors=[rgba],
        fill_mode=SOLID,
    )


def _ground_plane(
    model: mujoco.MjModel, half_x: float, half_y: float, rgba: list[int]
) -> rr.Mesh3D:
    """Return a plane as a board of finite size. Half sizes [m] of 0 mean an infinite plane."""
    reach = 2.0 * float(model.stat.extent)
    half_sizes = (min(half_x, reach) or reach, min(half_y, reach) or reach)
    return _checkerboard(half_sizes, rgba)


def _checkerboard(half_sizes: tuple[float, float], rgba: list[int]) -> rr.Mesh3D:
    """Return the plane z = 0 as a board of squares in two tones, which shows depth.

    `half_sizes` are along x and y [m].
    """
    # (squares, 2) column and row of every square.
    squares = np.indices((BOARD_SQUARES, BOARD_SQUARES)).reshape(2, -1).T

    # (squares, 4, 2) corners of every square, counter-clockwise.
    shifts = np.array([(0, 0), (1, 0), (1, 1), (0, 1)])
    corners = squares[:, None, :] + shifts
    xy = (2.0 * corners / BOARD_SQUARES - 1.0) * half_sizes

    vertices = np.zeros((4 * len(squares), 3))
    vertices[:, :2] = xy.reshape(-1, 2)

    is_bright = squares.sum(axis=1) % 2 == 1
    brightness = np.where(is_bright, 1.0, DARK_SQUARE)
    colours = brightness[:, None] * np.array(rgba[:3])
    first_corners = 4 * np.arange(len(squares))[:, None]
    return rr.Mesh3D(
        vertex_positions=vertices,
        triangle_indices=_two_triangles(first_corners, (0, 1, 2), (0, 2, 3)),
        vertex_normals=np.broadcast_to((0.0, 0.0, 1.0), vertices.shape),
        vertex_colors=np.repeat(colours, 4, axis=0).astype(np.uint8),
    )


def _two_triangles(
    first_corners: NDArray[np.intp], first: tuple[int, ...], second: tuple[int, ...]
) -> NDArray[np.intp]:
    """Return (2n, 3) triangles, two for each of n squares.

    The corners of a triangle are the first corners (n, 1) plus the shifts `first` or `second`.
    """
    triangles = [first_corners + np.array(shifts) for shifts in (first, second)]
    return np.concatenate(triangles)


def _height_field(model: mujoco.MjModel, field: int, rgba: list[int]) -> rr.Mesh3D:
    """Return the top surface of a height field; its rows run along y, its columns along x."""
    rows, columns = int(model.hfield_nrow[field]), int(model.hfield_ncol[field])
    first = int(model.hfield_adr[field])
    half_x, half_y, top, _ = model.hfield_size[field]

    heights = model.hfield_data[first : first + rows * columns].reshape(rows, columns)
    z = top * heights
    x = np.linspace(-half_x, half_x, columns)
    y = np.linspace(-half_y, half_y, rows)
    vertices = np.stack([*np.meshgrid(x, y), z], axis=2)

    # A normal of the surface z(x, y) is (-dz/dx, -dz/dy, 1).
    slope_y, slope_x = np.gradient(z, y, x)
    normals = np.stack([-slope_x, -slope_y, np.ones_like(z)], axis=2).reshape(-1, 3)
    normals /= np.linalg.norm(normals, axis=1, keepdims=True)

    # The first corner of every rectangle between two rows and two columns.
    row_starts = np.arange(rows - 1)[:, None] * columns
    first_corners = (row_starts + np.arange(columns - 1)).reshape(-1, 1)
    return rr.Mesh3D(
        vertex_positions=vertices.reshape(-1, 3),
        triangle_indices=_two_triangles(
            first_corners, (0, 1, columns + 1), (0, columns + 1, columns)
        ),
        vertex_normals=normals,
        albedo_factor=rgba,
    )


def _mesh(model: mujoco.MjModel, index: int, rgba: list[int]) -> rr.Mesh3D:
    """Return a compiled mesh, which MuJoCo has centred.

    It has a vertex for every distinct pair of vertex and normal.
    """
    first = int(model.mesh_faceadr[index])
    faces = slice(first, first + int(model.mesh_facenum[index]))
    vertex_indices = model.mesh_face[faces].ravel()
    normal_indices = model.mesh_facenormal[faces].ravel()

    pairs = np.stack([vertex_indices, normal_indices], axis=1)
    distinct, triangles = np.unique(pairs, axis=0, return_inverse=True)
    return rr.Mesh3D(
        vertex_positions=model.mesh_vert[model.mesh_vertadr[index] + distinct[:, 0]],
        triangle_indices=triangles.reshape(-1, 3),
        vertex_normals=model.mesh_normal[model.mesh_normaladr[index] + distinct[:, 1]],
        albedo_factor=rgba,
    )

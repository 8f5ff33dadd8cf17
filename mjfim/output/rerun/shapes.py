"""Geoms of a MuJoCo model as Rerun archetypes, each in its own frame."""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import dataclass

import mujoco
import numpy as np
import rerun as rr

from mjfim.arrays import Array

GeomType = mujoco.mjtGeom
DEFAULT_RGBA = (0.5, 0.5, 0.5, 1.0)


@dataclass(frozen=True)
class Look:
    """How a robot is drawn: accent colour (0..255), its share over the geoms' own brightness, opacity."""

    accent: tuple[int, int, int]
    share: float = 0.9
    opacity: float = 1.0

    def paint(self, rgba: Iterable[float], moving: bool) -> list[int]:
        """Colour of a geom (0..255); what does not move stays grey and opaque."""
        own = np.fromiter(rgba, dtype=np.float64)
        grey = np.full(3, 255.0 * float(own[:3] @ (0.30, 0.59, 0.11)))
        share = self.share if moving else 0.1
        colour = share * np.array(self.accent) + (1.0 - share) * grey
        return [
            round(float(c)) for c in (*colour, 255.0 * own[3] * (self.opacity if moving else 1.0))
        ]


def drawn_geoms(model: mujoco.MjModel, body: int) -> list[int]:
    """Geoms as MuJoCo's viewer shows them (groups 0 to 2); those of the hidden groups where a body has no others."""
    first = int(model.body_geomadr[body])
    geoms = [
        g
        for g in range(first, first + int(model.body_geomnum[body]))
        if geom_rgba(model, g)[3] > 0.0
    ]
    return [g for g in geoms if model.geom_group[g] <= 2] or geoms


def geom_rgba(model: mujoco.MjModel, geom: int) -> tuple[float, ...]:
    """Colour (0..1): the material's unless the geom sets its own, as in MuJoCo's renderer."""
    own = tuple(float(c) for c in model.geom_rgba[geom])
    material = int(model.geom_matid[geom])
    if material >= 0 and np.allclose(own, DEFAULT_RGBA):
        return tuple(float(c) for c in model.mat_rgba[material])
    return own


def shape(model: mujoco.MjModel, geom: int, rgba: list[int]) -> rr.AsComponents | None:
    """Archetype of one geom in its own frame; sizes are half sizes [m]. None for types without a surface."""
    kind, (a, b, c) = (
        GeomType(int(model.geom_type[geom])),
        (float(s) for s in model.geom_size[geom]),
    )
    solid, colors = rr.components.FillMode.Solid, [rgba]
    match kind:
        case GeomType.mjGEOM_SPHERE:
            return rr.Ellipsoids3D(half_sizes=[[a, a, a]], colors=colors, fill_mode=solid)
        case GeomType.mjGEOM_ELLIPSOID:
            return rr.Ellipsoids3D(half_sizes=[[a, b, c]], colors=colors, fill_mode=solid)
        case GeomType.mjGEOM_BOX:
            return rr.Boxes3D(half_sizes=[[a, b, c]], colors=colors, fill_mode=solid)
        case GeomType.mjGEOM_CYLINDER:
            return rr.Cylinders3D(lengths=[2 * b], radii=[a], colors=colors, fill_mode=solid)
        case GeomType.mjGEOM_CAPSULE:
            return capsule(np.array([0.0, 0.0, -b]), 2 * b, a, rgba)
        case GeomType.mjGEOM_PLANE:
            reach = 2.0 * float(model.stat.extent)
            return checkerboard(min(a, reach) or reach, min(b, reach) or reach, rgba)
        case GeomType.mjGEOM_HFIELD:
            return height_field(model, int(model.geom_dataid[geom]), rgba)
        case GeomType.mjGEOM_MESH | GeomType.mjGEOM_SDF:
            return mesh(model, int(model.geom_dataid[geom]), rgba)
    return None


def capsule(start: Array, length: float, radius: float, rgba: list[int]) -> rr.Capsules3D:
    """Capsule that begins at `start` and runs along z [m]."""
    solid = rr.components.FillMode.Solid
    return rr.Capsules3D(
        lengths=[length], radii=[radius], translations=[start], colors=[rgba], fill_mode=solid
    )


def sticks(model: mujoco.MjModel, body: int, rgba: list[int]) -> tuple[rr.AsComponents, ...]:
    """A ball at the origin of a body without geoms, and a stick to the origin of each of its children."""
    solid, radius = rr.components.FillMode.Solid, 0.02 * float(model.stat.extent)
    ball = rr.Ellipsoids3D(half_sizes=[[1.5 * radius] * 3], colors=[rgba], fill_mode=solid)
    ends = [model.body_pos[child] for child in np.flatnonzero(model.body_parentid == body)]
    ends = [end for end in ends if np.any(end != 0.0)]
    turns = np.empty((len(ends), 4))
    for turn, end in zip(turns, ends, strict=True):
        mujoco.mju_quatZ2Vec(turn, end / np.linalg.norm(end))
    if not ends:
        return (ball,)
    return ball, rr.Capsules3D(
        lengths=np.linalg.norm(ends, axis=1),
        radii=[radius] * len(ends),
        quaternions=np.roll(turns, -1, axis=1),
        colors=[rgba] * len(ends),
        fill_mode=solid,
    )


def checkerboard(half_x: float, half_y: float, rgba: list[int], cells: int = 12) -> rr.Mesh3D:
    """Plane z = 0 as a two-tone board of squares, so that depth can be read. half_x, half_y [m]."""
    i, j = (
        index.ravel() for index in np.meshgrid(np.arange(cells), np.arange(cells), indexing="ij")
    )
    corners = np.stack(
        [np.stack([i + di, j + dj], axis=1) for di, dj in ((0, 0), (1, 0), (1, 1), (0, 1))], axis=1
    )
    xy = (2.0 * corners / cells - 1.0) * (half_x, half_y)
    vertices = np.concatenate([xy, np.zeros((*xy.shape[:2], 1))], axis=2).reshape(-1, 3)
    tone = np.where((i + j) % 2, 1.0, 0.8)[:, None] * np.array(rgba[:3])
    quads = 4 * np.arange(cells * cells)[:, None]
    return rr.Mesh3D(
        vertex_positions=vertices,
        triangle_indices=np.concatenate(
            [quads + np.array(half) for half in ((0, 1, 2), (0, 2, 3))]
        ),
        vertex_normals=np.broadcast_to((0.0, 0.0, 1.0), vertices.shape),
        vertex_colors=np.repeat(tone, 4, axis=0).astype(np.uint8),
    )


def height_field(model: mujoco.MjModel, field: int, rgba: list[int]) -> rr.Mesh3D:
    """Top surface of a height field; rows run along y, columns along x."""
    rows, cols, first = (
        int(model.hfield_nrow[field]),
        int(model.hfield_ncol[field]),
        int(model.hfield_adr[field]),
    )
    half_x, half_y, top, _ = model.hfield_size[field]
    z = top * model.hfield_data[first : first + rows * cols].reshape(rows, cols)
    x, y = np.meshgrid(np.linspace(-half_x, half_x, cols), np.linspace(-half_y, half_y, rows))
    slope_y, slope_x = np.gradient(z, 2 * half_y / (rows - 1), 2 * half_x / (cols - 1))
    normals = np.stack([-slope_x, -slope_y, np.ones_like(z)], axis=2).reshape(-1, 3)
    corner = (np.arange(rows - 1)[:, None] * cols + np.arange(cols - 1)).reshape(-1, 1)
    halves = (0, 1, cols + 1), (0, cols + 1, cols)
    return rr.Mesh3D(
        vertex_positions=np.stack([x, y, z], axis=2).reshape(-1, 3),
        triangle_indices=np.concatenate([corner + np.array(half) for half in halves]),
        vertex_normals=normals / np.linalg.norm(normals, axis=1, keepdims=True),
        albedo_factor=rgba,
    )


def mesh(model: mujoco.MjModel, index: int, rgba: list[int]) -> rr.Mesh3D:
    """A compiled mesh (already re-centred by MuJoCo), one vertex per distinct (vertex, normal) pair."""
    faces = slice(
        int(model.mesh_faceadr[index]), int(model.mesh_faceadr[index] + model.mesh_facenum[index])
    )
    pairs = np.stack([model.mesh_face[faces].ravel(), model.mesh_facenormal[faces].ravel()], axis=1)
    distinct, triangles = np.unique(pairs, axis=0, return_inverse=True)
    return rr.Mesh3D(
        vertex_positions=model.mesh_vert[model.mesh_vertadr[index] + distinct[:, 0]],
        triangle_indices=triangles.reshape(-1, 3),
        vertex_normals=model.mesh_normal[model.mesh_normaladr[index] + distinct[:, 1]],
        albedo_factor=rgba,
    )

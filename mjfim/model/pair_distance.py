"""Distances of single pairs of geoms, computed by MuJoCo only where its results are correct.

`mj_geomDistance` is not used where it is wrong:

- distances to planes are computed exactly here (MuJoCo takes a wrong corner of a box that stands on
  its edge);
- between a capsule and a box, MuJoCo measures the capsule's axis, and the radius is subtracted (the
  primitive collider reports deep penetration as separation);
- geoms that touch are moved apart a little to find the normal of their surfaces.

Height fields and signed distance fields are refused (`mjfim.model.geom_pairs`).
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.model.geom_pairs import GeomPair
from mjfim.model.sizes import model_length

# Array of indices.
Indices = NDArray[np.intp]

# MuJoCo's types of geoms as numbers.
PLANE = int(mujoco.mjtGeom.mjGEOM_PLANE)
SPHERE = int(mujoco.mjtGeom.mjGEOM_SPHERE)
CAPSULE = int(mujoco.mjtGeom.mjGEOM_CAPSULE)
ELLIPSOID = int(mujoco.mjtGeom.mjGEOM_ELLIPSOID)
CYLINDER = int(mujoco.mjtGeom.mjGEOM_CYLINDER)
BOX = int(mujoco.mjtGeom.mjGEOM_BOX)

# Types of geoms whose distance to a plane is exact here.
PRIMITIVES = (SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX)

# The distances below are relative to the length of the model.

# Tolerance and largest number of iterations of the convex collider. MuJoCo's defaults, 1e-6 m and
# 35, make the slopes of curved geoms inaccurate.
CCD_TOLERANCE = 1e-10
CCD_ITERATIONS = 200

# Distance that is larger than any between geoms.
INFINITE_DISTANCE = 1e6

# Radius that the axis of a capsule gets. With radius 0 the collider sometimes reports deep
# penetration as contact at distance 0.
AXIS_RADIUS = 1e-9

# Distance below which the nearest points of two surfaces do not determine their normal.
TOUCHING_DISTANCE = 1e-8

# Distance by which touching geoms are moved apart to find the normal.
PARTING_DISTANCE = 1e-5


class PairDistances:
    """Distances of p pairs of geoms at poses of all geoms.

    Attributes:
        first: (p,) numbers of the first geoms.
        second: (p,) numbers of the second geoms.
        planes: Numbers of the pairs whose second geom is a plane.
        exact: (p,) True where `lower_bounds` gives the distance itself: a primitive over a plane.
        infinite: Distance that is larger than any between geoms [m].
    """

    def __init__(self, model: Any, pairs: Sequence[GeomPair]) -> None:
        """Prepare the computation for pairs of geoms of a model, which is copied."""
        self._model = copy.copy(model)
        self._model.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
        self._length = model_length(model)
        self.infinite = INFINITE_DISTANCE * self._length
        tolerance = CCD_TOLERANCE * self._length
        self._model.opt.ccd_tolerance = min(self._model.opt.ccd_tolerance, tolerance)
        self._model.opt.ccd_iterations = max(self._model.opt.ccd_iterations, CCD_ITERATIONS)
        self._data = mujoco.MjData(self._model)

        self.first = np.array([pair.first for pair in pairs])
        self.second = np.array([pair.second for pair in pairs])

        # (2, p) types of the geoms.
        types = self._model.geom_type
        kinds = np.stack([types[self.first], types[self.second]])

        self.planes = np.flatnonzero(kinds[1] == PLANE)
        self.exact = (kinds[1] == PLANE) & np.isin(kinds[0], PRIMITIVES)
        bounding_radii = self._model.geom_rbound
        self._radii = bounding_radii[self.first] + bounding_radii[self.second]

        # Between a capsule and a box, MuJoCo measures the distance of the capsule's axis, from
        # which the radius is subtracted.
        by_axis = (np.sort(kinds, axis=0) == [[CAPSULE], [BOX]]).all(axis=0)
        capsule = np.where(kinds[0] == CAPSULE, self.first, self.second)
        self._axis_offset = np.where(by_axis, self._model.geom_size[capsule, 0], 0.0)
        axis_model = _with_capsule_axes(self._model, AXIS_RADIUS * self._length)

        # Arguments of MuJoCo's function, pair by pair.
        self._calls = [
            (axis_model if axis else self._model, pair.first, pair.second, float(offset))
            for pair, axis, offset in zip(pairs, by_axis, self._axis_offset, strict=True)
        ]

    def lower_bounds(self, positions: Array, frames: Array) -> tuple[Array, Array]:
        """Lower bounds of the distances, from bounding spheres.

        For `exact` pairs these are the distances themselves.

        Args:
            positions: (n, ngeom, 3) positions of the geoms [m].
            frames: (n, ngeom, 3, 3) frames of the geoms.

        Returns:
            (n, p) bounds [m], and (n, number of planes, 3) points of the first geoms nearest to the
            planes [m].
        """
        between = positions[:, self.second] - positions[:, self.first]
        bounds = np.sqrt(np.einsum("npi,npi->np", between, between)) - self._radii

        size = self._model.geom_size
        kind = self._model.geom_type
        points = np.empty((len(positions), len(self.planes), 3))
        for i, p in enumerate(self.planes):
            first = self.first[p]
            second = self.second[p]
            normal = frames[:, second, :, 2]
            frame = frames[:, first]

            points[:, i] = positions[:, first]
            if self.exact[p]:
                downwards = -np.einsum("nij,ni->nj", frame, normal)
                local = _farthest_points(int(kind[first]), size[first], downwards)
                points[:, i] += np.einsum("nij,nj->ni", frame, local)

            height = points[:, i] - positions[:, second]
            bounds[:, p] = np.einsum("ni,ni->n", height, normal)
            if not self.exact[p]:
                bounds[:, p] -= self._radii[p]
        return bounds, points

    def set_pose(self, positions: Array, frames: Array) -> None:
        """Set the pose of all geoms in which `distance` measures.

        Args:
            positions: (ngeom, 3) positions of the geoms [m].
            frames: (ngeom, 3, 3) frames of the geoms.
        """
        self._data.geom_xpos[:] = positions
        self._data.geom_xmat[:] = frames.reshape(-1, 9)

    def distance(self, p: int, limit: float, segment: Array | None = None) -> float:
        """Distance of one pair in the pose set by `set_pose`.

        Args:
            p: Number of the pair.
            limit: Distance beyond which MuJoCo does not search [m].
            segment: (6,) overwritten by the nearest points of the first and of the second geom [m].

        Returns:
            The distance [m] if it is below `limit`, else some number that is at least `limit`.
        """
        model, first, second, offset = self._calls[p]
        found = mujoco.mj_geomDistance(model, self._data, first, second, limit + offset, segment)
        return float(found) - offset

    def measure(
        self, rows: Indices, pairs: Indices, positions: Array, frames: Array, reach: float
    ) -> tuple[Array, Array]:
        """Distances of h pairs, each in one of n poses.

        Args:
            rows: (h,) numbers of the poses, ascending.
            pairs: (h,) numbers of the pairs.
            positions: (n, ngeom, 3) positions of the geoms [m].
            frames: (n, ngeom, 3, 3) frames of the geoms.
            reach: Distance beyond which nothing is measured [m].

        Returns:
            (h,) distances, at most reach [m], and (h, 6) the nearest points of the geoms [m].
        """
        found = np.full(len(rows), reach)
        segments = np.zeros((len(rows), 6))
        data = self._data
        posed = -1

        for i, (k, p) in enumerate(zip(rows.tolist(), pairs.tolist(), strict=True)):
            if k != posed:
                self.set_pose(positions[k], frames[k])
                posed = k
            model, first, second, offset = self._calls[p]
            limit = reach + offset
            distance = mujoco.mj_geomDistance(model, data, first, second, limit, segments[i])
            if distance < limit:
                found[i] = distance - offset
        return found, segments

    def normals(
        self,
        rows: Indices,
        pairs: Indices,
        *,
        distances: Array,
        segments: Array,
        positions: Array,
        frames: Array,
        reach: float,
    ) -> Array:
        """Unit vectors (h, 3) from the first to the second geoms, along the measured distances.

        Args:
            rows: (h,) numbers of the poses.
            pairs: (h,) numbers of the pairs.
            distances: (h,) distances by `measure` [m].
            segments: (h, 6) nearest points by `measure` [m].
            positions: (n, ngeom, 3) positions of the geoms [m].
            frames: (n, ngeom, 3, 3) frames of the geoms.
            reach: Distance beyond which nothing is measured [m].
        """
        signed = distances + self._axis_offset[pairs]
        sign = np.where(signed < 0.0, -1.0, 1.0)
        normals = (segments[:, 3:] - segments[:, :3]) * sign[:, None]

        for i in np.flatnonzero(np.abs(signed) < TOUCHING_DISTANCE * self._length):
            pose = positions[rows[i]], frames[rows[i]]
            normals[i] = self._normal_when_parted(pairs[i], *pose, reach)

        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.asarray(normals / np.where(length > 0.0, length, 1.0))

    def _normal_when_parted(self, p: int, positions: Array, frames: Array, reach: float) -> Array:
        """(3,) vector from the first to the second geom of a pair that touches.

        The geoms are moved apart a little to find it.
        """
        model, first, second, offset = self._calls[p]
        parted = positions.copy()
        between = parted[second] - parted[first]
        apart = PARTING_DISTANCE * self._length
        parted[second] += apart * between / (np.linalg.norm(between) or 1.0)
        self.set_pose(parted, frames)

        segment = np.zeros(6)
        limit = reach + offset
        distance = mujoco.mj_geomDistance(model, self._data, first, second, limit, segment)
        sign = -1.0 if distance < 0.0 else 1.0
        return np.asarray((segment[3:] - segment[:3]) * sign)


def _with_capsule_axes(model: Any, radius: float) -> Any:
    """A copy of a model in which capsules are replaced by their axes: cylinders of a radius [m]."""
    axes = copy.copy(model)
    capsules = axes.geom_type == CAPSULE
    axes.geom_type[capsules] = CYLINDER
    axes.geom_size[capsules, 0] = radius
    return axes


def _farthest_points(kind: int, size: Array, direction: Array) -> Array:
    """Points of a primitive that lie farthest along given directions.

    Args:
        kind: Type of the geom.
        size: (3,) size of the geom [m].
        direction: (n, 3) unit vectors in the frame of the geom.

    Returns:
        (n, 3) points in the frame of the geom [m].
    """
    if kind == BOX:
        return np.asarray(size * np.sign(direction))

    if kind == ELLIPSOID:
        stretched = np.linalg.norm(size * direction, axis=1, keepdims=True)
        return np.asarray(size**2 * direction / stretched)

    point = np.asarray(size[0] * direction)
    if kind == CYLINDER:
        radial = np.linalg.norm(direction[:, :2], axis=1, keepdims=True)
        point[:, :2] /= np.where(radial > 0.0, radial, 1.0)
        point[:, 2] = 0.0
    if kind != SPHERE:
        point[:, 2] += size[1] * np.sign(direction[:, 2])
    return point

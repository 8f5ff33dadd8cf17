"""Distances of single pairs of geoms, computed by MuJoCo only where its results are correct.

`mj_geomDistance` is not used where it is wrong:

- distances to planes are computed exactly here (MuJoCo takes a wrong corner of a box that stands on
  its edge);
- between a capsule and a box, MuJoCo measures the capsule's axis, and the radius is subtracted (the
  primitive collider reports deep penetration as separation);
- geoms that touch are moved apart a little to find the normal of their surfaces.

Height fields and signed distance fields are refused (`mjfim.model.clearance.pair_distance`).
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Sequence
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, unknown
from mjfim.model.elements import geom_labels, unique_names
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
        axis_model = copy.copy(self._model)
        capsules = axis_model.geom_type == CAPSULE
        axis_model.geom_type[capsules] = CYLINDER
        axis_model.geom_size[capsules, 0] = AXIS_RADIUS * self._length

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
            # Geoms that touch are moved apart a little.
            model, first, second, offset = self._calls[pairs[i]]
            parted = positions[rows[i]].copy()
            between = parted[second] - parted[first]
            apart = PARTING_DISTANCE * self._length
            parted[second] += apart * between / (np.linalg.norm(between) or 1.0)
            self.set_pose(parted, frames[rows[i]])
            segment = np.zeros(6)
            limit = reach + offset
            distance = mujoco.mj_geomDistance(model, self._data, first, second, limit, segment)
            normals[i] = (segment[3:] - segment[:3]) * (-1.0 if distance < 0.0 else 1.0)

        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.asarray(normals / np.where(length > 0.0, length, 1.0))


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


# Types of geoms for which MuJoCo has no reliable distance, in words.
REFUSED_TYPES = {
    int(mujoco.mjtGeom.mjGEOM_HFIELD): "height field",
    int(mujoco.mjtGeom.mjGEOM_SDF): "signed distance field",
}


@dataclass(frozen=True, kw_only=True)
class GeomPair:
    """Two geoms that can come near each other.

    Attributes:
        first: Number of a geom that can move.
        second: Number of the other geom; a geom that cannot move is always the second one.
        name: Name of the pair, `<geom> - <geom>`.
        bodies: Name of the pair of their bodies, `<body> - <body>`.
    """

    first: int
    second: int
    name: str
    bodies: str


def find_geom_pairs(model: Any, ignored: Collection[frozenset[str]]) -> tuple[GeomPair, ...]:
    """All pairs of geoms that move relative to each other and that may collide.

    The rules are MuJoCo's, except that it does not matter whether contacts are enabled. Left out
    are geoms of bodies that are welded together, of parent and child (unless the parent is fixed
    in the world or the flag filterparent is off), and of an `<exclude>`; contype and conaffinity
    must match. An explicit `<pair>` overrules these rules. Flexes have no geoms and are left out.

    Args:
        model: The model (`mujoco.MjModel`).
        ignored: Pairs of names of bodies whose geoms are left out.

    Raises:
        ExperimentError: A body is unknown, or a height field or signed distance field remains.
    """
    bodies = unique_names(model, "body")
    labels = geom_labels(model)
    for names in ignored:
        for name in sorted(names):
            if name not in bodies:
                raise ExperimentError(f"ignored: {unknown('body', name, bodies)}")
        if len(names) != 2:
            raise ExperimentError(
                f"ignored: {sorted(names)} is no pair of bodies; needs two different names"
            )

    selection = _Selection(model)
    body_of = [bodies[body] for body in model.geom_bodyid.tolist()]
    found = []
    for one, other in combinations(range(model.ngeom), 2):
        first, second = (one, other) if selection.can_move(one) else (other, one)
        pair = (body_of[first], body_of[second])
        if frozenset(pair) in ignored or not selection.can_come_near(first, second):
            continue

        for geom in (first, second):
            refused = REFUSED_TYPES.get(int(model.geom_type[geom]))
            if refused is not None:
                raise ExperimentError(
                    f"clearance: {labels[geom]} is a {refused}, for which MuJoCo has no reliable "
                    f"distance; ignore the bodies {pair[0]!r} and {pair[1]!r}, or use boxes or "
                    "meshes"
                )
        found.append(
            GeomPair(
                first=first,
                second=second,
                name=f"{labels[first]} - {labels[second]}",
                bodies=" - ".join(pair),
            )
        )
    return tuple(found)


class _Selection:
    """MuJoCo's selection of pairs of geoms that may collide."""

    def __init__(self, model: Any) -> None:
        """Read from a model the properties on which the selection depends."""
        self._model = model
        self._body = model.geom_bodyid.tolist()
        self._tree = model.body_treeid.tolist()
        self._weld = model.body_weldid.tolist()
        self._parent_weld = model.body_weldid[model.body_parentid].tolist()
        self._contype = model.geom_contype.tolist()
        self._conaffinity = model.geom_conaffinity.tolist()

        explicit = zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
        self._explicit = {frozenset(pair) for pair in explicit}

        # The signature of an <exclude> holds the numbers of both bodies, 16 bits each.
        signatures = model.exclude_signature.tolist()
        self._excluded = {frozenset(divmod(signature, 1 << 16)) for signature in signatures}

        filterparent_off = int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT)
        self._filters_parents = not model.opt.disableflags & filterparent_off

    def can_move(self, geom: int) -> bool:
        """Whether a geom belongs to a kinematic tree."""
        return bool(self._tree[self._body[geom]] >= 0)

    def can_come_near(self, first: int, second: int) -> bool:
        """Whether two geoms move relative to each other and may collide.

        Where only one of them can move, it is the first one.
        """
        a = self._body[first]
        b = self._body[second]
        if not self.can_move(first) or self._weld[a] == self._weld[b]:
            return False
        if frozenset((first, second)) in self._explicit:
            return True

        # Parent and child do not collide; a body that is fixed in the world is no parent.
        weld_a, weld_b = self._weld[a], self._weld[b]
        related = weld_a == self._parent_weld[weld_b] or weld_b == self._parent_weld[weld_a]
        is_filtered = self._filters_parents and weld_a and weld_b and related
        if frozenset((a, b)) in self._excluded or is_filtered:
            return False
        forward = self._contype[first] & self._conaffinity[second]
        backward = self._contype[second] & self._conaffinity[first]
        return bool(forward or backward)

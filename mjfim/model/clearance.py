"""Distances of a robot to itself and to the world at many configurations, with their slopes.

Bounding spheres show, for all configurations at once, which geoms could be within reach; MuJoCo is
called for these only. `mj_geomDistance` is not used where it is wrong:

- distances to planes are computed exactly here (MuJoCo takes a wrong corner of a box that stands on
  its edge);
- between a capsule and a box, MuJoCo measures the capsule's axis, and the radius is subtracted (the
  primitive collider reports deep penetration as separation);
- geoms that touch are moved apart a little to find the normal of their surfaces.

Height fields and signed distance fields are refused.
"""

from __future__ import annotations

import copy
from collections.abc import Collection, Sequence
from typing import Any

import mujoco
import numpy as np
from numpy.typing import NDArray

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, SimulationDivergedError, unknown
from mjfim.model.elements import geom_labels, model_length, unique_names
from mjfim.model.loading import ModelSource

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

# Types of geoms for which MuJoCo has no reliable distance, in words.
REFUSED_TYPES = {
    int(mujoco.mjtGeom.mjGEOM_HFIELD): "height field",
    int(mujoco.mjtGeom.mjGEOM_SDF): "signed distance field",
}

# Largest number of lower bounds of distances that are held in memory at once. Where there are
# more, the configurations are processed in blocks.
MAX_BOUNDS_AT_ONCE = 1 << 18


def farthest_points(kind: int, size: Array, direction: Array) -> Array:
    """Points of a primitive that lie farthest along given directions.

    Args:
        kind: Type of the geom.
        size: (3,) size of the geom [m].
        direction: (n, 3) unit vectors in the frame of the geom.

    Returns:
        (n, 3) points in the frame of the geom [m].
    """
    if kind == BOX:
        return size * np.sign(direction)

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


# Name of the geom that stands for a floor which only an experiment states.
FLOOR = "limits.floor"


def with_floor(source: ModelSource, height: float) -> ModelSource:
    """A model with a plane that touches nothing, for distances to it.

    Args:
        source: The model.
        height: Height of the plane [m].
    """
    plane = {
        "name": FLOOR,
        "type": mujoco.mjtGeom.mjGEOM_PLANE,
        "size": [0.0, 0.0, 1.0],
        "pos": [0.0, 0.0, height],
        "contype": 0,
        "conaffinity": 0,
    }
    return source.with_elements((FLOOR, height), lambda spec: spec.worldbody.add_geom(**plane))


# Two geoms that can come near each other: number of a geom that can move, number of the other geom
# (a geom that cannot move is always the second one), and name of the pair, `<geom> - <geom>`.
GeomPair = tuple[int, int, str]


def _require_pairs(ignored: Collection[frozenset[str]], bodies: Sequence[str]) -> None:
    """Require that names that are to be ignored are pairs of bodies; ExperimentError."""
    for names in ignored:
        for name in sorted(names):
            if name not in bodies:
                raise ExperimentError(f"ignored: {unknown('body', name, bodies)}")
        if len(names) != 2:
            raise ExperimentError(
                f"ignored: {sorted(names)} is no pair of bodies; needs two different names"
            )


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
    _require_pairs(ignored, bodies)
    body_of = [bodies[body] for body in model.geom_bodyid.tolist()]
    found = []
    for first, second in _pairs_that_may_collide(model):
        pair = (body_of[first], body_of[second])
        if frozenset(pair) in ignored:
            continue
        for geom in (first, second):
            refused = REFUSED_TYPES.get(model.geom_type[geom])
            if refused is not None:
                raise ExperimentError(
                    f"clearance: {labels[geom]} is a {refused}, for which MuJoCo has no reliable "
                    f"distance; ignore the bodies {pair[0]!r} and {pair[1]!r}, or use boxes or "
                    "meshes"
                )
        found.append((first, second, f"{labels[first]} - {labels[second]}"))
    return tuple(found)


def _pairs_that_may_collide(model: Any) -> list[list[int]]:
    """Numbers of two geoms each that move relative to each other and may collide by MuJoCo's rules.

    Where only one of them can move, it is the first one.
    """
    body, weld = model.geom_bodyid, model.body_weldid
    can_move = model.body_treeid[body] >= 0
    # A scene may have thousands of geoms that cannot move.
    ends = np.meshgrid(np.flatnonzero(can_move), np.arange(model.ngeom))
    codes = np.unique(np.minimum(*ends) * model.ngeom + np.maximum(*ends))
    pairs = np.stack(divmod(codes, model.ngeom))
    pairs = pairs[:, pairs[0] != pairs[1]]
    pairs = np.where(can_move[pairs[0]], pairs, pairs[::-1])
    second = pairs[1]
    # Every geom that moves has a distance to a floor that only an experiment states.
    chosen = second == mujoco.mj_name2id(model, mujoco.mjtObj.mjOBJ_GEOM, FLOOR)
    chosen |= np.isin(_codes(pairs), _codes(np.stack([model.pair_geom1, model.pair_geom2])))
    # Parent and child do not collide; a body that is fixed in the world is no parent.
    weld_a, weld_b = weld[body[pairs]]
    parent = weld[model.body_parentid]
    may_collide = (weld_a != parent[weld_b]) & (weld_b != parent[weld_a])
    may_collide |= (weld_a == 0) | (weld_b == 0)
    if model.opt.disableflags & mujoco.mjtDisableBit.mjDSBL_FILTERPARENT:
        may_collide[:] = True
    # The signature of an <exclude> holds the numbers of both bodies, 16 bits each.
    excluded = np.stack(divmod(model.exclude_signature, 1 << 16))
    may_collide &= ~np.isin(_codes(body[pairs]), _codes(excluded))
    types, affinities = model.geom_contype[pairs], model.geom_conaffinity[pairs[::-1]]
    chosen |= may_collide & (types & affinities).any(axis=0)
    found: list[list[int]] = pairs[:, chosen & (weld_a != weld_b)].T.tolist()
    return found


def _codes(pairs: Indices) -> Indices:
    """(n,) one number for each pair of numbers (2, n), whatever their order."""
    low, high = np.sort(pairs.astype(np.int64), axis=0)
    return np.asarray(low << 32 | high)


# Signed distances at n configurations, in m columns: (n, m) distances [m], negative in penetration,
# at most the reach, NaN at configurations that are not finite; and their (n, m, nv) slopes d(d)/dq,
# q in the tangent space of qpos as in `mj_integratePos`, zero where d is the reach, or None where
# slopes were not asked for.
SignedDistances = tuple[Array, Array | None]


class GeomDistances:
    """Distances between chosen pairs of geoms.

    Attributes:
        reach: Distance beyond which nothing is measured [m].
        pairs: The p pairs in the order of the columns.
        columns: Names of the m columns.
    """

    def __init__(
        self,
        model: Any,
        chosen: Sequence[GeomPair],
        reach: float,
        grouped: bool = True,
        *,
        max_bounds: int = MAX_BOUNDS_AT_ONCE,
    ) -> None:
        """Prepare the computation for pairs of geoms of a model.

        Args:
            model: The model (`mujoco.MjModel`), which is copied; mocap bodies keep the poses that
                it states.
            chosen: Pairs by `find_geom_pairs`, at least one.
            reach: Distance beyond which nothing is measured [m].
            grouped: Columns are pairs of bodies (the minimum over their pairs of geoms) instead of
                pairs of geoms.
            max_bounds: Largest number of lower bounds that are held in memory at once.

        Raises:
            ExperimentError: There is no pair, or the reach is not positive and finite.
        """
        if not chosen:
            raise ExperimentError(
                "clearance: no two geoms can come near each other; needs a moving geom whose "
                "contype and conaffinity match"
            )
        self.reach = float(reach)
        self._max_bounds = max_bounds

        # Pairs of one column are adjacent, columns in the order in which they first appear.
        body = model.geom_bodyid.tolist()
        keys = [
            (body[first], body[second]) if grouped else (first, second)
            for first, second, _ in chosen
        ]
        number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
        order = sorted(range(len(chosen)), key=lambda i: number[keys[i]])
        self.pairs = tuple(chosen[i] for i in order)
        self._column = np.array([number[keys[i]] for i in order])
        self._first_of_column = np.searchsorted(self._column, np.arange(len(number)))

        leaders = [self.pairs[i] for i in self._first_of_column]
        bodies = unique_names(model, "body")
        self.columns = tuple(
            f"{bodies[body[first]]} - {bodies[body[second]]}" if grouped else name
            for first, second, name in leaders
        )

        # (m, nv): +1 where a degree of freedom moves the second body only, -1 where the first only,
        # else 0.
        moved = np.zeros((model.nbody, model.nv))
        for each in range(1, model.nbody):
            dof, count = model.body_dofadr[each], model.body_dofnum[each]
            moved[each] = moved[model.body_parentid[each]]
            moved[each, dof : dof + count] = 1.0
        self._dof_sign = np.array(
            [moved[body[second]] - moved[body[first]] for first, second, _ in leaders]
        )

        self._length = model_length(model)
        self._infinite = INFINITE_DISTANCE * self._length
        if not 0.0 < reach < self._infinite:
            raise ExperimentError(
                f"clearance: reach {reach:g} m; needs a positive, finite distance"
            )
        self._model = copy.copy(model)
        options = self._model.opt
        options.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
        options.ccd_tolerance = min(options.ccd_tolerance, CCD_TOLERANCE * self._length)
        options.ccd_iterations = max(options.ccd_iterations, CCD_ITERATIONS)
        self._data = mujoco.MjData(self._model)
        # The poses in which distances are measured.
        self._posed = mujoco.MjData(self._model)
        self._prepare_pairs()

    def _prepare_pairs(self) -> None:
        """Set what the distance of each pair needs."""
        model = self._model
        self._first = np.array([first for first, _, _ in self.pairs])
        self._second = np.array([second for _, second, _ in self.pairs])
        # (2, p) types of the geoms.
        kinds = model.geom_type[np.stack([self._first, self._second])]
        # Numbers of the pairs whose second geom is a plane, and (p,) True for a primitive over a
        # plane, whose lower bound is the distance itself.
        self._planes = np.flatnonzero(kinds[1] == PLANE)
        self._exact = (kinds[1] == PLANE) & np.isin(kinds[0], PRIMITIVES)
        radii = model.geom_rbound[self._first] + model.geom_rbound[self._second]
        self._radii = np.where(self._exact, 0.0, radii)
        # Between a capsule and a box, MuJoCo measures the distance of the capsule's axis, from
        # which the radius is subtracted.
        by_axis = (np.sort(kinds, axis=0) == [[CAPSULE], [BOX]]).all(axis=0)
        capsule = np.where(kinds[0] == CAPSULE, self._first, self._second)
        self._axis_offset = np.where(by_axis, model.geom_size[capsule, 0], 0.0)
        axis_model = copy.copy(model)
        capsules = axis_model.geom_type == CAPSULE
        axis_model.geom_type[capsules] = CYLINDER
        axis_model.geom_size[capsules, 0] = AXIS_RADIUS * self._length
        # Arguments of MuJoCo's function, pair by pair.
        self._calls = [
            (axis_model if axis else model, first, second, float(offset))
            for (first, second, _), axis, offset in zip(
                self.pairs, by_axis, self._axis_offset, strict=True
            )
        ]

    def __call__(self, qpos: Array, slopes: bool) -> SignedDistances:
        """Distances of every column at every configuration.

        Args:
            qpos: (n, nq) configurations.
            slopes: Whether their slopes are computed as well.
        """
        rows = max(self._max_bounds // len(self.pairs), 1)
        starts = range(0, max(len(qpos), 1), rows)
        blocks = [self._block(qpos[k : k + rows], slopes) for k in starts]

        d = np.concatenate([block for block, _ in blocks])
        found = [slope for _, slope in blocks if slope is not None]
        return d, np.concatenate(found) if slopes else None

    def nearest(self, qpos: Array) -> tuple[float, str]:
        """The smallest distance at any configuration, however large it is.

        Args:
            qpos: (n, nq) configurations, n > 0, finite.

        Returns:
            The distance [m] and the name of its pair.

        Raises:
            SimulationDivergedError: A configuration is not finite.
        """
        infinite = np.flatnonzero(~np.isfinite(qpos).all(axis=1))
        if infinite.size:
            raise SimulationDivergedError(
                f"configuration {infinite[0]} is not finite; it has no clearance"
            )

        positions, frames, _ = self._poses(qpos, False)
        bounds = self._lower_bounds(positions, frames)[0].T.copy()
        # No point of a geom goes farther [m]. A plane stands still.
        moved, turned = (x - np.roll(x, 1, axis=0) for x in (positions, frames))
        turns = self._model.geom_rbound * np.linalg.norm(turned, axis=(2, 3))
        ways = (np.linalg.norm(moved, axis=2) + turns).T.cumsum(axis=1)
        best, pair = np.inf, 0

        # What has the least bound is measured, until no bound is below the smallest distance. From
        # pose to pose a distance changes by no more than the ways of both geoms.
        least = bounds.min(axis=1)
        while least[p := least.argmin()] < best:
            bound = bounds[p]
            k, distance = bound.argmin(), least[p]
            if not self._exact[p]:
                self._set_pose(positions[k], frames[k])
                distance = self._distance(p, self._infinite, None)
                way = ways[self._first[p]] + ways[self._second[p]]
                np.maximum(bound, distance - np.abs(way - way[k]), out=bound)
            if distance < best:
                best, pair = distance, p
            bound[k] = np.inf
            least[p] = bound.min()
        return best, self.pairs[pair][2]

    def _block(self, qpos: Array, slopes: bool) -> SignedDistances:
        """Distances at configurations: (n, nq) whose bounds fit into memory. See `__call__`."""
        finite = np.asarray(np.isfinite(qpos).all(axis=1))
        safe = np.where(finite[:, None], qpos, self._model.qpos0)
        positions, frames, screws = self._poses(safe, slopes)

        # Bounds of all pairs, replaced by the distance where they are within reach.
        every, points = self._lower_bounds(positions, frames)
        every[every >= self.reach] = self.reach
        near = every < self.reach
        rows, pairs = np.nonzero(near & ~self._exact)
        distances, segments = self._measured(rows, pairs, positions, frames)
        every[rows, pairs] = distances
        every[~finite] = np.nan
        d = np.minimum.reduceat(every, self._first_of_column, axis=1)
        if screws is None:
            return d, None
        # Normals, and nearest points of the first geoms: measured pairs first, then pairs over
        # planes.
        plane_rows, plane_pairs = np.nonzero(near & self._exact)
        normals = np.concatenate(
            [
                self._normals(rows, pairs, distances, segments, (positions, frames)),
                -frames[plane_rows, self._second[plane_pairs], :, 2],
            ]
        )
        places = np.searchsorted(self._planes, plane_pairs)
        nearest_points = np.concatenate([segments[:, :3], points[plane_rows, places]])
        rows = np.concatenate([rows, plane_rows])
        pairs = np.concatenate([pairs, plane_pairs])
        # Which of these pairs are the nearest of their column, and within reach.
        column = self._column[pairs]
        value = every[rows, pairs]
        least = (value == d[rows, column]) & (value < self.reach)

        # The normal as a line (moment about the origin, direction). The product of a line and a
        # screw is the rate of the distance.
        lines = np.zeros((*d.shape, 6))
        lines[rows[least], column[least], :3] = np.cross(nearest_points[least], normals[least])
        lines[rows[least], column[least], 3:] = normals[least]
        return d, np.asarray((lines @ screws.transpose(0, 2, 1)) * self._dof_sign)

    def _lower_bounds(self, positions: Array, frames: Array) -> tuple[Array, Array]:
        """Lower bounds of the distances, from bounding spheres; for `_exact` pairs the distances.

        Args:
            positions: (n, ngeom, 3) positions of the geoms [m].
            frames: (n, ngeom, 3, 3) frames of the geoms.

        Returns:
            (n, p) bounds [m], and (n, number of planes, 3) points of the first geoms nearest to the
            planes [m].
        """
        between = positions[:, self._second] - positions[:, self._first]
        bounds = np.sqrt(np.einsum("npi,npi->np", between, between)) - self._radii
        points = positions[:, self._first[self._planes]]
        for i, p in enumerate(self._planes):
            first, second = self._first[p], self._second[p]
            normal = frames[:, second, :, 2]
            if self._exact[p]:
                frame = frames[:, first]
                downwards = -np.einsum("nij,ni->nj", frame, normal)
                kind, size = self._model.geom_type[first], self._model.geom_size[first]
                local = farthest_points(kind, size, downwards)
                points[:, i] += np.einsum("nij,nj->ni", frame, local)
            height = points[:, i] - positions[:, second]
            bounds[:, p] = np.einsum("ni,ni->n", height, normal) - self._radii[p]
        return bounds, points

    def _set_pose(self, positions: Array, frames: Array) -> None:
        """Set the positions (ngeom, 3) and frames (ngeom, 3, 3) in which `_distance` measures."""
        self._posed.geom_xpos[:] = positions
        self._posed.geom_xmat[:] = frames.reshape(-1, 9)

    def _distance(self, p: int, limit: float, segment: Array | None) -> float:
        """Distance of one pair in the pose set by `_set_pose`.

        Args:
            p: Number of the pair.
            limit: Distance beyond which MuJoCo does not search [m].
            segment: (6,) overwritten by the nearest points of the first and of the second geom [m].

        Returns:
            The distance [m] if it is below `limit`, else some number that is at least `limit`.
        """
        model, first, second, offset = self._calls[p]
        found = mujoco.mj_geomDistance(model, self._posed, first, second, limit + offset, segment)
        return float(found) - offset

    def _measured(
        self, rows: Indices, pairs: Indices, positions: Array, frames: Array
    ) -> tuple[Array, Array]:
        """Distances of h pairs, each in one of n poses.

        Args:
            rows: (h,) numbers of the poses, ascending.
            pairs: (h,) numbers of the pairs.
            positions: (n, ngeom, 3) positions of the geoms [m].
            frames: (n, ngeom, 3, 3) frames of the geoms.

        Returns:
            (h,) distances, at most the reach [m], and (h, 6) the nearest points of the geoms [m].
        """
        found = np.empty(len(rows))
        segments = np.zeros((len(rows), 6))
        posed = -1
        for i, (k, p) in enumerate(zip(rows.tolist(), pairs.tolist(), strict=True)):
            if k != posed:
                self._set_pose(positions[k], frames[k])
                posed = k
            model, first, second, offset = self._calls[p]
            found[i] = mujoco.mj_geomDistance(
                model, self._posed, first, second, self.reach + offset, segments[i]
            )
        return np.minimum(found - self._axis_offset[pairs], self.reach), segments

    def _normals(
        self,
        rows: Indices,
        pairs: Indices,
        distances: Array,
        segments: Array,
        poses: tuple[Array, Array],
    ) -> Array:
        """Unit vectors (h, 3) from the first to the second geoms, along the measured distances.

        Args:
            rows: (h,) numbers of the poses.
            pairs: (h,) numbers of the pairs.
            distances: (h,) distances by `_measured` [m].
            segments: (h, 6) nearest points by `_measured` [m].
            poses: (n, ngeom, 3) positions of the geoms [m], and (n, ngeom, 3, 3) their frames.
        """
        positions, frames = poses
        segments = segments.copy()
        signed = distances + self._axis_offset[pairs]
        for i in np.flatnonzero(np.abs(signed) < TOUCHING_DISTANCE * self._length):
            # Geoms that touch are moved apart a little.
            p = pairs[i]
            first, second = self._first[p], self._second[p]
            parted = positions[rows[i]].copy()
            between = parted[second] - parted[first]
            apart = PARTING_DISTANCE * self._length
            parted[second] += apart * between / (np.linalg.norm(between) or 1.0)
            self._set_pose(parted, frames[rows[i]])
            segments[i] = 0.0
            signed[i] = self._distance(p, self.reach, segments[i]) + self._axis_offset[p]
        sign = np.where(signed < 0.0, -1.0, 1.0)
        normals = (segments[:, 3:] - segments[:, :3]) * sign[:, None]
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return normals / np.where(length > 0.0, length, 1.0)

    def _poses(self, qpos: Array, slopes: bool) -> tuple[Array, Array, Array | None]:
        """Poses of all geoms, and motions of the degrees of freedom, at configurations.

        Args:
            qpos: (n, nq) configurations.
            slopes: Whether the motions are computed.

        Returns:
            (n, ngeom, 3) positions [m], (n, ngeom, 3, 3) frames, and (n, nv, 6) screws about the
            origin: the angular velocity per degree of freedom, then the velocity of the point of
            the body that is at the origin. None without slopes.
        """
        model, data, n = self._model, self._data, len(qpos)
        positions = np.empty((n, model.ngeom, 3))
        frames = np.empty((n, model.ngeom, 9))
        screws = np.empty((n, model.nv, 6))
        centres = np.empty((n, model.nbody, 3))

        # Views of MuJoCo's arrays. Looking up the attributes for every configuration would take
        # longer than the kinematics.
        q, xpos, xmat = data.qpos, data.geom_xpos, data.geom_xmat
        cdof, com = data.cdof, data.subtree_com
        for k, configuration in enumerate(qpos):
            q[:] = configuration
            mujoco.mj_kinematics(model, data)
            positions[k] = xpos
            frames[k] = xmat
            if slopes:
                mujoco.mj_comPos(model, data)
                screws[k] = cdof
                centres[k] = com

        frames = frames.reshape(n, model.ngeom, 3, 3)
        if not slopes:
            return positions, frames, None

        # MuJoCo's screws are about the centre of mass of the kinematic tree.
        about = centres[:, model.body_rootid[model.dof_bodyid]]
        screws[:, :, 3:] += np.cross(about, screws[:, :, :3])
        return positions, frames, screws

"""Distances of a robot to itself and to the world at many configurations, with their slopes.

Bounding spheres show, for all configurations at once, which geoms could be within reach; MuJoCo is
called for these only.
"""

from __future__ import annotations

import copy
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, SimulationDivergedError
from mjfim.model.clearance.pair_distance import GeomPair, Indices, PairDistances

# Largest number of lower bounds of distances that are held in memory at once. Where there are
# more, the configurations are processed in blocks.
MAX_BOUNDS_AT_ONCE = 1 << 18


@dataclass(frozen=True, kw_only=True, eq=False)
class SignedDistances:
    """Signed distances at n configurations, in m columns.

    Attributes:
        d: (n, m) distances [m], negative in penetration, at most the reach; NaN at configurations
            that are not finite.
        slope: (n, m, nv) d(d)/dq, q in the tangent space of qpos as in `mj_integratePos`; zero
            where d is the reach. None where slopes were not asked for.
    """

    d: Array
    slope: Array | None


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
        body = model.geom_bodyid
        keys = [
            (int(body[p.first]), int(body[p.second])) if grouped else (p.first, p.second)
            for p in chosen
        ]
        number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
        order = sorted(range(len(chosen)), key=lambda i: number[keys[i]])
        self.pairs = tuple(chosen[i] for i in order)
        self._column = np.array([number[keys[i]] for i in order])
        self._first_of_column = np.searchsorted(self._column, np.arange(len(number)))

        leaders = [self.pairs[i] for i in self._first_of_column]
        self.columns = tuple(p.bodies if grouped else p.name for p in leaders)

        # (m, nv): +1 where a degree of freedom moves the second body only, -1 where the first only,
        # else 0.
        moved = np.zeros((model.nbody, model.nv))
        for each in range(1, model.nbody):
            dof, count = model.body_dofadr[each], model.body_dofnum[each]
            moved[each] = moved[model.body_parentid[each]]
            moved[each, dof : dof + count] = 1.0
        first_bodies = body[[p.first for p in leaders]]
        second_bodies = body[[p.second for p in leaders]]
        self._dof_sign = moved[second_bodies] - moved[first_bodies]

        self._model = copy.copy(model)
        self._data = mujoco.MjData(self._model)
        self._distances = PairDistances(self._model, self.pairs)
        if not 0.0 < reach < self._distances.infinite:
            raise ExperimentError(
                f"clearance: reach {reach:g} m; needs a positive, finite distance"
            )

    def __call__(self, qpos: Array, slopes: bool) -> SignedDistances:
        """Distances of every column at every configuration.

        Args:
            qpos: (n, nq) configurations.
            slopes: Whether their slopes are computed as well.
        """
        rows = max(self._max_bounds // len(self.pairs), 1)
        starts = range(0, max(len(qpos), 1), rows)
        blocks = [self._block(qpos[k : k + rows], slopes) for k in starts]

        d = np.concatenate([block.d for block in blocks])
        found = [block.slope for block in blocks if block.slope is not None]
        return SignedDistances(d=d, slope=np.concatenate(found) if slopes else None)

    def nearest(self, qpos: Array) -> tuple[float, int, GeomPair]:
        """The smallest distance at any configuration, however large it is.

        Args:
            qpos: (n, nq) configurations, n > 0, finite.

        Returns:
            The distance [m], the row of its configuration, and its pair.

        Raises:
            SimulationDivergedError: A configuration is not finite.
        """
        infinite = np.flatnonzero(~np.isfinite(qpos).all(axis=1))
        if infinite.size:
            raise SimulationDivergedError(
                f"configuration {infinite[0]} is not finite; it has no clearance"
            )

        positions, frames, _ = self._poses(qpos, False)
        bounds, _ = self._distances.lower_bounds(positions, frames)
        best, row, pair = np.inf, 0, self.pairs[0]

        # Measure in ascending order of the bounds. Stop at the first bound that exceeds the
        # smallest distance found: no later pair can be nearer.
        ascending = np.unravel_index(np.argsort(bounds, axis=None), bounds.shape)
        for k, p in zip(*ascending, strict=True):
            distance = float(bounds[k, p])
            if distance >= best:
                break
            if not self._distances.exact[p]:
                self._distances.set_pose(positions[k], frames[k])
                distance = self._distances.distance(p, min(best, self._distances.infinite))
            if distance < best:
                best, row, pair = distance, int(k), self.pairs[p]
        return best, row, pair

    def _block(self, qpos: Array, slopes: bool) -> SignedDistances:
        """Distances at configurations: (n, nq) whose bounds fit into memory. See `__call__`."""
        finite = np.asarray(np.isfinite(qpos).all(axis=1))
        safe = np.where(finite[:, None], qpos, self._model.qpos0)
        positions, frames, screws = self._poses(safe, slopes)

        # Bounds of all pairs, replaced by the distance where they are within reach.
        distances = self._distances
        every, points = distances.lower_bounds(positions, frames)
        every[every >= self.reach] = self.reach
        near = every < self.reach
        rows, pairs = np.nonzero(near & ~distances.exact)
        found, segments = distances.measure(rows, pairs, positions, frames, self.reach)
        every[rows, pairs] = found
        every[~finite] = np.nan
        d = np.minimum.reduceat(every, self._first_of_column, axis=1)
        if screws is None:
            return SignedDistances(d=d, slope=None)

        plane_rows, plane_pairs = np.nonzero(near & distances.exact)
        slope = self._slopes(
            d,
            every,
            measured=(rows, pairs, found, segments),
            exact=(plane_rows, plane_pairs, points),
            poses=(positions, frames, screws),
        )
        return SignedDistances(d=d, slope=slope)

    def _slopes(
        self,
        d: Array,
        every: Array,
        *,
        measured: tuple[Indices, Indices, Array, Array],
        exact: tuple[Indices, Indices, Array],
        poses: tuple[Array, Array, Array],
    ) -> Array:
        """Slopes of the distances of all columns.

        The slope of a column is that of its nearest pair.

        Args:
            d: (n, m) distances of the columns [m].
            every: (n, p) distances of the pairs [m].
            measured: Rows and pairs (h,) that MuJoCo measured, their distances (h,) and nearest
                points (h, 6).
            exact: Rows and pairs (e,) over planes, and points (n, number of planes, 3) nearest to
                the planes.
            poses: Positions, frames and screws by `_poses`.

        Returns:
            (n, m, nv) slopes [m / tangent unit of qpos].
        """
        positions, frames, screws = poses
        rows, pairs, found, segments = measured
        plane_rows, plane_pairs, plane_points = exact

        # Normals, and nearest points of the first geoms: measured pairs first, then pairs over
        # planes.
        normals = self._distances.normals(
            rows,
            pairs,
            distances=found,
            segments=segments,
            positions=positions,
            frames=frames,
            reach=self.reach,
        )
        planes = self._distances.second[plane_pairs]
        plane_normals = -frames[plane_rows, planes, :, 2]
        plane_places = np.searchsorted(self._distances.planes, plane_pairs)
        normals = np.concatenate([normals, plane_normals])
        nearest_points = np.concatenate([segments[:, :3], plane_points[plane_rows, plane_places]])
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
        return np.asarray((lines @ screws.transpose(0, 2, 1)) * self._dof_sign)

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

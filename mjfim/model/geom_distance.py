"""Distances of a robot to itself and to the world at many configurations, with their slopes: MuJoCo's geom distances.

Bounding spheres say for all configurations at once which geoms could be within reach; only those ask MuJoCo.
Where `mj_geomDistance` is wrong, it is not asked that way: planes are exact here (it takes a wrong corner of a box that
stands on its edge), capsules in boxes are asked about their axis (the primitive collider calls deep penetration
separation), height fields and signed distance fields are refused.
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
from mjfim.errors import ExperimentError, SimulationDivergedError, unknown

Ids = NDArray[np.intp]


PLANE, SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX = (
    int(kind)
    for kind in (
        mujoco.mjtGeom.mjGEOM_PLANE,
        mujoco.mjtGeom.mjGEOM_SPHERE,
        mujoco.mjtGeom.mjGEOM_CAPSULE,
        mujoco.mjtGeom.mjGEOM_ELLIPSOID,
        mujoco.mjtGeom.mjGEOM_CYLINDER,
        mujoco.mjtGeom.mjGEOM_BOX,
    )
)


PRIMITIVES = (SPHERE, CAPSULE, ELLIPSOID, CYLINDER, BOX)
REFUSED = {
    int(mujoco.mjtGeom.mjGEOM_HFIELD): "height field",
    int(mujoco.mjtGeom.mjGEOM_SDF): "signed distance field",
}


CCD_TOLERANCE, CCD_ITERATIONS = 1e-10, 200  # MuJoCo's 1e-6 and 35 blur the slopes of curved geoms


FAR = 1e6  # [m], farther than anything
THIN = 1e-9  # [m], radius of a capsule's axis: at none the collider now and then calls deep penetration touching
TOUCHING = 1e-8  # [m], closer surfaces do not show their normal
APART = 1e-5  # [m], by which geoms are parted to see it
BLOCK = 1 << 18  # bounds at a time


@dataclass(frozen=True)
class GeomPair:
    """Two geoms that can come near each other. first, second: ids, the one that cannot move comes second."""

    first: int
    second: int
    name: str


@dataclass(frozen=True, eq=False)
class SignedDistances:
    """Signed distances. d: (n, m) [m], negative in penetration, at most reach;  slope: (n, m, nv) d(d)/dq, or None.

    q: tangent of qpos as in `mj_integratePos`;  the slope is zero where d is reach
    d is NaN at configurations that are not finite
    """

    d: Array
    slope: Array | None


def find_geom_pairs(model: Any, ignored: Collection[frozenset[str]]) -> tuple[GeomPair, ...]:
    """All pairs of geoms that move relative to each other and that MuJoCo would let collide, contacts enabled or not.

    As MuJoCo selects: no geoms of bodies welded together, of parent and child (unless the parent is fixed in the
    world or the flag filterparent is off) or of an `<exclude>`, contype and conaffinity must match; an explicit `<pair>`
    overrules all of these.
    ignored: pairs of names of bodies, whose geoms are left out. Flexes have no geoms and are not seen.
    Raises ExperimentError for unknown bodies, and where a height field or signed distance field is left.
    """
    bodies = _body_names(model)
    for names in ignored:
        for name in sorted(names):
            if name not in bodies:
                raise ExperimentError(f"ignored: {unknown('body', name, bodies)}")
        if len(names) != 2:
            raise ExperimentError(
                f"ignored: {sorted(names)} is no pair of bodies; needs two different names"
            )
    explicit = {
        frozenset(p) for p in zip(model.pair_geom1.tolist(), model.pair_geom2.tolist(), strict=True)
    }
    excluded = {frozenset(divmod(s, 1 << 16)) for s in model.exclude_signature.tolist()}
    body, tree = model.geom_bodyid.tolist(), model.body_treeid.tolist()
    found = []
    for first, second in combinations(range(model.ngeom), 2):
        if tree[body[first]] < 0:
            first, second = second, first
        ids = frozenset((body[first], body[second]))
        if (
            tree[body[first]] < 0
            or model.body_weldid[body[first]] == model.body_weldid[body[second]]
            or frozenset(bodies[i] for i in ids) in ignored
            or not (
                frozenset((first, second)) in explicit
                or (
                    ids not in excluded
                    and not _related(model, *ids)
                    and _compatible(model, first, second)
                )
            )
        ):
            continue
        labels = [_geom_name(model, g, bodies[body[g]]) for g in (first, second)]
        for g, label in zip((first, second), labels, strict=True):
            if int(model.geom_type[g]) in REFUSED:
                raise ExperimentError(
                    f"clearance: {label} is a {REFUSED[int(model.geom_type[g])]}, to which MuJoCo knows no reliable distance; "
                    f"ignore the bodies {bodies[body[first]]!r} and {bodies[body[second]]!r}, or use boxes or meshes"
                )
        found.append(GeomPair(first, second, " - ".join(labels)))
    return tuple(found)


def _body_names(model: Any) -> list[str]:
    """nbody names; unnamed bodies are called by their number."""
    return [
        mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_BODY, i) or f"body{i}"
        for i in range(model.nbody)
    ]


def _related(model: Any, a: int, b: int) -> bool:
    """Whether MuJoCo filters two bodies as parent and child; what is fixed in the world is nobody's parent."""
    if model.opt.disableflags & int(mujoco.mjtDisableBit.mjDSBL_FILTERPARENT):
        return False
    a, b = int(model.body_weldid[a]), int(model.body_weldid[b])
    above = model.body_weldid[model.body_parentid]
    return bool(a and b and (a == above[b] or b == above[a]))


def _compatible(model: Any, a: int, b: int) -> bool:
    """Whether the collision bits of two geoms match."""
    kind, affinity = model.geom_contype, model.geom_conaffinity
    return bool(kind[a] & affinity[b] or kind[b] & affinity[a])


def _geom_name(model: Any, geom: int, body: str) -> str:
    return mujoco.mj_id2name(model, mujoco.mjtObj.mjOBJ_GEOM, geom) or f"{body} geom {geom}"


class GeomDistances:
    """Distances between chosen pairs of geoms.

    model: copied, mocap bodies stay where it puts them
    chosen: from `pairs`, at least one;  reach: farther is not measured [m]
    grouped: columns are pairs of bodies (the minimum over their pairs of geoms) instead of pairs of geoms
    pairs: (p,) in the order of columns;  columns: m names
    """

    def __init__(
        self, model: Any, chosen: Sequence[GeomPair], reach: float, grouped: bool = True
    ) -> None:
        if not chosen:
            raise ExperimentError(
                "clearance: no two geoms can come near each other; needs a moving geom whose contype and conaffinity match"
            )
        if not 0.0 < reach < FAR:
            raise ExperimentError(
                f"clearance: reach {reach:g} m; needs a positive, finite distance"
            )
        body = model.geom_bodyid
        keys = [
            (int(body[p.first]), int(body[p.second])) if grouped else (p.first, p.second)
            for p in chosen
        ]
        number = {key: i for i, key in enumerate(dict.fromkeys(keys))}
        order = sorted(range(len(chosen)), key=lambda i: number[keys[i]])
        self.reach = float(reach)
        self.pairs = tuple(chosen[i] for i in order)
        self._column = np.array([number[keys[i]] for i in order])
        self._starts = np.searchsorted(self._column, np.arange(len(number)))
        leaders = [self.pairs[i] for i in self._starts]
        bodies = _body_names(model)
        self.columns = tuple(
            f"{bodies[body[p.first]]} - {bodies[body[p.second]]}" if grouped else p.name
            for p in leaders
        )
        moved = _moved(model)
        self._sign = (
            moved[body[[p.second for p in leaders]]] - moved[body[[p.first for p in leaders]]]
        )

        self._model = own = copy.copy(model)
        own.opt.disableflags &= ~int(mujoco.mjtDisableBit.mjDSBL_NATIVECCD)
        own.opt.ccd_tolerance = min(own.opt.ccd_tolerance, CCD_TOLERANCE)
        own.opt.ccd_iterations = max(own.opt.ccd_iterations, CCD_ITERATIONS)
        axes = copy.copy(own)
        capsules = own.geom_type == CAPSULE
        axes.geom_type[capsules], axes.geom_size[capsules, 0] = CYLINDER, THIN
        self._data = mujoco.MjData(own)
        self._first = np.array([p.first for p in self.pairs])
        self._second = np.array([p.second for p in self.pairs])
        kinds = np.stack([own.geom_type[self._first], own.geom_type[self._second]])
        self._radii = own.geom_rbound[self._first] + own.geom_rbound[self._second]
        self._planes = np.flatnonzero(kinds[1] == PLANE)
        self._exact = (kinds[1] == PLANE) & np.isin(kinds[0], PRIMITIVES)
        cored = (np.sort(kinds, axis=0) == [[CAPSULE], [BOX]]).all(axis=0)
        capsule = np.where(kinds[0] == CAPSULE, self._first, self._second)
        # what is taken off the distance that MuJoCo gives, and all that a call needs
        self._taken = np.where(cored, own.geom_size[capsule, 0], 0.0)
        self._calls = [
            (axes if c else own, p.first, p.second, float(taken))
            for p, c, taken in zip(self.pairs, cored, self._taken, strict=True)
        ]

    def __call__(self, qpos: Array, slopes: bool) -> SignedDistances:
        """Distances of every column at every configuration, qpos: (n, nq); with their slopes or without."""
        rows = max(BLOCK // len(self.pairs), 1)
        blocks = [
            self._block(qpos[k : k + rows], slopes) for k in range(0, max(len(qpos), 1), rows)
        ]
        d = np.concatenate([b.d for b in blocks])
        return SignedDistances(
            d, np.concatenate([b.slope for b in blocks if b.slope is not None]) if slopes else None
        )

    def nearest(self, qpos: Array) -> tuple[float, int, GeomPair]:
        """Smallest distance [m] at any configuration however far, its row and its geoms. qpos: (n, nq), n > 0, finite."""
        bad = np.flatnonzero(~np.isfinite(qpos).all(axis=1))
        if bad.size:
            raise SimulationDivergedError(
                f"configuration {bad[0]} is not finite; it has no clearance"
            )
        places, frames, _ = self._poses(qpos, False)
        bounds, _ = self._bounds(places, frames)
        best, row, pair = np.inf, 0, self.pairs[0]
        for k, p in zip(
            *np.unravel_index(np.argsort(bounds, axis=None), bounds.shape), strict=True
        ):
            if bounds[k, p] >= best:
                break
            distance = float(bounds[k, p])
            if not self._exact[p]:
                self._pose(places[k], frames[k])
                model, first, second, taken = self._calls[p]
                limit = min(best, FAR) + taken
                distance = (
                    mujoco.mj_geomDistance(model, self._data, first, second, limit, None) - taken
                )
            if distance < best:
                best, row, pair = distance, int(k), self.pairs[p]
        return best, row, pair

    def _block(self, qpos: Array, slopes: bool) -> SignedDistances:
        finite = np.asarray(np.isfinite(qpos).all(axis=1))
        places, frames, screws = self._poses(
            np.where(finite[:, None], qpos, self._model.qpos0), slopes
        )
        every, points = self._bounds(places, frames)
        every[every >= self.reach] = self.reach
        near = every < self.reach
        rows, which = np.nonzero(near & ~self._exact)
        found, segments = self._measure(rows, which, places, frames)
        every[rows, which] = found
        every[~finite] = np.nan
        d = np.minimum.reduceat(every, self._starts, axis=1)
        if screws is None:
            return SignedDistances(d, None)

        k, p = np.nonzero(near & self._exact)
        normals = self._normals(rows, which, found, segments, places, frames)
        normals = np.concatenate([normals, -frames[k, self._second[p], :, 2]])
        points = np.concatenate([segments[:, :3], points[k, np.searchsorted(self._planes, p)]])
        rows, which = np.concatenate([rows, k]), np.concatenate([which, p])
        column = self._column[which]
        least = (every[rows, which] == d[rows, column]) & (every[rows, which] < self.reach)
        lines = np.zeros((*d.shape, 6))
        lines[rows[least], column[least], :3] = np.cross(points[least], normals[least])
        lines[rows[least], column[least], 3:] = normals[least]
        return SignedDistances(d, (lines @ screws.transpose(0, 2, 1)) * self._sign)

    def _poses(self, qpos: Array, slopes: bool) -> tuple[Array, Array, Array | None]:
        """Positions (n, ngeom, 3) [m] and frames (n, ngeom, 3, 3) of geoms; screws (n, nv, 6) of dofs about the origin.

        A screw is the angular velocity per dof, then the velocity of the point of the body that is at the origin.
        """
        model, data, n = self._model, self._data, len(qpos)
        places, frames = np.empty((n, model.ngeom, 3)), np.empty((n, model.ngeom, 9))
        screws, centres = np.empty((n, model.nv, 6)), np.empty((n, model.nbody, 3))
        q, xpos, xmat, cdof, com = (
            data.qpos,
            data.geom_xpos,
            data.geom_xmat,
            data.cdof,
            data.subtree_com,
        )
        for k, now in enumerate(qpos):
            q[:] = now
            mujoco.mj_kinematics(model, data)
            places[k], frames[k] = xpos, xmat
            if slopes:
                mujoco.mj_comPos(model, data)
                screws[k], centres[k] = cdof, com
        frames = frames.reshape(n, model.ngeom, 3, 3)
        if not slopes:
            return places, frames, None
        about = centres[:, model.body_rootid[model.dof_bodyid]]
        screws[:, :, 3:] += np.cross(about, screws[:, :, :3])
        return places, frames, screws

    def _bounds(self, places: Array, frames: Array) -> tuple[Array, Array]:
        """Lower bounds of distances, (n, p) [m], and points of geoms nearest to planes, (n, number of planes, 3).

        Distances themselves where a primitive meets a plane.
        """
        apart = places[:, self._second] - places[:, self._first]
        bounds = np.sqrt(np.einsum("npi,npi->np", apart, apart)) - self._radii
        points = np.empty((len(places), len(self._planes), 3))
        size, kind = self._model.geom_size, self._model.geom_type
        for i, p in enumerate(self._planes):
            first, second = self._first[p], self._second[p]
            normal, frame = frames[:, second, :, 2], frames[:, first]
            points[:, i] = places[:, first]
            if self._exact[p]:
                local = _farthest(
                    int(kind[first]), size[first], -np.einsum("nij,ni->nj", frame, normal)
                )
                points[:, i] += np.einsum("nij,nj->ni", frame, local)
            bounds[:, p] = np.einsum("ni,ni->n", points[:, i] - places[:, second], normal)
            if not self._exact[p]:
                bounds[:, p] -= self._radii[p]
        return bounds, points

    def _measure(self, rows: Ids, which: Ids, places: Array, frames: Array) -> tuple[Array, Array]:
        """Distances (h,) of pairs `which` at configurations `rows`, which ascend, and the segments (h, 6) they measure."""
        calls, data, reach, last = self._calls, self._data, self.reach, -1
        found, segments = np.full(len(rows), reach), np.zeros((len(rows), 6))
        for i, (k, p) in enumerate(zip(rows.tolist(), which.tolist(), strict=True)):
            if k != last:
                self._pose(places[k], frames[k])
                last = k
            model, first, second, taken = calls[p]
            distance = mujoco.mj_geomDistance(
                model, data, first, second, reach + taken, segments[i]
            )
            if distance < reach + taken:
                found[i] = distance - taken
        return found, segments

    def _normals(
        self, rows: Ids, which: Ids, found: Array, segments: Array, places: Array, frames: Array
    ) -> Array:
        """Unit vectors (h, 3) from first to second geoms; where they touch, as seen once they are parted a little."""
        signed = found + self._taken[which]
        normals = (segments[:, 3:] - segments[:, :3]) * np.where(signed < 0.0, -1.0, 1.0)[:, None]
        for i in np.flatnonzero(np.abs(signed) < TOUCHING):
            model, first, second, taken = self._calls[which[i]]
            parted, segment = places[rows[i]].copy(), np.zeros(6)
            apart = parted[second] - parted[first]
            parted[second] += APART * apart / (np.linalg.norm(apart) or 1.0)
            self._pose(parted, frames[rows[i]])
            distance = mujoco.mj_geomDistance(
                model, self._data, first, second, self.reach + taken, segment
            )
            normals[i] = (segment[3:] - segment[:3]) * (-1.0 if distance < 0.0 else 1.0)
        length = np.linalg.norm(normals, axis=1, keepdims=True)
        return np.asarray(normals / np.where(length > 0.0, length, 1.0))

    def _pose(self, places: Array, frames: Array) -> None:
        """Put geoms where one configuration has them, (ngeom, 3) and (ngeom, 3, 3)."""
        self._data.geom_xpos[:] = places
        self._data.geom_xmat[:] = frames.reshape(-1, 9)


def _moved(model: Any) -> Array:
    """(nbody, nv): 1 where a dof moves a body, else 0."""
    moved = np.zeros((model.nbody, model.nv))
    for b in range(1, model.nbody):
        first, count = model.body_dofadr[b], model.body_dofnum[b]
        moved[b] = moved[model.body_parentid[b]]
        moved[b, first : first + count] = 1.0
    return moved


def _farthest(kind: int, size: Array, direction: Array) -> Array:
    """Points (n, 3) of a primitive that lie farthest along unit vectors (n, 3), in its own frame."""
    if kind == BOX:
        return np.asarray(size * np.sign(direction))
    if kind == ELLIPSOID:
        return np.asarray(
            size**2 * direction / np.linalg.norm(size * direction, axis=1, keepdims=True)
        )
    point = np.asarray(size[0] * direction)
    if kind == CYLINDER:
        radial = np.linalg.norm(direction[:, :2], axis=1, keepdims=True)
        point[:, :2] /= np.where(radial > 0.0, radial, 1.0)
        point[:, 2] = 0.0
    if kind != SPHERE:
        point[:, 2] += size[1] * np.sign(direction[:, 2])
    return point

"""Pairs of geoms of a model that can come near each other.

They are selected by MuJoCo's rules for collisions.
"""

from __future__ import annotations

from collections.abc import Collection
from dataclasses import dataclass
from itertools import combinations
from typing import Any

import mujoco

from mjfim.errors import ExperimentError, unknown
from mjfim.model.elements import geom_labels, unique_names

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
    _check_ignored(ignored, bodies)

    selection = _Selection(model)
    body_of = [bodies[body] for body in model.geom_bodyid.tolist()]
    found = []
    for one, other in combinations(range(model.ngeom), 2):
        first, second = (one, other) if selection.can_move(one) else (other, one)
        pair = (body_of[first], body_of[second])
        if frozenset(pair) in ignored or not selection.can_come_near(first, second):
            continue

        for geom in (first, second):
            _check_type(model, geom, labels[geom], *pair)
        found.append(
            GeomPair(
                first=first,
                second=second,
                name=f"{labels[first]} - {labels[second]}",
                bodies=" - ".join(pair),
            )
        )
    return tuple(found)


def _check_ignored(ignored: Collection[frozenset[str]], bodies: tuple[str, ...]) -> None:
    """Raise where an ignored pair does not consist of two bodies of the model."""
    for names in ignored:
        for name in sorted(names):
            if name not in bodies:
                raise ExperimentError(f"ignored: {unknown('body', name, bodies)}")
        if len(names) != 2:
            raise ExperimentError(
                f"ignored: {sorted(names)} is no pair of bodies; needs two different names"
            )


def _check_type(model: Any, geom: int, label: str, first_body: str, second_body: str) -> None:
    """Raise where MuJoCo has no reliable distance for a geom.

    Args:
        model: The model (`mujoco.MjModel`).
        geom: Number of the geom.
        label: Name of the geom, for the message.
        first_body: Name of the body of the first geom of the pair, for the message.
        second_body: Name of the body of the second geom of the pair.
    """
    refused = REFUSED_TYPES.get(int(model.geom_type[geom]))
    if refused is not None:
        raise ExperimentError(
            f"clearance: {label} is a {refused}, for which MuJoCo has no reliable distance; ignore "
            f"the bodies {first_body!r} and {second_body!r}, or use boxes or meshes"
        )


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
        if frozenset((a, b)) in self._excluded or self._are_parent_and_child(a, b):
            return False
        return self._bits_match(first, second)

    def _are_parent_and_child(self, a: int, b: int) -> bool:
        """Whether MuJoCo lets two bodies not collide because they are parent and child.

        A body that is fixed in the world does not count as a parent.
        """
        if not self._filters_parents:
            return False
        a = self._weld[a]
        b = self._weld[b]
        related = a == self._parent_weld[b] or b == self._parent_weld[a]
        return bool(a and b and related)

    def _bits_match(self, first: int, second: int) -> bool:
        """Whether the collision bits of two geoms match."""
        forward = self._contype[first] & self._conaffinity[second]
        backward = self._contype[second] & self._conaffinity[first]
        return bool(forward or backward)

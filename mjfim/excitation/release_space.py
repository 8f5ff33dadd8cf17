"""Ranges of the initial state within which a design chooses the release."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError
from mjfim.excitation.limits.limits import Limit
from mjfim.experiment.system import System
from mjfim.model.coordinates import Component, unknown_coordinate
from mjfim.plant.state_space import StateSpace

# Distance from an end of a range, relative to its width, up to which a release is at that end.
EDGE_SHARE = 1e-3


@record
class ReleaseSpace:
    """The d coordinates of the initial state that a design may choose, and their ranges.

    A release is stated by its shares: 0 at the lower and 1 at the upper end of each range.

    Attributes:
        names: Names of the coordinates, such as `qpos:hinge`.
        units: Their units.
        addresses: (d,) places of the coordinates in the tangent space.
        lower: (d,) lower ends of the ranges [x-unit].
        upper: (d,) upper ends of the ranges [x-unit].
        origin: (d,) values of the coordinates in the stated initial state; 0 for rotations of ball
            and free joints, which are relative to it [x-unit].
        stated: (ns,) stated initial state.
        space: Layout of the state.
    """

    names: tuple[str, ...]
    units: tuple[str, ...]
    addresses: np.ndarray
    lower: Array
    upper: Array
    origin: Array
    stated: Array
    space: StateSpace

    @classmethod
    def of(cls, system: System, limits: Sequence[Limit]) -> ReleaseSpace | None:
        """Resolve the ranges that an experiment states; None where it states none.

        Args:
            system: The system.
            limits: Its limits; those on positions and velocities narrow the ranges.

        Raises:
            ExperimentError: A name is unknown, or a range is empty.
        """
        stated = system.experiment.initial.free
        if not stated:
            return None

        space, start = system.space, system.nominal_initial_state
        # Positions and velocities.
        deviations = system.source.coordinates.deviations[: 2 * space.nv]
        components = {component.name: component for component in deviations}
        chosen = []
        ranges = []
        for name, (low, high) in stated.items():
            if name not in components:
                raise ExperimentError(
                    f"initial.free: {unknown_coordinate('name', name, list(components))}"
                )
            component = components[name]
            chosen.append(component)
            ranges.append(_narrowed(name, (low, high), _limit_of(system, limits, component)))

        # Rotations of quaternions are relative to the stated state.
        qpos, qvel, _ = space.split(start)
        origin = np.concatenate([np.zeros(space.nv), qvel])
        origin[space.scalar_v] = qpos[space.scalar_q]
        addresses = np.array([component.address for component in chosen], dtype=np.intp)
        lower, upper = np.array(ranges, dtype=np.float64).T
        return cls(
            names=tuple(stated),
            units=tuple(component.unit for component in chosen),
            addresses=addresses,
            lower=lower,
            upper=upper,
            origin=origin[addresses],
            stated=np.array(start),
            space=space,
        )

    def state(self, shares: Array) -> Array:
        """(ns,) nominal initial state at shares: (d,)."""
        move = np.zeros(self.space.nx)
        values = self.lower + shares * (self.upper - self.lower)
        move[self.addresses] = values - self.origin
        return self.space.plus(self.stated, move)

    def shares_of_stated(self) -> Array | None:
        """(d,) shares of the stated initial state; None where it is outside of a range."""
        shares = (self.origin - self.lower) / (self.upper - self.lower)
        inside = (shares >= 0.0).all() and (shares <= 1.0).all()
        return np.asarray(shares) if inside else None

    def edges(self, shares: Array) -> list[str]:
        """Sentences about the coordinates of a release, (d,) shares, that end a range."""
        found = []
        for i, share in enumerate(shares.tolist()):
            if EDGE_SHARE < share < 1.0 - EDGE_SHARE:
                continue
            end, value = ("lower", self.lower[i]) if share < 0.5 else ("upper", self.upper[i])
            found.append(
                f"the best release is at the {end} end of the range of {self.names[i]}, "
                f"{value:.4g} {self.units[i]}".rstrip()
                + ": a wider range in initial.free, within the limits, may tell more"
            )
        return found


def _limit_of(system: System, limits: Sequence[Limit], component: Component) -> Limit | None:
    """The enforced limit on a position or velocity of a slide or hinge joint, if there is one."""
    if not system.experiment.limits.enforce:
        return None

    kind, _, name = component.name.partition(":")
    wanted = {"qpos": "position", "qvel": "velocity"}[kind]
    return next((x for x in limits if x.kind == wanted and x.name == name), None)


def _narrowed(name: str, stated: tuple[float, float], limit: Limit | None) -> tuple[float, float]:
    """The part of a stated range that lies within a limit.

    Raises:
        ExperimentError: The range is inverted, or outside of the limit.
    """
    low, high = stated
    if not low < high:
        raise ExperimentError(
            f"initial.free.{name}: the range [{low:g}, {high:g}] needs lower < upper"
        )
    if limit is None:
        return low, high

    inside = max(low, limit.lower), min(high, limit.upper)
    if not inside[0] < inside[1]:
        raise ExperimentError(
            f"initial.free.{name}: the range [{low:g}, {high:g}] is outside of the "
            f"{limit.kind} limit [{limit.lower:g}, {limit.upper:g}]"
        )
    return inside

"""Limits of an experiment: the intersection of the ranges of the MJCF and of the file's ranges.

They narrow the ranges of the initial state within which a design chooses a release.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import field, replace
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import ExperimentError, first_ones, listed, shortened, unknown
from mjfim.experiment.system import System
from mjfim.experiment.task_tables import Limits
from mjfim.model.coordinates import TRANSLATION, Component, control_names, unknown_coordinate
from mjfim.model.limited_elements import (
    KINDS,
    OWNERS,
    LimitedElement,
    LimitedElements,
    Range,
    limited_elements,
)
from mjfim.plant.state_space import StateSpace

# What the experiment file can state for one name: a number or a range; for a free joint also a
# range for each of its three coordinates.
Stated = float | Range
Box = tuple[Range, Range, Range]

# Kinds whose ranges in the MJCF are soft, and the largest share of a range by which the experiment
# file may widen each end of it.
SOFT_KINDS = ("position", "tendon_length")
SOFT_SHARE = 0.05

# Largest number of engine steps of a sample at which the barrier is evaluated with derivatives.
MAX_DERIVATIVE_SUBSTEPS = 5


def limit_title(kind: str, name: str) -> str:
    """Name of a limit in results: `control rate of elbow`."""
    return f"{kind.replace('_', ' ')} of {name}"


@record
class Limit:
    """Range of one quantity.

    Attributes:
        kind: One of `KINDS`, "position" for example.
        name: Name of the joint, the actuator or the tendon; `<joint>.<part>` for one coordinate of
            a ball or free joint, `<actuator>[<i>]` for one force of several.
        index: Address of the quantity, see `LimitedElement`.
        lower: Lower bound, -inf without one [unit of the kind].
        upper: Upper bound, inf without one [unit of the kind].
        size: Natural size of the quantity, stated where there is a single bound [unit of the kind].
        count: Number of numbers whose norm is the quantity; 1 for a number with a sign.
        unit: Unit of the quantity; empty where the model does not determine it.
    """

    kind: str
    name: str
    index: int
    lower: float
    upper: float
    size: float = 1.0
    count: int = 1
    unit: str = field(default="", compare=False)

    def __post_init__(self) -> None:
        if not self.lower < self.upper:
            raise ExperimentError(
                f"limits.{self.kind}.{self.name}: [{self.lower:g}, {self.upper:g}] is inverted; "
                "needs lower < upper"
            )

    @property
    def title(self) -> str:
        """Its name in results."""
        return limit_title(self.kind, self.name)

    def widened(self, share: float) -> Limit:
        """The limit with bounds that lie outwards by a share of `scale`."""
        room = share * self.scale
        lower = self.lower if self.is_magnitude else self.lower - room
        return replace(self, lower=lower, upper=self.upper + room)

    @property
    def is_magnitude(self) -> bool:
        """Whether the quantity is a speed, a norm of forces or an angle, which has no sign."""
        return self.count > 1

    @property
    def is_angle(self) -> bool:
        """Whether the quantity is an angle of rotation without a sign."""
        return self.is_magnitude and self.kind in ("tilt", "position")

    @property
    def scale(self) -> float:
        """Scale that makes margins relative [unit of the kind].

        It is half of the range, or the bound of a magnitude; with a single bound, the magnitude of
        the bound, at least the natural size of the quantity.
        """
        if self.is_magnitude:
            return self.upper
        finite = [abs(bound) for bound in (self.lower, self.upper) if np.isfinite(bound)]
        if len(finite) == 2:
            return 0.5 * (self.upper - self.lower)
        return max(*finite, self.size)


def limits_of(
    model: Any,
    controls: tuple[str, ...],
    stated: Limits,
    period: float,
    added: Collection[int] = (),
) -> tuple[Limit, ...]:
    """Collect all limits, ordered by kind.

    Args:
        model: MjModel.
        controls: Names of its nu controls.
        stated: The `[limits]` table of the experiment file.
        period: Sample period, from which the natural sizes of rates follow [s].
        added: Addresses in qpos of joints that physical terms have added; one number for all joints
            does not hold for them.

    Returns:
        The limits; where MJCF and file both have a range, the intersection of the two.

    Raises:
        ExperimentError: A name is unknown, a range is inverted, a stated range excludes that of the
            MJCF, a joint cannot have a stated limit, or a stated limit applies to nothing.
    """
    found = limited_elements(model, controls, period, added)
    return tuple(
        limit for kind in KINDS for limit in _limits_of_kind(kind, getattr(stated, kind), found)
    )


def limits_of_model(model: Any) -> tuple[Limit, ...]:
    """Collect the limits that the MJCF states by itself, ordered by kind.

    Args:
        model: MjModel.
    """
    timestep = float(model.opt.timestep)
    return limits_of(model, control_names(model), Limits(), timestep)


def _limits_of_kind(
    kind: str, stated: float | Mapping[str, Stated | Box], found: LimitedElements
) -> list[Limit]:
    """All limits of one kind, in the order of the elements.

    Args:
        kind: The kind.
        stated: Numbers of the experiment file: one for all names, or a table by name.
        found: The elements of the model.

    Raises:
        ExperimentError: An angle without a sign may be half a turn, which limits nothing; see also
            `limits_of`.
    """
    by_name = _stated_ranges(kind, stated, found)
    limits = []

    for name, element in found.by_kind[kind].items():
        ranges, own = [], element.stated
        if name in by_name:
            lower, upper = by_name[name]
            # A stated range has to be valid by itself, before the MJCF's range narrows it.
            Limit(kind=kind, name=name, index=element.index, lower=float(lower), upper=float(upper))
            ranges.append((lower, upper))
            if own is not None and kind in SOFT_KINDS:
                # A stop gives way: an end that is stated a little outside of the MJCF's holds.
                room = SOFT_SHARE * (own[1] - own[0])
                low = lower if own[0] - room <= lower < own[0] else own[0]
                own = low, upper if own[1] < upper <= own[1] + room else own[1]
        if own is not None:
            ranges.append(own)
        if not ranges:
            continue

        lower, upper = _intersection(f"limits.{kind}.{name}", ranges)
        is_bounded = np.isfinite([lower, upper])
        if not is_bounded.any():
            continue
        # The natural size is stated where there is a single bound.
        limit = Limit(
            kind=kind,
            name=name,
            index=element.index,
            lower=lower,
            upper=upper,
            size=1.0 if is_bounded.all() else element.size,
            count=element.count,
            unit=element.unit,
        )
        if limit.is_angle and not upper < np.pi:
            raise ExperimentError(
                f"limits.{kind}.{name}: {upper:g} rad limits nothing: this angle is in radians, "
                "between 0 and pi"
            )
        limits.append(limit)

    return limits


def _intersection(key: str, ranges: Sequence[Range]) -> Range:
    """Intersection of the one or two ranges of a key: from the file, then from the MJCF.

    Raises:
        ExperimentError: The two ranges exclude each other.
    """
    lower = float(max(low for low, _ in ranges))
    upper = float(min(high for _, high in ranges))

    if len(ranges) == 2 and not lower < upper:
        from_file, from_model = (f"[{low:g}, {high:g}]" for low, high in ranges)
        raise ExperimentError(
            f"{key}: {from_file} and the MJCF's range {from_model} exclude each other"
        )
    return lower, upper


def _stated_ranges(
    kind: str, stated: float | Mapping[str, Stated | Box], found: LimitedElements
) -> dict[str, Range]:
    """Ranges that the experiment file states, by name.

    A single number r is the range [-r, r], or [0, r] of a magnitude. Without a table it holds for
    all names, but not for single coordinates of a joint.

    Raises:
        ExperimentError: A name is unknown or cannot have such a limit, or no name can have it.
    """
    elements = found.by_kind[kind]
    if isinstance(stated, Mapping):
        table = _with_coordinates(kind, stated, found)
    else:
        table = {name: stated for name, each in elements.items() if not each.is_part}
        if not table:
            raise ExperimentError(_applies_to_nothing(kind, found))

    for name in table:
        if name not in elements:
            raise ExperimentError(f"limits.{kind}: {_not_limited(kind, name, found)}")
    return {name: _range_of(kind, name, table[name], elements[name]) for name in table}


def _with_coordinates(
    kind: str, stated: Mapping[str, Stated | Box], found: LimitedElements
) -> dict[str, Stated]:
    """A table in which the three ranges of a free joint are those of its coordinates.

    Raises:
        ExperimentError: A joint has another number of ranges than it needs.
    """
    table: dict[str, Stated] = {}
    for name, value in stated.items():
        for coordinate, each in _by_coordinate(kind, name, value, found).items():
            # A coordinate may be stated in the box and by itself; both hold.
            earlier = table.get(coordinate)
            if isinstance(earlier, tuple) and isinstance(each, tuple):
                each = max(earlier[0], each[0]), min(earlier[1], each[1])
            table[coordinate] = each
    return table


def _by_coordinate(
    kind: str, name: str, value: Stated | Box, found: LimitedElements
) -> dict[str, Stated]:
    """One entry of a table; that of a free joint by the names of its coordinates.

    Raises:
        ExperimentError: A joint has another number of ranges than it needs.
    """
    elements = found.by_kind[kind]
    parts = [f"{name}.{part}" for part in TRANSLATION]
    needs_three = name not in elements and parts[0] in elements

    if isinstance(value, tuple) and len(value) == 3:
        if needs_three:
            return dict(zip(parts, value, strict=True))
        raise ExperimentError(
            f"limits.{kind}.{name}: three ranges are for free joints; it needs one range, "
            "[lower, upper]"
        )
    if needs_three:
        raise ExperimentError(
            f"limits.{kind}: {name!r} is {found.joints[name]}: it needs three ranges, "
            "[[lower, upper], [lower, upper], [lower, upper]] of x, y and z; or limit single "
            f"coordinates: {listed(parts)}"
        )
    return {name: value}


def _range_of(kind: str, name: str, value: Stated, element: LimitedElement) -> Range:
    """The range that a stated number or range means.

    Raises:
        ExperimentError: A magnitude has a lower bound.
    """
    is_magnitude = element.count > 1
    if not isinstance(value, tuple):
        return (0.0, value) if is_magnitude else (-value, value)

    lower, upper = value
    if is_magnitude and lower != 0.0:
        raise ExperimentError(
            f"limits.{kind}.{name}: [{lower:g}, {upper:g}] should be one number: this quantity is "
            "a magnitude, which has an upper bound only"
        )
    return lower, upper


def _applies_to_nothing(kind: str, found: LimitedElements) -> str:
    """Say that no element of the model can have a limit."""
    owner, words = OWNERS[kind]
    listing = ""
    if owner == "joint":
        reasons = [f"{shortened(repr(name))} is {what}" for name, what in found.joints.items()]
        listing = f": {first_ones(reasons, '; ')}" if reasons else ""
    return (
        f"limits.{kind} applies to nothing in this model{listing}. It limits {words} only; "
        "remove the key"
    )


def _not_limited(kind: str, name: str, found: LimitedElements) -> str:
    """Say why a name cannot have a limit, which limits it can have, and which names can."""
    owner, words = OWNERS[kind]
    names = list(found.by_kind[kind])
    if owner == "joint" and name in found.joints:
        return (
            f"{name!r} is {found.joints[name]}, which can have {listed(found.kinds_of(name))}; "
            f"this key limits {words} only; valid: {listed(sorted(names))}"
        )
    return unknown(owner, name, names)


def has_constant_forces(model: Any) -> bool:
    """Check whether a constant control means constant forces of all actuators and on all joints.

    This holds for motors that act directly on slides and hinges. The forces of servos, filtered
    actuators and muscles change with the state.

    Args:
        model: MjModel.
    """
    is_direct = model.actuator_trntype == int(mujoco.mjtTrn.mjTRN_JOINT)
    driven = model.actuator_trnid[is_direct, 0]
    scalar = (int(mujoco.mjtJoint.mjJNT_SLIDE), int(mujoco.mjtJoint.mjJNT_HINGE))
    if not is_direct.all() or not np.isin(model.jnt_type[driven], scalar).all():
        return False

    is_motor = (
        (model.actuator_gaintype == int(mujoco.mjtGain.mjGAIN_FIXED))
        & (model.actuator_biastype == int(mujoco.mjtBias.mjBIAS_NONE))
        & (model.actuator_dyntype == int(mujoco.mjtDyn.mjDYN_NONE))
    )
    is_damped = model.actuator_damping.any() or model.actuator_dampingpoly.any()
    return bool(is_motor.all()) and not is_damped and not model.jnt_actgravcomp.any()


def unsupported_ranges(model: Any) -> tuple[str, ...]:
    """Find the elements with a range in the MJCF that a design cannot keep as a limit.

    Args:
        model: MjModel.

    Returns:
        Descriptions of limited activations, with their names.
    """
    limited = np.flatnonzero(model.actuator_actlimited).tolist()
    return tuple(f"the activation of {model.actuator(i).name or f'number {i}'}" for i in limited)


def derivative_substeps_of(substeps: int) -> tuple[int, ...]:
    """Engine steps of a sample, counted from 1, at which the barrier takes derivatives.

    They are closer together at the beginning of the sample, where the control jumps.
    """
    spaced = np.geomspace(1, substeps, min(MAX_DERIVATIVE_SUBSTEPS, substeps))
    return tuple(sorted({round(step) for step in spaced.tolist()}))


# ---- ranges of a release

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

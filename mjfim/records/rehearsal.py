"""Records of a rehearsal: a design on simulated robots, and standard deviations by finite steps.

Two robots show what a motion does not determine. In a rehearsal, the first row of each array over
robots is the model at the parameters of the design; the n robots follow.
"""

from __future__ import annotations

from collections.abc import Iterable
from dataclasses import field
from typing import Any

import numpy as np

from mjfim.arrays import NORMAL_95, Array, record
from mjfim.errors import first_ones, shortened
from mjfim.records.base import Record, ShownRecord, no_array

# Ratios of the effect of a finite step to that of the derivatives that confirm a standard
# deviation.
CONFIRMED = (0.7, 1.4)

# Share of the robots that may break a limit in a motion that is safe to play.
MAX_BROKEN = 0.05

# Share of a reserve that a design keeps where it can.
KEPT_SHARE = 0.9

# Excursion of a robot over that of the model up to which a reserve makes room for it.
MAX_EXCURSION = 2.0

# A joint rests at the end where its speed is below this share of its peak.
REST_SHARE = 0.02

# Largest number of robots whose paths are compared in fans.
MAX_PATHS = 500

# Kinds of limits that hold by a clamp of the simulation, which does not count as kept.
CLAMPED_KINDS = ("force", "joint_force", "tendon_force")


@record
class FiniteSteps(Record):
    """Standard deviations that steps of finite length along their principal directions give.

    Attributes:
        names: Names of the p parameters.
        predicted: (p,) standard deviations by derivatives; infinite for a parameter that is not
            identifiable alone [theta-unit].
        std: (p,) the same by finite steps [theta-unit].
        length: (d,) half of the length of the step along each of the d principal directions, in
            standard deviations of it; 2, or less where parameters would become impossible.
        ratio: (d,) change of the whitened outputs over the step, relative to that of the
            derivatives; NaN where the simulation diverges.
        causes: Contacts, dry friction and active limits along the motion, in words.
    """

    names: tuple[str, ...]
    predicted: Array
    std: Array
    length: Array
    ratio: Array
    causes: tuple[str, ...] = ()

    @property
    def confirmed(self) -> np.ndarray:
        """(p,) True where the derivatives and the finite steps agree, or nothing is predicted."""
        known = np.isfinite(self.predicted) & (self.predicted > 0.0)
        change = np.where(known, self.std, 1.0) / np.where(known, self.predicted, 1.0)
        low, high = CONFIRMED
        return (1.0 / high <= change) & (change <= 1.0 / low)

    @property
    def stated(self) -> Array:
        """(p,) standard deviations to state: those of the finite steps where they differ."""
        return np.where(self.confirmed, self.predicted, self.std)

    def __str__(self) -> str:
        """Say which standard deviations are approximate, and why; empty where none is."""
        odd = np.flatnonzero(~self.confirmed).tolist()
        if not odd:
            return ""
        if not np.isfinite(self.std[odd]).all():
            lost = first_ones([self.names[j] for j in odd if not np.isfinite(self.std[j])])
            return f"the simulation diverges at 2 σ from {lost}, so σ is a guess{self._reason}"
        changes = [
            f"{self.names[j]} {self.std[j]:.2g} in place of {self.predicted[j]:.2g}" for j in odd
        ]
        return f"σ is approximate, by finite steps ({first_ones(changes)}){self._reason}"

    @property
    def _reason(self) -> str:
        """What makes the standard deviations approximate, where something acts."""
        if not self.causes:
            return "; the outputs depend on the parameters in a strongly curved way"
        return f"; {first_ones(list(grouped(self.causes)))} makes it approximate"


def grouped(causes: Iterable[str]) -> list[str]:
    """Return causes such as `dry friction of Jaw`, each kind once with all of its names."""
    names: dict[str, list[str]] = {}
    for cause in causes:
        kind, of, name = cause.partition(" of ")
        names.setdefault(kind + of, []).append(name)
    return [kind + first_ones(found) for kind, found in names.items()]


@record
class Separation(Record):
    """How far the measured outputs of two robots are apart along one motion.

    Attributes:
        t: (n,) times [s].
        y: (2, n) output of each robot, that in which they differ most [unit of the output].
        distance: (n,) distance of all outputs up to each time [standard deviations of the noise].
    """

    t: Array
    y: Array
    distance: Array

    in_json = ("total", "largest", "at")
    json_names = {"total": "distance", "largest": "largest_difference", "at": "time"}

    @property
    def total(self) -> float:
        """Distance of all outputs [standard deviations of the noise]."""
        return float(self.distance[-1])

    @property
    def largest(self) -> float:
        """Largest difference of the output [unit of the output]."""
        return float(np.abs(self.y[0] - self.y[1]).max())

    @property
    def at(self) -> float:
        """Time of the largest difference [s]."""
        return float(self.t[np.argmax(np.abs(self.y[0] - self.y[1]))])

    @property
    def seen_after(self) -> float:
        """Time after which a test at 95 % tells the robots apart [s]; infinite for never."""
        is_seen = self.distance > NORMAL_95
        return float(self.t[np.argmax(is_seen)]) if is_seen.any() else np.inf


# Parameters that move by less than this share of the largest relative move are not shown. Length of
# the list of those that are named in a sentence [characters].
SHOWN_MOVE, NAMES_TEXT = 0.01, 64


@record
class Valley(Record):
    """Two robots with different parameters that a motion does not tell apart.

    Attributes:
        parameters: Names of the p parameters.
        units: Their units; may be empty.
        nominal: (p,) values in the middle between the robots, at which the experiment is made.
        sizes: (p,) sizes of which percent are taken [theta-unit].
        theta: (2, p) parameters of the robots [theta-unit].
        output: Output in which they differ most, with its unit.
        sigma: Standard deviation of its noise [unit of the output].
        motion: The motion that does not tell them apart.
        designed: The designed motion; None where there is none.
    """

    parameters: tuple[str, ...]
    units: tuple[str, ...]
    nominal: Array
    sizes: Array
    theta: Array
    output: str
    sigma: float
    motion: Separation
    designed: Separation | None = None

    in_json = ("parameters", "units", "theta", "percent", "output", "sigma", "motion", "designed")

    @property
    def percent(self) -> Array:
        """(2, p) differences from the nominal values [%]."""
        return 100.0 * (self.theta - self.nominal) / self.sizes

    @property
    def moved(self) -> list[int]:
        """Parameters in which the robots differ, those that differ most first."""
        move = np.abs(np.diff(self.percent, axis=0)[0])
        order = np.argsort(-move, kind="stable")
        return [int(j) for j in order if move[j] >= SHOWN_MOVE * move.max()]

    def __str__(self) -> str:
        """Say how far the robots are apart in each motion."""
        gaps = np.abs(np.diff(self.percent, axis=0)[0])
        every = [f"{shortened(self.parameters[j])} by {gaps[j]:.3g} %" for j in self.moved]
        names = first_ones(every, longest=NAMES_TEXT)
        which = "this" if self.designed is None else "the initial"
        found = (
            f"Along {which} motion, two robots that differ in {names} are apart by "
            f"{self.motion.total:.3g} σ of the noise: too little to tell them apart."
        )
        if self.designed is None:
            return found
        name, _, unit = self.output.partition(" [")
        difference = f"{self.designed.largest:.2g} {unit.rstrip(']')}".rstrip()
        return (
            f"{found} Along the designed motion they are apart by {self.designed.total:.3g} σ, "
            f"most in {name} ({difference} at {self.designed.at:.3g} s)."
        )


@record
class LimitRange(Record):
    """A limit: a range of the MJCF, a stated one, or one whose margin is measured on robots.

    Attributes:
        kind: Kind of the limit, such as `position`, `control_rate` or `clearance`.
        name: Name of the joint or actuator; "nearest pair" for a clearance.
        lower: Lower bound [unit of the quantity].
        upper: Upper bound [unit of the quantity].
        unit: Unit of the quantity; empty where it is unknown.
        scale: Half of the range, by which margins are divided [unit of the quantity].
    """

    kind: str
    name: str
    lower: float
    upper: float
    unit: str = ""
    scale: float = 1.0

    in_json = ("kind", "name", "lower", "upper", "unit")
    json_names = {"kind": "quantity"}

    @property
    def path(self) -> str:
        """Name of the limit in a list."""
        return f"{self.kind}/{self.name}"


@record
class Fan(Record):
    """Paths of one quantity over the robots that are plausible before and after an experiment.

    Attributes:
        limit: The quantity and its range, which is infinite where nothing limits it.
        t: (n,) times [s].
        model: (n,) path of the model [unit of the quantity].
        worst: (n,) path of the robot that comes closest to the limit; NaN without a limit.
        before: (2, n) paths below which 5 % and 95 % of the robots are.
        after: (2, n) the same of robots whose parameters are drawn from what the experiment leaves
            unknown.
    """

    limit: LimitRange
    t: Array
    model: Array
    worst: Array
    before: Array
    after: Array

    in_json = ("limit.kind", "limit.name", "limit.unit", "spread_before", "spread_after")

    @property
    def spread_before(self) -> float:
        """Half of the largest distance between the two paths [unit of the quantity]."""
        return 0.5 * float((self.before[1] - self.before[0]).max())

    @property
    def spread_after(self) -> float:
        """The same after the experiment."""
        return 0.5 * float((self.after[1] - self.after[0]).max())


@record
class Rehearsal(ShownRecord):
    """Result of `mjfim.rehearse`: a design on the model and on n simulated robots.

    Attributes:
        parameters: Names of the p parameters.
        wrong: Relative error up to which parameters without a prior were drawn.
        feedback: Whether the gains acted.
        latency: Delay of the control under feedback [s].
        theta: (n+1, p) parameters of the robots [theta-unit].
        limits: The l limits.
        margins: (n+1, l) smallest margin of each limit over half of its range, negative outside;
            minus infinity for a simulation that diverges.
        joints: Names of the j moving joints; a free joint counts twice, for its two speeds.
        units: Units of their speeds.
        speed: (n+1, j) largest speeds.
        acceleration: (n+1, j) largest accelerations [unit of the speed per s].
        end_speed: (n+1, j) speeds at the end.
        travel: (n+1, j) largest distances from the start; angles for rotations [m or rad].
        unlimited: Names of those joints whose speed nothing limits.
        unplaced: Names of those joints whose position nothing limits on at least one side.
        lowest: (n+1,) smallest height of any geom or body that moves, above the floor, or in the
            world where there is none [m].
        floor: Height of the floor in the world, or of the one that is assumed; minus infinity where
            there is neither [m].
        has_floor: Whether the model or the experiment states the floor.
        depth: Height below the floor that counts as passing through it [m].
        end_height: (n+1,) height of the lowest geom or body at the end, likewise [m].
        nearest: (n+1,) smallest distance of the robot to itself and to its surroundings [m]; NaN
            where the model has none that can be measured.
        in_contact: (n+1,) share of the time in which something touches.
        at_stop: (n+1,) share of the time in which a joint is at its stop.
        unbraked: Number of robots by the joint that cannot be braked at the end before it reaches a
            limit.
        growth: Largest growth of a small deviation along the motion without feedback; NaN where it
            is unknown.
        steps: Standard deviations by finite steps.
        kept_reserve: Key `limits.reserve` that the design kept, also where it was found
            automatically; None where a design is still to find it.
        end: Key `boundary.end` of the design.
        safe_wrong: Largest of the smaller errors that were tried with which this motion is safe;
            NaN where it is safe anyway, or with none of them; None where none was tried.
        safe_with_feedback: Whether feedback makes this motion safe; None where it was not tried.
        fans: Spread of the motions, for the quantities that come closest to their limits.
        motion_times: (k,) times of the motions that are drawn [s].
        motions: (k, nq) positions of some robots by their rows in the arrays, the least safe one
            first [m or rad; unit quaternions for ball and free joints].
    """

    parameters: tuple[str, ...]
    wrong: float
    feedback: bool
    latency: float
    theta: Array
    limits: tuple[LimitRange, ...]
    margins: Array
    joints: tuple[str, ...]
    units: tuple[str, ...]
    speed: Array
    acceleration: Array
    end_speed: Array
    travel: Array
    unlimited: tuple[str, ...]
    unplaced: tuple[str, ...]
    lowest: Array
    floor: float
    has_floor: bool
    depth: float
    end_height: Array
    nearest: Array
    in_contact: Array
    at_stop: Array
    unbraked: dict[str, int]
    steps: FiniteSteps
    growth: float = float("nan")
    kept_reserve: dict[str, float] | None = field(default_factory=dict)
    end: str = "free"
    safe_wrong: float | None = None
    safe_with_feedback: bool | None = None
    fans: tuple[Fan, ...] = ()
    motion_times: Array = no_array()
    motions: dict[int, Array] = field(default_factory=dict)

    file_stem = "rehearsal"
    made_by = "`mjfim rehearse DESIGN_FOLDER -o DIR`"
    in_json = (
        "is_safe",
        "robots",
        "wrong",
        "feedback",
        "latency",
        "all_kept",
        "at_clamp",
        "below_floor",
        "floor",
        "unbraked",
        "unlimited",
        "unplaced",
        "growth",
        "steps",
        "kept_reserve",
        "safe_wrong",
        "safe_with_feedback",
        "fans",
    )
    json_names = {"is_safe": "safe", "all_kept": "all_limits_kept", "kept_reserve": "reserve"}

    @property
    def robots(self) -> int:
        """Number n of robots."""
        return len(self.margins) - 1

    @property
    def kept(self) -> np.ndarray:
        """(n+1, l) True if the model, or a robot, keeps a limit."""
        return np.where(self.is_clamped, self.margins > 0.0, self.margins >= 0.0)

    @property
    def is_clamped(self) -> np.ndarray:
        """(l,) True for a limit that holds by a clamp, which no robot can leave."""
        return np.array([limit.kind in CLAMPED_KINDS for limit in self.limits], dtype=bool)

    @property
    def at_clamp(self) -> int:
        """Number of robots that reach a clamp; the information of a design does not hold there."""
        return int((~self.kept & self.is_clamped)[1:].any(axis=1).sum())

    @property
    def diverged(self) -> int:
        """Number of robots whose simulation diverges."""
        return int(np.isnan(self.end_height[1:]).sum())

    @property
    def inside(self) -> np.ndarray:
        """(n+1,) True where every limit that is no clamp is kept."""
        is_kept = (self.kept | self.is_clamped).all(axis=1)
        return np.asarray(is_kept & ~np.isnan(self.end_height))

    @property
    def unsafe(self) -> np.ndarray:
        """(n+1,) True where a limit that is no clamp is left, or the floor is passed through."""
        return np.asarray(~self.inside | self.passes_floor)

    @property
    def all_kept(self) -> int:
        """Number of robots that keep every limit that is no clamp."""
        return int(self.inside[1:].sum())

    @property
    def too_many(self) -> float:
        """Smallest number of robots that must not do what a person would not play."""
        return max(MAX_BROKEN * self.robots, 1.0)

    @property
    def is_clamping(self) -> bool:
        """True if too many robots reach a clamp for the information of the design to hold."""
        return self.at_clamp >= self.too_many

    @property
    def passes_floor(self) -> np.ndarray:
        """(n+1,) True where a geom or body passes through the floor."""
        return np.asarray(np.isfinite(self.floor) & (self.lowest < -self.depth))

    @property
    def below_floor(self) -> int:
        """Number of robots of which a geom or body passes through the floor."""
        return int(self.passes_floor[1:].sum())

    @property
    def is_safe(self) -> bool:
        """True if a person would play the motion on a robot.

        The model keeps all limits. At least 95 % of the robots keep those that are no clamps, stay
        above the floor, and can be braked at the end before a limit.
        """
        is_model_safe = bool(self.kept[0].all()) and not self.passes_floor[0]
        broken = self.robots - self.all_kept
        worst = max(self.unbraked.values(), default=0)
        return is_model_safe and max(broken, self.below_floor, worst) < self.too_many

    @property
    def falls(self) -> bool:
        """True if too many robots, or the model, pass through the floor within all limits.

        No design within these limits is kept from it.
        """
        is_fallen = self.passes_floor & self.inside
        return bool(is_fallen[0] or np.count_nonzero(is_fallen[1:]) >= self.too_many)

    @property
    def excursions(self) -> Array:
        """(l,) largest excursion of a robot towards each limit over that of the model."""
        worst = np.where(np.isfinite(self.margins), self.margins, np.inf).min(
            axis=0, initial=np.inf
        )
        used = 1.0 - self.margins[0]
        ratio = np.divide(1.0 - worst, used, out=np.full(len(used), np.inf), where=used > 0.0)
        return np.asarray(np.maximum(ratio, 1.0))

    @property
    def is_unstable(self) -> bool:
        """True if robots leave limits because their differences grow along the motion."""
        broken = ~(self.kept | self.is_clamped).all(axis=0)
        is_far = bool((self.excursions[broken] > MAX_EXCURSION).any())
        return is_far and not self.feedback and self.growth * self.wrong > 1.0

    @property
    def reserve(self) -> dict[str, float]:
        """Larger reserve for robots that leave limits: share of half of each range by kind.

        The excursion of a robot is taken to be in proportion to that of the model. It is at most
        halved at once. Clamps come first: where one acts, everything else follows from it. A joint
        that cannot be braked needs room in its position. No larger reserve helps where the design
        could not keep the present one, because the start or the end is too near.
        """
        found: dict[str, float] = {}
        if self.is_safe and not self.is_clamping:
            return found
        late = [each.kind == "position" and each.name in self.unbraked for each in self.limits]
        broken = np.flatnonzero(~self.kept.all(axis=0) | np.array(late, dtype=bool)).tolist()
        clamped = [i for i in broken if self.is_clamped[i]]
        kept = self.kept_reserve or {}
        for i in clamped or broken:
            kind, margins = self.limits[i].kind, self.margins[:, i]
            if margins[0] < KEPT_SHARE * kept.get(kind, 0.0):
                continue
            used = 1.0 - margins[0]
            growth = max(self.excursions[i], 1.0 + self.wrong * late[i])
            growth = 1.0 + self.wrong if clamped else min(growth, MAX_EXCURSION)
            share = 1.0 - used / growth
            if kind == "clearance":
                share = margins[0] - np.min(margins[np.isfinite(margins)], initial=0.0)
            share = np.ceil(100.0 * share) / 100.0
            if kept.get(kind, 0.0) < share < 1.0:
                found[kind] = max(float(share), found.get(kind, 0.0))
        return found

    @property
    def at_rest(self) -> bool:
        """Whether the model rests at the end."""
        return bool((self.end_speed[0] <= REST_SHARE * self.speed[0]).all())

    def summary(self) -> dict[str, Any]:
        """The contents of the record in JSON."""
        return {
            **super().summary(),
            "limits": [
                {
                    "kind": limit.kind,
                    "name": limit.name,
                    "range": [limit.lower, limit.upper],
                    "unit": limit.unit,
                    "planned": float(self.margins[0, i]) * limit.scale,
                    "worst": float(self.margins[1:, i].min(initial=np.inf)) * limit.scale,
                    "kept": int(self.kept[1:, i].sum()),
                }
                for i, limit in enumerate(self.limits)
            ],
            "joints": [
                {
                    "name": name,
                    "unit": self.units[i],
                    **{
                        key: _of_robots(getattr(self, key)[:, i], key)
                        for key in ("speed", "acceleration", "end_speed", "travel")
                    },
                }
                for i, name in enumerate(self.joints)
            ],
            **{
                key: _of_robots(getattr(self, key), key)
                for key in ("lowest", "end_height", "nearest", "in_contact", "at_stop")
            },
        }


def _of_robots(values: Array, key: str) -> dict[str, float]:
    """The value of the model, and the worst one of all robots; NaN where none is known.

    The worst one is the smallest height or distance, or else the largest value.
    """
    known = values[1:][np.isfinite(values[1:])]
    is_least = key in ("lowest", "end_height", "nearest")
    worst = known.min(initial=np.inf) if is_least else known.max(initial=-np.inf)
    return {"model": float(values[0]), "robots": float(worst) if len(known) else float("nan")}

"""Limits of an experiment: the intersection of the ranges of the MJCF and of the file's ranges."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.errors import ExperimentError, first_ones, listed, shortened, unknown
from mjfim.experiment.task_tables import Limits
from mjfim.model.coordinates import (
    ScalarJoint,
    actuator_names,
    control_names,
    joint_names,
    scalar_joints,
)
from mjfim.model.sizes import (
    LEAST_MOVE_PER_SAMPLE,
    actuator_force_sizes,
    control_sizes,
    force_sizes,
    position_sizes,
)

Range = tuple[float, float]

# Kinds of limits that are stated by joint; the others are stated by actuator.
JOINT_KINDS = ("position", "velocity", "acceleration", "joint_force")

# Largest number of engine steps of a sample at which the barrier is evaluated with derivatives.
MAX_DERIVATIVE_SUBSTEPS = 5


@dataclass(frozen=True, kw_only=True)
class Limit:
    """Range of one scalar.

    Attributes:
        kind: "position", "velocity", "acceleration", "control", "control_rate", "force" or
            "joint_force".
        name: Name of the joint or the actuator.
        index: Address in qpos, qvel, qacc, ctrl, ctrl, actuator_force or qfrc_actuator, for the
            kinds in this order.
        lower: Lower bound, -inf without one [unit of the kind].
        upper: Upper bound, inf without one [unit of the kind].
        size: Natural size of the quantity, stated where there is a single bound [unit of the kind].
    """

    kind: str
    name: str
    index: int
    lower: float
    upper: float
    size: float = 1.0

    def __post_init__(self) -> None:
        if not self.lower < self.upper:
            raise ExperimentError(
                f"limits.{self.kind}.{self.name}: [{self.lower:g}, {self.upper:g}] is inverted; "
                "needs lower < upper"
            )

    @property
    def scale(self) -> float:
        """Scale that makes margins relative [unit of the kind].

        It is half of the range; with a single bound, the magnitude of the bound, at least the
        natural size of the quantity.
        """
        finite = [abs(bound) for bound in (self.lower, self.upper) if np.isfinite(bound)]
        if len(finite) == 2:
            return 0.5 * (self.upper - self.lower)
        return max(*finite, self.size)


@dataclass(frozen=True, kw_only=True)
class _KindOfLimit:
    """One kind of limit before names are resolved.

    Attributes:
        kind: Name of the kind.
        stated: Numbers of the experiment file: one for all names, or a table by name.
        addresses: Address of each joint or actuator that can have such a limit, by name.
        model_ranges: Ranges of the MJCF, by name.
        excluded: What the joints or actuators are that cannot have such a limit, by name.
        sizes: (n,) natural sizes of the quantity, in the order of the addresses.
    """

    kind: str
    stated: float | Mapping[str, float | Range]
    addresses: Mapping[str, int]
    model_ranges: Mapping[str, Range]
    excluded: Mapping[str, str]
    sizes: Array


def limits_of(
    model: Any,
    coordinates: tuple[ScalarJoint, ...],
    controls: tuple[str, ...],
    stated: Limits,
    period: float,
) -> tuple[Limit, ...]:
    """Collect all limits, ordered by kind.

    Args:
        model: MjModel.
        coordinates: Its slide and hinge joints.
        controls: Names of its nu controls.
        stated: The `[limits]` table of the experiment file.
        period: Sample period, from which the natural sizes of rates follow [s].

    Returns:
        The limits; where MJCF and file both have a range, the intersection of the two.

    Raises:
        ExperimentError: A name is unknown, a range is inverted, a stated range excludes that of the
            MJCF, or a stated limit applies to nothing.
    """
    joints = {c.name: c for c in coordinates}
    scalar_actuators = {
        name: i
        for i, name in enumerate(actuator_names(model))
        if int(model.actuator_outnum[i]) == 1
    }
    dofs = {name: c.v for name, c in joints.items()}
    inputs = {name: i for i, name in enumerate(controls)}

    outputs = {n: int(model.actuator_outadr[i]) for n, i in scalar_actuators.items()}
    sizes = _natural_sizes(model, list(dofs.values()), list(outputs.values()), period)

    turning, several = _joints_without_limits(model), _actuators_without_limits(model)
    kinds = (
        _KindOfLimit(
            kind="position",
            stated=stated.position,
            addresses={name: c.q for name, c in joints.items()},
            model_ranges=_position_ranges(model, coordinates),
            excluded=turning,
            sizes=sizes["position"],
        ),
        _KindOfLimit(
            kind="velocity",
            stated=stated.velocity,
            addresses=dofs,
            model_ranges={},
            excluded=turning,
            sizes=sizes["velocity"],
        ),
        _KindOfLimit(
            kind="acceleration",
            stated=stated.acceleration,
            addresses=dofs,
            model_ranges={},
            excluded=turning,
            sizes=sizes["acceleration"],
        ),
        _KindOfLimit(
            kind="control",
            stated=stated.control,
            addresses=inputs,
            model_ranges=_control_ranges(model, controls),
            excluded={},
            sizes=sizes["control"],
        ),
        _KindOfLimit(
            kind="control_rate",
            stated=stated.control_rate,
            addresses=inputs,
            model_ranges={},
            excluded={},
            sizes=sizes["control_rate"],
        ),
        _KindOfLimit(
            kind="force",
            stated=stated.force,
            addresses=outputs,
            model_ranges=_force_ranges(model, scalar_actuators),
            excluded=several,
            sizes=sizes["force"],
        ),
        _KindOfLimit(
            kind="joint_force",
            stated={},
            addresses=dofs,
            model_ranges=_joint_force_ranges(model, joints),
            excluded=turning,
            sizes=sizes["joint_force"],
        ),
    )
    return tuple(limit for kind in kinds for limit in _limits_of_kind(kind))


def limits_of_model(model: Any) -> tuple[Limit, ...]:
    """Collect the limits that the MJCF states by itself, ordered by kind.

    Args:
        model: MjModel.
    """
    timestep = float(model.opt.timestep)
    return limits_of(model, scalar_joints(model), control_names(model), Limits(), timestep)


def _natural_sizes(
    model: Any, dofs: Sequence[int], outputs: Sequence[int], period: float
) -> dict[str, Array]:
    """Natural sizes of the limited quantities by kind, in the order of their addresses.

    Args:
        model: MjModel.
        dofs: Degrees of freedom of the joints that can have limits.
        outputs: Addresses of the forces of the actuators that can have limits.
        period: Sample period, from which the natural sizes of rates follow [s].
    """
    time = period / LEAST_MOVE_PER_SAMPLE
    position = position_sizes(model)[dofs]
    control = control_sizes(model, time)
    return {
        "position": position,
        "velocity": position / time,
        "acceleration": position / time**2,
        "control": control,
        "control_rate": control / time,
        "force": actuator_force_sizes(model, time)[outputs],
        "joint_force": force_sizes(model, time)[dofs],
    }


def _limits_of_kind(kind: _KindOfLimit) -> list[Limit]:
    """All limits of one kind, in the order of the addresses."""
    stated = _stated_ranges(kind)
    limits = []

    for name, index in kind.addresses.items():
        # A stated range has to be valid by itself, before the MJCF's range narrows it.
        if name in stated:
            lower, upper = stated[name]
            Limit(kind=kind.kind, name=name, index=index, lower=float(lower), upper=float(upper))

        ranges = [table[name] for table in (stated, kind.model_ranges) if name in table]
        if not ranges:
            continue

        lower, upper = _intersection(f"limits.{kind.kind}.{name}", ranges)
        if np.isfinite(lower) or np.isfinite(upper):
            limits.append(_limit(kind, name, lower, upper))

    return limits


def _limit(kind: _KindOfLimit, name: str, lower: float, upper: float) -> Limit:
    """Limit of one name; its natural size is stated where there is a single bound."""
    index = kind.addresses[name]
    limit = Limit(kind=kind.kind, name=name, index=index, lower=lower, upper=upper)
    if np.isfinite(lower) and np.isfinite(upper):
        return limit
    return replace(limit, size=float(kind.sizes[list(kind.addresses).index(name)]))


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


def _stated_ranges(kind: _KindOfLimit) -> dict[str, Range]:
    """Ranges that the experiment file states, by name.

    A single number r is the range [-r, r]; without a table it holds for all names.

    Raises:
        ExperimentError: A name is unknown or cannot have such a limit, or no name can have it.
    """
    names, stated = list(kind.addresses), kind.stated
    if not names and not isinstance(stated, Mapping):
        reasons = [f"{shortened(repr(name))} is {what}" for name, what in kind.excluded.items()]
        listing = first_ones(reasons, "; ")
        raise ExperimentError(
            f"limits.{kind.kind} applies to nothing in this model: {listing}. It limits "
            f"{_applies_to(kind.kind)} only; remove the key"
        )
    table = stated if isinstance(stated, Mapping) else dict.fromkeys(names, stated)

    for name in table:
        if name in kind.excluded:
            raise ExperimentError(
                f"limits.{kind.kind}: {name!r} is {kind.excluded[name]}; this key limits "
                f"{_applies_to(kind.kind)} only; valid: {listed(sorted(names))}"
            )
        if name not in names:
            element = "joint" if kind.kind in JOINT_KINDS else "actuator"
            raise ExperimentError(f"limits.{kind.kind}: {unknown(element, name, names)}")
    return {
        name: value if isinstance(value, tuple) else (-value, value)
        for name, value in table.items()
    }


def _applies_to(kind: str) -> str:
    """Elements to which a kind of limit applies, in words."""
    return "slides and hinges" if kind in JOINT_KINDS else "actuators with a single force"


def _joints_without_limits(model: Any) -> dict[str, str]:
    """Kinds of the ball and free joints, in words by name."""
    words = {
        int(mujoco.mjtJoint.mjJNT_BALL): "a ball joint",
        int(mujoco.mjtJoint.mjJNT_FREE): "a free joint",
    }
    kinds = zip(joint_names(model), model.jnt_type.tolist(), strict=True)
    return {name: words[kind] for name, kind in kinds if kind in words}


def _actuators_without_limits(model: Any) -> dict[str, str]:
    """Numbers of forces of the actuators that have several, in words by name."""
    counts = zip(actuator_names(model), model.actuator_outnum.tolist(), strict=True)
    return {name: f"an actuator with {count} forces" for name, count in counts if count != 1}


def unlimited_elements(model: Any, stated: Limits) -> tuple[str, ...]:
    """Find the limits that are stated for all names, but do not apply to some of them.

    Args:
        model: MjModel.
        stated: The `[limits]` table of the experiment file.

    Returns:
        Sentences that name the key and what it does not limit.
    """
    joints, actuators = _joints_without_limits(model), _actuators_without_limits(model)
    sentences = []
    for kind, excluded in (
        ("velocity", joints),
        ("acceleration", joints),
        ("force", actuators),
    ):
        if excluded and not isinstance(getattr(stated, kind), Mapping):
            named = listed([f"{what[2:]} {name}" for name, what in excluded.items()])
            sentences.append(
                f"limits.{kind} does not apply to the {named}: it limits {_applies_to(kind)} only"
            )
    return tuple(sentences)


def _position_ranges(model: Any, coordinates: tuple[ScalarJoint, ...]) -> dict[str, Range]:
    """Ranges of the joints in the MJCF, by name."""
    joints = {c.name: c.joint for c in coordinates}
    return _model_ranges(joints, model.jnt_limited, model.jnt_range)


def _control_ranges(model: Any, controls: tuple[str, ...]) -> dict[str, Range]:
    """Ranges of the controls in the MJCF, by name."""
    actuators = {name: i for i, name in enumerate(controls)}
    return _model_ranges(actuators, model.actuator_ctrllimited, model.actuator_ctrlrange)


def _force_ranges(model: Any, actuators: Mapping[str, int]) -> dict[str, Range]:
    """Ranges of the actuator forces in the MJCF, by name."""
    return _model_ranges(actuators, model.actuator_forcelimited, model.actuator_forcerange)


def _joint_force_ranges(model: Any, joints: Mapping[str, ScalarJoint]) -> dict[str, Range]:
    """Ranges of the summed actuator forces on joints in the MJCF, by name."""
    indices = {name: c.joint for name, c in joints.items()}
    return _model_ranges(indices, model.jnt_actfrclimited, model.jnt_actfrcrange)


def _model_ranges(indices: Mapping[str, int], limited: Any, ranges: Any) -> dict[str, Range]:
    """Ranges by name of the elements that the model limits.

    Args:
        indices: Index of each element, by name.
        limited: (n,) nonzero where the model limits an element.
        ranges: (n, 2) ranges of all elements.
    """
    return {name: tuple(ranges[i]) for name, i in indices.items() if limited[i]}


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
        Descriptions of limited ball joints, tendons, actuator forces on tendons and activations,
        with their names.
    """
    kinds = mujoco.mjtObj
    is_ball = model.jnt_type == int(mujoco.mjtJoint.mjJNT_BALL)
    balls = _names(model, kinds.mjOBJ_JOINT, is_ball & (model.jnt_limited != 0))
    tendons = _names(model, kinds.mjOBJ_TENDON, model.tendon_limited)
    pulled = _names(model, kinds.mjOBJ_TENDON, model.tendon_actfrclimited)
    actuators = _names(model, kinds.mjOBJ_ACTUATOR, model.actuator_actlimited)

    return (
        *(f"ball joint {name}" for name in balls),
        *(f"tendon {name}" for name in tendons),
        *(f"the actuator force on tendon {name}" for name in pulled),
        *(f"the activation of {name}" for name in actuators),
    )


def _names(model: Any, kind: Any, chosen: Any) -> list[str]:
    """Names of chosen elements of a kind, or their numbers; chosen: (n,) truth values."""
    indices = np.flatnonzero(chosen).tolist()
    return [mujoco.mj_id2name(model, kind, i) or f"number {i}" for i in indices]


def derivative_substeps_of(substeps: int) -> tuple[int, ...]:
    """Engine steps of a sample, counted from 1, at which the barrier takes derivatives.

    They are closer together at the beginning of the sample, where the control jumps.
    """
    spaced = np.geomspace(1, substeps, min(MAX_DERIVATIVE_SUBSTEPS, substeps))
    return tuple(sorted({round(step) for step in spaced.tolist()}))

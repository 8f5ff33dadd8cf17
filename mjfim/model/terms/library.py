"""The library of terms: all kinds, and the terms of an experiment resolved against its model.

The terms of a base that is not level and of a payload are here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.arrays import record
from mjfim.errors import ExperimentError
from mjfim.model.elements import model_length
from mjfim.model.terms import drives, friction
from mjfim.model.terms.term import (
    NON_NEGATIVE,
    Shape,
    Term,
    TermQuantity,
    TermTable,
    add_body,
    named_element,
    require_free_name,
    stated_quantities,
)

# Axes of the world, and of the frame of a body.
AXES = ("x", "y", "z")

# Places of a payload that are tested, as multiples of the vector from the origin of the body to its
# centre of mass: the centre itself, and about the end of the body.
PLACES = (1.0, 2.0)

# Poses of the robot in which the directions of a body are compared, and their smallest difference
# that counts; the directions have length 1.
POSES = 8
LEAST_TURN = 1e-6

ATKESON_1986 = (
    "C. G. Atkeson, C. H. An and J. M. Hollerbach, Estimation of inertial parameters of "
    "manipulator loads and links, International Journal of Robotics Research 5, 1986"
)
SWEVERS_2007 = (
    "J. Swevers, W. Verdonck and J. De Schutter, Dynamic model identification for industrial "
    "robots, IEEE Control Systems Magazine 27, 2007"
)


@record
class Tilt(Term):
    """Rotation of gravity in the frame of the world, which keeps its size.

    Attributes:
        gravity: Gravity of the stated model [m/s²].
    """

    kind = "tilt"
    description = (
        "A base that is not level: gravity is turned by a rotation vector in the axes of the "
        "world, and keeps its size."
    )
    equation = "gravity = R(x, y, z) · gravity of the model"
    elements = "option/gravity"
    acts_on = ""
    fields = tuple((axis, f"rotation about the world's {axis}", "rad") for axis in AXES)
    sources = (SWEVERS_2007,)
    # All components of gravity depend on all components of the rotation.
    is_written_as_a_whole = True

    gravity: tuple[float, ...]

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> Tilt:
        """Resolve the term."""
        if table.element:
            key = table.element[0][0]
            raise ExperimentError(f"{key}: a term of kind {cls.kind!r} acts on the base; remove it")
        if not np.any(model.opt.gravity):
            raise ExperimentError("kind: the model has no gravity that could be turned")

        numbers = tuple((f"option:gravity[{i}]", 1.0) for i in range(3))
        angle = TermQuantity(
            value=0.0, unit="rad", size=1.0, bounds=(-np.pi, np.pi), numbers=numbers
        )
        quantities = stated_quantities(cls.kind, table, dict.fromkeys(AXES, angle))
        gravity = tuple(model.opt.gravity.tolist())
        return cls(name=table.name, gravity=gravity, quantities=quantities)

    def write(self, model: Any, values: Mapping[str, float]) -> None:
        """Turn gravity."""
        model.opt.gravity[:] = self._turned(values)

    def edit(self, spec: Any) -> None:
        """Turn gravity in an MjSpec."""
        spec.option.gravity = self._turned(self.values)

    def _turned(self, values: Mapping[str, float]) -> np.ndarray:
        """(3,) gravity after the rotation [m/s²]."""
        vector = [values[axis] for axis in AXES]
        turn = scipy.spatial.transform.Rotation.from_rotvec(vector)
        return np.asarray(turn.apply(self.gravity))


@record
class Payload(Term):
    """A load that is fixed to a body, whose rotational inertia is equal about all axes.

    Attributes:
        body: Name of the body.
    """

    kind = "payload"
    description = (
        "A load that is fixed to a body, such as one in a gripper. Its rotational inertia about "
        "its centre of mass is equal about all axes, as that of a ball or a cube; 0 is a point "
        "mass."
    )
    equation = "mass and inertia at the point (x, y, z) of the body's frame"
    elements = "body without joints, with an inertial"
    acts_on = "body"
    fields = (
        ("mass", "mass of the load", "kg"),
        *((axis, f"{axis} in the frame of the body", "m") for axis in AXES),
        ("inertia", "rotational inertia of the load", "kg m²"),
    )
    sources = (ATKESON_1986,)
    words = "a payload at {}"
    size = "mass"
    # Its mass would change the inertias at which terms with equal effects are compared.
    alone = True

    body: str

    @classmethod
    def of(cls, table: TermTable, model: Any, period: float) -> Payload:
        """Resolve the term for a body that moves."""
        name, number = named_element(table, "body", model, cls.kind)
        require_free_name(model, "body", table.name)
        if model.body_weldid[number] == 0:
            raise ExperimentError(f"body: {name!r} does not move, so that a load has no effect")

        load = f"body/{table.name}"
        length = model_length(model)
        tree_mass = float(model.body_subtreemass[model.body_rootid[number]])
        mass = TermQuantity(
            value=0.0,
            unit="kg",
            size=tree_mass,
            bounds=NON_NEGATIVE,
            numbers=((f"{load}:mass", 1.0),),
        )
        inertia = replace(
            mass,
            unit="kg m²",
            size=tree_mass * length**2,
            numbers=tuple((f"{load}:inertia[{i}]", 1.0) for i in range(3)),
        )
        places = {
            axis: TermQuantity(
                value=0.0, unit="m", size=length, numbers=((f"{load}:pos[{i}]", 1.0),)
            )
            for i, axis in enumerate(AXES)
        }
        defaults = {"mass": mass, **places, "inertia": inertia}
        return cls(
            name=table.name,
            body=name,
            quantities=stated_quantities(cls.kind, table, defaults),
        )

    @classmethod
    def shapes(cls, model: Any, element: str, speed: float) -> list[Shape]:
        """Two places of a load on the line from a body's origin through its centre of mass.

        There are none where the body has no joint or carries a moving body.
        """
        body = model.body(element).id
        is_last = not any(
            model.body_weldid[model.body_parentid[other]] == body
            for other in np.flatnonzero(model.body_jntnum)
        )
        if not model.body_jntnum[body] or not is_last:
            return []
        data = mujoco.MjData(model)
        mujoco.mj_kinematics(model, data)
        mujoco.mj_comPos(model, data)
        rotation = data.xmat[body].reshape(3, 3)
        centre = rotation.T @ (data.subtree_com[body] - data.xpos[body])
        # At the origin of the body, both places are the same.
        is_apart = np.linalg.norm(centre) > LEAST_TURN * model_length(model)
        estimated = tuple(AXES[i] for i in _axes_with_effect(model, body))
        return [
            (dict(zip(AXES, (share * centre).tolist(), strict=True)), estimated)
            for share in (PLACES if is_apart else PLACES[:1])
        ]

    def edit(self, spec: Any) -> None:
        """Add the body of the load."""
        mass, inertia = self.value("mass"), self.value("inertia")
        load = add_body(spec.body(self.body), self.name, mass, inertia, np.zeros(3))
        load.pos = [self.value(axis) for axis in AXES]


def _axes_with_effect(model: mujoco.MjModel, body: int) -> tuple[int, ...]:
    """Axes of a body along which the place of a load has an effect of its own.

    Along an axis whose direction in the world never changes, such as that of the hinges of a planar
    robot, the place changes neither the velocity of a load nor the work of gravity.
    """
    rng = np.random.default_rng(0)
    data = mujoco.MjData(model)
    directions = []
    for _ in range(POSES):
        data.qpos[:] = model.qpos0
        mujoco.mj_integratePos(model, data.qpos, rng.standard_normal(model.nv), 1.0)
        mujoco.mj_kinematics(model, data)
        directions.append(data.xmat[body].reshape(3, 3).copy())

    # As many axes have an effect of their own as the changes of all axes have rank. Pivoting
    # chooses those with the largest changes.
    turned = np.concatenate(directions[1:]) - np.tile(directions[0], (POSES - 1, 1))
    _, R, order = scipy.linalg.qr(turned, mode="economic", pivoting=True)
    count = int((np.abs(np.diag(R)) > LEAST_TURN).sum())
    return tuple(sorted(order[:count].tolist()))


# All kinds of terms, by the name that the experiment file gives them.
KINDS: dict[str, type[Term]] = {
    each.kind: each
    for each in [*vars(friction).values(), *vars(drives).values(), *globals().values()]
    if isinstance(each, type) and issubclass(each, Term) and "kind" in vars(each)
}

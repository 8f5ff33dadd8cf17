"""Inverse dynamics of rigid bodies on hinges and slides, and its derivatives in closed form.

All is computed for n states at once. Motions are 6-vectors of an angular velocity and the velocity
of the body-fixed point at the origin; forces are 6-vectors of a moment about the origin and a
force. The axes are those of the world; the origin is a fixed point near the bodies.

Sources: Featherstone, Rigid Body Dynamics Algorithms (2008); Singh, Russell & Wensing, Efficient
analytical derivatives of rigid-body dynamics using spatial vector algebra (RA-L 2022).
"""

from __future__ import annotations

from functools import cached_property
from typing import Any

import mujoco
import numpy as np
import scipy

from mjfim.arrays import Array, record
from mjfim.model.inertia import INERTIA_COLUMNS, INERTIA_ROWS

# Fields of MjData from which a motion is made.
MOTION_FIELDS = ("xanchor", "xaxis", "xipos", "ximat")

# (3, 9) matrices of the cross products with the three unit vectors.
CROSS_PRODUCTS = np.cross(np.eye(3), np.eye(3)[:, None]).reshape(3, 9)


@record
class RigidBodyMotion:
    """Rigid bodies in n states of motion.

    Attributes:
        tree: The joints.
        joint_motion: (n, nv, 6) motion S of the bodies behind a joint per unit of its speed.
        speed: (n, nv) speeds of the joints.
        acceleration: (n, nv) accelerations of the joints.
        gravity: (3,) acceleration by gravity [m/s²].
        inertia: (n, nv, 6, 6) inertia of the bodies that are fixed to each joint.
        armature: (nv,) inertia that is added to each joint.
        origin: (n, 3) position of the origin in the world [m].
    """

    tree: JointTree
    joint_motion: Array
    speed: Array
    acceleration: Array
    gravity: Array
    inertia: Array
    armature: Array
    origin: Array

    @staticmethod
    def of(
        tree: JointTree, model: Any, fields: dict[str, Array], speed: Array, acceleration: Array
    ) -> RigidBodyMotion:
        """The motion of a model.

        Args:
            tree: Joints of the model.
            model: The model whose inertias are taken.
            fields: The `MOTION_FIELDS` of n states, each (n, elements, components).
            speed: (n, nv) speeds of the joints.
            acceleration: (n, nv) accelerations of the joints.
        """
        centre = fields["xipos"][:, tree.bodies]
        origin = centre.mean(axis=1)

        of_body = _spatial_inertia(
            model.body_mass[tree.bodies],
            centre - origin[:, None],
            fields["ximat"].reshape(len(origin), -1, 3, 3)[:, tree.bodies],
            model.body_inertia[tree.bodies],
        )
        inertia = np.zeros((len(origin), tree.count, 6, 6))
        for i, joint in enumerate(tree.last_joint):
            inertia[:, joint] += of_body[:, i]

        return RigidBodyMotion(
            tree=tree,
            joint_motion=_joint_motion(tree, fields, origin),
            speed=speed,
            acceleration=acceleration,
            gravity=np.array(model.opt.gravity),
            inertia=inertia,
            armature=np.array(model.dof_armature),
            origin=origin,
        )

    # Motions

    @cached_property
    def _body_speed(self) -> Array:
        """(n, nv, 6) motion v of the bodies behind each joint."""
        return self._summed_to(self.joint_motion * self.speed[..., None])

    @cached_property
    def _turning(self) -> Array:
        """(n, nv, 6) change of S by the motion of the bodies before the joint, per time.

        It is the same with the motion of the bodies behind the joint.
        """
        return _moved_motion(self._body_speed, self.joint_motion)

    @cached_property
    def _body_acceleration(self) -> Array:
        """(n, nv, 6) acceleration a of the bodies behind each joint, less gravity."""
        own = self.joint_motion * self.acceleration[..., None]
        acceleration = self._summed_to(own + self._turning * self.speed[..., None])
        acceleration[..., 3:] -= self.gravity
        return acceleration

    def _summed_to(self, of_joints: Array) -> Array:
        """(n, nv, ...) sums over the joints between each joint and the world, itself included."""
        flat = of_joints.reshape(*of_joints.shape[:2], -1)
        return (self.tree.supports @ flat).reshape(of_joints.shape)

    def _summed_behind(self, of_joints: Array) -> Array:
        """(n, nv, ...) sums over the joints that each joint moves, itself included."""
        flat = of_joints.reshape(*of_joints.shape[:2], -1)
        return (self.tree.supports.T @ flat).reshape(of_joints.shape)

    # Forces

    @cached_property
    def _momentum(self) -> Array:
        """(n, nv, 6) momentum of the bodies that are fixed to each joint."""
        return _product(self.inertia, self._body_speed)

    @cached_property
    def _force_behind(self) -> Array:
        """(n, nv, 6) force that each joint passes on to all bodies behind it."""
        by_acceleration = _product(self.inertia, self._body_acceleration)
        return self._summed_behind(by_acceleration + _moved_force(self._body_speed, self._momentum))

    @cached_property
    def _inertia_behind(self) -> Array:
        """(n, nv, 6, 6) inertia of all bodies that each joint moves."""
        return self._summed_behind(self.inertia)

    @cached_property
    def force(self) -> Array:
        """(n, nv) forces of the joints that this motion needs."""
        own = np.sum(self.joint_motion * self._force_behind, axis=2)
        return np.asarray(own + self.armature * self.acceleration)

    @cached_property
    def largest_force(self) -> Array:
        """(nv,) largest sums, among the n states, of the absolute terms of a force."""
        terms = np.abs(self.joint_motion * self._force_behind).sum(axis=2)
        terms += np.abs(self.armature * self.acceleration)
        return np.asarray(terms.max(axis=0))

    @cached_property
    def mass_matrix(self) -> Array:
        """(n, nv, nv) joint inertia matrix M."""
        lower = self._inertia_product @ np.swapaxes(self.joint_motion, 1, 2)
        lower = lower * self.tree.supports
        diagonal = np.arange(lower.shape[1])
        upper = np.swapaxes(lower, 1, 2).copy()
        upper[:, diagonal, diagonal] = self.armature
        return lower + upper

    @cached_property
    def _inertia_product(self) -> Array:
        """(n, nv, 6) inertia behind each joint times its motion S."""
        return _product(self._inertia_behind, self.joint_motion)

    # Derivatives

    def force_derivatives(self) -> tuple[Array, Array]:
        """Derivatives of the forces at fixed accelerations.

        Returns:
            (n, nv, nv) derivatives by the positions and (n, nv, nv) by the speeds of the joints.
        """
        S, turning, B = self.joint_motion, self._turning, self._coriolis_behind

        # Acceleration of S by the bodies before the joint; those of the joint itself drop out.
        own = S * self.acceleration[..., None] + turning * self.speed[..., None]
        before = self._body_acceleration - own
        speed_before = self._body_speed - S * self.speed[..., None]
        turning_twice = _moved_motion(before, S) + _moved_motion(speed_before, turning)

        # Forces at joints behind the one that moves, and at this joint.
        by_turn = np.swapaxes(B, 2, 3) @ S[..., None]
        behind = np.concatenate([by_turn[..., 0], self._inertia_product], axis=2)
        by_position = behind @ np.swapaxes(np.concatenate([turning, turning_twice], axis=2), 1, 2)
        by_speed = behind @ np.swapaxes(np.concatenate([S, 2.0 * turning], axis=2), 1, 2)

        # Forces at joints between the one that moves and the world.
        change = _product(B, turning) + _product(self._inertia_behind, turning_twice)
        change += _moved_force(S, self._force_behind)
        change_by_speed = _product(B, S) + 2.0 * _product(self._inertia_behind, turning)
        before_position = S @ np.swapaxes(change, 1, 2)
        before_speed = S @ np.swapaxes(change_by_speed, 1, 2)

        is_behind = self.tree.supports > 0.0
        is_before = is_behind.T & ~is_behind
        return (
            np.where(is_behind, by_position, np.where(is_before, before_position, 0.0)),
            np.where(is_behind, by_speed, np.where(is_before, before_speed, 0.0)),
        )

    @cached_property
    def _coriolis_behind(self) -> Array:
        """(n, nv, 6, 6) twice the matrix B of the source, of all bodies that each joint moves."""
        # Matrix of `_moved_motion` for the motion of the bodies.
        speed, force = self._body_speed, self._momentum
        of_motion = np.zeros((*speed.shape, 6))
        turn = _cross_matrix(speed[..., :3])
        of_motion[..., :3, :3] = turn
        of_motion[..., 3:, 3:] = turn
        of_motion[..., 3:, :3] = _cross_matrix(speed[..., 3:])

        # Matrix of `_moved_force` as a function of the motion, for the momentum.
        of_force = np.zeros((*force.shape, 6))
        linear = -_cross_matrix(force[..., 3:])
        of_force[..., :3, :3] = -_cross_matrix(force[..., :3])
        of_force[..., :3, 3:] = linear
        of_force[..., 3:, :3] = linear

        turned = self.inertia @ of_motion
        return self._summed_behind(of_force - turned - np.swapaxes(turned, 2, 3))

    def regressor(self, origins: Array, axes: Array, change: Array) -> Array:
        """Derivatives of the forces by parameters of the bodies' inertias.

        Args:
            origins: (n, b, 3) positions of the body frames of the b moved bodies [m].
            axes: (n, b, 3, 3) their axes as columns.
            change: (b, 10, m) derivative of the bodies' barycentric inertias by m parameters.

        Returns:
            (n, nv, m) derivatives.
        """
        total = np.zeros((*self.speed.shape, change.shape[2]))

        for i, joint in enumerate(self.tree.last_joint.tolist()):
            own = np.flatnonzero(change[i].any(axis=0))
            if not len(own):
                continue

            arm, R = origins[:, i] - self.origin, axes[:, i]
            velocity = _in_body(self._body_speed[:, joint], arm, R)
            acceleration = _in_body(self._body_acceleration[:, joint], arm, R)

            # The acceleration of the body's point itself contains that of its turning path.
            acceleration[:, 3:] += _cross(velocity[:, :3], velocity[:, 3:])
            forces = _inertial_forces(velocity[:, :3], acceleration) @ change[i][:, own]

            moving = np.flatnonzero(self.tree.supports[joint])
            S = _in_body(self.joint_motion[:, moving], arm[:, None], R[:, None])
            total[:, moving[:, None], own] += S @ forces
        return total


def barycentric_inertias(model: Any, bodies: np.ndarray) -> Array:
    """(b, 10) mass, first moments and inertia about the body frame's origin, in its axes.

    Args:
        model: The model.
        bodies: (b,) ids of the bodies.
    """
    mass, centre = model.body_mass[bodies], model.body_ipos[bodies]
    turns = scipy.spatial.transform.Rotation
    axes = turns.from_quat(model.body_iquat[bodies], scalar_first=True).as_matrix()
    spatial = _spatial_inertia(mass, centre[None], axes[None], model.body_inertia[bodies])[0]
    entries = spatial[:, INERTIA_ROWS, INERTIA_COLUMNS]
    return np.concatenate([mass[:, None], mass[:, None] * centre, entries], axis=1)


def _spatial_inertia(mass: Array, centre: Array, axes: Array, moments: Array) -> Array:
    """(n, b, 6, 6) inertias about the origin.

    Args:
        mass: (b,) masses [kg].
        centre: (n, b, 3) centres of mass, from the origin [m].
        axes: (n, b, 3, 3) principal axes as columns.
        moments: (b, 3) principal moments [kg m²].
    """
    arm = _cross_matrix(centre)
    weighted = mass[:, None, None] * arm
    inertia = np.zeros((*centre.shape[:2], 6, 6))
    inertia[..., :3, :3] = (axes * moments[:, None]) @ np.swapaxes(axes, 2, 3) - weighted @ arm
    inertia[..., :3, 3:] = weighted
    inertia[..., 3:, :3] = -weighted
    inertia[..., 3:, 3:] = mass[:, None, None] * np.eye(3)
    return inertia


def _inertial_forces(turn: Array, acceleration: Array) -> Array:
    """(n, 6, 10) moment and force per unit of a body's barycentric inertia, in the body's frame.

    Args:
        turn: (n, 3) angular velocity.
        acceleration: (n, 6) angular acceleration, and acceleration of the frame's origin less
            gravity.
    """
    angular, linear = acceleration[:, :3], acceleration[:, 3:]
    forces = np.zeros((len(turn), 6, 10))
    forces[:, 3:, 0] = linear

    across = _cross_matrix(turn)
    forces[:, 3:, 1:4] = _cross_matrix(angular) + across @ across
    forces[:, :3, 1:4] = -_cross_matrix(linear)
    forces[:, :3, 4:] = _inertia_columns(angular) + across @ _inertia_columns(turn)
    return forces


def _inertia_columns(vector: Array) -> Array:
    """(n, 3, 6) product of an inertia matrix and a vector (n, 3), per entry of the matrix."""
    columns = np.zeros((len(vector), 3, 6))
    for entry, (row, column) in enumerate(zip(INERTIA_ROWS, INERTIA_COLUMNS, strict=True)):
        columns[:, row, entry] = vector[:, column]
        columns[:, column, entry] = vector[:, row]
    return columns


def _in_body(motion: Array, arm: Array, axes: Array) -> Array:
    """Motion (..., 6) of the point at `arm` (..., 3), in the axes (..., 3, 3) of a body."""
    turn = motion[..., :3]
    at_point = motion[..., 3:] + _cross(turn, arm)
    both = np.stack([turn, at_point], axis=-2) @ axes
    return both.reshape(motion.shape)


def _cross(a: Array, b: Array) -> Array:
    """Cross product of (..., 3) vectors; NumPy's own function takes several times as long."""
    ax, ay, az = a[..., 0], a[..., 1], a[..., 2]
    bx, by, bz = b[..., 0], b[..., 1], b[..., 2]
    return np.stack([ay * bz - az * by, az * bx - ax * bz, ax * by - ay * bx], axis=-1)


def _cross_matrix(a: Array) -> Array:
    """(..., 3, 3) matrix of the cross product with a: (..., 3)."""
    return (a @ CROSS_PRODUCTS).reshape(*a.shape, 3)


def _product(matrix: Array, vector: Array) -> Array:
    """(..., 6) product of matrices (..., 6, 6) and vectors (..., 6)."""
    return np.asarray(np.einsum("...ij,...j->...i", matrix, vector))


def _moved_motion(v: Array, motion: Array) -> Array:
    """Change per time of a motion (..., 6) that is fixed to a body with the motion v: (..., 6)."""
    turn, linear = motion[..., :3], motion[..., 3:]
    return np.concatenate(
        [_cross(v[..., :3], turn), _cross(v[..., :3], linear) + _cross(v[..., 3:], turn)], axis=-1
    )


def _moved_force(v: Array, force: Array) -> Array:
    """Change per time of a force (..., 6) that is fixed to a body with the motion v: (..., 6)."""
    moment, linear = force[..., :3], force[..., 3:]
    return np.concatenate(
        [_cross(v[..., :3], moment) + _cross(v[..., 3:], linear), _cross(v[..., :3], linear)],
        axis=-1,
    )


def _joint_motion(tree: JointTree, fields: dict[str, Array], origin: Array) -> Array:
    """(n, nv, 6) spatial velocities of the bodies behind each joint per speed of the joint."""
    # A hinge moves the point at the origin by its distance from the axis, a slide along it.
    axis = fields["xaxis"]
    arm = fields["xanchor"] - origin[:, None]
    hinge = tree.is_hinge[:, None]
    return np.concatenate(
        [np.where(hinge, axis, 0.0), np.where(hinge, _cross(arm, axis), axis)], axis=2
    )


@record
class JointTree:
    """Hinges and slides of a model, and the bodies that each of them moves.

    Attributes:
        supports: (nv, nv) 1 where joint j (column) is joint i (row) or lies between it and the
            world, otherwise 0.
        is_hinge: (nv,) True for a hinge, False for a slide.
        bodies: (b,) ids of the bodies that joints move.
        last_joint: (b,) number of the joint nearest to each of these bodies, on its way to the
            world.
    """

    supports: Array
    is_hinge: np.ndarray
    bodies: np.ndarray
    last_joint: np.ndarray

    @property
    def count(self) -> int:
        """Number of joints."""
        return len(self.is_hinge)

    @staticmethod
    def of(model: Any) -> JointTree | None:
        """The tree of a model.

        Args:
            model: Compiled MuJoCo model.

        Returns:
            The tree; None where a joint is neither a hinge nor a slide.
        """
        kinds = model.jnt_type
        is_hinge = kinds == mujoco.mjtJoint.mjJNT_HINGE
        if not (is_hinge | (kinds == mujoco.mjtJoint.mjJNT_SLIDE)).all():
            return None

        # Parents have lower numbers than their children.
        nv = model.nv
        supports = np.eye(nv)
        for i, parent in enumerate(model.dof_parentid.tolist()):
            if parent >= 0:
                supports[i] += supports[parent]

        # A body without a joint of its own moves with its parent.
        last = np.full(model.nbody, -1)
        for body in range(1, model.nbody):
            last[body] = last[model.body_parentid[body]]
            if model.body_dofnum[body]:
                last[body] = model.body_dofadr[body] + model.body_dofnum[body] - 1
        bodies = np.flatnonzero(last >= 0)

        return JointTree(
            supports=supports, is_hinge=is_hinge, bodies=bodies, last_joint=last[bodies]
        )

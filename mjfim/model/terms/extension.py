"""Extension of an MjSpec by terms, with its keyframes and the layout of its state."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from typing import Any

import mujoco
import numpy as np

from mjfim.arrays import Array
from mjfim.model.terms.term import Term
from mjfim.model.units import actuator_gear, commanded_joint

# Types of dynamics whose activation follows the control, so that it equals the control at rest.
FILTERS = (int(mujoco.mjtDyn.mjDYN_FILTER), int(mujoco.mjtDyn.mjDYN_FILTEREXACT))


@dataclass(frozen=True, kw_only=True, eq=False)
class StateLayout:
    """Where the state of the stated model is in that of the extended one.

    Attributes:
        qpos: (nq,) addresses of the stated positions in the extended ones.
        qvel: (nv,) addresses of the stated velocities.
        act: (na,) addresses of the stated activations.
        model: The extended model (`mujoco.MjModel`).
    """

    qpos: np.ndarray
    qvel: np.ndarray
    act: np.ndarray
    model: Any

    @classmethod
    def between(
        cls, stated: Any, extended: Any, joints: Sequence[int], actuators: Sequence[int]
    ) -> StateLayout:
        """The layout of an extended model.

        Args:
            stated: The stated model.
            extended: The extended model.
            joints: Number in the extended model of each joint of the stated one.
            actuators: Number in the extended model of each actuator of the stated one.
        """
        qpos, qvel = np.zeros(stated.nq, dtype=np.intp), np.zeros(stated.nv, dtype=np.intp)
        for old, new in enumerate(joints):
            positions = _range(stated.jnt_qposadr, old, stated.nq)
            qpos[positions] = int(extended.jnt_qposadr[new]) + np.arange(len(positions))
            velocities = _range(stated.jnt_dofadr, old, stated.nv)
            qvel[velocities] = int(extended.jnt_dofadr[new]) + np.arange(len(velocities))

        act = np.zeros(stated.na, dtype=np.intp)
        for old, new in enumerate(actuators):
            count = int(stated.actuator_actnum[old])
            first = int(stated.actuator_actadr[old])
            act[first : first + count] = int(extended.actuator_actadr[new]) + np.arange(count)
        return cls(qpos=qpos, qvel=qvel, act=act, model=extended)

    @property
    def added(self) -> frozenset[int]:
        """Addresses in (qpos, qvel) of the extended model that the stated one does not have."""
        size = int(self.model.nq) + int(self.model.nv)
        stated = {*self.qpos.tolist(), *(int(self.model.nq) + self.qvel).tolist()}
        return frozenset(range(size)) - stated

    def positions(self, stated: Any) -> Array:
        """(nq,) extended positions: those of the stated model, and references of added joints."""
        positions = np.array(self.model.qpos0)
        positions[self.qpos] = stated
        return positions

    def velocities(self, stated: Any) -> Array:
        """(nv,) extended velocities; zero for added joints."""
        velocities = np.zeros(self.model.nv)
        velocities[self.qvel] = stated
        return velocities

    def activations(self, stated: Any, qpos: Array, ctrl: Array | None) -> Array:
        """(na,) extended activations; those that terms add are at rest.

        Args:
            stated: (na,) activations of the stated model.
            qpos: (nq,) positions of the extended model.
            ctrl: (nu,) control at rest; None where none is stated. Then a position servo holds its
                joint, and other controls are zero.
        """
        activations = np.zeros(self.model.na)
        added = np.setdiff1d(np.arange(self.model.na), self.act)
        for actuator in range(self.model.nactuator):
            first = int(self.model.actuator_actadr[actuator])
            if first in added and int(self.model.actuator_dyntype[actuator]) in FILTERS:
                activations[first] = self._resting_control(actuator, qpos, ctrl)

        activations[self.act] = stated
        return activations

    def _resting_control(self, actuator: int, qpos: Array, ctrl: Array | None) -> float:
        """Control of an actuator with one control at rest."""
        if ctrl is not None:
            return float(ctrl[int(self.model.actuator_ctrladr[actuator])])
        joint = commanded_joint(self.model, actuator)
        if joint is None:
            return 0.0
        position = float(qpos[int(self.model.jnt_qposadr[joint])])
        return position * actuator_gear(self.model, actuator)


def extended_spec(
    spec: Any, stated: Any, terms: Sequence[Term], compiled: Callable[[Any], Any]
) -> tuple[Any, StateLayout]:
    """A copy of an MjSpec with terms, and the layout of its state.

    Args:
        spec: The spec of the stated model, which is not changed.
        stated: The stated model that it compiles to.
        terms: The terms.
        compiled: Compiles a spec.

    Raises:
        ModelError: The extended spec does not compile.
    """
    extended = spec.copy()
    joints, actuators = list(extended.joints), list(extended.actuators)
    for term in terms:
        term.edit(extended)

    # Keyframes have the sizes of the state, which the terms may change.
    keys = [_StatedKey.of(key) for key in extended.keys]
    for key in extended.keys:
        key.qpos, key.qvel, key.act = [], [], []
    model = compiled(extended)

    layout = StateLayout.between(
        stated,
        model,
        [int(joint.id) for joint in joints],
        [int(actuator.id) for actuator in actuators],
    )
    for key, numbers in zip(extended.keys, keys, strict=True):
        numbers.write(key, layout)
    return extended, layout


@dataclass(frozen=True, kw_only=True, eq=False)
class _StatedKey:
    """Numbers of a keyframe of the stated model; those that are not stated are empty.

    Attributes:
        qpos: (nq,) positions.
        qvel: (nv,) velocities.
        act: (na,) activations.
        ctrl: (nu,) control.
    """

    qpos: Array
    qvel: Array
    act: Array
    ctrl: Array

    @staticmethod
    def of(key: Any) -> _StatedKey:
        """Numbers of a keyframe of an MjSpec."""
        return _StatedKey(
            qpos=np.array(key.qpos),
            qvel=np.array(key.qvel),
            act=np.array(key.act),
            ctrl=np.array(key.ctrl),
        )

    def write(self, key: Any, layout: StateLayout) -> None:
        """Write the numbers of the extended state into a keyframe of an MjSpec."""
        qpos = np.array(layout.model.qpos0)
        if len(self.qpos):
            qpos = layout.positions(self.qpos)
            key.qpos = qpos
        if len(self.qvel):
            key.qvel = layout.velocities(self.qvel)
        if len(self.act) or layout.model.na > len(layout.act):
            stated = self.act if len(self.act) else np.zeros(len(layout.act))
            key.act = layout.activations(stated, qpos, self.ctrl if len(self.ctrl) else None)


def _range(addresses: Any, element: int, end: int) -> np.ndarray:
    """Addresses that belong to an element, up to the first one of the next element or the end."""
    following = addresses[element + 1] if element + 1 < len(addresses) else end
    return np.arange(int(addresses[element]), int(following))

"""Positions as figures and reports show them: rotation vectors instead of quaternions."""

from __future__ import annotations

import numpy as np

from mjfim.arrays import Array
from mjfim.model.coordinates import QUATERNION, split_unit
from mjfim.plant.state_space import logarithm
from mjfim.records.labels import Labels

# Angle of a whole turn [rad].
TURN = 2.0 * np.pi


def shown_positions(labels: Labels, *qpos: Array) -> tuple[tuple[str, ...], tuple[Array, ...]]:
    """Return positions by degree of freedom, with their labels.

    Args:
        labels: Labels of the model's columns. Where they do not say which columns are a
            quaternion, as in records of earlier versions, qpos is returned as it is.
        qpos: (n, nq) positions of any number of trajectories [m or rad; unit quaternions].

    Returns:
        The labels, and the (n, nv) positions of each trajectory; orientations are rotation vectors
        [rad].
    """
    names = [split_unit(label)[0] for label in labels.qpos]
    first = [k for k, name in enumerate(names) if name.endswith(f".{QUATERNION[0]}")]
    if len(names) - len(first) != len(labels.positions):
        return labels.qpos, qpos

    shown = []
    for values in qpos:
        parts, done = [], 0
        for k in first:
            parts += [values[:, done:k], rotation_vectors(values[:, k : k + 4])]
            done = k + 4
        shown.append(np.hstack([*parts, values[:, done:]]))
    return labels.positions, tuple(shown)


def rotation_vectors(quaternions: Array) -> Array:
    """Return rotation vectors that change without jumps, also beyond half a turn.

    Args:
        quaternions: (n, 4) unit quaternions, the real part first.

    Returns:
        (n, 3) rotation vectors [rad].
    """
    vectors = logarithm(quaternions / np.linalg.norm(quaternions, axis=1, keepdims=True))
    angles = np.linalg.norm(vectors, axis=1)
    for k in range(1, len(vectors)):
        if angles[k] == 0.0:
            continue

        # Whole turns about the same axis are the same orientation.
        axis = vectors[k] / angles[k]
        turns = np.round((vectors[k - 1] @ axis - angles[k]) / TURN)
        vectors[k] += turns * TURN * axis
    return vectors

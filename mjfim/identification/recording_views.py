"""Values and information of single recordings, in coordinates with unit information of all of them.

Recordings may determine some directions of the parameters only. The scatter of the scores within
recordings says how far their information is too large.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array, scaled_to_unit_diagonal
from mjfim.identification.independent_blocks import RecordingEvidence
from mjfim.identification.random_effects import Information, total_of

# Eigenvalues of the scaled information of all recordings below this share of the largest one, and
# of one recording over that of all, count as zero.
TOTAL_TOLERANCE, TOLERANCE = 1e-12, 1e-9

# Share of a parameter in directions about which nothing is known, up to which it is known.
UNKNOWN_SHARE = 1e-6


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordingViews:
    """Evidence of single recordings, in coordinates z in which all of them have unit information.

    Attributes:
        theta: (s,) estimate from all recordings, where z = 0; NaN for unknowns that they do not
            determine.
        directions: (s, r) derivative of theta by z.
        parts: What each of K recordings says about z.
        values: (K, s) values that each recording alone suggests; NaN where it determines none.
        std: (K, s) their standard deviations; infinite where there is none.
        freedom: Degrees of freedom of the scatter within the recordings.
    """

    theta: Array
    directions: Array
    parts: list[Information]
    values: Array
    std: Array
    freedom: float

    def scatter(self, tau2: Array) -> Array:
        """(r, r) covariance of z between recordings.

        Args:
            tau2: (s,) variances of theta between recordings.
        """
        inverse = np.linalg.pinv(self.directions)
        return np.asarray(inverse * tau2 @ inverse.T)

    def mean(self, chosen: Sequence[int], tau2: Array) -> tuple[Array, Array]:
        """(s,) mean of theta over recordings that scatter, and (s,) its standard deviations.

        Args:
            chosen: Indices of the recordings.
            tau2: (s,) variances of theta between recordings.
        """
        scatter = self.scatter(tau2)
        total = total_of([self.parts[k].with_scatter(scatter) for k in chosen])
        return _estimate(self.theta, self.directions, total)


def recording_views(theta: Array, evidence: RecordingEvidence) -> RecordingViews:
    """Find what single recordings say about the unknowns that they share.

    Args:
        theta: (s,) estimate from all recordings [theta-unit].
        evidence: What each of K recordings says.
    """
    equations = [evidence.normal_equations(k) for k in range(evidence.count)]
    H = np.sum([information for information, _ in equations], axis=0)
    directions, is_determined = _unit_information(H)

    # Each recording in the coordinates z, and its estimate.
    informations = [directions.T @ each @ directions for each, _ in equations]
    steps = [
        -_inverse(each) @ (directions.T @ g)
        for each, (_, g) in zip(informations, equations, strict=True)
    ]
    inflation, own = _inflation(evidence, directions, informations, steps)

    # Scores of a recording scatter more than its information says by these factors.
    parts = []
    for information, step, factor in zip(informations, steps, own, strict=True):
        root = _root(information)
        matrix = root @ np.linalg.inv(inflation) @ root / factor
        parts.append(Information(matrix=0.5 * (matrix + matrix.T), vector=matrix @ step))

    known_theta = np.where(is_determined, theta, np.nan)
    found = [_estimate(known_theta, directions, part) for part in parts]
    return RecordingViews(
        theta=known_theta,
        directions=directions,
        parts=parts,
        values=np.array([value for value, _ in found]),
        std=np.array([std for _, std in found]),
        freedom=block_freedom(evidence),
    )


def block_freedom(evidence: RecordingEvidence) -> float:
    """Degrees of freedom of the scatter within recordings.

    Args:
        evidence: What the recordings say.
    """
    return float(max(len(evidence.scores) - evidence.count, 1))


def _unit_information(H: Array) -> tuple[Array, np.ndarray]:
    """(s, r) directions W with `W' H W = 1`, and (s,) True for the determined unknowns.

    Args:
        H: (s, s) information of rank r.
    """
    scaled, scale = scaled_to_unit_diagonal(H)
    eigenvalues, vectors = np.linalg.eigh(scaled)
    is_known = eigenvalues > TOTAL_TOLERANCE * eigenvalues.max(initial=0.0)
    directions = vectors[:, is_known] / np.sqrt(eigenvalues[is_known]) / scale[:, None]

    # Unknowns that a direction without information moves are not determined.
    is_determined = np.linalg.norm(vectors[:, ~is_known], axis=1) <= UNKNOWN_SHARE
    return directions, is_determined


def _inflation(
    evidence: RecordingEvidence,
    directions: Array,
    informations: Sequence[Array],
    steps: Sequence[Array],
) -> tuple[Array, list[float]]:
    """Scatter of the scores within recordings, over what the information says.

    Args:
        evidence: What the recordings say.
        directions: (s, r) directions with unit information.
        informations: (r, r) information of each recording in these directions.
        steps: (r,) step of each recording to its own estimate.

    Returns:
        (r, r) covariance of the scores of all recordings together, whose eigenvalues are at least
        1, and for each recording a factor of at least 1 by which its scores scatter more.
    """
    scatters = []
    for k, step in enumerate(steps):
        # Scores at the estimate of the recording, so that differences between recordings do not
        # count as scatter within one.
        of_recording = evidence.recording == k
        scores = evidence.scores[of_recording] @ directions
        moved = evidence.information[of_recording] @ directions
        scores = scores + np.einsum("sr,bsq,q->br", directions, moved, step)

        # An interrupted fit may have used no segment of a recording.
        count = len(scores)
        centred = scores - scores.sum(axis=0) / max(count, 1)
        scatters.append(centred.T @ centred * (count / max(count - 1, 1)))

    # A few blocks often scatter little by chance.
    eigenvalues, vectors = np.linalg.eigh(np.sum(scatters, axis=0))
    pooled = vectors * np.maximum(eigenvalues, 1.0) @ vectors.T

    factors = []
    for k, (scatter, information) in enumerate(zip(scatters, informations, strict=True)):
        root, inverse = _root(information), _inverse(information)
        expected = float(np.sum(inverse * (root @ pooled @ root)))
        found = float(np.sum(inverse * scatter))
        usable = np.sum(evidence.recording == k) > 1 and expected > 0.0
        factors.append(max(found / expected, 1.0) if usable else 1.0)
    return pooled, factors


def _estimate(theta: Array, directions: Array, part: Information) -> tuple[Array, Array]:
    """(s,) estimate of a part, and (s,) standard deviations; NaN and infinite where it has none."""
    eigenvalues, vectors = np.linalg.eigh(part.matrix)
    is_known = eigenvalues > TOLERANCE
    along = vectors[:, is_known]
    inverse = along / eigenvalues[is_known] @ along.T

    # A parameter is known if no unknown direction moves it.
    size = np.linalg.norm(directions, axis=1)
    unknown = np.linalg.norm(directions @ vectors[:, ~is_known], axis=1)
    determined = np.isfinite(theta) & (size > 0.0) & (unknown <= UNKNOWN_SHARE * size)
    value = theta + directions @ (inverse @ part.vector)
    variance = np.einsum("sr,rq,sq->s", directions, inverse, directions)
    return (
        np.where(determined, value, np.nan),
        np.where(determined, np.sqrt(np.maximum(variance, 0.0)), np.inf),
    )


def _inverse(information: Array) -> Array:
    """Pseudo-inverse of an information in directions in which that of all recordings is 1."""
    eigenvalues, vectors = np.linalg.eigh(information)
    is_known = eigenvalues > TOLERANCE
    along = vectors[:, is_known]
    return np.asarray(along / eigenvalues[is_known] @ along.T)


def _root(information: Array) -> Array:
    """Symmetric square root of an information."""
    eigenvalues, vectors = np.linalg.eigh(information)
    return np.asarray(vectors * np.sqrt(np.maximum(eigenvalues, 0.0)) @ vectors.T)

"""Blocks of a linearisation that count as independent, and the evidence of single recordings.

Residuals are correlated over some time. Consecutive blocks of the linearisation are merged to
blocks that are longer than this time, so that the scores of the longer blocks are independent.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array, scaled_pseudo_inverse
from mjfim.optimize.condensed_least_squares import Condensed

# Length of an independent block over the autocorrelation time of the residuals.
LENGTH_PER_CORRELATION_TIME = 4.0

# Autocorrelation time [rows] up to which residuals count as white.
WHITE_TIME = 1.5

# Smallest number of independent blocks, for any autocorrelation time.
MIN_BLOCKS = 20

# Eigenvalues of the scaled information about the unknowns of a single recording below this share of
# the largest one count as zero.
OWN_TOLERANCE = 1e-14


@dataclass(frozen=True, kw_only=True, eq=False)
class Blocks:
    """Scores and information of B blocks that count as independent.

    Attributes:
        scores: (B, c) gradient of half of each block's squared residuals.
        information: (B, c, c) information of each block.
        prior_rows: (l, c) Jacobian of the priors.
        recording: (B,) index of the recording.
    """

    scores: Array
    information: Array
    prior_rows: Array
    recording: np.ndarray

    @property
    def prior_information(self) -> Array:
        """(c, c) information of the priors."""
        return np.asarray(self.prior_rows.T @ self.prior_rows)


@dataclass(frozen=True, kw_only=True, eq=False)
class RecordingEvidence:
    """Evidence of single recordings about the s unknowns that all K recordings share.

    Unknowns that belong to a single recording are eliminated: they follow at their optimum.

    Attributes:
        scores: (B, s) gradient of half of the squared residuals of each independent block.
        information: (B, s, s) information of each block.
        recording: (B,) index of the recording of each block.
        priors: K arrays (l_k, s+1) of rows `[J, r]` of the priors on unknowns that belong to the
            recording.
    """

    scores: Array
    information: Array
    recording: np.ndarray
    priors: tuple[Array, ...]

    @property
    def count(self) -> int:
        """Number of recordings K."""
        return len(self.priors)

    def normal_equations(self, k: int) -> tuple[Array, Array]:
        """(s, s) information H and (s,) gradient g of half of the squares of recording k."""
        of_recording = self.recording == k
        J, r = self.priors[k][:, :-1], self.priors[k][:, -1]
        H = self.information[of_recording].sum(axis=0) + J.T @ J
        g = self.scores[of_recording].sum(axis=0) + J.T @ r
        return H, g


def recording_evidence(
    condensed: Condensed, blocks: Blocks, recording: np.ndarray, own: np.ndarray
) -> RecordingEvidence:
    """Collect what single recordings say about the unknowns that all of them share.

    Args:
        condensed: Linearisation at the minimum.
        blocks: Its independent blocks.
        recording: (b,) index of the recording of every block of the linearisation.
        own: (K, e) common columns of the unknowns that belong to each recording; e may be 0.
    """
    known = condensed.reduced_private_rows
    c = condensed.common_count
    recording_of_segment = np.zeros(condensed.segment_count, dtype=int)
    recording_of_segment[condensed.segment_of_block] = recording

    shared = np.setdiff1d(np.arange(c), own)
    scores = np.zeros((len(blocks.scores), len(shared)))
    information = np.zeros((len(blocks.scores), len(shared), len(shared)))
    priors = []

    for k, columns in enumerate(own):
        # Priors on the initial states of the recording, and on its other unknowns.
        rows = known[recording_of_segment == k].reshape(-1, c + 1)
        concerns_own = (condensed.common_rows[:, columns] != 0.0).any(axis=1)
        rows = np.concatenate([rows, condensed.common_rows[concerns_own]])

        # The unknowns of the recording follow the shared ones: d own = response @ d shared.
        of_recording = blocks.recording == k
        H = blocks.information[of_recording].sum(axis=0) + rows[:, :-1].T @ rows[:, :-1]
        inverse = scaled_pseudo_inverse(H[np.ix_(columns, columns)], OWN_TOLERANCE)
        follows = np.zeros((c, len(shared)))
        follows[shared] = np.eye(len(shared))
        follows[columns] = -inverse @ H[np.ix_(columns, shared)]

        scores[of_recording] = blocks.scores[of_recording] @ follows
        information[of_recording] = follows.T @ blocks.information[of_recording] @ follows
        priors.append(np.column_stack([rows[:, :-1] @ follows, rows[:, -1]]))

    return RecordingEvidence(
        scores=scores,
        information=information,
        recording=blocks.recording,
        priors=tuple(priors),
    )


def independent_blocks(
    condensed: Condensed, recording: np.ndarray, rows: np.ndarray, min_rows: float
) -> Blocks:
    """Merge the blocks of a linearisation to longer ones that count as independent.

    Args:
        condensed: The linearisation.
        recording: (b,) index of the recording of every block of the linearisation, ascending.
        rows: (b,) number of rows of every block.
        min_rows: Smallest number of rows of a longer block.
    """
    label = merge_blocks(recording, rows, min_rows)
    count = int(label.max(initial=-1)) + 1
    c = condensed.common_count

    scores = np.zeros((count, c))
    information = np.zeros((count, c, c))
    np.add.at(scores, label, condensed.block_scores)
    np.add.at(information, label, condensed.block_information)

    recording_of_label = np.zeros(count, dtype=int)
    recording_of_label[label] = recording
    known = condensed.reduced_private_rows.reshape(-1, c + 1)
    return Blocks(
        scores=scores,
        information=information,
        prior_rows=np.concatenate([condensed.common_rows, known])[:, :-1],
        recording=recording_of_label,
    )


def block_length(correlation_rows: Sequence[float], rows: int) -> float:
    """Number of rows of a block that counts as independent.

    Args:
        correlation_rows: Autocorrelation time of the residuals of every output [rows].
        rows: Number of all rows.

    Returns:
        Four autocorrelation times, or one row for white noise; at most a twentieth of all rows.
    """
    longest = max(correlation_rows, default=1.0)
    wanted = LENGTH_PER_CORRELATION_TIME * longest if longest > WHITE_TIME else 1.0
    return min(wanted, max(rows / MIN_BLOCKS, 1.0))


def merge_blocks(recording: np.ndarray, rows: np.ndarray, min_rows: float) -> np.ndarray:
    """Merge consecutive blocks of a recording to longer blocks with enough rows.

    The last block of a recording has at least half of `min_rows`, if the recording is that long.

    Args:
        recording: (b,) index of the recording of every block, ascending.
        rows: (b,) number of rows of every block.
        min_rows: Smallest number of rows of a longer block.

    Returns:
        (b,) number of the longer block to which each block belongs.
    """
    # Rows from each block to the end of its recording.
    to_end = np.cumsum(rows[::-1])[::-1]
    after_recording = np.searchsorted(recording, recording, side="right")
    left_in_recording = to_end - np.append(to_end, 0.0)[after_recording]

    numbers = np.zeros(len(rows), dtype=int)
    number = -1
    filled = 0.0
    for b in range(len(rows)):
        is_new_recording = b == 0 or recording[b] != recording[b - 1]
        is_full = filled >= min_rows and left_in_recording[b] >= 0.5 * min_rows
        if is_new_recording or is_full:
            number += 1
            filled = 0.0
        numbers[b] = number
        filled += rows[b]
    return numbers

"""Thinned motions of iterates: how many are kept, which ones, and at which samples."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
from numpy.testing import assert_array_equal

from mjfim.records.design import (
    MAX_MOTIONS,
    MOTION_SAMPLES,
    HistoryRow,
    extended,
    iterate_motion,
    without_motions,
)
from mjfim.records.trajectory import Trajectory
from tests.support.made_records import make_row


def moved(samples: int) -> Trajectory:
    """A trajectory of one slide, whose position is its time."""
    t = 0.01 * np.arange(samples + 1)
    empty = np.zeros((samples + 1, 0))
    return Trajectory(t=t, qpos=t[:, None], qvel=t[:, None], act=empty, ctrl=t[:-1, None])


def test_a_motion_has_both_ends_and_evenly_spread_samples() -> None:
    motion = iterate_motion(moved(1000))
    assert motion is not None
    t, qpos, ctrl = motion
    assert t.shape == (MOTION_SAMPLES,) and qpos.shape == (MOTION_SAMPLES, 1)
    assert t[0] == 0.0 and t[-1] == 10.0
    assert np.ptp(np.diff(t)) < 0.011
    assert_array_equal(qpos[:, 0], t)
    assert_array_equal(ctrl[:-1, 0], t[:-1])


def test_short_and_diverged_iterates_are_taken() -> None:
    short = iterate_motion(moved(3))
    assert short is not None
    assert set(short[0].tolist()) == {*moved(3).t.astype(np.float32).tolist()}
    assert iterate_motion(None) is None
    diverged = replace(moved(3), qpos=np.full((4, 1), np.inf))
    assert iterate_motion(diverged) is None


def test_many_iterates_keep_few_motions_evenly_spread() -> None:
    history: tuple[HistoryRow, ...] = ()
    motion = iterate_motion(moved(5))
    for iteration in range(500):
        history = extended(history, [make_row(iteration=iteration, motion=motion)])
    kept = [entry.iteration for entry in history if entry.motion is not None]
    assert len(history) == 500 and len(kept) == MAX_MOTIONS
    assert kept[0] == 0 and kept[-1] == 499
    assert np.diff(kept).max() <= 4 * np.median(np.diff(kept))


def test_motions_are_separated_from_the_history() -> None:
    by_iteration = {0: None, 1: iterate_motion(moved(9)), 4: iterate_motion(moved(5))}
    rows = [make_row(iteration=i, motion=motion) for i, motion in by_iteration.items()]
    history, motions = without_motions(rows)
    assert all(entry.motion is None for entry in history)
    assert motions is not None and motions.iteration.tolist() == [1.0, 4.0]
    assert motions.qpos.shape == (2, MOTION_SAMPLES, 1)
    assert without_motions(history)[1] is None

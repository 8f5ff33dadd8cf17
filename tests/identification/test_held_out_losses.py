"""Losses of predictions of left-out data, and the rule by which they are compared."""

from __future__ import annotations

import numpy as np
import pytest

from mjfim.identification.identify import least_squares
from mjfim.identification.left_out import HeldOutLosses, held_out_losses
from mjfim.parallel.budget import Budget
from tests.support.cart_pendulum import cart_pendulum, fit_of


def losses(
    values: list[float], counts: list[float] | None = None, parts: list[int] | None = None
) -> HeldOutLosses:
    """Losses of some blocks."""
    return HeldOutLosses(
        losses=np.array(values),
        counts=np.ones(len(values)) if counts is None else np.array(counts),
        parts=np.zeros(len(values), dtype=int) if parts is None else np.array(parts),
        estimates=np.zeros((1, 1)),
    )


def test_the_standard_error_is_that_of_paired_differences() -> None:
    rng = np.random.default_rng(0)
    common = 10.0 * rng.random(2000)
    first = losses((common + 1.0).tolist())
    second = losses((common + rng.normal(0.0, 0.2, 2000)).tolist())
    reduction = first.reduction(second)

    # What both have in common does not count.
    assert reduction.mean == pytest.approx(1.0, abs=0.02)
    assert reduction.standard_error == pytest.approx(0.2 / np.sqrt(2000), rel=0.1)
    assert reduction.is_clear
    assert not second.reduction(first).is_clear


def test_the_standard_error_with_blocks_of_different_sizes_is_that_of_the_scatter() -> None:
    rng = np.random.default_rng(1)
    counts = np.array([5.0, 20.0, 10.0, 40.0, 15.0, 10.0])
    means = []
    stated = []
    for _ in range(3000):
        difference = np.array([rng.normal(0.3, 1.0, int(count)).sum() for count in counts])
        reduction = losses(difference.tolist(), counts.tolist()).reduction(
            losses([0.0] * len(counts), counts.tolist())
        )
        means.append(reduction.mean)
        stated.append(reduction.standard_error**2)
    assert np.mean(means) == pytest.approx(0.3, abs=0.01)
    assert np.mean(stated) == pytest.approx(np.var(means), rel=0.25)


def test_a_model_that_diverges_is_never_better() -> None:
    good, bad = losses([1.0, 2.0]), losses([1.0, np.inf])
    assert not good.reduction(bad).is_clear
    assert bad.reduction(good).is_clear
    assert not bad.reduction(bad).is_clear


def test_a_difference_without_scatter_is_not_clear_where_it_is_tiny() -> None:
    # Two models that no data tell apart, whose searches ended at slightly different places.
    first = losses([1.0] * 20)
    assert not first.reduction(losses([1.0 - 1e-6] * 20)).is_clear
    assert first.reduction(losses([1.0 - 1e-2] * 20)).is_clear


def test_a_reduction_in_one_recording_only_is_not_clear() -> None:
    """Twenty blocks agree within each recording, but the recordings contradict each other."""
    parts = [0] * 10 + [1] * 10
    before = losses([1.0] * 20, parts=parts)
    one_better = losses([0.7] * 10 + [1.1] * 10, parts=parts)
    both_better = losses([0.8] * 10 + [0.9] * 10, parts=parts)
    assert before.reduction(one_better).mean == pytest.approx(0.1)
    assert not before.reduction(one_better).is_clear
    assert before.reduction(both_better).is_clear


@pytest.mark.parametrize(
    ("segments", "parts"),
    [
        ("whole", 5),
        pytest.param(0.75, 5, marks=pytest.mark.slow),
        pytest.param(0.2, 4, marks=pytest.mark.slow),
    ],
)
def test_a_single_recording_is_predicted_in_parts(segments: float | str, parts: int) -> None:
    """Each part is a stretch of the recording, also of a whole one or of two segments."""
    problem = fit_of(cart_pendulum(horizon=1.5, fit={"segments": segments}), 1).problem()
    solution = least_squares(problem, np.array([2.0, 1.0, 1.0]))
    found = held_out_losses(problem, solution, problem.noise.sigma, Budget())
    assert found is not None

    # All values are predicted once.
    assert len(found.estimates) == parts
    assert set(found.parts.tolist()) == set(range(parts))
    assert found.counts.sum() == sum(int(mask.sum()) for mask in problem.masks)

    # The estimates without each part scatter about as much as the noise explains.
    std = np.sqrt(np.diag(np.linalg.inv(solution.condensed.information())))
    assert (found.jackknife < 4.0 * std).all()
    assert (found.jackknife > std / 4.0).all()
    assert found.error == pytest.approx(1.0, abs=0.2)

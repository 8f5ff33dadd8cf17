"""Sizes of which the relative standard deviations of all verbs are a share."""

from __future__ import annotations

from pathlib import Path

from numpy.testing import assert_array_equal

from tests.support.limits import floating_task
from tests.support.numerics import cart_task


def test_an_entry_of_a_vector_has_the_size_of_the_whole(tmp_path: Path) -> None:
    task = floating_task(
        tmp_path,
        parameters={
            "m": {"target": "body/fore:mass"},
            "x": {"target": "body/fore:ipos[0]"},
            "z": {"target": "body/fore:ipos[2]"},
        },
    )
    assert task.theta[1] != 0.0
    assert task.theta[2] == 0.0

    sizes = task.parameters.sizes(task.theta)
    assert sizes[0] == task.theta[0]
    assert sizes[1] == sizes[2] >= abs(task.theta[1])


def test_the_size_of_a_single_number_follows_its_value(tmp_path: Path) -> None:
    task = cart_task(tmp_path, parameters={"m": {"target": "body/cart:mass"}})
    assert_array_equal(task.parameters.sizes(-3.0 * task.theta), 3.0 * task.theta)

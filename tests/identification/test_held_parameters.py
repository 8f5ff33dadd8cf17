"""Parameters that keep their guess: `fit.hold`."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

import mjfim
from mjfim.output.pages import page_of
from tests.support.cart_pendulum import cart_pendulum, logs_of


def stated(hold: tuple[str, ...]) -> mjfim.Experiment:
    """The cart-pendulum, one parameter of which is held at its true value."""
    fit = {"bootstrap": 0, "hold": hold}
    return cart_pendulum(horizon=1.0, parameters={"c": {"guess": 1.0}}, fit=fit)


@pytest.mark.slow
def test_a_held_parameter_keeps_its_guess_and_the_others_are_fitted(tmp_path: Path) -> None:
    logs = logs_of(stated(()), 0)
    found = mjfim.identify(stated(("c",)), logs, threads=1)
    free = mjfim.identify(stated(()), logs, threads=1)
    assert found.converged
    assert found.held == ("c",)
    assert (found.theta[2], found.std[2], *found.interval[2]) == (1.0, 0.0, 1.0, 1.0)

    # What is known about one parameter makes the others more accurate, and does not bias them.
    assert (found.std[:2] < free.std[:2]).all()
    assert (np.abs(found.theta[:2] - [2.0, 1.0]) < 4.0 * found.std[:2]).all()

    # The summary and the report say so, and the record is saved.
    assert "held" in page_of(found).tables[0].rows[2].cells
    found.save(tmp_path)
    assert mjfim.Estimate.load(tmp_path).held == ("c",)


@pytest.mark.parametrize(
    ("hold", "message"),
    [
        (("d",), r"fit\.hold: unknown parameter 'd'"),
        (("m", "l", "c"), r"fit\.hold: all parameters are held"),
    ],
)
def test_what_cannot_be_held_is_refused(hold: tuple[str, ...], message: str) -> None:
    with pytest.raises(mjfim.MjfimError, match=message):
        mjfim.identify(stated(hold), logs_of(stated(()), 0), threads=1)

"""The length of the segments is chosen by prediction where a model does not explain the data."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mjfim
from mjfim.errors import SimulationDivergedError
from mjfim.identification.identify import DIVERGED
from mjfim.identification.search import FitSearch
from mjfim.identification.starts import _chosen
from mjfim.output.pages.estimate import horizon_parts
from mjfim.records.estimate import HorizonStudy
from mjfim.records.trajectory import Recording
from tests.identification.test_held_out_losses import losses
from tests.support.cart_pendulum import cart_pendulum, logs_of

CONTROL = {"kind": "multisine", "amplitude": 4.0, "frequency": 0.4, "harmonics": 6}


def stated(**tables: object) -> mjfim.Experiment:
    """The cart-pendulum under a multisine."""
    fit = {"bootstrap": 0, **tables}
    return cart_pendulum(horizon=2.5, initial={"control": CONTROL}, fit=fit)


def made_study(**changes: object) -> HorizonStudy:
    """A study of two lengths and two parameters, of which the first depends on the length."""
    values = {
        "lengths": np.array([0.5, 4.0]),
        "errors": np.array([[1.0, 8.0], [1.2, 6.0]]),
        "chosen": 1,
        "is_whole": True,
        "parameters": ("mass", "damping"),
        "units": ("kg", "N s/m"),
        "theta": np.array([[83.0, 10.0], [94.0, 11.0]]),
        "half_widths": np.array([[1.0, 2.0], [2.0, 2.0]]),
        "is_apart": np.array([[True, False], [False, False]]),
        **changes,
    }
    return HorizonStudy(**values)  # type: ignore[arg-type]


def log_with(friction: float, count: int) -> list[Recording]:
    """Recordings of a robot whose cart has dry friction, which the model lacks."""
    parameters = {"f": {"target": "joint/slide:frictionloss", "guess": friction, "scale": 1.0}}
    return logs_of(stated().replace(parameters=parameters), *range(count))


@pytest.mark.slow
def test_lengths_are_compared_where_the_model_lacks_a_term() -> None:
    logs = log_with(0.6, 2)
    found = mjfim.identify(stated(), logs)
    assert found.misfit
    study = found.horizons
    assert study.errors.shape == (len(study.lengths), len(study.lengths))
    assert (np.diff(study.lengths) > 0.0).all()
    assert study.lengths[-1] == pytest.approx(2.5)

    # What friction does adds up, so that no fit predicts a long time as well as a short one.
    assert (study.errors[:, -1] > 1.2 * study.errors[:, 0]).all()

    # The interval holds the estimates of other lengths that chance does not explain.
    low, high = found.interval.T
    assert ((low <= study.theta) & (study.theta <= high))[study.is_apart > 0.0].all()

    # A stated length is not questioned, and is that of the segments.
    again = mjfim.identify(stated(segments=1.25), logs)
    assert again.horizons is None
    assert [len(begins) for begins in again.segments] == [2, 2]


def test_the_longest_length_is_chosen_unless_it_predicts_clearly_worse() -> None:
    rng = np.random.default_rng(0)
    noise = rng.random(20)
    best, same, worse = noise + 1.0, noise + 1.0 + rng.normal(0.0, 0.05, 20), noise + 1.5
    for of_lengths, expected in (
        ((best, same, best), 2),
        ((best, same, worse), 1),
        ((best, worse, worse), 0),
        # A difference of half a percent is clear here, but not relevant.
        ((best, 1.005 * best), 1),
    ):
        blocks = list(range(20))
        found = [[losses(each.tolist(), parts=blocks)] for each in of_lengths]
        assert _chosen(found) == expected


def test_a_dependence_on_the_length_is_a_finding_that_the_interval_covers() -> None:
    study = made_study()
    assert study.dependent == ("mass",)
    (finding,) = study.findings
    assert finding.startswith(
        "mass depends on the length: 83 kg with segments of 0.5 s and 94 kg with whole recordings"
    )
    interval = study.widened(np.array([[92.0, 96.0], [9.0, 13.0]]))
    assert_array_equal(interval, [[83.0, 96.0], [9.0, 13.0]])

    # The errors are those by which lengths are compared: relative to the smallest of each horizon.
    assert_allclose(study.relative_errors, [1.179, 1.105], rtol=1e-3)
    assert "each time: 1.1, 1.18 with segments of 0.5 s)" in study.about_choice
    assert "adds up with time" in study.about_growth
    flat = made_study(errors=np.array([[3.0, 3.2], [3.1, 3.3]]))
    assert "does not add up" in flat.about_growth

    # Without a dependence, nothing is widened and nothing is found.
    plain = made_study(is_apart=np.zeros((2, 2), dtype=bool))
    assert plain.findings == ()
    assert_array_equal(plain.widened(interval), interval)


def test_an_estimate_that_is_not_over_the_chosen_length_covers_it() -> None:
    study = made_study(chosen=0, is_apart=np.array([[False, False], [True, False]]))
    assert study.is_used and study.about_use == ""
    interval = np.array([[92.0, 96.0], [10.5, 13.0]])
    assert_array_equal(study.widened(interval), interval)

    # The estimate over whole recordings differs from that of the chosen length.
    unused = replace(study, why_not_used=DIVERGED)
    assert_array_equal(unused.widened(interval), [[83.0, 96.0], [10.5, 13.0]])
    assert unused.about_use.endswith("segments of 0.5 s: the fit over this length diverged.")
    assert unused.about_use in [getattr(part, "text", "") for part in horizon_parts(unused)]


@pytest.mark.slow
def test_a_failed_fit_over_the_chosen_length_is_said(monkeypatch: pytest.MonkeyPatch) -> None:
    """The estimate is over whole recordings where segments were chosen but cannot be fitted."""
    solve = FitSearch.solve

    def failing(*arguments: Any, **settings: Any) -> Any:
        """Diverge over segments."""
        if any(str(each).startswith("segments of") for each in arguments[3:]):
            raise SimulationDivergedError("it diverges")
        return solve(*arguments, **settings)

    monkeypatch.setattr("mjfim.identification.starts._chosen", lambda _: 0)
    monkeypatch.setattr(FitSearch, "solve", failing)
    found = mjfim.identify(stated(), log_with(0.6, 1))
    assert not found.horizons.is_used
    assert found.horizons.why_not_used == DIVERGED
    assert all(len(begins) == 1 for begins in found.segments)

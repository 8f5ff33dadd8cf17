"""Terms that a model lacks are selected by prediction of left-out data, and no others."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose, assert_array_equal

import mjfim
from mjfim.errors import SimulationDivergedError
from mjfim.excitation.task import DesignTask
from mjfim.experiment.system import simulate_system
from mjfim.parallel.budget import StopToken
from mjfim.records.terms import Decision
from mjfim.records.trajectory import Recording
from mjfim.studies import selection as selection_study
from tests.support.cart_pendulum import cart_pendulum
from tests.support.paths import ROOT

CONTROL = {"kind": "multisine", "amplitude": 4.0, "frequency": 0.4, "harmonics": 6}


def stated(segments: str | None = None, **tables: object) -> mjfim.Experiment:
    """The cart-pendulum under a multisine."""
    base = cart_pendulum()
    fit = {"bootstrap": 0} if segments is None else {"bootstrap": 0, "segments": segments}
    return base.replace(initial={"control": CONTROL}, fit=fit, **tables)


def recorded(folder: Path, added: str, count: int, horizon: float = 2.0) -> list[Recording]:
    """Recordings of a robot whose cart has attributes that the model lacks."""
    text = (ROOT / "models" / "cart_pendulum.xml").read_text(encoding="utf-8")
    changed = text.replace('axis="1 0 0"/>', f'axis="1 0 0" {added}/>')
    (folder / "cart_pendulum.xml").write_text(changed, encoding="utf-8")
    values = stated(horizon=horizon).model_dump(exclude_unset=True)
    task = DesignTask.resolve(mjfim.Experiment(**{**values, "directory": folder}))
    return [simulate_system(task.system, task.initial, seed) for seed in range(count)]


@pytest.mark.slow
def test_the_missing_term_is_added_and_nothing_else(tmp_path: Path) -> None:
    logs = recorded(tmp_path, 'frictionloss="0.5"', count=3)
    *fitted, kept = logs
    found = mjfim.select_terms(stated(), fitted, held_out=[kept])
    selection = found.selection
    assert [term.path for term in selection.terms] == ["joint/slide:frictionloss"]
    assert [step.decision for step in selection.steps if step.is_kept] == [
        Decision.BEGUN,
        Decision.ADDED,
    ]
    assert not found.misfit

    # With the term, left-out data are predicted as well as the noise permits.
    before, after = selection.errors
    assert before > after + 0.1
    assert after == pytest.approx(1.0, abs=0.1)
    (prediction,) = found.predictions
    assert prediction.held_out
    assert (prediction.identified.rms < prediction.nominal.rms).all()

    # The interval of the new parameter covers the true value.
    j = found.parameters.index("slide_frictionloss")
    low, high = found.interval[j]
    assert low < 0.5 < high
    assert found.initial_theta[j] == 0.0

    # The same experiment with the terms is what was identified.
    again = mjfim.identify(stated().replace(parameters=selection.parameters), fitted)
    assert_allclose(again.theta, found.theta, rtol=2e-2)


@pytest.mark.slow
def test_a_complete_model_stays_as_it_is(tmp_path: Path) -> None:
    logs = recorded(tmp_path, "", count=2)
    found = mjfim.select_terms(stated(), logs)
    assert not found.selection.terms
    assert len(found.selection.steps) == 1
    assert found.parameters == ("m", "l", "c")

    # Without a term, the estimate is that of an ordinary identification.
    plain = mjfim.identify(stated(), logs)
    assert_array_equal(found.theta, plain.theta)
    assert_array_equal(found.interval, plain.interval)

    # The length of the segments, which the user left free, is still free.
    assert mjfim.selected_experiment(stated(), found.selection) == stated()


@pytest.mark.slow
def test_terms_that_no_data_tell_apart_are_named_with_what_they_imply(tmp_path: Path) -> None:
    """Inertia of the cart or of the hinge, a weaker motor and a payload have the same effect."""
    found = mjfim.select_terms(stated(), recorded(tmp_path, 'armature="0.9"', count=2))
    (term,) = found.selection.terms
    assert term.path == "joint/slide:armature"
    (step,) = [step for step in found.selection.steps if step.decision is Decision.ADDED]
    others = {other.path: other.values for other in step.alternatives}
    assert set(others) == {
        "joint/hinge:armature",
        "actuator/force:gainprm[0]",
        "term/pendulum_payload:mass",
    }

    # Inertia about the hinge instead of the cart's needs a heavier bob on a shorter rod:
    # m = 2 + 0.9 and m l = 2.
    values = others["joint/hinge:armature"]
    assert values["m"] == pytest.approx(2.9, rel=0.1)
    assert values["m"] * values["l"] == pytest.approx(2.0, rel=0.05)
    found.save(tmp_path / "results")
    assert mjfim.Estimate.load(tmp_path / "results").selection == found.selection


def test_a_selection_that_is_stopped_returns_what_it_has(tmp_path: Path) -> None:
    stop = StopToken()
    logs = recorded(tmp_path, 'frictionloss="0.5"', count=2)
    found = mjfim.select_terms(stated(), logs, stop=stop, callback=lambda event: stop.request())
    assert found.interrupted
    assert len(found.theta) == 3

    # The selection says that nothing was tried.
    assert "interrupted before a term was tried" in str(found.selection)
    assert "σ" not in str(found.selection)


@pytest.mark.slow
def test_a_selection_that_cannot_predict_left_out_data_says_so(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """The estimate is that of an ordinary identification, with the length that it chooses."""
    monkeypatch.setattr(selection_study, "held_out_losses", lambda *args: None)
    logs = recorded(tmp_path, 'frictionloss="0.5"', count=1, horizon=1.0)
    found = mjfim.select_terms(stated(), logs)
    selection = found.selection
    assert "No part of the recordings could be predicted" in str(selection)
    assert not found.interrupted

    plain = mjfim.identify(stated(), logs)
    assert_allclose(found.theta, plain.theta, rtol=1e-4)

    # The error that is not known is shown, drawn and saved as such.
    found.save(tmp_path / "results")
    (step,) = mjfim.Estimate.load(tmp_path / "results").selection.steps
    assert np.isnan(step.error)


@pytest.mark.slow
def test_a_term_with_which_the_simulation_diverges_is_not_added(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    def diverge(*args: object, **options: object) -> None:
        """Fail as a fit does whose start cannot be simulated."""
        raise SimulationDivergedError("the simulation diverges at the start")

    monkeypatch.setattr(selection_study, "refit_task", diverge)
    logs = recorded(tmp_path, 'frictionloss="0.5"', count=2, horizon=1.0)
    found = mjfim.select_terms(stated(segments="whole"), logs)
    assert not found.selection.terms
    assert "No further term predicts" in found.selection.ending


@pytest.mark.slow
def test_two_missing_terms_are_both_found(tmp_path: Path) -> None:
    logs = recorded(tmp_path, 'frictionloss="0.3" stiffness="2"', count=2, horizon=3.0)
    found = mjfim.select_terms(stated(), logs)
    paths = {term.path for term in found.selection.terms}
    assert paths == {"joint/slide:frictionloss", "joint/slide:stiffness"}
    assert not found.misfit

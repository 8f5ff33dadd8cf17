"""Advice about segments for motions that amplify deviations."""

from __future__ import annotations

import re
from pathlib import Path

import numpy as np
import pytest
from numpy.testing import assert_allclose

import mjfim
from mjfim.excitation.task import DesignTask
from mjfim.identification.assessment.report import amplifications, sentence_about_instability
from tests.range.plants import PLANTS, Setting


@pytest.mark.parametrize("rate", [0.0, 0.7, 5.0])
def test_amplification_of_an_exponential_motion(rate: float) -> None:
    """Also where the factor exceeds the largest number: it is known by its logarithm."""
    A = np.tile(np.diag([np.exp(rate), 0.5]), (1500, 1, 1))
    found = amplifications(A, np.array([3.0, 1e-3]))
    assert_allclose(found, 2.0 ** np.arange(11) * rate / np.log(10.0), rtol=1e-12)


def test_a_motion_that_stands_still_amplifies_nothing() -> None:
    assert amplifications(np.ones((5, 2, 2)), np.zeros(2)).tolist() == [0.0]


def test_rounding_errors_are_mentioned_where_they_change_the_motion() -> None:
    def text(amplification: float) -> str:
        return sentence_about_instability(amplification, 8.0, 0.25)

    assert "grows 1e5-fold within 8 s" in text(5.0)
    assert "rounding" not in text(5.0)
    assert "rounding errors alone change it" in text(29.0)


@pytest.mark.slow
def test_a_chaotic_motion_is_fitted_with_the_recommended_segments(tmp_path: Path) -> None:
    """One simulation ends in a local minimum; the warning says with which segments it works."""
    xml, stated = PLANTS["acrobot"](Setting(horizon=6.0))
    (tmp_path / "plant.xml").write_text(xml, encoding="utf-8")
    tables = {"model": "plant.xml", "directory": tmp_path, "source": "chaos.toml", **stated}
    experiment = mjfim.Experiment(**tables)
    control = DesignTask.resolve(experiment, threads=1).initial
    recording = mjfim.simulate(experiment, control, seed=1, threads=1)

    # The length of the segments that a fit chooses would be short enough, too.
    whole = experiment.replace(fit={"segments": "whole", "max_iterations": 8})
    poor = mjfim.identify(whole, [recording], threads=1)
    assert poor.misfit
    advice = re.search(r"unstable or chaotic.*State fit.segments = (\S+) in", poor.warnings[0])
    assert advice is not None

    experiment = mjfim.Experiment(**tables, fit={"segments": float(advice[1])})
    good = mjfim.identify(experiment, [recording], threads=1)
    true = [entry["true"] for entry in stated["parameters"].values()]
    assert (np.abs(good.theta - true) < 4.0 * good.std).all()
    assert good.chi2 / good.dof == pytest.approx(1.0, abs=0.1)
    assert not good.misfit

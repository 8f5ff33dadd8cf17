"""Warnings of an identification stay short with very many parameters and outputs."""

from __future__ import annotations

from types import SimpleNamespace

import numpy as np
import pytest

from mjfim.errors import ExperimentError
from mjfim.identification.report import _warnings_of_bounds, _warnings_of_search
from mjfim.identification.task import _start

# Longest message [characters].
LONGEST_MESSAGE = 600

# Names of many parameters, of which a message shows the first ones.
NAMES = tuple(f"inertia_of_link_{i}" for i in range(300))


def test_warnings_about_many_parameters_list_the_first_ones_and_count_the_others() -> None:
    findings = SimpleNamespace(at_bound=NAMES, outside=False)
    (warning,) = _warnings_of_bounds(findings)
    assert len(warning) < LONGEST_MESSAGE
    assert "inertia_of_link_0" in warning and " more" in warning


def test_a_warning_about_many_outputs_lists_the_first_ones() -> None:
    findings = SimpleNamespace(
        interrupted=False,
        unpredictable=None,
        quality=SimpleNamespace(unexplained=NAMES),
        accuracy=SimpleNamespace(groups=(), singular=False),
    )
    (warning,) = _warnings_of_search(findings)
    assert len(warning) < LONGEST_MESSAGE


def test_a_start_of_wrong_length_lists_the_first_parameters() -> None:
    system = SimpleNamespace(parameters=SimpleNamespace(guess=np.zeros(300), names=NAMES))
    with pytest.raises(ExperimentError) as raised:
        _start(system, "least_squares", np.zeros(2))
    assert len(str(raised.value)) < LONGEST_MESSAGE

"""The benchmark of passes over the data names the reason of every simulation of a fit."""

from __future__ import annotations

import importlib

import pytest

from scripts.benchmarks import rail

# Modules whose functions call for simulations.
MODULES = (
    "continuation",
    "cross_validation",
    "flipped_signs",
    "identify",
    "missing_terms",
    "searches",
)


def test_every_reason_belongs_to_a_function_of_a_fit() -> None:
    modules = [importlib.import_module(f"mjfim.identification.{name}") for name in MODULES]
    methods = [modules[-1].FitSearch]
    for name in rail.REASONS:
        assert any(hasattr(place, name) for place in (*modules, *methods)), name


@pytest.mark.slow
def test_all_passes_of_a_short_log_have_a_reason() -> None:
    found = rail.passes(2.0, 0)
    assert {"main search", rail.REWEIGHTING, "folds", "suspects"} <= set(found.by_reason)
    assert found.by_reason[rail.OTHER] < 20.0
    assert 0 < found.estimate.steps <= found.steps

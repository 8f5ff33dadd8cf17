"""Derivatives by differences agree with MJX, differentiated automatically in float64."""

from __future__ import annotations

import importlib

import pytest


@pytest.mark.slow
@pytest.mark.parametrize("model", ["two_joint_arm"])  # the others take longer to compile
def test_derivatives_agree_with_automatic_differentiation_of_mjx(model: str) -> None:
    for module in ("jax", "mujoco.mjx"):
        pytest.importorskip(module, reason="needs MJX: pip install 'mjfim[oracle]'")
    oracle = importlib.import_module("scripts.benchmarks.mjx_oracle")
    (case,) = (each for each in oracle.CASES if each.model == model)

    found = oracle.agreement(case)
    assert found.F < 1e-14
    assert found.psi < 1e-7
    assert found.A < 1e-8
    assert found.B < 3e-8
    assert found.mixed < 1e-5
    assert found.mixed_quick < 1e-2
    assert found.psi_closed < 1e-7
    assert found.mixed_closed < 1e-5

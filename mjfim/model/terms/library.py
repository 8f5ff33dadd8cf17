"""The library of terms: all kinds, and the terms of an experiment resolved against its model."""

from __future__ import annotations

from collections.abc import Iterable
from typing import Any

from mjfim.errors import ExperimentError, unknown
from mjfim.model.terms.base import Payload, Tilt
from mjfim.model.terms.drives import ActuatorLag, BackEmf
from mjfim.model.terms.elasticity import Backlash, JointElasticity
from mjfim.model.terms.friction import AsymmetricFriction, LuGre, Stribeck
from mjfim.model.terms.load_friction import LoadDependentFriction
from mjfim.model.terms.term import Term, TermTable

# All kinds of terms, by the name that the experiment file gives them.
KINDS: dict[str, type[Term]] = {
    kind.kind: kind
    for kind in (
        Stribeck,
        LuGre,
        AsymmetricFriction,
        LoadDependentFriction,
        BackEmf,
        ActuatorLag,
        JointElasticity,
        Backlash,
        Tilt,
        Payload,
    )
}


def resolve_terms(
    tables: Iterable[tuple[str, TermTable]], model: Any, period: float
) -> tuple[Term, ...]:
    """Resolve the terms of an experiment.

    Args:
        tables: Kind and table of each term.
        model: The stated model without terms (`mujoco.MjModel`).
        period: Sample period of the experiment [s].

    Raises:
        ExperimentError: A table does not fit the model; the message names its key.
    """
    terms = []
    for kind, table in tables:
        if kind not in KINDS:
            raise ExperimentError(f"terms.{table.name}.kind: {unknown('kind', kind, list(KINDS))}")
        try:
            terms.append(KINDS[kind].of(table, model, period))
        except ExperimentError as error:
            raise ExperimentError(f"terms.{table.name}: {error}") from None
    return tuple(terms)

"""The physical terms of an experiment, resolved from its table `terms`."""

from __future__ import annotations

from mjfim.experiment.schema import Experiment
from mjfim.experiment.system_tables import TermSpec
from mjfim.model.loading import ModelSource
from mjfim.model.terms.library import resolve_terms
from mjfim.model.terms.term import ELEMENT_KEYS, Term, TermTable


def terms_of(experiment: Experiment, stated: ModelSource) -> tuple[Term, ...]:
    """Resolve the terms of an experiment, in their order in the file.

    Args:
        experiment: The experiment.
        stated: Its model without terms.

    Raises:
        ExperimentError: A table does not fit the model; the message names its key.
    """
    tables = [(spec.kind, _table(name, spec)) for name, spec in experiment.terms.items()]
    return resolve_terms(tables, stated.model, 1.0 / experiment.rate)


def _table(name: str, spec: TermSpec) -> TermTable:
    """A table of the experiment file as the library takes it."""
    elements = ((key, getattr(spec, key)) for key in ELEMENT_KEYS)
    return TermTable(
        name=name,
        element=tuple((key, element) for key, element in elements if element is not None),
        encoder=spec.encoder,
        values=tuple((field, float(value)) for field, value in spec.values.items()),
    )

"""What an experiment can see at all: along its own trajectory, and along random ones, which tell whether another would help."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from mjfim.arrays import Array
from mjfim.errors import SimulationDivergedError, UnidentifiableError
from mjfim.excitation.initial_controls import probes
from mjfim.experiment.system import Setup
from mjfim.information.fisher import Information
from mjfim.information.null_space import BLIND, COARSER, SURE, Null, grouped, invisible
from mjfim.plant.derivatives import SENSITIVITY_STEP
from mjfim.records.combinations import ParameterGroup, combination_matrix
from mjfim.records.design import CombinationAccuracy
from mjfim.records.trajectory import Sensitivity, Trajectory

PROBES = 3
ROUND_OFF = 1e-7  # relative error of rows that are taken from an information matrix
FAINTEST = 1e-6  # of the strongest effect in earlier experiments; less is their round-off
LOCAL = 60  # samples of a trajectory that are looked at one by one, before all of them
ONE_STEPS = (1e-4, 4e-4)  # relative to the parameters' sizes: a single step is smooth in them


@dataclass(frozen=True, eq=False)
class Survey:
    """Invisible directions here (along the given trajectory) and always (also along random multisines).

    names: of the wanted parameters;  groups_here, groups_always: the same in words
    """

    names: tuple[str, ...]
    here: Null
    always: Null
    groups_here: tuple[ParameterGroup, ...]
    groups_always: tuple[ParameterGroup, ...]

    @property
    def basis(self) -> Array | None:
        """(t, s) combinations that some experiment can see; None where all parameters are such."""
        return self.always.basis if self.always.count else None

    def combined(
        self, information: Information, values: Array, before: Array, after: Array
    ) -> tuple[CombinationAccuracy, ...]:
        """The visible combinations of `groups_always`: words, value and standard deviations of two informations (p, p).

        values: (t,) of the wanted parameters
        """
        rows = combination_matrix(self.groups_always, self.names)
        words = [str(c) for group in self.groups_always for c in group.combinations]
        combined_values = (rows @ values).tolist()
        std_before = information.spread(before, rows).tolist()
        std_after = information.spread(after, rows).tolist()

        columns = zip(words, combined_values, std_before, std_after, strict=True)
        return tuple(
            CombinationAccuracy(expression=name, value=value, std_initial=initial, std_final=final)
            for name, value, initial, final in columns
        )


def rows(setup: Setup, sensitivity: Sensitivity) -> Array:
    """(n, p) whitened rows of G at the measured samples."""
    return setup.noise.whitened_rows(sensitivity.G)


def survey(setup: Setup, trajectory: Trajectory, sensitivity: Sensitivity) -> Survey:
    """Look along a trajectory whose sensitivity is known; further only where that leaves a doubt."""
    J = rows(setup, sensitivity)
    local = _local(setup, [trajectory])
    quick = _null(setup, [J], None, local)
    if quick.smallest > SURE and not quick.count:
        return _words(setup, quick, quick)
    return _survey(setup, trajectory, *_pair(setup, trajectory, sensitivity), local)


def survey_rows(setup: Setup, trajectory: Trajectory, J: Array, error: Array) -> Survey:
    """Look at given rows of G: (n, p) and their error; along random trajectories only where that leaves a doubt.

    trajectory: one of those that the rows belong to
    """
    return _survey(setup, trajectory, J, error, _local(setup, [trajectory]))


def _survey(
    setup: Setup, trajectory: Trajectory, J: Array, error: Array, local: Array | None
) -> Survey:
    here = _null(setup, [J], [error], local)
    if not here.count:
        return _words(setup, here, here)
    tried = list(probes(setup, PROBES))
    always = _local(setup, [trajectory, *tried])
    stack, errors = [J], [error]
    if always is None or here.count > always.shape[1]:
        for probe in tried:
            fine = setup.plant.derivatives.sensitivity(setup.theta, probe)
            if fine is not None:
                more, doubt = _pair(setup, probe, fine)
                stack.append(more)
                errors.append(doubt)
    return _words(setup, here, _null(setup, stack, errors, always))


def _local(setup: Setup, trajectories: Sequence[Trajectory]) -> Array | None:
    """(t, k) directions without effect on single steps and their outputs: exact, even where whole motions are chaotic.

    Such a direction moves nothing, whatever is measured. None: there is no parameter inside the model.
    """
    p = setup.parameters
    inside = p.interest[p.changes_model[p.interest]]
    if not len(inside):
        return None
    unseen = np.zeros_like(setup.prior)
    every = max(t.samples for t in trajectories)
    for most in (LOCAL, every):  # what a few samples do not show, a contact between them may
        found = _stepped(setup, trajectories, most)
        if found is None:
            return None
        J, error = (each[:, inside] for each in found)
        null = invisible(
            J, error, p.magnitude[inside], p.scale[inside], np.arange(len(inside)), unseen
        )
        if not null.count:
            break
    out = np.zeros((len(p.interest), null.count))
    out[np.searchsorted(p.interest, inside)] = null.directions
    return _unseen_before(setup, out)


def _stepped(
    setup: Setup, trajectories: Sequence[Trajectory], most: int
) -> tuple[Array, Array] | None:
    """Effects on single steps at no more than so many samples of each trajectory, and their error; None where all diverge."""
    stack, errors = [], []
    for trajectory in trajectories:
        picked = np.unique(
            np.linspace(0, trajectory.samples - 1, min(most, trajectory.samples)).astype(int)
        )
        try:
            first, second = (
                setup.plant.derivatives.one_step(setup.theta, trajectory, picked, step)
                for step in ONE_STEPS
            )
        except SimulationDivergedError:
            continue
        stack.append(first)
        errors.append(second - first)
    return (np.concatenate(stack), np.concatenate(errors)) if stack else None


def _words(setup: Setup, here: Null, always: Null) -> Survey:
    p = setup.parameters
    names = tuple(p.names[j] for j in p.interest)
    size, units = p.magnitude[p.interest], [p.parameters[j].unit for j in p.interest]
    return Survey(
        names, here, always, grouped(here, names, size, units), grouped(always, names, size, units)
    )


def _null(
    setup: Setup, stack: Sequence[Array], errors: Sequence[Array] | None, known: Array | None
) -> Null:
    p = setup.parameters
    before = _rows_of(setup.earlier)
    error = None if errors is None else np.concatenate([*errors, ROUND_OFF * np.abs(before)])
    return invisible(
        np.concatenate([*stack, before]),
        error,
        p.magnitude,
        p.scale,
        p.interest,
        setup.prior,
        known,
    )


def _rows_of(information: Array) -> Array:
    """(n, p) rows whose squares add up to what earlier experiments told."""
    values, vectors = np.linalg.eigh(information)
    kept = values > 1e-14 * max(float(values[-1]), 0.0)
    return np.asarray(np.sqrt(values[kept])[:, None] * vectors.T[kept])


def _unseen_before(setup: Setup, directions: Array) -> Array:
    """Those (t, k) directions of the wanted parameters that earlier experiments do not see either."""
    if not setup.earlier.any() or not directions.shape[1]:
        return directions
    unit = directions / np.linalg.norm(
        directions / setup.parameters.magnitude[setup.parameters.interest][:, None], axis=0
    )
    before = _rows_of(setup.earlier)
    effect = before[:, setup.parameters.interest] @ unit
    _, values, V = np.linalg.svd(
        np.concatenate([effect, np.zeros((unit.shape[1], unit.shape[1]))]), full_matrices=False
    )
    strongest = np.linalg.norm(before * setup.parameters.magnitude, 2)
    return np.asarray(unit @ V[values <= max(BLIND, FAINTEST * strongest)].T)


def _pair(setup: Setup, trajectory: Trajectory, fine: Sensitivity) -> tuple[Array, Array]:
    """Rows of G and their change with the longer step (all of them where that diverges)."""
    J = rows(setup, fine)
    coarse = setup.plant.derivatives.sensitivity(
        setup.theta, trajectory, COARSER * SENSITIVITY_STEP
    )
    return J, np.zeros_like(J) if coarse is None else rows(setup, coarse) - J


def require_visible(setup: Setup, J: Array) -> None:
    """Raise UnidentifiableError where a wanted parameter cannot be told from data with these rows of G. J: (n, p)"""
    p = setup.parameters
    null = invisible(J, None, p.magnitude, p.scale, np.arange(len(p)), setup.prior)
    if null.count:
        said = "; ".join(
            str(g) for g in grouped(null, p.names, p.magnitude, [q.unit for q in p.parameters])
        )
        raise UnidentifiableError(f"this trajectory does not show every parameter: {said}")

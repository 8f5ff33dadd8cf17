"""Identifiability of the parameters of an experiment: along its trajectory, and along random ones.

Random trajectories show whether another control would help.
"""

from __future__ import annotations

import itertools
from collections.abc import Callable, Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import partial

import numpy as np

from mjfim.arrays import Array, record
from mjfim.errors import SimulationDivergedError, UnidentifiableError
from mjfim.information.criteria import SINGULAR_RATIO
from mjfim.information.fisher import FisherInformation
from mjfim.information.null_space import (
    CLEAR_SINGULAR_VALUE,
    COARSER_STEP_FACTOR,
    LEAST_EFFECT,
    NullSpace,
    find_null_space,
    parameter_groups,
)
from mjfim.model.parameters import ParameterSet
from mjfim.plant.outputs import Noise
from mjfim.plant.plant import SENSITIVITY_STEP, Plant
from mjfim.records.base import ParameterValue, listed_values
from mjfim.records.check import (
    ParameterGroup,
    combination_matrix,
    combination_terms,
    groups_in_words,
)
from mjfim.records.trajectory import Sensitivity, Trajectory

# Number of random trajectories that are tried.
PROBES = 3

# Relative error of rows that are taken from an information matrix.
ROW_ROUND_OFF = 1e-7

# An effect below this fraction of the strongest one in earlier experiments is round-off.
NEGLIGIBLE_EFFECT = 1e-6

# Largest number of samples of a trajectory whose single steps are tested.
MOST_SAMPLES = 200

# Difference steps of the parameters for single engine steps, relative to the size of each
# parameter.
SINGLE_STEP_DIFFERENCES = (1e-4, 4e-4)

# An effect on a whole motion is certain if it exceeds this multiple of the derivatives' error.
CLEAR_EFFECT = 1e3


@dataclass(frozen=True, kw_only=True, eq=False)
class Identifiability:
    """Directions of the wanted parameters without effect on the measured outputs.

    Attributes:
        names: Names of the t wanted parameters.
        along_trajectory: Null space along the given trajectory.
        along_all: Common null space of the given and of random trajectories.
        groups_along_trajectory: Groups of parameters that the given trajectory cannot separate.
        groups_along_all: Groups of parameters that none of the trajectories can separate.
    """

    names: tuple[str, ...]
    along_trajectory: NullSpace
    along_all: NullSpace
    groups_along_trajectory: tuple[ParameterGroup, ...]
    groups_along_all: tuple[ParameterGroup, ...]

    @property
    def basis(self) -> Array | None:
        """(t, s) combinations that an experiment can identify; None if it can identify all."""
        return self.along_all.basis if self.along_all.count else None

    def combinations(
        self, information: FisherInformation, values: Array, before: Array, after: Array
    ) -> tuple[ParameterValue, ...]:
        """Identifiable combinations with their standard deviations for two information matrices.

        Args:
            information: Computes standard deviations of combinations from an information matrix.
            values: (t,) values of the wanted parameters.
            before: (p, p) information of the first experiment.
            after: (p, p) information of the second experiment.

        Returns:
            The combinations with σ by the second matrix, and σ by the first one as `std_initial`;
            empty if every parameter is identifiable.
        """
        rows = combination_matrix(self.groups_along_all, self.names)
        words = [
            " ".join(combination_terms(combination))
            for group in self.groups_along_all
            for combination in group.combinations
        ]
        first, second = (information.combination_std(matrix, rows) for matrix in (before, after))
        units = [""] * len(words)
        return tuple(listed_values(words, units, rows @ values, second, std_initial=first))


# Rows of G along a motion, and their change with a longer difference step.
RowsAndError = tuple[Array, Array]


@record
class IdentifiabilityTest:
    """Test for combinations of parameters that the outputs of a plant do not depend on.

    Attributes:
        plant: The plant.
        parameters: The p unknown parameters.
        noise: Noise of the measured outputs.
        theta: (p,) parameter values.
        earlier: (p, p) information of earlier experiments, without the priors of the parameters.
        probes: Function that simulates a number of random controls; it leaves out trajectories that
            diverge.
        differentiated: Function that does `rows_along` for several trajectories, on workers for
            example; None for one after the other.
    """

    plant: Plant
    parameters: ParameterSet
    noise: Noise
    theta: Array
    earlier: Array
    probes: Callable[[int], Iterator[Trajectory]]
    differentiated: Callable[[Iterable[Trajectory]], Iterable[RowsAndError | None]] | None = None

    @property
    def inside(self) -> np.ndarray:
        """(t,) True for the wanted parameters that change the model."""
        return np.asarray(self.parameters.changes_model[self.parameters.interest])

    @property
    def prior(self) -> Array:
        """(p, p) information of earlier experiments and of the priors."""
        return self.parameters.prior_information + self.earlier

    def rows(self, sensitivity: Sensitivity) -> Array:
        """(n, p) whitened rows of G at the measured samples."""
        return self.noise.whitened_rows(sensitivity.G)

    def rows_along(self, trajectory: Trajectory) -> RowsAndError | None:
        """Differentiate a whole motion by the parameters.

        Args:
            trajectory: The motion.

        Returns:
            (n, p) whitened rows of G, and (n, p) their change with a longer difference step; None
            where a perturbed simulation diverges.
        """
        fine = self.plant.derivatives.sensitivity(self.theta, trajectory)
        return None if fine is None else _rows_and_error(self, trajectory, fine)

    def along(
        self,
        trajectory: Trajectory,
        sensitivity: Sensitivity,
        stop: Callable[[], bool] = lambda: False,
    ) -> Identifiability:
        """Test identifiability along a trajectory.

        Random trajectories are tested only if this trajectory leaves a doubt.

        Args:
            trajectory: The trajectory.
            sensitivity: Its sensitivities to the parameters.
            stop: Asked before every random trajectory; true leaves out the rest of them.

        Returns:
            The null spaces.
        """
        J = self.rows(sensitivity)
        steps = _step_rows(self, trajectory)

        # One difference step is enough if all singular values are far larger than round-off.
        quick = null_space(self, [J], None, _hidden_from_steps(self, [steps]))
        if quick.smallest > CLEAR_SINGULAR_VALUE and not quick.count:
            return _with_groups(self, quick, quick)

        J, error = _rows_and_error(self, trajectory, sensitivity)
        return _identifiability(self, J, error, steps, stop)

    def of_rows(
        self,
        trajectory: Trajectory,
        J: Array,
        error: Array,
        stop: Callable[[], bool] = lambda: False,
    ) -> Identifiability:
        """Test identifiability from rows of G.

        Random trajectories are tested only if these rows leave a doubt.

        Args:
            trajectory: One of the trajectories to which the rows belong.
            J: (n, p) whitened rows of G.
            error: (n, p) their change with a longer difference step.
            stop: Asked before every random trajectory; true leaves out the rest of them.

        Returns:
            The null spaces.
        """
        steps = _step_rows(self, trajectory)
        return _identifiability(self, J, error, steps, stop)


def require_visible(parameters: ParameterSet, prior: Array, J: Array) -> None:
    """Raise an error if a parameter cannot be identified from data with these rows of G.

    Args:
        parameters: The p unknown parameters.
        prior: (p, p) prior information.
        J: (n, p) whitened rows of G.

    Raises:
        UnidentifiableError: A combination of parameters has no effect on the rows.
    """
    every = np.arange(len(parameters))
    null = find_null_space(J, None, parameters.magnitude, parameters.scale, every, prior)
    if not null.count:
        return

    units = [parameter.unit for parameter in parameters.parameters]
    groups = parameter_groups(null, parameters.names, parameters.magnitude, units)
    raise UnidentifiableError(
        f"not every parameter is identifiable from this trajectory: {groups_in_words(groups)}"
    )


def _identifiability(
    test: IdentifiabilityTest,
    J: Array,
    error: Array,
    steps: RowsAndError | None,
    stop: Callable[[], bool],
) -> Identifiability:
    """Null space of the rows of a motion, and the part of it that remains with random motions.

    Whole motions show small effects that add up, but are inaccurate where the motion is chaotic;
    single steps are accurate, but do not see every contact. A combination counts as hidden if
    neither shows it.

    Args:
        test: The test.
        J: (n, p) whitened rows of G of the motion.
        error: (n, p) change of J with a longer difference step.
        steps: What single steps of the motion show.
        stop: Asked before each random motion.
    """
    hidden = _hidden(test, [steps], J, error)
    along_trajectory = null_space(test, [J], [error], hidden)
    if not along_trajectory.count or stop():
        return _with_groups(test, along_trajectory, along_trajectory)

    tried = list(itertools.takewhile(lambda _: not stop(), test.probes(PROBES)))
    hidden = _hidden(test, [steps, *(_step_rows(test, probe) for probe in tried)], J, error)
    rows = [(J, error)]

    # Whole motions are differentiated only if single steps do not explain the null space.
    if hidden is None or along_trajectory.count > hidden.shape[1]:
        differentiated = test.differentiated or partial(map, test.rows_along)
        rows += filter(None, differentiated(itertools.takewhile(lambda _: not stop(), tried)))

    stack, errors = zip(*rows, strict=True)
    return _with_groups(test, along_trajectory, null_space(test, stack, errors, hidden))


def _step_rows(test: IdentifiabilityTest, trajectory: Trajectory) -> RowsAndError | None:
    """Effects on single steps of a trajectory and their outputs, and the error of these effects.

    Returns:
        (n, p) rows, and their change with a longer difference step; None where no parameter of the
        model is wanted, or where a step diverges. Control laws remember what happened before a
        sample, so that only whole motions are tested with them.
    """
    if not test.inside.any() or test.plant.laws is not None:
        return None
    count = min(MOST_SAMPLES, trajectory.samples)
    picked = np.unique(np.linspace(0, trajectory.samples - 1, count).astype(int))
    try:
        first, second = (
            test.plant.derivatives.one_step(test.theta, trajectory, picked, step)
            for step in SINGLE_STEP_DIFFERENCES
        )
    except SimulationDivergedError:
        return None
    return first, second - first


def _hidden_from_steps(
    test: IdentifiabilityTest, steps: Sequence[RowsAndError | None]
) -> Array | None:
    """(t, k) directions without effect on single steps; None where no step is known."""
    known = [each for each in steps if each is not None]
    if not known:
        return None
    parameters, interest = test.parameters, test.parameters.interest
    inside = interest[test.inside]
    J, error = (np.concatenate(rows)[:, inside] for rows in zip(*known, strict=True))
    null = find_null_space(
        J,
        error,
        parameters.magnitude[inside],
        parameters.scale[inside],
        np.arange(len(inside)),
        np.zeros_like(test.prior),
    )
    directions = np.zeros((len(interest), null.count))
    directions[test.inside] = null.directions
    if not test.earlier.any() or not null.count:
        return directions

    # Combinations that earlier experiments have shown are not hidden.
    before = _rows_of_information(test.earlier)
    strongest = np.linalg.norm(before * parameters.magnitude, 2)
    return _without_effect(test, directions, before, NEGLIGIBLE_EFFECT * float(strongest))


def _hidden(
    test: IdentifiabilityTest, steps: Sequence[RowsAndError | None], J: Array, error: Array
) -> Array | None:
    """Directions without effect on single steps that have none on a whole motion either.

    Small effects add up over a motion; a contact may be shorter than a sample.
    """
    directions = _hidden_from_steps(test, steps)
    if directions is None or not directions.shape[1]:
        return directions

    # Motions that cannot be differentiated accurately, as chaotic ones, are no evidence.
    unit = _in_units_of_size(test, directions)
    rounding = CLEAR_EFFECT * float(np.linalg.norm(error[:, test.parameters.interest] @ unit, 2))
    return _without_effect(test, directions, J, rounding)


def _without_effect(test: IdentifiabilityTest, directions: Array, J: Array, least: float) -> Array:
    """Combinations of (t, k) directions whose effect on rows J is below a bound."""
    unit = _in_units_of_size(test, directions)
    square = np.zeros((unit.shape[1], unit.shape[1]))
    effect = np.concatenate([J[:, test.parameters.interest] @ unit, square])
    _, values, V = np.linalg.svd(effect, full_matrices=False)
    return np.asarray(unit @ V[values <= max(LEAST_EFFECT, least)].T)


def _in_units_of_size(test: IdentifiabilityTest, directions: Array) -> Array:
    """Directions of length 1, where each parameter is measured by its size."""
    sizes = test.parameters.magnitude[test.parameters.interest][:, None]
    return np.asarray(directions / np.linalg.norm(directions / sizes, axis=0))


def _with_groups(
    test: IdentifiabilityTest, along_trajectory: NullSpace, along_all: NullSpace
) -> Identifiability:
    """Combine two null spaces with their groups of parameters."""
    parameters = test.parameters
    interest = parameters.interest
    names = tuple(parameters.names[j] for j in interest)
    size = parameters.magnitude[interest]
    units = [parameters.parameters[j].unit for j in interest]

    return Identifiability(
        names=names,
        along_trajectory=along_trajectory,
        along_all=along_all,
        groups_along_trajectory=parameter_groups(along_trajectory, names, size, units),
        groups_along_all=parameter_groups(along_all, names, size, units),
    )


def null_space(
    test: IdentifiabilityTest,
    stack: Sequence[Array],
    errors: Sequence[Array] | None,
    known: Array | None,
) -> NullSpace:
    """Null space of the stacked rows and of the rows of earlier experiments.

    Args:
        test: The plant and its parameters.
        stack: (n, p) whitened rows of G of each trajectory.
        errors: Errors of these rows, or None.
        known: (t, k) directions that are known to have no effect, or None.
    """
    parameters = test.parameters
    before = _rows_of_information(test.earlier)
    error = None
    if errors is not None:
        error = np.concatenate([*errors, ROW_ROUND_OFF * np.abs(before)])

    return find_null_space(
        np.concatenate([*stack, before]),
        error,
        parameters.magnitude,
        parameters.scale,
        parameters.interest,
        test.prior,
        known=known,
    )


def _rows_of_information(information: Array) -> Array:
    """(n, p) rows J with J'J equal to an information matrix (p, p)."""
    values, vectors = np.linalg.eigh(information)
    largest = max(float(values[-1]), 0.0)
    kept = values > SINGULAR_RATIO * largest

    lengths = np.sqrt(values[kept])
    return np.asarray(lengths[:, None] * vectors.T[kept])


def _rows_and_error(
    test: IdentifiabilityTest, trajectory: Trajectory, fine: Sensitivity
) -> tuple[Array, Array]:
    """Whitened rows of G (n, p), and their change with a longer difference step (n, p).

    The change is zero if the simulation with the longer step diverges.
    """
    J = test.rows(fine)
    step = COARSER_STEP_FACTOR * SENSITIVITY_STEP
    coarse = test.plant.derivatives.sensitivity(test.theta, trajectory, step)
    return J, np.zeros_like(J) if coarse is None else test.rows(coarse) - J
